"""policy.json as a contract: what is in it, which ones are refused and how, and that a robot gets what the task would."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from helpers import CALM, ENGINE
from onnx import numpy_helper
from still_robot import BLIND, PROPRIOCEPTION, SMALL, exported, facts_for

from legged.deploy import contract as contracts
from legged.deploy.contract import CONTRACT_VERSION, need_of, read_contract
from legged.deploy.interface import Reading
from legged.deploy.policy import Policy
from legged.errors import ConfigError
from legged.learning.runner import Runner
from legged.policies.export import export
from legged.registry import make_task, task_config
from legged.robots.robot import load_robot

SMALL_TERRAIN = [
    ("terrain.num_rows", 3),
    ("terrain.num_cols", 10),
    ("terrain.border_size", 4.0),
    ("terrain.max_init_terrain_level", 2),
]


@pytest.fixture(scope="module")
def folder(policy_folder):
    return policy_folder


@pytest.fixture(scope="module")
def contract(folder):
    return read_contract(folder / "policy.json")


def changed(folder, tmp_path, **changes):
    """A copy of policy.json with other values under some keys; None takes a key away."""
    said = json.loads((folder / "policy.json").read_text())
    path = tmp_path / "policy.json"
    gone = [key for key, value in changes.items() if value is None]
    path.write_text(json.dumps({key: value for key, value in {**said, **changes}.items() if key not in gone}))
    return path


@pytest.mark.slow
def test_the_contract_says_what_a_robot_must_know(contract, folder):
    robot = load_robot("anymal_c")
    assert contract.joint_names == robot.joint_names
    np.testing.assert_allclose(contract.position_limits, robot.dof_pos_limits)
    np.testing.assert_allclose(contract.velocity_limits, robot.dof_vel_limits)
    assert (contract.imu_body, contract.control_dt, contract.width) == ("base", pytest.approx(0.02), 90)
    np.testing.assert_allclose(contract.command_ranges, [[-0.6, 1.1], [-0.4, 0.4], [-0.7, 0.7]], rtol=1e-6)
    assert contract.dead_zone == pytest.approx(0.1)
    assert [term.name for term in contract.terms] == PROPRIOCEPTION
    assert not contract.sources
    said = json.loads((folder / "policy.json").read_text())
    assert said["contract_version"] == CONTRACT_VERSION
    noise = {term["name"]: term["noise"] for term in said["observation"]}
    assert (noise["dof_vel"], noise["base_ang_vel"], noise["actions"]) == pytest.approx((1.5, 0.2, 0.0))
    assert need_of("dof_vel") == "joint velocities"
    assert need_of("heights") == "source heights"


def test_a_joint_without_limits_has_none_in_the_contract_too(folder, tmp_path):
    said = json.loads((folder / "policy.json").read_text())
    path = changed(folder, tmp_path, position_limits=[None, *said["position_limits"][1:]])
    assert np.isinf(read_contract(path).position_limits[0]).all()


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        (
            {"contract_version": None},
            r"contract_version: got none \(an older version .* export the policy again with `legged play",
        ),
        ({"contract_version": 2}, r"contract_version: got 2, but this program reads 1;"),
        ({"control_type": "T"}, r"control_type: got 'T'; a robot takes joint angles"),
        ({"control_type": None}, r"control_type: got None; a robot takes joint angles"),
        ({"command_ranges": None}, r"'anymal_c_flat' is no task of a legged robot"),
        ({"observation": None}, r"is no policy\.json of an export \(observation is missing\)"),
        ({"stiffness": [1.0]}, r"is no policy\.json of an export \(ValueError: stiffness: 12 numbers are wanted"),
        ({"damping": ["much"] * 12}, r"is no policy\.json of an export \(ValueError"),
        ({"imu_frame": None}, r"is no policy\.json of an export \(KeyError: 'imu_frame'\)"),
        ({"damping": [4.0] * 11 + [0.0]}, r"damping: must be above 0, because damping stops the robot, got 0"),
        ({"stiffness": [-1.0] + [90.0] * 11}, r"stiffness: must be 0 or more, got -1"),
        ({"sim_dt": -0.005}, r"sim_dt: must be above 0, and at most control_dt, got -0\.005"),
        ({"action_scale": float("nan")}, r"action_scale: must be finite, got nan"),
        ({"action_clip": float("inf")}, r"action_clip: must be above 0 and finite, got inf"),
        ({"torque_limits": [0.0] * 12}, r"torque_limits: must be above 0, got 0"),
        ({"position_limits": [[1.0, -1.0]] * 12}, r"position_limits: must be below the upper limits, got 1"),
        (
            {"command_ranges": {"vx": [1.0, -1.0], "vy": [0.0, 0.0], "yaw_rate": [0.0, 0.0]}},
            r"command_ranges: must be finite, and not above the upper limits, got 1",
        ),
        (
            {"base_commands": {"height": [0.5, 0.8, 0.7], "pitch": [0.0, 0.0, 0.0]}},
            r"base_commands: must be finite, and sorted: lowest, usual, highest, got 0\.8",
        ),
        (
            {"observation_groups": [{"name": "actor", "start": 0, "size": 45, "history": 0}]},
            r"observation_groups: each must have a history and a size of at least 1",
        ),
        ({"crouch_joint_angles": [50.0] * 12}, r"crouch_joint_angles: must be within position_limits, got 50 at 'LF_HAA'"),
        ({"control_dt": 5.0}, r"control_dt: must be between 0\.001 and 1, got 5"),
        ({"default_joint_angles": [2.0] * 12}, r"default_joint_angles: must be within position_limits, got 2 at 'LF_HAA'"),
        (
            {"observation_groups": [{"name": "actor", "start": 0, "size": 46, "history": 2}]},
            r"observation_groups: 'actor' has 46 numbers, but its terms have 45",
        ),
        (
            {"observation_groups": [{"name": "other", "start": 0, "size": 45, "history": 2}]},
            r"observation: the group 'actor' of 'base_ang_vel' does not exist",
        ),
    ],
)
def test_what_is_no_contract_is_refused_in_one_line(changes, says, folder, tmp_path):
    with pytest.raises(ConfigError, match=says):
        read_contract(changed(folder, tmp_path, **changes))


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"name": "my_gyro"}, "'my_gyro' cannot be made from 'gyro'"),
        ({"needs": "quaternion"}, "'base_ang_vel' cannot be made from 'quaternion'"),
        ({"size": 2, "scale": [1.0, 1.0]}, "'base_ang_vel' has 2 numbers, but a robot gives 3"),
        (
            {"name": "dof_pos", "needs": "joint positions", "joints": ["arm"] * 3},
            r"is no policy\.json .* 'arm' is not in list",
        ),
        (
            {"name": "dof_pos", "needs": "joint positions", "joints": ["LF_HAA"]},
            "'dof_pos' has 3 numbers, but a robot gives 1",
        ),
        ({"start": 3}, "'base_ang_vel' must start at column 0, got 3"),
    ],
)
def test_a_term_that_cannot_be_made_is_refused_before_the_robot_walks(changes, says, folder, tmp_path):
    said = json.loads((folder / "policy.json").read_text())
    path = changed(folder, tmp_path, observation=[{**said["observation"][0], **changes}, *said["observation"][1:]])
    with pytest.raises(ConfigError, match=says):
        read_contract(path)


@pytest.mark.parametrize("text", ["", "[]", "{}", "{", "[" * 100_000])
def test_a_file_that_is_none_is_refused(text, tmp_path):
    path = tmp_path / "policy.json"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"is no policy\.json of an export"):
        read_contract(path)


def other_order(names):
    return (names[1], names[0], *names[2:])


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"joint_names": lambda names: ("HIP", *names[1:])}, "joint_names: 'still' has no joint 'LF_HAA'"),
        (
            {"joint_names": lambda names: (*names, "TAIL")},
            "joint_names: 'still' has a joint 'TAIL' that the policy does not know",
        ),
        ({"joint_names": other_order}, "joint 0 is 'LF_HAA' for the policy and 'LF_HFE' for 'still'; their orders differ"),
        ({"torque_limits": lambda limits: limits * 0.9}, "trained with 80 N m at 'LF_HAA', but 'still' has 72"),
        ({"velocity_limits": lambda limits: limits - 1.0}, "trained with 20 rad/s at 'LF_HAA', but 'still' has 19"),
        ({"torque_limits": lambda limits: limits * np.nan}, "trained with 80 N m at 'LF_HAA', but 'still' has nan"),
        ({"position_limits": lambda limits: limits * 0.5}, "with -0.72 to 0.49 rad at 'LF_HAA', but 'still' has -0.36"),
        ({"imu_body": lambda _: "torso"}, "in the frame of 'base', but the IMU of 'still' measures in that of 'torso'"),
    ],
)
def test_a_robot_that_does_not_fit_is_refused_by_name(contract, changes, says):
    facts = facts_for(contract)
    own = {name: change(getattr(facts, name)) for name, change in changes.items()}
    with pytest.raises(ConfigError) as refused:
        contract.check_fits(replace(facts, **own))
    assert says in str(refused.value)


def test_a_stronger_robot_fits(contract):
    facts = facts_for(contract)
    contract.check_fits(replace(facts, torque_limits=2.0 * facts.torque_limits, velocity_limits=2.0 * facts.velocity_limits))


@pytest.mark.slow
def test_a_policy_that_needs_more_than_sensors_is_refused_by_the_name_of_the_observation(tmp_path):
    policy = Policy(exported(tmp_path, ("observations.groups.actor.terms", ["base_lin_vel", *PROPRIOCEPTION])))
    with pytest.raises(ConfigError, match=r"observation: no sensor measures 'base_lin_vel', and 'still' has no source"):
        policy.contract.check_fits(facts_for(policy.contract))
    policy.contract.check_fits(facts_for(policy.contract, offers=frozenset({"base_lin_vel", "heights"})))


def test_files_of_two_exports_are_refused(folder, tmp_path):
    (tmp_path / "policy.onnx").write_bytes((folder / "policy.onnx").read_bytes())
    for key, value in (("action_scale", 0.25), ("stiffness", [90.5] * 12), ("damping", [3.0] * 12), ("control_dt", 0.01)):
        changed(folder, tmp_path, **{key: value})
        with pytest.raises(
            ConfigError, match=rf"{key}: .*policy\.onnx has another value; the files are from different exports"
        ):
            Policy(tmp_path)


def test_folders_without_an_export_are_refused(folder, tmp_path):
    with pytest.raises(ConfigError, match=r"POLICY: there is no .*policy\.onnx"):
        Policy(tmp_path)
    (tmp_path / "policy.onnx").write_bytes((folder / "policy.onnx").read_bytes())
    with pytest.raises(ConfigError, match=r"POLICY: there is no .*policy\.json, no deploy\.yaml, and policy\.onnx has no"):
        Policy(tmp_path)
    (tmp_path / "policy.onnx").write_bytes(b"no network")
    changed(folder, tmp_path, sha256=None)
    with pytest.raises(ConfigError, match=r"policy\.onnx: onnxruntime cannot read it"):
        Policy(tmp_path)


@pytest.fixture
def export_of(folder, tmp_path):
    """export_of(change, **changes): a copy of the export whose ONNX model was changed, and entries of its policy.json too."""

    def write(change=lambda model: None, **changes):
        for name in ("policy.onnx", "policy.weights"):
            (tmp_path / name).write_bytes((folder / name).read_bytes())
        changed(folder, tmp_path, **changes)
        model = onnx.load(tmp_path / "policy.onnx")
        change(model)
        onnx.save(model, tmp_path / "policy.onnx")
        return tmp_path

    return write


@pytest.mark.parametrize(
    "changes",
    [
        {"command_ranges": {"vx": [-50.0, 50.0], "vy": [-0.4, 0.4], "yaw_rate": [-0.7, 0.7]}},
        {"torque_limits": [8.0] * 12},
        {"velocity_limits": [2.0] * 12},
        {"crouch_joint_angles": [0.0, 0.4, -0.8] * 4},
        {"command_dead_zone": 0.0},
        {"sim_dt": 0.001},
        {"robot": "go2"},
        {"my_own": 1},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_every_entry_is_compared_with_the_onnx_file(export_of, changes):
    (key,) = changes
    with pytest.raises(
        ConfigError, match=rf"policy\.json: {key}: .*policy\.onnx has another value; the files are from different exports"
    ):
        Policy(export_of(sha256=None, **changes))


def test_an_onnx_file_without_a_contract_is_refused(export_of):
    with pytest.raises(ConfigError, match=r"policy\.onnx: has no metadata of an export"):
        Policy(export_of(lambda model: model.ClearField("metadata_props"), sha256=None))


def test_an_export_without_checksums_is_read_as_before(export_of):
    assert Policy(export_of(sha256=None)).contract.width == 90


@pytest.mark.parametrize("name", ["policy.onnx", "policy.weights"])
def test_a_file_that_was_changed_after_the_export_is_refused(name, folder, tmp_path):
    changed(folder, tmp_path)
    for file in ("policy.onnx", "policy.weights"):
        (tmp_path / file).write_bytes((folder / file).read_bytes() + (b"\0" if file == name else b""))
    with pytest.raises(ConfigError, match=rf"{name}: is not the file exported with .*policy\.json \(sha256\)"):
        read_contract(tmp_path / "policy.json")


def spoil_weights(model):
    for tensor in model.graph.initializer:
        values = numpy_helper.to_array(tensor)
        if values.dtype == np.float32:
            tensor.CopyFrom(numpy_helper.from_array(np.full_like(values, np.nan), tensor.name))


def test_a_network_of_weights_that_are_not_finite_is_refused(export_of):
    with pytest.raises(ConfigError, match=r"policy\.onnx: gives actions that are not finite"):
        Policy(export_of(spoil_weights, sha256=None))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('{"observation": ' + "[" * 500 + "]" * 500 + "}", "the JSON text is nested too deeply"),
        ('{"observation": [], "sim_dt": ' + "1" * 400 + "}", "a whole number has 400 digits, more than 18"),
        ('{"observation": [], "sim_dt": ' + "1" * 5000 + "}", "a whole number has 5000 digits, more than 18"),
    ],
    ids=["deep", "long", "longer"],
)
def test_depth_and_numbers_of_the_file_are_bounded(text, says, tmp_path):
    (tmp_path / "policy.json").write_text(text)
    with pytest.raises(ConfigError, match=rf"is no policy\.json of an export \(ValueError: {says}\)"):
        read_contract(tmp_path / "policy.json")


POSTURES = [
    ("commands.ranges.base_height", [0.4, 0.6]),
    ("commands.ranges.base_pitch", [-0.2, 0.3]),
    ("observations.groups.actor.terms", ["base_ang_vel", "projected_gravity", "commands", "base_commands", "dof_pos"]),
]


def reading_of(task, robot, sources):
    """What a robot would measure where one of a task's is, from the engine's own numbers."""
    qpos, qvel = (tensor[robot].double().numpy() for tensor in (task.physics._qpos, task.physics._qvel))
    height = task.height_scan.heights[robot].double().numpy() - qpos[2]
    given = {"base_lin_vel": task.base_lin_vel[robot].double().numpy(), "heights": height}
    return Reading(0.0, 0.0, qpos[3:7], qvel[3:6], qpos[7:], qvel[6:], sources={name: given[name] for name in sources})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("anymal_c", SMALL_TERRAIN),
        ("anymal_c", [*SMALL_TERRAIN, ("observations.depth_limit", 0.02), ("observations.heights_limit", 0.04)]),
        ("anymal_c_proprio", SMALL_TERRAIN),
        ("anymal_c_flat", [("train.policy.rnn_type", "lstm"), ("train.policy.rnn_num_layers", 2)]),
        ("anymal_c_flat", [("train.policy.rnn_type", "gru"), ("control.held", ["HAA"])]),
        ("anymal_c_proprio", [*SMALL_TERRAIN, ("control.held", ["HAA"]), ("observations.joints", ["KFE", "HFE"])]),
        ("anymal_c_flat", POSTURES),
    ],
    ids=["height map", "shallow height map", "history", "LSTM", "GRU, held joints", "some joints", "height and pitch"],
)
def test_the_program_sees_and_does_what_the_tasks_policy_does(name, changes, tmp_path):
    """Observations to 2e-5 in their scaled units, and actions to 1e-5, over an episode's first steps."""
    always = [("env.num_envs", 2), ("init_state.yaw", [-3.0, 3.0]), *ENGINE, *CALM, *SMALL]
    always += [
        ("train.algorithm.symmetry", False),
        ("train.policy.rnn_hidden_dim", 8),
        ("train.algorithm.num_mini_batches", 2),
    ]
    task = make_task(task_config(name, [*always, *changes], on_cpu=True))
    torch.manual_seed(3)
    runner = Runner(task)
    network = runner.alg.get_policy()
    with torch.no_grad():
        for parameter in network.mlp[-1].parameters():
            parameter.mul_(3.0)  # actions of a size that matters
    export(task, network, tmp_path)
    act = runner.get_inference_policy("cpu")
    task.reset()
    commands = torch.tensor([[0.5, 0.2, -0.3], [-0.4, 0.0, 0.8]])
    bases = torch.tensor([[0.55, 0.2], task.base_sampler.usual.tolist()])
    observations = task.hold_commands(commands, base=bases)
    policies = [Policy(tmp_path) for _ in range(2)]
    sources = policies[0].contract.sources
    network.reset()
    for _ in range(8):
        with torch.inference_mode():
            actions = act(observations)
        for robot, policy in enumerate(policies):
            base = None if robot else bases[0].double().numpy()  # the second robot gets the usual height
            targets = policy.act(reading_of(task, robot, sources), commands[robot].double().numpy(), base)
            np.testing.assert_allclose(policy.observation, observations["actor"][robot], rtol=0.0, atol=2e-5)
            np.testing.assert_allclose(policy.actions, actions[robot], rtol=0.0, atol=1e-5)
            task.control.set_actions(actions)
            np.testing.assert_allclose(targets, task.control._target[robot], rtol=0.0, atol=1e-5)
        observations, _, dones, _ = task.step(actions)
        assert not dones.any()
    first = policies[0].actions.copy()
    policies[0].restart()
    policies[0].act(reading_of(task, 0, sources), commands[0].double().numpy())
    assert np.abs(policies[0].actions - first).max() > 1e-4, "a new episode begins without a past"


