"""What is seen of a training, on one line and as a table."""

import io
import re
import sys
from math import nan

from rich.console import Console

from legged.learning.display import Display, Progress


def shown(progress):
    """The table as text."""
    console = Console(width=120, record=True, file=io.StringIO())
    console.print(progress.table("a title"))
    return console.export_text()


def progress(iteration=3, **metrics):
    values = {"rew_tracking_lin_vel": 0.5, **{f"Metrics/{name}": value for name, value in metrics.items()}}
    return Progress(iteration, 10, 61.0, 130.0, 123456.0, 0.4, 0.1, 12.5, 0.37, values)


def test_a_line_says_where_training_is():
    line = progress(lin_vel_rmse=0.25, ang_vel_rmse=0.5, falls=0.125, episode_length=800.0).line()
    for words in ("it 3/10", "01:01 < 02:10", "123,456 steps/s", "0.250 m/s", "0.500 rad/s", "falls 12.5 %", "800 steps"):
        assert words in line
    assert "!" not in line


def test_a_legged_robot_s_line_is_this():
    metrics = {"episode_length": 800.0, "falls": 0.125, "command_vx": 0.6, "ang_vel_rmse": 0.5, "lin_vel_rmse": 0.25}
    assert progress(**metrics).line() == (
        "it 3/10  01:01 < 02:10  123,456 steps/s (0.40+0.10 s)  reward 12.50  error 0.250 m/s 0.500 rad/s  falls 12.5 %"
        "  episode 800 steps  std 0.37"
    )


def test_the_last_evaluation_is_on_the_line_and_in_the_table():
    seen = progress(lin_vel_rmse=0.25)
    seen.values.update({"Evaluation/lin_vel_rmse": 0.0612, "Evaluation/falls": 0.0})
    assert seen.line().endswith("  std 0.37  evaluated lin vel rmse 0.061")
    assert "evaluation: lin vel rmse" in shown(seen)


def test_what_has_no_value_yet_is_a_dash_and_not_a_number():
    nothing = progress(lin_vel_rmse=nan, falls=nan, x_velocity=nan)
    line = nothing.line()
    assert "error -  falls -  x velocity        -" in line
    begun = Progress(1, 2, 1.0, 1.0, 1.0, 0.4, 0.1, nan, 0.3, {**nothing.values, "rew_forward": nan})
    for text in (line, begun.line(), shown(begun)):
        assert "nan" not in text


def test_what_a_task_does_not_log_is_not_shown():
    for text in (progress(x_velocity=1.0).line(), shown(progress(x_velocity=1.0))):
        for word in ("falls", "error", "episode"):
            assert word not in text


def test_metrics_of_any_task_are_shown():
    """A runner that has no commands: two metrics with a place of their own, then the first of the others."""
    metrics = {"x_velocity": 4.125, "control_cost": 123456.0, "height": 0.001, "episode_length": 1000.0, "falls": 0.02}
    line = progress(**metrics).line()
    assert "  falls 2.0 %  episode 1000 steps  x velocity     4.12  control cost 1.23e+05  std" in line
    table = shown(progress(**metrics))
    for words in ("x velocity", "4.12", "control cost", "1.23e+05", "height", "1.00e-03", "2.0 % of episodes", "1000 steps"):
        assert words in table


def test_lines_of_one_task_have_their_numbers_below_each_other():
    first, second = (progress(x_velocity=speed, y_velocity=-speed).line() for speed in (0.5, 12.25))
    assert len(first) == len(second)
    assert first.index("y velocity") == second.index("y velocity")


def test_terrain_levels_without_a_value_are_left_out():
    values = {"Terrain/level": nan, "Terrain/level_gap": nan, "Terrain/level_pit": 1.5, "Terrain/promoted_pit": nan}
    progress = Progress(1, 2, 1.0, 1.0, 1.0, 0.4, 0.1, 1.0, 0.3, values)
    for text in (progress.line(), shown(progress)):
        assert "nan" not in text
    assert progress.levels() == {"pit": "level 1.50"}


def test_other_sections_have_rows_of_their_own():
    values = {"Terminations/too_low": 0.25, "Faults/reward_torques": 3.0, "Terrain/level": 2.5, "rew_alive": 1.0}
    text = shown(Progress(1, 2, 1.0, 1.0, 1.0, 0.4, 0.1, 1.0, 0.3, values))
    for row in (
        r"terminations: too low\W+0\.25",
        r"faults: reward torques\W+3\.00",
        r"terrain level\W+2\.50",
        r"alive\W+1\.0000",
    ):
        assert re.search(row, text), row


def test_lost_contacts_and_broken_worlds_are_shouted():
    assert "contacts lost in 7 robot steps" in progress(contact_overflows=7.0).line()
    assert "2 robots reset" in progress(non_finite_worlds=2.0).line()


def test_the_table_has_every_reward_term_and_the_tasks_own_metrics():
    text = shown(progress(command_vx=0.6))
    for words in ("a title", "tracking_lin_vel", "+0.5000", "command vx", "0.60"):
        assert words in text


def test_plain_lines_come_at_most_every_two_seconds_and_at_the_end(capsys):
    with Display("title") as display:
        for iteration, elapsed in ((1, 0.1), (2, 0.2), (3, 2.3), (10, 2.4)):
            display.show(Progress(iteration, 10, elapsed, 0.0, 1.0, 0.1, 0.1, 0.0, 0.5, {}))
    shown = [line.split()[1] for line in capsys.readouterr().out.splitlines()]
    assert shown == ["1/10", "3/10", "10/10"]


def test_a_terminal_that_cannot_be_controlled_gets_plain_lines(monkeypatch, capsys):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    monkeypatch.setenv("TERM", "dumb")
    with Display("title") as display:
        display.show(progress())
    assert capsys.readouterr().out.startswith("it 3/10 ")


def test_brackets_in_names_are_shown_as_they_are():
    console = Console(width=120, record=True, file=io.StringIO())
    console.print(Progress(1, 2, 1.0, 1.0, 1.0, 0.4, 0.1, 1.0, 0.3, {"rew_[/x]": 1.0}).table("run [/bold]"))
    text = console.export_text()
    assert "run [/bold]" in text
    assert "[/x]" in text
