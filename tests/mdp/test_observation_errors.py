"""Errors of observations, by numbers worked by hand: bias, delay, lost packets, and the map of heights."""

import pytest
import torch
from helpers import assert_goes_on_alike, small_task

from legged.errors import ConfigError
from legged.mdp.observation_errors import ObservationErrors
from legged.mdp.observations import ObservationTerms
from legged.mdp.random_pool import RandomPool

N = 6
NOBODY, EVERYBODY = torch.zeros(N, dtype=torch.bool), torch.ones(N, dtype=torch.bool)
ON = ("observations.add_noise", True)
QUIET = ("observations.noise_level", 0.0)
TERRAIN = [
    ("terrain.mesh_type", "height_map"),
    ("terrain.proportions", {"stairs_up": 1.0}),
    ("terrain.num_rows", 2),
    ("terrain.num_cols", 2),
    ("terrain.border_size", 4.0),
    ("terrain.max_init_terrain_level", 1),
]


class Bench:
    """Two terms that count steps, of widths 2 and 3, and sensors of them."""

    def __init__(self, names=("a",), bias=None, delay=None, dropped=None, noise=None):
        self.clock = torch.zeros(())
        self.terms = ObservationTerms({"a": self.a, "b": self.b})
        self.numbers = RandomPool(N, torch.device("cpu"))
        layout, tables = (self.terms.values, self.terms.columns), (bias or {}, delay or {}, dropped or {}, noise or {})
        self.errors = ObservationErrors(*layout, names, *tables, self.numbers)
        self.terms.errors = self.errors
        self.numbers.allocate()

    def a(self):
        return self.clock.expand(N, 2)

    def b(self):
        return (100.0 + self.clock).expand(N, 3)

    def step(self, begun=NOBODY):
        """The value of `a` and of `b` that are measured at the next tick of the clock."""
        self.clock += 1.0
        self.numbers.draw()
        self.terms.evaluate(begun)
        return self.errors.values[:, :2].clone(), self.errors.values[:, 2:].clone()


def test_a_delay_of_two_steps_shows_what_was_two_steps_ago():
    bench = Bench(delay={"a": (2, 2)})
    found = [bench.step(EVERYBODY if k == 0 else NOBODY) for k in range(6)]
    assert [a[0, 0].item() for a, _ in found] == [1.0, 1.0, 1.0, 2.0, 3.0, 4.0]  # an episode's first number is its past
    assert [b[0, 0].item() for _, b in found] == [101.0, 102.0, 103.0, 104.0, 105.0, 106.0]


def test_delays_are_those_of_each_robot_and_change_with_the_episode():
    bench = Bench(delay={"a": (0, 3)})
    bench.step(EVERYBODY)
    delays = []
    for k in range(60):
        before = bench.errors.delay.clone()
        begun = EVERYBODY if k % 6 == 5 else NOBODY
        a, _ = bench.step(begun)
        if k % 6 in (3, 4):  # the episode is old enough
            assert a[:, 0].tolist() == (bench.clock - bench.errors.delay[:, 0]).tolist()
        assert k % 6 == 5 or torch.equal(before, bench.errors.delay)
        delays.append(bench.errors.delay.clone())
    assert torch.stack(delays).unique().tolist() == [0, 1, 2, 3]


def test_a_reset_forgets_what_was_on_its_way_for_that_robot_alone():
    bench = Bench(delay={"a": (2, 2)})
    for k in range(4):
        bench.step(EVERYBODY if k == 0 else NOBODY)
    a, _ = bench.step(torch.arange(N) == 1)
    assert a[:, 0].tolist() == [3.0, 5.0, 3.0, 3.0, 3.0, 3.0]


def test_a_bias_stays_for_an_episode_and_is_drawn_for_the_next():
    bench = Bench(("a", "b"), bias={"a": 0.5})
    first = bench.step(EVERYBODY)[0] - bench.clock
    assert first.abs().max() <= 0.5
    assert len(first.unique()) == 2 * N  # of each number its own
    for _ in range(5):
        a, b = bench.step()
        torch.testing.assert_close(a - bench.clock, first)
        assert b.unique().tolist() == [100.0 + bench.clock.item()]
    again = bench.step(torch.arange(N) == 2)[0] - bench.clock
    changed = ((again - first).abs() > 1e-4).any(dim=1)
    assert changed.tolist() == [False, False, True, False, False, False]


