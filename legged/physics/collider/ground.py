"""Height map on the device, and Warp functions that compute the geometry of its contacts with spheres and capsules.

A shape consists of contact features (contact_features.py). For each feature only a few cells are checked: the surface of the
cell below the feature, and the vertical faces and rims of the neighbouring cells.
"""

import numpy as np
import warp as wp

from legged.terrain import HeightMap

FACE = wp.constant(1e-4)
"""Neighbouring surfaces are separated by a vertical face if their heights differ by more than this [m]."""
RIDGE = wp.constant(0.02)
"""The middle of a capsule can rest on a crease across which the slope (rise over run) drops by more than this."""
SAME = wp.constant(0.999)
"""Neighbouring surfaces count as one surface if the cosine of the angle between their normals is larger than this."""
NOTHING = wp.constant(1e6)
"""Distance that stands for no contact [m]."""


@wp.struct
class Ground:
    """A height map on the device."""

    corners: wp.array2d[wp.vec4]
    """(X, Y) corner heights of each cell: at (0, 0), (1, 0), (0, 1), (1, 1) [m]."""
    ceiling: wp.array2d[float]
    """(X, Y) height of the highest corner that a point feature over this cell can reach [m]."""
    wide_ceiling: wp.array2d[float]
    """(X, Y) height of the highest corner that a capsule with its middle over this cell can reach [m]."""
    x: float
    """World x of the outer corner of cell (0, 0) [m]; `y` is its world y."""
    y: float
    cell: float
    """Edge length of a cell [m]."""
    reach: int
    """The largest feature can touch this many cells on each side of the cell below its centre."""


@wp.struct
class Hit:
    """Possible contact of a sphere around `point`."""

    dist: float
    """Distance from the point to the ground [m]. The sphere's radius is not subtracted."""
    normal: wp.vec3
    point: wp.vec3
    face: bool
    """True if the sphere touches a vertical face or its rim, False if it touches a surface."""


@wp.func
def cell_of(ground: Ground, x: float, y: float) -> wp.vec2i:
    """Return the indices of the cell that contains a world point, or of the nearest cell if the point is outside the map."""
    i = wp.int32(wp.floor((x - ground.x) / ground.cell))
    j = wp.int32(wp.floor((y - ground.y) / ground.cell))
    i = wp.clamp(i, 0, ground.corners.shape[0] - 1)
    j = wp.clamp(j, 0, ground.corners.shape[1] - 1)
    return wp.vec2i(i, j)


@wp.func
def corners_of(ground: Ground, i: int, j: int) -> wp.vec4:
    """Return the corner heights of cell (i, j) [m], or those of the nearest border cell if (i, j) is outside the map."""
    i = wp.clamp(i, 0, ground.corners.shape[0] - 1)
    j = wp.clamp(j, 0, ground.corners.shape[1] - 1)
    return ground.corners[i, j]


@wp.func
def surface(ground: Ground, i: int, j: int, x: float, y: float) -> wp.vec3:
    """Return (height, slope along x, slope along y) of the surface of cell (i, j) at its point nearest to (x, y)."""
    c = corners_of(ground, i, j)
    u = wp.clamp((x - ground.x) / ground.cell - float(i), 0.0, 1.0)
    v = wp.clamp((y - ground.y) / ground.cell - float(j), 0.0, 1.0)
    along_x = wp.lerp(c[1] - c[0], c[3] - c[2], v)
    along_y = wp.lerp(c[2] - c[0], c[3] - c[1], u)
    height = wp.lerp(wp.lerp(c[0], c[1], u), wp.lerp(c[2], c[3], u), v)
    return wp.vec3(height, along_x / ground.cell, along_y / ground.cell)


@wp.func
def on_plane(p: wp.vec3, foot: wp.vec3, s: wp.vec3) -> Hit:
    """Return the possible contact of `p` with the plane through `foot` whose slopes along x and y are `s[1]` and `s[2]`."""
    normal = wp.normalize(wp.vec3(-s[1], -s[2], 1.0))
    hit = Hit()
    hit.point = p
    hit.normal = normal
    hit.dist = wp.dot(p - foot, normal)
    return hit


