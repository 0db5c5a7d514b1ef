"""The numbers of the README and of the pages of results and evaluation are those of the files that come with the policies."""

import json
import re
from pathlib import Path

import pytest
from helpers import POLICY

from legged.robots.robot import load_robot

ROOT = Path(__file__).resolve().parents[1]
README, RESULTS, EVALUATION = (
    (ROOT / name).read_text(encoding="utf-8") for name in ("README.md", "docs/results.md", "docs/evaluation.md")
)
ROUGH = ROOT / "resources" / "policies" / "anymal_c"


def test_numbers_of_the_results_table_are_those_of_the_shipped_evaluation():
    columns = [(seed, *engine) for seed in (1, 2, 3) for engine in (("mujoco_warp", "mujoco-warp"), ("mujoco", "C MuJoCo"))]
    for seed, engine, label in columns:
        folder = POLICY if seed == 1 else POLICY / f"seed_{seed}"
        result = json.loads((folder / f"evaluation_{engine}.json").read_text())
        (row,) = re.findall(rf"\| {seed}, {label} \|(.*)\n", RESULTS)
        lin, ang, gait = result["rmse_lin"], result["rmse_ang"], result["gait"]
        assert f"{lin['mean']:.3f} ({lin['worst']:.3f})" in row
        assert f"{ang['mean']:.3f} ({ang['worst']:.3f})" in row
        assert f"{100 * result['falls']:.2f} %" in row
        assert f"{gait['duty_factor']:.2f}, {gait['steps_per_s']:.2f}" in row


def seeds(physics: str) -> list[dict]:
    """The shipped evaluations of the rough task's three seeds."""
    return [json.loads((ROUGH / seed / f"evaluation_{physics}.json").read_text()) for seed in ("", "seed_2", "seed_3")]


def of_seeds(values: list[float], decimals: int, unit: str = "") -> str:
    """As the page of results writes them: mean (lowest to highest)."""
    middle = sum(values) / len(values)
    edges = 0 if unit else decimals
    return f"{middle:.{decimals}f}{unit} ({min(values):.{edges}f} to {max(values):.{edges}f})"


def share(result: dict, terrain: str, size: float) -> float:
    """Success [%] at a size."""
    (point,) = [point for point in result["success"]["types"][terrain]["points"] if point["size"] == size]
    return 100.0 * point["share"]


def test_numbers_of_the_rough_results_are_those_of_the_shipped_evaluations():
    both = [seeds(physics) for physics in ("mujoco_warp", "mujoco")]
    for label, terrain, size in (
        ("stairs up, 0.20 m", "stairs_up", 0.2),
        ("stairs down, 0.20 m", "stairs_down", 0.2),
        ("obstacles, 0.20 m", "obstacles", 0.2),
        ("slope up, 20 degrees", "slope_up", 20.0),
        ("stairs up, 0.25 m", "stairs_up", 0.25),
        ("stairs down, 0.25 m", "stairs_down", 0.25),
        ("obstacles, 0.25 m", "obstacles", 0.25),
        ("stairs up, 0.30 m", "stairs_up", 0.3),
        ("stairs down, 0.30 m", "stairs_down", 0.3),
        ("slope up, 30 degrees", "slope_up", 30.0),
    ):
        cells = [of_seeds([share(result, terrain, size) for result in results], 1, " %") for results in both]
        assert f"| {label} | {' | '.join(cells)} |" in RESULTS
    for key in ("rmse_lin", "rmse_ang"):
        for part in ("mean", "worst"):
            cells = [of_seeds([result["rough"][key][part] for result in results], 3) for results in both]
            assert f"| {' | '.join(cells)} |" in RESULTS
    cells = [of_seeds([100.0 * result["rough"]["falls"] for result in results], 2) for results in both]
    assert f"| falls [%] | {' | '.join(cells)} |" in RESULTS


def over_seeds(task: str) -> tuple[str, list[list[dict]]]:
    """The beginning of a row of the page of results, and the evaluations of all seeds by engine: seeds, means of the errors
    (worst cell of all), falls."""
    folders = [ROUGH.parent / task, *sorted((ROUGH.parent / task).glob("seed_*"))]
    files = [[folder / f"evaluation_{engine}.json" for folder in folders] for engine in ("mujoco_warp", "mujoco")]
    results = [[json.loads(file.read_text()) for file in of_engine] for of_engine in files]
    cells = []
    for error in ("rmse_lin", "rmse_ang"):
        for each in ([result[error] for result in of_engine] for of_engine in results):
            mean, worst = sum(one["mean"] for one in each) / len(each), max(one["worst"] for one in each)
            cells.append(f"{mean:.3f} ({worst:.3f})")
    falls = [f"{100.0 * sum(result['falls'] for result in each) / len(each):.2f} %" for each in results]
    both = falls[0] if falls[0] == falls[1] else f"{falls[0]}, in C {falls[1]}"
    return f"| {len(folders)} | {' | '.join([*cells, both])} |", results


