"""The parts of the task by themselves, continued: observation groups, metrics, terminations, randomization, pushes."""

import math
from itertools import pairwise

import pytest
import torch

from legged.config.robot import RobotDomainRandConfig
from legged.errors import TermError
from legged.mdp.metrics import Metrics
from legged.mdp.observations import ObservationGroup, ObservationTerms
from legged.mdp.randomization import Pushes, Randomization, RobotRandomization
from legged.mdp.terminations import Terminations
from legged.state import load_state, state_of

CPU = torch.device("cpu")
DT = 0.02


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


def mask(*values) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.bool)


# ---- observations ----------------------------------------------------------------------------------------------------


def group(noise=None, clip=100.0, num_envs=2, names=("a", "b", "c")) -> ObservationGroup:
    functions = {
        "a": lambda: torch.tensor([[1.0, 2.0]]).repeat(num_envs, 1),
        "b": lambda: torch.tensor([[-3.0]]).repeat(num_envs, 1),
        "c": lambda: torch.tensor([[10.0, 20.0, 30.0]]).repeat(num_envs, 1),
    }
    source = ObservationTerms(functions)
    source.evaluate()
    return ObservationGroup(source, names, {"a": 2.0, "c": [0.1, 0.2, 0.3]}, noise or {}, clip)


def test_terms_lie_side_by_side_in_order_each_with_its_scale():
    found = group()
    found.compute()
    expected = [2.0, 4.0, -3.0, 1.0, 4.0, 9.0]
    assert found.buffer.tolist() == [pytest.approx(expected), pytest.approx(expected)]
    assert [(term.name, term.columns) for term in found.terms] == [("a", slice(0, 2)), ("b", slice(2, 3)), ("c", slice(3, 6))]


def test_scaled_observations_are_clipped():
    found = group(clip=3.5)
    found.compute()
    assert found.buffer[0].tolist() == pytest.approx([2.0, 3.5, -3.0, 1.0, 3.5, 3.5])


def test_the_buffer_is_rewritten_in_place():
    found = group()
    address = found.buffer.data_ptr()
    found.compute()
    assert found.buffer.data_ptr() == address


def test_noise_is_uniform_centred_of_the_stated_half_width_before_scaling_and_new_at_every_draw():
    found = group(noise={"a": 0.1, "c": 0.5}, num_envs=20_000)
    found.numbers.draw()
    found.compute()
    first = found.buffer.clone()
    noise = first - torch.tensor([2.0, 4.0, -3.0, 1.0, 4.0, 9.0])
    half = torch.tensor([0.2, 0.2, 0.0, 0.05, 0.1, 0.15])  # half width times scale
    assert (noise.abs() <= half + 1e-5).all()
    assert torch.allclose(noise.abs().amax(dim=0), half, rtol=0.01, atol=1e-6)
    assert torch.allclose(noise.mean(dim=0), torch.zeros(6), atol=0.004)
    assert torch.allclose(noise.std(dim=0), half / math.sqrt(3.0), rtol=0.02, atol=1e-6)
    found.numbers.draw()
    found.compute()
    assert not torch.equal(found.buffer[:, 0], first[:, 0])


def test_a_group_without_noise_is_exact():
    found = group()
    found.numbers.draw()
    found.compute()
    assert torch.equal(found.buffer[0], torch.tensor([1.0, 2.0, -3.0, 10.0, 20.0, 30.0]) * found._scale)


def test_a_term_that_is_no_matrix_is_named():
    with pytest.raises(TermError, match=r"_obs_flat: must return a tensor \(num_envs, width\), got \(2,\)"):
        ObservationTerms({"flat": lambda: torch.zeros(2)})


def test_a_term_that_fails_is_named():
    def fail():
        raise IndexError("no such foot")

    with pytest.raises(TermError, match="_obs_broken: no such foot"):
        ObservationTerms({"broken": fail})


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (("b", "c"), [-3.0, 1.0, 4.0, 9.0]),
        (("c", "a"), [1.0, 4.0, 9.0, 2.0, 4.0]),
        (("a", "c"), [2.0, 4.0, 1.0, 4.0, 9.0]),
        (("b",), [-3.0]),
    ],
)
def test_a_group_picks_its_terms_in_its_own_order(names, expected):
    found = group(names=names)
    found.compute()
    assert found.buffer.tolist() == [pytest.approx(expected)] * 2


