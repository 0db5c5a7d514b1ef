"""A training and the evaluations of its policy, read from a run folder or from the folder of a shipped policy."""

import re
import sys
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from legged.config import LeggedConfig
from legged.errors import ConfigError
from legged.evaluation.engines import ENGINES
from legged.evaluation.reports.record import folders_in
from legged.evaluation.result_file import changes_text, file_name, grid_text, read_results, tracking_of
from legged.evaluation.velocity_grid import axes_of
from legged.learning.run_folder import SHIPPED_MODEL, checkpoints, of_another_policy, run_config
from legged.learning.timing import Timing, read_timing
from legged.process.paths import relative

SEED_FOLDER = re.compile(r"seed_(\d+)", re.ASCII)
"""Names of the folders of other seeds, next to a shipped policy."""


@dataclass(frozen=True)
class EvaluatedRun:
    """A training and its evaluations. A failed training may have no folder, times or results."""

    cfg: LeggedConfig
    seed: int
    folder: Path | None = None
    timing: Timing | None = None
    results: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Engine -> result of its evaluation."""
    failure: str = ""
    """Reason why there is no finished policy; empty if there is one."""
    notes: tuple[str, ...] = ()
    """Other remarks, such as evaluations that were left out."""


def read_run(folder: Path) -> EvaluatedRun:
    """Read a run folder or the folder of a shipped policy. Evaluations of earlier checkpoints, and evaluations with changed
    settings, are left out with a note. A note also marks evaluations on another grid of commands than the task's.

    Raises:
        ConfigError: the folder is no run folder, its task follows no commands, or a file in it is damaged.
    """
    cfg = run_config(folder)
    if not isinstance(cfg, LeggedConfig):
        raise ConfigError(f"{relative(folder)}: '{cfg.task}' follows no commands; the table has only tasks that do")
    timing = read_timing(folder)
    notes = ["it was resumed, and its times are those of the last part"] if timing and timing.resumed else []
    results = results_in(folder)
    others = {name: one["checkpoint"] for name, one in results.items() if of_another_policy(folder, one.get("checkpoint"))}
    notes += [f"its evaluation in {name} is of {file}, not of its last policy" for name, file in others.items()]
    known = {name: one for name, one in results.items() if name not in others}
    for name, one in [*known.items()]:
        if one.get("changes"):
            notes.append(f"its evaluation in {name} was made with {changes_text(known.pop(name))}, and is left out")
        elif tracking_of(one).get("grid") not in (None, axes_of(cfg)):
            notes.append(f"its evaluation in {name} is not on its task's grid of commands, but on {grid_text(one)}")
    return EvaluatedRun(cfg, cfg.env.seed, folder, timing, known, why_unfinished(folder, cfg, timing), tuple(notes))


def results_in(folder: Path) -> dict[str, dict[str, Any]]:
    """Return engine -> result of the evaluations in a folder.

    Raises:
        ConfigError: an evaluation is damaged, or does not measure how a policy follows commands.
    """
    found = {}
    for engine in ENGINES:
        path = folder / file_name(engine)
        if path.is_file():
            (found[engine],) = read_results([path])
            if "episodes" in found[engine]:
                raise ConfigError(f"{relative(path)}: measures episodes, but the table has only tasks that follow commands")
    return found


def why_unfinished(folder: Path, cfg: LeggedConfig, timing: Timing | None) -> str:
    """Return the reason why a folder holds no policy that was trained to the end; an empty text if it holds one."""
    there = checkpoints(folder)
    if not there:
        return "it left no checkpoint"
    last, wanted = max(there) + 1, cfg.train.runner.max_iterations
    if there[last - 1].name == SHIPPED_MODEL or (last >= wanted if timing is None else timing.finished):
        return ""
    return f"stopped after {last} of {wanted} iterations"


def find_runs(paths: Iterable[Path]) -> list[EvaluatedRun]:
    """Read the runs in some folders: run folders, folders that hold them (logs/ or logs/<task>/), or the folder of a shipped
    policy with its other seeds. Each run is read once. Runs whose task follows no commands or whose configuration can't be
    read are left out, and a printed line names them.

    Raises:
        ConfigError: a folder holds no run with commands, or a file is damaged.
    """
    found: list[EvaluatedRun] = []
    seen: set[Path] = set()
    left_out: dict[str, list[str]] = {}
    for path in paths:
        folders = folders_in(path)
        reasons = {folder: why_not(folder) for folder in folders if folder != path}
        kept = [folder for folder in folders if not reasons.get(folder)] or folders[
            :1
        ]  # if none is left, reading the first one raises the error
        for folder in kept:
            if folder.resolve() not in seen:
                found += [read_run(folder), *_other_seeds(folder)]
            seen.add(folder.resolve())
        for folder, reason in reasons.items():
            if reason:
                left_out.setdefault(reason, []).append(relative(folder))
    for reason, names in left_out.items():
        print(f"left out, {reason}: {', '.join(names)}", file=sys.stderr, flush=True)
    return found


def why_not(folder: Path) -> str:
    """Return the reason why a run is not in the table; an empty text if it is."""
    try:
        cfg = run_config(folder)
    except ConfigError as error:
        return f"because its configuration can't be read ({' '.join(str(error).split())})"
    return "" if isinstance(cfg, LeggedConfig) else "because their tasks follow no commands"


def _other_seeds(folder: Path) -> list[EvaluatedRun]:
    """Read the evaluations and times of the other seeds of a shipped policy."""
    cfg = run_config(folder)
    assert isinstance(cfg, LeggedConfig), "its own seed was read before"
    numbers = {int(match[1]): path for path in folder.iterdir() if (match := SEED_FOLDER.fullmatch(path.name))}
    return [EvaluatedRun(cfg, seed, path, read_timing(path), results_in(path)) for seed, path in sorted(numbers.items())]
