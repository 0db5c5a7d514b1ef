"""Marks on methods of a task. `@unit` gives a term's unit; `@concurrent` lets a term run while terminations are determined.

A subclass that overrides a method does not inherit its marks. They have to be written above the override too.
"""

from collections.abc import Callable
from typing import Any, TypeVar

from legged.config.units import BASE, is_unit
from legged.errors import ConfigError

Method = TypeVar("Method", bound=Callable[..., Any])


def unit(text: str) -> Callable[[Method], Method]:
    """Declare the unit of a term's values, such as "m^2/s^2"; "1" for a plain number. If columns have different units, list
    the units, separated by commas. Only the first one is used to rescale settings for another robot (docs/scaling.md).

    Raises:
        ConfigError: the text is not a unit.
    """
    if not isinstance(text, str) or not is_unit(text):
        raise ConfigError(
            f'@unit({text!r}): expected powers and products of {", ".join(BASE)}, such as @unit("m^2/s^2") or'
            ' @unit("rad/s, m"); a plain number has @unit("1")'
        )

    def mark(method: Method) -> Method:
        vars(getattr(method, "__func__", method))["_unit"] = text
        return method

    return mark


def unit_of(method: Any) -> str | None:
    """Return the unit that a term declares; None without `@unit`."""
    return getattr(method, "_unit", None)


def concurrent(method: Method) -> Method:
    """Let a reward, a termination or a metric run on a parallel stream while `check_termination` determines which episodes
    end.

    Such a term must not read `terminated_buf`, `time_out_buf`, `reset_buf`, `valid` or `rew_buf`, which are not written yet.
    If it does, the first step raises a TermError. Such a term must also not write a tensor that another term reads. Terms
    without the mark run after `check_termination`, in the order of the configuration.

    BaseTask's hooks `check_termination`, `measure` and `compute_reward` have the mark too, because they write no tensor that
    a term with the mark reads. If a class overrides one of them without the mark, all terms run as if they had no mark.
    """
    vars(getattr(method, "__func__", method))["_concurrent"] = True
    return method


def is_concurrent(method: Any) -> bool:
    """Return whether a method has the mark `@concurrent`."""
    return getattr(method, "_concurrent", False)
