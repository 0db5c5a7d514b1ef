"""Constraint solver for CPUs. It computes several worlds at once, one in each lane of the CPU's vector registers.

For a single world the solver is a chain of short loops, which a compiler hardly vectorises. Worlds in different lanes execute
the same instructions; worlds with fewer iterations or fewer rows wait for the others of their block. A world's results do not
depend on the other worlds of its block.
"""

from typing import Any

import numpy as np
import warp as wp

from legged.physics.fused.active_set import ROW_STATES
from legged.physics.fused.native import Constant, native_source
from legged.physics.fused.solver_arrays import SolverArrays
from legged.physics.fused.tree import Tree

SOURCE = ("wide_solver.h",)
WIDE = 16
"""Number of worlds per block: the number of floats in a register of AVX-512. If the CPU's registers are smaller, the compiler
uses two or four registers instead of one."""
STACK_BYTES = 2 * 1024 * 1024
"""Largest size of a block's data on a thread's stack [bytes]. By default, Linux gives a stack 8 MB."""


def wide_constants(
    tree: Tree, entries: tuple[np.ndarray, np.ndarray], rows: int, damped: bool, friction: bool, known: bool = False
) -> dict[str, Constant]:
    """Return the constants of wide_solver.h.

    Args:
        tree: elimination tree of the degrees of freedom.
        entries: rows and columns of the stored entries of the mass matrix.
        rows: largest number of constraint rows.
        damped: True if dampers are integrated implicitly.
        friction: True if there are rows of dry friction.
        known: True if rows have keys. The solver uses a row's key to find the row's state in the last step.
    """
    nv = len(tree.parent)
    paths = [tree.path(i) for i in range(nv)]
    starts = np.cumsum([0, *map(len, paths)])
    lower = [(max(pair), min(pair)) for pair in zip(*(side.tolist() for side in entries), strict=True)]
    return {
        **{"WIDE": WIDE, "NV": nv, "ROWS": rows, "ENTRIES": len(lower), "DAMPED": damped, "FRICTION": friction},
        "KNOWN": known,
        **ROW_STATES,
        "COUPLED": bool(tree.constants()["SPLIT"]),
        "PATH_START": tuple(starts[:-1].tolist()),
        "PATH_LENGTH": tuple(map(len, paths)),
        "PATHS": tuple(j for path in paths for j in path),
        "ENTRY_PLACE": tuple(int(starts[i]) + paths[i].index(j) for i, j in lower),
    }


def fits_wide(nv: int, rows: int) -> bool:
    """Return True if the data of a block with `nv` degrees of freedom and `rows` constraint rows fit a thread's stack."""
    return 4 * WIDE * (rows * (nv + 9) + 2 * nv * nv) <= STACK_BYTES


def wide_function(constants: dict[str, Constant]) -> Any:
    """Return the kernel's device function. It computes one block: up to `WIDE` worlds from `start` on, all before `end`."""

    @wp.func_native(native_source(SOURCE, constants))
    def solve_block(start: int, end: int, arrays: SolverArrays) -> None: ...

    return solve_block


def wide_kernel(constants: dict[str, Constant]) -> Any:
    """Return the kernel for a set of `wide_constants`. Its launch dimension is (blocks,). A launch computes the worlds from
    `first` to `end - 1`.
    """
    solve_block = wide_function(constants)

    @wp.kernel(module="unique", enable_backward=False)
    def solve_blocks(first: int, end: int, arrays: SolverArrays) -> None:
        start = first + wp.tid() * WIDE  # type: ignore[operator]
        solve_block(start, end, arrays)

    return solve_blocks
