"""Run the stress test: measure a policy under disturbances, on new ground and with other solvers, and show the results."""

import gc
import time
from collections.abc import Sequence
from functools import partial
from math import sqrt
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from tensordict import TensorDict
from torch import Tensor

from legged.config import LeggedConfig, override
from legged.errors import ConfigError
from legged.evaluation.intervals import mean_of_shares
from legged.evaluation.measurement import Setting, warn_of_overflows
from legged.evaluation.result_file import stress_name, write_result
from legged.evaluation.stress.disturbances import (
    GIVEN,
    NOMINAL,
    WRITTEN_FOR,
    Disturbance,
    StressedTask,
    declared,
    make_stressed,
    table,
)
from legged.evaluation.success import FORWARD, TIME_S, point, run_out, share_of, to_run_out
from legged.evaluation.tiles import dividing_cell, tiles_apart
from legged.evaluation.velocity_grid import axes_of, number_or_null
from legged.evaluation.velocity_tracking import hold
from legged.figures import figure
from legged.mdp.actuators.network import NetworkWeights
from legged.mdp.tracking_error import velocity_error
from legged.policies.episodes import Policy
from legged.policies.restore import restore, undisturbed
from legged.process.paths import relative
from legged.robots.similarity import size_of
from legged.tables import screen_table
from legged.terrain import TERRAIN_TYPES, Terrain, TileSpec

RISER = 0.17
"""Height of the stairs' steps at terrain.scale 1 [m]."""
TREAD = 0.28
"""Width of the stairs' steps [m], as on stairs in houses. This width is not scaled to the robot's size."""
STAIRS = ("stairs_up", "stairs_down")
"""Terrain types of the stairs: half of the robots go up, half go down."""
GROUND = {"dense_blocks": 0.25, "kerbs": 0.17, "rubble": 0.2}
"""Terrain type that no task is trained on -> its size at terrain.scale 1 [m]."""
HOLD_S, SETTLE_S = 6.0, 1.0
"""Duration of a command on the flat, and duration of its first part, in which errors are not measured [s]."""
LIMIT = 0.25
"""Largest RMS velocity error with which a robot counts as following its command, at terrain.scale 1 [m/s]."""
COMMANDS = (
    *((1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)),
    *((0.5, 0.0, 0.5), (0.5, 0.0, -0.5)),
)
"""Commands on the flat (vx, vy, yaw rate), as shares of the limits in the section `evaluation`. A positive number is a share
of the highest value, a negative number is a share of the lowest. The robots of a line get the commands in turn."""
Changes = Sequence[tuple[str, Any]]
"""Overrides of a configuration."""
HALF_STEP = "half the time step"
"""Name of the solver setting that is not possible with LSTM actuators."""
COLORS = {"table": "#0072B2", "combined": "#D55E00", "settings": "#009E73", "ground": "#E69F00"}
"""Kind of a bar -> its colour, from the palette of Okabe and Ito."""
LABELS = {"table": "one disturbance", "combined": "several", "settings": "another solver", "ground": "new ground"}
COMBINED = ("together", "everything")
SETTING_LINES = ("nominal", "together")
"""Lines of the table that are measured with each solver setting. With `--full` all lines are measured."""


def settings(cfg: LeggedConfig, engine: str) -> dict[str, list[tuple[str, Any]]]:
    """Return name of a solver setting -> overrides, for the settings that the engine and the actuator network support."""
    found: dict[str, list[tuple[str, Any]]] = {}
    network = cfg.control.actuator.network
    # An LSTM that models motors has learned one length of the physics step, so the step cannot be halved.
    if not network or NetworkWeights.load(network).kind != "lstm":
        found[HALF_STEP] = [("sim.dt", 0.5 * cfg.sim.dt), ("control.decimation", 2 * cfg.control.decimation)]
        if cfg.control.actuator.delay[1]:  # the delay is given in physics steps
            found[HALF_STEP] += [("control.actuator.delay", [2 * steps for steps in cfg.control.actuator.delay])]
    if engine in ("mujoco", "mujoco_warp", "newton_mujoco"):
        found["elliptic cones"] = [("sim.cone", "elliptic")]
        found["impratio 100"] = [("sim.impratio", 100.0), ("sim.iterations", max(50, cfg.sim.iterations))]
    return found


