"""What is said of episodes: figures, their order, statistics of joints; numbers worked by hand."""

import numpy as np
import pytest
from handmade import DT, JOINTS, LIMIT, made_by_hand

from legged.episodes.joint_statistics import (
    PHASES,
    SETTLE_S,
    cycles_of,
    joint_statistics,
    notes_of,
    resampled,
    tables_of,
)
from legged.episodes.page import Panels, groups_of
from legged.episodes.ranking import counts_text, figures_of, listing, order_of
from legged.errors import ConfigError
from legged.evaluation.reports.document import text_of
from legged.tables import markdown_table

SETTLED = round(SETTLE_S / DT)


def test_figures_are_those_of_their_definitions():
    episodes = made_by_hand(4, 2)
    episodes["reward"][:] = [1.0, 2.0, 3.0, 4.0, -1.0, -2.0]
    episodes["command"][:, 0], episodes["base_lin_vel"][:, 0] = 1.0, [1.0, 0.0, 1.0, 0.0, 1.5, 1.5]
    episodes["base_ang_vel"][4:, 2] = -0.5
    episodes["torque"][0, 1], episodes["joint_vel"][0, 1] = -30.0, 2.0
    episodes["torque"][5, 3], episodes["joint_vel"][5, 3] = 10.0, -4.0
    figures = figures_of(episodes)
    want = {
        "length": [4 * DT, 2 * DT],
        "return": [10.0, -3.0],
        "tracking": [np.sqrt(0.5), 0.5],
        "turning": [0.0, 0.5],
        "energy": [60.0 * DT, 40.0 * DT],
        "power": [15.0, 20.0],
        "torque": [100.0 * 30.0 / LIMIT, 100.0 * 10.0 / LIMIT],
    }
    assert figures.values.keys() == want.keys()
    for name, values in want.items():
        np.testing.assert_allclose(figures.values[name], values, rtol=1e-6, err_msg=name)
    assert figures.strained == ["right_hip", "right_knee"]


def test_what_failed_comes_first_and_then_what_is_worst():
    contact, tilt = (True, False), (False, True)
    episodes = made_by_hand(9, 5, 9, 3, failed=(False, True, False, True), ended_by=((False, False), contact, tilt, contact))
    episodes["command"][episodes.rows(2), 0] = 1.0
    figures = figures_of(episodes)
    assert figures.ended == [["time"], ["contact"], ["tilt"], ["contact"]]
    assert order_of(figures, "fell") == [3, 1, 2, 0]
    assert order_of(figures, "length") == [3, 1, 0, 2]
    assert order_of(figures, "tracking")[0] == 2
    assert order_of(figures, "length", "contact") == [3, 1]
    assert counts_text(figures) == "4 episodes, 2 failed; ended: 2 by contact, 1 by time, 1 by tilt"
    assert order_of(figures, "fell", "non_finite") == []
    with pytest.raises(ConfigError, match="--ended: contakt: no such term ends episodes; did you mean 'contact'"):
        order_of(figures, "fell", "contakt")
    with pytest.raises(ConfigError, match="--sort: speed: these episodes have no such figure"):
        order_of(figures, "speed")


def test_what_blew_up_is_the_worst_of_all():
    episodes = made_by_hand(3, 3, 3, failed=(False, True, False))
    episodes["torque"][4] = np.nan
    episodes["reward"][4] = np.nan
    episodes["torque"][0, 0] = 39.0
    figures = figures_of(episodes)
    assert figures.ended[1] == ["non_finite"]
    for by in ("torque", "energy", "return", "fell"):
        assert order_of(figures, by)[0] == 1, by


def test_a_list_is_a_table_of_markdown():
    figures = figures_of(made_by_hand(2))
    lines = markdown_table(*listing(figures, [0]), left=(1,)).splitlines()
    assert len({line.count("|") for line in lines}) == 1
    assert lines[0].startswith("| episode | ended by | time [s] | return |")
    assert lines[2].startswith("| 0 | time | 0.04 | 0.00 |")


