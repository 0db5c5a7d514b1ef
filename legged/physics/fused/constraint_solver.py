"""MuJoCo's Newton solver for constraint forces, in one launch: a warp of threads for each world, all its data on the chip.

mujoco-warp takes about ten launches for a round of the solver and goes on until the slowest of all worlds has converged;
here a world that is done is done. What is minimised is the same (Todorov, ICRA 2014; MuJoCo documentation, "Computation"):
0.5 (a - a0)^T M (a - a0) + sum_r s_r(J_r a - aref_r) over accelerations a, with s_r quadratic on the side where a limit
or an edge of a friction pyramid pushes, and Huber's function for dry friction. Newton's method on that piecewise quadratic
function with an exact line search ends where no row changes sides any more.
"""

from typing import Any

import mujoco
import warp as wp

LANES = 32
"""Threads that solve one world on a GPU; on the CPU it is one."""
SHARED_BYTES = 48 * 1024
"""Memory that a block of threads may share."""

# Written for a warp. On a GPU each lane holds what belongs to one degree of freedom (its row of a matrix too) and to every
# 32nd constraint row, in registers; others get it by FROM, which all lanes must reach together, so outside EACH. On the CPU
# one thread holds everything and the same text is the serial solver. What all lanes read often is in shared memory; `meet`
# separates phases that write it from those that read.
SOURCE = """
    const int NV = %(nv)d, ROWS = %(rows)d, STEP = %(step)d;
#if defined(__CUDA_ARCH__)
    #define LEGGED_SHARED __shared__ alignas(16)
    #define EACH(i) if (const int i = threadIdx.x & 31; i < NV)
    #define EACH_FROM(i, first) EACH(i)
    #define ONLY(i, wanted) if (const int i = threadIdx.x & 31; i == (wanted))
    #define EACH_ROW(r, q) _Pragma("unroll") for (int q = 0, r = threadIdx.x & 31; q < HELD; ++q, r += 32) if (r < rows)
    #define OF(values, i) values[0]
    #define FROM(values, i) __shfl_sync(0xffffffffu, values[0], i)
    #define ENTRY_FROM(matrix, i, j) __shfl_sync(0xffffffffu, matrix[0][j], i)
    const int DOFS = 1, HELD = (ROWS + 31) / 32, lanes = 32, lane = threadIdx.x & 31;
    auto meet = []() { __syncwarp(); };
    auto sum = [](float x) {
        for (int apart = 16; apart > 0; apart >>= 1) x += __shfl_xor_sync(0xffffffffu, x, apart);
        return x;
    };
#else
    #define LEGGED_SHARED
    #define EACH(i) for (int i = 0; i < NV; ++i)
    #define EACH_FROM(i, first) for (int i = first; i < NV; ++i)
    #define ONLY(i, wanted) if (const int i = (wanted); true)
    #define EACH_ROW(r, q) for (int r = 0, q = 0; r < rows; ++r, ++q)
    #define OF(values, i) values[i]
    #define FROM(values, i) values[i]
    #define ENTRY_FROM(matrix, i, j) matrix[i][j]
    const int DOFS = NV, HELD = ROWS, lanes = 1, lane = 0;
    auto meet = []() {};
    auto sum = [](float x) { return x; };
#endif
    auto most = [](float p, float q) { return p > q ? p : q; };
    LEGGED_SHARED float J[ROWS * STEP];
    LEGGED_SHARED float M[NV * STEP];
    LEGGED_SHARED float shown[STEP];  // a vector over degrees of freedom, for those who hold rows
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
    for (int k = lane; k < NV * STEP; k += lanes) M[k] = 0.0f;
    for (int k = lane; k < rows * NV; k += lanes)
        J[(k / NV) * STEP + k %% NV] = jacobian[(k / NV) * width + k %% NV];
    EACH_ROW(r, q) {
        const int at = world * arrays.stiffness.shape[1] + r;
        D[q] = arrays.stiffness.data[at];
        loss[q] = arrays.frictionloss.data[at];
        sides[q] = -3.0f;
    }
    EACH(i) {
        OF(a, i) = arrays.warmstart.data[world * arrays.warmstart.shape[1] + i];
        OF(smooth, i) = arrays.qfrc_smooth.data[world * arrays.qfrc_smooth.shape[1] + i];
        shown[i] = OF(a, i);
    }
    meet();
    float trace = 0.0f;
    EACH(i) {
        const int from = arrays.row_start.data[i], count = arrays.row_count.data[i];
        for (int k = from; k < from + count; ++k) {
            const int j = arrays.column.data[k];
            const float m = arrays.inertia.data[world * arrays.inertia.shape[1] + k];
            M[i * STEP + j] = m;
            M[j * STEP + i] = m;
            if (i == j) trace += m;
        }
    }
    const float scale = 1.0f / most(TINY, sum(trace));
    meet();
    EACH(i) {
        float total = 0.0f;
        #pragma unroll
        for (int j = 0; j < NV; ++j) total += M[i * STEP + j] * shown[j];
        OF(Ma, i) = total;
    }
    EACH_ROW(r, q) {
        float total = -arrays.reference.data[world * arrays.reference.shape[1] + r];
        #pragma unroll
        for (int j = 0; j < NV; ++j) total += J[r * STEP + j] * shown[j];
        x[q] = total;
    }

    int round = 0;
    while (true) {
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
        EACH(i) {
            float pushed = 0.0f;
            #pragma unroll 4
            for (int r = 0; r < rows; ++r) pushed += J[r * STEP + i] * force[r];
            arrays.qfrc_constraint.data[world * arrays.qfrc_constraint.shape[1] + i] = pushed;
            OF(grad, i) = OF(Ma, i) - OF(smooth, i) - pushed;
            squares += OF(grad, i) * OF(grad, i);
        }
        squares = sum(squares);
        if (round == most_rounds || scale * sqrtf(squares) < tolerance || (round > 0 && changed == 0.0f)) break;

        // Hessian M + J^T diag(curvature) J.
        EACH(i) {
            #pragma unroll
            for (int j = 0; j < NV; ++j) OF(H, i)[j] = M[i * STEP + j];
        }
        for (int r = 0; r < rows; ++r) {
            if (curvature[r] == 0.0f) continue;
            EACH(i) {
                const float part = curvature[r] * J[r * STEP + i];
                #pragma unroll
                for (int j = 0; j < NV; ++j) OF(H, i)[j] += part * J[r * STEP + j];
            }
        }
        // H = L diag(d) L^T, with L below the diagonal, L^T above it, and 1 / d apart.
        #pragma unroll
        for (int k = 0; k < NV; ++k) {
            const float over = 1.0f / most(ENTRY_FROM(H, k, k), TINY);
            EACH_FROM(i, k) OF(column_of_L, i) = i > k ? OF(H, i)[k] * over : 0.0f;
            #pragma unroll
            for (int j = k + 1; j < NV; ++j) {
                const float below = ENTRY_FROM(H, j, k);
                EACH_FROM(i, j) OF(H, i)[j] -= OF(column_of_L, i) * below;
                ONLY(i, k) OF(H, i)[j] = below * over;
            }
            EACH_FROM(i, k + 1) OF(H, i)[k] = i > k ? OF(column_of_L, i) : OF(H, i)[k];
            ONLY(i, k) OF(inverse, i) = over;
        }
        // The step s = -H^-1 grad.
        EACH(i) OF(s, i) = -OF(grad, i);
        #pragma unroll
        for (int k = 0; k < NV - 1; ++k) {
            const float known = FROM(s, k);
            EACH_FROM(i, k + 1) if (i > k) OF(s, i) -= OF(H, i)[k] * known;
        }
        EACH(i) OF(s, i) *= OF(inverse, i);
        #pragma unroll
        for (int k = NV - 1; k > 0; --k) {
            const float known = FROM(s, k);
            EACH(i) if (i < k) OF(s, i) -= OF(H, i)[k] * known;
        }
        EACH(i) shown[i] = OF(s, i);
        meet();

        // Along the step: derivative slope + alpha * bend of the inertial part, and of every row.
        float slope = 0.0f, bend = 0.0f, length = 0.0f, decrement = 0.0f;
        EACH(i) {
            float total = 0.0f;
            #pragma unroll
            for (int j = 0; j < NV; ++j) total += M[i * STEP + j] * shown[j];
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
        if (!(scale * 0.5f * decrement >= tolerance)) break;  // nothing to gain; also where something is not a number
        EACH_ROW(r, q) {
            float total = 0.0f;
            #pragma unroll
            for (int j = 0; j < NV; ++j) total += J[r * STEP + j] * shown[j];
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
        EACH(i) {
            OF(a, i) += alpha * OF(s, i);
            OF(Ma, i) += alpha * OF(Ms, i);
        }
        EACH_ROW(r, q) x[q] += alpha * jv[q];
        ++round;
    }

    EACH(i) {
        arrays.qacc.data[world * arrays.qacc.shape[1] + i] = OF(a, i);
        arrays.inertial.data[world * arrays.inertial.shape[1] + i] = OF(Ma, i);
    }
    for (int r = lane; r < rows; r += lanes) arrays.efc_force.data[world * arrays.efc_force.shape[1] + r] = force[r];
    if (lane == 0) arrays.rounds.data[world] = round;
    #undef LEGGED_SHARED
    #undef EACH
    #undef EACH_FROM
    #undef ONLY
    #undef EACH_ROW
    #undef OF
    #undef FROM
    #undef ENTRY_FROM
"""


