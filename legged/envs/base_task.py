"""A task of any kind: the loop of a Markov decision process on batched physics, behind rsl-rl's interface.

Terms are methods: `_obs_<name>`, `_reward_<name>`, `_terminate_<name>`, `_metric_<name>`; the configuration says which of
them run. All tensors have N rows, one an environment, and stay at their addresses, so that a step is one CUDA graph.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor

from legged.config.networks import groups_in
from legged.config.schema import TaskConfig
from legged.envs.actions import as_actions, ordinary_tensors
from legged.envs.checks import check_task
from legged.envs.final_observation import StepWatcher
from legged.envs.judging import JudgingTask
from legged.envs.marks import concurrent
from legged.envs.observing import ObservingTask
from legged.envs.privileged_terms import PrivilegedTerms
from legged.envs.saved import SavedTask
from legged.errors import ConfigError
from legged.graph.step_graph import Branch, StepGraph
from legged.math import masked_set_
from legged.mdp.mirror_images import MirrorImages
from legged.mdp.nan_guard import LARGEST_STATE, NanGuard
from legged.mdp.observations import ObservationGroup, ObservationTerms
from legged.mdp.random_pool import RandomPool
from legged.physics import Scene
from legged.process.ranks import Ranks


class BaseTask(ObservingTask, JudgingTask, PrivilegedTerms, SavedTask, VecEnv):
    """N environments on one device. A subclass says what the world is (`make_scene`), how an episode begins (`draw_reset`)
    and which terms there are; the rest are hooks.
    """

    Config: ClassVar[type[TaskConfig]] = TaskConfig
    """The schema of its configuration."""
    QUANTITIES: ClassVar[tuple[str, ...]] = ()
    """Arrays of MuJoCo's data, beside qpos and qvel, that its terms read by `self.physics.quantity(name)`."""
    OWN_HELPERS: ClassVar[tuple[str, ...]] = ()
    """Methods of a subclass that are named like a hook of another framework, which nothing here calls, but which the subclass
    calls itself. Without this they are an error (legged/envs/class_checks.py)."""

    def __init__(self, cfg: TaskConfig, device: torch.device | str = "cpu", graph: bool = True) -> None:
        """Build physics and terms on `device`; with `graph`, the step is captured on a GPU.

        Raises:
            ConfigError: the configuration names something that does not exist; nothing is compiled then.
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
        torch.manual_seed(cfg.env.seed + Ranks.now().rank)  # other robots on each GPU, on the same ground
        self.randomization = self.make_randomization()
        self._build_physics(self.make_scene())
        self.num_actions = self.physics.ctrl.shape[1]
        self._allocate()
        self._init_buffers()
        if not self._has_buffers:
            raise ConfigError(f"{type(self).__name__}._init_buffers must call super()._init_buffers()")
        self.randomization.prepare(self.physics, self.numbers, self.dt, cfg.train.runner.num_steps_per_env)
        self._collect_terms()
        self.numbers.allocate()
        # An engine that no graph can hold runs eagerly on a GPU; on the CPU nothing is captured, only checked.
        self._build_graph(graph and (self.physics.capturable or device.type == "cpu"))

    @classmethod
    def check(cls, cfg: TaskConfig) -> None:
        """Look for everything that can be wrong with a configuration, before anything is built.

        Raises:
            ConfigError: there is something.
        """
        check_task(cls, cfg)

    @classmethod
    def terms(cls, prefix: str) -> set[str]:
        """Return the names of the methods that begin with `prefix`, without it."""
        return {name.removeprefix(prefix) for name in dir(cls) if name.startswith(prefix)}

    @abstractmethod
    def make_scene(self) -> Scene:
        """Say what a world consists of."""

    def _allocate(self) -> None:
        """Allocate what every task has; D actions."""
        n, device = self.num_envs, self.device
        self.actions = torch.zeros(n, self.num_actions, device=device)
        """(N, D) actions of this step, clipped."""
        self.last_actions = torch.zeros_like(self.actions)
        """(N, D) actions of the step before."""
        self.rew_buf = torch.zeros(n, device=device)
        """(N,) reward."""
        self.terminated_buf = torch.zeros(n, dtype=torch.bool, device=device)
        """(N,) the episode ended in a failure."""
        self.time_out_buf = torch.zeros_like(self.terminated_buf)
        """(N,) the episode ended by time; the learner bootstraps its value."""
        self.reset_buf = torch.zeros_like(self.terminated_buf)
        """(N,) either of the two."""
        self.valid = torch.ones_like(self.terminated_buf)
        """(N,) environments whose numbers are numbers: physics now, rewards and observations a step before; the others are
        terminated and reset.
        """
        self.reset_qpos = torch.zeros_like(self.physics.qpos)
        """(N, nq) generalised positions that the next episode of each environment begins with."""
        self.reset_qvel = torch.zeros_like(self.physics.qvel)
        """(N, nv) and velocities."""
        self.qpos0 = torch.as_tensor(self.physics.model.qpos0, dtype=torch.float32, device=device)
        """(nq,) the model's own positions."""
        model = self.physics.model
        low, high = torch.as_tensor(model.actuator_ctrlrange, dtype=torch.float32, device=device).unbind(dim=1)
        limited = torch.as_tensor(model.actuator_ctrllimited, device=device).bool()
        self.control_middle = torch.where(limited, 0.5 * (low + high), 0.0)
        """(D,) controls at action 0."""
        self.control_reach = torch.where(limited, 0.5 * (high - low), 1.0)
        """(D,) how much an action of 1 adds to them."""
        self._episode_length = torch.zeros(n, dtype=torch.long, device=device)
        self._action_input = torch.zeros_like(self.actions)
        self._clipped_actions = torch.zeros_like(self.actions)
        self._in_bounds = torch.ones_like(self.valid)
        self._stream_1, self._stream_2 = Branch(device), Branch(device)  # type: ignore[arg-type]
        self.numbers = RandomPool(n, device)  # type: ignore[arg-type]
        """What a step draws at random; subclasses ask it for theirs in `_init_buffers`."""
        self.step_watcher: StepWatcher | None = None
        """What looks at a step before episodes begin anew, where somebody asked for it (`final_observation.watch_steps`)."""
        self._steps_since_log = 0
        self._has_buffers = False

    def _init_buffers(self) -> None:
        """Allocate a subclass' own tensors and parts: physics is there, terms have not been called yet. Call super()'s."""
        self._has_buffers = True

    def _collect_terms(self) -> None:
        """Find the terms that the configuration names."""
        cfg = self.cfg
        self._collect_judgements()
        groups = groups_in(cfg)
        # Those of the largest group first, so that it finds them side by side.
        in_order = [name for group in sorted(groups.values(), key=lambda g: -len(g.terms)) for name in group.terms]
        self.observation_terms = ObservationTerms(self._methods("_obs_", dict.fromkeys(in_order)))
        self.observation_terms.errors = self.make_observation_errors()
        self.observation_groups: dict[str, ObservationGroup] = {name: self._group(name) for name in groups}
        self.nan_guard = NanGuard(self.rewards.names, self.observation_terms, self.num_envs, self.device)  # type: ignore[arg-type]

    def _methods(self, prefix: str, names: Any) -> dict[str, Callable[[], Tensor]]:
        """Return the methods `<prefix><name>` by name."""
        return {name: getattr(self, prefix + name) for name in names}

    def active_terminations(self) -> tuple[list[str], list[str]]:
        """Return the failures and the time-outs that can happen."""
        return list(self.cfg.terminations.failures), list(self.cfg.terminations.time_outs)

    def _build_graph(self, enabled: bool) -> None:
        """Capture the step (on a GPU) or check that it could be (on the CPU), then start all episodes anew."""
        with ordinary_tensors():
            before = self.state_dict()
            self._graph = StepGraph(self._step, self.device, enabled)  # type: ignore[arg-type]
            # The trial steps leave no trace, but for buffers that a term makes at its first call.
            now = self.state_dict()
            self.load_state_dict({part: {**state, **before[part]} for part, state in now.items()})
            self.reset_curricula()
        self.reset()

    # ---- one control step --------------------------------------------------------------------------------------------

    def _step(self) -> None:
        """Go from `_action_input` to all buffers: no host reads, no new addresses."""
        self.take_actions()
        for _ in range(self.cfg.control.decimation):
            self.apply_control()
            self.physics.step()
        with self._stream_1.fork():
            self.draw()
        self.sense()
        self.advance()
        self._start_terms()
        self.check_termination()
        if type(self).check_termination is not BaseTask.check_termination:
            self._settle_endings()
        with self._stream_2.fork():
            self.measure()
        self.compute_reward()
        self._stream_1.join()
        self._stream_2.join()
        if self.step_watcher is not None:
            self.step_watcher.take()
        with self._stream_1.fork():
            self._record()
        with self._stream_2.fork():
            self._look_for_faults()
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
        """Clip the actions; one that is no number counts as 0."""
        clip = self.cfg.control.clip_actions
        torch.clamp(self._action_input, -clip, clip, out=self._clipped_actions)
        torch.nan_to_num(self._clipped_actions, nan=0.0, out=self.actions)
        self.set_controls()

    def set_controls(self) -> None:
        """Give the actuators their controls (`physics.ctrl`) for a control step: actions from -1 to 1 span an actuator's
        range, one without a range takes the action itself.
        """
        torch.addcmul(self.control_middle, self.control_reach, self.actions, out=self.physics.ctrl)

    def apply_control(self) -> None:
        """Compute `physics.ctrl` anew before each physics step: a hook for control laws that are faster than the policy."""

    def draw(self) -> None:
        """Draw random numbers for every environment, used by those that are reset, and noise. Runs beside the step."""
        self.numbers.draw()
        self.randomization.draw()
        self.draw_reset()

    @abstractmethod
    def draw_reset(self) -> None:
        """Write a state for every environment to begin an episode with to `reset_qpos`, `reset_qvel`; `numbers` are fresh."""

    def sense(self) -> None:
        """Bring everything that follows from the physics' state up to date."""
        self.physics.refresh()

    def advance(self) -> None:
        """Let a control step pass, for all that counts time."""
        self.episode_length_buf.add_(1)

    @concurrent
    def check_termination(self) -> None:
        """Judge which episodes end: by a term, by time, or because physics blew up."""
        state = torch.cat([self.physics.qpos, self.physics.qvel, self._clipped_actions], dim=1)
        largest = torch.linalg.vector_norm(state, torch.inf, dim=1)
        torch.lt(largest, LARGEST_STATE, out=self._in_bounds)  # so is NaN not
        torch.logical_and(self._in_bounds, self.nan_guard.outputs_finite, out=self.valid)
        self._concurrent_terminations.join()
        self.terminations.evaluate(self.valid, self.episode_length_buf >= self.max_episode_length)

    def _settle_endings(self) -> None:
        """Let what an override of `check_termination` wrote into `reset_buf`, as legged_gym's do, count: what ends and is not
        out of time has failed.
        """
        self.time_out_buf.logical_and_(self.reset_buf)
        torch.gt(self.reset_buf, self.time_out_buf, out=self.terminated_buf)

    def update_curricula(self) -> None:
        """Judge the episodes that end (`reset_buf`), for what becomes harder: a hook."""

    def reset_idx(self, mask: Tensor) -> None:
        """Begin new episodes in the environments of `mask` (N,), in the states that were drawn."""
        with self.redrawing(mask):
            self.physics.write(mask, self.reset_qpos, self.reset_qvel)
            self.forget(mask)

    def forget(self, mask: Tensor) -> None:
        """Forget the past of the environments of `mask` (N,), whose episodes begin. Runs beside `redraw`: what depends on
        properties that are drawn again comes later in `reset_idx`.
        """
        self.rewards.reset(mask)
        masked_set_(self.actions, mask, 0.0)
        masked_set_(self.episode_length_buf, mask, 0)

    def disturb(self, mask: Tensor) -> None:
        """Disturb the environments of `mask` (N,), whose episodes go on: a hook."""

    def ask(self) -> None:
        """Renew what is asked of the robots; `reset_buf` says whose episodes have just begun: a hook."""

    def observe(self) -> None:
        """Write the observation groups; what is no number in them is looked for beside what follows."""
        self.observation_terms.evaluate(self.reset_buf)
        with self._stream_1.fork():
            self.nan_guard.check_observations(self.reset_buf)
        for group in self.observation_groups.values():
            group.advance()
            group.compute()
            group.restart(self.reset_buf)

    def remember(self) -> None:
        """Keep of this step what the next one compares with."""
        self.last_actions.copy_(self.actions)

    # ---- rsl-rl's interface ------------------------------------------------------------------------------------------

    @property
    def episode_length_buf(self) -> Tensor:
        """(N,) steps since the episode began. Assigning copies, so that the address a graph knows stays."""
        return self._episode_length

    @episode_length_buf.setter
    def episode_length_buf(self, value: Tensor) -> None:
        self._episode_length.copy_(value)

    @property
    def captured(self) -> bool:
        """Whether the step runs as one CUDA graph."""
        return self._graph.captured

    def reset(self) -> TensorDict:
        """Begin a new episode in every environment; returns the observations."""
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
        """Return copies of the observation groups: rsl-rl keeps what it is given until after the next step."""
        groups = {name: group.buffer.clone() for name, group in self.observation_groups.items()}
        return TensorDict(groups, batch_size=[self.num_envs], device=self.device)  # type: ignore[arg-type]

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """Make one control step of all environments under `actions` (N, D): a tensor on any device, an array or a list, of
        any real numbers. Nothing of it is differentiated, whether or not the caller records gradients.

        Returns observations, rewards (N,), dones (N,) bool, and extras with `time_outs` (N,) bool and, once per
        rollout, `log`: means over the rollout as 0-dimensional tensors.

        Raises:
            ValueError: the actions have another shape, or are no real numbers; nothing is stepped then.
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
        """Make one control step, without copies or a graph of its own: for who captures more than the step. Results are in
        `rew_buf`, `reset_buf`, `time_out_buf` and the buffers of `observation_groups`.
        """
        self._action_input.copy_(actions)
        self._step()

    def mirror_images(self) -> MirrorImages | None:
        """Return what turns observations and actions into those of the mirrored robot; None if the task has no mirror image.

        Raises:
            ConfigError: a term is not as wide as its kind says.
        """
        return None

    def log_rollout(self) -> dict[str, Tensor]:
        """Return what is logged of a rollout: fresh 0-dimensional tensors by their name in TensorBoard."""
        return {**self.metrics.flush(), **self.nan_guard.flush()}

    def reset_curricula(self) -> None:
        """Go back to where training starts."""