def test_joints_are_summed_up_after_they_have_settled():
    episodes = made_by_hand(SETTLED + 4, SETTLED + 2, SETTLED)
    episodes["joint_pos"][:, 0] = 100.0  # counts for nothing where it is not replaced
    for number, values in ((0, [1.0, 2.0, 3.0, 4.0]), (1, [6.0, 8.0])):
        episodes["joint_pos"][episodes.rows(number), 0] = [100.0] * SETTLED + values
    found = joint_statistics(episodes)
    values = np.array([1.0, 2.0, 3.0, 4.0, 6.0, 8.0])
    assert (found.episodes, found.steps) == (2, 6)
    assert found.mean["joint_pos"][0] == pytest.approx(4.0)
    assert found.std["joint_pos"][0] == pytest.approx(np.sqrt(np.mean((values - 4.0) ** 2)))
    assert found.units["joint_vel"] == ["rad/s"] * len(JOINTS)
    with pytest.raises(ConfigError, match="longer than 1 s"):
        joint_statistics(made_by_hand(SETTLED))


def test_steps_and_cycles_without_numbers_are_left_out_and_counted():
    episodes = made_by_hand(SETTLED + 4, SETTLED + 60)
    episodes["joint_pos"][SETTLED : SETTLED + 4, 0] = [1.0, 2.0, 9.0, np.nan]
    episodes["torque"][SETTLED + 2, 3] = np.inf
    second = slice(2 * SETTLED + 4, None)
    episodes["joint_pos"][second, 0] = 1.5
    for begin in (5, 25, 45):
        episodes["feet_contact"][second, 0][begin : begin + 8] = 1.0
    episodes["joint_vel"][second, 1][45] = np.nan  # the touch-down that ends the second cycle
    found = joint_statistics(episodes)
    assert (found.episodes, found.steps, found.lost) == (2, 2 + 59, 3)
    assert found.mean["joint_pos"][0] == pytest.approx(1.5)
    assert found.std["joint_pos"][0] == pytest.approx(np.sqrt(0.5 / 61))
    for values in (*found.mean.values(), *found.std.values(), *found.over_cycle("joint_vel")):
        assert np.isfinite(values).all()
    assert len(found.cycle_s) == 1
    assert "A: 2 episodes, 61 control steps; 3 more are left out" in notes_of({"A": found})
    episodes["joint_pos"][:] = np.nan
    with pytest.raises(ConfigError, match="POLICY: physics blew up: no step of 'by_hand'"):
        joint_statistics(episodes)


def test_a_cycle_goes_from_one_touch_down_to_the_next():
    down = np.zeros(60)
    for begin in (5, 25, 45):
        down[begin : begin + 8] = 1.0
    assert cycles_of(down, DT) == [(5, 25), (25, 45)]
    assert cycles_of(np.ones(60), DT) == []
    down[:] = 0.0
    down[[3, 5]] = 1.0  # bounced: 0.04 s
    assert cycles_of(down, DT) == []
    line = np.arange(60.0)[:, None]
    np.testing.assert_allclose(resampled(line, 5, 25)[:, 0], 5.0 + 20.0 * np.arange(PHASES) / PHASES)


def test_joints_over_the_cycle_are_those_of_a_wave():
    """A wave of the gait's period has no deviation over cycles, and its mean over them is the wave."""
    period, rows = 20, SETTLED + 10 + 5 * 20
    episodes = made_by_hand(rows)
    steps = np.arange(rows) - SETTLED - 5
    episodes["joint_pos"][:, 2] = np.sin(2.0 * np.pi * steps / period)
    for foot, stance in enumerate((12, 5)):  # a contact is held for a step more than the foot feels the ground
        episodes["feet_force"][:, foot, 2] = np.where((steps % period) < stance, 50.0, 0.5)
        episodes["feet_contact"][:, foot] = (steps % period) < stance + 1
    found = joint_statistics(episodes)
    mean, std = found.over_cycle("joint_pos")
    assert found.cycle_s == pytest.approx(np.full(len(found.cycle_s), period * DT))
    assert len(found.cycle_s) == 5
    np.testing.assert_allclose(mean[:, 2], np.sin(2.0 * np.pi * np.arange(PHASES) / PHASES), atol=0.013)  # linear between
    np.testing.assert_allclose(std, 0.0, atol=1e-5)
    assert found.duty == pytest.approx({"left_foot": 0.6, "right_foot": 0.25})
    assert "touch-down of left_foot to its next" in notes_of({"A": found})


