"""Robots walk out of their tiles of terrain, one after the other in the middle of the picture."""

from collections.abc import Callable

import torch
from rich.markup import escape
from rich.table import Table
from tensordict import TensorDict
from torch import Tensor

from legged.envs import LeggedRobot
from legged.play.errors import TrackingErrors, velocities
from legged.play.playground import Playground
from legged.play.video import Video

FORWARD = 0.7
"""Velocity asked for [m/s], if the task was trained on it."""
EPISODE_S = 12.0
"""Time a robot has to walk out of its tile, and into the one behind it [s]; then all start again."""
EPISODES = 2
SETTLE_S = 1.0
"""At the start of an episode, not measured [s]."""


@torch.inference_mode()
def walk_out(task: LeggedRobot, act: Callable[[TensorDict], Tensor], playground: Playground, video: Video) -> Table:
    """Let the robots walk along x from the middle of their tiles, filmed by `video`; return a table of errors and falls for
    each type.
    """
    assert task.terrain is not None, "the task stands on a plane"
    device = torch.device(task.device)
    errors = TrackingErrors(task.num_envs, device)
    low, high = task.command_sampler.full_ranges[0].tolist()
    command = torch.tensor([min(max(FORWARD, low), high), 0.0, 0.0], device=device)
    playground.place(task)
    for episode in range(EPISODES):
        task.reset()
        observations = task.hold_commands(command, torch.zeros(task.num_envs, device=device))
        followed = episode % task.num_envs
        video.follow(followed)
        for step in range(max(1, round(EPISODE_S / task.dt))):
            observations, _, _, _ = task.step(act(observations))
            errors.add(task, task.episode_length_buf * task.dt >= SETTLE_S)  # not those that began anew in this step
            if video.due(step):
                where = playground.label(task.terrain, task.base_pos[followed].tolist())
                video.take(*velocities(task, slice(followed, followed + 1)), where)
    return _table(errors, playground, task.num_envs, float(command[0]))


def _table(errors: TrackingErrors, playground: Playground, num_envs: int, speed: float) -> Table:
    title = f"walking out at {speed:g} m/s, {EPISODES} times {EPISODE_S:g} s"
    table = Table(title=title, title_justify="left")
    for name in ("terrain", "robots", *errors.COLUMNS):
        table.add_column(name, justify="left" if name == "terrain" else "right")
    kinds = [playground.rows[0][column].type for column in playground.columns(num_envs)]
    for kind, label in playground.labels().items():
        robots = torch.tensor([own == kind for own in kinds], device=errors.steps.device)
        if robots.any():
            table.add_row(escape(label), str(int(robots.sum())), *errors.row(robots))
    return table
