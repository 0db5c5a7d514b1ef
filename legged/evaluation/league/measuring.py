"""Runs of a policy in the league: stages, scores, table and file."""

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from tensordict import TensorDict
from torch import Tensor

from legged.config import LeggedConfig, follows_velocities
from legged.config.actuator import ActuatorConfig
from legged.errors import ConfigError
from legged.evaluation.intervals import bootstrap_mean, wilson
from legged.evaluation.league.protocol import CONTROL_DT, POINTS, RUN_S
from legged.evaluation.league.robot import HUMANOIDS, OURS, arms_of, check_robot, league_robot, servo_gains
from legged.evaluation.league.task import SLOT, STAGES, Course, LeagueTask, make_league
from legged.evaluation.measurement import Overflows, Setting, warn_of_overflows
from legged.evaluation.result_file import changes_of, device_name, write_result
from legged.mdp.control import control_gains
from legged.physics import engine_name, resolve_physics
from legged.policies.foreign import ForeignPolicy, Layout
from legged.policies.restore import nominal, restore, undisturbed
from legged.process.paths import relative
from legged.registry import task_config
from legged.robots.robot import Robot, load_robot
from legged.tables import screen_table

MOST_RUNS = 2**16
"""Largest number of runs of a stage."""
SOLVER = {"dt": 0.002, "impratio": 1.0, "iterations": 100, "ls_iterations": 50, "nconmax": 64, "njmax": 320}
"""Settings of the section `sim`: MuJoCo's defaults, and memory for a robot that lies on the ground."""
FIXED = (
    *("control.", "commands.", "domain_rand.", "terrain.", "rewards.scales", "robot", "sim.self_collisions"),
    *("env.num_envs", "env.episode_length_s", *(f"sim.{name}" for name in SOLVER)),
)
"""Beginnings of the settings that the league's rules set."""
AT_ONCE_S = 1.0
"""Simulated time after which the runs are asked whether all have ended [s]."""
Act = Callable[[LeagueTask, TensorDict], Tensor]
"""Task and observations -> actions (N, A)."""


def rules(cfg: LeggedConfig, course: Course, stage: str, gains: tuple[np.ndarray, np.ndarray]) -> list[tuple[str, Any]]:
    """Return the overrides that make a task run a stage under the league's rules. `gains` (D,) each are the policy's."""
    names, used = course.robot.joint_names, gains_of(stage, course.robot, gains)
    tables = (dict(zip(names, values.tolist(), strict=True)) for values in used)
    return [
        *undisturbed(cfg, len(course.points), RUN_S),
        ("robot", str(course.robot.folder)),
        ("terrain.mesh_type", "plane"),
        *zip(("control.stiffness", "control.damping"), tables, strict=True),
        *((f"sim.{name}", value) for name, value in SOLVER.items()),
        ("sim.self_collisions", True),
        ("control.decimation", round(CONTROL_DT / SOLVER["dt"])),
        ("rewards.scales", dict.fromkeys(cfg.rewards.scales, 0.0)),
    ]


def with_ideal_motors(cfg: LeggedConfig) -> LeggedConfig:
    """Return a configuration with motors that give the torques of the PD law, up to their limits."""
    return replace(cfg, control=replace(cfg.control, actuator=ActuatorConfig()))


