"""Evaluating and playing tasks without commands: their files, tables and flags; and an exported policy in Gymnasium."""

import json
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from helpers import call, kept_global_state, run_folders, tiny_run

from legged.cli.benchmark import ground, step
from legged.cli.evaluate import checkpoints, episodes, grid
from legged.cli.evaluate import evaluate as policy
from legged.cli.evaluate import gymnasium as in_gymnasium
from legged.cli.play import play
from legged.cli.runs import curves, evaluations
from legged.cli.terrain import terrain
from legged.errors import ConfigError
from legged.evaluation.episodes import run_exported

pytestmark = pytest.mark.usefixtures("workplace")
TASK = "half_cheetah"
SHORT = [TASK, "sim.threads=1", "env.episode_length_s=1"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder with one short run."""
    folder = tmp_path_factory.mktemp("cheetah")
    with pytest.MonkeyPatch.context() as patch, kept_global_state():
        patch.chdir(folder)
        tiny_run("--task", TASK, num_envs=4, iterations=2)
    return folder


@pytest.fixture
def run(trained, monkeypatch) -> Path:
    monkeypatch.chdir(trained)
    (folder,) = run_folders()
    return folder


@pytest.mark.slow
def test_episodes_are_measured_and_written(run, capsys):
    assert call(episodes.main, [*SHORT, "--physics", "mujoco", "--episodes", "3"]) == 0
    out = capsys.readouterr().out
    result = json.loads((run / "changed" / "evaluation_mujoco.json").read_text())  # its episodes are shorter than the task's
    assert (result["task"], result["checkpoint"], result["physics"], result["device"]) == (
        TASK,
        "model_1.pt",
        "mujoco",
        "cpu",
    )
    found = result["episodes"]
    assert (found["count"], found["failures"], found["length"]["mean"]) == (3, 0.0, 20.0)
    assert sum(found["terms"].values()) == pytest.approx(found["return"]["mean"], rel=1e-4)
    assert found["metrics"].keys() == {"x_velocity"}
    for words in ("3 episodes", f"{found['return']['mean']:.1f}", "evaluation_mujoco.json"):
        assert words in out


@pytest.mark.slow
def test_seeds_and_engines_are_compared(run, tmp_path, capsys):
    assert call(episodes.main, [*SHORT, "--physics", "mujoco", "--episodes", "2", "--out", str(tmp_path / "1")]) == 0
    result = json.loads((tmp_path / "1" / "evaluation_mujoco.json").read_text())
    for name, value in (("1", 10.0), ("2", 20.0)):
        result["episodes"]["return"]["mean"] = value
        (tmp_path / name).mkdir(exist_ok=True)
        (tmp_path / name / "evaluation_mujoco.json").write_text(json.dumps(result))
    other = {**result, "physics": "gymnasium", "episodes": {**result["episodes"], "metrics": {}}}
    (tmp_path / "2" / "evaluation_gymnasium.json").write_text(json.dumps(other))
    capsys.readouterr()
    assert call(evaluations.main, [str(tmp_path / "1"), str(tmp_path / "2")]) == 0
    out = capsys.readouterr().out
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in out.split("\n") if "│" in line]
    lines = {row[0]: row[1:] for row in rows}
    assert lines["return"] == ["15.00 (10.00 to 20.00)", "20.00"]
    assert lines["x_velocity"][1] == ""  # Gymnasium tells nothing of it
    del result["episodes"]["return"]["std"]
    (tmp_path / "1" / "evaluation_mujoco.json").write_text(json.dumps(result))
    assert call(evaluations.main, [str(tmp_path / "1")]) == 2
    assert "episodes.return.std: expected a number, got nothing" in capsys.readouterr().err


@pytest.mark.slow
def test_an_exported_policy_is_scored_by_gymnasium(run, tmp_path, capsys):
    """By Gymnasium's own count, beside the same loop written out here."""
    assert call(in_gymnasium.main, [TASK, "--episodes", "2", "--out", str(tmp_path)]) == 0
    assert "HalfCheetah-v5: 2 episodes" in capsys.readouterr().out
    result = json.loads((tmp_path / "evaluation_gymnasium.json").read_text())
    assert (result["physics"], result["environment"]) == ("gymnasium", "HalfCheetah-v5")
    policy = torch.jit.load(tmp_path / "exported" / "policy.pt")
    environment, returns = gymnasium.make("HalfCheetah-v5"), []
    for seed in range(2):
        seen, _ = environment.reset(seed=seed)
        returns.append(0.0)
        for _ in range(1000):
            action = policy(torch.tensor(np.float32(seen))[None])[0].detach().numpy().clip(-1, 1)
            seen, reward, _, _, _ = environment.step(action)
            returns[-1] += reward
    found = result["episodes"]
    assert found["return"]["mean"] == pytest.approx(np.mean(returns), rel=1e-6)
    assert found["return"]["std"] == pytest.approx(np.std(returns), rel=1e-6)
    assert (found["length"]["mean"], found["failures"]) == (1000.0, 0.0)
    assert found["terms"].keys() == {"forward", "ctrl"}


class Always(torch.nn.Module):
    """A policy that does one thing, as long as what it sees keeps within limits and begins as Gymnasium's first does."""

    def __init__(self, action: float, first: torch.Tensor) -> None:
        super().__init__()
        self.action = action
        self.register_buffer("first", first)
        self.steps = 0

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        self.steps += 1
        right = bool(observations.abs().max() <= 0.25)
        if self.steps == 1:
            right = right and torch.allclose(observations[0], self.first)
        return torch.full((observations.shape[0], 6), self.action if right else 0.0)

    @torch.jit.export
    def reset(self) -> None:
        self.steps = 0


def exported(folder: Path, action: float, **changes) -> Path:
    """A policy of one action as play exports one."""
    seen, _ = gymnasium.make("HalfCheetah-v5").reset(seed=0)
    first = np.clip(seen * np.array([2.0] * 8 + [3.0] * 9), -0.25, 0.25)
    torch.jit.save(torch.jit.script(Always(action, torch.tensor(first, dtype=torch.float32))), folder / "policy.pt")
    described = {
        "observation": [{"size": 8, "scale": [2.0] * 8}, {"size": 9, "scale": [3.0] * 9}],
        "observation_clip": 0.25,
        "observation_groups": [{"history": 1}],
        "action_clip": 2.0,
        "control_middle": [0.0] * 6,
        "control_reach": [0.5] * 6,
    }
    (folder / "policy.json").write_text(json.dumps({**described, **changes}))
    return folder


@pytest.mark.slow
def test_controls_are_those_that_the_file_describes(tmp_path):
    """An action of 1 is half of what a motor can do: the controls cost 0.1 * 6 * 0.5^2 a step. One of 9 is clipped at 2."""
    for action, cost in ((1.0, 150.0), (9.0, 600.0)):
        measured = run_exported(exported(tmp_path, action), "HalfCheetah-v5", 1)
        assert measured["terms"]["ctrl"] == pytest.approx(-cost, rel=1e-5)
        assert measured["return"]["mean"] == pytest.approx(sum(measured["terms"].values()), rel=1e-6)


@pytest.mark.parametrize(
    ("changes", "name", "words"),
    [
        (
            {"observation": [{"size": 18, "scale": 1.0}]},
            "HalfCheetah-v5",
            r"differ: HalfCheetah-v5 \(\(17,\), \(6,\)\), policy \(\(18,\), ",
        ),
        ({}, "QuarterCheetah-v5", "has no QuarterCheetah-v5"),
    ],
)
def test_a_policy_for_something_else_is_refused(changes, name, words, tmp_path):
    with pytest.raises(ConfigError, match=words):
        run_exported(exported(tmp_path, 0.0, **changes), name, 1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "arguments", "words"),
    [
        (grid, [TASK, "--vx=0"], f"POLICY: '{TASK}' has no velocity commands; use `legged evaluate episodes"),
        (checkpoints, [TASK], f"POLICY: '{TASK}' has no velocity commands; use `legged evaluate episodes"),
        (episodes, [TASK, "--num-envs", "3"], "--num-envs: leave it out, because the evaluation chooses"),
        (episodes, [TASK, "--episodes", "0"], "--episodes: must be at least 1, got 0"),
        (in_gymnasium, [TASK, "--episodes", "100000"], "--episodes: must be at most 65,536, got 100,000"),
        (episodes, [TASK, "--physics", "all"], "sim.physics: unknown value 'all'"),
        (in_gymnasium, [TASK, "--physics", "mujoco"], "--physics: leave it out, because Gymnasium simulates the robots"),
        (in_gymnasium, [TASK, "--sim-device", "cpu"], "--sim-device: leave it out, because Gymnasium simulates the robots"),
        (in_gymnasium, ["humanoid"], "'humanoid'"),
        (episodes, ["anymal_c_flat"], "POLICY: 'anymal_c_flat' follows velocity commands; use `legged evaluate grid"),
        (in_gymnasium, ["anymal_c_flat"], "'anymal_c_flat'"),
    ],
)
def test_a_policy_of_the_other_kind_of_task_is_refused(run, command, arguments, words, capsys):
    assert call(command.main, arguments) == 2
    err = capsys.readouterr().err
    assert words in err
    assert err.count("\n") == 1


