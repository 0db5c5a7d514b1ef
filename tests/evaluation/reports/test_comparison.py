"""Runs side by side: which differences are marked, and what an interval is told of, by hand."""

from datetime import datetime
from math import sqrt
from pathlib import Path

from legged.evaluation.reports.comparison import comparison_parts, conditions_of
from legged.evaluation.reports.document import Figures, Paragraph, Table
from legged.evaluation.reports.record import Code, Record


def parts_of(*results):
    """The page on runs with such results."""
    records = [
        Record(
            Path(f"logs/task/{number}"),
            {"task": "task", "train": {"runner": {"run_name": f"run {number}"}}},
            datetime(2026, 1, 2, 3, 4, 5),
            None, {}, {"mujoco": {"physics": "mujoco", **result}}, Code(), "", "finished", "", 1, (),
        )
        for number, result in enumerate(results)
    ]  # fmt: skip
    return comparison_parts(records)


def figures(*results):
    """Measure -> cells of the table of evaluations, of runs with such results."""
    (table,) = [part for part in parts_of(*results) if isinstance(part, Table) and part.head[0] == "measure"]
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


def test_other_conditions_are_told():
    """The first has another grid, the second other contacts; the third was made as the first, whose grid is told too."""
    grids = {"vx": [-1.0, 1.0], "vy": [0.0], "yaw": [0.0]}, {"vx": [0.5], "vy": [0.0], "yaw": [0.0]}
    first, second = ({"grid": grid} for grid in grids)
    changed = first | {"changes": {"terrain.scan": "own", "sim.dt": 0.002}}
    wide, narrow = "vx -1 to 1, vy 0, yaw 0 (2 commands)", "vx 0.5, vy 0, yaw 0 (1 command)"
    assert conditions_of([first, changed, None]) == [("", ""), ("sim.dt=0.002, terrain.scan=own", ""), ("", "")]
    assert conditions_of([first, second, first]) == [("", wide), ("", narrow), ("", wide)]
    said = [
        part.text for part in parts_of({**tracking(0.2), **first}, {**tracking(0.3), **second}) if isinstance(part, Paragraph)
    ]
    assert f"run 0: on {wide}." in said
    assert f"run 1: on {narrow}." in said


def test_each_line_of_success_has_the_end_of_its_own_training():
    """Two runs of which one trained to higher stairs, and a type that one of them did not train on."""

    def of(up, pit):
        ends = {"stairs_up": up, "pit": pit}
        points = [{"size": 0.1, "share": 1.0}, {"size": 0.2, "share": 0.5}]
        types = {name: {"unit": "m", "what": "height", "trained_to": end, "points": points} for name, end in ends.items()}
        return {**tracking(0.2, 0.4), "success": {"types": types}}

    (drawings,) = [part.drawings for part in parts_of(of(0.2, None), of(0.3, 0.4)) if isinstance(part, Figures)]
    stairs, pit = drawings
    assert "hardest of training: run 0<" in stairs
    assert "hardest of training: run 1<" in stairs
    assert pit.count("hardest of training<") == 1
    (both_alike,) = (part.drawings for part in parts_of(of(0.2, None), of(0.2, None)) if isinstance(part, Figures))
    assert both_alike[0].count("hardest of training<") == 1
    assert "hardest" not in both_alike[1]


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
