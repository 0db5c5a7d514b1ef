"""Kernels that write random values to a model's arrays within a step, in one launch for all arrays."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from legged.physics.fields import FIELDS, own_array
from legged.physics.randomized_model import RandomizedModel

HOW = {"set": 0, "add": 1, "scale": 2}
BOUNCE = {"": 0, "ratio": 1, "inverse": 2}
ADD, SCALE, INVERSE = wp.constant(HOW["add"]), wp.constant(HOW["scale"]), wp.constant(BOUNCE["inverse"])
THREADS = 128
"""Number of GPU threads that share the numbers of one world. In a step, few worlds take new values. With one thread for each
number and world, most threads would be idle. With 32, each thread would wait for memory about ten times."""

wp.set_module_options({"enable_backward": False})


@wp.struct
class Rows:
    """Model arrays with one row per world, (N, L) each. A kernel writes to any number of arrays, because it gets their
    addresses.
    """

    address: wp.array[wp.uint64]
    """Address of the first number of each array."""
    length: wp.array[int]
    """Length L of each array's rows."""


@wp.func
def put(to: Rows, array: int, world: int, at: int, number: float) -> None:
    """Write a number at position `at` of a world's row in one of the arrays."""
    row = wp.array(ptr=to.address[array], shape=((world + 1) * to.length[array],), dtype=wp.float32)
    row[world * to.length[array] + at] = number


@wp.kernel
def write_drawn(
    threads: int,
    mask: wp.array[wp.bool],
    drawn: wp.array2d[float],
    place: wp.array2d[int],
    own: wp.array[float],
    first: wp.array[int],
    entry: wp.array2d[int],
    weight: wp.array[float],
    ratios: wp.array[float],
    to: Rows,
):
    """Compute the randomised numbers of the worlds in `mask`: each is the model's own number, to which the changes of all
    fields are applied in turn. `threads` threads per world share the numbers. `place` holds the array of each number and its
    position there. `entry` holds, for each change, the column of its value in `drawn`, the operation, and the conversion
    from restitution.
    """
    world, thread = wp.tid()
    if not mask[world]:
        return
    for n in range(thread, own.shape[0], threads):
        number = own[n]
        for k in range(first[n], first[n + 1]):
            value = drawn[world, entry[k, 0]]
            bounce = entry[k, 2]
            if bounce > 0:
                points = ratios.shape[0] - 1
                at = wp.clamp(value, 0.0, 1.0) * float(points)
                low = wp.min(int(at), points - 1)
                value = ratios[low] + (at - float(low)) * (ratios[low + 1] - ratios[low])
                if bounce == INVERSE:
                    value = 1.0 / value
            value = value * weight[k]
            if entry[k, 1] == SCALE:
                number = number * value
            elif entry[k, 1] == ADD:
                number = number + value
            else:
                number = value
        put(to, place[n, 0], world, place[n, 1], number)


@wp.kernel
def copy_variants(
    threads: int,
    mask: wp.array[wp.bool],
    chosen: wp.array[wp.int64],
    variants: wp.array2d[float],
    place: wp.array2d[int],
    to: Rows,
):
    """Copy the chosen variant into the worlds of `mask`. `threads` threads per world share the numbers of the variant.
    `place` holds the array of each number and its position there.
    """
    world, thread = wp.tid()
    if not mask[world]:
        return
    row = int(chosen[world])
    for n in range(thread, variants.shape[1], threads):
        put(to, place[n, 0], world, place[n, 1], variants[row, n])


def _threads() -> int:
    """Return the number of threads per world on Warp's current device."""
    return 1 if wp.get_device().is_cpu else THREADS


def _rows(arrays: Sequence[Tensor]) -> Any:
    """Return the addresses of arrays (N, ...) that a kernel writes. The arrays must be contiguous, and must outlive the
    result.
    """
    assert all(array.is_contiguous() and array.dtype is torch.float32 for array in arrays)
    to = Rows()
    to.address = wp.array([array.data_ptr() for array in arrays], dtype=wp.uint64)
    to.length = wp.array([array[0].numel() for array in arrays], dtype=int)
    return to


