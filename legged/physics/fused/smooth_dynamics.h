// Computes poses, inertias and all forces except constraint forces for one world, whose trees may have free, ball, slide and
// hinge joints in any order. Constants: NB (bodies), NV (degrees of freedom), NJ (joints), NG (shapes), NT (trees), DEPTH
// (levels of bodies below the world), OF_INERTIA, OF_MOTION, OF_BODY (row strides in shared memory), BALLS, SLIDES, SPRINGS,
// BALL_SPRINGS, DAMPERS, GEARS, GAINS, AFFINE_BIAS, CONTROL_LIMITS, FORCE_LIMITS, JOINT_LIMITS (the model has the feature),
// ONE_MOTOR (at most one motor per degree of freedom), PUSHED (external forces act on bodies), EQUALITIES (equality
// constraints hold bodies), SITES (number of sites if equality constraints hold sites, else 0), FREE, BALL, SLIDE, AFFINE
// (MuJoCo's numbers of types), and for each array of the model VARIES_<array> (worlds may differ in it). The compiler removes
// the code of features that a model lacks.

LEGGED_SHARED float centre[NB * 3], inertia[NB * OF_INERTIA], motion[NV * OF_MOTION], speed[NV];
// Motions overwrite poses, which are then no longer needed. This saves shared memory, so that more worlds run at once.
const int POSES = 7 * NB + 6 * NJ, MOTIONS = OF_BODY * NB;
LEGGED_SHARED float place[POSES > MOTIONS ? POSES : MOTIONS];
float *pos = place, *quat = pos + 3 * NB, *anchor = quat + 4 * NB, *axis = anchor + 3 * NJ;
// row of each body: its velocity and acceleration, which the inertia and force of its subtree replace later
float* of_bodies = place;
const int CARRIED = 0, VELOCITY = 0, ACCELERATION = 10, FORCE = 10;
// Offsets of a body's orientation, principal inertias and mass, until the body's spatial inertia replaces them.
const int TURN = 0, MAIN = 4, MASS = 7;

// Returns this world's row of `length` floats in a model array, which has one row for all worlds or one for each.
auto row_of = [&](const auto& array, int length, bool varies) {
    const float* data = reinterpret_cast<const float*>(array.data);
    if (!varies) return data;
    const int rows = array.shape[0];
    return data + (long long)(world < rows ? world : world % rows) * length;
};
#define ROW(name, length) row_of(arrays.name, length, VARIES_##name)
auto clamped = [](float x, const float* range) { return x < range[0] ? range[0] : x > range[1] ? range[1] : x; };
// Computes the momentum of a spatial inertia with velocity v.
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
// number of bodies that a body carries, itself included; they have consecutive indices
const int* subtree = arrays.body_subtree.data;
// Functions that unpack the integers that describe bodies and joints.
auto parent_of = [](int packed) { return packed & 0xff; };
auto first_of = [](int packed) { return (packed >> 8) & 0xff; };
auto count_of = [](int packed) { return (packed >> 16) & 0xf; };
auto level_of = [](int packed) { return packed >> 20; };
auto type_of = [](int packed) { return packed & 0xf; };
auto address_of = [](int packed) { return (packed >> 4) & 0xfff; };
auto dof_of = [](int packed) { return packed >> 16; };

