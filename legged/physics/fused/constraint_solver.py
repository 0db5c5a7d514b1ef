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

from legged.physics.fused.native import LANES, SHARED_BYTES, native_source


def row_length(nv: int) -> int:
    """Floats from one row of a matrix in shared memory to the next: whole vectors of four, an odd number of them, so that
    lanes that read rows side by side meet different banks.
    """
    return 4 * (-(-nv // 4) | 1)


@wp.struct
class SolverArrays:
    """What the solver reads of mujoco-warp's model and data; from `qacc` to `rounds` what it writes; and what it reads and
    writes besides where there are dampers.
    """

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
    timestep: wp.array[float]
    damping: wp.array2d[float]
    advance: wp.array2d[float]


def solver_constants(nv: int, rows: int, damped: bool = False) -> dict[str, int | bool]:
    """Return what constraint_solver.h asks for, of models of `nv` degrees of freedom and at most `rows` constraint rows, with
    dampers to integrate implicitly or without.
    """
    return {"NV": nv, "ROWS": rows, "STRIDE": row_length(nv), "DAMPED": damped}


def solver_kernel(constants: dict[str, int | bool]) -> Any:
    """Return the kernel for some `solver_constants`; launched for (worlds, lanes)."""

    @wp.func_native(native_source("constraint_solver.h", constants))
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

    advance: wp.array2d
    """(worlds, nv) the accelerations that integrate velocities: `qacc`, or with dampers integrated implicitly another."""

    def __init__(self, m: Any, d: Any, damped: bool = False) -> None:
        """Prepare the launch for mujoco-warp's model and data, of which `why_not` says nothing; with `damped`, compute what
        integrates dampers implicitly too. Call with their device as Warp's current one.
        """
        self._kernel = solver_kernel(solver_constants(m.nv, d.njmax, damped))
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
        self.advance = wp.zeros_like(d.qacc) if damped else d.qacc
        arrays.timestep, arrays.damping, arrays.advance = opt.timestep, m.dof_damping, self.advance
        self._worlds = d.nworld

    @staticmethod
    def why_not(m: Any, d: Any) -> str:
        """Return what of a model this solver does not know; empty if nothing."""
        if not 1 <= m.nv <= LANES:
            return f"it takes 1 to {LANES} degrees of freedom, the model has {m.nv}"
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
        if m.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_WARMSTART:
            return "the model disables warm starts"
        if max(len(m.opt.tolerance), len(m.opt.ls_tolerance)) > 1:
            return "worlds differ in the solver's tolerances"
        return ""

    def solve(self) -> None:
        """Compute qacc, qfrc_constraint and efc.force from M, qfrc_smooth, the constraint rows and the last acceleration."""
        dim = (self._worlds, self._lanes)
        inputs = [*self._settings, self._arrays]
        wp.launch(self._kernel, dim=dim, inputs=inputs, block_dim=self._lanes)
