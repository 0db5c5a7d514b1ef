"""Evaluation of terms with the mark `@concurrent` on parallel CUDA streams, while terminations are determined."""

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from legged.envs.marks import is_concurrent
from legged.graph.step_graph import Branch, ForbidReads, calling

Function = Callable[[], Tensor]


class ConcurrentTerms:
    """Terms that run at the same time as `check_termination`, on several streams. On the CPU they run one after the other.

    On a GPU, a term launches a few short kernels, each of which waits for the previous one. If all rewards of a quadruped
    run on one stream, they take a tenth of a step. On parallel streams they add almost no time to the step.
    """

    def __init__(self, device: torch.device, streams: int, settled: Callable[[], Mapping[str, Tensor]]) -> None:
        """Distribute terms over `streams` CUDA streams. With 0 streams every term runs when it is called. `settled` returns,
        by name, the tensors that other code writes at the same time. Terms on the streams must not read these.
        """
        self._branches = [Branch(device) for _ in range(streams)]
        self._functions: list[dict[str, Function]] = [{} for _ in range(streams)]
        self._values: dict[str, Tensor] = {}
        self._settled = settled
        self._checked = False

    def add(self, prefix: str, functions: Mapping[str, Function]) -> dict[str, Function]:
        """Add the functions with the mark `@concurrent` to the streams. Return replacements of all `functions`, in the same
        order. At its first call after `start`, a replacement returns the value that `start` computed. At other calls it
        computes a new value.
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
        """Start to evaluate all terms from the current state, at the same time as the code between this call and `join`.

        Raises:
            TermError: a term reads a tensor of `settled`. Only the first call checks this.
        """
        for branch, functions in zip(self._branches, self._functions, strict=True):
            if functions:
                with branch.fork():
                    for term, function in functions.items():
                        with calling(term):
                            self._values[term] = function() if self._checked else self._check(function)
        self._checked = True

    def _check(self, function: Function) -> Tensor:
        """Return the value of a term, and check that it reads no tensor of `settled`."""
        forbidden = ForbidReads(
            self._settled(),
            "which may be written while terms with @concurrent run; remove @concurrent from this term, so that it runs after"
            " check_termination",
        )
        with forbidden:
            value = function()
        forbidden.judge(value)
        return value

    def join(self) -> None:
        """Let the following code wait for the values of all terms."""
        for branch, functions in zip(self._branches, self._functions, strict=True):
            if functions:
                branch.join()
