"""Completion in bash and zsh: what the shells' own functions offer after the beginning of a command line."""

import argparse
import contextlib
import io
import shutil
import subprocess

import pytest
from legged.commandline.completion import words_of
from legged.commandline.listing import robots, tasks
from legged.tools import completion

BASH = """
source "$1"
COMP_WORDBREAKS=$' \\t\\n"\\'><=;|&(:'
COMP_LINE=$2 COMP_POINT=${#2}
_legged
printf '%s\\n' "${COMPREPLY[@]}"
"""
ZSH = """
compdef() { }
compadd() { while [[ $1 != -- ]]; do shift; done; shift; print -rl -- "$@" }
_files() { }
source "$1"
words=("${(@s: :)2}") CURRENT=$#words
_legged
"""


@pytest.fixture(scope="module", params=["bash", "zsh"])
def complete(request, tmp_path_factory):
    """Return what a shell offers for the last word of a line; of bash only what follows the last '='."""
    if shutil.which(request.param) is None:
        pytest.skip(f"{request.param} is not installed")
    file = tmp_path_factory.mktemp("completion") / "script"
    with file.open("w") as out:
        out.write(written(request.param))
    flags = {"bash": ["--norc", "-c", BASH], "zsh": ["-f", "-c", ZSH]}[request.param]

    def offered(line: str) -> set[str]:
        command = [request.param, *flags, "test", str(file), line]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        assert done.stderr == ""
        kept = line.rpartition(" ")[2].rpartition("=")
        front = "".join(kept[:2]) if request.param == "bash" else ""
        return {front + word for word in done.stdout.split()}

    return offered


def written(shell: str) -> str:
    with contextlib.redirect_stdout(io.StringIO()) as out:
        assert completion.main([shell]) == 0
    return out.getvalue()


def test_tasks_are_those_of_the_installation(complete):
    assert complete("python train.py --task ") == set(tasks())
    assert complete("python train.py --task=h1") == {"--task=h1", "--task=h1_flat"}
    assert complete("python -m legged.tools.report --task anymal_c_fl") == {"anymal_c_flat"}
    assert complete("python -m legged.tools.migrate --task anymal_c_fl") == set()  # that is a name of legged_gym's


def test_flags_are_those_of_the_tool(complete):
    assert complete("python play.py --task anymal_c --terr") == {"--terrain"}
    assert complete("legged-train --max") == {"--max_iterations"}
    assert complete("python3 -m legged.tools.evaluate --gym") == {"--gymnasium"}
    assert complete("python -m legged.tools.plot --") == {"--help", "--out"}
    assert complete("python -m legged.deploy --rob") == {"--robot"}


def test_keys_are_offered_section_by_section(complete):
    assert complete("./train.py --task anymal_c trai") == {"train."}
    sections = {"train.policy.", "train.algorithm.", "train.distillation.", "train.runner."}
    assert complete("python train.py train.") == sections
    assert complete("python train.py train.runner.max") == {"train.runner.max_iterations="}
    assert complete("python train.py rewards.scales.tracking_") == {
        "rewards.scales.tracking_lin_vel=",
        "rewards.scales.tracking_ang_vel=",
    }
    assert complete("python train.py observations.groups.actor.") == {
        f"observations.groups.actor.{name}=" for name in ("terms", "history", "noise")
    }


def test_values_are_those_that_a_field_may_have(complete):
    assert complete("python train.py sim.cone=") == {"sim.cone=pyramidal", "sim.cone=elliptic"}
    assert complete("python train.py train.algorithm.symmetry=t") == {"train.algorithm.symmetry=true"}
    assert complete("python train.py --runner ") == {"stock", "captured"}
    assert complete("python train.py robot=go") == {f"robot={name}" for name in robots() if name.startswith("go")}


def test_modules_are_offered_to_python_and_nothing_to_other_programs(complete):
    assert complete("python -m legged.tools.ev") == {"legged.tools.evaluate"}
    assert complete("python -m legged.de") == {"legged.deploy"}
    assert complete("python other.py --ta") == set()
    assert complete("python other.py train.py --ta") == set()


def test_a_task_that_has_come_later_is_offered(tmp_path, monkeypatch):
    folder = tmp_path / "a folder"
    folder.mkdir()
    monkeypatch.setattr("legged.commandline.completion.data_folder", lambda _: folder)
    (tmp_path / "script").write_text(written("bash"))
    command = ["bash", "--norc", "-c", BASH, "test", str(tmp_path / "script"), "python train.py --task "]
    for names in (["early"], ["early", "zz_later"]):
        for name in names:
            (folder / f"{name}.yaml").touch()
        assert subprocess.run(command, capture_output=True, text=True, check=True).stdout.split() == names


def test_words_of_a_parser():
    parser = argparse.ArgumentParser()
    parser.add_argument("names", nargs="*", metavar="TASK | key=value")
    parser.add_argument("--task")
    parser.add_argument("-s", "--side", choices=[1, 2], type=int)
    parser.add_argument("--again", action="store_true")
    parser.add_argument("--worker", help=argparse.SUPPRESS)  # for the command's own use
    words = words_of(parser, {"sim.physics": (), "sim.solver": ()})
    assert words.flags == ("--help", "--task", "--side", "--again")
    assert words.values == {"--task": ("@tasks",), "--side": ("1", "2")}
    assert (words.tasks, words.keys) == (True, True)


def test_another_shell_is_a_wrong_flag(capsys):
    with pytest.raises(SystemExit) as stop:
        completion.main(["fish"])
    assert stop.value.code == 2
    assert "invalid choice: 'fish'" in capsys.readouterr().err
