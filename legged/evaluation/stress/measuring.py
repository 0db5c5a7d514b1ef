"""The measurements of the stress test: disturbances on stairs and on the flat, new ground, and other solvers."""

import gc
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from math import sqrt
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from legged.config import LeggedConfig, override
from legged.errors import ConfigError
from legged.evaluation.intervals import mean_of_shares, wilson
from legged.evaluation.overflows import Overflows
from legged.evaluation.stress.stressed_task import GIVEN, StressedTask, declared, make_stressed
from legged.evaluation.stress.table import NOMINAL, WRITTEN_FOR, Disturbance, table
from legged.evaluation.success import point, run_out, to_run_out
from legged.evaluation.tiles import dividing_cell, tiles_apart
from legged.evaluation.velocity_grid import axes_of, number_or_null
from legged.mdp.actuator_network import NetworkWeights
from legged.mdp.tracking_error import velocity_error
from legged.policies.restore import TrainedPolicy, restore, undisturbed
from legged.robots.similarity import size_of
from legged.terrain import TERRAIN_TYPES, Terrain, TileSpec

RISER = 0.17
"""Height of the steps of the stairs, at scale 1 [m]."""
TREAD = 0.28
"""Width of the steps, for a robot of any size: that of a house's stairs [m]."""
STAIRS = ("stairs_up", "stairs_down")
"""Half of the robots go up, the others down."""
GROUND = {"dense_blocks": 0.25, "kerbs": 0.17, "rubble": 0.2}
"""Type of ground that no task is trained on -> its size at scale 1 [m]."""
HOLD_S, SETTLE_S = 6.0, 1.0
"""Time for which a command is held on the flat, and the time at its start that is not measured [s]."""
LIMIT = 0.25
"""Largest root mean square error of the velocity of a robot that follows its command, at scale 1 [m/s]."""
COMMANDS = (
    *((1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)),
    *((0.5, 0.0, 0.5), (0.5, 0.0, -0.5)),
)
"""Commands on the flat (vx, vy, yaw rate), as parts of the ends of the axes of the task's grid; they are given to the robots
in turn."""
HALF_STEP = "half the time step"
"""Name of the setting that LSTM actuators do not allow."""


@dataclass(frozen=True)
class Wish:
    """Values of the command line in place of the defaults."""

    riser: float | None = None
    """Height of the steps [m]; RISER times the scale by default."""
    tread: float = TREAD
    """Width of the steps [m]."""
    payload: float | None = None
    """Mass on the base [kg]; that of the table by default."""
    lines: tuple[str, ...] = ()
    """Names of the lines that are measured; by default all, with new ground and other solvers."""


@dataclass(frozen=True)
class Setting:
    """Another solver setting, as overrides."""

    name: str
    changes: tuple[tuple[str, Any], ...]


def settings(cfg: LeggedConfig, engine: str) -> list[Setting]:
    """Return the solver settings to try, besides the task's own, that engine and motors allow."""
    halved: tuple[tuple[str, Any], ...] = (("sim.dt", 0.5 * cfg.sim.dt), ("control.decimation", 2 * cfg.control.decimation))
    if cfg.control.actuator.delay[1]:  # in physics steps
        halved = (*halved, ("control.actuator.delay", [2 * steps for steps in cfg.control.actuator.delay]))
    found = [Setting(HALF_STEP, halved)] if can_halve_step(cfg) else []
    if engine in ("mujoco", "mujoco_warp", "newton_mujoco"):
        found += [
            Setting("elliptic cones", (("sim.cone", "elliptic"),)),
            Setting("impratio 100", (("sim.impratio", 100.0), ("sim.iterations", max(50, cfg.sim.iterations)))),
        ]
    return found


def can_halve_step(cfg: LeggedConfig) -> bool:
    """Return whether a task can be simulated with half its time step. An LSTM of the motors can't, because it advances with
    every step of the length that it was trained with.
    """
    network = cfg.control.actuator.network
    return not network or NetworkWeights.load(network).kind != "lstm"


def check_asked(changes: Sequence[tuple[str, Any]]) -> None:
    """Check that the command line randomises no property that the lines of the table set.

    Raises:
        ConfigError: it randomises one.
    """
    ranges = "domain_rand.ranges"
    for key, value in changes:
        names = value if key == ranges and isinstance(value, dict) else (key.removeprefix(f"{ranges}.").split(".")[0],)
        for name in names if key.startswith(ranges) else ():
            if name in GIVEN:
                raise ConfigError(
                    f"command line: {ranges}.{name}: legged evaluate stress sets it in each of its lines; leave it out"
                )


