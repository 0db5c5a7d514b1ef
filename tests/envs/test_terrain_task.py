"""The task on terrain: height scan, where robots start, the curriculum of levels, histories, blind actors."""

import math

import numpy as np
import pytest
import torch
from helpers import CALM, ENGINE, tiny_run, zero_actions

from legged.config.legged import CommandsConfig
from legged.config.robot import TerrainConfig
from legged.envs import LeggedRobot
from legged.errors import ConfigError
from legged.learning.display import Progress
from legged.mdp.commands import Commands
from legged.mdp.observations import ObservationGroup, ObservationTerms
from legged.mdp.sensors import HeightScan
from legged.mdp.terrain_curriculum import TerrainCurriculum
from legged.registry import make_task, task_config
from legged.terrain import Terrain, TileSpec

CPU = torch.device("cpu")
EVEN = {"stairs_up": 0.5, "slope_down": 0.5, **{n: 0.0 for n in ("slope_up", "rough_slope_up", "rough_slope_down")}}
SMALL = [
    ("terrain.num_rows", 4),
    ("terrain.num_cols", 2),
    ("terrain.border_size", 4.0),
    ("terrain.max_init_terrain_level", 1),
    ("terrain.proportions", {**EVEN, **{n: 0.0 for n in ("stairs_down", "obstacles", "random_grid")}}),
]

NOISY = ("observations.add_noise", True)


def config(name="anymal_c", *changes, num_envs=8):
    return task_config(name, [("env.num_envs", num_envs), *ENGINE, *CALM, *SMALL, *changes], on_cpu=True)


def terrain_task(name="anymal_c", *changes, num_envs=8) -> LeggedRobot:
    torch.set_num_threads(1)
    return make_task(config(name, *changes, num_envs=num_envs))


@pytest.fixture(scope="module")
def task() -> LeggedRobot:
    return terrain_task()


def yawed(*degrees: float) -> torch.Tensor:
    half = 0.5 * torch.deg2rad(torch.tensor(degrees))
    zero = torch.zeros_like(half)
    return torch.stack([half.cos(), zero, zero, half.sin()], dim=1)


# ---- height scan ---------------------------------------------------------------------------------------------------------


def step_terrain() -> Terrain:
    """One pit, 0.4 m deep and 4 m wide, in the middle of a level map."""
    cfg = TerrainConfig(mesh_type="height_map", border_size=2.0)
    return Terrain.of_tiles([[TileSpec("pit", 0.4)]], cfg, np.random.default_rng(0))


def pose(n):
    """Positions and orientations that no test reads."""
    return torch.zeros(n, 3), torch.zeros(n, 4)


def test_scan_points_turn_with_the_heading_and_read_the_lower_of_neighbours():
    """From (1.45, 0.05) the pit's riser is at x = 2: points ahead of it see 0, the others -0.4; turned by 180 degrees all
    see the pit; by 90 degrees the riser is on the right. The cell beside the riser counts as low (legged_gym).
    """
    cfg = TerrainConfig(measured_points_x=(0.0, 0.3, 0.7), measured_points_y=(-0.7, 0.0))
    scan = HeightScan(cfg, step_terrain(), pose(3))
    points = torch.tensor([[x, y] for x in (0.0, 0.3, 0.7) for y in (-0.7, 0.0)])
    torch.testing.assert_close(scan.points, points)
    place = torch.tensor([[1.45, 0.05, 0.2]]).expand(3, 3)
    scan.look_from(place, yawed(0.0, 180.0, 90.0))
    low = -0.4
    expected = [[low, low, low, low, 0.0, 0.0], [low] * 6, [0.0, low, 0.0, low, 0.0, low]]
    torch.testing.assert_close(scan.heights, torch.tensor(expected))
    torch.testing.assert_close(scan.ground, torch.full((3,), low))


@pytest.mark.parametrize(("scan", "seen"), [("lowest", [-0.4, -0.4, 0.0]), ("own", [-0.4, 0.0, 0.0]), ("highest", [0.0] * 3)])
def test_what_a_point_reads_beside_a_riser_is_a_setting(scan, seen):
    """The pit ends at y = -2 and x = 2. Points lie at y = 0.05, in the last cell of the pit, x = 1.95, and beyond it; seen
    from the pit's other side, at y = -2.05, the cell next to it belongs to the ground and has the pit as its neighbour.
    """
    cfg = TerrainConfig(measured_points_x=(0.0,), measured_points_y=(0.0,), scan=scan)
    reading = HeightScan(cfg, step_terrain(), pose(3))
    reading.look_from(torch.tensor([[1.95, 0.05, 0.0], [0.05, -2.05, 0.0], [2.05, 0.05, 0.0]]), yawed(0.0, 0.0, 0.0))
    torch.testing.assert_close(reading.heights[:, 0], torch.tensor(seen))
    torch.testing.assert_close(reading.ground, torch.tensor(seen))


