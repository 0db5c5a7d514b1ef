"""policy.json of a task whose world is a model with actuators of its own."""

from typing import Any

import mujoco

from legged.envs import BaseTask

CONVENTIONS = {
    "units": "SI: m, s, rad, N, N m; positions and velocities in MuJoCo's generalised coordinates",
    "observation": "for each term clip(scale * value, -observation_clip, observation_clip), at its columns start to"
    " start + size, without noise",
    "history": "the last observation_history observations side by side, oldest first; at the start of an episode all are"
    " the first one",
    "action": "actions = policy(observation), then clipped at plus and minus action_clip, one for each actuator",
    "control": "control_middle + control_reach * action, for each actuator, in the unit that it takes",
    "time": "every control_dt: observe, run the policy, hold its controls for control_dt",
}


def describe_control(task: BaseTask) -> dict[str, Any]:
    """Return how actions move the model: conventions, actuators, their controls, and times."""
    model = task.physics.model
    limited = model.actuator_ctrllimited.astype(bool)
    low, high = model.actuator_ctrlrange.T
    return {
        "conventions": CONVENTIONS,
        "joint_names": [model.joint(i).name for i in range(model.njnt)],
        "actuator_names": [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, i) for i in range(model.nu)],
        "control_middle": [float(0.5 * (low[i] + high[i])) if limited[i] else 0.0 for i in range(model.nu)],
        "control_reach": [float(0.5 * (high[i] - low[i])) if limited[i] else 1.0 for i in range(model.nu)],
        "action_clip": task.cfg.control.clip_actions,
        "control_dt": task.dt,
        "sim_dt": task.cfg.sim.dt,
    }
