"""Evaluations during training. Between iterations, the policy is measured on undisturbed robots in a separate task."""

from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from legged.config import LeggedConfig
from legged.envs import BaseTask
from legged.envs.actions import ordinary_tensors
from legged.envs.checks import evaluated_figures
from legged.evaluation.velocity_grid import Grid, axes_of
from legged.evaluation.velocity_tracking import place_to_track
from legged.graph.step_graph import StepGraph
from legged.learning.run_state import kept_generators
from legged.mdp.random_pool import seed_host
from legged.mdp.tracking_error import velocity_error, yaw_rate_error
from legged.physics import resolve_physics
from legged.policies.actor import Actor
from legged.policies.episodes import unit_of
from legged.policies.restore import nominal
from legged.registry import make_task, task_class

HOLD_S = 3.0
"""Default time for which a command is held [s]."""
SETTLE_S = 1.0
"""The measurement starts this long after the command, but at the latest after a third of the command's duration [s]."""


def few_commands(cfg: LeggedConfig) -> Grid:
    """Return the grid of commands for `train.runner.evaluate_envs` robots. As long as the grid has more commands than
    robots, every second value of its longest axis is left out.

    Raises:
        ConfigError: an axis of the configuration is not a range.
    """
    axes, runner = axes_of(cfg), cfg.train.runner
    hold_s = runner.evaluate_s or HOLD_S
    while (grid := Grid(**axes, robots=1, hold_s=hold_s, settle_s=min(SETTLE_S, hold_s / 3.0))).num_cells > max(
        runner.evaluate_envs, 1
    ):
        longest = max(axes, key=lambda name: len(axes[name]))
        axes[longest] = thinned(axes[longest])
    return replace(grid, robots=runner.evaluate_envs // grid.num_cells)


def thinned(values: list[float]) -> list[float]:
    """Return about half the values, evenly spread from the first to the last. If there are two values, return the first."""
    keep = (len(values) + 1) // 2
    last = len(values) - 1
    return [values[round(i * last / (keep - 1))] for i in range(keep)] if keep > 1 else values[:1]


class TrainingEvaluation:
    """Measurement of a policy in a copy of the training's task without noise, pushes, randomisation and curricula. Every
    measurement starts from the same random state and leaves the training's random generators unchanged.
    """

    def __init__(self, training: BaseTask) -> None:
        """Build the task on the device and in the engine of the task `training`. If the training's step is a CUDA graph, the
        evaluation's step is one too, unless the policy is recurrent.

        Raises:
            ConfigError: the grid of commands is invalid.
        """
        cfg, device = training.cfg, torch.device(training.device)
        self.figures: tuple[str, ...] = evaluated_figures(task_class(cfg.task), cfg)
        """Names of the figures, the most important first."""
        self._grid = few_commands(cfg) if isinstance(cfg, LeggedConfig) else None
        engine = resolve_physics(cfg.sim.physics, device, num_envs=cfg.env.num_envs)
        asked: list[tuple[str, Any]] = [("sim.physics", "mujoco" if training.physics.why_c_engine else engine)]
        terrain = None
        if self._grid is not None:
            asked, terrain = place_to_track(cfg, self._grid, asked)  # type: ignore[arg-type]
        else:
            asked += [("env.num_envs", cfg.train.runner.evaluate_envs), ("observations.add_noise", False)]
            asked += [("env.episode_length_s", cfg.train.runner.evaluate_s)] if cfg.train.runner.evaluate_s else []
        with kept_generators(device):
            self.task: Any = make_task(nominal(cfg, asked), device, False, terrain)
            self._actor = Actor(self.task, device)
            self._allocate(device)
            capture = training.captured and not self._actor.network.is_recurrent
            with ordinary_tensors():
                self._graph = StepGraph(self._step, device, capture)

    def _allocate(self, device: torch.device) -> None:
        task = self.task
        buffers = {name: group.buffer for name, group in task.observation_groups.items()}
        self._observations = TensorDict(buffers, batch_size=[task.num_envs], device=device)
        self._running = torch.ones(task.num_envs, dtype=torch.bool, device=device)
        self._failed = torch.zeros_like(self._running)
        self._sums = torch.zeros(4, task.num_envs, device=device)
        self._return, self._length, self._lin, self._ang = self._sums
        self._measured = torch.zeros((), device=device)
        """0-dimensional: 1 while errors are measured, 0 while robots settle."""
        self._zero = torch.zeros((), device=device)
        if self._grid is not None:
            cells = torch.tensor(self._grid.cells, dtype=torch.float32, device=device)
            self._commands = cells.repeat_interleave(self._grid.robots, dim=0)
            self._standing = torch.zeros(task.num_envs, 3, device=device)

    def _step(self) -> None:
        """Simulate one control step, and add its rewards and errors to the sums."""
        task = self.task
        task.step_in_place(self._actor(self._observations))
        self._return.add_(torch.where(self._running, task.rew_buf, self._zero))
        self._length.add_(self._running)
        self._failed.logical_or_(self._running & task.terminated_buf)
        self._running.logical_and_(~task.reset_buf)
        if self._grid is not None:
            up = self._running.unsqueeze(1)
            lin_vel = torch.where(up, task.base_lin_vel, self._standing)
            ang_vel = torch.where(up, task.base_ang_vel, self._standing)
            self._lin.add_(self._measured * velocity_error(self._commands, lin_vel))
            self._ang.add_(self._measured * yaw_rate_error(self._commands, ang_vel))

    def measure(self, policy: nn.Module) -> dict[str, float]:
        """Return name of a figure -> its value over the first episode of each robot. `policy` is an rsl-rl model with the
        architecture of the policy in training; its weights are copied.

        `return` is the mean undiscounted sum of scale * term over steps, `falls` the share of robots that failed, and
        `episode_length` the mean number of steps in the episode. For robots that follow commands, `lin_vel_rmse` [m/s] and
        `ang_vel_rmse` [rad/s] are the root mean square errors of each command, averaged over commands. A fallen robot counts
        as standing still; `legged evaluate` leaves it out. Other metrics are means over robots and steps.
        """
        task, grid = self.task, self._grid
        device = torch.device(task.device)
        with kept_generators(device), ordinary_tensors():
            torch.default_generator.manual_seed(task.cfg.env.seed)
            seed_host(task.cfg.env.seed)
            if device.type == "cuda":
                torch.cuda.default_generators[device.index].manual_seed(task.cfg.env.seed)
            self._actor.network.load_state_dict(policy.state_dict())
            self._actor.network.reset()
            task.reset()
            if grid is not None:
                task.hold_commands(self._commands)
            self._running.fill_(True)
            self._failed.fill_(False)
            self._sums.zero_()
            steps = task.max_episode_length if grid is None else max(1, round(grid.hold_s / task.dt))
            settle = 0 if grid is None else min(round(grid.settle_s / task.dt), steps - 1)
            self._measured.fill_(0.0)
            for step in range(steps):
                if step == settle:
                    self._measured.fill_(1.0)
                    task.metrics.flush()
                self._graph()
            found = self._found(steps - settle)
            numbers = torch.stack(list(found.values())).tolist()
        return dict(zip(found, numbers, strict=True))

    def _found(self, measured: int) -> dict[str, Tensor]:
        """Return name of a figure -> 0-dimensional value, from each robot's sums. Sums of errors cover `measured` steps."""
        own = {name.removeprefix("Metrics/"): value for name, value in self.task.metrics.flush().items()}
        found = {
            "return": self._return.mean() / unit_of(self.task),
            "falls": self._failed.float().mean(),
            "episode_length": self._length.mean(),
        }
        if self._grid is not None:
            for name, errors in (("lin_vel_rmse", self._lin), ("ang_vel_rmse", self._ang)):
                found[name] = (errors.view(-1, self._grid.robots).mean(dim=1) / measured).sqrt().mean()
        return {name: found[name] if name in found else own[name] for name in self.figures}
