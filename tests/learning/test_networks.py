"""Networks by configuration: each kind is trained, resumed, played, evaluated and exported."""

import json
import re
from dataclasses import replace

import numpy as np
import onnxruntime
import pytest
import torch
from helpers import TASK, TINY_TRAINING, call, checkpoints, small_config, small_task, tiny_run
from tensordict import TensorDict

from legged.cli.evaluate import grid as evaluate_grid
from legged.cli.play import play
from legged.cli.train import train
from legged.errors import ConfigError
from legged.learning.captured import CapturedRunner
from legged.learning.checkpoint import check_fits, read_checkpoint
from legged.learning.networks import action_std, build_actor, use_matmul
from legged.learning.run_folder import run_config
from legged.learning.runner import Runner
from legged.policies.restore import TrainedPolicy, restore

pytestmark = pytest.mark.usefixtures("workplace")

UNLIKE = ["observations.groups.critic.terms=[dof_pos, base_lin_vel]", "observations.groups.actor.history=2"]
"""The groups have different terms: 2 x 48 numbers, and 15."""
NO_MIRROR = "train.algorithm.symmetry=false"
RECURRENT = ["train.policy.rnn_hidden_dim=6", "train.algorithm.num_mini_batches=2", NO_MIRROR]
VARIANTS = {
    "sizes, sgd": [
        "train.policy.actor_hidden_dims=[16, 8, 4]",
        "train.policy.activation=tanh",
        "train.algorithm.optimizer=sgd",
        "train.algorithm.normalize_advantage_per_mini_batch=true",
    ],
    "shared observations, bounded std": [
        "train.policy.critic_observations=[actor]",
        *(f"train.policy.{name}" for name in ("init_noise_std=0.5", "min_noise_std=0.499", "max_noise_std=0.501")),
        *UNLIKE,
    ],
    "several groups, log std": [
        "train.policy.actor_observations=[critic, actor]",
        "train.policy.critic_observations=[actor, critic]",
        "train.policy.noise_std_type=log",
        "train.policy.min_noise_std=0.3",
        "train.policy.obs_normalization=true",
        *UNLIKE,
    ],
    "std by state": ["train.policy.state_dependent_std=true", "train.policy.noise_std_type=log"],
    "estimator": [
        "train.policy.estimator.targets=[base_lin_vel]",
        "train.policy.estimator.hidden_dims=[8]",
        "train.policy.estimator.latent=2",
        "train.policy.obs_normalization=true",
        *UNLIKE,
    ],
    "lstm": ["train.policy.rnn_type=lstm", "train.policy.obs_normalization=true", *RECURRENT],
    "gru": [
        "train.policy.rnn_type=gru",
        "train.policy.rnn_num_layers=2",
        "train.policy.noise_std_type=log",
        "train.policy.actor_observations=[actor, critic]",
        *UNLIKE,
        *RECURRENT,
    ],
}
BASE = ["--task", TASK, "--sim_device", "cpu"]


class Exported:
    """The exported files of a policy, as a controller runs them: for a batch of robots, whose episodes begin one by one."""

    def __init__(self, folder):
        self.facts = json.loads((folder / "policy.json").read_text())
        self.session = onnxruntime.InferenceSession(str(folder / "policy.onnx"), providers=["CPUExecutionProvider"])
        self.script = [torch.jit.load(str(folder / "policy.pt")) for _ in range(3)]
        self.hidden = {}

    def onnx(self, observation, begins):
        memory = self.facts["recurrent"]
        if memory is not None:
            layers, _, width = memory["shape"]
            for name in memory["onnx_inputs"]:
                self.hidden.setdefault(name, np.zeros((layers, len(begins), width), dtype=np.float32))[:, begins] = 0.0
        action, *states = self.session.run(None, {"obs": observation, **self.hidden})
        self.hidden = {name: np.array(state) for name, state in zip(self.hidden, states, strict=True)}
        return action

    def torchscript(self, observation, begins):
        actions = []
        for script, row, new in zip(self.script, observation, begins, strict=True):
            if new:
                script.reset()
            with torch.no_grad():
                actions.append(script(torch.tensor(row[None])).numpy())
        return np.concatenate(actions)


