"""policy.json says enough: a controller that knows nothing else does what the task's policy does."""

import json

import numpy as np
import onnxruntime
import pytest
import torch
from helpers import CALM, ENGINE, call, small_config, small_task, tiny_run

from legged import unit
from legged.cli.export import export as export_tool
from legged.config.mdp import ObservationGroupConfig
from legged.envs import LeggedRobot
from legged.learning.runner import Runner
from legged.physics import FIELDS
from legged.policies.description import describe
from legged.policies.export import export
from legged.registry import make_task, task_config

SMALL_TERRAIN = [
    ("terrain.num_rows", 3),
    ("terrain.num_cols", 10),
    ("terrain.border_size", 4.0),
    ("terrain.max_init_terrain_level", 2),
]
SMALL_NETWORKS = [("train.policy.actor_hidden_dims", [16]), ("train.policy.critic_hidden_dims", [8])]


class Controller:
    """What a robot runs: it reads policy.json and policy.onnx, and for each step the state of the robot."""

    def __init__(self, folder):
        self.facts = json.loads((folder / "policy.json").read_text())
        self.session = onnxruntime.InferenceSession(str(folder / "policy.onnx"), providers=["CPUExecutionProvider"])
        self.start()

    def start(self):
        """Of an episode."""
        self.actions = np.zeros(len(self.facts["joint_names"]))
        self.past = []

    def act(self, state, ground):
        """Actions for one robot; `state` in the world frame, `ground(x, y)` the height of the ground there."""
        facts = self.facts
        w, x, y, z = state["quaternion"]
        to_world = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        yaw = np.arctan2(to_world[1, 0], to_world[0, 0])
        parts = []
        for term in facts["observation"]:
            assert term["start"] == sum(map(len, parts))
            parts.append(term["scale"] * self.value(term, state, to_world, yaw, ground))
            assert len(parts[-1]) == term["size"]
        limit = facts["observation_clip"]
        now = np.clip(np.concatenate(parts), -limit, limit)
        self.past = [*(self.past or [now] * facts["observation_history"])[1:], now]
        observation = np.concatenate(self.past).astype(np.float32)[None]
        (actions,) = self.session.run(None, {"obs": observation})
        self.actions = np.clip(actions[0], -facts["action_clip"], facts["action_clip"])
        return observation[0], actions[0]

    def value(self, term, state, to_world, yaw, ground):
        """A term by its name, as its formula says."""
        match term["name"]:
            case "base_lin_vel":
                return to_world.T @ state["linear_velocity"]
            case "base_ang_vel":
                return to_world.T @ state["angular_velocity"]
            case "projected_gravity":
                return to_world.T @ np.array([0.0, 0.0, -1.0])
            case "commands":
                return np.array(state["command"])
            case "dof_pos":
                return state["angles"] - np.array(self.facts["default_joint_angles"])
            case "dof_vel":
                return state["joint_velocities"]
            case "actions":
                return self.actions
            case "heights":
                turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
                points = state["position"][:2] + np.array(term["points"]) @ turn.T
                below = state["position"][2] - term["offset"] - np.array([ground(*point) for point in points])
                return np.clip(below, -term["limit"], term["deepest"])
        raise AssertionError(term["name"])

    def torques(self, state):
        """By the law that is described for control_type P."""
        facts = {name: np.array(value) for name, value in self.facts.items() if name != "conventions"}
        wanted = facts["action_scale"] * self.actions + facts["default_joint_angles"]
        torques = facts["stiffness"] * (wanted - state["angles"]) - facts["damping"] * state["joint_velocities"]
        return np.clip(torques, -facts["torque_limits"], facts["torque_limits"])


def raw_state(task: LeggedRobot, robot: int) -> dict:
    """From the engine's own numbers: MuJoCo's free joint has its linear velocity in the world, its angular in the base."""
    qpos, qvel = (tensor[robot].double().numpy() for tensor in (task.physics._qpos, task.physics._qvel))
    w, *axis = qpos[3:7]
    turning = qvel[3:6]
    return {
        "position": qpos[:3],
        "quaternion": qpos[3:7],
        "linear_velocity": qvel[:3],
        "angular_velocity": turning + 2.0 * np.cross(axis, np.cross(axis, turning) + w * turning),
        "angles": qpos[7:],
        "joint_velocities": qvel[6:],
        "command": task.commands[robot, :3].double().numpy(),
    }


