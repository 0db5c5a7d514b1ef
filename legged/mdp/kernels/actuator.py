"""Kernel of actuators with friction, delay and a torque-speed curve. For the same formulas in torch, and for their sources,
see legged/mdp/actuators/.

The kernel has a separate module, so that training with ideal motors does not compile it.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def below(value: float, limit: float) -> float:
    """Return the smaller of `value` and `limit`; NaN stays NaN."""
    return wp.where(value > limit, limit, value)


@wp.func
def above(value: float, limit: float) -> float:
    """Return the larger of `value` and `limit`; NaN stays NaN."""
    return wp.where(value < limit, limit, value)


@wp.kernel
def drive_joints(
    targets: wp.array3d[float],
    delay: wp.array[int],
    step: int,
    decimation: int,
    dof_pos: wp.array2d[float],
    dof_vel: wp.array2d[float],
    stiffness: wp.array2d[float],
    damping: wp.array2d[float],
    effort: wp.array2d[float],
    stall_torque: wp.array[float],
    no_load_speed: wp.array2d[float],
    coulomb: wp.array[float],
    extra: wp.array[float],
    viscous: wp.array[float],
    stribeck_velocity: float,
    smoothing: float,
    has_friction: bool,
    torques: wp.array2d[float],
):
    """Compute the torques of joints under PD control (`Actuator.drive`). One thread per robot and joint. NaN stays NaN."""
    robot, joint = wp.tid()
    late = wp.max(delay[robot] - step, 0)
    age = wp.min((late + decimation - 1) // decimation, targets.shape[0] - 1)
    velocity = dof_vel[robot, joint]
    spring = stiffness[robot, joint] * (targets[age, robot, joint] - dof_pos[robot, joint])
    torque = spring - damping[robot, joint] * velocity
    limit, stall = effort[robot, joint], stall_torque[joint]
    share = velocity / no_load_speed[robot, joint]
    torque = above(torque, above(below(stall * (-1.0 - share), limit), -limit))
    torque = below(torque, below(above(stall * (1.0 - share), -limit), limit))
    if has_friction:
        slow = wp.exp(-((velocity / stribeck_velocity) * (velocity / stribeck_velocity)))
        resistance = (coulomb[joint] + extra[joint] * slow) * wp.tanh(velocity / smoothing) + viscous[joint] * velocity
        torque = above(below(torque - resistance, limit), -limit)
    torques[robot, joint] = torque
