"""Commands of the base's height and pitch, sampled together with velocity commands."""

import torch
from torch import Tensor

from legged.config.legged import CommandRanges
from legged.math import masked_set_
from legged.mdp.commands import Commands
from legged.mdp.random_pool import RandomPool


class BaseCommands:
    """Commanded height above the ground [m] and pitch [rad] of the bases of N robots."""

    STATE: tuple[str, ...] = ()

    def __init__(self, cfg: CommandRanges, height: float, numbers: RandomPool) -> None:
        """Command the height `height` [m] and no pitch, until `update` samples others. A range of zero width at 0 keeps these
        values. Random numbers come from the pool `numbers`.
        """
        self.usual = torch.tensor([height, 0.0], device=numbers.device)
        """(2,) height and pitch that are commanded without a range, and while velocity commands are held."""
        self.commands = self.usual.repeat(numbers.num_envs, 1)
        """(N, 2) commanded height [m] and pitch [rad], positive if the base leans forward."""
        heights = cfg.base_height if any(cfg.base_height) else (height, height)
        self.ranges = (heights, cfg.base_pitch) if any((*cfg.base_height, *cfg.base_pitch)) else None
        """Ranges of the height [m] and of the pitch [rad]; None if both are constant."""
        self._drawn = None
        if self.ranges is not None:
            low, high = zip(*self.ranges, strict=True)
            self._drawn, self.STATE = numbers.between(low, high, 2), ("commands",)

    def update(self, velocity: Commands) -> None:
        """Give new commands to the robots that got a new velocity command."""
        if self._drawn is not None:
            masked_set_(self.commands, velocity.renewed, self._drawn.values)

    def hold(self, commands: Tensor | None = None) -> None:
        """Command the heights [m] and pitches [rad] `commands` (N, 2) or (2,), or the usual ones."""
        self.commands.copy_(self.usual if commands is None else commands)
