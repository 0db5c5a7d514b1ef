"""Models of many kinds for mujoco_warp's fused step, and worlds of one, beside the same in C MuJoCo."""

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from legged.physics.fused.constraint_solver import ConstraintSolver, ask_for_dense_rows
from legged.physics.fused.contact_stage import ContactStage
from legged.physics.fused.smooth_dynamics import SmoothDynamics
from legged.physics.fused.torque_step import TorqueStep
from legged.physics.warp.mujoco_warp import absent_stages

OPTION = '<option timestep="0.004" gravity="0.4 -0.3 -9" solver="Newton" cone="pyramidal" integrator="Euler"/>'

CROOKED = f"""
<mujoco>
  <compiler angle="radian"/>
  {OPTION}
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1" pos="0.1 0.2 -0.3"/>
    <body name="base" pos="0 0 1">
      <freejoint/>
      <geom name="trunk" type="box" size=".3 .2 .1" mass="5" pos=".02 .01 0" quat=".9 .1 .3 -.2"/>
      <body name="mast" pos="0 0 .2" quat=".8 .2 -.1 .4"><geom name="mast" type="capsule" size=".02 .1" mass=".7"/></body>
      <body name="arm" pos=".3 .1 0" quat=".7 .3 .2 -.4">
        <joint name="shoulder" type="hinge" axis="1 2 -1" pos=".02 -.03 .05" armature="0.03" ref="0.4"/>
        <joint name="twist" type="hinge" axis="0 1 1" pos=".01 0 0"/>
        <geom name="arm" type="box" size=".2 .04 .03" mass="1.1" pos=".1 0 .02"/>
        <body name="hand" pos=".4 0 0" quat=".9 -.2 .3 .1">
          <joint name="wrist" type="hinge" axis="0 0 1" pos="-.05 0 0"/>
          <geom name="hand" size=".05" mass=".3" pos=".05 .02 0"/>
        </body>
      </body>
      <body name="tail" pos="-.3 0 0">
        <joint name="tail" type="hinge" axis="0 1 0"/>
        <geom name="tail" type="capsule" fromto="0 0 0 -.3 0 .1" size=".02" mass=".4"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor joint="shoulder" forcerange="-20 20"/><motor joint="twist" forcerange="-20 20"/>
    <motor joint="wrist" forcerange="-20 20"/><motor joint="tail" forcerange="-20 20"/>
  </actuator>
</mujoco>
"""
"""A welded body, two hinges in one body, joints off their bodies' origins, a reference angle, gravity aslant."""

EVERY_JOINT = f"""
<mujoco>
  <compiler angle="radian"/>
  {OPTION}
  <worldbody>
    <body name="post" pos="1 0 .2" quat=".9 .1 0 .3">
      <geom type="box" size=".1 .1 .4" mass="3"/>
      <body name="swing" pos="0 .1 .5" quat=".8 .1 .3 -.2">
        <joint name="swing" type="hinge" axis="0 1 .2" stiffness="3" springref=".3" damping=".4" ref=".1"/>
        <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass=".8"/>
        <body name="bob" pos=".3 0 0">
          <joint name="bob" type="ball" damping=".03" stiffness="2" pos=".01 .02 0"/>
          <geom type="box" size=".1 .04 .03" mass=".5" pos=".1 0 0"/>
          <body name="rod" pos=".1 0 .1">
            <joint name="rod" type="slide" axis="1 0 1" damping=".6" stiffness="20"/>
            <geom size=".04" mass=".3" pos="0 .05 0"/>
          </body>
        </body>
      </body>
    </body>
    <body name="cart" pos="0 1 0">
      <joint name="x" type="slide" axis="1 0 0" ref=".2"/>
      <joint name="z" type="slide" axis="0 .1 1" damping="1"/>
      <joint name="pitch" type="hinge" axis="0 1 0" pos=".1 0 0" stiffness="8" armature=".1"/>
      <geom type="box" size=".2 .1 .1" mass="2" pos=".03 0 .02" quat=".9 .1 .3 -.2"/>
      <body name="leg" pos=".2 0 0">
        <joint name="leg" type="hinge" axis="0 1 0" damping=".2" actuatorfrcrange="-3 4"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".03" mass=".5"/>
      </body>
    </body>
    <body name="flyer" pos="0 -1 1">
      <joint name="flyer" type="free" damping=".3" stiffness="1.5"/>
      <geom type="box" size=".1 .2 .05" mass="1"/>
      <body name="wing" pos="0 .2 0">
        <joint name="wing" type="hinge" axis="1 0 0"/><geom type="box" size=".1 .2 .01" pos="0 .2 0" mass=".2"/>
      </body>
    </body>
    <geom name="mark" size=".05" pos="2 2 0"/>
  </worldbody>
  <actuator>
    <motor joint="leg" gear="3" ctrllimited="true" ctrlrange="-1 .5"/>
    <position joint="wing" kp="4" kv=".2" forcerange="-2 1" ctrlrange="-1 1"/>
    <motor joint="swing" gear="-1.5" forcerange="-1 1"/>
    <general joint="leg" gear=".7" gainprm="2"/>
    <velocity joint="rod" kv="2" gear="1.3"/>
    <motor joint="pitch"/>
  </actuator>
</mujoco>
"""
"""Three trees, one of them on a fixed body, of all kinds of joints, with springs, dampers, passive joints, several joints in
a body, several actuators of a joint, gears, servos, and limits of controls, actuators and joints."""


