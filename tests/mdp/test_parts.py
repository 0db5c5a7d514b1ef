"""The parts of the task by themselves: commands, curriculum, contacts, control, rewards, observations, statistics."""

import math

import pytest
import torch

from legged.config.legged import CommandCurriculumConfig, CommandRanges, CommandsConfig
from legged.config.robot import RobotControlConfig
from legged.errors import TermError
from legged.mdp.command_curriculum import CommandCurriculum
from legged.mdp.commands import Commands
from legged.mdp.contacts import FeetContacts
from legged.mdp.control import Control
from legged.mdp.rewards import Rewards
from legged.robots.robot import load_robot
from legged.state import StateError, load_state, state_of

CPU = torch.device("cpu")
DT = 0.02
MANY = 20_000
UPRIGHT = torch.tensor([1.0, 0.0, 0.0, 0.0])
RANGES = CommandRanges(lin_vel_x=(-0.6, 1.1), lin_vel_y=(-0.4, 0.4), ang_vel_yaw=(-0.7, 0.9), heading=(-1.0, 2.0))


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


def commands(num_envs=MANY, **settings) -> Commands:
    """Commands without heading mode, sampled once for every robot."""
    cfg = CommandsConfig(**{"ranges": RANGES, "heading_command": False, "small_command": 0.0, **settings})
    sampler = Commands(cfg, num_envs, DT, CPU)
    sampler.numbers.draw()
    sampler.draw()
    sampler.update(torch.ones(num_envs, dtype=torch.bool), UPRIGHT.expand(num_envs, 4))
    return sampler


def mask(*values) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.bool)


def quat_of_yaw(yaw: float) -> torch.Tensor:
    return torch.tensor([math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)])


# ---- commands --------------------------------------------------------------------------------------------------------


def test_commands_fill_their_ranges_and_stay_inside():
    values = commands().commands
    for i, (low, high) in enumerate((RANGES.lin_vel_x, RANGES.lin_vel_y, RANGES.ang_vel_yaw, RANGES.heading)):
        width = high - low
        assert low <= values[:, i].min() < low + 0.01 * width
        assert high - 0.01 * width < values[:, i].max() <= high
        assert values[:, i].mean() == pytest.approx((low + high) / 2, abs=0.02 * width)


def test_ranges_that_a_curriculum_narrows_are_sampled():
    sampler = Commands(CommandsConfig(heading_command=False, small_command=0.0), MANY, DT, CPU)
    sampler.ranges.copy_(torch.tensor([[-0.1, 0.2], [0.0, 0.0], [0.3, 0.4]]))
    sampler.numbers.draw()
    sampler.draw()
    sampler.update(torch.ones(MANY, dtype=torch.bool), UPRIGHT.expand(MANY, 4))
    vx, vy, yaw = sampler.commands[:, :3].unbind(dim=1)
    assert vx.min() >= -0.1
    assert 0.19 < vx.max() <= 0.2
    assert (vy == 0.0).all()
    assert yaw.min() >= 0.3
    assert yaw.max() <= 0.4


def test_small_horizontal_commands_become_zero_and_keep_their_yaw_rate():
    values = commands(small_command=0.2).commands
    norm = values[:, :2].norm(dim=1)
    stopped = norm == 0.0
    assert (norm[~stopped] >= 0.2).all()
    # Share of the rectangle 1.7 x 0.8 that a disk of radius 0.2 covers: 0.1257 / 1.36.
    assert stopped.float().mean() == pytest.approx(0.0924, abs=0.01)
    assert (values[stopped, 2] != 0.0).all()


def test_the_standing_share_gets_no_velocity_at_all():
    sampler = commands(standing_share=0.3)
    standing = (sampler.commands[:, :3] == 0.0).all(dim=1)
    assert standing.float().mean() == pytest.approx(0.3, abs=0.015)
    assert not sampler.is_moving[standing].any()


def test_the_single_axis_share_keeps_one_axis_each_a_third_of_the_time():
    used = commands(single_axis_share=0.6).commands[:, :3] != 0.0
    single = used.sum(dim=1) == 1
    assert single.float().mean() == pytest.approx(0.6, abs=0.015)
    assert (used.sum(dim=1)[~single] == 3).all()
    assert torch.allclose(used[single].float().mean(dim=0), torch.full((3,), 1 / 3), atol=0.02)


def test_standing_robots_are_not_asked_to_turn_in_heading_mode():
    sampler = commands(heading_command=True, standing_share=1.0)
    assert (sampler.commands[:, :3] == 0.0).all()


