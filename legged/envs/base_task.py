"""The boundary to rsl-rl: a vectorised environment whose step is one function, captured where there is a GPU."""

from abc import abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor

from legged.config.schema import TaskConfig
from legged.graph.step_graph import StepGraph
from legged.mdp.observations import ObservationGroup
from legged.mdp.statistics import Statistics


@contextmanager
def ordinary_tensors() -> Iterator[None]:
    """Record no gradients, but make no inference tensors either, even if the caller does: what a term keeps of one step must
    be writable in the next, whoever makes that.
    """
    with torch.inference_mode(False), torch.no_grad():
        yield


def as_actions(actions: Any, num_envs: int, num_actions: int) -> Tensor:
    """The actions that a caller gave, as a tensor (N, D) of real numbers.

    Raises:
        ValueError: they are none.
    """
    wanted = f"actions: expected real numbers of shape (N, D) = ({num_envs}, {num_actions})"
    try:
        tensor = actions if isinstance(actions, Tensor) else torch.tensor(actions)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{wanted}, got {type(actions).__name__}: {error}") from error
    if tensor.shape != (num_envs, num_actions):
        raise ValueError(f"{wanted}, got {tuple(tensor.shape)}")
    if tensor.is_complex() or tensor.dtype == torch.bool:
        raise ValueError(f"{wanted}, got {tensor.dtype}")
    return tensor


class BaseTask(VecEnv):
    """N environments on one device. Subclasses fill the buffers in `_step`; here they are handed out as copies, because
    rsl-rl keeps references to what it is given until after the next step.
    """

    observation_groups: dict[str, ObservationGroup]
    statistics: Statistics

    def __init__(self, cfg: TaskConfig, num_actions: int, device: torch.device) -> None:
        """Allocate the buffers every task has; D = num_actions."""
        n = cfg.env.num_envs
        self.cfg: TaskConfig = cfg  # type: ignore[assignment]
        self.num_envs, self.num_actions, self.device = n, num_actions, device  # type: ignore[assignment]
        self.dt = cfg.dt
        """Control step [s]."""
        self.max_episode_length = round(cfg.env.episode_length_s / cfg.dt)
        """Steps of a full episode."""
        self.actions = torch.zeros(n, num_actions, device=device)
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
        self._episode_length = torch.zeros(n, dtype=torch.long, device=device)
        self._action_input = torch.zeros_like(self.actions)
        self._graph: StepGraph | None = None
        self._steps_since_log = 0

    @property
    def episode_length_buf(self) -> Tensor:
        """(N,) steps since the episode began. Assigning copies, so that the address a graph knows stays."""
        return self._episode_length

    @episode_length_buf.setter
    def episode_length_buf(self, value: Tensor) -> None:
        self._episode_length.copy_(value)

    @property
    def unwrapped(self) -> "BaseTask":
        """The task itself, as Gymnasium names it."""
        return self

    @property
    def step_dt(self) -> float:
        """Control step [s], as rsl-rl's extensions name it."""
        return self.dt

    @property
    def captured(self) -> bool:
        """Whether the step runs as one CUDA graph."""
        return self._graph is not None and self._graph.captured

    @abstractmethod
    def _step(self) -> None:
        """One control step, from `_action_input` to all buffers: no host reads, no new addresses."""

    @abstractmethod
    def _draw(self) -> None:
        """Draw the random numbers that the next reset uses."""

    @abstractmethod
    def reset_idx(self, mask: Tensor) -> None:
        """Begin new episodes in the environments of `mask` (N,)."""

    @abstractmethod
    def _observe(self) -> None:
        """Bring state, commands and observations up to date after a reset."""

    def reset_curricula(self) -> None:
        """Go back to where training starts."""

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

    def reset(self) -> TensorDict:
        """Begin a new episode in every environment; returns the observations."""
        with ordinary_tensors():
            self.reset_buf.fill_(True)
            self._draw()
            self.reset_idx(self.reset_buf)
            self._observe()
            self.statistics.flush()
            self._steps_since_log = 0
        return self.get_observations()

    def get_observations(self) -> TensorDict:
        """Copies of the observation groups; neither steps nor resets."""
        groups = {name: group.buffer.clone() for name, group in self.observation_groups.items()}
        return TensorDict(groups, batch_size=[self.num_envs], device=self.device)  # type: ignore[arg-type]

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """One control step of all environments under `actions` (N, D): a tensor on any device, an array or a list, of any
        real numbers. Nothing of it is differentiated, whether or not the caller records gradients.

        Returns observations, rewards (N,), dones (N,) bool, and extras with `time_outs` (N,) bool and, once per
        rollout, `log`: means over the rollout as 0-dimensional tensors.

        Raises:
            ValueError: the actions have another shape, or are no real numbers; nothing is stepped then.
        """
        assert self._graph is not None, "the subclass must call _build_graph"
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
        """One control step, without copies or a graph of its own: for who captures more than the step. Results are in
        `rew_buf`, `reset_buf`, `time_out_buf` and the buffers of `observation_groups`.
        """
        self._action_input.copy_(actions)
        self._step()

    def log_rollout(self) -> dict[str, Tensor]:
        """What is logged of a rollout: fresh 0-dimensional tensors by their name in TensorBoard."""
        return self.statistics.flush()

    def progress(self) -> dict[str, Any]:
        """How far the curricula have got: what every checkpoint holds, whatever the number of environments."""
        return {}

    def load_progress(self, progress: dict[str, Any]) -> None:
        """Go on from there; to be followed by `reset`."""

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Copies of everything that the next step is a function of, beside the actions and torch's random numbers."""

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Put the task back into a saved state; the next step is then the one that would have followed.

        Raises:
            StateError: it is of another number of environments, or of another task; nothing should be used then.
        """
