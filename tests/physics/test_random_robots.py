"""The fused step on robots drawn at random, with all that a robot's model may have: each step is C MuJoCo's."""

import os
from collections.abc import Collection
from typing import Any

import mujoco
import numpy as np
import pytest
from mechanisms import FusedWorlds, relative_error
from random_robots import EXTRAS, random_robot, rollout

from legged.physics.fused.tree import Tree

CASES = int(os.environ.get("FUZZ_CASES", "0"))
ERRORS = {"qfrc_smooth": 1e-5, "qfrc_constraint": 1e-3, "qacc": 1e-3, "qpos": 1e-5, "qvel": 1e-4}
"""What one step may differ, in units of the largest number where that is above 1: as float32 leaves it, of stiff contacts."""
GRAZING = 1e-6
"""How near [m] a contact is to none at all where one engine may have it and the other not."""


def states_of(passed: list[dict[str, Any]]) -> list[np.ndarray]:
    return [np.stack([state[name] for state in passed]) for name in ("qpos", "qvel", "ctrl")]


def grazes(model: mujoco.MjModel, qpos: np.ndarray) -> bool:
    """Whether some foot, a ball, neither clearly touches something nor clearly does not."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    balls = np.flatnonzero((model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE) & (model.geom_conaffinity > 0))
    depths = [data.geom_xpos[ball][2] - model.geom_size[ball][0] for ball in balls]
    if model.geom_contype[balls[0]]:
        depths += [
            np.linalg.norm(data.geom_xpos[one] - data.geom_xpos[other]) - model.geom_size[[one, other], 0].sum()
            for one in balls
            for other in balls
            if one < other
        ]
    return bool(np.abs(depths).min() < GRAZING)


def check_steps(seed: int, hinges: int, extras: Collection[str], device: str) -> None:
    """Check one step of each of 20 states that C MuJoCo passes under random controls, from before to after it lands."""
    model = random_robot(seed, hinges, extras)
    passed = rollout(model, seed, steps=400, every=20)
    fused = FusedWorlds(model, len(passed), rows=200, device=device)
    fused.write(*states_of(passed))
    fused.step()
    rows, found = fused.read("nefc"), {name: fused.read(name) for name in ERRORS}
    assert sum(state["touching"] for state in passed) > 5
    for i, state in enumerate(passed):
        if rows[i] != state["rows"]:
            assert grazes(model, state["qpos"]), (seed, i, rows[i], state["rows"])
            continue
        for name, most in ERRORS.items():
            error = relative_error(found[name][i], state.get(f"{name} after", state[name]))
            assert error < most, (seed, hinges, extras, i, name, error)


@pytest.mark.slow
@pytest.mark.parametrize("extras", [EXTRAS[i::4] for i in range(4)], ids=", ".join)
def test_a_step_with_some_extras_is_that_of_c_mujoco(extras, device):
    check_steps(1, 12, extras, device)


@pytest.mark.slow
@pytest.mark.parametrize("hinges", [2, 12, 29])
def test_a_step_with_all_extras_is_that_of_c_mujoco(hinges, device):
    check_steps(2, hinges, EXTRAS, device)


@pytest.mark.slow
def test_a_step_of_the_most_degrees_of_freedom_is_that_of_c_mujoco(device):
    check_steps(3, 54, ("damping", "self-collision"), device)


@pytest.mark.parametrize("seed", range(CASES))
def test_a_step_of_any_robot_is_that_of_c_mujoco(seed, device):
    """Only drawn with FUZZ_CASES: each is another robot, whose kernels are compiled."""
    rng = np.random.default_rng(seed)
    check_steps(seed, int(rng.integers(2, 41)), [extra for extra in EXTRAS if rng.random() < 0.5], device)


@pytest.mark.slow
@pytest.mark.parametrize("extras", [("damping", "self-collision"), EXTRAS], ids=["few extras", "all extras"])
def test_a_hundred_steps_are_those_of_c_mujoco(extras, device):
    """To 1e-4, with contacts that come and go. A world in which one engine meets the ground a step earlier than the other is
    left out from then on.
    """
    model = random_robot(1, 12, extras)
    passed = rollout(model, seed=1, steps=320, every=40)
    fused = FusedWorlds(model, len(passed), rows=200, device=device)
    fused.write(*states_of(passed))
    datas = []
    for state in passed:
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.ctrl[:] = (state[name] for name in ("qpos", "qvel", "ctrl"))
        datas.append(data)
    together = np.ones(len(datas), dtype=bool)
    rows = set()
    for _ in range(100):
        fused.step()
        for data in datas:
            mujoco.mj_step(model, data)
        counts = np.array([data.nefc for data in datas])
        together &= fused.read("nefc") == counts
        rows |= set(counts.tolist())
    assert len(rows) > 2
    assert together.sum() > len(datas) // 2
    for name in ("qpos", "qvel"):
        found = fused.read(name)
        for i in np.flatnonzero(together):
            assert relative_error(found[i], getattr(datas[i], name)) < 1e-4, (name, i)


@pytest.mark.slow
def test_a_row_that_couples_branches_is_solved_too(device):
    """Legs that touch each other: such a row has no place in the order of the branches."""
    model = random_robot(4, 8, ("self-collision",))
    tree = Tree.of(model)
    passed = rollout(model, seed=4, steps=600, every=10)
    paths = [set(tree.path(i)) for i in range(model.nv)]
    coupled = []
    for state in passed:
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = state["qpos"], state["qvel"]
        mujoco.mj_forward(model, data)
        matrix = data.efc_J.reshape(data.nefc, model.nv)
        moved = [set(np.flatnonzero(row)) for row in matrix]
        coupled.append(any(not any(each <= path for path in paths) for each in moved))
    assert sum(coupled) > 3
    fused = FusedWorlds(model, len(passed), rows=200, device=device)
    fused.write(*states_of(passed))
    fused.step()
    for i in np.flatnonzero(coupled):
        assert fused.read("nefc")[i] == passed[i]["rows"]
        assert relative_error(fused.read("qacc")[i], passed[i]["qacc"]) < 1e-3
