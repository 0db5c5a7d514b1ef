"""Distillation on made-up data: it computes what rsl-rl's does, and a student comes to do what its teacher does."""

import pytest
import torch
from devices import on_both
from learners import ROBOTS, STEPS, observe
from rsl_rl.algorithms import Distillation
from rsl_rl.models import MLPModel, RNNModel
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict

from legged.graph.step_graph import ForbidHostReads
from legged.learning.distillation import DeviceDistillation

GROUPS = {"student": ["actor"], "teacher": ["critic"]}
GAUSSIAN = {"class_name": "GaussianDistribution", "init_std": 0.1}
ACTIONS = 3
RNN = {"rnn_hidden_dim": 5, "rnn_num_layers": 2}
VARIANTS = {
    "plain": {},
    "huber": {"loss_type": "huber"},
    "normalised": {"normalized": True},
    "tight clip": {"max_grad_norm": 0.01},
    "one gradient": {"gradient_length": STEPS},
    "mixed precision": {"use_mixed_precision": True},
    "lstm": {"rnn_type": "lstm"},
    "gru": {"rnn_type": "gru", "normalized": True},
}


def distiller(kind, normalized=False, rnn_type="", device="cpu", groups=GROUPS, **options):
    """A learner with weights that depend on nothing else; all of it is drawn on the CPU."""
    torch.manual_seed(0)
    layers = {"obs_normalization": normalized, "hidden_dims": [16], "distribution_cfg": GAUSSIAN}
    model, more = (RNNModel, {"rnn_type": rnn_type, **RNN}) if rnn_type else (MLPModel, {})
    student = model(observe(), groups, "student", ACTIONS, **layers, **more)
    teacher = MLPModel(observe(), groups, "teacher", ACTIONS, hidden_dims=[16], distribution_cfg=GAUSSIAN)
    storage = RolloutStorage("distillation", ROBOTS, STEPS, observe(device), [ACTIONS], device)
    settings = {"gradient_length": 4, "num_learning_epochs": 2, "max_grad_norm": 1.0, **options}
    return kind(student.to(device), teacher.to(device), storage, device=device, **settings)


def fill(alg, seed: int) -> None:
    """A rollout of noise through rsl-rl's own functions."""
    torch.manual_seed(seed)
    with torch.inference_mode():
        for _ in range(STEPS):
            alg.act(observe(alg.device))
            ends = torch.rand(ROBOTS).to(alg.device) < 0.1
            alg.process_env_step(observe(alg.device), torch.zeros_like(ends, dtype=torch.float), ends, {})


def exact_or_on_the_cpu(case) -> bool:
    """Whether numbers can be compared: on a GPU, what is rounded to bfloat16 depends on the order of sums."""
    device, options = case.values
    return device == "cpu" or "use_mixed_precision" not in options


@pytest.mark.slow
@pytest.mark.usefixtures("full_precision")
@pytest.mark.parametrize(("device", "options"), filter(exact_or_on_the_cpu, on_both(VARIANTS)))
def test_an_update_is_that_of_rsl_rl(device, options):
    """Losses, weights and moments over three updates on the same rollouts, in which episodes end."""
    stock, ours = distiller(Distillation, device=device, **options), distiller(DeviceDistillation, device=device, **options)
    assert ours.why_stock == ""
    rounded = 20.0 if options.get("use_mixed_precision") else 1.0  # what is rounded depends on the size of a batch
    for seed in range(3):
        fill(stock, seed)
        wanted = stock.update()
        # Only what is learned from is compared here: of the rollout, actions depend on the student's noise.
        for name in ("observations", "privileged_actions", "dones"):
            getattr(ours.storage, name).copy_(getattr(stock.storage, name))
        for before, now in zip(ours.memory_before, ours.memory.parts, strict=True):
            before.copy_(now)
        assert ours.update() == pytest.approx(wanted, rel=rounded * 1e-4, abs=1e-6)
    for name, tensor in stock.student.state_dict().items():
        torch.testing.assert_close(ours.student.state_dict()[name], tensor, rtol=1e-3, atol=rounded * 2e-5, msg=name)
    hidden = stock.student.get_hidden_state()
    for mine, theirs in zip(ours.memory.parts, hidden if isinstance(hidden, tuple) else [hidden], strict=False):
        torch.testing.assert_close(mine, theirs, rtol=1e-3, atol=2e-5)
    assert len(ours.memory.parts) == {"lstm": 2, "gru": 1}.get(options.get("rnn_type"), 0)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["", "lstm", "gru"])
def test_an_update_waits_for_no_device(kind):
    alg = distiller(DeviceDistillation, rnn_type=kind)
    fill(alg, 0)
    alg.learn()  # the moments come to be
    with ForbidHostReads(torch.device("cpu")):
        alg.learn()
    assert alg.losses()["behavior"] > 0.0


