"""A policy that estimates: what trains it, what it is given, and that every file of it does the same."""

import copy
import json

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from helpers import TASK, TINY_TRAINING, call, run_folders, small_config, small_task, tiny_run
from learners import LEARNING, ROBOTS, STEPS
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from test_resume import content, same

from legged.cli.train import train
from legged.errors import ConfigError
from legged.evaluation.learning_curves import read_scalars
from legged.evaluation.velocity_grid import Grid
from legged.evaluation.velocity_tracking import estimation_errors, measure_tracking
from legged.graph.step_graph import ForbidHostReads
from legged.learning.captured import CapturedRunner
from legged.learning.checkpoint import check_fits, read_checkpoint
from legged.learning.estimator import EstimatingModel, EstimationErrors
from legged.learning.ppo import DevicePPO
from legged.learning.rollout import Rollout
from legged.learning.runner import Runner
from legged.mdp.observations import ObservationGroup, ObservationTerms
from legged.policies.actor import Actor
from legged.policies.export import export

pytestmark = pytest.mark.usefixtures("workplace")

TARGETS = ("train.policy.estimator.targets", ["base_lin_vel"])
BLIND = ("observations.groups.actor.terms", ["base_ang_vel", "projected_gravity", "dof_pos", "dof_vel", "actions"])
SMALL = [TARGETS, BLIND, ("train.policy.estimator.hidden_dims", [16])]
BASE = ["--task", TASK, "--sim_device", "cpu"]
KNOWN = torch.arange(21.0).view(7, 3) / 20.0 - 0.5
"""What the made-up robots are to estimate from their seven observations: three numbers, by this matrix."""


def observe() -> TensorDict:
    seen = torch.randn(ROBOTS, 7)
    groups = {"actor": seen, "critic": torch.randn(ROBOTS, 9), "truth": seen @ KNOWN}
    return TensorDict(groups, batch_size=[ROBOTS])


def errors() -> EstimationErrors:
    """Of three numbers of one term, which is scaled by 2."""
    return EstimationErrors(ObservationGroup(ObservationTerms({"v": lambda: torch.zeros(2, 3)}), ["v"], {"v": 2.0}, {}, 9.0))


def model(latent=0, policy_gradient=False) -> EstimatingModel:
    groups = {"actor": ["actor"], "critic": ["critic"], "estimator": ["truth"]}
    gaussian = {"class_name": "GaussianDistribution", "init_std": 0.5, "std_type": "scalar"}
    sizes = {"hidden_dims": [16], "activation": "elu", "obs_normalization": False, "distribution_cfg": gaussian}
    return EstimatingModel(
        observe(), groups, "actor", 3, **sizes, estimator_hidden_dims=[32], latent=latent, policy_gradient=policy_gradient
    )


def learner(rate=1e-3, **options) -> DevicePPO:
    """A learner on made-up data with an estimator."""
    torch.manual_seed(0)
    given = {name: options.pop(name) for name in ("latent", "policy_gradient") if name in options}
    critic = MLPModel(observe(), {"critic": ["critic"]}, "critic", 1, [16], "elu")
    storage = RolloutStorage("rl", ROBOTS, STEPS, observe(), [3], "cpu")
    alg = DevicePPO(model(**given), critic, storage, device="cpu", **{**LEARNING, **options})
    alg.learn_to_estimate(errors(), rate)
    return alg


def fill(alg, seed=0) -> None:
    """A rollout of noise through rsl-rl's own functions."""
    torch.manual_seed(seed)
    with torch.inference_mode():
        for _ in range(STEPS):
            alg.act(observe())
            alg.process_env_step(observe(), torch.randn(ROBOTS), torch.rand(ROBOTS) < 0.1, {})
        alg.compute_returns(observe())


# ---- what trains it --------------------------------------------------------------------------------------------------


def gradients(made: EstimatingModel) -> list[torch.Tensor | None]:
    """How the estimator's parameters change the actions."""
    made.train()
    actions = made.mlp(made.get_latent(observe()))
    loss = (actions * torch.randn_like(actions)).sum()
    return list(torch.autograd.grad(loss, list(made.estimator.parameters()), allow_unused=True))


