"""Training on a GPU: rollout and update are one graph each, which compute what runs without graphs do; and what comes of it
is used on the CPU.
"""

import contextlib
import io
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from devices import CUDA
from helpers import CALM, TASK, checkpoints, run_folders
from tensordict import TensorDict

from legged.cli.train import train
from legged.envs import LeggedRobot
from legged.evaluation.learning_curves import read_scalars
from legged.graph.step_graph import StepGraph
from legged.learning.captured import CapturedRunner
from legged.learning.checkpoint import read_checkpoint
from legged.learning.rollout import Rollout, Steps
from legged.learning.run_folder import run_config
from legged.policies.export import export
from legged.policies.restore import TrainedPolicy, restore
from legged.registry import task_config

pytestmark = [pytest.mark.gpu, pytest.mark.usefixtures("workplace", "full_precision")]

ROBOTS, STEPS = 64, 8
SHORT = [("env.num_envs", ROBOTS), ("train.runner.num_steps_per_env", STEPS), ("train.runner.matmul", "float32")]
CPU = torch.device("cpu")


def trained(*arguments: str, task: str = TASK, iterations: int = 3, device: str = CUDA) -> tuple[Path, str]:
    """Train for a moment in the test's own folder: the new run folder, and what was printed."""
    before = set(run_folders())
    flags = ["--task", task, "--sim_device", device, "--num_envs", str(ROBOTS), "--max_iterations", str(iterations)]
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(out):
        code = train.main([*flags, "train.runner.report=false", f"train.runner.num_steps_per_env={STEPS}", *arguments])
    assert code == 0, out.getvalue()
    (folder,) = set(run_folders()) - before
    return folder, out.getvalue()


@pytest.fixture
def graphs(monkeypatch) -> list[StepGraph]:
    """Those of the trainings to come: for each the rollout's and the update's, and that of the value function alone if there
    is one.
    """
    made: list[StepGraph] = []
    capture = CapturedRunner._capture

    def note(runner: CapturedRunner, rollout: Steps, warms_up: bool) -> tuple[StepGraph, ...]:
        found = capture(runner, rollout, warms_up)
        made.extend(dict.fromkeys(found))
        return found

    monkeypatch.setattr(CapturedRunner, "_capture", note)
    return made


def weights(folder: Path, iteration: int) -> torch.Tensor:
    """All parameters of a checkpoint's actor and critic in one vector, on the CPU."""
    saved = read_checkpoint(folder / f"model_{iteration}.pt")
    states = (saved["actor_state_dict"], saved["critic_state_dict"])
    return torch.cat([tensor.flatten().float() for state in states for tensor in state.values()])


@pytest.mark.parametrize(
    ("task", "iterations"),
    [(TASK, 4), ("half_cheetah", 2), ("humanoid", 2), ("anymal_c_estimator", 2)],
    ids=[TASK, "half_cheetah", "humanoid", "anymal_c_estimator"],
)
def test_a_training_is_captured_and_its_weights_are_finite(task, iterations, graphs):
    folder, printed = trained(task=task, iterations=iterations)
    assert [graph.captured for graph in graphs] == [True, True]
    assert "rsl-rl's own training loop" not in printed
    assert "mujoco-warp's own launches" not in printed
    last = iterations - 1
    assert checkpoints(folder) == [0, last]
    first, final = weights(folder, 0), weights(folder, last)
    assert final.isfinite().all()
    assert (final != first).float().mean() > 0.9  # each update moved nearly all of them
    saved = torch.load(folder / f"model_{last}.pt", weights_only=True, map_location="cpu")
    cfg = run_config(folder).train.algorithm
    updates = iterations * cfg.num_learning_epochs * cfg.num_mini_batches
    assert {int(state["step"]) for state in saved["optimizer_state_dict"]["state"].values()} == {updates}


def test_a_value_function_warms_up_in_a_graph_of_its_own(graphs):
    """Two iterations of it, then two of both: the policy stays bit by bit, and its moments begin with its own first step."""
    warmup = ["train.algorithm.critic_warmup_iterations=2", "train.runner.save_interval=1"]
    folder, _ = trained(*warmup, iterations=4)
    assert [graph.captured for graph in graphs] == [True] * 3
    saved = [read_checkpoint(folder / f"model_{iteration}.pt") for iteration in range(4)]
    policies = [torch.cat([tensor.flatten() for tensor in one["actor_state_dict"].values()]) for one in saved]
    critics = [one["critic_state_dict"]["mlp.0.weight"] for one in saved]
    assert policies[0].equal(policies[1])
    for before, after in ((policies[1], policies[2]), (policies[2], policies[3]), *pairwise(critics)):
        assert after.isfinite().all()
        assert not before.equal(after)
    cfg = run_config(folder).train.algorithm
    updates = cfg.num_learning_epochs * cfg.num_mini_batches
    moments = saved[-1]["optimizer_state_dict"]["state"]
    of_policy = len(saved[0]["actor_state_dict"])
    assert {int(moments[i]["step"]) for i in range(of_policy)} == {2 * updates}
    assert {int(moments[i]["step"]) for i in range(of_policy, len(moments))} == {4 * updates}


