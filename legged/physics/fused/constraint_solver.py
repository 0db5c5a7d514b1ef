"""MuJoCo's Newton solver for constraint forces in one launch. One warp of threads computes each world, whose data stay on the
chip.

mujoco-warp needs about ten launches per iteration of the solver, and iterates until the slowest world has converged. Here
each world stops when it has converged. The objective is the same (Todorov, ICRA 2014; MuJoCo documentation, "Computation"):
0.5 (a - a0)^T M (a - a0) + sum_r s_r(J_r a - aref_r) over accelerations a. For a limit or an edge of a friction pyramid, s_r
is quadratic on the side on which the constraint exerts force; for dry friction it is Huber's function. The objective is
piecewise quadratic. A row's state tells which piece of the row's cost applies. Newton's method with a line search ends when
no row changes its state. It starts with the states of the last step (active_set.py). These states define a quadratic function
whose minimum is usually near the solution.
"""

from typing import Any

import mujoco
import numpy as np
import warp as wp

from legged.physics.fused.active_set import ROW_STATES, ActiveSet
from legged.physics.fused.native import LANES, Constant, lanes_of, native_source
from legged.physics.fused.solver_arrays import SolverArrays
from legged.physics.fused.tree import MOST_DOFS, Tree
from legged.physics.fused.wide_solver import WIDE, fits_wide, wide_constants, wide_kernel

SOURCE = ("constraint_rows.h", "elliptic_cones.h", "elimination.h", "constraint_solver.h")
ELLIPTIC_ROW = int(mujoco.mjtConstraint.mjCNSTR_CONTACT_ELLIPTIC)
MOST_ROWS = 512
KEPT_BYTES = 3600
"""Largest part of a Jacobian that a block keeps in shared memory [bytes]. The block reads further rows from global memory.
With this limit, more worlds fit on a multiprocessor."""
MULTIPROCESSOR_BYTES, BYTES_OF_A_BLOCK = 228 * 1024, 1024
"""Shared memory of a multiprocessor of an H100, and the part of it that each block reserves [bytes]."""


