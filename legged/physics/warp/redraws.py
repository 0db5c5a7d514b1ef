"""What was drawn again into the arrays of mujoco-warp's model, within a step: a launch for each array, no host read."""

from collections.abc import Mapping

import numpy as np
import torch
import warp as wp
from torch import Tensor

from legged.physics.fields import FIELDS, own_array
from legged.physics.randomized_model import RandomizedModel

HOW = {"set": 0, "add": 1, "scale": 2}
BOUNCE = {"": 0, "ratio": 1, "inverse": 2}
SCALE, INVERSE = wp.constant(HOW["scale"]), wp.constant(BOUNCE["inverse"])

wp.set_module_options({"enable_backward": False})


@wp.kernel
def write_drawn(
    mask: wp.array[wp.bool],
    drawn: wp.array2d[float],
    element: wp.array[int],
    own: wp.array[float],
    first: wp.array[int],
    column: wp.array[int],
    how: wp.array[int],
    bounce: wp.array[int],
    weight: wp.array[float],
    ratios: wp.array[float],
    array: wp.array2d[float],
):
    """One thread a world and number of the array that changes: the model's own, changed by one field after the other."""
    world, place = wp.tid()
    if not mask[world]:
        return
    number = own[place]
    for k in range(first[place], first[place + 1]):
        value = drawn[world, column[k]]
        if bounce[k] > 0:
            points = ratios.shape[0] - 1
            at = wp.clamp(value, 0.0, 1.0) * float(points)
            low = wp.min(int(at), points - 1)
            value = ratios[low] + (at - float(low)) * (ratios[low + 1] - ratios[low])
            if bounce[k] == INVERSE:
                value = 1.0 / value
        value = value * weight[k]
        if how[k] == SCALE:
            number = number * value
        elif how[k] == 1:
            number = number + value
        else:
            number = value
    array[world, element[place]] = number


@wp.kernel
def copy_variants(mask: wp.array[wp.bool], chosen: wp.array[wp.int64], variants: wp.array2d[float], array: wp.array2d[float]):
    """One thread a world and number."""
    world, place = wp.tid()
    if mask[world]:
        array[world, place] = variants[int(chosen[world]), place]


class Redraws:
    """Launches that write what is in `drawn` into arrays of the model."""

    def __init__(
        self, of: RandomizedModel, drawn: Tensor, columns: Mapping[str, slice], arrays: Mapping[str, Tensor]
    ) -> None:
        """Write into `arrays`, (N, ...) each, from `drawn` (N, V), where `columns` says which are those of each field. Call
        with their device as Warp's current one.
        """
        ratios = of.bounces.table if of.bounces is not None else torch.zeros(2, device=drawn.device)
        self._drawn, self._ratios = wp.from_torch(drawn), wp.from_torch(ratios)
        self._launches = [self._prepared(of, name, columns, array) for name, array in arrays.items()]

    def _prepared(
        self, of: RandomizedModel, name: str, columns: Mapping[str, slice], array: Tensor
    ) -> tuple[tuple[int, int], list[wp.array], wp.array]:
        """Return dimensions, tables and target of the launch for one array."""
        own = own_array(of.model, name)
        width = int(np.prod(own.shape[1:], dtype=int))
        changes: dict[int, list[tuple[int, int, int, float]]] = {}
        for field, rows in of.rows.items():
            for change in FIELDS[field].changes:
                if change.array != name or field not in columns:
                    continue
                weights = np.ones(len(own)) if change.weight is None else change.weight(of.model)
                each = columns[field].stop - columns[field].start > 1
                for k, row in enumerate(rows.tolist()):
                    column = columns[field].start + (k if each else 0)
                    for place in range(width) if change.column is None else (change.column,):
                        entry = (column, HOW[change.how], BOUNCE[change.bounce], float(weights[row]))
                        changes.setdefault(row * width + place, []).append(entry)
        entries = [entry for found in changes.values() for entry in found]
        first = np.cumsum([0, *(len(found) for found in changes.values())])
        tables = [
            wp.array(list(changes), dtype=int),
            wp.array(own.ravel()[list(changes)], dtype=float),
            wp.array(first, dtype=int),
            *(wp.array([entry[k] for entry in entries], dtype=int) for k in range(3)),
            wp.array([entry[3] for entry in entries], dtype=float),
        ]
        return (len(array), len(changes)), tables, wp.from_torch(array.view(len(array), -1))

    def launch(self, mask: Tensor) -> None:
        """Write the rows of the worlds of `mask` (N,)."""
        due = wp.from_torch(mask)
        for dim, tables, array in self._launches:
            wp.launch(write_drawn, dim=dim, inputs=[due, self._drawn, *tables, self._ratios], outputs=[array])


class Variants:
    """Arrays of models with constants derived, of which worlds take one's."""

    def __init__(self, arrays: Mapping[str, tuple[Tensor, Tensor]]) -> None:
        """Keep of each array the variants (K, ...), and where the worlds have it, (N, ...)."""
        self._variants = {name: made.reshape(len(made), -1).contiguous() for name, (made, _) in arrays.items()}
        self._pairs = [
            (wp.from_torch(self._variants[name]), wp.from_torch(array.view(len(array), -1)))
            for name, (_, array) in arrays.items()
        ]

    def replace(self, made: Mapping[str, Tensor]) -> None:
        """Take other variants, as many, at the same address."""
        for name, array in made.items():
            self._variants[name].copy_(array.reshape(len(array), -1))

    def launch(self, mask: Tensor, chosen: Tensor) -> None:
        """Copy those `chosen` (N,) into the worlds of `mask` (N,)."""
        due, numbers = wp.from_torch(mask), wp.from_torch(chosen)
        for variants, array in self._pairs:
            wp.launch(copy_variants, dim=array.shape, inputs=[due, numbers, variants], outputs=[array])
