"""Settings of real motors: speed-dependent torque limits, friction, delay, and learned actuators."""

from dataclasses import dataclass, field
from typing import Any, Literal

from legged.config.bounds import LARGEST, TERMS, between, positive, quantity

MOTORS = "motors.npz"
"""Name of the file to which a run folder and an export copy the learned actuator (`ActuatorConfig.network`)."""
LONGEST_DELAY = 1000
"""Largest allowed delay. A motor's delay is counted in physics steps, an observation's delay in control steps."""
Steps = tuple[int, int]
"""Smallest and largest number of steps."""


@dataclass(frozen=True)
class ActuatorConfig:
    """Model of the motors, which turn targets into joint torques. By default motors are ideal: they give the torque of the
    control law at once, up to their effort limit.
    """

    model: Literal["ideal", "dc_motor"] = "ideal"
    """Torque limit of a motor. `ideal`: the effort limit at any speed. `dc_motor`: at the velocity v, the torque is between
    `stall_torque * (-1 - v / no_load_speed)` and `stall_torque * (1 - v / no_load_speed)`, and within the effort limit."""
    joints: tuple[str, ...] = field(default=(), metadata=TERMS)
    """Name patterns of the joints with this `model` and `network`; empty means all joints. All other joints have
    `model: ideal` and no network."""
    stall_torque: dict[str, float] = field(default_factory=dict, metadata=quantity("N m", positive(LARGEST)))
    """Joint-name pattern -> torque of a blocked motor (dc_motor) [N m]; by default the joint's effort limit."""
    no_load_speed: dict[str, float] = field(default_factory=dict, metadata=quantity("rad/s", positive(LARGEST)))
    """Joint-name pattern -> speed at which the motor gives no torque (dc_motor) [rad/s]; by default the joint's velocity
    limit."""
    armature: dict[str, float] = field(default_factory=dict, metadata=quantity("kg m^2", between(0, LARGEST)))
    """Joint-name pattern -> inertia of rotor and gear about the joint [kg m^2], for every `model`; by default the value in
    the robot's file."""
    coulomb_friction: dict[str, float] = field(default_factory=dict, metadata=quantity("N m", between(0, LARGEST)))
    """Joint-name pattern -> friction of a moving joint, independent of its speed [N m]; by default 0."""
    breakaway_friction: dict[str, float] = field(default_factory=dict, metadata=quantity("N m", between(0, LARGEST)))
    """Joint-name pattern -> friction that a joint must overcome to begin to move (Stribeck) [N m]; by default the joint's
    Coulomb friction."""
    stribeck_velocity: float = field(default=0.1, metadata=quantity("rad/s", positive(1000, low=1e-4)))
    """Speed at which friction has fallen 63 % of the way from breakaway to Coulomb friction [rad/s]."""
    viscous_friction: dict[str, float] = field(default_factory=dict, metadata=quantity("N m s/rad", between(0, LARGEST)))
    """Joint-name pattern -> friction proportional to the speed [N m s/rad]; by default 0."""
    friction_smoothing: float = field(default=0.1, metadata=quantity("rad/s", positive(1000, low=1e-4)))
    """Speed v0 below which Coulomb friction fades [rad/s]. At the speed v, Coulomb friction has the factor `tanh(v / v0)`."""
    delay: Steps = field(default=(0, 0), metadata=between(0, LONGEST_DELAY))
    """Range of the delay of targets, in physics steps (sim.dt). In each episode, each robot has its own delay."""
    delay_varies: bool = False
    """True: a new delay is sampled for each robot in every control step. An older target never replaces a newer one."""
    network: str = ""
    """File of a learned actuator (`legged fit-actuator`), relative to the configuration file. The network in this file
    computes the torque from target, angle and velocity, in place of the P law."""
    models: dict[str, Any] = field(default_factory=dict)
    """User-defined model (`register_actuator`) -> its settings; null switches an inherited model off. The models follow the
    built-in ones, in this order."""
