"""The states of the program and how one leads to another."""

from enum import Enum


class State(Enum):
    """What the robot is being asked for."""

    IDLE = "idle"
    """No torque."""
    DAMPING = "damping"
    """Joints are braked: the robot sinks to the ground."""
    STAND = "stand"
    """Joints move to the default pose, and hold it."""
    WALK = "walk"
    """The policy acts."""
    STOP = "stop"
    """Joints are braked because something is wrong; only the operator leads out of it."""


class Event(Enum):
    """What the operator asks for, or the watch."""

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
"""(state, event) -> the next state; what is not here is refused."""
MOVING = (State.STAND, State.WALK)
"""States in which the robot must be healthy."""


def next_state(state: State, event: Event) -> State | None:
    """Return the state that an event leads to; None if it leads nowhere from here."""
    return TRANSITIONS.get((state, event))
