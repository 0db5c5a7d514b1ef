"""The report on one run: report.html, which is self-contained, and report.md with its pictures."""

import shlex
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from legged.evaluation.engines import engine_of
from legged.evaluation.intervals import wilson
from legged.evaluation.learning_curves import curves_of_run, smooth, times_of
from legged.evaluation.reports.charts import curves, heat_map
from legged.evaluation.reports.document import (
    Cell,
    Figures,
    Heading,
    Listing,
    Mono,
    Number,
    Paragraph,
    Part,
    Picture,
    Table,
    between,
    number,
    write_pages,
)
from legged.evaluation.reports.record import FILMS, Record, from_task_file, read_record, words
from legged.evaluation.result_file import BROKEN, changes_text, falls_of, has_tracking, tracking_of
from legged.evaluation.success import success_charts
from legged.evaluation.velocity_grid import AXES
from legged.evaluation.velocity_tracking import PANELS, grid_means
from legged.learning.invocation import Invocation
from legged.learning.run_folder import BEST_MODEL, CODE_FILE, REPORT, checkpoints
from legged.process.paths import relative

ROWS = 10
"""Number of rows of the table that shows figures over the training."""
LARGEST_FILM = 12 * 2**20
"""Size of the largest film that the report shows [bytes]. For a larger film the report gives only the file name."""
LONGEST_DIFF = 200_000
"""Largest number of letters of a code diff in the page; CODE_FILE holds the whole diff."""
ON_GRID = (
    "Measured on a grid of commands, without noise and pushes. Errors are root mean squares over time, averaged over the"
    " commands. The interval of falls is Wilson's. The maps show means over the command that has no axis."
)
ON_TERRAIN = (
    "Share of robots that get out of tiles of each difficulty, with Wilson's 95 % interval. A dotted line marks the most"
    " difficult tiles of the training."
)
OVER_TRAINING = {
    "Train/mean_reward": ("return", 1.0, ".2f"),
    "Train/std_reward": ("standard deviation of the return", 1.0, ".2f"),
    "Metrics/lin_vel_rmse": ("velocity error [m/s]", 1.0, ".3f"),
    "Metrics/ang_vel_rmse": ("yaw rate error [rad/s]", 1.0, ".3f"),
    "Metrics/falls": ("falls [%]", 100.0, ".1f"),
    "Metrics/episode_length": ("episode [steps]", 1.0, ".0f"),
    "Terrain/level": ("terrain level", 1.0, ".2f"),
}
"""Tag -> heading, factor and number format of its column in the table that shows figures over the training."""


def write_report(folder: Path) -> Path:
    """Write report.html, report.md and its pictures into a run folder; return the path of report.html.

    Raises:
        ConfigError: the folder is not a run folder.
        RunError: a file can't be written.
    """
    record = read_record(folder)
    return write_pages(folder / REPORT, f"{record.task}: {record.folder.resolve().name}", report_parts(record))


def report_parts(record: Record) -> list[Part]:
    """Return all parts of a run's report."""
    parts: list[Part] = [Paragraph(record.why, record.status)]
    if record.note:
        parts.append(Paragraph(record.note))
    parts += _film(record)
    parts += [Heading("Run"), Table(["", ""], _facts(record))]
    parts += _differences(record)
    if record.scalars:
        parts += [Heading("Over training"), Paragraph("Running means over nine iterations."), over_training(record)]
        parts += [Heading("Curves"), Figures("curves", curves_of_run(record.log), "learning curves")]
    else:
        parts += [Heading("Curves"), Paragraph("This folder holds no TensorBoard file with values.")]
    parts += _evaluations(record)
    if record.problems:
        parts += [Heading("What could not be read"), *(Paragraph(text) for text in record.problems)]
    if record.code.text:
        shown = record.code.text[:LONGEST_DIFF]
        rest = "" if len(shown) == len(record.code.text) else f"\n... and more: see {CODE_FILE}"
        parts += [Heading("Code"), Listing(f"version {record.code.version}, {record.code.summary}", shown + rest, CODE_FILE)]
    return parts


def command_on(record: Record, command: str) -> str:
    """Return the shell command `legged COMMAND RUN`, with the option `--import` if the run's task is user-defined."""
    given = Invocation(record.task) if record.given is None else record.given
    return shlex.join(["legged", *command.split(), *given.flags, relative(record.folder)])


