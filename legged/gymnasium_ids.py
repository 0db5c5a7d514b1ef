"""Gymnasium ids of our tasks: `legged/<task>`.

This module does not import Gymnasium. The ids are registered as soon as other code imports Gymnasium. Gymnasium imports
our classes by name when it makes an environment.
"""

import importlib.util
import sys
from collections.abc import Callable, Iterable, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

NAMESPACE = "legged"
"""Part of an id before the slash."""


def announce(names: Callable[[], Iterable[str]]) -> None:
    """Register the tasks that `names` returns, now or as soon as Gymnasium is imported."""
    if "gymnasium" in sys.modules:
        add_ids(names())
    else:
        sys.meta_path.insert(0, _AtImport(names))


def add_ids(names: Iterable[str]) -> None:
    """Register the tasks `names` with Gymnasium and replace earlier ids of the same names.
    Do nothing before Gymnasium is imported.

    Gymnasium refuses names with characters other than letters, digits and `_:.-`, and refuses `x` together with `x-v1`. A
    refused task gets no id.
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
    """Finder that lets Python import Gymnasium as usual, and registers our tasks afterwards."""

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
    """Loader that runs Gymnasium's loader, then registers our tasks and removes the finder."""

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
