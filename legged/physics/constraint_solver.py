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

from legged.config import ConfigError

LANES = 32
"""Threads that solve one world on a GPU; on the CPU it is one."""
SHARED_BYTES = 48 * 1024
"""Memory that a block of threads may share."""

# Written for a warp: loops over rows or degrees of freedom are dealt out to the lanes, `meet` separates phases that write
# what others read, `sum` adds up over the lanes. With a single lane the same text is the serial solver.
SOURCE = """
#if defined(__CUDA_ARCH__)
    #define LEGGED_SHARED __shared__
    const int lanes = 32;
    const int lane = threadIdx.x & 31;
    auto meet = []() { __syncwarp(); };
    auto sum = [](float x) {
        for (int apart = 16; apart > 0; apart >>= 1) x += __shfl_xor_sync(0xffffffffu, x, apart);
        return x;
    };
#else
    #define LEGGED_SHARED
    const int lanes = 1;
    const int lane = 0;
    auto meet = []() {};
    auto sum = [](float x) { return x; };
#endif
    auto most = [](float p, float q) { return p > q ? p : q; };
    const int NV = %(nv)d, ROWS = %(rows)d, STEP = %(step)d;  // an odd row length spreads columns over all banks
    LEGGED_SHARED float J[ROWS * STEP], D[ROWS], x[ROWS], jv[ROWS], loss[ROWS], force[ROWS], sides[ROWS];
    LEGGED_SHARED float M[NV * STEP], H[NV * STEP];
    LEGGED_SHARED float a[NV], Ma[NV], Ms[NV], smooth[NV], grad[NV], s[NV];
    const float TINY = 1e-15f;

    const int ne = equalities.data[world], nf = ne + frictions.data[world];
    const int rows = nefc.data[world] < ROWS ? nefc.data[world] : ROWS;
    const int width = jacobian.shape[2];  // padded

    // Derivative of a row's cost at x. `side` tells the pieces of its cost apart: the curvature where it is quadratic.
    auto pull = [&](int r, float at, float& side) {
        side = D[r];
        if (r >= nf && at >= 0.0f) { side = 0.0f; return 0.0f; }
        if (r >= ne && r < nf) {
            if (D[r] * at > loss[r]) { side = -1.0f; return loss[r]; }
            if (D[r] * at < -loss[r]) { side = -2.0f; return -loss[r]; }
        }
        return D[r] * at;
    };

    meet();  // of the world before
    for (int k = lane; k < NV * STEP; k += lanes) M[k] = 0.0f;
    for (int k = lane; k < rows * NV; k += lanes)
        J[(k / NV) * STEP + k %% NV] = jacobian.data[((long long)world * jacobian.shape[1] + k / NV) * width + k %% NV];
    for (int r = lane; r < rows; r += lanes) {
        const int at = world * stiffness.shape[1] + r;
        D[r] = stiffness.data[at];
        loss[r] = frictionloss.data[at];
        sides[r] = -3.0f;
    }
    for (int i = lane; i < NV; i += lanes) {
        a[i] = warmstart.data[world * warmstart.shape[1] + i];
        smooth[i] = qfrc_smooth.data[world * qfrc_smooth.shape[1] + i];
    }
    meet();
    float trace = 0.0f;
    for (int i = lane; i < NV; i += lanes) {
        const int from = row_start.data[i], count = row_count.data[i];
        for (int k = from; k < from + count; ++k) {
            const int j = column.data[k];
            const float m = inertia.data[world * inertia.shape[1] + k];
            M[i * STEP + j] = m;
            M[j * STEP + i] = m;
            if (i == j) trace += m;
        }
    }
    const float scale = 1.0f / most(TINY, sum(trace));
    meet();
    for (int i = lane; i < NV; i += lanes) {
        float total = 0.0f;
        for (int j = 0; j < NV; ++j) total += M[i * STEP + j] * a[j];
        Ma[i] = total;
    }
    for (int r = lane; r < rows; r += lanes) {
        float total = -reference.data[world * reference.shape[1] + r];
        for (int j = 0; j < NV; ++j) total += J[r * STEP + j] * a[j];
        x[r] = total;
    }

    int round = 0;
    while (true) {
        // Forces, the rows that changed sides, and the gradient.
        float changed = 0.0f;
        for (int r = lane; r < rows; r += lanes) {
            float side;
            force[r] = -pull(r, x[r], side);
            if (side != sides[r]) changed += 1.0f;
            sides[r] = side;
        }
        changed = sum(changed);
        meet();
        float squares = 0.0f;
        for (int i = lane; i < NV; i += lanes) {
            float pushed = 0.0f;
            for (int r = 0; r < rows; ++r) pushed += J[r * STEP + i] * force[r];
            qfrc_constraint.data[world * qfrc_constraint.shape[1] + i] = pushed;
            grad[i] = Ma[i] - smooth[i] - pushed;
            squares += grad[i] * grad[i];
        }
        squares = sum(squares);
        if (round == most_rounds || scale * sqrtf(squares) < tolerance || (round > 0 && changed == 0.0f)) break;

        // Hessian M + J^T diag(curvature) J, its Cholesky factor (lower), and the step s = -H^-1 grad.
        for (int k = lane; k < NV * (NV + 1) / 2; k += lanes) {
            int i = (int)((sqrtf(8.0f * k + 1.0f) - 1.0f) * 0.5f);
            while ((i + 1) * (i + 2) / 2 <= k) ++i;
            while (i * (i + 1) / 2 > k) --i;
            const int j = k - i * (i + 1) / 2;
            float total = M[i * STEP + j];
            for (int r = 0; r < rows; ++r) total += most(sides[r], 0.0f) * J[r * STEP + i] * J[r * STEP + j];
            H[i * STEP + j] = total;
        }
        meet();
        for (int k = 0; k < NV; ++k) {
            const float root = sqrtf(most(H[k * STEP + k], TINY));
            meet();
            for (int i = k + lane; i < NV; i += lanes) H[i * STEP + k] = i == k ? root : H[i * STEP + k] / root;
            meet();
            for (int i = k + 1 + lane; i < NV; i += lanes)
                for (int j = k + 1; j <= i; ++j) H[i * STEP + j] -= H[i * STEP + k] * H[j * STEP + k];
            meet();
        }
        for (int i = lane; i < NV; i += lanes) s[i] = -grad[i];
        meet();
        for (int k = 0; k < NV; ++k) {
            const float solved = s[k] / H[k * STEP + k];
            meet();
            for (int i = k + lane; i < NV; i += lanes) s[i] = i == k ? solved : s[i] - H[i * STEP + k] * solved;
            meet();
        }
        for (int k = NV - 1; k >= 0; --k) {
            const float solved = s[k] / H[k * STEP + k];
            meet();
            for (int i = lane; i <= k; i += lanes) s[i] = i == k ? solved : s[i] - H[k * STEP + i] * solved;
            meet();
        }

        // Along the step: derivative slope + alpha * bend of the inertial part, and of every row.
        float slope = 0.0f, bend = 0.0f, length = 0.0f, decrement = 0.0f;
        for (int i = lane; i < NV; i += lanes) {
            float total = 0.0f;
            for (int j = 0; j < NV; ++j) total += M[i * STEP + j] * s[j];
            Ms[i] = total;
            slope += s[i] * (Ma[i] - smooth[i]);
            bend += s[i] * total;
            length += s[i] * s[i];
            decrement -= s[i] * grad[i];
        }
        slope = sum(slope);
        bend = sum(bend);
        length = sum(length);
        decrement = sum(decrement);
        if (!(scale * 0.5f * decrement >= tolerance)) break;  // nothing to gain; also where something is not a number
        for (int r = lane; r < rows; r += lanes) {
            float total = 0.0f;
            for (int j = 0; j < NV; ++j) total += J[r * STEP + j] * s[j];
            jv[r] = total;
        }
        const float flat = tolerance * ls_tolerance * sqrtf(length) / scale;
        float alpha = 1.0f, low = 0.0f, high = -1.0f;
        for (int k = 0; k < most_searches; ++k) {
            float first = 0.0f, second = 0.0f;
            for (int r = lane; r < rows; r += lanes) {
                float side;
                first += jv[r] * pull(r, x[r] + alpha * jv[r], side);
                second += jv[r] * jv[r] * most(side, 0.0f);
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
        for (int i = lane; i < NV; i += lanes) {
            a[i] += alpha * s[i];
            Ma[i] += alpha * Ms[i];
        }
        for (int r = lane; r < rows; r += lanes) x[r] += alpha * jv[r];
        ++round;
    }

    for (int i = lane; i < NV; i += lanes) {
        qacc.data[world * qacc.shape[1] + i] = a[i];
        inertial.data[world * inertial.shape[1] + i] = Ma[i];
    }
    for (int r = lane; r < rows; r += lanes) efc_force.data[world * efc_force.shape[1] + r] = force[r];
    if (lane == 0) rounds.data[world] = round;
    #undef LEGGED_SHARED
"""


