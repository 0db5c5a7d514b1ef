"""Disturbances: kicks of the base and forces on bodies, at random intervals for each robot, and goals of held joints."""

from collections.abc import Sequence

import torch
from torch import Tensor

from legged.config.randomization import DrawConfig, ForceConfig, KickConfig
from legged.config.robot import RobotDomainRandConfig
from legged.math import masked_set_, quat_rotate, uniform
from legged.mdp.distributions import Distributions
from legged.mdp.held_goals import HeldGoals
from legged.mdp.kernels import Kernels
from legged.mdp.random_pool import RandomPool
from legged.mdp.sensors import BodyStates
from legged.physics import Physics
from legged.robots.patterns import match_names

AXES = ("x", "y", "z")
TURNS = ("roll", "pitch", "yaw")


def _columns(
    cfg: KickConfig | ForceConfig, names: tuple[str, ...], times: tuple[str, ...]
) -> tuple[list[DrawConfig], list[float]]:
    """Return the distribution of each random column of a disturbance, and the value that each range starts from. The first
    columns are the components `names`, whose ranges may widen from 0. The last columns are `times`, with constant ranges.
    """
    columns = [DrawConfig(range=getattr(cfg, name), grow=cfg.grow) for name in names]
    columns += [DrawConfig(range=getattr(cfg, name)) for name in times]
    return columns, [0.0] * len(names) + [getattr(cfg, name)[0] for name in times]


class Kicks:
    """Kicks: sudden changes of the base's velocity at random intervals."""

    STATE = ("time_left",)
    WIDTH = 7
    """Number of random columns of a kick: 6 for the change of velocity, 1 for the time until the next kick."""

    def __init__(self, cfg: KickConfig, dt: float, time_left: Tensor) -> None:
        """Draw the times of the first kicks, between 0 and the longest interval. `dt` is the control step [s]; `time_left`
        (N,) is written in place.
        """
        self.columns, self.start = _columns(cfg, (*AXES, *TURNS), ("interval_s",))
        """Distribution of each random column, and the value that its range starts from."""
        self._dt = dt
        self.time_left = time_left
        """(N,) time until the next kick [s]."""
        time_left.copy_(uniform(0.0, cfg.interval_s[1], (len(time_left),), time_left.device))

    def take(self, drawn: Tensor) -> None:
        """Use the tensor `drawn` (N, 7), which holds each robot's next kick: the change of velocity [m/s, rad/s], and the
        interval between this kick and the one after it [s].
        """
        self.velocity, self._next = drawn[:, :6], drawn[:, 6]

    def act(self, physics: Physics, mask: Tensor) -> None:
        """Kick the robots that are due, but only robots in `mask` (N,)."""
        self.time_left.sub_(self._dt)
        due = (self.time_left <= 0.5 * self._dt) & mask
        physics.push(due, self.velocity)
        masked_set_(self.time_left, due, self._next)


class Forces:
    """Pushes: a force on one body for a duration, at random intervals."""

    STATE: tuple[str, ...] = ("left", "force")
    WIDTH = 5
    """Number of random columns of a push: 3 for the force, 1 for the interval, 1 for the duration."""

    def __init__(self, cfg: ForceConfig, body: int, dt: float, left: Tensor, force: Tensor) -> None:
        """Push the body with index `body` in the model. The first pushes begin at random times within the longest interval.
        `dt` is the control step [s]; `left` (N, 2) and `force` (N, 3) are written in place.
        """
        self.columns, self.start = _columns(cfg, AXES, ("interval_s", "duration_s"))
        """Distribution of each random column, and the value that its range starts from."""
        self._any_direction = cfg.size != (0.0, 0.0)
        if self._any_direction:  # size, z of the direction, and its angle about z; `turn` converts them to a force
            spans = (DrawConfig(range=span) for span in ((-1.0, 1.0), (-torch.pi, torch.pi)))
            self.columns[:3] = [DrawConfig(range=cfg.size, grow=cfg.grow), *spans]
        self._dt, self.body = dt, body
        self.left, self.force = left, force
        """`left` (N, 2): time until the current push ends, and time until the next push begins [s]. `force` (N, 3): force of
        the current push in the world frame [N], or 0."""
        left[:, 1] = uniform(0.0, cfg.interval_s[1], (len(left),), left.device)

    def take(self, drawn: Tensor) -> None:
        """Use the tensor `drawn` (N, 5), which holds each robot's next push: its force [N], interval [s] and duration [s]."""
        self.drawn = drawn

    def turn(self) -> None:
        """Convert the first three numbers of each next push to a force, if they are a size and a direction."""
        if self._any_direction:
            size, z, angle = self.drawn[:, :3].unbind(dim=1)
            across = size * (1.0 - z.square()).clamp(min=0.0).sqrt()
            self.drawn[:, :3].copy_(torch.stack([across * angle.cos(), across * angle.sin(), size * z], dim=1))

    def act(self, physics: Physics, mask: Tensor) -> None:
        """Begin the pushes that are due. End the pushes whose time is over, and every push on a robot outside `mask` (N,)."""
        assert physics.forces is not None
        self._advance(mask)
        physics.forces[:, self.body, :3].add_(self.force)

    def _advance(self, mask: Tensor) -> Tensor:
        """Update `left` and `force` by a control step. Return the robots whose next push begins, (N,)."""
        self.left.sub_(self._dt)
        passed = self.left <= 0.5 * self._dt
        due = passed[:, 1] & mask
        self.force.masked_fill_((passed[:, 0] | ~mask).unsqueeze(1), 0.0)
        masked_set_(self.force, due, self.drawn[:, :3])
        lasting = self.drawn[:, 4].clamp(min=self._dt)
        masked_set_(self.left, due, torch.stack([lasting, self.drawn[:, 3] + lasting], dim=1))
        return due


