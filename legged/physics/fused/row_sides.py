"""On which side of its cost each constraint row was at the end of the last step: where most rows still are.

A row of a contact or a limit pushes or does not; one of dry friction holds, or slips one way or the other. Newton's method is
done once it knows which. Left to find out from the acceleration of the last step, it takes four rounds, because the forces
of stiff contacts hang on differences of accelerations that change from step to step by more than that; the sides themselves
seldom change. So it begins with those of the last step, and half of the rounds are saved, with nearly all line searches.
"""

from dataclasses import dataclass
from typing import Any

import warp as wp

UNKNOWN, SLIPPING_BACK, SLIPPING, IDLE, HOLDING = -3, -2, -1, 0, 1
"""Sides: of rows that nothing is known of; of dry friction whose force is its greatest, forwards or backwards; of rows that
do not push; and of those whose force is that of a spring. A row that was there is kept as 4 * its key + its side + 2."""
SIDES = {"UNKNOWN": UNKNOWN, "SLIPPING_BACK": SLIPPING_BACK, "SLIPPING": SLIPPING, "IDLE": IDLE, "HOLDING": HOLDING}
"""What native sources call them."""


@dataclass(frozen=True)
class RowSides:
    """Arrays of all worlds, on the device that was Warp's current one when they were made."""

    key: wp.array
    """(N, rows) by what a row is known again: rising from row to row, behind those of equalities."""
    last: wp.array
    """(N, 1 + rows) how many there were in the last step, and each of them, in the same order."""

    @classmethod
    def of(cls, d: Any) -> "RowSides":
        """Return those of mujoco-warp's data `d`, of which nothing is known yet."""
        return cls(wp.zeros((d.nworld, d.njmax), dtype=int), wp.zeros((d.nworld, 1 + d.njmax), dtype=int))
