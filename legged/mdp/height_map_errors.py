"""Errors of the height map that a robot builds while it walks: offset, drift and holes."""

from collections.abc import Callable

import torch
from torch import Tensor

from legged.config.robot import HeightMapConfig
from legged.math import masked_set_
from legged.mdp.kernels import Kernels
from legged.mdp.random_pool import RandomPool
from legged.mdp.sensors.height_scan import HeightScan


def is_exact(cfg: HeightMapConfig) -> bool:
    """Return True if the map has no errors."""
    return not (cfg.offset or cfg.shift or cfg.drift or cfg.shift_drift or cfg.holes or cfg.lost)


class HeightMapErrors:
    """Height maps of N robots, with errors: a map is displaced from the ground, the displacement drifts, and some of the
    map's P points are unknown.
    """

    STATE = ("error", "rate", "holes")

    def __init__(
        self,
        cfg: HeightMapConfig,
        scan: HeightScan,
        pose: tuple[Tensor, Tensor],
        seen: Callable[[Tensor], Tensor],
        dt: float,
        numbers: RandomPool,
        kernels: Kernels | None = None,
    ) -> None:
        """Set up maps around the bases. `pose` has their positions (N, 3) [m] and orientations (N, 4) in the world frame.

        If the map can be displaced horizontally, this object updates `scan`, so no other object may use it. Otherwise the
        heights that `scan` holds are used. `seen` turns ground heights (N, P) in the world frame into the observation. `dt`
        is the control step [s]. Random numbers come from the pool `numbers`.
        """
        self._scan, self._seen, self._kernels = scan, seen, kernels
        self._position, self._orientation = pose
        num_envs, device = scan.heights.shape[0], scan.heights.device
        self._moved = cfg.shift > 0.0 or cfg.shift_drift > 0.0
        moves = dt * cfg.shift_drift
        half = torch.tensor([cfg.shift, cfg.shift, cfg.offset, moves, moves, dt * cfg.drift], device=device)
        self._drawn = numbers.between(-half, half, 6)
        self.error = torch.zeros(num_envs, 3, device=device)
        """(N, 3) displacement of the map, world frame [m]."""
        self.rate = torch.zeros_like(self.error)
        """(N, 3) change of the displacement in a control step, world frame [m]."""
        self._place = torch.zeros_like(self.error)
        self._share, self._lost = cfg.holes, cfg.lost
        points = scan.heights.shape[1] if cfg.holes or cfg.lost else 0
        self._holes_drawn = numbers.between(0.0, 1.0, points + 1) if points else None
        self.holes = torch.zeros(num_envs, points, dtype=torch.bool, device=device)
        """(N, P) True at unknown points; (N, 0) if the map has no holes."""

    def advance(self, begun: Tensor) -> None:
        """Advance the drift by one control step, and draw new errors for the robots of `begun` (N,), whose episodes are
        new.
        """
        if self._kernels is not None:
            chances = self._holes_drawn.values if self._holes_drawn is not None else self._drawn.values[:, :0]
            drawn = (begun, self._drawn.values, chances, self._share, self._lost)
            dim = (len(self.holes), max(self.holes.shape[1], 1))
            self._kernels.launch("advance_map", dim, *drawn, self.error, self.rate, self.holes)
            return
        self.error.add_(self.rate)
        masked_set_(self.error, begun, self._drawn.values[:, :3])
        masked_set_(self.rate, begun, self._drawn.values[:, 3:])
        if self._holes_drawn is not None:
            chances = self._holes_drawn.values
            masked_set_(self.holes, begun, (chances[:, :-1] < self._share) | (chances[:, -1:] < self._lost))

    def read(self) -> Tensor:
        """Return the observation (N, P) of the map's heights."""
        if self._moved:
            # At a place x, a map that is displaced by `error` shows the ground at x - error.
            torch.sub(self._position, self.error, out=self._place)
            self._scan.look_from(self._place, self._orientation)
        return torch.nan_to_num(self._seen(self._scan.heights + self.error[:, 2:]), nan=0.0)

    def cut_holes(self, observed: Tensor) -> None:
        """Set the heights `observed` (N, P) to 0 at unknown points."""
        if self._holes_drawn is not None:
            observed.masked_fill_(self.holes, 0.0)