def _facts(record: Record) -> list[list[Cell]]:
    timing, code = record.timing, record.code
    found: dict[str, str | None] = {
        "began": f"{record.began:%Y-%m-%d %H:%M:%S}",
        "code": f"legged {code.version}, commit {code.summary}" if code.commit else code.version and f"legged {code.version}",
        "robots, seed": f"{record.robots or '-'}, {record.at('env.seed')}",
    }
    if timing is not None:
        rest_s = timing.wall_s - timing.start_up_s - timing.loop_s - timing.evaluation_s
        compiled = f", {timing.kernels_compiled} modules of kernels compiled" if timing.kernels_compiled else ""
        found |= {
            "device": ("CPU" if timing.device == "cpu" else timing.device) + timing.company,
            "iterations, steps": f"{timing.iterations:,}, {timing.steps:,}" + (" after it was resumed" * timing.resumed),
            "time to start": f"{timing.start_up_s:.1f} s (imports, task{compiled or ', no kernels compiled'})",
            "time to train": f"{timing.loop_s:.1f} s ({timing.steps_per_s:,.0f} steps/s)",
            "time to evaluate": f"{timing.evaluation_s:.1f} s" if timing.evaluation_s else None,
            "time for the rest": f"{rest_s:.1f} s (graphs captured, checkpoints); {timing.wall_s:.1f} s in all",
        }
    elif record.scalars:
        _, seconds = times_of(record.scalars)
        found["time to train"] = f"{seconds.sum():.1f} s in the log" if len(seconds) else None
    faults = [tag for tag in record.scalars if tag.startswith("Faults/")]
    lost = record.scalars.get("Metrics/contact_overflows")
    saved = checkpoints(record.folder)
    best = f"; the best by its evaluations is {BEST_MODEL}" if (record.folder / BEST_MODEL).is_file() else ""
    found |= {
        "checkpoints": f"{len(saved)}, the last is {saved[max(saved)].name}{best}" if saved else "none",
        "faults": ", ".join(tag.partition("/")[2] for tag in faults) or None,
        "contacts lost": f"in {lost[1].sum():,.0f} robot steps" if lost is not None and lost[1].sum() > 0 else None,
    }
    return [[name, text] for name, text in found.items() if text]


def _film(record: Record) -> list[Part]:
    """Return the first of FILMS in the run folder. If that film is too large to show, return a sentence with its name."""
    for film in (record.folder / name for name in FILMS):
        with suppress(OSError):
            size = film.stat().st_size
            if not 0 < size <= LARGEST_FILM:
                return [Paragraph(f"A film of the policy is in {film.name} ({size / 2**20:.0f} MiB).")]
            return [Picture(film, "the last policy")]
    return []


def _differences(record: Record) -> list[Part]:
    heading, found = Heading("Settings other than the task's"), from_task_file(record)
    if found is None:
        told = f". Where it exists, `{command_on(record, 'runs report')}` can compare" if record.given is not None else ""
        text = f"There is no task '{record.task}' here to compare with{told}. config.yaml has all settings."
        set_there: list[list[Cell]] = [[Mono(path), Mono(words(value))] for path, value in record.changes.items()]
        return [heading, Paragraph(text), *([Table(["setting", "the command line"], set_there)] if set_there else [])]
    if not found:
        return [heading, Paragraph("None: the run has the settings that its task has now.")]
    rows: list[list[Cell]] = [[Mono(path), Mono(words(own)), Mono(words(of_task))] for path, (own, of_task) in found.items()]
    return [heading, Table(["setting", "this run", "the task's files now"], rows)]


def over_training(record: Record) -> Table:
    """Return a table with about ROWS iterations of a training: steps, time, returns, errors."""
    scalars = record.scalars
    columns = {tag: column for tag, column in OVER_TRAINING.items() if tag in scalars}
    steps = np.unique(np.concatenate([scalars[tag][0] for tag in columns or [next(iter(scalars))]]))
    picked = steps[np.unique(np.linspace(0, len(steps) - 1, ROWS).round().astype(int))]
    at, seconds = times_of(scalars)
    drawn = [(at, np.cumsum(seconds), ".1f")]
    drawn += [(scalars[tag][0], smooth(factor * scalars[tag][1]), form) for tag, (_, factor, form) in columns.items()]
    per_iteration = record.steps_per_iteration
    rows: list[list[Cell]] = []
    for step in picked:
        count = None if per_iteration is None else float((step + 1) * per_iteration)
        row: list[Cell] = [Number(f"{step + 1:,d}", float(step + 1)), number(count, ",.0f")]
        for iterations, values, form in drawn:  # a row shows the last value up to its iteration
            before = values[iterations <= step]
            row.append(number(float(before[-1]) if len(before) else None, form))
        rows.append(row)
    clock = "time since it was resumed [s]" if record.timing is not None and record.timing.resumed else "time [s]"
    return Table(["iteration", "steps", clock, *(head for head, _, _ in columns.values())], rows)


