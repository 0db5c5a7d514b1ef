"""Reader of any MJCF into a Tree: scenes with floors and lights, unnamed shapes, any actuators, welded bodies."""

from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from legged.errors import ConfigError
from legged.robots.importing.dynamics import account_for
from legged.robots.importing.mjcf_motors import read_motors
from legged.robots.importing.mjcf_source import read_spec
from legged.robots.importing.shapes import free_name
from legged.robots.importing.tree import (
    IDENTITY,
    Hinge,
    Link,
    Mesh,
    Shape,
    Tree,
    inverse,
    matrix,
    quat_product,
    rotate,
    text_of,
    turn_link,
)

KINDS = {
    mujoco.mjtGeom.mjGEOM_SPHERE: "sphere",
    mujoco.mjtGeom.mjGEOM_CAPSULE: "capsule",
    mujoco.mjtGeom.mjGEOM_CYLINDER: "cylinder",
    mujoco.mjtGeom.mjGEOM_BOX: "box",
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: "ellipsoid",
    mujoco.mjtGeom.mjGEOM_MESH: "mesh",
}
SIZED = {"sphere": 1, "capsule": 2, "cylinder": 2, "box": 3, "ellipsoid": 3, "mesh": 0}
PLAIN_FRICTION = (1.0, 0.005, 0.0001)


def read_mjcf(path: Path, drawn: bool = True) -> Tree:
    """Return the heaviest robot in an MJCF file, with its visual shapes if `drawn`.

    Raises:
        ConfigError: MuJoCo refuses the file, or no body in it moves.
    """
    spec, said = read_spec(path)
    return tree_of(spec, path, drawn, said)


def tree_of(spec: mujoco.MjSpec, path: Path, drawn: bool = True, said: Sequence[tuple[str, str]] = ()) -> Tree:
    """Return the heaviest robot in a spec that was read from the file `path`; the spec is changed in place. `said` are
    messages about changes made while reading, each with the name of the thing that was changed.

    Raises:
        ConfigError: MuJoCo refuses the spec, or no body in it moves.
    """
    tree = Tree(spec.modelname or path.stem, path, [], 0.0)
    for line, about in said:
        tree.say(line, about)
    model = _compiled(spec, path, tree, drawn)
    root = _root(model, path, tree)
    _read_links(model, root, tree, _meshes(spec, model, path), drawn)
    read_motors(model, tree)
    account_for(model, tree)
    _read_loops(model, tree)
    _read_apart(model, tree)
    _read_home(model, tree, path)
    base = tree.links[0]
    tree.turn(base.quat)  # the axes of the base's frame become parallel to the world's axes
    base.pos, base.quat = np.zeros(3), np.array(IDENTITY)
    tree.mass = float(model.body_subtreemass[root])
    return tree


def _compiled(spec: mujoco.MjSpec, path: Path, tree: Tree, drawn: bool) -> mujoco.MjModel:
    """Compile the parts of a spec that a robot consists of. Sensors and contact pairs are removed first, because they may
    refer to elements of a file that includes this one.
    """
    _name_joints(spec)
    paired = {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}
    for geom in spec.geoms:
        if geom.name and geom.name in paired:  # geoms of a contact pair collide even if contype and conaffinity are 0
            geom.contype = geom.contype or 1
    for kind in ("sensors", "pairs", "tuples", "skins"):
        for element in list(getattr(spec, kind)):
            spec.delete(element)
    spec.compiler.discardvisual = False
    folder = path.parent / (spec.meshdir or "")
    missing = {mesh_name(mesh) for mesh in spec.meshes if mesh.file and not (folder / mesh.file).is_file()}
    for geom in list(spec.geoms):
        if geom.type == mujoco.mjtGeom.mjGEOM_MESH and geom.meshname in missing:
            spec.delete(geom)
    if missing:
        tree.say(f"{len(missing)} mesh files do not exist, and the meshes are left out: {', '.join(sorted(missing))[:200]}")
    if not drawn:
        drop_visual_meshes(spec, path)
    used = {geom.meshname for geom in spec.geoms if geom.meshname}
    for mesh in list(spec.meshes):
        if mesh_name(mesh) in missing or mesh_name(mesh) not in used:
            spec.delete(mesh)
    try:
        return spec.compile()
    except Exception as error:
        for key in list(spec.keys):  # keyframes of a scene with more joints may cause the error
            spec.delete(key)
        try:
            return spec.compile()
        except Exception:
            raise ConfigError(f"{path}: MuJoCo refuses it: {' '.join(str(error).split())}") from error


