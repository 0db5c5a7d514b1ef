"""The command curriculum: ranges widen while robots follow."""

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from legged.config.schema import CommandCurriculumConfig

if TYPE_CHECKING:
    from legged.physics.warp.task_kernels import TaskKernels


class CommandCurriculum:
    """Widens the range of each command axis (vx, vy, yaw rate) by itself while that axis is followed.

    Judged once a window, on the robots that are asked for more than half of the current range: the mean velocity they
    reach in the direction asked for, as a share of what is asked. Unlike a tracking error, that share is not blurred by
    the sway of a gait or by exploration, and standing still scores 0 however narrow the range.
    """

    STATE = ("share", "_sums", "_steps")

    def __init__(
        self, cfg: CommandCurriculumConfig, full_ranges: Tensor, dt: float, kernels: "TaskKernels | None" = None
    ) -> None:
        """Widen up to `full_ranges` (3, 2); `dt` is the control step [s]."""
        self.cfg, self.full_ranges, self._kernels = cfg, full_ranges.clone(), kernels
        self._full_limit = full_ranges.abs().amax(dim=1)
        self._half_limit = 0.5 * self._full_limit
        self.window_steps = max(1, round(cfg.window_s / dt))
        device = full_ranges.device
        self.share = torch.ones(3, device=device)
        """(3,) share of the full range that is in use."""
        # Views of one block, so that a new window is one launch.
        self._window = torch.zeros(7, device=device)
        self._sums = self._window[:6].view(2, 3)  # velocity reached in the direction asked for, velocity asked for
        self._steps = self._window[6]
        self._zero = torch.zeros((), device=device)
        self.reset()

    def reset(self) -> None:
        """Go back to the ranges that training starts with."""
        self.share.fill_(self.cfg.start if self.cfg.enabled else 1.0)
        self._window.zero_()

    def write_ranges(self, ranges: Tensor) -> None:
        """Put the lowest and highest command of each axis now into `ranges` (3, 2)."""
        torch.mul(self.full_ranges, self.share.unsqueeze(1), out=ranges)

    def update(self, commands: Tensor, lin_vel: Tensor, ang_vel: Tensor, valid: Tensor) -> None:
        """Judge one step: commands (N, 3) as vx, vy, yaw rate, velocities (N, 3) in the base frame; `valid` (N,) robots that
        count.
        """
        if not self.cfg.enabled:
            return
        if self._kernels is not None:
            reached = torch.empty(2, *commands.shape, device=commands.device)
            self._kernels.follow_commands(commands, lin_vel, ang_vel, valid, self._half_limit, self.share, reached)
            rule = (float(self.window_steps), self.cfg.threshold, self.cfg.step)
            self._kernels.widen_commands(reached.sum(dim=1), *rule, self._sums, self._steps.view(1), self.share)
            return
        velocity = torch.cat([lin_vel[:, :2], ang_vel[:, 2:]], dim=1)
        size = commands.abs()
        asked = (size > self._half_limit * self.share) & valid.unsqueeze(1)
        reached = torch.stack([velocity * commands.sign(), size])
        self._sums.add_(torch.where(asked, reached, self._zero).sum(dim=1))
        self._steps.add_(1.0)
        due = self._steps >= self.window_steps
        followed = (self._sums[0] > self.cfg.threshold * self._sums[1]) & due
        self.share.add_(followed, alpha=self.cfg.step).clamp_(max=1.0)
        self._window.masked_fill_(due, 0.0)

    def metrics(self) -> dict[str, Tensor]:
        """Return the widest command of each axis now, fresh 0-dimensional tensors."""
        if not self.cfg.enabled:
            return {}
        names = ("command_vx", "command_vy", "command_yaw")
        return dict(zip(names, (self._full_limit * self.share).unbind(), strict=True))

    def progress(self) -> dict[str, Tensor]:
        """Return how far it has got, whatever the number of robots."""
        return {"share": self.share.clone()}

    def load_progress(self, state: dict[str, Tensor]) -> None:
        """Go on from there; a curriculum that is off keeps the full ranges."""
        if self.cfg.enabled:
            self.share.copy_(state["share"].to(self.share.device))
