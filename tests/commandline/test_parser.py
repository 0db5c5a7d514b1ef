"""The parser of a command: paragraphs and examples of its help, numbers below zero, and legged_gym's underscores."""

import pytest

from legged.commandline.command import sub_command
from legged.deploy.command_parser import CommandParser, argument


@pytest.mark.parametrize("given", ["--num_envs", "--num-envs"])
@pytest.mark.parametrize("form", ["{}=3", "{} 3"])
def test_options_of_legged_gym_are_read_with_underscores_too(given, form):
    @sub_command("x a", "x b", arguments=(argument("--num-envs", type=int), argument("rest", nargs="*")))
    def command(_args):
        """Do."""
        return 0

    args = command.parse(["a_b=num_envs", *form.format(given).split()])
    assert (args.num_envs, args.rest) == (3, ["a_b=num_envs"])


def test_other_options_have_hyphens_alone(capsys):
    parser = CommandParser("x", "Do.", "x a", "x b")
    parser.add_argument("--robots-per-point", type=int)
    with pytest.raises(SystemExit):
        parser.parse_args(["--robots_per_point", "3"])
    assert "did you mean '--robots-per-point'?" in capsys.readouterr().err


def test_paragraphs_of_a_description_are_filled_one_by_one_and_indented_lines_kept(monkeypatch):
    monkeypatch.setenv("COLUMNS", "40")
    text = "One two three four five six seven eight nine.\n\n  as it\n  is\n\nLast."
    said = CommandParser("x", text, "python x.py a", "python x.py b").format_help()
    assert "One two three four five six seven\neight nine.\n\n  as it\n  is\n\nLast.\n" in said
    assert said.endswith("examples:\n  python x.py a\n  python x.py b\n")


@pytest.mark.parametrize("given", ["-1e-1", "-.5E+0", "-2", "-0.25"])
def test_a_negative_number_is_a_value_however_it_is_written(given):
    parser = CommandParser("x", "Do.", "python x.py a", "python x.py b")
    parser.add_argument("--command", nargs=3, type=float)
    parser.add_argument("-v", action="store_true")
    assert parser.parse_args(["--command", given, "0", given, "-v"]).command == [float(given), 0.0, float(given)]


@pytest.mark.parametrize("given", ["-1e", "-e1", "-1x"])
def test_what_only_begins_like_a_number_is_no_value(given):
    parser = CommandParser("x", "Do.", "python x.py a", "python x.py b")
    parser.add_argument("--command", nargs="*")
    with pytest.raises(SystemExit):
        parser.parse_args(["--command", given])
