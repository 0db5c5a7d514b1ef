"""Fixtures: a working directory, the robot, and physics engines that are built once and shared."""

import legged.process.headless  # noqa: F401, I001  (chooses how to render, before MuJoCo is imported)

import functools
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
from helpers import kept_global_state

from legged.config.schema import SimConfig
from legged.physics import Physics
from legged.physics import make_physics as build_physics
from legged.robots.robot import Robot, load_robot

torch.set_num_threads(1)  # tensors are small here; a second thread only costs


@pytest.fixture
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Commands run in the test's own folder, and what they change for the whole process is put back. A file asks for it with
    `pytestmark = pytest.mark.usefixtures("workplace")`.
    """
    monkeypatch.chdir(tmp_path)
    with kept_global_state():
        yield


@pytest.fixture(scope="session")
def robot() -> Robot:
    return load_robot("anymal_c")


@pytest.fixture(scope="session")
def make_physics(robot: Robot) -> Callable[..., Physics]:
    """make_physics(name, num_envs=6, tag="", **sim): an engine on the CPU, the same one for the same arguments.

    Engines are dear (mujoco_warp compiles for 25 s on a fresh machine and takes 1 to 3 s later), so tests share them
    and put every world into a state before use. A test that changes the model (`randomize`) takes a `tag` of its own.
    """

    @functools.cache
    def make(name: str, num_envs: int = 6, tag: str = "", **sim: float) -> Physics:
        return build_physics(robot, SimConfig(physics=name, threads=2, **sim), num_envs, torch.device("cpu"))

    return make


@pytest.fixture(params=["mujoco", "mujoco_warp", "newton"])
def backend(request: pytest.FixtureRequest) -> str:
    """Every back-end; a test that asks for this holds for all of them."""
    return request.param


STEPS = {
    "mujoco_warp, rounds": {"constraint_solver": "rounds"},
    "mujoco_warp, stages": {"smooth_dynamics": "stages"},
}
"""Other ways of mujoco_warp to make a step."""


@pytest.fixture(params=["mujoco", "mujoco_warp", *STEPS])
def physics(request: pytest.FixtureRequest, make_physics: Callable[..., Physics]) -> Physics:
    """Six worlds with the shipped solver options, in whatever state the last test left them."""
    name, _, _ = request.param.partition(", ")
    return make_physics(name, **STEPS.get(request.param, {}))
