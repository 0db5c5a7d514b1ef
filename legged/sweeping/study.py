"""The trials of a sweep in their storage: begun, handed to processes, and taken back from processes that died."""

import os
import socket
import time
from contextlib import AbstractContextManager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from legged.errors import ConfigError, RunError
from legged.process.paths import make_folder
from legged.process.repeating import repeating
from legged.sweeping.plan import Parameter, Plan

if TYPE_CHECKING:
    from optuna import Study, Trial
    from optuna.storages import BaseStorage
    from optuna.trial import FrozenTrial

JOURNAL = "journal:"
"""Prefix of a storage that is a file of lines."""
BEAT_S = 10.0
"""Interval at which a process confirms that it works on its trial [s]."""
GRACE_S = 120.0
"""A process on another machine without a confirmation for this long is dead [s]."""
WAIT_S = 60
"""Longest wait for the lock of an SQLite file [s]."""
MOST_TRIES = 5
"""Number of attempts after which a trial is given up."""
OWNER, ALIVE, TRIES, WHY, RUNS = "owner", "alive", "tries", "why", "runs"
"""Attributes of a trial."""
SWEEP = "sweep"
"""Attribute of the study: the parts of the sweep that must stay the same."""
DEVICE = "device"
"""Attribute of the study: the kind of device of its trials, cpu or cuda."""


def check_installed() -> None:
    """Check that Optuna is installed.

    Raises:
        ConfigError: it is not installed.
    """
    if find_spec("optuna") is None:
        raise ConfigError("sweep: needs the package optuna, which is not installed here: pip install optuna")


class Trials:
    """The study of a sweep, shared by all processes that take part."""

    def __init__(self, plan: Plan, asked: str = "", worker: int = 0) -> None:
        """Open the storage `asked`, else that of the plan, else sweep.db in the sweep's folder.

        Raises:
            ConfigError: it holds another sweep of the same name, or its name is invalid.
            RunError: it can't be reached.
        """
        check_installed()
        import optuna

        optuna.logging.set_verbosity(optuna.logging.ERROR)
        self.plan, self._worker = plan, worker
        self._storage = _open(asked or plan.given.storage, plan.folder)
        self._optuna = optuna
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
                own = plan.own_drawn
                if None not in own.values():
                    self.study.enqueue_trial(own, skip_if_exists=True)
        except ConfigError:
            raise
        except Exception as error:  # SQLAlchemy, drivers and file systems raise their own classes
            raise RunError(f"sweep: the storage can't be used: {' '.join(str(error).split())[:300]}") from error
        if known not in (None, plan.identity):
            raise ConfigError(
                f"sweep: '{plan.name}' was begun with another task, other seeds, overrides, parameters or another objective;"
                " give this one another name (name: in its file)"
            )

    def keep_to(self, device: str) -> None:
        """Store the kind of device, cpu or cuda, with the first trial.

        Raises:
            ConfigError: earlier trials were trained on the other kind.
        """
        known = self.study.user_attrs.get(DEVICE)
        if known is None:
            self.study.set_user_attr(DEVICE, device)
        elif known != device:
            raise ConfigError(
                f"--sim-device: the trials of '{self.plan.name}' are trained on {known}, and those on {device} can't be"
                f" compared with them; go on with --sim-device {known}, or give this sweep another name (name: in its file)"
            )

    @property
    def all(self) -> list["FrozenTrial"]:
        """Return all trials."""
        return self.study.get_trials(deepcopy=False)

    @property
    def done(self) -> int:
        """Return the number of trials that ended with a value or were ended early."""
        return len(finished(self.all))

    def next(self) -> "Trial | None":
        """Begin the next trial, a repeated or a new one; return None if there are enough. Processes that call this at the
        same time do not begin more trials than planned.
        """
        self.take_back()
        wanted = self.plan.given.trials
        if len(finished(self.all)) + len(self._running()) >= wanted:
            return None
        # The seed depends on the number of trials, so that a process that resumes a sweep draws new values.
        begun = len(self.all)
        self.study.sampler = self._optuna.samplers.TPESampler(
            n_startup_trials=self.plan.given.startup_trials,
            seed=(self.plan.given.seed + 1009 * begun + 100_003 * self._worker) % 2**32,
            constant_liar=True,
        )
        trial = self.study.ask()
        trial.set_user_attr(ALIVE, time.time())
        trial.set_user_attr(OWNER, me())
        earlier = [other for other in self._running() if other.number < trial.number]
        if len(finished(self.all)) + len(earlier) >= wanted:
            self._put_back(trial.number, trial._trial_id, "there were enough")
            return None
        return trial

    def draw(self, trial: "Trial") -> dict[str, Any]:
        """Draw the values of a trial; return dotted path -> value of the setting."""
        return {parameter.path: parameter.value(_draw(trial, parameter)) for parameter in self.plan.parameters}

    def take_back(self) -> list[int]:
        """Queue the trials of dead processes again; return their numbers. Of several processes, one does so."""
        taken = []
        for trial in self._running():
            said = trial.user_attrs.get(ALIVE)
            if said is None and trial.datetime_start is not None:  # a trial without a confirmation has just begun
                said = trial.datetime_start.timestamp()
            if is_dead(trial.user_attrs.get(OWNER), said) and self.try_again(trial, "its process was killed"):
                taken.append(trial.number)
        return taken

    def try_again(self, trial: "FrozenTrial", why: str) -> bool:
        """End a trial without a value, and queue its settings again unless it had too many attempts. Return False if another
        process ended it.
        """
        state = self._optuna.trial.TrialState
        tries = int(trial.user_attrs.get(TRIES, 1))
        last = tries >= MOST_TRIES
        self._storage.set_trial_user_attr(trial._trial_id, WHY, f"{why}; {'given up' if last else 'tried again'}")
        try:
            if not self._storage.set_trial_state_values(trial._trial_id, state.PRUNED if last else state.FAIL):
                return False
        except (RuntimeError, self._optuna.exceptions.OptunaError):  # another process ended it
            return False
        if not last and trial.params:
            self.study.enqueue_trial(trial.params, user_attrs={TRIES: tries + 1})
        return True

    def _put_back(self, number: int, trial_id: int, why: str) -> None:
        """End a trial that is not needed."""
        self._storage.set_trial_user_attr(trial_id, WHY, why)
        self.study.tell(number, state=self._optuna.trial.TrialState.FAIL)

    def _running(self) -> list["FrozenTrial"]:
        return [trial for trial in self.all if trial.state.name == "RUNNING"]

    def alive(self, trial: "Trial") -> AbstractContextManager[None]:
        """Return a context in which this process confirms at intervals that it works on a trial."""

        def beat() -> None:
            with suppress(Exception):  # the storage may be away for a moment
                self._storage.set_trial_user_attr(trial._trial_id, ALIVE, time.time())

        return repeating(beat, BEAT_S)


