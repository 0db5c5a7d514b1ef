"""policy.weights: the same network as the ONNX file, in numpy and in C++."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from helpers import small_task
from still_robot import SMALL

import legged.deploy
from legged.deploy.weights import ACTIVATIONS, JOIN, KEEP, LINEAR, Layer, NumpyNetwork, pack, unpack
from legged.learning.runner import Runner
from legged.policies.export import export

HEADER = Path(legged.deploy.__file__).parent / "cpp" / "legged_policy.hpp"
COMPILER = shutil.which("g++") or shutil.which("clang++")
MAIN = """
#include "legged_policy.hpp"
#include <cstdio>
// Reads observations from a file, and writes actions; episodes begin at 0 and in the middle.
int main(int, char** given) {
    try {
        legged::Policy policy(given[1]);
        std::vector<float> observation(policy.inputs()), actions(policy.outputs());
        std::FILE* in = std::fopen(given[2], "rb");
        std::FILE* out = std::fopen(given[3], "wb");
        for (int i = 0; std::fread(observation.data(), sizeof(float), observation.size(), in) == observation.size(); ++i) {
            if (i == 50) policy.restart();
            policy.run(observation.data(), actions.data());
            std::fwrite(actions.data(), sizeof(float), actions.size(), out);
        }
        std::fclose(in);
        std::fclose(out);
        return 0;
    } catch (const std::exception& error) {
        std::fprintf(stderr, "%s\\n", error.what());
        return 2;
    }
}
"""
RECURRENT = [
    ("train.policy.rnn_hidden_dim", 12),
    ("train.policy.rnn_num_layers", 2),
    ("train.algorithm.symmetry", False),
]
VARIANTS = {
    "plain": [],
    "normalised, with a spread that depends on the state": [
        ("train.policy.obs_normalization", True),
        ("train.policy.state_dependent_std", True),
    ],
    "estimator": [
        ("train.policy.obs_normalization", True),
        ("train.policy.estimator.targets", ["base_lin_vel"]),
        ("train.policy.estimator.hidden_dims", [24]),
        ("train.policy.estimator.latent", 7),
    ],
    "LSTM": [("train.policy.rnn_type", "lstm"), *RECURRENT],
    "GRU": [("train.policy.rnn_type", "gru"), *RECURRENT],
    **{name: [("train.policy.activation", name)] for name in ACTIVATIONS if name != "elu"},
}


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    """The header in a program of a few lines, compiled with warnings as errors."""
    if COMPILER is None:
        pytest.skip("there is no C++ compiler here")
    folder = tmp_path_factory.mktemp("cpp")
    (folder / "main.cpp").write_text(MAIN)
    flags = ["-std=c++14", "-O2", "-Wall", "-Wextra", "-Werror", f"-I{HEADER.parent}"]
    subprocess.run([COMPILER, *flags, str(folder / "main.cpp"), "-o", str(folder / "main")], check=True)
    return folder / "main"


def exported(folder, *changes):
    runner = Runner(small_task(*SMALL, *changes, num_envs=4))
    network = runner.alg.get_policy()
    torch.manual_seed(5)
    if runner.env.cfg.train.policy.obs_normalization:
        network.train()
        for _ in range(3):
            network.update_normalization(runner.env.get_observations().apply(lambda x: torch.randn_like(x) * 3.0 + 1.0))
    with torch.no_grad():
        for parameter in network.mlp.parameters():
            parameter.copy_(torch.randn_like(parameter) * 0.5)
    export(runner.env, network, folder)


def by_onnx(folder, observations):
    """Actions for observations one after the other, forgetting at the 50th."""
    session = onnxruntime.InferenceSession(str(folder / "policy.onnx"), providers=["CPUExecutionProvider"])
    names = [given.name for given in session.get_inputs()][1:]
    actions = []
    for i, observation in enumerate(observations):
        if i in (0, 50):
            hidden = {name: np.zeros((2, 1, 12), dtype=np.float32) for name in names}
        action, *states = session.run(None, {"obs": observation[None], **hidden})
        hidden = dict(zip(hidden, states, strict=False))
        actions.append(action[0])
    return np.array(actions)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_the_header_computes_what_the_onnx_file_does(variant, program, tmp_path):
    """100 random observations, to 1e-5 of the largest action, or 1e-5 where that is below 1."""
    exported(tmp_path, *VARIANTS[variant])
    observations = np.random.default_rng(7).normal(size=(100, 48)).astype(np.float32)
    (tmp_path / "in").write_bytes(observations.tobytes())
    arguments = [str(tmp_path / name) for name in ("policy.weights", "in", "out")]
    subprocess.run([str(program), *arguments], check=True)
    found = np.frombuffer((tmp_path / "out").read_bytes(), np.float32).reshape(100, 12)
    wanted = by_onnx(tmp_path, observations)
    assert np.abs(wanted).max() > 0.1
    np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-5 * max(1.0, np.abs(wanted).max()))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("data", "says"),
    [(b"", "is cut short"), (b"nonsense, and more of it", "is no policy.weights"), (None, "is cut short")],
    ids=["empty", "nonsense", "cut short"],
)
def test_what_is_no_file_of_weights_is_refused(data, says, program, tmp_path):
    if data is None:
        data = pack([Layer(LINEAR, 0, 3, 2, (np.ones((2, 3)), np.ones(2)))])[:-1]
    (tmp_path / "policy.weights").write_bytes(data)
    done = subprocess.run([str(program), str(tmp_path / "policy.weights")], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert says in done.stderr
    with pytest.raises(ValueError, match=r"is no policy\.weights|is cut short"):
        unpack(data)


def linear(inputs, outputs):
    return Layer(LINEAR, 0, inputs, outputs, (np.ones((outputs, inputs)), np.ones(outputs)))


KEPT = Layer(KEEP, 0, 3, 3, ())
JOINS = ["nothing kept", "joined to another width", "joined twice", "kept with another width"]


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (pack([]), "has no layers"),
        (pack([linear(3, 2), linear(3, 2)]), "has layers that do not fit together"),
        (pack([linear(3, 2), Layer(2, 99, 2, 2, ())]), "has a layer that this program does not know"),
        (pack([linear(3, 2), Layer(2, 0, 2, 9, ())]), "has a layer whose outputs must be as many as its inputs"),
        (pack([linear(3, 2)]) + b"x", "is longer than its layers"),
        (pack([linear(3, 2), Layer(JOIN, 0, 2, 5, ())]), "has a layer JOIN without a layer KEEP that fits"),
        (pack([KEPT, linear(3, 2), Layer(JOIN, 0, 2, 6, ())]), "has a layer JOIN without a layer KEEP that fits"),
        (pack([KEPT, Layer(JOIN, 0, 3, 6, ()), Layer(JOIN, 0, 6, 9, ())]), "has a layer JOIN without a layer KEEP that fits"),
        (pack([Layer(KEEP, 0, 3, 4, ()), linear(4, 2)]), "has a layer whose outputs must be as many as its inputs"),
        (pack([Layer(LINEAR, 0, 1, 1, (np.full((1, 1), np.nan), np.ones(1)))]), "has numbers that are not finite"),
    ],
    ids=["no layers", "do not fit", "unknown activation", "another width", "longer", *JOINS, "NaN"],
)
def test_layers_that_make_no_network_are_refused_by_both(data, says, program, tmp_path):
    (tmp_path / "policy.weights").write_bytes(data)
    done = subprocess.run([str(program), str(tmp_path / "policy.weights")], capture_output=True, text=True, check=False)
    assert (done.returncode, says in done.stderr) == (2, True), done.stderr
    with pytest.raises(ValueError, match=says):
        unpack(data)


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_what_is_no_number_stays_none(name, program, tmp_path):
    """Or a sensor that has died would make actions that look like others."""
    data = pack([Layer(2, list(ACTIVATIONS).index(name), 1, 1, ())])
    (tmp_path / "policy.weights").write_bytes(data)
    (tmp_path / "in").write_bytes(np.array([np.nan], np.float32).tobytes())
    subprocess.run([str(program), *(str(tmp_path / name) for name in ("policy.weights", "in", "out"))], check=True)
    assert np.isnan(np.frombuffer((tmp_path / "out").read_bytes(), np.float32)).all()
    with np.errstate(invalid="ignore"):
        assert np.isnan(NumpyNetwork(data).run(np.array([[np.nan]]))).all()


def test_a_layer_by_hand():
    """(2 - 1) / 4 = 0.25; 3 * 0.25 - 1 = -0.25; elu of that is exp(-0.25) - 1."""
    layers = [
        Layer(0, 0, 1, 1, (np.array([1.0]), np.array([4.0]))),
        Layer(LINEAR, 0, 1, 1, (np.array([[3.0]]), np.array([-1.0]))),
        Layer(2, 0, 1, 1, ()),
    ]
    assert NumpyNetwork(pack(layers)).run(np.array([[2.0]]))[0, 0] == pytest.approx(np.exp(-0.25) - 1.0)


def test_what_was_kept_comes_before_what_was_found_in_it(program, tmp_path):
    """(2, 3) are kept, their sum plus 1 is found; the matrix picks 2, 30 and 600 of them."""
    found = Layer(LINEAR, 0, 2, 1, (np.ones((1, 2)), np.ones(1)))
    picked = Layer(LINEAR, 0, 3, 3, (np.diag([1.0, 10.0, 100.0]), np.zeros(3)))
    data = pack([Layer(KEEP, 0, 2, 2, ()), found, Layer(JOIN, 0, 1, 3, ()), picked])
    assert NumpyNetwork(data).run(np.array([[2.0, 3.0]])).tolist() == [[2.0, 30.0, 600.0]]
    (tmp_path / "policy.weights").write_bytes(data)
    (tmp_path / "in").write_bytes(np.array([2.0, 3.0], np.float32).tobytes())
    subprocess.run([str(program), *(str(tmp_path / name) for name in ("policy.weights", "in", "out"))], check=True)
    assert np.frombuffer((tmp_path / "out").read_bytes(), np.float32).tolist() == [2.0, 30.0, 600.0]
