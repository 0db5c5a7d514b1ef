"""A training and what its policy was found to be worth, read from its run folder or from the folder of a shipped policy."""

import re
import sys
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from legged.config import LeggedConfig
from legged.errors import ConfigError
from legged.evaluation.engines import ENGINES
from legged.evaluation.result_file import changes_text, file_name, grid_text, read_results, tracking_of
from legged.evaluation.velocity_grid import axes_of
from legged.learning.run_folder import CONFIG_FILE, SHIPPED_MODEL, checkpoints, of_another_policy, run_config
from legged.learning.timing import Timing, read_timing
from legged.process.paths import relative

DEEPEST = 3
"""Folders inside each other in which runs are looked for: logs, tasks, runs."""
SEED_FOLDER = re.compile(r"seed_(\d+)", re.ASCII)
"""What the folders of other seeds are called beside a shipped policy."""


@dataclass(frozen=True)
class EvaluatedRun:
    """One training. Where it failed, there may be neither folder nor times nor results."""

    cfg: LeggedConfig
    seed: int
    folder: Path | None = None
    timing: Timing | None = None
    results: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Engine -> what `evaluate` has written, of the engines that we know."""
    failure: str = ""
    """Why there is no finished policy; empty where there is one."""
    notes: tuple[str, ...] = ()
    """What else went wrong."""


def read_run(folder: Path) -> EvaluatedRun:
    """Read a run folder, or that of a shipped policy. An evaluation of another checkpoint than the last says nothing of the
    policy that is in the table and is shipped, and one with changed fields is not comparable; they are left out, and a note
    says so. So it does of one on another grid of commands than the task's.

    Raises:
        ConfigError: it is none, its task follows no commands, or a file in it is damaged.
    """
    cfg = run_config(folder)
    if not isinstance(cfg, LeggedConfig):
        raise ConfigError(f"{relative(folder)}: '{cfg.task}' follows no commands; the table is of tasks that do")
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
        ConfigError: one of them is damaged, or of something else than commands.
    """
    found = {}
    for engine in ENGINES:
        path = folder / file_name(engine)
        if path.is_file():
            (found[engine],) = read_results([path])
            if "episodes" in found[engine]:
                raise ConfigError(f"{relative(path)}: is of episodes; the table is of tasks that follow commands")
    return found


def why_unfinished(folder: Path, cfg: LeggedConfig, timing: Timing | None) -> str:
    """Say why a folder holds no policy that was trained to the end; nothing if it does."""
    there = checkpoints(folder)
    if not there:
        return "it left no checkpoint"
    last, wanted = max(there) + 1, cfg.train.runner.max_iterations
    if there[last - 1].name == SHIPPED_MODEL or (last >= wanted if timing is None else timing.finished):
        return ""
    return f"stopped after {last} of {wanted} iterations"


def find_runs(paths: Iterable[Path]) -> list[EvaluatedRun]:
    """Read the runs in some folders: a run folder itself, what lies in logs/ or logs/<task>/, or the folder of a shipped
    policy with those of its other seeds; each once, however often it is named. Where others lie beside them, runs of tasks
    that follow no commands and runs of a configuration that this version can't read are left out, and said to be.

    Raises:
        ConfigError: a folder holds no run, none that the table is of, or something in one is damaged.
    """
    found: list[EvaluatedRun] = []
    seen: set[Path] = set()
    left_out: dict[str, list[str]] = {}
    for path in paths:
        folders = folders_in(path)
        reasons = {folder: why_not(folder) for folder in folders if folder != path}
        kept = [folder for folder in folders if not reasons.get(folder)] or folders[:1]  # if none is left, the first says why
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
    """Say why the table is not of a run; nothing if it may be."""
    try:
        cfg = run_config(folder)
    except ConfigError as error:
        return f"for its configuration can't be read ({' '.join(str(error).split())})"
    return "" if isinstance(cfg, LeggedConfig) else "for their tasks follow no commands"


def folders_in(path: Path) -> list[Path]:
    """Return the run folders in a folder: itself, or what lies in logs/ or logs/<task>/.

    Raises:
        ConfigError: there is none.
    """
    levels = [sorted(path.glob("/".join(["*"] * depth + [CONFIG_FILE]))) for depth in range(DEEPEST)]
    folders = [file.parent for level in levels for file in level]
    if not folders:
        raise ConfigError(f"{path}: holds no run folder (there is no {CONFIG_FILE} in it)")
    return folders


def _other_seeds(folder: Path) -> list[EvaluatedRun]:
    """Read what is kept of the other seeds of a shipped policy: evaluations and times."""
    cfg = run_config(folder)
    assert isinstance(cfg, LeggedConfig), "its own seed was read before"
    numbers = {int(match[1]): path for path in folder.iterdir() if (match := SEED_FOLDER.fullmatch(path.name))}
    return [EvaluatedRun(cfg, seed, path, read_timing(path), results_in(path)) for seed, path in sorted(numbers.items())]
