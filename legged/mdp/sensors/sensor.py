"""Interface of sensors."""

from abc import ABC, abstractmethod


class Sensor(ABC):
    """A measurement of N robots, which terms read as tensors with N rows.

    `make_sensors` of the task returns the sensors. The task updates them whenever the state of the physics has changed: after
    the physics steps of a control step, and again after resets. So an update must follow from the state alone, and keep the
    rules of a captured step: results are written in place, and the host reads no tensor.
    """

    STATE: tuple[str, ...] = ()
    """Names of the tensors (N, ...) that a saved state of the task holds, for a sensor with a memory."""

    @abstractmethod
    def update(self) -> None:
        """Measure the present state, which `physics.refresh` has made up to date."""
