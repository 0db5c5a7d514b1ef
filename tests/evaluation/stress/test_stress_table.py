"""The table of disturbances, the figures of its lines, and the score."""

import math

import numpy as np
import pytest
import torch
from helpers import small_config

from legged.config import override
from legged.evaluation.intervals import mean_of_shares, wilson
from legged.evaluation.stress.disturbances import ALONE, NOMINAL, Disturbance, combined, scaled, table
from legged.evaluation.stress.measuring import STAIRS, followed, score, settings
from legged.evaluation.success import to_run_out
from legged.evaluation.tiles import dividing_cell, tiles_apart
from legged.mdp.actuators.network import NetworkWeights
from legged.registry import task_class, task_config
from legged.robots.similarity import Size
from legged.terrain import TileSpec

ANYMAL = Size(50.0, 0.5)


def test_lines_for_the_robot_they_are_written_for():
    lines = table(ANYMAL, ANYMAL)
    assert [line.name for line in lines] == ["nominal", *[line.name for line in ALONE], "together", "everything"]
    assert lines[0] == NOMINAL
    assert lines[1:-2] == ALONE
    assert lines[-2] == Disturbance("together", payload=8.0, friction=0.4, motors=0.85, delay=0.02)
    assert (lines[-1].delay, lines[-1].map_holes) == (0.02, 0.2)
    assert set(lines[-1].changes) == {name for line in ALONE for name in line.changes}


def test_masses_and_lengths_are_those_of_the_robot():
    """Half as high and a fifth as heavy: lengths times 0.5, masses times 0.2, speeds times sqrt(0.5)."""
    small = {line.name: line for line in table(Size(10.0, 0.25), ANYMAL)}
    assert small["payload"].payload == pytest.approx(1.6)
    assert small["pushes"].push == pytest.approx(0.71)
    assert (small["map offset"].map_height, small["map offset"].map_shift) == pytest.approx((0.025, 0.05))
    of_any_size = ("friction", "weak motors", "delay 20 ms", "delay 40 ms", "zero offsets", "askew sensor", "map holes")
    for name in (*of_any_size, "no map"):
        assert small[name] == next(line for line in ALONE if line.name == name)
    assert scaled(NOMINAL, Size(1.0, 0.1), ANYMAL) == NOMINAL


def test_lines_say_what_they_are_in_physical_units():
    assert [line.text for line in table(ANYMAL, ANYMAL)[:5]] == [
        "nothing",
        "8 kg on the base",
        "friction 0.4",
        "motors at 85%",
        "targets 0.02 s late",
    ]
    both = combined("both", [Disturbance("a", push=1.0), Disturbance("b", zero_offset=0.05)])
    assert both.text == "velocity set to up to 1 m/s every 5 s, encoders up to 0.05 rad off"


