"""Mesh files: finding, reading and converting them, and fitting primitives to meshes."""

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from glob import escape
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import mujoco
import numpy as np

from legged.errors import ConfigError
from legged.robots.importing.tree import Mesh, Shape, Vector, quat_product, rotate

READ = (".stl", ".obj", ".msh")
"""Suffixes of files that MuJoCo reads."""
MOST_FACES = 200_000
"""Largest number of faces that MuJoCo accepts in an STL file."""
ENOUGH_FACES = 50_000
"""A mesh with more than `MOST_FACES` faces is simplified until it has at most this number."""
FINEST = 600
"""Number of grid cells along the longest side of a mesh at the first attempt to simplify it."""
LONGEST = 3.0
"""Largest length of a mesh of a legged robot [m]; a longer mesh is probably in millimetres."""
STL_HEADER, STL_FACE = 84, 50
"""Sizes of the header and of a face in a binary STL file [bytes]."""


class MeshProblem(Exception):
    """A mesh can't be used. The message of the exception states the reason."""


class MeshMissing(MeshProblem):
    """A mesh whose file does not exist."""


def find(name: str, folder: Path, roots: Sequence[Path]) -> Path:
    """Return the mesh file that a URDF in `folder` names. `name` is a path, or begins with `file://` or `package://`.
    Packages are looked for in `folder`, in the folders above it, and in `roots`.

    Raises:
        MeshMissing: there is no such file.
    """
    path = re.sub(r"^(package|file|model):/*", lambda m: "/" if m[1] == "file" else "", unquote(name.strip()))
    parts = [part for part in Path(path).parts if part not in ("/", "\\")]
    places = [folder, *folder.parents, *roots]
    # A tail is the path without its first i parts. These may be a package's name or folders of another machine.
    tails = [parts[i:] for i in range(len(parts))]
    options = [Path(path)] if Path(path).is_absolute() else [folder / path]
    options += [place.joinpath(*tail) for tail in tails[:2] for place in places]
    options += [place.joinpath(*tail) for tail in tails[2:] for place in places[:3]]
    for option in options:
        if option.is_file():
            return option.resolve()
    for option in options:
        found = ignoring_case(option)
        if found is not None:
            return found.resolve()
    raise MeshMissing(f"mesh '{name}' was not found in {folder.name}/ or the folders around it")


def ignoring_case(path: Path) -> Path | None:
    """Return the file or folder whose path is `path`, except for upper and lower case; None if it does not exist."""
    if path.exists() or path.parent == path:
        return path if path.is_file() or path.is_dir() else None
    folder = ignoring_case(path.parent)
    if folder is None or not folder.is_dir():
        return None
    return next((other for other in sorted(folder.iterdir()) if other.name.lower() == path.name.lower()), None)


def find_by_name(name: str, folder: Path) -> Path:
    """Find a mesh whose path `name` in a URDF is wrong: return the only file with the same file name in the subfolders of
    `folder` and in the folders next to `folder`.

    Raises:
        MeshMissing: there is no such file, or there are several.
    """
    last = escape(Path(unquote(name.strip())).name)
    patterns = [(folder, f"{deep}{last}") for deep in ("*/", "*/*/")] + [(folder.parent, f"*/{last}")]
    found = {path.resolve() for place, pattern in patterns if last for path in place.glob(pattern) if path.is_file()}
    if len(found) != 1:
        raise MeshMissing(f"mesh '{name}' was not found in {folder.name}/ or the folders around it")
    return found.pop()


def read(path: Path, scale: Vector) -> list[tuple[Mesh, Vector | None]]:
    """Return pairs (mesh, colour) of a file, in a form that MuJoCo reads. The meshes are scaled by `scale` (3,). A colour is
    RGBA (4,), or None.

    Raises:
        MeshProblem: MuJoCo does not read the file, and it can't be converted.
    """
    if path.suffix.lower() == ".stl":
        with path.open("rb") as file:
            head = file.read(STL_HEADER)
        faces = int.from_bytes(head[80:84], "little")
        if path.stat().st_size == STL_HEADER + STL_FACE * faces and faces <= MOST_FACES:
            return [(Mesh(path.stem, path, scale), None)]
    elif path.suffix.lower() in READ:
        return [(Mesh(path.stem, path, scale), None)]
    parts = [(*_thinned(vertices, faces), rgba) for vertices, faces, rgba in _converted(path)]
    return [(Mesh(path.stem, None, scale, vertices * scale, faces), rgba) for vertices, faces, rgba in parts]


