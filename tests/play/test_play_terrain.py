"""Play on terrain: the tiles that were asked for, robots on them, figures for each type, and wrong input."""

import os
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from helpers import CALM, ENGINE, call, kept_global_state, tiny_run

from legged.cli.play import play
from legged.config import TaskConfig, override
from legged.envs import LeggedRobot
from legged.math import yaw_of
from legged.play import demonstrations, films
from legged.play.demonstrations import TrackingErrors
from legged.play.playground import ROWS_NEEDED, SETTING, Playground, label
from legged.process.paths import data_folder
from legged.registry import make_task, task_config
from legged.terrain import TERRAIN_TYPES

TYPES = [
    "slope_up",
    "slope_down",
    "rough_slope_up",
    "rough_slope_down",
    "stairs_up",
    "stairs_down",
    "obstacles",
    "random_grid",
]


def config(name: str = "anymal_c") -> TaskConfig:
    return task_config(name, [*ENGINE, *CALM], on_cpu=True)


def playground(cfg: TaskConfig, name: str | None = None, difficulty: float | None = None) -> Playground:
    found = Playground.of(cfg, name, difficulty)
    assert found is not None
    return found


def on(ground: Playground, cfg: TaskConfig, num_envs: int) -> LeggedRobot:
    """The task with its robots on their tiles."""
    torch.set_num_threads(1)
    cfg = override(cfg, [*SETTING, *ground.changes(cfg), ("env.num_envs", num_envs)])
    task = make_task(cfg, terrain=ground.build(cfg))
    ground.place(task)
    task.reset()
    return task


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a1_flat", "h1_flat"])
def test_flat_tasks_of_small_and_large_robots_have_ground_of_every_type(name):
    """Cells and tiles grow with what the types are made of: gaps between stones, platforms."""
    cfg = task_config(name)
    for kind in TERRAIN_TYPES:
        ground = playground(cfg, kind)
        built = ground.build(override(cfg, [*SETTING, *ground.changes(cfg)]))
        assert built.tile_size == pytest.approx((cfg.terrain.terrain_length, cfg.terrain.terrain_width), rel=1e-3)


# ---- the ground ------------------------------------------------------------------------------------------------------


def test_a_task_on_terrain_is_shown_on_each_of_its_types_once():
    cfg = config()
    ground = playground(cfg)
    assert [[spec.type for spec in row] for row in ground.rows] == [TYPES, TYPES]
    front, back = ({spec.type: spec.size for spec in row} for row in ground.rows)
    assert front["stairs_up"] == pytest.approx(0.05 + 0.18 * 0.5)
    assert back["obstacles"] == pytest.approx(0.05 + 0.2 * 0.8)
    terrain = ground.build(override(cfg, [*SETTING, *ground.changes(cfg)]))
    assert list(terrain.types) == TYPES
    assert terrain.origins.shape == (2, 8, 3)
    assert terrain.border == 3.0
    # The types that training has most of come first.
    assert [TYPES[column] for column in ground.columns(3)] == ["stairs_up", "stairs_down", "slope_up"]
    assert sorted(ground.columns(8)) == list(range(8))


def test_difficulty_alone_is_that_of_all_types():
    ground = playground(config(), difficulty=0.25)
    for row in ground.rows:
        assert [spec.size for spec in row] == [TERRAIN_TYPES[name].size(0.25) for name in TYPES]


def test_a_size_that_training_fixes_is_shown_unless_a_difficulty_is_asked_for():
    cfg = config("anymal_c_step")
    sizes = [{spec.size for row in ground.rows for spec in row} for ground in (playground(cfg), playground(cfg, "step"))]
    assert sizes == [{0.15}, {0.15}]
    hardest = [spec.size for row in playground(cfg, difficulty=1.0).rows for spec in row]
    assert hardest == [pytest.approx(0.05 + 0.18)] * len(hardest)