def test_a_command_is_held_for_exactly_the_resampling_time():
    sampler = commands(num_envs=3, resampling_time_s=4.0)
    quat, never = UPRIGHT.expand(3, 4), mask(False, False, False)
    changes, before = [], sampler.commands.clone()
    for step in range(1, 451):
        # The second robot begins a new episode at step 130, and with it a new command and a full interval.
        sampler.numbers.draw()
        sampler.draw()
        sampler.update(mask(False, step == 130, False) if step == 130 else never, quat)
        changed = (sampler.commands != before).any(dim=1)
        changes += [(step, robot) for robot in range(3) if changed[robot]]
        before = sampler.commands.clone()
    assert changes == [(130, 1), (200, 0), (200, 2), (330, 1), (400, 0), (400, 2)]  # 4 s / 0.02 s = 200 steps


def test_heading_mode_steers_by_half_the_wrapped_error_inside_the_yaw_range():
    ranges = CommandRanges(ang_vel_yaw=(-0.7, 0.9))
    sampler = Commands(CommandsConfig(ranges=ranges, heading_command=True), 5, DT, CPU)
    sampler.time_left.fill_(100.0)
    sampler.commands[:, 3] = torch.tensor([0.5, 3.0, -3.0, 3.0, -3.0])
    yaws = (0.1, -3.0, 3.0, 0.0, 0.0)
    sampler.update(torch.zeros(5, dtype=torch.bool), torch.stack([quat_of_yaw(yaw) for yaw in yaws]))
    # 0.5 * 0.4; 6 rad ahead is 0.2832 behind; and the reverse; 1.5 and -1.5 are clipped.
    expected = torch.tensor([0.2, -0.14159, 0.14159, 0.9, -0.7])
    assert torch.allclose(sampler.commands[:, 2], expected, atol=1e-4)


def test_a_curriculum_holds_the_rates_of_heading_mode_too():
    """They were those of the full range from the start, while the log said that 0.27 is the largest."""
    sampler = commands(heading_command=True)
    sampler.commands[:, 3] = torch.linspace(-3.0, 3.0, MANY)
    sampler.held.fill_(True)
    CommandCurriculum(CommandCurriculumConfig(enabled=True, start=0.3), sampler.full_ranges, DT).write_ranges(sampler.ranges)
    sampler.update(torch.zeros(MANY, dtype=torch.bool), torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(MANY, 4))
    assert sampler.commands[:, 2].aminmax() == pytest.approx((0.3 * -0.7, 0.3 * 0.9))


@pytest.mark.parametrize("heading", [False, True])
def test_held_commands_are_neither_sampled_nor_steered(heading):
    sampler = commands(num_envs=2, heading_command=heading, resampling_time_s=0.1)
    wanted = torch.tensor([[0.5, -0.2, 0.3], [0.0, 0.0, 0.0]])
    sampler.hold(wanted)
    for _ in range(20):
        sampler.numbers.draw()
        sampler.draw()
        sampler.update(mask(True, True), quat_of_yaw(1.0).expand(2, 4))
        assert torch.equal(sampler.commands[:, :3], wanted)
    assert sampler.is_moving.tolist() == [True, False]


def test_turning_on_the_spot_counts_as_moving():
    sampler = commands(num_envs=4)
    sampler.hold(torch.tensor([[0.0, 0.0, 0.2], [0.0, 0.0, 0.09], [0.2, 0.0, 0.0], [0.06, 0.06, 0.06]]))
    assert sampler.is_moving.tolist() == [True, False, True, True]  # 0.06 * sqrt(3) = 0.104


# ---- command curriculum ----------------------------------------------------------------------------------------------

FULL = torch.tensor([[-1.0, 1.0], [-0.5, 0.5], [-2.0, 2.0]])
ALL = torch.tensor([[1.0, 0.5, 2.0]]).repeat(8, 1)  # every robot is asked for the full range of every axis
EVERY = torch.ones(8, dtype=torch.bool)


def curriculum(**settings) -> CommandCurriculum:
    cfg = CommandCurriculumConfig(
        **{"enabled": True, "start": 0.3, "step": 0.2, "window_s": 0.2, "threshold": 0.75, **settings}
    )
    return CommandCurriculum(cfg, FULL, DT)


def run_window(
    found: CommandCurriculum, asked: torch.Tensor, reached: torch.Tensor, valid: torch.Tensor = EVERY
) -> list[float]:
    for _ in range(found.window_steps):
        found.update(asked, reached, reached, valid)
    return found.share.tolist()


def test_standing_still_never_widens_a_range():
    found = curriculum(start=0.01)
    for _ in range(5):
        assert run_window(found, ALL, torch.zeros(8, 3)) == pytest.approx([0.01] * 3)


