// MuJoCo's Newton solver for the constraint forces of one world. Constants: NV (degrees of freedom, at most 32), ROWS (most
// constraint rows), STRIDE (from one row of a matrix to the next), DAMPED (whether dampers are integrated implicitly).
//
// On a GPU each lane holds what belongs to one degree of freedom (its row of a matrix too) and to every 32nd constraint row,
// in registers; others get it by FROM, which all lanes must reach together, so outside EACH_DOF. On the CPU one thread holds
// everything, and the same text is the serial solver. What all lanes read often is in shared memory.

#if defined(__CUDA_ARCH__)
#define EACH_DOF(i) if (const int i = lane; i < NV)
#define EACH_DOF_FROM(i, first) EACH_DOF(i)
#define ONE_DOF(i, wanted) if (const int i = lane; i == (wanted))
#define EACH_ROW(r, q) _Pragma("unroll") for (int q = 0, r = lane; q < HELD; ++q, r += 32) if (r < rows)
#define OF(values, i) values[0]
#define FROM(values, i) __shfl_sync(0xffffffffu, values[0], i)
#define ENTRY_FROM(matrix, i, j) __shfl_sync(0xffffffffu, matrix[0][j], i)
const int DOFS = 1, HELD = (ROWS + 31) / 32;
#else
#define EACH_DOF(i) for (int i = 0; i < NV; ++i)
#define EACH_DOF_FROM(i, first) for (int i = first; i < NV; ++i)
#define ONE_DOF(i, wanted) if (const int i = (wanted); true)
#define EACH_ROW(r, q) for (int r = 0, q = 0; r < rows; ++r, ++q)
#define OF(values, i) values[i]
#define FROM(values, i) values[i]
#define ENTRY_FROM(matrix, i, j) matrix[i][j]
const int DOFS = NV, HELD = ROWS;
#endif
LEGGED_SHARED float J[ROWS * STRIDE];
LEGGED_SHARED float M[NV * STRIDE];
LEGGED_SHARED float shown[STRIDE];  // a vector over degrees of freedom, for those who hold rows
LEGGED_SHARED float force[ROWS], curvature[ROWS];
float D[HELD], loss[HELD], x[HELD], jv[HELD], sides[HELD];  // of constraint rows
float a[DOFS], Ma[DOFS], Ms[DOFS], smooth[DOFS], grad[DOFS], s[DOFS], inverse[DOFS], column_of_L[DOFS];
float H[DOFS][NV];
const float TINY = 1e-15f;

const int ne = arrays.equalities.data[world], nf = ne + arrays.frictions.data[world];
const int rows = arrays.nefc.data[world] < ROWS ? arrays.nefc.data[world] : ROWS;
const int width = arrays.jacobian.shape[2];  // padded
const float* jacobian = arrays.jacobian.data + (long long)world * arrays.jacobian.shape[1] * width;

// Derivative of a row's cost at x. `side` tells the pieces of its cost apart: the curvature where it is quadratic.
auto pull = [&](int r, int q, float at, float& side) {
    side = D[q];
    if (r >= nf && at >= 0.0f) { side = 0.0f; return 0.0f; }
    if (r >= ne && r < nf) {
        if (D[q] * at > loss[q]) { side = -1.0f; return loss[q]; }
        if (D[q] * at < -loss[q]) { side = -2.0f; return -loss[q]; }
    }
    return D[q] * at;
};

meet();  // of the world before
EACH(k, NV * STRIDE) M[k] = 0.0f;
EACH(k, rows * NV)
    J[(k / NV) * STRIDE + k % NV] = jacobian[(k / NV) * width + k % NV];
