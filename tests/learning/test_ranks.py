"""Training in several processes: they learn together, one of them saves, and they end together."""

import contextlib
import os
import queue
import re
import shlex
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from helpers import HANG_S, TASK, TINY_TRAINING, call, checkpoints, run_folders, small_task

import legged
from legged.cli.train import train
from legged.commandline.arguments import pick_device
from legged.errors import ConfigError, RunError
from legged.learning import distributed
from legged.process.ranks import Ranks
from legged.registry import make_task, task_config

pytestmark = pytest.mark.usefixtures("workplace")

REPOSITORY = Path(legged.__file__).parents[1]
TESTS = Path(__file__).parents[1]
TRAIN = ["--task", TASK, "--sim_device", "cpu", "--num_envs", "8", *TINY_TRAINING]

# train.py, whose processes log an iteration while the next one runs, as on GPUs. They also leave what they have learned, and
# their robots' friction, in rank<r>.pt.
SPY = """
import sys, torch
from legged.process.ranks import Ranks
from legged.cli.train import train
from legged.learning.captured import CapturedRunner
from legged.learning.runner import Runner
CapturedRunner._runs_ahead = True
learn = Runner.train

def spy(runner, until):
    start = runner.alg.get_policy().state_dict()["mlp.0.weight"].clone()
    finished = learn(runner, until)
    states = {name: network.state_dict() for name, network in runner._networks().items()}
    extra = {"start": start, "friction": runner.env.randomization.friction, "rate": runner.alg.learning_rate}
    torch.save({**states, **extra}, f"rank{Ranks.now().rank}.pt")
    return finished

Runner.train = spy
sys.exit(train.main())
"""


def two_processes(script, *arguments: str):
    """torchrun with two processes, its output in out.txt."""
    return torchrun("out.txt", "--standalone", "--nproc-per-node", "2", str(script), *arguments)


@contextlib.contextmanager
def torchrun(output: str, *arguments: str, **environment: str):
    """torchrun with its output in a file; killed in the end, with its children."""
    command = [sys.executable, "-m", "torch.distributed.run", *arguments]
    paths = os.pathsep.join(str(path) for path in (REPOSITORY, TESTS))
    with open(output, "w") as out:
        everything = {**os.environ, "PYTHONPATH": paths, **environment}
        process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT, env=everything, start_new_session=True)
    try:
        yield process
    finally:
        with contextlib.suppress(OSError):  # it is a zombie by now, or there is no /proc
            for child in children(process):  # torchrun gives each a session of its own
                os.kill(child, signal.SIGKILL)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def ended(process, code: int) -> str:
    """What two processes have said, once they have ended."""
    assert process.wait(timeout=HANG_S) == code, Path("out.txt").read_text()
    return Path("out.txt").read_text()


def children(process) -> list[int]:
    """Ids of torchrun's processes, in the order of their ranks."""
    return [int(child) for child in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()]


def wait_for_iterations(process) -> None:
    end = time.monotonic() + HANG_S
    while "\nit 1/" not in Path("out.txt").read_text():
        assert process.poll() is None, Path("out.txt").read_text()
        assert time.monotonic() < end
        time.sleep(0.05)


def test_a_process_that_waits_for_others_says_so(monkeypatch):
    said = queue.SimpleQueue()

    class Error:
        write, flush = staticmethod(said.put), staticmethod(lambda: None)

    def meet(*_args, **_kwargs):
        heard.append(said.get(timeout=HANG_S))

    heard: list[str] = []
    monkeypatch.setenv("MASTER_ADDR", "10.0.0.1")
    monkeypatch.setenv("MASTER_PORT", "29500")
    monkeypatch.setattr(distributed, "PATIENCE_S", 0.0)
    monkeypatch.setattr(distributed.dist, "init_process_group", meet)
    monkeypatch.setattr(sys, "stderr", Error)
    distributed.join(Ranks(1, 0, 3, 1), torch.device("cpu"))
    assert heard == ["rank 1 at 10.0.0.1:29500: waiting for the others of 3 processes"]

    def time_out(*_args, **_kwargs):
        raise distributed.dist.DistStoreError("Timed out after 1801 seconds waiting for clients.\nmore")

    monkeypatch.setattr(distributed, "PATIENCE_S", HANG_S)
    monkeypatch.setattr(distributed.dist, "init_process_group", time_out)
    with pytest.raises(
        RunError, match=r"^rank 1 at 10\.0\.0\.1:29500: .* did not meet.*\(Timed out after 1801 .* clients\.\)$"
    ):
        distributed.join(Ranks(1, 0, 3, 1), torch.device("cpu"))