@pytest.mark.slow
@pytest.mark.parametrize("name", VARIANTS)
def test_every_kind_of_network_is_trained_resumed_played_evaluated_and_exported(name):
    folder = tiny_run(*VARIANTS[name])
    resumed = tiny_run("--resume", "--load_run", str(folder), *VARIANTS[name], iterations=3)
    assert max(checkpoints(resumed)) == 2
    assert run_config(resumed).train.policy == run_config(folder).train.policy
    assert call(play.main, [*BASE, "--load_run", str(folder), "--num_envs", "3", "--no-video"]) == 0
    one_cell = ["--vx=0", "--vy=0", "--yaw=0", "--robots", "1"]
    assert call(evaluate_grid.main, [str(folder), "--sim-device", "cpu", *one_cell]) == 0

    policy = TrainedPolicy(run_config(folder), folder / "model_1.pt")
    task, act = restore(policy, [("env.num_envs", 3)], torch.device("cpu"))
    exported = Exported(folder / "exported")
    groups = {group["name"]: group for group in exported.facts["observation_groups"]}
    assert [*groups] == list(task.cfg.train.policy.actor_observations)
    torch.manual_seed(4)
    largest = 0.0
    for step in range(100):
        begins = torch.rand(3) < (1.0 if step == 0 else 0.05)
        task.reset_buf.copy_(begins)
        observations = task.get_observations().apply(torch.randn_like)
        flat = np.concatenate([observations[group].numpy() for group in groups], axis=1)
        for group in groups.values():  # where the description says, as many numbers as it says
            end = group["start"] + group["history"] * group["size"]
            np.testing.assert_array_equal(flat[:, group["start"] : end], observations[group["name"]].numpy())
        with torch.inference_mode():
            wanted = act(observations).numpy()
        for found in (exported.onnx(flat, begins.numpy()), exported.torchscript(flat, begins.numpy())):
            np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-5)
        largest = max(largest, float(np.abs(wanted).max()))
    assert largest > 0.01


@pytest.mark.slow
def test_terms_of_several_groups_lie_where_their_description_says():
    """48 numbers twice after 15: the newest of the actor's dof_pos begins at 15 + 48 + 12."""
    folder = tiny_run(*VARIANTS["several groups, log std"])
    assert call(play.main, [*BASE, "--load_run", str(folder), "--num_envs", "1", "--no-video"]) == 0
    facts = json.loads((folder / "exported" / "policy.json").read_text())
    assert facts["observation_groups"] == [
        {"name": "critic", "start": 0, "size": 15, "history": 1},
        {"name": "actor", "start": 15, "size": 48, "history": 2},
    ]
    starts = {(term["group"], term["name"]): term["start"] for term in facts["observation"]}
    assert starts["critic", "dof_pos"] == 0
    assert starts["critic", "base_lin_vel"] == 12
    assert starts["actor", "base_lin_vel"] == 15
    assert starts["actor", "dof_pos"] == 15 + 12


@pytest.mark.slow
def test_networks_read_the_groups_that_they_are_told_to():
    changes = [("observations.groups.critic.terms", ["dof_pos"]), ("train.policy.critic_observations", ["actor"])]
    alg = Runner(small_task(*changes)).alg
    assert (alg.actor.obs_dim, alg.critic.obs_dim) == (48, 48)
    both = ("train.policy.actor_observations", ["critic", "actor"])
    alg = Runner(small_task(("observations.groups.critic.terms", ["dof_pos"]), both)).alg
    assert (alg.actor.obs_dim, alg.critic.obs_dim) == (60, 12)


