"""Terms that end episodes, by name."""

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from legged.graph.step_graph import calling


class Terminations:
    """The terms that end episodes: failures, after which nothing is to be gained, and time-outs, which are nobody's fault."""

    def __init__(
        self,
        failures: Mapping[str, Callable[[], Tensor]],
        time_outs: Mapping[str, Callable[[], Tensor]],
        failed: Tensor,
        timed_out: Tensor,
        ended: Tensor,
    ) -> None:
        """Take functions by term, each giving (N,) bool; write results to `failed`, `timed_out` and `ended`, (N,) bool."""
        self._failures, self._time_outs = dict(failures), dict(time_outs)
        self.names = (*failures, *time_outs)
        self.failed, self.timed_out, self.ended = failed, timed_out, ended
        self.found: list[Tensor] = [torch.zeros_like(failed) for _ in self.names]
        """For each term the robots (N,) that it has ended at the last step."""

    def evaluate(self, broken: Tensor, over: Tensor) -> None:
        """Judge the step: the robots of `broken` (N,) have failed and those of `over` (N,) are out of time whatever the terms
        say. Who has failed is not out of time as well.
        """
        found = []
        failed, timed_out = broken, over
        for name, function in self._failures.items():
            found.append(self._value(name, function))
            failed = failed | found[-1]
        for name, function in self._time_outs.items():
            found.append(self._value(name, function))
            timed_out = timed_out | found[-1]
        self.found = found
        self.failed.copy_(failed)
        self.timed_out.copy_(timed_out & ~failed)
        torch.logical_or(self.failed, self.timed_out, out=self.ended)

    def _value(self, name: str, function: Callable[[], Tensor]) -> Tensor:
        with calling(f"_terminate_{name}"):
            value = function()
            if value.shape != self.failed.shape or value.dtype != torch.bool:
                raise ValueError(
                    f"must return a tensor ({len(self.failed)},) of bool, got {tuple(value.shape)} of {value.dtype}"
                )
        return value
