"""Program that runs the configuration of a legged_gym fork and prints the values, methods and terrain types as JSON.

`reading.py` starts this program as a child process. The program imports nothing of this package. Stand-ins replace the
modules in `REPLACED`, and modules that are not installed. Any use of a stand-in gives another stand-in.
"""

import abc
import ast
import contextlib
import functools
import hashlib
import importlib.util
import inspect
import itertools
import json
import os
import re
import sys
import sysconfig
import traceback
import types
from collections.abc import Iterator
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import Any

SECTIONS = (
    *("env", "terrain", "commands", "init_state", "control"),
    *("asset", "domain_rand", "rewards", "normalization", "noise"),
)
LEARNER_SECTIONS = ("policy", "algorithm", "runner")
REPLACED = ("isaacgym", "rsl_rl")
"""Modules that stand-ins replace even if they are installed."""
ALONE = "file_of_the_user"
"""Name of the package that is made for a file outside any package."""
BUILT_IN = "legged_gym's"
"""Module name of the classes in `KNOWN`."""
GAP = 2
"""Largest number of folders without __init__.py between a file and its package."""
LONGEST = 100_000
"""Greatest length of a value or of an error's text, in characters."""
OPERATORS = ["add", "sub", "mul", "truediv", "floordiv", "mod", "pow", "matmul", "and", "or", "xor", "lshift", "rshift"]
INSTALLED = ("site-packages", "dist-packages", sysconfig.get_path("stdlib"), "<frozen")
READS = {
    "tracking_sigma": r"\btracking_sigma\b",
    "fourth": r"\bcommands\[:, (3|4|5|6|7|8|9)",
    "normal": r"\brandn",
    "yaw": r"wrap_to_pi\([^()]*\), -([\d.]+), \1\)",
}
"""Name -> pattern that is searched for in the text of a method."""
CUT = "(cut)"
"""Name of a stand-in for columns of a `torch.cat` result, if it is unknown which joined parts the columns come from."""
CALLS: list[tuple[str, tuple[Any, ...], dict[str, Any]]] = []
"""Calls of stand-ins: name, and arguments."""
KNOWN: dict[str, Any] = {}
"""Name -> object of legged_gym, which the stand-in of legged_gym provides."""
USED: dict[str, None] = {}
"""Names of the classes in `KNOWN` that the user's files import."""


class StandIn:
    """Stand-in for an object of a module that is not installed, or for a value computed from such objects. It records the
    names and numbers that it was computed from, and the parts that `torch.cat` joined.
    """

    def __init__(self, *names: str, parts: "list[StandIn] | None" = None) -> None:
        self.names = tuple(dict.fromkeys(names))
        self.parts = parts

    def __getattr__(self, name: str) -> Any:
        return _attribute(self.names[0], name, *self.names[1:])

    def __call__(self, *args: Any, **options: Any) -> Any:
        name = self.names[0].rpartition(".")[2]
        CALLS.append((name, args, options))
        if len(args) == 1 and not options and (isinstance(args[0], type) or inspect.isfunction(args[0])):
            return args[0]  # used as a decorator
        if name == "cat" and args and isinstance(args[0], list | tuple):
            return StandIn(*self.names, parts=[part for item in args[0] for part in item.parts or [item]])
        return _computed(self, *args)

    def __getitem__(self, key: Any) -> Any:
        keys = key if type(key) is tuple else (key,)
        text = ", ".join(f"{k.start or ''}:{k.stop or ''}" if isinstance(k, slice) else str(k) for k in keys)
        return StandIn(CUT if self.parts else f"{self.names[0]}[{text}]", *self.names[1:])

    def __mro_entries__(self, bases: Any) -> tuple[type, ...]:
        return (Base,)

    def __iter__(self) -> Iterator[Any]:
        return iter(())

    def __enter__(self) -> "StandIn":
        return self

    def __exit__(self, *error: object) -> None: ...

    def __setitem__(self, key: Any, value: Any) -> None: ...


def _attribute(owner: str, name: str, *others: str) -> StandIn:
    if name.startswith("__"):
        raise AttributeError(name)
    return StandIn(f"{owner}.{name}", *others)


def _computed(*values: Any) -> StandIn:
    names = [value.names if isinstance(value, StandIn) else (str(value),) for value in values]
    return StandIn(*itertools.chain.from_iterable(names), parts=getattr(values[0], "parts", None))


for _name in (*OPERATORS, *(f"r{operator}" for operator in OPERATORS), "neg", "pos", "abs", "invert", "lt", "le", "gt", "ge"):
    setattr(StandIn, f"__{_name}__", lambda self, *other: _computed(self, *other))