@pytest.mark.slow
def test_every_map_of_a_task_reads_what_its_configuration_says():
    """The true one, and the displaced one of a robot that drifts, on the same ground as before."""
    task = terrain_task("anymal_c", ("terrain.scan", "highest"), ("observations.height_map.shift", 0.05), NOISY)
    expected = task.terrain.height_map.scan_map("highest")
    for scan in (task.height_scan, task.observation_terms.errors._map._scan):
        assert np.array_equal(scan._map.view(*expected.shape).numpy(), expected)


def test_scan_beyond_the_map_and_of_a_robot_that_blew_up_reads_the_border():
    scan = HeightScan(TerrainConfig(), step_terrain(), pose(2))
    scan.look_from(torch.tensor([[1e9, -1e9, 0.0], [math.nan, math.inf, 0.0]]), yawed(0.0, 0.0))
    assert torch.isfinite(scan.heights).all()
    assert scan.ground[0] == 0.0


def test_scan_on_a_plane_is_zero():
    scan = HeightScan(TerrainConfig(), None, pose(2))
    scan.look_from(torch.full((2, 3), 5.0), yawed(0.0, 30.0))
    assert scan.heights.shape == (2, 187)
    assert not scan.heights.any()


@pytest.mark.slow
def test_heights_observation(task):
    """clip(base_z - 0.5 - h, -0.35, 0.35) * 2.5 in the last 187 of 235 columns, worked from the map itself."""
    observations = task.reset()["actor"]
    assert observations.shape == (8, 235)
    x = task.base_pos[:, :1] + torch.cos(yaw(task)) * POINTS[:, 0] - torch.sin(yaw(task)) * POINTS[:, 1]
    y = task.base_pos[:, 1:2] + torch.sin(yaw(task)) * POINTS[:, 0] + torch.cos(yaw(task)) * POINTS[:, 1]
    ground = task.terrain.height_map
    i, j = ground.index(x.numpy(), y.numpy())
    height = torch.tensor(ground.scan_map("own")[i, j])
    expected = 2.5 * (task.base_pos[:, 2:3] - 0.5 - height).clamp(-0.35, 0.35)
    same = (observations[:, 48:] - expected).abs() < 1e-5
    assert same.float().mean() > 0.99  # a point on a border of cells may round to either


POINTS = torch.tensor([[0.1 * i - 0.8, 0.1 * j - 0.5] for i in range(17) for j in range(11)])


def yaw(task) -> torch.Tensor:
    w, x, y, z = task.base_quat.unbind(dim=1)
    return torch.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)).unsqueeze(1)


def test_base_height_is_above_the_ground_around(task):
    task.reset()
    task.height_scan.update()
    height = task.base_pos[:, 2] - task.height_scan.heights.mean(dim=1)
    torch.testing.assert_close(task._reward_base_height(), (height - 0.5).square())
    assert (height - 0.6).abs().max() < 0.25  # spawned at 0.6 m, near the platform, whatever its level


# ---- where robots start, and when they are taken back --------------------------------------------------------------------


def test_robots_start_on_their_tile(task):
    """Within 1 m of its middle, at the spawn height above its highest middle point."""
    task.reset()
    offset = task.base_pos - task.env_origins
    assert offset[:, :2].abs().max() <= 1.0
    assert offset[:, :2].std() > 0.3
    torch.testing.assert_close(offset[:, 2], torch.full((8,), 0.6), atol=1e-5, rtol=0)
    rows, columns = task.terrain_curriculum.levels, task.terrain_curriculum.columns
    tiles = torch.tensor(task.terrain.origins, dtype=torch.float32)
    torch.testing.assert_close(task.env_origins, tiles[rows, columns])
    assert columns.tolist() == [0, 0, 0, 0, 1, 1, 1, 1]


