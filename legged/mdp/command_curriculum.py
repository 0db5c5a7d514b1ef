"""Command curriculum: ranges of commands widen while robots follow them."""

import torch
from torch import Tensor

from legged.config.legged import CommandCurriculumConfig
from legged.mdp.kernels import Kernels


class CommandCurriculum:
    """Curriculum that widens the range of each command axis (vx, vy, yaw rate) separately, while robots follow that axis.

    Each axis is judged once per window, from the robots whose command exceeds half of the current range. The measure is their
    mean velocity in the commanded direction, as a share of the commanded velocity. In this share, a gait's sway and the
    noise of exploration average out. In a tracking error they would not. A robot that stands still scores 0 in any range.
    """

    STATE = ("share", "_sums", "_steps")

    def __init__(self, cfg: CommandCurriculumConfig, full_ranges: Tensor, dt: float, kernels: Kernels | None = None) -> None:
        """Set the widest ranges, `full_ranges` (3, 2). `dt` is the control step [s]."""
        self.cfg, self.full_ranges, self._kernels = cfg, full_ranges.clone(), kernels
        self._full_limit = full_ranges.abs().amax(dim=1)
        self._half_limit = 0.5 * self._full_limit
        self.window_steps = max(1, round(cfg.window_s / dt))
        device = full_ranges.device
        self.share = torch.ones(3, device=device)
        """(3,) share of the full range that is in use."""
        # The sums and the count are views of one tensor, so that one launch clears a window.
        self._window = torch.zeros(7, device=device)
        self._sums = self._window[:6].view(2, 3)  # rows: velocity in the commanded direction, commanded velocity
        self._steps = self._window[6]
        self._zero = torch.zeros((), device=device)
        self.reset()

    def reset(self) -> None:
        """Reset to the ranges that training starts with."""
        self.share.fill_(self.cfg.start if self.cfg.enabled else 1.0)
        self._window.zero_()

    def write_ranges(self, ranges: Tensor) -> None:
        """Write the current lowest and highest command of each axis into `ranges` (3, 2)."""
        torch.mul(self.full_ranges, self.share.unsqueeze(1), out=ranges)

    def update(self, commands: Tensor, lin_vel: Tensor, ang_vel: Tensor, valid: Tensor) -> None:
        """Add a control step: `commands` (N, 3) as vx, vy, yaw rate, and velocities (N, 3) in the base frame [m/s, rad/s].
        Only robots of `valid` (N,) count. At the end of a window, widen the ranges of the axes that were followed.
        """
        if not self.cfg.enabled:
            return
        if self._kernels is not None:
            reached = torch.empty(2, *commands.shape, device=commands.device)
            now = (commands, lin_vel, ang_vel, valid)
            self._kernels.launch("follow_commands", tuple(commands.shape), *now, self._half_limit, self.share, reached)
            rule = (float(self.window_steps), self.cfg.threshold, self.cfg.step)
            kept = (self._sums, self._steps.view(1), self.share)
            self._kernels.launch("widen_commands", 1, reached.sum(dim=1), *rule, *kept)
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
        """Return the largest allowed command of each axis as a new 0-dimensional tensor, under its name in TensorBoard."""
        if not self.cfg.enabled:
            return {}
        names = ("command_vx", "command_vy", "command_yaw")
        return dict(zip(names, (self._full_limit * self.share).unbind(), strict=True))

    def progress(self) -> dict[str, Tensor]:
        """Return the progress of the curriculum. It does not depend on the number of robots."""
        return {"share": self.share.clone()}

    def load_progress(self, state: dict[str, Tensor]) -> None:
        """Continue from the progress in `state`. A disabled curriculum keeps the full ranges."""
        if self.cfg.enabled:
            self.share.copy_(state["share"].to(self.share.device))