@pytest.mark.parametrize("task", ["anymal_c", "anymal_c_flat"])
def test_a_chosen_type_fills_all_tiles_with_steps_of_that_size(task):
    cfg = config(task)
    ground = playground(cfg, "stairs_up", 0.8)
    cfg = override(cfg, [*SETTING, *ground.changes(cfg)])
    assert cfg.terrain.mesh_type == "height_map"
    terrain = ground.build(cfg)
    assert set(terrain.types) == {"stairs_up"}
    riser = 0.05 + 0.18 * 0.8
    for x, y, _ in terrain.origins.reshape(-1, 3):
        steps = np.diff(terrain.height_map.height_at(np.linspace(x, x + 3.99, 400), np.full(400, y)))
        np.testing.assert_allclose(steps[np.abs(steps) > 1e-6], riser, rtol=1e-5)
        assert (steps > 0).sum() >= 7


def test_tiles_of_a_random_type_are_not_the_same():
    cfg = override(config(), SETTING)
    terrain = playground(cfg, "obstacles", 1.0).build(cfg)
    middles = terrain.origins[0, :, :2]
    x, y = np.meshgrid(np.arange(-3.95, 4.0, 0.1), np.arange(-3.95, 4.0, 0.1))
    tiles = [terrain.height_map.height_at(cx + x, cy + y) for cx, cy in middles]
    for i in range(1, len(tiles)):
        assert np.abs(tiles[i] - tiles[0]).max() > 0.1


def test_a_plane_stays_one_unless_a_type_is_named():
    assert Playground.of(config("anymal_c_flat"), None, None) is None


def test_labels_give_sizes_in_the_units_of_the_types():
    assert label("stairs_up", [0.19400000000000003]) == "stairs_up, step height 0.194 m"
    assert label("slope_down", [11.3, 17.7]) == "slope_down, angle 11 to 18 degrees"
    assert label("flat", [0.0]) == "flat"
    assert playground(config()).labels()["stairs_down"] == "stairs_down, step height 0.14 to 0.194 m"
    assert playground(config(), difficulty=0.5).labels()["stairs_down"] == "stairs_down, step height 0.14 m"


