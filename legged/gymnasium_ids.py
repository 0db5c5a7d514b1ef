"""What Gymnasium calls our tasks: `legged/<task>`. Gymnasium is not imported here; it is told as soon as somebody else does,
and finds our classes by their names when an environment is made.
"""

import importlib.util
import sys
from collections.abc import Callable, Iterable, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

NAMESPACE = "legged"
"""What stands before the slash."""


def announce(names: Callable[[], Iterable[str]]) -> None:
    """Register the tasks that `names` lists: now, if Gymnasium is imported already, else when it is."""
    if "gymnasium" in sys.modules:
        add_ids(names())
    else:
        sys.meta_path.insert(0, _AtImport(names))


def add_ids(names: Iterable[str]) -> None:
    """Register these tasks, again if they are already; nothing happens while Gymnasium is not imported. It has no id for a
    name with letters other than a-z, 0-9 and `_:.-`, nor for both of `x` and `x-v1`: such a task has none.
    """
    gymnasium = sys.modules.get("gymnasium")
    if gymnasium is None:
        return
    for name in names:
        gymnasium.registry.pop(f"{NAMESPACE}/{name}", None)
        try:
            gymnasium.register(
                id=f"{NAMESPACE}/{name}",
                entry_point="legged.gymnasium_envs:TaskEnv",
                vector_entry_point="legged.gymnasium_envs:TaskVectorEnv",
                kwargs={"task": name},
            )
        except gymnasium.error.Error:
            continue


class _AtImport(MetaPathFinder):
    """Finds Gymnasium as it would be found anyway, and registers our tasks once it has been imported."""

    def __init__(self, names: Callable[[], Iterable[str]]) -> None:
        self.names = names
        self._looking = False

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != "gymnasium" or self._looking:
            return None
        self._looking = True
        try:
            spec = importlib.util.find_spec(fullname)
        finally:
            self._looking = False
        if spec is not None and spec.loader is not None:
            spec.loader = _AndThen(spec.loader, self)
        return spec


class _AndThen(Loader):
    """Another loader, and what follows it."""

    def __init__(self, loader: Any, finder: _AtImport) -> None:
        self._loader, self._finder = loader, finder

    def __getattr__(self, name: str) -> Any:
        return getattr(self._loader, name)

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        return self._loader.create_module(spec)  # type: ignore[no-any-return]

    def exec_module(self, module: ModuleType) -> None:
        self._loader.exec_module(module)
        if self._finder in sys.meta_path:
            sys.meta_path.remove(self._finder)
        add_ids(self._finder.names())
