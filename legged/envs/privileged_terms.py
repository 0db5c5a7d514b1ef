"""Privileged observations: randomised properties, which a critic or a teacher may observe and a robot cannot measure."""

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from legged.config.randomization import DrawConfig, ForceConfig, draw_of
from legged.config.robot import RobotConfig
from legged.envs.marks import unit
from legged.errors import ConfigError
from legged.mdp.mirror_images import MirrorKind
from legged.mdp.randomization import Randomization
from legged.physics.fields import FIELDS, Field

PREFIX = "rand_"


class PrivilegedTerms:
    """Mixin of BaseTask with the terms `_obs_rand_<field>`, one for each field of `physics.FIELDS`, and `_obs_push_force`.

    A field's term is (N, 1), or (N, rows) if every joint, body or shape has its own number. The ends of the configured range
    are observed as -1 and 1, even while the range is still widening. With `log_uniform` the scale is logarithmic. A field in
    `domain_rand.observed_ranges` that `domain_rand.ranges` does not draw is observed at its neutral value.
    """

    cfg: Any
    randomization: Randomization
    field_rows: dict[str, int]
    num_envs: int
    device: Any
    disturbances: Any

    @unit("1")
    def _obs_push_force(self) -> Tensor:
        """External forces on bodies (domain_rand.forces): x, y and z of each force in the world frame, as shares of the
        largest component that can be drawn [1].
        """
        found = []
        for name, cfg in observed_forces(self.cfg).items():
            acting = self.disturbances.forces.get(name)
            nothing = torch.zeros(self.num_envs, 3, device=self.device)
            found.append(nothing if acting is None else acting.force / largest_of(cfg))
        return torch.cat(found, dim=1)


def _mirror_kind(name: str, field: Field) -> MirrorKind:
    if name == "joint_offset":
        return "joints"
    if name.endswith("_y"):
        return "sideways"
    return "of_joints" if field.law or name.startswith(("joint_", "motor_", "actuator_")) else "scalar"


MIRROR_KINDS: dict[str, MirrorKind] = {f"{PREFIX}{name}": _mirror_kind(name, field) for name, field in FIELDS.items()}
"""Privileged observation -> kind of its mirror image."""
MIRROR_KINDS["push_force"] = "vectors"


def observed_forces(cfg: RobotConfig) -> dict[str, ForceConfig]:
    """Return name -> force. Forces that are only in `domain_rand.observed_forces` do not act, and are observed as 0."""
    return {**cfg.domain_rand.observed_forces, **cfg.domain_rand.forces}


def largest_of(force: ForceConfig) -> float:
    """Return the largest absolute value that can be drawn for a component [N]. Observed forces are divided by this value."""
    return max(abs(end) for axis in (force.x, force.y, force.z, force.size) for end in axis)


def observed(cfg: Any, name: str) -> DrawConfig | None:
    """Return the distribution whose range scales the observation of a field to [-1, 1]. Return None if the configuration has
    no range for the field.
    """
    rand = cfg.domain_rand
    entry = rand.observed_ranges.get(name, rand.ranges.get(name))
    if entry is None and name == "friction" and getattr(rand, "randomize_friction", False):
        entry = rand.friction_range
    if entry is None and name == "added_base_mass" and getattr(rand, "randomize_base_mass", False):
        entry = rand.added_mass_range
    return None if entry is None else draw_of(entry)


def normalised(values: Tensor, draw: DrawConfig) -> Tensor:
    """Return `values` rescaled so that the range of `draw` becomes [-1, 1]; 0 if the ends of the range are equal."""
    low, high = draw.range
    if draw.distribution == "log_uniform":
        values, low, high = values.clamp(min=1e-9).log(), math.log(low), math.log(high)
    return (values - 0.5 * (low + high)) * (2.0 / (high - low) if high > low else 0.0)


def _observer(name: str, field: Field) -> Callable[[Any], Tensor]:
    def observe(self: Any) -> Tensor:
        draw = observed(self.cfg, name)
        if draw is None:
            raise ConfigError(
                f"_obs_{PREFIX}{name}: '{name}' has no range in domain_rand.ranges or observed_ranges, and can't be observed"
            )
        drawn = self.randomization.fields.get(name)
        if drawn is None:
            each = field.each if draw.each is None else draw.each
            drawn = torch.full((self.num_envs, self.field_rows[name] if each else 1), field.neutral, device=self.device)
        return normalised(drawn.view(self.num_envs, -1), draw)

    observe.__name__ = f"_obs_{PREFIX}{name}"
    observe.__doc__ = f"{field.meaning[0].upper()}{field.meaning[1:]}, from -1 to 1 over its range [1]."
    return unit("1")(observe)


for _name, _field in FIELDS.items():
    setattr(PrivilegedTerms, f"_obs_{PREFIX}{_name}", _observer(_name, _field))
