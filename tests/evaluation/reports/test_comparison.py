"""Runs side by side: which differences are marked, and what an interval is told of, by hand."""

from datetime import datetime
from math import sqrt
from pathlib import Path

from legged.evaluation.reports.comparison import comparison_parts
from legged.evaluation.reports.document import Table
from legged.evaluation.reports.record import Code, Record


def figures(*results):
    """Measure -> cells of the table of evaluations, of runs with such results."""
    records = [
        Record(
            Path(f"logs/task/{number}"),
            {"task": "task", "train": {"runner": {"run_name": f"run {number}"}}},
            datetime(2026, 1, 2, 3, 4, 5),
            None, {}, ({"physics": "mujoco", **result},), Code(), "", "finished", "", 1, (),
        )
        for number, result in enumerate(results)
    ]  # fmt: skip
    (table,) = [part for part in comparison_parts(records) if isinstance(part, Table) and part.head[0] == "measure"]
    return {row[0]: list(row[1:]) for row in table.rows}


def tracking(*errors, falls=0.0):
    cells = [{"command": [float(i), 0.0, 0.0], "rmse_lin": error, "rmse_ang": 0.1} for i, error in enumerate(errors)]
    return {"cells": cells, "robots_per_cell": 100, "falls": falls}


def episodes(mean, std, count):
    return {"episodes": {"count": count, "return": {"mean": mean, "std": std}, "failures": 0.0}}


def test_of_one_command_there_is_neither_interval_nor_mark():
    found = figures(tracking(0.2), tracking(0.35))
    assert found["velocity RMSE [m/s]"] == ["0.200", "0.350", "+0.150"]
    found = figures(tracking(0.2, 0.4), tracking(0.35, 0.55))  # two that differ by the same are the bootstrap's to judge
    assert found["velocity RMSE [m/s]"][2] == "+0.150 (+0.150 to +0.150) *"
    assert figures(tracking(0.2, None), tracking(None, 0.3))["velocity RMSE [m/s]"] == ["0.200", "0.300", "-"]


def test_of_one_episode_there_is_neither_interval_nor_mark():
    found = figures(episodes(100.0, 0.0, 1), episodes(200.0, 3.0, 9))
    assert found["return"][0] == "100.0"
    assert found["return"][2] == "+100.0"


def test_returns_have_the_standard_deviation_of_a_sample():
    """Files have that of the returns themselves: 3 over 9 of them is 3 sqrt(9 / 8) of a sample, its error sqrt(9 / 8)."""
    half = 1.959964 * sqrt(9 / 8)
    found = figures(episodes(200.0, 3.0, 9), episodes(200.0 + 1.96 * sqrt(2), 3.0, 9))
    assert found["return"][0] == f"200.0 ({200 - half:.1f} to {200 + half:.1f})"
    assert found["return"][0] == "200.0 (197.9 to 202.1)"  # 198.0 to 202.0 without the correction
    assert not found["return"][2].endswith("*")  # the border was crossed without it
