"""Modules of users, which register their tasks: how they are found and run, and how their mistakes are reported."""

import importlib
import importlib.util
import sys
import traceback
from pathlib import Path

from legged.config.checks import shown
from legged.errors import ConfigError
from legged.paths import exists

_IMPORTED: set[str] = set()
"""Names of the modules that were run from files."""


def import_tasks(name: str) -> None:
    """Run a user's module, 'my_tasks' or 'path/my_tasks.py', so that it registers its tasks. What lies beside it can be
    imported from it.

    Raises:
        ConfigError: it can't be found, or it fails.
    """
    path = Path(name)
    is_file = path.suffix == ".py"
    if is_file and not (exists(path) and path.is_file()):
        raise ConfigError(f"--import: there is no file {shown(name)}")
    folder = str(path.resolve().parent if is_file else Path.cwd())
    if folder not in sys.path:
        sys.path.insert(0, folder)
    before = set(sys.modules)
    try:
        _run(path) if is_file else importlib.import_module(name)
    except ConfigError as error:
        raise ConfigError(f"--import: {name}{_line(error, folder)}: {error}") from error
    except ModuleNotFoundError as error:
        if not is_file and error.name is not None and f"{name}.".startswith(f"{error.name}."):
            raise ConfigError(
                f"--import: there is no module {shown(name)} (a module name, or a path that ends in .py)"
            ) from error
        raise _failed(name, error, folder) from error
    except (Exception, SystemExit) as error:
        for module in set(sys.modules) - before:  # half of a module is none
            if str(getattr(sys.modules[module], "__file__", None) or "").startswith(folder):
                del sys.modules[module]
        raise _failed(name, error, folder) from error


def _run(path: Path) -> None:
    """Run a file as the module of its name."""
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


def _failed(name: str, error: BaseException, folder: str) -> ConfigError:
    text = " ".join(str(error.msg if isinstance(error, SyntaxError) else error).split())
    return ConfigError(f"--import: {name}{_line(error, folder)}: {type(error).__name__}: {text}")


def _line(error: BaseException, folder: str) -> str:
    """' (file, line n)' of a mistake: where a file cannot be parsed, else the innermost line of a file in `folder`."""
    if isinstance(error, SyntaxError) and error.filename:
        return f" ({error.filename}, line {error.lineno})"
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if Path(frame.filename).is_relative_to(folder) and frame.filename != __file__]
    last = [frame for frame in own if "importlib" not in frame.filename] or []
    return f" ({last[-1].filename}, line {last[-1].lineno})" if last else ""
