"""Active set of the last step: the state of each constraint row at its end, which most rows keep in the next step.

The state of a row tells which piece of the row's piecewise cost applies. A row of a contact or a limit exerts force or does
not. A row of dry friction holds, or slips in one of two directions. Newton's method has converged when it knows all states.
Starting from the acceleration of the last step alone takes four iterations, because the forces of stiff contacts depend on
small differences of accelerations, and accelerations change by more than these between steps. The states seldom change, so
starting from them saves half of the iterations and nearly all line searches.
"""

from dataclasses import dataclass
from typing import Any

import warp as wp

UNKNOWN, SLIPPING_BACK, SLIPPING, IDLE, HOLDING = -3, -2, -1, 0, 1
"""States of rows: unknown; slipping backwards or forwards, with the greatest dry friction; idle, without force; holding, with
the force of a spring. The state of a row is stored as 4 * key + state + 2."""
ROW_STATES = {"UNKNOWN": UNKNOWN, "SLIPPING_BACK": SLIPPING_BACK, "SLIPPING": SLIPPING, "IDLE": IDLE, "HOLDING": HOLDING}
"""Names of the states in native sources."""


@dataclass(frozen=True)
class ActiveSet:
    """Arrays of all worlds, on Warp's current device at construction."""

    key: wp.array
    """(N, rows) stable key of each row, ascending, after the rows of equality constraints."""
    last: wp.array
    """(N, 1 + rows) number of rows in the last step, followed by their stored states in the same order."""

    @classmethod
    def of(cls, d: Any) -> "ActiveSet":
        """Return the active set for mujoco-warp's data `d`, with unknown states."""
        return cls(wp.zeros((d.nworld, d.njmax), dtype=int), wp.zeros((d.nworld, 1 + d.njmax), dtype=int))
