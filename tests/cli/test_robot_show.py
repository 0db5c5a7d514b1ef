"""`legged robot show`: the numbers of a robot's folder, and a name that is not one."""

from pathlib import Path

import numpy as np
import pytest
from helpers import call

from legged.cli.robot import show
from legged.robots.robot import load_robot

pytestmark = pytest.mark.usefixtures("workplace")


def rows_of(said: str) -> dict[str, list[str]]:
    """Return the first cell of every row of a table -> the other cells."""
    cells = [[cell.strip() for cell in line.split("│")[1:-1]] for line in said.splitlines() if "│" in line]
    return {row[0]: row[1:] for row in cells}


@pytest.mark.parametrize("name", ["anymal_c", "g1"])
def test_every_joint_has_its_numbers(name, capsys):
    assert call(show.main, [name]) == 0
    said, robot = capsys.readouterr().out, load_robot(name)
    rows = rows_of(said)
    assert list(rows) == list(robot.joint_names)
    for i, joint in enumerate(robot.joint_names):
        default, limits, *others = rows[joint]
        assert float(default) == pytest.approx(robot.default_dof_pos[i], rel=1e-3, abs=1e-3)
        assert [float(part) for part in limits.split(" to ")] == pytest.approx(robot.dof_pos_limits[i], rel=1e-3, abs=1e-3)
        wanted = [
            values[i]
            for values in (robot.dof_vel_limits, robot.torque_limits, robot.stiffness, robot.damping, robot.armature)
        ]
        assert [np.inf if cell == "-" else float(cell) for cell in others] == pytest.approx(wanted, rel=1e-3)
    assert f"feet: {', '.join(robot.feet_names)}\n" in said
    assert said.startswith(f"{name}: {robot.mass:.4g} kg, ")


def test_a_robot_of_a_folder_is_shown(added, capsys):
    from importing_fixtures import urdf

    added(urdf(), "--name", "shown_toy")
    assert call(show.main, ["mine/shown_toy"]) == 0
    said = capsys.readouterr().out
    assert said.startswith("shown_toy: 13 kg, ")
    assert "contact ends an episode: trunk\n" in said
    assert len(rows_of(said)) == 12
    assert Path("mine/shown_toy").name in said.splitlines()[0]


def test_a_robot_that_is_not_there_is_one_line(capsys):
    assert call(show.main, ["anymal_x"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ROBOT: there is no robot 'anymal_x'; did you mean")
    assert len(said.splitlines()) == 1
