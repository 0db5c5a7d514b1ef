"""Terrain curriculum: robots that follow their commands move to harder tiles, robots that fall short move to easier ones."""

import torch
from torch import Tensor

from legged.config.robot import TerrainConfig
from legged.mdp.kernels import Kernels
from legged.terrain.terrain import Terrain

PROMOTED, DEMOTED = 0.8, 0.5
"""Share of the asked way above which a robot moves up a level, and share below which it moves down."""


class TerrainCurriculum:
    """Tile of each robot. The column of the tile (a terrain type) is fixed; the row (a level) changes with success.

    The *asked* way is the length of the path that the commands of an episode describe. After a fall, the last command counts
    for the time that was left. *Progress* is the way that the robot walked in the commanded directions, along curves too. A
    robot moves up if its progress exceeds PROMOTED of the asked way, or half a tile where that is less. It moves down if its
    progress is below DEMOTED of the asked way. A robot that was asked to turn on the spot or to stand keeps its level.

    A robot that moves up from the top level goes to a random level. Therefore, with ten rows, a policy that is always
    promoted has a mean level of 6.0, not 9. legged_gym judges the distance from the middle of the tile instead, so that
    robots that walk along curves move down.
    """

    STATE = ("levels", "columns", "origins", "way", "_sums")

    def __init__(
        self,
        cfg: TerrainConfig,
        terrain: Terrain,
        num_envs: int,
        dt: float,
        device: torch.device,
        kernels: Kernels | None = None,
    ) -> None:
        """Spread robots evenly over the columns, at random levels up to cfg.max_init_terrain_level. `dt` is the control step
        [s].
        """
        self.enabled, self.dt, self._kernels = cfg.curriculum, dt, kernels
        self.rows, columns = terrain.origins.shape[:2]
        highest = cfg.max_init_terrain_level if cfg.curriculum else self.rows - 1
        self.levels = torch.randint(0, min(highest, self.rows - 1) + 1, (num_envs,), device=device)
        """(N,) row of each robot's tile."""
        self._first_levels = self.levels.clone()
        self.columns = torch.arange(num_envs, device=device) * columns // num_envs
        """(N,) column of each robot's tile."""
        self.origins = torch.zeros(num_envs, 3, device=device)
        """(N, 3) middle of each robot's tile, world frame [m]."""
        self.way = torch.zeros(2, num_envs, device=device)
        """(2, N) progress and asked way since each robot's episode began [m]."""
        self.names = terrain.type_names
        kinds = torch.tensor([self.names.index(name) for name in terrain.types], device=device)
        self._of_type = torch.nn.functional.one_hot(kinds[self.columns], len(self.names)).t().float()  # (K, N) for K types
        self.tiles = torch.tensor(terrain.origins, dtype=torch.float32, device=device).flatten(0, 1)
        """(rows * columns, 3) middle of each tile, world frame [m]."""
        self._count = columns
        self._far = 0.5 * min(terrain.tile_size)
        self._random = torch.zeros_like(self.levels)
        self._sums = torch.zeros(3, len(self.names), device=device)  # rows: episodes, promoted, demoted
        self._place()

    def begin(self) -> None:
        """Begin new episodes on the present tiles."""
        self.way.zero_()

    def reset(self) -> None:
        """Reset to the levels that training starts with."""
        self.levels.copy_(self._first_levels)
        self._sums.zero_()
        self._place()

    def draw(self) -> None:
        """Draw a random level for every robot. A robot that finishes the hardest level moves to its random level."""
        self._random.random_(0, self.rows)

    def update(self, ended: Tensor, valid: Tensor, commands: Tensor, base_lin_vel: Tensor, steps_left: Tensor) -> None:
        """Add a control step to the robots' progress, and move the robots whose episodes end to their next levels.

        Args:
            ended: (N,) bool, the robots whose episodes end.
            valid: (N,) bool, the robots whose state is finite. Other robots make no progress and keep their levels.
            commands: (N, 2 or more) vx and vy in the base frame [m/s].
            base_lin_vel: (N, 3) velocities of the bases in the base frame [m/s].
            steps_left: (N,) int64, control steps until an episode's time is up.
        """
        if not self.enabled:
            return
        if self._kernels is not None:
            judged = torch.empty(3, len(ended), device=ended.device)
            step = (ended, valid, commands, base_lin_vel, steps_left, self.dt)
            tiles = (self.rows, self._count, self._random, self.columns, self.tiles)
            written = (self.way, self.levels, self.origins, judged)
            self._kernels.launch("move_levels", len(ended), *step, self._far, PROMOTED, DEMOTED, *tiles, *written)
            self._sums.add_(judged @ self._of_type.t())
            return
        speed = commands[:, :2].norm(dim=1)
        along = (commands[:, :2] * base_lin_vel[:, :2]).sum(dim=1) / speed.clamp(min=1e-6)
        self.way.add_(torch.where(valid, self.dt * torch.stack([along, speed]), 0.0))
        progress, asked = self.way[0], self.way[1] + self.dt * steps_left * speed
        mask = ended & valid
        up = mask & (progress > (PROMOTED * asked).clamp(max=self._far))
        down = mask & (progress < DEMOTED * asked) & ~up
        up &= asked > 0.0
        self.way.masked_fill_(ended, 0.0)
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
        torch.index_select(self.tiles, 0, self.levels * self._count + self.columns, out=self.origins)

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
