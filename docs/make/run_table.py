"""One table of many trainings: duration and quality of the policy, by task and seed."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import asdict
from statistics import mean
from typing import Any

from evaluated_run import EvaluatedRun

from legged.errors import ConfigError
from legged.evaluation.engines import ENGINES, engine_of
from legged.evaluation.result_file import tracking_of
from legged.process.paths import relative
from legged.robots.robot import load_robot
from legged.tables import markdown_table

UP, DOWN = "stairs_up", "stairs_down"
NONE = "-"
"""Text of a cell whose value is not known."""
LEGEND = (
    "Errors: root mean square over time, mean of the cells of the command grid (worst cell). Falls: share of the robots on"
    " the grid. Stairs: share of the robots that get up, and down, steps of the height in the column before; h is the height"
    " of the base in the default pose. In a line of means the worst cell is that of the worst seed."
)
SIDE_BY_SIDE = " Times with a + are of trainings that shared the machine, each with so many others."
COMPILED = " Start-up times with a * hold the compilation of kernels."

Row = dict[str, Any]


def summary(runs: Sequence[EvaluatedRun]) -> list[Row]:
    """Return plain numbers for each task, in the order of the runs: one row for each seed, and the mean over seeds."""
    tasks = dict.fromkeys(run.cfg.task for run in runs)
    return [_task(task, [run for run in runs if run.cfg.task == task]) for task in tasks]


def _task(task: str, runs: Sequence[EvaluatedRun]) -> Row:
    robot, height = _robot(runs[0].cfg.robot)
    step = stairs_height(runs)
    stairs = None if step is None else {"size": step, "share_of_height": step / height if height else None}
    rows = [_row(run, step) for run in runs]
    good = [row for row in rows if not row["failure"]]
    return {
        "task": task,
        "robot": robot,
        "height": height,
        "stairs": stairs,
        "seeds": rows,
        "mean": means(good) if len(good) > 1 else None,
    }


@functools.cache
def _robot(given: str) -> tuple[str, float | None]:
    """Return name and standing height [m] of the robot that a configuration names. The height is None if the robot is not
    found.
    """
    try:
        robot = load_robot(given)
    except ConfigError:
        return given, None
    return robot.name, robot.height


def stairs_height(runs: Sequence[EvaluatedRun]) -> float | None:
    """Return the height of the steps for which the table states the success [m]. It is the smallest height that every
    evaluation with stairs measured up and down, and not below the share of the base height that the first run's
    configuration demands. Return None if there is no such height.
    """
    cfg = runs[0].cfg
    least = cfg.evaluation.stairs * cfg.rewards.base_height_target - 1e-9
    results = [result for run in runs for result in run.results.values()]
    sizes = [{*_shares(result, UP)} & {*_shares(result, DOWN)} for result in results if _shares(result, UP)]
    common = set.intersection(*sizes) if sizes else set()
    return min((size for size in common if size >= least), default=None)


def _shares(result: Row, terrain: str) -> dict[float, float]:
    """Return size -> share of success that an evaluation found on a terrain type."""
    entry = result.get("success", {}).get("types", {}).get(terrain, {"points": []})
    return {point["size"]: point["share"] for point in entry["points"]}


def _row(run: EvaluatedRun, step: float | None) -> Row:
    timing = {} if run.timing is None else asdict(run.timing) | {"steps_per_s": run.timing.steps_per_s}
    engines = {}
    for name, result in run.results.items():
        tracking = tracking_of(result)
        errors = {key: {part: tracking[key][part] for part in ("mean", "worst")} for key in ("rmse_lin", "rmse_ang")}
        ways = {way: _shares(result, terrain) for way, terrain in (("up", UP), ("down", DOWN))}
        there = step is not None and all(step in shares for shares in ways.values())
        stairs = {way: shares[step] for way, shares in ways.items()} if there else None  # type: ignore[index]
        engines[name] = {**errors, "falls": tracking["falls"], "stairs": stairs}
    return {
        "seed": run.seed,
        "folder": None if run.folder is None else relative(run.folder),
        "failure": run.failure,
        "notes": list(run.notes),
        "robots": timing.get("robots", run.cfg.env.num_envs),
        "iterations": timing.get("iterations", run.cfg.train.runner.max_iterations),
        **{key: timing.get(key) for key in ("loop_s", "start_up_s", "wall_s", "steps_per_s", "device")},
        **{key: timing.get(key, 0) for key in ("beside", "kernels_compiled")},
        "engines": engines,
    }


def means(rows: Sequence[Row]) -> Row:
    """Return the means over seeds, and the worst of their worst cells. A mean leaves out seeds without the number."""
    engines = {}
    for name in ENGINES:
        found = [row["engines"][name] for row in rows if name in row["engines"]]
        if not found:
            continue
        errors = {
            key: {part: _of([one[key][part] for one in found], of) for part, of in (("mean", mean), ("worst", max))}
            for key in ("rmse_lin", "rmse_ang")
        }
        crossed = [one["stairs"] for one in found if one["stairs"] is not None]
        stairs = {way: mean(one[way] for one in crossed) for way in ("up", "down")} if crossed else None
        engines[name] = {**errors, "falls": mean(one["falls"] for one in found), "stairs": stairs}
    times = {key: _of([row[key] for row in rows], mean) for key in ("loop_s", "start_up_s", "wall_s", "steps_per_s")}
    same = {key: rows[0][key] if len({row[key] for row in rows}) == 1 else None for key in ("robots", "iterations")}
    most = {key: max(row[key] for row in rows) for key in ("beside", "kernels_compiled")}
    return {"seeds": len(rows), **same, **times, **most, "engines": engines}


def _of(values: Sequence[float | None], of: Callable[..., float]) -> float | None:
    """Return `of` the values that are not None. A value is None if every robot fell early."""
    there = [value for value in values if value is not None]
    return of(there) if there else None


# ---- Markdown --------------------------------------------------------------------------------------------------------


def markdown(tasks: Sequence[Row]) -> str:
    """Return a summary as a Markdown table. Each task has a row for each seed, below the mean if it has several seeds."""
    rows = [row for task in tasks for row in (*([task["mean"]] if task["mean"] else []), *task["seeds"])]
    engines = [name for name in ENGINES if any(name in row["engines"] for row in rows)]
    stairs = any(task["stairs"] for task in tasks)
    labels = [engine_of(name).label for name in engines]
    head = ["task", "seed", "robots", "iterations", "loop [s]", "start-up [s]", "in all [s]", "steps/s"]
    for measure in ("velocity RMSE [m/s]", "yaw rate RMSE [rad/s]", "falls [%]"):
        head += [f"{measure}, {label}" for label in labels]
    if stairs:
        head += ["stairs [m]", *(f"up, down [%], {label}" for label in labels)]
    lines = [
        _cells(task, row, engines, stairs)
        for task in tasks
        for row in (*([task["mean"]] if task["mean"] else []), *task["seeds"])
    ]
    table = markdown_table(head, lines, left=range(len(head)))
    marks = {SIDE_BY_SIDE: "beside", COMPILED: "kernels_compiled"}
    legend = "".join([_devices(rows), LEGEND, *(text for text, key in marks.items() if any(row[key] for row in rows))])
    return "\n\n".join([table, legend, *_notes(tasks)]) + "\n"


def _cells(task: Row, row: Row, engines: Sequence[str], stairs: bool) -> list[str]:
    """Return the cells of one seed, or of the mean of several."""
    is_mean = "seeds" in row
    cells = [task["task"], f"mean of {row['seeds']}" if is_mean else str(row["seed"])]
    cells += [_text(row["robots"], ",d"), _text(row["iterations"], ",d")]
    beside = f" +{row['beside']}" if row["beside"] else ""
    if not is_mean and row["failure"]:
        cells += ["failed", *[NONE] * 3]
    else:
        marks = {"loop_s": beside, "start_up_s": " *" if row["kernels_compiled"] else "", "wall_s": ""}
        cells += [NONE if row[key] is None else f"{row[key]:.1f}{mark}" for key, mark in marks.items()]
        cells.append(_text(row["steps_per_s"], ",.0f"))
    judged = [row["engines"].get(name) for name in engines]
    for key in ("rmse_lin", "rmse_ang"):
        cells += [NONE if one is None else f"{_text(one[key]['mean'])} ({_text(one[key]['worst'])})" for one in judged]
    cells += [NONE if one is None else f"{100.0 * one['falls']:.2f}" for one in judged]
    if stairs:
        cells.append(NONE if task["stairs"] is None else _stairs(task["stairs"]))
        crossed = [None if one is None else one["stairs"] for one in judged]
        cells += [NONE if one is None else f"{100 * one['up']:.1f}, {100 * one['down']:.1f}" for one in crossed]
    return cells


def _text(value: float | None, form: str = ".3f") -> str:
    return NONE if value is None else f"{value:{form}}"


def _stairs(stairs: Row) -> str:
    share = stairs["share_of_height"]
    return f"{stairs['size']:.3f}" + (f" = {share:.2f} h" if share is not None else "")


def _devices(rows: Sequence[Row]) -> str:
    """Return a sentence on the devices of the trainings, as far as they are known."""
    names = dict.fromkeys(str(row["device"]) for row in rows if row.get("device"))
    return f"Trained on {', '.join('a CPU' if name == 'cpu' else name for name in names)}. " if names else ""


def _notes(tasks: Sequence[Row]) -> list[str]:
    """Return a list of failures and notes, if there are any."""
    said = []
    for task in tasks:
        for row in task["seeds"]:
            reasons = [f"training failed: {row['failure']}"] if row["failure"] else []
            said += [f"- {task['task']}, seed {row['seed']}: {text}" for text in (*reasons, *row["notes"])]
    return ["\n".join(said)] if said else []
