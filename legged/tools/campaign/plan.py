"""What a campaign consists of: trainings of tasks and seeds, and evaluations of each; what of it is done already."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from legged.config import LeggedConfig, override, parse_override
from legged.errors import ConfigError, suggest
from legged.evaluation.engines import ENGINES
from legged.evaluation.evaluated_run import EvaluatedRun, results_in, why_unfinished
from legged.evaluation.result_file import tracking_of
from legged.evaluation.success import chosen_sizes
from legged.evaluation.velocity_grid import axes_of
from legged.learning.run_folder import CONFIG_FILE, checkpoints, experiment_folder, find_checkpoint, run_config
from legged.learning.timing import read_timing
from legged.registry import task_config

NEWTON = "newton_"
"""How the names of Newton's solvers begin among the engines."""


@dataclass(frozen=True)
class Order:
    """What the command line asks of each task."""

    overrides: tuple[str, ...] = ()
    """`key=value`, of the trainings."""
    module: str | None = None
    """Module that registers tasks, or a file of one, or a YAML file that is one."""
    sim_device: str | None = None
    on_cpu: bool = False
    """Whether tasks take the settings of their `cpu:` section."""
    engines: tuple[str, ...] = ("mujoco_warp", "mujoco")
    robots: int = 16
    """Robots a cell of the command grid."""
    types: str | None = None
    """Terrain types to cross, with commas between them; those of the training if nothing is said."""
    full: bool = False
    robots_per_point: int = 32
    threads: int = 0
    """Of the C engine in an evaluation; 0 takes all cores."""


@dataclass(eq=False)
class Training:
    """A task with a seed: wanted, and what has come of it."""

    given: str
    """The task as it was named: its own name, or a file."""
    seed: int
    cfg: LeggedConfig
    folder: Path | None = None
    """Its run folder, once it has finished."""
    failure: str = ""
    notes: list[str] = field(default_factory=list)

    @property
    def label(self) -> str:
        """Its name in lines that are printed."""
        return f"{self.cfg.task}, seed {self.seed}"

    @property
    def stem(self) -> str:
        """The beginning of the names of its files."""
        return f"{self.cfg.task}_s{self.seed}"

    @property
    def rough(self) -> bool:
        """Whether there is success on terrain to be measured."""
        return self.cfg.terrain.mesh_type != "plane"

    def judged(self, order: Order) -> EvaluatedRun:
        """Return what is known of it, as far as it was judged as `order` asks."""
        if self.folder is None:
            return EvaluatedRun(self.cfg, self.seed, failure=self.failure or "not trained yet", notes=tuple(self.notes))
        left = missing_engines(self, order)
        results = {name: result for name, result in results_in(self.folder).items() if name in {*order.engines} - {*left}}
        return EvaluatedRun(self.cfg, self.seed, self.folder, read_timing(self.folder), results, notes=tuple(self.notes))


def trainings_of(tasks: Sequence[tuple[str, str]], seeds: Sequence[int], order: Order) -> list[Training]:
    """Return what is to be trained: the first seed of all `tasks` (as given, and the name), then the second, so that
    there is a table of all of them early.

    Raises:
        ConfigError: a task is none or follows no commands, or an override does not fit it.
    """
    configs = [(given, _config(task, order)) for given, task in tasks]
    return [Training(given, seed, _seeded(cfg, seed)) for seed in seeds for given, cfg in configs]


def _config(task: str, order: Order) -> LeggedConfig:
    cfg = task_config(task, map(parse_override, order.overrides), order.on_cpu)
    if not isinstance(cfg, LeggedConfig):
        raise ConfigError(f"'{task}' follows no commands; a table of RMSE and falls is of tasks that do")
    axes_of(cfg)
    if cfg.terrain.mesh_type != "plane":
        chosen_sizes(cfg, order.types, order.full, cfg.terrain.scale)
    return cfg


def _seeded(cfg: LeggedConfig, seed: int) -> LeggedConfig:
    return override(cfg, [("env.seed", seed), ("train.runner.run_name", f"s{seed}")])  # type: ignore[return-value]


def finished_run(cfg: LeggedConfig) -> Path | None:
    """Return the newest run that was trained to its end with just this configuration; how policies are judged and shown may
    differ.
    """
    found = []
    for path in experiment_folder(cfg).glob(f"*_{cfg.train.runner.run_name}*/{CONFIG_FILE}"):
        folder = path.parent
        try:
            trained = run_config(folder)
            same = isinstance(trained, LeggedConfig) and _shown_as(cfg, trained) == cfg
            if same and not why_unfinished(folder, cfg, read_timing(folder)):
                found.append(folder)
        except ConfigError:  # of another version of the task, or damaged
            continue
    return max(found, key=lambda folder: max(file.stat().st_mtime for file in checkpoints(folder).values()), default=None)


