"""Entries of the walking league: the files alone, in Python and compiled for the CPU, do what our policy does."""

import ctypes
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from helpers import call
from test_formats import BLIND, ONE_FRAME, SMALL, Other, measured_in, trained

from legged.cli.export import export as export_tool
from legged.deploy.contract import contract_of
from legged.errors import ConfigError
from legged.learning.runner import Runner
from legged.policies import league_format
from legged.policies.description import describe
from legged.policies.export import ExportError, onnx_of
from legged.policies.formats import export_as
from legged.policies.league_format import Entry
from legged.registry import make_task, task_config

COMPILER = shutil.which("g++") or shutil.which("clang++")
STAND_IN = Path(__file__).with_name("league_stand_in.hpp")
ROBOTS = 3
ARMS = ["shoulder", "elbow", "wrist"]
TRUE = [
    ("observations.bias.base_ang_vel", 0.0),
    ("observations.bias.projected_gravity", 0.0),
    ("domain_rand.ranges.joint_offset.range", [0.0, 0.0]),
]
"""Measurements of g1_teleop without errors."""
CALLS = """
static NAME::Policy* policy;
extern "C" {
const char* start(policy_api::Network network, int robots) {
    policy_api::network = network;
    policy = new NAME::Policy();
    policy->init(robots);
    return policy->network_->said.c_str();
}
void step(const policy_api::Ctx* arrays) { policy->step(*arrays); }
void restart(int robot) { std::memset(policy->state_ + robot * NAME::STATE, 0, NAME::STATE * sizeof(float)); }
void facts(float* kp, float* kd, double* limits) {
    std::memcpy(kp, policy->kp(), 29 * sizeof(float));
    std::memcpy(kd, policy->kd(), 29 * sizeof(float));
    const policy_api::Limits all = policy->limits();
    std::memcpy(limits, &all, 5 * sizeof(double));
}
int owned() { return policy->owned(); }
const char* name() { return policy->name(); }
void stop() { delete policy; }
}
"""
FLOATS = ctypes.POINTER(ctypes.c_float)
ARRAYS = ("motor_q", "motor_dq", "gyro", "base_lin_vel", "gravity", "cmd", "task", "arm_pose", "base_quat", "q_target")


class ByHand:
    """An entry run by a program that reads in policy.cpp only which arrays the network gets."""

    def __init__(self, folder, robots):
        self.session = onnxruntime.InferenceSession(str(folder / "model.onnx"), providers=["CPUExecutionProvider"])
        text = (folder / "policy.cpp").read_text()
        self.columns = re.findall(r"\(c\.(\w+), (\d+), inputs_, INPUTS, (\d+), robots_\)", text)
        self.obs, self.state = (
            np.zeros([robots if size == "batch" else size for size in each.shape], np.float32)
            for each in self.session.get_inputs()
        )

    def act(self, arrays):
        """Targets (N, 29) of all joints."""
        self.obs.fill(np.nan)
        for name, width, column in self.columns:
            self.obs[:, int(column) : int(column) + int(width)] = arrays[name]
        targets, self.state = self.session.run(None, {"obs": self.obs, "state_in": self.state})
        return np.concatenate([targets, arrays["arm_pose"][:, targets.shape[1] :]], axis=1)

    def restart(self, robot):
        self.state = self.state.copy()
        self.state[:, robot] = 0.0


