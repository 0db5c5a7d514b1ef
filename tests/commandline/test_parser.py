"""Help of every command: its paragraphs, and examples that its own parser reads."""

from importlib import import_module

import pytest
from legged.commandline.listing import module_of, tasks, tools

from legged.commandline.arguments import overrides
from legged.process.command_parser import CommandParser
from legged.registry import task_config

INSTALLED = {"legged.tools.train": "python train.py ", "legged.tools.play": "python play.py "}


def parser_of(tool: str) -> CommandParser:
    return import_module(module_of(tool)).build_parser()


@pytest.mark.parametrize("tool", tools())
def test_help_of_a_command_shows_two_examples_that_it_can_read(tool, capsys):
    parser = parser_of(tool)
    assert len(parser.examples) >= 2
    with pytest.raises(SystemExit) as stop:
        import_module(module_of(tool)).main(["--help"])
    assert stop.value.code == 0
    shown = capsys.readouterr().out.partition("\nexamples:\n")[2].splitlines()
    assert shown == [f"  {example}" for example in parser.examples]
    for example in parser.examples:
        assert f"{example} ".startswith(INSTALLED.get(tool, f"python -m {tool} "))
        args = parser.parse_intermixed_args(CommandParser.arguments_of(example))
        task = getattr(args, "task", None)
        assert task is None or task in tasks() or tool == "legged.tools.migrate"  # its tasks are those of legged_gym
        if task is not None and hasattr(args, "overrides"):
            task_config(task, overrides(args))  # its settings are ones of that task


@pytest.mark.parametrize("program", ["python train.py", "python -m legged.tools.train", "legged-train"])
def test_arguments_of_an_example_are_what_follows_the_program(program):
    assert CommandParser.arguments_of(f"{program} --task 'x y' > a.txt") == ["--task", "x y"]


def test_a_command_with_one_example_is_not_built():
    with pytest.raises(ValueError, match="at least 2 examples, got 1"):
        CommandParser("x", "Do.", "python x.py")


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
