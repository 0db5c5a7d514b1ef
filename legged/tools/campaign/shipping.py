"""A policy as it comes with the package: small, with its configuration, its times, its evaluations and its stress tests."""

import io
import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import torch

from legged.config.actuator import MOTORS
from legged.errors import ConfigError, RunError
from legged.evaluation.evaluated_run import SEED_FOLDER, EvaluatedRun
from legged.evaluation.result_file import file_name, stress_name
from legged.learning.checkpoint import read_checkpoint
from legged.learning.run_folder import CONFIG_FILE, SHIPPED_MODEL, checkpoints, find_checkpoint, of_another_policy
from legged.learning.timing import TIMING_FILE
from legged.process.paths import make_folder, reason, relative, write_bytes

LARGEST = 700_000
"""A file with the critic, at most [bytes]: a larger one holds the actor alone, which is enough to act."""
ACTOR = ("actor_state_dict", "iter", "infos")
BOTH = ("actor_state_dict", "critic_state_dict", "iter", "infos")
JUDGED = ("evaluation_*", "stress_*", "crossing.*", "time_to_walk.json")
"""Files that say what a policy was found to be worth."""
PICTURES = ("*.png", "*.gif", "*.mp4")


def ship(runs: Sequence[EvaluatedRun], folder: Path) -> list[str]:
    """Write `folder`/<task>/ for each task: the policy of the lowest seed that has finished, with configuration, times,
    evaluations and stress tests, and in seed_<number>/ times, evaluations and stress tests of the others. Of several runs of
    a seed the last counts. What an earlier shipment has left of these goes. Return a line on each.

    Raises:
        ConfigError: a checkpoint or a stress test can't be read, or a run lies where it would be shipped to.
        RunError: a file can't be written.
    """
    finished = [run for run in runs if run.folder is not None and not run.failure]
    _check_elsewhere(finished, folder)
    lines = []
    for task in dict.fromkeys(run.cfg.task for run in finished):
        by_seed = {run.seed: run for run in finished if run.cfg.task == task}
        seeds = [by_seed[seed] for seed in sorted(by_seed)]
        first = next((run for run in seeds if run.folder is not None and checkpoints(run.folder)), None)
        if first is None or first.folder is None:
            continue
        others = [run for run in seeds if run is not first]
        model = _small(find_checkpoint(first.folder, None))
        files = {run.seed: _judged(run) for run in seeds}  # before what is there goes
        make_folder(folder / task)
        _remove_shipment(folder / task)
        write_bytes(folder / task / SHIPPED_MODEL, model)
        _copy(first, folder / task, (CONFIG_FILE, MOTORS, *files[first.seed]))
        for other in others:
            _copy(other, folder / task / f"seed_{other.seed}", files[other.seed])
        more = "".join(f", evaluations of seed {other.seed}" for other in others)
        lines.append(f"{relative(folder / task)}: policy of seed {first.seed}, {len(model) / 1e6:.2f} MB{more}")
        pictures = sorted(path.name for pattern in PICTURES for path in (folder / task).glob(pattern))
        if pictures:  # which may be linked to from pages, and are drawn by other commands
            lines.append(f"{relative(folder / task)}: draw anew what shows the policy before: {', '.join(pictures)}")
    return lines


def _check_elsewhere(runs: Sequence[EvaluatedRun], folder: Path) -> None:
    """Look whether all runs lie elsewhere than the policies that are made of them.

    Raises:
        ConfigError: one of them is itself shipped there.
    """
    for run in runs:
        assert run.folder is not None, "those without one were left out"
        source, place = run.folder.resolve(), (folder / run.cfg.task).resolve()
        if source == place or (source.parent == place and SEED_FOLDER.fullmatch(source.name)):
            raise ConfigError(f"--ship: {relative(run.folder)} is shipped there already; name another folder, or other runs")


def _small(checkpoint: Path) -> memoryview:
    """Return a checkpoint's file without what only a resumed training needs, and without the critic if it is large.

    Raises:
        ConfigError: it can't be read.
    """
    saved = read_checkpoint(checkpoint)
    for parts in (BOTH, ACTOR):
        buffer = io.BytesIO()
        torch.save({part: saved[part] for part in parts if part in saved}, buffer)
        if buffer.tell() <= LARGEST:
            break
    return buffer.getbuffer()


def _remove_shipment(folder: Path) -> None:
    """Remove what an earlier policy was found to be worth: with the new one it would be read as if it were of that.

    Raises:
        RunError: a file can't be removed.
    """
    seeds = [path for path in folder.iterdir() if SEED_FOLDER.fullmatch(path.name) and path.is_dir()]
    try:
        (folder / MOTORS).unlink(missing_ok=True)
        for place in (folder, *seeds):
            for path in [place / TIMING_FILE, *(path for pattern in JUDGED for path in place.glob(pattern))]:
                path.unlink(missing_ok=True)
        for seed in seeds:
            if not any(seed.iterdir()):  # what else lies there is not ours
                seed.rmdir()
    except OSError as error:
        raise RunError(f"{relative(folder)}: {reason(error)}") from error


def _judged(run: EvaluatedRun) -> tuple[str, ...]:
    """Return the names of the files that say what a run came to: times, evaluations, and stress tests of its last policy.

    Raises:
        ConfigError: a stress test is damaged.
    """
    assert run.folder is not None, "those without one were left out"
    found = [TIMING_FILE, *map(file_name, run.results)]
    for path in sorted(run.folder.glob(stress_name("*"))):
        try:
            checkpoint = json.loads(path.read_text(encoding="utf-8"))["checkpoint"]
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            raise ConfigError(f"{relative(path)}: is not the result of a stress test ({error})") from error
        if not of_another_policy(run.folder, checkpoint):
            found.append(path.name)
    return tuple(found)


def _copy(run: EvaluatedRun, folder: Path, names: Sequence[str]) -> None:
    """Copy the files of those names that a run has."""
    assert run.folder is not None, "those without one were left out"
    make_folder(folder)
    for name in names:
        if (run.folder / name).is_file():
            try:
                shutil.copyfile(run.folder / name, folder / name)
            except OSError as error:
                raise RunError(f"{relative(folder / name)}: {reason(error)}") from error
