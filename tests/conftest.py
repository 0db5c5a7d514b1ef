"""Fixtures: a working directory, the robot, and physics engines that are built once and shared."""

import legged.process.headless  # noqa: F401, I001  (chooses how to render, before MuJoCo is imported)

import os

import torch

# Without a GPU, Triton's interpreter runs the update's kernels. Triton reads this when tensordict imports it.
os.environ.setdefault("TRITON_INTERPRET", "0" if torch.cuda.is_available() else "1")

import functools
import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from importlib.util import find_spec
from pathlib import Path
from unittest import mock

import pytest
from devices import CUDA, ON_A_GPU, build, on_gpu
from helpers import kept_global_state

from legged.physics import Physics, RobotScene
from legged.physics.fused.smooth_dynamics import SmoothDynamics
from legged.process import neighbours
from legged.robots.robot import Robot, load_robot

# A shell ignores SIGINT for a program in the background, `nohup` SIGHUP; programs that the tests start would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)
if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
    signal.signal(signal.SIGHUP, lambda *_: None)
torch.set_num_threads(1)  # tensors are small here; a second thread only costs

collect_ignore = [] if find_spec("hypothesis") else ["fuzz"]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip the tests marked `gpu` where there is none."""
    if torch.cuda.is_available():
        return
    for item in items:
        if item.get_closest_marker("gpu"):
            item.add_marker(pytest.mark.skip(reason="torch finds no CUDA device"))


@pytest.fixture
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Commands run in the test's own folder, and what they change for the whole process is put back. A file asks for it with
    `pytestmark = pytest.mark.usefixtures("workplace")`. Trainings of other tests are no neighbours of theirs.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(neighbours, "FOLDER", str(tmp_path.with_name(f"{tmp_path.name}_neighbours")))
    with kept_global_state():
        yield


@pytest.fixture
def full_precision() -> Iterator[None]:
    """A GPU multiplies float32 matrices as they are, whatever a training before has asked of it."""
    matmul = torch.backends.cuda.matmul
    before, matmul.allow_tf32 = matmul.allow_tf32, False
    yield
    matmul.allow_tf32 = before


@pytest.fixture(scope="session")
def robot() -> Robot:
    return load_robot("anymal_c")


@pytest.fixture(scope="session")
def make_physics(robot: Robot) -> Callable[..., Physics]:
    """make_physics(name, num_envs=6, tag="", **sim): an engine, the same one for the same arguments; on the CPU, or by a name
    like "newton, cuda" on a GPU, but seen from the host.

    Engines are dear (mujoco_warp compiles for 25 s on a fresh machine and takes 1 to 3 s later), so tests share them
    and put every world into a state before use. A test that changes the model (`randomize`) takes a `tag` of its own.
    With the tag "stages", mujoco_warp has our constraint solver within its own launches.
    """

    @functools.cache
    def make(name: str, num_envs: int = 6, tag: str = "", **sim: float | str) -> Physics:
        scene, randomized = RobotScene(robot), ("friction", "added_base_mass") if tag and tag != "stages" else ()
        with stages_kept() if tag == "stages" else nullcontext():
            return build(scene, name, num_envs, randomized, threads=2, **sim)

    return make


@pytest.fixture(params=["cpu", on_gpu(CUDA)])
def device(request: pytest.FixtureRequest) -> str:
    """Return Warp's name of a device on which the fused launches are tested."""
    return request.param


def stages_kept() -> AbstractContextManager:
    """Return a context in which a mujoco_warp that is built has our constraint solver among its own launches for all else."""
    return mock.patch.object(SmoothDynamics, "why_not", return_value="the test wants stages")


@pytest.fixture(params=["mujoco", "mujoco_warp", "newton", *map(on_gpu, ("mujoco_warp, cuda", "newton, cuda"))])
def backend(request: pytest.FixtureRequest) -> str:
    """Every back-end, by a name for make_physics; a test that asks for this holds for all of them."""
    return request.param


STEPS = {
    "mujoco_warp, library": {"step": "library"},
    "mujoco_warp, stages": {"tag": "stages"},
}
"""Other ways of mujoco_warp to make a step."""


@pytest.fixture(params=["mujoco", "mujoco_warp", *STEPS, *map(on_gpu, ("mujoco_warp, cuda", "mujoco_warp, stages, cuda"))])
def physics(request: pytest.FixtureRequest, make_physics: Callable[..., Physics]) -> Physics:
    """Six worlds with the shipped solver options, in whatever state the last test left them."""
    way = request.param.removesuffix(ON_A_GPU)
    where = request.param.removeprefix(way)
    return make_physics(way.partition(", ")[0] + where, **STEPS.get(way, {}))