def _name_joints(spec: mujoco.MjSpec) -> None:
    """Name the unnamed joints of each body. A body's first unnamed joint is left out: it is called `<body>_joint` later."""
    taken = {joint.name for joint in spec.joints}
    for body in spec.bodies[1:]:
        for joint in [joint for joint in body.joints if not joint.name][1:]:
            joint.name = free_name(f"{body.name or 'link'}_joint", {f"{body.name}_joint", *taken})
            taken.add(joint.name)


def drop_visual_meshes(spec: mujoco.MjSpec, path: Path) -> None:
    """Remove visual meshes from a spec that was read from `path`, because they take longest to read. Meshes with
    missing files and meshes from which a mass is computed stay.
    """
    folder = path.parent / (spec.meshdir or "")
    there = {mesh_name(mesh) for mesh in spec.meshes if mesh.file and (folder / mesh.file).is_file()}
    dropped = set()
    for geom in list(spec.geoms if there else ()):
        seen_only = not (geom.contype or geom.conaffinity) and geom.type == mujoco.mjtGeom.mjGEOM_MESH
        if seen_only and geom.meshname in there and geom.parent.explicitinertial:
            dropped.add(geom.meshname)
            spec.delete(geom)
    for mesh in list(spec.meshes):
        if mesh_name(mesh) in dropped - {geom.meshname for geom in spec.geoms}:
            spec.delete(mesh)


def mesh_name(mesh: mujoco.MjsMesh) -> str:
    """Return the name of a mesh, which is its file name without suffix by default."""
    return str(mesh.name or Path(mesh.file).stem)


def _root(model: mujoco.MjModel, path: Path, tree: Tree) -> int:
    """Return the id of the robot's base. Of the world's children that have a hinge below them, the base is the one that
    carries most mass.
    """
    turned = [int(body) for body in model.jnt_bodyid[model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE]]
    moved = {root for body in turned if (root := int(model.body_rootid[body])) != body}
    tops = [body for body in range(1, model.nbody) if model.body_parentid[body] == 0]
    able = [body for body in tops if body in moved]
    if not able:
        raise ConfigError(f"{path}: holds no robot: no body that hangs on another body has a hinge")
    root = max(able, key=lambda body: float(model.body_subtreemass[body]))
    others = [_name(model, body) for body in tops if body != root and body in model.geom_bodyid]
    on_world = int((model.geom_bodyid == 0).sum())
    if others or on_world:
        what = [f"{on_world} shapes of the world"] * bool(on_world) + [f"bodies {', '.join(others)[:120]}"] * bool(others)
        tree.say(f"left out: {' and '.join(what)}; the task brings the ground")
    own = [int(i) for i in range(model.njnt) if model.jnt_bodyid[i] == root]
    if not own:
        tree.say(f"body '{_name(model, root)}' is fixed to the world in the file, but floats in the model")
    elif model.jnt_type[own[0]] != mujoco.mjtJoint.mjJNT_FREE:
        names = ", ".join(model.joint(i).name or "unnamed" for i in own)
        tree.say(f"body '{_name(model, root)}' hangs on the joints {names} in the file, but floats in the model")
    return root


def _name(model: mujoco.MjModel, body: int) -> str:
    return model.body(body).name or f"link_{body}"


def _read_links(model: mujoco.MjModel, root: int, tree: Tree, meshes: dict[int, Mesh], drawn: bool) -> None:
    """Append the links of `root` and all bodies below it."""
    places: dict[int, int] = {}
    for body in (b for b in range(1, model.nbody) if model.body_rootid[b] == root):
        link = Link(_name(model, body), -1, model.body_pos[body].copy(), model.body_quat[body].copy())
        link.mass, link.com = float(model.body_mass[body]), model.body_ipos[body].copy()
        turn = matrix(model.body_iquat[body])
        link.inertia = turn @ np.diag(model.body_inertia[body]) @ turn.T
        link.shapes = [
            shape
            for geom in range(model.ngeom)
            if model.geom_bodyid[geom] == body and (shape := _shape(model, geom, link.name, meshes, tree)) is not None
            if shape.collides or drawn
        ]
        if body != root:
            link.parent = places[int(model.body_parentid[body])]
            _read_hinges(model, body, link, tree)
        places[body] = len(tree.links)
        tree.links.append(link)