def test_a_task_on_steps_has_the_constraint_rows_that_play_gives_to_others():
    sim = task_config("anymal_c").sim
    assert (sim.njmax, sim.nconmax) == (ROWS_NEEDED, ROWS_NEEDED // 4)  # a contact has four rows


@pytest.mark.slow
def test_robots_start_on_their_tiles_and_face_along_x():
    ground = playground(config())
    task = on(ground, config(), num_envs=10)
    assert task.terrain is not None
    middles = torch.tensor(task.terrain.origins[0], dtype=torch.float32)[ground.columns(10)]
    assert ((task.base_pos - middles)[:, :2].abs() <= 0.3).all()
    assert (task.base_pos[:, 2] > middles[:, 2] + 0.3).all()
    assert yaw_of(task.base_quat).abs().max() < 1e-5
    names = [ground.label(task.terrain, pos).split(",")[0] for pos in task.base_pos.tolist()]
    assert names[:3] == ["stairs_up", "stairs_down", "slope_up"]
    assert set(names[:8]) == set(TYPES)
    assert names[8:] == names[:2]
    ground.place(task, shift=1)
    task.reset()
    assert ground.label(task.terrain, task.base_pos[0].tolist()).startswith("stairs_down, step height 0.14")
    # A tile length farther along x it stands on the harder one.
    x, y, z = task.base_pos[0].tolist()
    assert ground.label(task.terrain, (x + 8.0, y, z)) == "stairs_down, step height 0.194 m"


# ---- walking ---------------------------------------------------------------------------------------------------------


def test_errors_are_root_mean_squares_of_settled_robots():
    """Robot 0 is 0.3 and 0.4 off, robot 1 has just begun its episode, robot 2 falls and would spoil everything."""
    task = SimpleNamespace(
        num_envs=3,
        device="cpu",
        commands=torch.tensor([[0.7, 0.0, 0.2, 0.0]] * 3),
        base_lin_vel=torch.tensor([[0.4, 0.4, 9.0], [5.0, 5.0, 5.0], [7.0, 7.0, 7.0]]),
        base_ang_vel=torch.tensor([[9.0, 9.0, 0.3], [5.0, 5.0, 5.0], [7.0, 7.0, 7.0]]),
        terminated_buf=torch.tensor([False, False, True]),
    )
    errors = TrackingErrors(task)
    for _ in range(2):
        errors.add(task, torch.tensor([True, False, False]))
    assert errors.row(torch.tensor([True, True, False])) == ("0.500 m/s", "0.100 rad/s", "0")
    assert errors.row(torch.tensor([False, False, True])) == ("-", "-", "2")
    assert errors.row() == ("0.500 m/s", "0.100 rad/s", "2")


@pytest.mark.slow
@pytest.mark.parametrize("heading", [True, False])
def test_robots_are_asked_to_walk_along_x_and_are_counted_by_type(monkeypatch, heading):
    monkeypatch.setattr(demonstrations, "EPISODE_S", 0.1)
    cfg = override(config(), [("commands.heading_command", heading), ("commands.ranges.lin_vel_x", [-1.0, 0.5])])
    ground = playground(cfg)
    task = on(ground, cfg, num_envs=9)
    seen = []

    def act(observations) -> torch.Tensor:
        seen.append(task.commands.clone())
        return torch.zeros(9, 12)

    table = demonstrations.walk_out(task, act, ground, films.Video(task, 1, None))
    assert len(seen) == 2 * 5
    commands = torch.stack(seen)
    torch.testing.assert_close(commands[..., 0], torch.full((10, 9), 0.5))  # what the task was trained on
    assert (commands[..., 1] == 0.0).all()
    turning = commands[1:5, :, 2].abs().max() > 0  # robots start with a random yaw rate; steered back to heading 0
    assert bool(turning) == heading
    assert list(table.columns[0].cells) == list(ground.labels().values())
    assert dict(zip(TYPES, table.columns[1].cells, strict=True)) == {**dict.fromkeys(TYPES, "1"), "stairs_up": "2"}


class FakeCamera:
    """Notes which robot it was to follow, and what was written."""

    shots: list[tuple[int, str]] = []

    def __init__(self, task: LeggedRobot, count: int) -> None:
        self.followed, self.count = 0, count

    def picture(self, caption: list[str]) -> np.ndarray:
        self.shots.append((self.followed, caption[2]))
        return np.zeros((18, 32, 3), dtype=np.uint8)

    def close(self) -> None: ...


@pytest.mark.slow
def test_each_episode_shows_another_robot_and_says_what_is_below_it(monkeypatch, tmp_path):
    monkeypatch.setattr(demonstrations, "EPISODE_S", 0.08)
    monkeypatch.setattr(demonstrations, "EPISODES", 3)
    monkeypatch.setattr(films, "camera_of", FakeCamera)
    monkeypatch.setattr(FakeCamera, "shots", [])
    ground = playground(config(), difficulty=0.5)
    task = on(ground, config(), num_envs=2)
    with films.Video(task, 2, tmp_path) as film:
        demonstrations.walk_out(task, lambda _: torch.zeros(2, 12), ground, film)
    up, down = (0, "stairs_up, step height 0.14 m"), (1, "stairs_down, step height 0.14 m")
    assert FakeCamera.shots == [up, up, down, down, up, up]
    assert (tmp_path / "play.mp4").is_file()


# ---- the command -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of anymal_c on two types."""
    with pytest.MonkeyPatch.context() as patch, kept_global_state():
        patch.chdir(tmp_path_factory.mktemp("play"))
        kept = {"slope_up": 0.6, "obstacles": 0.4}
        shares = ", ".join(f"{name}: {kept.get(name, 0)}" for name in TYPES)
        tiles = ["terrain.num_rows=2", "terrain.num_cols=4", "terrain.max_init_terrain_level=1"]
        folder = Path.cwd() / tiny_run("--task", "anymal_c", *tiles, f"terrain.proportions={{{shares}}}", iterations=1)
    return folder


@pytest.fixture
def short(monkeypatch):
    monkeypatch.setattr(demonstrations, "EPISODE_S", 1.2)
    monkeypatch.setattr(demonstrations, "EPISODES", 1)
    with kept_global_state():
        yield


def arguments(run: Path, out: Path, *more: str) -> list[str]:
    flags = ["--task", "anymal_c", "--load_run", str(run), "--sim_device", "cpu", "--out", str(out)]
    return [*flags, "sim.threads=1", "sim.physics=mujoco", *more]


@pytest.mark.slow
def test_play_on_the_types_of_the_task(run, short, tmp_path, capsys, monkeypatch):
    tasks = []
    monkeypatch.setattr(
        "legged.cli.play.walk_out", lambda task, *rest: tasks.append(task) or demonstrations.walk_out(task, *rest)
    )
    assert call(play.main, arguments(run, tmp_path, "--no-video", "--difficulty", "0.5")) == 0
    out = capsys.readouterr().out
    assert (tmp_path / "exported" / "policy.onnx").is_file()
    assert not list(tmp_path.glob("play*"))
    assert "slope_up, angle 11 degrees" in out
    assert "obstacles, height 0.15 m" in out
    assert out.count(" rad/s ") == 2
    assert "stairs" not in out
    (task,) = tasks
    assert task.num_envs == 2
    assert task.terrain.border == 3.0
    assert task.max_episode_length * task.dt > 1.2  # nobody is put back while it walks
    assert not task.cfg.observations.add_noise


@pytest.mark.slow
def test_play_records_a_film_of_one_type(run, short, tmp_path, capsys, monkeypatch):
    try:
        mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 16, 16).close()
    except Exception as error:  # each GL back-end fails in its own way
        pytest.skip(f"nothing can be rendered here: {error}")
    monkeypatch.setattr(demonstrations, "EPISODE_S", 1.0)
    more = ["--headless", "--gif", "--terrain", "stairs_down", "--difficulty", "0.8", "--num_envs", "1"]
    assert call(play.main, arguments(run, tmp_path, *more)) == 0
    out = capsys.readouterr().out
    assert "recorded 25 frames" in out
    assert "stairs_down, step height 0.194 m" in out
    assert {path.name for path in tmp_path.iterdir()} == {"exported", "play.mp4", "play.gif"}
    assert os.path.getsize(tmp_path / "play.mp4") > 1000


