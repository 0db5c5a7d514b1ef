"""Curricula: what becomes harder while the robots succeed."""

import torch
from torch import Tensor

from legged.config.schema import CommandCurriculumConfig


class CommandCurriculum:
    """Widens the range of each command axis (vx, vy, yaw rate) by itself while that axis is followed.

    Judged once a window, on the robots that are asked for more than half of the current range: their mean tracking
    score must pass the threshold, and their error must be below half of what they are asked, which standing still is
    not however narrow the range.
    """

    def __init__(
        self, cfg: CommandCurriculumConfig, full_ranges: Tensor, dt: float, tracking_sigma: float
    ) -> None:
        """`full_ranges` (3, 2); `dt` is the control step [s]."""
        self.cfg, self.sigma = cfg, tracking_sigma
        self.full_ranges = full_ranges.clone()
        self.window_steps = max(1, round(cfg.window_s / dt))
        device = full_ranges.device
        self.share = torch.full((3,), cfg.start if cfg.enabled else 1.0, device=device)
        """(3,) share of the full range that is in use."""
        self._sums = torch.zeros(4, 3, device=device)  # score, squared error, squared command, robots
        self._steps = torch.zeros((), device=device)

    @property
    def ranges(self) -> Tensor:
        """(3, 2) lowest and highest command of each axis now."""
        return self.full_ranges * self.share.unsqueeze(1)

    def update(self, commands: Tensor, velocity: Tensor, valid: Tensor) -> None:
        """Judge one step: commands and velocities (N, 3) as vx, vy, yaw rate; `valid` (N,) robots that count."""
        if not self.cfg.enabled:
            return
        limit = self.ranges.abs().amax(dim=1)
        asked = (commands.abs() > 0.5 * limit) & valid.unsqueeze(1)
        squared = torch.where(asked, (commands - velocity).square(), 0.0)
        score = torch.where(asked, torch.exp(-squared / self.sigma), 0.0)
        wanted = torch.where(asked, commands.square(), 0.0)
        self._sums.add_(torch.stack([score.sum(0), squared.sum(0), wanted.sum(0), asked.sum(0).float()]))
        self._steps.add_(1.0)
        due = self._steps >= self.window_steps
        score_sum, error_sum, command_sum, count = self._sums.unbind(0)
        followed = (score_sum > self.cfg.threshold * count) & (error_sum < 0.25 * command_sum) & (count > 0)
        self.share.add_(torch.where(followed & due, self.cfg.step, 0.0)).clamp_(max=1.0)
        self._sums.masked_fill_(due, 0.0)
        self._steps.masked_fill_(due, 0.0)

    def state_dict(self) -> dict[str, Tensor]:
        """What a resumed run needs."""
        return {"share": self.share.clone()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Go on from a saved state."""
        self.share.copy_(state["share"].to(self.share.device))
