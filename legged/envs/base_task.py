"""Base class of all tasks. It steps N environments on batched physics, and implements `VecEnv`, rsl-rl's interface.

The terms of a task (observations, rewards, terminations and metrics) are methods. The configuration names the methods
`_obs_<name>`, `_reward_<name>` and `_terminate_<name>` that run. All methods `_metric_<name>` run. A tensor with N rows has
one row for each environment. Tensors keep their addresses, so that one CUDA graph can hold the whole step.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor

from legged.config.networks import groups_in
from legged.config.task import TaskConfig
from legged.envs.actions import as_actions, ordinary_tensors
from legged.envs.checks import check_task
from legged.envs.concurrent_terms import ConcurrentTerms
from legged.envs.marks import concurrent, is_concurrent
from legged.envs.privileged_terms import PrivilegedTerms
from legged.errors import ConfigError
from legged.graph.step_graph import Branch, StepGraph
from legged.math import masked_set_
from legged.mdp.height_map_errors import HeightMapErrors
from legged.mdp.kernels import name_module, task_kernels
from legged.mdp.metrics import Metrics
from legged.mdp.mirror_images import MirrorImages
from legged.mdp.nan_guard import LARGEST_STATE, NanGuard
from legged.mdp.observation_errors import HEIGHTS, ObservationErrors
from legged.mdp.observations import ObservationGroup, ObservationTerms
from legged.mdp.random_pool import RandomPool, seed_host
from legged.mdp.randomization import Randomization
from legged.mdp.rewards import Rewards
from legged.mdp.sensors import Sensor
from legged.mdp.terminations import Terminations
from legged.physics import FIELDS, Scene, check_ranges, make_physics, row_counts
from legged.process.ranks import Ranks
from legged.process.startup import stage_ended
from legged.state import load_state, state_of, take, tensors_of, without_memory_of

REWARD_STREAMS = 5
"""Number of streams that concurrent rewards are distributed over. On an H100, the rewards of an ANYmal take 49 us on 5
streams, and 90 us on one stream. `check_termination`, which runs at the same time, takes 34 us."""
SETTLED = ("valid", "terminated_buf", "time_out_buf", "reset_buf", "rew_buf")
"""Tensors that `check_termination` and `compute_reward` write."""


class BaseTask(PrivilegedTerms, VecEnv):
    """N environments on one device. A subclass defines the world (`make_scene`), the initial states of episodes
    (`draw_reset`) and the terms. All other public methods that a step calls (see `_step`) are hooks with a default.
    """

    Config: ClassVar[type[TaskConfig]] = TaskConfig
    """Schema of the task's configuration."""
    QUANTITIES: ClassVar[tuple[str, ...]] = ()
    """Names of arrays in MuJoCo's data that terms read by `self.physics.quantity(name)`. qpos and qvel need no entry."""
    OWN_HELPERS: ClassVar[tuple[str, ...]] = ()
    """Names of a subclass's methods that are also names of hooks in another framework, such as legged_gym. BaseTask never
    calls such a method. If a subclass calls it itself, its name must be listed here; otherwise `check` raises an error."""

    def __init__(self, cfg: TaskConfig, device: torch.device | str = "cpu", graph: bool = True) -> None:
        """Build physics and terms on `device`. With `graph`, the step is captured in a CUDA graph if `device` is a GPU.

        Raises:
            ConfigError: the configuration or the task class is invalid.
            TermError: a term fails or cannot be captured.
        """
        self.check(cfg)
        device = torch.device(device)
        if device.type == "cuda" and device.index is None:
            device = torch.device("cuda", torch.cuda.current_device())
        n = cfg.env.num_envs
        self.cfg: TaskConfig = cfg  # type: ignore[assignment]
        self.num_envs, self.device = n, device  # type: ignore[assignment]
        self.dt = cfg.dt
        """Control step [s]."""
        self.max_episode_length = round(cfg.env.episode_length_s / cfg.dt)
        """Steps of a full episode."""
        seed = cfg.env.seed + Ranks.now().rank  # random numbers differ between GPUs
        torch.manual_seed(seed)
        seed_host(seed)
        self.randomization = self.make_randomization()
        self._build_physics(self.make_scene())
        self.num_actions = self.physics.ctrl.shape[1]
        self._allocate()
        self._init_buffers()
        if not self._has_buffers:
            raise ConfigError(f"{type(self).__name__}._init_buffers must call super()._init_buffers()")
        self.randomization.prepare(self.physics, self.numbers, self.dt, cfg.train.runner.num_steps_per_env, self.kernels)
        self._collect_terms()
        self.numbers.allocate()
        # On a GPU, the step runs eagerly if the engine can't be captured. On the CPU, `_build_graph` only checks the step.
        self._build_graph(graph and (self.physics.capturable or device.type == "cpu"))

    @classmethod
    def check(cls, cfg: TaskConfig) -> None:
        """Check a configuration completely, before anything is built.

        Raises:
            ConfigError: the configuration is invalid for this task.
        """
        check_task(cls, cfg)

    @classmethod
    def terms(cls, prefix: str) -> set[str]:
        """Return the names of the methods that begin with `prefix`, with the prefix removed."""
        return {name.removeprefix(prefix) for name in dir(cls) if name.startswith(prefix)}

    @abstractmethod
    def make_scene(self) -> Scene:
        """Return the scene of one world; all N worlds have the same scene."""

    def make_randomization(self) -> Randomization:
        """Return the randomised properties, drawn for every environment."""
        return Randomization(self.cfg.domain_rand.ranges, self.num_envs, self.device)

    def make_sensors(self) -> dict[str, Sensor]:
        """Hook: return name -> sensor that `sense` updates. Terms read `self.sensors[name]`. The scene, `self.physics` and
        `self.kernels` exist by then. A subclass extends the result of super().make_sensors().
        """
        return {}

    def pushed_by_forces(self) -> bool:
        """Return True if external forces act on bodies (`physics.forces`)."""
        return False

    def _build_physics(self, scene: Scene) -> None:
        """Build the physics of a scene, and apply the randomised properties.

        Raises:
            ConfigError: the engine or the model lacks a randomised property, or `each` is set for a property of which a robot
                has only one value.
        """
        cfg, where = self.cfg, self.cfg.origins.where
        fields = [name for name in self.randomization.fields if FIELDS[name].changes]
        check_ranges(cfg.domain_rand.ranges, scene, cfg.sim, where)
        others = (self.QUANTITIES, where, self.pushed_by_forces(), (name_module,))
        self.physics = make_physics(scene, cfg.sim, self.num_envs, self.device, fields, *others)
        self.kernels = task_kernels(self.physics)
        """Warp kernels that replace torch operations in parts of the step; None if the engine does not use Warp."""
        stage_ended("physics built")
        self.field_rows = row_counts(scene, self.physics.model, self.randomization.draws)
        for name, draw in self.randomization.draws.items():
            if draw.each and self.field_rows[name] < 2:
                path = where(f"domain_rand.ranges.{name}.each")
                raise ConfigError(f"{path}: a robot has only one value of this property; remove the setting `each`")
        self.randomization.widen(self.field_rows)
        self.randomization.apply(self.physics)

    def _allocate(self) -> None:
        """Allocate the tensors that every task has. D is the number of actions."""
        n, device = self.num_envs, self.device
        self.actions = torch.zeros(n, self.num_actions, device=device)
        """(N, D) clipped actions of this step."""
        self.last_actions = torch.zeros_like(self.actions)
        """(N, D) clipped actions of the previous step."""
        self.rew_buf = torch.zeros(n, device=device)
        """(N,) reward of this step."""
        self.terminated_buf = torch.zeros(n, dtype=torch.bool, device=device)
        """(N,) True if the episode ended in a failure."""
        self.time_out_buf = torch.zeros_like(self.terminated_buf)
        """(N,) True if the episode ended by a time-out; the learner then bootstraps with the value function."""
        self.reset_buf = torch.zeros_like(self.terminated_buf)
        """(N,) True if the episode ended, by failure or time-out."""
        self.valid = torch.ones_like(self.terminated_buf)
        """(N,) True if all numbers of an environment are finite and in bounds. The numbers are state and actions of this
        step, and rewards and observations of the previous step. Where `valid` is False, the episode ends in a failure."""
        self.reset_qpos = torch.zeros_like(self.physics.qpos)
        """(N, nq) generalised positions at the beginning of each environment's next episode."""
        self.reset_qvel = torch.zeros_like(self.physics.qvel)
        """(N, nv) generalised velocities at the beginning of each environment's next episode."""
        self.qpos0 = torch.as_tensor(self.physics.model.qpos0, dtype=torch.float32, device=device)
        """(nq,) generalised positions of the model's reference pose."""
        model = self.physics.model
        low, high = torch.as_tensor(model.actuator_ctrlrange, dtype=torch.float32, device=device).unbind(dim=1)
        limited = torch.as_tensor(model.actuator_ctrllimited, device=device).bool()
        self.control_middle = torch.where(limited, 0.5 * (low + high), 0.0)
        """(D,) controls at action 0."""
        self.control_reach = torch.where(limited, 0.5 * (high - low), 1.0)
        """(D,) change of the controls by an action of 1."""
        self._episode_length = torch.zeros(n, dtype=torch.long, device=device)
        self._action_input = torch.zeros_like(self.actions)
        self._clipped_actions = torch.zeros_like(self.actions)
        self._in_bounds = torch.ones_like(self.valid)
        self._stream_1, self._stream_2 = Branch(device), Branch(device)  # type: ignore[arg-type]
        self.sensors = self.make_sensors()
        """Sensors by name."""
        self.numbers = RandomPool(n, device)  # type: ignore[arg-type]
        """Pool of the random numbers of a step. Subclasses reserve columns in `_init_buffers`."""
        self.step_watcher: Callable[[], None] | None = None
        """Function that copies tensors in each step, before episodes are reset; `final_observation.watch_steps` sets it."""
        self._steps_since_log = 0
        self._has_buffers = False

    def _init_buffers(self) -> None:
        """Hook: allocate the tensors and objects of a subclass. The hook is called after the physics is built and before any
        term runs. Overrides must call super()._init_buffers().
        """
        self._has_buffers = True

    def _collect_terms(self) -> None:
        """Collect the terms that the configuration names."""
        cfg = self.cfg
        self._collect_judgements()
        groups = groups_in(cfg)
        # The terms of the largest group come first, so that their columns in `observation_terms` are adjacent.
        in_order = [name for group in sorted(groups.values(), key=lambda g: -len(g.terms)) for name in group.terms]
        self.observation_terms = ObservationTerms(self._methods("_obs_", dict.fromkeys(in_order)))
        self.observation_terms.errors = self.make_observation_errors()
        self.observation_groups: dict[str, ObservationGroup] = {name: self._group(name) for name in groups}
        self.nan_guard = NanGuard(self.rewards.names, self.observation_terms, self.num_envs, self.device)  # type: ignore[arg-type]

    def _collect_judgements(self) -> None:
        """Collect the terminations and rewards that the configuration names, and all metrics."""
        cfg = self.cfg.rewards
        # A hook without the mark `@concurrent` may write tensors that terms read. With such a hook no term runs on a stream.
        hooks = (self.check_termination, self.measure, self.compute_reward)
        streams = (1, REWARD_STREAMS, 1) if all(is_concurrent(hook) for hook in hooks) else (0, 0, 0)
        self._concurrent_terminations, self._concurrent_rewards, self._concurrent_metrics = (
            ConcurrentTerms(self.device, count, self._settled) for count in streams
        )
        failures, time_outs = (
            self._concurrent_terminations.add("_terminate_", self._methods("_terminate_", names))
            for names in self.active_terminations()
        )
        self.terminations = Terminations(failures, time_outs, self.terminated_buf, self.time_out_buf, self.reset_buf)
        scales = {name: scale for name, scale in cfg.scales.items() if scale != 0.0}
        unit = self.dt if cfg.times_dt else 1.0
        rewards = self._concurrent_rewards.add("_reward_", self._methods("_reward_", scales))
        self.rewards = Rewards(rewards, scales, unit, cfg.only_positive_rewards, self.rew_buf, self.kernels)
        self.episode_sums = self.rewards.episode_sums
        names = sorted(self.terms("_metric_"))
        metrics = self._concurrent_metrics.add("_metric_", self._methods("_metric_", names))
        full = self.cfg.env.episode_length_s if cfg.times_dt else self.max_episode_length
        parts = self.rewards.names, self.terminations.names
        self.metrics = Metrics(metrics, *parts, full, self.num_envs, self.device)

    def _settled(self) -> dict[str, Tensor]:
        """Return the tensors, by name, that are written after `_start_terms`. Concurrent terms must not read them."""
        named = {name: getattr(self, name) for name in SETTLED}
        found = zip(self.terminations.names, self.terminations.found, strict=True)
        return named | {f"terminations.found of '{name}'": tensor for name, tensor in found}

    def _methods(self, prefix: str, names: Any) -> dict[str, Callable[[], Tensor]]:
        return {name: getattr(self, prefix + name) for name in names}

    def active_terminations(self) -> tuple[list[str], list[str]]:
        """Return the names of the failures and of the time-outs that are evaluated."""
        return list(self.cfg.terminations.failures), list(self.cfg.terminations.time_outs)

    def observation_scales(self) -> dict[str, Any]:
        """Return the factor on each term: one number, or one for each of its columns. A missing term has the factor 1."""
        return dict(self.cfg.observations.scales)

    def make_height_map(self) -> HeightMapErrors | None:
        """Return the inexact height map from which the term `heights` is read; None if the map has no errors."""
        return None

    def make_observation_errors(self) -> ObservationErrors | None:
        """Return the object that adds bias, delay, loss and errors of the height map to terms. Return None if no group with
        noise has a term with such errors.
        """
        cfg, noise = self.cfg.observations, self._noise()
        noisy = {term for group in cfg.groups.values() if group.noise for term in group.terms} if cfg.add_noise else set()
        height_map = self.make_height_map() if HEIGHTS in noisy else None
        named = {name for table in (cfg.bias, cfg.dropped) for name, value in table.items() if value}
        named |= {name for name, (_, most) in cfg.delay.items() if most}
        measured = noisy & (named | ({HEIGHTS} if height_map is not None else set()))
        if not measured:
            return None
        errors = (cfg.bias, cfg.delay, cfg.dropped)
        terms = self.observation_terms
        return ObservationErrors(terms.values, terms.columns, sorted(measured), *errors, noise, self.numbers, height_map)

    def _noise(self) -> dict[str, float]:
        """Return the half width of each term's noise, in the term's unit."""
        cfg = self.cfg.observations
        return {term: half * cfg.noise_level for term, half in cfg.noise.items()}

    def _group(self, name: str) -> ObservationGroup:
        """Build the observation group `name`."""
        cfg, terms = self.cfg.observations, self.observation_terms
        group = groups_in(self.cfg)[name]
        noisy = group.noise and cfg.add_noise
        noise = self._noise() if noisy else {}
        measured = terms.errors if noisy else None
        if measured is not None:  # terms with errors get their noise in `ObservationErrors`
            noise = {term: half for term, half in noise.items() if term not in measured.names}
        scales = self.observation_scales()
        return ObservationGroup(measured or terms, group.terms, scales, noise, cfg.clip, group.history, self.numbers)

    def _build_graph(self, enabled: bool) -> None:
        """Capture the step on a GPU, or check on the CPU that a graph could hold it. Then reset all episodes."""
        with ordinary_tensors():
            before = self.state_dict()
            self._graph = StepGraph(self._step, self.device, enabled)  # type: ignore[arg-type]
            # Undo the trial steps of StepGraph, but keep the buffers that terms allocated at their first call.
            now = self.state_dict()
            self.load_state_dict({part: {**state, **before[part]} for part, state in now.items()})
            self.reset_curricula()
        self.reset()

    # ---- one control step --------------------------------------------------------------------------------------------

    def _step(self) -> None:
        """Make one control step with `_action_input`. A CUDA graph captures it, so the host must not read tensors."""
        self.take_actions()
        for _ in range(self.cfg.control.decimation):
            self.apply_control()
            self.physics.step()
        with self._stream_1.fork():
            self.draw()
        self.sense()
        self.advance()
        self._concurrent_terminations.start()
        self._concurrent_rewards.start()
        self._concurrent_metrics.start()
        self.check_termination()
        if type(self).check_termination is not BaseTask.check_termination:
            self.terminations.settle()
        with self._stream_2.fork():
            self.measure()
        self.compute_reward()
        self._stream_1.join()
        self._stream_2.join()
        if self.step_watcher is not None:
            self.step_watcher()
        with self._stream_1.fork():
            self.metrics.add_episodes(self.reset_buf, self.terminated_buf, self.episode_length_buf, self.rewards.sums)
        with self._stream_2.fork():
            self.nan_guard.check_state(self._in_bounds, self._clipped_actions)
            self.nan_guard.check_rewards(self.rewards.terms_finite, self.valid)
        self.update_curricula()
        self._stream_1.join()
        self.reset_idx(self.reset_buf)
        self.disturb(~self.reset_buf)
        self._stream_2.join()
        self.sense()
        self.ask()
        self.observe()
        self.remember()
        self._stream_1.join()

    def take_actions(self) -> None:
        """Clip the actions and set the controls. A NaN action counts as 0."""
        clip = self.cfg.control.clip_actions
        torch.clamp(self._action_input, -clip, clip, out=self._clipped_actions)
        torch.nan_to_num(self._clipped_actions, nan=0.0, out=self.actions)
        self.set_controls()

    def set_controls(self) -> None:
        """Hook: set the actuators' controls (`physics.ctrl`) for a control step. Actions from -1 to 1 span an actuator's
        range; an actuator without a range takes the action itself.
        """
        torch.addcmul(self.control_middle, self.control_reach, self.actions, out=self.physics.ctrl)

    def apply_control(self) -> None:
        """Hook: update `physics.ctrl` before each physics step, for control laws that run faster than the policy."""

    def draw(self) -> None:
        """Hook: draw the random numbers of the step, and an initial state for every environment. Only environments that are
        reset use their initial states. The hook runs on another stream, in parallel with other parts of the step.
        """
        self.numbers.draw()
        self.randomization.draw()
        self.draw_reset()

    @abstractmethod
    def draw_reset(self) -> None:
        """Write an initial state for every environment to `reset_qpos` and `reset_qvel`. Before each call, the pool `numbers`
        has drawn new random numbers.
        """

    def sense(self) -> None:
        """Hook: update all tensors that are computed from the state of the physics."""
        self.physics.refresh()
        for sensor in self.sensors.values():
            sensor.update()

    def advance(self) -> None:
        """Hook: advance counters of time, such as `episode_length_buf`, by a control step."""
        self.episode_length_buf.add_(1)

    @concurrent
    def check_termination(self) -> None:
        """Hook: determine which episodes end. An episode ends by a termination term, by time, or if it is not `valid`."""
        state = torch.cat([self.physics.qpos, self.physics.qvel, self._clipped_actions], dim=1)
        largest = torch.linalg.vector_norm(state, torch.inf, dim=1)
        torch.lt(largest, LARGEST_STATE, out=self._in_bounds)  # NaN < x is False, so NaN counts as out of bounds
        torch.logical_and(self._in_bounds, self.nan_guard.outputs_finite, out=self.valid)
        self._concurrent_terminations.join()
        self.terminations.evaluate(self.valid, self.episode_length_buf >= self.max_episode_length)

    @concurrent
    def measure(self) -> None:
        """Hook: add the step to the metrics, at the same time as the rewards are computed."""
        self._concurrent_metrics.join()
        self.metrics.add_step(self.valid, self.physics.overflowed, self.terminations.found)

    @concurrent
    def compute_reward(self) -> None:
        """Hook: compute the reward of the step, before anything is reset."""
        self._concurrent_rewards.join()
        self.rewards.compute(self.valid)

    def update_curricula(self) -> None:
        """Hook: update curricula with the episodes that end (`reset_buf`)."""

    def reset_idx(self, mask: Tensor) -> None:
        """Hook: begin new episodes in the environments of `mask` (N,), at the drawn initial states."""
        redraws = bool(self.randomization.redrawn)
        if redraws:
            with self._stream_1.fork():
                self.redraw(mask)
        self.physics.write(mask, self.reset_qpos, self.reset_qvel)
        self.forget(mask)
        if redraws:
            self._stream_1.join()
            self._stream_2.join()

    def forget(self, mask: Tensor) -> None:
        """Hook: reset the buffers of the environments of `mask` (N,), whose episodes begin. This hook must not read
        randomised properties, because the hook `redraw` changes them at the same time. An override of `reset_idx` may read
        them after `super().reset_idx(mask)`.
        """
        self.rewards.reset(mask)
        masked_set_(self.actions, mask, 0.0)
        masked_set_(self.episode_length_buf, mask, 0)

    def redraw(self, mask: Tensor) -> None:
        """Hook: give new values to randomised properties, at resets (where `mask` (N,) is True) and when an interval has
        elapsed. The hook is called only if a property has `when: reset` or `interval`. It runs at the same time as `forget`.
        """
        self.randomization.redraw(mask)
        with self._stream_2.fork():
            self.randomization.rewrite(self.physics)

    def disturb(self, mask: Tensor) -> None:
        """Hook: disturb environments, for example by pushes. `mask` (N,) is True where the episode continues."""

    def ask(self) -> None:
        """Hook: update commands. `reset_buf` marks new episodes."""

    def observe(self) -> None:
        """Hook: write the observation groups. The check for non-finite numbers runs on a parallel stream."""
        self.observation_terms.evaluate(self.reset_buf)
        with self._stream_1.fork():
            self.nan_guard.check_observations(self.reset_buf)
        for group in self.observation_groups.values():
            group.advance()
            group.compute()
            group.restart(self.reset_buf)

    def remember(self) -> None:
        """Hook: store values of this step, such as the actions, for terms that compare the next step with this one."""
        self.last_actions.copy_(self.actions)

    # ---- rsl-rl's interface ------------------------------------------------------------------------------------------

    @property
    def episode_length_buf(self) -> Tensor:
        """(N,) control steps since the episode began. An assignment copies values, so that the tensor keeps its address."""
        return self._episode_length

    @episode_length_buf.setter
    def episode_length_buf(self, value: Tensor) -> None:
        self._episode_length.copy_(value)

    @property
    def captured(self) -> bool:
        """True if the step runs as one CUDA graph."""
        return self._graph.captured

    def reset(self) -> TensorDict:
        """Begin a new episode in every environment, and return the observations."""
        with ordinary_tensors():
            self.reset_buf.fill_(True)
            self.draw()
            self.reset_idx(self.reset_buf)
            self.sense()
            self.ask()
            self.observe()
            self.remember()
            self._stream_1.join()
            self.metrics.flush()
            self._steps_since_log = 0
        return self.get_observations()

    def get_observations(self) -> TensorDict:
        """Return copies of the observation groups, because rsl-rl keeps the result until after the next step."""
        groups = {name: group.buffer.clone() for name, group in self.observation_groups.items()}
        return TensorDict(groups, batch_size=[self.num_envs], device=self.device)  # type: ignore[arg-type]

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """Make one control step of all environments under `actions` (N, D): a tensor on any device, an array or a list of
        real numbers. The step records no gradients, even if the caller does.

        Returns observations, rewards (N,), dones (N,) bool, and extras. The extras hold `time_outs` (N,) bool and, once per
        rollout, `log`, which holds means over the rollout as 0-dimensional tensors.

        Raises:
            ValueError: the actions have another shape, or are not real numbers; the state is then unchanged.
        """
        with ordinary_tensors():
            self._action_input.copy_(as_actions(actions, self.num_envs, self.num_actions))
            self._graph()
        extras: dict[str, Any] = {"time_outs": self.time_out_buf.clone()}
        self._steps_since_log += 1
        if self._steps_since_log == self.cfg.train.runner.num_steps_per_env:
            extras["log"] = self.log_rollout()
            self._steps_since_log = 0
        return self.get_observations(), self.rew_buf.clone(), self.reset_buf.clone(), extras

    def step_in_place(self, actions: Tensor) -> None:
        """Make one control step without the task's own graph, for callers that capture the step in a larger graph. The step
        returns no copies. Results are in `rew_buf`, `reset_buf`, `time_out_buf` and the buffers of `observation_groups`.
        """
        self._action_input.copy_(actions)
        self._step()

    def mirror_images(self) -> MirrorImages | None:
        """Return the mirror images of observations and actions; None if the task has no mirror image.

        Raises:
            ConfigError: `MIRRORED` has no kind for a term, or a kind that does not fit the term's number of columns.
        """
        return None

    def log_rollout(self) -> dict[str, Tensor]:
        """Return the last rollout's figures for the log: name in TensorBoard -> new 0-dimensional tensor."""
        return {**self.metrics.flush(), **self.nan_guard.flush()}

    def reset_curricula(self) -> None:
        """Reset curricula to the start of training."""

    # ---- saved state ---------------------------------------------------------------------------------------------------

    def apply_randomization(self) -> None:
        """Apply the randomised properties again, after a saved state was loaded."""
        self.randomization.apply(self.physics)

    def progress(self) -> dict[str, Any]:
        """Return the progress of curricula, which every checkpoint holds. Any number of environments can load it."""
        grown = self.randomization.progress()
        return {"randomization": grown} if grown else {}

    def load_progress(self, progress: dict[str, Any]) -> None:
        """Continue from the progress of a checkpoint. Call `reset` afterwards."""
        self.randomization.load_progress(progress.get("randomization", {}))

    def parts(self) -> dict[str, Any]:
        """Return name in saved states -> part of the task. A part's `STATE` lists the tensors that are saved. A subclass adds
        its own parts.
        """
        return {
            "faults": self.nan_guard,
            "randomization": self.randomization,
            "rewards": self.rewards,
            **{f"sensor_{name}": sensor for name, sensor in self.sensors.items()},
            **{f"observations_{name}": group for name, group in self.observation_groups.items()},
            **(errors.parts() if (errors := self.observation_terms.errors) is not None else {}),
        }

    def state_dict(self) -> dict[str, Any]:
        """Return copies of the simulation's tensors. The next step follows from these, the actions and the state of torch's
        random generator, which is not included.
        """
        return {
            "physics": {name: tensor.clone() for name, tensor in self.physics.state_tensors().items()},
            "task": {name: tensor.clone() for name, tensor in self._own_tensors().items()},
            **{name: state_of(part) for name, part in self.parts().items()},
        }

    @torch.no_grad()
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load a saved state. With the same actions and random numbers, the next steps equal those after the save.

        Raises:
            StateError: the state belongs to another task or another number of environments. The task may be partly
                overwritten then and must not be used.
        """
        try:
            for name, part in self.parts().items():
                load_state(part, state.get(name, {}))
            take(self._own_tensors(), state.get("task", {}), type(self).__name__)
        finally:
            self.apply_randomization()  # engine and `randomization` must agree even after an error
        self.physics.load_state(state.get("physics", {}))

    def _own_tensors(self) -> dict[str, Tensor]:
        """Return, by name, the attributes of the task that are tensors with N rows. Tensors that belong to a part or to the
        physics are left out.
        """
        owners = [self.physics, self.physics.robot_state, *self.parts().values()]
        others = [*self.physics.state_tensors().values(), *(t for owner in owners for t in tensors_of(owner).values())]
        own = without_memory_of(others, tensors_of(self))
        return {name: tensor for name, tensor in own.items() if tensor.shape[:1] == (self.num_envs,)}
