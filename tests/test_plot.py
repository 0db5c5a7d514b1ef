"""Curves of runs: what is read, averaged and drawn."""

import numpy as np
import pytest
from PIL import Image
from torch.utils.tensorboard import SummaryWriter

from legged.errors import ConfigError
from legged.tools import plot


def write_run(folder, levels):
    """TensorBoard files of a run on terrain: five iterations."""
    writer = SummaryWriter(str(folder))
    for step in range(5):
        writer.add_scalar("Metrics/lin_vel_rmse", 1.0 - 0.1 * step, step)
        writer.add_scalar("Terrain/level_pit", levels + step, step)
        if step != 2:  # no episode of that type ended
            writer.add_scalar("Terrain/promoted_pit", 0.5, step)
            writer.add_scalar("Terrain/demoted_pit", 0.25, step)
    writer.close()


def test_runs_are_read_and_averaged_over_common_iterations(tmp_path):
    write_run(tmp_path / "a", 1.0)
    runs = [plot.read_scalars(tmp_path / "a")]
    steps, values = runs[0]["Terrain/level_pit"]
    assert steps.tolist() == [0, 1, 2, 3, 4]
    assert values == pytest.approx([1.0, 2.0, 3.0, 4.0, 5.0])
    runs.append({"Terrain/level_pit": (np.array([1, 3, 9]), np.array([4.0, 8.0, 1.0]))})
    steps, values = plot.mean_of(runs, "Terrain/level_pit")
    assert steps.tolist() == [2, 4]  # counted from 1
    assert values == pytest.approx([3.0, 6.0])


def test_levels_get_panels_of_their_own(tmp_path):
    write_run(tmp_path / "rough", 1.0)
    assert plot.main([str(tmp_path / "rough"), "--out", str(tmp_path / "rough.png")]) == 0
    runs = {"flat": {"Metrics/lin_vel_rmse": (np.arange(5), np.ones(5))}}
    plot.draw(runs, tmp_path / "flat.png")
    with Image.open(tmp_path / "rough.png") as rough, Image.open(tmp_path / "flat.png") as flat:
        assert rough.height == pytest.approx(1.5 * flat.height, rel=0.02)
        assert np.asarray(rough.convert("L"))[-flat.height // 2 :].std() > 10.0


def test_a_folder_without_events_is_named(tmp_path):
    with pytest.raises(ConfigError, match="holds no TensorBoard file"):
        plot.read_scalars(tmp_path)