def test_the_axis_that_is_followed_widens_by_one_step_a_window_up_to_the_full_range():
    found = curriculum()
    assert found.window_steps == 10
    following = ALL * torch.tensor([0.0, 0.8, 0.0])  # 80 % of what is asked sideways, nothing else
    for _ in range(9):
        found.update(ALL, following, following, EVERY)
    assert found.share.tolist() == pytest.approx([0.3] * 3)  # not before the window is over
    found.update(ALL, following, following, EVERY)
    assert found.share.tolist() == pytest.approx([0.3, 0.5, 0.3])
    shares = [run_window(found, ALL, following)[1] for _ in range(4)]
    assert shares == pytest.approx([0.7, 0.9, 1.0, 1.0])
    ranges = torch.zeros(3, 2)
    found.write_ranges(ranges)
    assert torch.allclose(ranges, torch.tensor([[-0.3, 0.3], [-0.5, 0.5], [-0.6, 0.6]]))


@pytest.mark.parametrize(
    ("asked", "factor", "widens"),
    [
        (1.0, 0.76, True),
        (1.0, 0.74, False),  # below the threshold
        (-1.0, 0.9, True),  # backwards is followed too
        (1.0, -0.9, False),  # the wrong way round
        (0.14, 1.0, False),  # less than half of the range in use (0.3) proves nothing
        (0.16, 1.0, True),
    ],
)
def test_what_counts_as_following(asked, factor, widens):
    commands = torch.zeros(8, 3)
    commands[:, 0] = asked
    assert run_window(curriculum(), commands, factor * commands)[0] == pytest.approx(0.5 if widens else 0.3)


def test_robots_whose_physics_blew_up_are_not_judged():
    reached, valid = ALL.clone(), EVERY.clone()
    reached[3], valid[3] = torch.nan, False
    assert run_window(curriculum(), ALL, reached, valid) == pytest.approx([0.5] * 3)


def test_a_curriculum_that_is_off_uses_the_full_range():
    found = curriculum(enabled=False)
    assert run_window(found, ALL, torch.zeros(8, 3)) == [1.0] * 3
    assert found.metrics() == {}


def test_the_curriculum_s_progress_survives_a_round_trip():
    found, other = curriculum(), curriculum()
    run_window(found, ALL, ALL * torch.tensor([1.0, 0.0, 1.0]))
    state = found.progress()
    run_window(found, ALL, ALL)  # a saved state is not changed by what comes after it
    other.load_progress(state)
    assert other.share.tolist() == pytest.approx([0.5, 0.3, 0.5])
    widest = {name: float(value) for name, value in other.metrics().items()}
    assert widest == pytest.approx({"command_vx": 0.5, "command_vy": 0.15, "command_yaw": 1.0})


def test_a_curriculum_that_is_off_ignores_the_narrow_ranges_of_an_earlier_training():
    narrow, off = curriculum(), curriculum(enabled=False)
    off.load_progress(narrow.progress())
    assert off.share.tolist() == [1.0] * 3


# ---- feet ------------------------------------------------------------------------------------------------------------


def feel(contacts: FeetContacts, *vertical: float) -> None:
    forces = torch.zeros(1, len(vertical), 3)
    forces[0, :, 2] = torch.tensor(vertical)
    forces[0, :, 0] = 50.0  # sideways forces are no contact
    contacts.update(forces)


def test_a_swing_is_timed_from_lift_off_to_touch_down():
    contacts = FeetContacts(1, 2, DT, CPU)
    # Foot 0: down, lifts, swings, touches down at step 7. Foot 1 stays on the ground. The foot that lifts at step 3 is
    # still taken for a standing one there; its swing is steps 4, 5, 6 and 7: 4 * 0.02 s.
    forces = [200.0, 200.0, 0.0, 0.0, 0.5, 0.0, 200.0, 200.0]
    in_contact = [True, True, True, False, False, False, True, True]
    air_time = [0.0, 0.0, 0.0, 0.02, 0.04, 0.06, 0.0, 0.0]
    contact_time = [0.02, 0.04, 0.06, 0.0, 0.0, 0.0, 0.02, 0.04]
    for step in range(8):
        feel(contacts, forces[step], 100.0)
        assert contacts.in_contact.tolist() == [[in_contact[step], True]]
        assert contacts.first_contact.tolist() == [[step == 6, False]]
        assert contacts.air_time[0].tolist() == pytest.approx([air_time[step], 0.0])
        assert contacts.last_air_time[0].tolist() == pytest.approx([0.08 if step >= 6 else 0.0, 0.0])
        assert contacts.contact_time[0].tolist() == pytest.approx([contact_time[step], 0.02 * (step + 1)])


