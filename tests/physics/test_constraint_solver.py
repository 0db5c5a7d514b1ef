"""The one-launch constraint solver: what C MuJoCo finds, on every kind of row; worlds that end by themselves."""

import re

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import torch
import warp as wp
from devices import on_gpu
from helpers import call
from reference import heaps, random_states, roll

from legged.cli.train import train
from legged.errors import ConfigError
from legged.physics.fused.constraint_solver import ConstraintSolver

EVERY_ROW = """
<mujoco>
  <option timestep="0.004" cone="pyramidal" impratio="5" iterations="50" ls_iterations="50" tolerance="1e-8"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1"/>
    <body name="box" pos="0 0 .099">
      <freejoint/><geom type="box" size=".1 .1 .1" mass="3" friction=".7"/>
      <body name="arm" pos=".1 0 .1">
        <joint name="dry" type="hinge" axis="0 1 0" frictionloss="0.8"/>
        <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass=".4"/>
        <body name="hand" pos=".3 0 0">
          <joint name="limited" type="hinge" axis="0 0 1" limited="true" range="-0.2 0.2"/>
          <geom type="capsule" fromto="0 0 0 .2 0 0" size=".02" mass=".2"/>
        </body>
      </body>
    </body>
    <body name="left" pos="1 0 1"><joint name="left" type="slide" axis="0 0 1"/><geom size=".05" mass="1"/></body>
    <body name="right" pos="1.5 0 1"><joint name="right" type="slide" axis="0 0 1"/><geom size=".05" mass="2"/></body>
  </worldbody>
  <equality><joint joint1="left" joint2="right" polycoef="0 -1 0 0 0"/></equality>
</mujoco>
"""
"""Equality, dry friction, a joint limit and a contact: rows of every kind that a pyramidal cone has."""


