"""Actuators: the chain of models between joint targets and joint torques."""

from collections.abc import Callable

import torch
from torch import Tensor

from legged.config.actuator import ActuatorConfig
from legged.config.origins import Origins
from legged.config.robot import RobotControlConfig
from legged.errors import ConfigError
from legged.mdp.actuators.delay import Delay
from legged.mdp.actuators.friction import Friction, friction_numbers
from legged.mdp.actuators.model import ActuatorModel, JointStep, Motors, modelled_joints, registered_models
from legged.mdp.actuators.motor_curve import IdealMotor, MotorCurve, check_line, motor_numbers, with_rotors
from legged.mdp.actuators.network import LearnedTorque, NetworkWeights
from legged.mdp.random_pool import RandomPool
from legged.robots.robot import Robot


def is_ideal(cfg: ActuatorConfig) -> bool:
    """Return True if motors give the torque of the control law without delay and losses, up to their effort limit."""
    own = any(settings is not None for settings in cfg.models.values())
    return cfg.model == "ideal" and not has_friction(cfg) and cfg.delay == (0, 0) and not cfg.network and not own


def has_friction(cfg: ActuatorConfig) -> bool:
    """Return True if any joint has friction."""
    return any(any(table.values()) for table in (cfg.coulomb_friction, cfg.breakaway_friction, cfg.viscous_friction))


class Actuator:
    """Actuators of N robots with D joints: a chain of models. The built-in models come first: delay, network, motor and
    friction. The user-defined models follow, in the order of the configuration.
    """

    STATE: tuple[str, ...] = ("targets", "delay")

    def __init__(self, motors: Motors) -> None:
        """Build the models of the configuration.

        Raises:
            ConfigError: as for `check_actuator`.
        """
        cfg, self._kernels = motors.cfg, motors.kernels
        self.line = Delay(motors)
        """Targets on their way to the control law."""
        self.curve = MotorCurve.of(motors)
        self.friction = Friction.of(motors)
        self.learned = LearnedTorque.of(motors) if cfg.network else None
        self.own = registered_models(motors)
        """Name -> user-defined model."""
        built_in: list[ActuatorModel] = [self.line] if self.line.longest else []
        if self.learned is not None:
            built_in.append(self.learned)
            self.STATE = (*self.STATE, "past")
        self._has_friction = has_friction(cfg)
        if cfg.model == "dc_motor":
            built_in.append(self.curve)
        elif self._has_friction or self.own:
            built_in.append(IdealMotor())
        if self._has_friction:
            built_in.append(self.friction)
        self.models = (*built_in, *self.own.values())
        """Models that change something, in the order of the chain."""
        moves_targets = any(type(model).targets is not ActuatorModel.targets for model in self.own.values())
        self._fuses = motors.kernels is not None and self.learned is None and not moves_targets

    @property
    def targets(self) -> Tensor:
        """(K, N, D) targets of the last K control steps, newest first."""
        return self.line.kept

    @property
    def delay(self) -> Tensor:
        """(N,) delay of each robot, in physics steps."""
        return self.line.steps

    @property
    def past(self) -> Tensor:
        """State of the network. Saved states hold it under the name `past`."""
        assert self.learned is not None
        return self.learned.network.state

    def parts(self) -> dict[str, "Actuator | ActuatorModel"]:
        """Return name in saved states -> object whose `STATE` lists the saved tensors."""
        return {"actuator": self, **{f"actuator_{name}": model for name, model in self.own.items() if model.STATE}}

    def describe(self, joint: int) -> str:
        """Describe in a few words how a joint's motor differs from an ideal motor."""
        models = (self.learned, self.curve, self.friction, self.line, *self.own.values())
        return ", ".join(filter(None, (model.describe(joint) for model in models if model is not None))) or "ideal motor"

    def drive(
        self,
        dof_pos: Tensor,
        dof_vel: Tensor,
        law: Callable[[Tensor], Tensor],
        gains: tuple[Tensor, Tensor] | None,
        effort: Tensor,
        out: Tensor,
    ) -> None:
        """Write to `out` the torques (N, D) [N m] of one physics step, at joint angles [rad] and velocities [rad/s], (N, D)
        each.

        `law` computes the commanded torques (N, D) from targets (N, D). For the P law, `gains` are its stiffness and damping.
        `effort` holds the effort limits of the joints [N m]. Gains and limits are (D,) or (N, D).
        """
        if self._fuses and gains is not None:
            self._drive_built_in(dof_pos, dof_vel, gains, effort, out)
            rest, torques = tuple(self.own.values()), out
            target = self.line.targets(self.line.newest) if rest else self.line.newest
        else:
            rest, target = self.models, self.line.newest
            for model in self.models:
                target = model.targets(target)
            torques = law(target)
        if rest or torques is not out:
            step = JointStep(target, dof_pos, dof_vel, effort)
            for model in rest:
                torques = model.torques(torques, step)
            torch.clamp(torques, -effort, effort, out=out)
        self.line.age += 1

    def _drive_built_in(
        self, dof_pos: Tensor, dof_vel: Tensor, gains: tuple[Tensor, Tensor], effort: Tensor, out: Tensor
    ) -> None:
        """Write to `out` the torques (N, D) of the P law and the built-in models, by one kernel."""
        assert self._kernels is not None
        line, curve, friction = self.line, self.curve, self.friction
        by_robot = (each.expand_as(out) for each in (*gains, effort))
        now: tuple[Tensor | float, ...] = (line.kept, line.steps, line.age, line.decimation, dof_pos, dof_vel)
        rough = (friction.coulomb, friction.extra, friction.viscous, friction.stribeck_velocity, friction.smoothing)
        motor = (curve.stall_torque, curve.no_load_speed.expand_as(out))
        self._kernels.launch("drive_joints", tuple(out.shape), *now, *by_robot, *motor, *rough, self._has_friction, out)

    def reset(self, mask: Tensor) -> None:
        """Begin new episodes of the robots in `mask` (N,). Every control step calls this, also if no episode ends."""
        for model in self.models:
            model.reset(mask)


