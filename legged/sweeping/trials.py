"""The trials of a sweep in a storage that processes share, and the report on them."""

import json
import os
import shlex
import socket
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from legged.config import parse_override
from legged.config.loader import merge, nest
from legged.config.origins import Origins
from legged.config.yaml_files import dump
from legged.errors import ConfigError, RunError
from legged.figures import DPI, import_matplotlib
from legged.process.paths import make_folder, relative, replacing, write_text
from legged.sweeping.plan import Plan
from legged.tables import markdown_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from optuna import Study, Trial
    from optuna.storages import BaseStorage
    from optuna.trial import FrozenTrial

JOURNAL = "journal:"
"""Beginning of a storage's name if the storage is a journal file of Optuna."""
BEAT_S = 10.0
"""Interval at which a process confirms that it works on its trial [s]."""
GRACE_S = 120.0
"""A process on another machine counts as dead if it has not confirmed its work for this long [s]."""
WAIT_S = 60
"""Longest wait for the lock of an SQLite file [s]."""
FEWEST = 4
"""The importance of settings is computed only if at least this many trials have a value."""
MOST_TRIES = 5
"""Number of attempts after which a trial is given up."""
OWNER, ALIVE, TRIES, WHY, RUNS = "owner", "alive", "tries", "why", "runs"
"""Attributes of a trial."""
SWEEP, DEVICE = "sweep", "device"
"""Attributes of the study: the parts of the sweep that must stay the same, and the kind of device (cpu or cuda)."""


class Trials:
    """The study of a sweep, shared by all processes that take part."""

    def __init__(self, plan: Plan, asked: str = "", worker: int = 0) -> None:
        """Open the storage `asked`, or by default the storage that the plan names, or else sweep.db in the sweep's folder.

        Raises:
            ConfigError: the storage holds another sweep of the same name, or the storage has an invalid name.
            RunError: the storage can't be reached.
        """
        import optuna

        optuna.logging.set_verbosity(optuna.logging.ERROR)
        self.plan, self._worker, self._optuna = plan, worker, optuna
        self._storage = _open(asked or plan.given.storage, plan.folder)
        try:
            self.study: Study = optuna.create_study(
                study_name=plan.name,
                storage=self._storage,
                direction="minimize" if plan.minimize else "maximize",
                load_if_exists=True,
                pruner=_pruner(plan),
            )
            known = self.study.user_attrs.get(SWEEP)
            if known is None:
                self.study.set_user_attr(SWEEP, plan.identity)
                if None not in plan.own_drawn.values():
                    self.study.enqueue_trial(plan.own_drawn, skip_if_exists=True)
        except Exception as error:  # SQLAlchemy, drivers and file systems raise errors of many classes
            raise RunError(f"sweep: the storage can't be used: {' '.join(str(error).split())[:300]}") from error
        if known not in (None, plan.identity):
            raise ConfigError(
                f"sweep: '{plan.name}' was begun with another task, other seeds, other overrides, other parameters or another"
                " objective; give this sweep another `name` in its file"
            )

    def keep_to(self, device: str) -> None:
        """Store the `device` (cpu or cuda) on which trials are trained. If one is stored already, compare `device` with it.

        Raises:
            ConfigError: earlier trials were trained on the other kind of device.
        """
        known = self.study.user_attrs.get(DEVICE)
        if known is None:
            self.study.set_user_attr(DEVICE, device)
        elif known != device:
            raise ConfigError(
                f"--sim-device: earlier trials of '{self.plan.name}' were trained on {known} and can't be compared with"
                f" trials on {device}; go on with --sim-device {known}, or give this sweep another `name` in its file"
            )

    @property
    def all(self) -> list["FrozenTrial"]:
        """Return all trials."""
        return self.study.get_trials(deepcopy=False)

    @property
    def finished(self) -> list["FrozenTrial"]:
        """Return the trials that ended with a value or were ended early."""
        return [trial for trial in self.all if trial.state.name in ("COMPLETE", "PRUNED")]

    def next(self) -> "Trial | None":
        """Begin the next trial, a repeated or a new one. Return None if there are enough trials. Processes that call this at
        the same time do not begin more trials than planned.
        """
        self.take_back()
        wanted = self.plan.given.trials
        if len(self.finished) + len(self._running()) >= wanted:
            return None
        # The seed depends on the number of trials, so that a process that resumes a sweep draws new values.
        begun = len(self.all)
        self.study.sampler = self._optuna.samplers.TPESampler(
            n_startup_trials=self.plan.given.startup_trials,
            seed=(self.plan.given.seed + 1009 * begun + 100_003 * self._worker) % 2**32,
            constant_liar=True,
        )
        trial = self.study.ask({one.path: one.distribution for one in self.plan.parameters})
        trial.set_user_attr(ALIVE, time.time())
        trial.set_user_attr(OWNER, me())
        earlier = [other for other in self._running() if other.number < trial.number]
        if len(self.finished) + len(earlier) >= wanted:
            self.end(trial, "FAIL", "there were enough trials")
            return None
        return trial

    def end(self, trial: "Trial", state: str, why: str) -> None:
        """End a trial that has no value. `state` is PRUNED for an early end, and FAIL if the trial does not count."""
        trial.set_user_attr(WHY, why)
        self.study.tell(trial, state=self._optuna.trial.TrialState[state])

    def take_back(self) -> list[int]:
        """Queue the trials of dead processes again, and return the trials' numbers. If several processes call this at the
        same time, each trial is queued only once.
        """
        taken = []
        for trial in self._running():
            begun = trial.datetime_start.timestamp() if trial.datetime_start is not None else None
            said = trial.user_attrs.get(ALIVE, begun)
            if is_dead(trial.user_attrs.get(OWNER), said) and self.try_again(trial, "its process was killed"):
                taken.append(trial.number)
        return taken

    def try_again(self, trial: "Trial | FrozenTrial", why: str) -> bool:
        """End a trial that has no value. Queue its settings again unless they had too many attempts. Return False if another
        process has already ended the trial.
        """
        tries = int(trial.user_attrs.get(TRIES, 1))
        last = tries >= MOST_TRIES
        state = self._optuna.trial.TrialState["PRUNED" if last else "FAIL"]
        self._storage.set_trial_user_attr(trial._trial_id, WHY, f"{why}; {'given up' if last else 'tried again'}")
        try:
            if not self._storage.set_trial_state_values(trial._trial_id, state):
                return False
        except (RuntimeError, self._optuna.exceptions.OptunaError):  # another process has ended the trial
            return False
        if not last and trial.params:
            self.study.enqueue_trial(trial.params, user_attrs={TRIES: tries + 1})
        return True

    def _running(self) -> list["FrozenTrial"]:
        return [trial for trial in self.all if trial.state.name == "RUNNING"]

    def alive(self, trial: "Trial") -> AbstractContextManager[None]:
        """Return a context in which this process confirms at intervals that it works on a trial."""

        def beat() -> None:
            with suppress(Exception):  # the storage may be unreachable for a moment
                self._storage.set_trial_user_attr(trial._trial_id, ALIVE, time.time())

        return repeating(beat, BEAT_S)


