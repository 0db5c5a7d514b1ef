"""Python files of a configuration tree as classes, without running them; inheritance works as in Python."""

import ast
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from legged.errors import ConfigError
from legged.migration.expressions import BUILTINS, ROOT, CannotEvaluateError, Evaluator, Numbers
from legged.migration.found import MEMBER_OF, Found, Place
from legged.migration.legged_gym_defaults import known_class
from legged.process.paths import exists, relative

MOST_BYTES = 2_000_000
NUMERIC = ("math", "numpy")
EMPTY_BASES = ("object", "BaseConfig", "ABC", "PrefixProto", "ParamsProto", "Proto", "NamedTuple", "Enum")
"""Base classes without settings."""


@dataclass(frozen=True)
class _Import:
    """A name bound by an import, resolved when it is used."""

    module: str
    name: str
    """Name in the module; empty for the module itself."""
    level: int


class Module:
    """One file: its names, read from top to bottom."""

    def __init__(self, path: Path, tree: "Tree") -> None:
        """Read the file at `path`.

        Raises:
            ConfigError: the file can't be read, or is not Python.
        """
        self.path, self.tree = path, tree
        self.names: dict[str, Any] = {}
        self._stars: list[_Import] = []
        self._open: set[str] = set()
        text = _text(path)
        try:
            parsed = ast.parse(text)
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            line = f":{error.lineno}" if isinstance(error, SyntaxError) and error.lineno else ""
            why = error.msg if isinstance(error, SyntaxError) else type(error).__name__
            raise ConfigError(f"{relative(path)}{line}: is not a readable Python file ({why})") from error
        self._run(parsed.body, self.names)

    def get(self, name: str) -> Any:
        """Return the meaning of a name in this file: a `Found`, a class, a module, `Numbers`.

        Raises:
            CannotEvaluateError: the name is unknown.
        """
        if name in self.names:
            bound = self.names[name]
            return self._imported(bound) if isinstance(bound, _Import) else bound
        if name not in self._open:
            self._open.add(name)
            try:
                for star in self._stars:
                    module = self.tree.module(star.module, star.level, self.path)
                    if isinstance(module, Module):
                        try:
                            return module.get(name)
                        except CannotEvaluateError:
                            continue
            finally:
                self._open.discard(name)
        if name in BUILTINS:
            return Found(BUILTINS[name], Place(relative(self.path), 0))
        if name.endswith("ROOT_DIR"):
            return Found(f"{{{ROOT}}}", Place(relative(self.path), 0))
        raise CannotEvaluateError(f"uses {name}, which is set nowhere")

    def _imported(self, bound: _Import) -> Any:
        if bound.name.endswith("ROOT_DIR"):
            return Found(f"{{{ROOT}}}", Place(relative(self.path), 0))
        if bound.module.split(".")[0] in NUMERIC:
            return Numbers() if not bound.name else Found(Numbers().get(bound.name), Place(bound.module, 0))
        module = self.tree.module(bound.module, bound.level, self.path)
        if module is not None and not bound.name:
            return module
        if isinstance(module, Module):
            try:
                return module.get(bound.name)
            except CannotEvaluateError:
                inner = self.tree.module(f"{bound.module}.{bound.name}".strip("."), bound.level, self.path)
                if inner is not None:
                    return inner
                raise
        inner = self.tree.module(f"{bound.module}.{bound.name}".strip("."), bound.level, self.path)
        if inner is not None:
            return inner
        known = known_class(bound.name, self.tree.built_in)
        if known is not None:
            return known
        where = "." * bound.level + bound.module
        raise CannotEvaluateError(f"uses {bound.name or where} of {where}, which is not a file of this tree")

    # ---- statements ------------------------------------------------------------------------------------------------------

    def _place(self, node: Any) -> Place:
        return Place(relative(self.path), node.lineno)

    def _run(self, body: list[ast.stmt], scope: dict[str, Any]) -> None:
        """Read statements in order; `scope` is the module's or a class's."""
        for node in body:
            if isinstance(node, ast.ClassDef):
                scope[node.name] = self._class(node, scope)
            elif isinstance(node, ast.Assign | ast.AnnAssign | ast.AugAssign):
                self._assign(node, scope)
            elif isinstance(node, ast.Import):
                for alias in node.names:
                    first = alias.name if alias.asname else alias.name.split(".")[0]
                    scope[alias.asname or first] = _Import(first, "", 0)
            elif isinstance(node, ast.ImportFrom):
                self._import_from(node, scope)
            elif isinstance(node, ast.If):
                self._branch(node, scope)
            elif isinstance(node, ast.Try | ast.With):
                self._run(node.body, scope)
            elif isinstance(node, ast.For | ast.While):
                self.tree.note(self._place(node), "a loop, which is not followed")

    def _import_from(self, node: ast.ImportFrom, scope: dict[str, Any]) -> None:
        for alias in node.names:
            if alias.name == "*":
                self._stars.append(_Import(node.module or "", "*", node.level))
            else:
                scope[alias.asname or alias.name] = _Import(node.module or "", alias.name, node.level)

    def _branch(self, node: ast.If, scope: dict[str, Any]) -> None:
        if ast.unparse(node.test).startswith("__name__"):
            return
        try:
            self._run(node.body if self._evaluator(scope)(node.test) else node.orelse, scope)
        except CannotEvaluateError as error:
            self.tree.note(self._place(node), f"the condition '{ast.unparse(node.test)}' {error}; neither branch is taken")

    def _class(self, node: ast.ClassDef, scope: dict[str, Any]) -> type:
        bases: list[type] = []
        for expression in node.bases:
            try:
                base = self._evaluator(scope)(expression)
                if not isinstance(base, type):
                    raise CannotEvaluateError("is not a class")
                bases.append(base)
            except CannotEvaluateError as error:
                name = ast.unparse(expression).split(".")[-1].split("[")[0]
                if name not in EMPTY_BASES:
                    self.tree.note(
                        self._place(node), f"class {node.name}: what its base {ast.unparse(expression)} sets: {error}"
                    )
        inner: dict[str, Any] = {}
        self._run(node.body, inner)
        members = {
            name: value for name, value in inner.items() if not name.startswith("__") and not isinstance(value, _Import)
        }
        members[MEMBER_OF] = self._place(node)
        try:
            return type(node.name, tuple(bases), members)
        except TypeError as error:
            raise ConfigError(f"{self._place(node)}: class {node.name}: {' '.join(str(error).split())}") from error

    def _assign(self, node: ast.Assign | ast.AnnAssign | ast.AugAssign, scope: dict[str, Any]) -> None:
        if node.value is None:
            return  # an annotation alone
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        place = self._place(node)
        try:
            expression = node.value
            if isinstance(node, ast.AugAssign):
                expression = ast.BinOp(_loaded(node.target), node.op, node.value)
            value = self._evaluator(scope)(expression)
            why = ""
        except CannotEvaluateError as error:
            value, why = None, str(error)
        for target in targets:
            self._bind(target, value, why, place, scope)

    def _bind(self, target: ast.expr, value: Any, why: str, place: Place, scope: dict[str, Any]) -> None:
        if isinstance(target, ast.Name):
            scope[target.id] = value if isinstance(value, type | Module | Numbers) else Found(value, place, why)
        elif isinstance(target, ast.Tuple | ast.List):
            values = list(value) if isinstance(value, list | tuple) else []
            if len(values) != len(target.elts):
                values, why = [None] * len(target.elts), why or "is not taken apart"
            for part, item in zip(target.elts, values, strict=True):
                self._bind(part, item, why, place, scope)
        elif isinstance(target, ast.Attribute | ast.Subscript):
            try:
                owner = self._evaluator(scope)(target.value)
                if isinstance(target, ast.Attribute) and isinstance(owner, type):
                    setattr(owner, target.attr, value if isinstance(value, type) else Found(value, place, why))
                elif isinstance(target, ast.Subscript) and isinstance(owner, dict | list) and not why:
                    owner[self._evaluator(scope)(target.slice)] = value
                else:
                    raise CannotEvaluateError(why or "is not followed")
            except (CannotEvaluateError, LookupError, TypeError) as error:
                self.tree.note(place, f"{ast.unparse(target)} {error}")

    def _evaluator(self, scope: dict[str, Any]) -> Evaluator:
        def value_of(found: Any) -> Any:
            if not isinstance(found, Found):
                return found
            if found.why_unknown:
                raise CannotEvaluateError(found.why_unknown)
            return found.value

        def lookup(name: str) -> Any:
            if name in scope and not isinstance(scope[name], _Import):
                return value_of(scope[name])
            return value_of(self.get(name))  # as in Python, a class body does not see the names of the class around it

        def member(owner: Any, name: str) -> Any:
            if isinstance(owner, Module):
                return value_of(owner.get(name))
            if isinstance(owner, type) and not name.startswith("__"):
                if hasattr(owner, name):
                    return value_of(getattr(owner, name))
                raise CannotEvaluateError(f"uses {owner.__name__}.{name}, which is set nowhere")
            raise CannotEvaluateError(f"uses .{name}, which is not run")

        return Evaluator(lookup, member)


