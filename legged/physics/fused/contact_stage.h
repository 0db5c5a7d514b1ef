// Constraint rows of one world: dry friction, joint limits, and the `found` contacts in the world's slots. They follow the
// rows of equality constraints, which exist already. Constants: NV (degrees of freedom), NJ (joints), ROWS (largest number of
// rows), SLOTS (largest number of contacts), PLAIN (largest number of rows of friction and limits), DIMS (largest number of
// directions of a contact), FRICTIONS (the model has dry friction), LIMITS (joint limits), BALLS (ball joints), EQUALITIES
// (equality constraints), DENSE_FRICTION (the Jacobian's rows of dry friction are read), BOUNCES (the springs of contacts
// differ between worlds), ELLIPTIC (friction cones instead of pyramids), and MuJoCo's numbers BALL, CONSTRAINT (a type of
// contact), FRICTIONLESS, FRICTIONAL (types of rows), NARROWPHASE (an overflow flag). Each row has a key, with which the
// solver finds the row's state in the last step. Keys ascend from row to row: first those of degrees of freedom, then of
// joints, then of candidates for contacts.

// Record of a contact: its offsets from the centres of mass of the two trees, its axes, its friction coefficients, and the
// parameters of its rows.
const int OFFSET = 0, FRAME = 6, FRICTION = 15, STIFFNESS = 20, PULL = 21, DAMPING = 22, SLIDING = 23, RECORD = 24;
const int HELD = (NV + LANES - 1) / LANES;
const int MOST_EDGES = 2 * (DIMS > 1 ? DIMS - 1 : 1);  // largest number of rows of a contact
LEGGED_SHARED float record[SLOTS * RECORD];
LEGGED_SHARED int directions[SLOTS], first_row[SLOTS], bodies[2 * SLOTS];
LEGGED_SHARED float entry[3 * PLAIN];  // a row of friction or of a limit has up to three adjacent entries
LEGGED_SHARED int entry_dof[PLAIN];
const float TINY = 1e-15f, LEAST_FRICTION = 1e-5f;

auto row_of = [&](const auto& array, int length) {
    const float* data = reinterpret_cast<const float*>(array.data);
    const int given = array.shape[0];
    return given == 1 ? data : data + (long long)(world < given ? world : world % given) * length;
};
// Returns the impedance of a constraint with violation -pos. A spring holds stiffness, damping, and the parameters of the
// impedance curve, from its least to its greatest value (contact_pairs.py).
const int SPRING = 7;
auto impedance = [](const float* spring, float pos) {
    const float least = spring[2], greatest = spring[3], middle = spring[5], power = spring[6];
    const float at = fabsf(pos) / spring[4];
    if (at <= 0.0f) return least;
    if (at >= 1.0f) return greatest;
    if (power == 1.0f) return least + at * (greatest - least);
    const float y = at <= middle ? powf(at, power) / powf(middle, power - 1.0f)
                                 : 1.0f - powf(1.0f - at, power) / powf(1.0f - middle, power - 1.0f);
    return least + y * (greatest - least);
};
auto stiffness_of = [&](float inverse_weight, float impedance) {
    return 1.0f / most(inverse_weight * (1.0f - impedance) / impedance, TINY);
};
const int width = arrays.jacobian.shape[2];  // padded length of a row
// Returns a pointer to the number of this world's row `row` in an array. Arrays may have room for different numbers of rows.
auto at_row = [&](const auto& array, int row) { return array.data + (long long)world * array.shape[1] + row; };
float* jacobian = arrays.jacobian.data + (long long)world * arrays.jacobian.shape[1] * width;
auto put = [&](int row, int key, float stiffness, float reference, float loss) {
    if (row >= ROWS) return;
    *at_row(arrays.row_key, row) = key;
    *at_row(arrays.stiffness, row) = stiffness;
    *at_row(arrays.reference, row) = reference;
    *at_row(arrays.frictionloss, row) = loss;
};
const float* v_in = arrays.qvel.data + (long long)world * NV;
[[maybe_unused]] const float* q_in = arrays.qpos.data + (long long)world * arrays.qpos.shape[1];
[[maybe_unused]] const float* dof_weights = row_of(arrays.dof_invweight0, NV);

