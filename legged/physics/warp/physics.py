"""What the back-ends on Warp share: states as views of the engine's arrays, streams, and capture on the CPU."""

from abc import abstractmethod
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import torch
import warp as wp
from torch import Tensor

from legged.physics.base import Physics, RobotState, allocate_state
from legged.physics.warp.exchange import StateExchange
from legged.robots.robot import Robot

wp.config.log_level = wp.LOG_WARNING
wp.config.enable_backward = False  # nothing here is differentiated, and adjoints double the time to compile
wp.init()


class WarpPhysics(Physics):
    """N worlds in an engine written in Warp. All tensors live on one device, at fixed addresses, so that a step can be
    captured; on the CPU the step is captured here, by Warp.

    A subclass sets `model`, `torques`, `_qpos`, `_qvel` and `_exchange`, and implements `_step` with Warp launches only.
    """

    capturable = True
    model: mujoco.MjModel
    """The robot in MuJoCo, for names, masses and pictures."""
    _qpos: Tensor
    """(N, 7 + D) base position [m], orientation (w, x, y, z) and joint angles [rad]."""
    _qvel: Tensor
    """(N, 6 + D) velocity of the base's origin, world frame [m/s], angular velocity, base frame, joints [rad/s]."""
    _exchange: StateExchange

    def __init__(self, robot: Robot, num_envs: int, dt: float, device: torch.device) -> None:
        """The part that needs no engine."""
        self.num_envs, self.dt, self.device, self.robot = num_envs, dt, device, robot
        self.overflowed = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self._wp_device = wp.device_from_torch(device)
        self._forces_read = False
        self._advance: Callable[[], Any] = self._step

    @abstractmethod
    def _step(self) -> None:
        """One physics step, as launches."""

    def _allocate_state(self) -> RobotState:
        """RobotState with the fields that `_qpos` and `_qvel` hold already as views of them."""
        return replace(
            allocate_state(self.num_envs, self.robot, self.device),
            base_pos=self._qpos[:, :3],
            base_quat=self._qpos[:, 3:7],
            base_lin_vel_w=self._qvel[:, :3],
            base_ang_vel=self._qvel[:, 3:6],
            dof_pos=self._qpos[:, 7:],
            dof_vel=self._qvel[:, 6:],
        )

    def _record_step(self) -> Callable[[], Any]:
        """The step as a Warp graph on the CPU: the same arithmetic without the cost of launching from Python. Runs it
        once, to compile; recording does not execute.
        """
        with wp.ScopedDevice(self._wp_device):
            self._step()
            with wp.ScopedCapture(self._wp_device) as capture:
                self._step()
        return lambda: wp.capture_launch(capture.graph)

    def _on_device(self) -> AbstractContextManager[Any]:
        """Warp launches on our device, and on the stream torch uses now, so that both stay in order, also while
        capturing.
        """
        stack = ExitStack()
        stack.enter_context(wp.ScopedDevice(self._wp_device))
        if not self._wp_device.is_cpu:
            stream = torch.cuda.current_stream(self.device)
            # A second Warp object for the same stream would not know of the capture on it.
            if self._wp_device.stream.cuda_stream != stream.cuda_stream:
                stack.enter_context(wp.ScopedStream(wp.stream_from_torch(stream), sync_enter=False))
        return stack

    def step(self) -> None:
        with self._on_device():
            self._advance()
        self._forces_read = False

    def refresh(self) -> None:
        with self._on_device():
            self._exchange.kinematics()
            if not self._forces_read:  # once a step: a reset in between has cleared its worlds' forces
                self._exchange.contact_forces()
                self._forces_read = True

    def write_state(
        self,
        mask: Tensor,
        base_pos: Tensor,
        base_quat: Tensor,
        base_lin_vel: Tensor,
        base_ang_vel: Tensor,
        dof_pos: Tensor,
        dof_vel: Tensor,
    ) -> None:
        with self._on_device():
            self._exchange.write(mask, base_pos, base_quat, base_lin_vel, base_ang_vel, dof_pos, dof_vel)

    def state_tensors(self) -> dict[str, Tensor]:
        return {"qpos": self._qpos, "qvel": self._qvel, "contact_forces": self.state.contact_forces}

    def copy_to(self, env_id: int, data: mujoco.MjData) -> None:
        data.qpos[:] = self._qpos[env_id].cpu().numpy().astype(np.float64)
        data.qvel[:] = self._qvel[env_id].cpu().numpy().astype(np.float64)
        mujoco.mj_forward(self.model, data)