def _read_hinges(model: mujoco.MjModel, body: int, link: Link, tree: Tree) -> None:
    """Add the hinges of a body to `link`. Their angles are MuJoCo's joint positions. Joints of other types are held."""
    for i in (i for i in range(model.njnt) if model.jnt_bodyid[i] == body):
        name = model.joint(i).name or f"{link.name}_joint"
        kind = mujoco.mjtJoint(int(model.jnt_type[i]))
        if kind != mujoco.mjtJoint.mjJNT_HINGE:
            what = {mujoco.mjtJoint.mjJNT_SLIDE: "slide", mujoco.mjtJoint.mjJNT_BALL: "are balls"}.get(kind, "float")
            tree.say(f"joints that {what} are no hinges; they are held at position 0", name)
            continue
        dof, drawn_at = int(model.jnt_dofadr[i]), float(model.qpos0[model.jnt_qposadr[i]])
        hinge = Hinge(name, model.jnt_axis[i].copy(), model.jnt_pos[i].copy(), driven=False)
        if drawn_at:  # in the file's pose, the joint is at this angle (`ref`)
            turn_link(link, hinge, -drawn_at)
        if model.jnt_limited[i]:
            hinge.range = (float(model.jnt_range[i, 0]), float(model.jnt_range[i, 1]))
        if model.jnt_actfrclimited[i]:
            hinge.effort = _smaller(model.jnt_actfrcrange[i])
        hinge.passive = {
            key: float(value)
            for key, value in (
                ("damping", model.dof_damping[dof]),
                ("armature", model.dof_armature[dof]),
                ("frictionloss", model.dof_frictionloss[dof]),
                ("stiffness", model.jnt_stiffness[i]),
                ("springref", model.qpos_spring[model.jnt_qposadr[i]] if model.jnt_stiffness[i] else 0.0),
            )
            if value
        }
        link.hinges.append(hinge)


def _smaller(limits: np.ndarray) -> float | None:
    """Return the smaller absolute value of the two `limits`, or the larger one if the smaller one is 0. Return None if the
    result is 0 or too large.
    """
    size = float(min(abs(limits[0]), abs(limits[1])) or max(abs(limits[0]), abs(limits[1])))
    return size if 0.0 < size < 1e5 else None


def _shape(model: mujoco.MjModel, geom: int, link: str, meshes: dict[int, Mesh], tree: Tree) -> Shape | None:
    """Return a geom as a shape of `link`; None for types that are left out, such as planes."""
    kind = KINDS.get(mujoco.mjtGeom(int(model.geom_type[geom])))
    collides = bool(model.geom_contype[geom] or model.geom_conaffinity[geom])
    if kind is None:
        tree.say(f"a {mujoco.mjtGeom(int(model.geom_type[geom])).name[7:].lower()} is left out, on link", link)
        return None
    size = np.where(np.arange(3) < SIZED[kind], model.geom_size[geom], 0.0)
    pos, quat = model.geom_pos[geom].copy(), model.geom_quat[geom].copy()
    mesh = None
    if kind == "mesh":
        number = int(model.geom_dataid[geom])
        mesh = meshes[number]
        back = inverse(model.mesh_quat[number])  # MuJoCo moves the vertices of a mesh to its centre and principal axes
        quat = quat_product(quat, back)
        pos = pos - rotate(quat, model.mesh_pos[number])
    material = int(model.geom_matid[geom])
    rgba = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material] * _texture(model, material)
    friction = model.geom_friction[geom]
    return Shape(
        kind,
        size,
        pos,
        quat,
        collides,
        link,
        model.geom(geom).name,
        mesh,
        rgba.astype(float),
        None if np.allclose(friction, PLAIN_FRICTION) else friction.copy(),
    )


def _texture(model: mujoco.MjModel, material: int) -> np.ndarray:
    """Return the mean colour (4,) of a material's texture; textures are not imported."""
    texture = int(model.mat_texid[material, int(mujoco.mjtTextureRole.mjTEXROLE_RGB)])
    if texture < 0:
        return np.ones(4)
    channels, start = int(model.tex_nchannel[texture]), int(model.tex_adr[texture])
    count = int(model.tex_height[texture] * model.tex_width[texture])
    pixels = model.tex_data[start : start + channels * count].reshape(count, channels)
    return np.array([*(pixels[:, :3].mean(axis=0) / 255.0), 1.0]) if channels >= 3 else np.ones(4)


