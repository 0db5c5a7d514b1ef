"""Terrain curriculum: robots that walk far move to harder tiles, robots that fall short move to easier ones."""

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from legged.config.schema import TerrainConfig
from legged.terrain.terrain import Terrain

if TYPE_CHECKING:
    from legged.physics.warp.task_kernels import TaskKernels


class TerrainCurriculum:
    """Tile of each robot. The column of the tile (a terrain type) is fixed; the row (a level) changes with success.

    The rule is legged_gym's. A robot moves up a level if it ends further than half a tile from the middle of its tile. It
    moves down if it got less than half as far as its command asked. A robot that moves up from the top level goes to a random
    level. Therefore, with ten rows, a policy that is always promoted has a mean level of 6.0, not 9.
    """

    STATE = ("levels", "columns", "origins", "_sums")

    def __init__(
        self,
        cfg: TerrainConfig,
        terrain: Terrain,
        num_envs: int,
        device: torch.device,
        kernels: "TaskKernels | None" = None,
    ) -> None:
        """Spread robots evenly over the columns, at random levels up to cfg.max_init_terrain_level."""
        self.enabled, self._kernels = cfg.curriculum, kernels
        self.rows, columns = terrain.origins.shape[:2]
        highest = cfg.max_init_terrain_level if cfg.curriculum else self.rows - 1
        self.levels = torch.randint(0, min(highest, self.rows - 1) + 1, (num_envs,), device=device)
        """(N,) row of each robot's tile."""
        self._first_levels = self.levels.clone()
        self.columns = torch.arange(num_envs, device=device) * columns // num_envs
        """(N,) column of each robot's tile."""
        self.origins = torch.zeros(num_envs, 3, device=device)
        """(N, 3) middle of each robot's tile, world frame [m]."""
        self.names = terrain.type_names
        kinds = torch.tensor([self.names.index(name) for name in terrain.types], device=device)
        self._of_type = torch.nn.functional.one_hot(kinds[self.columns], len(self.names)).t().float()  # (K, N) for K types
        self._tiles = torch.tensor(terrain.origins, dtype=torch.float32, device=device).flatten(0, 1)
        self._count = columns
        self._far = 0.5 * min(terrain.tile_size)
        self._random = torch.zeros_like(self.levels)
        self._sums = torch.zeros(3, len(self.names), device=device)  # rows: episodes, promoted, demoted
        self._place()

    def reset(self) -> None:
        """Reset to the levels that training starts with."""
        self.levels.copy_(self._first_levels)
        self._sums.zero_()
        self._place()

    def draw(self) -> None:
        """Draw a random level for every robot. A robot that finishes the hardest level moves to its random level."""
        self._random.random_(0, self.rows)

    def update(self, mask: Tensor, base_pos: Tensor, asked: Tensor) -> None:
        """Move the robots of `mask` (N,), whose episodes end, to their next levels. `base_pos` (N, 3) is their final position
        [m]; `asked` (N,) is the distance that their command asks for in an episode [m].
        """
        if not self.enabled:
            return
        if self._kernels is not None:
            judged = torch.empty(3, len(mask), device=mask.device)
            tiles = (self.rows, self._count, self._random, self.columns, self._tiles)
            self._kernels.move_levels(mask, base_pos, asked, self._far, *tiles, self.levels, self.origins, judged)
            self._sums.add_(judged @ self._of_type.t())
            return
        walked = (base_pos[:, :2] - self.origins[:, :2]).norm(dim=1)
        up = mask & (walked > self._far)
        down = mask & (walked < 0.5 * asked) & ~up
        self._sums.add_(torch.stack([mask.float(), up.float(), down.float()]) @ self._of_type.t())
        moved = (self.levels + up.long() - down.long()).clamp(min=0)
        self.levels.copy_(torch.where(moved >= self.rows, self._random, moved))
        self._place()

    def place_at(self, levels: Tensor, columns: Tensor) -> None:
        """Assign the tiles at `levels` and `columns`, (N,) each, to the robots, and disable the curriculum."""
        self.enabled = False
        self.levels.copy_(levels)
        self.columns.copy_(columns)
        self._place()

    def _place(self) -> None:
        torch.index_select(self._tiles, 0, self.levels * self._count + self.columns, out=self.origins)

    def metrics(self) -> dict[str, Tensor]:
        """Return new 0-dimensional tensors by name in TensorBoard: the mean level, and for each terrain type the mean level
        and the shares of ended episodes that moved up and down. Shares are averaged over about the last ten calls, since one
        rollout ends few episodes of each type.
        """
        if not self.enabled:
            return {}
        sums = self._sums.clone()
        self._sums.mul_(0.9)
        levels = self._of_type @ self.levels.float() / self._of_type.sum(dim=1)
        log = {"Terrain/level": self.levels.float().mean()}
        log |= {f"Terrain/level_{name}": level for name, level in zip(self.names, levels.unbind(), strict=True)}
        for what, share in (("promoted", sums[1] / sums[0]), ("demoted", sums[2] / sums[0])):
            log |= {f"Terrain/{what}_{name}": value for name, value in zip(self.names, share.unbind(), strict=True)}
        return log

    def progress(self) -> dict[str, Tensor]:
        """Return the levels of the robots."""
        return {"levels": self.levels.clone()}

    def load_progress(self, state: dict[str, Tensor]) -> None:
        """Continue from saved levels. If the number of robots has changed, levels are drawn from the saved levels. Reset the
        robots afterwards, because until then they stand on their old tiles.
        """
        saved = state["levels"].to(self.levels.device).clamp(max=self.rows - 1)
        if len(saved) != len(self.levels):
            saved = saved[torch.randint(len(saved), self.levels.shape, device=saved.device)]
        if self.enabled:
            self.levels.copy_(saved)
            self._place()
