"""The league's course, a mix-in of a task's class: it moves the arms, punches, steers to the waypoints, and keeps scores."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor
from torch.nn.functional import normalize

from legged.envs import LeggedRobot
from legged.evaluation.league import protocol
from legged.evaluation.league.protocol import CONTROL_DT, GOAL_S, POINT_S, POINTS
from legged.evaluation.league.robot import HUMANOIDS, arm_of, arms_of
from legged.math import quat_multiply, quat_rotate, yaw_of
from legged.mdp.waypoints import approach
from legged.registry import task_class
from legged.robots.robot import Robot

STAGES = {
    "own": "the arms are as in the training",
    "held": "the arms are held at their angles of the start",
    "walking": "the arms move",
    "punches": "the arms move, and punches hit the robot",
}
"""Stage of the ladder -> what happens in it."""
FALLEN = 0.2
"""Height of the pelvis below which a run ends [m]."""
GAIN = 1.5
"""Command per distance to the waypoint and per error of the yaw [1/s]."""
REACHED, LEFT = (0.10, 0.05), (0.20, 0.12)
"""Distance [m] and error of the yaw [rad] below which the command becomes 0, and those above which it returns."""
SLOT, GOAL = round(POINT_S / CONTROL_DT), round(GOAL_S / CONTROL_DT)
"""Number of control steps for a waypoint and for a goal of the arms."""
PUNCH = (round(protocol.PUNCH_AT_S / CONTROL_DT), round((protocol.PUNCH_AT_S + protocol.PUNCH_S) / CONTROL_DT))
"""First control step of a slot with a punch, and the first one without."""


@dataclass(frozen=True)
class Course:
    """What N runs ask of a robot; it is the same for all policies."""

    robot: Robot
    arms: Sequence[int]
    """(2 K,) indices of the joints of the left and the right arm."""
    height: float
    """Height of the base at the start [m]."""
    points: np.ndarray
    """(N, POINTS, 3) waypoints."""
    goals: np.ndarray
    """(N, 1 + goals, 2 K) angles of the arms while they move."""
    punches: Sequence[protocol.Punches]
    """(N,) punches."""
    limits: np.ndarray
    """(3, 2) lowest and highest command of the policy [m/s, m/s, rad/s]."""

    @classmethod
    def of(cls, runs: Sequence[int], robot: Robot, limits: np.ndarray) -> "Course":
        """Return the course of the runs with the ids `runs`."""
        assert robot.mirror is not None
        (left, right), height = arms_of(robot), HUMANOIDS[robot.name].height or robot.file.spawn_height
        goals = protocol.arm_goals(runs, arm_of(robot))
        both = np.concatenate([goals, goals * np.array(robot.mirror.signs)[left]], axis=2)
        points = np.array([protocol.waypoints(run) for run in runs])
        punches = [protocol.punches(run, robot.num_dof) for run in runs]
        return cls(robot, [*left, *right], height, points, both, punches, limits)


def chains_of(model: mujoco.MjModel, bodies: np.ndarray) -> np.ndarray:
    """Return the joints on the way from the base to each of D joints, that joint included, (D, L). The joints turn `bodies`
    (D,). Shorter chains begin with -1.
    """
    numbers, chains = {int(body): joint for joint, body in enumerate(bodies)}, []
    for body in bodies:
        chain: list[int] = []
        while body in numbers:
            chain, body = [numbers[int(body)], *chain], model.body_parentid[body]
        chains.append(chain)
    longest = max(map(len, chains))
    return np.array([[-1] * (longest - len(chain)) + chain for chain in chains])


def make_league(course: Course, stage: str, cfg: Any, device: torch.device, graph: bool, terrain: None) -> "LeagueTask":
    """Build the task of `cfg` with a robot for each run of `course`, in the stage of this name in STAGES."""
    kind: Any = task_class(cfg.task)
    own: Any = type(f"League{kind.__name__}", (LeagueTask, kind), {"course": course, "stage": stage, "__module__": __name__})
    return own(cfg, device, graph)  # type: ignore[no-any-return]


class LeagueTask(LeggedRobot):
    """A mix-in that lets each robot run its tour. The mix-in is the first base class, before the task's class."""

    course: Course
    stage: str

    def pushed_by_forces(self) -> bool:
        return self.stage == "punches"

    def active_terminations(self) -> tuple[list[str], list[str]]:
        """Return no terminations, because a fall is a score here and does not begin a new episode."""
        return [], []

    def _init_buffers(self) -> None:
        super()._init_buffers()
        n, model, course = self.num_envs, self.physics.model, self.course

        def tensor(values: Any, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.as_tensor(np.array(values), dtype=dtype, device=torch.device(self.device))

        names = self.robot.joint_names
        self._arms = tensor(course.arms, torch.long)
        held = [(column, course.arms.index(joint)) for column, joint in enumerate(self.control.held) if joint in course.arms]
        self._held, self._of_held = tensor(held, torch.long).view(-1, 2).unbind(dim=1)
        goals = course.goals
        self._goals = tensor(goals[:, :1].repeat(goals.shape[1], axis=1) if self.stage == "held" else goals)
        self._points, self._limits = tensor(course.points), tensor(course.limits)
        self._rows = torch.arange(n, device=torch.device(self.device))
        bodies = model.jnt_bodyid[[model.joint(name).id for name in names]]
        joint = np.array([each.joint for each in course.punches])
        of_child = np.array([each.of_child for each in course.punches])
        frame = np.where(of_child, bodies[joint], model.body_parentid[bodies[joint]])
        lean, force = (tensor(values) for values in (protocol.league_frames(model), [each.force for each in course.punches]))
        self._blows = quat_rotate(lean[tensor(frame, torch.long)], force)
        self._struck, self._of_child = tensor(joint, torch.long), tensor(of_child, torch.bool)
        self._links, self._centres = tensor(bodies, torch.long), tensor(model.body_ipos[bodies])
        chains = chains_of(model, bodies)
        self._chains = tensor(np.maximum(chains, 0), torch.long)
        self._axes = tensor(model.jnt_axis[model.body_jntadr[bodies]][chains] * (chains >= 0)[..., None])
        self._near, self._far = tensor(REACHED), tensor(LEFT)
        self._reached = torch.zeros(n, 2, dtype=torch.bool, device=torch.device(self.device))
        self.alive = torch.ones(n, dtype=torch.bool, device=torch.device(self.device))
        """(N,) True until the run ends by a fall."""
        self.lasted = torch.zeros(n, dtype=torch.long, device=torch.device(self.device))
        """(N,) control steps until the fall."""
        self.missed = torch.zeros(n, POINTS, 2, device=torch.device(self.device))
        """(N, POINTS, 2) distance to the waypoint [m] and error of the yaw [rad] at the end of each slot."""
        self.energy = torch.zeros(n, device=torch.device(self.device))
        """(N,) sum of |torque * joint velocity| over joints and control steps, times the control step [J]."""

    def reset(self) -> TensorDict:
        self.alive.fill_(True)
        for score in (self.lasted, self.missed, self.energy):
            score.zero_()
        return super().reset()

    def place(self) -> None:
        self.reset_qpos[:, :2].zero_()
        self.reset_qpos[:, 2].fill_(self.course.height)
        self.reset_qpos[:, 3].fill_(1.0)
        self.reset_qpos[:, 4:7].zero_()
        self.reset_qpos[:, 7:].copy_(self.default_dof_pos.expand(self.num_envs, -1))
        self.reset_qvel.zero_()

    def set_controls(self) -> None:
        super().set_controls()
        if self.stage != "own":
            self.control.aim(self._arms, self._arm_targets())

    def _arm_targets(self) -> Tensor:
        """Return the targets of the left and the right arm in the next control step, (N, 2 K) [rad]."""
        step = self.episode_length_buf.clamp(max=POINTS * SLOT - 1)
        goal, share = step // GOAL, ((step % GOAL + 1) / GOAL * (step > 0)).unsqueeze(1)  # still at the first step
        last = self._goals[self._rows, goal]
        return last + share * (self._goals[self._rows, goal + 1] - last)

    def apply_control(self) -> None:
        super().apply_control()
        if self.stage == "punches":
            self._punch()

    def _punch(self) -> None:
        """Set the external forces of a physics step. The struck link turns, and so does the force."""
        forces = self.physics.forces
        assert forces is not None
        slot, step = self._slot(), self.episode_length_buf % SLOT
        struck = self._struck[self._rows, slot]
        half = 0.5 * self.dof_pos.gather(1, self._chains[struck]).unsqueeze(2)
        turns = torch.cat([torch.cos(half), torch.sin(half) * self._axes[struck]], dim=2)
        parent = child = self.physics.qpos[:, 3:7]
        for turn in turns.unbind(dim=1):
            # A chain begins with fillers, whose axes are zero. They have to leave the orientation as it is.
            parent, child = child, quat_multiply(child, normalize(turn, dim=1))
        frame = torch.where(self._of_child[self._rows, slot].unsqueeze(1), child, parent)
        active = ((step >= PUNCH[0]) & (step < PUNCH[1])).unsqueeze(1)
        force = active * quat_rotate(frame, self._blows[self._rows, slot])
        arm = quat_rotate(child, self._centres[struck])
        forces.zero_()
        forces[self._rows, self._links[struck]] = torch.cat([force, torch.linalg.cross(-arm, force)], dim=1)

    def _slot(self) -> Tensor:
        """Return the index of each robot's waypoint, (N,)."""
        return (self.episode_length_buf // SLOT).clamp(max=POINTS - 1)

    def advance(self) -> None:
        super().advance()
        self.lasted.add_(self.alive)
        power = (self.torques * self.dof_vel).abs().sum(dim=1)
        self.energy.add_(torch.where(self.alive, power * self.dt, 0.0))
        self.alive.logical_and_(self.base_pos[:, 2] >= FALLEN)  # false for NaN

    def ask(self) -> None:
        super().ask()
        slot, step = self._slot(), self.episode_length_buf % SLOT
        self.alive.logical_and_(~self.reset_buf | (self.lasted == 0))  # a reset ends the run of a state that diverged
        pose = torch.cat([self.base_pos[:, :2], yaw_of(self.base_quat).unsqueeze(1)], dim=1)
        point = self._points[self._rows, slot]
        commands, missed = approach(point, pose, self._reached, step > 0, self._near, self._far, GAIN)
        walks = self.alive & (self.episode_length_buf < POINTS * SLOT)
        self.missed[self._rows, slot] = torch.where(walks.unsqueeze(1), missed, self.missed[self._rows, slot])
        self.command_sampler.hold(commands.clamp(self._limits[:, 0], self._limits[:, 1]))
        self.base_sampler.hold()
        if self.stage != "own":  # a policy may observe the targets of held joints
            targets = self._arm_targets() - self.default_dof_pos[self._arms]
            self.control.held_offsets.index_copy_(1, self._held, targets.index_select(1, self._of_held))
