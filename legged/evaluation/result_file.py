"""Files with the results of evaluations. A file is checked when it is read, because it may be damaged or of another kind."""

import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import torch

from legged.errors import ConfigError
from legged.evaluation.json_forms import ANY, NUMBER, TEXT, OrNull, check_form
from legged.process.paths import make_folder, write_text

CHANGED = "changed"
"""Name of the folder, next to the policy's other results, for evaluations under changed conditions."""
SAYS_NOTHING = ("sim.physics", "sim.solver", "sim.threads", "env.seed", "env.num_envs", "robot")
"""Fields that do not change the conditions of an evaluation."""
SECTIONS_THAT_SAY_NOTHING = ("train.", "evaluation.")
"""Sections whose fields do not change the conditions. The section `evaluation` holds the grid of commands, which has its own
place in a result."""

BROKEN = (KeyError, TypeError, ValueError, IndexError, AttributeError)
"""Errors that are raised when a missing part of a result is read."""

ERRORS = {"mean": OrNull(NUMBER), "worst": OrNull(NUMBER)}
SPREAD = dict.fromkeys(("mean", "std", "min", "max"), NUMBER)
POINT = {"size": NUMBER, "share": NUMBER}
TYPE = {"unit": TEXT, "what": TEXT, "trained_to": OrNull(NUMBER), "points": [POINT]}
HEAD = {"task": TEXT, "physics": TEXT, "changes?": {}}
TRACKING = {"falls": NUMBER, "grid?": {ANY: [NUMBER, ...]}, "rmse_lin": ERRORS, "rmse_ang": ERRORS}
EPISODES = {
    **dict.fromkeys(("count", "failures"), NUMBER),
    **dict.fromkeys(("return", "length"), SPREAD),
    "terms": {ANY: NUMBER},
    "metrics": {ANY: NUMBER},
}
SUCCESS: dict[str, Any] = {"success?": {"types": {ANY: TYPE}}}
"""Forms of the parts of a result."""


def changes_of(asked: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    """Return field -> value for those of the overrides that change the conditions of an evaluation."""
    said = ((field, value) for field, value in asked if field not in SAYS_NOTHING)
    return {field: value for field, value in said if not f"{field}.".startswith(SECTIONS_THAT_SAY_NOTHING)}


def file_name(engine: str) -> str:
    """Return the name of the file with the evaluation in an engine."""
    return f"evaluation_{engine}.json"


def stress_name(engine: str) -> str:
    """Return the name of the file with the stress test in an engine."""
    return f"stress_{engine}.json"


def kept_parts(path: Path, head: dict[str, Any]) -> dict[str, Any]:
    """Return the measured parts of the result at `path`. Return an empty mapping if there is no result, or if its first
    fields, such as task and checkpoint, differ from `head`.
    """
    try:
        old = json.loads(path.read_text(encoding="utf-8"))
        same = isinstance(old, dict) and all(old.get(name) == value for name, value in head.items())
    except (OSError, ValueError, RecursionError):
        return {}
    if not same or ("changes" in old) != ("changes" in head):
        return {}
    return {name: value for name, value in old.items() if name not in (*head, "wall_s")}


def read_results(paths: Iterable[Path]) -> list[dict[str, Any]]:
    """Read the results at `paths`, which are files or folders. A file that is found twice counts once.

    Raises:
        ConfigError: a path does not exist or holds no evaluation.
    """
    results: dict[Path, dict[str, Any]] = {}
    for path in paths:
        files = sorted(path.glob(file_name("*"))) if path.is_dir() else [path]
        if not files or not all(file.is_file() for file in files):
            raise ConfigError(f"{path}: holds no evaluation_<physics>.json; the command `legged evaluate` writes it")
        for file in files:
            try:
                result = json.loads(file.read_text(encoding="utf-8"))
            except (OSError, ValueError, RecursionError) as error:
                raise ConfigError(f"{file}: is not the result of an evaluation ({error})") from error
            check_result(result, str(file))
            results[file.resolve()] = result
    return list(results.values())


def check_result(result: Any, where: str) -> None:
    """Check the fields of a result that comparisons read. `where` names the file in messages.

    Raises:
        ConfigError: a field is missing or has a wrong type.
    """
    damaged, there = f"{where}: is not the result of an evaluation", result if isinstance(result, dict) else {}
    alone = "success" in there and not TRACKING.keys() & there.keys()  # `legged evaluate terrain` writes success alone
    tracking: dict[str, Any] = {"rough": TRACKING} if "rough" in there else {} if alone else TRACKING
    check_form(result, {**HEAD, "episodes": EPISODES} if "episodes" in there else {**HEAD, **SUCCESS, **tracking}, damaged)


def device_name(device: torch.device) -> str:
    """Return the name of a device: the product name of a GPU, or "cpu"."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu"


def write_result(path: Path, result: dict[str, Any]) -> None:
    """Write a result as a JSON file, in a folder that is made if it is missing.

    Raises:
        RunError: the file can't be written.
    """
    make_folder(path.parent)
    write_text(path, json.dumps(result, indent=1, allow_nan=False))


def tracking_of(result: dict[str, Any]) -> dict[str, Any]:
    """Return the part of a result that holds the tracking errors: "rough" if it exists, else the whole result."""
    return result.get("rough", result)


def falls_of(tracking: dict[str, Any]) -> tuple[int, int] | None:
    """Return how many robots fell on the grid of commands, and how many robots there were; None if numbers are missing."""
    try:
        robots = len(tracking["cells"]) * int(tracking["robots_per_cell"])
        return (round(tracking["falls"] * robots), robots) if robots > 0 else None
    except BROKEN:
        return None


def has_tracking(result: dict[str, Any]) -> bool:
    """Return whether a checked result holds errors on a grid of commands, which `legged evaluate grid` measures."""
    return "rmse_lin" in tracking_of(result)


def changes_text(result: dict[str, Any]) -> str:
    """Return the changed fields of an evaluation as text: 'sim.dt=0.002, terrain.scan=own', or '' without changes."""
    return ", ".join(f"{field}={value}" for field, value in sorted(result.get("changes", {}).items()))


def grid_text(result: dict[str, Any]) -> str:
    """Return the grid of an evaluation as text: 'vx -1 to 1, vy 0, yaw 0 (5 commands)', or '' without a grid."""
    grid = tracking_of(result).get("grid", {})
    ends = {axis: sorted({min(values), max(values)}) for axis, values in grid.items()}
    parts = [f"{axis} {' to '.join(f'{value:g}' for value in values)}" for axis, values in ends.items()]
    count = math.prod(map(len, grid.values()))
    return f"{', '.join(parts)} ({count} command{'s' if count > 1 else ''})" if grid else ""