def test_two_policies_are_compared_joint_by_joint():
    one, other = made_by_hand(SETTLED + 2), made_by_hand(SETTLED + 2)
    one["torque"][:, 1], other["torque"][:, 1] = 3.0, 5.5
    both = {"A": joint_statistics(one), "B": joint_statistics(other)}
    row = tables_of(both)["torque [N m]"].rows[1]
    assert [text_of(cell) for cell in row] == ["right_hip", "3.000", "0.000", "5.500", "0.000", "+2.500"]
    other.about["joints"] = [*other.about["joints"][:3], {**other.about["joints"][3], "name": "tail"}]
    with pytest.raises(ConfigError, match=r"POLICY: the joints of the two policies differ \(right_knee, tail\)"):
        tables_of({"A": both["A"], "B": joint_statistics(other)})


def test_joints_of_different_legs_share_a_plot():
    assert groups_of(["LF_HAA", "LF_KFE", "RF_HAA", "RF_KFE"]) == [("HAA", [0, 2]), ("KFE", [1, 3])]
    assert groups_of(["left-hip-pitch", "torso", "right-hip-pitch"]) == [("hip pitch", [0, 2]), ("torso", [1])]
    assert groups_of(["bthigh", "fthigh"]) == [("bthigh", [0]), ("fthigh", [1])]


def test_what_a_failure_costs_once_is_said_and_not_drawn():
    """Else it would be all that one sees."""
    episodes = made_by_hand(3)
    episodes.about["arrays"] = {**episodes.about["arrays"], "reward_parts": {"columns": ["tracking", "termination"]}}
    episodes["reward_parts"][:] = [[0.01, 0.0], [0.01, 0.0], [0.0, -2.0]]
    section = next(one for one in Panels(episodes, 0).sections() if one["title"] == "Reward parts")
    assert [line["label"] for line in section["panels"][0]["lines"]] == ["tracking"]
    assert "-2 at the end" in section["note"]


def test_parts_without_a_colour_of_their_own_are_drawn_as_one():
    episodes = made_by_hand(2)
    names = [f"part {i}" for i in range(10)]
    episodes.about["arrays"] = {**episodes.about["arrays"], "reward_parts": {"columns": names}}
    episodes.arrays["reward_parts"] = np.tile(-0.02 * np.arange(10.0), (2, 1))  # part 0 is never paid
    panels = Panels(episodes, 0)
    section = next(one for one in panels.sections() if one["title"] == "Reward parts")
    labels = [line["label"] for line in section["panels"][0]["lines"]]
    assert labels == [f"part {i}" for i in range(9, 2, -1)] + ["2 others"]
    np.testing.assert_allclose(panels.arrays["other_parts"], -(1.0 + 2.0))


def test_plots_of_an_episode_show_its_own_numbers():
    episodes = made_by_hand(3, 4)
    episodes["contact_force"][4, 2] = 30.0
    episodes["qpos"][3:, 3:7] = [np.cos(0.25), np.sin(0.25), 0.0, 0.0]  # rolled by half a radian
    episodes["reward_parts"][3:] = [0.02, -0.04]
    panels = Panels(episodes, 1)
    sections = {section["title"]: section for section in panels.sections()}
    np.testing.assert_allclose(panels.arrays["tilt"], np.degrees(0.5), rtol=1e-5)
    np.testing.assert_allclose(panels.arrays["reward_parts"], [[1.0, -2.0]] * 4, rtol=1e-6)  # a second
    assert "left out" not in sections["Reward parts"]["note"]
    gait = sections["Feet"]["panels"][0]
    assert [line["label"] for line in gait["lines"]] == ["left", "right", "shin"]
    torques = sections["Torques"]["panels"]
    assert [panel["title"] for panel in torques] == ["torque, hip", "torque, knee"]
    assert torques[0]["limits"] == [-LIMIT, LIMIT]
    assert all(len(array) == 4 for array in panels.arrays.values())
