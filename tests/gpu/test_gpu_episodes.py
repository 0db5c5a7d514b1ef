"""Episodes recorded on a GPU: what is copied within the captured step is what an eager step would have copied."""

import numpy as np
import pytest
import torch
from devices import CUDA
from helpers import CALM, TASK, stand

from legged.episodes.recorder import record_episodes
from legged.episodes.stored import Episodes
from legged.registry import make_task, task_config

pytestmark = pytest.mark.gpu

DT = 0.02
"""Control step of the task [s]."""
SAME = 5
"""Steps after which rounding may have grown."""


def recorded(graph: bool) -> Episodes:
    changes = [("env.num_envs", 8), ("env.episode_length_s", 1.0), ("rewards.only_positive_rewards", False), *CALM]
    task = make_task(task_config(TASK, [*changes, ("sim.physics", "mujoco_warp")]), CUDA, graph)

    def act(observations: object) -> torch.Tensor:
        return stand(observations).to(CUDA)  # type: ignore[arg-type]

    episodes, _ = record_episodes(task, act, 12, place=lambda: torch.manual_seed(3), graph=graph)
    assert task.captured == graph
    return episodes


def test_a_captured_step_is_recorded_as_an_eager_one():
    captured, eager = recorded(True), recorded(False)
    assert captured.lengths.tolist() == eager.lengths.tolist() == [50] * 12
    for number in range(8):
        for name, array in captured.of(number).items():
            want = eager.of(number)[name][:SAME]
            np.testing.assert_allclose(array[:SAME], want, rtol=1e-3, atol=1e-3 * (1.0 + np.abs(want).max()), err_msg=name)


def test_every_row_is_of_its_own_step():
    episodes = recorded(True)
    np.testing.assert_allclose(episodes["reward_parts"].sum(axis=1), episodes["reward"], atol=1e-5)
    for number in range(len(episodes)):
        one = episodes.of(number)
        assert (np.diff(one["qpos"][:, :7], axis=0) != 0.0).any(axis=1).all()  # nothing is frozen
        moved = np.diff(one["qpos"][:, 0])
        mean = 0.5 * (one["qvel"][1:, 0] + one["qvel"][:-1, 0])
        np.testing.assert_allclose(moved, mean * DT, atol=5e-3)
        assert abs(one["qpos"][0, 0] - episodes["first_qpos"][number, 0]) < 0.05
