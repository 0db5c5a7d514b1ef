"""Stands in for what mjlab imports and a headless training does not need, such as viewers, where it is not installed."""

import importlib.util
import sys
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any
from unittest.mock import MagicMock

UNNEEDED = ("OpenGL", "git", "glfw", "imageio_ffmpeg", "mediapy", "mjviser", "prettytable", "torchrunx", "torchvision")
UNNEEDED += ("trimesh", "tyro", "viser", "wandb")
"""Packages for pictures, windows, command lines and logging on the web."""


class _Module(ModuleType):
    """A module that has whatever is asked of it, as a mock."""

    __path__: list[str] = []

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        if (self.__name__, name) == ("git", "Repo"):  # rsl-rl leaves out a repository that cannot be opened
            return MagicMock(side_effect=OSError("git is not installed"))
        found = MagicMock(name=name)
        found.return_value.get_string.return_value = ""  # what mjlab prints as tables
        return found


class _Finder(MetaPathFinder, Loader):
    """Finds the modules of packages that are missing."""

    def __init__(self, missing: list[str]) -> None:
        self._missing = missing

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        missing = any(fullname == name or fullname.startswith(f"{name}.") for name in self._missing)
        return ModuleSpec(fullname, self, is_package=True) if missing else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return _Module(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        pass


def stand_in() -> list[str]:
    """Let the packages of UNNEEDED that are not installed be imported all the same; return their names."""
    missing = [name for name in UNNEEDED if importlib.util.find_spec(name) is None]
    if "glfw" in missing:
        missing.append("mujoco.viewer")  # needs a window of glfw while it is imported
    if "mjviser" in missing:
        missing.append("mjlab.viewer.viser")  # derives classes from it
    sys.meta_path.insert(0, _Finder(missing))
    return missing