def solver_kernel(nv: int, rows: int) -> Any:
    """The kernel for models of `nv` degrees of freedom and at most `rows` constraint rows; launched for (worlds, lanes)."""

    @wp.func_native(SOURCE % {"nv": nv, "rows": rows, "step": nv | 1})
    def solve_world(
        world: int,
        most_rounds: int,
        most_searches: int,
        tolerance: float,
        ls_tolerance: float,
        row_start: wp.array[int],
        row_count: wp.array[int],
        column: wp.array[int],
        inertia: wp.array2d[float],
        qfrc_smooth: wp.array2d[float],
        warmstart: wp.array2d[float],
        equalities: wp.array[int],
        frictions: wp.array[int],
        nefc: wp.array[int],
        jacobian: wp.array3d[float],
        stiffness: wp.array2d[float],
        reference: wp.array2d[float],
        frictionloss: wp.array2d[float],
        qacc: wp.array2d[float],
        inertial: wp.array2d[float],
        qfrc_constraint: wp.array2d[float],
        efc_force: wp.array2d[float],
        rounds: wp.array[int],
    ) -> None: ...

    @wp.kernel(module="unique", enable_backward=False)
    def solve_constraints(
        most_rounds: int,
        most_searches: int,
        tolerance: float,
        ls_tolerance: float,
        row_start: wp.array[int],
        row_count: wp.array[int],
        column: wp.array[int],
        inertia: wp.array2d[float],
        qfrc_smooth: wp.array2d[float],
        warmstart: wp.array2d[float],
        equalities: wp.array[int],
        frictions: wp.array[int],
        nefc: wp.array[int],
        jacobian: wp.array3d[float],
        stiffness: wp.array2d[float],
        reference: wp.array2d[float],
        frictionloss: wp.array2d[float],
        qacc: wp.array2d[float],
        inertial: wp.array2d[float],
        qfrc_constraint: wp.array2d[float],
        efc_force: wp.array2d[float],
        rounds: wp.array[int],
    ) -> None:
        world, _lane = wp.tid()  # type: ignore[misc]
        solve_world(
            world,
            most_rounds,
            most_searches,
            tolerance,
            ls_tolerance,
            row_start,
            row_count,
            column,
            inertia,
            qfrc_smooth,
            warmstart,
            equalities,
            frictions,
            nefc,
            jacobian,
            stiffness,
            reference,
            frictionloss,
            qacc,
            inertial,
            qfrc_constraint,
            efc_force,
            rounds,
        )

    return solve_constraints