def _meshes(spec: mujoco.MjSpec, model: mujoco.MjModel, path: Path) -> dict[int, Mesh]:
    """Return id -> mesh: the mesh's file if it exists and the MJCF does not move or turn the mesh, else its vertices."""
    found: dict[int, Mesh] = {}
    for mesh in spec.meshes:
        number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_MESH, mesh_name(mesh))
        if number < 0:
            continue
        name = model.mesh(number).name
        file = (path.parent / (spec.meshdir or "") / mesh.file).resolve() if mesh.file else None
        plain = np.allclose(mesh.refpos, 0.0) and np.allclose(mesh.refquat, IDENTITY)
        if file is not None and plain and file.is_file():
            found[number] = Mesh(name, file, np.array(mesh.scale, dtype=float))
    for number in set(range(model.nmesh)) - set(found):
        start, count = int(model.mesh_vertadr[number]), int(model.mesh_vertnum[number])
        vertices = model.mesh_vert[start : start + count].astype(float)
        vertices = rotate(model.mesh_quat[number], vertices) + model.mesh_pos[number]
        start, count = int(model.mesh_faceadr[number]), int(model.mesh_facenum[number])
        found[number] = Mesh(
            model.mesh(number).name, None, np.ones(3), vertices, model.mesh_face[start : start + count].copy()
        )
    return found


def _read_loops(model: mujoco.MjModel, tree: Tree) -> None:
    """Read the equality constraints between links or hinges; report the others as left out."""
    links, hinges = {link.name for link in tree.links}, {hinge.name for hinge in tree.hinges}
    for i in range(model.neq):
        if not model.eq_active0[i]:
            continue
        kind, data = mujoco.mjtEq(int(model.eq_type[i])), model.eq_data[i]
        solver = {"solref": text_of(model.eq_solref[i]), "solimp": text_of(model.eq_solimp[i])}
        ids = (int(model.eq_obj1id[i]), int(model.eq_obj2id[i]))
        if kind == mujoco.mjtEq.mjEQ_CONNECT:
            sites = model.eq_objtype[i] == mujoco.mjtObj.mjOBJ_SITE
            bodies = [int(model.site_bodyid[j]) if sites else j for j in ids]
            anchors = model.site_pos[list(ids)] if sites else data[:6].reshape(2, 3)
            names = [_name(model, body) for body in bodies]
            if set(names) <= links:
                ends = dict(zip(("body1", "body2", "anchor", "anchor2"), (*names, *map(text_of, anchors)), strict=True))
                tree.loops.append({"tag": "connect", **ends, **solver})
                continue
        elif kind == mujoco.mjtEq.mjEQ_JOINT:
            names = [model.joint(j).name for j in ids if j >= 0]
            if set(names) <= hinges:
                ends = dict(zip(("joint1", "joint2"), names, strict=False))
                first, *second = (float(model.qpos0[model.jnt_qposadr[j]]) for j in ids if j >= 0)
                tree.loops.append(
                    {"tag": "joint", **ends, "polycoef": text_of(_coupling(data[:5], first, *second)), **solver}
                )
                continue
        tree.say(f"a constraint ({kind.name[5:].lower()}) is left out: only connect, and joint between hinges, are supported")


def _read_apart(model: mujoco.MjModel, tree: Tree) -> None:
    """Read the pairs of links that do not collide."""
    links = {link.name for link in tree.links}
    for signature in model.exclude_signature:
        pair = (_name(model, int(signature) >> 16), _name(model, int(signature) & 0xFFFF))
        if set(pair) <= links:
            tree.apart.add(pair)


def _coupling(factors: np.ndarray, first: float, second: float = 0.0) -> np.ndarray:
    """Return the coefficients (5,) of the polynomial that gives the first hinge's angle from the second's [rad]. `first`
    and `second` are the joints' `ref` angles [rad]. MuJoCo's coefficients `factors` are for angles from `ref`.
    """
    polynomial = first + np.polynomial.Polynomial(factors)(np.polynomial.Polynomial([-second, 1.0]))
    return np.pad(polynomial.coef, (0, 5 - len(polynomial.coef)))


def _read_home(model: mujoco.MjModel, tree: Tree, path: Path) -> None:
    """Read the joint angles of a keyframe: one whose name says that the robot stands, else the first."""
    if not model.nkey:
        return
    names = [model.key(i).name for i in range(model.nkey)]
    key = next((i for i, name in enumerate(names) if any(word in name.lower() for word in ("home", "stand", "default"))), 0)
    tree.home = {}
    for i in range(model.njnt):
        if model.jnt_type[i] == mujoco.mjtJoint.mjJNT_HINGE:
            name = model.joint(i).name or f"{_name(model, int(model.jnt_bodyid[i]))}_joint"
            tree.home[name] = float(model.key_qpos[key, model.jnt_qposadr[i]])
    tree.home_name = names[key] or str(key)
