"""Task of a robot on its ground: control, contacts, height scan, tiles, randomisation, pushes and initial states. A subclass
adds commands. Terms of every robot task are in robot_terms.py.
"""

from collections.abc import Sequence
from typing import Any, ClassVar, TypeGuard

import torch
from tensordict import TensorDict
from torch import Tensor

from legged.config.robot import RobotConfig, has_robot
from legged.config.task import TaskConfig
from legged.envs.base_task import BaseTask
from legged.envs.legged_checks import check_legged
from legged.envs.robot_terms import RobotTerms, observed_joints
from legged.math import evenly_spaced, quat_rotate
from legged.mdp.actuators.motor_curve import with_rotors
from legged.mdp.contacts import FeetContacts, contact_force
from legged.mdp.control import Control, acted_joints
from legged.mdp.disturbances import Disturbances
from legged.mdp.height_map_errors import HeightMapErrors, is_exact
from legged.mdp.held_goals import HeldGoals
from legged.mdp.mirror_images import MirrorImages
from legged.mdp.randomization import Pushes, RobotRandomization
from legged.mdp.sensors import ContactForces, HeightScan, Sensor
from legged.mdp.terrain_curriculum import TerrainCurriculum
from legged.physics import ContactGroups, RobotScene, Scene
from legged.robots.robot import Robot, load_robot
from legged.terrain import Terrain

POSES = 256
"""Number of random initial poses that are computed at the start for a robot with closed kinematic loops."""


