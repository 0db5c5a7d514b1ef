"""Sources of a configuration's fields, for errors that name a file."""

from legged.errors import ConfigError


class Origins(dict[str, str]):
    """Map: dotted path -> source of its value, such as 'cfg/mine.yaml', 'cfg/mine.yaml: cpu' or 'command line'."""

    reference_robots: tuple[str, ...] = ()
    """Reference robots that files name in `written_for`, each once."""
    rescaled: frozenset[str] = frozenset()
    """Sources whose numbers were rescaled from a reference robot (rescale.py)."""

    def note(self, path: str, source: str) -> None:
        """Record that `source` set `path`, and remove the entries of the path's parents and children."""
        for old in [key for key in self if key.startswith(f"{path}.") or path.startswith(f"{key}.")]:
            del self[old]
        self[path] = source

    def of(self, path: str) -> str:
        """Return the source of `path`, or 'the default' if no source is recorded. For a section, return all sources that set
        one of its keys.

        The source of an item of a list, `path[2]`, is the source of the list.
        """
        path = path.partition("[")[0]
        found = [source for key, source in self.items() if key == path or key.startswith(f"{path}.")]
        return ", ".join(dict.fromkeys(found)) or "the default"

    def where(self, path: str) -> str:
        """Return the prefix of an error message about `path`, such as 'cfg/mine.yaml: terrain.border_size'."""
        return f"{self.of(path)}: {path}"

    def error(self, path: str, text: str) -> ConfigError:
        """Return the error that the setting `path` is wrong. `text` gives the reason, the value and the allowed values."""
        return ConfigError(f"{self.where(path)}: {text}")
