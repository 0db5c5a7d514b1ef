"""95 % confidence intervals of measured shares and means, and of the difference of two shares or two means."""

from collections.abc import Sequence
from math import sqrt

import numpy as np

Z95 = 1.959964
"""0.975 quantile of the standard normal distribution."""
DRAWS = 2000
"""Number of resamples of a bootstrap."""

FEWEST = 2
"""Smallest number of values for which there is an interval. A single value has no spread."""

Interval = tuple[float, float]


def wilson(successes: int, trials: int, z: float = Z95) -> Interval:
    """Return Wilson's score interval of a share (E. B. Wilson 1927). It lies in [0, 1], and its width is never 0."""
    share, scale = successes / trials, 1.0 + z**2 / trials
    middle = (share + 0.5 * z**2 / trials) / scale
    half = z / scale * sqrt(share * (1.0 - share) / trials + 0.25 * z**2 / trials**2)
    return max(0.0, min(share, middle - half)), min(1.0, max(share, middle + half))  # rounding must not exclude the share


def newcombe(first: tuple[int, int], second: tuple[int, int]) -> Interval:
    """Return the interval of the difference `second` - `first` of two shares, computed from their Wilson intervals (R. G.
    Newcombe, Statistics in Medicine 17, 1998, method 10). Each share is given as (successes, trials).
    """
    (a, (a_low, a_high)), (b, (b_low, b_high)) = ((n / of, wilson(n, of)) for n, of in (first, second))
    return (
        b - a - sqrt((b - b_low) ** 2 + (a_high - a) ** 2),
        b - a + sqrt((b_high - b) ** 2 + (a - a_low) ** 2),
    )


def mean_of_shares(shares: Sequence[tuple[int, int]]) -> tuple[float, Interval]:
    """Return the equally weighted mean of `shares`, each (successes, trials), and the interval of the mean. The lower half
    of this interval is the root of the summed squares of the shares' distances to the lower ends of their Wilson intervals,
    divided by the number of shares. The upper half uses the upper ends (G. Y. Zou and A. Donner, Statistics in Medicine 27,
    2008). The interval has a width above 0 even if all shares are 0 or 100 %.
    """
    found = [(n / of, *wilson(n, of)) for n, of in shares]
    mean = sum(share for share, _, _ in found) / len(found)
    below, above = (sqrt(sum((one[0] - one[end]) ** 2 for one in found)) / len(found) for end in (1, 2))
    return mean, (max(0.0, mean - below), min(1.0, mean + above))


def normal_mean(mean: float, std: float, count: int) -> Interval | None:
    """Return the interval of a mean, computed with the normal distribution. `mean` and `std` are the mean and the sample
    standard deviation of `count` values. Return None for fewer than two values.
    """
    if count < FEWEST:
        return None
    half = Z95 * std / sqrt(count)
    return mean - half, mean + half


def welch(first: tuple[float, float, int], second: tuple[float, float, int]) -> Interval | None:
    """Return the interval of the difference `second` - `first` of two means, each (mean, sample standard deviation, count).
    The standard deviations may differ (B. L. Welch 1947). Counts are assumed to be large, so the normal distribution replaces
    Student's t. Return None if a count is below 2.
    """
    if min(first[2], second[2]) < FEWEST:
        return None
    half = Z95 * sqrt(sum(std**2 / count for _, std, count in (first, second)))
    difference = second[0] - first[0]
    return difference - half, difference + half


def bootstrap_mean(values: Sequence[float], seed: int = 0) -> Interval | None:
    """Return the percentile bootstrap interval of the mean of `values` (B. Efron 1979). The same `seed` gives the same
    interval. Return None for fewer than two values.
    """
    if len(values) < FEWEST:
        return None
    given = np.asarray(values, dtype=float)
    picks = np.random.default_rng(seed).integers(0, len(given), (DRAWS, len(given)))
    low, high = np.quantile(given[picks].mean(axis=1), (0.025, 0.975))
    return float(low), float(high)