def test_a_lost_packet_shows_the_numbers_before_noise_and_all():
    torch.manual_seed(0)
    bench = Bench(dropped={"a": 0.4}, noise={"a": 0.1})
    before, _ = bench.step(EVERYBODY)
    lost = 0
    for _ in range(200):
        a, _ = bench.step()
        same = (a == before).all(dim=1)
        assert ((a[~same] - bench.clock).abs() <= 0.1).all()
        lost += int(same.sum())
        before = a
    assert lost / (200 * N) == pytest.approx(0.4, abs=0.05)


def test_an_episode_does_not_begin_with_a_packet_of_the_last_one():
    bench = Bench(dropped={"a": 1.0})
    assert bench.step(EVERYBODY)[0].unique().tolist() == [1.0]
    assert bench.step()[0].unique().tolist() == [1.0]
    assert bench.step(torch.arange(N) == 0)[0][:, 0].tolist() == [3.0, 1.0, 1.0, 1.0, 1.0, 1.0]


def test_a_preview_shows_the_next_step_and_changes_nothing():
    bench = Bench(delay={"a": (0, 2)}, dropped={"a": 0.3}, bias={"a": 0.1}, noise={"a": 0.1})
    bench.step(EVERYBODY)
    for _ in range(30):
        bench.clock += 1.0
        bench.numbers.draw()
        kept = {name: getattr(bench.errors, name).clone() for name in bench.errors.STATE}
        bench.terms.evaluate()
        shown = bench.errors.values.clone()
        for name, value in kept.items():
            assert torch.equal(getattr(bench.errors, name), value), name
        bench.terms.evaluate(NOBODY)
        torch.testing.assert_close(bench.errors.values, shown)
        bench.terms.evaluate(NOBODY, again=True)
        torch.testing.assert_close(bench.errors.values, shown)


@pytest.mark.slow
def test_the_actor_is_misled_and_the_critic_is_not():
    settings = [ON, QUIET, ("observations.bias", {"dof_pos": 0.1}), ("observations.delay", {"dof_vel": [1, 1]})]
    task = small_task(*settings)
    speeds = []
    for _ in range(3):
        obs, *_ = task.step(torch.randn(4, 12))
        actor, critic = obs["actor"], obs["critic"]
        speeds.append(critic[:, 24:36])
        off = actor[:, 12:24] - critic[:, 12:24]
        torch.testing.assert_close(off, task.observation_terms.errors.bias[:, :12])
        torch.testing.assert_close(actor[:, :12], critic[:, :12], rtol=0.0, atol=0.0)
    torch.testing.assert_close(actor[:, 24:36], speeds[1])
    assert small_task(*settings[1:]).observation_terms.errors is None  # add_noise is off: nothing misleads


def test_two_groups_have_the_same_sensor():
    noisy = {"terms": ["dof_pos"], "noise": True}
    plain = {"actor": noisy, "more": {**noisy, "history": 3}, "critic": {"terms": ["dof_pos"]}}
    task = small_task(ON, ("observations.groups", plain), ("observations.bias", {"dof_pos": 0.1}))
    obs, *_ = task.step(torch.zeros(4, 12))
    assert torch.equal(obs["actor"], obs["more"][:, -12:])
    assert not torch.equal(obs["actor"], obs["critic"])


@pytest.mark.slow
def test_a_step_with_all_errors_is_checked_and_resumes():
    settings = [
        *TERRAIN,
        ON,
        ("observations.groups.actor.terms", ["base_ang_vel", "projected_gravity", "heights", "dof_pos"]),
        ("observations.bias", {"base_ang_vel": 0.05, "dof_pos": 0.02}),
        ("observations.delay", {"dof_pos": [0, 2], "heights": [1, 3]}),
        ("observations.dropped", {"heights": 0.3, "projected_gravity": 0.1}),
        ("observations.height_map", {"offset": 0.05, "shift": 0.1, "drift": 0.01, "shift_drift": 0.02}),
        ("observations.height_map", {"holes": 0.1, "lost": 0.3}),
    ]
    assert_goes_on_alike(settings, torch.randn(14, 4, 12))


def heights_task(**height_map):
    """A task on stairs whose actor sees heights alone, from a map with errors."""
    groups = ("observations.groups.actor.terms", ["heights"])
    settings = [*TERRAIN, ON, QUIET, groups, ("observations.scales.heights", 1.0), ("observations.height_map", height_map)]
    return small_task(*settings)