EACH_ROW(r, q) {
    const int at = world * arrays.stiffness.shape[1] + r;
    D[q] = arrays.stiffness.data[at];
    loss[q] = arrays.frictionloss.data[at];
    sides[q] = -3.0f;
}
EACH_DOF(i) {
    OF(a, i) = arrays.warmstart.data[world * arrays.warmstart.shape[1] + i];
    OF(smooth, i) = arrays.qfrc_smooth.data[world * arrays.qfrc_smooth.shape[1] + i];
    shown[i] = OF(a, i);
}
meet();
float trace = 0.0f;
EACH_DOF(i) {
    const int from = arrays.row_start.data[i], count = arrays.row_count.data[i];
    for (int k = from; k < from + count; ++k) {
        const int j = arrays.column.data[k];
        const float m = arrays.inertia.data[world * arrays.inertia.shape[1] + k];
        M[i * STRIDE + j] = m;
        M[j * STRIDE + i] = m;
        if (i == j) trace += m;
    }
}
const float scale = 1.0f / most(TINY, sum(trace));
meet();
EACH_DOF(i) {
    float total = 0.0f;
    #pragma unroll
    for (int j = 0; j < NV; ++j) total += M[i * STRIDE + j] * shown[j];
    OF(Ma, i) = total;
}
EACH_ROW(r, q) {
    float total = -arrays.reference.data[world * arrays.reference.shape[1] + r];
    #pragma unroll
    for (int j = 0; j < NV; ++j) total += J[r * STRIDE + j] * shown[j];
    x[q] = total;
}