def test_a_term_is_evaluated_once_for_all_groups_that_name_it():
    calls = []
    source = ObservationTerms({"a": lambda: calls.append(1) or torch.ones(2, 1)})
    groups = [ObservationGroup(source, ["a"], {"a": scale}, {}, 100.0) for scale in (2.0, 3.0)]
    calls.clear()
    source.evaluate()
    for each in groups:
        each.compute()
    assert [each.buffer[0].tolist() for each in groups] == [[2.0], [3.0]]
    assert len(calls) == 1


def test_what_is_no_number_is_seen_as_zero():
    source = ObservationTerms({"a": lambda: torch.tensor([[math.nan, math.inf, -math.inf, 1.0]])})
    source.evaluate()
    assert source.values.tolist() == [[0.0, 0.0, 0.0, 1.0]]
    assert source.raw.isnan().tolist() == [[True, False, False, False]]


# ---- metrics ---------------------------------------------------------------------------------------------------------


def metrics_of(rewards=(), terminations=(), num_envs=2, **values) -> Metrics:
    """Metrics whose terms give what `values` holds at that moment."""
    return Metrics({n: lambda n=n: values[n][0] for n in values}, rewards, terminations, 20.0, num_envs, CPU)


def test_a_metric_is_its_mean_over_valid_robots_and_steps_or_the_root_of_it():
    values = {"lin_vel_rmse": [torch.tensor([0.04, 0.16])], "height": [torch.tensor([1.0, 3.0])]}
    metrics = metrics_of(**values)
    metrics.add_step(mask(True, True), mask(False, False), [])
    values["lin_vel_rmse"][0] = torch.tensor([0.07, math.nan])
    values["height"][0] = torch.tensor([5.0, math.nan])
    metrics.add_step(mask(True, False), mask(True, False), [])
    log = metrics.flush()
    assert log["Metrics/lin_vel_rmse"].item() == pytest.approx(0.3)  # sqrt(0.27 / 3)
    assert log["Metrics/height"].item() == pytest.approx(3.0)
    assert log["Metrics/non_finite_worlds"].item() == 1.0
    assert log["Metrics/contact_overflows"].item() == 1.0


def test_a_metric_of_the_wrong_shape_is_refused_by_name():
    with pytest.raises(TermError, match=r"_metric_height: must return a tensor \(2,\), got \(3,\)"):
        metrics_of(height=[torch.ones(3)]).add_step(mask(True, True), mask(False, False), [])


def test_episode_means_count_ended_episodes_only():
    metrics = metrics_of(["walk", "lean"], num_envs=3)
    sums = torch.tensor([[10.0, 4.0, 99.0], [-1.0, -3.0, 99.0]])
    metrics.add_episodes(mask(True, True, False), mask(True, False, False), torch.tensor([100, 1000, 7]), sums)
    log = metrics.flush()
    assert log["Metrics/falls"].item() == pytest.approx(0.5)
    assert log["Metrics/episode_length"].item() == pytest.approx(550.0)
    assert log["rew_walk"].item() == pytest.approx(0.35)  # mean sum 7 over 20 s
    assert log["rew_lean"].item() == pytest.approx(-0.1)


def test_each_termination_has_its_share_of_the_ended_episodes():
    metrics = metrics_of(terminations=["contact", "tilt"], num_envs=4)
    none = mask(False, False, False, False)
    metrics.add_step(~none, none, [mask(True, True, False, False), mask(True, False, False, False)])
    metrics.add_episodes(mask(True, True, True, True), mask(True, True, False, False), torch.ones(4), torch.zeros(0, 4))
    log = metrics.flush()
    assert log["Terminations/contact"].item() == pytest.approx(0.5)
    assert log["Terminations/tilt"].item() == pytest.approx(0.25)
    assert math.isnan(metrics.flush()["Terminations/tilt"])


def test_a_value_that_is_nan_in_a_running_episode_does_not_spoil_the_others():
    metrics = metrics_of(["walk"])
    metrics.add_episodes(mask(True, False), mask(False, False), torch.tensor([5, 5]), torch.tensor([[20.0, math.nan]]))
    assert metrics.flush()["rew_walk"].item() == pytest.approx(1.0)


def test_without_an_ended_episode_its_means_are_nan_and_counts_zero():
    metrics = metrics_of(["walk"], lin_vel_rmse=[torch.ones(2)])
    metrics.add_step(mask(True, True), mask(False, False), [])
    log = metrics.flush()
    for name in ("rew_walk", "Metrics/falls", "Metrics/episode_length"):
        assert math.isnan(log[name])
    assert log["Metrics/lin_vel_rmse"].item() == 1.0
    assert log["Metrics/non_finite_worlds"].item() == 0.0


