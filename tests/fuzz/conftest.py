"""Fuzzing: eight cases a test by default, as many as asked for by `FUZZ_CASES=1000 pytest tests/fuzz`."""

import contextlib
import io
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from helpers import kept_global_state, tiny_run
from hypothesis import HealthCheck, settings

CASES = int(os.environ.get("FUZZ_CASES", "8"))
settings.register_profile(
    "fuzz",
    max_examples=CASES,
    deadline=None,  # how fast a case is decides nothing: the machine may be busy
    derandomize="FUZZ_CASES" not in os.environ,  # the same cases for everybody in the ordinary run
    database=None,
    print_blob=True,
    suppress_health_check=list(HealthCheck),
)
settings.load_profile("fuzz")


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a short run: two checkpoints, a state, a configuration."""
    folder = tmp_path_factory.mktemp("trained")
    with pytest.MonkeyPatch.context() as patch, kept_global_state():
        patch.chdir(folder)
        return tiny_run(num_envs=4).resolve()


@pytest.fixture
def in_new_folder(tmp_path_factory: pytest.TempPathFactory) -> Callable[[], contextlib.AbstractContextManager[Path]]:
    """in_new_folder(): a context in a working directory of its own, one for each case."""

    @contextlib.contextmanager
    def enter() -> Iterator[Path]:
        before, folder = Path.cwd(), tmp_path_factory.mktemp("case")
        os.chdir(folder)
        try:
            with kept_global_state():
                yield folder
        finally:
            os.chdir(before)

    return enter


class Outcome:
    """What a command did: its exit code, and what it said."""

    def __init__(self, code: int, out: str, err: str) -> None:
        self.code, self.out, self.err = code, out, err


@pytest.fixture
def run() -> Callable[..., Outcome]:
    """run(main, arguments): the outcome of a command. An exception that it lets through fails the test."""

    def run(main: Callable[[list[str]], int], arguments: list[str]) -> Outcome:
        out, err = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            try:
                code = main(arguments)
            except SystemExit as stop:
                code = int(stop.code or 0)
        assert "Traceback" not in out.getvalue() + err.getvalue(), err.getvalue()
        assert code in (0, 1, 2), f"exit code {code}: {err.getvalue()}"
        if code:
            assert err.getvalue().strip(), "nothing is said"
        return Outcome(code, out.getvalue(), err.getvalue())

    return run