# ---- standard deviation ----------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("kind", [Runner, CapturedRunner])
@pytest.mark.parametrize("std_type", ["scalar", "log"])
def test_the_std_stays_within_its_bounds_and_comes_back(kind, std_type, tmp_path):
    """A bonus for entropy drives it to the upper bound, a malus to the lower one; it must not stick there."""
    bounds = [
        ("train.policy.init_noise_std", 0.5),
        ("train.policy.min_noise_std", 0.45),
        ("train.policy.max_noise_std", 0.55),
    ]
    fast = [("train.algorithm.learning_rate", 3e-3), ("train.algorithm.schedule", "fixed")]
    more = [("train.policy.noise_std_type", std_type), ("train.algorithm.symmetry", False)]
    runner = kind(small_task(*bounds, *fast, *more, num_envs=1), None, "cpu")
    policy = runner.alg.get_policy()
    (parameter,) = policy.distribution.parameters()

    def std():
        return parameter.detach().exp() if std_type == "log" else parameter.detach()

    for bonus, bound in ((100.0, 0.55), (-100.0, 0.45), (100.0, 0.55)):
        runner.alg.entropy_coef = bonus
        runner.learn(6)
        torch.testing.assert_close(std(), torch.full((12,), bound), rtol=0, atol=1e-6)
        assert action_std(policy).min() >= 0.45 - 1e-6
        assert action_std(policy).max() <= 0.55 + 1e-6


@pytest.mark.slow
def test_bounds_that_are_narrowed_hold_after_a_resume():
    folder = tiny_run("train.policy.init_noise_std=0.8")
    narrow = ["train.policy.max_noise_std=0.6", "train.policy.init_noise_std=0.6"]
    resumed = tiny_run("--resume", "--load_run", str(folder), *narrow, iterations=3)
    before, after = (read_checkpoint(run / f"model_{i}.pt")["actor_state_dict"] for run, i in ((folder, 1), (resumed, 2)))
    assert before["distribution.std_param"].min() > 0.7
    assert after["distribution.std_param"].max() <= 0.6


@pytest.mark.slow
def test_a_std_that_is_fixed_by_its_bounds_does_not_change():
    same = [f"train.policy.{name}_noise_std=0.3" for name in ("init", "min", "max")]
    state = read_checkpoint(tiny_run(*same) / "model_1.pt")["actor_state_dict"]
    assert state["distribution.std_param"].tolist() == pytest.approx([0.3] * 12)


# ---- what does not fit -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (
            "train.policy.critic_observations=[acter]",
            r"line: train\.policy\.critic_observations: there is no observation group 'acter'; did you mean 'actor'\?",
        ),
        ("train.policy.actor_observations=[]", r"train\.policy\.actor_observations: must not be empty"),
        ("train.policy.actor_observations=[actor, actor]", r"'actor' is named twice"),
        (
            "train.policy.min_noise_std=0.8",
            r"init_noise_std: must lie between train\.policy\.min_noise_std=0\.8 \(command line\) and .*got 0\.75",
        ),
        ("train.policy.max_noise_std=0.1", r"train\.policy\.init_noise_std: must lie .*max_noise_std=0\.1.*got 0\.75"),
        ("train.policy.noise_std_type=lag", r"train\.policy\.noise_std_type: unknown value 'lag'; did you mean 'log'\?"),
        ("train.algorithm.optimizer=adm", r"train\.algorithm\.optimizer: unknown value 'adm'; did you mean 'adam'\?"),
    ],
)
def test_networks_that_cannot_be_are_refused_at_start_up(change, text, capsys):
    assert call(train.main, [*BASE, change]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert re.search(text, error), error


def test_a_mirror_loss_needs_mirror_images(capsys):
    assert call(train.main, [*BASE, NO_MIRROR, "train.algorithm.mirror_loss_coeff=0.5"]) == 2
    assert "train.algorithm.mirror_loss_coeff: must be 0 without mirror images" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ([("train.policy.noise_std_type", "log")], "its actor has noise_std_type scalar, .* train.policy.noise_std_type log"),
        ([("train.policy.state_dependent_std", True)], "its actor has state_dependent_std False"),
        (
            [("train.policy.critic_observations", ["actor"])],
            r"its critic has the observations \['critic'\], .* train\.policy\.critic_observations \['actor'\]",
        ),
    ],
)
def test_a_checkpoint_of_other_networks_is_refused(changes, text, tmp_path):
    path = tmp_path / "model_0.pt"
    sizes = [("train.policy.actor_hidden_dims", [8]), ("train.policy.critic_hidden_dims", [8])]
    Runner(small_task(*sizes)).save(str(path))
    saved = read_checkpoint(path)
    check_fits(path, saved, small_config(*sizes))
    with pytest.raises(ConfigError, match=text):
        check_fits(path, saved, small_config(*sizes, *changes))


