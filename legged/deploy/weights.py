"""The file policy.weights: a network as plain numbers, for computers without onnxruntime and for `cpp/legged_policy.hpp`.

All numbers are little-endian. The file begins with `MAGIC` and the number of layers (uint32). Each layer has kind, detail,
number of inputs and number of outputs (uint32 each), followed by arrays of float32 numbers, with matrices row by row:

- `NORMALISE`: means (inputs,) and divisors (inputs,). The outputs are (x - mean) / divisor.
- `LINEAR`: a matrix (outputs, inputs) and a bias (outputs,).
- `ACTIVATION`: no arrays. `detail` is the index of the function in `ACTIVATIONS`.
- `LSTM`: two matrices, (4 * outputs, inputs) and (4 * outputs, outputs), and two biases (4 * outputs,). Gates have the
  order i, f, g, o, as in torch.nn.LSTM.
- `GRU`: two matrices, (3 * outputs, inputs) and (3 * outputs, outputs), and two biases (3 * outputs,). Gates have the
  order r, z, n, as in torch.nn.GRU.
- `KEEP`: no arrays. The outputs equal the inputs, and the layer keeps the inputs for the next `JOIN`.
- `JOIN`: no arrays. The outputs are the kept inputs followed by the layer's own inputs. With `KEEP` and `JOIN` a policy
  receives the outputs of an estimator in addition to its observations.
"""

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

MAGIC = b"LEGGEDW1"
COUNT = struct.Struct("<I")
HEAD = struct.Struct("<4I")
NORMALISE, LINEAR, ACTIVATION, LSTM, GRU, KEEP, JOIN = range(7)
SELU_ALPHA, SELU_SCALE = 1.6732632423543772, 1.0507009873554805
_erf = np.vectorize(math.erf, otypes=[float])


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return 0.5 * (1.0 + np.tanh(0.5 * x))


def _softplus(x: np.ndarray) -> np.ndarray:
    return np.logaddexp(0.0, x)


ACTIVATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "elu": lambda x: np.where(x > 0.0, x, np.expm1(np.minimum(x, 0.0))),
    "selu": lambda x: SELU_SCALE * np.where(x > 0.0, x, SELU_ALPHA * np.expm1(np.minimum(x, 0.0))),
    "relu": lambda x: np.maximum(x, 0.0),
    "lrelu": lambda x: np.where(x > 0.0, x, 0.01 * x),
    "tanh": np.tanh,
    "sigmoid": _sigmoid,
    "softplus": _softplus,
    "gelu": lambda x: 0.5 * x * (1.0 + _erf(x / math.sqrt(2.0))),
    "swish": lambda x: x * _sigmoid(x),
    "mish": lambda x: x * np.tanh(_softplus(x)),
}
"""Name in rsl-rl -> activation function. A file of weights has the index of the function in this order."""


@dataclass(frozen=True)
class Layer:
    """A layer of a network."""

    kind: int
    detail: int
    inputs: int
    outputs: int
    arrays: tuple[np.ndarray, ...]
    """Arrays of numbers, in the order of the file."""


def shapes(kind: int, inputs: int, outputs: int) -> list[tuple[int, ...]]:
    """Return the shapes of a layer's arrays.

    Raises:
        ValueError: the kind of layer does not exist.
    """
    if kind == NORMALISE:
        return [(inputs,), (inputs,)]
    if kind == LINEAR:
        return [(outputs, inputs), (outputs,)]
    if kind in (ACTIVATION, KEEP, JOIN):
        return []
    if kind in (LSTM, GRU):
        rows = (4 if kind == LSTM else 3) * outputs
        return [(rows, inputs), (rows, outputs), (rows,), (rows,)]
    raise ValueError(f"there is no layer of kind {kind}")


def pack(layers: list[Layer]) -> bytes:
    """Return the contents of the file for a network."""
    parts = [MAGIC, COUNT.pack(len(layers))]
    for layer in layers:
        parts.append(HEAD.pack(layer.kind, layer.detail, layer.inputs, layer.outputs))
        parts += [np.ascontiguousarray(array, dtype="<f4").tobytes() for array in layer.arrays]
    return b"".join(parts)


