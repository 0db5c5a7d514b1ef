"""Robots drawn at random: a floating base with a tree of hinges, and whatever else a robot's model may have."""

from collections.abc import Collection
from typing import Any

import mujoco
import numpy as np

EXTRAS = (
    "damping",
    "friction",
    "springs",
    "limits",
    "force limits",
    "gears",
    "servos",
    "passive",
    "loops",
    "couplings",
    "self-collision",
    "elliptic",
)
"""What `random_robot` can add. Of `elliptic`, contacts have any number of directions that MuJoCo knows."""
TIMESTEP = 0.002


def random_robot(seed: int, hinges: int, extras: Collection[str] = ()) -> mujoco.MjModel:
    """Return a robot of 6 + `hinges` degrees of freedom on a plane, with all `extras`, that stands or lies near the ground.

    Its limbs branch at the base and now and then further out; ends have balls for feet.
    """
    rng = np.random.default_rng(seed)
    spec = mujoco.MjSpec()
    option = spec.option
    option.timestep, option.iterations, option.ls_iterations, option.tolerance = TIMESTEP, 100, 50, 1e-10
    option.solver, option.integrator = mujoco.mjtSolver.mjSOL_NEWTON, mujoco.mjtIntegrator.mjINT_EULER
    option.impratio = rng.uniform(1.0, 10.0)
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC if "elliptic" in extras else mujoco.mjtCone.mjCONE_PYRAMIDAL
    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[5, 5, 0.1], contype=1, conaffinity=0)
    base = spec.worldbody.add_body(name="base", pos=[0, 0, 0.35])
    base.add_freejoint()
    meets = 2 if "self-collision" in extras else 0  # others' bits, beside the floor's
    shape = {"contype": meets, "conaffinity": 1 | meets}
    base.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.12, 0, 0], mass=3.0 + 0.2 * hinges, **shape)
    apart = 0.06 if meets else 0.12  # so near that feet meet
    chains = max(1, min(4, hinges // 2))
    made: list[Any] = []
    ends: list[Any] = []
    for k in range(hinges):
        branch = rng.random() < 0.2 and len(made) > chains
        parent = base if k < chains else made[int(rng.integers(0, len(made)))] if branch else made[k - chains]
        turn = 2.0 * np.pi * (k % chains) / chains
        step = [apart * np.cos(turn), apart * np.sin(turn), 0.0] if parent is base else [0.02, 0.01, -0.28 * chains / hinges]
        body = parent.add_body(name=f"limb{k}", pos=np.array(step) + rng.normal(0.0, 0.01, 3), quat=[1, *rng.normal(0, 0.1, 3)])
        made.append(body)
        ends = [end for end in ends if end is not parent] + [body]
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=[0, 0, 0, 0.03, 0, -0.05],
            size=[0.015, 0, 0],
            mass=rng.uniform(0.2, 0.5),
            contype=0,
            conaffinity=0,
        )
        axis = np.eye(3)[k % 3] + rng.normal(0.0, 0.1, 3)
        joint = body.add_joint(name=f"hinge{k}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis, armature=rng.uniform(0.01, 0.05))
        _furnish(spec, joint, rng, extras)
    directions = (1, 3, 4, 6) if "elliptic" in extras else (3,)
    for n, end in enumerate(ends):
        end.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[0.04, 0, 0],
            pos=[0, 0, -0.05],
            mass=0.1,
            condim=directions[n % len(directions)],
            friction=[rng.uniform(0.3, 1.2), 0.02, 0.01],
            **shape,
        )
    if "couplings" in extras and hinges > 3:
        spec.add_equality(type=mujoco.mjtEq.mjEQ_JOINT, name1="hinge1", name2=f"hinge{hinges - 1}", data=[0, 0.7] + 10 * [0])
    model = spec.compile()
    if "loops" in extras and len(ends) > 1:
        _close(spec, model, ends)
        model = spec.compile()
    return model


def _furnish(spec: Any, joint: Any, rng: np.random.Generator, extras: Collection[str]) -> None:
    """Add to a hinge what the extras ask for, and a motor."""
    if "damping" in extras:
        joint.damping[0] = rng.uniform(0.0, 1.0)
    if "friction" in extras and rng.random() < 0.7:
        joint.frictionloss = rng.uniform(0.1, 0.6)
    if "springs" in extras and rng.random() < 0.5:
        joint.stiffness[0], joint.springref = rng.uniform(1.0, 20.0), rng.normal(0.0, 0.2)
    if "limits" in extras:
        joint.limited, joint.range = True, [-rng.uniform(0.05, 1.0), rng.uniform(0.05, 1.0)]
    if "force limits" in extras:
        joint.actfrclimited, joint.actfrcrange = True, [-rng.uniform(0.2, 2.0), rng.uniform(0.2, 2.0)]
    if "passive" in extras and rng.random() < 0.4:
        return
    motor = spec.add_actuator(target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    if "gears" in extras:
        motor.gear[0] = rng.uniform(0.5, 2.0)
    if "servos" in extras:
        motor.biastype, motor.gainprm[0], motor.biasprm[1:3] = mujoco.mjtBias.mjBIAS_AFFINE, 10.0, [-10.0, -0.3]
    if "force limits" in extras:
        motor.forcelimited, motor.forcerange = True, [-1.0, 1.0]


def _close(spec: Any, model: mujoco.MjModel, ends: list[Any]) -> None:
    """Tie two ends together where they are, and hold another, if there is one, by a rod's end that may turn."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    first, second = ends[0].name, ends[1].name
    middle = 0.5 * (data.body(first).xpos + data.body(second).xpos)
    anchor = data.body(first).xmat.reshape(3, 3).T @ (middle - data.body(first).xpos)
    tie = spec.add_equality(type=mujoco.mjtEq.mjEQ_CONNECT, name1=first, name2=second, objtype=mujoco.mjtObj.mjOBJ_BODY)
    tie.data[:3] = anchor
    if len(ends) > 3:
        other = spec.add_equality(
            type=mujoco.mjtEq.mjEQ_WELD, name1=ends[2].name, name2=ends[3].name, objtype=mujoco.mjtObj.mjOBJ_BODY
        )
        other.data[:] = 0.0
        other.data[10] = 1.0


def rollout(model: mujoco.MjModel, seed: int, steps: int, every: int, most: float = 1.0) -> list[dict[str, Any]]:
    """Return each `every`th of `steps` states that C MuJoCo passes under random controls, in numbers of float32, with what one
    step makes of it.
    """
    rng, data = np.random.default_rng(seed), mujoco.MjData(model)
    data.qvel[:] = 0.3 * rng.normal(size=model.nv)
    data.qpos[7:] += 0.1 * rng.normal(size=model.nq - 7)
    passed = []
    for k in range(steps):
        if k % 10 == 0:
            data.ctrl[:] = np.float32(rng.uniform(-most, most, model.nu))
        data.qpos[:], data.qvel[:] = np.float32(data.qpos), np.float32(data.qvel)
        state = {name: getattr(data, name).copy() for name in ("qpos", "qvel", "ctrl")}
        mujoco.mj_step(model, data)
        if k % every == every - 1:
            names = ("qacc", "qfrc_constraint", "qfrc_smooth")
            after = {"qpos after": data.qpos.copy(), "qvel after": data.qvel.copy(), "rows": data.nefc, "touching": data.ncon > 0}
            passed.append(state | {name: getattr(data, name).copy() for name in names} | after)
    return passed