class JointForces(Forces):
    """Pushes at joints: each acts on the child body of a random joint, at the joint's anchor."""

    STATE = (*Forces.STATE, "joint")
    WIDTH = 6
    """Number of random columns of a push: those of `Forces`, and 1 for the joint."""

    def __init__(
        self,
        cfg: ForceConfig,
        joints: Sequence[str],
        physics: Physics,
        dt: float,
        left: Tensor,
        force: Tensor,
        kernels: Kernels | None = None,
    ) -> None:
        """Push at the joints with the names `joints` (J,) in the model. Other parameters are those of `Forces`."""
        super().__init__(cfg, 0, dt, left, force)
        self.columns.append(DrawConfig(range=(0.0, float(len(joints)))))
        self.start.append(0.0)
        model, device = physics.model, left.device
        numbers = [int(model.joint(name).id) for name in joints]
        bodies = model.jnt_bodyid[numbers]
        self._bodies = torch.as_tensor(bodies, dtype=torch.long, device=device)
        self._arms = torch.as_tensor(model.jnt_pos[numbers] - model.body_ipos[bodies], dtype=torch.float32, device=device)
        self._states = BodyStates(physics, [model.body(k).name for k in bodies], kernels)
        self.joint = torch.zeros(len(left), dtype=torch.long, device=device)
        """(N,) index of the joint of the current push, from 0 to J - 1."""

    def act(self, physics: Physics, mask: Tensor) -> None:
        assert physics.forces is not None
        masked_set_(self.joint, self._advance(mask), self.drawn[:, 5].long().clamp(max=len(self._bodies) - 1))
        self._states.update()
        quat = torch.take_along_dim(self._states.quat, self.joint.view(-1, 1, 1), dim=1).squeeze(1)
        arm = quat_rotate(quat, self._arms.index_select(0, self.joint))
        wrench = torch.cat([self.force, torch.linalg.cross(arm, self.force)], dim=1).unsqueeze(1)
        places = self._bodies.index_select(0, self.joint).view(-1, 1, 1).expand_as(wrench)
        physics.forces.scatter_add_(1, places, wrench)


