"""Robots walk out of their tiles of terrain, one after the other in the middle of the picture."""

from collections.abc import Callable

import torch
from rich.markup import escape
from rich.table import Table
from tensordict import TensorDict
from torch import Tensor

from legged.envs import LeggedRobot
from legged.play.playground import Playground
from legged.play.video import Video

FORWARD = 0.7
"""Velocity asked for [m/s], if the task was trained on it."""
EPISODE_S = 12.0
"""Time a robot has to walk out of its tile, and into the one behind it [s]; then all start again."""
EPISODES = 2
SETTLE_S = 1.0
"""At the start of an episode, not measured [s]."""


class Tracking:
    """Squared errors and falls of N robots, summed up."""

    def __init__(self, num_envs: int, device: torch.device) -> None:
        self.steps, self.lin, self.ang, self.falls = (torch.zeros(num_envs, device=device) for _ in range(4))
        """(N,) control steps measured, sums of squared errors of vx and vy [m^2/s^2] and yaw rate [rad^2/s^2], falls."""

    def add(self, task: LeggedRobot) -> None:
        """Take in the step that was just made; robots that began anew in it are not measured."""
        self.falls += task.terminated_buf
        measured = (task.episode_length_buf * task.dt >= SETTLE_S).float()
        self.steps += measured
        self.lin += measured * (task.commands[:, :2] - task.base_lin_vel[:, :2]).square().sum(dim=1)
        self.ang += measured * (task.commands[:, 2] - task.base_ang_vel[:, 2]).square()

    def row(self, robots: Tensor) -> tuple[str, str, str]:
        """Root mean squares of velocity and yaw rate and number of falls of the robots in `robots` (N,)."""
        steps, lin, ang, falls = (float(sums[robots].sum()) for sums in (self.steps, self.lin, self.ang, self.falls))
        if steps == 0.0:  # they fell at once, every time
            return "-", "-", f"{falls:.0f}"
        return f"{(lin / steps) ** 0.5:.3f} m/s", f"{(ang / steps) ** 0.5:.3f} rad/s", f"{falls:.0f}"


@torch.inference_mode()
def walk_out(task: LeggedRobot, act: Callable[[TensorDict], Tensor], playground: Playground, video: Video) -> Table:
    """Let the robots walk along x from the middle of their tiles, filmed by `video`; returns a table of errors and falls for
    each type.
    """
    assert task.terrain is not None, "the task stands on a plane"
    device = torch.device(task.device)
    tracking = Tracking(task.num_envs, device)
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
            tracking.add(task)
            if video.due(step):
                where = playground.label(task.terrain, task.base_pos[followed].tolist())
                video.take(slice(followed, followed + 1), where)
    return _table(tracking, playground, task.num_envs, float(command[0]))


def _table(tracking: Tracking, playground: Playground, num_envs: int, speed: float) -> Table:
    title = f"walking out at {speed:g} m/s, {EPISODES} times {EPISODE_S:g} s"
    table = Table(title=title, title_justify="left")
    for name in ("terrain", "robots", "velocity RMSE", "yaw rate RMSE", "falls"):
        table.add_column(name, justify="left" if name == "terrain" else "right")
    kinds = [playground.rows[0][column].type for column in playground.columns(num_envs)]
    for kind, label in playground.labels().items():
        robots = torch.tensor([own == kind for own in kinds], device=tracking.steps.device)
        if robots.any():
            table.add_row(escape(label), str(int(robots.sum())), *tracking.row(robots))
    return table
