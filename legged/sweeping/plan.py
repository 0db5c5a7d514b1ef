"""The YAML file of a sweep, checked against the task's configuration before a training begins."""

import json
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

from legged.config import TaskConfig, override, to_dict
from legged.config.bounds import FLOAT32_MAX, NAME, between, items
from legged.config.checks import PLAIN, build, is_plain_name, shown
from legged.config.dotted import value_at
from legged.config.yaml_files import read_yaml
from legged.envs.checks import evaluated_figures, lower_is_better
from legged.errors import ConfigError, suggest
from legged.process.paths import data_folder, exists, relative
from legged.registry import YAML_ENDINGS, register_file, task_class, task_config, task_names

OWN = ("task", "env.seed", "train.runner.run_name", "train.runner.experiment_name", "train.runner.stop_at")
"""Settings that the file of a sweep must not contain, because the sweep sets them."""
EVALUATIONS = 10
"""Default number of evaluations of a trial."""
NUMBER = between(-FLOAT32_MAX, FLOAT32_MAX)


@dataclass(frozen=True)
class ParameterConfig:
    """Values that are tried for a setting: a range or a list of choices."""

    low: float | None = field(default=None, metadata=NUMBER)
    """Least value."""
    high: float | None = field(default=None, metadata=NUMBER)
    """Greatest value."""
    log: bool = False
    """Sample uniformly on a logarithmic scale."""
    choices: tuple[Any, ...] = field(default=(), metadata=items(1000, {"may_be_empty": True, "unique": True}))
    """Values to try, in place of a range."""


@dataclass(frozen=True)
class ObjectiveConfig:
    """The objective of a sweep."""

    figure: str = ""
    """Name of a figure that evaluations during training measure; empty for the most important figure."""
    take: Literal["last", "best", "time", "steps"] = "last"
    """Value of a trial: the last or best value of the figure, or the cost of reaching `target`. The cost is the training
    time [s] or the number of steps of all robots."""
    target: float | None = field(default=None, metadata=NUMBER)
    """Value of the figure at which a trial ends."""


@dataclass(frozen=True)
class SweepConfig:
    """The file of a sweep."""

    task: str = ""
    """Task to train: a name, or a YAML file with a path relative to the sweep's file."""
    name: str = field(default="", metadata=NAME)
    """Folder under logs/; by default sweep_ followed by the name of the sweep's file."""
    trials: int = field(default=20, metadata=between(1, 1_000_000))
    """Number of trials of all processes together."""
    seeds: tuple[int, ...] = field(default=(1,), metadata=items(100, {**between(0, 2**62), "unique": True}))
    """Seeds of each trial. The value of a trial is the mean over its seeds."""
    objective: ObjectiveConfig = ObjectiveConfig()
    """The objective."""
    pruner: Literal["median", "hyperband", "none"] = "median"
    """Rule for early ends of trials: `median` of earlier trials, `hyperband` (repeated successive halving), or `none`."""
    startup_trials: int = field(default=10, metadata=between(1, 1_000_000))
    """Number of random trials before earlier results guide the search."""
    seed: int = field(default=1, metadata=between(0, 2**31 - 1))
    """Seed of the search."""
    storage: str = ""
    """Storage of the trials: a URL of a database, or journal:<file>; by default sweep.db in the sweep's folder."""
    overrides: dict[str, Any] = field(default_factory=dict)
    """Dotted path -> value, for all trials."""
    parameters: dict[str, ParameterConfig] = field(default_factory=dict)
    """Dotted path -> values to try."""


@dataclass(frozen=True)
class Parameter:
    """A swept setting."""

    path: str
    distribution: Any
    """Optuna's distribution: of whole numbers, of real numbers, or of choices as JSON texts."""

    def value(self, drawn: Any) -> Any:
        """Return the setting's value for `drawn`, the number or text that Optuna sampled. Real numbers get four digits."""
        if isinstance(drawn, str):
            return json.loads(drawn)
        if isinstance(drawn, int):
            return drawn
        return min(max(float(f"{drawn:.4g}"), self.distribution.low), self.distribution.high)

    def drawn(self, value: Any) -> Any:
        """Return the number or text that Optuna samples for this value of the setting; None if the sweep cannot sample it."""
        if hasattr(self.distribution, "choices"):
            return next((text for text in self.distribution.choices if json.loads(text) == value), None)
        if isinstance(value, bool) or not isinstance(value, int | float):
            return None
        return value if self.distribution.low <= value <= self.distribution.high and self.value(value) == value else None


