"""Task of legged robots that follow velocity commands: commands and curricula. Its terms are in velocity_terms.py and
robot_terms.py.
"""

from typing import Any, ClassVar, TypeGuard

import torch
from tensordict import TensorDict
from torch import Tensor

from legged.config.legged import LeggedConfig, follows_velocities
from legged.config.task import TaskConfig
from legged.envs.base_task import BaseTask
from legged.envs.legged_checks import check_commands, check_grid
from legged.envs.legged_gym_names import LeggedGymNames
from legged.envs.robot_task import RobotTask
from legged.envs.velocity_terms import VelocityTerms
from legged.mdp.base_commands import BaseCommands
from legged.mdp.command_curriculum import CommandCurriculum
from legged.mdp.commands import Commands
from legged.mdp.sensors import BodyStates, Sensor
from legged.mdp.waypoints import Waypoints


class LeggedRobot(VelocityTerms, LeggedGymNames, RobotTask):
    """Legged robots that follow velocity commands. Subclass this class and add methods `_reward_<name>`, `_obs_<name>` or
    `_terminate_<name>`, which run if the configuration names them, or `_metric_<name>`, which always run. N robots, D joints,
    F feet, B tracked collision shapes.
    """

    Config: ClassVar[type[TaskConfig]] = LeggedConfig
    cfg: LeggedConfig

    @classmethod
    def check(cls, cfg: TaskConfig) -> None:
        super().check(cfg)
        assert follows_velocities(cfg)
        check_grid(cfg)
        check_commands(cfg)

    def _init_buffers(self) -> None:
        """Allocate tensors and parts for the robot, its ground, its commands and their curriculum."""
        super()._init_buffers()
        cfg, kernels = self.cfg, self.kernels
        full_ranges = self.command_sampler.full_ranges
        self.command_curriculum = CommandCurriculum(cfg.commands.curriculum, full_ranges, self.dt, kernels)

    def make_sensors(self) -> dict[str, Sensor]:
        """Return the sensors of every robot task, and `pitch_body` if commands.pitch_body names a body."""
        name, where = self.cfg.commands.pitch_body, self.cfg.origins.where("commands.pitch_body")
        bodies = {"pitch_body": BodyStates(self.physics, [name], self.kernels, where)} if name else {}
        return {**super().make_sensors(), **bodies}

    def make_commands(self) -> None:
        sampler = Commands(self.cfg.commands, self.num_envs, self.dt, self.device, self.kernels, self.numbers)
        self.command_sampler, self.commands, self.is_moving = sampler, sampler.commands, sampler.is_moving
        cfg, height = self.cfg.commands, self.cfg.rewards.base_height_target
        self.base_sampler = BaseCommands(cfg.ranges, height, self.numbers)
        self.base_commands = self.base_sampler.commands
        self.waypoints = Waypoints(cfg.waypoints, sampler, self.numbers) if cfg.waypoints.share else None

    def observation_scales(self) -> dict[str, Any]:
        """Return the factor on each observation. By default, commands have the factors of base_lin_vel and base_ang_vel."""
        scales = super().observation_scales()
        lin, ang = scales.get("base_lin_vel", 1.0), scales.get("base_ang_vel", 1.0)
        scales.setdefault("commands", [lin, lin, ang])
        return scales

    # ---- hooks of a control step -------------------------------------------------------------------------------------

    def draw(self) -> None:
        super().draw()
        self.command_sampler.draw()

    def update_curricula(self) -> None:
        self.command_curriculum.update(self.commands[:, :3], self.base_lin_vel, self.base_ang_vel, self.valid)
        self.command_curriculum.write_ranges(self.command_sampler.ranges)
        if self.terrain_curriculum is not None:
            steps_left = self.max_episode_length - self.episode_length_buf
            step = (self.commands, self.base_lin_vel, steps_left)
            self.terrain_curriculum.update(self.reset_buf, self.valid, *step)

    def ask(self) -> None:
        """Give robots their next commands when these are due, and steer towards headings and waypoints."""
        self.command_sampler.update(self.reset_buf, self.base_quat)
        if self.waypoints is not None:
            self.waypoints.steer(self.reset_buf, self.base_pos, self.base_quat)
        self.base_sampler.update(self.command_sampler)

    @torch.no_grad()
    def hold_commands(self, commands: Tensor, heading: Tensor | None = None, base: Tensor | None = None) -> TensorDict:
        """Hold `commands` (N, 3) or (3,): vx, vy [m/s] and yaw rate [rad/s], until the next call. Return the observations.
        If `heading` (N,) [rad] is given and heading mode is on, the yaw rate steers towards the heading instead. `base`,
        (N, 2) or (2,), are height [m] and pitch [rad] of the base, by default the usual height and no pitch.
        """
        self.command_sampler.hold(commands, heading)
        self.base_sampler.hold(base)
        self.observation_terms.evaluate(self.episode_length_buf == 0, again=True)
        for group in self.observation_groups.values():
            group.compute()
            group.restart(self.episode_length_buf == 0)
        return self.get_observations()

    # ---- curricula and saved state -----------------------------------------------------------------------------------

    def reset_curricula(self) -> None:
        super().reset_curricula()
        self.command_curriculum.reset()
        self.command_curriculum.write_ranges(self.command_sampler.ranges)

    def log_rollout(self) -> dict[str, Tensor]:
        ranges = {f"Metrics/{name}": value for name, value in self.command_curriculum.metrics().items()}
        levels = self.terrain_curriculum.metrics() if self.terrain_curriculum is not None else {}
        return {**super().log_rollout(), **ranges, **levels}

    def progress(self) -> dict[str, Any]:
        return super().progress() | {"command_curriculum": self.command_curriculum.progress()}

    def load_progress(self, progress: dict[str, Any]) -> None:
        super().load_progress(progress)
        self.command_curriculum.load_progress(progress["command_curriculum"])
        self.command_curriculum.write_ranges(self.command_sampler.ranges)

    def parts(self) -> dict[str, Any]:
        own = {"commands": self.command_sampler, "base_commands": self.base_sampler}
        parts = {**super().parts(), **own, "command_curriculum": self.command_curriculum}
        return parts if self.waypoints is None else {**parts, "waypoints": self.waypoints}


def is_velocity_task(task: BaseTask) -> TypeGuard[LeggedRobot]:
    """Return whether a task's robots follow velocity commands, so that `hold_commands` steers them."""
    return isinstance(task, LeggedRobot)