def test_a_robot_that_walks_off_the_map_is_reset_and_not_blamed(task):
    """The map is 4 tiles of 8 m and a border of 4 m long: it ends at x = 20, and robots have left it at 19."""
    task.reset()
    assert task.terrain.reach == (19.0, 11.0)
    states = task.physics.robot_state
    place = states.base_pos.clone()
    place[2], place[3] = torch.tensor([19.2, 0.0, 0.6]), torch.tensor([0.0, -11.2, 0.6])
    place[4] = torch.tensor([18.8, 10.8, 0.6])
    everyone = torch.ones(8, dtype=torch.bool)
    task.physics.write(everyone, torch.cat([place, task.physics.qpos[:, 3:]], dim=1), torch.zeros(8, 18))
    _, _, dones, extras = task.step(zero_actions(task))
    assert dones.tolist() == [False, False, True, True, False, False, False, False]
    assert extras["time_outs"].tolist() == dones.tolist()
    assert (task.base_pos[2:4] - task.env_origins[2:4])[:, :2].abs().max() <= 1.01


@pytest.mark.slow
def test_lowest_base_height_counts_from_the_ground():
    """At the bottom of stairs of 0.2 m risers, a base 0.6 m above its ground is far below zero and still alright."""
    task = terrain_task("anymal_c", ("terminations.min_base_height", 0.3), ("terrain.max_init_terrain_level", 3))
    task.terrain_curriculum.place_at(torch.full((8,), 3), torch.ones(8, dtype=torch.long))
    task.reset()
    assert (task.base_pos[:, 2] < 0.0).all()
    task.step(zero_actions(task))
    assert not task.terminated_buf.any()


@pytest.mark.slow
def test_initial_headings_are_drawn():
    task = terrain_task("anymal_c", ("init_state.yaw", [1.0, 1.2]))
    assert ((yaw(task) >= 1.0) & (yaw(task) <= 1.2)).all()
    assert yaw(task).std() > 0.01


# ---- levels --------------------------------------------------------------------------------------------------------------


def curriculum(rows=10, robots=6, **changes) -> TerrainCurriculum:
    """Return a curriculum with a control step of 1 s."""
    cfg = TerrainConfig(mesh_type="height_map", num_rows=rows, border_size=2.0, max_init_terrain_level=0, **changes)
    tiles = [[TileSpec("flat", 0.0), TileSpec("pit", 0.0)] for _ in range(rows)]
    return TerrainCurriculum(cfg, Terrain.of_tiles(tiles, cfg, np.random.default_rng(0)), robots, 1.0, CPU)


def walk(levels: TerrainCurriculum, asked, walked, ended=True, valid=True, steps_left=0) -> list[int]:
    """Ask for `asked` m forward and walk `walked` m in a step of 1 s; return the levels."""
    n = len(levels.levels)
    commands, velocity = torch.zeros(n, 4), torch.zeros(n, 3)
    commands[:, 0], velocity[:, 0] = torch.as_tensor(asked), torch.as_tensor(walked)
    masks = [torch.as_tensor(mask).expand(n) for mask in (ended, valid)]
    levels.update(*masks, commands, velocity, torch.as_tensor(steps_left).expand(n))
    return levels.levels.tolist()


def test_levels_follow_success():
    """Further than 4 m or than 0.8 of what was asked: up. Less than half of it: down. Else, or still under way: as before."""
    levels = curriculum(robots=8)
    levels.levels.fill_(5)
    levels._place()
    ended = [True, True, True, True, False, True, True, True]
    asked = [20.0, 7.0, 1.0, 1.0, 20.0, 0.0, 3.8, 3.8]
    walked = [4.1, 3.9, 0.4, 0.6, 4.1, 0.0, 3.1, 3.0]
    assert walk(levels, asked, walked, ended) == [6, 5, 4, 5, 5, 5, 6, 5]
    x = levels.tiles.view(10, 2, 3)[levels.levels, levels.columns]
    torch.testing.assert_close(levels.origins, x)
    log = levels.metrics()
    assert log["Terrain/level_flat"] == pytest.approx(5.0)  # (6 + 5 + 4 + 5) / 4
    assert log["Terrain/promoted_flat"] == pytest.approx(1 / 4)
    assert log["Terrain/demoted_flat"] == pytest.approx(1 / 4)
    assert log["Terrain/promoted_pit"] == pytest.approx(1 / 3)


def test_robots_that_walk_along_a_curve_or_change_direction_move_up():
    """The end of both ways is near the middle of the tile, and the robots walked what they were asked to walk."""
    levels = curriculum(robots=2)
    commands = torch.tensor([[0.5, 0.0, 0.5, 0.0], [0.3, 0.4, 0.0, 0.0]])
    still, everyone = torch.tensor([[False] * 2, [True] * 2])
    for step in range(20):
        if step == 10:
            commands[1] *= -1.0
        velocity = 0.9 * commands[:, :3]  # in the base frame
        levels.update(everyone if step == 19 else still, everyone, commands, velocity, torch.full((2,), 19 - step))
    assert levels.levels.tolist() == [1, 1]
    assert levels.way.tolist() == [[0.0, 0.0], [0.0, 0.0]]