class ConstraintSolver:
    """Constraint forces and accelerations of all worlds, from what mujoco-warp has put into its data."""

    def __init__(self, m: Any, d: Any) -> None:
        """For mujoco-warp's model and data; call with their device as Warp's current one.

        Raises:
            ConfigError: the model has what this solver does not know.
        """
        if reason := self.why_not(m, d):
            raise ConfigError(f"sim.constraint_solver=fused: {reason}; sim.constraint_solver=rounds takes it")
        self._kernel = solver_kernel(m.nv, d.njmax)
        self._lanes = 1 if d.qacc.device.is_cpu else LANES
        efc, opt = d.efc, m.opt
        settings = [opt.iterations, opt.ls_iterations, float(opt.tolerance.numpy()[0]), float(opt.ls_tolerance.numpy()[0])]
        inertia = [m.M_rowadr, m.M_rownnz, m.M_colind, d.M]
        rows = [d.ne, d.nf, d.nefc, efc.J, efc.D, efc.aref, efc.frictionloss]
        self._inputs = [*settings, *inertia, d.qfrc_smooth, d.qacc_warmstart, *rows]
        self._outputs = [d.qacc, efc.Ma, d.qfrc_constraint, efc.force, d.solver_niter]
        self._worlds = d.nworld

    @staticmethod
    def why_not(m: Any, d: Any) -> str:
        """What of a model this solver does not know; empty if nothing."""
        floats = (d.njmax + 2 * m.nv) * (m.nv | 1) + 6 * d.njmax + 6 * m.nv
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
        wp.launch(self._kernel, dim=dim, inputs=self._inputs, outputs=self._outputs, block_dim=self._lanes)