def test_the_policy_s_gradient_does_not_reach_the_estimates():
    assert gradients(model()) == [None] * 4


def test_it_does_reach_the_latent():
    """The last layer's rows of the latent and the hidden layer; the rows of the estimates stay where they are."""
    hidden, _, weight, bias = gradients(model(latent=5))
    assert hidden.abs().max() > 0.0
    assert weight.shape == (8, 32)
    last = torch.cat([weight, bias.unsqueeze(1)], dim=1)
    assert bool((last[:3] == 0.0).all())
    assert bool((last[3:].abs().sum(dim=1) > 0.0).all())


def test_it_reaches_the_estimates_if_that_is_wanted():
    *_, bias = gradients(model(policy_gradient=True))
    assert bool((bias != 0.0).all())


@pytest.mark.parametrize("symmetric", [False, True])
def test_an_update_s_gradient_of_the_estimator_is_that_of_the_squared_error(symmetric):
    """Whatever the advantages are; and the policy's gradient knows nothing of the targets."""
    mirror = {"env": None, "data_augmentation_func": twice, "use_data_augmentation": True}
    alg = learner(max_grad_norm=1e9, **({"symmetry_cfg": mirror} if symmetric else {}))
    fill(alg)
    ((_, batch),) = alg._mini_batches()[0]
    before, policy = copy.deepcopy(alg.actor), []
    for targets in (batch[-1], batch[-1] + 1.0):
        alg.actor.load_state_dict(before.state_dict())
        alg._step([(1.0, [*batch[:-1], targets])])
        found = before.estimator(batch[0])
        wanted = torch.autograd.grad((found - targets).square().mean(), list(before.estimator.parameters()))
        for parameter, gradient in zip(alg.actor.estimator.parameters(), wanted, strict=True):
            torch.testing.assert_close(parameter.grad, gradient, rtol=1e-4, atol=1e-6)
        policy.append([parameter.grad.clone() for parameter in alg.actor.mlp.parameters()])
    for one, other in zip(*policy, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0)


def twice(env, obs, actions):
    """A mirror that changes nothing."""
    seen = None if obs is None else TensorDict({k: torch.cat([v, v]) for k, v in obs.items()}, batch_size=[2 * len(obs)])
    return seen, None if actions is None else torch.cat([actions, actions])


@pytest.mark.slow
def test_estimates_come_to_be_a_known_linear_map():
    """Errors are stated in the unit of the term, which is scaled by 2; what is not estimated learns on beside it."""
    alg = learner(rate=3e-3, latent=2)
    found = []
    for seed in range(60):
        fill(alg, seed)
        found.append(alg.update()["Estimator/v_rmse"])
    assert found[0] > 0.2
    assert found[-1] < 0.03
    fresh = observe()
    with torch.no_grad():
        square = (alg.actor.estimate(fresh) - fresh["truth"]).square().mean()
    assert 0.5 * float(square.sqrt()) == pytest.approx(found[-1], rel=0.5)


def test_its_learning_rate_does_not_adapt_and_is_saved():
    alg = learner(rate=2.5e-3)
    fill(alg)
    alg.update()
    saved = alg.save()
    rates = [group["lr"] for group in saved["optimizer_state_dict"]["param_groups"]]
    assert rates == [pytest.approx(alg.learning_rate), 2.5e-3]
    assert alg.learning_rate != pytest.approx(1e-3)
    other = learner(rate=4e-3)  # a configuration may ask for another rate when a run is resumed
    other.load(saved, None, True)
    assert other.learning_rate == pytest.approx(alg.learning_rate)
    assert other.optimizer.param_groups[1]["lr"] == 4e-3