@pytest.mark.slow
@pytest.mark.parametrize("name", ["anymal_c", "anymal_c_proprio", "anymal_c_flat"])
def test_a_controller_that_reads_only_the_exported_files_does_the_same(name, tmp_path):
    """Observations to 2e-5 in their scaled units and actions to 1e-5, over an episode's first steps."""
    terrain = [] if name == "anymal_c_flat" else SMALL_TERRAIN
    changes = [("env.num_envs", 3), ("init_state.yaw", [-3.0, 3.0]), *ENGINE, *CALM, *SMALL_NETWORKS, *terrain]
    task = make_task(task_config(name, changes, on_cpu=True))
    torch.manual_seed(3)
    runner = Runner(task)
    policy = runner.alg.get_policy()
    with torch.no_grad():
        for parameter in policy.mlp[-1].parameters():
            parameter.mul_(3.0)  # actions of a size that matters
    export(task, policy, tmp_path)
    act = runner.get_inference_policy("cpu")

    def ground(x: float, y: float) -> float:
        if task.terrain is None:
            return 0.0
        heights = task.terrain.height_map
        row, column = np.floor((np.array([x, y]) - heights.origin) / heights.cell).astype(int)
        return float(scanned[row, column])

    scanned = None if task.terrain is None else task.terrain.height_map.scan_map("own")
    task.reset()
    observations = task.hold_commands(torch.tensor([[0.5, 0.2, -0.3], [-0.4, 0.0, 0.8], [0.0, 0.0, 0.0]]))
    controllers = [Controller(tmp_path) for _ in range(3)]
    for _ in range(8):
        with torch.inference_mode():
            actions = act(observations)
        for robot, controller in enumerate(controllers):
            seen, done = controller.act(raw_state(task, robot), ground)
            np.testing.assert_allclose(seen, observations["actor"][robot], rtol=0.0, atol=2e-5)
            np.testing.assert_allclose(done, actions[robot], rtol=0.0, atol=1e-5)
        observations, _, dones, _ = task.step(actions)
        assert not dones.any()
    task.control.set_actions(task.actions)
    computed = task.control.compute(task.dof_pos, task.dof_vel)
    for robot, controller in enumerate(controllers):
        np.testing.assert_allclose(controller.torques(raw_state(task, robot)), computed[robot], rtol=0.0, atol=1e-3)


@pytest.mark.slow
@pytest.mark.usefixtures("workplace")
@pytest.mark.parametrize(("add", "half"), [("true", 0.25), ("false", 0.0)])
def test_noise_is_that_of_the_training_and_not_of_the_task_that_is_exported_from(add, half):
    """Tools turn noise off, whatever the training had, and somebody may ask them for another level of it."""
    folder = tiny_run("observations.noise.dof_vel=0.5", "observations.noise_level=0.5", f"observations.add_noise={add}")
    arguments = [str(folder), "observations.noise_level=8"]
    assert call(export_tool.main, arguments) == 0
    terms = json.loads((folder / "exported" / "00002" / "policy.json").read_text())["observation"]
    assert {term["name"]: term["noise"] for term in terms}["dof_vel"] == half


