"""torch's compiler, imported when somebody compiles and not before.

`torch._dynamo` and what it imports (sympy, torch._inductor, parts of torch.distributed) are a third of all modules of a
training and a third of its start, and nothing here compiles. But it is imported in passing: tensordict marks some of its
functions for it, torch's optimisers and dispatch modes switch it off around themselves. Until somebody wants more of it than
that, a module stands in its place which notes these marks; then the real one is imported, and is given them.
"""

import importlib
import importlib.metadata
import importlib.util
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any

NAME = "torch._dynamo"
KNOWN = ("2.13.",)
"""Versions of torch whose use of its compiler the stand-in knows; under any other the real one is imported, as ever."""


class DeferredCompiler(ModuleType):
    """What stands in for `torch._dynamo`: the four functions that are called by code that does not compile. Anything else is
    asked of the real one, and so is a module inside it.
    """

    def __init__(self, folder: Path) -> None:
        """Stand in for the package in `folder`."""
        super().__init__(NAME, "A stand-in for torch's compiler.")
        spec = importlib.util.spec_from_file_location(NAME, folder / "__init__.py", submodule_search_locations=[str(folder)])
        # Who looks through all modules, for a file for instance, shall not cause an import.
        self.__spec__, self.__file__, self.__path__ = spec, str(folder / "__init__.py"), [str(folder)]
        self.__package__ = NAME
        self._marks: list[tuple[str, Any]] = []
        self._not_disabled: list[Any] = []

    def allow_in_graph(self, function: Any) -> Any:
        """Note that a function is to be traced as one piece."""
        return self._mark("allow_in_graph", function)

    def assume_constant_result(self, function: Any) -> Any:
        """Note that a function gives the same in all calls."""
        return self._mark("assume_constant_result", function)

    def _mark(self, name: str, function: Any) -> Any:
        if not self.stands:
            return getattr(self.real(), name)(function)
        self._marks.append((name, function))
        return function

    def disable(self, function: Any = None, *args: Any, **kwargs: Any) -> Any:
        """Leave a function as it is for torch's own wrapper, which asks when it is called first and keeps what it is given;
        nobody else is served before the compiler is there.
        """
        if self.stands and sys._getframe(1).f_globals.get("__name__") == "torch._compile":
            self._not_disabled.append(function)
            return function
        return self.real().disable(function, *args, **kwargs)

    def graph_break(self, *args: Any, **kwargs: Any) -> None:
        """Do nothing: outside of what is being compiled, the real one does nothing either."""
        if not self.stands:
            self.real().graph_break(*args, **kwargs)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(f"module {NAME!r} has no attribute {name!r}")
        return getattr(self.real(), name)

    def real(self) -> ModuleType:
        """Return the real module, imported by the first who asks, and told of the marks."""
        if not self.stands:
            return importlib.import_module(NAME)
        del sys.modules[NAME]
        real = importlib.import_module(NAME)
        for name, function in self._marks:
            getattr(real, name)(function)
        for function in self._not_disabled:
            vars(function).pop("__dynamo_disable", None)  # torch's wrapper will ask again
        return real

    @property
    def stands(self) -> bool:
        """Whether nobody has wanted the real module yet."""
        return sys.modules.get(NAME) is self


class _Submodules:
    """Finds the modules inside the compiler by importing it first, which imports most of them."""

    def __init__(self, stand_in: DeferredCompiler) -> None:
        self._stand_in = stand_in

    def find_spec(self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Find a module that has just been imported in passing; all others are left to Python."""
        if not self._stand_in.stands or not name.startswith(f"{NAME}."):
            return None
        self._stand_in.real()
        module = sys.modules.get(name)
        return None if module is None else importlib.util.spec_from_loader(name, _Imported(module))  # type: ignore[arg-type]


class _Imported:
    """Gives Python a module that there is, in place of a second one."""

    def __init__(self, module: ModuleType) -> None:
        self._module, self._spec = module, module.__spec__

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return self._module

    def exec_module(self, module: ModuleType) -> None:
        module.__spec__ = self._spec


def defer_compiler() -> None:
    """Put the stand-in where the compiler would be, unless it or torch has been imported, or torch is missing or of a version
    that is not known.
    """
    torch = importlib.util.find_spec("torch") if "torch" not in sys.modules else None
    if torch is None or torch.origin is None or NAME in sys.modules or not _version().startswith(KNOWN):
        return
    stand_in = DeferredCompiler(Path(torch.origin).parent / "_dynamo")
    sys.modules[NAME] = stand_in
    sys.meta_path.insert(0, _Submodules(stand_in))  # type: ignore[arg-type]


def _version() -> str:
    """Return the version of torch that is installed, without importing it; nothing if its package does not say."""
    try:
        return importlib.metadata.version("torch")
    except importlib.metadata.PackageNotFoundError:
        return ""
