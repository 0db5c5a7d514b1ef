"""Arrays and settings of the constraint solver."""

import warp as wp

Vector5 = wp.types.vector(length=5, dtype=wp.float32)


@wp.struct
class SolverArrays:
    """Arrays of the solver: its own tables, and arrays of mujoco-warp's model and data. The solver writes the arrays from
    `qacc` to `rounds`. If dampers are integrated implicitly, it writes `advance`. If rows have keys (`row_key`), it writes
    their final states to `last_rows`. The last four entries are settings.
    """

    dof_depth: wp.array[int]
    dof_place: wp.array[int]
    dof_path: wp.array[int]
    below: wp.array[int]
    depth_width: wp.array[int]
    path: wp.array[wp.uint64]
    entry_row: wp.array[int]
    entry_column: wp.array[int]
    inertia: wp.array2d[float]
    qfrc_smooth: wp.array2d[float]
    warmstart: wp.array2d[float]
    equalities: wp.array[int]
    frictions: wp.array[int]
    limits: wp.array[int]
    nefc: wp.array[int]
    type: wp.array2d[int]
    id: wp.array2d[int]
    jacobian: wp.array3d[float]
    stiffness: wp.array2d[float]
    reference: wp.array2d[float]
    frictionloss: wp.array2d[float]
    contact_dim: wp.array[int]
    contact_row: wp.array2d[int]
    friction: wp.array[Vector5]
    impratio_invsqrt: wp.array[float]
    timestep: wp.array[float]
    damping: wp.array2d[float]
    qacc: wp.array2d[float]
    inertial: wp.array2d[float]
    qfrc_constraint: wp.array2d[float]
    efc_force: wp.array2d[float]
    rounds: wp.array[int]
    advance: wp.array2d[float]
    row_key: wp.array2d[int]
    last_rows: wp.array2d[int]
    most_rounds: int
    most_searches: int
    tolerance: float
    ls_tolerance: float
