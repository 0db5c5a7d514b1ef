"""Who set which field of a configuration, for errors that name a file."""

from collections.abc import Mapping


class Origins(dict[str, str]):
    """Dotted path -> who set it: 'cfg/mine.yaml', 'cfg/mine.yaml: cpu', 'command line'."""

    def __init__(self, other: Mapping[str, str] | None = None) -> None:
        """Copy another one, or begin with nothing."""
        super().__init__(other or {})
        self.reference_robots: tuple[str, ...] = other.reference_robots if isinstance(other, Origins) else ()
        """Robots for which files say that their numbers are written, each once."""
        self.rescaled: frozenset[str] = other.rescaled if isinstance(other, Origins) else frozenset()
        """Sources whose numbers were carried from another robot (rescale.py)."""

    def note(self, path: str, source: str) -> None:
        """Note that `source` set `path`, and forget what it replaces, above and below."""
        for old in [key for key in self if key.startswith(f"{path}.") or path.startswith(f"{key}.")]:
            del self[old]
        self[path] = source

    def of(self, path: str) -> str:
        """Return the source of `path`; for a section, all sources that set one of its keys; 'the default' when nobody did.

        An item of a list, `path[2]`, comes from whoever gave the list.
        """
        path = path.partition("[")[0]
        found = [source for key, source in self.items() if key == path or key.startswith(f"{path}.")]
        return ", ".join(dict.fromkeys(found)) or "the default"

    def where(self, path: str) -> str:
        """Return 'cfg/mine.yaml: terrain.border_size', as an error about the value at `path` begins."""
        return f"{self.of(path)}: {path}"