def check_asked(changes: Changes) -> None:
    """Check that the overrides `changes` randomise none of the properties that the disturbances set."""
    ranges = "domain_rand.ranges"
    for key, value in changes:
        names = value if key == ranges and isinstance(value, dict) else [key.removeprefix(f"{ranges}.").split(".")[0]]
        for name in names if key.startswith(ranges) else ():
            if name in GIVEN:
                where = f"command line: {ranges}.{name}"
                raise ConfigError(f"{where}: leave it out, because `legged evaluate stress` sets this property")


class Bench:
    """Test bench for a policy: it builds tasks with disturbed robots and measures them one after another."""

    def __init__(
        self,
        setting: Setting,
        robots: int,
        riser: float | None = None,
        tread: float = TREAD,
        payload: float | None = None,
        lines: Sequence[str] = (),
    ) -> None:
        """Prepare a test with `robots` robots for each line of the table. The steps of the stairs have the height `riser` [m]
        and the width `tread` [m], and `payload` is the mass on the base [kg]. `lines` are the names of the lines to measure.
        By default the height is RISER times `terrain.scale`, the payload is that of the table, and all lines are measured.

        Raises:
            ConfigError: the robot cannot be loaded, or an override randomises a property that the disturbances set.
        """
        check_asked(setting.overrides)
        self.setting, self.robots, self.tread = setting, robots, tread
        self.cfg: LeggedConfig = setting.cfg
        rows = table(size_of(self.setting.policy.cfg.robot), size_of(WRITTEN_FOR), payload)  # type: ignore[attr-defined]
        self.whole = not lines
        self.rows = tuple(row for row in rows if self.whole or row.name in lines)
        """The lines of the table that are measured."""
        self.scale = self.cfg.terrain.scale
        self.on_plane = self.cfg.terrain.mesh_type == "plane"
        """True if the policy was trained on a plane. Then it is measured on the flat only."""
        self.riser = round(RISER * self.scale, 3) if riser is None else riser
        self.limit = LIMIT * sqrt(self.scale)
        """Largest RMS velocity error with which a robot counts as following its command [m/s]."""
        self.lost = 0
        """Number of times that a robot lost contacts in a control step, because memory was full."""

    def measure(self, rows: Sequence[Disturbance], changes: Changes = ()) -> list[dict[str, Any]]:
        """Measure the lines `rows` of the table and return their figures. `changes` are the overrides of a solver setting."""
        found: list[dict[str, Any]] = [{"name": row.name, "what": row.text} for row in rows]
        if not self.on_plane:
            for line, figures in zip(found, self.on_stairs(rows, changes), strict=True):
                line["stairs"] = figures
        for line, figures in zip(found, self.on_flat(rows, changes), strict=True):
            line["flat"] = figures
        return found

    def on_stairs(self, rows: Sequence[Disturbance], changes: Changes = ()) -> list[dict[str, Any]]:
        """Return the success on stairs for each line. Half of a line's robots go up, half go down."""
        half = max(1, self.robots // 2)
        per_robot = [row for _ in STAIRS for row in rows for _ in range(half)]
        cell = ("terrain.horizontal_scale", dividing_cell(self.tread, self.cfg.terrain.horizontal_scale))
        specs = [TileSpec(name, self.riser, self.tread) for name in STAIRS]
        outcomes, times = self._run_out(per_robot, specs, [cell, *changes])
        # Robots are ordered by (up or down, line, robot). Reorder them to one row for each line.
        outcomes, times = (values.view(2, len(rows), half).transpose(0, 1).flatten(1) for values in (outcomes, times))
        return [point(self.riser, *of_row) for of_row in zip(outcomes, times, strict=True)]

    def on_new_ground(self) -> dict[str, Any]:
        """Return terrain type -> success of undisturbed robots, for the types in GROUND."""
        specs = [TileSpec(name, round(size * self.scale, 6)) for name, size in GROUND.items()]
        found = self._run_out([NOMINAL] * (len(specs) * self.robots), specs)
        outcomes, times = (values.view(len(specs), self.robots) for values in found)
        ground = {}
        for spec, *of_type in zip(specs, outcomes, times, strict=True):
            kind = TERRAIN_TYPES[spec.type]
            ground[spec.type] = {"unit": kind.unit, "what": kind.what, **point(spec.size, *of_type)}
        return ground

    def on_flat(self, rows: Sequence[Disturbance], changes: Changes = ()) -> list[dict[str, Any]]:
        """Let the robots of each line follow commands on a plane, and return the figures of each line."""
        per_robot = [row for row in rows for _ in range(self.robots)]
        ends = torch.tensor([[abs(axis[end]) for axis in axes_of(self.cfg).values()] for end in (0, -1)])
        parts = torch.tensor(COMMANDS)
        commands = torch.where(parts < 0.0, parts * ends[0], parts * ends[1])
        turns = torch.arange(self.robots) % len(COMMANDS)
        own = [
            *undisturbed(self.cfg, len(per_robot), HOLD_S),
            ("observations.add_noise", self.cfg.observations.add_noise),
            ("terrain.mesh_type", "plane"),
        ]
        task, act = self._build(per_robot, own, changes, None)
        error, fell = self._follow(task, act, commands[turns].repeat(len(rows), 1))
        by_row = zip(error.view(len(rows), -1), fell.view(len(rows), -1), strict=True)
        return [followed(*of_row, self.limit) for of_row in by_row]

    def _build(
        self, rows: Sequence[Disturbance], own: Changes, last: Changes, terrain: Terrain | None
    ) -> tuple[StressedTask, Policy]:
        """Build a task with one robot for each of `rows`, and its policy. The overrides `own` apply first, then the user's,
        then `last`, so that a solver setting in `last` replaces the user's.
        """
        gc.collect()  # the previous task is in a reference cycle, and a GPU may not have the memory for two tasks
        changes = [*own, *declared(rows), *self.setting.asked, *last]
        make = partial(make_stressed, rows)
        return restore(self.setting.policy, changes, self.setting.device, self.setting.graph, terrain, make)

    def _run_out(self, rows: Sequence[Disturbance], specs: Sequence[TileSpec], last: Changes = ()) -> tuple[Tensor, Tensor]:
        """Let robots walk out of tiles of all `specs`; return outcomes (N,) and times (N,) [s]. For `last` see `_build`."""
        own = to_run_out(self.cfg, len(rows))
        cfg = override(self.cfg, [*own, *self.setting.asked, *last])
        task, act = self._build(rows, own, last, tiles_apart(specs, cfg.terrain, cfg.env.seed))
        scores, lost = run_out(task, act, len(rows) // len(specs))
        self.lost += lost
        return scores.outcome.cpu(), scores.time_s.cpu()

    def _follow(self, task: StressedTask, act: Policy, commands: Tensor) -> tuple[Tensor, Tensor]:
        """Return the mean square error (N,) of each robot's velocity in its first episode [m^2/s^2], and flags (N,) of robots
        that fell. The error is NaN for robots that fell before the measurement began.
        """

        def read(_: TensorDict) -> dict[str, Tensor]:
            return {"error": velocity_error(task.commands, task.base_lin_vel)}

        sums, fell, lost = hold(task, act, commands.to(task.device), SETTLE_S, HOLD_S, read)
        self.lost += lost
        return (sums["error"] / sums["steps"]).cpu(), fell.cpu()


def followed(error: Tensor, fell: Tensor, limit: float) -> dict[str, Any]:
    """Return the figures of robots on the flat, from the mean square errors (n,) of their velocities [m^2/s^2] and the flags
    (n,) of robots that fell. A robot succeeds if it did not fall and its RMS error is at most `limit` [m/s].
    """
    known = error[~error.isnan()]
    rmse = number_or_null(float(known.double().mean().sqrt())) if len(known) else None
    return {**share_of(~fell & (error.sqrt() <= limit), int(fell.sum())), "rmse_lin": rmse}


def score(lines: Sequence[dict[str, Any]], ground: dict[str, Any]) -> dict[str, Any]:
    """Return the score with its 95 % confidence interval, and the means of its three parts: stairs, flat and new ground. The
    score is the mean of all shares of successful robots. The nominal line does not count.
    """
    disturbed = [line for line in lines if line["name"] != NOMINAL.name]
    parts = {name: [line[name] for line in disturbed if name in line] for name in ("stairs", "flat")}
    parts["ground"] = list(ground.values())
    counts = {name: [(one["successes"], one["robots"]) for one in found] for name, found in parts.items()}
    value, (low, high) = mean_of_shares([one for found in counts.values() for one in found])
    means = {name: mean_of_shares(found)[0] for name, found in counts.items() if found}
    return {"value": value, "low": low, "high": high, **means}


# ---- the whole test --------------------------------------------------------------------------------------------------


def evaluate_stress(bench: Bench, full: bool) -> int:
    """Run the stress test, print the result, write stress_<physics>.json and .png, and return the exit code. With `full` all
    lines are measured with every solver setting. If the bench has only some of the lines, new ground is not tested, the score
    is None, and solver settings are tried only with `full`.

    Raises:
        RunError: a file can't be written.
    """
    start = time.perf_counter()
    setting = bench.setting
    engine = setting.engine
    print(f"{len(bench.rows)} lines x {bench.robots} robots, in {engine}", flush=True)
    lines = bench.measure(bench.rows)
    ground = bench.on_new_ground() if bench.whole and not bench.on_plane else {}
    few = [row for row in bench.rows if full or row.name in SETTING_LINES]
    others = {}
    tried = settings(bench.cfg, engine) if full or bench.whole else {}
    if tried and HALF_STEP not in tried:
        print(f"{HALF_STEP}: left out, because the LSTM in control.actuator.network fits one time step only", flush=True)
    for name, changes in tried.items():
        print(f"{name}: {len(few)} lines", flush=True)
        others[name] = bench.measure(few, changes)
    result = {
        **setting.head,
        "wall_s": time.perf_counter() - start,
        "changes": {key: value for key, value in setting.overrides if key != "sim.physics"},
        "definition": {
            "riser_m": bench.riser,
            "tread_m": bench.tread,
            "robots_per_line": bench.robots,
            "time_s": TIME_S,
            "vx": FORWARD * bench.scale**0.5,
            "hold_s": HOLD_S,
            "measured_s": HOLD_S - SETTLE_S,
            "limit": bench.limit,
            "interval": "Wilson 95 %; of the score: mean of such shares (Zou and Donner)",
        },
        "score": score(lines, ground) if bench.whole else None,
        "lines": lines,
        "ground": ground,
        "settings": others,
        "contact_overflows": bench.lost,
    }
    print_stress(result)
    warn_of_overflows("stress", bench.lost)
    path = setting.folder / stress_name(engine)
    write_result(path, result)
    draw_stress(result, path.with_suffix(".png"))
    print(f"written: {relative(path)}, {relative(path.with_suffix('.png'))}")
    return 0


def rows_of(result: dict[str, Any]) -> list[tuple[str, str, str, dict[str, Any] | None, dict[str, Any] | None]]:
    """Return rows: kind (key of COLORS), name, description, figures on stairs or new ground, and figures on the flat."""
    named = [("combined" if line["name"] in COMBINED else "table", line["name"], line) for line in result["lines"]]
    for name, lines in result["settings"].items():
        named += [("settings", f"{name}: {line['name']}", line) for line in lines]
    rows = [(kind, name, line["what"], line.get("stairs"), line["flat"]) for kind, name, line in named]
    for name, entry in result["ground"].items():
        what = f"{entry['what']} {entry['size']:.3g} {entry['unit']}"
        rows.append(("ground", f"{name.replace('_', ' ')}, {entry['size']:.3g} {entry['unit']}", what, entry, None))
    return rows


def score_text(result: dict[str, Any]) -> str:
    """Return the score as text. Without a score, return the ground on which the lines were measured."""
    found, rule = result["score"], result["definition"]
    if found is None:
        return f"stairs of {rule['riser_m']:g} x {rule['tread_m']:g} m" if "stairs" in result["lines"][0] else "on the flat"
    parts = ", ".join(f"{name} {100 * found[name]:.0f} %" for name in ("stairs", "flat", "ground") if name in found)
    stairs = f"; stairs of {rule['riser_m']:g} x {rule['tread_m']:g} m" if "stairs" in found else ""
    low, high = (100 * found[end] for end in ("low", "high"))
    return f"stress score {100 * found['value']:.1f} % ({low:.1f} to {high:.1f} %): {parts}{stairs}"


def print_stress(result: dict[str, Any]) -> None:
    """Print a table with a line for each disturbance, setting and ground, then the score."""
    limit, last = result["definition"]["limit"], "table"
    rows: list[list[str] | None] = []
    for kind, name, what, stairs, flat in rows_of(result):
        rows += [None] if kind != last else []
        last = kind
        error = "none" if flat and flat["rmse_lin"] is None else f"{flat['rmse_lin']:.3f} m/s" if flat else ""
        up = [share_text(stairs), str(stairs["fell"]), str(stairs["stuck"])] if stairs else ["", "", ""]
        level = [share_text(flat), str(flat["fell"]), error] if flat else ["", "", ""]
        rows.append([f"{name}: {what}" if kind == "table" and name != NOMINAL.name else name, *up, *level])
    heads = ["success on stairs\nor new ground", "fell", "stuck"]
    heads += [f"on the flat, error\nbelow {limit:.3g} m/s", "fell", "RMSE"]
    table = screen_table(f"{result['task']} ({result['checkpoint']}) in {result['physics']}", ["disturbance", *heads], rows)
    table.columns[0].max_width = 48
    Console(width=130).print(table)
    print(score_text(result))


def share_text(entry: dict[str, Any]) -> str:
    """Return a share with its interval as text: '97 % (84 to 99)'."""
    return f"{100 * entry['share']:.0f} % ({100 * entry['low']:.0f} to {100 * entry['high']:.0f})"


def draw_stress(result: dict[str, Any], path: Path) -> None:
    """Draw three bars for each row of `rows_of`: success on stairs or new ground, success on the flat, and velocity error."""
    rows = rows_of(result)
    names = [name for _, name, *_ in rows]
    colors = [COLORS[kind] for kind, *_ in rows]
    limit = result["definition"]["limit"]
    with figure(path, (12.5, 1.7 + 0.3 * len(rows)), columns=3, share_y=True) as (drawn, axes):
        from matplotlib.patches import Patch

        places = list(range(len(rows)))
        for axis, column, label in ((axes[0, 0], 3, "success"), (axes[0, 1], 4, f"flat: stood, error below {limit:.3g} m/s")):
            there = [place for place in places if rows[place][column]]
            entries: list[Any] = [rows[place][column] for place in there]
            ends = [[100 * abs(one[end] - one["share"]) for one in entries] for end in ("low", "high")]
            look = {"xerr": ends, "error_kw": {"elinewidth": 1.0, "ecolor": "0.25", "capsize": 2}}
            axis.barh(there, [100 * one["share"] for one in entries], color=[colors[place] for place in there], **look)
            axis.set_xlim(0.0, 102.0)
            axis.set_xlabel(f"{label} [% of robots]")
        flat = [(place, row[4]["rmse_lin"], color) for place, row, color in zip(places, rows, colors, strict=True) if row[4]]
        axes[0, 2].barh([one[0] for one in flat], [one[1] or 0.0 for one in flat], color=[one[2] for one in flat])
        axes[0, 2].axvline(limit, color="0.25", ls=":", lw=1.4)
        axes[0, 2].set_xlabel("flat: RMSE of the velocity [m/s]")
        for axis in axes[0]:
            axis.spines[["top", "right"]].set_visible(False)
            axis.grid(axis="x", alpha=0.3)
            axis.set_axisbelow(True)
        axes[0, 0].set_yticks(places, names)
        axes[0, 0].set_ylim(len(rows) - 0.4, -0.6)
        kinds = dict.fromkeys(kind for kind, *_ in rows)
        keys = [Patch(color=COLORS[kind], label=LABELS[kind]) for kind in kinds]
        drawn.legend(handles=keys, loc="outside lower center", ncols=len(keys), frameon=False)
        drawn.suptitle(f"{result['task']} in {result['physics']}: {score_text(result)}", fontsize="medium")
