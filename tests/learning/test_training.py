"""Training from the command line: what a run leaves behind, how it goes on, and how it stops."""

import contextlib
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
import yaml
from helpers import HANG_S, TASK, TINY_TRAINING, call, checkpoints, run_folders, tiny_run, wait_for

import legged
from legged.cli.train import train
from legged.commandline.arguments import POLICY, policy_overrides
from legged.config import from_dict
from legged.config.loader import read_yaml
from legged.deploy.command_parser import CommandParser
from legged.learning.run_folder import find_run, run_config
from legged.learning.runner import Runner
from legged.policies.restore import policy_of
from legged.registry import make_task, task_config

REPOSITORY = Path(legged.__file__).parents[1]
UPDATES = 20  # optimiser steps per iteration: 5 epochs of 4 mini-batches
SIZES = ["train.policy.actor_hidden_dims=[8]", "train.policy.critic_hidden_dims=[8]"]

pytestmark = pytest.mark.usefixtures("workplace")


def saved(folder: Path, iteration: int) -> dict:
    return torch.load(folder / f"model_{iteration}.pt", weights_only=True)


def optimiser_steps(checkpoint: dict) -> set[int]:
    return {int(state["step"]) for state in checkpoint["optimizer_state_dict"]["state"].values()}


# ---- what a run leaves behind ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_run_leaves_its_configuration_the_state_of_the_code_events_and_checkpoints():
    folder = tiny_run("--run_name", "first", "--seed", "7", "rewards.scales.torques=-3e-5")
    assert re.fullmatch(r"\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d_first", folder.name)
    assert folder.parent == Path("logs") / TASK
    assert list(folder.glob("events.out.tfevents.*"))
    assert checkpoints(folder) == [0, 1]
    assert not [path for path in folder.iterdir() if path.name.startswith(".")]
    code = (folder / "code.diff").read_text()
    assert re.match(r"legged \S+\n(commit [0-9a-f]{40}\n|not in a git repository of its own\n|git )", code)
    values = [("env.num_envs", 8), ("env.seed", 7), ("train.runner.max_iterations", 2), ("train.runner.run_name", "first")]
    more = [("rewards.scales.torques", -3e-5), ("sim.physics", "mujoco"), ("sim.threads", 1), ("train.runner.report", False)]
    network = [("train.policy.actor_hidden_dims", [8]), ("train.policy.critic_hidden_dims", [8])]
    expected = task_config(TASK, [*values, *more, *network, ("train.runner.num_steps_per_env", 4)], on_cpu=True)
    assert run_config(folder) == expected
    assert saved(folder, 1)["iter"] == 1
    assert optimiser_steps(saved(folder, 1)) == {2 * UPDATES}
    assert optimiser_steps(saved(folder, 0)) == {UPDATES}


@pytest.mark.slow
def test_tensorboard_gets_metrics_and_rewards_and_never_nan():
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    folder = tiny_run("env.episode_length_s=0.1")  # five steps: some iterations of four see an episode end
    events = EventAccumulator(str(folder))
    events.Reload()
    tags = set(events.Tags()["scalars"])
    for tag in ("Metrics/lin_vel_rmse", "Metrics/falls", "Metrics/episode_length", "Episode/rew_tracking_lin_vel"):
        assert tag in tags
    for tag in tags:
        values = [event.value for event in events.Scalars(tag)]
        assert all(value == value for value in values), tag
    assert [event.step for event in events.Scalars("Metrics/lin_vel_rmse")] == [0, 1]


@pytest.mark.slow
def test_lines_are_plain_where_there_is_no_terminal(capsys):
    arguments = ["--task", TASK, "--sim_device", "cpu", "--num_envs", "8", "--max_iterations", "2", *TINY_TRAINING]
    assert train.main(arguments) == 0
    out = capsys.readouterr().out
    assert "\x1b" not in out
    lines = [line for line in out.splitlines() if line.startswith("it ")]
    assert lines[0].startswith("it 1/2 ")
    assert lines[-1].startswith("it 2/2 ")
    for line in lines:
        for pattern in (r"[\d,]+ steps/s", r"error \d\.\d{3} m/s \d\.\d{3} rad/s", r"reward ", r"std 0\.\d\d"):
            assert re.search(pattern, line), line
    assert "finished after 2 iterations: 64 steps" in out
    assert f"legged play {TASK}" in out


