"""Choice of the classes in a file: the environment's configuration, its learner's, and the name of the task."""

import ast
import re
from dataclasses import dataclass
from pathlib import Path

from legged.config.checks import shown
from legged.errors import ConfigError, suggest
from legged.migration.expressions import CannotEvaluateError
from legged.migration.found import place_of
from legged.migration.modules import Module, Tree
from legged.process.paths import exists, relative

SECTIONS = {
    "env",
    "terrain",
    "commands",
    "init_state",
    "control",
    "asset",
    "domain_rand",
    "rewards",
    "normalization",
    "noise",
}
LEARNER_SECTIONS = {"policy", "algorithm", "runner"}
PACKAGES_ABOVE = 5
"""Number of folders above a file whose __init__.py may register its task."""


@dataclass(frozen=True)
class Choice:
    """The classes and the task name to migrate."""

    task: str
    """Name of the task."""
    environment: type
    learner: type | None


@dataclass(frozen=True)
class _Registration:
    """A call of `task_registry.register`."""

    task: str
    environment: str
    learner: str
    """Name of the learner's class, or empty."""


def choose(tree: Tree, path: Path, asked: str | None) -> Choice:
    """Return the classes to migrate from the file at `path`. `asked` is a class of the file, a task registered next to it, or
    the name of the new task.

    Raises:
        ConfigError: the file has no configuration, or several and `asked` chooses none of them.
    """
    module = tree.read(path)
    assert module is not None
    environments = {name: cls for name, cls in _classes(module).items() if _has(cls, SECTIONS)}
    registered = _registrations(path)
    if asked is not None:
        for entry in registered:
            cls = _class(module, entry.environment)
            if entry.task == asked and (entry.environment in environments or (not environments and cls is not None)):
                assert cls is not None
                return Choice(asked, cls, _class(module, entry.learner) or _learner(module, entry.environment))
    if not environments:
        names = [entry.task for entry in registered if _class(module, entry.environment) is not None]
        of_tasks = f"; it registers tasks: --task{suggest(asked or '', names, 'tasks')}" if names else ""
        raise ConfigError(f"{relative(path)}: has no configuration of an environment (class XCfg(LeggedRobotCfg)){of_tasks}")
    if asked in environments:
        name = asked
    elif len(environments) == 1:
        name = next(iter(environments))
    else:
        given = "" if asked is None else f"{shown(asked)} is none of them: "
        which = suggest(
            asked or "", [*environments, *(e.task for e in registered if e.environment in environments)], "--task"
        )
        raise ConfigError(f"--task: {relative(path)} has several configurations, {given}say which{which}")
    known = next((entry for entry in registered if entry.environment == name), None)
    learner = (_class(module, known.learner) if known else None) or _learner(module, name)
    own = asked if asked is not None and asked != name else None
    return Choice(own or (known.task if known else _snake(name)), environments[name], learner)


def _classes(module: Module) -> dict[str, type]:
    """Return the classes that a file itself defines."""
    here = relative(module.path)
    return {name: cls for name, cls in module.names.items() if isinstance(cls, type) and place_of(cls).file == here}


def _class(module: Module, name: str) -> type | None:
    try:
        found = module.get(name) if name else None
    except CannotEvaluateError:
        return None
    return found if isinstance(found, type) else None


def _has(cls: type, sections: set[str]) -> bool:
    return any(isinstance(getattr(cls, name, None), type) for name in sections)


def _learner(module: Module, environment: str) -> type | None:
    """Return the learner's configuration that belongs to an environment's by its name, or the only one."""
    classes = _classes(module)
    learners = {name: cls for name, cls in classes.items() if _has(cls, LEARNER_SECTIONS) and not _has(cls, SECTIONS)}
    for name in (f"{environment}PPO", environment.replace("Cfg", "CfgPPO"), environment.replace("Config", "ConfigPPO")):
        if name in learners:
            return learners[name]
    return next(iter(learners.values())) if len(learners) == 1 else None


def _registrations(path: Path) -> list[_Registration]:
    """Return the registrations in the file, and in the packages above it."""
    path = path.resolve()
    files = [path, *(folder / "__init__.py" for folder in list(path.parents)[:PACKAGES_ABOVE])]
    found: list[_Registration] = []
    for file in dict.fromkeys(files):
        if not (exists(file) and file.is_file()):
            continue
        try:
            parsed = ast.parse(file.read_text(encoding="utf-8", errors="replace"))
        except (OSError, SyntaxError, ValueError, RecursionError):
            continue
        for node in ast.walk(parsed):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "register":
                found += _registration(node)
    return found


def _registration(call: ast.Call) -> list[_Registration]:
    """Return the content of a call `register("name", Env, EnvCfg(), LearnerCfg())`; empty for another call."""
    if len(call.args) < 3 or not isinstance(call.args[0], ast.Constant) or not isinstance(call.args[0].value, str):
        return []
    names = []
    for argument in call.args[2:4]:
        inner = argument.func if isinstance(argument, ast.Call) else argument
        names.append(inner.id if isinstance(inner, ast.Name) else inner.attr if isinstance(inner, ast.Attribute) else "")
    return [_Registration(call.args[0].value, names[0], names[1] if len(names) > 1 else "")]


def _snake(name: str) -> str:
    """Return a task name for a class: 'GO2RoughCfg' -> 'go2_rough'."""
    name = re.sub(r"(Cfg|Config)$", "", name) or name
    name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name)
    name = re.sub(r"(?<=[A-Z])(?=[A-Z][a-z])", "_", name)
    return name.lower().strip("_") or "task"
