"""The parts of the task by themselves, continued: observation groups, statistics, randomization and pushes."""

import math
from itertools import pairwise
from types import SimpleNamespace

import pytest
import torch

from legged.config.schema import DomainRandConfig
from legged.errors import TermError
from legged.mdp.observations import ObservationGroup, ObservationTerms
from legged.mdp.randomization import Randomization
from legged.mdp.statistics import Statistics

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
    found.draw()
    found.compute()
    first = found.buffer.clone()
    noise = first - torch.tensor([2.0, 4.0, -3.0, 1.0, 4.0, 9.0])
    half = torch.tensor([0.2, 0.2, 0.0, 0.05, 0.1, 0.15])  # half width times scale
    assert (noise.abs() <= half + 1e-5).all()
    assert torch.allclose(noise.abs().amax(dim=0), half, rtol=0.01, atol=1e-6)
    assert torch.allclose(noise.mean(dim=0), torch.zeros(6), atol=0.004)
    assert torch.allclose(noise.std(dim=0), half / math.sqrt(3.0), rtol=0.02, atol=1e-6)
    found.draw()
    found.compute()
    assert not torch.equal(found.buffer[:, 0], first[:, 0])


def test_a_group_without_noise_is_exact():
    found = group()
    found.draw()
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


# ---- statistics ------------------------------------------------------------------------------------------------------


def test_errors_are_the_root_of_the_mean_square_over_valid_robots_and_steps():
    statistics = Statistics([], 20.0, CPU)
    nothing = mask(False, False)
    statistics.add_step(torch.tensor([0.04, 0.16]), torch.tensor([0.01, 0.03]), mask(True, True), nothing)
    statistics.add_step(torch.tensor([0.07, math.nan]), torch.tensor([0.02, math.nan]), mask(True, False), mask(True, False))
    log = statistics.flush()
    assert log["Metrics/lin_vel_rmse"].item() == pytest.approx(0.3)  # sqrt(0.27 / 3)
    assert log["Metrics/ang_vel_rmse"].item() == pytest.approx(math.sqrt(0.02))
    assert log["Metrics/non_finite_worlds"].item() == 1.0
    assert log["Metrics/contact_overflows"].item() == 1.0


def test_episode_means_count_ended_episodes_only():
    statistics = Statistics(["walk", "lean"], 20.0, CPU)
    sums = torch.tensor([[10.0, 4.0, 99.0], [-1.0, -3.0, 99.0]])
    statistics.add_episodes(mask(True, True, False), mask(True, False, False), torch.tensor([100, 1000, 7]), sums)
    log = statistics.flush()
    assert log["Metrics/falls"].item() == pytest.approx(0.5)
    assert log["Metrics/episode_length"].item() == pytest.approx(550.0)
    assert log["rew_walk"].item() == pytest.approx(0.35)  # mean sum 7 over 20 s
    assert log["rew_lean"].item() == pytest.approx(-0.1)


def test_a_value_that_is_nan_in_a_running_episode_does_not_spoil_the_others():
    statistics = Statistics(["walk"], 20.0, CPU)
    statistics.add_episodes(mask(True, False), mask(False, False), torch.tensor([5, 5]), torch.tensor([[20.0, math.nan]]))
    assert statistics.flush()["rew_walk"].item() == pytest.approx(1.0)


def test_without_an_ended_episode_its_means_are_nan_and_counts_zero():
    statistics = Statistics(["walk"], 20.0, CPU)
    statistics.add_step(torch.ones(2), torch.ones(2), mask(True, True), mask(False, False))
    log = statistics.flush()
    for name in ("rew_walk", "Metrics/falls", "Metrics/episode_length"):
        assert math.isnan(log[name])
    assert log["Metrics/lin_vel_rmse"].item() == 1.0
    assert log["Metrics/non_finite_worlds"].item() == 0.0


def test_a_flush_starts_anew_and_its_tensors_are_fresh():
    statistics = Statistics(["walk"], 20.0, CPU)

    def add(error: float) -> None:
        statistics.add_step(torch.tensor([error]), torch.tensor([error]), mask(True), mask(False))
        statistics.add_episodes(mask(True), mask(True), torch.tensor([10]), torch.tensor([[error]]))

    add(4.0)
    first = statistics.flush()
    add(9.0)
    second = statistics.flush()
    assert (first["Metrics/lin_vel_rmse"].item(), second["Metrics/lin_vel_rmse"].item()) == (2.0, 3.0)
    assert (first["rew_walk"].item(), second["rew_walk"].item()) == (pytest.approx(0.2), pytest.approx(0.45))
    assert all(value.shape == () for value in first.values())
    addresses = [value.untyped_storage().data_ptr() for log in (first, second) for value in log.values()]
    assert not {statistics._steps.data_ptr(), statistics._episodes.data_ptr()} & set(addresses)