@pytest.mark.slow
def test_a_fixed_seed_trains_to_the_same_network():
    first, second = tiny_run("--seed", "5"), tiny_run("--seed", "5")
    other = tiny_run("--seed", "6")
    networks = [saved(folder, 1)["actor_state_dict"] for folder in (first, second, other)]
    assert all(torch.equal(networks[0][name], networks[1][name]) for name in networks[0])
    assert not all(torch.equal(networks[0][name], networks[2][name]) for name in networks[0])


# ---- the command line ------------------------------------------------------------------------------------------------


def test_show_prints_yaml_that_loads_back_and_builds_nothing(capsys, monkeypatch):
    monkeypatch.setattr("legged.cli.train.make_task", lambda *_: pytest.fail("built"))
    arguments = ["--task", TASK, "--sim_device", "cpu", "--show", "--num_envs", "9", "rewards.scales.torques=-1e-6"]
    assert train.main(arguments) == 0
    shown = from_dict(yaml.safe_load(capsys.readouterr().out))
    assert shown == task_config(TASK, [("env.num_envs", 9), ("rewards.scales.torques", -1e-6)], on_cpu=True)
    assert not Path("logs").exists()


@pytest.mark.slow
def test_every_flag_of_legged_gym_is_accepted(capsys):
    loaded = tiny_run("--experiment_name", "e", num_envs=4)
    flags = (
        f"--resume --experiment_name e --run_name r --load_run {loaded.name} --checkpoint 0 --headless --num_envs 4 --seed 2"
    )
    capsys.readouterr()
    arguments = [
        "--task",
        TASK,
        *flags.split(),
        "--max_iterations",
        "9",
        "--sim_device",
        "cpu",
        "--rl_device",
        "cpu",
        "--show",
    ]
    assert call(train.main, arguments) == 0
    runner = from_dict(yaml.safe_load(capsys.readouterr().out)).train.runner
    assert (runner.experiment_name, runner.run_name, runner.max_iterations) == ("e", "r", 9)


def test_runs_of_an_experiment_lie_in_its_folder():
    folder = tiny_run("--experiment_name", "walking", iterations=1)
    assert folder.parent == Path("logs") / "walking"


# ---- going on --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_resuming_goes_on_with_iterations_optimiser_and_learning_rate():
    first = tiny_run("train.algorithm.learning_rate=2e-4")
    before = saved(first, 1)
    second = tiny_run("--resume", iterations=4)
    assert checkpoints(second) == [3]  # iterations 2 and 3; 0 and 50 would be saved in between
    after = saved(second, 3)
    assert after["iter"] == 3
    assert optimiser_steps(after) == {4 * UPDATES}
    assert run_config(second).train.runner.max_iterations == 4
    assert checkpoints(first) == [0, 1]  # the old folder is left alone
    task = make_task(run_config(second))
    runner = Runner(task)
    runner.load(str(first / "model_1.pt"))
    assert runner.alg.learning_rate == before["infos"]["learning_rate"]
    assert runner.alg.optimizer.param_groups[0]["lr"] == before["infos"]["learning_rate"]
    assert runner.current_learning_iteration == 2
    for name, value in runner.alg.get_policy().state_dict().items():
        assert torch.equal(value, before["actor_state_dict"][name])


@pytest.mark.slow
def test_resuming_restores_the_command_curriculum():
    folder = tiny_run(iterations=1)
    checkpoint = saved(folder, 0)
    share = torch.tensor([0.9, 0.65, 0.8])
    checkpoint["infos"]["task_state"]["command_curriculum"]["share"] = share
    torch.save(checkpoint, folder / "model_0.pt")
    (folder / "state_0.pt").unlink()  # which holds the curriculum as it was
    task = make_task(run_config(folder))
    Runner(task).load(str(folder / "model_0.pt"))
    assert torch.allclose(task.command_curriculum.share, share)
    assert torch.allclose(task.command_sampler.ranges, task.command_sampler.full_ranges * share.unsqueeze(1))
    resumed = tiny_run("--resume", "commands.curriculum.window_s=1000", iterations=2)
    again = saved(resumed, 1)["infos"]["task_state"]["command_curriculum"]["share"]
    assert torch.allclose(again, share)


