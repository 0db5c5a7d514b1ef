"""Robots that weigh next to nothing feel the ground as heavy ones do."""

import re

import pytest
import torch
import yaml
from helpers import small_task

from legged.mdp.contacts import contact_force
from legged.process.paths import data_folder

LIGHTER = 50.0


def test_what_counts_as_a_contact():
    """1 N down to a weight of 100 N, below that 1 % of it."""
    assert [contact_force(mass) for mass in (52.0, 10.2)] == [1.0, 1.0]
    assert contact_force(0.5) == pytest.approx(0.04905)


@pytest.fixture
def feather(tmp_path):
    """The folder of a Go2 of 300 g, whose feet carry 0.74 N each."""
    source = data_folder("resources") / "robots" / "go2"
    folder = tmp_path / "feather"
    folder.mkdir()
    text = (source / "go2.xml").read_text(encoding="utf-8")
    numbers = re.compile(r'\b(mass|diaginertia|fullinertia|armature|damping|frictionloss)="([^"]*)"')

    def lighter(found: re.Match) -> str:
        return f'{found[1]}="{" ".join(str(float(number) / LIGHTER) for number in found[2].split())}"'

    (folder / "go2.xml").write_text(numbers.sub(lighter, text), encoding="utf-8")
    robot = yaml.safe_load((source / "robot.yaml").read_text(encoding="utf-8"))
    robot = {key: value for key, value in robot.items() if key not in ("stiffness", "damping")}  # by the rule
    (folder / "robot.yaml").write_text(yaml.safe_dump(robot), encoding="utf-8")
    return folder


@pytest.mark.slow
def test_a_robot_of_300_grams_stands_on_its_feet(feather):
    still = [("init_state.dof_pos_factor", [1.0, 1.0]), ("init_state.base_velocity", [0.0, 0.0])]
    task = small_task(("robot", str(feather)), ("domain_rand.randomize_base_mass", False), *still, num_envs=2)
    for _ in range(50):
        task.step(torch.zeros(2, 12))
    forces = task.contact_forces[:, task.feet_indices, 2]
    assert task.robot.mass == pytest.approx(15.019 / LIGHTER, rel=1e-3)
    assert forces.sum(dim=1).tolist() == pytest.approx([9.81 * task.robot.mass] * 2, rel=0.1)
    assert task.contacts.in_contact.all()
    assert (task.contacts.air_time == 0.0).all()
    assert not task.terminated_buf.any()