def _open(asked: str, folder: Path) -> "BaseStorage":
    """Open a storage. Raises the errors of `Trials`."""
    from optuna.storages import JournalStorage, RDBStorage
    from optuna.storages.journal import JournalFileBackend

    if not asked:
        make_folder(folder)
        asked = f"sqlite:///{(folder / 'sweep.db').absolute()}"
    scheme, mark, rest = asked.partition("://")
    # Messages must not show the password of a database.
    where = f"storage: '{scheme}{mark}***@{rest.rpartition('@')[2]}'" if "@" in rest else f"storage: '{asked}'"
    try:
        if asked.startswith(JOURNAL):
            file = Path(asked.removeprefix(JOURNAL))
            make_folder(file.parent)
            return JournalStorage(JournalFileBackend(str(file)))
        waiting = {"connect_args": {"timeout": WAIT_S}} if asked.startswith("sqlite") else {"pool_pre_ping": True}
        return RDBStorage(asked, engine_kwargs=waiting)
    except ImportError as error:
        raise ConfigError(f"{where} needs a driver that is not installed ({error})") from error
    except Exception as error:
        import sqlalchemy

        if isinstance(error, sqlalchemy.exc.ArgumentError) or not mark:
            known = f"sqlite:///<file>, postgresql://..., mysql://... or {JOURNAL}<file>"
            raise ConfigError(f"{where} is no storage; expected {known}") from error
        raise RunError(f"{where} can't be reached: {' '.join(str(error).split())[:300]}") from error


