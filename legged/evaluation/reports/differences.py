"""In what configurations differ: a run's from its task file's, and those of several runs."""

from typing import Any

from legged.config import to_dict
from legged.config.dotted import MISSING, differences, flat
from legged.config.yaml_files import dump
from legged.errors import ConfigError
from legged.evaluation.reports.record import Record
from legged.registry import task_config

NAMES = ("train.runner.run_name", "train.runner.experiment_name", "train.runner.report", "train.runner.film", "task")
"""Settings that say nothing of how a policy comes to be."""
MOST_WORDS = 4
"""Settings that are named in a few words."""
LONGEST_VALUE = 60


def from_task_file(record: Record) -> dict[str, list[Any]] | None:
    """Return the settings in which a run differs from its task as it is now, each with both values; None where there is no
    such task any more. A run that does not say on which device it was made is compared with the settings that it is nearest
    to, those of a CPU or the others.
    """
    where = [record.timing.device == "cpu"] if record.timing else [False, True]
    found = []
    for on_cpu in where:
        try:
            found.append(differences([record.config, to_dict(task_config(record.task, on_cpu=on_cpu))]))
        except (ConfigError, OSError):
            return None
    return min(found, key=len)


def words(value: Any) -> str:
    """Return a value as it would stand in a YAML file, on one line; a dash for none."""
    if value is MISSING:
        return "-"
    text = dump(value, default_flow_style=True, width=1_000_000).strip().removesuffix("...").strip()
    return text if len(text) <= LONGEST_VALUE else text[: LONGEST_VALUE - 3] + "..."


def what_changed(record: Record, named: bool = True) -> str:
    """Say in a few words what a run is about: somebody's note, else its own name, where it is to be `named`, and what it sets
    otherwise than its task; where that task is not known here, what its command line set.
    """
    if record.note:
        return record.note
    found = from_task_file(record)
    if found is not None:
        changed = {path: own for path, (own, _) in found.items()}
    else:
        changed = dict(record.given.changes) if record.given is not None else {}
    said = [
        f"{'.'.join(path.split('.')[-2:])} {words(own)}" for path, own in changed.items() if path not in (*NAMES, "env.seed")
    ]
    if len(said) > MOST_WORDS:
        said = [*said[:MOST_WORDS], f"{len(said) - MOST_WORDS} more settings"]
    return ": ".join(text for text in (record.run_name if named else "", ", ".join(said)) if text)


def but_for_seeds(record: Record) -> str:
    """Return a text that is the same for all runs that differ in nothing but their seed and what they are called."""
    told = {path: value for path, value in flat(record.config).items() if path not in (*NAMES[:-1], "env.seed")}
    device = record.timing.device if record.timing else ""
    return repr((sorted(told.items()), record.note, record.status, record.done, record.code.summary, device))