QUADRUPEDS = {
    "a1_flat": "A1",
    "go1_flat": "Go1",
    "go2_flat": "Go2",
    "anymal_b_flat": "ANYmal B",
    "anymal_d_flat": "ANYmal D",
    "spot_flat": "Spot",
}


@pytest.mark.parametrize("task", QUADRUPEDS)
def test_numbers_of_the_quadrupeds_are_those_of_the_shipped_evaluations(task):
    """And they are what the rewards that scale promise: no cell above 0.15 m/s, no fall in 500."""
    row, results = over_seeds(task)
    assert f"| {QUADRUPEDS[task]} {row}\n" in RESULTS
    low, high = map(float, re.findall(r"\| velocity RMSE ([\d.]+) to ([\d.]+) m/s, no falls \|", README)[0])
    assert low <= round(results[1][0]["rmse_lin"]["mean"], 2) <= high
    assert results[1][0]["falls"] == 0.0
    for result in results[1]:
        assert result["rmse_lin"]["mean"] <= 0.07
        assert result["rmse_lin"]["worst"] <= 0.15
        assert result["rmse_ang"]["mean"] <= 0.09
        assert result["falls"] < 0.002


@pytest.mark.parametrize(("task", "row"), [("g1_flat", "G1"), ("h1_flat", "H1"), ("cassie_flat", "Cassie")])
def test_numbers_of_the_bipeds_are_those_of_the_shipped_evaluations(task, row):
    cells, results = over_seeds(task)
    gait = results[1][0]["gait"]
    assert f"| {row} {cells} {gait['duty_factor']:.2f}, {gait['steps_per_s']:.2f} |" in RESULTS
    rmse = results[1][0]["rmse_lin"]["mean"]
    low, high = map(float, re.findall(r"\| flat: velocity RMSE ([\d.]+) to ([\d.]+) m/s \|", README)[0])
    assert low <= round(rmse, 2) <= high


def evaluations(task: str) -> list[list[dict]]:
    """The shipped evaluations of a rough task: of each engine, those of all seeds."""
    folders = [ROUGH.parent / task, *sorted((ROUGH.parent / task).glob("seed_*"))]
    engines = ("mujoco_warp", "mujoco")
    return [[json.loads((folder / f"evaluation_{engine}.json").read_text()) for folder in folders] for engine in engines]


def rough_errors(results: list[list[dict]]) -> list[str]:
    """Cells with the errors on bumps, of velocity and yaw rate in both engines: mean of the seeds (worst cell of any), and a
    cell with the falls."""
    cells = []
    for error in ("rmse_lin", "rmse_ang"):
        for of_engine in results:
            each = [result["rough"][error] for result in of_engine]
            cells.append(f"{sum(one['mean'] for one in each) / len(each):.3f} ({max(one['worst'] for one in each):.3f})")
    falls = [f"{100.0 * sum(result['rough']['falls'] for result in each) / len(each):.2f} %" for each in results]
    return [*cells, falls[0] if falls[0] == falls[1] else f"{falls[0]}, in C {falls[1]}"]


def crossings(results: list[dict], terrain: str) -> list[tuple[float, float]]:
    """Sizes that were measured and the success there [%], mean of the seeds."""
    points = [result["success"]["types"][terrain]["points"] for result in results]
    return [(of[0]["size"], 100.0 * sum(point["share"] for point in of) / len(of)) for of in zip(*points, strict=True)]


KNOWING = (
    "anymal_c",
    "anymal_c_blind",
    "anymal_c_proprio",
    "anymal_c_estimator",
    "anymal_c_student",
    "anymal_c_student_ppo",
)
"""Tasks of one robot on the same ground, by what their policies are told."""


def row_of_a_task(task: str) -> str:
    """A line of the table of these tasks: errors on bumps, falls, and how many get over stairs and obstacles in C MuJoCo [%],
    means of three seeds."""
    results = evaluations(task)
    assert [len(of_engine) for of_engine in results] == [3, 3]
    shares = [
        [sum(share(result, terrain, size) for result in results[1]) / 3.0 for size in sizes]
        for terrain, sizes in (("stairs_up", (0.2, 0.25)), ("stairs_down", (0.2, 0.3)), ("obstacles", (0.2,)))
    ]
    crossed = [", ".join(f"{of:.0f}" for of in each) + " %" for each in shares]
    return f"| `{task}` | {' | '.join([*rough_errors(results), *crossed])} |"