def _pruner(plan: Plan) -> Any:
    from optuna.pruners import HyperbandPruner, MedianPruner, NopPruner

    runner = plan.cfg.train.runner
    most = runner.max_iterations * len(plan.given.seeds)
    if plan.given.pruner == "hyperband":
        return HyperbandPruner(min_resource=runner.evaluate_interval, max_resource=most, reduction_factor=3)
    # Early figures say little, so no trial is ended in the first quarter of its iterations.
    median = MedianPruner(n_startup_trials=5, n_warmup_steps=runner.max_iterations // 4)
    return NopPruner() if plan.given.pruner == "none" else median


def me() -> str:
    """Return an identifier of this process that is unique over machines."""
    return f"{_machine()} {os.getpid()} {_began(os.getpid())}"


def is_dead(owner: str | None, said: float | None) -> bool:
    """Return True if the process of a trial has died. A process of this machine has died if it does not exist. A process of
    another machine counts as dead if its last confirmation, at the time `said` [s since 1970], is too old.
    """
    parts = (owner or "").rsplit(" ", 2)
    if len(parts) == 3 and parts[0] == _machine() and parts[1].isdecimal():
        return _began(int(parts[1])) != parts[2]
    return said is None or time.time() - said > GRACE_S


def _machine() -> str:
    """Return an identifier of this machine or container. It changes at a restart."""
    words = [socket.gethostname()]
    with suppress(OSError):
        words.append(Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip())
        words.append(os.readlink("/proc/self/ns/pid"))
    return ":".join(words).replace(" ", "_")


def _began(pid: int) -> str:
    """Return the start time of a process on this machine, 'there' if the time is unknown, or 'gone' if the process ended."""
    with suppress(OSError):
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
        return "gone" if fields[0] in "ZX" else fields[19]
    with suppress(PermissionError):
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return "gone"
    return "there"


@contextmanager
def repeating(call: Callable[[], None], every_s: float, at_end: bool = False) -> Iterator[None]:
    """Call a function every `every_s` seconds in a thread while the block runs. `at_end` adds a call after the block. The
    context ends when the last call has returned.
    """
    over = threading.Event()

    def repeat() -> None:
        while not over.wait(every_s):
            call()
        if at_end:
            call()

    thread = threading.Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


# ---- report ----------------------------------------------------------------------------------------------------------


def write_report(trials: Trials, module: str | None = None) -> list[str]:
    """Write table.md, best.yaml and figures into the sweep's folder; return lines about the result and the files. `module` is
    the value of --import.

    Raises:
        RunError: a file can't be written.
    """
    plan, all_trials = trials.plan, trials.all
    ranked, folder = ranking(plan, all_trials), plan.folder
    write_text(folder / "table.md", table(plan, all_trials, module))
    written = [folder / "table.md"]
    lines = [f"{len(trials.finished)} of {plan.given.trials} trials are done"]
    if ranked:
        best, own = ranked[0], own_trial(plan, ranked)
        write_text(folder / "best.yaml", best_yaml(plan, best))
        written += [folder / "best.yaml", *draw_figures(trials)]
        lines.append(f"best: trial {best.number}, {plan.objective_text}: {best.value:.4g}")
        if own is not None:
            rank = f"rank {ranked.index(own) + 1} of {len(ranked)}"
            lines[-1] += f"; the task's own settings: trial {own.number}, {own.value:.4g}, {rank}"
    return [*lines, f"written: {', '.join(relative(path) for path in written)}"]


def ranking(plan: Plan, trials: Sequence["FrozenTrial"]) -> list["FrozenTrial"]:
    """Return the trials with a value, the best first."""
    there = [trial for trial in trials if trial.state.name == "COMPLETE"]
    return sorted(there, key=lambda trial: float(trial.value or 0.0), reverse=not plan.minimize)


def own_trial(plan: Plan, trials: Sequence["FrozenTrial"]) -> "FrozenTrial | None":
    """Return the trial that has the task's own settings, if there is one."""
    own = plan.own
    return next((trial for trial in trials if plan.settings(trial.params) == own), None)


def table(plan: Plan, trials: Sequence["FrozenTrial"], module: str | None = None) -> str:
    """Return all trials as Markdown: those with a value by rank, then those that were ended early, then all other trials."""
    order = {"PRUNED": 0, "RUNNING": 1, "WAITING": 2, "FAIL": 3}
    ranked = ranking(plan, trials)
    others = sorted((t for t in trials if t.state.name != "COMPLETE"), key=lambda t: (order[t.state.name], t.number))
    paths = [one.path for one in plan.parameters]
    own = own_trial(plan, ranked)
    besides = f" Trial {own.number} has the task's own settings." if own is not None else ""
    rows = [[rank, trial.number, f"{trial.value:.4g}"] for rank, trial in enumerate(ranked, 1)]
    rows += [["", trial.number, _why_no_value(plan, trial)] for trial in others]
    for row, trial in zip(rows, [*ranked, *others], strict=True):
        given = plan.settings(trial.params)
        row += [_text(given[path]) if path in given else "" for path in paths]
        row.append(", ".join(f"`{Path(run).name}`" for run in trial.user_attrs.get(RUNS, [])))
    heads = ["rank", "trial", plan.objective_text, *(f"`{path}`" for path in paths), "run"]
    parts = [f"# {plan.name}", f"`{plan.cfg.task}`, for the {plan.objective_text}.{besides}"]
    parts.append(markdown_table(heads, rows, left=[len(heads) - 1]))
    if ranked:
        words = ["legged", "train", *(["--import", module] if module else []), plan.task]
        words += [_override(path, value) for path, value in plan.settings(ranked[0].params).items()]
        parts += ["The settings of the best trial, as YAML:", f"```yaml\n{best_yaml(plan, ranked[0])}```"]
        parts += ["and on the command line:", f"```\n{shlex.join(words)}\n```"]
        if plan.given.overrides:
            common = ", ".join(f"`{path}={_text(value)}`" for path, value in plan.given.overrides.items())
            parts.append(f"Add the overrides that all trials share: {common}.")
    return "\n\n".join(parts) + "\n"


def _why_no_value(plan: Plan, trial: "FrozenTrial") -> str:
    """Return the reason why a trial has no value, with the last figure of a trial that was ended early."""
    state = trial.state.name
    why = trial.user_attrs.get(WHY) or {"RUNNING": "is being trained", "WAITING": "is to be tried again"}.get(state, "failed")
    if state != "PRUNED" or not trial.intermediate_values:
        return str(why)
    step = max(trial.intermediate_values)
    return f"{why}; {(-1.0 if plan.negated else 1.0) * trial.intermediate_values[step]:.4g} at {step}"


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _override(path: str, value: Any) -> str:
    """Return `key=value` for the command line. A text that would be read as another type gets quotation marks."""
    plain = f"{path}={_text(value)}"
    return plain if parse_override(plain) == (path, value) else f"{path}={json.dumps(value)}"


def best_yaml(plan: Plan, best: "FrozenTrial") -> str:
    """Return the settings of a trial as the lines of a task's YAML file."""
    nested: dict[str, Any] = {}
    for path, value in plan.settings(best.params).items():
        merge(nested, nest(path, value), "sweep", Origins())
    heading = f"# {plan.name}, trial {best.number}; {plan.objective_text}: {best.value:.4g}\n"
    return heading + dump(nested, sort_keys=False, default_flow_style=None, width=120)


def draw_figures(trials: Trials) -> list[Path]:
    """Draw Optuna's figures of the trials, and return the files' paths. The figures show values over trials, values over
    settings, and the importance of each setting, i.e. how much it decides whether a trial is among the best (PED-ANOVA,
    Watanabe et al., arXiv 2304.10255). Importance is left out if there are too few trials. It is also left out if the best
    quarter is no better than the rest, because all settings would then be equally important.

    Raises:
        RunError: a file can't be written.
    """
    import_matplotlib()
    import matplotlib.pyplot as plt
    from optuna.importance import PedAnovaImportanceEvaluator
    from optuna.visualization import matplotlib as drawing

    plt.switch_backend("agg")  # draw without a window system
    plan, study = trials.plan, trials.study
    ranked = ranking(plan, trials.all)
    own = own_trial(plan, ranked)
    paths = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Optuna calls these functions experimental
        warnings.filterwarnings("error", message=".*select the same set of trials", category=UserWarning)
        history = drawing.plot_optimization_history(study, target_name=plan.objective_text)
        if own is not None and own.value is not None:
            history.axhline(own.value, color="black", lw=1.0, ls="--", label="the task's own settings")
            history.legend()
        drawn = {"history": history, "parallel": drawing.plot_parallel_coordinate(study, target_name=plan.objective_text)}
        if len(ranked) >= FEWEST and len(plan.parameters) > 1:
            evaluator = PedAnovaImportanceEvaluator(target_quantile=0.25)
            with suppress(ValueError, RuntimeError, UserWarning):
                drawn["importance"] = drawing.plot_param_importances(study, evaluator, target_name=plan.objective_text)
        for name, axes in drawn.items():
            figure = cast("Figure", axes.figure)
            paths.append(plan.folder / f"{name}.png")
            with replacing(paths[-1]) as part:
                figure.savefig(part, dpi=DPI, format="png", bbox_inches="tight")
            plt.close(figure)
    return paths