class Compiled:
    """An entry whose policy.cpp is compiled with a stand-in for the league."""

    def __init__(self, folder, robots):
        text = re.sub(r"(\w+)<<<(.*?)>>>\(", r"launch(\2, \1, ", (folder / "policy.cpp").read_text())
        source, library = folder / "whole.cpp", folder / "whole.so"
        source.write_text(STAND_IN.read_text() + text + CALLS.replace("NAME", folder.name))
        flags = ["-std=c++17", "-Wall", "-Wextra", "-Werror", "-O1", "-shared", "-fPIC"]
        done = subprocess.run([COMPILER, *flags, str(source), "-o", str(library)], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        self.session = onnxruntime.InferenceSession(str(folder / "model.onnx"), providers=["CPUExecutionProvider"])
        self.library = ctypes.CDLL(str(library))
        self.library.start.restype = self.library.name.restype = ctypes.c_char_p
        self.network = ctypes.CFUNCTYPE(None, FLOATS, FLOATS, FLOATS, FLOATS, ctypes.c_int)(self.run)
        self.said = self.library.start(self.network, robots).decode()

    def run(self, *given):
        *pointers, robots = given
        ends = [*self.session.get_inputs(), *self.session.get_outputs()]
        shapes = [[robots if isinstance(size, str) else size for size in each.shape] for each in ends]
        obs, state, *out = (np.ctypeslib.as_array(each, shape) for each, shape in zip(pointers, shapes, strict=True))
        for place, values in zip(out, self.session.run(None, {"obs": obs, "state_in": state}), strict=True):
            place[:] = values

    def act(self, arrays):
        targets = np.full(arrays["motor_q"].shape, np.nan, np.float32)
        kept = [np.ascontiguousarray({**arrays, "q_target": targets}.get(name, []), np.float32) for name in ARRAYS]
        self.library.step((FLOATS * len(ARRAYS))(*(each.ctypes.data_as(FLOATS) for each in kept)))
        return kept[-1]

    def restart(self, robot):
        self.library.restart(robot)


def arrays_of(task, commands):
    """The league's arrays (N, width) float32 for the state of a task, whose joints are in the order of the motors."""
    rows = [measured_in(task, robot, command) for robot, command in enumerate(commands.double().numpy())]
    arms = task.default_dof_pos.expand(len(rows), -1).clone()
    arms[:, list(task.control.held)] += task.control.held_offsets
    arms[:, :15] = 0.3  # what the league has there is not for the policy
    columns = {
        "motor_q": [[*row["angles"].values()] for row in rows],
        "motor_dq": [[*row["speeds"].values()] for row in rows],
        "arm_pose": arms.numpy(),
    }
    theirs = {"gyro": "gyro", "base_lin_vel": "velocity", "gravity": "gravity", "cmd": "command"}
    columns |= {name: [row[ours] for row in rows] for name, ours in theirs.items()}
    return {name: np.array(values, np.float32) for name, values in columns.items()}


def entry_of(name, folder, *changes):
    task, runner, network = trained(name, ("env.num_envs", ROBOTS), *changes)
    assert export_as(task, network, folder, "league") < 1e-5
    return task, runner, network, folder / "policies" / name


@pytest.mark.slow
@pytest.mark.parametrize(
    "reader", [ByHand, pytest.param(Compiled, marks=pytest.mark.skipif(not COMPILER, reason="no compiler"))]
)
@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("g1_teleop", [("train.policy.obs_normalization", True), *TRUE]),
        ("g1_flat", [("observations.clip", 0.3), ("control.clip_actions", 0.25), ("control.action_scale", 0.4386)]),
        ("g1_flat", [("control.held", [*ARMS, "waist"]), ("observations.groups.actor.terms", [*BLIND, "held_targets"])]),
        (
            "g1_flat",
            [
                *ONE_FRAME,
                ("observations.groups.actor.history", 2),
                ("train.policy.rnn_type", "lstm"),
                ("train.policy.rnn_hidden_dim", 8),
                ("train.policy.rnn_num_layers", 2),
            ],
        ),
        ("g1_flat", [*ONE_FRAME, ("train.policy.rnn_type", "gru"), ("train.policy.rnn_hidden_dim", 8)]),
    ],
    ids=["15 actions, history", "29 actions, clipped", "held waist, targets of arms", "LSTM", "GRU"],
)
def test_an_entry_does_what_the_policy_does(reader, name, changes, tmp_path):
    task, runner, network, folder = entry_of(name, tmp_path, *changes)
    act, entry = runner.get_inference_policy("cpu"), reader(folder, ROBOTS)
    task.reset()
    commands = torch.tensor([[0.5, 0.2, -0.3], [-0.4, 0.0, 0.8], [0.0, 0.0, 0.0]])
    observations = task.hold_commands(commands)
    network.reset()
    largest = 0.0
    for _ in range(100):
        with torch.inference_mode():
            actions = act(observations)
        clip = task.cfg.control.clip_actions
        task.control.set_actions(actions.clip(-clip, clip))
        arrays = arrays_of(task, commands)
        targets = entry.act(arrays)
        np.testing.assert_allclose(targets[:, :15], task.control._target[:, :15], rtol=0.0, atol=1e-5)
        np.testing.assert_array_equal(targets[:, 15:], arrays["arm_pose"][:, 15:])
        assert np.abs(targets[0] - targets[1]).max() > 1e-4  # the rows differ
        largest = max(largest, float(actions.abs().max()))
        observations, _, dones, _ = task.step(actions)
        with torch.inference_mode():
            network.reset(dones)
        for robot in dones.nonzero().flatten().tolist():
            entry.restart(robot)
    assert largest > 0.2


