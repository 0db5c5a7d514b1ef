"""How much of the ground's height is observed, in training and once a policy is trained."""

import pytest
import torch
from helpers import CALM, ENGINE

from legged.policies.restore import nominal
from legged.registry import make_task, task_config

SHARES = {"stairs_up": 0.5, "slope_down": 0.5}
OTHERS = ("slope_up", "rough_slope_up", "rough_slope_down", "stairs_down", "obstacles", "random_grid")
GROUND = [
    ("terrain.num_rows", 2),
    ("terrain.num_cols", 2),
    ("terrain.border_size", 4.0),
    ("terrain.max_init_terrain_level", 1),
    ("terrain.proportions", {**SHARES, **dict.fromkeys(OTHERS, 0.0)}),
]


def config(*changes):
    return task_config("anymal_c", [("env.num_envs", 2), *ENGINE, *CALM, *GROUND, *changes], on_cpu=True)


@pytest.mark.slow
def test_low_ground_looks_no_deeper_than_the_limit_of_depth():
    """Worked by hand: the base is 1 m high, so that 0.5 m is level; higher by 0.4 m is cut at 0.3, lower by 0.4 m at 0.1."""
    limits = [("observations.heights_limit", 0.3), ("observations.depth_limit", 0.1)]
    ground = torch.tensor([[0.9, 0.6, 0.5, 0.45, 0.1]]).expand(2, 5)
    for changes, seen in (
        (limits, [-0.3, -0.1, 0.0, 0.05, 0.1]),
        (limits[:1], [-0.3, -0.1, 0.0, 0.05, 0.3]),  # 0 is heights_limit
        ([*limits[:1], ("observations.depth_limit", 2.0)], [-0.3, -0.1, 0.0, 0.05, 0.3]),  # the smaller of both
    ):
        task = make_task(config(*changes))
        task.base_pos[:, 2] = 1.0
        torch.testing.assert_close(task.heights_seen(ground), torch.tensor([seen] * 2))


@pytest.mark.slow
def test_a_trained_policy_is_told_less_of_depth_than_in_training():
    """Wherever it acts: play, evaluation and export build their tasks by `nominal()`. What is asked for there comes first."""

    def limits(cfg):
        return cfg.observations.heights_limit, cfg.observations.deepest

    training = config(("observations.once_trained", {"heights_limit": 0.17, "depth_limit": 0.07}))
    assert limits(training) == (0.35, 0.35)
    assert limits(nominal(training, [])) == (0.17, 0.07)
    assert limits(nominal(nominal(training, []), [])) == (0.17, 0.07)  # the pages of episodes do it twice
    assert limits(nominal(training, [("observations.depth_limit", 0.1)])) == (0.17, 0.1)
    same = config(
        ("observations.once_trained", {"heights_limit": 0.0, "depth_limit": 0.0}),
        ("observations.depth_limit", 0.2),
    )
    assert limits(nominal(same, [])) == limits(same) == (0.35, 0.2)