def test_one_missing_sample_does_not_split_a_stance():
    contacts = FeetContacts(1, 1, DT, CPU)
    feel(contacts, 200.0)
    for step, force in enumerate((200.0, 0.0, 200.0, 0.0, 200.0)):
        feel(contacts, force)
        assert contacts.in_contact.item()
        assert not contacts.first_contact.item()
        assert contacts.air_time.item() == 0.0
        assert contacts.contact_time.item() == pytest.approx(DT * (step + 2))


def test_a_reset_forgets_the_swing_of_the_masked_robots_only():
    contacts = FeetContacts(2, 1, DT, CPU)
    for force in (0.0, 0.0, 0.0, 200.0, 0.0, 0.0):
        contacts.update(torch.tensor([0.0, 0.0, force]).expand(2, 1, 3))
    assert contacts.air_time.flatten().tolist() == pytest.approx([0.02, 0.02])
    contacts.reset(mask(True, False))
    assert contacts.air_time.flatten().tolist() == pytest.approx([0.0, 0.02])
    assert contacts.last_air_time.flatten().tolist() == pytest.approx([0.0, 0.08])
    contacts.update(torch.tensor([0.0, 0.0, 200.0]).expand(2, 1, 3))
    assert contacts.first_contact.flatten().tolist() == [False, True]
    contacts.reset(mask(False, True))
    assert contacts.contact_time.flatten().tolist() == pytest.approx([0.02, 0.0])


def test_a_state_that_was_saved_before_stances_were_timed_does_not_fit():
    """A resumed run begins new episodes then, as with any state that does not fit."""
    contacts = FeetContacts(2, 4, DT, CPU)
    saved = state_of(contacts)
    saved["_times"] = saved["_times"][:, :2].clone()
    with pytest.raises(StateError, match=r"FeetContacts\._times is \(2, 2, 4\) float32, not \(2, 3, 4\)"):
        load_state(contacts, saved)


# ---- control ---------------------------------------------------------------------------------------------------------


def control(kind: str | dict[str, str]) -> Control:
    """ANYmal C with gains 10 / 2, 20 / 3 and 30 / 4 for HAA, HFE and KFE, two robots, 5 ms."""
    cfg = RobotControlConfig(
        control_type=kind,
        stiffness={"HAA": 10.0, "HFE": 20.0, "KFE": 30.0},
        damping={"HAA": 2.0, "HFE": 3.0, "KFE": 4.0},
        action_scale=0.5,
    )
    return Control(load_robot("anymal_c"), cfg, torch.zeros(2, 12), 0.005)


def rows(*first_leg: float) -> torch.Tensor:
    """(2, 12): the left front leg's HAA, HFE and KFE as given, the other legs zero."""
    values = torch.zeros(2, 12)
    values[:, :3] = torch.tensor(first_leg)
    return values


def test_position_control_by_hand():
    law = control("P")
    law.set_actions(rows(1.0, 0.2, -0.4))
    # Targets 0.5, 0.1 + 0.4, -0.2 - 0.8.
    torques = law.compute(rows(0.1, 0.0, -1.5), rows(1.0, -2.0, 0.5))
    assert torques[0, :3].tolist() == pytest.approx([10 * 0.4 - 2 * 1, 20 * 0.5 + 3 * 2, 30 * 0.5 - 4 * 0.5])
    assert torques is law.torques
    # Right hind leg, action 0 at angle 0: its own default angles 0, -0.4, 0.8 pull.
    assert torques[0, 9:].tolist() == pytest.approx([0.0, -8.0, 24.0])


def test_gains_vary_by_robot_and_properties_drawn_at_the_start_stay():
    law = control("P")
    law.vary({"p_gain": torch.tensor([0.5, 2.0]), "torque_limit": torch.full((2, 12), 0.25)})
    law.vary({"d_gain": torch.tensor([[1.5], [0.0]])})
    assert law.stiffness[:, :3].flatten().tolist() == [5.0, 10.0, 15.0, 20.0, 40.0, 60.0]
    assert law.damping[:, :3].flatten().tolist() == [3.0, 4.5, 6.0, 0.0, 0.0, 0.0]
    law.set_actions(rows(10.0, 10.0, 10.0))
    assert law.compute(rows(0.0, 0.0, 0.0), rows(-1.0, 0.0, 0.0))[:, 0].tolist() == [20.0, 20.0]  # a quarter of 80 N m


