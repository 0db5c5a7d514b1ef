"""A policy that all tests of the robot's program can run: it needs nothing but sensors."""

from pathlib import Path

import pytest
from still_robot import Stage, exported


@pytest.fixture(scope="session")
def policy_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with its export."""
    return exported(tmp_path_factory.mktemp("policy"))


@pytest.fixture
def stage(policy_folder: Path) -> Stage:
    """A program in virtual time."""
    return Stage(policy_folder)
