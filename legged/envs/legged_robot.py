"""The legged robot's MDP, top to bottom: one step, terminations, resets. Observation and reward terms are in terms.py."""

from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from legged.config.schema import TaskConfig
from legged.envs.base_task import BaseTask
from legged.envs.checks import check_base_mass, check_mirror_kinds, check_sizes
from legged.envs.overrides import check_overrides, check_terms
from legged.envs.recurrent import check_recurrent
from legged.envs.terms import Terms
from legged.errors import ConfigError, suggest
from legged.graph.step_graph import Branch
from legged.math import masked_set_
from legged.mdp.command_curriculum import CommandCurriculum
from legged.mdp.commands import Commands
from legged.mdp.contacts import FeetContacts
from legged.mdp.control import Control, control_gains
from legged.mdp.faults import LARGEST_STATE, Faults
from legged.mdp.height_scan import HeightScan
from legged.mdp.observations import ObservationGroup, ObservationTerms
from legged.mdp.randomization import Randomization
from legged.mdp.rewards import Rewards
from legged.mdp.statistics import Statistics
from legged.mdp.terrain_curriculum import TerrainCurriculum
from legged.physics import make_physics
from legged.process.ranks import Ranks
from legged.robots.robot import Robot, load_robot
from legged.state import load_state, state_of, take
from legged.terrain import Terrain, check_terrain

TERMINATION_FORCE = 1.0
"""Contact force on a terminating shape that ends the episode [N]."""


