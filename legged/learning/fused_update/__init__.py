"""PPO's update in a few Triton kernels (`kernels.py`). The same formulas in torch are in closed_form.py.

Notation: a network has layers l = 1 ... L. Layer l has inputs h[l-1] (rows, in), weights W[l] (out, in) and biases b[l].

    forward     h[l] = elu(h[l-1] W[l]^T + b[l]), without elu in the last layer
    losses      gradients d[L] of PPO's losses by the outputs of actor and critic
    backward    d[l-1] = (d[l] W[l]) * elu'(h[l-1]), where elu' = 1 for h > 0, else h + 1
    weights     dW[l] = d[l]^T h[l-1], db[l] = sum of the rows of d[l]
    Adam        on one vector that holds all parameters, after the gradient of each network is clipped

Operands of products are float16, sums are float32. Gradients are multiplied by a power of two, so that float16 holds them.
"""

import importlib.util

import torch

from legged.learning.closed_form import fits
from legged.learning.critic_warmup import CriticWarmup
from legged.learning.estimator import EstimatingModel
from legged.learning.fused_update.layout import padded


def why_not(alg: CriticWarmup) -> str:
    """Return the reason why the kernels can't compute a learner's updates, or an empty text."""
    rows = 2 * alg.storage.actions[..., 0].numel() // alg.num_mini_batches
    parameters = [parameter for model in (alg.actor, alg.critic) for parameter in model.parameters()]
    widest = padded(max(max(parameter.shape) for parameter in parameters))
    reasons = {
        "the device is not a GPU": torch.device(alg.device).type != "cuda",
        "Triton is not installed": importlib.util.find_spec("triton") is None,
        "a parameter is not learned": not all(parameter.requires_grad for parameter in parameters),
        "the actor has an estimator": isinstance(alg.actor, EstimatingModel),
        "the layers are not linear with ELU between them": not all(fits(model.mlp) for model in (alg.actor, alg.critic)),
        "the standard deviation is learned as its logarithm": alg.actor.distribution.std_type != "scalar",
        "there are more than 128 actions": alg.storage.actions.shape[-1] > 128,
        "a mini-batch has too many rows for 32-bit indices": rows * widest >= 2**31,
        "advantages are normalised for each mini-batch": alg.normalize_advantage_per_mini_batch,
        "train.algorithm.use_mixed_precision is true": alg.use_mixed_precision,
        "train.runner.matmul is float32": not torch.backends.cuda.matmul.allow_tf32,
    }
    return next((reason for reason, holds in reasons.items() if holds), "")