def test_a_flush_starts_anew_and_its_tensors_are_fresh():
    values = {"lin_vel_rmse": [torch.zeros(1)]}
    metrics = metrics_of(["walk"], num_envs=1, **values)

    def add(error: float) -> None:
        values["lin_vel_rmse"][0] = torch.tensor([error])
        metrics.add_step(mask(True), mask(False), [])
        metrics.add_episodes(mask(True), mask(True), torch.tensor([10]), torch.tensor([[error]]))

    add(4.0)
    first = metrics.flush()
    add(9.0)
    second = metrics.flush()
    assert (first["Metrics/lin_vel_rmse"].item(), second["Metrics/lin_vel_rmse"].item()) == (2.0, 3.0)
    assert (first["rew_walk"].item(), second["rew_walk"].item()) == (pytest.approx(0.2), pytest.approx(0.45))
    assert all(value.shape == () for value in first.values())
    addresses = [value.untyped_storage().data_ptr() for log in (first, second) for value in log.values()]
    kept = {value.data_ptr() for value in vars(metrics).values() if isinstance(value, torch.Tensor)}
    assert kept
    assert not kept & set(addresses)


# ---- terminations ----------------------------------------------------------------------------------------------------


def test_failures_and_time_outs_are_told_apart_and_a_failure_is_no_time_out():
    failed, timed_out, ended = (torch.zeros(6, dtype=torch.bool) for _ in range(3))
    fell = mask(True, False, False, True, False, False)
    left = mask(False, True, False, True, False, False)
    terminations = Terminations({"fell": lambda: fell}, {"left": lambda: left}, failed, timed_out, ended)
    broken, over = mask(False, False, True, False, False, False), mask(True, False, True, False, True, False)
    terminations.evaluate(~broken, over)
    assert failed.tolist() == [True, False, True, True, False, False]
    assert timed_out.tolist() == [False, True, False, False, True, False]
    assert ended.tolist() == [True, True, True, True, True, False]
    assert terminations.names == ("fell", "left")
    assert [found.tolist() for found in terminations.found] == [fell.tolist(), left.tolist()]


@pytest.mark.parametrize("value", [torch.zeros(2), torch.zeros(3, dtype=torch.bool), torch.zeros(2, 1, dtype=torch.bool)])
def test_a_termination_that_gives_something_else_is_refused_by_name(value):
    buffers = (torch.zeros(2, dtype=torch.bool) for _ in range(3))
    with pytest.raises(TermError, match=r"_terminate_mine: must return a tensor \(2,\) of bool, got"):
        Terminations({"mine": lambda: value}, {}, *buffers).evaluate(mask(True, True), mask(False, False))


# ---- randomization ---------------------------------------------------------------------------------------------------


class FakePhysics:
    """Records what it is given; velocity (0.3, -0.4) for every robot."""

    def __init__(self, num_envs: int) -> None:
        self.qvel = torch.tensor([[0.3, -0.4, 9.0]]).repeat(num_envs, 1)
        self.given = {}
        self.due = torch.zeros(num_envs, dtype=torch.bool)

    def randomize(self, field, values):
        self.given[field] = values.clone()

    def push(self, due, change):
        self.due, self.change = due.clone(), change.clone()


def test_friction_comes_from_as_many_values_as_there_are_buckets():
    cfg = RobotDomainRandConfig(friction_range=(0.5, 1.25), friction_buckets=8)
    friction = RobotRandomization(cfg, 5000, CPU).friction
    assert len(friction.unique()) == 8
    assert friction.min() >= 0.5
    assert friction.max() <= 1.25
    assert torch.bincount(torch.unique(friction, return_inverse=True)[1]).min() > 500  # about 625 each


def test_added_masses_fill_their_range():
    mass = RobotRandomization(RobotDomainRandConfig(added_mass_range=(-5.0, 3.0)), 5000, CPU).added_mass
    assert -5.0 <= mass.min() < -4.95
    assert 2.95 < mass.max() <= 3.0
    assert mass.mean() == pytest.approx(-1.0, abs=0.15)


