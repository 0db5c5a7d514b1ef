"""Intervals of 95 % around measured shares and means, and around differences of two."""

from collections.abc import Sequence
from math import sqrt

import numpy as np

Z95 = 1.959964
"""Quantile of the normal distribution [standard deviations]."""
DRAWS = 2000
"""Samples of a bootstrap."""

FEWEST = 2
"""Fewest values of an interval; the spread of a single value is not known."""

Interval = tuple[float, float]


def wilson(successes: int, trials: int, z: float = Z95) -> Interval:
    """Return Wilson's score interval of a share (E. B. Wilson 1927): never outside [0, 1], never empty at 0 or 100 %."""
    share, scale = successes / trials, 1.0 + z**2 / trials
    middle = (share + 0.5 * z**2 / trials) / scale
    half = z / scale * sqrt(share * (1.0 - share) / trials + 0.25 * z**2 / trials**2)
    return max(0.0, min(share, middle - half)), min(1.0, max(share, middle + half))  # contains the share in spite of rounding


def newcombe(first: tuple[int, int], second: tuple[int, int]) -> Interval:
    """Return the interval of the difference second - first of two shares, each (successes, trials), from the Wilson intervals
    of both (R. G. Newcombe, Statistics in Medicine 17, 1998, method 10).
    """
    (a, (a_low, a_high)), (b, (b_low, b_high)) = ((n / of, wilson(n, of)) for n, of in (first, second))
    return (
        b - a - sqrt((b - b_low) ** 2 + (a_high - a) ** 2),
        b - a + sqrt((b_high - b) ** 2 + (a - a_low) ** 2),
    )


def mean_of_shares(shares: Sequence[tuple[int, int]]) -> tuple[float, Interval]:
    """Return the mean of equally weighted shares, each (successes, trials), and its interval from their Wilson intervals:
    squared distances to their ends add (G. Y. Zou and A. Donner, Statistics in Medicine 27, 2008). The interval has a width
    even if all shares are 0 or 100 %.
    """
    found = [(n / of, *wilson(n, of)) for n, of in shares]
    mean = sum(share for share, _, _ in found) / len(found)
    below, above = (sqrt(sum((one[0] - one[end]) ** 2 for one in found)) / len(found) for end in (1, 2))
    return mean, (max(0.0, mean - below), min(1.0, mean + above))


def normal_mean(mean: float, std: float, count: int) -> Interval | None:
    """Return the interval of a mean over `count` values, from their sample standard deviation and the normal distribution;
    None for fewer than two values.
    """
    if count < FEWEST:
        return None
    half = Z95 * std / sqrt(count)
    return mean - half, mean + half


def welch(first: tuple[float, float, int], second: tuple[float, float, int]) -> Interval | None:
    """Return the interval of the difference second - first of two means, each (mean, sample standard deviation, count), whose
    standard deviations may differ (B. L. Welch 1947), by the normal distribution, because counts are large. Return None if a
    mean has fewer than two values.
    """
    if min(first[2], second[2]) < FEWEST:
        return None
    half = Z95 * sqrt(sum(std**2 / count for _, std, count in (first, second)))
    difference = second[0] - first[0]
    return difference - half, difference + half


def bootstrap_mean(values: Sequence[float], seed: int = 0) -> Interval | None:
    """Return the percentile bootstrap interval of the mean of some values (B. Efron 1979), with a fixed seed; None for fewer
    than two values.
    """
    if len(values) < FEWEST:
        return None
    given = np.asarray(values, dtype=float)
    picks = np.random.default_rng(seed).integers(0, len(given), (DRAWS, len(given)))
    low, high = np.quantile(given[picks].mean(axis=1), (0.025, 0.975))
    return float(low), float(high)
