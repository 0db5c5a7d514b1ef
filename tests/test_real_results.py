"""The numbers of docs/real.md are those of the evaluations and stress tests that come with the policies."""

import json
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parent.parent
REAL = (ROOT / "docs/real.md").read_text(encoding="utf-8")
TASKS = {"anymal_c_real": (0.2, 0.25), "go2_real": (0.12, 0.15)}
"""Task -> the steps whose success is said [m], as rounded there."""


def shipped(task: str, name: str) -> dict[str, Any]:
    return json.loads((ROOT / "resources/policies" / task / name).read_text(encoding="utf-8"))


def percent(share: float) -> str:
    return f"{100.0 * share:.0f}"


@pytest.mark.parametrize("task", TASKS)
def test_errors_and_success_are_those_of_the_shipped_evaluation(task):
    result = shipped(task, "evaluation_mujoco.json")
    grid, types = result["rough"], result["success"]["types"]

    def success(terrain: str, size: float) -> str:
        return percent(next(p["share"] for p in types[terrain]["points"] if round(p["size"], 2) == size))

    errors = [f"{grid[name]['mean']:.3f} ({grid[name]['worst']:.3f})" for name in ("rmse_lin", "rmse_ang")]
    up, down = ([f"{success(terrain, size)} %" for size in TASKS[task]] for terrain in ("stairs_up", "stairs_down"))
    slopes = {success(f"slope_{way}", 30.0) for way in ("up", "down")}
    assert len(slopes) == 1
    first, second = (f"{size:.2f} m" for size in TASKS[task])
    cells = [*errors, f"{100.0 * grid['falls']:.2f} %", f"{first}: {up[0]}, {second}: {up[1]}", ", ".join(down)]
    assert f"| `{task}` | {' | '.join(cells)} | 30 degrees: {slopes.pop()} % |" in REAL


@pytest.mark.parametrize("task", TASKS)
def test_success_under_stress_is_that_of_the_shipped_stress_test(task):
    """And it is what such policies are asked for: 95 % under each of four disturbances, 85 % under all four together."""
    result = shipped(task, "stress_mujoco.json")
    lines = {line["name"]: line["stairs"] for line in result["lines"]}
    told = ["nominal", "payload", "friction", "weak motors", "delay 20 ms", "delay 40 ms", "pushes", "together", "everything"]
    assert f"| `{task}` | {' | '.join(percent(lines[name]['share']) for name in told)} |" in REAL
    assert min(lines[name]["share"] for name in ("payload", "friction", "weak motors", "delay 20 ms")) >= 0.95
    assert lines["together"]["share"] >= 0.85
    assert {lines[name]["size"] for name in lines} == {0.17 if task == "anymal_c_real" else 0.12}
    for setting in result["settings"].values():
        assert next(line for line in setting if line["name"] == "together")["stairs"]["share"] == 1.0
    ground = {name: percent(point["share"]) for name, point in result["ground"].items()}
    assert (
        ground == dict.fromkeys(ground, "100") or f"{', '.join(list(ground.values())[:2])} and {ground['rubble']} %" in REAL
    )


@pytest.mark.parametrize("task", TASKS)
def test_times_are_those_of_the_shipped_training(task):
    timing = shipped(task, "timing.json")
    assert timing["beside"] == 0
    assert f"{timing['loop_s']:.1f} s" in REAL
    assert f"({timing['steps_per_s'] / 1e6:.2f} M steps/s)" in REAL
    assert f"{timing['wall_s']:.0f}" in REAL
