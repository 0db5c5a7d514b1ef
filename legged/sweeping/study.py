"""The trials of a sweep in their storage: begun, handed to processes, and taken back from processes that died."""

import os
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from legged.errors import ConfigError, RunError
from legged.process.paths import make_folder
from legged.sweeping.plan import Plan

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
SWEEP, DEVICE = "sweep", "device"
"""Attributes of the study: the parts of the sweep that must stay the same, and the kind of device, cpu or cuda."""


class Trials:
    """The study of a sweep, shared by all processes that take part."""

    def __init__(self, plan: Plan, asked: str = "", worker: int = 0) -> None:
        """Open the storage `asked`, else that of the plan, else sweep.db in the sweep's folder.

        Raises:
            ConfigError: it holds another sweep of the same name, or its name is invalid.
            RunError: it can't be reached.
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
        except Exception as error:  # of SQLAlchemy, drivers and file systems, each of its own kind
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
        trial = self.study.ask({one.path: one.distribution for one in self.plan.parameters})
        trial.set_user_attr(ALIVE, time.time())
        trial.set_user_attr(OWNER, me())
        earlier = [other for other in self._running() if other.number < trial.number]
        if len(finished(self.all)) + len(earlier) >= wanted:
            self.end(trial, "FAIL", "there were enough")
            return None
        return trial

    def end(self, trial: "Trial", state: str, why: str) -> None:
        """End a trial that has no value: PRUNED if it was ended early, FAIL if it does not count."""
        trial.set_user_attr(WHY, why)
        self.study.tell(trial, state=self._optuna.trial.TrialState[state])

    def take_back(self) -> list[int]:
        """Queue the trials of dead processes again; return their numbers. Of several processes, one does so."""
        taken = []
        for trial in self._running():
            begun = trial.datetime_start.timestamp() if trial.datetime_start is not None else None
            said = trial.user_attrs.get(ALIVE, begun)
            if is_dead(trial.user_attrs.get(OWNER), said) and self.try_again(trial, "its process was killed"):
                taken.append(trial.number)
        return taken

    def try_again(self, trial: "Trial | FrozenTrial", why: str) -> bool:
        """End a trial without a value, and queue its settings again unless it had too many attempts. Return False if another
        process ended it.
        """
        tries = int(trial.user_attrs.get(TRIES, 1))
        last = tries >= MOST_TRIES
        state = self._optuna.trial.TrialState["PRUNED" if last else "FAIL"]
        self._storage.set_trial_user_attr(trial._trial_id, WHY, f"{why}; {'given up' if last else 'tried again'}")
        try:
            if not self._storage.set_trial_state_values(trial._trial_id, state):
                return False
        except (RuntimeError, self._optuna.exceptions.OptunaError):  # another process ended it
            return False
        if not last and trial.params:
            self.study.enqueue_trial(trial.params, user_attrs={TRIES: tries + 1})
        return True

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


def _open(asked: str, folder: Path) -> "BaseStorage":
    """Open a storage. Raises the errors of `Trials`."""
    from optuna.storages import JournalStorage, RDBStorage
    from optuna.storages.journal import JournalFileBackend

    if not asked:
        make_folder(folder)
        asked = f"sqlite:///{(folder / 'sweep.db').absolute()}"
    scheme, mark, rest = asked.partition("://")
    where = f"storage: '{scheme}{mark}***@{rest.rpartition('@')[2]}'" if "@" in rest else f"storage: '{asked}'"  # no password
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
    # Early figures say little, so a trial may run for a quarter of its length.
    median = MedianPruner(n_startup_trials=5, n_warmup_steps=runner.max_iterations // 4)
    return NopPruner() if plan.given.pruner == "none" else median


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
    """Return the start of a process of this machine, in the system's unit; 'gone' if there is no such process."""
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
    """Call a function every `every_s` seconds in a thread while the block runs, and once more after it if `at_end`. The block
    ends when the last call has returned.
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