@pytest.mark.slow
def test_two_processes_end_together_when_the_first_finds_their_target_reached():
    """The second evaluates nothing."""
    goal = ["train.runner.evaluate_interval=2", "train.runner.evaluate_envs=8", "train.runner.evaluate_s=0.1"]
    arguments = [*TRAIN, "--max_iterations", "50", *goal, "train.runner.stop_at.falls=0.9"]
    with two_processes(REPOSITORY / "train.py", *arguments) as process:
        out = ended(process, 0)
    (folder,) = run_folders()
    assert checkpoints(folder) == [0, 1]
    assert (folder / "model_best.pt").is_file()
    assert out.count("reached its target after 2 iterations: falls 0") == 1


@pytest.mark.slow
def test_two_processes_learn_one_policy_from_different_robots():
    Path("spy.py").write_text(SPY)
    policy = ["train.policy.obs_normalization=true", "train.policy.estimator.targets=[base_lin_vel]"]
    arguments = [*policy, "train.algorithm.critic_warmup_iterations=1", "--max_iterations", "2"]
    with two_processes("spy.py", *TRAIN, *arguments) as process:
        out = ended(process, 0)
    first, second = (torch.load(f"rank{r}.pt", weights_only=True) for r in (0, 1))
    for network in ("actor", "critic"):
        for name, tensor in first[network].items():
            assert tensor.equal(second[network][name]), name
    assert first["rate"] == second["rate"]
    assert not first["friction"].equal(second["friction"])
    assert not first["start"].equal(first["actor"]["mlp.0.weight"])  # something was learned
    assert not first["start"].equal(second["start"])  # and equal only because it was sent round
    # processes, iterations after that of the value function alone, steps, robots
    assert int(first["actor"]["obs_normalizer.count"]) == 2 * 1 * 4 * 8
    (folder,) = run_folders()
    assert checkpoints(folder) == [0, 1]
    saved = torch.load(folder / "model_1.pt", weights_only=True)["actor_state_dict"]
    assert all(tensor.equal(first["actor"][name]) for name, tensor in saved.items())
    assert out.count("it 2/2") == out.count("finished after 2 iterations: 128 steps") == 1
    assert "8 robots on each of 2 processes" in out


@pytest.mark.slow
def test_two_processes_teach_one_student():
    Path("spy.py").write_text(SPY)
    student = ["train.algorithm.class_name=Distillation", "--teacher", TASK, "train.distillation.gradient_length=4"]
    with two_processes("spy.py", *TRAIN, "--max_iterations", "2", *student) as process:
        ended(process, 0)
    first, second = (torch.load(f"rank{r}.pt", weights_only=True) for r in (0, 1))
    for network in ("actor", "teacher"):
        for name, tensor in first[network].items():
            assert tensor.equal(second[network][name]), name
    assert not first["friction"].equal(second["friction"])
    assert not first["start"].equal(first["actor"]["mlp.0.weight"])


def commands_of_the_page() -> list[list[str]]:
    """Return the words of the torchrun commands in docs/distributed.md, those of the Slurm script too."""
    page = (REPOSITORY / "docs" / "distributed.md").read_text(encoding="utf-8").replace("\\\n", " ")
    return [shlex.split(command) for command in re.findall(r"torchrun (--nnodes .*)", page)]


