"""Values and classes of files that are read without being run."""

import ast
import math
from pathlib import Path

import pytest

from legged.errors import ConfigError
from legged.migration.expressions import CannotEvaluateError, Evaluator, Numbers
from legged.migration.found import Found, members
from legged.migration.modules import Tree
from legged.migration.translation import plain

pytestmark = pytest.mark.usefixtures("workplace")


def evaluated(text: str) -> object:
    names = {"np": Numbers(), "math": Numbers(), "A": [1, 2, 3], "B": {"a": 0.5}, "n": 4}
    names |= {known.__name__: known for known in (list, max, str, sum)}

    def lookup(name: str) -> object:
        if name not in names:
            raise CannotEvaluateError(f"uses {name}, which is set nowhere")
        return names[name]

    def member(owner: object, name: str) -> object:
        raise CannotEvaluateError(f"uses .{name}, which is not run")

    return Evaluator(lookup, member)(ast.parse(text, mode="eval").body)


VALUES = {
    "2 * np.pi": 2 * math.pi,
    "-math.pi / 2": -math.pi / 2,
    "1.e-3": 1e-3,
    "2**23": 8388608,
    "1 << 4": 16,
    "45 + 3 * (n - 1)": 54,
    "[0.1 * i for i in A]": [0.1, 0.2, 0.1 * 3],
    "{f'{leg}_hip': 0.1 for leg in ('FL', 'FR') if leg != 'FR'}": {"FL_hip": 0.1},
    "{**B, 'b': 1}": {"a": 0.5, "b": 1},
    "[*A, 4]": [1, 2, 3, 4],
    "A[-1]": 3,
    "A[1:]": [2, 3],
    "[0.] * 3": [0.0, 0.0, 0.0],
    "np.array([1, 2])": [1, 2],
    "np.linspace(0, 1, 3)": [0.0, 0.5, 1.0],
    "np.arange(0, 1, 0.25)": [0.0, 0.25, 0.5, 0.75],
    "np.deg2rad(180)": math.pi,
    "max(A) if n > 3 else 0": 3,
    "sum(x for x in A)": 6,
    "not (1 < n <= 4 and n in A)": True,
    "None or 3": 3,
    "(1, 2)": (1, 2),
    "{(i, j): i * j for i, j in [(1, 2)]}": {(1, 2): 2},
    "field(default_factory=lambda: [1, 2])": [1, 2],
    "os.path.join('a', 'b.urdf')": "a/b.urdf",
    "np.linspace(-0.5, 0.5, 5) * 2": [-1.0, -0.5, 0.0, 0.5, 1.0],
    "2 * np.arange(3) - 1": [-1, 1, 3],
    "np.array([1, 2, 3]) + np.array([0.5, 0.5, 0.5])": [1.5, 2.5, 3.5],
    "A + np.array([1, 1, 1])": [2, 3, 4],
    "-np.array((1, 2)) / [2, 4]": [-0.5, -0.5],
    "1 - np.array([[1, 2], [3, 4]])[:, 1]": [-1, -3],
    "[row * 2 for row in np.array([[1, 2], [3, 4]])]": [[2, 4], [6, 8]],
    "np.array([1, 2, 3])[1:] * 2": [4, 6],
    "[*np.array([1, 2])] * 2": [1, 2, 1, 2],
    "np.array([1, 2]).tolist() * 2": [1, 2, 1, 2],
    "list(np.array([1, 2])) + [3]": [1, 2, 3],
    "np.array(A).copy() * 100000": [100000, 200000, 300000],
    "[0, *np.arange(2), 1]": [0, 0, 1, 1],
    "2 in np.arange(3)": True,
    "'{}_{}'.format('a', n)": "a_4",
    "'{leg}_{0:.2f}'.format(0.5, leg='FL')": "FL_0.50",
    "'{ROOT}/x'.format(ROOT='y')": "y/x",
    "'{MY_ROOT_DIR}/x'.format(MY_ROOT_DIR=MY_ROOT_DIR)": "{MY_ROOT_DIR}/x",
}