@pytest.mark.slow
def test_a_policy_for_a_plane_is_shown_on_terrain(short, tmp_path, capsys):
    """The one that is shipped, which sees no heights."""
    flags = ["--task", "anymal_c_flat", "--load_run", str(data_folder("resources") / "policies" / "anymal_c_flat")]
    flags += ["--sim_device", "cpu", "--no-video", "--out", str(tmp_path), "--terrain", "slope_down", "--num_envs", "2"]
    assert call(play.main, [*flags, "sim.threads=1", "sim.physics=mujoco"]) == 0
    row = next(line for line in capsys.readouterr().out.splitlines() if "slope_down" in line)
    cells = [cell.strip() for cell in row.strip("│ ").split("│")]
    assert cells[:2] == ["slope_down, angle 11 to 18 degrees", "2"]
    assert cells[4] == "0"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "more", "words"),
    [
        ("anymal_c", ["--terrain", "stair_up"], ["--terrain", "'stair_up'", "did you mean 'stairs_up'?"]),
        ("anymal_c", ["--difficulty", "1.01"], ["--difficulty", "between 0 and 1", "1.01"]),
        ("anymal_c", ["--terrain", "gap", "--difficulty", "-0.1"], ["--difficulty", "between 0 and 1"]),
        ("anymal_c", ["--difficulty", "nan"], ["--difficulty", "between 0 and 1"]),
        ("anymal_c", ["terrain.proportions={gapp: 0.5}"], ["terrain.proportions.gapp", "did you mean 'gap'?"]),
        ("anymal_c", ["--terrain", "pit", "terrain.terrain_length=3"], ["3 x 8 m", "platform of 'pit'"]),
        ("anymal_c_flat", ["--gif"], ["--gif", "--no-video"]),
        ("anymal_c_flat", ["--difficulty", "0.5"], ["--difficulty", "anymal_c_flat", "plane", "--terrain"]),
    ],
)
def test_wrong_input_ends_before_anything_is_built(run, tmp_path, capsys, monkeypatch, task, more, words):
    def build(*args: object, **kwargs: object) -> None:
        raise AssertionError("built")

    monkeypatch.setattr("legged.policies.restore.make_task", build)
    flags = arguments(run, tmp_path / "out", "--no-video", *more)
    if task != "anymal_c":
        flags[1], flags[3] = task, str(data_folder("resources") / "policies" / "anymal_c_flat")
    assert call(play.main, flags) == 2
    message = capsys.readouterr().err
    for word in words:
        assert word in message
    assert not (tmp_path / "out").exists()