class _Meta(abc.ABCMeta):
    def __getattr__(cls, name: str) -> Any:
        return _attribute(cls.__name__, name)


class Base(metaclass=_Meta):
    """Stand-in for a base class that is not installed."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__()


class StandInModule(types.ModuleType):
    """Stand-in for a module that is not installed."""

    def __getattr__(self, name: str) -> Any:
        if name not in KNOWN:
            return _attribute(self.__name__, name)
        if isinstance(KNOWN[name], type):
            USED[name] = None
        return KNOWN[name]


class Finder:
    """Finder of stand-ins for modules that the user's files import. Modules that an installed package imports get no
    stand-in, because they may be optional.
    """

    def __init__(self, only: tuple[str, ...] = (), own: str = "") -> None:
        self.only, self.own = only, own

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        """Return the specification of a stand-in, or None."""
        top = name.partition(".")[0]
        frame = sys._getframe(1)
        while frame.f_back and ("importlib" in frame.f_code.co_filename or frame.f_code.co_filename == __file__):
            frame = frame.f_back
        if (self.only and top not in self.only) or top == self.own or _is_installed(frame.f_code.co_filename):
            return None
        return ModuleSpec(name, self, is_package=True)  # type: ignore[arg-type]

    def create_module(self, spec: ModuleSpec) -> types.ModuleType:
        """Return the stand-in of a module."""
        return StandInModule(spec.name)

    def exec_module(self, module: types.ModuleType) -> None:
        """Give the stand-in of isaacgym.torch_utils the modules that a star import of the original provides."""
        if module.__name__ == "isaacgym.torch_utils":
            exec("import os, torch, numpy as np", vars(module))


def _is_installed(file: str) -> bool:
    return any(part in file for part in INSTALLED)


def _is_of_fork(module: str) -> bool:
    """Return True for a module of the user, or the stand-in of legged_gym."""
    file = getattr(sys.modules.get(module), "__file__", None)
    return module == BUILT_IN or (file is not None and module != "__main__" and not _is_installed(file))


def define(name: str, data: dict[str, Any], parent: Any) -> type:
    """Return a class with the values of a table. Nested tables become nested classes, except tables of joints."""
    own: dict[str, Any] = {"__module__": BUILT_IN, "__qualname__": name}
    for key, value in data.items():
        nested = isinstance(value, dict) and key not in ("default_joint_angles", "stiffness", "damping")
        own[key] = define(name, value, getattr(parent, key, None)) if nested else value
    return type(name, () if parent is None else (parent,), own)


def load(file: Path) -> tuple[types.ModuleType, Path]:
    """Import the file as a module of its package. Return the module and the folder of the package, else of the file."""
    gap, root, own = 0, file.parent, ALONE
    for folder in file.parents:
        gap += 1
        if (folder / "__init__.py").is_file():
            gap, root, own = 0, folder, folder.name
        if gap > GAP:
            break
    sys.path.insert(0, str(root if own == ALONE else root.parent))
    sys.meta_path.insert(0, Finder(only=REPLACED, own=own))  # type: ignore[arg-type]
    sys.meta_path.append(Finder(own=own))  # type: ignore[arg-type]
    if own == ALONE:
        sys.modules[ALONE] = types.ModuleType(ALONE)
        sys.modules[ALONE].__path__ = [str(root)]
    return importlib.import_module(module_name(file, root)), root


def module_name(file: Path, root: Path) -> str:
    """Return the dotted name of a file below the folder `root`."""
    package = ALONE if ALONE in sys.modules else root.name
    return ".".join((package, *file.relative_to(root).with_suffix("").parts)).removesuffix(".__init__")


def objects() -> list[Any]:
    """Return the objects of the fork's modules and of legged_gym's stand-in."""
    modules = [KNOWN, *(vars(module) for name, module in list(sys.modules.items()) if _is_of_fork(name))]
    return [value for module in modules for value in list(module.values())]


def fork_classes(*attributes: str) -> list[type]:
    """Return the user's classes that have an attribute whose name begins with one of `attributes`. A class is left out if
    another of these classes is derived from it.
    """
    classes = dict.fromkeys(value for value in objects() if isinstance(value, type) and _is_of_fork(value.__module__))
    having = [cls for cls in classes if any(name.startswith(attributes) for name in dir(cls))]
    return [cls for cls in having if not any(other is not cls and issubclass(other, cls) for other in having)]


def registered() -> dict[str, tuple[Any, Any, Any]]:
    """Return, for each task in any registry, its class, its configuration and its learner's configuration."""
    found: dict[str, tuple[Any, Any, Any]] = {}
    for value in objects():
        tables = [getattr(value, name, None) for name in ("task_classes", "env_cfgs", "train_cfgs")]
        if all(isinstance(table, dict) for table in tables):
            found |= {task: (tables[0].get(task), cfg, tables[2].get(task)) for task, cfg in tables[1].items()}  # type: ignore
    return found