def check_actuator(robot: Robot, cfg: RobotControlConfig, sim_dt: float, origins: Origins | None = None) -> None:
    """Check that the actuators fit the robot, its control law and the physics step `sim_dt` [s]. `origins` has the sources of
    the settings, for error messages.

    Raises:
        ConfigError: a pattern matches no joint, a no-load speed is missing, a motor is too strong for the physics step, or
            the network's file is missing or invalid, or the network needs law P or another physics step; or a user-defined
            model is not registered or has invalid settings.
    """
    actuator, where = cfg.actuator, str if origins is None else origins.where
    check_line(with_rotors(robot, actuator, where), *motor_numbers(robot, actuator, where), sim_dt, where)
    friction_numbers(robot, actuator, where)
    if actuator.network:
        path = where("control.actuator.network")
        laws = robot.each(cfg.control_type, where("control.control_type"))
        for law in laws[list(modelled_joints(robot, actuator, where))]:
            if law != "P":
                raise ConfigError(f"{path}: a learned actuator needs control_type P (joint angles), not {law}")
        NetworkWeights.load(actuator.network, path).steps_between(sim_dt, path)
    registered_models(one_robot(robot, actuator, sim_dt, origins))


def one_robot(robot: Robot, cfg: ActuatorConfig, sim_dt: float, origins: Origins | None = None) -> Motors:
    """Return the motors of one robot on the CPU, whose targets are set in every physics step of `sim_dt` [s]."""
    numbers, rest = RandomPool(1, torch.device("cpu")), torch.zeros(robot.num_dof)
    return Motors(robot, cfg, 1, 1, sim_dt, torch.device("cpu"), numbers, lambda: rest, origins=origins)