@pytest.mark.slow
def test_a_student_recovers_a_linear_teacher():
    """The teacher is a fixed linear map of what the student sees too; a student of one layer finds its numbers."""
    torch.manual_seed(0)
    see = {"student": ["actor"], "teacher": ["actor"]}
    models = [MLPModel(observe(), see, name, ACTIONS, [1], distribution_cfg=GAUSSIAN) for name in see]
    for model in models:
        model.mlp = torch.nn.Sequential(torch.nn.Linear(7, ACTIONS))
    storage = RolloutStorage("distillation", ROBOTS, STEPS, observe(), [ACTIONS])
    alg = DeviceDistillation(*models, storage, gradient_length=STEPS, num_learning_epochs=20, learning_rate=0.02)
    wanted = torch.arange(21.0).view(ACTIONS, 7) / 10.0 - 1.0
    offset = torch.tensor([0.5, 0.0, -0.5])
    alg.teacher.mlp.load_state_dict({"0.weight": wanted, "0.bias": offset})
    losses = []
    for seed in range(15):
        fill(alg, seed)
        losses.append(alg.update()["behavior"])
    torch.testing.assert_close(alg.student.mlp[0].weight, wanted, atol=0.02, rtol=0.0)
    torch.testing.assert_close(alg.student.mlp[0].bias, offset, atol=0.02, rtol=0.0)
    assert losses[-1] < 1e-3 * losses[0]


def test_the_noise_of_a_student_is_not_learned_and_the_teacher_stays():
    alg = distiller(DeviceDistillation)
    before = {name: tensor.clone() for name, tensor in alg.teacher.state_dict().items()}
    std = alg.action_std().clone()
    fill(alg, 0)
    alg.update()
    assert torch.equal(alg.action_std(), std)
    assert all(torch.equal(before[name], tensor) for name, tensor in alg.teacher.state_dict().items())


def gradient_of_first_step(length: int) -> torch.Tensor:
    """How the loss of the last of eight steps depends on what a recurrent student saw at the first one."""
    alg = distiller(DeviceDistillation, rnn_type="gru", gradient_length=length)
    seen = torch.randn(STEPS, ROBOTS, 7, requires_grad=True)
    alg.storage.dones.zero_()
    with torch.no_grad():
        alg.storage.privileged_actions.zero_()
    taken = []
    alg._descend = lambda loss: taken.append(torch.autograd.grad(loss, seen, retain_graph=True)[0])  # type: ignore[method-assign]
    alg._epoch_with_memory(seen)
    assert len(taken) == STEPS // length
    return taken[-1][0]


def test_the_gradient_of_a_recurrent_student_goes_back_as_far_as_it_is_told():
    assert float(gradient_of_first_step(STEPS).abs().max()) > 0.0
    assert float(gradient_of_first_step(STEPS // 2).abs().max()) == 0.0


def test_nothing_goes_back_over_the_end_of_an_episode():
    """A robot whose episode ended after the first step forgets: what it saw then changes nothing of what it does later."""
    alg = distiller(DeviceDistillation, rnn_type="lstm", gradient_length=STEPS)
    seen = torch.randn(STEPS, ROBOTS, 7, requires_grad=True)
    alg.storage.dones.zero_()
    alg.storage.dones[0, : ROBOTS // 2] = 1
    first = torch.zeros(STEPS, ROBOTS, ACTIONS)
    later = []
    alg.loss_fn = lambda actions, _: later.append(actions) or (actions - first[0]).square().mean()
    alg._descend = lambda _: None  # type: ignore[method-assign]
    alg._epoch_with_memory(seen)
    (gradient,) = torch.autograd.grad(torch.stack(later[1:]).sum(), seen)
    assert float(gradient[0, : ROBOTS // 2].abs().max()) == 0.0
    assert float(gradient[0, ROBOTS // 2 :].abs().min(dim=1).values.max()) > 0.0


def test_a_gradient_that_is_no_number_changes_nothing():
    alg = distiller(DeviceDistillation, gradient_length=STEPS, num_learning_epochs=1)
    fill(alg, 0)
    alg.storage.privileged_actions[2, 3, 1] = torch.nan
    before = {name: tensor.clone() for name, tensor in alg.student.state_dict().items()}
    losses = alg.update()
    assert alg.left_out == 1.0
    assert losses["behavior"] != losses["behavior"]
    assert all(torch.equal(before[name], tensor) for name, tensor in alg.student.state_dict().items())


def test_observations_of_the_teacher_are_not_seen_by_the_student():
    """The label follows from the teacher's group alone, the student's action from its own."""
    alg = distiller(DeviceDistillation, use_mixed_precision=False)
    seen = observe()
    changed = TensorDict({"actor": seen["actor"], "critic": seen["critic"] + 1.0}, batch_size=[ROBOTS])
    with torch.no_grad():
        assert torch.equal(alg.student(seen), alg.student(changed))
        assert not torch.equal(alg.teacher(seen), alg.teacher(changed))
