"""Heights of the ground around robots, by lookup in the height map."""

import torch
from torch import Tensor

from legged.config.schema import TerrainConfig
from legged.math import yaw_of
from legged.terrain.terrain import Terrain


class HeightScan:
    """A grid of P points around each robot, turned with its heading. On a plane all heights are 0.

    As in legged_gym a point's height is the lowest of three neighbouring cells (HeightMap.scan_map).
    """

    def __init__(self, cfg: TerrainConfig, terrain: Terrain | None, num_envs: int, device: torch.device) -> None:
        """Points are cfg.measured_points_x times cfg.measured_points_y, x changing slowest."""
        self._on_plane = terrain is None
        x = torch.tensor(cfg.measured_points_x, device=device)
        y = torch.tensor(cfg.measured_points_y, device=device)
        self.points = torch.cartesian_prod(x, y)
        """(P, 2) in the base's frame, seen from above [m]."""
        self.heights = torch.zeros(num_envs, len(self.points), device=device)
        """(N, P) height of the ground there, world frame [m]."""
        self.ground = torch.zeros(num_envs, device=device)
        """(N,) height of the ground under each base [m]."""
        if terrain is not None:
            ground = terrain.height_map
            self._cell = ground.cell
            self._origin = torch.tensor(ground.origin, dtype=torch.float32, device=device)
            lowest = torch.tensor(ground.scan_map(), device=device)
            self._columns = lowest.shape[1]
            self._last = torch.tensor([lowest.shape[0] - 1, lowest.shape[1] - 1], device=device)
            self._map = lowest.flatten()

    def update(self, base_pos: Tensor, base_quat: Tensor) -> None:
        """Look up the heights for bases at (N, 3), (N, 4) in the world."""
        if self._on_plane:
            return
        yaw = yaw_of(base_quat).unsqueeze(1)
        cos, sin = torch.cos(yaw), torch.sin(yaw)
        x, y = self.points.unbind(dim=1)
        self.heights.copy_(self._lookup(base_pos[:, :1] + cos * x - sin * y, base_pos[:, 1:2] + sin * x + cos * y))
        self.ground.copy_(self._lookup(base_pos[:, 0], base_pos[:, 1]))

    def _lookup(self, x: Tensor, y: Tensor) -> Tensor:
        """Heights at world points of any shape; outside the map, those at its border."""
        row = ((x - self._origin[0]) / self._cell).nan_to_num().floor().long().clamp(min=0).minimum(self._last[0])
        column = ((y - self._origin[1]) / self._cell).nan_to_num().floor().long().clamp(min=0).minimum(self._last[1])
        return self._map[row * self._columns + column]