def test_velocity_control_by_hand_remembers_the_last_velocity_and_forgets_it_at_a_reset():
    law = control("V")
    law.set_actions(rows(2.0, 0.0, -2.0))
    torques = law.compute(rows(9.0, 9.0, 9.0), rows(0.1, 0.0, 0.0))
    # 10 (1 - 0.1) - 2 * 0.1 / 0.005; 0; 30 (-1 - 0).
    assert torques[0, :3].tolist() == pytest.approx([9 - 40, 0.0, -30.0], abs=1e-4)
    law.reset(mask(True, False))
    torques = law.compute(rows(9.0, 9.0, 9.0), rows(0.12, 0.0, 0.0))
    assert torques[:, 0].tolist() == pytest.approx([8.8 - 48, 8.8 - 8], abs=1e-4)


def test_torque_control_is_the_scaled_action():
    law = control("T")
    law.set_actions(rows(1.0, -3.0, 20.0))
    assert law.compute(rows(1, 1, 1), rows(1, 1, 1))[1, :3].tolist() == [0.5, -1.5, 10.0]


def test_each_joint_may_have_its_own_law():
    law = control({"HAA": "P", "HFE": "V", "KFE": "T"})
    law.set_actions(rows(1.0, 2.0, -3.0))
    torques = law.compute(rows(0.1, 9.0, 9.0), rows(1.0, 0.1, 9.0))
    # 10 (0.5 - 0.1) - 2 * 1; 20 (1 - 0.1) - 3 * 0.1 / 0.005; -1.5. Action 0 of other legs: default angles of HFE count not.
    assert torques[0, :3].tolist() == pytest.approx([2.0, 18 - 60, -1.5], abs=1e-4)
    assert torques[0, 9:].tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("kind", ["P", "V", "T"])
def test_torques_are_clipped_at_the_motors_80_newton_metres(kind):
    law = control(kind)
    law.set_actions(rows(1000.0, -1000.0, 0.0))
    assert law.compute(torch.zeros(2, 12), torch.zeros(2, 12))[0, :2].tolist() == [80.0, -80.0]


# ---- rewards ---------------------------------------------------------------------------------------------------------


def rewards(only_positive: bool, **terms: tuple[float, list[float]]) -> Rewards:
    functions = {name: lambda value=value: torch.tensor(value) for name, (_, value) in terms.items()}
    scales = {name: scale for name, (scale, _) in terms.items()}
    return Rewards(functions, scales, DT, only_positive, torch.zeros(3))


TERMS = {"good": (2.0, [1.0, 1.0, 3.0]), "bad": (-5.0, [0.1, 1.0, 0.0]), "termination": (-10.0, [0.0, 1.0, 1.0])}
VALID = torch.ones(3, dtype=torch.bool)


def test_a_reward_is_the_sum_of_scale_times_step_times_term():
    total = rewards(False, **TERMS).compute(VALID)
    # 0.02 (2 - 0.5); 0.02 (2 - 5 - 10); 0.02 (6 - 10)
    assert total.tolist() == pytest.approx([0.03, -0.26, -0.08])


def test_the_sum_is_clipped_at_zero_before_termination_is_added():
    assert rewards(True, **TERMS).compute(VALID).tolist() == pytest.approx([0.03, -0.2, 0.12 - 0.2])


@pytest.mark.parametrize("only_positive", [False, True])
def test_robots_whose_physics_blew_up_get_zero_even_if_a_term_is_nan(only_positive):
    terms = {**TERMS, "broken": (1.0, [0.0, math.nan, 0.0])}
    found = rewards(only_positive, **terms)
    total = found.compute(mask(True, False, True))
    assert total[1] == 0.0
    assert total[[0, 2]].tolist() == pytest.approx([0.03, -0.08])
    assert torch.isfinite(found.sums).all()


def test_episode_sums_add_up_by_term_and_start_anew_at_a_reset():
    found = rewards(True, **TERMS)
    for _ in range(3):
        found.compute(VALID)
    assert found.episode_sums["good"].tolist() == pytest.approx([0.12, 0.12, 0.36])
    assert found.episode_sums["bad"].tolist() == pytest.approx([-0.03, -0.3, 0.0])  # not clipped: what the term did
    found.reset(mask(True, False, False))
    assert found.episode_sums["good"].tolist() == pytest.approx([0.0, 0.12, 0.36])


@pytest.mark.parametrize("shape", [(3, 1), (2,), ()])
def test_a_term_of_the_wrong_shape_is_named(shape):
    found = Rewards({"odd": lambda: torch.zeros(shape)}, {"odd": 1.0}, DT, True, torch.zeros(3))
    with pytest.raises(TermError, match=r"_reward_odd: must return a tensor \(3,\)"):
        found.compute(VALID)