@pytest.mark.parametrize("task", KNOWING)
def test_numbers_of_the_tasks_that_are_told_less_are_those_of_the_shipped_evaluations(task):
    assert f"{row_of_a_task(task)}\n" in RESULTS


ROUGH_QUADRUPEDS = {
    "a1": "A1",
    "go1": "Go1",
    "go2": "Go2",
    "anymal_b": "ANYmal B",
    "anymal_c": "ANYmal C",
    "anymal_d": "ANYmal D",
    "spot": "Spot",
}


@pytest.mark.parametrize("task", ROUGH_QUADRUPEDS)
def test_numbers_of_the_quadrupeds_on_rough_ground_are_those_of_the_shipped_evaluations(task):
    """And each gets up stairs of 0.36 times its height (the fourth size) in at least 95 %, in both engines."""
    results = evaluations(task)
    ways = ("stairs_up", "stairs_down")
    stairs = [", ".join(f"{crossings(each, way)[3][1]:.0f}" for way in ways) + " %" for each in results]
    step = crossings(results[0], "stairs_up")[3][0]
    row = [ROUGH_QUADRUPEDS[task], str(len(results[0])), *rough_errors(results), f"{step:.3f} m", *stairs]
    assert f"| {' | '.join(row)} |" in RESULTS
    beyond = [", ".join(f"{crossings(results[1], name)[i][1]:.0f}" for i in (3, 4, 5)) for name in (*ways, "obstacles")]
    assert f"| {ROUGH_QUADRUPEDS[task]} | {' | '.join(beyond)} |" in RESULTS
    height, ends = load_robot(task).height, results[0][0]["success"]["types"]
    shares = [f"{crossings(results[1], 'stairs_up')[i][0] / height:.2f}" for i in (3, 4, 5)]
    assert "at {}, {} and {} times the standing height; training ends at".format(*shares) in RESULTS
    stairs, obstacles = (ends[name]["trained_to"] / height for name in ("stairs_up", "obstacles"))
    assert f"training ends at {stairs:.2f} (obstacles {obstacles:.2f}):" in RESULTS
    least = int(re.findall(r"\| up stairs of 0\.36 of their height: (\d+) to 100 % \|", README)[0])
    for each in results:
        assert crossings(each, "stairs_up")[3][1] >= 95.0
        assert crossings(each, "stairs_up")[3][1] >= least


@pytest.mark.parametrize(("task", "row"), [("g1", "G1"), ("h1", "H1"), ("cassie", "Cassie")])
def test_numbers_of_the_bipeds_on_rough_ground_are_those_of_the_shipped_evaluations(task, row):
    """And each crosses stairs of 0.10 m of a G1 (the second size) and slopes in at least 90 %."""
    results, ways = evaluations(task), ("stairs_up", "stairs_down", "obstacles")
    stairs, slopes = [], []
    for each in results:
        stairs.append([crossings(each, name)[1] for name in ways])
        slopes.append([crossings(each, f"slope_{way}")[-1][1] for way in ("up", "down")])
        assert min(share for _, share in stairs[-1][:2]) >= 90.0
        assert min(slopes[-1]) >= 90.0
    shown = [", ".join(f"{share:.0f}" for _, share in of) + " %" for of in stairs]
    shown += [", ".join(f"{share:.0f}" for share in of) + " %" for of in slopes]
    assert f"| {row} | {' | '.join([*rough_errors(results), f'{stairs[0][0][0]:.3f} m', *shown])} |" in RESULTS
    beyond = [
        ", ".join(f"{crossings(results[1], name)[i][1]:.0f}" for i in (2, 3, 4))
        for name in ("stairs_up", "stairs_down", "obstacles")
    ]
    assert f"| {row} | {' | '.join(beyond)} |" in RESULTS


STRESSED = (
    ("`anymal_c`, seed 1", "anymal_c"),
    ("`anymal_c`, seed 2", "anymal_c/seed_2"),
    ("`anymal_c`, seed 3", "anymal_c/seed_3"),
    ("`anymal_c_blind`, seed 1", "anymal_c_blind"),
    ("`anymal_c_blind`, seed 2", "anymal_c_blind/seed_2"),
    ("`anymal_c_blind`, seed 3", "anymal_c_blind/seed_3"),
    ("`anymal_c_proprio`", "anymal_c_proprio"),
    ("`anymal_c_estimator`", "anymal_c_estimator"),
    ("`anymal_c_student`", "anymal_c_student"),
    ("`anymal_c_student_ppo`", "anymal_c_student_ppo"),
)


