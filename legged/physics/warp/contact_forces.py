"""Kernels that sum mujoco-warp's contact forces on each shape of a robot."""

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
    """Add each contact's force to the sum of its second shape, and the opposite force to the sum of its first shape, world
    frame [N]. One thread per contact.
    """
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
    """Return the value of `x` in lane `lane` of this warp. On the CPU there is one lane."""
    ...


@wp.func_native(ON_GPU.format("__shfl_sync(0xffffffffu, x, lane)", "x"))
def whole_from_lane(x: int, lane: int) -> int:  # type: ignore[empty-body]
    """Return the integer `x` in lane `lane` of this warp. On the CPU there is one lane."""
    ...


@wp.func_native(ON_GPU.format("__popc(__ballot_sync(0xffffffffu, on))", "on ? 1 : 0"))
def lanes_with(on: bool) -> int:  # type: ignore[empty-body]
    """Return the number of lanes of this warp in which `on` is true."""
    ...


@wp.func
def frame_force(
    row: int,
    rows: int,
    dim: int,
    elliptic: bool,
    friction: Vector5,
    efc_force: wp.array[float],
):
    """Return the force of the contact whose constraint rows begin at `row`, in the contact frame [N]. `efc_force` has the
    forces of all `rows` of the world.

    With elliptic cones, constraint rows hold the force along the axes of the contact frame. With pyramids, they hold the
    forces along the edges, each of which is the normal plus or minus friction times a tangent.
    """
    force = wp.vec3(0.0)
    if elliptic or dim == 1:
        for k in range(3):
            if k < dim and row + k < rows:
                force[k] = efc_force[row + k]
    else:
        for k in range(dim - 1):
            edge = row + 2 * k
            up = wp.where(edge < rows, efc_force[wp.min(edge, rows - 1)], 0.0)
            down = wp.where(edge + 1 < rows, efc_force[wp.min(edge + 1, rows - 1)], 0.0)
            force[0] += up + down
            if k < 2:
                force[k + 1] = (up - down) * friction[k]
    return force


@wp.func
def between(first: int, second: int):
    """Return whether a contact of shapes with these `ContactGroups.bits` is a contact between the groups."""
    return ((first & 1) != 0 and (second & 2) != 0) or ((first & 2) != 0 and (second & 1) != 0)


@wp.kernel
def shift_forces(forces: wp.array2d[float]):
    """Move the forces of earlier steps by one column, and set the first column to zero. One thread per world."""
    world = wp.tid()
    for k in range(forces.shape[1] - 1, 0, -1):
        forces[world, k] = forces[world, k - 1]
    forces[world, 0] = 0.0


@wp.kernel
def find_largest_force(
    nacon: wp.array[int],
    rows: int,
    elliptic: bool,
    geom: wp.array[wp.vec2i],
    dim: wp.array[int],
    address: wp.array2d[int],
    worldid: wp.array[int],
    friction: wp.array[Vector5],
    efc_force: wp.array2d[float],
    bits: wp.array[int],
    forces: wp.array2d[float],
):
    """Raise the first column of `forces` to the largest force of a contact between two groups of shapes [N]. One thread per
    contact.
    """
    i = wp.tid()
    if i >= nacon[0] or address[i, 0] < 0:
        return
    if between(bits[geom[i][0]], bits[geom[i][1]]):
        world = worldid[i]
        force = frame_force(address[i, 0], rows, dim[i], elliptic, friction[i], efc_force[world])
        wp.atomic_max(forces, world, 0, wp.length(force))


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
    """Sum the contact forces on each shape in one launch, for worlds with room for `slots` contacts each. `lanes` threads per
    world. Each thread computes the force of one contact, and then the sum on one shape.
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
                on_second = frame_force(row, rows, dim[c], elliptic, friction[c], efc_force[world]) @ frame[c]
            count = lanes_with(row >= 0)  # contacts with constraint rows come first
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