class RobotTask(RobotTerms, BaseTask):
    """N robots on their ground. A subclass adds commands (`make_commands`, `ask`) and its terms. D joints, F feet, B tracked
    collision shapes.
    """

    Config: ClassVar[type[TaskConfig]] = RobotConfig
    cfg: RobotConfig

    def __init__(
        self, cfg: RobotConfig, device: torch.device | str = "cpu", graph: bool = True, terrain: Terrain | None = None
    ) -> None:
        """Build physics and MDP on `device`. With `graph`, the step is captured in a CUDA graph if `device` is a GPU. If
        `terrain` is given, it replaces the configured one.

        Raises:
            ConfigError: the configuration or the task class is invalid.
            TermError: a term fails or cannot be captured.
        """
        self.terrain = terrain
        super().__init__(cfg, device, graph)

    @classmethod
    def check(cls, cfg: TaskConfig) -> None:
        super().check(cfg)
        assert has_robot(cfg)
        check_legged(cls, cfg, load_robot(cfg.robot, cfg.origins.where("robot")))

    # ---- construction ------------------------------------------------------------------------------------------------

    def make_randomization(self) -> RobotRandomization:
        """Return the randomised properties: friction, base mass and the fields of `domain_rand.ranges`. Friction and base
        mass are drawn even if their randomisation is off.
        """
        return RobotRandomization(self.cfg.domain_rand, self.num_envs, self.device)

    def make_scene(self) -> Scene:
        """Return the robot on its ground."""
        self.robot: Robot = with_rotors(load_robot(self.cfg.robot), self.cfg.control.actuator)
        self.terrain = self.terrain or self.make_terrain()
        on, where, groups = self.cfg.sim.self_collisions, f"{type(self).__name__}.contact_groups", self.contact_groups()
        watched = {
            name: ContactGroups.of(self.robot, pair, self.cfg.control.decimation, on, f"{where}: {name}")
            for name, pair in groups.items()
        }
        return RobotScene(self.robot, self.terrain, watched)

    def contact_groups(self) -> dict[str, tuple[Sequence[str], Sequence[str]]]:
        """Hook: return name -> two groups of shapes, given as patterns of shapes or as `GROUND`. The sensor of this name, a
        `ContactForces`, measures the forces of contacts between both groups.
        """
        if not self.cfg.rewards.scales.get("self_collision"):
            return {}
        shapes = tuple(self.robot.colliding(self.cfg.sim.self_collisions))
        return {"self_collision": (shapes, shapes)}

    def make_sensors(self) -> dict[str, Sensor]:
        """Return the height scan and the sensors of `contact_groups`. A subclass may add sensors."""
        state = self.physics.robot_state
        assert state is not None
        self.height_scan = HeightScan(self.cfg.terrain, self.terrain, (state.base_pos, state.base_quat), self.kernels)
        forces = {name: ContactForces(measured) for name, measured in self.physics.group_forces.items()}
        return {**super().make_sensors(), "height_scan": self.height_scan, **forces}

    def make_terrain(self) -> Terrain | None:
        """Hook: return the configured terrain; None for a plane. A subclass may return another terrain."""
        cfg = self.cfg.terrain
        return None if cfg.mesh_type == "plane" else Terrain.build(cfg, self.cfg.env.seed)

    def _allocate(self) -> None:
        """Allocate the tensors that all tasks have. There is one action for each joint that is not held."""
        self.num_actions = len(acted_joints(self.robot, self.cfg.control))
        self._joints = {}
        super()._allocate()

    def _init_buffers(self) -> None:
        """Allocate tensors and parts for the robot, its ground and what the robot is asked to do."""
        super()._init_buffers()
        cfg, robot, n, device = self.cfg, self.robot, self.num_envs, self.device
        kernels = self.kernels
        state = self.physics.robot_state
        assert state is not None
        self.base_pos, self.base_quat = state.base_pos, state.base_quat
        self.base_lin_vel, self.base_ang_vel = state.base_lin_vel, state.base_ang_vel
        self.projected_gravity = state.projected_gravity
        self.dof_pos, self.dof_vel = state.dof_pos, state.dof_vel
        self.feet_pos, self.feet_vel = state.feet_pos, state.feet_vel
        self.contact_forces = state.contact_forces
        self.last_dof_vel = torch.zeros_like(self.dof_vel)

        self.pushes = Pushes(cfg.domain_rand, n, self.dt, device, self.numbers)
        steps = cfg.train.runner.num_steps_per_env
        walk = cfg.domain_rand.held_goals
        goals = HeldGoals(walk, robot, cfg.control, n, self.dt, device, cfg.origins.where) if walk.step else None
        self.disturbances = Disturbances(
            cfg.domain_rand, self.physics, self.dt, steps, self.numbers, kernels, robot.joint_names, goals
        )
        offsets = None if goals is None else goals.offsets
        self.control = Control(robot, cfg.control, self.physics.ctrl, cfg.sim.dt, kernels, self.numbers, offsets)
        self.torques, self.default_dof_pos = self.control.torques, self.control.default_dof_pos
        self.make_commands()
        self.contacts = FeetContacts(n, len(robot.feet_indices), self.dt, device, kernels, contact_force(robot.mass))

        self.feet_indices = torch.tensor(robot.feet_indices, device=device)
        self._feet_shapes = evenly_spaced(robot.feet_indices) or self.feet_indices
        self.penalised_indices = torch.tensor(robot.penalised_indices, dtype=torch.long, device=device)
        self.termination_indices = torch.tensor(robot.termination_indices, dtype=torch.long, device=device)
        self._terminating_shapes = evenly_spaced(robot.termination_indices) or self.termination_indices
        self._nominal_vel_limits = torch.tensor(robot.dof_vel_limits, dtype=torch.float32, device=device)
        self.dof_vel_limits = self._nominal_vel_limits
        if "velocity_limit" in self.randomization.draws:
            self.dof_vel_limits = torch.zeros_like(self.dof_vel)
        self._vary()
        self.dof_pos_limits = self._soft_limits(robot)
        self._without_wheels = torch.tensor(robot.without_wheels, device=device) if robot.wheels.any() else None
        seen = observed_joints(robot, cfg.observations.joints, cfg.origins.where)
        self.seen_joints = {"dof_pos": tuple(i for i in seen if not robot.wheels[i]), "dof_vel": seen}
        """Observation term -> indices of the joints that it shows."""
        self._seen_angles, self._seen_speeds = (
            None if len(each) == robot.num_dof else torch.tensor(each, device=device) for each in self.seen_joints.values()
        )
        self.posture_joints = torch.tensor(~robot.swings & ~robot.wheels, dtype=torch.float32, device=device)
        if goals is not None:
            self.posture_joints[list(self.control.held)] = 0.0
        self.measured_heights = self.height_scan.heights
        self.terrain_curriculum: TerrainCurriculum | None = None
        """Tiles on which episodes begin; None on a plane. Robots keep their tiles unless a subclass moves them."""
        self.env_origins = torch.zeros(n, 3, device=device)
        """(N, 3) middle of the area in which each robot's episodes begin, world frame [m]."""
        if self.terrain is not None:
            self.terrain_curriculum = TerrainCurriculum(cfg.terrain, self.terrain, n, self.dt, device, kernels)
            self.env_origins = self.terrain_curriculum.origins
        reach, height = cfg.terrain.spawn_range if self.terrain is not None else 0.0, robot.file.spawn_height
        self._spawn = self.numbers.between([-reach, -reach, height], [reach, reach, height], 3)
        low, high = (factor * self.default_dof_pos for factor in cfg.init_state.dof_pos_factor)
        self._reset_joints = self.numbers.between(low, high, robot.num_dof)
        self._reset_velocity = self.numbers.between(*cfg.init_state.base_velocity, 6)  # linear and angular, in the base frame
        self._reset_yaw = self.numbers.between(*cfg.init_state.yaw, 1)
        self.reset_qpos[:, 3] = 1.0
        self._poses: Tensor | None = None
        """(K, nq - 7) joint positions of K poses in which the kinematic loops are closed. Each reset picks one of them. None
        without passive joints."""
        if robot.passive is not None:
            where = cfg.origins.where("init_state.dof_pos_factor")
            poses = robot.passive.draw(robot.default_qpos, cfg.init_state.dof_pos_factor, POSES, cfg.env.seed, where)
            self._poses = torch.tensor(poses, dtype=torch.float32, device=device)[:, 7:]
            self._pose_draw = self.numbers.between(0.0, float(len(poses)), 1)
            self.passive_default_pos = torch.tensor(
                robot.default_qpos[list(robot.passive.qpos_columns)], dtype=torch.float32, device=device
            )
            self.passive_qpos_columns = torch.tensor(robot.passive.qpos_columns, device=device)
            self.passive_qvel_columns = torch.tensor(robot.passive.qvel_columns, device=device)

    def make_commands(self) -> None:
        """Hook: allocate what the robots are asked to do. `self.control` exists by then, `self.contacts` does not."""

    def _soft_limits(self, robot: Robot) -> Tensor:
        """Return joint limits (D, 2) [rad], shrunk about their middle by the factor `soft_dof_pos_limit`."""
        limits = torch.tensor(robot.dof_pos_limits, dtype=torch.float32, device=self.device)
        middle, half = limits.mean(dim=1, keepdim=True), 0.5 * (limits[:, 1:] - limits[:, :1])
        soft = half * self.cfg.rewards.soft_dof_pos_limit
        bounded = torch.cat([middle - soft, middle + soft], dim=1)
        return torch.where(torch.isfinite(bounded), bounded, limits)

    def active_terminations(self) -> tuple[list[str], list[str]]:
        """Return the names of the failures and of the time-outs that are evaluated. A limit of 0 switches `base_height` or
        `tilt` off, and on a plane `left_terrain` is off.
        """
        cfg = self.cfg.terminations
        limits = (("base_height", cfg.min_base_height), ("tilt", cfg.max_tilt))
        ours = {
            name
            for name, _ in limits
            if getattr(type(self), f"_terminate_{name}") is getattr(RobotTerms, f"_terminate_{name}")
        }
        off = {name for name, limit in limits if limit == 0.0} & ours
        if self.terrain is None:
            off.add("left_terrain")
        failures, time_outs = super().active_terminations()
        return [name for name in failures if name not in off], [name for name in time_outs if name not in off]

    def make_height_map(self) -> HeightMapErrors | None:
        cfg = self.cfg.observations.height_map
        if is_exact(cfg):
            return None
        scan, kernels, pose = self.height_scan, self.kernels, (self.base_pos, self.base_quat)
        if cfg.shift or cfg.shift_drift:
            scan = HeightScan(self.cfg.terrain, self.terrain, pose, kernels)
        return HeightMapErrors(cfg, scan, pose, self.heights_seen, self.dt, self.numbers, kernels)

    def mirror_images(self) -> MirrorImages | None:
        if self.robot.mirror is None:
            return None
        groups, points = self.observation_groups, self.height_scan.points
        seen, control = self.seen_joints, self.control
        joints = {"actions": control.acted, "angles": seen["dof_pos"], "speeds": seen["dof_vel"], "held": control.held}
        return MirrorImages(type(self).__name__, self.MIRRORED, groups, self.robot, joints, points)

    # ---- hooks of a control step -------------------------------------------------------------------------------------

    def set_controls(self) -> None:
        """Pass the actions to the control law."""
        self.control.set_actions(self.actions)

    def apply_control(self) -> None:
        self.control.compute(self.dof_pos, self.dof_vel)

    def draw(self) -> None:
        super().draw()
        self.disturbances.draw()

    def draw_reset(self) -> None:
        """Draw joint angles near the default pose, and velocity and yaw of the base. A robot with passive joints gets one of
        the poses that were computed at the start. In these poses its kinematic loops are closed.
        """
        if self.terrain_curriculum is not None:
            self.terrain_curriculum.draw()
        if self._poses is None:
            self.reset_qpos[:, 7:].copy_(self._reset_joints.values)
        else:
            self.reset_qpos[:, 7:].copy_(self._poses[self._pose_draw.values[:, 0].long().clamp_(max=len(self._poses) - 1)])
        self.reset_qvel[:, :6].copy_(self._reset_velocity.values)
        if self.cfg.init_state.yaw != (0.0, 0.0):
            half_yaw = 0.5 * self._reset_yaw.values[:, 0]
            torch.cos(half_yaw, out=self.reset_qpos[:, 3])
            torch.sin(half_yaw, out=self.reset_qpos[:, 6])
            # In MuJoCo the linear velocity of a floating base is in the world frame, the angular velocity in the base frame.
            self.reset_qvel[:, :3].copy_(quat_rotate(self.reset_qpos[:, 3:7], self._reset_velocity.values[:, :3]))

    def advance(self) -> None:
        super().advance()
        self.contacts.update(self.contact_forces[:, self._feet_shapes])

    def place(self) -> None:
        """Hook: write the positions of the bases at the beginning of the next episodes to `reset_qpos`."""
        torch.add(self.env_origins, self._spawn.values, out=self.reset_qpos[:, :3])

    def reset_idx(self, mask: Tensor) -> None:
        self.place()
        super().reset_idx(mask)
        self.control.reset(mask)  # `control` reads angles that `redraw` may change, so its reset comes last

    def forget(self, mask: Tensor) -> None:
        super().forget(mask)
        self.contacts.reset(mask)

    def reset(self) -> TensorDict:
        self.disturbances.end(self.physics)
        if self.terrain_curriculum is not None:
            self.terrain_curriculum.begin()
        return super().reset()

    def reset_curricula(self) -> None:
        if self.terrain_curriculum is not None:
            self.terrain_curriculum.reset()

    def redraw(self, mask: Tensor) -> None:
        super().redraw(mask)
        self._vary(again=True)

    def _vary(self, again: bool = False) -> None:
        """Apply randomised properties to the control law, and `velocity_limit` to `dof_vel_limits` and to the no-load speeds
        of motors; with `again`, only properties with `when: reset` or `interval`.
        """
        drawn = self.randomization.fields
        names = self.randomization.redrawn if again else self.randomization.draws
        self.control.vary({name: drawn[name] for name in names})
        if "velocity_limit" in names:
            factor = drawn["velocity_limit"].view(self.num_envs, -1)
            torch.mul(self._nominal_vel_limits, factor, out=self.dof_vel_limits)
            if self.control.actuator is not None:
                self.control.actuator.curve.vary(factor)

    def apply_randomization(self) -> None:
        super().apply_randomization()
        self._vary()

    def pushed_by_forces(self) -> bool:
        return bool(self.cfg.domain_rand.forces)

    def disturb(self, mask: Tensor) -> None:
        """Apply the pushes, kicks and forces that are due, but only to robots in `mask` (N,)."""
        self.pushes.push(self.physics, mask)
        self.disturbances.act(self.physics, mask)

    def remember(self) -> None:
        super().remember()
        self.last_dof_vel.copy_(self.dof_vel)

    # ---- saved state -------------------------------------------------------------------------------------------------

    def progress(self) -> dict[str, Any]:
        progress = super().progress()
        if self.disturbances.STATE:
            progress["disturbances"] = self.disturbances.progress()
        if self.terrain_curriculum is not None:
            progress["terrain_curriculum"] = self.terrain_curriculum.progress()
        return progress

    def load_progress(self, progress: dict[str, Any]) -> None:
        super().load_progress(progress)
        self.disturbances.load_progress(progress.get("disturbances", {}))
        if self.terrain_curriculum is not None and "terrain_curriculum" in progress:
            self.terrain_curriculum.load_progress(progress["terrain_curriculum"])

    def parts(self) -> dict[str, Any]:
        parts = {
            **super().parts(),
            "contacts": self.contacts,
            "control": self.control,
            "pushes": self.pushes,
        }
        if self.disturbances.STATE:
            parts["disturbances"] = self.disturbances
        if self.control.actuator is not None:
            parts |= self.control.actuator.parts()
        if self.terrain_curriculum is not None:
            parts["terrain_curriculum"] = self.terrain_curriculum
        return parts


def is_robot_task(task: BaseTask) -> TypeGuard[RobotTask]:
    """Return whether a task has a robot with joints, contacts and a ground."""
    return isinstance(task, RobotTask)
