"""Episodes of a policy: the task is rebuilt with or without disturbances, and described for the file."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch

from legged.config import LeggedConfig, TaskConfig, override
from legged.config.loader import to_dict
from legged.envs import BaseTask, LeggedRobot
from legged.episodes.quantities import joints_of
from legged.episodes.recorder import StepRecord, record_episodes
from legged.episodes.stored import Episodes
from legged.episodes.stored_check import FORMAT
from legged.errors import ConfigError
from legged.evaluation.measurement import warn_of_overflows
from legged.evaluation.result_file import changes_of, device_name
from legged.physics import engine_name, resolve_physics
from legged.play.playground import SETTING, Playground
from legged.policies.episodes import unit_of
from legged.policies.restore import TrainedPolicy, restore, undisturbed
from legged.terrain import Terrain

MOST_EPISODES = 4096
"""Most episodes of a recording; at 20 s each they take some gigabytes."""


GOLDEN = 0.5 * (5.0**0.5 - 1.0)
"""The golden ratio minus 1."""


@dataclass(frozen=True)
class Wish:
    """Choices of the command line."""

    episodes: int
    robots: int
    as_trained: bool = False
    """Keep noise, pushes, curricula and randomisation of the training."""
    command: tuple[float, float, float] | None = None
    """vx, vy [m/s], yaw rate [rad/s] for all robots; commands of the training if None."""
    terrain: str | None = None
    """Type of the tiles, as in play; without it and a difficulty, the ground of the training."""
    difficulty: float | None = None
    changes: tuple[tuple[str, Any], ...] = ()
    """Overrides, applied last."""


def check_wish(policy: TrainedPolicy, wish: Wish) -> Playground | None:
    """Return the chosen tiles; None if the task keeps its own ground.

    Raises:
        ConfigError: a choice does not fit the task.
    """
    task = policy.cfg.task
    if not isinstance(policy.cfg, LeggedConfig):
        for flag in ("terrain", "difficulty", "command"):
            if getattr(wish, flag) is not None:
                what = "follows no commands" if flag == "command" else "has no terrain to choose"
                raise ConfigError(f"--{flag}: '{task}' {what}")
        return None
    if wish.as_trained:
        for flag in ("terrain", "difficulty"):
            if getattr(wish, flag) is not None:
                raise ConfigError(f"--{flag}: --as-trained takes the ground of the training; leave one of them out")
        return None
    wanted: Any = override(policy.cfg, wish.changes)
    if wish.terrain is None and wish.difficulty is None:
        return None
    return Playground.of(wanted, wish.terrain, wish.difficulty)


def ground_of(cfg: TaskConfig, chosen: dict[str, Any] | None) -> Terrain | None:
    """Build the tiles of recorded episodes again; return None if the task builds its ground itself. `cfg` is the task's
    configuration, `chosen` the entry "ground" of episodes.json.

    Raises:
        ConfigError: the type of the tiles is unknown.
    """
    if chosen is None or not isinstance(cfg, LeggedConfig):
        return None
    playground = Playground.of(cfg, chosen["terrain"], chosen["difficulty"])
    return None if playground is None else playground.build(cfg)


def roll_out(
    policy: TrainedPolicy, wish: Wish, device: torch.device, graph: bool = True, where: str = "sim.physics"
) -> tuple[Episodes, TaskConfig]:
    """Record a policy's episodes on `device`; return them and their task's configuration. `where` names the setting of the
    engine in errors.

    Raises:
        ConfigError: a choice does not fit the task, or the checkpoint does not fit.
        TermError: the step cannot be captured.
    """
    playground = check_wish(policy, wish)
    changes = _changes(policy, wish, playground)
    asked = [("sim.physics", resolve_physics("auto", device)), *changes]
    engine = engine_name(override(policy.cfg, asked).sim, device, where)
    terrain = None
    if playground is not None:
        built: Any = override(policy.cfg, asked)
        terrain = playground.build(built)
    task, act = restore(policy, asked, device, graph, terrain)
    place = partial(playground.place, task) if playground is not None else None
    if place is None and not wish.as_trained and getattr(task, "terrain_curriculum", None) is not None:
        place = partial(spread, task)
    episodes, lost = record_episodes(task, act, wish.episodes, wish.command, place, graph)
    warn_of_overflows("episodes", lost)
    about = _about(task, StepRecord(task)) | {
        "checkpoint": policy.checkpoint.name,
        "run": "/".join(policy.folder.resolve().parts[-3:]),
        "physics": engine,
        "device": device_name(device),
        "as_trained": wish.as_trained,
        "changes": changes_of(wish.changes),
        "held_command": list(wish.command) if wish.command else None,
        "ground": {"terrain": wish.terrain, "difficulty": wish.difficulty} if playground is not None else None,
        "episodes": wish.episodes,
        "robots": task.num_envs,
        "seed": task.cfg.env.seed,
        "contact_overflows": lost,
    }
    return replace(episodes, about=about), task.cfg


def spread(task: LeggedRobot) -> None:
    """Put robots on tiles of all levels and types evenly, where they stay. The level of robot i is given by the fractional
    part of i times the golden ratio, so that the levels of any few robots are far apart.
    """
    assert task.terrain_curriculum is not None, "the task stands on a plane"
    share = torch.arange(task.num_envs, device=task.device) * GOLDEN % 1.0
    curriculum = task.terrain_curriculum
    curriculum.place_at((share * curriculum.rows).long(), curriculum.columns.clone())


def _changes(policy: TrainedPolicy, wish: Wish, playground: Playground | None) -> list[tuple[str, Any]]:
    """Return the overrides of a recording."""
    cfg = policy.cfg
    own: list[tuple[str, Any]] = [("env.num_envs", wish.robots)]
    if wish.as_trained:
        drawn = to_dict(cfg.domain_rand)
        own += [(f"domain_rand.{name}", drawn[name]) for name in ("ranges", "kicks", "forces") if drawn.get(name)]
    elif isinstance(cfg, LeggedConfig):
        # Episodes keep the length of the training.
        own += [change for change in undisturbed(wish.robots, 0.0) if change[0] != "env.episode_length_s"]
        if playground is not None:
            own += [*SETTING, *playground.changes(cfg)]
    else:
        own.append(("observations.add_noise", False))
    return [*own, *wish.changes, ("env.num_envs", wish.robots)]


def _about(task: BaseTask, record: StepRecord) -> dict[str, Any]:
    """Return the description of the recorded arrays, which depends on the task only."""
    arrays = {
        quantity.name: {"unit": quantity.unit, "what": quantity.what, "columns": list(quantity.columns)}
        for quantity in record.quantities
        if quantity.name != "ended"
    }
    legs: dict[str, Any] = {}
    if isinstance(task, LeggedRobot):
        robot = task.robot
        default = np.asarray(robot.default_qpos)[list(robot.qpos_columns)]
        legs = {
            "robot": robot.name,
            "mass": robot.mass,
            "feet": list(robot.feet_names),
            "contacts": list(robot.contact_names),
            "contact_threshold": task.contacts.force,
            "default_joint_pos": default.tolist(),
        }
    return {
        "format": FORMAT,
        "task": task.cfg.task,
        "dt": task.dt,
        "sim_dt": task.cfg.sim.dt,
        "episode_length_s": task.cfg.env.episode_length_s,
        "reward_unit": unit_of(task),
        "terminations": list(task.terminations.names),
        "joints": [joint.described() for joint in joints_of(task)],
        **legs,
        "arrays": arrays,
    }
