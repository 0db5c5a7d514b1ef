"""User-defined modules that register tasks: their import by name or file, and reports of their errors."""

import importlib
import importlib.util
import sys
import traceback
from pathlib import Path

from legged.config.checks import plain_path, shown
from legged.errors import ConfigError
from legged.process.paths import exists

_IMPORTED: set[str] = set()
"""Names of the modules that were run from files."""
_FOLDERS: set[str] = set()
"""Folders of the modules that were run from files. After an import by module name, also the working directory."""


def run_module(name: str) -> None:
    """Import a user-defined module, which registers its tasks. `name` is the name of a module ('my_tasks') or its file
    ('path/my_tasks.py'). The module can import other modules in its folder.

    Raises:
        ConfigError: the module can't be found, or fails.
    """
    path = Path(name)
    is_file = path.suffix == ".py"
    if is_file and not (exists(path) and path.is_file()):
        raise ConfigError(f"--import: there is no file {shown(name)}")
    folder = str(path.resolve().parent if is_file else Path.cwd())
    _FOLDERS.add(folder)
    find_modules_in(folder)
    before = set(sys.modules)
    try:
        _run(path) if is_file else importlib.import_module(name)
    except (Exception, SystemExit) as error:
        for module in set(sys.modules) - before:  # remove modules whose import may be incomplete
            file = getattr(sys.modules[module], "__file__", None)
            if file and str(Path(file).parent) == folder:
                del sys.modules[module]
        raise _described(name, is_file, folder, error) from error


def find_modules_in(folder: str) -> None:
    """Add a folder to Python's search path, unless the path contains it already. For an installed program such as `legged`,
    Python does not add the working directory itself.
    """
    if folder not in sys.path:
        sys.path.insert(0, folder)


def is_of_a_module(file: str) -> bool:
    """Return True if a code file is in or below the folder of a user-defined module, and not in site-packages."""
    path = Path(file)
    return any(path.is_relative_to(folder) for folder in _FOLDERS) and "site-packages" not in path.parts


def _run(path: Path) -> None:
    """Run a file as the module with the file's name.

    Raises:
        ConfigError: another module with that name is loaded.
    """
    loaded = sys.modules.get(path.stem)
    if loaded is not None and path.stem not in _IMPORTED:
        file = getattr(loaded, "__file__", None) or "built in"
        if file != str(path.resolve()):
            raise ConfigError(f"a module '{path.stem}' is loaded already ({file}); give the file another name")
    spec = importlib.util.spec_from_file_location(path.stem, path.resolve())
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    _IMPORTED.add(path.stem)
    spec.loader.exec_module(module)


def _described(name: str, is_file: bool, folder: str, error: BaseException) -> ConfigError:
    """Return a ConfigError that says that the module `name` does not exist, or why and in which line it failed."""
    if isinstance(error, ModuleNotFoundError) and not is_file and f"{name}.".startswith(f"{error.name}."):
        return ConfigError(f"--import: there is no module {shown(name)}; give a module name, or a path that ends in .py")
    text = " ".join(str(error.msg if isinstance(error, SyntaxError) else error).split())
    kind = "" if isinstance(error, ConfigError) else f"{type(error).__name__}: "
    return ConfigError(f"--import: {plain_path(name)}{_line(error, folder)}: {kind}{text}")


def _line(error: BaseException, folder: str) -> str:
    """Return the place of an error as ' (file, line n)': the line with the syntax error, or else the last line in the
    traceback whose file is in `folder`. Return '' if there is no such line.
    """
    if isinstance(error, SyntaxError) and error.filename:
        return f" ({error.filename}, line {error.lineno})"
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename != __file__]
    own = [frame for frame in frames if Path(frame.filename).is_relative_to(folder) and "importlib" not in frame.filename]
    return f" ({own[-1].filename}, line {own[-1].lineno})" if own else ""
