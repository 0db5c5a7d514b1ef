"""Base class of a configuration's sections, which can be read as those of legged_gym's forks."""

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

from legged.config.origins import Origins
from legged.errors import suggest


@dataclass(frozen=True)
class Section:
    """A configuration or one of its sections. `cfg.rewards.name` is the number `custom.name` if the section has no setting of
    that name. `cfg["rewards"]` is `cfg.rewards`.
    """

    def __getitem__(self, name: str) -> Any:
        return getattr(self, name)

    if not TYPE_CHECKING:  # type checkers do not see __getattr__, so they still report misspelled settings

        def __getattr__(self, name: str) -> Any:
            if name.startswith("_"):
                raise AttributeError(name)
            custom, own, origins = vars(self).get("_custom", ({}, "the configuration", Origins()))
            if name in custom:
                return custom[name]
            near = suggest(name, [f.name for f in fields(self)] + list(custom), "settings")
            raise AttributeError(f"{origins.where('custom')} has no '{name}', and neither has {own}{near}")
