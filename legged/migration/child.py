"""Program that runs a fork's configuration and prints its live values, methods and terrain types as JSON.

`reading.py` starts it as a child process. It imports nothing of this package. Modules that are not installed, and Isaac Gym
in any case, are replaced by stand-ins: any use of a stand-in gives another one.
"""

import abc
import ast
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
import textwrap
import traceback
import types
from collections.abc import Iterator
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import Any

SECTIONS = {
    *("env", "terrain", "commands", "init_state", "control"),
    *("asset", "domain_rand", "rewards", "normalization", "noise"),
}
LEARNER_SECTIONS = {"policy", "algorithm", "runner"}
REPLACED = ("isaacgym", "rsl_rl")
"""Modules with a stand-in even if they are installed."""
ALONE = "file_of_the_user"
"""Name of the package that a file outside any package belongs to."""
BUILT_IN = "legged_gym's"
"""Name of the module of the classes in `KNOWN`."""
GAP = 2
"""Largest number of folders without __init__.py between a file and its package."""
DEEPEST, MOST, LONGEST = 12, 100_000, 10_000
"""Largest depth and number of values, and length of a text."""
OPERATORS = ["add", "sub", "mul", "truediv", "floordiv", "mod", "pow", "matmul", "and", "or", "xor", "lshift", "rshift"]
INSTALLED = ("site-packages", "dist-packages", sysconfig.get_path("stdlib"), "<frozen")
CALLS: list[tuple[str, tuple[Any, ...], dict[str, Any]]] = []
"""Calls of stand-ins: name, and arguments."""
KNOWN: dict[str, Any] = {}
"""Objects of legged_gym that its stand-in has, by name."""
USED: dict[str, list[str]] = {"stand_ins": [], "built_in": []}


class StandIn:
    """Object of a module that is not installed, or a value computed from one. It knows the names and numbers that it was
    computed from, and the parts that `torch.cat` joined.
    """

    parts: "list[StandIn] | None"

    def __init__(self, *names: str, parts: "list[StandIn] | None" = None) -> None:
        self.names, self.parts = tuple(dict.fromkeys(names)), parts

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return StandIn(f"{self.names[0]}.{name}", *self.names[1:])

    def __call__(self, *args: Any, **options: Any) -> Any:
        name = self.names[0].rpartition(".")[2]
        CALLS.append((name, args, options))
        if len(args) == 1 and not options and (isinstance(args[0], type) or inspect.isfunction(args[0])):
            return args[0]  # a decorator
        if name == "cat" and args and isinstance(args[0], list | tuple):
            return StandIn(*self.names, parts=[part for item in args[0] for part in item.parts or [item]])
        return _computed(self, *args)

    def __getitem__(self, key: Any) -> Any:
        keys = [
            f"{k.start or ''}:{k.stop or ''}" if isinstance(k, slice) else k for k in (key if type(key) is tuple else [key])
        ]
        return StandIn(CUT if self.parts else f"{self.names[0]}[{', '.join(map(str, keys))}]", *self.names[1:])

    def __mro_entries__(self, bases: Any) -> tuple[type, ...]:
        return (Base,)

    def __iter__(self) -> Iterator[Any]:
        return iter(())

    def __enter__(self) -> "StandIn":
        return self

    def __exit__(self, *error: object) -> None: ...

    def __setitem__(self, key: Any, value: Any) -> None: ...


CUT = "(cut)"
"""Name of some columns of joined parts."""


def _computed(*values: Any) -> StandIn:
    names = [value.names if isinstance(value, StandIn) else (str(value),) for value in values]
    return StandIn(*itertools.chain.from_iterable(names), parts=getattr(values[0], "parts", None))


for _name in (*OPERATORS, *(f"r{operator}" for operator in OPERATORS), "neg", "pos", "abs", "invert", "lt", "le", "gt", "ge"):
    setattr(StandIn, f"__{_name}__", lambda self, *other: _computed(self, *other))