def _thinned(vertices: Vector, faces: Vector) -> tuple[Vector, Vector]:
    """Return the vertices (V, 3) and the faces (T, 3) of a mesh. If it has too many faces for MuJoCo, vertices near each
    other are merged.
    """
    cells = FINEST
    low, extent = vertices.min(axis=0), max(float(np.ptp(vertices, axis=0).max()), 1e-9)
    points, corners = vertices, faces
    if len(faces) <= MOST_FACES:
        return vertices, faces
    while len(corners) > ENOUGH_FACES and cells > 1:
        places, which = np.unique(np.round((vertices - low) / extent * cells).astype(int), axis=0, return_inverse=True)
        points, corners = low + places * extent / cells, which.reshape(-1)[faces]
        a, b, c = corners.T
        corners = corners[(a != b) & (b != c) & (a != c)]
        cells = cells * 2 // 3
    return points, corners


@cache
def _converted(path: Path) -> list[tuple[Vector, Vector, Vector | None]]:
    """Read a file with trimesh, and return the vertices (V, 3), the faces (T, 3) and the colour of each part."""
    try:
        import trimesh
    except ImportError as error:
        raise MeshProblem(f"{path.name}: MuJoCo does not read {path.suffix}; run `pip install trimesh pycollada`") from error
    try:
        scene = trimesh.load_scene(path)
        parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    except Exception as error:  # the readers that trimesh calls raise many classes of errors
        raise MeshProblem(f"{path.name}: can't be converted ({type(error).__name__}: {error})"[:200]) from error
    if not parts:
        raise MeshProblem(f"{path.name}: has no faces")
    return [(np.array(part.vertices, dtype=float), np.array(part.faces), _colour(part)) for part in parts]


def _colour(part: Any) -> Vector | None:
    """Return the colour (4,) of a part; None if it has no single colour or is invisible."""
    try:
        rgba = np.array(part.visual.to_color().main_color, dtype=float) / 255.0
    except Exception:  # a missing texture, for example, raises an error
        return None
    return rgba if rgba.shape == (4,) and rgba[3] > 0.0 else None


