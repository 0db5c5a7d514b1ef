"""Active set: the state of each constraint row at the end of the last step, from which the solver starts the next step.

The cost of a row is piecewise, and the row's state names the piece that applies. A row of a contact or a limit exerts force
or does not. A row of dry friction holds, or slips in one of two directions. Newton's method has converged when all states are
right. It takes four iterations if it starts only from the last step's acceleration: the forces of stiff contacts depend on
small differences of accelerations, and from step to step accelerations change by more than these differences. The states
seldom change, so a start from them saves half of the iterations and nearly all line searches.
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
    """Row keys and row states of all worlds, on the device that was Warp's current device at construction."""

    key: wp.array
    """(N, rows) key that identifies a row across steps. Keys ascend. The first rows (equality constraints) have no keys."""
    last: wp.array
    """(N, 1 + rows) number of rows with keys in the last step, followed by the stored states of these rows."""

    @classmethod
    def of(cls, d: Any) -> "ActiveSet":
        """Return the active set for mujoco-warp's data `d`, with unknown states."""
        return cls(wp.zeros((d.nworld, d.njmax), dtype=int), wp.zeros((d.nworld, 1 + d.njmax), dtype=int))
