"""Kernel of the poses and velocities of named bodies. legged/mdp/sensors/bodies.py has the same formulas in torch.

The kernel has a separate module, so that only tasks with this sensor compile it.
"""

import warp as wp

from legged.physics import body_chains
from legged.physics.warp.state_io import rotate

wp.set_module_options({"enable_backward": False})

FREE, BALL = wp.constant(body_chains.FREE), wp.constant(body_chains.BALL)
SLIDE, HINGE = wp.constant(body_chains.SLIDE), wp.constant(body_chains.HINGE)
END = wp.constant(body_chains.END)


@wp.func
def product(a: wp.vec4, b: wp.vec4) -> wp.vec4:
    """Return the product of two quaternions (w, x, y, z)."""
    u, v = wp.vec3(a[1], a[2], a[3]), wp.vec3(b[1], b[2], b[3])
    xyz = a[0] * v + b[0] * u + wp.cross(u, v)
    return wp.vec4(a[0] * b[0] - wp.dot(u, v), xyz[0], xyz[1], xyz[2])


@wp.func
def vector_at(values: wp.array2d[float], world: int, first: int) -> wp.vec3:
    """Return three numbers of a row as a vector."""
    return wp.vec3(values[world, first], values[world, first + 1], values[world, first + 2])


@wp.func
def quat_at(values: wp.array2d[float], world: int, first: int) -> wp.vec4:
    """Return four numbers of a row as a unit quaternion."""
    found = wp.vec4(values[world, first], values[world, first + 1], values[world, first + 2], values[world, first + 3])
    return wp.normalize(found)


@wp.kernel
def read_bodies(
    pos: wp.array2d[wp.vec3],
    lin_vel: wp.array2d[wp.vec3],
    ang_vel: wp.array2d[wp.vec3],
    body_pos: wp.array2d[wp.vec3],
    axis: wp.array2d[wp.vec3],
    anchor: wp.array2d[wp.vec3],
    quat: wp.array3d[float],
    body_quat: wp.array3d[float],
    kind: wp.array2d[int],
    position: wp.array2d[int],
    speed: wp.array2d[int],
    reference: wp.array2d[float],
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
):
    """Walk from the world to a body, link by link (`BodyStates.update`). One thread per world and body. `body_pos` to
    `reference` are the fields of `BodyChains`.
    """
    world, body = wp.tid()
    p, v, w = wp.vec3(), wp.vec3(), wp.vec3()
    q = wp.vec4(1.0, 0.0, 0.0, 0.0)
    for level in range(kind.shape[0]):
        of, at, rate = kind[level, body], position[level, body], speed[level, body]
        if of == FREE:
            p, v = vector_at(qpos, world, at), vector_at(qvel, world, rate)
            q = quat_at(qpos, world, at + 3)
            w = rotate(q, vector_at(qvel, world, rate + 3))
        elif of != END:
            arm = rotate(q, body_pos[level, body])
            p += arm
            v += wp.cross(w, arm)
            mount = wp.vec4()
            for i in range(4):
                mount[i] = body_quat[level, body, i]
            q = product(q, mount)
            a = axis[level, body]
            along = rotate(q, a)
            if of == SLIDE:
                path = (qpos[world, at] - reference[level, body]) * along
                p += path
                v += wp.cross(w, path) + qvel[world, rate] * along
            arm = rotate(q, anchor[level, body])
            p += arm
            v += wp.cross(w, arm)
            if of == HINGE:
                half = 0.5 * (qpos[world, at] - reference[level, body])
                xyz = wp.sin(half) * a
                q = product(q, wp.vec4(wp.cos(half), xyz[0], xyz[1], xyz[2]))
                w += qvel[world, rate] * along
            if of == BALL:
                q = product(q, quat_at(qpos, world, at))
                w += rotate(q, vector_at(qvel, world, rate))
            arm = rotate(q, anchor[level, body])
            p -= arm
            v -= wp.cross(w, arm)
    pos[world, body] = p
    lin_vel[world, body] = v
    ang_vel[world, body] = w
    for i in range(4):
        quat[world, body, i] = q[i]