def row_length(nv: int) -> int:
    """Return the number of floats from one row of a matrix to the next in shared memory. It is an odd multiple of four, so
    that lanes that read different rows use different memory banks.
    """
    return 4 * (-(-nv // 4) | 1)


def solver_constants(
    tree: Tree,
    rows: int,
    entries: int,
    damped: bool = False,
    friction: bool = True,
    dry: bool = True,
    elliptic: bool = False,
    known: bool = False,
) -> dict[str, int | bool]:
    """Return the constants of the native sources (SOURCE).

    Args:
        tree: elimination tree of the degrees of freedom.
        rows: largest number of constraint rows.
        entries: number of stored entries of the mass matrix.
        damped: True if dampers are integrated implicitly.
        friction: True if there are rows of dry friction.
        dry: True if all rows of dry friction belong to degrees of freedom, and none to tendons.
        elliptic: True for elliptic friction cones.
        known: True if rows have keys. The solver uses a row's key to find the row's state in the last step.
    """
    nv = len(tree.parent)
    sizes = {"NV": nv, "ROWS": rows, "STRIDE": row_length(nv), "ENTRIES": entries}
    sizes["KEPT_ROWS"] = min(rows, KEPT_BYTES // (4 * sizes["STRIDE"]))
    kinds = {
        "DAMPED": damped,
        "FRICTION": friction,
        "DRY": friction and dry,
        "ELLIPTIC": elliptic,
        "ELLIPTIC_ROW": ELLIPTIC_ROW,
        "KNOWN": known and not elliptic,
    }
    return {**sizes, **kinds, **ROW_STATES, **tree.constants()}


def blocks(constants: dict[str, int | bool]) -> int:
    """Return the number of worlds that a multiprocessor must be able to run at once; the compiler limits the registers of a
    lane accordingly. It is the largest multiple of 4, from 4 to 32, for which the shared memory suffices.
    """
    nv, rows, stride = constants["NV"], constants["ROWS"], constants["STRIDE"]
    pitch, path = (4 * ((n + 4) // 4) for n in (constants["DEPTH"], nv))
    board = max(constants["WIDTH"] * pitch, path if constants["SPLIT"] else 0)
    floats = (constants["KEPT_ROWS"] + nv + 1) * stride + 2 * board
    taken = 4 * floats + (20 + (13 if constants["ELLIPTIC"] else 0)) * rows + (19 * nv if constants["DRY"] else 0)
    return max(4, min(32, MULTIPROCESSOR_BYTES // (taken + BYTES_OF_A_BLOCK) // 4 * 4))


def solver_kernel(constants: dict[str, int | bool]) -> Any:
    """Return the kernel for a set of `solver_constants`. Its launch dimension is (worlds, lanes)."""

    @wp.func_native(native_source(SOURCE, constants))
    def solve_world(world: int, arrays: SolverArrays) -> None: ...

    @wp.kernel(module="unique", enable_backward=False, launch_bounds=(LANES, blocks(constants)))
    def solve_constraints(arrays: SolverArrays) -> None:
        world, _lane = wp.tid()  # type: ignore[misc]
        solve_world(world, arrays)

    return solve_constraints


def ask_for_dense_rows(model: mujoco.MjModel) -> None:
    """Make mujoco-warp store dense Jacobians, because this solver reads only these. By default, mujoco-warp stores sparse
    Jacobians above 32 degrees of freedom.
    """
    if model.nv <= MOST_DOFS:
        model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE


class ConstraintSolver:
    """Computes constraint forces and accelerations of all worlds from mujoco-warp's data."""

    advance: wp.array2d
    """(worlds, nv) accelerations from which the next velocities are computed: `qacc`, or another array if dampers are
    integrated implicitly."""

    def __init__(
        self, model: mujoco.MjModel, m: Any, d: Any, damped: bool = False, active_set: ActiveSet | None = None
    ) -> None:
        """Prepare the launch for a `model` that `why_not` accepts; `m` and `d` are mujoco-warp's model and data for it. With
        `damped`, also compute the acceleration with implicitly integrated dampers. With `active_set`, start from the row
        states of the last step; for elliptic cones, `active_set` is ignored, since a sliding cone's cost is not quadratic.
        Warp's current device must be that of `m` and `d`.
        """
        tree, elliptic = Tree.of(model), m.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
        friction = not m.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS
        counts, columns = m.M_rownnz.numpy(), m.M_colind.numpy()
        dry = not model.ntendon
        rows = np.repeat(np.arange(m.nv), counts)
        self.constants = solver_constants(tree, d.njmax, len(rows), damped, friction, dry, elliptic, active_set is not None)
        self.wide: dict[str, Constant] | None = None
        """Constants of wide_solver.h, if that solver is used (on a CPU only); None otherwise."""
        if d.qacc.device.is_cpu and not elliptic and fits_wide(m.nv, d.njmax):
            entries = rows, columns[: len(rows)]
            self.wide = wide_constants(tree, entries, d.njmax, damped, friction, active_set is not None)
        self._kernel = solver_kernel(self.constants) if self.wide is None else wide_kernel(self.wide)
        self._lanes = lanes_of(d.qacc.device)
        efc, opt = d.efc, m.opt
        arrays = self.arrays = SolverArrays()
        arrays.most_rounds, arrays.most_searches = opt.iterations, opt.ls_iterations
        arrays.tolerance, arrays.ls_tolerance = float(opt.tolerance.numpy()[0]), float(opt.ls_tolerance.numpy()[0])
        for name, table in tree.tables().items():
            setattr(arrays, name, wp.array(table, dtype=wp.uint64 if name == "path" else int))
        arrays.entry_row, arrays.entry_column = wp.array(rows, dtype=int), wp.array(columns[: len(rows)], dtype=int)
        arrays.inertia, arrays.qfrc_smooth, arrays.warmstart = d.M, d.qfrc_smooth, d.qacc_warmstart
        arrays.equalities, arrays.frictions, arrays.limits, arrays.nefc = d.ne, d.nf, d.nl, d.nefc
        arrays.type, arrays.id, arrays.jacobian, arrays.stiffness, arrays.reference = efc.type, efc.id, efc.J, efc.D, efc.aref
        arrays.frictionloss = efc.frictionloss
        arrays.contact_dim, arrays.contact_row, arrays.friction = d.contact.dim, d.contact.efc_address, d.contact.friction
        arrays.impratio_invsqrt = opt.impratio_invsqrt
        arrays.qacc, arrays.inertial, arrays.qfrc_constraint = d.qacc, efc.Ma, d.qfrc_constraint
        arrays.efc_force, arrays.rounds = efc.force, d.solver_niter
        self.advance = wp.zeros_like(d.qacc) if damped else d.qacc
        arrays.timestep, arrays.damping, arrays.advance = opt.timestep, m.dof_damping, self.advance
        nothing = wp.empty((0, 0), dtype=int)
        arrays.row_key, arrays.last_rows = (nothing, nothing) if active_set is None else (active_set.key, active_set.last)
        self._worlds = d.nworld

    @staticmethod
    def why_not(m: Any, d: Any) -> str:
        """Return the reason why this solver does not support a model, or an empty text if it does."""
        if not 1 <= m.nv <= MOST_DOFS:
            return f"the model has {m.nv} degrees of freedom; 1 to {MOST_DOFS} are supported"
        if m.is_sparse:
            return "mujoco-warp stores sparse Jacobians for the model"
        if d.njmax > MOST_ROWS:
            return f"{d.njmax} constraint rows (sim.njmax) exceed {MOST_ROWS}"
        if m.opt.solver != mujoco.mjtSolver.mjSOL_NEWTON:
            return "the model's solver is not Newton"
        if m.opt.integrator != mujoco.mjtIntegrator.mjINT_EULER:
            return "the model's integrator is not Euler"
        if m.opt.noslip_iterations:
            return "the model uses noslip iterations"
        if m.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_WARMSTART:
            return "the model disables warm starts"
        if max(len(m.opt.tolerance), len(m.opt.ls_tolerance)) > 1:
            return "worlds differ in the solver's tolerances"
        return ""

    def solve(self) -> None:
        """Compute qacc, qfrc_constraint and efc.force from M, qfrc_smooth, the constraint rows and the last acceleration."""
        if self.wide is not None:
            wp.launch(self._kernel, dim=-(-self._worlds // WIDE), inputs=[0, self._worlds, self.arrays])
        else:
            wp.launch(self._kernel, dim=(self._worlds, self._lanes), inputs=[self.arrays], block_dim=self._lanes)