@dataclass(frozen=True)
class Plan:
    """A checked sweep."""

    name: str
    given: SweepConfig
    cfg: TaskConfig
    """Common configuration of all trials."""
    figure: str
    parameters: tuple[Parameter, ...]
    task: str
    """TASK of `legged train`: a name, or a YAML file."""

    @property
    def own(self) -> dict[str, Any]:
        """Dotted path of each swept setting -> the task's own value."""
        task = to_dict(self.cfg)
        return {one.path: value_at(task, one.path) for one in self.parameters}

    @property
    def own_drawn(self) -> dict[str, Any]:
        """Dotted path of each swept setting -> `Parameter.drawn` of the task's own value."""
        own = self.own
        return {one.path: one.drawn(own[one.path]) for one in self.parameters}

    def settings(self, drawn: Mapping[str, Any]) -> dict[str, Any]:
        """Return the swept settings of a trial, dotted path -> value. `drawn` maps dotted paths to what Optuna sampled."""
        return {one.path: one.value(drawn[one.path]) for one in self.parameters if one.path in drawn}

    @property
    def folder(self) -> Path:
        """Folder of the sweep's files and of the run folders of its trials."""
        return Path("logs") / self.name

    @property
    def until_target(self) -> bool:
        """True if the value of a trial is the time or the number of steps to its target."""
        return self.given.objective.take in ("time", "steps")

    @property
    def minimize(self) -> bool:
        """True if smaller values are better."""
        return self.until_target or lower_is_better(self.figure)

    @property
    def negated(self) -> bool:
        """True if figures are reported to Optuna with the opposite sign. This is so if Optuna minimises the time or the
        steps to a target, but a larger figure is better.
        """
        return self.until_target and not lower_is_better(self.figure)

    @property
    def objective_text(self) -> str:
        """Objective as text, with its unit."""
        objective = self.given.objective
        units = {"lin_vel_rmse": " [m/s]", "ang_vel_rmse": " [rad/s]"}
        if self.until_target:
            what = "time in iterations [s]" if objective.take == "time" else "steps of all robots"
            return f"{what} until {self.figure} reaches {objective.target:g}"
        return f"{objective.take} {self.figure}{units.get(self.figure, '')}"

    @property
    def identity(self) -> str:
        """Text of all parts of the sweep that must stay the same, so that trials can be compared."""
        given = to_dict(self.given)
        return json.dumps(
            {name: given[name] for name in ("task", "seeds", "objective", "overrides", "parameters")}, sort_keys=True
        )

    def arguments(self, values: Mapping[str, Any], number: int, seed: int) -> list[str]:
        """Return the arguments of `legged train` for trial `number`. They switch on evaluations, to compare the trials.
        They switch off report and film, which often take longer than a trial; `legged runs report` can make them later.
        """
        runner, target = self.cfg.train.runner, self.given.objective.target
        settings = {
            "train.runner.report": False,
            "train.runner.film": False,
            "train.runner.evaluate_interval": runner.evaluate_interval,
            "train.runner.evaluate_share": runner.evaluate_share,
            **self.given.overrides,
            **values,
            **({} if target is None else {f"train.runner.stop_at.{self.figure}": target}),
        }
        flags = [self.task, "--seed", str(seed), "--experiment-name", self.name]
        flags += ["--run-name", f"trial{number:03d}_s{seed}", "--note", self.note(values, number)]
        return [*flags, *(f"{path}={json.dumps(value)}" for path, value in settings.items())]

    def note(self, values: Mapping[str, Any], number: int) -> str:
        """Return the note for the runs of a trial: the values of its settings."""
        drawn = [f"{'.'.join(path.split('.')[-2:])} {json.dumps(value)}" for path, value in values.items()]
        return f"trial {number} of {self.name}: {', '.join(drawn)}"


def sweep_file(text: str) -> Path:
    """Return the file of a sweep. `text` is its path, or the name of a sweep in cfg/sweeps of this package.

    Raises:
        ConfigError: there is no such file.
    """
    folder = data_folder("cfg") / "sweeps"
    for path in (Path(text), folder / f"{text}.yaml"):
        if exists(path) and path.is_file():
            return path
    names = [path.stem for path in folder.glob("*.yaml")]
    raise ConfigError(f"sweep: there is no file {shown(text)}{suggest(text[:100], names, 'sweeps')}")