def test_evaluate_measures_what_fits_the_task(run, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("legged.cli.evaluate.ENVIRONMENTS", 3)
    assert call(policy.main, [*SHORT, "--physics", "mujoco", "--out", str(tmp_path)]) == 0
    assert "half_cheetah" in capsys.readouterr().out
    assert json.loads((tmp_path / "evaluation_mujoco.json").read_text())["episodes"]["count"] == 3


def test_play_exports_and_prints_a_table(run, tmp_path, capsys):
    assert call(play.main, [*SHORT, "sim.physics=mujoco", "--no-video", "--num_envs", "2", "--out", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "half_cheetah: 2 episodes" in out
    assert "return of forward" in out
    described = json.loads((tmp_path / "exported" / "policy.json").read_text())
    assert [(term["name"], term["start"], term["size"]) for term in described["observation"]] == [
        ("position", 0, 8),
        ("velocity", 8, 9),
    ]
    assert described["actuator_names"] == ["bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot"]
    assert (described["control_middle"], described["control_reach"]) == ([0.0] * 6, [1.0] * 6)
    assert (described["control_dt"], described["sim_dt"], described["action_clip"]) == (pytest.approx(0.05), 0.01, 1.0)


@pytest.mark.parametrize("flag", [["--terrain", "pit"], ["--difficulty", "0.5"]])
def test_a_model_with_a_floor_of_its_own_has_no_tiles(run, flag, capsys):
    assert call(play.main, [*SHORT, "--no-video", *flag]) == 2
    assert f"{flag[0]}: 'half_cheetah' has no terrain to choose" in capsys.readouterr().err


def test_there_is_no_terrain_to_show_or_to_compare_colliders_on(capsys):
    assert call(terrain.main, [TASK]) == 2
    assert "'half_cheetah' has no terrain to show" in capsys.readouterr().err
    assert call(ground.main, [TASK, "--sim-device", "cpu", "sim.physics=mujoco_warp"]) == 2
    assert "TASK: 'half_cheetah' has no terrain" in capsys.readouterr().err


def test_a_step_is_timed(capsys):
    few = ["--num_envs", "4", "--steps", "2", "--repeats", "1", "--iterations", "0", "sim.physics=mujoco", "sim.threads=1"]
    assert call(step.main, [TASK, "--sim-device", "cpu", *few]) == 0
    assert "half_cheetah, 4 robots, CPU" in capsys.readouterr().out


def test_a_run_is_drawn(run, tmp_path):
    assert call(curves.main, [str(run), "--out", str(tmp_path)]) == 0
    assert (tmp_path / "learning_curve.png").read_bytes().startswith(b"\x89PNG")
