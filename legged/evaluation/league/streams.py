"""Random streams of the league: the Mersenne Twister of C++'s standard library, seeded by its `std::seed_seq`."""

from collections.abc import Sequence

import numpy as np

WORDS = 624
"""Number of 32-bit words in the state of the Mersenne Twister."""
MASK = 0xFFFFFFFF


def spread(words: Sequence[int], count: int = WORDS) -> np.ndarray:
    """Return `count` (at least 624) 32-bit words that `std::seed_seq` makes of the seeds `words` ([rand.util.seedseq])."""

    def mix(word: int) -> int:
        return word ^ word >> 27

    state, given = [0x8B8B8B8B] * count, [word & MASK for word in words]
    ahead = (count - 11) // 2
    for k in range(count + count):
        here, near, last = k % count, (k + ahead) % count, (k - 1) % count
        far = (near + 11) % count
        if k < count:
            near_add = 1664525 * mix(state[here] ^ state[near] ^ state[last]) & MASK
            own = len(given) if k == 0 else here + (given[k - 1] if k <= len(given) else 0)
            far_add = near_add + own & MASK
            state[near], state[far] = state[near] + near_add & MASK, state[far] + far_add & MASK
        else:
            near_add = 1566083941 * mix(state[here] + state[near] + state[last] & MASK) & MASK
            far_add = near_add - here & MASK
            state[near], state[far] = state[near] ^ near_add, state[far] ^ far_add
        state[here] = far_add
    return np.array(state, dtype=np.uint32)


class Stream:
    """One random stream of one run."""

    def __init__(self, run: int, number: int) -> None:
        """Begin stream `number` of the run with the id `run`."""
        self._twister = np.random.MT19937()
        self._twister.state = {"bit_generator": "MT19937", "state": {"key": spread((run, number)), "pos": WORDS}}

    def units(self, count: int) -> np.ndarray:
        """Return the next `count` numbers, uniform in [0, 1), (count,): the upper 24 bits of each 32-bit word."""
        return (self._twister.random_raw(count) >> 8) / 2.0**24

    def between(self, low: float, high: float) -> float:
        """Return the next number, uniform in [low, high)."""
        return low + (high - low) * float(self.units(1)[0])

    def below(self, bound: int) -> int:
        """Return an integer from 0 to bound - 1. Words that would favour small integers are drawn again."""
        share = 2**32 // bound
        while (word := int(self._twister.random_raw())) >= share * bound:
            pass
        return word // share
