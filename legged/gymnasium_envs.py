"""Tasks as environments of Gymnasium: `gymnasium.make("legged/<task>")` and `gymnasium.make_vec` (docs/gymnasium.md)."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from typing import Any, ClassVar, Literal

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from torch import Tensor

from legged.commandline.arguments import pick_device
from legged.config.checks import shown
from legged.config.networks import groups_of
from legged.envs.final_observation import keep_final_step
from legged.errors import ConfigError, suggest
from legged.learning.run_state import kept_generators
from legged.registry import make_task, task_config
from legged.rendering.camera import ModelCamera, RobotsCamera, camera_of

SEEN = ("actor", "dict")
"""Forms of the observations: one array that joins the policy's observation groups, or a dictionary of all groups."""
RENDER_MODES = ["rgb_array"]
REWARD = "reward_"
"""Prefix of the reward terms in infos."""
LARGEST_SEED = 2**63
LARGEST_PICTURE = 16384
"""Largest side of a picture [pixels]. It is a limit of graphics cards."""


class TaskVectorEnv(VectorEnv):  # type: ignore[misc]
    """The N environments of a task. At the end of an episode an environment is reset within the same step: `step` returns the
    first observation of the next episode, and `infos["final_obs"]` has the last observation of the old episode. The
    environments share a random state of their own. `reset` and `step` load it into torch's global generators, and restore the
    state of these generators at the end.
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
        to_numpy: bool = True,
        render_mode: str | None = None,
        device: str = "cpu",
        physics: str = "auto",
        config: Mapping[str, Any] | None = None,
        observations: Literal["actor", "dict"] = "actor",
        width: int = 480,
        height: int = 270,
    ) -> None:
        """Build the task `task`; the arguments are explained in docs/gymnasium.md.

        Raises:
            ConfigError: the task, the device or a setting does not exist, or a value is not allowed.
        """
        for name, value, allowed in (("render_mode", render_mode, RENDER_MODES), ("observations", observations, SEEN)):
            if value not in allowed and (name, value) != ("render_mode", None):
                raise ConfigError(f"{name}: got {shown(value)}{suggest(str(value)[:100], allowed)}")
        for name, side in (("width", width), ("height", height)):
            if isinstance(side, bool) or not isinstance(side, (int, np.integer)) or not 1 <= side <= LARGEST_PICTURE:
                raise ConfigError(f"{name}: must be a whole number of pixels from 1 to {LARGEST_PICTURE}, got {shown(side)}")
        if config is not None and not (isinstance(config, Mapping) and all(isinstance(path, str) for path in config)):
            raise ConfigError(f"config: expected settings by dotted path, such as {{'sim.dt': 0.004}}; got {shown(config)}")
        if "env.num_envs" in (config or {}):
            raise ConfigError("config: env.num_envs: set the number of environments by make_vec(..., num_envs=...) instead")
        self.num_envs, self._to_numpy = num_envs, to_numpy
        self.render_mode, self._size = render_mode, (int(width), int(height))
        self._device = pick_device(str(device), "device")
        settings = [("train.algorithm.num_mini_batches", 1), *(config or {}).items(), ("env.num_envs", num_envs)]
        if physics != "auto":
            settings.append(("sim.physics", physics))
        cfg = task_config(task, settings, on_cpu=self._device.type == "cpu")
        self._random: list[Tensor] | None = None
        with kept_generators(torch.device("cpu")), self._own_random_numbers():
            self.task: Any = make_task(cfg, self._device, graph=False)
            """The task, a `legged.envs.BaseTask`. An environment whose episode has ended is already in its next episode."""
            # On a GPU, keep_final_step captures the step and the copies of the final state as one CUDA graph.
            self.final = keep_final_step(self.task, graph=self._device.type == "cuda")
            # Some terms create buffers at their first call. `_beginning` must hold these buffers, so make and undo a step.
            before = self.task.state_dict()
            self.task.step(torch.zeros_like(self.task.actions))
            self._beginning = {part: {**state, **before[part]} for part, state in self.task.state_dict().items()}
            self.task.load_state_dict(self._beginning)
        self._seeded = False
        self._groups = None if observations == "dict" else groups_of(cfg, "actor")
        self._camera: ModelCamera | RobotsCamera | None = None
        # With one picture per step, videos run in real time.
        self.metadata = {**type(self).metadata, "render_fps": max(1, round(1.0 / self.task.dt))}  # type: ignore[misc]

        def box(bound: float, width: int) -> spaces.Box:
            return spaces.Box(-bound, bound, (width,), np.float32)

        clip = cfg.observations.clip
        widths = {name: group.buffer.shape[1] for name, group in self.task.observation_groups.items()}
        boxes: dict[str, spaces.Space[Any]] = {name: box(clip, width) for name, width in widths.items()}
        chosen = self._groups
        self.single_observation_space = spaces.Dict(boxes) if chosen is None else box(clip, sum(widths[n] for n in chosen))
        self.single_action_space = box(cfg.control.clip_actions, self.task.num_actions)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    @contextmanager
    def _own_random_numbers(self) -> Iterator[None]:
        """Let torch use the random state of these environments within a `with` block. Then restore torch's global state."""
        on_gpu = [self._device] if self._device.type == "cuda" else []
        with torch.random.fork_rng(on_gpu):
            if self._random is not None:
                torch.set_rng_state(self._random[0])
                for device, state in zip(on_gpu, self._random[1:], strict=True):
                    torch.cuda.set_rng_state(state, device)
            try:
                yield
            finally:
                self._random = [torch.get_rng_state(), *(torch.cuda.get_rng_state(device) for device in on_gpu)]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode in every environment; return the observations (N, width) and empty infos. A seed restores the
        initial state, curricula included, and seeds the random numbers. Without a seed the random numbers go on.

        Raises:
            ConfigError: `options` are given.
        """
        super().reset(seed=seed)
        if options:
            raise ConfigError(f"reset: options: the task has no options, got {shown(options)}")
        with self._own_random_numbers():
            if seed is not None or not self._seeded:
                drawn = int(self.np_random.integers(LARGEST_SEED)) if seed is None else seed % LARGEST_SEED
                torch.random.default_generator.manual_seed(drawn)
                if self._device.type == "cuda":
                    with torch.cuda.device(self._device):
                        torch.cuda.manual_seed(drawn)
            if seed is not None:
                self.task.load_state_dict(self._beginning)
            self._seeded = True
            return self._seen(self.task.reset()), {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Make a step with `actions` (N, D). Return the observations (N, width), the rewards (N,), a mask (N,) of
        episodes that ended in a failure, a mask (N,) of episodes whose time ran out, and infos.

        Infos hold each reward term as `reward_<name>` (N,). Where an episode ended, `final_info` holds the terms instead, and
        `final_obs` the last observation. With NumPy, `final_obs` is an array of N objects, which are None where the episode
        goes on. Both keys are absent if no episode ended. With tensors, `final_obs` is (N, width), and its rows are valid
        where the mask `_final_obs` is True.

        Raises:
            ValueError: the shape of the actions is not (N, D), or they are not real numbers.
        """
        with self._own_random_numbers():
            observations, rewards, _, _ = self.task.step(actions)
        seen, rewards = self._seen(observations), self._given(rewards)
        terminated, truncated = (self._given(mask.clone()) for mask in (self.task.terminated_buf, self.task.time_out_buf))
        ended = terminated | truncated
        terms = self._given(self.task.rewards.last.clone())  # one copy to the host for all terms
        parts = {f"{REWARD}{name}": part for name, part in zip(self.task.rewards.names, terms, strict=True)}
        infos = masked(parts, ~ended)
        if not self._to_numpy or ended.any():
            last = self._seen({name: group.clone() for name, group in self.final.observations.items()})
            final_obs = rows_of(last, ended) if self._to_numpy else last
            infos |= masked({"final_obs": final_obs, "final_info": masked(parts, ended)}, ended)
        return seen, rewards, terminated, truncated, infos

    def _seen(self, groups: Mapping[str, Tensor]) -> Any:
        """Return the policy's observation groups in one array, or a dictionary of all `groups`."""
        if self._groups is None:
            return {name: self._given(group) for name, group in groups.items()}
        chosen = [groups[name] for name in self._groups]
        return self._given(chosen[0] if len(chosen) == 1 else torch.cat(chosen, dim=1))

    def _given(self, value: Tensor) -> Any:
        """Return `value` itself or, with `to_numpy`, as an array. The array of a CPU tensor shares the tensor's memory."""
        return value.cpu().numpy() if self._to_numpy else value

    def render(self) -> tuple[np.ndarray, ...] | None:  # type: ignore[override]
        """Return a picture (height, width, 3) uint8 of each environment, or None without a `render_mode`.

        Raises:
            RunError: this machine cannot render.
        """
        if self.render_mode is None:
            gymnasium.logger.warn('render() returns None without a render mode; try make(..., render_mode="rgb_array")')
            return None
        if self._camera is None:
            self._camera = camera_of(self.task, 1, *self._size)
        found = []
        for env in range(self.task.num_envs):
            self._camera.turn_to(env)
            found.append(self._camera.picture())
        return tuple(found)

    def close_extras(self, **kwargs: Any) -> None:
        """Free the camera."""
        if self._camera is not None:
            self._camera.close()
            self._camera = None


