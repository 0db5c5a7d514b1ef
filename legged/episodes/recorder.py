"""Recordings of a policy's episodes: the task is built again with or without disturbances, and robots run whole episodes. At
every control step, quantities are stored on the device. Chunks of many steps are copied from there to the host.
"""

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any

import mujoco
import numpy as np
import torch
from torch import Tensor

from legged.config import TaskConfig, follows_velocities, has_robot, override
from legged.config.loader import to_dict
from legged.envs import BaseTask, RobotTask, is_robot_task, is_velocity_task
from legged.envs.final_observation import watch_steps
from legged.episodes.stored import AXES, FORMAT, Episodes
from legged.errors import ConfigError
from legged.evaluation.measurement import Overflows, warn_of_overflows
from legged.evaluation.result_file import changes_of, device_name
from legged.physics import engine_name, resolve_physics
from legged.play.playground import SETTING, Playground
from legged.policies.episodes import Policy, unit_of
from legged.policies.restore import TrainedPolicy, restore, undisturbed

MOST_EPISODES = 4096
"""Largest number of episodes of a recording. With 20 s each they take some gigabytes."""
GOLDEN = 0.5 * (5.0**0.5 - 1.0)
"""The golden ratio minus 1."""
FLAGS = ("failed", "timed_out")
"""First columns of `ended`; a column for each termination term follows."""
CHUNK_MB = 64.0
"""Largest size of a chunk of steps on the device, which is fetched in one transfer [MiB]."""
LONGEST_CHUNK = 100
"""Largest number of steps of a chunk. After each chunk the recorder checks whether all robots have finished."""


@dataclass(frozen=True)
class Wish:
    """Settings of a recording, from the command line."""

    episodes: int
    robots: int
    as_trained: bool = False
    """True: noise, pushes, curricula and randomisation are those of the training."""
    command: tuple[float, float, float] | None = None
    """Command of all robots, vx, vy [m/s], yaw rate [rad/s]; if None, commands are sampled as in the training."""
    terrain: str | None = None
    """Terrain type, as in `play`. If neither type nor difficulty is given, the ground is that of the training."""
    difficulty: float | None = None
    changes: tuple[tuple[str, Any], ...] = ()
    """Overrides of the user, which are applied last."""


def check_wish(policy: TrainedPolicy, wish: Wish) -> Playground | None:
    """Check that the settings fit the task, and return the playground; None if the task keeps its own ground.

    Raises:
        ConfigError: a setting does not fit the task.
    """
    if wish.command is not None and not follows_velocities(policy.cfg):
        raise ConfigError(f"--command: '{policy.cfg.task}' follows no commands")
    for flag, given in (("terrain", wish.terrain), ("difficulty", wish.difficulty)):
        if given is not None and wish.as_trained:
            raise ConfigError(f"--{flag}: --as-trained takes the ground of the training; leave out one of the two")
    wanted = override(policy.cfg, wish.changes)
    chosen = wish.terrain is not None or wish.difficulty is not None
    return Playground.of(wanted, wish.terrain, wish.difficulty) if chosen else None