@pytest.mark.slow
@pytest.mark.skipif(not COMPILER, reason="no compiler")
def test_the_class_states_gains_limits_and_the_networks_ends(tmp_path):
    ranges = {"lin_vel_x": [-0.3, 0.8], "lin_vel_y": [-0.4, 0.2], "ang_vel_yaw": [-1.0, 0.6]}
    changes = [(f"commands.ranges.{key}", value) for key, value in ranges.items()]
    task, _, _, folder = entry_of(
        "g1_flat", tmp_path, ("control.held", ARMS), ("observations.groups.actor.terms", BLIND), *changes
    )
    entry = Compiled(folder, ROBOTS)
    # 3 gyro, 3 gravity, 3 command, 29 angles, 29 speeds; a mark, 15 actions, an observation of 9 + 2 * 29 + 15 numbers
    assert entry.said == "policies/g1_flat/model.onnx obs,-1,67 state_in,1,-1,98 actions,-1,15 state_out,1,-1,98"
    kp, kd, limits = np.zeros(29, np.float32), np.zeros(29, np.float32), np.zeros(5)
    entry.library.facts(*(each.ctypes.data_as(ctypes.c_void_p) for each in (kp, kd, limits)))
    np.testing.assert_array_equal(kp, task.control.nominal["p_gain"])
    np.testing.assert_array_equal(kd, task.control.nominal["d_gain"])
    np.testing.assert_allclose(limits, [-0.3, 0.8, 0.2, 0.6, 0.0], rtol=1e-6)
    assert (entry.library.owned(), entry.library.name()) == (15, b"g1_flat")
    entry.library.stop()


def test_the_name_of_an_entry_is_a_name_in_cpp():
    task = make_task(task_config("g1_flat", [("sim.physics", "mujoco"), *SMALL], on_cpu=True))
    contract = replace(contract_of(Path("g1_flat"), describe(task)), task="my-g1.v2")
    assert Entry(torch.nn.Identity(), contract).name == "my_g1_v2"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "changes", "says"),
    [
        ("go2_flat", [], r"robot: --format league is for a g1 with 29 joints, got 'go2'"),
        (
            "g1_flat",
            [("control.decimation", 2)],
            r"control\.decimation: --format league has control steps of 0.02 s, got 0.01 s",
        ),
        (
            "g1_flat",
            [("observations.groups.actor.terms", [*BLIND, "heights"])],
            r"observations\.groups\.actor: --format league cannot express 'heights' of 187 numbers \(known: base_ang_vel, ",
        ),
        (
            "g1_flat",
            [("control.control_type", "T")],
            r"control\.control_type: --format league knows joint position targets only",
        ),
    ],
)
def test_what_the_league_does_not_have_is_refused_by_the_setting(name, changes, says, tmp_path):
    task = make_task(task_config(name, [("sim.physics", "mujoco"), *SMALL[:-1], *changes], on_cpu=True))
    with pytest.raises(ConfigError, match=says):
        export_as(task, None, tmp_path / "exported", "league")
    assert not (tmp_path / "exported").exists()


def test_a_network_that_computes_something_else_is_refused(tmp_path, monkeypatch):
    class Shifted(Other):
        def forward(self, *given):
            targets, state = self.network(*given)
            return targets + 0.5, state

    Shifted.input_names, Shifted.output_names = Entry.input_names, Entry.output_names
    monkeypatch.setattr(league_format, "onnx_of", lambda entry, *rest: onnx_of(Shifted(entry), *rest))
    task = make_task(task_config("g1_flat", [("sim.physics", "mujoco"), *SMALL], on_cpu=True))
    with pytest.raises(ExportError, match=r"model\.onnx: differs from the policy by"):
        export_as(task, Runner(task).alg.get_policy(), tmp_path, "league")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.usefixtures("workplace")
def test_the_command_writes_a_folder_for_the_league(tmp_path):
    assert call(export_tool.main, ["g1_teleop", "--format", "league"]) == 0
    (folder,) = (tmp_path / "logs" / "export" / "g1_teleop" / "exported_league").iterdir()
    found = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert found == {"policies/g1_teleop/model.onnx", "policies/g1_teleop/policy.cpp"}