@pytest.mark.parametrize("recurrent", [False, True], ids=["feedforward", "recurrent"])
def test_a_student_is_trained_in_graphs(recurrent, graphs):
    """Of a recurrent one the rollout alone is a graph."""
    memory = ["train.policy.rnn_type=lstm", "train.policy.rnn_hidden_dim=16"] if recurrent else []
    student = ["train.algorithm.class_name=Distillation", "--teacher", TASK, *memory]
    folder, printed = trained(*student, iterations=4)
    assert [graph.captured for graph in graphs] == [True, not recurrent]
    assert "rsl-rl's own training loop" not in printed
    first, last = (read_checkpoint(folder / f"model_{i}.pt")["actor_state_dict"]["mlp.0.weight"] for i in (0, 3))
    assert last.isfinite().all()
    assert (last != first).float().mean() > 0.9
    losses = read_scalars(folder)["Loss/behavior"][1]
    assert losses[-1] < losses[0]


class InTheAir(LeggedRobot):
    """Robots far above the ground, where no contacts come in another order each time."""

    def _init_buffers(self) -> None:
        super()._init_buffers()
        self._spawn = self.numbers.between([0.0, 0.0, 50.0], [0.0, 0.0, 50.0], 3)


def test_captured_iterations_are_the_eager_ones():
    """Two rollouts and updates under the same random numbers. The kernels are the same too; what is allowed is what another
    order of float32 sums would leave, which an update multiplies.
    """
    cfg = task_config(TASK, [*SHORT, ("env.episode_length_s", 0.1), ("sim.physics", "mujoco_warp")])
    tasks = [InTheAir(cfg, CUDA, graph=graph) for graph in (True, False)]
    assert [task.captured for task in tasks] == [True, False]
    found = []
    for task in tasks:
        torch.manual_seed(3)
        runner = CapturedRunner(task, None, CUDA)
        assert runner.why_stock == ""
        runner.alg.train_mode()
        collect, update, _ = runner._capture(Rollout(task, runner.alg), False)
        assert (collect.captured, update.captured) == (task.captured, task.captured)
        found.append((runner.alg, collect, update))
    tasks[0].load_state_dict(tasks[1].state_dict())
    storages = []
    for task, (alg, collect, _) in zip(tasks, found, strict=True):
        torch.manual_seed(7)
        task.reset()
        collect()
        storages.append(alg.storage)
    assert storages[1].dones.sum() >= ROBOTS
    for name in ("actions", "dones", "rewards", "values", "returns", "advantages", "actions_log_prob"):
        mine, theirs = (getattr(storage, name) for storage in storages)
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-4, msg=lambda text, name=name: f"{name}: {text}")
    for name in ("actor", "critic"):
        mine, theirs = (storage.observations[name] for storage in storages)
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-4, msg=lambda text, name=name: f"{name}: {text}")
    (ours, _, _), (eager, _, _) = found
    for number, allowed in enumerate((1e-4, 2e-2)):
        for _, collect, update in found:
            torch.manual_seed(20 + number)
            if number > 0:
                collect()
            update()
        assert ours.losses() == pytest.approx(eager.losses(), rel=allowed, abs=allowed), number
        for mine, theirs in zip(ours.tensors(), eager.tensors(), strict=True):
            torch.testing.assert_close(mine, theirs, rtol=100.0 * allowed, atol=allowed)
    assert ours.left_out == eager.left_out == 0.0


def test_what_was_trained_on_a_gpu_goes_on_on_the_cpu(graphs):
    """Its checkpoint acts there as here, is exported from either, and is trained further by the C engine."""
    sizes = [f"train.policy.{network}_hidden_dims=[32,16]" for network in ("actor", "critic")]
    folder, _ = trained(*sizes, "train.policy.obs_normalization=true", "train.runner.matmul=float32")
    assert [graph.captured for graph in graphs] == [True, True]
    policy = TrainedPolicy(run_config(folder), folder / "model_2.pt")
    calm = [*CALM, ("env.num_envs", 4)]
    task, here = restore(policy, calm, torch.device(CUDA))
    _, there = restore(policy, [*calm, ("sim.physics", "mujoco"), ("sim.threads", 1)], CPU)
    assert next(here.network.parameters()).is_cuda
    assert not next(there.network.parameters()).is_cuda
    groups = {name: torch.randn(4, group.buffer.shape[1]) for name, group in task.observation_groups.items()}
    observations = TensorDict(groups, batch_size=[4])
    with torch.inference_mode():
        by_gpu, by_cpu = here(observations.to(CUDA)).cpu(), there(observations)
    torch.testing.assert_close(by_gpu, by_cpu, rtol=1e-4, atol=1e-5)
    assert by_cpu.std() > 1e-3

    differences = export(task, here.network, Path("exported"))
    assert max(differences.values()) < 1e-5
    assert next(here.network.parameters()).is_cuda  # as it was
    script = torch.jit.load("exported/policy.pt")
    torch.testing.assert_close(script(observations["actor"]), by_cpu, rtol=1e-4, atol=1e-5)

    engine = ["sim.physics=mujoco", "sim.threads=1"]
    resumed, printed = trained(*engine, "--resume", "--load_run", str(folder), iterations=4, device="cpu")
    assert "after iteration 3; " in printed, printed
    assert weights(resumed, 3).isfinite().all()
    assert not torch.equal(weights(resumed, 3), weights(folder, 2))


def test_a_training_resumed_on_a_gpu_goes_on_where_it_was(graphs):
    """Robots, episodes and the GPU's random numbers; its graphs are captured anew."""
    folder, _ = trained(*(f"{path}={value}" for path, value in CALM), iterations=2)
    resumed, printed = trained("--resume", "--load_run", str(folder), iterations=3)
    assert "robots and random numbers go on where they were" in printed, printed
    assert [graph.captured for graph in graphs] == [True] * 4
    assert checkpoints(resumed) == [2]
    assert weights(resumed, 2).isfinite().all()