def with_sections(module: types.ModuleType, names: tuple[str, ...]) -> dict[str, type]:
    """Return the classes of a module that have a section named in `names`."""
    return {
        key: value
        for key, value in vars(module).items()
        if isinstance(value, type) and any(isinstance(getattr(value, name, None), type) for name in names)
    }


def configurations(module: types.ModuleType) -> dict[str, type]:
    """Return the environment configurations that a module defines. If it defines none and imports exactly one, call the
    module's functions `config_*`, which change the imported configuration, and return it under the functions' names.
    """
    learners = with_sections(module, LEARNER_SECTIONS)
    classes = {name: value for name, value in with_sections(module, SECTIONS).items() if name not in learners}
    own = {name: value for name, value in classes.items() if value.__module__ == module.__name__}
    if not own and len(classes) == 1:
        for name, value in list(vars(module).items()):
            if name.startswith("config") and inspect.isfunction(value) and value.__module__ == module.__name__:
                (made,) = classes.values()
                value(made)
                own[name.removeprefix("config_")] = made
    return own


def learner_of(module: types.ModuleType, name: str) -> Any:
    """Return the learner's configuration whose name fits `name`, else the only one in the module, else None."""
    learners = {k: v for k, v in with_sections(module, LEARNER_SECTIONS).items() if v.__module__ == module.__name__}
    for other in (f"{name}PPO", name.replace("Cfg", "CfgPPO"), name.replace("Config", "ConfigPPO")):
        if other in learners:
            return learners[other]
    return next(iter(learners.values())) if len(learners) == 1 else None


@functools.cache
def nodes_of(file: str) -> dict[str, Any]:
    """Return dotted name -> node of a file's syntax tree, for classes, methods and attributes of classes."""
    found: dict[str, Any] = {}

    def visit(node: ast.AST, prefix: str) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.ClassDef | ast.FunctionDef):
                found[f"{prefix}{child.name}"] = child
            elif isinstance(child, ast.Name) and isinstance(child.ctx, ast.Store):
                found[f"{prefix}{child.id}"] = child
            if not isinstance(child, ast.FunctionDef):
                visit(child, f"{prefix}{child.name}." if isinstance(child, ast.ClassDef) else prefix)

    with contextlib.suppress(OSError, SyntaxError, ValueError, RecursionError):
        visit(ast.parse(Path(file).read_bytes()), "")
    return found


def place_of(owner: type, name: str) -> tuple[str, int]:
    """Return file and line of a class's attribute, or of the class if the attribute was set elsewhere."""
    file = getattr(sys.modules.get(owner.__module__), "__file__", None)
    if file is None:
        return f"legged_gym's {owner.__qualname__}", 0
    nodes, cls = nodes_of(file), owner.__qualname__
    return file, getattr(nodes.get(f"{cls}.{name}", nodes.get(cls)), "lineno", 0)


class NotPlain(Exception):
    """Exception for a value that is not made of numbers, texts, lists and tables."""


def plain(value: Any) -> Any:
    """Return a value as JSON represents it: numbers, texts, lists and tables.

    Raises:
        NotPlain: JSON cannot represent the value. The error's text gives the reason.
    """

    def other(item: Any) -> Any:
        if isinstance(item, StandIn | StandInModule):
            raise NotPlain(f"comes from {getattr(item, 'names', ['a module'])[0]}, which is not installed")
        if hasattr(item, "tolist"):
            return item.tolist()
        raise NotPlain(f"is of type {type(item).__name__}")

    try:
        text = json.dumps(value, default=other)
    except TypeError as error:
        raise NotPlain(f"has {error}") from None
    except (ValueError, RecursionError):
        raise NotPlain("is too large") from None
    if len(text) > LONGEST:
        raise NotPlain("is too large")
    return json.loads(text, parse_float=lambda number: float(number) + 0.0)  # adding 0.0 turns -0.0 into 0.0