class _Meta(abc.ABCMeta):
    def __getattr__(cls, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return StandIn(f"{cls.__name__}.{name}")


class Base(metaclass=_Meta):
    """Base class in place of one that is not installed."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__()


class StandInModule(types.ModuleType):
    """Module in place of one that is not installed."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        if name in KNOWN:
            USED["built_in"] += [name] if name not in USED["built_in"] and isinstance(KNOWN[name], type) else []
            return KNOWN[name]
        return StandIn(f"{self.__name__}.{name}")


class Finder:
    """Finder of stand-ins for modules that the user's files import. Installed packages get none for their optional parts."""

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
        """Note the stand-in, and give it the names that Isaac Gym's star import has."""
        USED["stand_ins"].append(module.__name__)
        if module.__name__ == "isaacgym.torch_utils":
            for name, alias in (("numpy", "np"), ("torch", "torch"), ("os", "os")):
                setattr(module, alias, importlib.import_module(name))


def _is_installed(file: str) -> bool:
    return any(part in file for part in INSTALLED)


def _is_of_fork(module: str) -> bool:
    """Return True for a module of the user, or the stand-in of legged_gym."""
    file = getattr(sys.modules.get(module), "__file__", None)
    return module == BUILT_IN or (file is not None and module != "__main__" and not _is_installed(file))


def define(name: str, data: dict[str, Any], parent: Any) -> type:
    """Return a class with the values of a table; nested tables are nested classes, except tables by joint."""
    own: dict[str, Any] = {"__module__": BUILT_IN, "__qualname__": name}
    for key, value in data.items():
        nested = isinstance(value, dict) and key not in ("default_joint_angles", "stiffness", "damping")
        own[key] = define(name, value, getattr(parent, key, None)) if nested else value
    return type(name, () if parent is None else (parent,), own)


def load(file: Path) -> tuple[types.ModuleType, Path]:
    """Import the file as a module of its package; return it and the folder of the package or, without one, of the file."""
    gap, top = 0, None
    for folder in file.parents:
        top, gap = (folder, 0) if (folder / "__init__.py").is_file() else (top, gap + 1)
        if gap > GAP:
            break
    root = file.parent if top is None else top
    sys.path.insert(0, str(root if top is None else root.parent))
    own = ALONE if top is None else root.name
    sys.meta_path.insert(0, Finder(only=REPLACED, own=own))  # type: ignore[arg-type]
    sys.meta_path.append(Finder(own=own))  # type: ignore[arg-type]
    if top is None:
        package = types.ModuleType(ALONE)
        package.__path__ = [str(root)]
        sys.modules[ALONE] = package
    return importlib.import_module(module_name(file, root, top is None)), root


def module_name(file: Path, root: Path, alone: bool) -> str:
    """Return the dotted name of a file below the folder `root`."""
    parts = (ALONE, file.stem) if alone else file.relative_to(root.parent).with_suffix("").parts
    return ".".join(parts).removesuffix(".__init__")


def registered() -> dict[str, tuple[Any, Any, Any]]:
    """Return task -> class, configuration and learner's configuration, from all registries that were filled."""
    found: dict[str, tuple[Any, Any, Any]] = {}
    for module in [KNOWN, *(vars(module) for name, module in list(sys.modules.items()) if _is_of_fork(name))]:
        for value in list(module.values()):
            tables = [getattr(value, name, None) for name in ("task_classes", "env_cfgs", "train_cfgs")]
            if all(isinstance(table, dict) for table in tables):
                found |= {task: (tables[0].get(task), cfg, tables[2].get(task)) for task, cfg in tables[1].items()}  # type: ignore
    return found


def _has(owner: Any, names: set[str]) -> bool:
    return any(isinstance(getattr(owner, name, None), type) for name in names)


def configurations(module: types.ModuleType) -> dict[str, type]:
    """Return the environment configurations that a module defines. A function `config_*` makes one of a class that its module
    imports.
    """
    classes = {
        name: value
        for name, value in vars(module).items()
        if isinstance(value, type) and _has(value, SECTIONS) and not _has(value, LEARNER_SECTIONS)
    }
    own = {name: value for name, value in classes.items() if value.__module__ == module.__name__}
    if not own and len(classes) == 1:
        for name, value in list(vars(module).items()):
            if name.startswith("config") and inspect.isfunction(value) and value.__module__ == module.__name__:
                (made,) = classes.values()
                value(made)
                own[name.removeprefix("config_")] = made
    return own


def learner_of(module: types.ModuleType, name: str) -> Any:
    """Return the learner's configuration that belongs to an environment's by its name, or the only one."""
    learners = {
        key: value
        for key, value in vars(module).items()
        if isinstance(value, type) and value.__module__ == module.__name__ and _has(value, LEARNER_SECTIONS)
    }
    for other in (f"{name}PPO", name.replace("Cfg", "CfgPPO"), name.replace("Config", "ConfigPPO")):
        if other in learners:
            return learners[other]
    return next(iter(learners.values())) if len(learners) == 1 else None


@functools.cache
def lines_of(file: str) -> dict[str, int]:
    """Return dotted name of a class or of its attribute -> line in a file."""
    found: dict[str, int] = {}

    def visit(node: ast.AST, prefix: str) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.ClassDef):
                found[f"{prefix}{child.name}"] = child.lineno
                visit(child, f"{prefix}{child.name}.")
            elif isinstance(child, ast.Name) and isinstance(child.ctx, ast.Store):
                found[f"{prefix}{child.id}"] = child.lineno
            elif not isinstance(child, ast.FunctionDef):
                visit(child, prefix)

    try:
        visit(ast.parse(Path(file).read_bytes()), "")
    except (OSError, SyntaxError, ValueError, RecursionError):
        return {}
    return found


