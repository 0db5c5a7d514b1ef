"""Heights of the ground around robots, by lookup in the height map."""

import torch
from torch import Tensor

from legged.config.robot import TerrainConfig
from legged.math import yaw_of
from legged.mdp.kernels import Kernels
from legged.mdp.sensors.sensor import Sensor
from legged.terrain.terrain import Terrain


class HeightScan(Sensor):
    """Ground heights at a grid of P points around each robot. The grid turns with the robot's heading. On a plane all heights
    are 0.

    The setting `terrain.scan` determines how a point's height follows from the cells around the point
    (`HeightMap.scan_map`). The height of the ground under the base is looked up in the same way.
    """

    def __init__(
        self,
        cfg: TerrainConfig,
        terrain: Terrain | None,
        pose: tuple[Tensor, Tensor],
        kernels: Kernels | None = None,
    ) -> None:
        """Build the grid of cfg.measured_points_x by cfg.measured_points_y, with x changing slowest. Without `terrain` the
        ground is a plane. `pose` has the bases' positions (N, 3) [m] and orientations (N, 4) in the world frame, which
        `update` reads.
        """
        self._on_plane, self._kernels, self._pose = terrain is None, kernels, pose
        num_envs, device = len(pose[0]), pose[0].device
        x = torch.tensor(cfg.measured_points_x, device=device)
        y = torch.tensor(cfg.measured_points_y, device=device)
        self.points = torch.cartesian_prod(x, y)
        """(P, 2) x and y of the points in the yaw frame [m]."""
        self.heights = torch.zeros(num_envs, len(self.points), device=device)
        """(N, P) height of the ground at the points, world frame [m]."""
        self.ground = torch.zeros(num_envs, device=device)
        """(N,) height of the ground under each base, world frame [m]."""
        if terrain is not None:
            ground = terrain.height_map
            found = torch.tensor(ground.scan_map(cfg.scan), device=device)
            self._cell, (self._rows, self._columns) = ground.cell, found.shape
            self._origin = torch.tensor(ground.origin, dtype=torch.float32, device=device)
            self._last = [float(size - 1) for size in found.shape]
            self._map = found.flatten()
            # Coordinates in cells. The last point is the base's position, so the same lookup finds the ground under the base.
            self._x, self._y = (torch.cat([self.points, torch.zeros(1, 2, device=device)]) / ground.cell).T.contiguous()

    def update(self) -> None:
        self.look_from(*self._pose)

    def look_from(self, base_pos: Tensor, base_quat: Tensor) -> None:
        """Update the heights for bases at positions (N, 3) and orientations (N, 4) in the world frame. Points outside the map
        have the height at its border.
        """
        if self._on_plane:
            return
        if self._kernels is not None:
            points, ground = (self._x, self._y), (self._map, self._origin, self._cell, self._rows, self._columns)
            dim = (len(base_pos), len(self._x))
            self._kernels.launch("scan_heights", dim, base_pos, base_quat, *points, *ground, self.heights, self.ground)
            return
        yaw = yaw_of(base_quat).nan_to_num().unsqueeze(1)
        cos, sin = torch.cos(yaw), torch.sin(yaw)
        row, column = ((base_pos[:, :2] - self._origin) / self._cell).nan_to_num().split(1, dim=1)
        rows = row.addcmul(cos, self._x).addcmul_(sin, self._y, value=-1.0).clamp_(0.0, self._last[0]).floor_()
        columns = column.addcmul(sin, self._x).addcmul_(cos, self._y).clamp_(0.0, self._last[1]).floor_()
        # float32 holds every cell number exactly, because `check_terrain` refuses maps with too many cells.
        cells = columns.add_(rows, alpha=self._columns).int()
        found = self._map[cells]
        self.heights.copy_(found[:, :-1])
        self.ground.copy_(found[:, -1])

    def ground_at(self, points: Tensor) -> Tensor:
        """Return the heights of the ground at `points` (N, K, 2), x and y in the world frame: (N, K) [m]."""
        if self._on_plane:
            return torch.zeros_like(points[..., 0])
        row, column = ((points - self._origin) / self._cell).nan_to_num().unbind(dim=-1)
        rows, columns = row.clamp(0.0, self._last[0]).floor(), column.clamp(0.0, self._last[1]).floor()
        return self._map[(rows * self._columns + columns).int()]