def settings(owner: Any, prefix: str = "", above: tuple[type, ...] = ()) -> dict[str, Any]:
    """Return the settings of a configuration (a class or an instance) and of its sections: dotted path -> value, file, line,
    and the reason if the value is unknown.
    """
    found: dict[str, Any] = {}
    cls = owner if isinstance(owner, type) else type(owner)
    owners = {name: part for part in reversed(cls.__mro__[:-1]) for name in vars(part)}
    for name in owners | getattr(owner, "__dict__", {}):
        value = getattr(owner, name, None)
        kind = value if isinstance(value, type) else type(value)
        if name.startswith("_") or inspect.isroutine(value):
            continue
        if hasattr(kind, "__mro__") and _is_of_fork(kind.__module__) and not isinstance(value, StandIn):
            found |= settings(value, f"{prefix}{name}.", (*above, kind)) if kind not in above else {}
            continue
        place = place_of(owners.get(name, cls), name)
        try:
            found[f"{prefix}{name}"] = [plain(value), *place, ""]
        except NotPlain as why:
            found[f"{prefix}{name}"] = [None, *place, str(why)]
    return found


def method(function: Any) -> dict[str, Any]:
    """Return place and digest of a method, and the names of `READS` that it reads, with the texts of the patterns' groups.
    Layout and docstring do not affect the digest. `self.env.x`, as in containers of rewards, gives the digest of `self.x`.
    """
    code = inspect.unwrap(function).__code__
    node = nodes_of(code.co_filename).get(code.co_qualname, ast.parse(""))
    body = node.body if ast.get_docstring(node) is None else node.body[1:]
    text = re.sub(r"\b(\w+)\.env\b", r"\1", "\n".join(map(ast.unparse, body)))
    digest = hashlib.sha256(text.encode()).hexdigest()[:10]
    reads = {name: found[found.re.groups] for name, pattern in READS.items() if (found := re.search(pattern, text))}
    return {"place": [code.co_filename, code.co_firstlineno], "digest": digest, "reads": reads}


def methods_of(classes: list[type], names: list[str]) -> dict[str, list[dict[str, Any]]]:
    """Return name -> methods of the classes: rewards, and the methods that `names` lists."""
    found: dict[str, list[dict[str, Any]]] = {}
    for cls in classes:
        for name in dir(cls):
            function = inspect.getattr_static(cls, name)
            if inspect.isfunction(function) and (name.startswith("_reward_") or name in names):
                found.setdefault(name, []).append(method(function))
    return found


def environment_classes(task_class: Any, root: Path) -> list[type]:
    """Return the task's class if a registry names it. Otherwise, return all classes with rewards or observations in the
    package, or in the folder of a file outside any package.
    """
    if isinstance(task_class, type):
        return [task_class]
    for file in sorted(root.glob("*.py" if ALONE in sys.modules else "**/*.py"))[:1000]:
        name = module_name(file, root)
        if re.search(rb"def (_reward_|compute_observations)", file.read_bytes()) and name not in sys.modules:
            try:
                importlib.import_module(name)
            except BaseException:
                sys.modules.pop(name, None)
    return fork_classes("_reward_", "compute_observations")


def replay(function: Any, values: dict[str, Any], others: dict[str, Any]) -> None:
    """Run a function. `values` has the arguments by name; stand-ins replace missing arguments. `others` has objects that
    replace globals of the function, by name.
    """
    run = types.FunctionType(function.__code__, function.__globals__ | others, None, None, function.__closure__)
    CALLS.clear()
    run(*(values.get(name, StandIn(name)) for name in inspect.signature(function).parameters))


def terrains(config: Any) -> list[Any] | None:
    """Return an item for each entry of terrain_proportions; None if the fork has no make_terrain. An item has a pair for each
    half of the entry's columns. A pair is the names of the terrain functions that make_terrain calls, joined by " + ", and
    the sign of the first function's slope or step height. If make_terrain fails, None takes the place of the pair.
    """
    shares, makers = getattr(config, "terrain_proportions", None), fork_classes("make_terrain")
    if not makers or not isinstance(shares, list | tuple):
        return None
    make = makers[0].make_terrain  # type: ignore[attr-defined]
    parts = {name: StandIn(name) for name in make.__globals__ if name.endswith("_terrain")}
    ends, self = list(itertools.accumulate(shares)), StandIn("terrain")
    vars(self).update(cfg=config, proportions=ends)
    found: list[Any] = []
    for end, share in zip(ends, shares, strict=True):
        found.append([])
        for part in (0.25, 0.75) if share > 0 else ():
            values = {"self": self, "choice": end - share * (1 - part), "difficulty": 0.5, "proportions": ends, "cfg": config}
            try:
                replay(make, values, parts)
            except Exception:
                found[-1].append(None)
                continue
            calls = [call for call in CALLS if call[0].endswith("_terrain")]
            found[-1].append([" + ".join(name for name, *_ in calls), sign(*calls[0][1:]) if calls else 0])
    return found