def unpack(data: bytes) -> list[Layer]:
    """Return the layers in the contents of a file.

    Raises:
        ValueError: the data are no policy.weights, have the wrong length or numbers that are not finite, or form no network.
    """
    if data[: len(MAGIC)] != MAGIC:
        raise ValueError("is no policy.weights of an export")
    place, kept = len(MAGIC) + COUNT.size, 0
    layers: list[Layer] = []
    try:
        for _ in range(COUNT.unpack_from(data, len(MAGIC))[0]):
            kind, detail, inputs, outputs = HEAD.unpack_from(data, place)
            place += HEAD.size
            arrays = []
            for shape in shapes(kind, inputs, outputs):
                size = math.prod(shape)
                if place + 4 * size > len(data):
                    raise ValueError("is cut short")
                arrays.append(np.frombuffer(data, "<f4", size, place).reshape(shape))
                if not np.isfinite(arrays[-1]).all():
                    raise ValueError("has numbers that are not finite")
                place += 4 * size
            if kind == KEEP:
                kept = inputs
            if kind == JOIN:
                if not kept or outputs != kept + inputs:
                    raise ValueError("has a layer JOIN without a layer KEEP that fits")
                kept = 0
            if kind in (NORMALISE, ACTIVATION, KEEP) and inputs != outputs:
                raise ValueError("has a layer whose outputs must be as many as its inputs")
            if kind == ACTIVATION and detail >= len(ACTIVATIONS):
                raise ValueError("has a layer that this program does not know")
            if layers and layers[-1].outputs != inputs:
                raise ValueError("has layers that do not fit together")
            layers.append(Layer(kind, detail, inputs, outputs, tuple(arrays)))
    except struct.error as error:
        raise ValueError("is cut short") from error
    if place != len(data):
        raise ValueError("is longer than its layers")
    if not layers:
        raise ValueError("has no layers")
    return layers


class NumpyNetwork:
    """A network from policy.weights, run in float64 on a batch of observations. The hidden state is kept between calls."""

    def __init__(self, data: bytes) -> None:
        """Load the contents of a file. Wrong contents raise the errors of `unpack`."""
        self._layers = unpack(data)
        self._functions = list(ACTIVATIONS.values())
        self._hidden: dict[int, np.ndarray] = {}
        self._cells: dict[int, np.ndarray] = {}

    def restart(self, begins: np.ndarray | None = None) -> None:
        """Clear the hidden state of the batch rows for which the mask `begins` (N,) is true; without a mask, of all rows."""
        for states in (self._hidden, self._cells):
            for state in states.values():
                state[slice(None) if begins is None else begins] = 0.0

    def run(self, observations: np.ndarray) -> np.ndarray:
        """Return actions (N, A) for observations (N, width)."""
        x = kept = np.asarray(observations, dtype=float)
        for place, layer in enumerate(self._layers):
            if layer.kind == NORMALISE:
                x = (x - layer.arrays[0]) / layer.arrays[1]
            elif layer.kind == LINEAR:
                x = x @ layer.arrays[0].T + layer.arrays[1]
            elif layer.kind == ACTIVATION:
                x = self._functions[layer.detail](x)
            elif layer.kind == KEEP:
                kept = x
            elif layer.kind == JOIN:
                x = np.concatenate([kept, x], axis=1)
            else:
                x = self._recurrent(place, layer, x)
        return x

    def _recurrent(self, place: int, layer: Layer, x: np.ndarray) -> np.ndarray:
        """Advance a recurrent layer by one step; return its new hidden state (N, outputs)."""
        size = (len(x), layer.outputs)
        h = self._hidden.setdefault(place, np.zeros(size))
        of_input = x @ layer.arrays[0].T + layer.arrays[2]
        of_past = h @ layer.arrays[1].T + layer.arrays[3]
        if layer.kind == LSTM:
            c = self._cells.setdefault(place, np.zeros(size))
            i, f, g, o = np.split(of_input + of_past, 4, axis=1)
            c[:] = _sigmoid(f) * c + _sigmoid(i) * np.tanh(g)
            h[:] = _sigmoid(o) * np.tanh(c)
        else:
            (r, z, n), (hr, hz, hn) = np.split(of_input, 3, axis=1), np.split(of_past, 3, axis=1)
            update = _sigmoid(z + hz)
            h[:] = (1.0 - update) * np.tanh(n + _sigmoid(r + hr) * hn) + update * h
        return h.copy()
