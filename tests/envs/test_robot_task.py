"""A task with a robot that follows a motion, not velocity commands: every command works on it, as on its terrain."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import ENGINE, TINY_TRAINING, call

from legged.cli.episodes import record
from legged.cli.evaluate import evaluate
from legged.cli.export import export
from legged.cli.play import play
from legged.cli.train import train
from legged.commandline.show import summary
from legged.config import follows_velocities, has_robot
from legged.deploy.contract import read_contract
from legged.envs import is_robot_task, is_velocity_task
from legged.episodes.stored import load_episodes
from legged.errors import ConfigError
from legged.learning.run_folder import run_config
from legged.play.films import walker
from legged.play.live.session import Session, Watched, changes_for, check_ground
from legged.policies.restore import policy_of
from legged.registry import import_tasks, make_task, task_config
from legged.rendering.camera import RobotsCamera, camera_of

pytestmark = pytest.mark.usefixtures("workplace")

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "tasks.md").read_text(encoding="utf-8")
MODULE = (
    PAGE.partition("# dance.py\n")[2].partition("```")[0]
    + """
hills = {"mesh_type": "height_map", "proportions": {"waves": 0.5, "stairs_up": 0.5}, "num_rows": 6, "num_cols": 2}
register("dance_hills", {"extends": "dance", "terrain": hills}, Dance)
"""
)
ONE = [("env.num_envs", 4), ("env.episode_length_s", 0.4), *ENGINE]


@pytest.fixture
def dance(workplace) -> Path:
    """The module with the two tasks, which it registers."""
    Path("dance.py").write_text(MODULE, encoding="utf-8")
    import_tasks("dance.py")
    return Path("dance.py")


@pytest.fixture
def run(dance) -> Path:
    """Run folder of a short training on a plane, with evaluations."""
    flags = ["--task", "dance", "--import", str(dance), "--sim_device", "cpu", "--num_envs", "4", "--max_iterations", "2"]
    more = ["train.runner.evaluate_interval=1", "train.runner.evaluate_envs=4", "train.runner.film=false"]
    assert train.main([*flags, *TINY_TRAINING, *more]) == 0
    (folder,) = Path("logs/dance").iterdir()
    return folder


def test_the_task_has_a_robot_and_no_commands(dance, capsys):
    task = make_task(task_config("dance", ONE))
    assert has_robot(task.cfg)
    assert is_robot_task(task)
    assert not follows_velocities(task.cfg)
    assert not is_velocity_task(task)
    assert not hasattr(task.cfg, "commands")
    assert not hasattr(task, "commands")
    task.step(torch.zeros(4, 12))
    np.testing.assert_allclose(task.reference[0], task.default_dof_pos + 0.2 * np.sin(6.2832 * task.dt), rtol=1e-5)
    text = "\n".join(summary(task.cfg))
    assert "robot: anymal_c" in text
    assert "command" not in text


def test_robots_stand_on_tiles_of_their_terrain_and_keep_them(dance):
    task = make_task(task_config("dance_hills", ONE))
    assert task.terrain_curriculum.columns.tolist() == [0, 0, 1, 1]
    levels = task.terrain_curriculum.levels.clone()
    tiles = torch.tensor(task.terrain.origins, dtype=torch.float32)
    for _ in range(2 * task.max_episode_length):
        task.step(torch.zeros(4, 12))
    torch.testing.assert_close(task.terrain_curriculum.levels, levels, rtol=0.0, atol=0.0)
    torch.testing.assert_close(task.env_origins, tiles[levels, task.terrain_curriculum.columns])
    again = make_task(task_config("dance_hills", ONE))
    again.load_progress(task.progress())
    torch.testing.assert_close(again.env_origins, task.env_origins)


@pytest.mark.slow
def test_training_evaluates_episodes(run):
    assert run_config(run).task == "dance"
    assert (run / "model_best.pt").is_file()


@pytest.mark.slow
def test_play_films_and_exports(run, dance, capsys):
    flags = [str(run), "--import", str(dance), "--sim-device", "cpu", "--no-video", "--out", "played", *map(setting, ENGINE)]
    assert call(play.main, flags) == 0
    assert "exported" in capsys.readouterr().out
    said = json.loads(Path("played/exported/policy.json").read_text(encoding="utf-8"))
    assert len(said["joint_names"]) == 12
    assert "command_ranges" not in said
    with pytest.raises(ConfigError, match="'dance' is no task of a legged robot that follows commands"):
        read_contract(Path("played/exported/policy.json"))
    assert call(play.main, [*flags, "--terrain", "stairs_up"]) == 0


@pytest.mark.slow
def test_other_commands(run, dance, capsys):
    own = ["--import", str(dance), "--sim-device", "cpu"]
    assert call(evaluate.main, [str(run), *own, *map(setting, ENGINE)]) == 0
    assert json.loads((run / "evaluation_mujoco.json").read_text(encoding="utf-8"))["episodes"]["count"] > 1
    assert call(export.main, [str(run), "--import", str(dance), "--out", "all"]) == 0
    assert len(list(Path("all").glob("*/policy.onnx"))) == 2
    more = ["--episodes", "2", "--num-envs", "2", "--terrain", "waves", *map(setting, ENGINE)]
    assert call(record.main, [str(run), *own, *more]) == 0
    (found,) = run.glob("episodes*")
    recorded = load_episodes(found, "RUN")
    assert "feet_force" in recorded
    assert "command" not in recorded
    with pytest.raises(ConfigError, match="'dance' follows no commands"):
        walker(policy_of(str(run)))


@pytest.mark.slow
@pytest.mark.parametrize("kind", [None, "stairs_up"])
def test_watching(run, kind):
    cfg = run_config(run)
    session = Session(Watched(cfg, run), changes_for(cfg, 2, ENGINE), check_ground(cfg, kind, None))
    for _ in range(30):
        session.step()
    assert not session.has_commands
    assert session.history.feet
    curves = session.history.curves()
    assert np.isfinite(curves["actual"]).any()
    assert not np.isfinite(curves["commanded"]).any()
    camera = camera_of(session.task, 2, 64, 48)
    assert isinstance(camera, RobotsCamera)
    assert camera.picture().shape == (48, 64, 3)
    camera.close()


def setting(change: tuple[str, object]) -> str:
    return "=".join(map(str, change))
