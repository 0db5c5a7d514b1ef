"""Evaluator of Python expressions in files that are not run: literals, arithmetic, members of math and numpy, known names."""

import ast
import math
import operator
from collections.abc import Callable, Mapping
from typing import Any

from legged.migration.arrays import MOST_ITEMS, Array

LARGEST_EXPONENT = 1000
ROOT = "LEGGED_GYM_ROOT_DIR"
"""Name of legged_gym's root folder. Its path is unknown here, so it stays a name in braces."""


class CannotEvaluateError(Exception):
    """An expression that has no value without running the file; the text states the reason."""


class Numbers:
    """The members of math and numpy that configurations use."""

    VALUES = {"pi": math.pi, "e": math.e, "inf": math.inf, "tau": math.tau}
    ONE_TO_ONE = ("sqrt", "sin", "cos", "tan", "exp", "log", "floor", "ceil", "radians", "degrees", "fabs")
    LISTS = ("array", "asarray", "list", "float32", "float64", "int32", "int64")

    def get(self, name: str) -> Any:
        """Return a number, or a function of numbers.

        Raises:
            CannotEvaluateError: the modules' member `name` is not supported.
        """
        if name in self.VALUES:
            return self.VALUES[name]
        functions: dict[str, Callable[..., Any]] = {
            "deg2rad": math.radians,
            "rad2deg": math.degrees,
            "abs": abs,
            "round": round,
            "linspace": _linspace,
            "arange": _arange,
            **{other: getattr(math, other) for other in self.ONE_TO_ONE},
            **{other: _array for other in self.LISTS},
        }
        if name in functions:
            return functions[name]
        raise CannotEvaluateError(f"uses {name} of a library; libraries are not run")


def _array(value: Any, **_: Any) -> Any:
    """Return an array for a list, and a number unchanged."""
    return Array(value) if isinstance(value, list | tuple) else value


def _linspace(start: float, stop: float, num: int = 50) -> Array:
    _bounded(num)
    return Array(start + (stop - start) * i / max(num - 1, 1) for i in range(num))


def _arange(start: float, stop: float | None = None, step: float = 1) -> Array:
    first, last = (0, start) if stop is None else (start, stop)
    count = max(0, math.ceil((last - first) / step))
    _bounded(count)
    return Array(first + i * step for i in range(count))


def _bounded(count: int) -> None:
    if count > MOST_ITEMS:
        raise CannotEvaluateError(f"has more than {MOST_ITEMS} items")


def _range(*args: int) -> list[int]:
    _bounded(len(range(*args)))
    return list(range(*args))


BUILTINS: dict[str, Any] = {
    "float": float,
    "int": int,
    "bool": bool,
    "str": str,
    "abs": abs,
    "min": min,
    "max": max,
    "round": round,
    "len": len,
    "sum": sum,
    "sorted": sorted,
    "list": list,
    "tuple": tuple,
    "dict": dict,
    "range": _range,
    "True": True,
    "False": False,
    "None": None,
}
"""Names that every file has."""


def _power(base: Any, exponent: Any) -> Any:
    if abs(exponent) > LARGEST_EXPONENT or abs(base) > 1e6:
        raise CannotEvaluateError("is a power too large to compute")
    return base**exponent


def _times(left: Any, right: Any) -> Any:
    for sequence, count in ((left, right), (right, left)):
        if isinstance(sequence, str | list | tuple) and not isinstance(sequence, Array) and isinstance(count, int):
            _bounded(len(sequence) * count)
    return left * right


BINARY: dict[type, Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: _times,
    ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv,
    ast.Mod: operator.mod,
    ast.Pow: _power,
    ast.BitOr: operator.or_,
    ast.BitAnd: operator.and_,
    ast.LShift: lambda a, b: _times(a, _power(2, b)),
}
UNARY: dict[type, Callable[[Any], Any]] = {ast.USub: operator.neg, ast.UAdd: operator.pos, ast.Not: operator.not_}
COMPARE: dict[type, Callable[[Any, Any], bool]] = {
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Is: operator.is_,
    ast.IsNot: operator.is_not,
    ast.In: lambda a, b: a in b,
    ast.NotIn: lambda a, b: a not in b,
}