@pytest.mark.slow
def test_an_optimiser_of_another_kind_is_not_resumed(capsys):
    folder = tiny_run()
    capsys.readouterr()
    again = [*BASE, "--resume", "--load_run", str(folder), "--max_iterations", "3", "train.algorithm.optimizer=sgd"]
    assert call(train.main, again) == 2
    wanted = "its optimiser is adam, the configuration has train.algorithm.optimizer sgd"
    assert wanted in capsys.readouterr().err


# ---- the captured loop -----------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "why"),
    [
        (["train.algorithm.mirror_loss_coeff=0.5"], "mirror_loss_coeff is above 0"),
        (["train.algorithm.optimizer=adamw"], "the optimiser is AdamW"),
        (["train.policy.state_dependent_std=true"], "actions are HeteroscedasticGaussianDistribution"),
        (VARIANTS["lstm"], "the actor is a RNNModel"),
    ],
)
def test_what_the_captured_loop_cannot_hold_trains_on_rsl_rls_and_says_why(changes, why, capsys):
    arguments = [*BASE, "--num_envs", "8", "--max_iterations", "1", *TINY_TRAINING, *changes]
    assert call(train.main, arguments) == 0
    assert f"rsl-rl's own training loop: {why}\n" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        VARIANTS["several groups, log std"],
        VARIANTS["estimator"],
        ["train.algorithm.normalize_advantage_per_mini_batch=true"],
    ],
)
def test_what_it_can_hold_trains_on_it(changes, capsys):
    arguments = [*BASE, "--num_envs", "8", "--max_iterations", "1", *TINY_TRAINING, *changes]
    assert call(train.main, arguments) == 0
    assert "rsl-rl's own" not in capsys.readouterr().out


@pytest.mark.slow
def test_a_mirror_loss_pulls_the_policy_towards_its_mirror_image():
    """The same training with and without it: with a large weight little else is learned."""
    apart = {}
    for weight in (0.0, 100.0):
        torch.manual_seed(0)
        task = small_task(("train.algorithm.symmetry", True), ("train.algorithm.mirror_loss_coeff", weight), num_envs=8)
        runner = Runner(task)
        runner.learn(4)
        images = task.mirror_images()
        observations = torch.randn(200, 48, generator=torch.Generator().manual_seed(1))
        (columns, signs), (joints, turns) = images.groups["actor"], images.actions
        with torch.no_grad():
            mine, theirs = (
                runner.alg.actor(TensorDict({"actor": x}, batch_size=[200]))
                for x in (observations, observations[:, columns] * signs)
            )
        apart[weight] = float((mine[:, joints] * turns - theirs).square().mean())
    assert apart[100.0] < 0.7 * apart[0.0]


def test_building_an_actor_draws_no_random_numbers():
    task = small_task()
    torch.manual_seed(5)
    wanted = torch.rand(3)
    torch.manual_seed(5)
    build_actor(task.cfg, task.get_observations(), task.num_actions)
    assert torch.equal(torch.rand(3), wanted)


@pytest.mark.parametrize("matmul", ["tf32", "float32"])
def test_matrices_are_multiplied_in_float32_on_a_cpu(matmul):
    """Rounded to bfloat16, the products of 300 numbers of size 1 would be off by some 0.05, in TF32 by 0.01."""
    cfg = small_config()
    use_matmul(replace(cfg, train=replace(cfg.train, runner=replace(cfg.train.runner, matmul=matmul))))
    generator = torch.Generator().manual_seed(1)
    a, b = (torch.randn(300, 300, generator=generator) for _ in range(2))
    torch.testing.assert_close((a @ b).double(), a.double() @ b.double(), atol=2e-4, rtol=0.0)
