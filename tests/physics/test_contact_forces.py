"""Contact forces on shapes: those of slots, summed by shape, are those that mujoco-warp finds contact by contact."""

import pytest
import torch
import warp as wp
from reference import heaps, roll

from legged.physics.warp.state_io import MujocoWarpStateIO


@pytest.mark.slow
@pytest.mark.parametrize(
    "sim",
    [{}, {"cone": "elliptic"}, {"self_collisions": True}, {"njmax": 10}],
    ids=["pyramids", "cones", "shapes", "no room"],
)
def test_sums_by_shape_are_mujoco_warps_forces(robot, make_physics, sim):
    """Of robots in a heap, with feet, legs and trunks on the ground; also with rows that found no room, within a contact."""
    physics = make_physics("mujoco_warp", step="fused", **sim)
    states = heaps(robot, 6, seed=4)
    states.write(physics)
    roll(physics, states.dof_pos, 80)  # they land
    forces, found = physics.robot_state.contact_forces, []
    assert physics._state_io._slots == 24
    state = (physics._m, physics._d, physics.overflowed, physics.model, robot, physics.robot_state)
    with wp.ScopedDevice("cpu"):
        contact_by_contact = MujocoWarpStateIO(*state)
    for _ in range(5):
        roll(physics, states.dof_pos, 4)
        found.append(forces.clone())
        forces.fill_(7.0)
        with wp.ScopedDevice("cpu"):
            contact_by_contact.contact_forces()
        torch.testing.assert_close(found[-1], forces, atol=1e-3, rtol=1e-5)
    assert (torch.stack(found).norm(dim=3) > 50.0).sum() > 30
    if "njmax" in sim:
        assert (physics._d.nefc.numpy() > physics._d.njmax).any()