@wp.func
def leave_sideways(ground: Ground, i: int, j: int, p: wp.vec3, top: Hit) -> Hit:
    """Return the possible contact of a point `p` below the surface of cell (i, j). The contact pushes the point out by the
    shortest way: up, as the contact `top` does, or sideways through a vertical face of the cell.
    """
    best = top
    x0 = ground.x + float(i) * ground.cell
    y0 = ground.y + float(j) * ground.cell
    for side in range(4):
        sign = float(2 * (side % 2) - 1)
        step = 2 * (side % 2) - 1
        hit = Hit()
        hit.point = p
        if side < 2:
            hit.normal = wp.vec3(sign, 0.0, 0.0)
            hit.dist = -wp.where(side == 0, p[0] - x0, x0 + ground.cell - p[0])
            outside = surface(ground, i + step, j, p[0], p[1])
        else:
            hit.normal = wp.vec3(0.0, sign, 0.0)
            hit.dist = -wp.where(side == 2, p[1] - y0, y0 + ground.cell - p[1])
            outside = surface(ground, i, j + step, p[0], p[1])
        if outside[0] < p[2] and hit.dist > best.dist:
            best = hit
    return best


@wp.func
def hit_neighbour(ground: Ground, i: int, j: int, ni: int, nj: int, p: wp.vec3) -> Hit:
    """Return the possible contact of a point `p` over cell (i, j) with the neighbouring cell (ni, nj). The point may touch
    the neighbour's vertical face, the rim of this face, or, if there is no face, the neighbour's surface.
    """
    x0 = ground.x + float(ni) * ground.cell
    y0 = ground.y + float(nj) * ground.cell
    qx = wp.clamp(p[0], x0, x0 + ground.cell)
    qy = wp.clamp(p[1], y0, y0 + ground.cell)
    s = surface(ground, ni, nj, qx, qy)
    # Height of the ground that adjoins the neighbour on the point's side. Above this height, the neighbour's face is exposed.
    before = -NOTHING
    if ni != i:
        before = wp.max(before, surface(ground, ni - wp.sign(ni - i), nj, qx, qy)[0])
    if nj != j:
        before = wp.max(before, surface(ground, ni, nj - wp.sign(nj - j), qx, qy)[0])
    hit = Hit()
    hit.point = p
    hit.dist = NOTHING
    if s[0] > before + FACE:
        hit.face = True
        if p[2] > before:
            to = p - wp.vec3(qx, qy, wp.min(p[2], s[0]))
            hit.dist = wp.length(to)
            hit.normal = wp.normalize(to)
            if hit.dist < 1e-6:  # the point lies on the face; push it towards cell (i, j)
                hit.normal = wp.normalize(wp.vec3(float(i - ni), float(j - nj), 0.0))
    elif s[0] > before - FACE:
        # No face separates the two surfaces. Take the neighbour's surface as a plane, and ignore it if the projection of the
        # point on this plane lies outside the neighbour.
        plane = on_plane(p, wp.vec3(qx, qy, s[0]), s)
        x = p[0] - plane.dist * plane.normal[0]
        y = p[1] - plane.dist * plane.normal[1]
        if x > x0 and x < x0 + ground.cell and y > y0 and y < y0 + ground.cell:
            hit = plane
    return hit


