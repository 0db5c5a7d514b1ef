"""Gymnasium knows our tasks, whoever is imported first, and nobody waits for it."""

import subprocess
import sys
from pathlib import Path

import gymnasium
import pytest

from legged.gymnasium_ids import add_ids
from legged.registry import register, task_names

ROOT = Path(__file__).resolve().parents[2]
IDS = "print(sorted(name for name in gymnasium.registry if name.startswith('legged/')))"


def run(code: str) -> str:
    """What a process of its own prints."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def shipped() -> list[str]:
    return sorted(f"legged/{path.stem}" for path in (ROOT / "cfg").glob("*.yaml"))


def test_every_task_has_an_id():
    assert {f"legged/{name}" for name in task_names()} <= set(gymnasium.registry)


@pytest.mark.slow
def test_importing_legged_imports_no_gymnasium_and_gymnasium_knows_the_tasks_later():
    code = (
        "import sys, importlib.util, legged\n"
        "assert 'gymnasium' not in sys.modules\n"
        "found = importlib.util.find_spec('gymnasium')\n"  # looks only, as legged itself does for the models
        "assert 'gymnasium' not in sys.modules\n"
        "import gymnasium\n"
        "assert gymnasium.__spec__.origin == found.origin\n"
        "from gymnasium.vector import VectorEnv\n"
        "assert not [finder for finder in sys.meta_path if 'legged' in type(finder).__module__]\n"
    )
    assert run(code + IDS) == str(shipped())


@pytest.mark.slow
def test_gymnasium_that_was_imported_first_knows_them_too():
    assert run(f"import gymnasium, legged\n{IDS}") == str(shipped())


@pytest.mark.slow
def test_gymnasium_imports_legged_by_itself_where_the_id_says_so():
    code = "import gymnasium\nenv = gymnasium.make('legged:legged/half_cheetah', config={'sim.threads': 1})\n"
    assert run(code + "print(env.reset(seed=1)[0].shape)") == "(17,)"


def test_a_task_of_a_user_has_an_id_and_the_newest_of_a_name_counts(recwarn):
    config = {"extends": "half_cheetah", "env": {"episode_length_s": 0.1}}
    register("gymnasium_cheetah", config)
    register("gymnasium_cheetah", {**config, "control": {"clip_actions": 0.5}})
    env = gymnasium.make("legged/gymnasium_cheetah", config={"sim.threads": 1})
    assert float(env.action_space.high[0]) == 0.5
    env.reset(seed=0)
    assert [env.step(env.action_space.sample())[3] for _ in range(2)] == [False, True]
    assert not [w for w in recwarn if "Overriding" in str(w.message)]


def test_a_name_that_gymnasium_cannot_have_is_left_out():
    register("what is this?", {"extends": "half_cheetah"})
    add_ids(["half_cheetah-v1"])  # beside half_cheetah
    assert "legged/what is this?" not in gymnasium.registry
    assert "legged/half_cheetah-v1" not in gymnasium.registry
    assert "what is this?" in task_names()


def test_a_wrong_name_is_answered_with_the_nearest_one():
    with pytest.raises(gymnasium.error.NameNotFound, match="half_cheetah"):
        gymnasium.make("legged/half_cheeta")