meet();  // wait until the previous world is finished, and all lanes have found their contacts
const int start = EQUALITIES ? arrays.equalities.data[world] : 0;
int rows = start;
if (FRICTIONS) {
    const float* losses = row_of(arrays.dof_frictionloss, NV);
    for (int from = 0; from < NV; from += LANES) {
        const int i = from + lane;
        const bool is = i < NV && losses[i] > 0.0f;
        const int place = rows - start + (int)before(is ? 1.0f : 0.0f);
        rows += (int)sum(is ? 1.0f : 0.0f);
        if (!is) continue;
        const float* spring = arrays.dof_spring.data + i * SPRING;
        put(start + place, i, stiffness_of(dof_weights[i], impedance(spring, 0.0f)), -spring[1] * v_in[i], losses[i]);
        // The solver reads from `row_id` which degree of freedom the friction belongs to.
        if (start + place < ROWS) *at_row(arrays.row_id, start + place) = i;
        entry_dof[place] = i;
        for (int k = 0; k < 3; ++k) entry[3 * place + k] = k == 0 ? 1.0f : 0.0f;
    }
}
const int frictions = rows - start;
if (LIMITS) {
    for (int from = 0; from < NJ; from += LANES) {
        const int j = from + lane;
        bool is = j < NJ && arrays.jnt_limited.data[j];
        float pos = 0.0f, speed = 0.0f, pulled[3] = {0.0f, 0.0f, 0.0f};
        int dof = 0;
        if (is) {
            const float* range = row_of(arrays.jnt_range, 2 * NJ) + 2 * j;
            const float* q = q_in + arrays.jnt_qposadr.data[j];
            dof = arrays.jnt_dofadr.data[j];
            if (BALLS && arrays.jnt_type.data[j] == BALL) {
                float turn[4] = {q[0], q[1], q[2], q[3]};
                normalize(turn);
                const float sine = sqrtf(turn[1] * turn[1] + turn[2] * turn[2] + turn[3] * turn[3]);
                float angle = 2.0f * atan2f(sine, turn[0]);
                if (angle > 3.14159265f) angle -= 6.28318531f;
                pos = most(range[0], range[1]) - fabsf(angle);
                for (int k = 0; k < 3; ++k) {
                    pulled[k] = sine == 0.0f ? 0.0f : (angle < 0.0f ? turn[1 + k] : -turn[1 + k]) / sine;
                    speed += pulled[k] * v_in[dof + k];
                }
            } else {
                const float below = q[0] - range[0], above = range[1] - q[0];
                pulled[0] = below < above ? 1.0f : -1.0f;
                pos = below < above ? below : above;
                speed = pulled[0] * v_in[dof];
            }
            pos -= row_of(arrays.jnt_margin, NJ)[j];
            is = pos < 0.0f;
        }
        const int place = rows - start + (int)before(is ? 1.0f : 0.0f);
        rows += (int)sum(is ? 1.0f : 0.0f);
        if (!is) continue;
        const float* spring = arrays.joint_spring.data + j * SPRING;
        const float impeded = impedance(spring, pos);
        const float reference = -spring[0] * impeded * pos - spring[1] * speed;
        put(start + place, NV + j, stiffness_of(dof_weights[dof], impeded), reference, 0.0f);
        entry_dof[place] = dof;
        for (int k = 0; k < 3; ++k) entry[3 * place + k] = pulled[k];
    }
}
const int plain = rows - start;

