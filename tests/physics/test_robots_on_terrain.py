"""Whole robots on tiles of rough ground: our collider, mujoco-warp's general one and C MuJoCo carry them alike."""

import numpy as np
import pytest
import torch
from devices import ON_A_GPU, build, on_gpu
from reference import roll, standing, tiles

from legged.config.world import SimConfig
from legged.physics import RobotScene, make_physics


@pytest.mark.slow
@pytest.mark.parametrize("where", [pytest.param("", id="cpu"), on_gpu(ON_A_GPU, id="cuda")])
def test_robots_tumble_and_come_to_rest_alike_on_all_back_ends(robot, where):
    """Dropped off the platform onto stairs, a slope and rough ground, which throws two of them over: after 0.5 s, with
    the trunk and legs on risers and rims, positions agree within 2 mm on steps, and within 15 mm on the slope, where the C
    engine feels a height field from afar (not on the rough ground, where it has triangles). Once at rest, upright or
    fallen, forces sum to the weight.
    """
    ground = tiles(("stairs_up", 0.15), ("slope_down", 15.0), ("rough_slope_up", 10.0), ("obstacles", 0.15))
    engines = {
        name: build(RobotScene(robot, ground), name + (where if name != "mujoco" else ""), 4, threads=1, njmax=128)
        for name in ("mujoco", "mujoco_warp", "newton")
    }
    states = standing(robot, 4)
    for i, x in enumerate((1.75, 2.0, 1.9, 2.0)):
        place = ground.origins[0, i]
        reach = np.linspace(-0.4, 0.4, 9)
        near = ground.height_map.height_at(*np.meshgrid(place[0] + x + reach, place[1] + reach))
        states.base_pos[i] = torch.tensor([place[0] + x, place[1], near.max() + 0.55])
    places, tilted = {}, {}
    for name, physics in engines.items():
        states.write(physics)
        roll(physics, states.dof_pos, 100)
        places[name] = physics.robot_state.base_pos.clone().numpy()
        roll(physics, states.dof_pos, 900)
        tilted[name] = physics.robot_state.projected_gravity[:, 2] > -0.9
        assert (physics.robot_state.base_lin_vel.norm(dim=1) < 0.02).all()
        force = physics.robot_state.contact_forces[:, :, 2].sum(dim=1)
        np.testing.assert_allclose(force.numpy(), robot.mass * 9.81, rtol=0.01, err_msg=name)
        assert not physics.overflowed.any()
    for name in ("mujoco_warp", "newton"):
        np.testing.assert_allclose(places[name][[0, 3]], places["mujoco"][[0, 3]], atol=2e-3, err_msg=name)
        np.testing.assert_allclose(places[name][1], places["mujoco"][1], atol=0.015, err_msg=name)
    assert all(fallen.tolist() == [True, True, False, False] for fallen in tilted.values())


@pytest.mark.slow
def test_the_general_collider_carries_a_robot_too(robot):
    """sim.terrain_collider=convex, across the rim of a platform on a slope: as C MuJoCo, with a height field there too. That
    one lies deeper; its contacts lie half way between, so feet roll as if they were thicker: 1 cm further.
    """
    ground = tiles(("slope_up", 15.0))
    states = standing(robot, 1)
    place = ground.origins[0, 0] - [1.2, 0.0, 0.0]
    height = ground.height_map.height_at(place[:1], place[1:2])[0]
    states.base_pos[0] = torch.tensor([place[0], place[1], height + 0.65])
    found = []
    for name, collider in (("mujoco", "cells"), ("mujoco_warp", "convex")):
        sim = SimConfig(physics=name, threads=1, terrain_collider=collider, nconmax=64, njmax=256)
        physics = make_physics(RobotScene(robot, ground), sim, 1, torch.device("cpu"))
        states.write(physics)
        roll(physics, states.dof_pos, 200)
        found.append(physics.robot_state)
        assert not physics.overflowed.any()
    assert (found[0].contact_forces[0, :, 2] > 50.0).sum() == 4
    torch.testing.assert_close(found[1].base_pos, found[0].base_pos, atol=0.01, rtol=0.0)
    torch.testing.assert_close(found[1].base_quat, found[0].base_quat, atol=5e-3, rtol=0.0)


@pytest.mark.slow
def test_self_collisions_are_kept_if_asked(robot):
    """Knees turned inward until left and right thigh meet: they feel each other, on level ground far above it."""
    ground = tiles(("flat", 0.0))
    sim = SimConfig(physics="mujoco_warp", self_collisions=True)
    physics = make_physics(RobotScene(robot, ground), sim, 2, torch.device("cpu"))
    states = standing(robot, 2, height=3.0)
    inward = [i for i, name in enumerate(robot.joint_names) if "HAA" in name]
    signs = [-1.0 if robot.joint_names[i][0] == "L" else 1.0 for i in inward]
    states.dof_pos[1, inward] = 0.7 * torch.tensor(signs)
    states.write(physics)
    physics.step()
    physics.refresh()
    touching = physics.robot_state.contact_forces.norm(dim=2) > 0.0
    assert not touching[0].any()
    assert touching[1].any()
    np.testing.assert_allclose(physics.robot_state.contact_forces[1].sum(dim=0).numpy(), 0.0, atol=1e-2)
