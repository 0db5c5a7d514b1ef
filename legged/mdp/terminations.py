"""Termination terms, which end episodes."""

from collections.abc import Callable, Mapping
from functools import reduce

import torch
from torch import Tensor

from legged.graph.step_graph import calling


class Terminations:
    """Termination terms of two kinds: failures, after which no reward is expected, and time-outs, after which the learner
    bootstraps with the value function.
    """

    def __init__(
        self,
        failures: Mapping[str, Callable[[], Tensor]],
        time_outs: Mapping[str, Callable[[], Tensor]],
        failed: Tensor,
        timed_out: Tensor,
        ended: Tensor,
    ) -> None:
        """Set the functions of failures and time-outs by term, each returning (N,) bool. Results are written to `failed`,
        `timed_out` and `ended`, (N,) bool each.
        """
        self._failures, self._time_outs = dict(failures), dict(time_outs)
        self.names = (*failures, *time_outs)
        self.failed, self.timed_out, self.ended = failed, timed_out, ended
        self.found: list[Tensor] = [torch.zeros_like(failed) for _ in self.names]
        """For each term a mask (N,) of the robots whose episodes it ended at the last step."""

    def evaluate(self, valid: Tensor, over: Tensor) -> None:
        """Evaluate all terms. Whatever the terms return, robots outside `valid` (N,) have failed, and robots of `over` (N,)
        are timed out. A failed robot is never also timed out.

        Raises:
            TermError: a term fails, or does not return (N,) bool.
        """
        failures = [self._value(name, function) for name, function in self._failures.items()]
        time_outs = [self._value(name, function) for name, function in self._time_outs.items()]
        self.found = failures + time_outs
        torch.logical_not(valid, out=self.failed)
        for found in failures:
            self.failed.logical_or_(found)
        torch.gt(reduce(torch.logical_or, time_outs, over), self.failed, out=self.timed_out)  # timed out and not failed
        torch.logical_or(self.failed, self.timed_out, out=self.ended)

    def settle(self) -> None:
        """Make failures and time-outs agree with `ended`. This is necessary if an override of `check_termination` writes only
        `reset_buf`, as in legged_gym. An episode that ends without a time-out has failed.
        """
        self.timed_out.logical_and_(self.ended)
        torch.gt(self.ended, self.timed_out, out=self.failed)

    def _value(self, name: str, function: Callable[[], Tensor]) -> Tensor:
        with calling(f"_terminate_{name}"):
            value = function()
            if value.shape != self.failed.shape or value.dtype != torch.bool:
                raise ValueError(
                    f"must return a tensor ({len(self.failed)},) of bool, got {tuple(value.shape)} of {value.dtype}"
                )
        return value