def test_progress_is_along_the_command():
    levels = curriculum(robots=2)
    levels.levels.fill_(5)
    commands, velocity = torch.tensor([[1.0, 0.0], [0.0, -8.0]]), torch.tensor([[0.0, 8.0, 0.0], [6.0, -6.0, 0.0]])
    everyone = torch.ones(2, dtype=torch.bool)
    levels.update(everyone, everyone, commands, velocity, torch.zeros(2, dtype=torch.long))
    assert levels.levels.tolist() == [4, 6]


def test_after_a_fall_the_last_command_counts_for_the_time_that_was_left():
    levels = curriculum(robots=2)
    levels.levels.fill_(5)
    assert walk(levels, 1.0, 1.0, steps_left=[2, 0]) == [4, 6]  # 1 m of 3 m, and of 1 m


def test_a_state_that_is_not_finite_moves_no_robot():
    levels = curriculum(robots=2)
    levels.levels.fill_(5)
    assert walk(levels, 1.0, [math.nan, 1.0], valid=[False, True]) == [5, 6]
    assert walk(levels, 1.0, 1.0) == [6, 7]


def test_nobody_falls_below_the_easiest_level():
    assert walk(curriculum(), 20.0, 0.0) == [0] * 6


def test_always_promoted_robots_have_a_mean_level_of_six():
    """Over ten rows and a random level after the top: sum of l (l + 1) over sum of (l + 1) = 330 / 55."""
    torch.manual_seed(0)
    levels = curriculum(robots=4000)
    means = []
    for i in range(200):
        levels.draw()
        walk(levels, 20.0, 5.0)
        if i >= 100:
            means.append(levels.levels.float().mean())
    assert torch.stack(means).mean() == pytest.approx(6.0, abs=0.05)


@pytest.mark.slow
def test_levels_are_saved_and_restored(task):
    state = task.progress()
    state["terrain_curriculum"]["levels"] = torch.tensor([3, 2, 1, 0, 3, 2, 1, 0])
    other = terrain_task()
    other.load_progress(state)
    assert other.terrain_curriculum.levels.tolist() == [3, 2, 1, 0, 3, 2, 1, 0]
    smaller = terrain_task(num_envs=4)
    state["terrain_curriculum"]["levels"].fill_(2)
    smaller.load_progress(state)
    assert smaller.terrain_curriculum.levels.tolist() == [2, 2, 2, 2]
    other.reset_curricula()
    assert other.terrain_curriculum.levels.max() <= 1


@pytest.mark.slow
def test_without_a_curriculum_rows_are_hard_and_robots_stay():
    task = terrain_task("anymal_c", ("terrain.curriculum", False))
    before = task.terrain_curriculum.levels.clone()
    assert before.max() > 1
    task.episode_length_buf = torch.full((8,), task.max_episode_length)
    task.step(zero_actions(task))
    assert task.reset_buf.all()
    torch.testing.assert_close(task.terrain_curriculum.levels, before)
    assert "Terrain/level" not in task.log_rollout()
    risers = -task.terrain.origins[:, task.terrain.types.index("stairs_up"), 2] / 9  # nine of them down to the middle
    assert set(np.round(risers, 3)) <= {0.14, 0.185, 0.212}


def test_the_step_judges_levels_and_logs_them(task):
    task.reset_curricula()
    task.reset()
    task.terrain_curriculum.levels.fill_(1)
    task.terrain_curriculum.way[1] = 10.0
    task.episode_length_buf = torch.full((8,), task.max_episode_length - 1)
    task.step(zero_actions(task))
    assert task.terrain_curriculum.levels.tolist() == [0] * 8  # asked for 10 m, walked none
    assert task.log_rollout()["Terrain/demoted_stairs_up"] == 1.0


def test_levels_are_displayed():
    values = {"Terrain/level": 3.2, "Terrain/level_pit": 3.2, "Terrain/promoted_pit": 0.5, "Terrain/demoted_pit": 0.25}
    progress = Progress(1, 10, 1.0, 9.0, 100.0, 0.5, 0.5, 1.0, 0.5, values)
    assert "level 3.20" in progress.line()
    assert progress.levels() == {"pit": "level 3.20  +50 % -25 %"}