@pytest.mark.parametrize("text", VALUES)
def test_an_expression_has_its_value(text):
    assert evaluated(text) == VALUES[text]


WITHOUT = {
    "open('/etc/passwd')": "uses open, which is set nowhere",
    "__import__('os').system('ls')": "uses .system, which is not run|uses __import__",
    "np.random.rand()": "uses random of a library",
    "(lambda: 1)()": "Lambda",
    "1 / 0": "division by zero",
    "A[7]": "fails: ",
    "'a' + 1": "fails: ",
    "[0] * 10**9": "too large|more than 10000 items",
    "10**10**10": "too large",
    "np.linspace(0, 1, 10**6)": "more than 10000 items",
    "A.__class__": "not run",
    "unknown_thing * 2": "uses unknown_thing, which is set nowhere",
    "np.arange(3) + np.arange(2)": "fails: ",
    "np.arange(3) / 0": "fails: ",
    "np.arange(200) * np.array([[i] for i in np.arange(200)])": "more than 10000 items",
    "np.array(['a']) * 2": "other things than numbers",
    "np.arange(3) > 1": "compares arrays",
    "'{}_{}'.format('a')": "fails: ",
    "'{}'.format(A)": "other values than texts",
    "'{}'.format(unknown_thing)": "uses unknown_thing",
    "'{a}'.format(**B)": "not followed",
    "str(n)(3)": "calls str\\(n\\)",
}


@pytest.mark.parametrize("text", WITHOUT)
def test_what_would_have_to_be_run_has_none(text):
    with pytest.raises(CannotEvaluateError, match=WITHOUT[text]):
        evaluated(text)


def written(path: str, text: str) -> Path:
    file = Path(path)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)
    return file


def of_class(file: Path, name: str, tree: Tree | None = None) -> dict:
    """Members of a class: values, and classes as dictionaries."""

    def values(owner: type) -> dict:
        return {
            name: (found.value if not found.why_unknown else found.why_unknown) if isinstance(found, Found) else values(found)
            for name, found in members(owner)
        }

    module = (tree or Tree()).read(file)
    return values(module.get(name))


def test_classes_inherit_as_pythons_do():
    file = written(
        "a.py",
        "STEP = 0.5\n"
        "class Base:\n"
        "    class env:\n"
        "        a = 1\n"
        "        b = a + 1\n"
        "    class other:\n"
        "        c = 3\n"
        "class Mixin:\n"
        "    class other(Base.other):\n"
        "        d = STEP * 2\n"
        "class Last(Mixin, Base):\n"
        "    class env(Base.env):\n"
        "        b = Base.env.b * 10\n"
        "        def method(self):\n"
        "            return 1\n"
        "Last.env.e = 'late'\n",
    )
    assert of_class(file, "Last") == {"env": {"a": 1, "b": 20, "e": "late"}, "other": {"c": 3, "d": 1.0}}
    assert of_class(file, "Base")["env"] == {"a": 1, "b": 2}


def test_a_class_that_replaces_a_section_has_nothing_of_the_old_one():
    file = written("a.py", "class A:\n    class s:\n        x = 1\nclass B(A):\n    class s:\n        y = 2\n")
    assert of_class(file, "B") == {"s": {"y": 2}}


def test_a_class_body_does_not_see_the_class_around_it():
    file = written("a.py", "x = 1\nclass A:\n    x = 2\n    class inner:\n        y = x\n    z = x\n")
    assert of_class(file, "A") == {"x": 2, "inner": {"y": 1}, "z": 2}