meet();  // wait until the previous world is finished
// Load all data from global memory at once, and compute the rotations of all joints at once: in the loop over levels below,
// all bodies would wait for the slowest.
EACH(b, NB) {
    for (int k = 0; k < 3; ++k) centre[b * 3 + k] = ROW(body_ipos, NB * 3)[b * 3 + k];
    for (int k = 0; k < 4; ++k) inertia[b * OF_INERTIA + TURN + k] = ROW(body_iquat, NB * 4)[b * 4 + k];
    for (int k = 0; k < 3; ++k) inertia[b * OF_INERTIA + MAIN + k] = ROW(body_inertia, NB * 3)[b * 3 + k];
    inertia[b * OF_INERTIA + MASS] = ROW(body_mass, NB)[b];
    if (level_of(arrays.body_packed.data[b]) > 0) continue;
    for (int k = 0; k < 3; ++k) pos[b * 3 + k] = 0.0f;
    for (int k = 0; k < 4; ++k) quat[b * 4 + k] = k == 0 ? 1.0f : 0.0f;
}
EACH(i, NV) speed[i] = v_in[i];
EACH(j, NJ) {
    const int packed = arrays.joint_packed.data[j], type = type_of(packed), at = address_of(packed);
    if (type == FREE || (BALLS && type == BALL)) continue;
    const float change = q_in[at] - ROW(qpos0, arrays.qpos0.shape[1])[at];
    const bool slides = SLIDES && type == SLIDE;
    anchor[j * 3] = slides ? change : cosf(0.5f * change);
    if (!slides) anchor[j * 3 + 1] = sinf(0.5f * change);
}
meet();
// Poses, level by level away from the world.
for (int level = 1; level <= DEPTH; ++level) {
    EACH(b, NB) if (const int of_body = arrays.body_packed.data[b]; level_of(of_body) == level) {
        const int parent = parent_of(of_body), first = first_of(of_body), last = first + count_of(of_body);
        float p[3], q[4], moved[3];
        const int of_first = first < last ? arrays.joint_packed.data[first] : -1;
        const bool floats = first < last && type_of(of_first) == FREE;  // a body with a free joint has no other joint
        if (floats) {
            const int at = address_of(of_first);
            for (int k = 0; k < 3; ++k) anchor[first * 3 + k] = p[k] = q_in[at + k];
            for (int k = 0; k < 4; ++k) q[k] = q_in[at + 3 + k];
        } else {
            rotate(quat + parent * 4, ROW(body_pos, NB * 3) + b * 3, moved);
            for (int k = 0; k < 3; ++k) p[k] = pos[parent * 3 + k] + moved[k];
            multiply(quat + parent * 4, ROW(body_quat, NB * 4) + b * 4, q);
        }
        for (int j = floats ? last : first; j < last; ++j) {
            [[maybe_unused]] const int packed = j == first ? of_first : arrays.joint_packed.data[j], type = type_of(packed);
            // Displacement of a slide, or cosine and sine of half the angle of a hinge.
            [[maybe_unused]] const float path = anchor[j * 3], cosine = path, sine = anchor[j * 3 + 1];
            const float* at_body = ROW(jnt_pos, NJ * 3) + j * 3;
            const float* about = ROW(jnt_axis, NJ * 3) + j * 3;
            float turn[4], before[4];
            rotate(q, at_body, moved);
            for (int k = 0; k < 3; ++k) anchor[j * 3 + k] = p[k] + moved[k];
            rotate(q, about, axis + j * 3);
            if (BALLS && type == BALL) {
                for (int k = 0; k < 4; ++k) turn[k] = q_in[address_of(packed) + k];
                normalize(turn);
            } else if (SLIDES && type == SLIDE) {
                for (int k = 0; k < 3; ++k) p[k] += axis[j * 3 + k] * path;
                continue;
            } else {
                turn[0] = cosine;
                for (int k = 0; k < 3; ++k) turn[1 + k] = sine * about[k];
            }
            for (int k = 0; k < 4; ++k) before[k] = q[k];
            multiply(before, turn, q);
            rotate(q, at_body, moved);
            for (int k = 0; k < 3; ++k) p[k] = anchor[j * 3 + k] - moved[k];
        }
        normalize(q);
        for (int k = 0; k < 3; ++k) pos[b * 3 + k] = p[k];
        for (int k = 0; k < 4; ++k) quat[b * 4 + k] = q[k];
    }
    meet();
}
EACH(g, NG) {
    const int b = arrays.geom_bodyid.data[g];
    const long long at = (long long)world * NG + g;
    float* out = reinterpret_cast<float*>(arrays.geom_xpos.data) + at * 3;
    float moved[3], q[4];
    rotate(quat + b * 4, ROW(geom_pos, NG * 3) + g * 3, moved);
    for (int k = 0; k < 3; ++k) out[k] = pos[b * 3 + k] + moved[k];
    multiply(quat + b * 4, ROW(geom_quat, NG * 4) + g * 4, q);
    to_matrix(q, reinterpret_cast<float*>(arrays.geom_xmat.data) + at * 9);
}
// Poses that equality constraints need.
if (EQUALITIES) EACH(b, NB) {
    const long long at = (long long)world * NB + b;
    for (int k = 0; k < 3; ++k) reinterpret_cast<float*>(arrays.xpos.data)[at * 3 + k] = pos[b * 3 + k];
    for (int k = 0; k < 4; ++k) reinterpret_cast<float*>(arrays.xquat.data)[at * 4 + k] = quat[b * 4 + k];
    to_matrix(quat + b * 4, reinterpret_cast<float*>(arrays.xmat.data) + at * 9);
}
EACH(n, SITES) {
    const int b = arrays.site_bodyid.data[n];
    float* out = reinterpret_cast<float*>(arrays.site_xpos.data) + ((long long)world * SITES + n) * 3;
    float moved[3];
    rotate(quat + b * 4, ROW(site_pos, SITES * 3) + n * 3, moved);
    for (int k = 0; k < 3; ++k) out[k] = pos[b * 3 + k] + moved[k];
}
// Centres of mass of bodies and of trees.
EACH(b, NB) {
    float moved[3];
    rotate(quat + b * 4, centre + b * 3, moved);
    for (int k = 0; k < 3; ++k) centre[b * 3 + k] = pos[b * 3 + k] + moved[k];
}
float coms[NT * 3];
for (int t = 0; t < NT; ++t) {
    const int root = arrays.tree_root.data[t];
    float total[4] = {0.0f, 0.0f, 0.0f, 0.0f};  // mass times position, and mass
    EACH(b, NB) if (b >= root && b < root + subtree[root]) {
        const float m = inertia[b * OF_INERTIA + MASS];
        for (int k = 0; k < 3; ++k) total[k] += m * centre[b * 3 + k];
        total[3] += m;
    }
    sum_four(total);
    for (int k = 0; k < 3; ++k) coms[t * 3 + k] = total[k] / total[3];
    if (lane == 0) {
        float* out = reinterpret_cast<float*>(arrays.subtree_com.data) + ((long long)world * NB + root) * 3;
        for (int k = 0; k < 3; ++k) out[k] = coms[t * 3 + k];
    }
}
auto com_of = [&](int b) { return coms + (NT == 1 ? 0 : 3 * arrays.body_tree.data[b]); };
// Inertias about the tree's centre of mass.
EACH(b, NB) {
    float* out = inertia + b * OF_INERTIA;
    float q[4], R[9], I[6];
    multiply(quat + b * 4, out + TURN, q);
    to_matrix(q, R);
    const float main[3] = {out[MAIN], out[MAIN + 1], out[MAIN + 2]}, m = out[MASS];
    const int one[6] = {0, 1, 2, 0, 0, 1}, other[6] = {0, 1, 2, 1, 2, 2};
    for (int n = 0; n < 6; ++n) {
        I[n] = 0.0f;
        for (int k = 0; k < 3; ++k) I[n] += R[one[n] * 3 + k] * main[k] * R[other[n] * 3 + k];
    }
    const float* com = com_of(b);
    const float x = centre[b * 3] - com[0], y = centre[b * 3 + 1] - com[1], z = centre[b * 3 + 2] - com[2];
    out[0] = I[0] + m * (y * y + z * z); out[1] = I[1] + m * (x * x + z * z); out[2] = I[2] + m * (x * x + y * y);
    out[3] = I[3] - m * x * y; out[4] = I[4] - m * x * z; out[5] = I[5] - m * y * z;
    out[6] = m * x; out[7] = m * y; out[8] = m * z; out[9] = m;
}
// Motion that each degree of freedom causes in the bodies that it moves.
EACH(i, NV) {
    float* out = motion + i * OF_MOTION;
    const int packed = arrays.dof_packed.data[i];  // saves a chain of look-ups
    const int b = packed & 0xff, j = (packed >> 8) & 0xff, type = (packed >> 16) & 0xf, of_joint = packed >> 20;
    // axis of rotation in the body's frame, for a free or ball joint
    const int turning = type == FREE ? of_joint - 3 : of_joint;
    if (turning < 0) {
        for (int k = 0; k < 6; ++k) out[k] = k == 3 + of_joint ? 1.0f : 0.0f;
    } else if (SLIDES && type == SLIDE) {
        for (int k = 0; k < 6; ++k) out[k] = k < 3 ? 0.0f : axis[j * 3 + k - 3];
    } else {
        float offset[3];
        if (type == FREE || (BALLS && type == BALL)) {
            const float unit[3] = {turning == 0 ? 1.0f : 0.0f, turning == 1 ? 1.0f : 0.0f, turning == 2 ? 1.0f : 0.0f};
            rotate(quat + b * 4, unit, out);
        } else {
            for (int k = 0; k < 3; ++k) out[k] = axis[j * 3 + k];
        }
        const float* com = com_of(b);
        for (int k = 0; k < 3; ++k) offset[k] = com[k] - anchor[j * 3 + k];
        cross(out, offset, out + 3);
    }
    float* shown = reinterpret_cast<float*>(arrays.cdof.data) + ((long long)world * NV + i) * 6;
    for (int k = 0; k < 6; ++k) shown[k] = out[k];
}
meet();
// Rates of change of the motion axes, which equality constraints need.
[[maybe_unused]] float* turning_axes = reinterpret_cast<float*>(arrays.cdof_dot.data) + (long long)world * NV * 6;
// Velocities, and accelerations with zero joint accelerations, level by level.
EACH(b, NB) if (level_of(arrays.body_packed.data[b]) == 0) {
    const float* gravity = ROW(gravity, 3);
    for (int k = 0; k < 6; ++k) of_bodies[b * OF_BODY + VELOCITY + k] = 0.0f;
    for (int k = 0; k < 6; ++k) of_bodies[b * OF_BODY + ACCELERATION + k] = k < 3 ? 0.0f : -gravity[k - 3];
}
meet();
for (int level = 1; level <= DEPTH; ++level) {
    EACH(b, NB) if (const int of_body = arrays.body_packed.data[b]; level_of(of_body) == level) {
        const int first = first_of(of_body), last = first + count_of(of_body);
        const float* of_parent = of_bodies + parent_of(of_body) * OF_BODY;
        float v[6], a[6], now[6], c[3], d[3];
        for (int k = 0; k < 6; ++k) { v[k] = of_parent[VELOCITY + k]; a[k] = of_parent[ACCELERATION + k]; }
        for (int j = first; j < last; ++j) {
            const int packed = arrays.joint_packed.data[j], type = type_of(packed);
            int from = dof_of(packed);
            if (type == FREE) {
                for (int k = 0; k < 3; ++k) v[3 + k] += speed[from + k];
                if (EQUALITIES) for (int k = 0; k < 18; ++k) turning_axes[from * 6 + k] = 0.0f;
                from += 3;
            }
            // The three axes of a free or ball joint turn together.
            const int to = from + (type == FREE || (BALLS && type == BALL) ? 3 : 1);
            for (int k = 0; k < 6; ++k) now[k] = v[k];
            for (int i = from; i < to; ++i) {
                const float* s = motion + i * OF_MOTION;
                cross(now, s, c);
                for (int k = 0; k < 3; ++k) a[k] += c[k] * speed[i];
                cross(now, s + 3, c);
                cross(now + 3, s, d);
                for (int k = 0; k < 3; ++k) a[3 + k] += (c[k] + d[k]) * speed[i];
                for (int k = 0; k < 6; ++k) v[k] += s[k] * speed[i];
                if (EQUALITIES) {
                    cross(now, s, turning_axes + i * 6);
                    for (int k = 0; k < 3; ++k) turning_axes[i * 6 + 3 + k] = c[k] + d[k];
                }
            }
        }
        float* own = of_bodies + b * OF_BODY;
        for (int k = 0; k < 6; ++k) { own[VELOCITY + k] = v[k]; own[ACCELERATION + k] = a[k]; }
    }
    meet();
}
EACH(b, NB) {
    float* own = of_bodies + b * OF_BODY;
    float v[6], a[6], p[6], along[6], c[3], d[3], f[6];
    for (int k = 0; k < 6; ++k) { v[k] = own[VELOCITY + k]; a[k] = own[ACCELERATION + k]; }
    float* shown = reinterpret_cast<float*>(arrays.cvel.data) + ((long long)world * NB + b) * 6;
    if (EQUALITIES) for (int k = 0; k < 6; ++k) shown[k] = v[k];
    momentum(inertia + b * OF_INERTIA, v, p);
    momentum(inertia + b * OF_INERTIA, a, along);
    cross(v, p, c);
    cross(v + 3, p + 3, d);
    for (int k = 0; k < 3; ++k) f[k] = along[k] + c[k] + d[k];
    cross(v, p + 3, c);
    for (int k = 0; k < 3; ++k) f[3 + k] = along[3 + k] + c[k];
    if (PUSHED) {  // force, then torque, at the body's centre of mass
        const float* push = reinterpret_cast<const float*>(arrays.xfrc_applied.data) + ((long long)world * NB + b) * 6;
        const float* com = com_of(b);
        float arm[3];
        for (int k = 0; k < 3; ++k) arm[k] = centre[b * 3 + k] - com[k];
        cross(arm, push, c);
        for (int k = 0; k < 3; ++k) f[k] -= c[k] + push[3 + k];
        for (int k = 0; k < 3; ++k) f[3 + k] -= push[k];
    }
    for (int k = 0; k < 10; ++k) own[CARRIED + k] = inertia[b * OF_INERTIA + k];
    for (int k = 0; k < 6; ++k) own[FORCE + k] = f[k];
}
meet();
// Add the inertia and force of each body to its parent's, towards the world. Each lane adds one of the sixteen numbers.
EACH(k, 16)
    for (int b = NB - 1; b > 0; --b)
        if (const int parent = parent_of(arrays.body_packed.data[b]); parent > 0)
            of_bodies[parent * OF_BODY + k] += of_bodies[b * OF_BODY + k];