# ---- in a task -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_targets_are_mirrored_with_the_observations_they_are_estimated_from():
    """To the left becomes to the right; nothing in the iteration reads on the host."""
    task = small_task(*SMALL, ("train.algorithm.symmetry", True), ("train.runner.num_steps_per_env", 8), num_envs=6)
    runner = CapturedRunner(task, None, "cpu")
    rollout = Rollout(task, runner.alg)
    with ForbidHostReads():
        rollout.collect()
        runner.alg.learn()
    ((_, (seen, *_, targets)),) = runner.alg._mini_batches()[0]
    n = len(targets) // 2
    assert targets.shape[1] == 3
    assert float(targets[:, 1].abs().max()) > 0.01
    torch.testing.assert_close(targets[n:], targets[:n] * torch.tensor([1.0, -1.0, 1.0]), rtol=0, atol=0)
    columns, signs = task.mirror_images().groups["actor"]
    torch.testing.assert_close(seen[n:], seen[:n][:, columns] * signs, rtol=0, atol=0)


def test_targets_are_what_the_simulator_knew_when_the_robots_saw_what_they_did():
    """Twice the base's velocity, without noise, beside the observation of the same step."""
    task = small_task(*SMALL, ("observations.add_noise", True), ("train.runner.num_steps_per_env", 3), num_envs=4)
    runner = CapturedRunner(task, None, "cpu")
    wanted = []
    step = task.step_in_place
    task.step_in_place = lambda actions: (wanted.append(2.0 * task.base_lin_vel.clone()), step(actions))
    Rollout(task, runner.alg).collect()
    torch.testing.assert_close(runner.alg.storage.observations["estimated"], torch.stack(wanted), rtol=0, atol=0)


@pytest.mark.slow
def test_the_error_is_logged_and_printed_in_the_unit_of_the_term(capsys):
    """Of an estimator that gives 0 and does not learn it is the root mean square velocity of the samples."""
    task = small_task(*SMALL, ("train.policy.estimator.learning_rate", 1e-12), num_envs=4)
    runner = CapturedRunner(task, None, "cpu")
    with torch.no_grad():
        for parameter in runner.alg.actor.estimator.parameters():
            parameter.zero_()
    Rollout(task, runner.alg).collect()
    found = runner.alg.update()["Estimator/base_lin_vel_rmse"]
    velocity = runner.alg.storage.observations["estimated"] / 2.0
    assert found == pytest.approx(float(velocity.square().mean().sqrt()), rel=1e-4)

    wanted = ["train.policy.estimator.targets=[base_lin_vel]", "train.policy.estimator.hidden_dims=[8]"]
    assert call(train.main, [*BASE, "--num_envs", "8", "--max_iterations", "2", *TINY_TRAINING, *wanted]) == 0
    scalars = read_scalars(run_folders()[0])
    steps, found = scalars["Estimator/base_lin_vel_rmse"]
    assert len(steps) == len(found) == 2
    assert not [name for name in scalars if name.startswith("Loss/Estimator")]
    assert f"estimated base lin vel rmse {found[-1]:.3f}" in capsys.readouterr().out


@pytest.mark.slow
def test_errors_are_taken_in_where_nothing_is_written_too():
    """As in all processes but the first, whose iterations go on after the one that has an error to tell."""
    runner = CapturedRunner(small_task(*SMALL, ("train.runner.num_steps_per_env", 4), num_envs=4), None, "cpu")
    runner.learn(3)
    assert 0.0 < runner.logger.latest["Estimator/base_lin_vel_rmse"] < 1.0


@pytest.mark.slow
def test_it_is_evaluated_in_the_unit_of_the_term():
    """Velocities of 0.3 m/s forward and 0.4 to the left, of which a policy that estimates 0 knows nothing; the robot that is
    not counted moves faster. Six numbers: the root of (0.09 + 0.16) / 6.
    """
    runner = Runner(small_task(*SMALL, num_envs=3))
    with torch.no_grad():
        for parameter in runner.alg.actor.estimator.parameters():
            parameter.zero_()
    observations = runner.env.get_observations()
    observations["estimated"] = 2.0 * torch.tensor([[0.3, 0.0, 0.0], [0.0, 0.4, 0.0], [5.0, 5.0, 5.0]])
    errors, counted = EstimationErrors(runner.env.observation_groups["estimated"]), torch.tensor([1.0, 1.0, 0.0])
    with torch.no_grad():
        squares = errors.squares(runner.alg.actor.estimate(observations), observations["estimated"]) * counted[:, None]
    found = estimation_errors(type(runner.env), errors.names, squares, counted)
    assert found == {"base_lin_vel": {"rmse": pytest.approx((0.25 / 6.0) ** 0.5), "unit": "m/s"}}
    none = estimation_errors(type(runner.env), errors.names, 0.0 * squares, 0.0 * counted)
    assert none == {"base_lin_vel": {"rmse": None, "unit": "m/s"}}