@pytest.mark.slow
def test_two_machines_learn_one_policy_into_one_run_folder():
    """Each machine is a torchrun of its own; they find each other by the flags that docs/distributed.md shows."""
    Path("spy.py").write_text(SPY)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        endpoint = f"127.0.0.1:{free.getsockname()[1]}"
    flags = commands_of_the_page()[0]
    flags = flags[: flags.index("train.py")]
    flags[flags.index("--nproc-per-node") + 1] = "1"
    flags[flags.index("--rdzv-endpoint") + 1] = endpoint
    command = [*flags, "spy.py", *TRAIN, "--max_iterations", "2"]
    with (
        torchrun("out.txt", *command, GLOO_SOCKET_IFNAME="lo") as one,
        torchrun("other.txt", *command, GLOO_SOCKET_IFNAME="lo") as other,
    ):
        said = ended(one, 0)
        assert other.wait(timeout=HANG_S) == 0, Path("other.txt").read_text()
    said += Path("other.txt").read_text()
    first, second = (torch.load(f"rank{r}.pt", weights_only=True) for r in (0, 1))
    for network in ("actor", "critic"):
        for name, tensor in first[network].items():
            assert tensor.equal(second[network][name]), name
    assert not first["start"].equal(first["actor"]["mlp.0.weight"])
    assert not first["friction"].equal(second["friction"])
    (folder,) = run_folders()
    saved = torch.load(folder / "model_1.pt", weights_only=True)["actor_state_dict"]
    assert all(tensor.equal(first["actor"][name]) for name, tensor in saved.items())
    assert said.count("finished after 2 iterations: 128 steps") == 1
    assert "8 robots on each of 2 processes" in said


def test_the_slurm_script_starts_the_same_training_and_is_one_of_bash():
    page = (REPOSITORY / "docs" / "distributed.md").read_text(encoding="utf-8")
    by_hand, by_slurm = commands_of_the_page()
    assert {word for word in by_hand if word.startswith("--")} <= set(by_slurm)
    train.build_parser().parse_intermixed_args(by_slurm[by_slurm.index("train.py") + 1 :])
    (script,) = re.findall(r"```bash\n(#!/bin/bash\n.*?)```", page, flags=re.DOTALL)
    assert subprocess.run(["bash", "-n"], input=script, text=True, check=False).returncode == 0


@pytest.mark.slow
def test_updates_of_several_processes_are_those_of_rsl_rl():
    with two_processes(TESTS / "ranks_learn.py") as process:
        out = ended(process, 0)
    for rank in (0, 1):
        for case in ("normalised, per mini-batch", "fixed rate", "symmetric", "guard"):
            assert f"rank {rank} {case} equal" in out


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="finds processes in /proc")
def test_a_process_that_dies_ends_the_run_and_is_named():
    with two_processes(REPOSITORY / "train.py", *TRAIN, "--max_iterations", "100000") as process:
        wait_for_iterations(process)
        first, second = children(process)
        os.kill(second, signal.SIGKILL)
        out = ended(process, 1)
    assert "rank 0: another process has ended" in out
    cause = out[out.index("Root Cause") :]
    assert re.search(r"rank +: 1 ", cause)
    assert "SIGKILL" in cause
    assert not Path(f"/proc/{first}").exists()


@pytest.mark.slow
def test_a_signal_stops_all_with_one_checkpoint():
    flags = ["--runner", "stock", "--max_iterations", "100000", "train.runner.save_interval=100000"]
    with two_processes(REPOSITORY / "train.py", *TRAIN, *flags) as process:
        wait_for_iterations(process)
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does; torchrun passes it on once more
        out = ended(process, 1)
    assert "Traceback" not in out.split("torch/distributed")[0]
    assert out.count("stopping after this iteration") == 1
    done = int(re.search(r"stopped after (\d+) iterations", out).group(1))
    (folder,) = run_folders()
    assert checkpoints(folder) == sorted({0, done - 1})
    assert torch.load(folder / f"model_{done - 1}.pt", weights_only=True)["iter"] == done - 1