@pytest.mark.slow
def test_every_shipped_term_has_a_formula_and_a_unit():
    """Of a robot that has something to say for each of them."""
    measured = sorted(LeggedRobot.terms("_obs_") - {"push_force"} - {f"rand_{name}" for name in FIELDS})  # not privileged
    every = [("robot", "cassie"), ("control.held", ["foot"]), ("observations.groups.actor.terms", measured)]
    task = make_task(task_config("anymal_c", [("env.num_envs", 1), *ENGINE, *SMALL_TERRAIN, *every], on_cpu=True))
    terms = {term["name"]: term for term in describe(task)["observation"]}
    assert set(terms) == set(measured)
    units = {name: term["unit"] for name, term in terms.items()}
    assert units == {
        "base_lin_vel": "m/s",
        "base_ang_vel": "rad/s",
        "projected_gravity": "1",
        "commands": "m/s, m/s, rad/s",
        "base_commands": "m, rad",
        "held_targets": "rad",
        "dof_pos": "rad",
        "dof_vel": "rad/s",
        "actions": "1",
        "heights": "m",
        "passive_pos": "rad",
        "passive_vel": "rad/s",
    }
    frames = {name: term["frame"] for name, term in terms.items()}
    assert frames == {
        **dict.fromkeys(("base_lin_vel", "base_ang_vel", "projected_gravity", "commands"), "base frame"),
        **dict.fromkeys(("dof_pos", "dof_vel", "actions", "passive_pos", "passive_vel"), None),
        **dict.fromkeys(("base_commands", "held_targets"), None),
        "heights": "yaw frame",
    }
    assert all(term["formula"].endswith(f"[{term['unit']}].") for term in terms.values())
    assert len(terms["held_targets"]["joints"]) == terms["held_targets"]["size"] == 2
    assert terms["passive_pos"]["joints"][:2] == ["left_shin", "left_tarsus"]
    assert terms["passive_pos"]["default"][:2] == pytest.approx([0.0, 1.4214], abs=1e-3)
    heights = terms["heights"]
    larger = 1.008025 / 0.548820  # than ANYmal C, for which the task is written
    assert (heights["offset"], heights["limit"]) == pytest.approx((0.5 * larger, 0.35 * larger), rel=1e-4)
    assert heights["deepest"] == heights["limit"]
    assert len(heights["points"]) == 187
    assert heights["points"][1] == pytest.approx([-0.8 * larger, -0.4 * larger], rel=1e-4)
    assert "(0, 0, -1) when the base is level" in terms["projected_gravity"]["formula"]


@pytest.mark.slow
def test_the_law_and_the_time_are_those_of_the_task():
    told = describe(small_task(("control.control_type", "V")))
    assert told["conventions"]["torque"].startswith("clip(stiffness * (action_scale * action - dq) - damping * ddq")
    assert told["sim_dt"] == pytest.approx(0.005)
    assert told["control_dt"] == pytest.approx(0.02)
    assert told["command_ranges"]["vx"] == pytest.approx(list(small_config().commands.ranges.lin_vel_x))
    assert told["recurrent"] is None


@pytest.mark.slow
def test_gains_are_a_number_for_each_joint_whatever_is_drawn_for_them():
    drawn = {"p_gain": [0.9, 0.9], "d_gain": [1.1, 1.1], "torque_limit": [0.8, 0.8], "joint_offset": [0.01, 0.01]}
    told, usual = describe(small_task(("domain_rand.ranges", drawn), num_envs=2)), describe(small_task())
    for name, value in (("stiffness", 90.0), ("damping", 4.0), ("torque_limits", 80.0)):
        assert told[name] == usual[name] == [value] * 12
    assert told["default_joint_angles"] == usual["default_joint_angles"]


@pytest.mark.slow
def test_a_user_defined_term_is_described_by_its_docstring_and_its_unit():
    class Mine(LeggedRobot):
        MIRRORED = {**LeggedRobot.MIRRORED, "feet": "feet", "bare": "same"}

        @unit("1")
        def _obs_feet(self):
            """Which feet are on the ground,
            in the world frame [m].

            Not part of the formula [m].
            """
            return self.contacts.in_contact.float()

        def _obs_bare(self):  # without docstring and unit
            return self.base_pos[:, 2:]

    cfg = small_config()
    cfg.observations.groups["actor"] = ObservationGroupConfig(("feet", "bare"))
    feet, bare = describe(Mine(cfg))["observation"]
    assert feet["formula"] == "Which feet are on the ground, in the world frame [m]."
    assert (feet["unit"], feet["frame"], feet["size"]) == ("1", "world frame", 4)
    assert (bare["unit"], bare["frame"], bare["formula"]) == (None, None, None)