# ---- what the networks see -----------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("name", "actor"), [("anymal_c", 235), ("anymal_c_blind", 48), ("anymal_c_proprio", 6 * 45)])
def test_the_critic_sees_heights_whatever_the_actor_does(name, actor):
    observations = terrain_task(name).get_observations()
    assert observations["actor"].shape == (8, actor)
    assert observations["critic"].shape == (8, 235)


def test_history_is_the_last_steps_oldest_first():
    """Values 1, 2, 3, ... of one column; a robot that starts anew repeats its first."""
    value = torch.zeros(2, 1)
    source = ObservationTerms({"count": lambda: value})
    group = ObservationGroup(source, ["count"], {}, {}, clip=100.0, history=3)

    def step(number: float, fresh: list[bool]) -> list[list[float]]:
        value.fill_(number)
        source.evaluate()
        group.advance()
        group.compute()
        group.restart(torch.tensor(fresh))
        return group.buffer.tolist()

    assert step(1.0, [True, True]) == [[1, 1, 1], [1, 1, 1]]
    assert step(2.0, [False, False]) == [[1, 1, 2], [1, 1, 2]]
    assert step(3.0, [False, True]) == [[1, 2, 3], [3, 3, 3]]
    value.fill_(9.0)
    source.evaluate()
    group.compute()  # the same step, seen again
    assert group.buffer.tolist() == [[1, 2, 9], [3, 3, 9]]


@pytest.mark.slow
def test_the_history_of_a_task_moves_once_a_step_and_holds_no_other_episode():
    task = terrain_task("anymal_c_proprio")
    task.reset()
    first = task.hold_commands(torch.tensor([0.5, 0.0, 0.0]))["actor"].view(8, 6, 45)
    for i in range(6):
        torch.testing.assert_close(first[:, i], first[:, 5])  # no step with the command before
    second = task.step(zero_actions(task))[0]["actor"].view(8, 6, 45)
    torch.testing.assert_close(second[:, :5], first[:, 1:])
    assert (second[:, 5] - second[:, 4]).abs().max() > 0.0
    task.episode_length_buf[3] = task.max_episode_length
    third = task.step(zero_actions(task))[0]["actor"].view(8, 6, 45)
    torch.testing.assert_close(third[3, 0], third[3, 5])
    torch.testing.assert_close(third[2, :5], second[2, 1:])


def test_a_held_heading_steers():
    """0.5 * (heading - yaw), at most the largest yaw rate; a held command alone does not steer."""
    commands = Commands(CommandsConfig(heading_command=True), 3, 0.02, CPU)
    nobody = torch.zeros(3, dtype=torch.bool)
    commands.hold(torch.tensor([0.75, 0.1, 0.0]), heading=torch.tensor([0.4, -3.0, 0.0]))
    commands.update(nobody, yawed(0.0, 0.0, 0.0))
    torch.testing.assert_close(commands.commands[:, 2], torch.tensor([0.2, -1.0, 0.0]))
    torch.testing.assert_close(commands.commands[:, :2], torch.tensor([[0.75, 0.1]]).expand(3, 2))
    commands.hold(torch.tensor([0.75, 0.1, 0.3]))
    commands.update(nobody, yawed(0.0, 90.0, 0.0))
    torch.testing.assert_close(commands.commands[:, 2], torch.full((3,), 0.3))


# ---- mistakes, and a training --------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ([("terrain.proportions", {"stairs_up": 0.6})], r"terrain\.proportions: must sum to 1, got 1\.1"),
        ([("terrain.proportions", {"stair_up": 0.1})], r"proportions\.stair_up: there is no terrain type.*'stairs_up'"),
        ([("terrain.terrain_length", 2.5)], r"tile of 2\.5 x 8 m .* not larger than the platform"),
        ([("terrain.spawn_range", 4.0)], r"terrain\.spawn_range: robots would start up to 4 m"),
        ([("terrain.max_init_terrain_level", 4)], r"max_init_terrain_level: must be below num_rows = 4"),
        ([("terrain.num_cols", 1)], r"less than one"),
    ],
)
def test_a_wrong_terrain_is_refused_before_anything_is_built(changes, message):
    with pytest.raises(ConfigError, match=message):
        config("anymal_c", *changes)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["anymal_c", "anymal_c_proprio"])
def test_a_training_on_terrain_runs_and_resumes(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    flags = ["--task", name, *(f"{key}={value}" for key, value in SMALL)]
    folder = tiny_run(*flags)
    saved = torch.load(folder / "model_1.pt", weights_only=True)
    assert saved["infos"]["task_state"]["terrain_curriculum"]["levels"].shape == (8,)
    assert tiny_run(*flags, "--resume", iterations=3) != folder