@pytest.mark.slow
def test_resuming_from_a_checkpoint_in_the_middle_repeats_nothing():
    folder = tiny_run("train.runner.save_interval=1", iterations=3)
    assert checkpoints(folder) == [0, 1, 2]
    resumed = tiny_run("--resume", "--load_run", folder.name, "--checkpoint", "0", iterations=2)
    assert checkpoints(resumed) == [1]
    assert optimiser_steps(saved(resumed, 1)) == {2 * UPDATES}


@pytest.mark.slow
def test_resuming_what_is_finished_is_an_error_and_leaves_no_folder(capsys):
    tiny_run()
    before = run_folders()
    assert call(train.main, ["--task", TASK, "--sim_device", "cpu", "--resume", "--max_iterations", "2", *SIZES]) == 2
    assert "--max-iterations" in capsys.readouterr().err
    assert run_folders() == before


def test_a_run_without_a_name_is_no_new_training(capsys):
    """As a script has it whose variable is empty."""
    arguments = ["--task", TASK, "--sim_device", "cpu", "--load_run", "", "--max_iterations", "1", *SIZES]
    assert call(train.main, arguments) == 2
    assert capsys.readouterr().err.startswith("error: --load-run: there is no run ''")
    assert run_folders() == []


@pytest.mark.slow
def test_the_newest_run_is_the_one_trained_last_not_the_one_looked_at_last():
    old = tiny_run("--run_name", "1_old", iterations=1)
    new = tiny_run("--run_name", "2_new", iterations=1)
    later = time.time() + 100.0
    (old / "evaluation_mujoco.json").write_text("{}")  # as evaluate and play write into a run's folder
    os.utime(old, (later, later))
    assert find_run(task_config(TASK), None) == new


@pytest.mark.slow
@pytest.mark.parametrize("name", ["walking", "walking/{run}", "logs/walking/{run}"])
def test_a_policy_is_found_by_the_arguments_that_commands_share(name):
    folder = tiny_run("--experiment_name", "walking", "train.runner.save_interval=1")
    parser = CommandParser("x", "Do.", "x a", "x b", arguments=POLICY)
    args = parser.parse_intermixed_args([name.format(run=folder.name), "--checkpoint", "0", "env.seed=3"])
    assert policy_overrides(args) == [("env.seed", 3)]
    policy = policy_of(args.policy, args.checkpoint)
    assert policy.checkpoint == folder / "model_0.pt"
    assert policy.cfg == from_dict(read_yaml(folder / "config.yaml"))


# ---- stopping --------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def training(*arguments: str):
    """A training of its own process, with its output in out.txt; killed in the end."""
    flags = ["--task", TASK, "--sim_device", "cpu", "--num_envs", "8", "--max_iterations", "100000"]
    command = [sys.executable, str(REPOSITORY / "train.py"), *flags, *TINY_TRAINING, *arguments]
    with open("out.txt", "w") as out:
        process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def loads(folder: Path, iteration: int) -> None:
    """A checkpoint from which a training could go on."""
    runner = Runner(make_task(run_config(folder)))
    runner.load(str(folder / f"model_{iteration}.pt"))
    assert runner.current_learning_iteration == iteration + 1
    assert optimiser_steps(saved(folder, iteration)) == {(iteration + 1) * UPDATES}


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_stops_after_the_iteration_with_a_checkpoint_of_it(number):
    with training("train.runner.save_interval=100000") as process:
        wait_for(lambda: "\nit 1/" in Path("out.txt").read_text(), process)
        process.send_signal(number)
        assert process.wait(timeout=HANG_S) == 128 + number
    out = Path("out.txt").read_text()
    assert "Traceback" not in out
    assert "stopping after this iteration" in out
    done = int(re.search(r"stopped after (\d+) iterations", out).group(1))
    (folder,) = run_folders()
    assert checkpoints(folder) == sorted({0, done - 1})
    assert not [path for path in folder.iterdir() if path.name.startswith(".")]
    loads(folder, done - 1)
    resumed = tiny_run("--resume", iterations=done + 1)
    assert checkpoints(resumed) == [done]


@pytest.mark.slow
def test_a_kill_leaves_the_checkpoints_saved_so_far_whole():
    with training("train.runner.save_interval=1") as process:
        wait_for(lambda: any(len(checkpoints(folder)) > 3 for folder in run_folders()), process)
        process.kill()
        process.wait()
    (folder,) = run_folders()
    for iteration in checkpoints(folder):  # whichever was being written: it is there whole, or not at all
        assert saved(folder, iteration)["iter"] == iteration
    loads(folder, max(checkpoints(folder)))
