"""A task as a vector of Gymnasium environments."""

from collections.abc import Mapping
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from legged.gymnasium_envs.driver import RENDER_MODES, Driver, Seen, as_numpy, checked_render_mode, checked_size, rows_of


class TaskVectorEnv(VectorEnv):
    """The N environments of a task. At the end of an episode an environment is reset within the same step: `step` returns the
    first observation of the next episode, and `infos["final_obs"]` has the last one of the old.
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
            ConfigError: the task, the device or a setting does not exist, or a value is not allowed.
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
        """Return the task, a `legged.envs.BaseTask`."""
        return self._driver.task

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode in every environment; return the observations (N, width) and empty infos.

        Raises:
            ConfigError: `options` are given.
        """
        super().reset(seed=seed)
        seen = self._driver.reset(seed, options, self.np_random)  # type: ignore[arg-type]
        return (as_numpy(seen) if self._to_numpy else seen), {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Make a step with `actions` (N, D). Return the observations (N, width), the rewards (N,), masks (N,) of the episodes
        that ended in a failure and of those whose time ran out, and infos.

        Infos have the reward terms, `reward_<name>` (N,). For environments whose episode ended, these are in `final_info` and
        the last observations in `final_obs`. With NumPy `final_obs` is an array of N objects, None where no episode ended,
        and is absent if none ended; with tensors it is (N, width), valid where the mask `_final_obs` is true.

        Raises:
            ValueError: the actions have another shape, or are not real numbers.
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
            RunError: this machine cannot render.
        """
        if self.render_mode is None:
            gymnasium.logger.warn('render() shows nothing without a render mode: make_vec(..., render_mode="rgb_array")')
            return None
        return tuple(self._driver.picture(env, *self._size) for env in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:
        """Free the camera."""
        self._driver.close()


def masked(values: Mapping[str, Any], mask: Any) -> dict[str, Any]:
    """Return infos in Gymnasium's form: each value (N, ...) with a mask (N,) of the environments for which it is valid."""
    return {key: value for name, part in values.items() for key, value in ((name, part), (f"_{name}", mask))}


def endings(final_obs: Any, parts: Mapping[str, Any], ended: Any) -> dict[str, Any]:
    """Return the infos of the environments in `ended` (N,)."""
    return masked({"final_obs": final_obs, "final_info": masked(parts, ended)}, ended)