def plan_sweep(path: Path, on_cpu: bool, trials: int | None = None) -> Plan:
    """Read the file of a sweep, check it against its task, and return the plan. `trials`, if given, replaces the number of
    trials in the file.

    Raises:
        ConfigError: Optuna is missing, a setting is unknown, a value is out of bounds, or the objective is not measured.
    """
    if find_spec("optuna") is None:
        raise ConfigError("sweep: the package optuna is not installed; run `pip install optuna`")
    given = build(SweepConfig, read_yaml(path), str(path))
    given = given if trials is None else replace(given, trials=trials)
    name = given.name or f"sweep_{path.stem}"
    if not is_plain_name(name):
        raise ConfigError(f"{path}: name: expected {PLAIN}; got {shown(name)}")
    if not given.task:
        raise ConfigError(f"{path}: task: is missing; name the task to train{suggest('', task_names(), 'tasks')}")
    if not given.parameters:
        raise ConfigError(f"{path}: parameters: is empty; name at least one setting and the values to try")
    for section in ("overrides", "parameters"):
        for key in getattr(given, section):
            if key in OWN or key.startswith(f"{OWN[-1]}."):
                raise ConfigError(f"{path}: {section}: {key}: leave it out; the sweep sets it from seeds, name or objective")
    named = relative(path.parent / given.task) if given.task.endswith(YAML_ENDINGS) else given.task
    task = register_file(named, f"{path}: task") if named.endswith(YAML_ENDINGS) else named
    with _said_in(path, "overrides"):
        cfg = task_config(task, given.overrides.items(), on_cpu)
    runner = cfg.train.runner
    changes: list[tuple[str, Any]] = []
    if not runner.evaluate_interval:
        changes.append(("train.runner.evaluate_interval", max(1, runner.max_iterations // EVALUATIONS)))
    if "train.runner.evaluate_share" not in given.overrides:
        # Trials are compared at equal iterations, so no evaluation may be skipped to save time.
        changes.append(("train.runner.evaluate_share", 1.0))
    cfg = override(cfg, changes)
    parameters = tuple(_parameter(key, one, cfg, path) for key, one in given.parameters.items())
    figures, objective = evaluated_figures(task_class(task), cfg), given.objective
    figure = objective.figure or figures[0]
    if figure not in figures:
        known = suggest(figure, figures, "they measure")
        raise ConfigError(f"{path}: objective.figure: evaluations of '{cfg.task}' do not measure {shown(figure)}{known}")
    if objective.take in ("time", "steps") and objective.target is None:
        raise ConfigError(f"{path}: objective.target: is missing; give the value of {figure} at which trials end")
    return Plan(name, given, cfg, figure, parameters, named)


def _parameter(key: str, one: ParameterConfig, cfg: TaskConfig, path: Path) -> Parameter:
    """Return the swept setting. Both ends of its range, or all its choices, must be valid values."""
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    where = f"{path}: parameters: {key}"
    if one.choices:
        if one.low is not None or one.high is not None or one.log:
            raise ConfigError(f"{where}: give either choices, or low and high with an optional log")
        _try(key, one.choices, cfg, path)
        return Parameter(key, CategoricalDistribution([json.dumps(value) for value in one.choices]))
    if one.low is None or one.high is None:
        raise ConfigError(f"{where}: expected low and high of a range, or choices")
    if not one.low < one.high:
        raise ConfigError(f"{where}: low must be below high, got {one.low:g} and {one.high:g}")
    if one.log and one.low <= 0.0:
        raise ConfigError(f"{where}: with log, low must be above 0, got {one.low:g}")
    own = value_at(to_dict(cfg), key)
    if isinstance(own, bool) or not isinstance(own, int):
        _try(key, (one.low, one.high), cfg, path)
        return Parameter(key, FloatDistribution(one.low, one.high, log=one.log))
    low, high = int(one.low), int(one.high)
    if (low, high) != (one.low, one.high):
        raise ConfigError(f"{where}: expected whole numbers for low and high, got {one.low:g} and {one.high:g}")
    _try(key, (low, high), cfg, path)
    return Parameter(key, IntDistribution(low, high, log=one.log))


def _try(key: str, values: Iterable[Any], cfg: TaskConfig, path: Path) -> None:
    with _said_in(path, "parameters"):
        for value in values:
            task_class(cfg.task).check(override(cfg, [(key, value)]))


@contextmanager
def _said_in(path: Path, section: str) -> Iterator[None]:
    """In errors that the block raises, replace 'command line' or 'TASK' by the sweep's file and section."""
    try:
        yield
    except ConfigError as error:
        for said, key in (("command line: ", section), ("TASK: ", "task")):
            if str(error).startswith(said):
                raise ConfigError(f"{path}: {key}: {str(error).removeprefix(said)}") from error
        raise