int round = 0;
// With dampers, what follows the last round is the solution of another system by the same lines: the acceleration that moves
// the world on, with dampers as they act at the end of the step (MuJoCo's Euler), (M + h D) a = all forces.
bool advancing = false;
while (true) {
    if (!advancing) {
        // Forces, the rows that changed sides, and the gradient.
        float changed = 0.0f;
        EACH_ROW(r, q) {
            float side;
            force[r] = -pull(r, q, x[q], side);
            curvature[r] = most(side, 0.0f);
            if (side != sides[q]) changed += 1.0f;
            sides[q] = side;
        }
        changed = sum(changed);
        meet();
        float squares = 0.0f;
        EACH_DOF(i) {
            float pushed = 0.0f;
            #pragma unroll 4
            for (int r = 0; r < rows; ++r) pushed += J[r * STRIDE + i] * force[r];
            arrays.qfrc_constraint.data[world * arrays.qfrc_constraint.shape[1] + i] = pushed;
            OF(grad, i) = OF(Ma, i) - OF(smooth, i) - pushed;
            squares += OF(grad, i) * OF(grad, i);
        }
        squares = sum(squares);
        if (round == most_rounds || scale * sqrtf(squares) < tolerance || (round > 0 && changed == 0.0f)) {
            if (!DAMPED) break;
            advancing = true;
        }
    }

    // Hessian M + J^T diag(curvature) J, or M + h D.
    EACH_DOF(i) {
        #pragma unroll
        for (int j = 0; j < NV; ++j) OF(H, i)[j] = M[i * STRIDE + j];
    }
    for (int r = 0; !advancing && r < rows; ++r) {
        if (curvature[r] == 0.0f) continue;
        EACH_DOF(i) {
            const float part = curvature[r] * J[r * STRIDE + i];
            #pragma unroll
            for (int j = 0; j < NV; ++j) OF(H, i)[j] += part * J[r * STRIDE + j];
        }
    }
    if (DAMPED && advancing) {
        const float h = arrays.timestep.data[world % arrays.timestep.shape[0]];
        const float* damping = arrays.damping.data + (long long)(world % arrays.damping.shape[0]) * NV;
        EACH_DOF(i) {
            #pragma unroll
            for (int j = 0; j < NV; ++j) if (i == j) OF(H, i)[j] += h * damping[i];
        }
    }
    // H = L diag(d) L^T, with L below the diagonal, L^T above it, and 1 / d apart.
    #pragma unroll
    for (int k = 0; k < NV; ++k) {
        const float over = 1.0f / most(ENTRY_FROM(H, k, k), TINY);
        EACH_DOF_FROM(i, k) OF(column_of_L, i) = i > k ? OF(H, i)[k] * over : 0.0f;
        #pragma unroll
        for (int j = k + 1; j < NV; ++j) {
            const float below = ENTRY_FROM(H, j, k);
            EACH_DOF_FROM(i, j) OF(H, i)[j] -= OF(column_of_L, i) * below;
            ONE_DOF(i, k) OF(H, i)[j] = below * over;
        }
        EACH_DOF_FROM(i, k + 1) OF(H, i)[k] = i > k ? OF(column_of_L, i) : OF(H, i)[k];
        ONE_DOF(i, k) OF(inverse, i) = over;
    }
    // The step s = -H^-1 grad, or the acceleration.
    EACH_DOF(i) OF(s, i) = DAMPED && advancing ? OF(Ma, i) - OF(grad, i) : -OF(grad, i);
    #pragma unroll
    for (int k = 0; k < NV - 1; ++k) {
        const float known = FROM(s, k);
        EACH_DOF_FROM(i, k + 1) if (i > k) OF(s, i) -= OF(H, i)[k] * known;
    }
    EACH_DOF(i) OF(s, i) *= OF(inverse, i);
    #pragma unroll
    for (int k = NV - 1; k > 0; --k) {
        const float known = FROM(s, k);
        EACH_DOF(i) if (i < k) OF(s, i) -= OF(H, i)[k] * known;
    }
    if (DAMPED && advancing) {
        EACH_DOF(i) arrays.advance.data[(long long)world * NV + i] = OF(s, i);
        break;
    }
    EACH_DOF(i) shown[i] = OF(s, i);
    meet();

    // Along the step: derivative slope + alpha * bend of the inertial part, and of every row.
    float slope = 0.0f, bend = 0.0f, length = 0.0f, decrement = 0.0f;
    EACH_DOF(i) {
        float total = 0.0f;
        #pragma unroll
        for (int j = 0; j < NV; ++j) total += M[i * STRIDE + j] * shown[j];
        OF(Ms, i) = total;
        slope += OF(s, i) * (OF(Ma, i) - OF(smooth, i));
        bend += OF(s, i) * total;
        length += OF(s, i) * OF(s, i);
        decrement -= OF(s, i) * OF(grad, i);
    }
    slope = sum(slope);
    bend = sum(bend);
    length = sum(length);
    decrement = sum(decrement);
    if (!(scale * 0.5f * decrement >= tolerance)) {  // nothing to gain; also where something is not a number
        if (!DAMPED) break;
        advancing = true;
        continue;
    }
    EACH_ROW(r, q) {
        float total = 0.0f;
        #pragma unroll
        for (int j = 0; j < NV; ++j) total += J[r * STRIDE + j] * shown[j];
        jv[q] = total;
    }
    const float flat = tolerance * ls_tolerance * sqrtf(length) / scale;
    float alpha = 1.0f, low = 0.0f, high = -1.0f;
    for (int k = 0; k < most_searches; ++k) {
        float first = 0.0f, second = 0.0f;
        EACH_ROW(r, q) {
            float side;
            first += jv[q] * pull(r, q, x[q] + alpha * jv[q], side);
            second += jv[q] * jv[q] * most(side, 0.0f);
        }
        first = sum(first) + slope + alpha * bend;
        second = sum(second) + bend;
        if (!(fabsf(first) > flat)) break;
        if (first < 0.0f) low = alpha; else high = alpha;
        float next = alpha - first / second;
        if (fabsf(next - alpha) <= 1e-7f * alpha) break;  // as near as float32 gets
        if (high > 0.0f && (next <= low || next >= high)) next = 0.5f * (low + high);
        alpha = next;
    }
    EACH_DOF(i) {
        OF(a, i) += alpha * OF(s, i);
        OF(Ma, i) += alpha * OF(Ms, i);
    }
    EACH_ROW(r, q) x[q] += alpha * jv[q];
    ++round;
}

EACH_DOF(i) {
    arrays.qacc.data[world * arrays.qacc.shape[1] + i] = OF(a, i);
    arrays.inertial.data[world * arrays.inertial.shape[1] + i] = OF(Ma, i);
}
EACH(r, rows) arrays.efc_force.data[world * arrays.efc_force.shape[1] + r] = force[r];
if (lane == 0) arrays.rounds.data[world] = round;
