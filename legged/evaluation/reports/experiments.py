"""The page of experiments: all runs in one table, newest first. Runs that differ only in their seed may share a row."""

import itertools
from collections.abc import Sequence
from pathlib import Path
from statistics import mean
from typing import Any

from legged.config.dotted import value_at
from legged.evaluation.learning_curves import smooth
from legged.evaluation.reports.document import Cell, Link, Mono, Number, Paragraph, Part, Table, number, text_of
from legged.evaluation.reports.record import Record, but_for_seeds, what_changed
from legged.evaluation.result_file import tracking_of
from legged.evaluation.success import types_in
from legged.learning.run_folder import REPORT

TITLE = "Experiments"
EMPTY = ("", "-")
"""Texts of empty cells. A column with only empty cells is left out."""
STAIRS = ("stairs_up", "stairs_down")
PASSED = 0.9
"""Stairs count as crossed if at least this share of the robots crosses them."""


def experiments_parts(records: Sequence[Record], beside: Path, ending: str, seeds_share: bool = False) -> list[Part]:
    """Return the parts of a page that lists runs. The page will be written to the folder `beside`; runs in this folder get
    links to their reports, report.<ending>. With `seeds_share`, runs that differ only in their seeds share a row of means.
    """
    newest = sorted(records, key=lambda record: (record.began, record.name), reverse=True)
    groups: dict[str, list[Record]] = {}
    for record in newest:
        groups.setdefault(but_for_seeds(record) if seeds_share else str(record.folder), []).append(record)
    rows = [_shared_row(group, beside, ending) for group in groups.values()]
    head = list(rows[0]) if rows else []
    shown = [name for name in head if any(text_of(row[name]) not in EMPTY for row in rows)]
    text = (
        f"{len(newest)} runs, newest first, made by `legged runs`. The column `what changed` shows the"
        " note of a run (`--note`), else its name and the settings that differ from its task's files. RMSE, falls and stairs"
        " come from `legged evaluate`, without noise and pushes; stairs are the highest steps that nine of"
        " ten robots climb, and nine of ten descend. Terrain level, return and velocity error are those at the end of"
        " training, with noise and pushes. A + marks a commit with uncommitted changes."
    )
    if "evaluated" in shown:
        text += " The column `evaluated` names the checkpoint that was evaluated if it is not the last one."
    if len(rows) < len(newest):
        text += " Runs that differ only in their seed share a row, with their means."
    return [Paragraph(text), Table(shown, [[row[name] for name in shown] for row in rows], wide=True)]


def _shared_row(group: Sequence[Record], beside: Path, ending: str) -> dict[str, Cell]:
    """Return column -> cell, for a single run or for runs that differ only in their seeds."""
    rows = [_row(record, beside, ending) for record in group]
    if len(rows) == 1:
        return rows[0]
    shared: dict[str, Cell] = dict(rows[0])
    for name, (_, form) in _figures(group[0], {}).items():
        known = [cell.value for row in rows if isinstance(cell := row[name], Number) and cell.value is not None]
        shared[name] = number(mean(known) if known else None, form)
    seeds = [seed for record in group if isinstance(seed := record.at("env.seed"), int)]
    shared["seed"] = Number(", ".join(f"{seed:,d}" for seed in sorted(seeds)), min(seeds, default=None))
    shared["evaluated"] = ", ".join(dict.fromkeys(text for row in rows if (text := text_of(row["evaluated"]))))
    shared["what changed"] = what_changed(group[0], named=False)
    return shared


def _row(record: Record, beside: Path, ending: str) -> dict[str, Cell]:
    """Return column -> cell for a run. Evaluated figures are from the run's first evaluation in the order of ENGINES."""
    timing = record.timing
    judged = next(iter(record.results.values()), {})
    return {
        "began": _began(record, beside, ending),
        "task": record.task,
        "what changed": what_changed(record),
        "status": record.status,
        "iterations": number(record.done, ",.0f"),
        "seed": number(seed if isinstance(seed := record.at("env.seed"), int) else None, ",.0f"),
        "evaluated": record.another_policy(judged),
        **{name: number(value, form) for name, (value, form) in _figures(record, judged).items()},
        "robots": number(record.robots, ",.0f"),
        "device": "" if timing is None else "CPU" if timing.device == "cpu" else timing.device,
        "commit": Mono(record.code.commit[:10] + ("+" if record.code.files else "")),
    }


def _figures(record: Record, judged: dict[str, Any]) -> dict[str, tuple[float | None, str]]:
    """Return column -> (figure, number format), for the figures that are averaged over seeds: those of the evaluation
    `judged`, those at the end of the training, and the training's times.
    """
    timing, tracking = record.timing, tracking_of(judged)
    return {
        "RMSE [m/s]": (value_at(tracking, "rmse_lin.mean"), ".3f"),
        "yaw rate RMSE [rad/s]": (value_at(tracking, "rmse_ang.mean"), ".3f"),
        "falls [%]": (100.0 * tracking["falls"] if "falls" in tracking else None, ".2f"),
        "stairs [m]": (highest_stairs(judged), ".3f"),
        "return, evaluated": (value_at(judged, "episodes.return.mean"), ".1f"),
        "terrain level": (_last(record, "Terrain/level"), ".2f"),
        "return": (_last(record, "Train/mean_reward"), ".2f"),
        "velocity error [m/s]": (_last(record, "Metrics/lin_vel_rmse"), ".3f"),
        "steps [M]": (timing.steps / 1e6 if timing else None, ".1f"),
        "start-up [s]": (timing.start_up_s if timing else None, ".1f"),
        "loop [s]": (timing.loop_s if timing else None, ".1f"),
        "steps/s": (timing.steps_per_s if timing else None, ",.0f"),
    }


def highest_stairs(result: dict[str, Any]) -> float | None:
    """Return the height of the highest stair steps [m] that the robots crossed both up and down. They must have crossed all
    lower steps too. Return 0 if they did not cross the lowest steps, and None if they were not evaluated in both directions.
    """
    points = [types_in(result).get(name, {}).get("points", []) for name in STAIRS]
    ways = [{point["size"]: point["share"] for point in of_type} for of_type in points]
    sizes = sorted(ways[0].keys() & ways[1].keys())
    crossed = list(itertools.takewhile(lambda size: min(way[size] for way in ways) >= PASSED, sizes))
    return max(crossed, default=0.0) if sizes else None


def _began(record: Record, beside: Path, ending: str) -> Cell:
    """Return the time at which a run began. It is a link to the run's report if the report lies in the folder `beside`."""
    text, report = f"{record.began:%Y-%m-%d %H:%M}", (record.folder / f"{REPORT}.{ending}").resolve()
    if report.is_file() and report.is_relative_to(beside.resolve()):
        return Link(text, report.relative_to(beside.resolve()).as_posix())
    return text


def _last(record: Record, tag: str) -> float | None:
    """Return the last value of a curve's running mean; None if the curve was not logged."""
    return float(smooth(record.scalars[tag][1])[-1]) if tag in record.scalars else None
