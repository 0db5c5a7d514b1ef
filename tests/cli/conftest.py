"""What tests of commands share."""

import pytest
from helpers import call

from legged.cli.robot import add


@pytest.fixture
def added(tmp_path, capsys):
    """added(text, *flags): what `legged robot add` prints for a file of that text; its robot is ./mine/<name>."""

    def added(text: str, *flags: str, file: str = "toy.urdf") -> str:
        (tmp_path / file).write_text(text)
        assert call(add.main, [file, "--out", "mine", *flags]) == 0, capsys.readouterr().err
        return capsys.readouterr().out

    return added
