"""What a training says when it begins."""

import pytest
import torch

from legged.cli.train import describe
from legged.registry import task_config


@pytest.mark.parametrize(("count", "says"), [(1, "1 robot,"), (2, "2 robots,")])
def test_one_robot_is_no_robots(count, says):
    cfg = task_config("anymal_c_flat", [("env.num_envs", count), ("sim.physics", "mujoco"), ("sim.threads", 1)], on_cpu=True)
    assert describe(cfg, torch.device("cpu")).startswith(
        f"anymal_c_flat: {says} {cfg.train.runner.max_iterations} iterations, no GPU in use: C MuJoCo on 1 core,"
    )
