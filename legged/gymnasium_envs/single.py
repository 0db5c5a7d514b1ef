"""A task as a single Gymnasium environment."""

from collections.abc import Mapping
from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch

from legged.gymnasium_envs.driver import RENDER_MODES, Driver, Seen, as_numpy, checked_render_mode, checked_size, row


class TaskEnv(gymnasium.Env):
    """One environment of a task. At the end of an episode `step` returns its last observation; `reset` starts the next."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": RENDER_MODES}  # type: ignore[misc]

    def __init__(
        self,
        task: str,
        *,
        render_mode: str | None = None,
        device: str = "cpu",
        physics: str = "auto",
        config: Mapping[str, Any] | None = None,
        observations: Seen = "actor",
        width: int = 480,
        height: int = 270,
    ) -> None:
        """Build the task `task`; the arguments are explained in docs/gymnasium.md.

        Raises:
            ConfigError: the task, the device or a setting does not exist, or a value is not allowed.
        """
        self.render_mode = checked_render_mode(render_mode)
        self._size = checked_size(width, height)
        self._driver = Driver(task, 1, device, physics, config, observations)
        self.metadata = {**type(self).metadata, "render_fps": self._driver.fps}  # type: ignore[misc]
        self.action_space = self._driver.action_space()
        self.observation_space = self._driver.observation_space()
        self._over = True
        self._shows_the_next = False

    @property
    def task(self) -> Any:
        """Return the task, a `legged.envs.BaseTask`. After the end of an episode it is already in the next one."""
        return self._driver.task

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode; return the observation and empty infos.

        Raises:
            ConfigError: `options` are given.
        """
        super().reset(seed=seed)
        seen = self._driver.reset(seed, options, self.np_random)
        self._over = self._shows_the_next = False
        return row(as_numpy(seen), 0), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Make a step with `action` (D,). Return the observation, the reward, whether the episode ended in a failure, whether
        its time ran out, and infos with the reward terms, `reward_<name>`.

        Raises:
            ResetNeeded: no episode is running.
            ValueError: the action has another shape, or is not of real numbers.
        """
        if self._over:
            raise gymnasium.error.ResetNeeded("the episode is over, or none has begun: call reset() before step()")
        actions = action[None] if isinstance(action, torch.Tensor) else np.asarray(action)[None]
        seen, rewards = self._driver.step(actions)
        terminated, truncated = bool(self.task.terminated_buf[0]), bool(self.task.time_out_buf[0])
        self._over = self._shows_the_next = terminated or truncated
        if self._over:
            seen = self._driver.final_observations()
        infos = {name: float(part[0]) for name, part in self._driver.reward_parts(to_numpy=True).items()}
        return row(as_numpy(seen), 0), float(rewards[0]), terminated, truncated, infos

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """Return a picture (height, width, 3) uint8, or None without a `render_mode`.

        Raises:
            RunError: this machine cannot render.
        """
        if self.render_mode is None:
            gymnasium.logger.warn('render() shows nothing without a render mode: make(..., render_mode="rgb_array")')
            return None
        if self._shows_the_next:
            self._show_the_end()
        return self._driver.picture(0, *self._size)

    def _show_the_end(self) -> None:
        """Restore the end of the episode for pictures; only a reset can follow."""
        final, task = self._driver.final, self.task
        task.physics.write(torch.ones_like(task.reset_buf), final.qpos, final.qvel)
        task.sense()
        self._shows_the_next = False

    def close(self) -> None:
        """Free the camera."""
        self._driver.close()