class LeggedRobot(Terms, BaseTask):
    """A legged robot that follows velocity commands. Subclass it and add `_reward_<name>` or `_obs_<name>` methods;
    the configuration names the ones that run. N robots, D joints, F feet, B tracked collision shapes.
    """

    def __init__(
        self, cfg: TaskConfig, device: torch.device | str = "cpu", graph: bool = True, terrain: Terrain | None = None
    ) -> None:
        """Build physics and MDP on `device`; with `graph`, the step is captured on a GPU. A `terrain` takes the place of
        the one that the configuration asks for.

        Raises:
            ConfigError: the configuration names something that does not exist; nothing is compiled then.
            TermError: a term fails or cannot be captured.
        """
        robot = self.check(cfg)
        device = torch.device(device)
        super().__init__(cfg, robot.num_dof, device)
        self.robot = robot
        torch.manual_seed(cfg.env.seed + Ranks.now().rank)  # other robots on each GPU, on the same ground
        n = self.num_envs
        self.randomization = Randomization(cfg.domain_rand, n, self.dt, device)
        self.terrain = terrain or self.make_terrain()
        self.physics = make_physics(robot, cfg.sim, n, device, self.terrain, self.randomization.fields)
        self.randomization.apply(self.physics)

        state = self.physics.state
        self.base_pos, self.base_quat = state.base_pos, state.base_quat
        self.base_lin_vel, self.base_ang_vel = state.base_lin_vel, state.base_ang_vel
        self.projected_gravity = state.projected_gravity
        self.dof_pos, self.dof_vel = state.dof_pos, state.dof_vel
        self.feet_pos, self.feet_vel = state.feet_pos, state.feet_vel
        self.contact_forces = state.contact_forces
        self.last_dof_vel = torch.zeros_like(self.dof_vel)

        self.control = Control(robot, cfg.control, self.physics.torques, cfg.sim.dt)
        self.torques, self.default_dof_pos = self.control.torques, self.control.default_dof_pos
        self.command_sampler = Commands(cfg.commands, n, self.dt, device)
        self.commands, self.is_moving = self.command_sampler.commands, self.command_sampler.is_moving
        self.contacts = FeetContacts(n, len(robot.feet_indices), self.dt, device)
        full_ranges = self.command_sampler.full_ranges
        self.command_curriculum = CommandCurriculum(cfg.commands.curriculum, full_ranges, self.dt)
        self.valid = torch.ones(n, dtype=torch.bool, device=device)
        """(N,) robots whose numbers are numbers: physics now, rewards and observations a step before; the others are
        terminated and reset.
        """
        self._in_bounds = torch.ones_like(self.valid)
        self._clipped_actions = torch.zeros_like(self.actions)

        self.feet_indices = torch.tensor(robot.feet_indices, device=device)
        self.penalised_indices = torch.tensor(robot.penalised_indices, dtype=torch.long, device=device)
        self.termination_indices = torch.tensor(robot.termination_indices, dtype=torch.long, device=device)
        self.dof_vel_limits = torch.tensor(robot.dof_vel_limits, dtype=torch.float32, device=device)
        self.dof_pos_limits = self._soft_limits(robot)
        self.height_scan = HeightScan(cfg.terrain, self.terrain, n, device)
        self.measured_heights = self.height_scan.heights
        self.terrain_curriculum: TerrainCurriculum | None = None
        self.env_origins = torch.zeros(n, 3, device=device)
        """(N, 3) where each robot starts, world frame [m]."""
        if self.terrain is not None:
            self.terrain_curriculum = TerrainCurriculum(cfg.terrain, self.terrain, n, device)
            self.env_origins = self.terrain_curriculum.origins
        self._spawn_offset = torch.zeros(n, 3, device=device)
        self._spawn_offset[:, 2] = robot.file.spawn_height
        self._spawn_quat = torch.zeros(n, 4, device=device)
        self._spawn_yaw = torch.zeros(n, device=device)
        self._reset_velocity = torch.zeros(2, n, 3, device=device)  # linear, angular
        self._reset_dof_pos, self._reset_dof_vel = (torch.zeros(n, self.num_actions, device=device) for _ in range(2))
        self._beside = Branch(device)

        scales = {name: scale for name, scale in cfg.rewards.scales.items() if scale != 0.0}
        terms = {name: getattr(self, f"_reward_{name}") for name in scales}
        self.rewards = Rewards(terms, scales, self.dt, cfg.rewards.only_positive_rewards, self.rew_buf)
        self.episode_sums = self.rewards.episode_sums
        self.observation_terms = ObservationTerms({name: getattr(self, f"_obs_{name}") for name in self._term_order()})
        self.observation_groups = {"actor": self._group("actor"), "critic": self._group("critic")}
        self.faults = Faults(self.rewards.names, self.observation_terms, n, device)
        self.statistics = Statistics(self.rewards.names, cfg.env.episode_length_s, device)
        # A back-end that no graph can hold runs eagerly on a GPU; on the CPU nothing is captured, only checked.
        self._build_graph(graph and (self.physics.capturable or device.type == "cpu"))

    def make_terrain(self) -> Terrain | None:
        """The ground the configuration asks for; None for a plane. A subclass may return a terrain of its own."""
        cfg = self.cfg.terrain
        return None if cfg.mesh_type == "plane" else Terrain.build(cfg, self.cfg.env.seed)

    @classmethod
    def check(cls, cfg: TaskConfig) -> Robot:
        """Everything that can be wrong with a configuration, before anything is built; returns the robot."""
        origins = cfg.origins
        check_overrides(cls, LeggedRobot)
        robot = load_robot(cfg.robot, origins.where("robot"))
        rewards, terms = cls.terms("_reward_"), cls.terms("_obs_")
        for name in cfg.rewards.scales:
            if name not in rewards:
                where = origins.where(f"rewards.scales.{name}")
                raise ConfigError(f"{where}: {cls.__name__} has no reward '{name}'{suggest(name, rewards)}")
        for part in ("actor", "critic", "scales", "noise"):
            for name in getattr(cfg.observations, part):
                if name not in terms:
                    where = origins.where(f"observations.{part}" + (f".{name}" if part in ("scales", "noise") else ""))
                    raise ConfigError(f"{where}: {cls.__name__} has no observation '{name}'{suggest(name, terms)}")
        check_terms(cls, cfg)
        check_recurrent(cfg)
        if cfg.train.algorithm.symmetry:
            where, otherwise = origins.where("train.algorithm.symmetry"), "false learns without mirror images"
            if robot.mirror is None:
                raise ConfigError(f"{where}: '{robot.name}' is lopsided (joints and feet at zero angles); {otherwise}")
            used = (*cfg.observations.actor, *cfg.observations.critic)
            check_mirror_kinds(cls.__name__, cls.MIRRORED, used, where)
            y = cfg.terrain.measured_points_y
            if sorted(y) != sorted(-value for value in y):
                points = f"terrain.measured_points_y ({origins.of('terrain.measured_points_y')})"
                raise ConfigError(f"{where}: {points} are not the same left and right: {list(y)}")
        control_gains(robot, cfg.control, origins.where)
        check_terrain(cfg.terrain, origins)
        check_base_mass(cfg, robot)
        check_sizes(cfg)
        if round(cfg.env.episode_length_s / cfg.dt) < 1:
            where, given = origins.where("env.episode_length_s"), cfg.env.episode_length_s
            raise ConfigError(
                f"{where}: must be at least a control step of {cfg.dt:g} s (sim.dt * control.decimation), got {given:g}"
            )
        samples = cfg.env.num_envs * cfg.train.runner.num_steps_per_env
        if cfg.train.algorithm.num_mini_batches > samples:
            where, given = origins.where("train.algorithm.num_mini_batches"), cfg.train.algorithm.num_mini_batches
            raise ConfigError(
                f"{where}: must be at most the {samples} samples of an iteration (num_envs * num_steps_per_env), got {given}"
            )
        return robot

    @classmethod
    def terms(cls, prefix: str) -> set[str]:
        """Names of the methods that begin with `prefix`, without it."""
        return {name.removeprefix(prefix) for name in dir(cls) if name.startswith(prefix)}

    # ---- one control step --------------------------------------------------------------------------------------------

    def _step(self) -> None:
        clip = self.cfg.control.clip_actions
        torch.clamp(self._action_input, -clip, clip, out=self._clipped_actions)
        torch.nan_to_num(self._clipped_actions, nan=0.0, out=self.actions)
        self.control.set_actions(self.actions)
        for _ in range(self.cfg.control.decimation):
            self.control.compute(self.dof_pos, self.dof_vel)
            self.physics.step()
        with self._beside.fork():
            self._draw()
        self.physics.refresh()
        self.height_scan.update(self.base_pos, self.base_quat)
        self.episode_length_buf.add_(1)
        self.contacts.update(self.contact_forces[:, self.feet_indices])

        self.check_termination()
        with self._beside.fork():
            self.track()
        self.compute_reward()
        self._beside.join()
        with self._beside.fork():
            self.faults.check_rewards(self.rewards.fine, self.valid)
        if self.terrain_curriculum is not None:
            asked = self.commands[:, :2].norm(dim=1) * self.cfg.env.episode_length_s
            self.terrain_curriculum.update(self.reset_buf & self.valid, self.base_pos, asked)
        self.reset_idx(self.reset_buf)
        self.randomization.push(self.physics, ~self.reset_buf)
        self._observe()

    def check_termination(self) -> None:
        """Failures: a terminating shape feels a force, the base is too low or tilted, physics blew up. And time-outs."""
        cfg = self.cfg.terminations
        state = (self.base_pos, self.base_quat, self.base_lin_vel, self.base_ang_vel, self.dof_pos, self.dof_vel)
        largest = torch.linalg.vector_norm(torch.cat([*state, self._clipped_actions], dim=1), torch.inf, dim=1)
        torch.lt(largest, LARGEST_STATE, out=self._in_bounds)  # so is NaN not
        torch.logical_and(self._in_bounds, self.faults.sound, out=self.valid)
        force = self.contact_forces[:, self.termination_indices].norm(dim=2)
        failed = (force > TERMINATION_FORCE).any(dim=1) | ~self.valid
        if cfg.min_base_height > 0.0:
            failed = failed | (self.base_pos[:, 2] - self.height_scan.ground < cfg.min_base_height)
        if cfg.max_tilt > 0.0:
            failed = failed | (torch.acos((-self.projected_gravity[:, 2]).clamp(-1.0, 1.0)) > cfg.max_tilt)
        self.terminated_buf.copy_(failed)
        over = self.episode_length_buf >= self.max_episode_length
        if self.terrain is not None:
            x, y = self.terrain.reach  # a robot that walked off the map is not judged for it
            over = over | (self.base_pos[:, 0].abs() > x) | (self.base_pos[:, 1].abs() > y)
        self.time_out_buf.copy_(over & ~failed)
        torch.logical_or(self.terminated_buf, self.time_out_buf, out=self.reset_buf)

    def compute_reward(self) -> None:
        """Judged on the command that the policy saw, before anything is reset; ended episodes are recorded."""
        self.rewards.compute(self.valid)
        self.statistics.add_episodes(self.reset_buf, self.terminated_buf, self.episode_length_buf, self.rewards.sums)

    def track(self) -> None:
        """Record tracking errors; let the command curriculum judge the step."""
        velocity = torch.cat([self.base_lin_vel[:, :2], self.base_ang_vel[:, 2:]], dim=1)
        error = (self.commands[:, :3] - velocity).square()
        self.statistics.add_step(error[:, :2].sum(dim=1), error[:, 2], self.valid, self.physics.overflowed)
        self.faults.check_state(self._in_bounds, self._clipped_actions)
        self.command_curriculum.update(self.commands[:, :3], velocity, self.valid)
        self.command_curriculum.write_ranges(self.command_sampler.ranges)

    def _draw(self) -> None:
        """Random numbers for every robot, used by those that are reset, pushed or given a new command, and noise."""
        cfg = self.cfg.init_state
        self._reset_dof_pos.uniform_(*cfg.dof_pos_factor).mul_(self.default_dof_pos)
        self._reset_velocity.uniform_(*cfg.base_velocity)
        self._spawn_yaw.uniform_(*cfg.yaw)
        if self.terrain_curriculum is not None:
            reach = self.cfg.terrain.spawn_range
            self._spawn_offset[:, :2].uniform_(-reach, reach)
            self.terrain_curriculum.draw()
        self.command_sampler.draw()
        self.randomization.draw()
        for group in self.observation_groups.values():
            group.draw()

    def reset_idx(self, mask: Tensor) -> None:
        """New episodes for the robots in `mask` (N,): joints near the default pose, base at its spawn height, moving."""
        torch.cos(0.5 * self._spawn_yaw, out=self._spawn_quat[:, 0])
        torch.sin(0.5 * self._spawn_yaw, out=self._spawn_quat[:, 3])
        self.physics.write_state(
            mask,
            base_pos=self.env_origins + self._spawn_offset,
            base_quat=self._spawn_quat,
            base_lin_vel=self._reset_velocity[0],
            base_ang_vel=self._reset_velocity[1],
            dof_pos=self._reset_dof_pos,
            dof_vel=self._reset_dof_vel,
        )
        self.control.reset(mask)
        self.contacts.reset(mask)
        self.rewards.reset(mask)
        masked_set_(self.actions, mask, 0.0)
        masked_set_(self.episode_length_buf, mask, 0)

    def _observe(self) -> None:
        self.physics.refresh()
        self.height_scan.update(self.base_pos, self.base_quat)
        self.command_sampler.update(self.reset_buf, self.base_quat)
        self.observation_terms.evaluate()
        with self._beside.fork():
            self.faults.check_observations()
        for group in self.observation_groups.values():
            group.advance()
            group.compute()
            group.restart(self.reset_buf)
        self._beside.join()
        self.last_actions.copy_(self.actions)
        self.last_dof_vel.copy_(self.dof_vel)

    @torch.no_grad()
    def hold_commands(self, commands: Tensor, heading: Tensor | None = None) -> TensorDict:
        """Ask for fixed vx, vy [m/s], yaw rate [rad/s], (N, 3) or (3,), until told otherwise; returns observations. With
        `heading` (N,) [rad] and in heading mode, the yaw rate steers towards it instead.
        """
        self.command_sampler.hold(commands, heading)
        self.observation_terms.evaluate()
        for group in self.observation_groups.values():
            group.compute()
            group.restart(self.episode_length_buf == 0)
        return self.get_observations()

    # ---- construction and state --------------------------------------------------------------------------------------

    def _group(self, name: str) -> ObservationGroup:
        """The observation group `name`; only the actor's is noisy."""
        cfg = self.cfg.observations
        names = cfg.actor if name == "actor" else cfg.critic
        scales: dict[str, Any] = dict(cfg.scales)
        lin, ang = cfg.scales.get("base_lin_vel", 1.0), cfg.scales.get("base_ang_vel", 1.0)
        scales.setdefault("commands", [lin, lin, ang])
        noisy = name == "actor" and cfg.add_noise
        noise = {term: half * cfg.noise_level for term, half in cfg.noise.items()} if noisy else {}
        history = cfg.actor_history if name == "actor" else 1
        return ObservationGroup(self.observation_terms, names, scales, noise, cfg.clip, history)

    def _term_order(self) -> list[str]:
        """The terms of all groups, each once; those of the largest group first, so that it finds them side by side."""
        groups = sorted((self.cfg.observations.actor, self.cfg.observations.critic), key=len, reverse=True)
        return list(dict.fromkeys(name for names in groups for name in names))

    def _soft_limits(self, robot: Robot) -> Tensor:
        """(D, 2) joint limits, shrunk about their middle by `soft_dof_pos_limit` [rad]."""
        limits = torch.tensor(robot.dof_pos_limits, dtype=torch.float32, device=self.device)
        middle, half = limits.mean(dim=1, keepdim=True), 0.5 * (limits[:, 1:] - limits[:, :1])
        soft = half * self.cfg.rewards.soft_dof_pos_limit
        bounded = torch.cat([middle - soft, middle + soft], dim=1)
        return torch.where(torch.isfinite(bounded), bounded, limits)

    def reset_curricula(self) -> None:
        self.command_curriculum.reset()
        self.command_curriculum.write_ranges(self.command_sampler.ranges)
        if self.terrain_curriculum is not None:
            self.terrain_curriculum.reset()

    def log_rollout(self) -> dict[str, Tensor]:
        ranges = {f"Metrics/{name}": value for name, value in self.command_curriculum.metrics().items()}
        levels = self.terrain_curriculum.metrics() if self.terrain_curriculum is not None else {}
        return {**super().log_rollout(), **ranges, **levels, **self.faults.flush()}

    def progress(self) -> dict[str, Any]:
        progress = {"command_curriculum": self.command_curriculum.progress()}
        if self.terrain_curriculum is not None:
            progress["terrain_curriculum"] = self.terrain_curriculum.progress()
        return progress

    def load_progress(self, progress: dict[str, Any]) -> None:
        self.command_curriculum.load_progress(progress["command_curriculum"])
        self.command_curriculum.write_ranges(self.command_sampler.ranges)
        if self.terrain_curriculum is not None and "terrain_curriculum" in progress:
            self.terrain_curriculum.load_progress(progress["terrain_curriculum"])

    def _parts(self) -> dict[str, Any]:
        """What has a state of its own, by name."""
        parts = {
            "commands": self.command_sampler,
            "command_curriculum": self.command_curriculum,
            "contacts": self.contacts,
            "control": self.control,
            "faults": self.faults,
            "randomization": self.randomization,
            "rewards": self.rewards,
            **{f"observations_{name}": group for name, group in self.observation_groups.items()},
        }
        if self.terrain_curriculum is not None:
            parts["terrain_curriculum"] = self.terrain_curriculum
        return parts

    def _own_tensors(self) -> dict[str, Tensor]:
        """The task's own tensors of a row per robot, a subclass' among them; not those that are parts' or the physics'."""
        others = [*vars(self.physics.state).values(), *self.physics.state_tensors().values(), self.height_scan.heights]
        others += [tensor for part in self._parts().values() for tensor in vars(part).values() if isinstance(tensor, Tensor)]
        known = {tensor.untyped_storage().data_ptr() for tensor in others}
        return {
            name: tensor
            for name, tensor in vars(self).items()
            if isinstance(tensor, Tensor)
            and tensor.shape[:1] == (self.num_envs,)
            and tensor.untyped_storage().data_ptr() not in known
        }

    def state_dict(self) -> dict[str, Any]:
        return {
            "physics": {name: tensor.clone() for name, tensor in self.physics.state_tensors().items()},
            "task": {name: tensor.clone() for name, tensor in self._own_tensors().items()},
            **{name: state_of(part) for name, part in self._parts().items()},
        }

    @torch.no_grad()
    def load_state_dict(self, state: dict[str, Any]) -> None:
        for name, part in self._parts().items():
            load_state(part, state.get(name, {}))
        take(self._own_tensors(), state.get("task", {}), type(self).__name__)
        self.randomization.apply(self.physics)
        self.physics.load_state(state.get("physics", {}))
