"""All parts of a physics step except contacts and constraints, in one launch: poses, inertias, and the forces of motors,
springs and gravity.

mujoco-warp needs about twenty launches for this, and at 4096 worlds each launch costs microseconds even if it computes
little. Here each world has one warp of threads, and the quantities that bodies pass to their parents and children stay on
the chip. The algorithms are recursive Newton-Euler and composite rigid bodies (Featherstone, Rigid Body Dynamics Algorithms,
2008), in MuJoCo's coordinates: spatial vectors are (angular, linear) in world axes about a tree's centre of mass; inertias
are (xx, yy, zz, xy, xz, yz, m * offset, m).

Parameters are read from mujoco-warp's own model arrays, in which worlds may differ.
"""

from collections.abc import Collection
from typing import Any

import mujoco
import numpy as np
import warp as wp

from legged.physics.fused.native import LANES, SHARED_BYTES, lanes_of, native_source
from legged.physics.fused.tree import CONNECT, JOINT, SITE, WELD

FREE, BALL, SLIDE, HINGE = (int(getattr(mujoco.mjtJoint, f"mjJNT_{name}")) for name in ("FREE", "BALL", "SLIDE", "HINGE"))
AFFINE = int(mujoco.mjtBias.mjBIAS_AFFINE)
SOURCE = ("smooth_dynamics.h",)
UNKNOWN = {
    "gravity compensation": ("body_gravcomp",),
    "nonlinear springs": ("jnt_stiffnesspoly", "jnt_springyield"),
    "nonlinear dampers": ("dof_dampingpoly",),
    "dampers or armature of actuators": ("actuator_damping", "actuator_dampingpoly", "actuator_armature"),
    "tendons with forces or limits": (
        "tendon_stiffness",
        "tendon_stiffnesspoly",
        "tendon_damping",
        "tendon_dampingpoly",
        "tendon_frictionloss",
        "tendon_armature",
        "tendon_limited",
    ),
    "adhesion": ("geom_adhesion",),
    "delayed controls": ("actuator_delay",),
}
"""Unsupported feature -> arrays of the model that contain only zeros if the model lacks the feature."""
COUNTED = {
    "nflex": "flexes",
    "nmocap": "mocap bodies",
    "na": "actuators with a state",
    "nplugin": "plugins",
}
"""Count in the model -> unsupported feature. The count is zero if the model lacks the feature."""
NEEDED_STAGES = ("ACTUATION", "CLAMPCTRL", "DAMPER", "EULERDAMP", "GRAVITY", "SPRING", "WARMSTART")
"""Stages that a model may disable in MuJoCo, but that are always computed here."""
PUSHED = "xfrc_applied"
"""Array of external forces. `randomized` contains this name if external forces act on bodies."""
ROW_LENGTHS = {"OF_INERTIA": 11, "OF_MOTION": 7, "OF_BODY": 17}
"""Lengths of rows in shared memory [floats]: of inertias, motion axes, and other quantities of bodies. They are odd, so that
lanes that read different rows use different memory banks."""
MOST_BLOCKS = 32
"""Number of blocks that a multiprocessor must be able to run at once. The compiler limits the registers of a lane
accordingly, so that 4096 worlds run at once on an H100."""

Vector10 = wp.types.vector(length=10, dtype=wp.float32)


