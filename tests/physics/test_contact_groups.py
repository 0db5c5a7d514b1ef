"""Forces between groups of shapes: in each physics step, the largest of C MuJoCo's mj_contactForce over their contacts."""

import mujoco
import numpy as np
import pytest
import torch
from reference import heaps, pd, standing

from legged.config.world import SimConfig
from legged.errors import ConfigError
from legged.physics import GROUND, ContactGroups, RobotScene, make_physics

N, K = 6, 3
GROUPS = {
    "self": (("base", "THIGH", "SHANK", "FOOT"),) * 2,
    "left": (["LF_"], ["LH_THIGH", "RF_"]),
    "feet": (["FOOT"], [GROUND]),
    "rear": ([GROUND, "RH_"], ["RH_", "LH_", "LF_"]),
}


def scene_of(robot, self_collisions: bool = True, names=tuple(GROUPS)) -> RobotScene:
    groups = {name: ContactGroups.of(robot, GROUPS[name], K, self_collisions, "here") for name in names}
    return RobotScene(robot, contact_groups=groups)


def engine(robot, name: str, **sim):
    asked = SimConfig(physics=name, self_collisions=True, nconmax=48, njmax=192, threads=1, **sim)
    return make_physics(scene_of(robot), asked, N, torch.device("cpu"))


def stepped(model: mujoco.MjModel, qpos, qvel, ctrl) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = (values.double().numpy() for values in (qpos, qvel, ctrl))
    mujoco.mj_step(model, data)
    return data


def in_group(name: str, patterns) -> bool:
    return any(pattern == name or (name != GROUND and pattern in name) for pattern in patterns)


def largest(model: mujoco.MjModel, data: mujoco.MjData, first, second) -> float:
    forces, found = [0.0], np.zeros(6)
    for k, contact in enumerate(data.contact):
        a, b = (model.geom(g).name if model.geom_bodyid[g] else GROUND for g in (contact.geom1, contact.geom2))
        if (in_group(a, first) and in_group(b, second)) or (in_group(b, first) and in_group(a, second)):
            mujoco.mj_contactForce(model, data, k, found)
            forces.append(float(np.linalg.norm(found[:3])))
    return max(forces)


@pytest.mark.parametrize(
    ("name", "sim"),
    [
        ("mujoco", {}),
        ("mujoco", {"cone": "elliptic"}),
        ("mujoco_warp", {"step": "fused"}),
        ("mujoco_warp", {"cone": "elliptic"}),
        pytest.param("mujoco_warp", {"step": "library"}, marks=pytest.mark.slow),
        pytest.param("newton", {}, marks=pytest.mark.slow),
    ],
    ids=lambda value: value if isinstance(value, str) else next(iter(value.values()), "default"),
)
def test_forces_are_mujocos_in_each_step(robot, name, sim):
    """Robots in a heap, whose limbs are in each other and on the ground. Each step starts from the engine's own state."""
    physics, model = engine(robot, name, **sim), RobotScene(robot).model(SimConfig(self_collisions=True, **sim))
    states = heaps(robot, N, seed=4)
    states.write(physics)
    history = {group: torch.zeros(N, K) for group in GROUPS}
    seen = dict.fromkeys(GROUPS, 0)
    rtol = 0.1 if name == "newton" or sim.get("step") == "library" else 1e-3  # mujoco-warp's solver stops early at one impact
    for step in range(70):
        physics.ctrl.copy_(pd(physics.robot_state.dof_pos, physics.robot_state.dof_vel, states.dof_pos))
        before = physics.qpos.clone(), physics.qvel.clone(), physics.ctrl.clone()
        physics.step()
        if step < 55:  # they fall
            continue
        worlds = [stepped(model, *(values[i] for values in before)) for i in range(N)]
        for group, pair in GROUPS.items():
            now = torch.tensor([largest(model, data, *pair) for data in worlds])
            history[group] = torch.cat([now.unsqueeze(1), history[group][:, :-1]], dim=1)
            seen[group] += int((now > 10.0).sum())
            if step >= 57:
                found = physics.group_forces[group]
                torch.testing.assert_close(found, history[group], rtol=rtol, atol=1.0, msg=lambda m, g=group: f"{g}: {m}")
    assert all(count > 2 for count in seen.values()), seen


@pytest.mark.parametrize("name", ["mujoco", "mujoco_warp"])
def test_a_written_state_has_no_forces_and_a_saved_one_has_them(robot, name):
    physics = engine(robot, name)
    states = standing(robot, N)
    states.write(physics)
    for _ in range(30):
        physics.ctrl.copy_(pd(physics.robot_state.dof_pos, physics.robot_state.dof_vel, states.dof_pos))
        physics.step()
    feet = physics.group_forces["feet"]
    assert (feet > 50.0).all()
    saved = {key: tensor.clone() for key, tensor in physics.state_tensors().items()}
    mask = torch.tensor([True, False] * (N // 2))
    states.write(physics, mask)
    assert (feet[mask] == 0.0).all()
    assert torch.equal(feet[~mask], saved["forces_feet"][~mask])
    physics.load_state(saved)
    assert torch.equal(feet, saved["forces_feet"])


@pytest.mark.parametrize("name", ["mujoco", "mujoco_warp"])
def test_measuring_changes_no_motion(robot, name):
    sim, motions = SimConfig(physics=name, self_collisions=True, nconmax=48, njmax=192, threads=1), []
    for scene in (scene_of(robot), RobotScene(robot)):
        physics = make_physics(scene, sim, N, torch.device("cpu"))
        states = heaps(robot, N, seed=4)
        states.write(physics)
        for _ in range(60):
            physics.ctrl.copy_(pd(physics.robot_state.dof_pos, physics.robot_state.dof_vel, states.dof_pos))
            physics.step()
        physics.refresh()
        motions.append((physics.qpos.clone(), physics.qvel.clone(), physics.robot_state.contact_forces.clone()))
    assert all(torch.equal(*pair) for pair in zip(*motions, strict=True))


def test_one_sensor_of_mujoco_is_enough_for_the_whole_robot(robot):
    model = scene_of(robot, names=("self", "feet")).model(SimConfig(self_collisions=True), contact_sensors=True)
    names = [model.sensor(k).name for k in range(model.nsensor)]
    assert [name for name in names if name.endswith(":self")] == ["contact_of:0:0:self"]
    assert len([name for name in names if name.endswith(":feet")]) == 4


def test_wrong_groups_are_refused(robot):
    def of(first, second, self_collisions=True):
        return ContactGroups.of(robot, (first, second), K, self_collisions, "Mine.contact_groups: a")

    with pytest.raises(ConfigError, match=r"^Mine\.contact_groups: a: pattern 'THIHG' matches nothing.*LF_THIGH"):
        of(["THIHG"], [GROUND])
    with pytest.raises(ConfigError, match=r"^Mine\.contact_groups: a: a group is empty; it needs .* 'ground'"):
        of(["FOOT"], [])
    with pytest.raises(ConfigError, match=r"^Mine\.contact_groups: a: contacts .* need sim\.self_collisions=true, got false"):
        of(["THIGH"], ["SHANK"], self_collisions=False)
    assert of(["FOOT"], [GROUND], self_collisions=False).second == (GROUND,)
