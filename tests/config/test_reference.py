"""The schema as text: every field is there, with what its declaration and the errors of its checks say."""

import dataclasses
import re

import pytest

from legged.config import TaskConfig
from legged.config.bounds import between, rescaled
from legged.config.legged import LeggedConfig
from legged.config.loader import from_dict, nest, to_dict
from legged.config.randomization import ForceConfig, KickConfig
from legged.config.reference import FieldText, bounds_of, fields
from legged.config.robot import TerrainConfig
from legged.config.units import exponents, is_unit
from legged.errors import ConfigError

EMPTY = {
    "domain_rand.kicks": KickConfig,
    "domain_rand.forces": ForceConfig,
    "domain_rand.observed_forces": ForceConfig,
}
"""Maps of sections that are empty by default."""
FIELDS = {text.path: text for text in fields(LeggedConfig)}


def leaves(data: dict, prefix: str = "") -> set[str]:
    """Dotted paths of a configuration's values; those of observation groups, and of what else is a map of sections, once."""
    found = set()
    for key, value in data.items():
        path = f"{prefix}{key}"
        sections = isinstance(value, dict) and path in FIELDS and FIELDS[path].is_section
        if path == "observations.groups":
            found |= leaves(value["actor"], f"{path}.<name>.")
        elif path in EMPTY:
            found |= {f"{path}.<name>.{field.name}" for field in dataclasses.fields(EMPTY[path])}
        elif sections:
            found |= leaves(value, f"{path}.")
        else:
            found.add(path)
    return found


LAW = "one of `P`, `V`, `T`"


def test_every_field_of_a_configuration_is_there():
    values = {path for path, text in FIELDS.items() if not text.is_section}
    assert values == leaves(to_dict(LeggedConfig())) - {"task"}


def test_every_field_has_a_meaning_and_a_default_that_is_accepted():
    for path, text in FIELDS.items():
        assert text.meaning, path
        if not text.is_section and "<name>" not in path:
            from_dict(nest(path, text.default))


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        ("sim.dt", ("a number", 0.005, "s", "at least 1e-05, at most 0.1")),
        ("env.num_envs", ("a whole number", 4096, "", "1 to 1048576")),
        ("control.control_type", (f"{LAW} or a map: {LAW} for each name", "P", "", "")),
        ("control.action_scale", ("a number or a map: a number for each name", 0.5, "rad", "above 0, at most 1e+06")),
        ("domain_rand.added_mass_range", ("[low, high]: 2 numbers", [-5.0, 5.0], "kg", "at most 10000 in size")),
        ("evaluation.yaw", ("a list of 3 numbers", [-1.0, 1.0, 0.5], "rad/s", "at most 20 in size")),
        ("terminations.time_outs", ("a list: text each", ["left_terrain"], "", "0 to 1000 items, without duplicates")),
        ("train.runner.run_name", ("text", "", "", "a name that a folder can have")),
    ],
)
def test_what_is_said_of_a_field(path, expected):
    text = FIELDS[path]
    assert (text.kind, text.default, text.unit, text.bounds) == expected


def test_bounds_that_are_said_are_those_that_are_checked():
    said = FIELDS["sim.impratio"].bounds
    assert said == "at least 0.001, at most 100000"
    for value, fine in ((0.001, True), (0.0009, False), (100000, True), (100001, False)):
        if fine:
            from_dict(nest("sim.impratio", value))
        else:
            with pytest.raises(ConfigError):
                from_dict(nest("sim.impratio", value))
    assert bounds_of({}) == ""


def test_units_of_fields_are_units_and_those_by_which_they_are_rescaled():
    """A factor on lengths grows with the robot, and has no unit."""
    assert all(is_unit(text.unit) for text in FIELDS.values() if text.unit)
    for path, text in FIELDS.items():
        if text.is_section or "<name>" in path:
            continue
        kind = LeggedConfig
        *sections, name = path.split(".")
        for section in sections:
            kind = type(getattr(kind(), section))
        metadata = {field.name: field.metadata for field in dataclasses.fields(kind)}[name]
        if "rescaled" in metadata and (kind, name) != (TerrainConfig, "scale"):
            assert text.unit, path
            assert exponents(text.unit) == exponents(metadata["rescaled"]), path


def test_units_for_the_reader_are_those_of_the_metadata():
    """The first unit in brackets of a field's docstring; nothing reads it, so it could differ without notice."""
    for path, text in FIELDS.items():
        said = [found for found in re.findall(r"\[([^\]]*)\]", text.meaning) if is_unit(found)]
        assert text.unit == (said[0] if said else ""), path


@dataclasses.dataclass(frozen=True)
class Own(TaskConfig):
    lowest_z: float = dataclasses.field(default=0.7, metadata=rescaled("m", between(0.1, 2)))
    """Height below which the hopper
    has fallen [m]."""
    silent: bool = False


def test_a_schema_of_a_user_is_described_too():
    found = {text.path: text for text in fields(Own)}
    said = FieldText("lowest_z", "a number", 0.7, "m", "0.1 to 2", "Height below which the hopper has fallen [m].")
    assert found["lowest_z"] == said
    assert found["silent"].meaning == ""
    assert "commands" not in found