def test_a_map_that_is_too_high_shows_lower_bases():
    task = heights_task(offset=0.05, drift=0.5)
    errors = task.observation_terms.errors._map
    for _ in range(5):
        before = errors.error.clone()
        obs, *_ = task.step(torch.zeros(4, 12))
        begun = task.reset_buf
        grown = before + errors.rate
        torch.testing.assert_close(errors.error[~begun], grown[~begun])
        seen = (task.base_pos[:, 2:] - 0.5 - task.measured_heights - errors.error[:, 2:]).clamp(-1.0, 1.0)
        torch.testing.assert_close(obs["actor"], seen, rtol=1e-5, atol=1e-5)
    assert 0.0 < errors.error[:, 2].abs().max() <= 0.05 + 5 * 0.5 * task.dt
    assert not errors.error[:, :2].any()


def test_a_shifted_map_has_the_ground_of_another_place():
    task = heights_task(shift=0.3)
    errors, scan = task.observation_terms.errors._map, task.height_scan
    obs, *_ = task.step(torch.zeros(4, 12))
    there = task.base_pos.clone() - errors.error
    at_home = scan.heights.clone()
    scan.look_from(there, task.base_quat)
    seen = (task.base_pos[:, 2:] - 0.5 - scan.heights).clamp(-1.0, 1.0)
    torch.testing.assert_close(obs["actor"], seen, rtol=1e-5, atol=1e-5)
    assert not torch.equal(at_home, scan.heights)


def test_holes_read_0_and_stay_for_the_episode():
    task = heights_task(holes=0.25)
    holes = task.observation_terms.errors._map.holes.clone()
    assert holes.float().mean().item() == pytest.approx(0.25, abs=0.08)
    for _ in range(3):
        obs, *_ = task.step(torch.zeros(4, 12))
        kept = ~task.reset_buf
        assert (obs["actor"][kept][holes[kept]] == 0.0).all()
        seen = task.base_pos[:, 2:] - 0.5 - task.measured_heights
        torch.testing.assert_close(obs["actor"][kept][~holes[kept]], seen[kept][~holes[kept]], rtol=1e-5, atol=1e-5)


@pytest.mark.slow
def test_a_lost_map_reads_0_everywhere_and_the_others_are_whole():
    task, count = heights_task(lost=0.5), 0
    for _ in range(10):
        task.reset()
        obs, *_ = task.step(torch.zeros(4, 12))
        holes = task.observation_terms.errors._map.holes
        lost = holes.any(dim=1)
        assert (lost == holes.all(dim=1)).all()
        seen = (task.base_pos[:, 2:] - 0.5 - task.measured_heights).masked_fill(lost.unsqueeze(1), 0.0)
        torch.testing.assert_close(obs["actor"], seen.clamp(-1.0, 1.0), rtol=1e-5, atol=1e-5)
        count += int(lost.sum())
    assert 8 < count < 32


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        ("observations.bias", {"imu": 0.1}, "has no observation 'imu'"),
        ("observations.delay", {"dof_poss": [0, 1]}, "did you mean 'dof_pos'"),
        ("observations.delay", {"dof_pos": [2, 1]}, "expected [low, high] with low <= high"),
        ("observations.delay", {"dof_pos": 1}, "expected a list"),
        ("observations.dropped", {"dof_pos": 1.5}, "must be at most 1"),
        ("observations.height_map.hole", 0.1, "unknown key 'hole'"),
        ("observations.height_map.offset", -0.1, "must be at least 0"),
    ],
)
def test_wrong_settings_are_one_line_that_names_them(path, value, said):
    with pytest.raises(ConfigError) as error:
        small_task((path, value))
    assert str(error.value).startswith(f"command line: {path}")
    assert said in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_errors_of_0_are_none():
    """The random numbers and the observations are those of a task that names no errors, bit by bit."""
    zero = [("observations.bias", {"dof_pos": 0.0}), ("observations.delay", {"dof_pos": [0, 0]})]
    rollouts = []
    for settings in ([], [*zero, ("control.actuator.delay", [0, 0])]):
        task = small_task(ON, *settings)
        assert task.observation_terms.errors is None
        rollouts.append(torch.stack([task.step(torch.full((4, 12), 0.1 * k))[0]["actor"] for k in range(5)]))
    assert torch.equal(*rollouts)
