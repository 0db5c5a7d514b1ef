"""The update's kernels compute what autograd does. Without a GPU they run in Triton's interpreter (conftest.py)."""

import math
from itertools import pairwise

import pytest
import torch
from learners import MIRROR, SAMPLES, fill, learner

from legged.learning.fused_update import why_not
from legged.learning.fused_update.layout import Layout
from legged.learning.ppo import DevicePPO

pytest.importorskip("triton")
from legged.learning.fused_update import kernels
from legged.learning.fused_update.network import Network, linear_layers

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
VARIANTS = {
    "plain": {},
    "normalised": {"normalized": True},
    "adaptive rate": {"schedule": "adaptive"},
    "free values": {"use_clipped_value_loss": False, "value_loss_coef": 0.5},
    "symmetry, normalised": {"symmetry_cfg": MIRROR, "normalized": True},
    "tight clips": {"clip_param": 0.05, "max_grad_norm": 0.1},
}


def both(kind=torch.float32, seed=0, change=lambda alg: None, **options):
    """Two learners with the same data: the one's updates by autograd, the other's by kernels with operands of type `kind`."""
    pair = [learner(DevicePPO, device=DEVICE, **{"schedule": "fixed", "num_learning_epochs": 1, **options}) for _ in range(2)]
    order = torch.randperm(SAMPLES, generator=torch.Generator().manual_seed(seed)).to(DEVICE)
    for alg in pair:
        fill(alg, seed)
        # Data of a slightly different policy: otherwise the divergence at the first mini-batch is 0 up to rounding, and its
        # sign decides on the adaptive rate.
        with torch.no_grad():
            for parameter in alg.actor.parameters():
                parameter.mul_(1.02)
        with torch.inference_mode():
            change(alg)
        alg._order = lambda _: order
    pair[1].use_kernels(kind)
    return pair


def parameters(alg):
    return torch.cat([p.detach().flatten() for model in (alg.actor, alg.critic) for p in model.parameters()])


def distance(pair, before):
    """How far both learners are apart, compared with what their update changed."""
    ours, theirs = parameters(pair[1]), parameters(pair[0])
    return float((ours - theirs).norm() / (theirs - before).norm())


@pytest.mark.slow
@pytest.mark.parametrize("options", VARIANTS.values(), ids=VARIANTS)
def test_an_update_is_that_of_autograd(options):
    pair = both(**options)
    before = parameters(pair[0])
    wanted, found = (alg.update() for alg in pair)
    assert distance(pair, before) < 1e-5
    assert found == pytest.approx(wanted, rel=1e-4, abs=1e-6)
    assert pair[1].learning_rate == pytest.approx(pair[0].learning_rate)
    for ours, theirs in zip(*(alg.optimizer.state_dict()["state"].values() for alg in reversed(pair)), strict=True):
        assert float(ours["step"]) == float(theirs["step"]) == 4.0
        torch.testing.assert_close(ours["exp_avg_sq"], theirs["exp_avg_sq"], rtol=1e-3, atol=1e-10)


def scaled(name, factor):
    def change(alg):
        getattr(alg.storage, name).mul_(factor)

    return change


def observed(factor):
    def change(alg):
        for group in alg.storage.observations.values():
            group[..., 0] *= factor

    return change


HARD = {
    "usual numbers": lambda alg: None,
    "returns of a few thousand": scaled("returns", 3e3),
    "tiny returns": lambda alg: [scaled(name, 1e-6)(alg) for name in ("returns", "values")],
    "observations of 1e4": observed(1e4),
    "tiny gradients": scaled("advantages", 1e-7),
    "large advantages": scaled("advantages", 1e6),
}


def gradients(pair):
    """Gradients of both learners by the whole rollout, for each parameter."""
    autograd, kernels = pair
    for alg in pair:
        alg.update()
    fused = kernels._fused
    views = fused.layout.views(
        fused.gradient, [linear_layers(model) for model in fused.models], kernels.actor.distribution.std_param
    )
    names = [(model, name) for model in ("actor", "critic") for name, _ in getattr(autograd, model).named_parameters()]
    for model, name in names:
        theirs, ours = (dict(getattr(alg, model).named_parameters())[name] for alg in pair)
        yield f"{model}.{name}", views[ours], theirs.grad