# ---- randomization ---------------------------------------------------------------------------------------------------


class FakePhysics:
    """Records what it is given; velocity (0.3, -0.4) for every robot."""

    def __init__(self, num_envs: int) -> None:
        self.state = SimpleNamespace(base_lin_vel_w=torch.tensor([[0.3, -0.4, 9.0]]).repeat(num_envs, 1))
        self.given = {}
        self.due = torch.zeros(num_envs, dtype=torch.bool)

    def randomize(self, field, values):
        self.given[field] = values.clone()

    def push(self, due, change):
        self.due, self.change = due.clone(), change.clone()


def test_friction_comes_from_as_many_values_as_there_are_buckets():
    cfg = DomainRandConfig(friction_range=(0.5, 1.25), friction_buckets=8)
    friction = Randomization(cfg, 5000, DT, CPU).friction
    assert len(friction.unique()) == 8
    assert friction.min() >= 0.5
    assert friction.max() <= 1.25
    assert torch.bincount(torch.unique(friction, return_inverse=True)[1]).min() > 500  # about 625 each


def test_added_masses_fill_their_range():
    mass = Randomization(DomainRandConfig(added_mass_range=(-5.0, 3.0)), 5000, DT, CPU).added_mass
    assert -5.0 <= mass.min() < -4.95
    assert 2.95 < mass.max() <= 3.0
    assert mass.mean() == pytest.approx(-1.0, abs=0.15)


@pytest.mark.parametrize(("friction", "mass"), [(True, False), (False, True), (False, False)])
def test_the_physics_is_given_what_is_asked_for_and_no_more(friction, mass):
    cfg = DomainRandConfig(randomize_friction=friction, randomize_base_mass=mass)
    randomization, physics = Randomization(cfg, 3, DT, CPU), FakePhysics(3)
    randomization.apply(physics)
    assert ("friction" in physics.given, "added_base_mass" in physics.given) == (friction, mass)
    if friction:
        assert torch.equal(physics.given["friction"], randomization.friction)


def push_steps(randomization: Randomization, physics: FakePhysics, steps: int, allowed: torch.Tensor) -> list[list[int]]:
    """Steps at which each robot is pushed."""
    found: list[list[int]] = [[] for _ in range(len(allowed))]
    for step in range(1, steps + 1):
        randomization.draw()
        randomization.push(physics, allowed)
        for robot in physics.due.nonzero().flatten().tolist():
            found[robot].append(step)
    return found


@pytest.mark.parametrize("interval_s", [1.0, 2.0, 15.0])
def test_each_robot_is_pushed_at_its_own_moments_exactly_one_interval_apart(interval_s):
    randomization, physics = Randomization(DomainRandConfig(push_interval_s=interval_s), 40, DT, CPU), FakePhysics(40)
    interval = round(interval_s / DT)
    found = push_steps(randomization, physics, 4 * interval, torch.ones(40, dtype=torch.bool))
    firsts = [steps[0] for steps in found]
    assert len(set(firsts)) > 15
    assert min(firsts) < 0.3 * interval
    assert 0.7 * interval < max(firsts) <= interval
    gaps = {b - a for steps in found for a, b in pairwise(steps)}
    assert gaps == {interval}


def test_a_push_sets_the_horizontal_velocity_inside_its_range():
    randomization, physics = Randomization(DomainRandConfig(max_push_vel_xy=0.8), 2000, DT, CPU), FakePhysics(2000)
    randomization.push_time_left.fill_(0.0)
    randomization.draw()
    randomization.push(physics, torch.ones(2000, dtype=torch.bool))
    assert physics.due.all()
    velocity = physics.change + physics.state.base_lin_vel_w[:, :2]
    assert velocity.abs().max() <= 0.8 + 1e-6
    assert velocity.max() > 0.75
    assert velocity.min() < -0.75


def test_robots_outside_the_mask_are_pushed_later_and_none_with_pushes_off():
    randomization, physics = Randomization(DomainRandConfig(push_interval_s=1.0), 2, DT, CPU), FakePhysics(2)
    randomization.push_time_left.fill_(0.055)
    assert push_steps(randomization, physics, 10, mask(True, False)) == [[3], []]
    assert push_steps(randomization, physics, 1, mask(True, True)) == [[], [1]]
    off = Randomization(DomainRandConfig(push_robots=False), 2, DT, CPU)
    physics.due.fill_(False)
    assert push_steps(off, physics, 800, mask(True, True)) == [[], []]