def place_of(owner: type, name: str) -> tuple[str, int]:
    """Return file and line of an attribute of a class; the line of the class if the attribute was set elsewhere."""
    file = getattr(sys.modules.get(owner.__module__), "__file__", None)
    if file is None:
        return f"legged_gym's {owner.__qualname__}", 0
    lines = lines_of(file)
    return file, lines.get(f"{owner.__qualname__}.{name}", lines.get(owner.__qualname__, 0))


class NotPlain(Exception):
    """A value that is not made of numbers, texts, lists and tables."""


def plain(value: Any, depth: int = 0) -> Any:
    """Return a value for JSON.

    Raises:
        NotPlain: it has no such form; the text says why.
    """
    if value is None or isinstance(value, bool | float) or (isinstance(value, int) and value.bit_length() < 1000):
        return value
    if isinstance(value, str) and len(value) <= LONGEST:
        return value
    if isinstance(value, StandIn | StandInModule):
        raise NotPlain(f"comes from {getattr(value, 'names', ['a module'])[0]}, which is not installed")
    if depth > DEEPEST or (isinstance(value, str | list | tuple | dict) and len(value) > LONGEST):
        raise NotPlain("is too large")
    if isinstance(value, list | tuple):
        return [plain(item, depth + 1) for item in value]
    if isinstance(value, dict) and all(isinstance(key, str) for key in value):
        return {key: plain(item, depth + 1) for key, item in value.items()}
    if hasattr(value, "tolist"):
        return plain(value.tolist(), depth + 1)
    raise NotPlain(f"is of type {type(value).__name__}")


def settings(owner: Any, prefix: str, found: dict[str, Any], above: tuple[int, ...] = ()) -> None:
    """Add the settings of a configuration, a class or an instance, and of its sections: dotted path -> value, place, reason
    why the value is unknown.
    """
    cls = owner if isinstance(owner, type) else type(owner)
    owners = {name: part for part in reversed(cls.__mro__[:-1]) for name in vars(part) if not name.startswith("_")}
    names = [*owners, *(name for name in getattr(owner, "__dict__", {}) if name not in owners and not name.startswith("_"))]
    for name in names:
        value = getattr(owner, name, None)
        kind = value if isinstance(value, type) else type(value)
        if inspect.isroutine(value) or len(found) > MOST:
            continue
        if hasattr(kind, "__mro__") and _is_of_fork(kind.__module__) and not isinstance(value, StandIn):
            if id(kind) not in above and len(above) < DEEPEST:
                settings(value, f"{prefix}{name}.", found, (*above, id(kind)))
            continue
        place = place_of(owners.get(name, cls), name)
        try:
            found[f"{prefix}{name}"] = [plain(value), *place, ""]
        except NotPlain as why:
            found[f"{prefix}{name}"] = [None, *place, str(why)]


