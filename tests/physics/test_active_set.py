"""Active set of the last step, from which the constraint solver starts: it saves iterations, and changes nothing else."""

from unittest import mock

import mujoco
import numpy as np
import pytest
import torch
from devices import CUDA, on_gpu
from mechanisms import EVERY_ROW, FusedWorlds, relative_error
from reference import heaps

from legged.physics.fused import constraint_solver
from legged.physics.fused.active_set import HOLDING, IDLE, SLIPPING, SLIPPING_BACK, UNKNOWN

COUNT = 19
HERE = [pytest.param("cpu", "wide", id="blocks"), pytest.param("cpu", "lanes", id="lanes")]
SOURCES = [*HERE, on_gpu(CUDA, "lanes", id="cuda")]
"""Both texts of the solver; a CPU runs that of a GPU's lanes too, with one lane."""


def crawlers(device: str, source: str, known: bool = True) -> FusedWorlds:
    """Return worlds that have just been put down, and slide."""
    model = mujoco.MjModel.from_xml_string(EVERY_ROW)
    rng = np.random.default_rng(0)
    qpos = np.tile(model.qpos0, (COUNT, 1)) + np.pad(rng.uniform(-0.2, 0.2, (COUNT, model.nq - 7)), ((0, 0), (7, 0)))
    qpos[:, 2] += rng.uniform(-2e-3, 0.05, COUNT)
    with mock.patch.object(constraint_solver, "fits_wide", return_value=source == "wide"):
        worlds = FusedWorlds(model, COUNT, device=device, known=known)
    worlds.write(qpos, rng.normal(0.0, 0.5, (COUNT, model.nv)), np.zeros((COUNT, 0)))
    return worlds


@pytest.mark.slow
@pytest.mark.parametrize(("device", "source"), SOURCES)
def test_beginning_with_them_halves_the_rounds_and_leads_to_the_same_forces(device, source):
    """Each step of both from the same state and the same last acceleration."""
    told, untold = crawlers(device, source), crawlers(device, source, known=False)
    rounds, seen = np.zeros(2), set()
    for step in range(60):
        for name in ("qpos", "qvel", "qacc_warmstart"):
            getattr(untold.d, name).assign(getattr(told.d, name).numpy())
        for worlds in (told, untold):
            worlds.step()
        seen |= {name for name in ("ne", "nf", "nl") if told.read(name).any()}
        assert relative_error(told.read("qacc"), untold.read("qacc")) < 1e-3, step
        assert relative_error(told.read("qfrc_constraint"), untold.read("qfrc_constraint")) < 1e-3, step
        if step >= 10:
            rounds += [told.read("solver_niter").mean(), untold.read("solver_niter").mean()]
    assert seen == {"ne", "nf", "nl"}
    assert told.read("nefc").max() > 3 + 4
    assert rounds[0] < 0.7 * rounds[1]


@pytest.mark.parametrize(("device", "source"), SOURCES)
def test_final_states_of_rows_are_kept_in_the_order_of_their_keys(device, source):
    """A row pushes or not, by its force; one of dry friction (0.8 N m) is at its greatest force or below."""
    worlds = crawlers(device, source)
    for _ in range(40):
        worlds.step()
    active_set, force = worlds.active_set, worlds.d.efc.force.numpy()
    keys, last = active_set.key.numpy(), active_set.last.numpy()
    ne, nf, nefc = (worlds.read(name) for name in ("ne", "nf", "nefc"))
    of_friction, of_others = set(), set()
    for world in range(COUNT):
        count = nefc[world] - ne[world]
        assert last[world, 0] == count
        rows = last[world, 1 : 1 + count]
        assert (np.diff(rows >> 2) > 0).all()
        assert (rows >> 2 == keys[world, ne[world] : nefc[world]]).all()
        for k, side in enumerate((rows & 3) - 2):
            pushes = force[world, ne[world] + k]
            if k < nf[world]:
                expected = SLIPPING if pushes <= -0.8 else SLIPPING_BACK if pushes >= 0.8 else HOLDING
                of_friction.add(expected)
            else:
                expected = HOLDING if pushes > 0.0 else IDLE
                of_others.add(expected)
            assert side == expected
    assert len(of_friction) > 1
    assert of_others == {HOLDING, IDLE}
    assert UNKNOWN not in of_friction | of_others


@pytest.mark.parametrize(("device", "source"), SOURCES)
def test_wrong_states_cost_iterations_only(device, source):
    """Every row is said to be where it is not, or by a key that no row has."""
    right, wrong = crawlers(device, source), crawlers(device, source)
    for _ in range(30):
        right.step()
    for name in ("qpos", "qvel", "qacc_warmstart"):
        getattr(wrong.d, name).assign(getattr(right.d, name).numpy())
    last = right.active_set.last.numpy()
    keys, side = last[:, 1:] >> 2, (last[:, 1:] & 3) - 2
    other = np.where(keys < right.model.nv, np.where(side == HOLDING, SLIPPING, HOLDING), IDLE + HOLDING - side)
    keys[::3] += 1000
    wrong.active_set.last.assign(np.hstack([last[:, :1], keys << 2 | other + 2]))
    for worlds in (right, wrong):
        worlds.step()
    assert relative_error(wrong.read("qacc"), right.read("qacc")) < 1e-3
    assert wrong.read("solver_niter").mean() > right.read("solver_niter").mean()


@pytest.mark.parametrize("engine", ["mujoco_warp", on_gpu("mujoco_warp, cuda")])
def test_a_world_that_is_put_into_another_state_begins_as_if_it_were_new(robot, make_physics, engine):
    """Heaps of robots land, then some are put back; those go where they went at first, to the bit."""
    physics = make_physics(engine, num_envs=6)
    states = heaps(robot, 6, seed=3)
    every, some = torch.ones(6, dtype=torch.bool), torch.arange(6) % 2 == 0

    def rolled() -> torch.Tensor:
        for _ in range(60):  # they land after 30
            physics.step()
        return torch.cat([physics.qpos, physics.qvel], dim=1).clone()

    physics.write(every, states.qpos, states.qvel)
    first = rolled()
    physics.write(every, states.qpos.flip(0), states.qvel.flip(0))
    rolled()
    physics.write(some, states.qpos, states.qvel)
    again = rolled()
    assert torch.equal(again[some], first[some])
    assert not torch.equal(again[~some], first[~some])
