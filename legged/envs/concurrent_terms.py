"""Evaluation of terms with the mark `@concurrent` on parallel CUDA streams, before terminations are settled."""

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from legged.envs.marks import is_concurrent
from legged.graph.step_graph import Branch, ForbidReads, calling

Function = Callable[[], Tensor]


class ConcurrentTerms:
    """Terms that are evaluated at the same time as `check_termination`, on several streams; on the CPU one after the other.

    On a GPU a term is a few launches that wait for one another and not for arithmetic: one after the other, the rewards of a
    quadruped take a tenth of a step; on parallel streams they take next to nothing.
    """

    def __init__(self, device: torch.device, streams: int, settled: Callable[[], Mapping[str, Tensor]]) -> None:
        """Share the terms out among so many streams; without any, all run when they are called. `settled` returns by name the
        tensors that are written meanwhile, which no term here may read.
        """
        self._branches = [Branch(device) for _ in range(streams)]
        self._functions: list[dict[str, Function]] = [{} for _ in range(streams)]
        self._values: dict[str, Tensor] = {}
        self._settled = settled
        self._checked = False

    def add(self, prefix: str, functions: Mapping[str, Function]) -> dict[str, Function]:
        """Take the functions by term that have the mark `@concurrent`. Return functions by term that give the same values as
        those given, in the same order: a value of `start` once, otherwise a new one.
        """
        if not self._branches:
            return dict(functions)
        marked = [name for name, function in functions.items() if is_concurrent(function)]
        for place, name in enumerate(marked):
            self._functions[place % len(self._branches)][prefix + name] = functions[name]
        return {n: self._value_of(prefix + n, f) if n in marked else f for n, f in functions.items()}

    def _value_of(self, term: str, function: Function) -> Function:
        return lambda: self._values.pop(term) if term in self._values else function()

    def start(self) -> None:
        """Evaluate the terms as things are now, at the same time as what follows, up to `join`.

        Raises:
            TermError: at the first call, if a term reads what is settled meanwhile.
        """
        for branch, functions in zip(self._branches, self._functions, strict=True):
            if functions:
                with branch.fork():
                    for term, function in functions.items():
                        with calling(term):
                            self._values[term] = function() if self._checked else self._check(function)
        self._checked = True

    def _check(self, function: Function) -> Tensor:
        """Return the value of a term that reads nothing of what is settled meanwhile."""
        forbidden = ForbidReads(
            self._settled(),
            "which is not settled yet for a term with @concurrent: remove that mark, so that the term runs after"
            " check_termination",
        )
        with forbidden:
            value = function()
        forbidden.judge(value)
        return value

    def join(self) -> None:
        """Let what follows wait for the values."""
        for branch, functions in zip(self._branches, self._functions, strict=True):
            if functions:
                branch.join()
