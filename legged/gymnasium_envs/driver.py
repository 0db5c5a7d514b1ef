"""Shared parts of both kinds of environment: the task, its random numbers, its spaces and its camera."""

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor

from legged.commandline.arguments import pick_device
from legged.config.checks import shown
from legged.config.networks import groups_of
from legged.envs.final_observation import keep_final_step
from legged.errors import ConfigError, suggest
from legged.gymnasium_envs.random_stream import RandomStream
from legged.registry import make_task, task_config
from legged.rendering import ModelCamera, RobotsCamera, camera_of

Seen = Literal["actor", "dict"]
"""Form of the observations: the policy's groups side by side, or a dictionary of all groups."""
SEEN = ("actor", "dict")
RENDER_MODES = ["rgb_array"]
REWARD = "reward_"
"""Prefix of the reward terms in infos."""
LARGEST_SEED = 2**63
LARGEST_PICTURE = 16384
"""Largest side of a picture, a limit of graphics cards [pixels]."""


class Driver:
    """A task that keeps the last step of every episode and has its own random numbers."""

    def __init__(
        self, task: str, num_envs: int, device: str, physics: str, config: Mapping[str, Any] | None, observations: Seen
    ) -> None:
        """Build the task.

        Raises:
            ConfigError: the task, the device or a setting does not exist, or a value is not allowed.
        """
        if observations not in SEEN:
            raise ConfigError(f"observations: got {shown(observations)}{suggest(str(observations)[:100], SEEN)}")
        self.device = pick_device(str(device), "device")
        settings = [("train.algorithm.num_mini_batches", 1), *self._checked(config), ("env.num_envs", num_envs)]
        if physics != "auto":
            settings.append(("sim.physics", physics))
        cfg = task_config(task, settings, on_cpu=self.device.type == "cpu")
        self.random = RandomStream(self.device)
        with self.random.used():
            self.task = make_task(cfg, self.device, graph=False)
            # On a GPU the captured step includes the copies of final states; on the CPU the step needs no check for a
            # capture.
            self.final = keep_final_step(self.task, graph=self.device.type == "cuda")
            self._beginning = self._tried()
        self._seeded = False
        self.groups = None if observations == "dict" else groups_of(cfg, "actor")
        """Observation groups side by side; None for a dictionary of all groups."""
        self._camera: ModelCamera | RobotsCamera | None = None

    @staticmethod
    def _checked(config: Mapping[str, Any] | None) -> list[tuple[str, Any]]:
        """Return the settings by dotted path as pairs."""
        if config is None:
            return []
        if not isinstance(config, Mapping) or not all(isinstance(path, str) for path in config):
            raise ConfigError(f"config: expected settings by dotted path, {{'sim.dt': 0.004}}; got {shown(config)}")
        if "env.num_envs" in config:
            raise ConfigError("config: env.num_envs: the number of environments is that of make_vec(..., num_envs=...)")
        return list(config.items())

    def _tried(self) -> dict[str, Any]:
        """Return the initial state with the buffers that terms create at their first call; makes a step and undoes it."""
        before = self.task.state_dict()
        self.task.step(torch.zeros_like(self.task.actions))
        beginning = {part: {**state, **before[part]} for part, state in self.task.state_dict().items()}
        self.task.load_state_dict(beginning)
        return beginning

    # ---- spaces ------------------------------------------------------------------------------------------------------

    def action_space(self) -> spaces.Box:
        """Return the actions of one environment: within plus and minus `control.clip_actions`."""
        return self._box(self.task.cfg.control.clip_actions, self.task.num_actions)

    def observation_space(self) -> spaces.Space[Any]:
        """Return the observations of one environment: within plus and minus `observations.clip`."""
        clip = self.task.cfg.observations.clip
        widths = {name: group.buffer.shape[1] for name, group in self.task.observation_groups.items()}
        if self.groups is None:
            return spaces.Dict({name: self._box(clip, width) for name, width in widths.items()})
        return self._box(clip, sum(widths[name] for name in self.groups))

    @staticmethod
    def _box(bound: float, width: int) -> spaces.Box:
        return spaces.Box(-bound, bound, (width,), np.float32)

    # ---- steps -------------------------------------------------------------------------------------------------------

    def reset(self, seed: int | None, options: dict[str, Any] | None, chosen: np.random.Generator) -> Any:
        """Start an episode in every environment and return the observations. A seed restores the initial state, curricula
        included, and seeds the random numbers. Without one they continue; `chosen` draws the first seed.

        Raises:
            ConfigError: `options` are given.
        """
        if options:
            raise ConfigError(f"reset: options: there are none; got {shown(options)}")
        if seed is not None:
            self.random.seed(seed % LARGEST_SEED)
            self.task.load_state_dict(self._beginning)
        elif not self._seeded:
            self.random.seed(int(chosen.integers(LARGEST_SEED)))
        self._seeded = True
        with self.random.used():
            return self._seen(dict(self.task.reset().items()))

    def step(self, actions: Any) -> tuple[Any, Tensor]:
        """Make a step with `actions` (N, D); return the observations and the rewards (N,) in new tensors.

        Raises:
            ValueError: the actions have another shape, or are not real numbers.
        """
        with self.random.used():
            observations, rewards, _, _ = self.task.step(actions)
        return self._seen(dict(observations.items())), rewards

    def final_observations(self) -> Any:
        """Return the observations of the last step before environments were reset, in new tensors."""
        return self._seen({name: seen.clone() for name, seen in self.final.observations.items()})

    def reward_parts(self, to_numpy: bool) -> dict[str, Any]:
        """Return the terms of the last rewards, (N,) each, in new tensors or arrays."""
        rewards = self.task.rewards
        parts = rewards.last.clone()
        rows = parts.cpu().numpy() if to_numpy else parts  # all in one copy
        return {f"{REWARD}{name}": part for name, part in zip(rewards.names, rows, strict=True)}

    def _seen(self, groups: dict[str, Tensor]) -> Any:
        """Return the observations in the requested form."""
        if self.groups is None:
            return groups
        chosen = [groups[name] for name in self.groups]
        return chosen[0] if len(chosen) == 1 else torch.cat(chosen, dim=1)

    # ---- pictures ----------------------------------------------------------------------------------------------------

    @property
    def fps(self) -> int:
        """Return the picture rate of real time: one picture per step [1/s]."""
        return max(1, round(1.0 / self.task.dt))

    def picture(self, env: int, width: int, height: int) -> np.ndarray:
        """Return a picture (height, width, 3) uint8 of the present state of one environment.

        Raises:
            RunError: this machine cannot render.
        """
        if self._camera is None:
            self._camera = camera_of(self.task, 1, width, height)
        self._camera.turn_to(env)
        return self._camera.picture()

    def close(self) -> None:
        """Free the camera."""
        if self._camera is not None:
            self._camera.close()
            self._camera = None