meet();
EACH(i, NV) {
    float f[6];
    momentum(of_bodies + (arrays.dof_packed.data[i] & 0xff) * OF_BODY + CARRIED, motion + i * OF_MOTION, f);
    const int start = arrays.M_rowadr.data[i], stop = start + arrays.M_rownnz.data[i];
    for (int k = start; k < stop; ++k) {
        const int j = arrays.M_colind.data[k];
        float total = i == j ? ROW(dof_armature, NV)[i] : 0.0f;
        for (int n = 0; n < 6; ++n) total += motion[j * OF_MOTION + n] * f[n];
        arrays.M.data[(long long)world * arrays.M.shape[1] + k] = total;
    }
}
EACH(i, NV) {
    const int packed = arrays.dof_packed.data[i], b = packed & 0xff;
    [[maybe_unused]] const int j = (packed >> 8) & 0xff, type = (packed >> 16) & 0xf;
    [[maybe_unused]] const int at = SPRINGS || AFFINE_BIAS ? address_of(arrays.joint_packed.data[j]) : 0;
    const long long out = (long long)world * NV + i;
    float total = 0.0f;
    for (int k = 0; k < 6; ++k) total -= motion[i * OF_MOTION + k] * of_bodies[b * OF_BODY + FORCE + k];
    // Motors, all of which act on slides and hinges.
    float driven = 0.0f;
    // Usually a degree of freedom has at most one motor, and a motor has the control with its own index.
    const int from = ONE_MOTOR ? 0 : arrays.motor_start.data[i];
    const int only = ONE_MOTOR ? arrays.motor_of_dof.data[i] : -1, to = ONE_MOTOR ? only >= 0 : arrays.motor_start.data[i + 1];
    for (int n = from; n < to; ++n) {
        const int u = ONE_MOTOR ? only : arrays.motor.data[n], input = ONE_MOTOR ? u : arrays.actuator_ctrladr.data[u];
        const float gear = GEARS ? ROW(actuator_gear, 6 * arrays.actuator_gear.shape[1])[6 * u] : 1.0f;
        float asked = arrays.ctrl.data[(long long)world * arrays.ctrl.shape[1] + input];
        if (CONTROL_LIMITS && arrays.actuator_ctrllimited.data[input])
            asked = clamped(asked, ROW(actuator_ctrlrange, 2 * arrays.actuator_ctrlrange.shape[1]) + 2 * input);
        float push = asked;
        if (GAINS) push *= ROW(actuator_gainprm, 10 * arrays.actuator_gainprm.shape[1])[10 * u];
        if (AFFINE_BIAS && arrays.actuator_biastype.data[u] == AFFINE) {
            const float* bias = ROW(actuator_biasprm, 10 * arrays.actuator_biasprm.shape[1]) + 10 * u;
            push += bias[0] + bias[1] * (gear * q_in[at]) + bias[2] * (gear * speed[i]);
        }
        if (FORCE_LIMITS && arrays.actuator_forcelimited.data[u])
            push = clamped(push, ROW(actuator_forcerange, 2 * arrays.actuator_forcerange.shape[1]) + 2 * u);
        driven += gear * push;
    }
    if (JOINT_LIMITS && arrays.jnt_actfrclimited.data[j]) driven = clamped(driven, ROW(jnt_actfrcrange, 2 * NJ) + 2 * j);
    arrays.qfrc_actuator.data[out] = driven;
    total += driven;
    if (SPRINGS || DAMPERS) {
        float passive = 0.0f;
        if (SPRINGS) {
            const float* rest = ROW(qpos_spring, arrays.qpos0.shape[1]) + at;
            const int of_joint = packed >> 20, turning = type == FREE ? of_joint - 3 : type == BALL ? of_joint : -1;
            float bent = q_in[at + (type == FREE && turning < 0 ? of_joint : 0)] - rest[type == FREE && turning < 0 ? of_joint : 0];
            if (BALL_SPRINGS && turning >= 0) {  // compute the rotation vector from the rest orientation, in the body's frame
                const int first = type == FREE ? 3 : 0;
                float now[4], back[4], turn[4];
                for (int k = 0; k < 4; ++k) { now[k] = q_in[at + first + k]; back[k] = k == 0 ? rest[first] : -rest[first + k]; }
                normalize(now);
                multiply(back, now, turn);
                const float length = sqrtf(turn[1] * turn[1] + turn[2] * turn[2] + turn[3] * turn[3]);
                float angle = 2.0f * atan2f(length, turn[0]);
                if (angle > 3.14159265f) angle -= 6.28318531f;
                bent = length < 1e-15f ? 0.0f : turn[1 + turning] * (angle / length);
            }
            passive -= ROW(jnt_stiffness, NJ)[j] * bent;
        }
        if (DAMPERS) passive -= ROW(dof_damping, NV)[i] * speed[i];
        arrays.qfrc_passive.data[out] = passive;
        total += passive;
    }
    arrays.qfrc_smooth.data[out] = total;
}