def as_rank(monkeypatch, rank: int, count: int) -> None:
    places = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": count, "LOCAL_WORLD_SIZE": count}
    for name, value in places.items():
        monkeypatch.setenv(name, str(value))


@pytest.mark.slow
def test_robots_differ_between_processes_and_their_ground_does_not(monkeypatch):
    kinds = dict.fromkeys(task_config("anymal_c").terrain.proportions, 0.0) | {"rough_slope_up": 0.5, "obstacles": 0.5}
    sizes = [("terrain.num_rows", 2), ("terrain.num_cols", 2), ("terrain.border_size", 2.0)]
    ground = [("terrain.proportions", kinds), *sizes]
    cfg = task_config("anymal_c", [("env.num_envs", 4), ("sim.threads", 1), *ground], on_cpu=True)
    alone = make_task(cfg)
    tasks = []
    for rank in (0, 1):
        as_rank(monkeypatch, rank, 2)
        tasks.append(make_task(cfg))
    assert tasks[0].randomization.friction.equal(alone.randomization.friction)
    assert not tasks[1].randomization.friction.equal(alone.randomization.friction)
    for task in tasks:
        assert (task.terrain.height_map.heights == alone.terrain.height_map.heights).all()


def test_one_process_is_the_first_whatever_the_environment_says(monkeypatch):
    as_rank(monkeypatch, 1, 1)
    assert Ranks.now() == Ranks()
    assert Ranks.now().first
    assert not Ranks.now().several
    assert small_task().num_envs == 4


def test_each_process_has_the_gpu_of_its_number(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    as_rank(monkeypatch, 1, 2)
    for name in (None, "cuda", "cuda:1"):
        assert pick_device(name) == torch.device("cuda:1")
    assert pick_device("cpu") == torch.device("cpu")
    with pytest.raises(ConfigError, match="2 processes would share 'cuda:0'"):
        pick_device("cuda:0")
    as_rank(monkeypatch, 2, 3)
    with pytest.raises(ConfigError, match="3 processes need a GPU each, but torch sees 2"):
        pick_device(None)


def test_a_mistake_names_the_process(monkeypatch, capsys):
    as_rank(monkeypatch, 1, 2)
    assert call(train.main, ["--task", "anymal_z"]) == 2
    assert capsys.readouterr().err.startswith("rank 1: error: TASK: there is no task 'anymal_z'")


@pytest.mark.parametrize("name", ["RANK", "LOCAL_RANK", "WORLD_SIZE", "LOCAL_WORLD_SIZE"])
@pytest.mark.parametrize("text", ["two", "-1", "1.5"])
def test_an_environment_that_says_nonsense_is_named(monkeypatch, capsys, name, text):
    monkeypatch.setenv(name, text)
    assert call(train.main, ["--task", "anymal_c_flat", "--sim_device", "cpu"]) == 2
    assert capsys.readouterr().err.startswith(f"error: {name}: the environment says '{text}'")


def test_an_environment_that_says_nothing_is_one_process(monkeypatch):
    for name in ("RANK", "LOCAL_RANK", "WORLD_SIZE", "LOCAL_WORLD_SIZE"):
        monkeypatch.setenv(name, "")
    assert Ranks.now() == Ranks()


def test_a_rank_beyond_the_number_of_processes_is_named(monkeypatch):
    as_rank(monkeypatch, 2, 2)
    with pytest.raises(ConfigError, match="RANK: must be below 2, the number of processes, got 2"):
        Ranks.now()


def test_a_number_of_processes_that_was_left_behind_is_named_before_anything_is_built(monkeypatch, capsys):
    as_rank(monkeypatch, 0, 2)
    monkeypatch.delenv("MASTER_ADDR", raising=False)
    monkeypatch.setattr("legged.cli.train.make_task", lambda *_, **__: pytest.fail("built"))
    assert call(train.main, ["--task", "anymal_c_flat", "--sim_device", "cpu"]) == 2
    err = capsys.readouterr().err
    assert "error: WORLD_SIZE: the variable says that 2 processes train together" in err
    assert "MASTER_ADDR" in err
