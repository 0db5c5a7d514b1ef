"""Rules about the code itself: how long files are, those of the tests too, and which way imports point."""

import ast
import functools
import sys
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
    """Modules that a file imports anywhere in it, functions and annotations included, as dotted names."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
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
    {"errors", "math", "state"},
    {"process"},
    {"graph", "config", "figures", "tables"},
    {"robots", "terrain"},
    {"physics"},
    {"mdp"},
    {"envs"},
    {"user_modules", "gymnasium_ids"},
    {"registry"},
    {"commandline"},
    {"learning", "rendering", "deploy"},
    {"policies", "gymnasium_envs"},
    {"play"},
    {"evaluation"},
    {"episodes", "fitting", "migration", "simulated_robot"},
    {"sweeping"},
    {"cli"},
]
PARTS = sorted({name_of(path).split(".")[1] for path in FILES if name_of(path) not in ("legged", "legged.__main__")})
OF_ROBOTS = ("deploy", "errors", "process")
"""What a robot's computer runs; `process` imports no torch either."""
WITHOUT = {  # what else a part does without
    "errors": ["torch"],
    "process": ["torch"],
    "deploy": ["torch", "mujoco", "yaml", *(f"legged.{part}" for part in PARTS if part not in OF_ROBOTS)],
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
