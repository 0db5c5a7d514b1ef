"""Torque limits and gains of hinges, read from MuJoCo actuators."""

import mujoco
import numpy as np

from legged.robots.importing.tree import Hinge, Tree

ON_JOINTS = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
MOST = 1e5
"""Torques [N m] and gains [N m/rad] above this value count as missing."""


def read_motors(model: mujoco.MjModel, tree: Tree) -> None:
    """Set the torque limits and gains of the hinges that have actuators, and mark these hinges as driven. The values are
    those at the joint, after the gear. In a file without actuators, all hinges are driven.
    """
    hinges = {hinge.name: hinge for hinge in tree.hinges}
    for i in range(model.nu):
        joint = int(model.actuator_trnid[i, 0])
        name = ""
        if mujoco.mjtTrn(int(model.actuator_trntype[i])) in ON_JOINTS:
            name = model.joint(joint).name or f"{model.body(model.jnt_bodyid[joint]).name}_joint"
        if name not in hinges:
            tree.say("actuators that drive something other than one hinge are left out", model.actuator(i).name or str(i))
            continue
        _read_actuator(model, i, hinges[name])
    if not any(hinge.driven for hinge in hinges.values()):
        for hinge in hinges.values():
            hinge.driven = True
        tree.say("the file has no actuators: every hinge is given a motor")
    for hinge in hinges.values():
        if not hinge.driven:
            tree.say("hinges that have no motor stay passive", hinge.name)


def _read_actuator(model: mujoco.MjModel, i: int, hinge: Hinge) -> None:
    gear = float(model.actuator_gear[i, 0])
    gain, bias = model.actuator_gainprm[i], model.actuator_biasprm[i]
    fixed = model.actuator_gaintype[i] == mujoco.mjtGain.mjGAIN_FIXED
    affine = model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE
    hinge.driven = True
    limits = []
    if model.actuator_forcelimited[i]:
        limits.append(np.abs(model.actuator_forcerange[i] * gear))
    if fixed and not affine and model.actuator_ctrllimited[i]:  # the actuator is a motor: its control is a force
        limits.append(np.abs(model.actuator_ctrlrange[i] * gain[0] * gear))
    if affine and fixed:
        stiffness, damping = -float(bias[1]) * gear**2, -float(bias[2]) * gear**2
        if 0.0 < stiffness < MOST:
            hinge.stiffness = (hinge.stiffness or 0.0) + stiffness
        if 0.0 < damping < MOST:
            hinge.damping = (hinge.damping or 0.0) + damping
    sizes = [float(limit.min() or limit.max()) for limit in limits]
    found = [size for size in (hinge.effort, *sizes) if size is not None and 0.0 < size < MOST]
    hinge.effort = min(found, default=None)