// Each lane fills the record of one contact. Later, all lanes read all records.
const int contacts = found < SLOTS ? found : SLOTS;
for (int from = 0; from < contacts; from += LANES) {
    const int c = from + lane;
    const bool is = c < contacts;
    const long long slot = (long long)world * SLOTS + c;
    const int touch = is ? arrays.contact_touch.data[slot] : 0;
    const int dim = is ? arrays.touch_dim.data[touch] : 0;
    const int needed = ELLIPTIC || dim < 2 ? dim : 2 * (dim - 1);
    const int row = rows + (int)before((float)needed);
    rows += (int)sum((float)needed);
    if (!is) continue;
    float* out = record + c * RECORD;
    directions[c] = dim;
    first_row[c] = row;
    float weight = 0.0f;
    const float* pos = reinterpret_cast<const float*>(arrays.contact_pos.data) + 3 * slot;
    for (int side = 0; side < 2; ++side) {
        const int geom = reinterpret_cast<const int*>(arrays.touch_geom.data)[2 * touch + side];
        const int body = arrays.geom_bodyid.data[geom], root = arrays.body_rootid.data[body];
        const float* com = reinterpret_cast<const float*>(arrays.subtree_com.data)
            + 3 * ((long long)world * arrays.subtree_com.shape[1] + root);
        bodies[2 * c + side] = body;
        weight += row_of(arrays.body_invweight0, 2 * arrays.body_invweight0.shape[1])[2 * body];
        for (int k = 0; k < 3; ++k) out[OFFSET + 3 * side + k] = body == 0 ? 0.0f : pos[k] - com[k];
        reinterpret_cast<int*>(arrays.contact_geom.data)[2 * slot + side] = geom;
    }
    const float* frame = reinterpret_cast<const float*>(arrays.contact_frame.data) + 9 * slot;
    for (int k = 0; k < 9; ++k) out[FRAME + k] = frame[k];
    // Sliding friction is the same along both tangents, and rolling friction about both.
    const int* rough = reinterpret_cast<const int*>(arrays.touch_rough.data) + 2 * touch;
    const float* frictions_of = row_of(arrays.geom_friction, 3 * arrays.geom_friction.shape[1]);
    const int column[5] = {0, 0, 1, 2, 2};
    float* shown = reinterpret_cast<float*>(arrays.contact_friction.data) + 5 * slot;
    for (int k = 0; k < 5; ++k) {
        float friction = rough[0] < 0 ? reinterpret_cast<const float*>(arrays.touch_friction.data)[5 * touch + k]
            : most(frictions_of[3 * rough[0] + column[k]], frictions_of[3 * rough[1] + column[k]]);
        friction = most(LEAST_FRICTION, friction);
        out[FRICTION + k] = shown[k] = friction;
    }
    const float* spring = arrays.touch_spring.data + touch * SPRING;
    const float margin = arrays.touch_margin.data[touch], depth = arrays.contact_dist.data[slot] - margin;
    const float mu = out[FRICTION], root_ratio = arrays.impratio_invsqrt.data[0];
    const float impeded = impedance(spring, depth);
    if (!ELLIPTIC && dim > 1) weight = (weight + mu * mu * weight) * 2.0f * mu * mu * root_ratio * root_ratio;
    out[STIFFNESS] = stiffness_of(weight, impeded);
    float stiff = spring[0], damp = spring[1], slide = arrays.touch_sliding.data[touch];
    if (BOUNCES && rough[0] >= 0) {
        const float* bounce = reinterpret_cast<const float*>(arrays.touch_bounce.data) + 2 * touch;
        const float* of_world = row_of(arrays.geom_solref, 2 * arrays.geom_solref.shape[1]) + 2 * rough[0];
        const float time = bounce[1] * most(of_world[0], bounce[0]);
        stiff = 1.0f / (time * of_world[1] * time * of_world[1]);
        damp = slide = 2.0f / time;
    }
    out[PULL] = -stiff * impeded * depth;
    out[DAMPING] = damp;
    out[SLIDING] = slide;
    arrays.contact_dim.data[slot] = dim;
    arrays.contact_includemargin.data[slot] = margin;
    arrays.contact_worldid.data[slot] = world;
    arrays.contact_type.data[slot] = CONSTRAINT;
    arrays.contact_adhesion.data[slot] = 0.0f;
    int* addresses = arrays.contact_efc_address.data + slot * arrays.contact_efc_address.shape[1];
    // Readers compare addresses with the number of rows, so an address may lie beyond the last row. Readers test the sign of
    // the first address, so it is negative if the contact has no row.
    for (int k = 0; k < needed; ++k) addresses[k] = k > 0 || row < ROWS ? row + k : -1;
}
for (int c = contacts + lane; c < SLOTS; c += LANES)
    arrays.contact_efc_address.data[((long long)world * SLOTS + c) * arrays.contact_efc_address.shape[1]] = -1;
