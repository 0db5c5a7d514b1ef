"""Live plots: the history of a robot, and the data and options that the charts in the browser get."""

from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
from helpers import small_task, zero_actions

from legged.play.live.plots import KEPT_S, LARGEST, MOST_POINTS, History, LivePlots, gait_diagram, reward_curves


def history_of(
    samples: list[np.ndarray], terms=("speed", "torques"), feet=("LF_FOOT", "RF_FOOT"), dt: float = 0.1
) -> History:
    """A history of made-up samples."""
    rewards = SimpleNamespace(names=terms)
    cfg = SimpleNamespace(rewards=SimpleNamespace(times_dt=True))
    history = History(SimpleNamespace(rewards=rewards, cfg=cfg, dt=dt))
    history.feet = feet
    history.rows = samples
    return history


def sample(time: float, *, contacts=(0.0, 0.0), rewards=(0.0, 0.0), speed: float = 0.0) -> np.ndarray:
    return np.array([time, speed, *[0.0] * 5, *contacts, *rewards])


@pytest.mark.slow
def test_ten_seconds_are_kept_of_the_robot_that_is_followed():
    task = small_task(num_envs=2)
    history = History(task)
    assert history.feet == ("LF_FOOT", "RF_FOOT", "LH_FOOT", "RH_FOOT")
    for step in range(3):
        task.step(zero_actions(task))
        history.add(task, 1, 0.02 * step)
    assert history.curves()["times"] == pytest.approx([-0.04, -0.02, 0.0])
    assert history.curves()["actual"][:2, -1] == pytest.approx(task.base_lin_vel[1, :2].numpy())
    assert history.curves()["commanded"][:, -1] == pytest.approx(task.commands[1, :3].numpy())
    assert history.curves()["contacts"][:, -1] == pytest.approx(task.contacts.in_contact[1].float().numpy())
    last = history.rows[-1][11:]
    assert last == pytest.approx((task.rewards.last[:, 1] / task.dt).numpy())
    assert last.sum() * task.dt == pytest.approx(float(task.rew_buf[1]), abs=1e-6)
    for _ in range(600):
        history.add(task, 1, 0.0)
    assert len(history.rows) == KEPT_S / task.dt


@pytest.mark.slow
def test_an_episode_that_ends_breaks_the_curves():
    task = small_task(("env.episode_length_s", 0.08), num_envs=1)
    history = History(task)
    for step in range(6):
        task.step(zero_actions(task))
        history.add(task, 0, 0.02 * step)
    assert np.isnan(history.curves()["actual"][0]).tolist() == [False, False, False, True, False, False]
    assert np.isnan(history.curves()["rewards"][0]).tolist() == [False, False, False, True, False, False]


def test_rewards_are_means_over_a_fifth_of_a_second():
    history = history_of([sample(0.1 * k, rewards=(value, 1.0)) for k, value in enumerate((0.0, 4.0, 2.0, 0.0))])
    assert history.curves()["rewards"][0] == pytest.approx([0.0, 2.0, 3.0, 1.0])  # two steps of 0.1 s each
    assert history.curves()["rewards"][1] == pytest.approx([1.0] * 4)


def test_bars_cover_the_steps_in_which_a_foot_is_on_the_ground():
    on = [(1, 0), (1, 0), (0, 0), (0, 1), (1, 1)]
    found = history_of([sample(0.1 * k, contacts=feet) for k, feet in enumerate(on)]).curves()
    page = ElementTree.fromstring(gait_diagram(("LF_FOOT", "RF_FOOT"), found["times"], found["contacts"], 0.1))
    assert [row.text for row in page.iter("span")] == ["LF", "RF"]
    bars = [[(float(bar.get("x")), float(bar.get("width"))) for bar in svg] for svg in page.iter("svg")]
    assert bars[0] == [pytest.approx((-0.5, 0.2)), pytest.approx((-0.1, 0.1))]  # start before now, and length [s]
    assert bars[1] == [pytest.approx((-0.2, 0.2))]
    assert {svg.get("viewBox") for svg in page.iter("svg")} == {f"{-KEPT_S:g} 0 {KEPT_S:g} 1"}


def test_the_largest_reward_terms_have_curves_and_the_others_are_summed():
    terms = tuple(f"part_{i}" for i in range(9))
    history = history_of([sample(0.1 * k, rewards=np.arange(9.0)) for k in range(5)], terms)
    names, curves = reward_curves(terms, history.curves()["rewards"])
    assert names == [*terms[3:], "3 others"]
    assert len(names) == LARGEST + 1
    assert [curve[-1] for curve in curves] == pytest.approx([3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 0.0 + 1.0 + 2.0])
    few, _ = reward_curves(terms[:7], np.zeros((7, 0)))
    assert few == [*terms[:6], terms[6]]  # a single other term keeps its name


class Gui:
    """Stands in for viser's server: keeps the options of the charts, and allows assignments to them."""

    def __init__(self):
        self.gui = self
        self.charts, self.html = [], SimpleNamespace(content="")

    def add_uplot(self, data, series, **options):
        self.charts.append(SimpleNamespace(data=data, series=series, **options))
        return self.charts[-1]

    def add_html(self, content):
        return self.html

    def atomic(self):
        return self

    def __enter__(self):
        return self

    def __exit__(self, *failure):
        return None


def test_charts_get_the_samples_of_the_robot():
    samples = [sample(0.1 * k, rewards=(1.0, -1.0), speed=0.3, contacts=(1, 0)) for k in range(400)]
    history, gui = history_of(samples), Gui()
    plots = LivePlots(gui, history, has_commands=True)
    plots.update(history)
    assert [chart.title for chart in gui.charts] == ["vx [m/s]", "vy [m/s]", "yaw rate [rad/s]", "reward terms [1/s]"]
    times, commanded, actual = gui.charts[0].data
    assert times[0] == pytest.approx(-39.9)
    assert (len(times) <= MOST_POINTS, len(times) == len(actual)) == (True, True)
    assert (set(actual), set(commanded)) == ({0.3}, {0.0})
    assert [line["label"] for line in gui.charts[0].series] == ["time [s]", "commanded", "actual"]
    for chart in gui.charts:
        assert len(chart.data) == len(chart.series)
    assert "LF" in gui.html.content
    assert [curve[-1] for curve in gui.charts[-1].data[1:]] == pytest.approx([1.0, -1.0])


def test_reward_curves_have_new_names_when_other_terms_are_the_largest():
    terms = tuple(f"part_{i}" for i in range(9))
    history, gui = history_of([], terms), Gui()
    plots = LivePlots(gui, history, has_commands=False)
    assert [chart.title for chart in gui.charts] == ["forward velocity [m/s]", "reward terms [1/s]"]
    history.rows = [sample(0.1 * k, rewards=np.arange(9.0)) for k in range(5)]
    before = gui.charts[-1].series
    plots.update(history)
    assert [line["label"] for line in gui.charts[-1].series[1:]] == [*terms[3:], "3 others"]
    assert gui.charts[-1].series != before
    assert len({line["stroke"] for line in gui.charts[-1].series[1:]}) == LARGEST + 1
    same = gui.charts[-1].series
    plots.update(history)
    assert gui.charts[-1].series is same  # a chart whose series are assigned is built anew in the browser