@wp.func
def rim_or_ridge(ground: Ground, a: wp.vec3, b: wp.vec3, axis: int, line: int) -> Hit:
    """Return the possible contact of a segment a-b with the ground at one grid line: the `line`-th that is perpendicular to
    `axis` (0: x, 1: y). There the segment may touch the rim of a vertical face, or the ridge of a continuous surface.

    `dist` is NOTHING if an end of the segment is nearest to the ground, because each end is a separate feature.
    """
    hit = Hit()
    hit.dist = NOTHING
    d = b - a
    at = wp.where(axis == 0, ground.x, ground.y) + float(line) * ground.cell
    t = 0.5
    if wp.abs(d[axis]) > 1e-9:
        t = wp.clamp((at - a[axis]) / d[axis], 0.0, 1.0)
    p = a + t * d
    cell = cell_of(ground, p[0], p[1])
    low_i, low_j, high_i, high_j = cell[0], cell[1], cell[0], cell[1]
    if axis == 0:
        low_i, high_i = line - 1, line
        p[0] = at
    else:
        low_j, high_j = line - 1, line
        p[1] = at
    s_low = surface(ground, low_i, low_j, p[0], p[1])
    s_high = surface(ground, high_i, high_j, p[0], p[1])
    rise = s_high[0] - s_low[0]
    if wp.abs(rise) > FACE:
        # In the vertical plane perpendicular to the rim, find the segment's point that is nearest to the rim, and the
        # direction from the rim to this point.
        rim = wp.max(s_low[0], s_high[0])
        open_side = -wp.sign(rise)
        across, up = d[axis], d[2]
        length_sq = across * across + up * up
        if length_sq < 1e-12:
            return hit  # the segment lies along the rim, so its ends make the contacts
        t = ((at - a[axis]) * across + (rim - a[2]) * up) / length_sq
        if t <= 0.0 or t >= 1.0:
            return hit
        scale = 1.0 / wp.sqrt(length_sq)
        normal = wp.vec2(-up * scale, across * scale)  # horizontal and vertical component
        if normal[0] * open_side + normal[1] < 0.0:
            normal = -normal
        if normal[0] * open_side < -1e-3 or normal[1] < -1e-3:
            return hit  # the vertical face or the upper surface is nearer than the rim
        p = a + t * d
        dist = (p[axis] - at) * normal[0] + (p[2] - rim) * normal[1]
        if dist > -ground.cell:
            hit.dist = dist
            hit.point = p
            if axis == 0:
                hit.normal = wp.vec3(normal[0], 0.0, normal[1])
            else:
                hit.normal = wp.vec3(0.0, normal[0], normal[1])
    elif t > 0.0 and t < 1.0 and s_low[1 + axis] - s_high[1 + axis] > RIDGE:
        mean = 0.5 * (s_low + s_high)
        hit = on_plane(p, wp.vec3(p[0], p[1], mean[0]), mean)
    return hit


MOST = wp.constant(6)
"""Largest number of contacts of one feature. A sphere in a corner touches several surfaces and faces."""


@wp.struct
class Hits:
    """Memory for MOST contacts of each feature of each world, with one row for each feature and world. Local arrays of this
    size would take too many registers.
    """

    dist: wp.array2d[float]
    normal: wp.array2d[wp.vec3]
    point: wp.array2d[wp.vec3]


@wp.func
def add(hits: Hits, row: int, count: int, hit: Hit) -> int:
    """Append a possible contact to a row that holds `count` contacts, if there is room. Return the new number of contacts."""
    if count >= MOST:
        return count
    hits.dist[row, count] = hit.dist
    hits.normal[row, count] = hit.normal
    hits.point[row, count] = hit.point
    return count + 1