def canonical(node: Any) -> str:
    """Return a text of a syntax tree that does not depend on the layout or on the version of Python. Rewards in a container
    class read `self.env` in place of `self`.
    """
    if isinstance(node, ast.Attribute) and node.attr == "env" and isinstance(node.value, ast.Name):
        node = node.value
    if isinstance(node, ast.AST):
        fields = [
            (k, v) for k, v in ast.iter_fields(node) if k not in ("ctx", "kind", "type_comment") and v not in (None, [])
        ]
        return f"{type(node).__name__}({','.join(f'{k}={canonical(v)}' for k, v in fields)})"
    return f"[{','.join(map(canonical, node))}]" if isinstance(node, list) else repr(node)


def method(function: Any) -> dict[str, Any]:
    """Return place and digest of a method, and what matters of its text. The docstring does not count."""
    lines, first = inspect.getsourcelines(function)
    text = textwrap.dedent("".join(lines))
    node = ast.parse(text).body[0]
    assert isinstance(node, ast.FunctionDef)
    body = node.body[1:] if ast.get_docstring(node) is not None else node.body
    digest = hashlib.sha256(canonical(body).encode()).hexdigest()[:10]
    reads = [name for name, pattern in READS.items() if re.search(pattern, ast.unparse(body))]  # type: ignore[arg-type]
    return {"place": [inspect.getsourcefile(function), first], "digest": digest, "reads": reads}


READS = {"tracking_sigma": r"\btracking_sigma\b", "fourth": r"\bcommands\[:, (3|4|5|6|7|8|9)"}


def methods_of(classes: list[type], names: list[str]) -> dict[str, list[dict[str, Any]]]:
    """Return name -> methods of the classes: rewards, and those of the given names."""
    found: dict[str, list[dict[str, Any]]] = {}
    for cls in classes:
        for name in dir(cls):
            function = inspect.getattr_static(cls, name)
            if inspect.isfunction(function) and (name.startswith("_reward_") or name in names):
                try:
                    found.setdefault(name, []).append(method(function))
                except (OSError, SyntaxError, TypeError, AssertionError, RecursionError):
                    place = [function.__code__.co_filename, function.__code__.co_firstlineno]
                    found.setdefault(name, []).append({"place": place, "digest": "", "reads": []})
    return found


def fork_classes(attribute: str) -> list[type]:
    """Return the user's classes with an attribute that begins so, without base classes of others."""
    modules = [vars(module) for name, module in list(sys.modules.items()) if _is_of_fork(name)]
    classes = {
        value
        for module in modules
        for value in list(module.values())
        if isinstance(value, type) and _is_of_fork(value.__module__) and any(n.startswith(attribute) for n in dir(value))
    }
    return [cls for cls in classes if not any(other is not cls and issubclass(other, cls) for other in classes)]


def environment_classes(task_class: Any, root: Path) -> list[type]:
    """Return the class of the task; if no registry names it, all classes with rewards in the package or next to the file."""
    if isinstance(task_class, type):
        return [task_class]
    alone = ALONE in sys.modules
    for file in sorted(root.glob("*.py") if alone else root.rglob("*.py"))[:1000]:
        name = module_name(file, root, alone)
        if b"def _reward_" in file.read_bytes() and name not in sys.modules:
            try:
                importlib.import_module(name)
            except BaseException:
                sys.modules.pop(name, None)
    return fork_classes("_reward_")


