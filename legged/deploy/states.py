"""States of the program and the transitions between them."""

from enum import Enum


class State(Enum):
    """State of the program."""

    IDLE = "idle"
    """No torque."""
    DAMPING = "damping"
    """Joints are braked: the robot sinks to the ground."""
    STAND = "stand"
    """Joints move to the default pose, and hold it."""
    WALK = "walk"
    """The policy acts."""
    STOP = "stop"
    """Joints are braked after a fault; only the operator can leave this state."""


class Event(Enum):
    """Request of the operator or of the safety checks."""

    IDLE = "idle"
    DAMPING = "damping"
    STAND = "stand"
    WALK = "walk"
    STOP = "stop"
    QUIT = "quit"


TRANSITIONS = {
    (State.IDLE, Event.DAMPING): State.DAMPING,
    (State.DAMPING, Event.IDLE): State.IDLE,
    (State.DAMPING, Event.STAND): State.STAND,
    (State.STAND, Event.DAMPING): State.DAMPING,
    (State.STAND, Event.WALK): State.WALK,
    (State.WALK, Event.STAND): State.STAND,
    (State.WALK, Event.DAMPING): State.DAMPING,
    (State.STOP, Event.DAMPING): State.DAMPING,
    **{(state, Event.STOP): State.STOP for state in State},
}
"""(state, event) -> the next state; all other pairs are refused."""
MOVING = (State.STAND, State.WALK)
"""States in which the safety checks can stop the robot."""


def next_state(state: State, event: Event) -> State | None:
    """Return the state after an event; None if the event is refused in this state."""
    return TRANSITIONS.get((state, event))
