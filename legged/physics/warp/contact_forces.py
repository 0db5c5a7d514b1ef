"""Forces on a robot's shapes: sums of what mujoco-warp's contacts push with."""

import warp as wp

from legged.physics.fused.contact_kernel import Vector5

wp.set_module_options({"enable_backward": False})


@wp.kernel
def add_contact_forces(
    nacon: wp.array[int],
    geom: wp.array[wp.vec2i],
    worldid: wp.array[int],
    force: wp.array[wp.spatial_vector],
    contact_of_geom: wp.array[int],
    contact_forces: wp.array2d[wp.vec3],
):
    """One thread a contact: its force on the second shape, and the reaction on the first, world frame [N]."""
    i = wp.tid()
    if i >= nacon[0]:
        return
    on_second = wp.spatial_top(force[i])
    first, second = contact_of_geom[geom[i][0]], contact_of_geom[geom[i][1]]
    if first >= 0:
        wp.atomic_add(contact_forces, worldid[i], first, -on_second)
    if second >= 0:
        wp.atomic_add(contact_forces, worldid[i], second, on_second)


ON_GPU = "#if defined(__CUDA_ARCH__)\nreturn {};\n#else\nreturn {};\n#endif\n"


@wp.func_native(ON_GPU.format("__shfl_sync(0xffffffffu, x, lane)", "x"))
def from_lane(x: float, lane: int) -> float:  # type: ignore[empty-body]
    """Return the `x` of another lane of this warp; on the CPU there is one lane."""
    ...


@wp.func_native(ON_GPU.format("__shfl_sync(0xffffffffu, x, lane)", "x"))
def whole_from_lane(x: int, lane: int) -> int:  # type: ignore[empty-body]
    """The same of a whole number."""
    ...


@wp.func_native(ON_GPU.format("__popc(__ballot_sync(0xffffffffu, on))", "on ? 1 : 0"))
def lanes_with(on: bool) -> int:  # type: ignore[empty-body]
    """Return in how many lanes of this warp `on` holds."""
    ...


@wp.kernel
def sum_contact_forces(
    lanes: int,
    slots: int,
    rows: int,
    elliptic: bool,
    geom: wp.array[wp.vec2i],
    dim: wp.array[int],
    address: wp.array2d[int],
    friction: wp.array[Vector5],
    frame: wp.array[wp.mat33],
    efc_force: wp.array2d[float],
    contact_of_geom: wp.array[int],
    contact_forces: wp.array2d[wp.vec3],
):
    """The same in one launch, where each world has its contacts in `slots` of its own: so many threads a world, of which each
    finds the force of a contact, and then adds up those on a shape.

    Of a cone the rows have the force along its axes; of a pyramid its edges', each of them the normal plus or minus friction
    times a tangent.
    """
    world, lane = wp.tid()
    shapes = contact_forces.shape[1]
    for shape_block in range((shapes + lanes - 1) // lanes):
        shape = shape_block * lanes + lane
        total = wp.vec3(0.0)
        for slot_block in range((slots + lanes - 1) // lanes):
            slot = slot_block * lanes + lane
            c = world * slots + wp.min(slot, slots - 1)
            row = wp.where(slot < slots, address[c, 0], -1)
            shapes_of = wp.vec2i(-1, -1)
            on_second = wp.vec3(0.0)
            if row >= 0:
                shapes_of = wp.vec2i(contact_of_geom[geom[c][0]], contact_of_geom[geom[c][1]])
                force = wp.vec3(0.0)
                if elliptic or dim[c] == 1:
                    for k in range(3):
                        if k < dim[c] and row + k < rows:
                            force[k] = efc_force[world, row + k]
                else:
                    for k in range(dim[c] - 1):
                        edge = row + 2 * k
                        up = wp.where(edge < rows, efc_force[world, wp.min(edge, rows - 1)], 0.0)
                        down = wp.where(edge + 1 < rows, efc_force[world, wp.min(edge + 1, rows - 1)], 0.0)
                        force[0] += up + down
                        if k < 2:
                            force[k + 1] = (up - down) * friction[c][k]
                on_second = force @ frame[c]
            count = lanes_with(row >= 0)  # the first ones, since none that follows one without a row has any
            for k in range(count):
                first, second = whole_from_lane(shapes_of[0], k), whole_from_lane(shapes_of[1], k)
                push = wp.vec3(from_lane(on_second[0], k), from_lane(on_second[1], k), from_lane(on_second[2], k))
                if first == shape:
                    total -= push
                if second == shape:
                    total += push
            if count < lanes:
                break
        if shape < shapes:
            contact_forces[world, shape] = total