def stress_row(row: str, folder: str) -> str:
    """A line of the table of stress tests: score with its interval, its parts, and of 128 robots those that did not come
    through."""
    result = json.loads((ROUGH.parent / folder / "stress_mujoco.json").read_text())
    score, lines = result["score"], {line["name"]: line["stairs"] for line in result["lines"]}
    cells = [f"{100.0 * score['value']:.1f} % ({100.0 * score['low']:.0f} to {100.0 * score['high']:.0f})"]
    cells += [f"{100.0 * score[part]:.0f} %" for part in ("stairs", "flat", "ground")]
    measured = [lines[name] for name in ("payload", "delay 40 ms", "no map", "together", "everything")]
    measured += [result["ground"][name] for name in ("dense_blocks", "kerbs", "rubble")]
    assert all(point["robots"] == 128 for point in measured)
    cells += [str(point["robots"] - point["successes"]) for point in measured]
    return f"| {row} | {' | '.join(cells)} |\n"


@pytest.mark.parametrize(("row", "folder"), STRESSED)
def test_numbers_of_the_stress_table_are_those_of_the_shipped_stress_tests(row, folder):
    assert stress_row(row, folder) in EVALUATION


@pytest.mark.parametrize(("row", "folder"), [("1", "seed_1"), ("2, shipped", ""), ("3", "seed_3")])
def test_numbers_of_the_humanoid_are_those_of_the_shipped_evaluations(row, folder):
    files = [ROUGH.parent / "humanoid" / folder / f"evaluation_{engine}.json" for engine in ("mujoco_warp", "mujoco")]
    results = [json.loads(file.read_text())["episodes"] for file in files]
    assert all(result["count"] == 256 for result in results)
    cells = [f"{result['metrics']['x_velocity']:.2f}, {100.0 * result['failures']:.1f} %" for result in results]
    (shown,) = re.findall(rf"\n\| {row} \| [^|]* \| (\d\.\d+, .*) \|\n", RESULTS)
    assert shown == " | ".join(cells)
    assert folder or f"| {results[0]['metrics']['x_velocity']:.1f} m/s, no falls |" in README


def test_numbers_of_the_step_are_those_of_the_shipped_evaluation():
    result = json.loads((ROUGH.parent / "anymal_c_step" / "evaluation_mujoco_warp.json").read_text())
    points = {point["size"]: point for point in result["success"]["types"]["step"]["points"]}
    crossed = f"{points[0.15]['successes']} of {points[0.15]['robots']} tries"
    assert f"crosses the step of 15 cm in {crossed}, and one of 20 cm in {points[0.2]['successes']}." in RESULTS
    assert f"| crosses in {crossed} |" in README


@pytest.mark.parametrize(
    ("label", "folder"),
    [
        ("mujoco_warp (shipped)", POLICY),
        ("newton_mujoco", POLICY / "newton_mujoco"),
        ("newton_steel", POLICY / "newton_steel"),
        ("mujoco_warp, then 50 iterations in newton_xpbd", POLICY / "newton_xpbd"),
    ],
)
def test_numbers_of_the_table_of_engines_are_those_of_the_crossings(label, folder):
    shown = re.findall(rf"\n\| {re.escape(label)} \|(.*)\|\n", RESULTS)[0].split("|")
    rows = {row["physics"]: row for row in json.loads((folder / "crossing.json").read_text())["engines"]}
    columns = ("mujoco", "steel", "kamino", "featherstone", "xpbd", "semi_implicit")
    for cell, solver in zip(shown, columns, strict=True):
        row = rows.pop(f"newton_{solver}")
        fallen = f", {100.0 * row['falls']:.0f} % fall" if row["falls"] else ""
        assert cell.strip() == f"{row['rmse_lin']:.3f}, {row['rmse_ang']:.3f}{fallen}"
        if solver == "mujoco":
            alike = [rows.pop(name) for name in ("mujoco_warp", "mujoco")]
            assert all(abs(other[key] - row[key]) < 1e-3 for other in alike for key in ("rmse_lin", "rmse_ang", "falls"))
    assert not rows


@pytest.mark.parametrize("engine", ["mujoco_warp", "newton_mujoco", "newton_steel", "newton_xpbd"])
def test_numbers_of_the_table_of_trainings_are_those_of_the_evaluations(engine):
    result = json.loads((POLICY / engine / f"evaluation_{engine}.json").read_text())
    shown = [row for row in RESULTS.splitlines() if re.match(rf"\| (50 iterations in )?{engine} \| [\d.]+ s ", row)]
    errors = [f"{result[key]['mean']:.3f} ({result[key]['worst']:.3f})" for key in ("rmse_lin", "rmse_ang")]
    cells = [f"{errors[0]} m/s", f"{errors[1]} rad/s", f"{100.0 * result['falls']:.2f} %"]
    assert [row.strip("| ").split(" | ")[3:] for row in shown] == [cells]
