"""Live plots: what is kept of a robot, and what is drawn of it."""

from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
from helpers import small_task, zero_actions

from legged.play.live import plots
from legged.play.live.history import KEPT_S, History, Sample
from legged.play.live.plots import (
    LEFT,
    RIGHT,
    WIDTH,
    Curve,
    figure,
    gait_figure,
    reward_figure,
    short,
    tick_step,
    velocity_figures,
)

SVG = "{http://www.w3.org/2000/svg}"


def history_of(samples: list[Sample], terms=("speed", "torques"), feet=("LF_FOOT", "RF_FOOT"), dt: float = 0.1) -> History:
    """A history of made-up samples."""
    rewards = SimpleNamespace(names=terms)
    cfg = SimpleNamespace(rewards=SimpleNamespace(times_dt=True))
    history = History(SimpleNamespace(rewards=rewards, cfg=cfg, dt=dt))
    history.feet = feet
    history._samples = samples
    return history


def sample(time: float, *, contacts=(0.0, 0.0), rewards=(0.0, 0.0), speed: float = 0.0) -> Sample:
    return Sample(time, np.array([speed, 0.0, 0.0]), np.zeros(3), np.array(contacts), np.array(rewards))


def drawn(svg: str) -> ElementTree.Element:
    """The figure as a tree."""
    return ElementTree.fromstring(svg)


def texts(svg: str) -> list[str]:
    return [text.text for text in drawn(svg).iter(f"{SVG}text")]


def test_ten_seconds_are_kept_of_the_robot_that_is_followed():
    task = small_task(num_envs=2)
    history = History(task)
    assert history.feet == ("LF_FOOT", "RF_FOOT", "LH_FOOT", "RH_FOOT")
    for step in range(3):
        task.step(zero_actions(task))
        history.add(task, 1, 0.02 * step)
    assert history.times() == pytest.approx([-0.04, -0.02, 0.0])
    assert history.actual()[:2, -1] == pytest.approx(task.base_lin_vel[1, :2].numpy())
    assert history.commanded()[:, -1] == pytest.approx(task.commands[1, :3].numpy())
    assert history.contacts()[:, -1] == pytest.approx(task.contacts.in_contact[1].float().numpy())
    last = history._samples[-1].rewards
    assert last == pytest.approx((task.rewards.last[:, 1] / task.dt).numpy())
    assert last.sum() * task.dt == pytest.approx(float(task.rew_buf[1]), abs=1e-6)
    for step in range(600):
        history._samples.append(history._samples[-1])
        if step % 100 == 0:
            history.add(task, 1, 0.0)
    assert len(history) <= KEPT_S / task.dt + 100
    history.add(task, 1, 0.0)
    assert len(history) == KEPT_S / task.dt


def test_an_episode_that_ends_breaks_the_curves():
    task = small_task(("env.episode_length_s", 0.08), num_envs=1)
    history = History(task)
    for step in range(6):
        task.step(zero_actions(task))
        history.add(task, 0, 0.02 * step)
    assert np.isnan(history.actual()[0]).tolist() == [False, False, False, True, False, False]
    assert np.isnan(history.rewards()[0]).tolist() == [False, False, False, True, False, False]
    svg = figure("vx [m/s]", history.times(), [Curve("actual", history.actual()[0], "#000000")], 60.0)
    lines = [line.get("points").split() for line in drawn(svg).iter(f"{SVG}polyline")]
    assert [len(points) for points in lines] == [3, 2]


def test_rewards_are_means_over_a_fifth_of_a_second():
    history = history_of([sample(0.1 * k, rewards=(value, 1.0)) for k, value in enumerate((0.0, 4.0, 2.0, 0.0))])
    assert history.rewards()[0] == pytest.approx([0.0, 2.0, 3.0, 1.0])  # two steps of 0.1 s each
    assert history.rewards()[1] == pytest.approx([1.0] * 4)