def sign(args: tuple[Any, ...], options: dict[str, Any]) -> int:
    """Return the sign of a terrain function's slope or step height; 0 if it has neither."""
    value = options.get("slope", options.get("step_height", args[1] if len(args) > 1 else 0))
    return (value > 0) - (value < 0) if isinstance(value, int | float) else 0


def observations(cls: type, config: Any) -> list[Any]:
    """Return the parts that compute_observations joins: a list for the policy and a list for the value function. Each part
    is given as the names and numbers in its formula. A list is None if its parts cannot be determined.
    """
    self = StandIn("self")
    vars(self).update(cfg=config)
    try:
        replay(inspect.getattr_static(cls, "compute_observations"), {"self": self}, {"torch": StandIn("torch")})
    except Exception:
        return [None, None]
    buffers = [getattr(self.__dict__.get(name), "parts", None) for name in ("obs_buf", "privileged_obs_buf")]
    return [None if not parts or any(CUT in p.names for p in parts) else [list(p.names) for p in parts] for parts in buffers]


def answer(request: dict[str, Any]) -> dict[str, Any]:
    """Return the answer to a request that has a file, a task, and legged_gym's classes and names of methods."""
    registry = types.SimpleNamespace(task_classes={}, env_cfgs={}, train_cfgs={})
    tables = list(vars(registry).values())
    registry.register = lambda name, *entries: [t.update({name: entry}) for t, entry in zip(tables, entries, strict=False)]
    KNOWN.update(task_registry=registry, register=registry.register, LEGGED_GYM_ROOT_DIR="{LEGGED_GYM_ROOT_DIR}")
    for name, (parent, data) in request["known"].items():
        KNOWN[name] = define(name, data, KNOWN.get(parent))
    module, root = load(Path(request["file"]))
    asked, own, tasks = request["task"], configurations(module), registered()
    of_file = [task for task, entry in tasks.items() if not own or type(entry[1]) in own.values()]
    if asked in tasks:
        name, (task_class, environment, learner) = asked, tasks[asked]
    elif asked in own or len(own) == 1:
        chosen = asked if asked in own else next(iter(own))
        environment = own[chosen]
        name = next((task for task, entry in tasks.items() if type(entry[1]) is environment), "")
        task_class, _, learner = tasks.get(name, (None, None, learner_of(module, chosen)))
        name = asked if asked not in (None, *own) else name or snake(chosen)
    else:
        return {"classes": list(own), "tasks": of_file}
    classes = environment_classes(task_class, root)
    observing = [cls for cls in classes if "compute_observations" in dir(cls)]
    return {
        "task": name,
        "names": [getattr(cls, "__name__", type(cls).__name__) for cls in (environment, learner) if cls is not None],
        "built_in": list(USED),
        "settings": settings(environment) | ({} if learner is None else settings(learner)),
        "methods": methods_of(classes, request["methods"]),
        "observations": observations(observing[0], environment) if len(observing) == 1 else [None, None],
        "terrains": terrains(getattr(environment, "terrain", None)),
    }


def snake(name: str) -> str:
    """Return a task name for a class: 'GO2RoughCfg' -> 'go2_rough'."""
    name = re.sub(r"(Cfg|Config)$", "", name) or name
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", name).lower().strip("_") or "task"


def failure(error: BaseException) -> dict[str, Any]:
    """Return the answer for code that raised an error: the error's text, and the last place in the user's files."""
    places = [(frame.filename, frame.lineno) for frame in traceback.extract_tb(error.__traceback__)]
    own = [(file, line) for file, line in places if file != __file__ and not _is_installed(file)]
    if isinstance(error, SyntaxError) and error.filename:
        own.append((error.filename, error.lineno))
    text = f"{type(error).__name__}: {error}"[:LONGEST].replace(f"{ALONE}.", "")
    return {"error": text, "place": own[-1] if own else ("", 0)}


def main() -> None:
    """Answer the request on standard input. Output of the user's code goes to standard error."""
    out = os.dup(1)
    os.dup2(2, 1)
    request = json.loads(sys.stdin.buffer.read())
    sys.argv = [request["file"]]
    try:
        result = answer(request)
    except BaseException as error:
        result = failure(error)
    with os.fdopen(out, "w") as stream:
        json.dump(result, stream)
    sys.stderr.flush()
    os._exit(0)  # threads of the user's code would keep the process alive


if __name__ == "__main__":
    main()