@wp.func
def around_point(ground: Ground, p: wp.vec3, near: float, faces_only: bool, hits: Hits, row: int) -> int:
    """Find the possible contacts of a sphere around `p` with ground that is nearer to `p` than `near` [m]. With `faces_only`,
    find only those with vertical faces and their rims. Write them to row `row` of `hits`, and return their number.
    """
    count = wp.int32(0)
    cell = cell_of(ground, p[0], p[1])
    i, j = cell[0], cell[1]
    if p[2] - near > ground.ceiling[i, j]:
        return count
    s = surface(ground, i, j, p[0], p[1])
    own = on_plane(p, wp.vec3(p[0], p[1], s[0]), s)
    if own.dist < 0.0:
        own = leave_sideways(ground, i, j, p, own)
    if own.dist < near and not faces_only:
        count = add(hits, row, count, own)
    crease = Hit()
    crease.dist = NOTHING
    for di in range(-ground.reach, ground.reach + 1):
        x = ground.x + float(i + di) * ground.cell
        dx = p[0] - wp.clamp(p[0], x, x + ground.cell)
        for dj in range(-ground.reach, ground.reach + 1):
            y = ground.y + float(j + dj) * ground.cell
            dy = p[1] - wp.clamp(p[1], y, y + ground.cell)
            if (di != 0 or dj != 0) and dx * dx + dy * dy < near * near:
                hit = hit_neighbour(ground, i, j, i + di, j + dj, p)
                if hit.face and hit.dist < near:
                    count = add(hits, row, count, hit)
                elif hit.dist < crease.dist:
                    crease = hit
    if crease.dist < near and not faces_only and wp.dot(crease.normal, own.normal) < SAME:
        count = add(hits, row, count, crease)
    return count


@wp.func
def between_ends(ground: Ground, a: wp.vec3, b: wp.vec3, near: float, hits: Hits, row: int) -> int:
    """For each half of a capsule a-b, find the possible contact with the nearest rim or ridge between the capsule's ends.
    Write the contacts to row `row` of `hits`, and return their number.
    """
    middle = 0.5 * (a + b)
    cell = cell_of(ground, middle[0], middle[1])
    if wp.min(a[2], b[2]) - near > ground.wide_ceiling[cell[0], cell[1]]:
        return 0
    first = Hit()
    second = Hit()
    first.dist = NOTHING
    second.dist = NOTHING
    for axis in range(2):
        start = wp.where(axis == 0, ground.x, ground.y)
        low = wp.int32(wp.floor((wp.min(a[axis], b[axis]) - near - start) / ground.cell)) + 1
        high = wp.int32(wp.floor((wp.max(a[axis], b[axis]) + near - start) / ground.cell))
        # Grid lines outside the map are skipped, because in a world that diverges, a capsule could cross billions of lines.
        last = wp.where(axis == 0, ground.corners.shape[0], ground.corners.shape[1]) - 1
        for line in range(wp.clamp(low, 1, last), wp.clamp(high, 1, last) + 1):
            hit = rim_or_ridge(ground, a, b, axis, line)
            if hit.dist < near:
                if wp.length_sq(hit.point - a) < wp.length_sq(hit.point - b):
                    if hit.dist < first.dist:
                        first = hit
                elif hit.dist < second.dist:
                    second = hit
    count = wp.int32(0)
    if first.dist < near:
        count = add(hits, row, count, first)
    if second.dist < near:
        count = add(hits, row, count, second)
    return count


def room_for_hits(rows: int) -> Hits:
    """Return memory with `rows` rows for possible contacts, on Warp's current device."""
    hits = Hits()
    hits.dist = wp.zeros((rows, int(MOST)), dtype=float)
    hits.normal = wp.zeros((rows, int(MOST)), dtype=wp.vec3)
    hits.point = wp.zeros((rows, int(MOST)), dtype=wp.vec3)
    return hits


def ground_of(height_map: HeightMap, largest: float, longest: float) -> Ground:
    """Return `height_map` on Warp's current device. `largest` is the largest radius of a feature plus the contact margin [m];
    `longest` is the largest length of a capsule [m].
    """
    reach = int(np.ceil(largest / height_map.cell - 1e-9))
    wide = int(np.ceil((0.5 * longest + largest) / height_map.cell))
    ground = Ground()
    ground.corners = wp.array(height_map.corners, dtype=wp.vec4)
    ground.ceiling = wp.array(height_map.ceiling(reach), dtype=float)
    ground.wide_ceiling = wp.array(height_map.ceiling(wide), dtype=float)
    ground.x, ground.y = height_map.origin
    ground.cell, ground.reach = height_map.cell, reach
    return ground