def write_stl(path: Path, mesh: Mesh) -> None:
    """Write the vertices and faces of a mesh as a binary STL file."""
    assert mesh.vertices is not None
    assert mesh.faces is not None
    corners = mesh.vertices[mesh.faces].astype("<f4")
    record = np.zeros(len(corners), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    record["corners"] = corners
    path.write_bytes(bytes(80) + len(corners).to_bytes(4, "little") + record.tobytes())


FITS = {
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
}
ROUND = 1.25
"""Factor: a mesh counts as round if its largest extent is at most this factor times its smallest extent."""


def fitted(shape: Shape) -> Shape:
    """Return a shape whose mesh is replaced by the smallest primitive (capsule, box or sphere) that MuJoCo fits to the mesh's
    bounding box. Only a round mesh becomes a sphere.

    Raises:
        MeshProblem: MuJoCo refuses the mesh.
    """
    assert shape.mesh is not None
    found, points = _fits(shape.mesh)
    extent = found["box"][0]
    for kind, (size, pos, quat) in found.items():
        found[kind] = (size, shape.pos + rotate(shape.quat, pos), quat_product(shape.quat, quat))
    fair = [kind for kind in found if kind != "sphere" or extent.max() <= ROUND * extent.min()]
    best = min(fair, key=lambda kind: _volume(kind, found[kind][0]))
    points = shape.pos + rotate(shape.quat, points)
    return Shape(best, *found[best], True, shape.link, shape.name, friction=shape.friction, fits=found, points=points)


def check_length(source: Path, shape: Shape, points: Vector | None) -> None:
    """Check that a mesh is not too long for a legged robot. `points` (V, 3) are its vertices [m]. The robot's file `source`
    and the shape are named in the error message.

    Raises:
        ConfigError: the mesh is longer than `LONGEST`.
    """
    length = 0.0 if points is None or not len(points) else float(np.ptp(points, axis=0).max())
    if length > LONGEST:
        name = shape.mesh.file.name if shape.mesh is not None and shape.mesh.file is not None else shape.name
        raise ConfigError(
            f"{source}: link '{shape.link}': mesh '{name}' is {length:.4g} m long; if it is in millimetres, add"
            ' scale="0.001 0.001 0.001" to its <mesh>'
        )


def vertices(mesh: Mesh) -> Vector | None:
    """Return the vertices (V, 3) [m] of a mesh in memory or in an STL file; None for other files, which take long to read."""
    if mesh.file is None or mesh.file.suffix.lower() != ".stl":
        return mesh.vertices
    face = np.dtype([("normal", "<f4", 3), ("corners", "<f4", 9), ("attribute", "<u2")])
    content = mesh.file.read_bytes()[STL_HEADER:]
    return np.frombuffer(content, face, len(content) // STL_FACE)["corners"].reshape(-1, 3) * mesh.scale


def rounded(shape: Shape) -> Shape:
    """Return a round shape for a point foot: the smaller one of the capsule and the sphere that were fitted to its mesh."""
    options = [kind for kind in ("capsule", "sphere") if kind in shape.fits]
    return refitted(shape, min(options, key=lambda kind: _volume(kind, shape.fits[kind][0]), default=shape.kind))


def refitted(shape: Shape, kind: str) -> Shape:
    """Return the primitive `kind` that was fitted to the mesh of a shape, or a copy of the shape if there was no fit."""
    size, pos, quat = shape.fits.get(kind, (shape.size, shape.pos, shape.quat))
    kind = kind if kind in shape.fits else shape.kind
    return replace(shape, kind=kind, size=size.copy(), pos=pos.copy(), quat=quat.copy())


def _fits(mesh: Mesh) -> tuple[dict[str, tuple[Vector, Vector, Vector]], Vector]:
    """Return kind -> size (3,), position (3,) and orientation (4,) of the primitives that MuJoCo fits to a mesh, and the
    mesh's vertices (V, 3) [m]. No capsule fits a flat mesh.
    """
    found: dict[str, tuple[Vector, Vector, Vector]] = {}
    problem: Exception | None = None
    for inertia in (mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX, mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL):
        for name, kind in FITS.items():
            spec = mujoco.MjSpec()
            spec.compiler.fitaabb = True
            added = spec.add_mesh(name="mesh", inertia=inertia, scale=mesh.scale if mesh.file else [1, 1, 1])
            if mesh.file is not None:
                added.file = str(mesh.file)
            else:
                assert mesh.vertices is not None
                assert mesh.faces is not None
                added.uservert, added.userface = mesh.vertices.ravel(), mesh.faces.ravel()
            spec.worldbody.add_geom(name="fit", type=kind, meshname="mesh")
            try:
                model = spec.compile()
            except Exception as error:  # MuJoCo's errors have no class of their own
                problem = error
                continue
            geom = model.geom("fit")
            found[name] = (geom.size.copy(), geom.pos.copy(), geom.quat.copy())
            points = rotate(model.mesh_quat[0], model.mesh_vert.astype(float)) + model.mesh_pos[0]
        if "box" in found:
            return found, points
    raise MeshProblem(f"mesh '{mesh.name}': MuJoCo refuses it: {' '.join(str(problem).split())}")


def _volume(kind: str, size: Vector) -> float:
    """Return the volume of a primitive [m^3]."""
    if kind == "box":
        return float(8.0 * size.prod())
    return float(np.pi * size[0] ** 2 * (4 / 3 * size[0] + (2.0 * size[1] if kind == "capsule" else 0.0)))
