"""How motors differ from ideal ones: what they can give at a speed, friction behind them, delay, and laws that were
learned.
"""

from dataclasses import dataclass, field
from typing import Literal

from legged.config.bounds import LARGEST, TERMS, between, positive, quantity

MOTORS = "motors.npz"
"""What a copy of `network` is called in a run folder, and beside the policy.json of an export."""
LONGEST_DELAY = 1000
"""Steps of a delay, at most."""
Steps = tuple[int, int]
"""Fewest and most steps."""


@dataclass(frozen=True)
class ActuatorConfig:
    """What becomes of a target between the policy and the joint. By default motors are ideal: they give what the control law
    asks for, at once, up to their effort limit.
    """

    model: Literal["ideal", "dc_motor"] = "ideal"
    """What a motor can give: its effort limit at any speed, or less the faster it turns (`dc_motor`): between
    stall_torque * (1 - v / no_load_speed) and stall_torque * (-1 - v / no_load_speed) at the velocity v, and never more than
    the effort limit."""
    joints: tuple[str, ...] = field(default=(), metadata=TERMS)
    """Patterns of the joints that have this `model` and `network`; empty means all of them. The others have ideal motors."""
    stall_torque: dict[str, float] = field(default_factory=dict, metadata=quantity("N m", positive(LARGEST)))
    """Joint-name pattern -> torque of a motor that is held still (dc_motor) [N m]; joints that are not named have their
    effort limit."""
    no_load_speed: dict[str, float] = field(default_factory=dict, metadata=quantity("rad/s", positive(LARGEST)))
    """Joint-name pattern -> speed at which the motor gives no torque (dc_motor) [rad/s]; joints that are not named have their
    velocity limit."""
    armature: dict[str, float] = field(default_factory=dict, metadata=quantity("kg m^2", between(0, LARGEST)))
    """Joint-name pattern -> inertia of rotor and gear as the joint turns them, in any `model` [kg m^2]; that of the robot's
    file where not named."""
    coulomb_friction: dict[str, float] = field(default_factory=dict, metadata=quantity("N m", between(0, LARGEST)))
    """Joint-name pattern -> friction of a moving joint at any speed [N m]; 0 where not named."""
    breakaway_friction: dict[str, float] = field(default_factory=dict, metadata=quantity("N m", between(0, LARGEST)))
    """Joint-name pattern -> friction that a joint must overcome to begin to move (Stribeck) [N m]; the Coulomb friction where
    not named."""
    stribeck_velocity: float = field(default=0.1, metadata=quantity("rad/s", positive(1000, low=1e-4)))
    """Speed at which the friction has come down from breakaway to Coulomb by 63 % [rad/s]."""
    viscous_friction: dict[str, float] = field(default_factory=dict, metadata=quantity("N m s/rad", between(0, LARGEST)))
    """Joint-name pattern -> friction that grows with the speed [N m s/rad]; 0 where not named."""
    friction_smoothing: float = field(default=0.1, metadata=quantity("rad/s", positive(1000, low=1e-4)))
    """Speed below which Coulomb friction fades: it goes with tanh(v / friction_smoothing) [rad/s]."""
    delay: Steps = field(default=(0, 0), metadata=between(0, LONGEST_DELAY))
    """Range from which each robot's delay of targets is drawn at the start of an episode, in physics steps (sim.dt)."""
    delay_varies: bool = False
    """Draw each robot's delay anew in every control step; a target that has arrived is then not taken back for an older one.
    """
    network: str = ""
    """File of a learned actuator (`legged fit-actuator`), relative to the file that names it: torque from
    target, angle and velocity, in place of the P law."""
