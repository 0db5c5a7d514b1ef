"""A robot in virtual time for tests of the program, and exported policies to run on it."""

from dataclasses import replace

import numpy as np
from helpers import small_config, small_task

from legged.deploy.interface import Interface, Reading, RobotFacts
from legged.deploy.operators import Event, Operator, Orders
from legged.deploy.policy import Policy
from legged.deploy.program import Program
from legged.learning.runner import Runner
from legged.policies.export import export

PROPRIOCEPTION = ["base_ang_vel", "projected_gravity", "commands", "dof_pos", "dof_vel", "actions"]
WALKS = {0.0: Event.DAMPING, 0.5: Event.STAND, 3.0: Event.WALK}
"""From 3 s on the policy acts."""
COMMANDS = [  # not the same to both sides
    ("commands.ranges.lin_vel_x", [-0.6, 1.1]),
    ("commands.ranges.lin_vel_y", [-0.4, 0.4]),
    ("commands.ranges.ang_vel_yaw", [-0.7, 0.7]),
]
SMALL = [("train.policy.actor_hidden_dims", [16, 8]), ("train.policy.critic_hidden_dims", [8]), *COMMANDS]
BLIND = [("observations.groups.actor.terms", PROPRIOCEPTION), ("observations.groups.actor.history", 2)]


def exported(folder, *changes):
    """The folder with a fresh policy of anymal_c_flat that needs nothing but sensors, unless `changes` say otherwise."""
    changes = (*SMALL, *(changes or BLIND))
    task, trained = small_task(*changes, num_envs=1), small_config(*changes, ("observations.add_noise", True))
    export(task, Runner(task).alg.get_policy(), folder, trained=trained)
    return folder


def facts_for(contract, **changes):
    """The facts of a robot that fits a contract, but for the `changes`."""
    facts = RobotFacts(
        name="still",
        joint_names=contract.joint_names,
        position_limits=contract.position_limits,
        velocity_limits=contract.velocity_limits,
        torque_limits=contract.torque_limits,
        imu_body=contract.imu_body,
    )
    return replace(facts, **changes)


class Time:
    """A clock that goes on only when somebody sleeps, or is kept busy."""

    def __init__(self):
        self.now = 100.0

    def clock(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


class StillRobot(Interface):
    """A robot whose joints are where they were asked to be at once; `change` makes of a reading another, or several."""

    def __init__(self, contract, time, facts=None):
        self.facts = facts or facts_for(contract)
        self.time, self.change = time, lambda reading: reading
        self.positions = contract.default + 0.1
        self.written, self.asked, self.closed, self.silent = [], None, False, False

    def ask(self, sources):
        self.asked = sources

    def read(self):
        if self.silent:
            return []
        now = self.time.now
        still = np.zeros(len(self.positions))
        reading = Reading(now, now, np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3), self.positions.copy(), still, torques=still)
        changed = self.change(reading)
        return changed if isinstance(changed, list) else [changed]

    def write(self, positions, stiffness, damping):
        self.written.append((self.time.now, positions.copy(), stiffness.copy(), damping.copy()))
        if stiffness.any():
            self.positions = positions.copy()

    def close(self):
        self.closed = True


class Says(Operator):
    """An operator who asks for something at some moments: {seconds: event or velocity}, and does something else at others."""

    def __init__(self, plan, does=None):
        self.plan, self.does = dict(plan), dict(does or {})
        self.velocity, self.lost, self.closed = np.zeros(3), None, False

    def poll(self, seconds):
        for moment in [moment for moment in self.does if moment <= seconds + 1e-9]:
            self.does.pop(moment)()
        events = []
        for moment in [moment for moment in self.plan if moment <= seconds + 1e-9]:
            wanted = self.plan.pop(moment)
            if isinstance(wanted, tuple):
                self.velocity = np.array(wanted, dtype=float)
            else:
                events.append(wanted)
        return Orders(self.velocity, tuple(events), lost=self.lost)

    def close(self):
        self.closed = True


class Stage:
    """A program in virtual time: `run(plan)` runs it to its end."""

    def __init__(self, folder, facts=None):
        self.time = Time()
        self.policy = Policy(folder)
        self.robot = StillRobot(self.policy.contract, self.time, facts)
        self.told = []

    def run(self, plan, does=None, seconds=20.0, stand_s=2.0, **settings):
        self.operator = Says(plan, does)
        clocks = {"clock": self.time.clock, "sleep": self.time.sleep, "tell": self.told.append, "stand_s": stand_s}
        self.program = Program(self.policy, self.robot, self.operator, **clocks, **settings)
        self.program.run(seconds)
        return self.program


def spoil(**changes):
    """A change of readings: name of a field -> what makes it of a reading."""
    return lambda reading: replace(reading, **{name: make(reading) for name, make in changes.items()})


def tilted(angle):
    """A change by which the base leans to a side [rad]."""
    return spoil(quaternion=lambda _: np.array([np.cos(0.5 * angle), np.sin(0.5 * angle), 0.0, 0.0]))


def with_one(name, value):
    """A change of the second number of a field."""

    def make(reading):
        values = getattr(reading, name).copy()
        values[1] = value
        return values

    return spoil(**{name: make})
