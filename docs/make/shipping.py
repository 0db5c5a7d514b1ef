"""Shipped policies: a small checkpoint with its configuration, times, evaluations and stress tests."""

import io
import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import torch

from legged.config.actuator import MOTORS
from legged.errors import ConfigError
from legged.evaluation.reports.record import Record
from legged.evaluation.result_file import file_name, stress_name
from legged.learning.checkpoint import read_checkpoint
from legged.learning.run_folder import CONFIG_FILE, SHIPPED_MODEL, find_checkpoint
from legged.learning.timing import TIMING_FILE
from legged.process.paths import make_folder, relative, write_bytes

LARGEST = 700_000
"""Size limit of a shipped checkpoint [bytes]. If needed, the critic is left out, and then weights are stored in float16."""
FEW = 4096
"""Parameters with at most this many numbers keep float32."""
ACTOR = ("actor_state_dict", "iter", "infos")
BOTH = (*ACTOR, "critic_state_dict")
MEASURED = (MOTORS, TIMING_FILE, "evaluation_*", "stress_*", "league_*", "crossing.*", "time_to_walk.json")
"""Files that describe one policy, and would be wrong next to another one."""
PICTURES = ("*.png", "*.gif", "*.mp4")


def ship(runs: Sequence[Record], folder: Path) -> list[str]:
    """Write `folder`/<task>/ for each task, and return a line on each.

    The policy comes from the lowest seed. If a seed has several runs, the last one counts. The times, evaluations and stress
    tests of other seeds are put into seed_<number>/. Files of an earlier shipment are removed.

    Raises:
        ConfigError: a checkpoint or a stress test can't be read, or a run is in the folder of its task already.
        RunError: a file can't be written.
    """
    tasks: dict[str, dict[int, Record]] = {}
    for run in runs:
        if run.folder.resolve() == (folder / run.task).resolve():
            raise ConfigError(f"--ship: {relative(run.folder)} is in that folder already; name another folder, or other runs")
        tasks.setdefault(run.task, {})[run.at("env.seed")] = run
    lines = []
    for task, by_seed in tasks.items():
        seed, *others = sorted(by_seed)
        place, first = folder / task, by_seed[seed]
        model = _small(find_checkpoint(first.folder, None))
        files = {place / name: first.folder / name for name in (CONFIG_FILE, MOTORS, *_measured(first))}
        for other in others:
            run = by_seed[other]
            files |= {place / f"seed_{other}" / name: run.folder / name for name in _measured(run)}
        make_folder(place)
        _remove_shipment(place)
        write_bytes(place / SHIPPED_MODEL, model)
        for target, source in files.items():
            if source.is_file():
                make_folder(target.parent)
                shutil.copyfile(source, target)
        more = "".join(f", evaluations of seed {other}" for other in others)
        lines.append(f"{relative(place)}: policy of seed {seed}, {len(model) / 1e6:.2f} MB{more}")
        pictures = sorted(path.name for pattern in PICTURES for path in place.glob(pattern))
        if pictures:
            lines.append(f"{relative(place)}: pictures show the earlier policy; draw them again: {', '.join(pictures)}")
    return lines


def _small(checkpoint: Path) -> memoryview:
    """Return a checkpoint's file without the state of the optimiser, made smaller as `LARGEST` says. Files that the training
    began with are named without their folders.

    Raises:
        ConfigError: the checkpoint can't be read.
    """
    saved = read_checkpoint(checkpoint)
    for source in (saved["infos"][key] for key in ("teacher", "transferred_from") if key in saved["infos"]):
        source["file"] = Path(source["file"]).name
    actor = saved["actor_state_dict"]
    large = {name for name, value in actor.items() if value.is_floating_point() and value.numel() > FEW}
    small = {name: value.half() if name in large else value for name, value in actor.items()}
    for parts, weights in ((BOTH, actor), (ACTOR, actor), (ACTOR, small)):
        buffer = io.BytesIO()
        torch.save({**{part: saved[part] for part in parts if part in saved}, "actor_state_dict": weights}, buffer)
        if buffer.tell() <= LARGEST:
            break
    return buffer.getbuffer()


def _measured(run: Record) -> list[str]:
    """Return the names of the files with the times, the evaluations, the stress tests and the league's runs of a run's last
    policy.

    Raises:
        ConfigError: a stress test or a file of the league is damaged.
    """
    names = [TIMING_FILE, *map(file_name, run.results)]
    for path in sorted([*run.folder.glob(stress_name("*")), *run.folder.glob("league_*.json")]):
        try:
            other = run.another_policy(json.loads(path.read_text(encoding="utf-8")))
        except (ValueError, AttributeError) as error:
            raise ConfigError(f"{relative(path)}: is not the result of an evaluation ({error})") from error
        names += [] if other else [path.name]
    return names


def _remove_shipment(folder: Path) -> None:
    """Remove the files that describe an earlier policy, and folders of seeds that are then empty."""
    seeds = [path for path in folder.glob("seed_*") if path.is_dir()]
    for path in [path for place in (folder, *seeds) for pattern in MEASURED for path in place.glob(pattern)]:
        path.unlink()
    for seed in seeds:
        if not any(seed.iterdir()):
            seed.rmdir()