def row_length(nv: int) -> int:
    """Floats from one row of a matrix in shared memory to the next: whole vectors of four, an odd number of them, so that
    lanes that read rows side by side meet different banks.
    """
    return 4 * (-(-nv // 4) | 1)


@wp.struct
class SolverArrays:
    """What the solver reads of mujoco-warp's model and data, and from `qacc` on what it writes."""

    row_start: wp.array[int]
    row_count: wp.array[int]
    column: wp.array[int]
    inertia: wp.array2d[float]
    qfrc_smooth: wp.array2d[float]
    warmstart: wp.array2d[float]
    equalities: wp.array[int]
    frictions: wp.array[int]
    nefc: wp.array[int]
    jacobian: wp.array3d[float]
    stiffness: wp.array2d[float]
    reference: wp.array2d[float]
    frictionloss: wp.array2d[float]
    qacc: wp.array2d[float]
    inertial: wp.array2d[float]
    qfrc_constraint: wp.array2d[float]
    efc_force: wp.array2d[float]
    rounds: wp.array[int]


def solver_kernel(nv: int, rows: int) -> Any:
    """The kernel for models of `nv` degrees of freedom and at most `rows` constraint rows; launched for (worlds, lanes)."""

    @wp.func_native(SOURCE % {"nv": nv, "rows": rows, "step": row_length(nv)})
    def solve_world(
        world: int, most_rounds: int, most_searches: int, tolerance: float, ls_tolerance: float, arrays: SolverArrays
    ) -> None: ...

    @wp.kernel(module="unique", enable_backward=False)
    def solve_constraints(
        most_rounds: int, most_searches: int, tolerance: float, ls_tolerance: float, arrays: SolverArrays
    ) -> None:
        world, _lane = wp.tid()  # type: ignore[misc]
        solve_world(world, most_rounds, most_searches, tolerance, ls_tolerance, arrays)

    return solve_constraints


class ConstraintSolver:
    """Constraint forces and accelerations of all worlds, from what mujoco-warp has put into its data."""

    def __init__(self, m: Any, d: Any) -> None:
        """For mujoco-warp's model and data, of which there is nothing to say by `why_not`; call with their device as Warp's
        current one.
        """
        self._kernel = solver_kernel(m.nv, d.njmax)
        self._lanes = 1 if d.qacc.device.is_cpu else LANES
        efc, opt = d.efc, m.opt
        self._settings = [
            opt.iterations,
            opt.ls_iterations,
            float(opt.tolerance.numpy()[0]),
            float(opt.ls_tolerance.numpy()[0]),
        ]
        arrays = self._arrays = SolverArrays()
        arrays.row_start, arrays.row_count, arrays.column, arrays.inertia = m.M_rowadr, m.M_rownnz, m.M_colind, d.M
        arrays.qfrc_smooth, arrays.warmstart = d.qfrc_smooth, d.qacc_warmstart
        arrays.equalities, arrays.frictions, arrays.nefc = d.ne, d.nf, d.nefc
        arrays.jacobian, arrays.stiffness, arrays.reference = efc.J, efc.D, efc.aref
        arrays.frictionloss = efc.frictionloss
        arrays.qacc, arrays.inertial, arrays.qfrc_constraint = d.qacc, efc.Ma, d.qfrc_constraint
        arrays.efc_force, arrays.rounds = efc.force, d.solver_niter
        self._worlds = d.nworld

    @staticmethod
    def why_not(m: Any, d: Any) -> str:
        """What of a model this solver does not know; empty if nothing."""
        if m.nv > LANES:
            return f"it takes at most {LANES} degrees of freedom, the model has {m.nv}"
        floats = (d.njmax + m.nv + 1) * row_length(m.nv) + 2 * d.njmax
        if 4 * floats > SHARED_BYTES:
            return f"{d.njmax} constraint rows (sim.njmax) of {m.nv} numbers do not fit a GPU's shared memory"
        if m.is_sparse:
            return f"with {m.nv} degrees of freedom mujoco-warp keeps Jacobians sparse"
        if m.opt.solver != mujoco.mjtSolver.mjSOL_NEWTON:
            return "the model's solver is not Newton"
        if m.opt.cone != mujoco.mjtCone.mjCONE_PYRAMIDAL:
            return "friction cones are elliptic (sim.cone)"
        if m.opt.integrator != mujoco.mjtIntegrator.mjINT_EULER:
            return "the model's integrator is not Euler"
        if m.opt.noslip_iterations:
            return "the model asks for noslip iterations"
        return ""

    def solve(self) -> None:
        """From M, qfrc_smooth, the constraint rows and the last acceleration: qacc, qfrc_constraint and efc.force."""
        dim = (self._worlds, self._lanes)
        inputs = [*self._settings, self._arrays]
        wp.launch(self._kernel, dim=dim, inputs=inputs, block_dim=self._lanes)
