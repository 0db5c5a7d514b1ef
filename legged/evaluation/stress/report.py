"""The stress test as a table, a picture and a file."""

import time
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from legged.config import LeggedConfig, override
from legged.evaluation.episodes import header
from legged.evaluation.overflows import warn_of_overflows
from legged.evaluation.result_file import device_name, stress_name, write_result
from legged.evaluation.stress.measuring import (
    HALF_STEP,
    HOLD_S,
    SETTLE_S,
    Bench,
    Wish,
    can_halve_step,
    score,
    settings,
)
from legged.evaluation.stress.table import NOMINAL
from legged.evaluation.success import FORWARD, TIME_S
from legged.evaluation.tables import screen_table
from legged.figures import figure
from legged.physics import engine_name
from legged.policies.restore import TrainedPolicy
from legged.process.paths import relative

COLORS = {"table": "#0072B2", "combined": "#D55E00", "settings": "#009E73", "ground": "#E69F00"}
"""Colours of bars, by their kind; those of Okabe and Ito."""
LABELS = {"table": "one disturbance", "combined": "several", "settings": "another solver", "ground": "new ground"}
COMBINED = ("together", "everything")
SETTING_LINES = ("nominal", "together")
"""Lines of the table that are measured with each setting of the solver without `full`."""


def evaluate_stress(
    policy: TrainedPolicy,
    robots: int,
    full: bool,
    wish: Wish,
    asked: list[tuple[str, Any]],
    device: torch.device,
    graph: bool,
    folder: Path,
    where: str = "sim.physics",
) -> int:
    """Run the stress test with `robots` for each line of its table; with `full`, all lines with every setting of the solver.
    A wish for some lines leaves out new ground and the score, and other solvers unless `full`. Print the result, then write
    stress_<physics>.json and .png into `folder`. Return the exit code. `where` names the setting of the engine in errors.

    Raises:
        RunError: a file can't be written.
    """
    start = time.perf_counter()
    assert isinstance(policy.cfg, LeggedConfig), "the task follows no commands"
    cfg: Any = override(policy.cfg, asked)
    engine = engine_name(cfg.sim, device, where)
    bench = Bench(policy, robots, wish, asked, device, graph)
    print(f"{len(bench.rows)} lines x {robots} robots, in {engine}", flush=True)
    lines = bench.measure(bench.rows)
    ground = {} if bench.on_plane or wish.lines else bench.on_new_ground()
    few = [row for row in bench.rows if full or row.name in SETTING_LINES]
    others = {}
    tried = settings(cfg, engine) if full or not wish.lines else []
    if tried and not can_halve_step(cfg):
        print(f"{HALF_STEP}: left out, because the motors' LSTM (control.actuator.network) knows its own alone", flush=True)
    for setting in tried:
        print(f"{setting.name}: {len(few)} lines", flush=True)
        others[setting.name] = bench.measure(few, setting.changes)
    result = {
        **header(policy, engine, device_name(device), ()),
        "wall_s": time.perf_counter() - start,
        "changes": {key: value for key, value in asked if key != "sim.physics"},
        "definition": {
            "riser_m": bench.riser,
            "tread_m": bench.tread,
            "robots_per_line": robots,
            "time_s": TIME_S,
            "vx": FORWARD * bench.scale**0.5,
            "hold_s": HOLD_S,
            "measured_s": HOLD_S - SETTLE_S,
            "limit": bench.limit,
            "interval": "Wilson 95 %; of the score: mean of such shares (Zou and Donner)",
        },
        "score": None if wish.lines else score(lines, ground),
        "lines": lines,
        "ground": ground,
        "settings": others,
        "contact_overflows": bench.lost,
    }
    print_stress(result)
    warn_of_overflows("stress", bench.lost)
    path = folder / stress_name(engine)
    write_result(path, result)
    draw_stress(result, path.with_suffix(".png"))
    print(f"written: {relative(path)}, {relative(path.with_suffix('.png'))}")
    return 0


def rows_of(result: dict[str, Any]) -> list[tuple[str, str, str, dict[str, Any] | None, dict[str, Any] | None]]:
    """Return the rows of the table: kind (of COLORS), name, description, and figures of success and of the flat."""
    rows = [
        ("combined" if line["name"] in COMBINED else "table", line["name"], line["what"], line.get("stairs"), line["flat"])
        for line in result["lines"]
    ]
    for name, lines in result["settings"].items():
        for line in lines:
            rows.append(("settings", f"{name}: {line['name']}", line["what"], line.get("stairs"), line["flat"]))
    for name, entry in result["ground"].items():
        what = f"{entry['what']} {entry['size']:.3g} {entry['unit']}"
        rows.append(("ground", f"{name.replace('_', ' ')}, {entry['size']:.3g} {entry['unit']}", what, entry, None))
    return rows


def score_text(result: dict[str, Any]) -> str:
    """Return the score as text."""
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
    """Draw a bar for each line, with its interval: success, commands followed on the flat, and the velocity error there."""
    rows = rows_of(result)
    names = [name for _, name, *_ in rows]
    colors = [COLORS[kind] for kind, *_ in rows]
    limit = result["definition"]["limit"]
    with figure(path, (12.5, 1.7 + 0.3 * len(rows)), columns=3, share_y=True) as (drawn, axes):
        from matplotlib.patches import Patch

        places = list(range(len(rows)))
        for axis, column, label in ((axes[0, 0], 3, "success"), (axes[0, 1], 4, f"flat: stood, error below {limit:.3g} m/s")):
            there = [
                (place, row[column], color) for place, row, color in zip(places, rows, colors, strict=True) if row[column]
            ]
            at, entries, shades = (list(part) for part in zip(*there, strict=True)) if there else ([], [], [])
            shares = [100 * one["share"] for one in entries]
            ends = [
                [100 * (one["share"] - one["low"]) for one in entries],
                [100 * (one["high"] - one["share"]) for one in entries],
            ]
            axis.barh(at, shares, color=shades, xerr=ends, error_kw={"elinewidth": 1.0, "ecolor": "0.25", "capsize": 2})
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