@wp.struct
class DynamicsArrays:
    """Arrays of the kernel: its own tables, and arrays of mujoco-warp's model and data, which have the same names there. The
    kernel writes `geom_xpos` and all arrays after it.
    """

    body_packed: wp.array[int]
    body_subtree: wp.array[int]
    body_tree: wp.array[int]
    tree_root: wp.array[int]
    motor_start: wp.array[int]
    motor: wp.array[int]
    motor_of_dof: wp.array[int]
    joint_packed: wp.array[int]
    dof_packed: wp.array[int]
    jnt_actfrclimited: wp.array[bool]
    geom_bodyid: wp.array[int]
    site_bodyid: wp.array[int]
    actuator_ctrladr: wp.array[int]
    actuator_biastype: wp.array[int]
    actuator_ctrllimited: wp.array[bool]
    actuator_forcelimited: wp.array[bool]
    M_rowadr: wp.array[int]
    M_rownnz: wp.array[int]
    M_colind: wp.array[int]
    gravity: wp.array[wp.vec3]
    body_mass: wp.array2d[float]
    body_inertia: wp.array2d[wp.vec3]
    body_pos: wp.array2d[wp.vec3]
    body_quat: wp.array2d[wp.quat]
    body_ipos: wp.array2d[wp.vec3]
    body_iquat: wp.array2d[wp.quat]
    jnt_pos: wp.array2d[wp.vec3]
    jnt_axis: wp.array2d[wp.vec3]
    jnt_stiffness: wp.array2d[float]
    jnt_actfrcrange: wp.array2d[wp.vec2]
    qpos0: wp.array2d[float]
    qpos_spring: wp.array2d[float]
    dof_armature: wp.array2d[float]
    dof_damping: wp.array2d[float]
    geom_pos: wp.array2d[wp.vec3]
    geom_quat: wp.array2d[wp.quat]
    site_pos: wp.array2d[wp.vec3]
    actuator_gear: wp.array2d[wp.spatial_vector]
    actuator_gainprm: wp.array2d[Vector10]
    actuator_biasprm: wp.array2d[Vector10]
    actuator_ctrlrange: wp.array2d[wp.vec2]
    actuator_forcerange: wp.array2d[wp.vec2]
    qpos: wp.array2d[float]
    qvel: wp.array2d[float]
    ctrl: wp.array2d[float]
    xfrc_applied: wp.array2d[wp.spatial_vector]
    geom_xpos: wp.array2d[wp.vec3]
    geom_xmat: wp.array2d[wp.mat33]
    subtree_com: wp.array2d[wp.vec3]
    cdof: wp.array2d[wp.spatial_vector]
    xpos: wp.array2d[wp.vec3]
    xquat: wp.array2d[wp.quat]
    xmat: wp.array2d[wp.mat33]
    site_xpos: wp.array2d[wp.vec3]
    cvel: wp.array2d[wp.spatial_vector]
    cdof_dot: wp.array2d[wp.spatial_vector]
    M: wp.array2d[float]
    qfrc_passive: wp.array2d[float]
    qfrc_actuator: wp.array2d[float]
    qfrc_smooth: wp.array2d[float]


OF_MODEL = (
    *("gravity", "qpos0", "qpos_spring", "dof_armature", "dof_damping", "geom_pos", "geom_quat", "site_pos"),
    *("body_mass", "body_inertia", "body_pos", "body_quat", "body_ipos", "body_iquat"),
    *("jnt_pos", "jnt_axis", "jnt_stiffness", "jnt_actfrcrange", "actuator_gear", "actuator_gainprm", "actuator_biasprm"),
    *("actuator_ctrlrange", "actuator_forcerange"),
)
"""Arrays of the model that may have one row per world."""


def dynamics_constants(model: mujoco.MjModel, randomized: Collection[str] = ()) -> dict[str, int | bool]:
    """Return the constants of smooth_dynamics.h for a model. `randomized` names the arrays in which worlds differ."""
    trees = _trees(model)
    return {
        **{"NB": model.nbody, "NV": model.nv, "NJ": model.njnt, "NG": model.ngeom},
        **{"NT": len(trees["tree_root"]), "DEPTH": int((trees["body_packed"] >> 20).max())},
        **ROW_LENGTHS,
        "BALLS": bool(np.any(model.jnt_type == BALL)),
        "SLIDES": bool(np.any(model.jnt_type == SLIDE)),
        "ONE_MOTOR": _one_motor(model),
        "SPRINGS": bool(np.any(model.jnt_stiffness)) or "jnt_stiffness" in randomized,
        "BALL_SPRINGS": bool(np.any(model.jnt_stiffness[~_scalar(model)]))
        or ("jnt_stiffness" in randomized and not _scalar(model).all()),
        "DAMPERS": has_dampers(model, randomized),
        "GEARS": bool(np.any(model.actuator_gear[:, 0] != 1.0)) or "actuator_gear" in randomized,
        "GAINS": bool(np.any(model.actuator_gainprm[:, 0] != 1.0)) or "actuator_gainprm" in randomized,
        "AFFINE_BIAS": bool(np.any(model.actuator_biastype == AFFINE)),
        "CONTROL_LIMITS": bool(np.any(model.actuator_ctrllimited)),
        "FORCE_LIMITS": bool(np.any(model.actuator_forcelimited)),
        "JOINT_LIMITS": bool(np.any(model.jnt_actfrclimited)),
        "PUSHED": PUSHED in randomized,
        "EQUALITIES": bool(np.isin(model.eq_type, (CONNECT, WELD)).any()),
        "SITES": model.nsite if bool(np.any(model.eq_objtype == SITE)) else 0,
        **{"FREE": FREE, "BALL": BALL, "SLIDE": SLIDE, "AFFINE": AFFINE},
        **{f"VARIES_{name}": name in randomized for name in OF_MODEL},
    }