BLOCKED = """
import importlib.abc, sys
ALLOWED = {"numpy", "onnxruntime", "legged"}
class Blocks(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        frame, inside = sys._getframe(1), False
        while frame is not None and not inside:
            inside = any(f"/site-packages/{package}/" in frame.f_code.co_filename for package in ("onnxruntime", "numpy"))
            frame = frame.f_back
        if top in sys.stdlib_module_names or top in ALLOWED or inside:
            return None
        raise ModuleNotFoundError(f"{name} is blocked", name=name)
sys.meta_path.insert(0, Blocks())
"""


def test_it_needs_numpy_and_onnxruntime_alone(folder):
    """Everything else is blocked; what these two try to import on their own account is their affair."""
    code = (
        f"{BLOCKED}"
        "import pkgutil, importlib, legged.deploy\n"
        "names = [module.name for module in pkgutil.iter_modules(legged.deploy.__path__)]\n"
        "assert {'program', 'unitree', 'udp', 'weights', '__main__'} <= set(names), names\n"
        "for name in names: importlib.import_module(f'legged.deploy.{name}')\n"
        "from legged.deploy.policy import Policy\n"
        f"policy = Policy(__import__('pathlib').Path({str(folder)!r}))\n"
        "try: import torch\n"
        "except ImportError as error: print(policy.contract.width, error)\n"
        "print([name for name in ('torch', 'mujoco', 'yaml', 'tensordict', 'gymnasium') if name in sys.modules])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.split("\n")[:2] == ["90 torch is blocked", "[]"], done.stdout + done.stderr


def test_it_runs_as_a_copy_of_its_folder_alone(folder, tmp_path):
    """A robot's computer needs the folder `deploy`, and no other part of the package."""
    shutil.copytree(Path(contracts.__file__).parent, tmp_path / "legged" / "deploy")
    (tmp_path / "legged" / "__init__.py").touch()  # so that an installed package of this name is not found instead
    (tmp_path / "orders.txt").write_text("0 damping\n1 quit\n", encoding="utf-8")
    code = f"{BLOCKED}import runpy\nrunpy.run_module('legged.deploy', run_name='__main__', alter_sys=True)\n"
    alone = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}

    def run(*arguments):
        command = [sys.executable, "-c", code, *arguments]
        return subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False, env=alone)

    assert "--stand-seconds" in run("--help").stdout
    robot = ("--robot", "udp:127.0.0.1:9")  # nobody listens at this port
    assert "did you mean '--log'?" in run(str(folder), *robot, "--logs", "a.npz").stderr
    done = run(str(folder), *robot, "--commands", "orders.txt")
    assert done.returncode == 1
    assert done.stderr.startswith("error: --robot: no robot answers at udp:127.0.0.1:9"), done.stderr


@pytest.mark.slow
def test_a_policy_that_estimates_a_velocity_needs_nothing_that_gives_it(tmp_path):
    """The estimator is within the network: the robot's program reads what it always does."""
    estimating = ("train.policy.estimator.targets", ["base_lin_vel"]), ("train.policy.estimator.hidden_dims", [8])
    policy = Policy(exported(tmp_path, *BLIND, *estimating))
    assert not policy.contract.sources
    assert policy.contract.width == 90
    still = np.zeros(12)
    targets = policy.act(Reading(0.0, 0.0, np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3), still, still), np.zeros(3))
    assert np.isfinite(targets).all()
    assert not np.array_equal(targets, policy.contract.default)
