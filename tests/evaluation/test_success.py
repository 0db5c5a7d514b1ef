"""Success against difficulty: its rules with scripted robots, where robots are put, what they are asked and what they see."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers import ENGINE, POLICY, small_config, stand

from legged import make_task
from legged.config import override
from legged.evaluation import success, tiles
from legged.evaluation.intervals import wilson
from legged.evaluation.measurement import Setting
from legged.evaluation.success import (
    FELL,
    REACHED,
    STUCK,
    Scores,
    point,
)
from legged.evaluation.tiles import on_terrain, tiles_of_sizes
from legged.learning.run_folder import find_checkpoint, run_config
from legged.math import yaw_of
from legged.policies.restore import TrainedPolicy, restore, undisturbed
from legged.registry import task_config
from legged.terrain import TERRAIN_TYPES

pytestmark = pytest.mark.usefixtures("workplace")


def task_on(name, sizes, num_envs, *settings, side=success.TILE, spawn_range=success.SPAWN_RANGE):
    """The flat task put on tiles of one type, without noise and at rest."""
    cfg = small_config(num_envs=num_envs)
    changes = [*on_terrain(cfg, side, spawn_range), ("init_state.base_velocity", [0.0, 0.0])]
    changes += [("commands.heading_command", True), ("init_state.yaw", [-math.pi, math.pi]), *settings]
    cfg = override(cfg, changes)
    return make_task(cfg, terrain=tiles_of_sizes(name, sizes, cfg.terrain, 1))


# ---- the rules -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [  # (k + z^2 / 2 -+ z sqrt(k (n - k) / n + z^2 / 4)) / (n + z^2), z = 1.96
        (0, 10, 0.0, 0.278),  # z^2 / (n + z^2)
        (5, 10, 0.237, 0.763),
        (10, 10, 0.722, 1.0),
        (8, 10, 0.490, 0.943),
        (0, 1, 0.0, 0.793),
    ],
)
def test_wilson_interval(successes, trials, low, high):
    assert wilson(successes, trials) == pytest.approx((low, high), abs=6e-4)


def test_a_share_lies_in_its_interval_whatever_is_rounded():
    """An error bar of length -1e-16 ended the picture of 128 robots that all came through."""
    for trials in range(1, 300):
        assert wilson(0, trials)[0] == 0.0
        assert wilson(trials, trials)[1] == 1.0
        for successes in range(trials + 1):
            low, high = wilson(successes, trials)
            assert 0.0 <= low <= successes / trials <= high <= 1.0


def test_the_first_event_counts():
    start = torch.tensor([[1.0, 2.0, 0.5]]).repeat(6, 1)
    scores = Scores(start)

    def at(time_s, distances, fell=()):
        position = start.clone()
        position[:, 1] += torch.tensor(distances)
        terminated = torch.zeros(6, dtype=torch.bool)
        terminated[list(fell)] = True
        scores.update(time_s, position, terminated, torch.zeros_like(terminated))

    at(1.0, [3.9, 3.0, 3.9, 0.0, 0.0, 3.99])
    assert scores.outcome.tolist() == [STUCK] * 6
    assert scores.time_s.tolist() == [20.0] * 6
    at(2.0, [4.0, 0.0, 3.9, 0.0, -4.1, 3.99], fell=[1])  # robot 1 falls at 3 m and is put back to its start
    at(3.0, [0.0, 4.5, 3.9, 4.2, 0.0, 3.99], fell=[0, 3])  # 0 falls after its success; 3 in the step in which it would be one
    at(4.0, [0.0, 4.5, 3.9, 4.5, 0.0, 3.99])  # 1 and 3 wander off after their falls
    assert not scores.done
    assert scores.outcome.tolist() == [REACHED, FELL, STUCK, FELL, REACHED, STUCK]
    assert scores.time_s.tolist() == [2.0, 2.0, 20.0, 3.0, 2.0, 20.0]
    at(5.0, [4.0] * 6)
    assert scores.outcome.tolist() == [REACHED, FELL, REACHED, FELL, REACHED, REACHED]
    assert scores.done


def test_a_time_out_of_the_task_ends_the_time_of_a_robot():
    """At 3 m it is put back to its start, from where it walks 4.1 m: that would be another try."""
    scores = Scores(torch.zeros(2, 3))
    no = torch.zeros(2, dtype=torch.bool)
    scores.update(1.0, torch.tensor([[4.5, 0.0, 0.0], [3.0, 0.0, 0.0]]), no, ~no)  # of neither is the place its own any more
    scores.update(2.0, torch.tensor([[4.1, 0.0, 0.0], [4.1, 0.0, 0.0]]), no, no)
    assert scores.outcome.tolist() == [STUCK, STUCK]
    assert scores.time_s.tolist() == [1.0, 1.0]


def test_height_is_no_distance():
    scores = Scores(torch.zeros(1, 3))
    no = torch.zeros(1, dtype=torch.bool)
    scores.update(1.0, torch.tensor([[2.0, 2.0, -5.0]]), no, no)
    assert scores.outcome.tolist() == [STUCK]
    scores.update(2.0, torch.tensor([[2.9, 2.9, 0.0]]), no, no)  # 4.1 m along the diagonal
    assert scores.outcome.tolist() == [REACHED]


def test_figures_of_a_point():
    found = point(0.1, torch.tensor([REACHED, FELL, REACHED, STUCK]), torch.tensor([5.0, 1.0, 7.0, 20.0]))
    low, high = wilson(2, 4)
    assert found == {
        "size": 0.1,
        "robots": 4,
        "successes": 2,
        "share": 0.5,
        "low": low,
        "high": high,
        "fell": 1,
        "stuck": 1,
        "mean_time_s": 6.0,
    }
    assert point(0.1, torch.tensor([FELL]), torch.tensor([1.0]))["mean_time_s"] is None


@pytest.mark.slow
def test_scripted_robots_on_a_real_task(monkeypatch):
    """On level ground: one is carried out and then laid on its back, one falls and is carried out after its reset, one falls
    3 m away, one is carried 3.9 m away and stays there.
    """
    monkeypatch.setattr(success, "TIME_S", 1.0)
    task = task_on("flat", [0.0, 0.0], 4)
    qpos, steps = task.physics._qpos, 0
    upside_down = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=torch.float64)

    def script(observations):
        nonlocal steps
        steps += 1

        def topple(robot):
            qpos[robot, 2], qpos[robot, 3:7] = 0.1, upside_down

        if steps == 5:
            qpos[0, 0] += 4.1
            topple(1)
            qpos[2, 0] += 3.0
            qpos[3, 1] -= 3.9
        if steps == 10:
            topple(0)
            topple(2)
        if steps == 40:
            assert qpos[1, 2] > 0.3  # the task has put it back on its feet
            qpos[1, 0] += 4.5
        return stand(observations)

    points, overflows = success.measure_success(task, script, [0.0, 0.0], 2)
    assert steps == 50  # the whole second, for the last robot
    assert overflows == 0
    first, second = ({key: entry[key] for key in ("successes", "fell", "stuck")} for entry in points)
    assert first == {"successes": 1, "fell": 1, "stuck": 0}
    assert second == {"successes": 0, "fell": 1, "stuck": 1}
    assert points[0]["mean_time_s"] == pytest.approx(0.1)  # 5 steps of 0.02 s


@pytest.mark.slow
def test_it_stops_when_everyone_is_done():
    task = task_on("flat", [0.0], 2)
    steps = 0

    def carry(observations):
        nonlocal steps
        steps += 1
        task.physics._qpos[:, 0] += 1.0
        return stand(observations)

    (entry,), _ = success.measure_success(task, carry, [0.0], 2)
    assert entry["successes"] == 2
    assert steps in (4, 5)  # 4 m, from up to 0.1 m before or behind the middle


# ---- where robots stand, and what they are asked ---------------------------------------------------------------------


@pytest.mark.slow
def test_robots_stand_on_the_tile_of_their_point_and_are_asked_to_leave_it(monkeypatch):
    monkeypatch.setattr(success, "TIME_S", 0.04)
    task = task_on("stairs_up", [0.05, 0.2], 16)
    seen = []

    def watch(observations):
        seen.append((task.base_pos.clone(), yaw_of(task.base_quat), task.commands.clone(), observations["actor"].clone()))
        if len(seen) == 1:  # turn every robot by 0.4 rad to the left
            half = 0.5 * (seen[0][1].double() + 0.4)
            task.physics._qpos[:, 3:7] = torch.stack([half.cos(), 0.0 * half, 0.0 * half, half.sin()], dim=1)
        return stand(observations)

    points, _ = success.measure_success(task, watch, [0.05, 0.2], 8)
    assert [entry["size"] for entry in points] == [0.05, 0.2]
    position, yaw, commands, observed = seen[0]
    # A platform of 3 m below nine treads of 0.3 m: 0.45 m and 1.8 m down.
    spawn = task.robot.file.spawn_height
    assert position[:, 2].tolist() == pytest.approx([spawn - 0.45] * 8 + [spawn - 1.8] * 8, abs=1e-4)
    # Three rows of 8 m, sizes in the outer two.
    offset = position[:, :2] - torch.tensor([[-8.0, 0.0]] * 8 + [[8.0, 0.0]] * 8)
    assert offset.abs().max() <= success.SPAWN_RANGE + 1e-5
    assert offset.std() > 0.02
    assert yaw.std() > 1.0
    assert commands[:, 0].tolist() == pytest.approx([0.75] * 16)
    assert commands[:, 1].abs().max() <= 0.1
    assert commands[:, 1].std() > 0.02
    assert commands[:, 2].abs().max() < 1e-6
    assert commands[:, 3].tolist() == pytest.approx(yaw.tolist())
    assert observed[:, 9].tolist() == pytest.approx([1.5] * 16)  # 2 * vx: the policy is told
    # Half the error of 0.4 rad back to the right, and no new command.
    assert seen[1][2][:, 2].tolist() == pytest.approx([-0.2] * 16, abs=0.03)
    assert torch.equal(seen[1][2][:, [0, 1, 3]], commands[:, [0, 1, 3]])


@pytest.mark.slow
def test_robots_are_shared_out_among_random_tiles(monkeypatch):
    monkeypatch.setattr(tiles, "VARIANTS", 4)
    task = task_on("obstacles", [0.1, 0.2], 12)
    success.place(task, 6)
    task.reset()
    # Seven columns of 8 m, tiles in every second one; six robots a size on four tiles.
    middle_y = torch.tensor([-24.0, -8.0, 8.0, 24.0, -24.0, -8.0]).repeat(2)
    middle_x = torch.tensor([-8.0] * 6 + [8.0] * 6)
    assert (task.base_pos[:, :2] - torch.stack([middle_x, middle_y], dim=1)).abs().max() <= success.SPAWN_RANGE + 1e-5


def test_tiles_are_apart_from_each_other_and_random_ones_differ(monkeypatch):
    monkeypatch.setattr(tiles, "VARIANTS", 4)
    cfg = override(small_config(), on_terrain(small_config(), 8.0, 0.1)).terrain
    terrain = tiles_of_sizes("obstacles", [0.1, 0.3], cfg, seed=3)
    heights, border = terrain.height_map.heights, 30
    assert heights.shape == (3 * 80 + 2 * border, 7 * 80 + 2 * border)
    at = [[heights[border + 80 * r :, border + 80 * c :][:80, :80] for c in range(7)] for r in range(3)]
    for r in range(3):
        for c in range(7):
            highest = (0.1 if r == 0 else 0.3) if r != 1 and c % 2 == 0 else 0.0
            assert abs(at[r][c]).max() == pytest.approx(highest)
    assert (at[0][0] != at[0][2]).any()
    assert (tiles_of_sizes("obstacles", [0.1, 0.3], cfg, seed=3).height_map.heights == heights).all()
    assert (tiles_of_sizes("obstacles", [0.1, 0.3], cfg, seed=4).height_map.heights != heights).any()
    for name in (name for name, kind in TERRAIN_TYPES.items() if kind.regular):  # one tile stands for all
        two = [tiles_of_sizes(name, [0.1], cfg, seed=seed).height_map.heights for seed in (1, 2)]
        assert two[0].shape == (80 + 2 * border, 80 + 2 * border)
        assert (two[0] == two[1]).all()


@pytest.mark.slow
def test_the_policy_sees_what_it_saw_in_training():
    """The same points, scales and noise; what is changed is the ground, not the observation."""
    exact = [
        (f"observations.height_map.{error}", 0.0) for error in ("offset", "shift", "drift", "shift_drift", "holes", "lost")
    ]
    cfg = task_config("anymal_c", [("env.num_envs", 2), *exact, *ENGINE], on_cpu=True)
    changed = override(cfg, [*undisturbed(cfg, 2, 20.0), *on_terrain(cfg, 8.0, 0.1), ("observations.add_noise", True)])
    task = make_task(changed, terrain=tiles_of_sizes("pit", [0.4], changed.terrain, 1))
    success.place(task, 2)
    seen = task.reset()
    heights = seen["critic"][:, 48:]
    assert heights.shape == (2, 187)
    # The pit is 4 m wide: all that is measured lies on its floor, and the base 0.6 m above; scaled by 2.5.
    assert heights.flatten().tolist() == pytest.approx([2.5 * (0.6 - 0.5)] * 374, abs=1e-3)
    noise = seen["actor"][:, 48:] - heights
    assert 0.2 < noise.abs().max() <= 0.2501  # 2.5 times U(-0.1, 0.1)


def setting_of(cfg, overrides) -> Setting:
    return Setting(TrainedPolicy(cfg, Path("model_0.pt")), torch.device("cpu"), Path(), overrides)


def test_configuration_of_the_tasks(monkeypatch, capsys):
    """As trained, but for the ground, the commands and what is switched off on purpose; the command line comes last."""
    cfg = task_config("anymal_c", [("observations.noise_level", 0.7), ("terrain.num_rows", 10), *ENGINE], on_cpu=True)
    found = []

    def fake(setting, name, sizes, robots, changes):
        found.append(override(cfg, changes))
        return [point(size, torch.tensor([REACHED] * robots), torch.ones(robots)) for size in sizes], 3

    monkeypatch.setattr(success, "_on_type", fake)
    sizes = success.chosen_sizes(cfg, "stairs_up,pit", False, 1.0)
    result = success.success_over_difficulty(setting_of(cfg, [("sim.threads", 2)]), sizes, 5)
    lines = capsys.readouterr().out.splitlines()
    assert lines == ["stairs_up: 6 sizes x 5 robots, 100 % got out", "pit: 6 sizes x 5 robots, 100 % got out"]
    assert result["contact_overflows"] == 6
    assert result["types"]["stairs_up"]["trained_to"] == pytest.approx(0.212)
    assert result["types"]["pit"]["trained_to"] is None
    run = found[0]
    assert (run.env.num_envs, run.sim.threads) == (30, 2)
    assert run.env.episode_length_s > 20.0  # the measurement's own clock is the one that runs out
    with_a_map = replace(cfg.observations.height_map, lost=0.0)  # who has none is measured by the stress test
    assert run.observations == replace(cfg.observations, height_map=with_a_map)
    assert run.observations.add_noise
    assert run.init_state == replace(cfg.init_state, yaw=(-math.pi, math.pi))
    assert run.commands.heading_command
    assert (run.commands.curriculum.enabled, run.terrain.curriculum) == (False, False)
    rand = run.domain_rand
    assert (rand.push_robots, rand.randomize_friction, rand.randomize_base_mass) == (False, False, False)
    assert (run.terrain.terrain_length, run.terrain.terrain_width, run.terrain.spawn_range) == (8.0, 8.0, 0.1)
    assert (run.control, run.terminations, run.sim.dt) == (cfg.control, cfg.terminations, cfg.sim.dt)


def test_ground_of_a_scale_that_is_asked_for_is_measured_and_told_at_that_scale(monkeypatch):
    """At a quarter of the lengths and half the speeds; what training ended at stays. Its cells still divide treads."""
    cfg = task_config("anymal_c", [("terrain.num_rows", 10), *ENGINE], on_cpu=True)
    found = []

    def fake(setting, name, sizes, robots, changes):
        found.append((name, sizes, override(cfg, changes).terrain))
        return [point(size, torch.tensor([REACHED] * robots), torch.ones(robots)) for size in sizes], 0

    monkeypatch.setattr(success, "_on_type", fake)
    asked = [("terrain.scale", 0.25), ("terrain.horizontal_scale", 0.025)]
    chosen = success.chosen_sizes(cfg, "stairs_up,narrow_stairs_up", False, 0.25)
    result = success.success_over_difficulty(setting_of(cfg, asked), chosen, 2)
    rule = result["definition"]
    assert (rule["distance_m"], rule["vx"], rule["vy"][1]) == pytest.approx((1.0, 0.375, 0.05))
    assert result["types"]["stairs_up"]["trained_to"] == pytest.approx(0.212)
    (_, sizes, built), (_, _, narrow) = found
    assert sizes == pytest.approx([0.25 * size for size in success.FEWER["stairs_up"]])
    assert (built.scale, built.terrain_length, built.horizontal_scale) == pytest.approx((0.25, 2.0, 0.025))
    assert narrow.horizontal_scale == pytest.approx(0.07 / 3)  # a third of the tread of 0.28 m at that scale


@pytest.mark.slow
def test_the_shipped_policy_climbs_a_gentle_slope_and_not_a_wall():
    """The whole measurement, with a policy that walks: 10 degrees are easy for it, a pit of 1 m has walls."""
    policy = TrainedPolicy(run_config(POLICY), find_checkpoint(POLICY, None))
    changes = [
        *undisturbed(policy.cfg, 8, 20.0),
        *ENGINE,
        *on_terrain(policy.cfg, 8.0, 0.1),
        ("commands.heading_command", True),
    ]
    changes.append(("init_state.yaw", [-math.pi, math.pi]))
    cfg = override(policy.cfg, changes)

    def points(name, size):
        task, act = restore(policy, changes, torch.device("cpu"), terrain=tiles_of_sizes(name, [size], cfg.terrain, 1))
        ((entry,), _) = success.measure_success(task, act, [size], 8)
        return entry

    slope, pit = points("slope_up", 10.0), points("pit", 1.0)
    assert slope["successes"] == 8
    assert 4.5 < slope["mean_time_s"] < 10.0  # 4 m at 0.75 m/s are 5.3 s on level ground
    assert pit["successes"] == 0
    assert pit["fell"] + pit["stuck"] == 8
