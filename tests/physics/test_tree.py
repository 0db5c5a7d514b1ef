"""The order of elimination: trees of known mechanisms, by hand."""

import mujoco
import numpy as np
import pytest
from random_robots import EXTRAS, random_robot

from legged.config.world import SimConfig
from legged.physics.fused.constraint_solver import blocks, solver_constants
from legged.physics.fused.tree import Tree
from legged.physics.scene import RobotScene

SCISSORS = """
<mujoco>
  <worldbody>
    <body name="base"><freejoint/><geom size=".1"/>
      <body name="left"><joint axis="0 1 0"/><geom size=".1"/>
        <body name="left end"><joint name="left end" axis="0 1 0"/><geom size=".1"/></body>
      </body>
      <body name="middle"><joint axis="0 1 0"/><geom size=".1"/></body>
      <body name="right"><joint axis="0 1 0"/><geom size=".1"/>
        <body name="right end"><joint name="right end" axis="0 1 0"/><geom size=".1"/></body>
      </body>
    </body>
  </worldbody>
  <equality>%s</equality>
</mujoco>
"""
"""Degrees of freedom: 0 to 5 of the base, 6 and 7 left, 8 in the middle, 9 and 10 right."""
CLOSED = {
    "open": ("", [5, 6, 5, 5, 9]),
    "two ends meet": ('<connect body1="left end" body2="right end" anchor="0 0 0"/>', [5, 6, 5, 7, 9]),
    "two joints go together": ('<joint joint1="left end" joint2="right end"/>', [5, 6, 5, 7, 9]),
    "an end is held by the base": ('<weld body1="left end" body2="base"/>', [5, 6, 5, 5, 9]),
    "an end is held by the world": ('<weld body1="left end"/>', [5, 6, 5, 5, 9]),
}


@pytest.mark.parametrize("name", CLOSED)
def test_loops_put_their_branches_one_above_the_other(name):
    equality, above = CLOSED[name]
    tree = Tree.of(mujoco.MjModel.from_xml_string(SCISSORS % equality))
    np.testing.assert_array_equal(tree.parent, [-1, 0, 1, 2, 3, 4, *above])


def test_legs_are_eliminated_side_by_side(robot):
    """ANYmal C: six degrees of freedom of the base, and four legs of three."""
    tree = Tree.of(RobotScene(robot).model(SimConfig()))
    constants = tree.constants()
    assert {name: constants[name] for name in ("ROOT", "DEPTH", "WIDTH", "SPLIT")} == {
        "ROOT": 6,
        "DEPTH": 9,
        "WIDTH": 4,
        "SPLIT": True,
    }
    tables = tree.tables()
    np.testing.assert_array_equal(tables["depth_width"], [1] * 6 + [4] * 3)
    np.testing.assert_array_equal(tables["dof_place"][6:], np.repeat(range(4), 3))
    # On the thigh of the second leg, dof 10, hangs its shank alone; on the base hang all four.
    below = tables["below"].reshape(9, 18)
    assert (below[8, 10] & 0xFF, below[8, 10] >> 8) == (1, 2)
    assert (below[8, 5] & 0xFF, below[8, 5] >> 8) == (0, 4)
    assert int(tables["path"][10]) == 0b11_000_111111


def test_trees_without_a_common_beginning_have_no_root():
    assert Tree(np.array([-1, 0, -1, 2])).root == 0
    assert Tree(np.array([-1, 0, 0, 1])).root == 1
    assert Tree(np.arange(9) - 1).root == 6
    assert Tree(np.array([-1])).root == 1


@pytest.mark.parametrize("hinges", [5, 17, 33])
def test_an_elimination_changes_entries_of_paths_alone(hinges):
    """The matrix of the mass and of what equality constraints couple, eliminated from its end, fills in nowhere else."""
    model = random_robot(hinges, hinges, EXTRAS)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    matrix = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, matrix)
    rows = data.efc_J.reshape(data.nefc, model.nv)[data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY]
    assert len(rows)
    matrix += rows.T @ rows
    tree = Tree.of(model)
    for k in range(model.nv - 1, -1, -1):
        changed = np.flatnonzero(np.abs(matrix[k, :k]) > 1e-14)
        assert set(changed) <= set(tree.path(k))
        matrix[:k, :k] -= np.outer(matrix[k, :k], matrix[k, :k]) / matrix[k, k]


def test_more_rows_and_degrees_of_freedom_leave_room_for_fewer_worlds():
    def held(nv: int, rows: int, **more: bool) -> int:
        return blocks(solver_constants(Tree(np.arange(nv) - 1), rows, nv, **more))

    assert held(18, 96) > held(35, 200) > held(60, 500) >= 4
    assert held(18, 200, elliptic=True) <= held(18, 200)
