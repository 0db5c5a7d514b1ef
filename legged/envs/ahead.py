"""Terms that are evaluated ahead of their turn, side by side, since they ask nothing that a step finds out meanwhile."""

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from legged.graph.step_graph import Branch, calling

Function = Callable[[], Tensor]


class Ahead:
    """Evaluates terms beside the step's main line, and beside each other, until somebody asks for their values.

    On a GPU a term is a few launches that wait for one another and not for arithmetic: one after the other, the rewards of a
    quadruped take a tenth of a step, beside the judgement which episodes end next to nothing.
    """

    def __init__(self, device: torch.device, lines: int) -> None:
        """Share the terms out among so many `lines` of work; without any, all have their turn."""
        self._lines = [Branch(device) for _ in range(lines)]
        self._functions: list[dict[str, Function]] = [{} for _ in range(lines)]
        self._found: dict[str, Tensor] = {}

    def take(self, prefix: str, functions: Mapping[str, Function], late: frozenset[str] = frozenset()) -> dict[str, Function]:
        """Return functions by term that give the same, but what was found ahead where it was. That is for terms of this
        package only, without those of `late`: one of a user's may keep numbers of its own, and so has its turn.
        """
        if not self._lines:
            return dict(functions)
        ahead = [name for name, function in functions.items() if name not in late and is_ours(function)]
        for place, name in enumerate(ahead):
            self._functions[place % len(self._lines)][prefix + name] = functions[name]
        return {n: self._taker(prefix + n, f) if n in ahead else f for n, f in functions.items()}

    def _taker(self, term: str, function: Function) -> Function:
        return lambda: self._found.pop(term) if term in self._found else function()

    def find(self) -> None:
        """Evaluate the terms as things are now. Runs beside what follows, up to `join`."""
        for line, functions in zip(self._lines, self._functions, strict=True):
            if functions:
                with line.fork():
                    for term, function in functions.items():
                        with calling(term):
                            self._found[term] = function()

    def join(self) -> None:
        """Let what follows wait for the values, and so take them."""
        for line, functions in zip(self._lines, self._functions, strict=True):
            if functions:
                line.join()


def is_ours(function: Callable[..., object]) -> bool:
    """Return whether a function is of this package."""
    return function.__module__.partition(".")[0] == __name__.partition(".")[0]