@pytest.mark.parametrize(("task", "riser"), [("anymal_c", 0.17), ("go2", 0.12)])
def test_stairs_have_the_risers_and_treads_that_are_asked_for(task, riser):
    """Along the middle line of the tiles up and down, in cells that divide 0.28 m."""
    cfg = task_config(task, [], on_cpu=True)
    cell = dividing_cell(0.28, cfg.terrain.horizontal_scale)
    cfg = override(cfg, [*to_run_out(cfg, 2), ("terrain.horizontal_scale", cell)])
    ground = tiles_apart([TileSpec(name, riser, 0.28) for name in STAIRS], cfg.terrain, 1).height_map
    rises = np.diff(ground.heights[:, ground.heights.shape[1] // 2])
    steps = np.flatnonzero(np.abs(rises) > 0.01)
    assert len(steps) >= 24  # two flights on each of two tiles
    np.testing.assert_allclose(np.abs(rises[steps]), riser)
    between = np.diff(steps) * ground.cell
    treads = between[between < 1.0]
    assert len(treads) >= 20
    np.testing.assert_allclose(treads, 0.28)


def test_solvers_that_are_tried():
    cfg = small_config()
    found = {name: dict(changes) for name, changes in settings(cfg, "mujoco").items()}
    assert found["half the time step"] == {"sim.dt": 0.0025, "control.decimation": 8}
    late = override(cfg, [("control.actuator.delay", [1, 6])])
    halved = dict(settings(late, "mujoco")["half the time step"])
    assert halved["control.actuator.delay"] == [2, 12]  # counted in physics steps, which are half as long
    assert found["elliptic cones"] == {"sim.cone": "elliptic"}
    assert found["impratio 100"] == {"sim.impratio": 100.0, "sim.iterations": 50}
    assert list(settings(cfg, "newton_xpbd")) == ["half the time step"]


def test_the_time_step_is_not_halved_of_motors_that_know_their_own_alone(tmp_path):
    """An LSTM sees every physics step as it was trained to; an MLP picks its samples out of more of them."""
    output = {"weight": np.ones((1, 2), np.float32), "bias": np.zeros(1, np.float32)}
    cell = {"input": np.ones((8, 2), np.float32), "hidden": np.ones((8, 2), np.float32), "bias": np.zeros(8, np.float32)}
    for kind, layers, tried in (("lstm", (cell, output), 2), ("mlp", (output,), 3)):
        file = tmp_path / f"{kind}.npz"
        NetworkWeights(kind, 0.005, 1, np.ones(3, np.float32), layers).save(file)
        learned = override(small_config(), [("control.actuator.network", str(file))])
        found = settings(learned, "mujoco")
        assert len(found) == tried
        for changes in found.values():  # every one of them can be built
            task_class(learned.task).check(override(learned, changes))


def test_who_has_followed_a_command():
    """Errors 0.1, 0.25, 0.3 m/s, one that fell, and one that fell before it was measured."""
    error = torch.tensor([0.1**2, 0.25**2 - 1e-6, 0.3**2, 0.1**2, math.nan])
    found = followed(error, torch.tensor([False, False, False, True, True]), 0.25)
    low, high = wilson(2, 5)
    assert (found["robots"], found["successes"], found["share"], found["fell"]) == (5, 2, 0.4, 2)
    assert (found["low"], found["high"]) == (low, high)
    assert found["rmse_lin"] == pytest.approx(math.sqrt((0.01 + 0.0625 + 0.09 + 0.01) / 4), rel=1e-4)
    assert followed(torch.tensor([math.nan]), torch.tensor([True]), 0.25)["rmse_lin"] is None


def test_the_mean_of_shares_has_an_interval_out_of_theirs():
    """Of one it is Wilson's; of four equal ones half as wide; of 10 of 10 and 0 of 10, whose ends are 0.722 and 0.278 away on
    the inner side and none on the outer, sqrt(0.278^2) / 2 to either side of 50 %.
    """
    assert mean_of_shares([(8, 10)]) == (0.8, pytest.approx(wilson(8, 10)))
    low, high = wilson(8, 10)
    assert mean_of_shares([(8, 10)] * 4) == (
        pytest.approx(0.8),
        pytest.approx((0.8 - (0.8 - low) / 2, 0.8 + (high - 0.8) / 2)),
    )
    assert mean_of_shares([(10, 10), (0, 10)]) == (0.5, pytest.approx((0.361, 0.639), abs=1e-3))


def test_the_score_is_the_mean_of_all_that_was_disturbed():
    """By hand: stairs 10 and 5 of 10, flat 10 and 10, ground 0 of 10: (1 + 0.5 + 1 + 1 + 0) / 5."""

    def of(successes):
        return {"successes": successes, "robots": 10}

    lines = [
        {"name": "nominal", "stairs": of(0), "flat": of(0)},
        {"name": "payload", "stairs": of(10), "flat": of(10)},
        {"name": "together", "stairs": of(5), "flat": of(10)},
    ]
    found = score(lines, {"kerbs": of(0)})
    assert found["value"] == pytest.approx(0.7)
    assert (found["stairs"], found["flat"], found["ground"]) == (0.75, 1.0, 0.0)
    assert found["low"] < 0.7 < found["high"]
    on_plane = score([{key: line[key] for key in ("name", "flat")} for line in lines], {})
    assert on_plane.keys() == {"value", "low", "high", "flat"}
    assert on_plane["value"] == 1.0