class Evaluator:
    """Evaluator of expressions; `lookup` returns the value of a name, `member` that of `object.name`."""

    def __init__(self, lookup: Callable[[str], Any], member: Callable[[Any, str], Any]) -> None:
        self._lookup, self._member = lookup, member
        self._local: list[Mapping[str, Any]] = []

    def __call__(self, node: ast.expr) -> Any:
        """Return the value of an expression.

        Raises:
            CannotEvaluateError: it has no value here; the text states the reason.
        """
        try:
            method = getattr(self, f"_{type(node).__name__.lower()}", None)
            if method is None:
                raise CannotEvaluateError(f"is of a kind that is not evaluated ({type(node).__name__})")
            return method(node)
        except CannotEvaluateError:
            raise
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
            raise CannotEvaluateError(f"fails: {' '.join(str(error).split())}") from error

    def _constant(self, node: ast.Constant) -> Any:
        return node.value

    def _name(self, node: ast.Name) -> Any:
        for names in reversed(self._local):
            if node.id in names:
                return names[node.id]
        return self._lookup(node.id)

    def _attribute(self, node: ast.Attribute) -> Any:
        owner = self(node.value)
        if isinstance(owner, Numbers):
            return owner.get(node.attr)
        return self._member(owner, node.attr)

    def _unaryop(self, node: ast.UnaryOp) -> Any:
        return UNARY[type(node.op)](self(node.operand))

    def _binop(self, node: ast.BinOp) -> Any:
        if type(node.op) not in BINARY:
            raise CannotEvaluateError("uses an operator that is not evaluated")
        return BINARY[type(node.op)](self(node.left), self(node.right))

    def _boolop(self, node: ast.BoolOp) -> Any:
        value = None
        for part in node.values:
            value = self(part)
            if bool(value) == isinstance(node.op, ast.Or):
                break
        return value

    def _compare(self, node: ast.Compare) -> bool:
        left = self(node.left)
        for op, other in zip(node.ops, node.comparators, strict=True):
            right = self(other)
            if isinstance(left, Array) or (isinstance(right, Array) and not isinstance(op, ast.In | ast.NotIn)):
                raise CannotEvaluateError("compares arrays, which is not evaluated")
            if not COMPARE[type(op)](left, right):
                return False
            left = right
        return True

    def _ifexp(self, node: ast.IfExp) -> Any:
        return self(node.body if self(node.test) else node.orelse)

    def _items(self, nodes: list[ast.expr]) -> list[Any]:
        found: list[Any] = []
        for node in nodes:
            found.extend(self(node.value) if isinstance(node, ast.Starred) else [self(node)])
        return found

    def _list(self, node: ast.List) -> list[Any]:
        return self._items(node.elts)

    def _tuple(self, node: ast.Tuple) -> tuple[Any, ...]:
        return tuple(self._items(node.elts))

    def _set(self, node: ast.Set) -> list[Any]:
        return self._items(node.elts)

    def _dict(self, node: ast.Dict) -> dict[Any, Any]:
        found: dict[Any, Any] = {}
        for key, value in zip(node.keys, node.values, strict=True):
            found.update(self(value) if key is None else {self(key): self(value)})
        return found

    def _subscript(self, node: ast.Subscript) -> Any:
        return self(node.value)[self(node.slice)]

    def _slice(self, node: ast.Slice) -> slice:
        return slice(*(None if part is None else self(part) for part in (node.lower, node.upper, node.step)))

    def _joinedstr(self, node: ast.JoinedStr) -> str:
        return "".join(str(self(part)) for part in node.values)

    def _formattedvalue(self, node: ast.FormattedValue) -> str:
        return format(self(node.value), "" if node.format_spec is None else self(node.format_spec))

    def _call(self, node: ast.Call) -> Any:
        name = ast.unparse(node.func)
        if name in ("field", "dataclasses.field"):
            return self._field(node)
        if name.endswith("path.join"):
            return "/".join(str(part) for part in self._items(node.args))
        method = node.func if isinstance(node.func, ast.Attribute) else None
        if method is not None and method.attr in ("copy", "format", "items", "keys", "tolist", "values"):
            owner = self(method.value)
            if method.attr == "format" and isinstance(owner, str):
                return self._formatted(owner, node)
            if isinstance(owner, dict | list):
                found = getattr(owner, method.attr)()
                return found if method.attr == "copy" else list(found)
        function = self(node.func)
        if isinstance(function, type) and function not in (float, int, bool, str, list, tuple, dict):
            return function  # an instance of a configuration class has the class's values
        if not callable(function):
            raise CannotEvaluateError(f"calls {name}, which is not run")
        keywords = {word.arg: self(word.value) for word in node.keywords if word.arg}
        return function(*self._items(node.args), **keywords)

    def _formatted(self, text: str, node: ast.Call) -> str:
        """Return the result of `text.format(...)`. A folder that is unknown here stays a name in braces."""
        named: dict[str, Any] = {}
        for word in node.keywords:
            if word.arg is None:
                raise CannotEvaluateError("formats a text with names that are not followed")
            try:
                named[word.arg] = self(word.value)
            except CannotEvaluateError:
                if not word.arg.endswith(("ROOT", "DIR")):
                    raise
                named[word.arg] = f"{{{word.arg}}}"
        given = self._items(node.args)
        if not all(isinstance(value, str | int | float) for value in (*given, *named.values())):
            raise CannotEvaluateError("formats other values than texts and numbers")
        return text.format(*given, **named)

    def _field(self, node: ast.Call) -> Any:
        """Return the default of a dataclass field."""
        for word in node.keywords:
            if word.arg == "default":
                return self(word.value)
            if word.arg == "default_factory":
                made = word.value.body if isinstance(word.value, ast.Lambda) else ast.Call(word.value, [], [])
                return self(made)
        raise CannotEvaluateError("has no default")

    def _listcomp(self, node: ast.ListComp | ast.GeneratorExp) -> list[Any]:
        return [self(node.elt) for _ in self._each(node.generators)]

    _generatorexp = _listcomp

    def _dictcomp(self, node: ast.DictComp) -> dict[Any, Any]:
        return {self(node.key): self(node.value) for _ in self._each(node.generators)}

    def _each(self, generators: list[ast.comprehension]) -> Any:
        """Yield once per iteration of nested loops, with their names bound."""
        if not generators:
            yield
            return
        first, *rest = generators
        for value in self(first.iter):
            if isinstance(first.target, ast.Name):
                names = {first.target.id: value}
            elif isinstance(first.target, ast.Tuple):
                targets = [part.id for part in first.target.elts if isinstance(part, ast.Name)]
                names = dict(zip(targets, value, strict=True))
            else:
                raise CannotEvaluateError("loops over something that is not followed")
            self._local.append(names)
            try:
                if all(self(test) for test in first.ifs):
                    yield from self._each(rest)
            finally:
                self._local.pop()
