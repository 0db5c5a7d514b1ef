"""Evaluation files of `legged evaluate terrain` alone, without errors on a grid, in tables and reports."""

import json
import shutil

import pytest
from helpers import POLICY, call

from legged.cli.runs import evaluations, report
from legged.cli.runs import runs as table
from legged.errors import ConfigError
from legged.evaluation.result_file import check_result

pytestmark = pytest.mark.usefixtures("workplace")


@pytest.fixture
def run(tmp_path):
    """A copy of a shipped policy's folder as a run, whose evaluations hold success alone."""
    folder = tmp_path / "logs" / "anymal_c" / "run"
    shutil.copytree(POLICY.with_name("anymal_c"), folder)
    for path in folder.glob("evaluation_*.json"):
        result = json.loads(path.read_text())
        assert result.pop("rough")
        assert result["success"]
        path.write_text(json.dumps(result))
    return folder


def test_evaluations_are_shown_by_their_success(run, capsys):
    assert call(evaluations.main, [str(run)]) == 0
    out = capsys.readouterr().out
    assert "stairs_up" in out
    assert "velocity RMSE" not in out


def test_one_with_errors_and_one_without_are_both_shown(run, capsys):
    assert call(evaluations.main, [str(run), str(POLICY.with_name("anymal_c"))]) == 0
    out = capsys.readouterr().out
    assert "stairs_up" in out
    assert "velocity RMSE" in out


@pytest.mark.slow
def test_the_table_and_the_report_of_the_run_are_written(run):
    assert call(table.main, []) == 0
    text = (run.parents[1] / "experiments.md").read_text()
    assert r"stairs \[m\]" in text
    assert r"RMSE \[m/s\]" not in text, "a column in which no run has a number is left out"
    assert call(report.main, [str(run)]) == 0
    text = (run / "report.md").read_text()
    assert "velocity RMSE" not in text
    assert "robots that get out of tiles" in text


def test_an_evaluation_that_lost_a_part_of_its_errors_is_damaged():
    head = {"task": "t", "physics": "mujoco", "success": {"types": {}}}
    check_result(head, "a.json")
    for damaged in ({**head, "falls": 0.0}, {**head, "rough": {}}, {**head, "success": 3}):
        with pytest.raises(ConfigError, match=r"a\.json: is not the result of an evaluation"):
            check_result(damaged, "a.json")