def gains_of(stage: str, robot: Robot, own: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the gains (D,) of a stage: the policy's, `own`. In all stages except `own`, the G1's arms have the league's."""
    if stage == "own" or not HUMANOIDS[robot.name].is_the_leagues:
        return own
    arms = np.isin(np.arange(robot.num_dof), arms_of(robot))
    stiffness, damping = (np.where(arms, league, given) for league, given in zip(servo_gains(robot), own, strict=True))
    return stiffness, damping


@torch.inference_mode()
def run_tours(task: LeagueTask, act: Act) -> int:
    """Let all robots run their tours, until the end or until all have fallen. The scores are attributes of the task. Return
    how often a robot lost contacts in a control step, because memory was full.
    """
    observations, overflows = task.reset(), Overflows()
    for step in range(POINTS * SLOT):
        observations, _, _, extras = task.step(act(task, observations))
        overflows.add(extras)
        if step % round(AT_ONCE_S / CONTROL_DT) == 0 and not task.alive.any():
            break
    return overflows.total(task)


def scores(task: LeagueTask) -> dict[str, Any]:
    """Return the scores of tours as plain numbers: means, and a list with the figures of each run."""
    lasted, alive = task.lasted.cpu().numpy() * CONTROL_DT, task.alive.cpu().numpy()
    missed, energy = task.missed.cpu().numpy(), task.energy.cpu().numpy()
    ends = SLOT * CONTROL_DT * np.arange(1, POINTS + 1)
    reached = alive[:, None] | (lasted[:, None] > ends + 0.5 * CONTROL_DT)

    def mean(values: np.ndarray) -> float | None:
        return float(values.mean()) if len(values) else None

    runs = [
        {"survival_s": round(float(time), 2), "completed": bool(ended), "slots": int(slots.sum())}
        for time, ended, slots in zip(lasted, alive, reached, strict=True)
    ]
    completed = int(alive.sum())
    return {
        "survival_s": float(lasted.mean()),
        "interval": bootstrap_mean(lasted.tolist()),
        "completed": completed / len(alive),
        "completed_interval": wilson(completed, len(alive)),
        "position_error_m": mean(missed[reached, 0]),
        "yaw_error_rad": mean(missed[reached, 1]),
        "energy_j": mean(energy[alive]),
        "runs": runs,
    }


def evaluate_league(setting: Setting, runs: Sequence[int], stages: Sequence[str]) -> int:
    """Measure a trained policy in the league: the runs with the ids `runs` in each of `stages`. Print a table, write
    league_<physics>.json, and return the exit code.

    Raises:
        ConfigError: the policy's robot is not this package's G1 or H1, its joints have another law than P, or an override is
            one of the league's rules.
        RunError: the file can't be written.
    """
    cfg = setting.cfg
    _check_overrides(setting.asked)
    own = load_robot(cfg.robot)
    check_robot(own, setting.policy.cfg.task)
    assert follows_velocities(setting.policy.cfg)
    if cfg.control.laws != {"P"}:
        raise ConfigError("POLICY: the league moves the arms by their angles, so all joints need control.control_type P")
    policy, ranges = replace(setting.policy, cfg=with_ideal_motors(setting.policy.cfg)), cfg.commands.ranges

    def build(course: Course, stage: str) -> tuple[LeagueTask, Act]:
        changes = [*rules(cfg, course, stage, control_gains(own, cfg.control)), *setting.asked]
        task, actor = restore(policy, changes, setting.device, setting.graph, None, partial(make_league, course, stage))
        return task, lambda _, observations: actor(observations)

    limits = np.array([ranges.lin_vel_x, ranges.lin_vel_y, ranges.ang_vel_yaw])
    return _measure(build, own.name, runs, stages, limits, {**setting.head, **setting.changes}, setting.folder)


def evaluate_foreign(
    file: Path,
    layout: Layout,
    runs: Sequence[int],
    stages: Sequence[str],
    device: torch.device,
    graph: bool,
    overrides: Sequence[tuple[str, Any]],
    folder: Path,
) -> int:
    """Measure an ONNX policy in the league, as `evaluate_league` does for a trained one. Commands are within the ranges of
    the policy's contract, or from -1 to 1 without a contract. The file league_<physics>.json goes to `folder`.

    Raises:
        ConfigError: the policy or its layout does not fit the robot, its control step is not the league's, or an override is
            one of the league's rules.
        RunError: the file can't be written.
    """
    _check_overrides(overrides)
    robot = OURS if layout.contract is None else layout.contract.robot
    if robot not in HUMANOIDS:
        raise ConfigError(f"POLICY: the league measures {' and '.join(HUMANOIDS)}, but {file} is for '{robot}'")
    cfg = task_config(f"{robot}_flat", [("sim.physics", resolve_physics("auto", device)), *overrides])
    assert follows_velocities(cfg)
    if abs(layout.control_dt - CONTROL_DT) > 1e-9:
        raise ConfigError(f"layout: control_dt: must be {CONTROL_DT} in the league, got {layout.control_dt}")

    def build(course: Course, stage: str) -> tuple[LeagueTask, Act]:
        foreign = ForeignPolicy(file, layout, course.robot)
        changes = rules(cfg, course, stage, (foreign.stiffness, foreign.damping))
        changes += [("control.action_scale", 1.0), ("control.clip_actions", 1000.0)]
        foreign.reset(len(runs))
        return make_league(course, stage, nominal(cfg, changes), device, graph, None), partial(_act, foreign)

    limits = layout.contract.command_ranges if layout.contract is not None else np.array([(-1.0, 1.0)] * 3)
    head = {"file": str(file), "physics": engine_name(cfg.sim, device), "device": device_name(device)}
    return _measure(build, robot, runs, stages, limits, {**head, **changes_of(overrides)}, folder)


def _check_overrides(overrides: Sequence[tuple[str, Any]]) -> None:
    for path, _ in overrides:
        if path.startswith(FIXED):
            raise ConfigError(f"{path}: cannot be changed, because the league's rules set it")


def _act(foreign: ForeignPolicy, task: LeagueTask, _: TensorDict) -> Tensor:
    """Return the actions with which the task's joints have the targets of an ONNX policy."""
    state = (task.commands[:, :3], task.base_lin_vel, task.base_ang_vel, task.projected_gravity, task.dof_pos, task.dof_vel)
    targets = foreign.act(*(values.double().cpu().numpy() for values in state))
    return torch.as_tensor(targets - task.robot.default_dof_pos, dtype=torch.float32)


def _measure(
    build: Callable[[Course, str], tuple[LeagueTask, Act]],
    robot: str,
    runs: Sequence[int],
    stages: Sequence[str],
    limits: np.ndarray,
    head: dict[str, Any],
    folder: Path,
) -> int:
    """Run the tours of `robot` in each stage, print the table of their scores, write it to league_<physics>.json in `folder`,
    and return the exit code. `build` makes the task and the policy of a stage. `limits` (3, 2) are the lowest and the highest
    command. `head` has the first fields of the file.
    """
    start, found, rows, lost = time.perf_counter(), {}, [], 0
    with tempfile.TemporaryDirectory() as place:
        course = Course.of(runs, league_robot(robot, Path(place)), limits)
        for stage in stages:
            task, act = build(course, stage)
            lost += run_tours(task, act)
            found[stage] = score = scores(task)
            print(f"{stage}: {score['survival_s']:.1f} s", flush=True)
            interval = "" if score["interval"] is None else "{:.1f} to {:.1f}".format(*score["interval"])
            errors = zip(("position_error_m", "yaw_error_rad", "energy_j"), (3, 2, 0), strict=True)
            texts = ["-" if score[name] is None else f"{score[name]:.{digits}f}" for name, digits in errors]
            rows.append([stage, f"{score['survival_s']:.1f}", interval, f"{100 * score['completed']:.0f} %", *texts])
    heads = ("stage", "survival [s]", "95 %", "completed", "position error [m]", "yaw error [rad]", "energy [J]")
    name = f"{head.get('task', head.get('file'))} in {head['physics']}: {len(runs)} runs of {RUN_S:g} s"
    Console(width=120).print(screen_table(name, heads, rows))
    warn_of_overflows("league", lost)
    result = {**head, "wall_s": time.perf_counter() - start, "stages": found, "contact_overflows": lost}
    path = folder / f"league_{head['physics']}.json"
    write_result(path, {**result, "first_run": runs[0], "definition": STAGES})
    print(f"written: {relative(path)}")
    return 0