class Tree:
    """All files of a configuration, each read once, when a name of it is needed."""

    def __init__(self) -> None:
        self._modules: dict[Path, Module | None] = {}
        self.notes: list[tuple[Place, str]] = []
        """Statements that are not supported, and the reasons."""
        self.built_in: dict[str, type] = {}
        """Classes of legged_gym that no file of the tree defines, with the values known to this package."""

    def note(self, place: Place, text: str) -> None:
        """Store an unsupported statement for the report."""
        self.notes.append((place, text))

    def read(self, path: Path) -> Module | None:
        """Return the module at `path`; None while it is being read, for files that import each other."""
        path = path.resolve()
        if path not in self._modules:
            self._modules[path] = None
            self._modules[path] = Module(path, self)
        return self._modules[path]

    def module(self, name: str, level: int, importer: Path) -> Module | None:
        """Return the module that an import in the file `importer` names; None if it is not a file of the tree."""
        parts = [part for part in name.split(".") if part]
        if level:
            folders = [importer.parents[level - 1]] if level <= len(importer.parents) else []
        else:
            folders = list(importer.parents)
        for folder in folders:
            base = folder.joinpath(*parts)
            for path in (base.with_suffix(".py") if parts else base / "__init__.py", base / "__init__.py"):
                if exists(path) and path.is_file() and path != importer:
                    return self.read(path)
        return None


def _loaded(target: ast.expr) -> ast.expr:
    """Return the expression that an augmented assignment reads."""
    return ast.parse(ast.unparse(target), mode="eval").body


def _text(path: Path) -> str:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"{relative(path)}: cannot be read ({error.strerror or error})") from error
    if len(content) > MOST_BYTES:
        raise ConfigError(f"{relative(path)}: is not a configuration: it is larger than {MOST_BYTES:,} bytes")
    return content.decode("utf-8-sig", errors="replace")
