"""All runs there are in one table, newest first."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from legged.evaluation.engines import ENGINES
from legged.evaluation.learning_curves import smooth
from legged.evaluation.reports.differences import what_changed
from legged.evaluation.reports.document import Cell, Link, Mono, Number, Paragraph, Part, Table
from legged.evaluation.reports.evaluation_part import number
from legged.evaluation.reports.record import Record
from legged.evaluation.reports.run_report import REPORT
from legged.evaluation.result_file import tracking_of

TITLE = "Experiments"
EMPTY = ("", "-")
"""Cells that say nothing; a column of nothing else is left out."""


def experiments_parts(records: Sequence[Record], beside: Path, ending: str) -> list[Part]:
    """Return the page on some runs. Those below the folder `beside`, where the page is written, lead to their reports of that
    `ending`.
    """
    newest = sorted(records, key=lambda record: (record.began, record.name), reverse=True)
    rows = [_row(record, beside, ending) for record in newest]
    head = list(rows[0]) if rows else []
    shown = [name for name in head if any(_text(row[name]) not in EMPTY for row in rows)]
    text = (
        f"{len(rows)} runs, newest first, made by `python -m legged.tools.experiments`. What changed is a note to the run"
        " (`--note`), else its own name and what it sets otherwise than its task as it is now. Return and velocity error are"
        " those of the end of training, with noise and pushes; RMSE and falls are those of the evaluation, without them, by"
        " `python -m legged.tools.evaluate`. A commit with a + had changes that were not committed."
    )
    return [Paragraph(text), Table(shown, [[row[name] for name in shown] for row in rows], wide=True)]


def _text(cell: Cell) -> str:
    return cell.text if isinstance(cell, Link | Number) else cell


def _row(record: Record, beside: Path, ending: str) -> dict[str, Cell]:
    """Return what the table says of a run, by column."""
    timing = record.timing
    steps = timing.steps if timing else None
    judged = _judged(record)
    tracking = {} if judged is None or "episodes" in judged else tracking_of(judged)
    episodes = judged["episodes"] if judged is not None and "episodes" in judged else None
    return {
        "began": _began(record, beside, ending),
        "task": record.task,
        "what changed": what_changed(record),
        "status": record.status,
        "seed": number(_whole(record.at("env.seed")), ",.0f"),
        "robots": number(record.robots, ",.0f"),
        "iterations": number(record.done, ",.0f"),
        "steps [M]": number(None if steps is None else steps / 1e6, ".1f"),
        "start-up [s]": number(timing.start_up_s if timing else None, ".1f"),
        "loop [s]": number(timing.loop_s if timing else None, ".1f"),
        "steps/s": number(timing.steps_per_s if timing else None, ",.0f"),
        "return": number(_last(record, "Train/mean_reward"), ".2f"),
        "velocity error [m/s]": number(_last(record, "Metrics/lin_vel_rmse")),
        "RMSE [m/s]": number(tracking["rmse_lin"]["mean"] if tracking else None),
        "falls [%]": number(100.0 * tracking["falls"] if tracking else None, ".2f"),
        "return, evaluated": number(episodes["return"]["mean"] if episodes else None, ".1f"),
        "device": ("" if timing is None else "CPU" if timing.device == "cpu" else timing.device),
        "commit": Mono(record.code.commit[:10] + ("+" if record.code.files else "")),
    }


def _began(record: Record, beside: Path, ending: str) -> Cell:
    text = f"{record.began:%Y-%m-%d %H:%M}"
    report = record.folder / f"{REPORT}.{ending}"
    place = report.resolve()
    if place.is_file() and place.is_relative_to(beside.resolve()):
        return Link(text, place.relative_to(beside.resolve()).as_posix())
    return text


def _whole(value: Any) -> int | None:
    return value if isinstance(value, int) else None


def _last(record: Record, tag: str) -> float | None:
    """Return the last value of a curve, as a running mean."""
    return float(smooth(record.scalars[tag][1])[-1]) if tag in record.scalars else None


def _judged(record: Record) -> dict[str, Any] | None:
    """Return the evaluation that the table is of: in the first of our engines that there is."""
    order = [*ENGINES, *(result["physics"] for result in record.results)]
    return min(record.results, key=lambda result: order.index(result["physics"]), default=None)