def packaged(name: str, **options: Any) -> mujoco.MjModel:
    """Return a model of gymnasium's package data, with the integrator, solver and cones of the fused step."""
    spec = mujoco.MjSpec.from_file(str(Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / name))
    option = spec.option
    option.integrator, option.solver = mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtSolver.mjSOL_NEWTON
    option.cone, option.iterations, option.tolerance = mujoco.mjtCone.mjCONE_PYRAMIDAL, 50, 1e-8
    for key, value in options.items():
        setattr(option, key, value)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what is out of date in those files
        return spec.compile()


def random_tree(seed: int, joints: int, passive: bool, limited: bool = False) -> mujoco.MjModel:
    """Return a tree of hinges and slides, about four in three bodies, in all sizes and orientations; with `passive` most
    have springs and dampers, with `limited` all have limits. Trees of as many joints have as many bodies and levels, so that
    they share kernels.
    """
    rng = np.random.default_rng(seed)
    bodies = max(2, 3 * joints // 4)
    levels = max(2, bodies // 2)
    extra = rng.choice(bodies, size=joints - bodies, replace=False)
    parents = [k - 1 if k < levels else int(rng.integers(0, levels - 1)) for k in range(bodies)]
    spec = mujoco.MjSpec.from_string(f"<mujoco><compiler angle='radian'/>{OPTION}</mujoco>")
    made: list[Any] = []
    for k, parent in enumerate(parents):
        body = (made[parent] if parent >= 0 else spec.worldbody).add_body(
            pos=rng.uniform(-0.3, 0.3, 3), quat=rng.normal(size=4)
        )
        made.append(body)
        size = rng.uniform(0.03, 0.15, 3)
        box = mujoco.mjtGeom.mjGEOM_BOX
        body.add_geom(type=box, size=size, pos=rng.uniform(-0.1, 0.1, 3), quat=rng.normal(size=4), contype=0, conaffinity=0)
        for n in range(1 + (k in extra)):
            kind = mujoco.mjtJoint.mjJNT_SLIDE if rng.random() < 0.3 else mujoco.mjtJoint.mjJNT_HINGE
            joint = body.add_joint(
                name=f"{k} {n}", type=kind, axis=rng.normal(size=3), pos=rng.uniform(-0.1, 0.1, 3), ref=rng.uniform(-1.0, 1.0)
            )
            joint.armature = rng.uniform(0.02, 0.1)  # so that springs are not too stiff for the time step
            if passive and rng.random() < 0.8:
                joint.damping[0], joint.stiffness[0] = rng.uniform(0.0, 2.0), rng.uniform(0.0, 20.0)
                joint.springref = rng.normal()
            joint.limited, joint.range = limited, joint.ref + np.array([-rng.random(), rng.random()])
            if rng.random() < 0.7:
                motor = spec.add_actuator(target=f"{k} {n}", trntype=mujoco.mjtTrn.mjTRN_JOINT)
                motor.gear[0], motor.gainprm[0] = rng.normal(), rng.uniform(0.5, 2.0)
                motor.forcelimited, motor.forcerange = rng.random() < 0.5, np.sort(rng.normal(size=2))
    return spec.compile()


EVERY_ROW = """
<mujoco>
  <option timestep="0.004" cone="pyramidal" impratio="5" iterations="50" ls_iterations="50" gravity="1 0 -9"/>
  <default><geom contype="0" conaffinity="1"/></default>
  <worldbody>
    <geom type="plane" size="5 5 .1" contype="1" conaffinity="0"/>
    <body pos="0 0 .099">
      <freejoint/><geom type="box" size=".1 .1 .1" mass="3" friction=".7"/>
      <body pos=".1 0 .1">
        <joint type="hinge" axis="0 1 0" frictionloss="0.8" damping=".1"/>
        <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass=".4"/>
        <body pos=".3 0 0">
          <joint type="hinge" axis="0 0 1" limited="true" range="-0.2 0.2"/>
          <geom type="capsule" fromto="0 0 0 .2 0 0" size=".02" mass=".2"/>
        </body>
      </body>
    </body>
    <body pos="1 0 1"><joint name="left" type="slide" axis="0 0 1"/><geom size=".05" mass="1"/></body>
    <body pos="1.5 0 1"><joint name="right" type="slide" axis="0 0 1"/><geom size=".05" mass="2"/></body>
  </worldbody>
  <equality><joint joint1="left" joint2="right" polycoef="0 -1 0 0 0"/></equality>
</mujoco>
"""
"""Rows of every kind: a box that slides, with an arm that rubs, is damped and has a limit, and two masses that are tied."""


class FusedWorlds:
    """Worlds in mujoco-warp's arrays that the fused step moves."""

    def __init__(
        self,
        model: mujoco.MjModel,
        count: int,
        drawn: Mapping[str, np.ndarray] | None = None,
        contacts: int = 64,
        rows: int = 128,
        device: str = "cpu",
        known: bool = True,
    ) -> None:
        """Build `count` worlds, which differ in the arrays `drawn` of the model, of one row a world; if rows are `known`
        again, the solver begins with where they were in the step before.
        """
        drawn = drawn or {}
        self.model, self.device = model, device
        ask_for_dense_rows(model)
        with wp.ScopedDevice(device):
            self.m = mjw.put_model(model, batch_sizes={name: count for name in drawn})
            for name, values in drawn.items():
                getattr(self.m, name).assign(np.float32(values))
            self.d = mjw.make_data(model, nworld=count, nconmax=contacts, njmax=rows)
            self.m.opt.run_qacc_smooth = False
            self.m.opt.tolerance.fill_(1e-9)  # mujoco-warp's least, 1e-6, would leave light joints beside heavy ones alone
            assert ConstraintSolver.why_not(self.m, self.d) == ""
            assert SmoothDynamics.why_not(model, drawn) == ""
            self.m.opt.disableflags |= absent_stages(model, drawn)
            own = not ContactStage.why_not(model, self.m, self.d, drawn)
            self._contacts = ContactStage(model, self.m, self.d, drawn) if own else None
            self.active_set = None if self._contacts is None or not known else self._contacts.active_set
            self._step = TorqueStep(model, self.m, self.d, drawn, self.active_set)

    def write(self, qpos: np.ndarray, qvel: np.ndarray, ctrl: np.ndarray) -> None:
        """Put the worlds into states, one row a world, with their controls."""
        for name, values in (("qpos", qpos), ("qvel", qvel), ("ctrl", ctrl)):
            getattr(self.d, name).assign(np.float32(values))

    def step(self, constrained: bool = True) -> None:
        """Make a step; without rows of constraints for a model that has none, since to make them takes many kernels."""
        with wp.ScopedDevice(self.device):
            self._step.begin()
            if constrained and self._contacts is not None:
                self._contacts.launch()
            elif constrained:
                mjw.collision(self.m, self.d)
                mjw.make_constraint(self.m, self.d)
            self._step.finish()

    def read(self, name: str) -> np.ndarray:
        """Return a copy of an array of the data, one row a world."""
        return getattr(self.d, name).numpy().copy()

    def mass_matrices(self) -> np.ndarray:
        """Return (worlds, nv, nv), made of mujoco-warp's sparse rows."""
        nv, sparse = self.model.nv, self.read("M")
        full = np.zeros((len(sparse), nv, nv))
        rows, starts, columns = (getattr(self.m, name).numpy() for name in ("M_rownnz", "M_rowadr", "M_colind"))
        for i in range(nv):
            for k in range(starts[i], starts[i] + rows[i]):
                full[:, i, columns[k]] = full[:, columns[k], i] = sparse[:, k]
        return full


def random_motion(model: mujoco.MjModel, count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return positions, velocities and controls of worlds in any pose, in numbers of float32; free bodies stay where they are
    in the model.
    """
    rng = np.random.default_rng(seed)
    qpos = np.tile(model.qpos0, (count, 1))
    for kind, at in zip(model.jnt_type, model.jnt_qposadr, strict=True):
        if kind in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL):
            at += 3 * (kind == mujoco.mjtJoint.mjJNT_FREE)
            quat = rng.normal(size=(count, 4))
            qpos[:, at : at + 4] = quat / np.linalg.norm(quat, axis=1, keepdims=True)
        else:
            qpos[:, at] += rng.normal(size=count) * (0.3 if kind == mujoco.mjtJoint.mjJNT_SLIDE else 1.0)
    qvel, ctrl = rng.normal(size=(count, model.nv)), 2.0 * rng.normal(size=(count, model.nu))
    return tuple(np.float64(np.float32(values)) for values in (qpos, qvel, ctrl))


def c_worlds(model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray, ctrl: np.ndarray) -> list[mujoco.MjData]:
    """Return the same worlds in C MuJoCo, not yet stepped."""
    datas = []
    for row in zip(qpos, qvel, ctrl, strict=True):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.ctrl[:] = row
        datas.append(data)
    return datas


def relative_error(found: np.ndarray, true: np.ndarray) -> float:
    """Return the largest difference, in units of the largest number where that is above 1."""
    return float(np.abs(found - true).max() / max(1.0, np.abs(true).max()))