def _shown_as(cfg: LeggedConfig, trained: LeggedConfig) -> LeggedConfig:
    """Return the configuration of a training, judged and shown as `cfg` says."""
    runner = replace(trained.train.runner, film=cfg.train.runner.film, report=cfg.train.runner.report)
    return replace(trained, evaluation=cfg.evaluation, train=replace(trained.train, runner=runner))


# ---- commands --------------------------------------------------------------------------------------------------------


def training_command(training: Training, order: Order) -> list[str]:
    """Return the command that trains."""
    name = ["--seed", str(training.seed), "--run_name", f"s{training.seed}"]
    return [*_program("train", training, order), *name, *_device(order), *order.overrides]


def evaluation_command(training: Training, engine: str, order: Order) -> list[str]:
    """Return the command that judges the policy of a finished training in an engine, as `ENGINES` names it."""
    assert training.folder is not None, "the training comes first"
    flags = ["--load_run", str(training.folder.resolve()), "--robots", str(order.robots)]
    flags += (
        ["--physics", "newton", "--solver", engine[len(NEWTON) :]] if engine.startswith(NEWTON) else ["--physics", engine]
    )
    if training.rough:
        flags += ["--robots-per-point", str(order.robots_per_point)]
        flags += [*(["--types", order.types] if order.types else []), *(["--full"] if order.full else [])]
    flags += [] if engine == "mujoco" else _device(order)
    threads = [f"sim.threads={order.threads}"] if order.threads and not training.cfg.sim.threads else []
    judged = [f"evaluation.{axis}={list(values)}" for axis, values in _changed_axes(training).items()]
    return [*_program("evaluate", training, order), *flags, *threads, *judged]


def _program(tool: str, training: Training, order: Order) -> list[str]:
    module = ["--import", order.module] if order.module else []
    return [sys.executable, "-m", f"legged.tools.{tool}", "--task", training.given, *module]


def _device(order: Order) -> list[str]:
    return ["--sim_device", order.sim_device] if order.sim_device else []


def _changed_axes(training: Training) -> dict[str, Sequence[float]]:
    """Return the axes of the grid that differ from those which the run was trained with."""
    assert training.folder is not None, "the training comes first"
    trained = run_config(training.folder)
    assert isinstance(trained, LeggedConfig), "it was found by its configuration"
    wanted = training.cfg.evaluation
    return {
        axis: getattr(wanted, axis)
        for axis in ("vx", "vy", "yaw")
        if getattr(wanted, axis) != getattr(trained.evaluation, axis)
    }


def missing_engines(training: Training, order: Order) -> list[str]:
    """Return the engines in which the policy of a finished training has not been judged as the order asks."""
    assert training.folder is not None, "the training comes first"
    results = results_in(training.folder)
    return [name for name in order.engines if not is_measured(results.get(name), training, order)]


def is_measured(result: dict[str, Any] | None, training: Training, order: Order) -> bool:
    """Say whether an evaluation is of the last checkpoint, on the grid and the terrain that are asked for, and with no field
    changed.
    """
    assert training.folder is not None, "the training comes first"
    if result is None or result.get("changes") or result.get("checkpoint") != find_checkpoint(training.folder, None).name:
        return False
    tracking = tracking_of(result)
    if tracking.get("grid") != axes_of(training.cfg) or tracking.get("robots_per_cell") != order.robots:
        return False
    if not training.rough:
        return True
    cfg = training.cfg
    wanted = chosen_sizes(cfg, order.types, order.full, cfg.terrain.scale)
    success = result.get("success", {"types": {}})
    found = {name: {point["size"] for point in entry["points"]} for name, entry in success["types"].items()}
    there = all({*sizes} <= found.get(name, set()) for name, sizes in wanted.items())
    return there and success.get("robots_per_point") == order.robots_per_point


def known_engines(text: str) -> tuple[str, ...]:
    """Read the engines of a list with commas.

    Raises:
        ConfigError: one is none.
    """
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",")))
    for name in names:
        if name not in ENGINES:
            raise ConfigError(f"--engines: there is no engine '{name}'{suggest(name, ENGINES)}")
    return names


def seeds_in(text: str) -> list[int]:
    """Read '1,2,3' as [1, 2, 3].

    Raises:
        ConfigError: not a list of different whole numbers.
    """
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isdecimal() for part in parts):
        raise ConfigError(f"--seeds: '{text}' is not a list of whole numbers, like 1,2,3")
    numbers = [int(part) for part in parts]
    if len({*numbers}) < len(numbers):
        raise ConfigError(f"--seeds: '{text}' names one twice; each may come once")
    return numbers