class TaskEnv(gymnasium.Env):  # type: ignore[misc]
    """One environment of a task. The last step of an episode returns its last observation. `reset` starts a new episode."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": RENDER_MODES}  # type: ignore[misc]

    def __init__(self, task: str, **arguments: Any) -> None:
        """Build the task `task`; the arguments are explained in docs/gymnasium.md. Raises the errors of `TaskVectorEnv`."""
        self._vector = vector = TaskVectorEnv(task, 1, to_numpy=True, **arguments)
        self.task, self.render_mode = vector.task, vector.render_mode
        self.metadata = {**type(self).metadata, "render_fps": vector.metadata["render_fps"]}  # type: ignore[misc]
        self.action_space, self.observation_space = vector.single_action_space, vector.single_observation_space
        self._over = True
        self._shows_the_next = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode; return the observation and empty infos.

        Raises:
            ConfigError: `options` are given.
        """
        super().reset(seed=seed)
        self._vector.np_random = self.np_random  # without a seed, the first reset draws one from this generator
        seen, infos = self._vector.reset(seed=seed, options=options)
        self._over = self._shows_the_next = False
        return row(seen, 0), infos

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Make a step with `action` (D,). Return the observation, the reward, True if the episode ended in a failure, True if
        its time ran out, and infos with each reward term as `reward_<name>`.

        Raises:
            ResetNeeded: no episode is running.
            ValueError: the shape of the action is not (D,), or it does not consist of real numbers.
        """
        if self._over:
            raise gymnasium.error.ResetNeeded("the episode is over, or none has begun: call reset() before step()")
        actions = action[None] if isinstance(action, Tensor) else np.asarray(action)[None]
        seen, (reward,), (terminated,), (truncated,), infos = self._vector.step(actions)
        self._over = self._shows_the_next = bool(terminated or truncated)
        observation = infos["final_obs"][0] if self._over else row(seen, 0)
        terms = {name: float(part[0]) for name, part in infos.items() if name.startswith(REWARD)}
        return observation, float(reward), bool(terminated), bool(truncated), terms

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """Return a picture (height, width, 3) uint8, or None without a `render_mode`.

        Raises:
            RunError: this machine cannot render.
        """
        if self._shows_the_next and self.render_mode is not None:
            # The task holds the next episode's first state. Overwrite it with the old episode's final state for the picture.
            self.task.physics.write(torch.ones_like(self.task.reset_buf), self._vector.final.qpos, self._vector.final.qvel)
            self.task.sense()
            self._shows_the_next = False
        pictures = self._vector.render()
        return None if pictures is None else pictures[0]

    def close(self) -> None:
        """Free the camera."""
        self._vector.close_extras()


def row(value: Any, index: int) -> Any:
    """Return row `index` of an array. For a dictionary of arrays, return a dictionary of these rows."""
    return {name: part[index] for name, part in value.items()} if isinstance(value, dict) else value[index]


def rows_of(value: Any, mask: np.ndarray) -> np.ndarray:
    """Return an array (N,) of objects, as in Gymnasium: copies of the rows where `mask` (N,) is True, elsewhere None."""
    found = np.full(len(mask), None, dtype=object)
    for index in mask.nonzero()[0].tolist():
        found[index] = deepcopy(row(value, index))
    return found


def masked(values: Mapping[str, Any], mask: Any) -> dict[str, Any]:
    """Return infos in Gymnasium's form: each value (N, ...) with a mask (N,) of the environments for which it is valid."""
    return {key: value for name, part in values.items() for key, value in ((name, part), (f"_{name}", mask))}