def test_bars_stand_for_the_steps_in_which_a_foot_stood():
    on = [(1, 0), (1, 0), (0, 0), (0, 1), (1, 1)]
    svg = gait_figure(history_of([sample(0.1 * k, contacts=feet) for k, feet in enumerate(on)]))
    bars = [bar for bar in drawn(svg).iter(f"{SVG}rect") if bar.get("fill") == plots.ACTUAL]
    second = (WIDTH - LEFT - RIGHT) / KEPT_S
    assert [float(bar.get("width")) / second for bar in bars] == pytest.approx([0.2, 0.1, 0.2], abs=0.005)
    ends = [float(bar.get("x")) + float(bar.get("width")) for bar in bars]
    now = WIDTH - RIGHT
    assert [(end - now) / second for end in ends] == pytest.approx([-0.3, 0.0, 0.0], abs=0.005)
    assert {"LF", "RF", "time [s]", "feet on the ground"} <= set(texts(svg))


def test_axes_have_units_and_the_largest_parts_of_the_reward_are_named():
    terms = tuple(f"part_{i}" for i in range(9))
    history = history_of([sample(0.1 * k, rewards=np.arange(9.0)) for k in range(5)], terms)
    svg = reward_figure(history)
    assert "reward parts [1/s]" in texts(svg)
    assert [text for text in texts(svg) if "part_" in text or "others" in text] == [*terms[3:], "3 others"]
    others = [line for line in drawn(svg).iter(f"{SVG}polyline") if line.get("stroke-dasharray")]
    assert len(others) == 1  # 0 + 1 + 2, as high as part_3
    third = next(iter(drawn(svg).iter(f"{SVG}polyline")))
    assert others[0].get("points") == third.get("points")
    history.per_second = False
    assert "reward parts [1/step]" in texts(reward_figure(history))
    assert len({*plots.COLORS[: plots.PARTS], plots.OTHERS}) == plots.PARTS + 1

    whole = f"<div>{velocity_figures(history, True)}</div>"
    names = [text.text for text in ElementTree.fromstring(whole).iter(f"{SVG}text")]
    assert {"vx [m/s]", "vy [m/s]", "yaw rate [rad/s]", "commanded", "actual", "time [s]"} <= set(names)
    assert "forward velocity [m/s]" in texts(velocity_figures(history, False))


def test_a_point_is_where_its_axis_says():
    svg = figure("name", np.array([-10.0, -5.0, 0.0]), [Curve("a", np.array([0.0, 1.0, 2.0]), "#000000")], 100.0)
    points = next(iter(drawn(svg).iter(f"{SVG}polyline"))).get("points").split()
    found = [tuple(map(float, point.split(","))) for point in points]
    assert [x for x, _ in found] == pytest.approx([LEFT, 0.5 * (LEFT + WIDTH - RIGHT), WIDTH - RIGHT])
    ticks = {text.text: float(text.get("y")) for text in drawn(svg).iter(f"{SVG}text") if text.get("text-anchor") == "end"}
    assert [y + 3.5 for _, y in found] == pytest.approx([ticks["0"], ticks["1"], ticks["2"]], abs=0.1)


@pytest.mark.parametrize("values", [[], [float("nan")] * 3, [0.0] * 3, [1e-9, 0.0, 0.0], [1e6, -1e6, 0.0]])
def test_whatever_there_is_gives_a_figure(values):
    times = np.linspace(-1.0, 0.0, len(values))
    svg = figure("a < b & c", times, [Curve("x", np.array(values), "#000000")], 60.0, least=0.5)
    assert "a < b & c" in texts(svg)
    assert "nan" not in svg
    assert "inf" not in svg


@pytest.mark.parametrize(
    ("span", "most", "step"), [(1.0, 5, 0.2), (1.0, 3, 0.5), (7.0, 5, 2.0), (0.03, 3, 0.01), (2e6, 5, 5e5)]
)
def test_ticks_are_round(span, most, step):
    assert tick_step(span, most) == pytest.approx(step)


def test_names_are_short():
    feet = ("LF_FOOT", "RF_FOOT", "LH_FOOT", "RH_FOOT")
    assert [short(name, feet) for name in feet] == ["LF", "RF", "LH", "RH"]
    assert [short(name, ("foot_left", "foot_right")) for name in ("foot_left", "foot_right")] == ["left", "right"]
    assert short("FL_calf_contact", ("FL_calf_contact", "FR_calf_contact")) == "FL"
    assert short("only", ("only",)) == "only"
