"""Demonstrations for the film and the tables of `play`: robots follow a schedule of commands or walk out of their terrain
tiles. In tasks without commands they go through an episode.
"""

import numpy as np
import torch
from rich.table import Table
from torch import Tensor

from legged.envs import BaseTask, LeggedRobot
from legged.mdp.tracking_error import velocity_error, yaw_rate_error
from legged.play.films import Video
from legged.play.playground import Playground
from legged.policies.episodes import Policy, episodes_table, measure_episodes
from legged.tables import screen_table

SCHEDULE = (  # (seconds, (vx, vy [m/s], yaw rate [rad/s]))
    (2.0, (0.5, 0.0, 0.0)),
    (2.5, (1.0, 0.0, 0.0)),
    (2.0, (0.0, 0.5, 0.0)),
    (2.5, (0.4, 0.0, 0.8)),
    (1.5, (0.0, 0.0, -0.8)),
    (1.5, (0.0, 0.0, 0.0)),
)
"""Durations and commands of the demonstration; commands are clipped to the ranges of the training."""
SETTLE_S = 1.0
"""Time after the start of a command, and after a fall, in which errors are not measured [s]."""
FORWARD = 0.7
"""Commanded forward velocity [m/s], clipped to the range of the training."""
EPISODE_S = 12.0
"""Time in which robots walk out of their tile and into the next one; then all robots start again [s]."""
EPISODES = 2
FILM_S = 20.0
"""Length of the filmed part of an episode [s]."""


class TrackingErrors:
    """Sums of squared velocity errors, and numbers of falls, for each of N robots."""

    COLUMNS = ("velocity RMSE", "yaw rate RMSE", "falls")
    """Headings of the columns of `row`."""

    def __init__(self, task: LeggedRobot) -> None:
        self.steps, self.lin, self.ang, self.falls = torch.zeros(4, task.num_envs, device=task.device)
        """(N,) each: number of measured control steps, sums of squared errors of (vx, vy) [m^2/s^2] and of the yaw rate
        [rad^2/s^2], and number of falls.
        """

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
    """Return two lines of text: the commanded velocity of the first of `robots`, and the mean actual velocity of `robots`."""
    wanted = task.commands[robots][0, :3].tolist()
    actual = [*task.base_lin_vel[robots, :2].mean(dim=0).tolist(), float(task.base_ang_vel[robots, 2].mean())]
    text = "{}  {:+.2f}  {:+.2f} m/s  {:+.2f} rad/s"
    return [text.format("commanded", *wanted), text.format("actual", *actual)]


@torch.inference_mode()
def follow_schedule(task: LeggedRobot, act: Policy, video: Video) -> Table:
    """Let all robots follow the schedule, record `video`, and return a table of errors and falls."""
    rows = []
    low, high = task.command_sampler.full_ranges.cpu().numpy().T
    task.reset()
    for seconds, wanted in SCHEDULE:
        command = np.clip(np.array(wanted), low, high)
        errors = TrackingErrors(task)
        observations = task.hold_commands(errors.steps.new_tensor(command))
        for step in range(max(1, round(seconds / task.dt))):
            observations, _, _, _ = task.step(act(observations))
            settled = task.episode_length_buf * task.dt >= SETTLE_S
            errors.add(task, settled & (step * task.dt >= SETTLE_S))
            if video.due(step):
                video.take(*velocities(task, slice(None)))
        rows.append([", ".join(f"{value:g}" for value in command), *errors.row()])
    return screen_table("following commands", ("vx, vy [m/s], yaw [rad/s]", *TrackingErrors.COLUMNS), rows)


@torch.inference_mode()
def walk_out(task: LeggedRobot, act: Policy, playground: Playground, video: Video) -> Table:
    """Let the robots walk along x from the middle of their tiles, record `video`, and return a table of errors and falls by
    terrain type.
    """
    assert task.terrain is not None, "the task stands on a plane"
    errors = TrackingErrors(task)
    low, high = task.command_sampler.full_ranges[0].tolist()
    speed = min(max(FORWARD, low), high)
    command, heading = errors.steps.new_tensor([speed, 0.0, 0.0]), torch.zeros_like(errors.steps)
    playground.place(task)
    for episode in range(EPISODES):
        task.reset()
        observations = task.hold_commands(command, heading)
        followed = episode % task.num_envs
        for step in range(max(1, round(EPISODE_S / task.dt))):
            observations, _, _, _ = task.step(act(observations))
            errors.add(task, task.episode_length_buf * task.dt >= SETTLE_S)  # robots are left out for SETTLE_S after a reset
            if video.due(step):
                where = playground.label(task.terrain, task.base_pos[followed].tolist())
                video.take(*velocities(task, slice(followed, followed + 1)), where, followed=followed)
    rows = []
    kinds = [playground.rows[0][column].type for column in playground.columns(task.num_envs)]
    for kind, label in playground.labels().items():
        robots = errors.steps.new_tensor([own == kind for own in kinds], dtype=torch.bool)
        if robots.any():
            rows.append([label, str(int(robots.sum())), *errors.row(robots)])
    title = f"walking out at {speed:g} m/s, {EPISODES} times {EPISODE_S:g} s"
    return screen_table(title, ("terrain", "robots", *TrackingErrors.COLUMNS), rows)


def roll_out(task: BaseTask, act: Policy, video: Video) -> Table:
    """Run an episode in every environment, record `video` in the first, and return a table of returns and lengths."""

    def film(step: int, so_far: float) -> None:
        if video.due(step) and step * task.dt < FILM_S:
            video.take(f"{step * task.dt:.1f} s, return {so_far:.0f}")

    return episodes_table(measure_episodes(task, act, film), task.cfg.task)
