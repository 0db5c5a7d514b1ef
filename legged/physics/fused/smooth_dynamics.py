"""Everything of a physics step that only joints and masses decide, in one launch: poses, inertias, bias forces.

mujoco-warp takes some twenty launches for it, and at 4096 worlds each costs microseconds however little it computes. Here a
warp of threads has a world, and what passes from body to body stays on the chip. Recursive Newton-Euler and composite rigid
bodies (Featherstone, Rigid Body Dynamics Algorithms, 2008), in MuJoCo's coordinates: spatial vectors are (angular, linear)
in world axes about the robot's centre of mass; inertias are (xx, yy, zz, xy, xz, yz, m * offset, m).
"""

from typing import Any

import mujoco
import numpy as np
import warp as wp

from legged.physics.fused.constraint_solver import LANES, SHARED_BYTES

# `EACH` deals items out to the threads of a world, `meet` separates phases that write what others read.
SOURCE = """
    const int NB = %(bodies)d, NV = %(dofs)d, NJ = %(joints)d, NG = %(geoms)d, DEPTH = %(depth)d, base = %(base)d;
    const float gravity[3] = {%(gravity)s};
    // Tables that `SmoothDynamics` fills: of a body the numbers, then floats, in its parent's frame; of a hinge; of a shape.
    enum { PARENT, LEVEL, FIRST_JOINT, END_JOINT, SUBTREE, NUMBERS };
    enum { POSITION, ORIENTATION = 3, COM = 7, PRINCIPAL_AXES = 10, PRINCIPAL = 14, BODY = 17 };
    enum { ANCHOR, AXIS = 3, REFERENCE = 6, LOWEST, HIGHEST, JOINT };
    const int GEOM = 7;  // POSITION, ORIENTATION
    const int* numbers = arrays.body_numbers.data;
    const float *bodies = arrays.bodies.data, *joints = arrays.joints.data, *geoms = arrays.geoms.data;
#if defined(__CUDA_ARCH__)
    #define LEGGED_SHARED __shared__
    const int lane = threadIdx.x & 31;
    #define EACH(i, count) for (int i = lane; i < (count); i += 32)
    auto meet = []() { __syncwarp(); };
#else
    #define LEGGED_SHARED
    const int lane = 0;
    #define EACH(i, count) for (int i = 0; i < (count); ++i)
    auto meet = []() {};
#endif
    LEGGED_SHARED float pos[NB * 3], quat[NB * 4], centre[NB * 3], inertia[NB * 10], carried[NB * 10];
    LEGGED_SHARED float anchor[NJ * 3], axis[NJ * 3], motion[NV * 6];
    LEGGED_SHARED float velocity[NB * 6], acceleration[NB * 6], force[NB * 6];

    auto cross = [](const float* u, const float* v, float* out) {
        out[0] = u[1] * v[2] - u[2] * v[1];
        out[1] = u[2] * v[0] - u[0] * v[2];
        out[2] = u[0] * v[1] - u[1] * v[0];
    };
    auto rotate = [&](const float* q, const float* v, float* out) {
        float t[3], tt[3];
        cross(q + 1, v, t);
        for (int k = 0; k < 3; ++k) t[k] *= 2.0f;
        cross(q + 1, t, tt);
        for (int k = 0; k < 3; ++k) out[k] = v[k] + q[0] * t[k] + tt[k];
    };
    auto multiply = [&](const float* p, const float* q, float* out) {
        float c[3];
        cross(p + 1, q + 1, c);
        out[0] = p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3];
        for (int k = 0; k < 3; ++k) out[1 + k] = p[0] * q[1 + k] + q[0] * p[1 + k] + c[k];
    };
    auto normalize = [](float* q) {
        const float length = sqrtf(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
        if (length < 1e-15f) { q[0] = 1.0f; q[1] = q[2] = q[3] = 0.0f; return; }
        for (int k = 0; k < 4; ++k) q[k] /= length;
    };
    auto to_matrix = [](const float* q, float* out) {
        const float xx = q[1] * q[1], yy = q[2] * q[2], zz = q[3] * q[3];
        const float xy = q[1] * q[2], xz = q[1] * q[3], yz = q[2] * q[3];
        const float wx = q[0] * q[1], wy = q[0] * q[2], wz = q[0] * q[3];
        out[0] = 1.0f - 2.0f * (yy + zz); out[1] = 2.0f * (xy - wz); out[2] = 2.0f * (xz + wy);
        out[3] = 2.0f * (xy + wz); out[4] = 1.0f - 2.0f * (xx + zz); out[5] = 2.0f * (yz - wx);
        out[6] = 2.0f * (xz - wy); out[7] = 2.0f * (yz + wx); out[8] = 1.0f - 2.0f * (xx + yy);
    };
    // Momentum of a spatial inertia in motion.
    auto momentum = [&](const float* body, const float* v, float* out) {
        float turned[3], carried_along[3];
        cross(body + 6, v + 3, turned);
        cross(v, body + 6, carried_along);
        out[0] = body[0] * v[0] + body[3] * v[1] + body[4] * v[2] + turned[0];
        out[1] = body[3] * v[0] + body[1] * v[1] + body[5] * v[2] + turned[1];
        out[2] = body[4] * v[0] + body[5] * v[1] + body[2] * v[2] + turned[2];
        for (int k = 0; k < 3; ++k) out[3 + k] = carried_along[k] + body[9] * v[3 + k];
    };

    const float* q_in = arrays.qpos.data + (long long)world * arrays.qpos.shape[1];
    const float* v_in = arrays.qvel.data + (long long)world * arrays.qvel.shape[1];
    const float* masses = arrays.body_mass.data + (long long)(world %% arrays.body_mass.shape[0]) * NB;

    meet();  // of the world before
    EACH(b, NB) if (numbers[b * NUMBERS + LEVEL] == 0) {
        for (int k = 0; k < 3; ++k) pos[b * 3 + k] = 0.0f;
        for (int k = 0; k < 4; ++k) quat[b * 4 + k] = k == 0 ? 1.0f : 0.0f;
        for (int k = 0; k < 6; ++k) velocity[b * 6 + k] = 0.0f;
        for (int k = 0; k < 6; ++k) acceleration[b * 6 + k] = k < 3 ? 0.0f : -gravity[k - 3];
    }
    meet();
    // Poses, level by level away from the world.
    for (int level = 1; level <= DEPTH; ++level) {
        EACH(b, NB) if (numbers[b * NUMBERS + LEVEL] == level) {
            const int parent = numbers[b * NUMBERS + PARENT];
            float p[3], q[4], moved[3];
            if (b == base) {
                for (int k = 0; k < 3; ++k) p[k] = q_in[k];
                for (int k = 0; k < 4; ++k) q[k] = q_in[3 + k];
            } else {
                rotate(quat + parent * 4, bodies + b * BODY + POSITION, moved);
                for (int k = 0; k < 3; ++k) p[k] = pos[parent * 3 + k] + moved[k];
                multiply(quat + parent * 4, bodies + b * BODY + ORIENTATION, q);
                for (int j = numbers[b * NUMBERS + FIRST_JOINT]; j < numbers[b * NUMBERS + END_JOINT]; ++j) {
                    float turn[4], before[4];
                    rotate(q, joints + j * JOINT + ANCHOR, moved);
                    for (int k = 0; k < 3; ++k) anchor[j * 3 + k] = p[k] + moved[k];
                    rotate(q, joints + j * JOINT + AXIS, axis + j * 3);
                    const float half = 0.5f * (q_in[7 + j] - joints[j * JOINT + REFERENCE]);
                    turn[0] = cosf(half);
                    for (int k = 0; k < 3; ++k) turn[1 + k] = sinf(half) * joints[j * JOINT + AXIS + k];
                    for (int k = 0; k < 4; ++k) before[k] = q[k];
                    multiply(before, turn, q);
                    rotate(q, joints + j * JOINT + ANCHOR, moved);
                    for (int k = 0; k < 3; ++k) p[k] = anchor[j * 3 + k] - moved[k];
                }
            }
            normalize(q);
            for (int k = 0; k < 3; ++k) pos[b * 3 + k] = p[k];
            for (int k = 0; k < 4; ++k) quat[b * 4 + k] = q[k];
        }
        meet();
    }
    EACH(g, NG) {
        const int b = arrays.geom_body.data[g];
        const long long at = (long long)world * NG + g;
        float* out = reinterpret_cast<float*>(arrays.geom_xpos.data) + at * 3;
        float moved[3], q[4];
        rotate(quat + b * 4, geoms + g * GEOM + POSITION, moved);
        for (int k = 0; k < 3; ++k) out[k] = pos[b * 3 + k] + moved[k];
        multiply(quat + b * 4, geoms + g * GEOM + ORIENTATION, q);
        to_matrix(q, reinterpret_cast<float*>(arrays.geom_xmat.data) + at * 9);
    }
    // The robot's centre of mass: all threads add up the same.
    EACH(b, NB) {
        float moved[3];
        rotate(quat + b * 4, bodies + b * BODY + COM, moved);
        for (int k = 0; k < 3; ++k) centre[b * 3 + k] = pos[b * 3 + k] + moved[k];
    }
    meet();
    const int last = base + numbers[base * NUMBERS + SUBTREE];
    float com[3] = {0.0f, 0.0f, 0.0f}, mass = 0.0f;
    for (int b = base; b < last; ++b) {
        mass += masses[b];
        for (int k = 0; k < 3; ++k) com[k] += masses[b] * centre[b * 3 + k];
    }
    for (int k = 0; k < 3; ++k) com[k] /= mass;
    // Inertias about it.
    EACH(b, NB) {
        float q[4], R[9], I[6];
        multiply(quat + b * 4, bodies + b * BODY + PRINCIPAL_AXES, q);
        to_matrix(q, R);
        const float* main = bodies + b * BODY + PRINCIPAL;
        const int one[6] = {0, 1, 2, 0, 0, 1}, other[6] = {0, 1, 2, 1, 2, 2};
        for (int n = 0; n < 6; ++n) {
            I[n] = 0.0f;
            for (int k = 0; k < 3; ++k) I[n] += R[one[n] * 3 + k] * main[k] * R[other[n] * 3 + k];
        }
        const float m = masses[b];
        const float x = centre[b * 3] - com[0], y = centre[b * 3 + 1] - com[1], z = centre[b * 3 + 2] - com[2];
        float* out = inertia + b * 10;
        out[0] = I[0] + m * (y * y + z * z); out[1] = I[1] + m * (x * x + z * z); out[2] = I[2] + m * (x * x + y * y);
        out[3] = I[3] - m * x * y; out[4] = I[4] - m * x * z; out[5] = I[5] - m * y * z;
        out[6] = m * x; out[7] = m * y; out[8] = m * z; out[9] = m;
    }
    // How each degree of freedom moves the bodies that it carries.
    EACH(i, NV) {
        float* out = motion + i * 6;
        const float* about = i < 6 ? pos + base * 3 : anchor + (i - 6) * 3;
        if (i < 3) {
            for (int k = 0; k < 6; ++k) out[k] = k == 3 + i ? 1.0f : 0.0f;
        } else {
            float offset[3];
            if (i < 6) {
                const float unit[3] = {i == 3 ? 1.0f : 0.0f, i == 4 ? 1.0f : 0.0f, i == 5 ? 1.0f : 0.0f};
                rotate(quat + base * 4, unit, out);
            } else {
                for (int k = 0; k < 3; ++k) out[k] = axis[(i - 6) * 3 + k];
            }
            for (int k = 0; k < 3; ++k) offset[k] = com[k] - about[k];
            cross(out, offset, out + 3);
        }
        float* shown = reinterpret_cast<float*>(arrays.cdof.data) + ((long long)world * NV + i) * 6;
        for (int k = 0; k < 6; ++k) shown[k] = out[k];
    }
    if (lane == 0) {
        float* out = reinterpret_cast<float*>(arrays.subtree_com.data) + ((long long)world * NB + base) * 3;
        for (int k = 0; k < 3; ++k) out[k] = com[k];
    }
    meet();
    EACH(b, NB)
        for (int k = 0; k < 10; ++k) {
            float total = 0.0f;
            for (int c = b; c < b + numbers[b * NUMBERS + SUBTREE]; ++c) total += inertia[c * 10 + k];
            carried[b * 10 + k] = total;
        }
    // Velocities, and accelerations as if no joint accelerated, level by level.
    for (int level = 1; level <= DEPTH; ++level) {
        EACH(b, NB) if (numbers[b * NUMBERS + LEVEL] == level) {
            const int parent = numbers[b * NUMBERS + PARENT];
            float v[6], a[6], now[6], c[3], d[3];
            for (int k = 0; k < 6; ++k) { v[k] = velocity[parent * 6 + k]; a[k] = acceleration[parent * 6 + k]; }
            int from = 6 + numbers[b * NUMBERS + FIRST_JOINT], to = 6 + numbers[b * NUMBERS + END_JOINT];
            if (b == base) {
                for (int k = 0; k < 3; ++k) v[3 + k] += v_in[k];
                from = 3;
                to = 6;
            }
            for (int k = 0; k < 6; ++k) now[k] = v[k];
            for (int i = from; i < to; ++i) {
                const float* s = motion + i * 6;
                cross(now, s, c);
                for (int k = 0; k < 3; ++k) a[k] += c[k] * v_in[i];
                cross(now, s + 3, c);
                cross(now + 3, s, d);
                for (int k = 0; k < 3; ++k) a[3 + k] += (c[k] + d[k]) * v_in[i];
                for (int k = 0; k < 6; ++k) v[k] += s[k] * v_in[i];
                if (b != base) for (int k = 0; k < 6; ++k) now[k] = v[k];  // the base's three turn at once
            }
            for (int k = 0; k < 6; ++k) { velocity[b * 6 + k] = v[k]; acceleration[b * 6 + k] = a[k]; }
        }
        meet();
    }
    EACH(i, NV) {
        float f[6];
        momentum(carried + arrays.dof_body.data[i] * 10, motion + i * 6, f);
        for (int k = arrays.row_start.data[i]; k < arrays.row_start.data[i] + arrays.row_count.data[i]; ++k) {
            const int j = arrays.column.data[k];
            float total = i == j ? arrays.armature.data[i] : 0.0f;
            for (int n = 0; n < 6; ++n) total += motion[j * 6 + n] * f[n];
            arrays.mass_matrix.data[(long long)world * arrays.mass_matrix.shape[1] + k] = total;
        }
    }
    EACH(b, NB) {
        float p[6], along[6], c[3], d[3];
        momentum(inertia + b * 10, velocity + b * 6, p);
        momentum(inertia + b * 10, acceleration + b * 6, along);
        cross(velocity + b * 6, p, c);
        cross(velocity + b * 6 + 3, p + 3, d);
        for (int k = 0; k < 3; ++k) force[b * 6 + k] = along[k] + c[k] + d[k];
        cross(velocity + b * 6, p + 3, c);
        for (int k = 0; k < 3; ++k) force[b * 6 + 3 + k] = along[3 + k] + c[k];
    }
    meet();
    EACH(i, NV) {
        const int b = arrays.dof_body.data[i];
        float total = 0.0f;
        for (int c = b; c < b + numbers[b * NUMBERS + SUBTREE]; ++c)
            for (int k = 0; k < 6; ++k) total -= motion[i * 6 + k] * force[c * 6 + k];
        if (i >= 6) {
            const float asked = arrays.torques.data[(long long)world * arrays.torques.shape[1] + i - 6];
            const float lowest = joints[(i - 6) * JOINT + LOWEST], highest = joints[(i - 6) * JOINT + HIGHEST];
            total += asked < lowest ? lowest : asked > highest ? highest : asked;
        }
        arrays.qfrc_smooth.data[(long long)world * arrays.qfrc_smooth.shape[1] + i] = total;
    }
    #undef LEGGED_SHARED
    #undef EACH
"""