def test_imports_are_followed_in_the_tree_without_being_run():
    danger = "import isaacgym\nraise SystemExit\n"
    written("fork/legged_gym/__init__.py", "import os\nLEGGED_GYM_ROOT_DIR = os.path.dirname(__file__)\n")
    written("fork/legged_gym/envs/__init__.py", f"{danger}from .base.config import Base\nfrom .star import *\n")
    written("fork/legged_gym/envs/base/config.py", f"{danger}class Base:\n    class env:\n        n = 3\n")
    written("fork/legged_gym/envs/star.py", "NUMBER = 7\n")
    file = written(
        "fork/legged_gym/envs/go/config.py",
        "from legged_gym import LEGGED_GYM_ROOT_DIR\n"
        "from legged_gym.envs import Base, NUMBER\n"
        "import legged_gym.envs.base.config as base\n"
        "from ..base import config as again\n"
        "class Go(Base):\n"
        "    class env(base.Base.env):\n"
        "        m = NUMBER + again.Base.env.n\n"
        "    file = f'{LEGGED_GYM_ROOT_DIR}/go.urdf'\n",
    )
    tree = Tree()
    assert of_class(file, "Go", tree) == {"env": {"n": 3, "m": 10}, "file": "{LEGGED_GYM_ROOT_DIR}/go.urdf"}
    assert not tree.notes
    assert not tree.built_in


def test_files_that_import_each_other_end():
    written("one.py", "from two import B\nclass A:\n    x = 1\n")
    written("two.py", "from one import A\nclass B(A):\n    y = 2\n")
    assert of_class(Path("two.py"), "B") == {"x": 1, "y": 2}


def test_what_is_not_known_says_why_and_where():
    file = written(
        "a.py",
        "import torch\n"
        "from elsewhere import Strange\n"
        "class A(Strange):\n"
        "    x = torch.ones(3)\n"
        "    y = x\n"
        "    for i in range(3):\n"
        "        z = i\n"
        "if torch.cuda.is_available():\n"
        "    class C: pass\n",
    )
    tree = Tree()
    found = of_class(file, "A", tree)
    assert found["x"].startswith("uses torch")
    assert found["y"] == found["x"]
    assert [(place.line, text.split(",")[0]) for place, text in tree.notes] == [
        (3, "class A: what its base Strange sets: uses Strange of elsewhere"),
        (6, "a loop"),
        (8, "the condition 'torch.cuda.is_available()' uses torch of torch"),
    ]


def test_augmented_assignments_conditions_and_annotations():
    file = written(
        "a.py",
        "N = 3\n"
        "class A:\n"
        "    feet: list = ['a']\n"
        "    feet += ['b']\n"
        "    alone: int\n"
        "    p, q = 1, [2]\n"
        "    if N > 2:\n"
        "        r = 'yes'\n"
        "    else:\n"
        "        r = 'no'\n"
        "    table = {'x': 1}\n"
        "    table['y'] = 2\n",
    )
    assert of_class(file, "A") == {"feet": ["a", "b"], "p": 1, "q": [2], "r": "yes", "table": {"x": 1, "y": 2}}


def test_names_of_arrays_are_arrays():
    """Their arithmetic is numpy's wherever it is done, and what is taken of them are lists."""
    file = written(
        "a.py",
        "import numpy as np\n"
        "X = np.linspace(0.0, 1.0, 3)\n"
        "class A:\n"
        "    twice = X * 2\n"
        "    more = np.array([1, 2])\n"
        "    more += [1, 1]\n"
        "    first, second = np.array([1, 2]) * 3\n",
    )
    found = of_class(file, "A")
    assert found == {"twice": [0.0, 1.0, 2.0], "more": [2, 3], "first": 3, "second": 6}
    assert all(type(item) is float for item in found["twice"])
    assert type(plain(found["twice"])) is list  # as it is written


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("class A(:\n    pass\n", r"a\.py:1: is not a readable Python file"),
        ("x = 1\n  y = 2\n", r"a\.py:2: is not a readable Python file"),
        ("a\0b", r"a\.py.*: is not a readable Python file"),
        ("class A: pass\nclass B(A, A): pass\n", r"a\.py:2: class B: duplicate base class"),
    ],
)
def test_a_broken_file_is_an_error_with_its_line(text, words):
    with pytest.raises(ConfigError, match=words):
        Tree().read(written("a.py", text))
