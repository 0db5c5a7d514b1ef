"""Physics step on a CPU, in blocks of worlds. Each block passes through all stages of the step; threads share the blocks.

If each launch computed one stage for all worlds, a stage's results would have left the cache before the next stage reads
them. The data of a block stay in one core's cache through all stages. A Warp launch on a CPU uses one thread, so blocks are
distributed over several threads that launch concurrently. A world's results do not depend on the number of threads.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import warp as wp

from legged.physics.collider.ground import Ground, Hits
from legged.physics.fused.contact_kernel import Candidates, StageArrays, stage_function
from legged.physics.fused.contact_stage import ContactStage
from legged.physics.fused.smooth_dynamics import DynamicsArrays, dynamics_function
from legged.physics.fused.solver_arrays import SolverArrays
from legged.physics.fused.torque_step import StateArrays, TorqueStep, integrate_joint
from legged.physics.fused.wide_solver import WIDE, wide_function


def block_kernel(step: TorqueStep, contacts: ContactStage) -> Any:
    """Return the kernel for a `step` and its `contacts`. Its launch dimension is (blocks,). A launch steps the worlds from
    `first` to `end - 1`.
    """
    assert step.solver.wide is not None
    move_world = dynamics_function(step.dynamics.constants)
    contacts_of_world = stage_function(contacts.constants, *contacts.kinds)
    solve_block = wide_function(step.solver.wide)

    @wp.kernel(module="unique", enable_backward=False)
    def step_blocks(
        first: int,
        end: int,
        moved: bool,
        dynamics: DynamicsArrays,
        stage: StageArrays,
        items: Candidates,
        cells: Ground,
        hits: Hits,
        solver: SolverArrays,
        state: StateArrays,
    ) -> None:
        start = first + wp.tid() * WIDE  # type: ignore[operator]
        stop = wp.min(start + WIDE, end)
        for world in range(start, stop):
            if not moved:
                move_world(world, dynamics)
            contacts_of_world(world, 0, 1, stage, items, cells, hits)
        solve_block(start, end, solver)
        for world in range(start, stop):
            for joint in range(state.jnt_type.shape[0]):
                integrate_joint(world, joint, state)

    return step_blocks


class BlockStep:
    """Computes complete physics steps on a CPU, for all worlds of mujoco-warp's data."""

    def __init__(self, step: TorqueStep, contacts: ContactStage, threads: int) -> None:
        """Prepare to launch `step` and `contacts` on `threads` threads. `fits(step)` must be True."""
        self._step, self._contacts = step, contacts
        self._kernel = block_kernel(step, contacts)
        moved = contacts.equalities  # with equality constraints, `_before_blocks` computes the poses
        self._inputs = [moved, step.dynamics.arrays, *contacts.inputs, step.solver.arrays, step.state]
        blocks = -(-step.worlds // WIDE)
        threads = min(threads, blocks)
        edges = [min(WIDE * (blocks * k // threads), step.worlds) for k in range(threads + 1)]
        self._parts = list(pairwise(edges))
        self._others = ThreadPoolExecutor(threads - 1, "legged-physics") if threads > 1 else None

    @staticmethod
    def fits(step: TorqueStep) -> bool:
        """Return True if a step's constraint forces can be computed in blocks: on a CPU, with pyramidal friction cones."""
        return step.solver.wide is not None

    def launch(self) -> None:
        """Make a step on this thread."""
        self._before_blocks()
        self._launch_part(0, self._step.worlds)

    def recorded(self) -> Callable[[], None]:
        """Return a function that makes a step on all threads."""
        first, *others = (self._launch_part(*part, record=True).launch for part in self._parts)

        def make_step() -> None:
            self._before_blocks()
            running = [self._others.submit(part) for part in others] if self._others is not None else []
            first()
            for part in running:
                part.result()

        return make_step

    def _before_blocks(self) -> None:
        """If the model has equality constraints, compute poses and the rows of these constraints, for all worlds."""
        if self._contacts.equalities:
            self._step.begin()
            self._contacts.launch_equalities()

    def _launch_part(self, first: int, end: int, record: bool = False) -> Any:
        inputs = [first, end, *self._inputs]
        return wp.launch(self._kernel, dim=-(-(end - first) // WIDE), inputs=inputs, record_cmd=record)
