"""What several test files need: small tasks on the C engine, which compiles nothing and is built in 40 ms."""

import contextlib
import io
import json
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from legged.cli.train import train
from legged.config import TaskConfig
from legged.envs import LeggedRobot
from legged.learning.report_process import wait_for_reports
from legged.registry import make_task, task_config

HANG_S = 900.0
"""What takes longer hangs, on the busiest machine too: no test is decided by how fast it is [s]."""
TASK = "anymal_c_flat"
JOINTS = 12
POLICY = Path(__file__).resolve().parents[1] / "resources" / "policies" / TASK
"""The policy of that task which comes with the package."""
POLICY_ITERATION = json.loads((POLICY / "timing.json").read_text())["iterations"] - 1
"""The last iteration of its training, counted from 0."""

# One thread: the tests share their cores with whatever else runs.
ENGINE = [("sim.physics", "mujoco"), ("sim.threads", 1)]

# Nothing random beside the reset itself.
CALM = [
    ("observations.add_noise", False),
    ("domain_rand.randomize_friction", False),
    ("domain_rand.randomize_base_mass", False),
    ("domain_rand.push_robots", False),
]

TINY_TRAINING = [
    "train.runner.report=false",
    "sim.physics=mujoco",
    "sim.threads=1",
    "train.runner.num_steps_per_env=4",
    "train.policy.actor_hidden_dims=[8]",
    "train.policy.critic_hidden_dims=[8]",
]


def small_config(*overrides: tuple[str, Any], num_envs: int = 4) -> TaskConfig:
    """anymal_c_flat as a machine without a GPU runs it, undisturbed, with a few robots."""
    return task_config(TASK, [("env.num_envs", num_envs), *ENGINE, *CALM, *overrides], on_cpu=True)


def small_task(*overrides: tuple[str, Any], num_envs: int = 4) -> LeggedRobot:
    """The task of `small_config`."""
    torch.set_num_threads(1)
    return make_task(small_config(*overrides, num_envs=num_envs))


def zero_actions(task: LeggedRobot) -> torch.Tensor:
    """The actions that ask for the default pose."""
    return torch.zeros(task.num_envs, task.num_actions)


def stand(observations: TensorDict) -> torch.Tensor:
    """The policy that keeps the default pose."""
    return torch.zeros(len(observations["actor"]), JOINTS)


def tiny_run(*arguments: str, num_envs: int = 8, iterations: int = 2) -> Path:
    """Train for a moment in the working directory, which the test has moved to its tmp_path; the new run folder,
    with its report.
    """
    before = set(run_folders())
    flags = ["--task", TASK, "--sim_device", "cpu", "--num_envs", str(num_envs), "--max_iterations", str(iterations)]
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(out):
        code = train.main([*flags, *TINY_TRAINING, *arguments])
    assert code == 0, out.getvalue()
    wait_for_reports()
    (folder,) = set(run_folders()) - before
    return folder


def run_folders(logs: str = "logs") -> list[Path]:
    """All run folders below logs/."""
    return sorted(path for path in Path(logs).glob("*/*") if path.is_dir())


def checkpoints(folder: Path) -> list[int]:
    """Iterations that a run folder has checkpoints of."""
    names = [re.fullmatch(r"model_(\d+)\.pt", path.name) for path in folder.glob("*.pt")]
    return sorted(int(match.group(1)) for match in names if match)


def call(main: Any, arguments: Sequence[str]) -> int:
    """The exit code of a command, whether it returns one or argparse ends it."""
    try:
        return main(list(arguments))
    except SystemExit as stop:
        return int(stop.code or 0)


@contextlib.contextmanager
def kept_global_state() -> Iterator[None]:
    """Put back what a command changes for its whole process: thread count, signal handlers, how matrices are multiplied."""
    import signal

    threads, precision = torch.get_num_threads(), torch.backends.mkldnn.matmul.fp32_precision
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        torch.backends.mkldnn.matmul.fp32_precision = precision
        for number, handler in handlers.items():
            signal.signal(number, handler)


def until(condition: Callable[[], object]) -> None:
    """Wait until something holds."""
    end = time.monotonic() + HANG_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def wait_for(condition: Callable[[], object], process: subprocess.Popen, seconds: float = HANG_S) -> None:
    """Wait until something holds while a process runs whose output goes to out.txt, and maybe to err.txt."""
    end = time.monotonic() + seconds
    while not condition():
        said = "".join(path.read_text() for path in (Path("out.txt"), Path("err.txt")) if path.is_file())
        assert process.poll() is None, said
        assert time.monotonic() < end, said
        time.sleep(0.01)


def forget_modules_of(folder: Path) -> None:
    """Forget the modules that were imported from a folder. Others stay: what imports a library twice has two classes of one
    name.
    """
    for name, module in list(sys.modules.items()):
        spec = getattr(module, "__spec__", None)
        places = [*(spec.submodule_search_locations or ()), spec.origin] if spec is not None else []
        if any(isinstance(place, str) and Path(place).is_relative_to(folder) for place in places):
            del sys.modules[name]


def assert_goes_on_alike(settings: Sequence[tuple[str, Any]], actions: torch.Tensor) -> LeggedRobot:
    """Check that a small task that is saved half-way through `actions` (T, N, D), and one that takes its state over, observe
    the same bit by bit from there on; returns the first one.
    """
    task, half = small_task(*settings), len(actions) // 2  # the guard looks at its steps
    for action in actions[:half]:
        task.step(action)
    saved, random = task.state_dict(), torch.get_rng_state()
    wanted = [task.step(action)[0]["actor"] for action in actions[half:]]
    other = small_task(*settings)
    other.load_state_dict(saved)
    torch.set_rng_state(random)
    for action, right in zip(actions[half:], wanted, strict=True):
        torch.testing.assert_close(other.step(action)[0]["actor"], right, rtol=0.0, atol=0.0)
    return task