def roll_out(
    policy: TrainedPolicy, wish: Wish, device: torch.device, graph: bool = True, where: str = "sim.physics"
) -> tuple[Episodes, TaskConfig]:
    """Record a policy's episodes on `device`; return the episodes and the task's configuration. `where` names the setting
    that chooses the engine, for error messages.

    Raises:
        ConfigError: a setting or the checkpoint does not fit the task.
        TermError: the step cannot be captured.
    """
    playground = check_wish(policy, wish)
    changes = [("sim.physics", resolve_physics("auto", device)), *_changes(policy, wish, playground)]
    changed: Any = override(policy.cfg, changes)
    engine = engine_name(changed.sim, device, where)
    task, act = restore(policy, changes, device, graph, None if playground is None else playground.build(changed))
    place = partial(playground.place, task) if playground is not None else None
    if place is None and not wish.as_trained and getattr(task, "terrain_curriculum", None) is not None:
        place = partial(spread, task)
    episodes, lost = record_episodes(task, act, wish.episodes, wish.command, place, graph)
    warn_of_overflows("episodes", lost)
    about = _about(task) | {
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


def spread(task: RobotTask) -> None:
    """Distribute robots evenly over the tiles of all levels and types. The level of robot i follows from the fractional part
    of i times the golden ratio, so that consecutive robots have levels that are far apart.
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
    else:
        own += undisturbed(cfg, wish.robots)
    if playground is not None and has_robot(cfg):
        own += [*SETTING, *playground.changes(cfg)]
    return [*own, *wish.changes, ("env.num_envs", wish.robots)]


def _about(task: BaseTask) -> dict[str, Any]:
    """Return the part of the recording's description that depends on the task only."""
    legs: dict[str, Any] = {}
    if is_robot_task(task):
        robot = task.robot
        legs = {
            "robot": robot.name,
            "mass": robot.mass,
            "feet": list(robot.feet_names),
            "contacts": list(robot.contact_names),
            "contact_threshold": task.contacts.force,
            "default_joint_pos": robot.default_qpos[list(robot.qpos_columns)].tolist(),
        }
    return {
        "format": FORMAT,
        "task": task.cfg.task,
        "dt": task.dt,
        "sim_dt": task.cfg.sim.dt,
        "episode_length_s": task.cfg.env.episode_length_s,
        "reward_unit": unit_of(task),
        "terminations": list(task.terminations.names),
        "joints": joints_of(task),
        **legs,
        "arrays": {
            quantity.name: {"unit": quantity.unit, "what": quantity.what, "columns": list(quantity.columns)}
            for quantity in quantities_of(task)
            if quantity.name != "ended"
        },
    }


# ---- steps -------------------------------------------------------------------------------------------------------------


class StepRecord:
    """All quantities of a step, in a row for each robot. The rows are written as a part of the captured step."""

    def __init__(self, task: BaseTask) -> None:
        self.quantities = quantities_of(task)
        values = [quantity.read() for quantity in self.quantities]
        self.shapes = [tuple(value.shape[1:]) for value in values]
        self.widths = [int(np.prod(shape)) for shape in self.shapes]
        self.row = torch.zeros(task.num_envs, sum(self.widths), device=task.device)
        """(N, W) quantities of every robot at the end of the last step, before robots are reset."""

    def take(self) -> None:
        """Write the current quantities into the rows."""
        rows = len(self.row)
        values = [quantity.read().reshape(rows, width) for quantity, width in zip(self.quantities, self.widths, strict=True)]
        torch.cat([value.float() for value in values], dim=1, out=self.row)

    def split(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        """Return name -> (T, ...) values of every quantity, from rows (T, W)."""
        parts = np.split(rows, np.cumsum(self.widths)[:-1], axis=1)
        return {
            quantity.name: part.reshape(len(rows), *shape)
            for quantity, part, shape in zip(self.quantities, parts, self.shapes, strict=True)
        }


def shares_of(episodes: int, robots: int) -> np.ndarray:
    """Return the number of episodes (N,) that each robot contributes. The numbers are fixed beforehand, so that they do not
    depend on the lengths of episodes.
    """
    return episodes // robots + (np.arange(robots) < episodes % robots)


def record_episodes(
    task: BaseTask,
    act: Policy,
    episodes: int,
    command: tuple[float, float, float] | None = None,
    place: Callable[[], None] | None = None,
    graph: bool = True,
) -> tuple[Episodes, int]:
    """Run `episodes` episodes, each from a reset to its end. Return them in order: all robots' first episodes, their second
    ones, and so on. Also return how often a robot lost contacts in a step because memory was short.

    Robot i contributes its first `shares_of(...)[i]` episodes, long or short. If the episodes that end first were taken
    instead, short ones would be too frequent. All robots hold `command`, vx, vy [m/s] and yaw rate [rad/s], if it is given.
    `place` is called before the first reset to place robots. With `graph`, a GPU captures the step as a CUDA graph.

    Raises:
        TermError: the step cannot be captured.
    """
    progress = copy.deepcopy(task.progress())
    record = StepRecord(task)
    watch_steps(task, record.take, graph)
    task.load_progress(progress)  # watch_steps has set curricula back to their start
    if place is not None:
        place()
    physics, (n, width), shares = task.physics, record.row.shape, shares_of(episodes, task.num_envs)
    # A row holds the quantities of a step, then qpos and qvel after the resets of this step. If an episode ended in this
    # step, qpos and qvel are the first state of the next episode.
    whole = width + physics.qpos.shape[1] + physics.qvel.shape[1]
    length = max(1, min(LONGEST_CHUNK, int(CHUNK_MB * 2**20 / (4 * n * whole)), task.max_episode_length))
    buffer = torch.zeros(length, n, whole, device=task.device)
    flags = slice(width - record.widths[-1], width - record.widths[-1] + len(FLAGS))
    with torch.inference_mode():
        observations, overflows = task.reset(), Overflows()
        if command is not None and is_velocity_task(task):
            observations = task.hold_commands(buffer.new_tensor(command))
        torch.cat([record.row, physics.qpos, physics.qvel], dim=1, out=buffer[0])
        chunks, finished = [np.array(buffer[:1].cpu())], np.zeros(n, dtype=int)
        while (finished < shares).any():
            for row in buffer:
                observations, _, _, extras = task.step(act(observations))
                overflows.add(extras)
                torch.cat([record.row, physics.qpos, physics.qvel], dim=1, out=row)
            chunks.append(np.array(buffer.cpu()))
            finished += chunks[-1][:, :, flags].any(axis=2).sum(axis=0)
    steps = np.concatenate(chunks)
    del chunks
    spans = []  # (number among the robot's episodes, robot, row before the first step, last row)
    for robot, share in enumerate(shares):
        ends = np.flatnonzero(steps[1:, robot, flags].any(axis=1))[:share] + 1
        spans += [(k, robot, begin, end) for k, (begin, end) in enumerate(pairwise([0, *ends.tolist()]))]
    spans.sort()
    arrays = record.split(np.concatenate([steps[begin + 1 : end + 1, robot, :width] for _, robot, begin, end in spans]))
    first = np.array([steps[begin, robot, width:] for _, robot, begin, _ in spans])
    starts = np.cumsum([0, *(end - begin for _, _, begin, end in spans)])
    ended = arrays.pop("ended")[starts[1:] - 1].astype(bool)
    per_episode = {
        "episode_start": starts,
        "robot": np.array([robot for _, robot, _, _ in spans]),
        "failed": ended[:, 0],
        "timed_out": ended[:, 1],
        "ended_by": ended[:, len(FLAGS) :],
        "first_qpos": first[:, : physics.qpos.shape[1]],
        "first_qvel": first[:, physics.qpos.shape[1] :],
    }
    return Episodes({**arrays, **per_episode}, {}), overflows.total(task)


# ---- quantities --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Quantity:
    """A quantity of N robots at the end of a control step."""

    name: str
    read: Callable[[], Tensor]
    """Return the current values (N, ...)."""
    unit: str
    what: str
    """Description, with the frame if the quantity has one."""
    columns: tuple[str, ...] = ()
    """Names along the second axis of the values; empty if the values are (N,)."""


def quantities_of(task: BaseTask) -> list[Quantity]:
    """Return the recorded quantities of a task; `ended` comes last."""
    physics, rewards, terms = task.physics, task.rewards, task.terminations
    model = physics.model

    def ended() -> Tensor:
        return torch.stack([terms.failed, terms.timed_out, *terms.found], dim=1)

    return [
        Quantity("qpos", lambda: physics.qpos, "m, rad", "generalised positions in MuJoCo's layout", _coordinates(model, 0)),
        Quantity(
            "qvel", lambda: physics.qvel, "m/s, rad/s", "generalised velocities, MuJoCo's layout", _coordinates(model, 1)
        ),
        Quantity("action", lambda: task.actions, "1", "what the policy asked for, clipped", _actions(task)),
        Quantity("reward", lambda: task.rew_buf, "1", "sum of the parts; a negative sum may have been set to 0"),
        Quantity("reward_parts", lambda: rewards.last.t(), "1", "scale times term of this step", rewards.names),
        *(_of_robot(task) if is_robot_task(task) else _of_motors(task)),
        Quantity("ended", ended, "1", "failed, out of time, and by which terms", (*FLAGS, *terms.names)),
    ]


def joints_of(task: BaseTask) -> list[dict[str, Any]]:
    """Return a mapping for each joint with a motor, in the order of the motors, to be written as JSON. The list is empty if a
    motor drives something other than one joint.

    `unit` is the unit of the joint's position: rad, or m for a slide. `qpos` and `qvel` are the joint's columns in the
    generalised positions and velocities. `range` has the lowest and the highest position. `max_torque` is the largest nominal
    torque [N m], or force [N] of a slide, in either direction. A limit is None if the joint does not have it.
    """
    model = task.physics.model
    if is_robot_task(task):
        robot, turning = task.robot, [True] * len(task.robot.joint_names)
        names, positions, velocities = robot.joint_names, robot.qpos_columns, robot.qvel_columns
        ranges, fastest = np.asarray(robot.dof_pos_limits), robot.dof_vel_limits
        strongest = task.control.nominal["torque_limit"].tolist()
    elif _all_motors(model):
        numbers = model.actuator_trnid[:, 0]
        names = tuple(model.joint(j).name for j in numbers)
        turning = (model.jnt_type[numbers] == mujoco.mjtJoint.mjJNT_HINGE).tolist()
        positions, velocities = model.jnt_qposadr[numbers], model.jnt_dofadr[numbers]
        limited = model.jnt_limited[numbers, None].astype(bool)
        ranges, fastest = np.where(limited, model.jnt_range[numbers], np.inf), np.full(model.nu, np.inf)
        strongest = np.abs(_control_ranges(model)).max(axis=0) * np.abs(_torque_per_control(model))
    else:
        return []
    return [
        {
            "name": names[i],
            "unit": "rad" if turning[i] else "m",
            "qpos": int(positions[i]),
            "qvel": int(velocities[i]),
            "range": [float(limit) for limit in ranges[i]] if np.isfinite(ranges[i]).all() else None,
            "max_velocity": float(fastest[i]) if np.isfinite(fastest[i]) else None,
            "max_torque": float(strongest[i]) if np.isfinite(strongest[i]) else None,
        }
        for i in range(len(names))
    ]


def _of_robot(task: RobotTask) -> list[Quantity]:
    """Return the quantities that are recorded only for tasks with a robot."""
    joints, feet, shapes = task.robot.joint_names, task.robot.feet_names, task.robot.contact_names
    columns, names, unit = task.feet_indices, ("vx", "vy", "yaw"), "m/s, m/s, rad/s"
    what = "velocity that was asked for in this step, base frame"
    asked = [Quantity("command", lambda: task.commands[:, :3], unit, what, names)] if is_velocity_task(task) else []
    force = "contact forces on the feet at the last physics step, world frame, by x, y, z"
    sizes = "size of the contact force on every tracked shape"
    return [
        Quantity("base_lin_vel", lambda: task.base_lin_vel, "m/s", "velocity of the base, base frame", AXES),
        Quantity("base_ang_vel", lambda: task.base_ang_vel, "rad/s", "angular velocity of the base, base frame", AXES),
        Quantity("ground", lambda: task.height_scan.ground, "m", "height of the ground below the base, world frame"),
        Quantity("joint_pos", lambda: task.dof_pos, "rad", "angles of the joints with a motor", joints),
        Quantity("joint_vel", lambda: task.dof_vel, "rad/s", "velocities of the joints with a motor", joints),
        Quantity("torque", lambda: task.torques, "N m", "torques of the last physics step", joints),
        *asked,
        Quantity("feet_pos", lambda: task.feet_pos, "m", "centres of the feet, world frame, by x, y, z", feet),
        Quantity("feet_force", lambda: task.contact_forces.index_select(1, columns), "N", force, feet),
        Quantity("feet_contact", lambda: task.contacts.in_contact, "1", "1 in contact, now or in the previous step", feet),
        Quantity("contact_force", lambda: task.contact_forces.norm(dim=2), "N", sizes, shapes),
    ]


def _of_motors(task: BaseTask) -> list[Quantity]:
    """Return the quantities of joints with motors; an empty list if the model has other actuators."""
    model, physics, joints = task.physics.model, task.physics, joints_of(task)
    if not joints:
        return []
    names = tuple(joint["name"] for joint in joints)
    units = "rad" if all(joint["unit"] == "rad" for joint in joints) else "rad, m"
    positions, velocities = torch.tensor([[joint[name] for joint in joints] for name in ("qpos", "qvel")]).to(physics.device)
    low, high = torch.as_tensor(_control_ranges(model), dtype=torch.float32, device=physics.device)
    per_control = torch.as_tensor(_torque_per_control(model), dtype=torch.float32, device=physics.device)
    return [
        Quantity("joint_pos", lambda: physics.qpos.index_select(1, positions), units, "joint positions", names),
        Quantity("joint_vel", lambda: physics.qvel.index_select(1, velocities), f"{units} per s", "joint velocities", names),
        Quantity("torque", lambda: physics.ctrl.clamp(low, high) * per_control, "N m", "torques of the motors", names),
    ]


def _all_motors(model: mujoco.MjModel) -> bool:
    """Return whether every actuator drives one hinge or slide with a torque or force proportional to its control."""
    if not model.nu or (model.actuator_trntype != mujoco.mjtTrn.mjTRN_JOINT).any():
        return False
    kinds = model.jnt_type[model.actuator_trnid[:, 0]]
    return bool(
        np.isin(kinds, (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)).all()
        and (model.actuator_gaintype == mujoco.mjtGain.mjGAIN_FIXED).all()
        and (model.actuator_biastype == mujoco.mjtBias.mjBIAS_NONE).all()
        and (model.actuator_dyntype == mujoco.mjtDyn.mjDYN_NONE).all()
        and not model.actuator_forcelimited.any()
    )


def _torque_per_control(model: mujoco.MjModel) -> np.ndarray:
    return model.actuator_gear[:, 0] * model.actuator_gainprm[:, 0]


def _control_ranges(model: mujoco.MjModel) -> np.ndarray:
    """Return the least and the greatest control of every motor, (2, nu); both are infinite without a range."""
    limited = model.actuator_ctrllimited[:, None].astype(bool)
    return np.where(limited, model.actuator_ctrlrange, [-np.inf, np.inf]).T


def _actions(task: BaseTask) -> tuple[str, ...]:
    if is_robot_task(task):
        return tuple(task.robot.joint_names[i] for i in task.control.acted)
    model = task.physics.model
    return tuple(model.actuator(i).name or f"actuator {i}" for i in range(model.nu))


def _coordinates(model: mujoco.MjModel, derivative: int) -> tuple[str, ...]:
    """Return the names of generalised positions (`derivative` 0) or velocities (1) in the form `<joint>.<part>`."""
    turn = tuple(f"w{axis}" for axis in AXES) if derivative else ("qw", "qx", "qy", "qz")
    parts = {mujoco.mjtJoint.mjJNT_FREE: (*AXES, *turn), mujoco.mjtJoint.mjJNT_BALL: turn}
    found: list[str] = []
    for i in range(model.njnt):
        name = model.joint(i).name or f"joint {i}"
        inner = parts.get(mujoco.mjtJoint(int(model.jnt_type[i])))
        found += [name] if inner is None else [f"{name}.{part}" for part in inner]
    return tuple(found)
