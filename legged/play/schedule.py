"""Robots on a plane follow one command after the other."""

from collections.abc import Callable

import numpy as np
import torch
from rich.markup import escape
from rich.table import Table
from tensordict import TensorDict
from torch import Tensor

from legged.envs import LeggedRobot
from legged.play.errors import TrackingErrors, velocities
from legged.play.video import Video

SCHEDULE = (  # seconds; vx, vy [m/s], yaw rate [rad/s]
    (2.0, (0.5, 0.0, 0.0)),
    (2.5, (1.0, 0.0, 0.0)),
    (2.0, (0.0, 0.5, 0.0)),
    (2.5, (0.4, 0.0, 0.8)),
    (1.5, (0.0, 0.0, -0.8)),
    (1.5, (0.0, 0.0, 0.0)),
)
"""What the robots are asked to do in the video, clipped to the ranges the task was trained on."""
SETTLE_S = 1.0
"""At the start of a command, for getting there, and of an episode that begins anew after a fall: not measured [s]."""


def schedule_s() -> float:
    """Return how long all commands last [s]."""
    return sum(seconds for seconds, _ in SCHEDULE)


@torch.inference_mode()
def follow_schedule(task: LeggedRobot, act: Callable[[TensorDict], Tensor], video: Video) -> Table:
    """Let the robots follow the schedule, filmed by `video`; return a table of errors and falls."""
    table = Table(title="following commands", title_justify="left")
    table.add_column(escape("vx, vy [m/s], yaw [rad/s]"), justify="left")
    for name in TrackingErrors.COLUMNS:
        table.add_column(name, justify="right")
    device = torch.device(task.device)
    low, high = task.command_sampler.full_ranges.cpu().numpy().T
    task.reset()
    for seconds, wanted in SCHEDULE:
        command = np.clip(np.array(wanted), low, high)
        observations = task.hold_commands(torch.tensor(command, dtype=torch.float32, device=device))
        errors = TrackingErrors(task.num_envs, device)
        for step in range(max(1, round(seconds / task.dt))):
            observations, _, _, _ = task.step(act(observations))
            settled = task.episode_length_buf * task.dt >= SETTLE_S
            errors.add(task, settled & (step * task.dt >= SETTLE_S))
            if video.due(step):
                video.take(*velocities(task, slice(None)))
        table.add_row(", ".join(f"{value:g}" for value in command), *errors.row())
    return table