@wp.struct
class DynamicsArrays:
    """Tables of the robot, what the launch reads of mujoco-warp's model and data, and from `geom_xpos` on what it writes."""

    bodies: wp.array[float]
    body_numbers: wp.array[int]
    joints: wp.array[float]
    geoms: wp.array[float]
    geom_body: wp.array[int]
    dof_body: wp.array[int]
    armature: wp.array[float]
    row_start: wp.array[int]
    row_count: wp.array[int]
    column: wp.array[int]
    body_mass: wp.array2d[float]
    qpos: wp.array2d[float]
    qvel: wp.array2d[float]
    torques: wp.array2d[float]
    geom_xpos: wp.array2d[wp.vec3]
    geom_xmat: wp.array2d[wp.mat33]
    subtree_com: wp.array2d[wp.vec3]
    cdof: wp.array2d[wp.spatial_vector]
    mass_matrix: wp.array2d[float]
    qfrc_smooth: wp.array2d[float]


def dynamics_kernel(numbers: dict[str, Any]) -> Any:
    """The kernel for the sizes and constants in `numbers`; launched for (worlds, lanes)."""

    @wp.func_native(SOURCE % numbers)
    def move_world(world: int, arrays: DynamicsArrays) -> None: ...

    @wp.kernel(module="unique", enable_backward=False)
    def smooth_dynamics(arrays: DynamicsArrays) -> None:
        world, _lane = wp.tid()  # type: ignore[misc]
        move_world(world, arrays)

    return smooth_dynamics