class Redraws:
    """Applies random values to arrays of the model, in one launch."""

    def __init__(
        self, of: RandomizedModel, drawn: Tensor, columns: Mapping[str, slice], arrays: Mapping[str, Tensor]
    ) -> None:
        """Prepare to write `arrays`, (N, ...) each, from `drawn` (N, V). `columns` gives the columns of each field in
        `drawn`. Warp's current device must be that of the tensors.
        """
        changes: dict[tuple[int, int], list[tuple[int, int, int, float]]] = {}
        own = []
        for number, name in enumerate(arrays):
            numbers = own_array(of.model, name)
            width = int(np.prod(numbers.shape[1:], dtype=int))
            found: dict[tuple[int, int], list[tuple[int, int, int, float]]] = {}
            for field, rows in of.rows.items():
                for change in FIELDS[field].changes:
                    if change.array != name or field not in columns:
                        continue
                    weights = np.ones(len(numbers)) if change.weight is None else change.weight(of.model)
                    each = columns[field].stop - columns[field].start > 1
                    for k, row in enumerate(rows.tolist()):
                        column = columns[field].start + (k if each else 0)
                        entry = (column, HOW[change.how], BOUNCE[change.bounce], float(weights[row]))
                        for at in range(width) if change.column is None else (change.column,):
                            found.setdefault((number, row * width + at), []).append(entry)
            own += [numbers.ravel()[at] for _, at in found]
            changes |= found
        entries = [entry for each in changes.values() for entry in each]
        ratios = of.bounces.table if of.bounces is not None else torch.zeros(2, device=drawn.device)
        self._inputs = [
            wp.from_torch(drawn),
            wp.array(list(changes), dtype=int, ndim=2),
            wp.array(own, dtype=float),
            wp.array(np.cumsum([0, *(len(each) for each in changes.values())]), dtype=int),
            wp.array([entry[:3] for entry in entries], dtype=int, ndim=2),
            wp.array([entry[3] for entry in entries], dtype=float),
            wp.from_torch(ratios),
            _rows(list(arrays.values())),
        ]
        self._dim = (len(drawn), _threads())

    def launch(self, mask: Tensor) -> None:
        """Write the rows of the worlds in `mask` (N,)."""
        wp.launch(write_drawn, dim=self._dim, inputs=[self._dim[1], wp.from_torch(mask), *self._inputs])


class Variants:
    """Model variants with derived constants. Each world takes one of them."""

    def __init__(self, arrays: Mapping[str, tuple[Tensor, Tensor]]) -> None:
        """Prepare to copy variants. `arrays` holds, for each name, the variants (K, ...) and the worlds' array (N, ...).
        Warp's current device must be that of the tensors.
        """
        self._variants = self._side_by_side({name: made for name, (made, _) in arrays.items()})
        widths = [made[0].numel() for made, _ in arrays.values()]
        place = [(number, at) for number, width in enumerate(widths) for at in range(width)]
        targets = [array for _, array in arrays.values()]
        self._inputs = [wp.from_torch(self._variants), wp.array(place, dtype=int, ndim=2), _rows(targets)]
        self._dim = (len(targets[0]), _threads())

    @staticmethod
    def _side_by_side(made: Mapping[str, Tensor]) -> Tensor:
        """Return the variants of all arrays as concatenated rows, (K, L)."""
        return torch.cat([array.reshape(len(array), -1) for array in made.values()], dim=1).contiguous()

    def replace(self, made: Mapping[str, Tensor]) -> None:
        """Overwrite the variants in place with the same number of new ones."""
        self._variants.copy_(self._side_by_side(made))

    def launch(self, mask: Tensor, chosen: Tensor) -> None:
        """Copy variant `chosen[i]` into each world i of `mask`. `mask` and `chosen` have the shape (N,)."""
        inputs = [self._dim[1], wp.from_torch(mask), wp.from_torch(chosen), *self._inputs]
        wp.launch(copy_variants, dim=self._dim, inputs=inputs)