def shared_bytes(model: mujoco.MjModel) -> int:
    """Return the size of the shared memory that smooth_dynamics.h uses in each block [bytes]."""
    bodies, joints, dofs = model.nbody, model.njnt, model.nv
    place = max(7 * bodies + 6 * joints, ROW_LENGTHS["OF_BODY"] * bodies)
    return 4 * ((3 + ROW_LENGTHS["OF_INERTIA"]) * bodies + (1 + ROW_LENGTHS["OF_MOTION"]) * dofs + place)


def dynamics_kernel(constants: dict[str, int | bool]) -> Any:
    """Return the kernel for a set of `dynamics_constants`. Its launch dimension is (worlds, lanes)."""
    move_world = dynamics_function(constants)

    @wp.kernel(module="unique", enable_backward=False, launch_bounds=(LANES, MOST_BLOCKS))
    def smooth_dynamics(arrays: DynamicsArrays) -> None:
        world, _lane = wp.tid()  # type: ignore[misc]
        move_world(world, arrays)

    return smooth_dynamics


def dynamics_function(constants: dict[str, int | bool]) -> Any:
    """Return the kernel's device function. It computes one world."""

    @wp.func_native(native_source(SOURCE, constants))
    def move_world(world: int, arrays: DynamicsArrays) -> None: ...

    return move_world


def has_dampers(model: mujoco.MjModel, randomized: Collection[str] = ()) -> bool:
    """Return True if a joint is damped in the model, or may be damped in a world because `dof_damping` is in `randomized`."""
    return bool(np.any(model.dof_damping)) or "dof_damping" in randomized


class SmoothDynamics:
    """Computes poses of shapes, centres of mass, motion axes, the mass matrix, and all forces except constraint forces, from
    joint positions, velocities and controls.
    """

    def __init__(self, model: mujoco.MjModel, m: Any, d: Any, randomized: Collection[str] = ()) -> None:
        """Prepare the launch for a `model` that `why_not` accepts; `m` and `d` are mujoco-warp's model and data for it.
        `randomized` names the arrays in which worlds differ. Warp's current device must be that of `m` and `d`.
        """
        arrays = self.arrays = DynamicsArrays()
        tables = _trees(model) | _motors(model) | _joints(model)
        for name in DynamicsArrays.vars:  # type: ignore[attr-defined]
            if name in tables:
                value = wp.array(tables[name], dtype=int)
            else:
                value = getattr(m.opt if name == "gravity" else m if hasattr(m, name) else d, name)
            setattr(arrays, name, value)
        self.constants = dynamics_constants(model, randomized)
        """Constants of smooth_dynamics.h."""
        self._kernel = dynamics_kernel(self.constants)
        self._lanes = lanes_of(d.qacc.device)
        self._worlds = d.nworld

    @staticmethod
    def why_not(model: mujoco.MjModel, randomized: Collection[str] = ()) -> str:
        """Return the reason why `model` is not supported, or an empty text. `randomized` names the arrays in which worlds
        differ.
        """
        for words, names in UNKNOWN.items():
            if drawn := [name for name in names if name in randomized]:
                return f"{words} may differ between worlds ({drawn[0]})"
            if any(np.any(getattr(model, name)) for name in names):
                return f"the model has {words}"
        for count, words in COUNTED.items():
            if getattr(model, count):
                return f"the model has {words}"
        if np.any(model.opt.wind) or model.opt.density or model.opt.viscosity:
            return "the model is in a fluid (density, viscosity or wind)"
        if off := [
            name for name in NEEDED_STAGES if model.opt.disableflags & getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}")
        ]:
            return f"the model disables {off[0].lower()}"
        if model.opt.enableflags or model.opt.disableactuator:
            return "the model enables optional features, or disables groups of actuators"
        if not model.nv:
            return "the model has no joints"
        if max(model.nbody, model.njnt) > 255:
            return f"the model has {model.nbody} bodies and {model.njnt} joints; at most 255 of each are supported"
        if shared_bytes(model) > SHARED_BYTES:
            return f"the data of {model.nbody} bodies exceed a GPU's shared memory"
        if not np.isin(model.eq_type, (CONNECT, WELD, JOINT)).all():
            return "the model has equality constraints of tendons or flexes"
        return _why_not_motors(model, _scalar(model))

    def launch(self) -> None:
        """Compute everything that a step needs before collision detection."""
        dim = (self._worlds, self._lanes)
        wp.launch(self._kernel, dim=dim, inputs=[self.arrays], block_dim=self._lanes)


