"""Completion: what bash offers after the beginning of a command line, with the script that `legged completion` prints."""

import contextlib
import io
import shutil
import subprocess

import pytest

from legged.cli.completion import completion
from legged.cli.list import tasks
from legged.cli.main import COMMANDS, sub_commands

BASH = """
compopt() { echo "$*" >> compopts; }
source "$1"
shift
COMP_WORDS=("$@") COMP_CWORD=$(($# - 1)) COMPREPLY=()
function=$(complete -p legged)
function=${function##*-F } function=${function%% *}
$function legged "${COMP_WORDS[COMP_CWORD]}" "${COMP_WORDS[COMP_CWORD-1]}"
printf '%s\\n' "${COMPREPLY[@]}"
"""


def written(shell: str) -> str:
    with contextlib.redirect_stdout(io.StringIO()) as out:
        assert completion.main([shell]) == 0
    return out.getvalue()


@pytest.fixture(scope="module")
def script(tmp_path_factory):
    file = tmp_path_factory.mktemp("completion") / "script"
    file.write_text(written("bash"))
    return file


@pytest.fixture
def complete(script, tmp_path):
    """Return what bash offers for the last word of a line."""

    def offered(line: str) -> set[str]:
        command = ["bash", "--norc", "-c", BASH, "test", str(script), *line.split(" ")]
        done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=tmp_path)
        assert done.stderr == ""
        return set(done.stdout.split())

    return offered


def test_commands_and_sub_commands(complete):
    assert complete("legged ") == {name.partition(" ")[0] for name in COMMANDS}
    assert complete("legged fit") == {"fit-actuator"}
    for group in ("episodes", "deploy", "benchmark"):
        assert complete(f"legged {group} ") == set(sub_commands(group))


def test_tasks_and_runs_are_offered_where_one_is_named(complete, tmp_path):
    assert complete("legged train ") == set(tasks())
    assert complete("legged train --task h1") == {name for name in tasks() if name.startswith("h1")}
    (tmp_path / "logs" / "anymal_c_flat" / "2026-01-02_run").mkdir(parents=True)
    assert complete("legged evaluate grid anymal_c_flat/") == {"anymal_c_flat/2026-01-02_run"}
    assert complete("legged runs report anymal_c_fl") == {"anymal_c_flat", "anymal_c_flat/2026-01-02_run"}
    assert complete("legged migrate --task anymal_c_fl") == set()  # that is a name of legged_gym's


def test_a_group_that_is_a_command_too_offers_both(complete):
    assert complete("legged evaluate ") == {*sub_commands("evaluate"), *tasks()}
    assert complete("legged evaluate go2_fl") == {"go2_flat"}
    assert complete("legged runs ") == set(sub_commands("runs"))


def test_options_are_those_of_the_command(complete):
    assert complete("legged play anymal_c --terr") == {"--terrain"}
    assert complete("legged train --max") == {"--max-iterations"}
    assert complete("legged runs curves --") == {"--help", "--out", "--import"}
    assert complete("legged deploy robot --ru") == set()


def test_choices_of_an_option(complete):
    assert complete("legged train --runner ") == {"stock", "captured"}
    assert complete("legged completion z") == {"zsh"}


def test_keys_are_offered_section_by_section(complete, tmp_path):
    assert complete("legged train anymal_c trai") == {"train."}
    sections = {"train.policy.", "train.algorithm.", "train.distillation.", "train.runner."}
    assert complete("legged train anymal_c train.") == sections
    assert (tmp_path / "compopts").read_text().splitlines()[-1] == "-o nospace"  # what was begun goes on
    assert complete("legged train anymal_c train.runner.max") == {"train.runner.max_iterations="}
    assert complete("legged export anymal_c rewards.scales.tracking_") == {
        "rewards.scales.tracking_lin_vel=",
        "rewards.scales.tracking_ang_vel=",
    }
    assert complete("legged play anymal_c observations.groups.actor.") == {
        f"observations.groups.actor.{name}=" for name in ("terms", "history", "noise")
    }


def test_a_task_that_has_come_later_is_offered(tmp_path, monkeypatch):
    folder = tmp_path / "a folder"
    folder.mkdir()
    monkeypatch.setattr("legged.cli.completion.data_folder", lambda _: folder)
    (tmp_path / "script").write_text(written("bash"))
    command = ["bash", "--norc", "-c", BASH, "test", str(tmp_path / "script"), "legged", "train", ""]
    for names in (["early"], ["early", "zz_later"]):
        for name in names:
            (folder / f"{name}.yaml").touch()
        done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=tmp_path)
        assert done.stdout.split() == names


def test_the_script_for_zsh_names_commands_and_keys():
    text = written("zsh")
    assert "#compdef legged" in text
    for words in ("fit-actuator", "--max-iterations", "train.runner.max_iterations="):
        assert words in text
    if shutil.which("zsh"):
        assert subprocess.run(["zsh", "-n"], input=text, text=True, check=False).returncode == 0


def test_another_shell_is_a_wrong_argument(capsys):
    with pytest.raises(SystemExit) as stop:
        completion.main(["fish"])
    assert stop.value.code == 2
    assert "invalid choice: 'fish'" in capsys.readouterr().err
