"""Fixtures: the command that migrates, when it goes well and when it ends with an error."""

import pytest
from forks import Result, written
from helpers import call

from legged import registry
from legged.cli.migrate import migrate


@pytest.fixture
def own_registry(monkeypatch):
    """The registry, without what a test adds to it."""
    monkeypatch.setattr(registry, "_REGISTERED", {})


@pytest.fixture
def migrated(capsys):
    """migrated(text, arguments...): migrate a file of that text, which goes well."""

    def migrated(text: str, *arguments: str, path: str = "fork_config.py") -> Result:
        code = call(migrate.main, [written(text, path), *arguments, "--run"])
        out, err = capsys.readouterr()
        assert code == 0, err
        return Result(out)

    return migrated


@pytest.fixture
def refused(capsys):
    """refused(arguments...): the one line that the command ends with."""

    def refused(*arguments: str) -> str:
        assert call(migrate.main, [*arguments, "--run"]) == 2
        out, err = capsys.readouterr()
        assert (out, err.count("\n")) == ("", 1)
        return err

    return refused
