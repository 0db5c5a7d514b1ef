"""Terms that end episodes, by name."""

from collections.abc import Callable, Mapping
from functools import reduce

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

    def evaluate(self, valid: Tensor, over: Tensor) -> None:
        """Judge the step: the robots outside `valid` (N,) have failed and those of `over` (N,) are out of time whatever the
        terms say. Who has failed is not out of time as well.
        """
        failures = [self._value(name, function) for name, function in self._failures.items()]
        time_outs = [self._value(name, function) for name, function in self._time_outs.items()]
        self.found = failures + time_outs
        torch.logical_not(valid, out=self.failed)
        for found in failures:
            self.failed.logical_or_(found)
        torch.gt(reduce(torch.logical_or, time_outs, over), self.failed, out=self.timed_out)  # the one and not the other
        torch.logical_or(self.failed, self.timed_out, out=self.ended)

    def _value(self, name: str, function: Callable[[], Tensor]) -> Tensor:
        with calling(f"_terminate_{name}"):
            value = function()
            if value.shape != self.failed.shape or value.dtype != torch.bool:
                raise ValueError(
                    f"must return a tensor ({len(self.failed)},) of bool, got {tuple(value.shape)} of {value.dtype}"
                )
        return value
