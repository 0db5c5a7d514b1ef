"""What is seen of a training, on one line and as a table."""

import io
import sys

from rich.console import Console

from legged.learning.display import Display, Progress


def progress(iteration=3, **metrics):
    values = {"rew_tracking_lin_vel": 0.5, **{f"Metrics/{name}": value for name, value in metrics.items()}}
    return Progress(iteration, 10, 61.0, 130.0, 123456.0, 0.4, 0.1, 12.5, 0.37, values)


def test_a_line_says_where_training_is():
    line = progress(lin_vel_rmse=0.25, ang_vel_rmse=0.5, falls=0.125, episode_length=800.0).line()
    for words in ("it 3/10", "01:01 < 02:10", "123,456 steps/s", "0.250 m/s", "0.500 rad/s", "falls 12.5 %", "800 steps"):
        assert words in line
    assert "!" not in line


def test_what_has_no_value_yet_is_a_dash_and_not_a_number():
    line = progress().line()
    assert "nan" not in line
    assert "falls -" in line


def test_lost_contacts_and_broken_worlds_are_shouted():
    assert "contacts lost in 7 robot steps" in progress(contact_overflows=7.0).line()
    assert "2 robots reset" in progress(non_finite_worlds=2.0).line()


def test_the_table_has_every_reward_term_and_the_tasks_own_metrics():
    console = Console(width=120, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
    console.print(progress(command_vx=0.6).table("a title"))
    text = console.export_text()
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