def _scalar(model: mujoco.MjModel) -> np.ndarray:
    """Return a mask (njnt,) of the slides and hinges."""
    return (model.jnt_type == SLIDE) | (model.jnt_type == HINGE)


def _why_not_motors(model: mujoco.MjModel, scalar: np.ndarray) -> str:
    """Return the reason why the actuators are not supported; empty if they are. `scalar` (njnt,) marks slides and hinges."""
    on_joint = np.isin(model.actuator_trntype, (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    if not on_joint.all() or not scalar[model.actuator_trnid[:, 0]].all():
        return "an actuator acts on neither a slide nor a hinge"
    plain = (
        (model.actuator_gaintype == mujoco.mjtGain.mjGAIN_FIXED)
        & np.isin(model.actuator_biastype, (mujoco.mjtBias.mjBIAS_NONE, AFFINE))
        & (model.actuator_dyntype == mujoco.mjtDyn.mjDYN_NONE)
        & (model.actuator_ctrlnum == 1)
    )
    return "" if plain.all() else "an actuator is neither a motor nor a position or velocity servo"


def _trees(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Return tables of the bodies and of their kinematic trees.

    For each body, `body_subtree` is the number of bodies in its subtree, itself included; `body_tree` is the index of its
    tree; `body_packed` packs its parent, its first joint, its number of joints and its level below the world into one
    integer. For each tree, `tree_root` is its first body, a child of the world. Trees without joints are left out, and
    `body_tree` of their bodies is 0. Each index has 8 bits, so `why_not` rejects models with more than 255 bodies or joints.
    """
    parent = model.body_parentid
    level, subtree = np.zeros(model.nbody, dtype=int), np.ones(model.nbody, dtype=int)
    for b in range(1, model.nbody):
        level[b] = level[parent[b]] + 1
    for b in range(model.nbody - 1, 0, -1):
        subtree[parent[b]] += subtree[b]
    roots = np.unique(model.body_rootid[model.dof_bodyid])
    tree = np.zeros(model.nbody, dtype=int)
    for t, root in enumerate(roots):
        tree[root : root + subtree[root]] = t
    joints = np.maximum(model.body_jntadr, 0) << 8 | model.body_jntnum << 16
    return {
        "body_packed": parent | joints | level << 20,
        "body_subtree": subtree,
        "body_tree": tree,
        "tree_root": roots,
    }


def _motors(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Return tables of motors. `motor` lists them sorted by degree of freedom. For each degree of freedom, `motor_start` is
    the place of its first motor in that list, and `motor_of_dof` is its last motor, or -1 without a motor.
    """
    dof = model.jnt_dofadr[model.actuator_trnid[:, 0]]
    start = np.searchsorted(np.sort(dof), np.arange(model.nv + 1))
    of_dof = np.full(model.nv, -1)
    of_dof[dof] = np.arange(model.nu)
    return {"motor_start": start, "motor": np.argsort(dof, kind="stable"), "motor_of_dof": of_dof}


def _one_motor(model: mujoco.MjModel) -> bool:
    """Return True if each degree of freedom has at most one motor, and each motor uses the control with the motor's index."""
    joints = model.actuator_trnid[:, 0]
    return len(set(joints.tolist())) == model.nu and bool((model.actuator_ctrladr == np.arange(model.nu)).all())


def _joints(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Return two tables that pack several numbers into one integer. `joint_packed` has the type of each joint, the index of
    its position in qpos, and its first degree of freedom. `dof_packed` has the body of each degree of freedom, its joint, the
    joint's type, and its index within the joint.
    """
    joint = model.dof_jntid
    place = np.arange(model.nv) - model.jnt_dofadr[joint]
    return {
        "joint_packed": model.jnt_type | model.jnt_qposadr << 4 | model.jnt_dofadr << 16,
        "dof_packed": model.dof_bodyid | joint << 8 | model.jnt_type[joint] << 16 | place << 20,
    }
