"""`legged evaluate` of an ONNX file: measured as by `legged evaluate onnx`, and options that it can't use are refused."""

import json
from pathlib import Path

import pytest
from helpers import POLICY, call

from legged.cli.evaluate import RESULT, onnx
from legged.cli.evaluate import evaluate as policy
from legged.cli.play import play

pytestmark = pytest.mark.usefixtures("workplace")


@pytest.mark.slow
def test_an_exported_folder_is_measured_as_by_its_own_command(capsys):
    flags = ["--no-video", "--headless", "--num-envs", "1", "--sim-device", "cpu", "--out", "."]
    assert call(play.main, [str(POLICY), *flags]) == 0
    capsys.readouterr()
    found = []
    for main, name, out in ((policy.main, "exported", "a"), (onnx.main, "exported/policy.onnx", "b")):
        assert call(main, [name, "--out", out]) == 0
        found.append(json.loads(Path(out, RESULT).read_text()))
    assert found[0] == found[1]
    assert found[0]["robot"] == "anymal_c"
    (measured,) = found[0]["policies"]
    assert all(row["fell_after"] is None for row in measured["commands"])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--physics", "newton"], "error: --physics: "),
        (["--checkpoint", "3"], "error: --checkpoint: "),
        (["--no-graph"], "error: --no-graph: "),
        (["--import", "mine.py"], "error: --import: "),
        (["sim.dt=0.01"], "error: sim.dt=0.01: "),
    ],
)
def test_what_means_nothing_for_it_is_refused(words, said, capsys):
    assert call(policy.main, ["exported/policy.onnx", *words]) == 2
    err = capsys.readouterr().err
    assert err.startswith(said)
    assert "legged evaluate onnx" in err
    assert len(err.splitlines()) == 1


def test_a_file_that_is_not_there_is_named(capsys):
    for command in (policy, onnx):
        assert call(command.main, ["nowhere.onnx"]) == 2
        assert capsys.readouterr().err.startswith("error: POLICY: there is no ONNX file 'nowhere.onnx'")
