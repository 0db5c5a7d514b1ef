"""Interface of actuator models, and the registry of user-defined ones."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, is_dataclass, replace
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from legged.config.actuator import ActuatorConfig
from legged.config.checks import PLAIN, build, is_plain_name, plain_path, shown
from legged.config.origins import Origins
from legged.errors import ConfigError, suggest
from legged.mdp.kernels import Kernels
from legged.mdp.random_pool import RandomPool
from legged.robots.patterns import match_names
from legged.robots.robot import Robot

MODELS = "control.actuator.models"
"""Setting that selects user-defined models."""


class JointStep(NamedTuple):
    """One physics step of N robots with D joints."""

    target: Tensor
    """(N, D) targets of the control law: [rad] for law P, [rad/s] for V, [N m] for T."""
    dof_pos: Tensor
    """(N, D) joint angles [rad]."""
    dof_vel: Tensor
    """(N, D) joint velocities [rad/s]."""
    effort: Tensor
    """(D,) or (N, D) effort limits [N m]."""


@dataclass(frozen=True)
class Motors:
    """Motors for which an actuator model is built: those of N robots with D joints."""

    robot: Robot
    cfg: ActuatorConfig
    num_envs: int
    decimation: int
    """Number of physics steps in a control step."""
    sim_dt: float
    """Duration of a physics step [s]."""
    device: torch.device
    numbers: RandomPool
    """Pool in which a model reserves its random numbers."""
    rest: Callable[[], Tensor]
    """Function that returns the joint targets of action 0: (D,), (N, D) or ()."""
    kernels: Kernels | None = None
    origins: Origins | None = None
    """Sources of the settings, for error messages."""
    path: str = "control.actuator"
    """Dotted path of the model's settings."""

    def where(self, path: str) -> str:
        """Return the beginning of an error message about the setting at a dotted path."""
        return path if self.origins is None else self.origins.where(path)

    def zeros(self) -> Tensor:
        """Return a new tensor (N, D) of zeros."""
        return torch.zeros(self.num_envs, self.robot.num_dof, device=self.device)

    def tensor(self, values: np.ndarray) -> Tensor:
        """Return an array as a float32 tensor on the motors' device."""
        return torch.as_tensor(values, dtype=torch.float32, device=self.device)

    def each(self, table: Mapping[str, float], setting: str, otherwise: float = 0.0) -> Tensor:
        """Return a number for each joint, (D,), from joint-name patterns. The longest pattern in a joint's name decides, and
        `otherwise` is the number of joints whose names contain no pattern. `setting` is the name of the model's setting.

        Raises:
            ConfigError: a pattern matches no joint.
        """
        fallback = np.full(self.robot.num_dof, otherwise)
        return self.tensor(by_joint(table, self.robot, self.where(f"{self.path}.{setting}"), fallback))


class ActuatorModel:
    """One property of N x D motors, such as their delay, their torque-speed line, or their friction.

    Each physics step calls `targets`, then the control law, then `torques`. The models form a chain: the result of a model is
    the argument of the next. Finally torques are limited to the effort limits. The calls must keep the rules of a captured
    step: tensors keep their addresses, and the host reads no tensor. Arguments must not be changed in place.

    A user-defined model has a constructor with the arguments `settings`, an instance of `Settings`, and `motors: Motors`.
    """

    Settings: ClassVar[type]
    """Frozen dataclass of the settings of a user-defined model."""
    STATE: tuple[str, ...] = ()
    """Names of the tensors (N, ...) that a saved state of the task holds."""

    def targets(self, targets: Tensor) -> Tensor:
        """Return the targets (N, D) of the control law in this physics step."""
        return targets

    def torques(self, torques: Tensor, step: JointStep) -> Tensor:
        """Return the torques (N, D) [N m] that this model makes of `torques` (N, D) in a physics step."""
        return torques

    def reset(self, mask: Tensor) -> None:
        """Begin new episodes of the robots in `mask` (N,). Every control step calls this, also if no episode ends."""

    def describe(self, joint: int) -> str:
        """Describe in a few words how this model changes the motor of a joint; '' if it does not."""
        return ""


Model = TypeVar("Model", bound=type[ActuatorModel])
_REGISTERED: dict[str, type[ActuatorModel]] = {}


def register_actuator(name: str) -> Callable[[Model], Model]:
    """Return a decorator that registers a subclass of ActuatorModel. `control.actuator.models.<name>` then selects the model
    and has its settings.

    Raises:
        ConfigError: the name is invalid, or the class is no model or has no dataclass `Settings`.
    """
    if not isinstance(name, str) or not is_plain_name(name) or "." in name:
        raise ConfigError(f"register_actuator: the name of a model must be {PLAIN}, and no dots; got {shown(name)}")

    def register(kind: Model) -> Model:
        if not (isinstance(kind, type) and issubclass(kind, ActuatorModel)):
            raise ConfigError(f"register_actuator('{name}'): expected a subclass of ActuatorModel, got {shown(kind)}")
        if not is_dataclass(getattr(kind, "Settings", None)):
            raise ConfigError(f"register_actuator('{name}'): {kind.__name__}.Settings must be a dataclass")
        _REGISTERED[name] = kind
        return kind

    return register


def registered_models(motors: Motors) -> dict[str, ActuatorModel]:
    """Build the user-defined models of a configuration, in its order.

    Raises:
        ConfigError: a model is not registered, or its settings are invalid.
    """
    made: dict[str, ActuatorModel] = {}
    for name, given in motors.cfg.models.items():
        path = f"{MODELS}.{plain_path(name)}"
        if given is None:
            continue
        if name not in _REGISTERED:
            known = suggest(name, _REGISTERED, "models")
            raise ConfigError(
                f"{motors.where(path)}: there is no actuator model {shown(name)}{known}; --import names the module that"
                " registers it"
            )
        settings: Any = build(_REGISTERED[name].Settings, given, "control", motors.origins, path=path)
        made[name] = _REGISTERED[name](settings, replace(motors, path=path))  # type: ignore[call-arg]
    return made


def by_joint(table: Mapping[str, float], robot: Robot, where: str, otherwise: np.ndarray) -> np.ndarray:
    """Return a number for each joint, (D,). The keys of `table` are patterns. The longest pattern in a joint's name decides.
    A joint whose name contains no pattern gets its number from `otherwise` (D,).

    Raises:
        ConfigError: a pattern matches no joint.
    """
    match_names(tuple(table), robot.joint_names, where)
    found = [max((p for p in table if p in name), key=len, default=None) for name in robot.joint_names]
    return np.array([otherwise[i] if p is None else table[p] for i, p in enumerate(found)], dtype=float)


def modelled_joints(robot: Robot, cfg: ActuatorConfig, where: Callable[[str], str] = str) -> tuple[int, ...]:
    """Return the indices of the joints in control.actuator.joints, or of all joints if it is empty. The motor model and the
    network apply to these joints. `where` turns a dotted path into the beginning of an error message.

    Raises:
        ConfigError: a pattern matches no joint.
    """
    if not cfg.joints:
        return tuple(range(robot.num_dof))
    return match_names(cfg.joints, robot.joint_names, where("control.actuator.joints"))