def checked_render_mode(mode: str | None) -> str | None:
    """Return the render mode.

    Raises:
        ConfigError: there is no such mode.
    """
    if mode is not None and mode not in RENDER_MODES:
        raise ConfigError(f"render_mode: got {shown(mode)}{suggest(str(mode)[:100], RENDER_MODES)}")
    return mode


def checked_size(width: int, height: int) -> tuple[int, int]:
    """Return the size of a picture [pixels].

    Raises:
        ConfigError: one of them is no whole number that can be drawn.
    """
    for name, side in (("width", width), ("height", height)):
        if isinstance(side, bool) or not isinstance(side, (int, np.integer)) or not 1 <= side <= LARGEST_PICTURE:
            raise ConfigError(f"{name}: must be a whole number of pixels from 1 to {LARGEST_PICTURE}, got {shown(side)}")
    return int(width), int(height)


def as_numpy(value: Any) -> Any:
    """Return a tensor, or the tensors of a dictionary, as arrays. The array of a tensor on the CPU shares the tensor's
    memory.
    """
    if isinstance(value, dict):
        return {name: as_numpy(part) for name, part in value.items()}
    return value.cpu().numpy() if isinstance(value, Tensor) else value


def row(value: Any, index: int) -> Any:
    """Return one row of an array, or of the arrays of a dictionary."""
    return {name: part[index] for name, part in value.items()} if isinstance(value, dict) else value[index]


def rows_of(value: Any, mask: np.ndarray) -> np.ndarray:
    """Return an array (N,) of objects, as Gymnasium stores final observations: copies of the rows in `mask` (N,) or None."""
    found = np.full(len(mask), None, dtype=object)
    for index in mask.nonzero()[0].tolist():
        one = row(value, index)
        found[index] = {name: part.copy() for name, part in one.items()} if isinstance(one, dict) else one.copy()
    return found
