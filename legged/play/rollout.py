"""Robots of a task without commands do what they have learned, for an episode."""

from rich.table import Table

from legged.envs import BaseTask
from legged.play.video import Video
from legged.policies.episodes import Policy, episodes_table, measure_episodes

FILM_S = 20.0
"""How much of an episode is filmed [s]."""


def roll_out(task: BaseTask, act: Policy, video: Video) -> Table:
    """Run every environment through an episode, the first one filmed by `video`; return a table of what was measured."""

    def film(step: int, so_far: float) -> None:
        if video.due(step) and step * task.dt < FILM_S:
            video.take(f"{step * task.dt:.1f} s, return {so_far:.0f}")

    return episodes_table(measure_episodes(task, act, film), task.cfg.task)