def solved(model: mujoco.MjModel, datas: list[mujoco.MjData], device: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of worlds in the states of `datas`: acceleration, constraint force and rounds, by the one-launch solver."""
    with wp.ScopedDevice(device):
        m = mjw.put_model(model)
        m.opt.tolerance.fill_(1e-9)  # C MuJoCo's may be, and with elliptic cones is what ends the rounds
        d = mjw.make_data(model, nworld=len(datas), nconmax=16, njmax=64)
        d.qpos.assign(np.stack([data.qpos for data in datas]))
        d.qvel.assign(np.stack([data.qvel for data in datas]))
        d.qacc_warmstart.zero_()
        mjw.fwd_position(m, d, factorize=False)
        mjw.fwd_velocity(m, d)
        mjw.fwd_actuation(m, d)
        mjw.fwd_acceleration(m, d)
        ConstraintSolver(model, m, d).solve()
        return d.qacc.numpy(), d.qfrc_constraint.numpy(), d.solver_niter.numpy()


def states_of_every_row(model: mujoco.MjModel, count: int) -> list[mujoco.MjData]:
    rng = np.random.default_rng(0)
    datas = []
    for i in range(count):
        data = mujoco.MjData(model)
        data.qpos[2] += rng.uniform(-2e-3, 0.0) if i % 3 else 1.0  # every third is in the air
        data.qpos[7:] = rng.uniform(-0.3, 0.3, model.nq - 7)
        data.qvel[:] = rng.normal(0.0, 0.5, model.nv)
        mujoco.mj_forward(model, data)
        datas.append(data)
    return datas


TENDON = """
  <tendon>
    <fixed name="dry" frictionloss="0.5"><joint joint="dry" coef="1"/><joint joint="limited" coef="-.6"/></fixed>
  </tendon>
</mujoco>"""


@pytest.mark.slow
@pytest.mark.parametrize("tendon", [False, True])
@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_every_kind_of_row_pushes_as_in_c_mujoco(device, cone, tendon):
    text = EVERY_ROW.replace("</mujoco>", TENDON) if tendon else EVERY_ROW
    model = mujoco.MjModel.from_xml_string(text.replace('cone="pyramidal"', f'cone="{cone}"'))
    datas = states_of_every_row(model, 30)
    kinds = np.concatenate([data.efc_type for data in datas])
    t = mujoco.mjtConstraint
    expected = {int(t.mjCNSTR_EQUALITY), int(t.mjCNSTR_FRICTION_DOF), int(t.mjCNSTR_LIMIT_JOINT)}
    expected.add(int(t.mjCNSTR_CONTACT_ELLIPTIC if cone == "elliptic" else t.mjCNSTR_CONTACT_PYRAMIDAL))
    assert {int(k) for k in kinds} == expected | ({int(t.mjCNSTR_FRICTION_TENDON)} if tendon else set())
    # Dry friction is met on both sides and in between: sliding either way, and sticking.
    sides = np.concatenate([data.efc_state[data.efc_type == t.mjCNSTR_FRICTION_DOF] for data in datas])
    s = mujoco.mjtConstraintState
    assert {int(side) for side in sides} >= {int(s.mjCNSTRSTATE_LINEARNEG), int(s.mjCNSTRSTATE_LINEARPOS)}
    acceleration, force, rounds = solved(model, datas, device)
    for i, data in enumerate(datas):
        scale = max(1.0, np.abs(data.qfrc_constraint).max())
        np.testing.assert_allclose(force[i], data.qfrc_constraint, atol=2e-4 * scale, err_msg=str(i))
        scale = max(1.0, np.abs(data.qacc).max())
        np.testing.assert_allclose(acceleration[i], data.qacc, atol=1e-3 * scale, err_msg=str(i))
    assert 1 <= rounds.max() < 20


@pytest.mark.slow
def test_without_constraints_the_acceleration_is_that_of_a_free_body(device):
    model = mujoco.MjModel.from_xml_string(EVERY_ROW.replace('frictionloss="0.8"', "").split("<equality>")[0] + "</mujoco>")
    data = mujoco.MjData(model)
    data.qpos[2] = 2.0
    mujoco.mj_forward(model, data)
    assert data.nefc == 0
    acceleration, force, _ = solved(model, [data], device)
    np.testing.assert_allclose(acceleration[0], data.qacc, atol=1e-4)
    assert not force.any()


@pytest.mark.parametrize(
    ("start", "name"),
    [
        pytest.param(random_states, "mujoco_warp", id="random_states"),
        pytest.param(heaps, "mujoco_warp", id="heaps"),
        on_gpu(random_states, "mujoco_warp, cuda", id="random_states, cuda"),
        on_gpu(heaps, "mujoco_warp, cuda", id="heaps, cuda"),
    ],
)
def test_robots_are_pushed_as_by_mujoco_warps_own_solver(robot, make_physics, start, name):
    """Ten steps from the same states: the two solvers stop at their tolerance, on different sides of the minimum."""
    engines = [make_physics(name, **way) for way in ({"step": "library"}, {"tag": "stages"})]
    states = start(robot, 6, seed=4)
    for engine in engines:
        states.write(engine)
        roll(engine, states.dof_pos, 10)
        engine.refresh()
    for name in ("base_pos", "dof_pos", "base_quat"):
        first, second = (getattr(engine.robot_state, name) for engine in engines)
        torch.testing.assert_close(first, second, atol=2e-5, rtol=0.0, msg=name)


def test_a_world_that_is_no_number_ends_and_harms_no_neighbour(robot, make_physics):
    engine = make_physics("mujoco_warp")
    states = random_states(robot, 6, seed=5)
    states.write(engine)
    roll(engine, states.dof_pos, 4)
    engine.refresh()
    untouched = engine.robot_state.base_pos.clone()
    states.write(engine)
    states.base_lin_vel[2] = torch.nan
    states.write(engine)
    roll(engine, states.dof_pos, 4)
    engine.refresh()
    others = [i for i in range(6) if i != 2]
    assert torch.equal(engine.robot_state.base_pos[others], untouched[others])
    states.base_lin_vel[2] = 0.0
    states.write(engine)
    roll(engine, states.dof_pos, 4)
    assert engine.robot_state.base_pos.isfinite().all()


@pytest.mark.parametrize(
    ("sim", "reason"),
    [({"njmax": 1000}, "1000 constraint rows .* exceed 512")],
)
def test_what_it_does_not_know_is_refused(make_physics, sim, reason):
    with pytest.raises(ConfigError, match=f"sim.step=fused: .*{reason}"):
        make_physics("mujoco_warp", num_envs=1, step="fused", **sim)
    assert re.search(reason, make_physics("mujoco_warp", num_envs=1, **sim).why_library)


def test_what_a_robot_has_not_is_left_out_of_its_kernel(make_physics):
    solver = make_physics("mujoco_warp")._fused_step.solver
    assert {name: solver.constants[name] for name in ("DAMPED", "FRICTION", "ELLIPTIC", "SPLIT")} == {
        "DAMPED": False,
        "FRICTION": False,
        "ELLIPTIC": False,
        "SPLIT": True,
    }


def test_a_wrong_name_says_which_are_right(capsys):
    arguments = ["--task", "anymal_c_flat", "sim.step=fuse", "--show"]
    assert call(train.main, arguments) == 2
    text = capsys.readouterr().err
    assert "sim.step" in text
    assert "fused" in text
