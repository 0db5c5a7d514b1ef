"""Rules about the code itself: how long files are, those of the tests too, and which way imports point."""

import ast
import functools
import sys
from collections.abc import Iterable, Mapping
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import legged

PACKAGE = Path(legged.__file__).parent
FILES = sorted(PACKAGE.rglob("*.py"))
TESTS = sorted(Path(__file__).parent.rglob("*.py"))
LONGEST = 600


def name_of(path: Path) -> str:
    """legged/cli/train.py -> legged.cli.train."""
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@functools.cache
def imports(path: Path) -> set[str]:
    """A file's imports anywhere in it, functions and annotations included, as dotted names: `a.b` of `from a import b`."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def uses(path: Path, *modules: str) -> set[str]:
    """Those of the modules that a file imports, or something inside them."""
    return {module for module in modules for name in imports(path) if name == module or name.startswith(f"{module}.")}


def test_the_rules_are_applied_to_all_of_the_package():
    names = {name_of(path) for path in FILES}
    assert {"legged.physics.warp.mujoco_warp", "legged.cli.train", "legged.envs.legged_robot", "legged"} <= names
    # The parser of imports sees what it should: a lazy import, and a plain one.
    assert uses(PACKAGE / "graph" / "step_graph.py", "warp") == {"warp"}
    assert uses(PACKAGE / "cli" / "train.py", "legged.learning", "torch", "warp") == {"legged.learning", "torch"}


def test_no_file_is_too_long_to_read():
    lines = {path.as_posix(): len(path.read_text(encoding="utf-8").splitlines()) for path in [*FILES, *TESTS]}
    assert not {path: count for path, count in lines.items() if count > LONGEST}


@pytest.mark.slow
def test_warp_is_known_to_the_physics_to_kernels_and_to_the_graph_only():
    outside = [path for path in FILES if not name_of(path).startswith("legged.physics")]
    assert not {name_of(path) for path in outside if uses(path, "mujoco_warp")}
    of_warp = {name_of(path) for path in outside if uses(path, "warp")}
    assert {name for name in of_warp if not name.startswith("legged.mdp.kernels")} <= {"legged.graph.step_graph"}


FLOORS = [  # from the ground up; each part imports from the floors below it only
    {"deploy"},  # a robot's computer runs a copy of this folder alone
    {"errors", "math", "state"},
    {"process"},
    {"graph", "config", "figures", "tables"},
    {"robots", "terrain"},
    {"motion", "physics"},
    {"mdp"},
    {"envs"},
    {"user_modules", "gymnasium_ids"},
    {"registry"},
    {"commandline"},
    {"learning", "rendering"},
    {"policies", "gymnasium_envs"},
    {"play"},
    {"evaluation"},
    {"episodes", "fitting", "migration", "simulated_robot"},
    {"sweeping"},
    {"cli"},
]
PARTS = sorted({name_of(path).split(".")[1] for path in FILES if name_of(path) not in ("legged", "legged.__main__")})
WITHOUT = {  # what else a part does without
    "errors": ["torch"],
    "process": ["torch"],
    "deploy": ["torch", "mujoco", "yaml", *(f"legged.{part}" for part in PARTS if part != "deploy")],
    "config": ["torch"],
    "robots": ["torch"],
    "terrain": ["torch", "mujoco"],
    "graph.python_state": ["torch"],
    "mdp": ["mujoco"],
    "envs": ["mujoco"],
}


def floor_of(part: str) -> int:
    return next(i for i, parts in enumerate(FLOORS) if part in parts)


def test_every_part_has_its_floor():
    assert sorted(part for parts in FLOORS for part in parts) == PARTS


@pytest.mark.slow
@pytest.mark.parametrize("part", PARTS)
def test_imports_point_one_way(part):
    above = [other for other in PARTS if other != part and floor_of(other) >= floor_of(part)]
    files = [path for path in FILES if name_of(path).split(".")[1:2] == [part]]
    found = {name_of(path): uses(path, *(f"legged.{other}" for other in above)) for path in files}
    assert not {name: modules for name, modules in found.items() if modules}


def circle_in(graph: Mapping[str, Iterable[str]]) -> list[str]:
    """Nodes of a circle, from a node back to itself; empty without a circle."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return error.args[1]
    return []


@functools.cache
def files_imported() -> dict[str, set[str]]:
    """File -> files that it imports, also within functions and for annotations only, as dotted names."""
    names = {name_of(path) for path in FILES}
    found = {}
    for path in FILES:
        files = {name if name in names else name.rpartition(".")[0] for name in imports(path)}
        found[name_of(path)] = files & names - {name_of(path)}
    return found


def test_a_circle_is_found():
    assert circle_in({"a": ["b"], "b": ["c"], "c": []}) == []
    assert set(circle_in({"a": ["b"], "b": ["c"], "c": ["a"]})) == {"a", "b", "c"}
    # The graph has imports at the top, in functions, of names in packages, and for annotations.
    graph = files_imported()
    assert "legged.envs.base_task" in graph["legged.envs.final_observation"]
    assert "legged.physics.warp.mujoco_warp" in graph["legged.physics"]
    assert "legged.learning.fused_update.update" in graph["legged.learning.ppo"]


def test_no_files_import_each_other_in_a_circle():
    assert not circle_in(files_imported())


def test_no_folders_side_by_side_import_each_other_in_a_circle():
    """Folders within a part, such as those of the engines; FLOORS orders the parts."""
    folders = {name_of(path.parent / "__init__.py") for path in FILES if len(name_of(path).split(".")) > 3}

    def folder(name: str) -> str:
        return name if name in folders else name.rpartition(".")[0]

    graph: dict[str, set[str]] = {name: set() for name in folders}
    for name, others in files_imported().items():
        if folder(name) in folders:
            graph[folder(name)] |= {folder(other) for other in others} & folders - {folder(name)}
    assert {"legged.physics.warp", "legged.physics.fused", "legged.play.live"} <= folders
    assert "legged.physics.fused" in graph["legged.physics.warp"]
    assert not circle_in(graph)


@pytest.mark.slow
@pytest.mark.parametrize("part", WITHOUT)
def test_a_part_does_without(part):
    files = [path for path in FILES if f"{name_of(path)}.".startswith(f"legged.{part}.")]
    assert files, f"there is no {part}"
    found = {name_of(path): uses(path, *WITHOUT[part]) for path in files}
    assert not {name: modules for name, modules in found.items() if modules}


def test_rsl_rl_is_known_to_its_boundary_only():
    users = {name_of(path) for path in FILES if uses(path, "rsl_rl")}
    assert users <= {
        "legged.envs.base_task",
        "legged.learning.distillation",
        "legged.learning.estimator",
        "legged.learning.logger",
        "legged.learning.networks",
        "legged.learning.runner",
        "legged.learning.ppo",
        "legged.learning.rollout",
        "legged.learning.scaled_rewards",
        "legged.learning.trackers",
    }


@pytest.mark.slow
def test_a_machine_without_a_gpu_imports_no_gpu_engine():
    """The C engine must not cost the start-up of Warp, nor need it."""
    import subprocess

    code = (
        "import sys\n"
        "from legged.registry import make_task, task_config\n"
        "task = make_task(task_config('anymal_c_flat', [('env.num_envs', 1), ('sim.threads', 1)], on_cpu=True))\n"
        "print([name for name in ('warp', 'mujoco_warp') if name in sys.modules])\n"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=PACKAGE.parent, check=False)
    assert result.stdout.strip() == "[]", result.stdout + result.stderr