@pytest.mark.slow
def test_an_evaluation_on_the_grid_holds_its_errors():
    grid = Grid([0.5], [0.0], [0.0], robots=2, hold_s=0.1, settle_s=0.04)
    task, other = small_task(*SMALL, num_envs=2), small_task(num_envs=2)
    estimates = measure_tracking(task, Actor(task, "cpu"), grid)["estimates"]
    assert estimates.keys() == {"base_lin_vel"}
    assert estimates["base_lin_vel"]["rmse"] > 0.0
    assert "estimates" not in measure_tracking(other, Actor(other, "cpu"), grid)


# ---- files -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_two_and_two_iterations_are_four():
    """Weights and moments of policy, value function and estimator, bit by bit."""
    flags = [f"{TARGETS[0]}=[base_lin_vel]", "train.policy.estimator.latent=2", "train.policy.obs_normalization=true"]
    four, two = (tiny_run(*flags, iterations=count) for count in (4, 2))
    rest = tiny_run("--resume", "--load_run", str(two), iterations=4)
    wanted, found = content(four, 3), content(rest, 3)
    assert any(name.startswith("estimator.") for name in wanted["actor_state_dict"])
    for part in ("actor_state_dict", "critic_state_dict", "optimizer_state_dict"):
        assert same(found[part], wanted[part]), part


@pytest.mark.slow
def test_a_transferred_estimator_learns_at_the_rate_of_the_configuration(tmp_path):
    """PPO's rate goes on where it was; the estimator's is not PPO's."""
    first = CapturedRunner(small_task(*SMALL, num_envs=2))
    first.alg.learning_rate = 3e-4
    first.save(str(tmp_path / "model_0.pt"))
    runner = CapturedRunner(small_task(*SMALL, ("train.policy.estimator.learning_rate", 4e-3), num_envs=2))
    runner.transfer(str(tmp_path / "model_0.pt"))
    assert runner.alg.learning_rate == pytest.approx(3e-4)
    assert runner.alg.optimizer.param_groups[1]["lr"] == 4e-3


