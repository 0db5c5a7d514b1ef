"""Demonstrations for the film and the tables of `play`: robots follow a schedule of commands, walk out of their tiles of
terrain, or, in tasks without commands, go through an episode.
"""

from collections.abc import Callable

import numpy as np
import torch
from rich.markup import escape
from rich.table import Table
from tensordict import TensorDict
from torch import Tensor

from legged.envs import BaseTask, LeggedRobot
from legged.mdp.tracking_error import velocity_error, yaw_rate_error
from legged.play.playground import Playground
from legged.play.video import Video
from legged.policies.episodes import Policy, episodes_table, measure_episodes

SCHEDULE = (  # seconds; vx, vy [m/s], yaw rate [rad/s]
    (2.0, (0.5, 0.0, 0.0)),
    (2.5, (1.0, 0.0, 0.0)),
    (2.0, (0.0, 0.5, 0.0)),
    (2.5, (0.4, 0.0, 0.8)),
    (1.5, (0.0, 0.0, -0.8)),
    (1.5, (0.0, 0.0, 0.0)),
)
"""Commands in the video, clipped to the ranges of the training."""
SETTLE_S = 1.0
"""Time after the start of a command and after a fall that is not measured [s]."""
FORWARD = 0.7
"""Commanded forward velocity [m/s], clipped to the range of the training."""
EPISODE_S = 12.0
"""Time in which robots walk out of their tile and into the next one, before all start again [s]."""
EPISODES = 2
FILM_S = 20.0
"""Filmed part of an episode [s]."""


class TrackingErrors:
    """Sums of squared velocity errors and of falls of N robots."""

    COLUMNS = ("velocity RMSE", "yaw rate RMSE", "falls")
    """Columns of a `row`."""

    def __init__(self, num_envs: int, device: torch.device) -> None:
        self.steps, self.lin, self.ang, self.falls = (torch.zeros(num_envs, device=device) for _ in range(4))
        """(N,) each: measured control steps, summed squared errors of vx and vy [m^2/s^2] and yaw rate [rad^2/s^2], falls."""

    def add(self, task: LeggedRobot, measured: Tensor) -> None:
        """Add the falls of the last step, and the errors of the robots in the mask `measured` (N,)."""
        self.falls += task.terminated_buf
        self.steps += measured
        self.lin += torch.where(measured, velocity_error(task.commands, task.base_lin_vel), 0.0)
        self.ang += torch.where(measured, yaw_rate_error(task.commands, task.base_ang_vel), 0.0)

    def row(self, robots: Tensor | slice = slice(None)) -> tuple[str, str, str]:
        """Return the root mean square errors and the number of falls of the robots in `robots` (N,), as text."""
        steps, lin, ang, falls = (float(sums[robots].sum()) for sums in (self.steps, self.lin, self.ang, self.falls))
        if steps == 0.0:  # no robot stood long enough to be measured
            return "-", "-", f"{falls:.0f}"
        return f"{(lin / steps) ** 0.5:.3f} m/s", f"{(ang / steps) ** 0.5:.3f} rad/s", f"{falls:.0f}"


def velocities(task: LeggedRobot, robots: slice) -> list[str]:
    """Return lines with the commanded velocity of the first of `robots` and the mean actual velocity of all of them."""
    wanted = task.commands[robots][0, :3].tolist()
    actual = [*task.base_lin_vel[robots, :2].mean(dim=0).tolist(), float(task.base_ang_vel[robots, 2].mean())]
    return [
        f"{name}  {v[0]:+.2f}  {v[1]:+.2f} m/s  {v[2]:+.2f} rad/s" for name, v in (("commanded", wanted), ("actual", actual))
    ]


def schedule_s() -> float:
    """Return the duration of the schedule [s]."""
    return sum(seconds for seconds, _ in SCHEDULE)


@torch.inference_mode()
def follow_schedule(task: LeggedRobot, act: Callable[[TensorDict], Tensor], video: Video) -> Table:
    """Run the schedule on all robots, filmed by `video`; return a table of errors and falls."""
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


@torch.inference_mode()
def walk_out(task: LeggedRobot, act: Callable[[TensorDict], Tensor], playground: Playground, video: Video) -> Table:
    """Walk the robots along x from the middle of their tiles, filmed by `video`; return a table of errors and falls by
    terrain type.
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
            errors.add(task, task.episode_length_buf * task.dt >= SETTLE_S)  # robots that were reset are left out
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


def roll_out(task: BaseTask, act: Policy, video: Video) -> Table:
    """Run every environment through an episode, the first one filmed by `video`; return a table of returns and lengths."""

    def film(step: int, so_far: float) -> None:
        if video.due(step) and step * task.dt < FILM_S:
            video.take(f"{step * task.dt:.1f} s, return {so_far:.0f}")

    return episodes_table(measure_episodes(task, act, film), task.cfg.task)
