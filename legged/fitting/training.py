"""Training of actuator networks on logs, for legged/mdp/actuators/network.py."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor, nn

from legged.errors import ConfigError
from legged.fitting.log import ActuatorLog
from legged.mdp.actuators.network import ActuatorNetwork, NetworkWeights

LEARNING_RATE = {"mlp": 3e-3, "lstm": 1e-2}
BATCH = 4096
"""Batch size of an MLP."""
CHUNK, BURN_IN, CHUNKS = 60, 15, 64
"""For an LSTM: samples in a sequence, samples at its start that the loss leaves out, and sequences in an update."""


def train_network(
    log: ActuatorLog, kind: str, hidden: Sequence[int], samples: int, spacing: int, updates: int, seed: int
) -> NetworkWeights:
    """Train a network (`kind`: `mlp` or `lstm`) with `hidden` units per layer on the samples of a log that are not held out.
    Return its weights. An MLP reads `samples` samples: the present one, and earlier ones at intervals of `spacing` samples.

    Raises:
        ConfigError: the runs are too short.
    """
    error, used = log.target - log.position, ~log.held_out
    spread = [max(float(np.std(values[used])), 1e-6) for values in (error, log.velocity, log.torque)]
    scales = np.array([1.0 / spread[0], 1.0 / spread[1], spread[2]], np.float32)
    inputs, torque = (error * scales[0], log.velocity * scales[1]), log.torque / scales[2]
    random = torch.Generator().manual_seed(seed)
    state = torch.get_rng_state()
    try:
        torch.manual_seed(seed)  # torch draws the initial weights from its global generator
        if kind == "mlp":
            network, loss = _mlp(log, inputs, torque, hidden, spacing * np.arange(samples), random)
        else:
            network, loss = _lstm(log, inputs, torque, hidden, random)
        optimiser = torch.optim.Adam(network.parameters(), LEARNING_RATE[kind])
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, updates)  # the learning rate decays to 0
        for _ in range(updates):
            optimiser.zero_grad()
            loss().backward()
            nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimiser.step()
            schedule.step()
    finally:
        torch.set_rng_state(state)
    dt, seen = (log.dt * spacing, samples) if kind == "mlp" else (log.dt, 1)
    layers = [_weights(layer) for layer in network.modules() if isinstance(layer, nn.Linear | nn.LSTM)]
    return NetworkWeights(kind, dt, seen, scales, tuple(layers))


def _weights(layer: nn.Module) -> dict[str, np.ndarray]:
    """Return name -> array of a layer's weights, named as in `NetworkWeights`."""
    weights = {name: values.detach().numpy().astype(np.float32) for name, values in layer.named_parameters()}
    if isinstance(layer, nn.Linear):
        return weights
    bias = weights["bias_ih_l0"] + weights["bias_hh_l0"]
    return {"input": weights["weight_ih_l0"], "hidden": weights["weight_hh_l0"], "bias": bias}


def predict(weights: NetworkWeights, log: ActuatorLog) -> np.ndarray:
    """Return the network's torques (T, D) [N m] for a log. The network runs step by step and is reset before each run."""
    joints = len(log.joint_names)
    network = ActuatorNetwork(weights, 1, joints, log.dt, torch.device("cpu"))
    error = torch.tensor(log.target - log.position, dtype=torch.float32)
    velocity = torch.tensor(log.velocity, dtype=torch.float32)
    begins = np.r_[True, np.diff(log.run) != 0]
    everyone, found = torch.ones(1, dtype=torch.bool), torch.zeros(len(error), joints)
    with torch.inference_mode():
        for k in range(len(error)):
            if begins[k]:
                network.reset(everyone)
            found[k] = network.torques(error[k : k + 1], velocity[k : k + 1])[0]
    return found.numpy().astype(np.float64)


def _rows(log: ActuatorLog, past: int) -> np.ndarray:
    """Return the indices of the training samples that follow at least `past` consecutive training samples of the same run."""
    usable = ~log.held_out
    starts = np.r_[True, (np.diff(log.run) != 0) | (np.diff(usable.astype(int)) != 0)]
    since = np.arange(len(usable)) - np.maximum.accumulate(np.where(starts, np.arange(len(usable)), 0))
    rows = np.flatnonzero(usable & (since >= past))
    if not len(rows):
        raise ConfigError(f"log: no run has more than {past} consecutive training samples; record longer runs")
    return rows


def _mlp(
    log: ActuatorLog,
    seen: Sequence[np.ndarray],
    torque: np.ndarray,
    hidden: Sequence[int],
    lags: np.ndarray,
    random: torch.Generator,
) -> tuple[nn.Module, Callable[[], Tensor]]:
    """Return an MLP and its loss. The MLP reads `seen` (scaled errors and velocities, (T, D)) from `lags` samples ago."""
    rows = _rows(log, int(lags[-1]))
    inputs = torch.tensor(np.stack([values[rows - lag].ravel() for values in seen for lag in lags], 1), dtype=torch.float32)
    outputs = torch.tensor(torque[rows].ravel(), dtype=torch.float32)
    widths = [2 * len(lags), *hidden]
    linear = [nn.Linear(a, b) for a, b in zip(widths, [*hidden, 1], strict=True)]
    network = nn.Sequential(*[part for layer in linear[:-1] for part in (layer, nn.Softsign())], linear[-1])

    def loss() -> Tensor:
        picked = torch.randint(len(inputs), (min(BATCH, len(inputs)),), generator=random)
        return nn.functional.mse_loss(network(inputs[picked])[:, 0], outputs[picked])

    return network, loss


def _lstm(
    log: ActuatorLog,
    seen: Sequence[np.ndarray],
    torque: np.ndarray,
    hidden: Sequence[int],
    random: torch.Generator,
) -> tuple[nn.Module, Callable[[], Tensor]]:
    """Return an LSTM and its loss on random sequences. The LSTM reads `seen` (scaled errors and velocities, (T, D))."""
    ends = torch.tensor(_rows(log, CHUNK - 1))
    inputs = torch.tensor(np.stack(seen, axis=2), dtype=torch.float32)
    outputs = torch.tensor(torque, dtype=torch.float32)
    cells = [nn.LSTM(a, b) for a, b in zip([2, *hidden], hidden, strict=False)]
    last = nn.Linear(hidden[-1], 1)
    back = torch.arange(CHUNK - 1, -1, -1).unsqueeze(1)

    def loss() -> Tensor:
        rows = ends[torch.randint(len(ends), (CHUNKS,), generator=random)] - back
        joints = torch.randint(inputs.shape[1], (CHUNKS,), generator=random)
        x = inputs[rows, joints]
        for cell in cells:
            x, _ = cell(x)
        return nn.functional.mse_loss(last(x)[BURN_IN:, :, 0], outputs[rows, joints][BURN_IN:])

    return nn.ModuleList([*cells, last]), loss