class SmoothDynamics:
    """From joint positions, velocities and torques: poses of shapes, the centre of mass, motion axes, the mass matrix, and
    all forces but those of constraints.
    """

    def __init__(self, model: mujoco.MjModel, m: Any, d: Any, base: int, limits: np.ndarray) -> None:
        """For a robot whose free body is `base`, followed by hinges only, with motors of torque `limits` (2, D) [Nm]; call
        with the arrays' device as Warp's current one.
        """
        parent = model.body_parentid
        depth, subtree = np.zeros(model.nbody, dtype=int), np.ones(model.nbody, dtype=int)
        for b in range(1, model.nbody):
            depth[b] = depth[parent[b]] + 1
        for b in range(model.nbody - 1, 0, -1):
            subtree[parent[b]] += subtree[b]
        hinges = np.where(np.arange(model.nbody) == base, 0, model.body_jntnum)
        first = np.concatenate([[0], np.cumsum(hinges)])
        numbers = np.stack([parent, depth, first[:-1], first[1:], subtree], axis=1)
        bodies = [model.body_pos, model.body_quat, model.body_ipos, model.body_iquat, model.body_inertia]
        joints = [model.jnt_pos[1:], model.jnt_axis[1:], model.qpos0[7:, None], limits.T]
        arrays = self._arrays = DynamicsArrays()
        arrays.bodies = wp.array(np.concatenate(bodies, axis=1).ravel(), dtype=float)
        arrays.body_numbers = wp.array(numbers.ravel(), dtype=int)
        arrays.joints = wp.array(np.concatenate(joints, axis=1).ravel(), dtype=float)
        arrays.geoms = wp.array(np.concatenate([model.geom_pos, model.geom_quat], axis=1).ravel(), dtype=float)
        arrays.geom_body, arrays.dof_body = wp.array(model.geom_bodyid, dtype=int), wp.array(model.dof_bodyid, dtype=int)
        arrays.armature, arrays.body_mass = wp.array(model.dof_armature, dtype=float), m.body_mass
        arrays.row_start, arrays.row_count, arrays.column = m.M_rowadr, m.M_rownnz, m.M_colind
        arrays.qpos, arrays.qvel, arrays.torques = d.qpos, d.qvel, d.ctrl
        arrays.geom_xpos, arrays.geom_xmat = d.geom_xpos, d.geom_xmat
        arrays.subtree_com, arrays.cdof = d.subtree_com, d.cdof
        arrays.mass_matrix, arrays.qfrc_smooth = d.M, d.qfrc_smooth
        self._kernel = dynamics_kernel(
            {
                "bodies": model.nbody,
                "dofs": model.nv,
                "joints": model.njnt - 1,
                "geoms": model.ngeom,
                "depth": int(depth.max()),
                "base": base,
                "gravity": ", ".join(f"{value:.9e}f" for value in model.opt.gravity),
            }
        )
        self._lanes = 1 if d.qacc.device.is_cpu else LANES
        self._worlds = d.nworld

    @staticmethod
    def why_not(model: mujoco.MjModel) -> str:
        """Say what of a model this does not compute; empty if nothing."""
        free, hinge = mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_HINGE
        if not model.njnt or model.jnt_type[0] != free or (model.jnt_type[1:] != hinge).any():
            return "its joints are not a free one followed by hinges"
        on_joints = (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT).all()
        if not on_joints or model.actuator_trnid[:, 0].tolist() != list(range(1, model.njnt)):
            return "its motors are not one for each hinge, in their order"
        if 4 * (48 * model.nbody + 6 * model.njnt + 6 * model.nv) > SHARED_BYTES:
            return f"{model.nbody} bodies do not fit a GPU's shared memory"
        if model.neq:
            return "the model has equality constraints, which need the poses of bodies and sites"
        return ""

    def launch(self) -> None:
        """Once a step, before collisions."""
        dim = (self._worlds, self._lanes)
        wp.launch(self._kernel, dim=dim, inputs=[self._arrays], block_dim=self._lanes)