# ---- evaluations -----------------------------------------------------------------------------------------------------


def _evaluations(record: Record) -> list[Part]:
    """Return the parts on evaluations in all engines: tables, heat maps over commands, success over difficulty, returns."""
    parts: list[Part] = [Heading("Evaluation")]
    if not record.results:
        return [*parts, Paragraph(f"None yet: `{command_on(record, 'evaluate')}`")]
    results = [(engine_of(name).label, result) for name, result in record.results.items()]
    for label, result in results:
        if file := record.another_policy(result):
            parts.append(Paragraph(f"In {label} the evaluation is of `{file}`, which is not the last policy."))
        if result.get("changes"):
            parts.append(Paragraph(f"In {label} the evaluation was made with {changes_text(result)}."))
    following = [(label, result) for label, result in results if "episodes" not in result]
    tracked = [(label, tracking_of(result)) for label, result in following if has_tracking(result)]
    rows: list[list[Cell]] = []
    for label, tracking in tracked:
        counted = falls_of(tracking)
        errors = [number(tracking[name][part]) for name in ("rmse_lin", "rmse_ang") for part in ("mean", "worst")]
        around = between(wilson(*counted), 100.0, ".2f") if counted else "-"
        falls, cost = number(100.0 * tracking["falls"], ".2f"), number(tracking.get("cost_of_transport"), ".2f")
        rows.append([label, *errors, falls, around, cost])
    heads = ["engine", "velocity RMSE [m/s]", "worst cell", "yaw rate RMSE [rad/s]", "worst cell", "falls [%]"]
    parts += [Paragraph(ON_GRID), Table([*heads, "95 % interval", "cost of transport"], rows)] if rows else []
    maps = [drawing for label, tracking in tracked for drawing in _heat_maps(tracking, label)]
    parts += [Figures("tracking", maps, "velocity and yaw rate errors over commands")] if maps else []
    success = [curves(chart) for chart in success_charts([result for _, result in following])]
    parts += [Paragraph(ON_TERRAIN), Figures("success", success, "success over difficulty")] if success else []
    for label, result in results:
        parts += _episodes(label, result["episodes"]) if "episodes" in result else []
    return parts


def _heat_maps(tracking: dict[str, Any], label: str) -> list[str]:
    """Return heat maps (SVG) of the errors over the commands; an empty list if `tracking` lacks its grid or its `cells`."""
    try:
        grid, found = tracking["grid"], []
        for name, over, other, title in PANELS:
            values = grid_means(tracking, name, over)
            where = (f"commanded vx [{AXES['vx']}]", f"commanded {other} [{AXES[other]}]")
            found.append(heat_map(f"{title}, {label}", *where, grid["vx"], grid[other], values))
        return found
    except BROKEN:
        return []


def _episodes(label: str, episodes: dict[str, Any]) -> list[Part]:
    rows: list[list[Cell]] = []
    for measure, key in (("return", "return"), ("length [control steps]", "length")):
        rows.append([measure, *(number(episodes[key][part], ".1f") for part in ("mean", "std", "min", "max"))])
    single = [(f"return of {name}", number(value, ".1f")) for name, value in episodes["terms"].items()]
    single.append(("ended in a failure [%]", number(100.0 * episodes["failures"], ".1f")))
    single += [(name.replace("_", " "), number(value)) for name, value in episodes["metrics"].items()]
    rows += [[name, value, *[number(None)] * 3] for name, value in single]
    return [
        Paragraph(f"{episodes['count']:.0f} full episodes without noise, in {label}."),
        Table(["measure", "mean", "standard deviation", "least", "greatest"], rows),
    ]