def test_properties_are_drawn_once_from_their_ranges_and_given_by_name():
    """They come after friction and mass, so that to add a range changes neither; a range takes their place."""
    torch.manual_seed(3)
    plain = RobotRandomization(RobotDomainRandConfig(), 2000, CPU)
    torch.manual_seed(3)
    ranges = {"joint_damping": (0.5, 1.5), "actuator_gain": (-5.0, 5.0)}
    randomization, physics = RobotRandomization(RobotDomainRandConfig(ranges=ranges), 2000, CPU), FakePhysics(2000)
    assert torch.equal(randomization.friction, plain.friction)
    assert torch.equal(randomization.added_mass, plain.added_mass)
    randomization.apply(physics)
    assert list(physics.given) == ["friction", *ranges]
    for name, (low, high) in ranges.items():
        values = physics.given[name]
        assert low <= values.min() < low + 0.01 * (high - low)
        assert high - 0.01 * (high - low) < values.max() <= high
    assert torch.corrcoef(randomization.drawn.t())[0, 1].abs() < 0.1  # fields are drawn apart
    narrow = RobotRandomization(RobotDomainRandConfig(ranges={"friction": (2.0, 2.1)}), 50, CPU)
    assert narrow.fields["friction"].min() >= 2.0


def test_what_was_drawn_is_put_back():
    ranges = {"link_mass": (0.8, 1.2)}
    first, second = (Randomization(ranges, 10, CPU) for _ in range(2))
    assert not torch.equal(first.fields["link_mass"], second.fields["link_mass"])
    load_state(second, state_of(first))
    physics = FakePhysics(10)
    second.apply(physics)
    assert torch.equal(physics.given["link_mass"], first.fields["link_mass"])


@pytest.mark.parametrize(("friction", "mass"), [(True, False), (False, True), (False, False)])
def test_the_physics_is_given_what_is_asked_for_and_no_more(friction, mass):
    cfg = RobotDomainRandConfig(randomize_friction=friction, randomize_base_mass=mass)
    randomization, physics = RobotRandomization(cfg, 3, CPU), FakePhysics(3)
    randomization.apply(physics)
    assert ("friction" in physics.given, "added_base_mass" in physics.given) == (friction, mass)
    if friction:
        assert torch.equal(physics.given["friction"], randomization.friction)


def push_steps(pushes: Pushes, physics: FakePhysics, steps: int, allowed: torch.Tensor) -> list[list[int]]:
    """Steps at which each robot is pushed."""
    found: list[list[int]] = [[] for _ in range(len(allowed))]
    for step in range(1, steps + 1):
        pushes.numbers.draw()
        pushes.push(physics, allowed)
        for robot in physics.due.nonzero().flatten().tolist():
            found[robot].append(step)
    return found


@pytest.mark.parametrize("interval_s", [1.0, 2.0, 15.0])
def test_each_robot_is_pushed_at_its_own_moments_exactly_one_interval_apart(interval_s):
    pushes, physics = Pushes(RobotDomainRandConfig(push_interval_s=interval_s), 40, DT, CPU), FakePhysics(40)
    interval = round(interval_s / DT)
    found = push_steps(pushes, physics, 4 * interval, torch.ones(40, dtype=torch.bool))
    firsts = [steps[0] for steps in found]
    assert len(set(firsts)) > 15
    assert min(firsts) < 0.3 * interval
    assert 0.7 * interval < max(firsts) <= interval
    gaps = {b - a for steps in found for a, b in pairwise(steps)}
    assert gaps == {interval}


def test_a_push_sets_the_horizontal_velocity_inside_its_range():
    pushes, physics = Pushes(RobotDomainRandConfig(max_push_vel_xy=0.8), 2000, DT, CPU), FakePhysics(2000)
    pushes.push_time_left.fill_(0.0)
    pushes.numbers.draw()
    pushes.push(physics, torch.ones(2000, dtype=torch.bool))
    assert physics.due.all()
    velocity = physics.change + physics.qvel[:, :2]
    assert velocity.abs().max() <= 0.8 + 1e-6
    assert velocity.max() > 0.75
    assert velocity.min() < -0.75


def test_robots_outside_the_mask_are_pushed_later_and_none_with_pushes_off():
    pushes, physics = Pushes(RobotDomainRandConfig(push_interval_s=1.0), 2, DT, CPU), FakePhysics(2)
    pushes.push_time_left.fill_(0.055)
    assert push_steps(pushes, physics, 10, mask(True, False)) == [[3], []]
    assert push_steps(pushes, physics, 1, mask(True, True)) == [[], [1]]
    off = Pushes(RobotDomainRandConfig(push_robots=False), 2, DT, CPU)
    physics.due.fill_(False)
    assert push_steps(off, physics, 800, mask(True, True)) == [[], []]
