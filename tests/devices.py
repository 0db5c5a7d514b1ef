"""Tests on a GPU: their mark, and physics engines there, seen by tests that work on the host."""

from collections.abc import Callable, Collection, Mapping
from typing import Any

import pytest
import torch
from torch import Tensor

from legged.config.world import SimConfig
from legged.physics import Physics, RobotState, Scene
from legged.physics import make_physics as build_physics

CUDA = "cuda:0"
"""The GPU of the tests, by the name that torch and Warp have for it."""
ON_A_GPU = ", cuda"
"""Ending of an engine's name in parameters of tests, where it runs on a GPU: "mujoco_warp, cuda"."""


def on_gpu(*values: Any, **options: Any) -> Any:
    """Return a parameter of tests that need a GPU."""
    return pytest.param(*values, marks=pytest.mark.gpu, **options)


def on_both(cases: Mapping[str, Any]) -> list[Any]:
    """Return parameters (device, case): every case on the CPU, by its own name, and again on a GPU."""
    here = [pytest.param("cpu", case, id=name) for name, case in cases.items()]
    return here + [on_gpu(CUDA, case, id=f"{name}{ON_A_GPU}") for name, case in cases.items()]


def build(
    scene: Scene,
    engine: str,
    num_envs: int,
    randomized: Collection[str] = (),
    quantities: Collection[str] = (),
    **sim: Any,
) -> Any:
    """Return worlds of `scene` in the engine that a test's parameter names, seen from the host where that is on a GPU."""
    name = engine.removesuffix(ON_A_GPU)
    device = torch.device("cpu" if name == engine else CUDA)
    physics = build_physics(scene, SimConfig(physics=name, **sim), num_envs, device, randomized, quantities)
    return physics if name == engine else Mirror(physics)


def engine_of(physics: Any) -> Physics:
    """Return the engine itself, which a test may see through a mirror."""
    return physics.engine if isinstance(physics, Mirror) else physics


class Mirror:
    """An engine on a GPU whose tensors are seen on the host. What is seen is copied after each call. What tests write in
    place, controls and the fields of the robots' state that a refresh fills, is copied before.
    """

    def __init__(self, engine: Physics) -> None:
        """Mirror all but those quantities that have not been asked for."""
        self.engine = engine
        self._written: list[tuple[Tensor, Tensor]] = []
        self._seen: list[tuple[Tensor, Tensor]] = []
        self._quantities: dict[str, Tensor] = {}
        self.qpos, self.qvel = self._mirrored(engine.qpos), self._mirrored(engine.qvel)
        self.ctrl, self.overflowed = self._mirrored(engine.ctrl, written=True), self._mirrored(engine.overflowed)
        self.robot_state: RobotState | None = None
        if engine.robot_state is not None:
            live = {tensor.untyped_storage().data_ptr() for tensor in (engine.qpos, engine.qvel)}
            fields = vars(engine.robot_state).items()
            self.robot_state = RobotState(
                **{name: self._mirrored(theirs, theirs.untyped_storage().data_ptr() not in live) for name, theirs in fields}
            )

    def _mirrored(self, theirs: Tensor, written: bool = False) -> Tensor:
        """Return a tensor on the host that follows one of the engine's, and leads it if it is `written`."""
        own = theirs.to("cpu", copy=True)
        self._seen.append((own, theirs))
        if written:
            self._written.append((own, theirs))
        return own

    def _call(self, function: Callable[..., None], *arguments: Any) -> None:
        """Call the engine between the copies, with tensors on its device."""
        for own, theirs in self._written:
            theirs.copy_(own)
        function(*(each.to(self.engine.device) if isinstance(each, Tensor) else each for each in arguments))
        for own, theirs in self._seen:
            own.copy_(theirs)

    def step(self) -> None:
        self._call(self.engine.step)

    def refresh(self) -> None:
        self._call(self.engine.refresh)

    def write(self, mask: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        self._call(self.engine.write, mask, qpos, qvel)

    def push(self, mask: Tensor, delta: Tensor) -> None:
        self._call(self.engine.push, mask, delta)

    def randomize(self, field: str, values: Tensor) -> None:
        self._call(self.engine.randomize, field, values)

    def load_state(self, saved: Mapping[str, Tensor]) -> None:
        self._call(self.engine.load_state, saved)

    def quantity(self, name: str) -> Tensor:
        if name not in self._quantities:
            self._quantities[name] = self._mirrored(self.engine.quantity(name))
        return self._quantities[name]

    def __getattr__(self, name: str) -> Any:
        return getattr(self.engine, name)
