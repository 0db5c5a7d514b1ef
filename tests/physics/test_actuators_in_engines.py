"""Motors that are not ideal are the same in every engine: what stands between a target and `ctrl` knows no engine."""

import functools

import pytest
import torch

from legged.registry import make_task, task_config

pytestmark = pytest.mark.slow

MOTORS = [
    ("control.actuator.model", "dc_motor"),
    ("control.actuator.no_load_speed", {"HAA": 8.0, "HFE": 8.0, "KFE": 9.0}),
    ("control.actuator.armature", {"KFE": 0.05}),
    ("control.actuator.coulomb_friction", {"KFE": 1.0}),
    ("control.actuator.viscous_friction", {"K": 0.1}),
    ("control.actuator.delay", [3, 3]),
]
ERRORS = [
    ("observations.noise_level", 0.0),
    ("observations.delay", {"dof_pos": [1, 1], "projected_gravity": [2, 2]}),
    ("observations.dropped", {"base_ang_vel": 0.2}),
]


@functools.cache
def found(engine: str, step: str = "auto") -> torch.Tensor:
    """Torques after the first control steps in the air, and the joint angles that the actor was shown, (8, 12)."""
    small = [("env.num_envs", 2), ("sim.physics", engine), ("sim.step", step), ("domain_rand.randomize_friction", False)]
    task = make_task(task_config("anymal_c_flat", [*small, *MOTORS, *ERRORS], on_cpu=True), "cpu")
    qpos, qvel = task.physics.qpos.clone(), torch.zeros_like(task.physics.qvel)
    qpos[:, :7] = torch.tensor([0.0, 0.0, 1.5, 1.0, 0.0, 0.0, 0.0])
    qpos[:, 7:] = task.default_dof_pos
    task.reset()
    task.physics.write(torch.ones(2, dtype=torch.bool), qpos, qvel)
    task.sense()
    torques, angles = [], []
    for k in range(4):
        obs, *_ = task.step(torch.full((2, 12), 0.8 if k < 2 else -0.4))
        torques.append(task.torques[0].clone())
        angles.append(obs["actor"][0, 12:24].clone())
    return torch.stack([*torques, *angles])


@pytest.mark.parametrize(("engine", "step"), [("mujoco_warp", "fused"), ("mujoco_warp", "library"), ("newton", "auto")])
def test_torques_and_observations_are_those_of_the_c_engine(engine, step):
    wanted = found("mujoco")
    assert wanted[:4].abs().max() > 20.0
    torch.testing.assert_close(found(engine, step), wanted, rtol=2e-3, atol=2e-3)
