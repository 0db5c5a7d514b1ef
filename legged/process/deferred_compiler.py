"""Import of torch's compiler, deferred until a function is compiled.

`torch._dynamo` and its imports (sympy, torch._inductor, parts of torch.distributed) are a third of the modules that a
training imports and take a third of its start-up time, although this package compiles nothing. Other libraries import the
compiler nevertheless: tensordict marks some functions for the compiler, and torch's optimisers and dispatch modes exclude
their own code from compilation. A stand-in module records these marks. The first use of any other attribute imports the real
module and passes the marks on.
"""

import importlib
import importlib.metadata
import importlib.util
import sys
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any

NAME = "torch._dynamo"
KNOWN = ("2.13.",)
"""Prefixes of the versions of torch that the stand-in supports. With any other version the real module is imported as
usual.
"""


class DeferredCompiler(ModuleType):
    """Stand-in for `torch._dynamo` with the four functions that libraries call even if nothing is compiled. Any other
    attribute, and any submodule, comes from the real module.
    """

    def __init__(self, folder: Path) -> None:
        """Create the stand-in for the package in `folder`."""
        super().__init__(NAME, "A stand-in for torch's compiler.")
        spec = importlib.util.spec_from_file_location(NAME, folder / "__init__.py", submodule_search_locations=[str(folder)])
        # Some code reads attributes such as `__file__` of every module. They are set here without the real module.
        self.__spec__, self.__file__, self.__path__ = spec, str(folder / "__init__.py"), [str(folder)]
        self.__package__ = NAME
        self._marks: list[tuple[str, Any]] = []
        self._not_disabled: list[Any] = []
        self.allow_in_graph = partial(self._mark, "allow_in_graph")
        self.assume_constant_result = partial(self._mark, "assume_constant_result")

    def _mark(self, name: str, function: Any) -> Any:
        """Mark `function` by the compiler's function `name`. Until the real module is imported, only record the mark."""
        if not self.stands:
            return getattr(self.real(), name)(function)
        self._marks.append((name, function))
        return function

    def disable(self, function: Any = None, *args: Any, **kwargs: Any) -> Any:
        """Return the function unchanged if the caller is torch's own wrapper, which calls `disable` once and keeps the
        result. Pass any other call on to the real module.
        """
        if self.stands and sys._getframe(1).f_globals.get("__name__") == "torch._compile":
            self._not_disabled.append(function)
            return function
        return self.real().disable(function, *args, **kwargs)

    def graph_break(self, *args: Any, **kwargs: Any) -> None:
        """Do nothing before the real module is imported. Outside compiled code the real function does nothing either."""
        if not self.stands:
            self.real().graph_break(*args, **kwargs)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(f"module {NAME!r} has no attribute {name!r}")
        return getattr(self.real(), name)

    def real(self) -> ModuleType:
        """Return the real module; the first call imports it and passes the recorded marks on."""
        if not self.stands:
            return importlib.import_module(NAME)
        del sys.modules[NAME]
        real = importlib.import_module(NAME)
        for name, function in self._marks:
            getattr(real, name)(function)
        for function in self._not_disabled:
            # Remove the result that torch's wrapper has kept. At its next call the wrapper then asks the real module.
            vars(function).pop("__dynamo_disable", None)
        return real

    @property
    def stands(self) -> bool:
        """True until the real module is imported."""
        return sys.modules.get(NAME) is self


class _Submodules:
    """Finder and loader of the compiler's submodules. It first imports the compiler, which imports most of its submodules
    itself. Python then gets the submodule that is already imported, not a second copy.
    """

    def __init__(self, stand_in: DeferredCompiler) -> None:
        self._stand_in = stand_in
        self._specs: dict[str, ModuleSpec | None] = {}

    def find_spec(self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Return the spec of a submodule that the compiler's import has just loaded; None for any other module."""
        if not self._stand_in.stands or not name.startswith(f"{NAME}."):
            return None
        self._stand_in.real()
        if name not in sys.modules:
            return None
        self._specs[name] = sys.modules[name].__spec__
        return importlib.util.spec_from_loader(name, self)  # type: ignore[arg-type]

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return sys.modules[spec.name]

    def exec_module(self, module: ModuleType) -> None:
        module.__spec__ = self._specs[module.__name__]


def defer_compiler() -> None:
    """Install the stand-in if torch is installed in a known version, and neither torch nor its compiler is imported yet."""
    torch = importlib.util.find_spec("torch") if "torch" not in sys.modules else None
    if torch is None or torch.origin is None or NAME in sys.modules:
        return
    with suppress(importlib.metadata.PackageNotFoundError):  # torch without package metadata has no version
        if importlib.metadata.version("torch").startswith(KNOWN):
            stand_in = DeferredCompiler(Path(torch.origin).parent / "_dynamo")
            sys.modules[NAME] = stand_in
            sys.meta_path.insert(0, _Submodules(stand_in))  # type: ignore[arg-type]