if (lane == 0) {
    arrays.frictions.data[world] = frictions;
    arrays.limits.data[world] = plain - frictions;
    arrays.nefc.data[world] = rows;
    if (!EQUALITIES) arrays.equalities.data[world] = 0;
    if (found > SLOTS) arrays.overflow.data[world] |= NARROWPHASE;
    // All slots count as contacts; empty ones have no rows.
    if (world == 0) arrays.nacon.data[0] = arrays.contact_dist.shape[0];
}
meet();
const int unread = DENSE_FRICTION ? 0 : frictions;
EACH(k, ((start + plain < ROWS ? plain : ROWS - start) - unread) * NV) {
    const int place = unread + k / NV, i = k % NV, at = i - entry_dof[place];
    jacobian[(start + place) * width + i] = at >= 0 && at < 3 ? entry[3 * place + at] : 0.0f;
}
float moved[HELD][6], speeds[HELD];
for (int q = 0, i = lane; q < HELD; ++q, i += LANES) {
    speeds[q] = i < NV ? v_in[i] : 0.0f;
    for (int k = 0; k < 6; ++k)
        moved[q][k] = i < NV ? reinterpret_cast<const float*>(arrays.cdof.data)[((long long)world * NV + i) * 6 + k] : 0.0f;
}
for (int c = 0; c < contacts; ++c) {
    const float* of = record + c * RECORD;
    const int dim = directions[c], row = first_row[c], mark = arrays.contact_mark.data[(long long)world * SLOTS + c];
    const int* carried_by = arrays.body_isdofancestor.data;
    const int of_body = arrays.body_isdofancestor.shape[1];
    float speed[DIMS];
    for (int k = 0; k < DIMS; ++k) speed[k] = 0.0f;
    for (int q = 0, i = lane; q < HELD; ++q, i += LANES) {
        if (i >= NV) continue;
        float pushed[3] = {0.0f, 0.0f, 0.0f}, turned[3] = {0.0f, 0.0f, 0.0f}, along[DIMS];
        for (int side = 0; side < 2; ++side) {
            if (!carried_by[bodies[2 * c + side] * of_body + i]) continue;
            const float sign = side == 0 ? -1.0f : 1.0f;
            float swung[3];
            cross(moved[q], of + OFFSET + 3 * side, swung);
            for (int k = 0; k < 3; ++k) {
                pushed[k] += sign * (moved[q][3 + k] + swung[k]);
                turned[k] += sign * moved[q][k];
            }
        }
        for (int k = 0; k < DIMS; ++k) {
            const float* axis = of + FRAME + 3 * (k < 3 ? k : k - 3);
            const float* motion = k < 3 ? pushed : turned;
            along[k] = axis[0] * motion[0] + axis[1] * motion[1] + axis[2] * motion[2];
            speed[k] += along[k] * speeds[q];
        }
        float* out = jacobian + row * width + i;
        if (ELLIPTIC || dim == 1) {
            for (int k = 0; k < DIMS; ++k)
                if (k < dim && row + k < ROWS) out[k * width] = along[k];
        } else {
            for (int k = 1; k < DIMS; ++k) {
                if (k >= dim) continue;
                const float sideways = of[FRICTION + k - 1] * along[k];
                if (row + 2 * k - 2 < ROWS) out[(2 * k - 2) * width] = along[0] + sideways;
                if (row + 2 * k - 1 < ROWS) out[(2 * k - 1) * width] = along[0] - sideways;
            }
        }
    }
    for (int k = 0; k < DIMS; ++k) speed[k] = sum(speed[k]);
    EACH(r, ELLIPTIC || dim < 2 ? dim : 2 * (dim - 1)) {
        float stiffness = of[STIFFNESS], along = ELLIPTIC && r > 0 ? 0.0f : speed[0];
        for (int k = 1; k < DIMS; ++k) {
            if (ELLIPTIC && k == r) along = speed[k];
            if (!ELLIPTIC && k == 1 + r / 2 && dim > 1) along += (r % 2 ? -1.0f : 1.0f) * of[FRICTION + k - 1] * speed[k];
        }
        float reference = of[PULL] - of[DAMPING] * along;
        if (ELLIPTIC && r > 0) {
            const float root_ratio = arrays.impratio_invsqrt.data[0], rest = of[FRICTION] / of[FRICTION + r - 1];
            stiffness /= root_ratio * root_ratio * (r > 1 ? rest * rest : 1.0f);
            reference = -of[SLIDING] * along;
        }
        put(row + r, NV + NJ + MOST_EDGES * mark + r, stiffness, reference, 0.0f);
        if (ELLIPTIC && row + r < ROWS) {
            *at_row(arrays.row_type, row + r) = dim == 1 ? FRICTIONLESS : FRICTIONAL;
            *at_row(arrays.row_id, row + r) = world * SLOTS + c;
        }
    }
}
