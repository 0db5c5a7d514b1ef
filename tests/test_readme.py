"""What the README shows works: its example task, its commands, its numbers, and the policy that is shipped."""

import json
import re
import shlex
from pathlib import Path

import pytest
import torch

from legged.registry import import_tasks, make_task, task_config
from legged.rl import play, train
from legged.tools import benchmark, evaluate, plot

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
POLICY = ROOT / "resources" / "policies" / "anymal_c_flat"


def test_the_example_task_trains_without_touching_the_package(tmp_path, monkeypatch):
    (code,) = re.findall(r"```python\n# my_tasks.py\n(.*?)```", README, flags=re.DOTALL)
    path = tmp_path / "readme_tasks.py"
    path.write_text(code, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    options = ["env.num_envs=4", "train.runner.num_steps_per_env=4", "--max_iterations", "1", "--sim_device", "cpu"]
    assert train.main(["--import", str(path), "--task", "anymal_c_careful", *options]) == 0
    assert list(tmp_path.glob("logs/anymal_c_careful/*/model_0.pt"))

    import_tasks(str(path))
    task = make_task(task_config("anymal_c_careful", [("env.num_envs", 2), ("sim.physics", "mujoco")], on_cpu=True))
    assert task.observation_groups["critic"].buffer.shape == (2, 52)  # 48 and four feet
    assert "foot_slip" in task.rewards.names


@pytest.mark.parametrize(
    ("name", "main"),
    [
        ("python train.py", train.main),
        ("python play.py", play.main),
        ("python -m legged.tools.evaluate", evaluate.main),
        ("python -m legged.tools.benchmark", benchmark.main),
        ("python -m legged.tools.plot", plot.main),
    ],
)
def test_every_flag_that_is_shown_exists(name, main, capsys):
    shown = {
        word.split("=")[0] for line in re.findall(rf"{re.escape(name)}([^\n`#&]*)", README) for word in shlex.split(line)
    }
    with pytest.raises(SystemExit) as stop:
        main(["--help"])
    assert stop.value.code == 0
    usage = capsys.readouterr().out
    for flag in sorted(word for word in shown if word.startswith("--")):
        assert flag in usage, f"{name} has no {flag}"


def test_links_and_pictures_are_there():
    for target in re.findall(r"\]\((?!http)([^)]+)\)", README):
        assert (ROOT / target).is_file(), target


def test_shipped_policy_follows_commands_in_c_mujoco(tmp_path, capsys):
    grid = ["--vx=-1:1:1", "--vy=-1:1:1", "--yaw=-1:1:1", "--robots", "1", "--physics", "mujoco"]
    arguments = ["--task", "anymal_c_flat", "--load_run", str(POLICY), "--out", str(tmp_path), *grid]
    assert evaluate.main(arguments) == 0
    result = json.loads((tmp_path / "evaluation_mujoco.json").read_text())
    # 27 of the 125 cells, one robot each instead of 16: the corners and the axes, the hardest part of the grid.
    assert result["rmse_lin"]["mean"] < 0.10
    assert result["rmse_ang"]["mean"] < 0.12
    assert result["falls"] == 0.0


def test_numbers_of_the_results_table_are_those_of_the_shipped_evaluation():
    for engine, label in (("mujoco_warp", "1, mujoco-warp"), ("mujoco", "1, C MuJoCo")):
        result = json.loads((POLICY / f"evaluation_{engine}.json").read_text())
        (row,) = re.findall(rf"\| {label} \|(.*)\n", README)
        lin, ang, gait = result["rmse_lin"], result["rmse_ang"], result["gait"]
        assert f"{lin['mean']:.3f} ({lin['worst']:.3f})" in row
        assert f"{ang['mean']:.3f} ({ang['worst']:.3f})" in row
        assert f"{100 * result['falls']:.2f} %" in row
        assert f"{gait['duty_factor']:.2f}, {gait['steps_per_s']:.2f}" in row


def test_shipped_checkpoint_is_finite_and_of_this_task():
    saved = torch.load(POLICY / "model.pt", weights_only=False, map_location="cpu")
    assert saved["infos"]["task"] == "anymal_c_flat"
    assert all(torch.isfinite(tensor).all() for tensor in saved["actor_state_dict"].values())
