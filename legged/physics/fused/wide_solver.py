"""The constraint solver for a CPU: many worlds at once, one in each place of its vector registers.

What one thread computes for one world is a chain of short loops that a compiler hardly vectorises. Side by side, worlds take
the same instructions; those that need fewer rounds, or fewer rows, wait for the others of their block. Each world's numbers
are the same in whatever company it is computed.
"""

from typing import Any

import numpy as np
import warp as wp

from legged.physics.fused.native import Constant, native_source
from legged.physics.fused.row_sides import SIDES
from legged.physics.fused.solver_arrays import SolverArrays
from legged.physics.fused.tree import Tree

SOURCE = ("wide_solver.h",)
WIDE = 16
"""Worlds of a block: the floats of AVX-512's registers. A compiler takes two or four registers where they are smaller."""
STACK_BYTES = 2 * 1024 * 1024
"""What a block's numbers may take of a thread's stack, of which there are 8 MB on Linux."""


def wide_constants(
    tree: Tree, entries: tuple[np.ndarray, np.ndarray], rows: int, damped: bool, friction: bool, known: bool = False
) -> dict[str, Constant]:
    """Return what wide_solver.h asks for, of models of a tree whose mass matrix has `entries` in these rows and columns, with
    at most `rows` constraint rows, dampers to integrate implicitly or none, rows of dry friction or none, and rows that are
    `known` again from step to step or not.
    """
    nv = len(tree.parent)
    paths = [tree.path(i) for i in range(nv)]
    starts = np.cumsum([0, *map(len, paths)])
    lower = [(max(pair), min(pair)) for pair in zip(*(side.tolist() for side in entries), strict=True)]
    return {
        **{"WIDE": WIDE, "NV": nv, "ROWS": rows, "ENTRIES": len(lower), "DAMPED": damped, "FRICTION": friction},
        "KNOWN": known,
        **SIDES,
        "COUPLED": bool(tree.constants()["SPLIT"]),
        "PATH_START": tuple(starts[:-1].tolist()),
        "PATH_LENGTH": tuple(map(len, paths)),
        "PATHS": tuple(j for path in paths for j in path),
        "ENTRY_PLACE": tuple(int(starts[i]) + paths[i].index(j) for i, j in lower),
    }


def fits_wide(nv: int, rows: int) -> bool:
    """Whether a block of models with so many degrees of freedom and constraint rows has room on a stack."""
    return 4 * WIDE * (rows * (nv + 9) + 2 * nv * nv) <= STACK_BYTES


def wide_function(constants: dict[str, Constant]) -> Any:
    """Return what the kernel does for one block: of worlds from `start` on, before `end`."""

    @wp.func_native(native_source(SOURCE, constants))
    def solve_block(
        start: int,
        end: int,
        most_rounds: int,
        most_searches: int,
        tolerance: float,
        ls_tolerance: float,
        arrays: SolverArrays,
    ) -> None: ...

    return solve_block


def wide_kernel(constants: dict[str, Constant]) -> Any:
    """Return the kernel for some `wide_constants`; launched for (blocks,), of worlds from `first` to before `end`."""
    solve_block = wide_function(constants)

    @wp.kernel(module="unique", enable_backward=False)
    def solve_blocks(
        first: int,
        end: int,
        most_rounds: int,
        most_searches: int,
        tolerance: float,
        ls_tolerance: float,
        arrays: SolverArrays,
    ) -> None:
        start = first + wp.tid() * WIDE  # type: ignore[operator]
        solve_block(start, end, most_rounds, most_searches, tolerance, ls_tolerance, arrays)

    return solve_blocks