class Disturbances:
    """All kicks and forces of a task, and the goals of held joints. The values of kicks and of forces on bodies are columns
    of common tensors, so that one kernel launch handles all of these.
    """

    def __init__(
        self,
        cfg: RobotDomainRandConfig,
        physics: Physics,
        dt: float,
        steps_per_iteration: int,
        numbers: RandomPool,
        kernels: Kernels | None = None,
        joint_names: Sequence[str] = (),
        goals: HeldGoals | None = None,
    ) -> None:
        """Build the kicks and forces that `cfg` names. `dt` is the control step [s]. `steps_per_iteration`, the number of
        control steps in a training iteration, converts `grow` [iterations] to control steps. Random numbers come from the
        pool `numbers`. `joint_names` are the joints at which forces may act. `goals` move held joints; None holds them still.
        """
        self._dt, self._kernels, self._goals = dt, kernels, goals
        num_envs, device = numbers.num_envs, numbers.device
        self._time_left = torch.zeros(num_envs, len(cfg.kicks), device=device)
        self._left = torch.zeros(num_envs, 2 * len(cfg.forces), device=device)
        self._force = torch.zeros(num_envs, 3 * len(cfg.forces), device=device)
        self.kicks = {name: Kicks(kick, dt, self._time_left[:, k]) for k, (name, kick) in enumerate(cfg.kicks.items())}
        """Name -> kicks of the base."""
        self.forces: dict[str, Forces] = {}
        """Name -> force that acts on a body. Those at joints come last, because the kernel does not handle them."""
        for k, (name, force) in enumerate(sorted(cfg.forces.items(), key=lambda entry: bool(entry[1].joints))):
            state = self._left[:, 2 * k : 2 * k + 2], self._force[:, 3 * k : 3 * k + 3]
            if force.joints:
                found = match_names(force.joints, joint_names, f"domain_rand.forces.{name}.joints")
                self.forces[name] = JointForces(force, [joint_names[i] for i in found], physics, dt, *state, kernels)
            else:
                self.forces[name] = Forces(force, body_number(physics, force.body), dt, *state)
        self.STATE: tuple[str, ...] = ()
        """Names of the tensors that are saved; empty without disturbances."""
        moving = () if goals is None else (goals,)
        self._all: tuple[Kicks | Forces | HeldGoals, ...] = (*self.kicks.values(), *self.forces.values(), *moving)
        if not self._all:
            return
        self.steps = torch.zeros((), device=device)
        """() control steps since training began, which determine how far ranges have widened."""
        self.STATE = ("steps",)
        for k, part in enumerate(self._all):
            for name in part.STATE:
                setattr(self, f"{name}_{k}", getattr(part, name))
                self.STATE = (*self.STATE, f"{name}_{k}")
        columns = [column for part in self._all for column in part.columns]
        start = [value for part in self._all for value in part.start]
        self._draws = Distributions(columns, start, device, steps_per_iteration, within=False)
        self._even = self._draws.ask(numbers)
        self._drawn = torch.zeros(num_envs, len(columns), device=device)
        for part, drawn in zip(self._all, self._drawn.split([part.WIDTH for part in self._all], dim=1), strict=True):
            part.take(drawn)
        at_joints = [force for force in self.forces.values() if isinstance(force, JointForces)]
        bodies = [force.body for force in self.forces.values() if not isinstance(force, JointForces)]
        self._bodies = torch.tensor(bodies, dtype=torch.int32, device=device)
        self._in_torch: tuple[Kicks | Forces | HeldGoals, ...] = self._all if kernels is None else (*at_joints, *moving)
        self._clear = bool(self.forces) and (kernels is None or not bodies)
        self._due = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self._velocity = torch.zeros(num_envs, 6, device=device)
        self._no_forces = torch.zeros(num_envs, 0, 6, device=device)

    def draw(self) -> None:
        """Draw the next disturbances of every robot. This runs in parallel with other parts of the step, and does nothing if
        there are no disturbances.
        """
        if self._all:
            self._drawn.copy_(self._draws.values(self._even.values, self.steps))
            for force in self.forces.values():
                force.turn()

    def act(self, physics: Physics, mask: Tensor) -> None:
        """Apply all disturbances that are due. They affect only robots in `mask` (N,), whose episodes continue."""
        if not self._all:
            return
        if self._kernels is not None:
            forces = self._no_forces if physics.forces is None else physics.forces
            state = (self._time_left, self._left, self._force, self.steps.view(1))
            found = (self._due, self._velocity, forces)
            dim, times = (len(mask), max(forces.shape[1], 1)), (self._dt, 0.5 * self._dt)
            self._kernels.launch("disturb", dim, mask, self._drawn, *times, self._bodies, *state, *found)
            if self.kicks:
                physics.push(self._due, self._velocity)
        else:
            self.steps.add_(1.0)
        if self._clear:
            assert physics.forces is not None
            physics.forces.zero_()
        for part in self._in_torch:
            part.act(physics, mask)

    def end(self, physics: Physics) -> None:
        """End all pushes, and hold joints at their default angles. The task calls this outside a step, when all robots begin
        a new episode.
        """
        if physics.forces is not None:
            physics.forces.zero_()
        for force in self.forces.values():
            force.force.zero_()
        if self._goals is not None:
            self._goals.end()

    def progress(self) -> dict[str, Tensor]:
        """Return the number of control steps since training began; {} if there are no disturbances."""
        return {"steps": self.steps.clone()} if self._all else {}

    def load_progress(self, progress: dict[str, Tensor]) -> None:
        """Continue from the number of control steps in `progress`."""
        if "steps" in progress and self._all:
            self.steps.copy_(progress["steps"])


def body_number(physics: Physics, name: str) -> int:
    """Return the index of a body in the physics' model. An empty name means the floating base."""
    return int(physics.model.jnt_bodyid[0]) if not name else int(physics.model.body(name).id)
