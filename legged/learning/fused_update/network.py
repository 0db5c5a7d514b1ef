"""Buffers of one network, and the launches of the kernels of its layers."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from legged.learning.fused_update import kernels
from legged.learning.fused_update.layout import BLOCK, Layer
from legged.learning.networks import normalization

ROWS, COLUMNS, DEPTH = 128, 128, 64
"""Largest tile of a product (rows, columns), and numbers of its inner dimension per turn. The number of rows is a multiple
of ROWS. These sizes, and those of `gradient_tile`, were the fastest on an H100 for layers of 16 to 512 numbers."""
LARGEST_INPUT = 2.0**14
"""Inputs above this number are scaled down by a power of two, so that float16 holds them and the first layer's outputs."""


def tile(width: int, largest: int) -> int:
    """Return the largest power of two that divides `width` and is at most `largest`."""
    return min(width & -width, largest)


def row_tile(width: int) -> tuple[int, int]:
    """Return the tile (rows, columns) of outputs with `width` columns that one program computes."""
    columns = tile(width, COLUMNS)
    return min(ROWS, ROWS * 64 // columns), columns


def gradient_tile(layer: Layer) -> tuple[int, int]:
    """Return the tile (outputs, inputs) of a layer's weights that one program of `weights` computes."""
    return tile(layer.outputs, DEPTH), tile(layer.inputs, COLUMNS)


def parts_of(layer: Layer, all_rows: int) -> int:
    """Return into how many parts the rows are split for the gradient of a layer's weights. With few tiles, many parts are
    needed to occupy a GPU. A part has at least ROWS rows.
    """
    rows, columns = gradient_tile(layer)
    tiles = layer.outputs // rows * (layer.inputs // columns)
    return min(max(16, 128 // tiles), all_rows // ROWS)


class Network:
    """One network in the update. A mini-batch has `rows` rows: samples, their mirror images, and padding."""

    def __init__(self, layers: Sequence[Layer], rows: int, batches: int, kind: torch.dtype, device: torch.device) -> None:
        """Allocate buffers for the `layers`. `kind` is the type of the operands of products."""
        self.layers, self.rows = layers, rows
        self.start = layers[0].weight
        self.size = layers[-1].end - self.start
        """Index of the first parameter in the vector of all parameters, and number of parameters with padding."""
        kinds = [*[kind] * (len(layers) - 1), torch.float32]
        self.inputs = torch.zeros(batches, rows, layers[0].inputs, dtype=kind, device=device)
        self.outputs = [torch.zeros(rows, la.outputs, dtype=k, device=device) for la, k in zip(layers, kinds, strict=True)]
        self.by_outputs = torch.zeros_like(self.outputs[-1])
        """Gradient by the last outputs (rows, outputs), as the losses give it."""
        self.gradients = [torch.zeros_like(output, dtype=kind) for output in self.outputs]
        """Gradients by the outputs of all layers, multiplied by the factor of the largest number of `by_outputs`."""
        parts = [parts_of(layer, rows) for layer in layers for _ in range(layer.weight, layer.end, BLOCK)]
        self.parts = torch.tensor(parts, dtype=torch.int32, device=device)
        """Number of parts of each block of parameters."""
        self.one_part = torch.ones_like(self.parts)
        self.partial = torch.zeros(max(parts), self.size, device=device)
        """Gradient of each part of the rows (parts, size)."""
        self.unit, self.one = torch.ones(1, device=device), torch.ones(1, device=device)
        """Number by which the scaled inputs must be multiplied, and the same for other layers."""

    def pack(self, model: nn.Module, x: Tensor, order: Tensor, mirror: tuple[Tensor, Tensor], samples: int) -> None:
        """Write the inputs of all mini-batches, from the inputs `x` (., width) of the rollout. `order` (batches * samples,)
        has the sample of each row, `mirror` the columns and signs (images, padded width).
        """
        width, padded_width = x.shape[1], self.inputs.shape[-1]
        shift, scale = x.new_zeros(padded_width), x.new_ones(padded_width)
        shift[:width], scale[:width] = normalization(model)
        low, high = torch.aminmax(x, dim=0)
        largest = (torch.maximum(low.abs(), high.abs()) + shift[:width].abs()) * scale[:width]
        excess = torch.log2(torch.where(largest.isfinite(), largest, 0.0).max() / LARGEST_INPUT).ceil().clamp(min=0.0)
        torch.exp2(excess, out=self.unit[0])
        images = len(mirror[0])
        loaded = 1 << (padded_width - 1).bit_length()
        block = max(1, 2048 // loaded)
        kernels.pack[(self.inputs[..., 0].numel() // block,)](
            x, order, *mirror, shift, scale / self.unit, self.inputs, samples, self.rows, width, padded_width, loaded, images,
            block,
        )  # fmt: skip

    def forward(self, batch: int, shadow: Tensor, vector: Tensor) -> None:
        """Compute the outputs of all layers. Weights come from `shadow`, biases from `vector`."""
        h, unit = self.inputs[batch], self.unit
        for layer, output in zip(self.layers, self.outputs, strict=True):
            rows, columns = row_tile(layer.outputs)
            kernels.forward[(self.rows // rows * (layer.outputs // columns),)](
                h, shadow[layer.weight :], vector[layer.bias :], unit, output, layer.inputs, layer.outputs,
                output is not self.outputs[-1], rows, columns, tile(layer.inputs, DEPTH), num_stages=2,
            )  # fmt: skip
            h, unit = output, self.one

    def backward(self, batch: int, shadow: Tensor, largest: Tensor) -> None:
        """Compute the gradients by all layers' outputs and parameters from the gradient by the last outputs, whose largest
        number is `largest`.
        """
        kernels.scale[(self.by_outputs.numel() // 1024,)](self.by_outputs, largest, self.gradients[-1], 1024)
        for i in reversed(range(len(self.layers))):
            layer, d = self.layers[i], self.gradients[i]
            h, unit = (self.outputs[i - 1], self.one) if i else (self.inputs[batch], self.unit)
            rows, columns = gradient_tile(layer)
            parts = parts_of(layer, self.rows)
            rows_each = ROWS * -(-self.rows // (ROWS * parts))
            kernels.weights[(layer.outputs // rows * (layer.inputs // columns), parts)](
                d, h, unit, self.partial[0, layer.weight - self.start :], self.partial[0, layer.bias - self.start :],
                self.size, self.rows, rows_each, layer.inputs, layer.outputs, rows, columns, ROWS,
            )  # fmt: skip
            if i:
                rows, columns = row_tile(layer.inputs)
                kernels.backward[(self.rows // rows * (layer.inputs // columns),)](
                    d, shadow[layer.weight :], h, self.gradients[i - 1], layer.inputs, layer.outputs,
                    rows, columns, tile(layer.outputs, DEPTH), num_stages=2,
                )  # fmt: skip

    def reduce(self, gradient: Tensor, squares: Tensor, largest: Tensor, samples: int) -> None:
        """Write the mean gradient over the `samples` rows that are no padding to this network's place in `gradient`, and sums
        of its squares to `squares`.
        """
        kernels.reduce[(len(self.parts),)](
            self.partial, self.parts, gradient[self.start :], squares, largest, 1.0 / samples, self.size, BLOCK
        )


def linear_layers(model: nn.Module) -> list[nn.Linear]:
    """Return the linear layers of a network."""
    return [layer for layer in model.modules() if isinstance(layer, nn.Linear)]
