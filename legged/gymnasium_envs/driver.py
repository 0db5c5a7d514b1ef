"""What both kinds of environment share: a task, its random numbers, its spaces and its camera."""

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
"""What is observed: what the policy is given, side by side, or every group by its name."""
SEEN = ("actor", "dict")
RENDER_MODES = ["rgb_array"]
REWARD = "reward_"
"""How the parts of the reward are called in infos."""
LARGEST_SEED = 2**63
LARGEST_PICTURE = 16384
"""Most pixels along a side of a picture: what graphics cards draw into at most."""


class Driver:
    """A task that keeps the last step of every episode, and draws from random numbers of its own."""

    def __init__(
        self, task: str, num_envs: int, device: str, physics: str, config: Mapping[str, Any] | None, observations: Seen
    ) -> None:
        """Build it.

        Raises:
            ConfigError: there is no such task, device or setting, or one has a value that it can't have.
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
            # On a GPU the step is captured once, with what is kept; on the CPU there is no graph to check it for.
            self.final = keep_final_step(self.task, graph=self.device.type == "cuda")
            self._beginning = self._tried()
        self._seeded = False
        self.groups = None if observations == "dict" else groups_of(cfg, "actor")
        """The groups that are seen side by side; None for all, by name."""
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
        """Make a step that leaves no trace, and return the state before it: a term may make a buffer at its first call."""
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
        """Begin an episode in every environment; returns what is seen. With a seed everything is as it was when the task was
        built, curricula included, but for the random numbers; without one they go on, and begin with one that `chosen` gives.

        Raises:
            ConfigError: there are options.
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
        """Make a step under `actions` (N, D); returns what is seen and the rewards (N,), in tensors of their own.

        Raises:
            ValueError: the actions have another shape, or are no real numbers.
        """
        with self.random.used():
            observations, rewards, _, _ = self.task.step(actions)
        return self._seen(dict(observations.items())), rewards

    def final_observations(self) -> Any:
        """Return what was seen at the end of the last step before any environment was reset, in tensors of their own."""
        return self._seen({name: seen.clone() for name, seen in self.final.observations.items()})

    def reward_parts(self, to_numpy: bool) -> dict[str, Any]:
        """Return the parts of the last rewards, (N,) each, in tensors or arrays of their own."""
        rewards = self.task.rewards
        parts = rewards.last.clone()
        rows = parts.cpu().numpy() if to_numpy else parts  # all in one copy
        return {f"{REWARD}{name}": part for name, part in zip(rewards.names, rows, strict=True)}

    def _seen(self, groups: dict[str, Tensor]) -> Any:
        """Choose among the observation groups."""
        if self.groups is None:
            return groups
        chosen = [groups[name] for name in self.groups]
        return chosen[0] if len(chosen) == 1 else torch.cat(chosen, dim=1)

    # ---- pictures ----------------------------------------------------------------------------------------------------

    @property
    def fps(self) -> int:
        """Pictures a second that show real time: one for each step."""
        return max(1, round(1.0 / self.task.dt))

    def picture(self, env: int, width: int, height: int) -> np.ndarray:
        """Return (height, width, 3) uint8: one environment as it is now.

        Raises:
            RunError: nothing can be rendered here.
        """
        if self._camera is None:
            self._camera = camera_of(self.task, 1, width, height)
        if isinstance(self._camera, RobotsCamera):
            self._camera.turn_to(env)
        else:
            self._camera.followed = env
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