def replay(function: Any, values: dict[str, Any], others: dict[str, Any]) -> None:
    """Run a function with the arguments `values` by their names, stand-ins for its other arguments, and other globals."""
    run = types.FunctionType(function.__code__, function.__globals__ | others, None, None, function.__closure__)
    CALLS.clear()
    run(*(values.get(name, StandIn(name)) for name in inspect.signature(function).parameters))


def terrains(config: Any) -> list[Any] | None:
    """Return, for each entry of terrain_proportions and for each half of its columns, the terrain functions that the fork's
    make_terrain calls and the sign of their slope or step; None without such a method.
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
                found[-1].append([[name, sign(args, options)] for name, args, options in CALLS if name.endswith("_terrain")])
            except Exception:
                found[-1].append(None)
    return found


def sign(args: tuple[Any, ...], options: dict[str, Any]) -> int:
    """Return the sign of a terrain function's slope or height of steps; 0 without one."""
    value = options.get("slope", options.get("step_height", args[1] if len(args) > 1 else 0))
    return (value > 0) - (value < 0) if isinstance(value, int | float) else 0


def observations(cls: type, config: Any) -> list[Any]:
    """Return the parts that compute_observations joins for the policy and for the value function, each as the names and
    numbers that it is computed from; None if they can't be told.
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
    """Return the answer to a request: file, task, and legged_gym's defaults."""
    registry = types.SimpleNamespace(task_classes={}, env_cfgs={}, train_cfgs={})
    tables = vars(registry).values()
    KNOWN.update(register=lambda name, *entries: [table.update({name: e}) for table, e in zip(tables, entries, strict=False)])
    KNOWN.update(task_registry=registry, LEGGED_GYM_ROOT_DIR="{LEGGED_GYM_ROOT_DIR}")
    registry.register = KNOWN["register"]
    for name, (parent, data) in request["known"].items():
        KNOWN[name] = define(name, data, KNOWN.get(parent))
    module, root = load(Path(request["file"]))
    asked, own, tasks = request["task"], configurations(module), registered()
    of_file = [task for task, entry in tasks.items() if not own or type(entry[1]) in own.values()]
    result: dict[str, Any] = {"classes": list(own), "tasks": of_file, **USED}
    task_class = None
    if asked in tasks:
        name, (task_class, environment, learner) = asked, tasks[asked]
    elif asked in own or len(own) == 1:
        name = asked if asked in own else next(iter(own))
        environment, known = own[name], [task for task, entry in tasks.items() if type(entry[1]) is own[name]]
        learner = learner_of(module, name)
        if known:
            task_class, _, learner = tasks[known[0]]
        result["given"] = asked if asked not in own else None
        name = known[0] if known else name
    else:
        return result
    found: dict[str, Any] = {}
    settings(environment, "", found)
    theirs: dict[str, Any] = {}
    settings(learner, "", theirs) if learner is not None else None
    names = [cls.__name__ if isinstance(cls, type) else type(cls).__name__ for cls in (environment, learner)]
    classes = environment_classes(task_class, root)
    return result | {
        "task": name,
        "environment": names[0],
        "learner": None if learner is None else names[1],
        "settings": found,
        "learning": theirs,
        "methods": methods_of(classes, request["methods"]),
        "observations": observations(classes[0], environment) if len(classes) == 1 else [None, None],
        "terrains": terrains(getattr(environment, "terrain", None)),
    }


def failure(error: BaseException) -> dict[str, Any]:
    """Return the answer for code that raised an error: its text, and the last place in the user's files."""
    frames = [
        f for f in traceback.extract_tb(error.__traceback__) if f.filename != __file__ and not _is_installed(f.filename)
    ]
    file, line = (frames[-1].filename, frames[-1].lineno) if frames else ("", 0)
    if isinstance(error, SyntaxError) and error.filename:
        file, line = error.filename, error.lineno
    text = f"{type(error).__name__}: {error}"[:LONGEST].replace(f"{ALONE}.", "")
    return {"error": text, "place": [file, line]}


def main() -> None:
    """Answer the request on standard input; what the user's code prints goes to standard error."""
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
    os._exit(0)  # threads of the user's code would keep the process


if __name__ == "__main__":
    main()