class Bench:
    """A policy on the test bench: builds tasks of stressed robots and measures them one after the other."""

    def __init__(
        self,
        policy: TrainedPolicy,
        robots: int,
        wish: Wish,
        asked: Sequence[tuple[str, Any]],
        device: torch.device,
        graph: bool,
    ) -> None:
        """Take `robots` for each line of the table; `asked` holds the overrides of the command line.

        Raises:
            ConfigError: the robot cannot be loaded, or `asked` randomises a property that the table sets.
        """
        check_asked(asked)
        assert isinstance(policy.cfg, LeggedConfig), "the task follows no commands"
        self.cfg: LeggedConfig = override(policy.cfg, asked)  # type: ignore[assignment]
        rows = table(size_of(policy.cfg.robot), size_of(WRITTEN_FOR), wish.payload)
        self.rows = tuple(row for row in rows if not wish.lines or row.name in wish.lines)
        """The lines of the table that are measured."""
        self.scale = self.cfg.terrain.scale
        self.riser = round(RISER * self.scale, 3) if wish.riser is None else wish.riser
        self.tread, self.robots = wish.tread, robots
        self.limit = LIMIT * sqrt(self.scale)
        """Largest error of a robot that follows its command [m/s]."""
        self.lost = 0
        """Number of control steps in which a robot lost contacts because memory was full."""
        self._policy, self._asked, self._device, self._graph = policy, tuple(asked), device, graph

    @property
    def on_plane(self) -> bool:
        """True if the policy was trained on a plane; it is then measured on the flat only."""
        return self.cfg.terrain.mesh_type == "plane"

    def measure(self, rows: Sequence[Disturbance], changes: Sequence[tuple[str, Any]] = ()) -> list[dict[str, Any]]:
        """Return the figures of some lines of the table; `changes` choose a solver."""
        found: list[dict[str, Any]] = [{"name": row.name, "what": row.text} for row in rows]
        if not self.on_plane:
            for line, figures in zip(found, self.on_stairs(rows, changes), strict=True):
                line["stairs"] = figures
        for line, figures in zip(found, self.on_flat(rows, changes), strict=True):
            line["flat"] = figures
        return found

    def on_stairs(self, rows: Sequence[Disturbance], changes: Sequence[tuple[str, Any]] = ()) -> list[dict[str, Any]]:
        """Return the success of each line; half of its robots go up, the others down."""
        half = max(1, self.robots // 2)
        per_robot = [row for _ in STAIRS for row in rows for _ in range(half)]
        cell = ("terrain.horizontal_scale", dividing_cell(self.tread, self.cfg.terrain.horizontal_scale))
        specs = [TileSpec(name, self.riser, self.tread) for name in STAIRS]
        outcomes, times = self._run_out(per_robot, specs, [cell, *changes])
        # From the order (up or down, line, robot) to rows of lines.
        outcomes, times = (values.view(2, len(rows), half).transpose(0, 1).flatten(1) for values in (outcomes, times))
        return [point(self.riser, *of_row) for of_row in zip(outcomes, times, strict=True)]

    def on_new_ground(self) -> dict[str, Any]:
        """Return type -> the success of undisturbed robots on new ground."""
        specs = [TileSpec(name, round(size * self.scale, 6)) for name, size in GROUND.items()]
        found = self._run_out([NOMINAL] * (len(specs) * self.robots), specs)
        outcomes, times = (values.view(len(specs), self.robots) for values in found)
        return {
            spec.type: {
                "unit": TERRAIN_TYPES[spec.type].unit,
                "what": TERRAIN_TYPES[spec.type].what,
                **point(spec.size, *of_type),
            }
            for spec, *of_type in zip(specs, outcomes, times, strict=True)
        }

    def on_flat(self, rows: Sequence[Disturbance], changes: Sequence[tuple[str, Any]] = ()) -> list[dict[str, Any]]:
        """Return the figures of each line's robots that follow commands on a plane."""
        per_robot = [row for row in rows for _ in range(self.robots)]
        axes = axes_of(self.cfg)
        ends = torch.tensor([[abs(axis[end]) for axis in axes.values()] for end in (0, -1)])
        parts = torch.tensor(COMMANDS)
        commands = torch.where(parts < 0.0, parts * ends[0], parts * ends[1])
        turns = torch.arange(self.robots) % len(COMMANDS)
        own = [
            *undisturbed(len(per_robot), HOLD_S),
            ("observations.add_noise", self.cfg.observations.add_noise),
            ("terrain.mesh_type", "plane"),
        ]
        task, act = self._build(per_robot, own, changes, None)
        error, fell = self._follow(task, act, commands[turns].repeat(len(rows), 1))
        return [
            followed(*of_row, self.limit) for of_row in zip(error.view(len(rows), -1), fell.view(len(rows), -1), strict=True)
        ]

    def _build(
        self,
        rows: Sequence[Disturbance],
        own: Sequence[tuple[str, Any]],
        last: Sequence[tuple[str, Any]],
        terrain: Terrain | None,
    ) -> tuple[StressedTask, Callable[[TensorDict], Tensor]]:
        """Build a task and its policy. Overrides apply in the order `own`, the user's, `last`: another solver replaces the
        user's.
        """
        gc.collect()  # the task before this one is in a reference cycle, and a GPU may not hold two
        make = partial(_make, rows)
        changes = [*own, *declared(rows), *self._asked, *last]
        return restore(self._policy, changes, self._device, self._graph, terrain, make)

    def _run_out(
        self,
        rows: Sequence[Disturbance],
        specs: Sequence[TileSpec],
        last: Sequence[tuple[str, Any]] = (),
    ) -> tuple[Tensor, Tensor]:
        """Return the outcomes (N,) of robots that are distributed over tiles, and their times [s]; `last` as for `_build`."""
        own = to_run_out(self.cfg, len(rows))
        cfg: Any = override(self.cfg, [*own, *self._asked, *last])
        task, act = self._build(rows, own, last, tiles_apart(specs, cfg.terrain, cfg.env.seed))
        scores, lost = run_out(task, act, len(rows) // len(specs))
        self.lost += lost
        return scores.outcome.cpu(), scores.time_s.cpu()

    @torch.inference_mode()
    def _follow(self, task: StressedTask, act: Callable[[TensorDict], Tensor], commands: Tensor) -> tuple[Tensor, Tensor]:
        """Return the mean square error of each robot's velocity in its first episode (N,) [m^2/s^2], NaN for robots that fell
        before the measurement began, and flags of those that fell (N,).
        """
        task.reset()
        observations = task.hold_commands(commands.to(task.device))
        alive = torch.ones(task.num_envs, dtype=torch.bool, device=task.device)
        fell = torch.zeros_like(alive)
        total, steps = (torch.zeros(task.num_envs, device=task.device) for _ in range(2))
        overflows = Overflows()
        for step in range(round(HOLD_S / task.dt)):
            observations, _, _, extras = task.step(act(observations))
            overflows.add(extras)
            fell |= alive & task.terminated_buf
            alive &= ~task.reset_buf
            if step >= round(SETTLE_S / task.dt):
                total += torch.where(alive, velocity_error(task.commands, task.base_lin_vel), 0.0)
                steps += alive
        self.lost += overflows.total(task)
        return (total / steps).cpu(), fell.cpu()


def _make(
    rows: Sequence[Disturbance], cfg: LeggedConfig, device: torch.device, graph: bool, terrain: Terrain | None
) -> StressedTask:
    task: Any = make_stressed(cfg, rows, device, graph, terrain)
    return task


def followed(error: Tensor, fell: Tensor, limit: float) -> dict[str, Any]:
    """Return the figures of robots (n,) on the flat, from the mean square errors of their velocities [m^2/s^2] and the flags
    of those that fell. A robot follows its command if it stands and its error is at most `limit` [m/s].
    """
    good = ~fell & (error.sqrt() <= limit)
    trials, successes = len(fell), int(good.sum())
    low, high = wilson(successes, trials)
    known = error[~error.isnan()]
    return {
        "robots": trials,
        "successes": successes,
        "share": successes / trials,
        "low": low,
        "high": high,
        "fell": int(fell.sum()),
        "rmse_lin": number_or_null(float(known.double().mean().sqrt())) if len(known) else None,
    }


def score(lines: Sequence[dict[str, Any]], ground: dict[str, Any]) -> dict[str, Any]:
    """Return the score: the mean of the shares of successful robots, over all lines of the table but the nominal one, on
    stairs and on the flat, and over new ground; with its interval of 95 % and the means of the three parts.
    """
    disturbed = [line for line in lines if line["name"] != NOMINAL.name]
    parts = {
        "stairs": [line["stairs"] for line in disturbed if "stairs" in line],
        "flat": [line["flat"] for line in disturbed],
        "ground": list(ground.values()),
    }
    counts = {name: [(one["successes"], one["robots"]) for one in found] for name, found in parts.items()}
    value, (low, high) = mean_of_shares([one for found in counts.values() for one in found])
    means = {name: mean_of_shares(found)[0] for name, found in counts.items() if found}
    return {"value": value, "low": low, "high": high, **means}