def test_the_exported_file_holds_the_estimator_and_says_what_it_estimates(tmp_path):
    """The estimate inside the ONNX file is torch's, of observations that are normalised."""
    normalised = ("train.policy.obs_normalization", True)
    runner = Runner(small_task(*SMALL, normalised, ("train.policy.estimator.latent", 2), num_envs=4))
    network = runner.alg.get_policy()
    network.train()
    network.update_normalization(runner.env.get_observations().apply(lambda x: torch.randn_like(x) * 3.0 + 1.0))
    export(runner.env, network, tmp_path)
    graph = onnx.load(str(tmp_path / "policy.onnx"))
    last = [node.output[0] for node in graph.graph.node if "estimator" in node.name and node.op_type == "Gemm"][-1]
    graph.graph.output.append(onnx.helper.make_tensor_value_info(last, onnx.TensorProto.FLOAT, None))
    session = onnxruntime.InferenceSession(graph.SerializeToString(), providers=["CPUExecutionProvider"])
    seen = runner.env.get_observations().apply(torch.randn_like)
    actions, found = session.run(None, {"obs": seen["actor"].numpy()})
    with torch.no_grad():
        wanted = network.estimate(seen).numpy()
        np.testing.assert_allclose(actions, network.eval()(seen).numpy(), rtol=0, atol=1e-5)
    assert found.shape == (4, 5)
    assert np.abs(wanted).max() > 0.01
    np.testing.assert_allclose(found[:, :3], wanted, rtol=0, atol=1e-5)
    said = json.loads((tmp_path / "policy.json").read_text())
    target = {"name": "base_lin_vel", "size": 3, "scale": [2.0, 2.0, 2.0], "unit": "m/s"}
    assert said["estimator"] == {"targets": [target], "latent": 2}
    assert "base_lin_vel" not in [term["name"] for term in said["observation"]]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "text"),
    [
        (
            [("train.policy.estimator.hidden_dims", [9])],
            r"estimator\.hidden_dims \[16\].*train\.policy\.estimator\.hidden_dims",
        ),
        ([("train.policy.estimator.targets", [])], r"estimator\.hidden_dims \[16\], the configuration has .* \[\]"),
        ([("train.policy.estimator.latent", 3)], r"estimator\.latent 0, the configuration has .*latent 3"),
        ([("train.policy.estimator.targets", ["projected_gravity"])], r"its actor has estimator\.targets \['base_lin_vel'\]"),
    ],
)
def test_a_checkpoint_of_another_estimator_is_refused(changes, text, tmp_path):
    path = tmp_path / "model_0.pt"
    Runner(small_task(*SMALL)).save(str(path))
    saved = read_checkpoint(path)
    check_fits(path, saved, small_config(*SMALL))
    with pytest.raises(ConfigError, match=text):
        check_fits(path, saved, small_config(*SMALL, *changes))


def test_a_checkpoint_that_estimates_nothing_is_refused(tmp_path):
    path = tmp_path / "model_0.pt"
    Runner(small_task(BLIND)).save(str(path))
    saved = read_checkpoint(path)
    check_fits(path, saved, small_config(BLIND))
    with pytest.raises(ConfigError, match=r"its actor has estimator\.hidden_dims \[\], the configuration has .* \[16\]"):
        check_fits(path, saved, small_config(*SMALL))


# ---- what cannot be --------------------------------------------------------------------------------------------------

ESTIMATOR = "train.policy.estimator"
LINEAR = f"{ESTIMATOR}.targets=[base_lin_vel]"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ([f"{ESTIMATOR}.targets=[base_lin_vle]"], f"{ESTIMATOR}.targets: LeggedRobot has no observation 'base_lin_vle'; did"),
        (
            [f"{ESTIMATOR}.targets=[rand_joint_damping]"],
            f"{ESTIMATOR}.targets: rand_joint_damping: domain_rand.ranges does not draw",
        ),
        ([f"{ESTIMATOR}.targets=[passive_pos]"], f"{ESTIMATOR}.targets: passive_pos: 'anymal_c' has no passive hinges"),
        ([f"{ESTIMATOR}.target=[base_lin_vel]"], f"{ESTIMATOR}.target: unknown key 'target'; did you mean 'targets'?"),
        ([f"{ESTIMATOR}.latent=4"], f"{ESTIMATOR}.latent: must be 0 without an estimator"),
        ([LINEAR, "observations.groups.estimated.terms=[dof_pos]"], "'estimated' is the group of the estimator's targets"),
        ([LINEAR, "train.runner.loop=stock"], "train.runner.loop: must be captured with an estimator"),
        ([LINEAR, "train.policy.state_dependent_std=true"], "state_dependent_std: must be false with an estimator"),
        ([LINEAR, "train.policy.rnn_type=gru", "train.algorithm.symmetry=false"], "rnn_type: must be none with an estimator"),
        ([LINEAR, "train.algorithm.mirror_loss_coeff=0.5"], "mirror_loss_coeff: must be 0 with an estimator"),
        ([LINEAR, "train.algorithm.optimizer=sgd"], "train.algorithm.optimizer: must be adam with an estimator"),
    ],
)
def test_estimators_that_cannot_be_are_refused_at_start_up(changes, words, capsys):
    assert call(train.main, [*BASE, "--num_envs", "2", "--max_iterations", "1", *changes]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert words in error, error
