"""Fixtures of the tests of environments."""

import mujoco
import pytest


@pytest.fixture
def pictures() -> None:
    """What draws pictures is skipped where nothing can be rendered."""
    try:
        mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 8, 8).close()
    except Exception as error:  # each GL back-end fails in its own way
        pytest.skip(f"nothing can be rendered here: {error}")
