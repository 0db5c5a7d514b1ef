"""All parameters of actor and critic in one vector, and likewise Adam's moments and the gradient."""

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor, nn

SMALLEST = 16
"""Smallest size of a tile in the products of GPUs; every width is padded to a multiple of it."""
BLOCK = 128
"""Parameters per program of kernels that treat them one by one; a layer's parameters are padded to a multiple of it."""


def padded(width: int) -> int:
    """Return the width with padding: a multiple of 64 above 32, else 16 or 32."""
    return 64 * -(-width // 64) if width > 2 * SMALLEST else SMALLEST * -(-width // SMALLEST)


@dataclass(frozen=True)
class Layer:
    """Place of a linear layer in the vector."""

    inputs: int
    """Number of inputs with padding."""
    outputs: int
    """Number of outputs with padding."""
    weight: int
    """Index of the first weight; weights are (outputs, inputs), row by row."""
    bias: int
    """Index of the first bias."""
    end: int
    """Index after the last parameter and padding."""


class Layout:
    """Order of the vector: actor's layers, standard deviation, critic's layers. Padding is between the real numbers."""

    def __init__(self, networks: Sequence[Sequence[nn.Linear]], actions: int) -> None:
        """Place the layers of actor and critic, and the standard deviation of `actions` actions."""
        self.networks: list[list[Layer]] = []
        self.std = self.actor_end = self.size = 0
        for linears in networks:
            layers = []
            for linear in linears:
                inputs, outputs = padded(linear.in_features), padded(linear.out_features)
                weight, bias = self.size, self.size + inputs * outputs
                self.size = bias + BLOCK * -(-outputs // BLOCK)
                layers.append(Layer(inputs, outputs, weight, bias, self.size))
            self.networks.append(layers)
            if len(self.networks) == 1:
                self.std, self.size = self.size, self.size + BLOCK
                self.actor_end = self.size

    def view(self, vector: Tensor, layer: Layer) -> tuple[Tensor, Tensor]:
        """Return weights (outputs, inputs) and biases (outputs,) of a layer, with padding, as views of the vector."""
        weight = vector[layer.weight : layer.bias].view(layer.outputs, layer.inputs)
        return weight, vector[layer.bias : layer.bias + layer.outputs]

    def views(self, vector: Tensor, networks: Sequence[Sequence[nn.Linear]], std: nn.Parameter) -> dict[Tensor, Tensor]:
        """Return parameter -> view of the vector with the parameter's shape."""
        found: dict[Tensor, Tensor] = {std: vector[self.std : self.std + len(std)]}
        for layers, linears in zip(self.networks, networks, strict=True):
            for layer, linear in zip(layers, linears, strict=True):
                weight, bias = self.view(vector, layer)
                found[linear.weight] = weight[: linear.out_features, : linear.in_features]
                found[linear.bias] = bias[: linear.out_features]
        return found