def finished(trials: list["FrozenTrial"]) -> list["FrozenTrial"]:
    """Return the trials that ended with a value or were ended early."""
    return [trial for trial in trials if trial.state.name in ("COMPLETE", "PRUNED")]


def _draw(trial: "Trial", parameter: Parameter) -> Any:
    if parameter.kind == "choice":
        return trial.suggest_categorical(parameter.path, parameter.choices)
    if parameter.kind == "whole":
        return trial.suggest_int(parameter.path, int(parameter.low), int(parameter.high), log=parameter.log)
    return trial.suggest_float(parameter.path, parameter.low, parameter.high, log=parameter.log)


def _open(asked: str, folder: Path) -> "BaseStorage":
    """Open a storage.

    Raises:
        ConfigError: its name is invalid.
        RunError: it can't be reached.
    """
    from optuna.storages import JournalStorage, RDBStorage
    from optuna.storages.journal import JournalFileBackend

    if not asked:
        make_folder(folder)
        asked = f"sqlite:///{(folder / 'sweep.db').absolute()}"
    try:
        if asked.startswith(JOURNAL):
            file = Path(asked.removeprefix(JOURNAL))
            make_folder(file.parent)
            return JournalStorage(JournalFileBackend(str(file)))
        waiting = {"connect_args": {"timeout": WAIT_S}} if asked.startswith("sqlite") else {"pool_pre_ping": True}
        return RDBStorage(asked, engine_kwargs=waiting)
    except ImportError as error:
        raise ConfigError(f"storage: '{_without_password(asked)}' needs a driver that is not installed ({error})") from error
    except Exception as error:
        import sqlalchemy

        text = " ".join(str(error).split())[:300]
        if isinstance(error, sqlalchemy.exc.ArgumentError) or "://" not in asked:
            raise ConfigError(
                f"storage: '{_without_password(asked)}' is no storage; expected sqlite:///<file>, postgresql://..., mysql://..."
                f" or {JOURNAL}<file>"
            ) from error
        raise RunError(f"storage: '{_without_password(asked)}' can't be reached: {text}") from error


def _without_password(url: str) -> str:
    """Return a URL without its password."""
    scheme, mark, rest = url.partition("://")
    return f"{scheme}{mark}***@{rest.rpartition('@')[2]}" if "@" in rest else url


def _pruner(plan: Plan) -> Any:
    from optuna.pruners import HyperbandPruner, MedianPruner, NopPruner

    runner = plan.cfg.train.runner
    if plan.given.pruner == "none":
        return NopPruner()
    if plan.given.pruner == "hyperband":
        most = runner.max_iterations * len(plan.given.seeds)
        return HyperbandPruner(min_resource=runner.evaluate_interval, max_resource=most, reduction_factor=3)
    # Early figures say little, so a trial may run for a quarter of its length.
    return MedianPruner(n_startup_trials=5, n_warmup_steps=runner.max_iterations // 4)


def me() -> str:
    """Return an identifier of this process that is unique over machines."""
    return f"{_machine()} {os.getpid()} {_began(os.getpid())}"


def is_dead(owner: str | None, said: float | None) -> bool:
    """Return whether the process of a trial has died: on this machine, if it does not exist; elsewhere, if its last
    confirmation `said` (seconds since 1970) is too old.
    """
    parts = (owner or "").rsplit(" ", 2)
    if len(parts) == 3 and parts[0] == _machine() and parts[1].isdecimal():
        return _began(int(parts[1])) != parts[2]
    return said is None or time.time() - said > GRACE_S


def _machine() -> str:
    """Return an identifier of this machine, or container, that changes when it restarts."""
    words = [socket.gethostname()]
    with suppress(OSError):
        words.append(Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip())
        words.append(os.readlink("/proc/self/ns/pid"))
    return ":".join(words).replace(" ", "_")


def _began(pid: int) -> str:
    """Return the start time of a process on this machine, in the system's unit; 'gone' if there is no such process."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
        return "gone" if fields[0] in "ZX" else fields[19]
    except OSError:
        pass
    if Path("/proc/self").exists():
        return "gone"
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return "gone"
    except PermissionError:
        pass
    return "there"
