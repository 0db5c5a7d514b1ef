"""Shipped policies: a small checkpoint with its configuration, times, evaluations and stress tests."""

import io
import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import torch
from evaluated_run import SEED_FOLDER, EvaluatedRun

from legged.config.actuator import MOTORS
from legged.errors import ConfigError, RunError
from legged.evaluation.result_file import file_name, stress_name
from legged.learning.checkpoint import read_checkpoint
from legged.learning.run_folder import CONFIG_FILE, SHIPPED_MODEL, checkpoints, find_checkpoint, of_another_policy
from legged.learning.timing import TIMING_FILE
from legged.process.paths import make_folder, reason, relative, write_bytes

LARGEST = 700_000
"""Size limit of a file with the critic [bytes]; a larger file holds the actor alone."""
ACTOR = ("actor_state_dict", "iter", "infos")
BOTH = (*ACTOR, "critic_state_dict")
MEASURED = (MOTORS, TIMING_FILE, "evaluation_*", "stress_*", "crossing.*", "time_to_walk.json")
"""Files that describe one policy, and would be wrong next to another one."""
PICTURES = ("*.png", "*.gif", "*.mp4")


def ship(runs: Sequence[EvaluatedRun], folder: Path) -> list[str]:
    """Write `folder`/<task>/ for each task, and return a line on each.

    The policy comes from the lowest seed that has finished. If a seed has several runs, the last one counts. The times,
    evaluations and stress tests of other seeds are put into seed_<number>/. Files of an earlier shipment are removed.

    Raises:
        ConfigError: a checkpoint or a stress test can't be read, or a run is already in the folder of its task.
        RunError: a file can't be written.
    """
    by_task: dict[str, dict[int, tuple[Path, list[str]]]] = {}
    for run in runs:
        if run.folder is not None and not run.failure:
            _check_elsewhere(run.folder, folder / run.cfg.task)
            results = [TIMING_FILE, *map(file_name, run.results)]
            by_task.setdefault(run.cfg.task, {})[run.seed] = run.folder, results
    lines = []
    for task, seeds in by_task.items():
        first = min((seed for seed, (source, _) in seeds.items() if checkpoints(source)), default=None)
        if first is None:
            continue
        model = _small(find_checkpoint(seeds[first][0], None))
        files = {seed: [*results, *_stress_tests(source)] for seed, (source, results) in sorted(seeds.items())}
        place = folder / task
        make_folder(place)
        _remove_shipment(place)
        write_bytes(place / SHIPPED_MODEL, model)
        _copy(seeds[first][0], place, [CONFIG_FILE, MOTORS, *files.pop(first)])
        for seed, names in files.items():
            _copy(seeds[seed][0], place / f"seed_{seed}", names)
        more = "".join(f", evaluations of seed {seed}" for seed in files)
        lines.append(f"{relative(place)}: policy of seed {first}, {len(model) / 1e6:.2f} MB{more}")
        pictures = sorted(path.name for pattern in PICTURES for path in place.glob(pattern))
        if pictures:
            lines.append(f"{relative(place)}: pictures show the earlier policy; draw them again: {', '.join(pictures)}")
    return lines


def _check_elsewhere(run: Path, place: Path) -> None:
    """Raise a ConfigError if a run is in the folder that it would be shipped to."""
    source, place = run.resolve(), place.resolve()
    if source == place or (source.parent == place and SEED_FOLDER.fullmatch(source.name)):
        raise ConfigError(f"--ship: {relative(run)} is in that folder already; name another folder, or other runs")


def _small(checkpoint: Path) -> memoryview:
    """Return a checkpoint's file without the state of the optimiser. If the file is too large, the critic is left out too.

    Raises:
        ConfigError: the checkpoint can't be read.
    """
    saved = read_checkpoint(checkpoint)
    for parts in (BOTH, ACTOR):
        buffer = io.BytesIO()
        torch.save({part: saved[part] for part in parts if part in saved}, buffer)
        if buffer.tell() <= LARGEST:
            break
    return buffer.getbuffer()


def _remove_shipment(folder: Path) -> None:
    """Remove the files that describe an earlier policy.

    Raises:
        RunError: a file can't be removed.
    """
    seeds = [path for path in folder.iterdir() if SEED_FOLDER.fullmatch(path.name) and path.is_dir()]
    try:
        for path in [path for place in (folder, *seeds) for pattern in MEASURED for path in place.glob(pattern)]:
            path.unlink()
        for seed in seeds:
            if not any(seed.iterdir()):
                seed.rmdir()
    except OSError as error:
        raise RunError(f"{relative(folder)}: {reason(error)}") from error


def _stress_tests(run: Path) -> list[str]:
    """Return the names of the stress tests of a run's last policy.

    Raises:
        ConfigError: a stress test is damaged.
    """
    found = []
    for path in sorted(run.glob(stress_name("*"))):
        try:
            checkpoint = json.loads(path.read_text(encoding="utf-8"))["checkpoint"]
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            raise ConfigError(f"{relative(path)}: is not the result of a stress test ({error})") from error
        if not of_another_policy(run, checkpoint):
            found.append(path.name)
    return found


def _copy(run: Path, folder: Path, names: Sequence[str]) -> None:
    """Copy those of the named files that a run has."""
    make_folder(folder)
    for name in names:
        if (run / name).is_file():
            try:
                shutil.copyfile(run / name, folder / name)
            except OSError as error:
                raise RunError(f"{relative(folder / name)}: {reason(error)}") from error