@pytest.mark.slow
@pytest.mark.parametrize("change", HARD.values(), ids=HARD)
def test_half_precision_holds_for_hard_numbers(change):
    """The gradients are those of float32 up to ten times the rounding of float16, 2^-11."""
    pair = both(torch.float16, change=change, max_grad_norm=1e30, entropy_coef=0.0, num_mini_batches=1)
    for name, ours, theirs in gradients(pair):
        assert float((ours - theirs).norm() / theirs.norm()) < 5e-3, name
    assert pair[1].left_out == 0.0


@pytest.mark.slow
def test_half_precision_holds_for_a_small_standard_deviation():
    """A mean action that is rounded by 2^-11 is 1 % of the deviation off."""

    def change(alg):
        alg.actor.distribution.std_param.fill_(0.05)
        alg.storage.clear()
        fill(alg, 3)

    pair = both(torch.float16, change=change, max_grad_norm=1e30, num_mini_batches=1)
    for name, ours, theirs in gradients(pair):
        assert float((ours - theirs).norm() / theirs.norm()) < 2e-2, name


@pytest.mark.slow
@pytest.mark.parametrize("name", ["observations", "advantages", "returns", "actions"])
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_mini_batch_with_a_bad_number_is_left_out(name, bad):
    """One sample of one mini-batch is bad. The others are learned from."""

    def change(alg):
        where = getattr(alg.storage, name)
        (where["actor"] if name == "observations" else where)[0, 0] = bad

    pair = both(change=change)
    before = parameters(pair[0])
    wanted, found = (alg.update() for alg in pair)
    assert [alg.left_out for alg in pair] == [0.25, 0.25]
    assert parameters(pair[1]).isfinite().all()
    assert distance(pair, before) < 1e-5
    assert found == pytest.approx(wanted, rel=1e-4, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    "widths", [(64, 128, 64, 32, 16), pytest.param((192, 512, 256, 128, 16), marks=pytest.mark.gpu)], ids=str
)
def test_layers_of_a_large_mini_batch(widths):
    """Gradients by weights and biases against float64. On a GPU each program makes many turns, and three repetitions must
    agree: an operand that is overwritten too early makes a few tiles wrong, by 4 % in all.
    """
    rows = 65_536 if DEVICE == "cuda" else 256
    torch.manual_seed(0)
    layers = [[torch.nn.Linear(*sizes) for sizes in pairwise(widths)] for _ in range(2)]
    layout = Layout(layers, actions=1)
    vector = torch.zeros(layout.size, device=DEVICE)
    for parameter, view in layout.views(vector, layers, torch.nn.Parameter(torch.zeros(1))).items():
        view.copy_(parameter.detach())
    network = Network(layout.networks[0], rows, 1, torch.float16, torch.device(DEVICE))
    network.inputs.normal_()
    shadow = vector.half()
    network.forward(0, shadow, vector)
    largest = network.by_outputs.normal_().abs().max()
    found = []
    for _ in range(3):
        gradient, squares = torch.zeros_like(vector), torch.zeros(len(network.parts), device=DEVICE)
        network.backward(0, shadow, largest)
        network.reduce(gradient, squares, largest, rows)
        found.append(gradient)
        assert float(squares.sum()) == pytest.approx(float(gradient.square().sum()), rel=1e-4)
    assert torch.equal(found[0], found[1])
    assert torch.equal(found[0], found[2])
    factor = 2.0 ** (4 - math.floor(math.log2(float(largest))))
    h = [network.inputs[0], *network.outputs]
    for i, layer in enumerate(network.layers):
        weight, bias = layout.view(found[0], layer)
        d = network.gradients[i].double() / factor
        for ours, theirs in ((weight, d.T @ h[i].double()), (bias, d.sum(dim=0))):
            assert float((ours * rows - theirs).norm() / theirs.norm()) < 1e-3


@pytest.mark.slow
def test_the_value_function_learns_alone():
    pair = both(num_learning_epochs=2)
    actor = [p.detach().clone() for p in pair[1].actor.parameters()]
    before = parameters(pair[0])
    for alg in pair:
        alg.warmup_left = 1
        alg.update()
    assert all(torch.equal(p, q) for p, q in zip(pair[1].actor.parameters(), actor, strict=True))
    assert distance(pair, before) < 1e-5
    for alg in pair:
        fill(alg, 1)
        alg.update()
    assert distance(pair, before) < 1e-5
    steps = [float(state["step"]) for state in pair[1].optimizer.state.values()]
    assert steps == [8.0] * 7 + [16.0] * 6


