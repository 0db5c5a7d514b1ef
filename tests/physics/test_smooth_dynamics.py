"""Poses, inertias and bias forces in one launch: those of C MuJoCo, for this robot and for crooked ones."""

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import warp as wp

from legged.config.schema import SimConfig
from legged.errors import ConfigError
from legged.physics.fused.smooth_dynamics import SmoothDynamics
from legged.physics.scene.robot_scene import build_model
from legged.physics.warp.compile import launched

CROOKED = """
<mujoco>
  <compiler angle="radian"/>
  <option gravity="0.4 -0.3 -9"/>
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
    <motor joint="shoulder"/><motor joint="twist"/><motor joint="wrist"/><motor joint="tail"/>
  </actuator>
</mujoco>
"""
"""A welded body, two hinges in one body, joints off their bodies' origins, a reference angle, gravity aslant."""


def shipped(robot) -> mujoco.MjModel:
    return build_model(robot, SimConfig())


def crooked(robot) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(CROOKED)


@pytest.mark.parametrize("build", [shipped, crooked])
def test_poses_inertias_and_forces_are_those_of_c_mujoco(robot, build):
    """In six worlds in any pose, moving fast, with quaternions of any length, and a base of another mass in each."""
    model, count, rng = build(robot), 6, np.random.default_rng(0)
    base, hinges = model.body("base").id, model.nv - 6
    limit = 20.0
    qpos = np.tile(model.qpos0, (count, 1)) + rng.normal(size=(count, model.nq))
    qpos[:, 3:7] = rng.normal(size=(count, 4))
    qvel, torques = 3.0 * rng.normal(size=(count, model.nv)), 20.0 * rng.normal(size=(count, hinges))
    mass = model.body_mass[base] * np.linspace(0.5, 1.5, count)
    with wp.ScopedDevice("cpu"):
        m = mjw.put_model(model, batch_sizes={"body_mass": count})
        d = mjw.make_data(model, nworld=count, nconmax=24, njmax=96)
        masses = m.body_mass.numpy()
        masses[:, base] = mass
        m.body_mass.assign(masses)
        for array, values in ((d.qpos, qpos), (d.qvel, qvel), (d.ctrl, torques)):
            array.assign(np.float32(values))
        SmoothDynamics(model, m, d, base, np.array([[-limit] * hinges, [limit] * hinges])).launch()
        found = {
            name: getattr(d, name).numpy() for name in ("geom_xpos", "geom_xmat", "subtree_com", "cdof", "M", "qfrc_smooth")
        }
        rows, starts, columns = (getattr(m, name).numpy() for name in ("M_rownnz", "M_rowadr", "M_colind"))
    for i in range(count):
        model.body_mass[base] = mass[i]
        mujoco.mj_setConst(model, data := mujoco.MjData(model))
        data.qpos[:], data.qvel[:] = qpos[i], qvel[i]
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(found["geom_xpos"][i], data.geom_xpos, atol=2e-6)
        np.testing.assert_allclose(found["geom_xmat"][i].reshape(-1, 9), data.geom_xmat, atol=2e-6)
        np.testing.assert_allclose(found["subtree_com"][i, base], data.subtree_com[base], atol=2e-6)
        np.testing.assert_allclose(found["cdof"][i], data.cdof, atol=5e-6)
        full = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full)
        for r in range(model.nv):
            entries = slice(starts[r], starts[r] + rows[r])
            np.testing.assert_allclose(found["M"][i, entries], full[r, columns[entries]], atol=2e-5)
        forces = -data.qfrc_bias
        forces[6:] += np.clip(torques[i], -limit, limit)
        np.testing.assert_allclose(found["qfrc_smooth"][i], forces, rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize(("way", "one_launch"), [("auto", True), ("fused", True), ("stages", False)])
def test_a_shipped_robot_takes_one_launch_unless_asked_for_stages(make_physics, way, one_launch):
    sim = {} if way == "auto" else {"smooth_dynamics": way}
    physics = make_physics("mujoco_warp", **sim)
    modules = " ".join(build.module.name for build in launched(wp.get_device("cpu"), (physics._step,)))
    assert ("dynamics_kernel" in modules) == one_launch
    assert ("mujoco_warp._src.smooth" in modules) != one_launch


def test_what_it_does_not_compute_is_refused(make_physics):
    with pytest.raises(ConfigError, match=r"smooth_dynamics=fused: needs the fused sim\.constraint_solver"):
        make_physics("mujoco_warp", num_envs=1, smooth_dynamics="fused", constraint_solver="rounds")
    welded = CROOKED.replace("<actuator>", '<equality><weld body1="hand" body2="tail"/></equality><actuator>')
    assert "equality constraints" in SmoothDynamics.why_not(mujoco.MjModel.from_xml_string(welded))
    assert SmoothDynamics.why_not(mujoco.MjModel.from_xml_string(CROOKED)) == ""
