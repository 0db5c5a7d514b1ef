"""Base class of the engines on Warp. It writes and reads states, handles streams, and captures steps on the CPU."""

from abc import abstractmethod
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from typing import Any

import mujoco
import numpy as np
import torch
import warp as wp
from torch import Tensor

from legged.physics.base import Physics
from legged.physics.robot_state import DrivenJoints
from legged.physics.warp.state_io import StateIO


class WarpPhysics(Physics):
    """N worlds in an engine written in Warp. All tensors are on one device, at fixed addresses, so that a step can be
    captured. On the CPU, this class records the step as a Warp graph.

    A subclass sets `model`, `qpos`, `qvel`, `ctrl`, `robot_state` and `_state_io`, and implements `_step` with Warp launches
    only.
    """

    capturable = True
    _state_io: StateIO
    _joints: DrivenJoints | None = None

    def __init__(self, num_envs: int, dt: float, device: torch.device) -> None:
        """Prepare the attributes that do not depend on the engine."""
        self.num_envs, self.dt, self.device = num_envs, dt, device
        self.overflowed = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self._wp_device = wp.device_from_torch(device)
        self.on_device = self._on_device
        self._forces_read = False
        self._advance: Callable[[], Any] = self._step

    @abstractmethod
    def _step(self) -> None:
        """Launch one physics step."""

    def _record_step(self) -> Callable[[], Any]:
        """Return a function that replays the step as a Warp graph on the CPU, with the same arithmetic but without the cost
        of launches from Python. The step runs once before the recording, so that its kernels are compiled.
        """
        with wp.ScopedDevice(self._wp_device):
            self._step()
            with wp.ScopedCapture(self._wp_device) as capture:
                self._step()
        return lambda: wp.capture_launch(capture.graph)

    def _on_device(self) -> AbstractContextManager[Any]:
        """Return a context in which Warp launches on this engine's device and on torch's current stream, so that launches of
        Warp and torch stay in order, also during a capture.
        """
        stack = ExitStack()
        stack.enter_context(wp.ScopedDevice(self._wp_device))
        if not self._wp_device.is_cpu:
            stream = torch.cuda.current_stream(self.device)
            # A second Warp object for the same stream would not know of the stream's capture.
            if self._wp_device.stream.cuda_stream != stream.cuda_stream:
                stack.enter_context(wp.ScopedStream(wp.stream_from_torch(stream), sync_enter=False))
        return stack

    def step(self) -> None:
        with self._on_device():
            self._advance()
            self._state_io.measure_groups()
            if self._joints is not None:
                self._joints.read()
        self._forces_read = False

    def refresh(self) -> None:
        forces_read, self._forces_read = self._forces_read, True
        with self._on_device():
            if not forces_read:  # without a new step, a second read would restore the forces that `write` has cleared
                self._state_io.contact_forces()
            if self._joints is not None:
                self._joints.read()
            self._state_io.kinematics()

    def write(self, mask: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        with self._on_device():
            self._state_io.write(mask, qpos, qvel)
        self._clear_groups(mask)

    def push(self, mask: Tensor, delta: Tensor) -> None:
        with self._on_device():
            self._state_io.push(mask, delta, self.qvel)

    def state_tensors(self) -> dict[str, Tensor]:
        return {"qpos": self.qpos, "qvel": self.qvel, **self._shared_state()}

    def copy_to(self, env_id: int, data: mujoco.MjData) -> None:
        data.qpos[:] = self.qpos[env_id].cpu().numpy().astype(np.float64)
        data.qvel[:] = self.qvel[env_id].cpu().numpy().astype(np.float64)
        mujoco.mj_forward(self.model, data)
