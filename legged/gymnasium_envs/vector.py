"""A task as many environments of Gymnasium's that are stepped as one."""

from collections.abc import Mapping
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from legged.gymnasium_envs.arrays import as_numpy, rows_of
from legged.gymnasium_envs.driver import RENDER_MODES, Driver, Seen, checked_render_mode, checked_size


class TaskVectorEnv(VectorEnv):
    """The N environments of a task. Those whose episode ends are reset within the same step: what is returned is the first
    observation of the next episode, the last one of the old is in `infos["final_obs"]`.
    """

    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]
        "render_modes": RENDER_MODES,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def __init__(
        self,
        task: str,
        num_envs: int,
        *,
        render_mode: str | None = None,
        device: str = "cpu",
        physics: str = "auto",
        config: Mapping[str, Any] | None = None,
        observations: Seen = "actor",
        to_numpy: bool = True,
        width: int = 480,
        height: int = 270,
    ) -> None:
        """Build the task `task`; the arguments are explained in docs/gymnasium.md.

        Raises:
            ConfigError: there is no such task, device or setting, or one has a value that it can't have.
        """
        self.num_envs, self.render_mode = num_envs, checked_render_mode(render_mode)
        self._size, self._to_numpy = checked_size(width, height), to_numpy
        self._driver = Driver(task, num_envs, device, physics, config, observations)
        self.metadata = {**type(self).metadata, "render_fps": self._driver.fps}  # type: ignore[misc]
        self.single_action_space = self._driver.action_space()
        self.single_observation_space = self._driver.observation_space()
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)

    @property
    def task(self) -> Any:
        """The task itself, a `legged.envs.BaseTask`."""
        return self._driver.task

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in every environment; returns what is seen, (N, width), and no infos.

        Raises:
            ConfigError: there are options.
        """
        super().reset(seed=seed)
        seen = self._driver.reset(seed, options, self.np_random)  # type: ignore[arg-type]
        return (as_numpy(seen) if self._to_numpy else seen), {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Make a step under `actions` (N, D). Returns what is seen (N, width), the rewards (N,), which episodes have ended in
        a failure and which have been cut off by time, (N,) bool each, and infos.

        Infos have the parts of the reward, `reward_<name>` (N,); of environments whose episode has ended they are in
        `final_info`, and what was seen last is in `final_obs`: with NumPy an array of N objects, None where no episode has
        ended, and nothing at all if none has; with tensors (N, width), to be read where the mask `_final_obs` is true.

        Raises:
            ValueError: the actions have another shape, or are no real numbers.
        """
        seen, rewards = self._driver.step(actions)
        terminated, truncated = self.task.terminated_buf.clone(), self.task.time_out_buf.clone()
        parts = self._driver.reward_parts(self._to_numpy)
        if not self._to_numpy:
            ended = terminated | truncated
            infos = {**masked(parts, ~ended), **endings(self._driver.final_observations(), parts, ended)}
            return seen, rewards, terminated, truncated, infos
        seen, rewards, terminated, truncated = (as_numpy(value) for value in (seen, rewards, terminated, truncated))
        ended = terminated | truncated
        infos = masked(parts, ~ended)
        if ended.any():
            infos |= endings(rows_of(as_numpy(self._driver.final_observations()), ended), parts, ended)
        return seen, rewards, terminated, truncated, infos

    def render(self) -> tuple[np.ndarray, ...] | None:  # type: ignore[override]
        """Return a picture (height, width, 3) uint8 of each environment, or None without a `render_mode`.

        Raises:
            RunError: nothing can be rendered here.
        """
        if self.render_mode is None:
            gymnasium.logger.warn('render() shows nothing without a render mode: make_vec(..., render_mode="rgb_array")')
            return None
        return tuple(self._driver.picture(env, *self._size) for env in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:
        """Free what draws."""
        self._driver.close()


def masked(values: Mapping[str, Any], mask: Any) -> dict[str, Any]:
    """Return infos as Gymnasium has them: each value (N, ...) with a mask (N,) of those whom it is about."""
    return {key: value for name, part in values.items() for key, value in ((name, part), (f"_{name}", mask))}


def endings(final_obs: Any, parts: Mapping[str, Any], ended: Any) -> dict[str, Any]:
    """Return what infos say of the environments of `ended` (N,)."""
    return masked({"final_obs": final_obs, "final_info": masked(parts, ended)}, ended)
