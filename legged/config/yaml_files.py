"""Conversion between YAML texts and plain values. An error message names the file and, if known, the line of the mistake."""

import functools
import re
from pathlib import Path
from typing import Any

import yaml

from legged.config.checks import shown
from legged.errors import ConfigError

MOST_BYTES = 250_000
"""Size of the largest file that is read [bytes]. A complete configuration has 6000 bytes. PyYAML needs seconds to
read 250 000 bytes."""
DEEPEST = 40
"""Deepest nesting of maps and lists."""
MOST_VALUES = 100_000
"""Largest number of values in a file after its aliases are expanded. A few lines of nested aliases can expand to billions."""


class _Loader(yaml.SafeLoader):
    """SafeLoader that also reads `1e-4` and `-.5` as numbers; PyYAML's SafeLoader reads them as texts. This class refuses
    repeated keys, whole numbers that differ between YAML 1.1 and 1.2, deep nesting, and too many values.
    """

    def __init__(self, source: str, text: str) -> None:
        super().__init__(text)
        self.name = source
        self._open = 0
        """Number of blocks around the present node."""
        self._sizes: dict[int, tuple[int, int]] = {}
        """Id of a node -> number of values in it and depth of its nesting, both after aliases are expanded."""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Compose a node as SafeLoader does, and measure it. Repeated keys are refused before merge keys (`<<`) are expanded,
        because a block may override a merged key.
        """
        is_alias = self.check_event(yaml.AliasEvent)
        self._open += 1
        if self._open > DEEPEST:  # a deeper nesting would exceed Python's recursion limit
            self._refuse(f"more than {DEEPEST} nested blocks", self.get_mark())
        node = super().compose_node(parent, index)
        self._open -= 1
        if is_alias:
            if id(node) not in self._sizes:
                self._refuse("an anchor refers to itself", self.get_mark())
            return node
        inner = node.value if isinstance(node, yaml.SequenceNode) else []
        if isinstance(node, yaml.MappingNode):
            self._refuse_key_given_twice(node)
            inner = [part for pair in node.value for part in pair]
        parts = [self._sizes[id(part)] for part in inner]
        size, depth = 1 + sum(part[0] for part in parts), 1 + max((part[1] for part in parts), default=0)
        if size > MOST_VALUES or depth > DEEPEST:
            limits = f"{MOST_VALUES} values or {DEEPEST} nested blocks"
            self._refuse(f"more than {limits} after aliases are expanded", self.get_mark())
        self._sizes[id(node)] = size, depth
        return node

    def _refuse_key_given_twice(self, node: yaml.MappingNode) -> None:
        seen = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):
                if (key.tag, key.value) in seen:
                    line = node.start_mark.line + 1
                    raise ConfigError(f"{self.name}: key '{key.value}' is given twice in the block from line {line}")
                seen.add((key.tag, key.value))

    def _refuse(self, problem: str, mark: Any) -> None:
        raise yaml.MarkedYAMLError(problem=problem, problem_mark=mark)

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int:
        """Construct a whole number. Refuse one that YAML 1.1 reads as octal (leading 0) or base 60 (colon)."""
        number: int = super().construct_yaml_int(node)
        digits = node.value.replace("_", "")
        if ":" in digits or (re.fullmatch(r"[-+]?0\d+", digits) and int(digits) != number):
            raise ValueError("YAML 1.1 and 1.2 read this number differently")
        return number

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """Construct an object as SafeLoader does. For an invalid number or date, raise an error that names the line."""
        try:
            return super().construct_object(node, deep)
        except (ValueError, OverflowError) as error:
            what = shown(node.value) if isinstance(node, yaml.ScalarNode) else "a value"
            raise yaml.MarkedYAMLError(problem=f"{what} cannot be read ({error})", problem_mark=node.start_mark) from error


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_yaml_int)


class _Dumper(yaml.SafeDumper):
    """SafeDumper that quotes texts such as '1e-4', which `_Loader` would read as numbers if they had no quotes."""


for _kind in (_Loader, _Dumper):
    _kind.add_implicit_resolver(
        "tag:yaml.org,2002:float",
        re.compile(r"^[-+]?(\d[\d_]*\.?[\d_]*|\.\d[\d_]*)[eE][-+]?\d+$|^[-+]\.\d[\d_]*$"),
        list("-+.0123456789"),
    )


def read_yaml(path: Path) -> dict[str, Any]:
    """Return the mapping in a YAML file.

    Raises:
        ConfigError: the file is missing, too large, malformed, or not a mapping.
    """
    try:
        with path.open("rb") as stream:
            content = stream.read(MOST_BYTES + 1)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from error
    if len(content) > MOST_BYTES:
        raise ConfigError(f"{path}: not a configuration: it is larger than {MOST_BYTES:,} bytes")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise ConfigError(f"{path}: not valid YAML: line {line} is not text in UTF-8") from error
    data = parse(text, str(path))
    if data is None:
        return {}
    if not isinstance(data, dict):
        raise ConfigError(f"{path}: expected a mapping of sections, got {type(data).__name__}")
    return data


def parse(text: str, source: str) -> Any:
    """Return the value of a YAML text. Error messages begin with `source`, such as the path of the text's file.

    Raises:
        ConfigError: the text is malformed, has an anchor that refers to itself, or is too large after aliases are expanded.
    """
    try:
        return yaml.load(text, functools.partial(_Loader, source))  # type: ignore[arg-type]
    except yaml.YAMLError as error:
        said, where = str(error), ""
        if isinstance(error, yaml.MarkedYAMLError):
            said = ", ".join(part for part in (error.context, error.problem) if part)
            mark = error.problem_mark or error.context_mark
            where = f" (line {mark.line + 1}, column {mark.column + 1})" if mark else ""
        raise ConfigError(f"{source}: not valid YAML: {' '.join(said.split())}{where}") from error


def dump(value: Any, **style: Any) -> str:
    """Return a plain value as a YAML text, which `parse` can read. `style` has options of yaml.dump."""
    text: str = yaml.dump(value, Dumper=_Dumper, **style)
    return text
