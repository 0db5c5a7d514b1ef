"""How many contacts and rows a world has room for in the contact launch, and what becomes of those that find none."""

import re

import mujoco
import mujoco_warp as mjw
import numpy as np
import pytest
import warp as wp
from mechanisms import FusedWorlds

from legged.physics.fused.contact_kernel import shared_bytes, stage_constants
from legged.physics.fused.contact_stage import ContactStage
from legged.physics.fused.native import SOURCES
from legged.physics.warp.state_io import LOST

BOX = """
<mujoco>
  <option cone="{cone}"/>
  <worldbody>
    <geom type="plane" size="0 0 1"/><body pos="0 0 .099"><freejoint/><geom type="box" size=".1 .1 .1"/></body>
  </worldbody>
</mujoco>
"""
"""A box on its four corners."""


def box(cone: str, **room: int) -> FusedWorlds:
    """Return two worlds of it after a step, with room for so many contacts and rows."""
    model = mujoco.MjModel.from_xml_string(BOX.format(cone=cone))
    worlds = FusedWorlds(model, 2, **room)
    worlds.write(np.tile(model.qpos0, (2, 1)), np.zeros((2, 6)), np.zeros((2, 0)))
    worlds.step()
    return worlds


def test_more_contacts_than_a_gpu_has_shared_memory_for_are_said():
    """The contacts of a world lie there, 112 bytes each, and with them 16 bytes for each row of dry friction or a limit."""
    model = mujoco.MjModel.from_xml_string(BOX.format(cone="elliptic"))
    with wp.ScopedDevice("cpu"):
        m = mjw.put_model(model)
        most = (48 * 1024 - 16 * (model.nv + model.njnt)) // 112
        assert ContactStage.why_not(model, m, mjw.make_data(model, nworld=2, nconmax=most, njmax=20)) == ""
        too_many = ContactStage.why_not(model, m, mjw.make_data(model, nworld=2, nconmax=most + 1, njmax=20))
    assert too_many == f"{most + 1} contacts per world (sim.nconmax) exceed a GPU's shared memory"
    constants = stage_constants(model, rows=20, slots=most, dim=6, frictions=True, limits=True)
    taken = 0
    for arrays in re.findall(r"LEGGED_SHARED (?:float|int) (.+?);", (SOURCES / "contact_stage.h").read_text()):
        taken += sum(4 * eval(size, {"RECORD": 24, **constants}) for size in re.findall(r"\[(.+?)\]", arrays))
    assert taken == shared_bytes(constants) <= 48 * 1024


@pytest.mark.slow
@pytest.mark.parametrize("room", [{"contacts": 3}, {"rows": 11}])
def test_what_finds_no_room_is_flagged(room):
    """Three contacts of four, eleven rows of twelve."""
    assert (box("elliptic").read("overflow") & LOST == 0).all()
    assert (box("elliptic", **room).read("overflow") & LOST != 0).all()


@pytest.mark.slow
def test_a_contact_whose_last_rows_find_no_room_has_no_force_there():
    """Rows for two contacts and two thirds. mujoco-warp reads forces by the addresses of rows, and knows one beyond the last
    row, but a negative one only at the first row of a contact.
    """
    worlds = box("elliptic", contacts=24, rows=8)
    assert worlds.read("nefc").tolist() == [12, 12]
    worlds.d.efc.force.assign(np.float32([range(10, 18), range(20, 28)]))
    with wp.ScopedDevice("cpu"):
        found = wp.zeros(2 * 24, dtype=wp.spatial_vector)
        mjw.contact_force(worlds.m, worlds.d, wp.array(range(2 * 24), dtype=int), False, found)
    forces = found.numpy()[[0, 1, 2, 3, 24, 25, 26, 27], :3].tolist()
    assert forces[:4] == [[10, 11, 12], [13, 14, 15], [16, 17, 0], [0, 0, 0]]
    assert forces[4:] == [[20, 21, 22], [23, 24, 25], [26, 27, 0], [0, 0, 0]]