@pytest.mark.slow
def test_processes_with_equal_gradients_learn_like_one(monkeypatch):
    """The average over two processes replaces the gradient, the sums of losses, and the squares for clipping."""
    pair = both(num_learning_epochs=1)
    before = parameters(pair[0])
    alg = pair[1]
    alg.is_multi_gpu, alg.gpu_world_size = True, 2
    monkeypatch.setattr(torch.distributed, "all_reduce", lambda gradient: gradient.mul_(2.0))
    wanted, found = (alg.update() for alg in pair)
    assert distance(pair, before) < 1e-5
    assert found == pytest.approx(wanted, rel=1e-4, abs=1e-6)


def test_networks_are_broadcast_to_all_processes(monkeypatch):
    """NCCL refuses tensors that are not contiguous, such as the padded weights of the kernels."""
    alg = both()[1]
    before = parameters(alg)

    def broadcast(tensor, src):
        assert tensor.is_contiguous()
        tensor.mul_(2.0)

    monkeypatch.setattr(torch.distributed, "broadcast", broadcast)
    alg.broadcast_parameters()
    torch.testing.assert_close(parameters(alg), 2.0 * before, rtol=0.0, atol=0.0)


@pytest.mark.slow
def test_checkpoints_are_exchanged():
    """Kernels go on where autograd stopped, and the other way round."""
    found = []
    for first, second in ((0, 1), (1, 0), (0, 0)):
        start, end = both()[first], both()[second]
        start.update()
        saved = start.save()
        assert all(tensor.is_contiguous() for tensor in saved["actor_state_dict"].values())
        end.storage.clear()
        fill(end, 1)
        end.load(saved, None, True)
        end.update()
        found.append(parameters(end))
    torch.testing.assert_close(found[0], found[2], rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(found[1], found[2], rtol=1e-4, atol=1e-6)


def test_without_a_compiler_torch_learns(monkeypatch):
    """Triton fails at the last kernel of the trial step; the learner is as it was."""
    alg, other = both()[0], both()[0]

    class Failing:
        def __getitem__(self, grid):
            raise RuntimeError("Failed to find C compiler.")

    monkeypatch.setattr(kernels, "adam", Failing())
    assert alg.use_kernels() == "Triton fails here: Failed to find C compiler."
    for one in (alg, other):
        one.update()
    assert torch.equal(parameters(alg), parameters(other))


@pytest.mark.slow
def test_a_standard_deviation_out_of_bounds_counts_as_the_bound():
    def change(alg):
        alg.actor.distribution.std_range = [0.6, 1.0]  # it is 0.51

    pair = both(change=change, num_mini_batches=1)
    wanted, found = (alg.update() for alg in pair)
    assert found == pytest.approx(wanted, rel=1e-4, abs=1e-6)
    assert float(pair[1].actor.distribution.std_param.min()) >= 0.6


def wide_input(alg):
    alg.actor.mlp[0] = torch.nn.Linear(64, 16)
    alg.storage.actions = torch.zeros(1, 1, 1).expand(2**10, 2**17, 3)  # 2^26 rows with mirror images


REASONS = {
    "a parameter is not learned": lambda alg: alg.actor.distribution.std_param.requires_grad_(False),
    "a mini-batch has too many rows for 32-bit indices": wide_input,
    "advantages are normalised for each mini-batch": lambda alg: setattr(alg, "normalize_advantage_per_mini_batch", True),
    "train.runner.matmul is float32": lambda alg: setattr(torch.backends.cuda.matmul, "allow_tf32", False),
}


@pytest.fixture
def tf32():
    """The switch of torch for products in TF32, as it was afterwards."""
    switch = torch.backends.cuda.matmul
    before = switch.allow_tf32
    yield switch
    switch.allow_tf32 = before


def test_what_keeps_the_kernels_from_running_is_named(tf32):
    assert why_not(learner(DevicePPO)) == "the device is not a GPU"
    for reason, change in REASONS.items():
        alg = learner(DevicePPO)
        alg.device = "cuda:0"
        tf32.allow_tf32 = True
        assert why_not(alg) == ""
        change(alg)
        assert why_not(alg) == reason
