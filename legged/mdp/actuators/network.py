"""Actuators learned from data: a network predicts joint torque from position errors and velocities. An MLP sees the last few
samples; an LSTM remembers all samples.

The MLP is that of Hwangbo et al., "Learning agile and dynamic motor skills for legged robots", Science Robotics 4 (2019),
eaau5872: its inputs are position error and velocity of the current and two earlier samples, and its small layers use
softsign. All joints share one network.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

import numpy as np
import torch
from torch import Tensor

from legged.errors import ConfigError, suggest
from legged.math import masked_set_
from legged.mdp.actuators.model import ActuatorModel, JointStep, Motors, modelled_joints
from legged.mdp.kernels import Kernels

KINDS = ("mlp", "lstm")
FORMAT = 1
"""Version of the layout of a learned actuator's file."""
WIDEST, DEEPEST = 1024, 16
"""Largest number of units in a layer, and largest number of layers."""
TOLERANCE = 1e-3
"""Samples must be a whole number of physics steps apart. This is the largest allowed deviation, in physics steps."""


@dataclass(frozen=True)
class NetworkWeights:
    """Contents of the file of a learned actuator (.npz, without pickled objects)."""

    kind: str
    """`mlp` or `lstm`."""
    dt: float
    """Time between the samples that the network was trained on [s]."""
    samples: int
    """Number of samples that an MLP sees: the current sample and `samples - 1` earlier ones, `dt` apart. It is 1 for an
    LSTM."""
    scales: np.ndarray
    """(3,) factors on position errors [1/rad], on velocities [s/rad] and on the output [N m]."""
    layers: tuple[dict[str, np.ndarray], ...]
    """Weights by layer. A linear layer has `weight` (out, in) and `bias` (out,). The cells of an LSTM come first, with
    `input` (4 H, in), `hidden` (4 H, H) and `bias` (4 H,), for the gates i, f, g, o in torch's order.
    """
    facts: dict[str, float] = field(default_factory=dict)
    """Figures of the fit, such as its error on held-out data."""

    def save(self, path: Path) -> None:
        """Write the weights to the file `path`."""
        arrays = {f"layer{i}.{name}": array for i, layer in enumerate(self.layers) for name, array in layer.items()}
        facts = {f"fact.{name}": np.array(value) for name, value in self.facts.items()}
        header = {"format": FORMAT, "kind": self.kind, "dt": self.dt, "samples": self.samples, "scales": self.scales}
        with open(path, "wb") as file:
            np.savez(file, **{**header, **arrays, **facts})  # type: ignore[arg-type]

    @classmethod
    def load(cls, path: str | Path, where: str = "control.actuator.network") -> "NetworkWeights":
        """Read the weights from the file `path`. `where` is the beginning of error messages.

        Raises:
            ConfigError: the file is missing, or is not a file of a learned actuator.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {name: file[name] for name in file.files}
        except OSError as error:
            raise ConfigError(f"{where}: {path}: {error.strerror or 'not a file of a learned actuator (.npz)'}") from error
        except Exception as error:  # a damaged file raises errors of zipfile, numpy and zlib
            raise ConfigError(f"{where}: {path}: not a file of `legged fit-actuator` (.npz)") from error
        try:
            return cls._of(arrays)
        except (KeyError, ValueError, TypeError) as error:
            said = f"'{error.args[0]}' is missing" if isinstance(error, KeyError) else str(error)
            raise ConfigError(f"{where}: {path}: not a file of a learned actuator: {said}") from error

    @classmethod
    def _of(cls, arrays: dict[str, np.ndarray]) -> "NetworkWeights":
        """Return the weights in the arrays of a file.

        Raises:
            KeyError: an array is missing.
            ValueError: the arrays do not describe a network.
        """
        if int(arrays["format"]) != FORMAT:
            raise ValueError(f"its format is {int(arrays['format'])}, not {FORMAT}")
        kind, dt, samples = str(arrays["kind"]), float(arrays["dt"]), int(arrays["samples"])
        if kind not in KINDS:
            raise ValueError(f"unknown kind '{kind}'{suggest(kind, KINDS)}")
        scales = arrays["scales"].astype(np.float32)
        layers: list[dict[str, np.ndarray]] = []
        while len(layers) <= DEEPEST and any(name.startswith(f"layer{len(layers)}.") for name in arrays):
            prefix = f"layer{len(layers)}."
            layers.append({n.removeprefix(prefix): a.astype(np.float32) for n, a in arrays.items() if n.startswith(prefix)})
        weights = cls(kind, dt, samples, scales, tuple(layers), {})
        weights._check()
        return weights

    def _check(self) -> None:
        """Check the header, and that the layers fit each other.

        Raises:
            KeyError: an array is missing.
            ValueError: the header is invalid, a layer does not fit the previous one or has non-finite weights, or the network
                returns more than one number.
        """
        if not (self.dt > 0.0 and self.samples > 0 and self.scales.shape == (3,) and 0 < len(self.layers) <= DEEPEST):
            raise ValueError("its header has invalid values")
        width = 2 * self.samples
        for i, layer in enumerate(self.layers):
            cell = self.kind == "lstm" and i + 1 < len(self.layers)
            out = len(layer["bias"]) // 4 if cell else len(layer["bias"])
            shapes = {"input": (4 * out, width), "hidden": (4 * out, out)} if cell else {"weight": (out, width)}
            if not 0 < out <= WIDEST or any(layer[name].shape != shape for name, shape in shapes.items()):
                raise ValueError(f"layer {i} does not fit the previous one")
            if not all(np.isfinite(array).all() for array in layer.values()):
                raise ValueError(f"layer {i} has weights that are NaN or infinite")
            width = out
        if width != 1:
            raise ValueError(f"it returns {width} numbers instead of one torque")

    def steps_between(self, sim_dt: float, where: str = "control.actuator.network") -> int:
        """Return the number of physics steps of `sim_dt` [s] between two samples.

        Raises:
            ConfigError: the number is not whole, or is more than 1 for an LSTM, because an LSTM must see every physics step.
        """
        steps = round(self.dt / sim_dt)
        if steps < 1 or abs(self.dt / sim_dt - steps) > TOLERANCE or (self.kind == "lstm" and steps != 1):
            allowed = f"{self.dt:g}" if self.kind == "lstm" else f"{self.dt:g} divided by a whole number"
            raise ConfigError(
                f"{where}: the network was trained on samples {self.dt:g} s apart. They do not fit physics steps of"
                f" sim.dt={sim_dt:g}; sim.dt must be {allowed} (`legged fit-actuator --spacing`; for an lstm, --dt)"
            )
        return steps


class ActuatorNetwork:
    """Learned actuator, evaluated once per physics step for all D joints of all N robots."""

    def __init__(
        self,
        weights: NetworkWeights,
        num_envs: int,
        joints: int,
        sim_dt: float,
        device: torch.device,
        kernels: Kernels | None = None,
    ) -> None:
        """Build the network, with all past errors, velocities and hidden states 0.

        Raises:
            ConfigError: the physics step `sim_dt` [s] does not fit the samples that the network was trained on.
        """
        self.kind, self._kernels = weights.kind, kernels
        self.shape, self._rows = (num_envs, joints), num_envs * joints
        self._every, self._samples = weights.steps_between(sim_dt), weights.samples
        self._scales = self._position, self._velocity, self._torque = tuple(map(float, weights.scales))
        self._layers = [{name: torch.tensor(array, device=device) for name, array in of.items()} for of in weights.layers]
        self._hidden = [] if self.kind == "mlp" else [layer["hidden"].shape[1] for layer in self._layers[:-1]]
        if self.kind == "mlp":
            shape = (self._every * (weights.samples - 1) + 1, 2, joints)
        else:
            shape = (2 * len(self._hidden), max(self._hidden, default=1), joints)
        self.state = torch.zeros(num_envs, *shape, device=device)
        """State of the network. For an MLP it is (N, steps, 2, D), the scaled errors and velocities of the last physics
        steps, newest first. For an LSTM it is (N, 2 * layers, H, D), for each layer its hidden state, then its cell state."""
        if kernels is not None:
            widths = [2 * weights.samples, *(len(layer["bias"]) for layer in weights.layers)]
            widths[1:-1] = self._hidden or widths[1:-1]
            self._widths = torch.tensor(widths, dtype=torch.int32, device=device)
            parts = [
                of[name].flatten() for of in self._layers for name in ("input", "hidden", "weight", "bias") if name in of
            ]
            self._weights = torch.cat(parts)
            self._scratch = torch.zeros(2, max(widths), self._rows, device=device)
            self._found = torch.zeros(self.shape, device=device)

    def torques(self, error: Tensor, dof_vel: Tensor) -> Tensor:
        """Return the torques (N, D) [N m] of this physics step. `error` (N, D) is the target minus the joint angle [rad],
        and `dof_vel` (N, D) the joint velocity [rad/s].
        """
        if self._kernels is not None:
            net = (self._weights, self._widths, self.state, self._scratch, self._found)
            dim = tuple(error.shape)
            if self.kind == "mlp":
                self._kernels.launch("run_mlp", dim, error, dof_vel, *self._scales, self._every, self._samples, *net)
            else:
                self._kernels.launch("run_lstm", dim, error, dof_vel, *self._scales, *net)
            return self._found
        found = self._mlp(error, dof_vel) if self.kind == "mlp" else self._lstm(error, dof_vel)
        return (self._torque * found).view(self.shape)

    def _mlp(self, error: Tensor, dof_vel: Tensor) -> Tensor:
        if self.state.shape[1] > 1:
            self.state[:, 1:].copy_(self.state[:, :-1].clone())
        torch.mul(error, self._position, out=self.state[:, 0, 0])
        torch.mul(dof_vel, self._velocity, out=self.state[:, 0, 1])
        # Rows of x are the errors of all samples, then the velocities, newest first. Columns are the joints of all robots.
        x = self.state[:, :: self._every].permute(2, 1, 0, 3).reshape(2 * self._samples, self._rows)
        for layer in self._layers[:-1]:
            x = torch.nn.functional.softsign(torch.addmm(layer["bias"].unsqueeze(1), layer["weight"], x))
        return torch.addmm(self._layers[-1]["bias"].unsqueeze(1), self._layers[-1]["weight"], x)

    def _lstm(self, error: Tensor, dof_vel: Tensor) -> Tensor:
        x = torch.stack([self._position * error, self._velocity * dof_vel]).view(2, self._rows)
        for i, (layer, size) in enumerate(zip(self._layers[:-1], self._hidden, strict=True)):
            h, c = (self.state[:, 2 * i + k, :size].permute(1, 0, 2).reshape(size, self._rows) for k in range(2))
            gates = torch.addmm(torch.addmm(layer["bias"].unsqueeze(1), layer["input"], x), layer["hidden"], h)
            take, keep, new, show = gates.chunk(4)
            c = torch.sigmoid(keep) * c + torch.sigmoid(take) * torch.tanh(new)
            x = torch.sigmoid(show) * torch.tanh(c)
            for k, value in enumerate((x, c)):
                self.state[:, 2 * i + k, :size].copy_(value.view(size, *self.shape).permute(1, 0, 2))
        return torch.addmm(self._layers[-1]["bias"].unsqueeze(1), self._layers[-1]["weight"], x)

    def reset(self, mask: Tensor) -> None:
        """Reset the state of the robots in `mask` (N,)."""
        masked_set_(self.state, mask, 0.0)


class LearnedTorque(ActuatorModel):
    """Torques of a network in place of those of the P law, at some joints."""

    def __init__(self, network: ActuatorNetwork, by_network: Tensor) -> None:
        """Use the torques of `network` at the joints of the mask `by_network` (D,)."""
        self.network, self._by_network = network, by_network
        self._error = torch.zeros(network.shape, device=by_network.device)

    @classmethod
    def of(cls, motors: Motors) -> Self:
        """Return the network that the settings name.

        Raises:
            ConfigError: the file is missing or invalid, or does not fit the physics step.
        """
        joints, cfg = motors.robot.num_dof, motors.cfg
        weights = NetworkWeights.load(cfg.network)
        network = ActuatorNetwork(weights, motors.num_envs, joints, motors.sim_dt, motors.device, motors.kernels)
        has = modelled_joints(motors.robot, cfg)
        return cls(network, torch.tensor([i in has for i in range(joints)], device=motors.device))

    def torques(self, torques: Tensor, step: JointStep) -> Tensor:
        torch.sub(step.target, step.dof_pos, out=self._error)
        return torch.where(self._by_network, self.network.torques(self._error, step.dof_vel), torques)

    def reset(self, mask: Tensor) -> None:
        self.network.reset(mask)

    def describe(self, joint: int) -> str:
        return f"torque by a network ({self.network.kind})" if bool(self._by_network[joint]) else ""
