"""Learners that know nothing of this package train in its tasks, and what docs/gymnasium.md and docs/lab/ppo_cheetah.md
show works."""

import re
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from envs_of_gymnasium import ONE_THREAD

DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.mark.slow
@pytest.mark.parametrize("task", ["half_cheetah", "anymal_c_flat"])
def test_stable_baselines3_learns_for_a_few_hundred_steps(task):
    stable_baselines3 = pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.env_checker import check_env
    from stable_baselines3.common.monitor import Monitor

    config = {**ONE_THREAD, "control.clip_actions": 1.0, "env.episode_length_s": 1.0}
    env = Monitor(gymnasium.make(f"legged/{task}", config=config))
    check_env(env.unwrapped)
    model = stable_baselines3.PPO("MlpPolicy", env, n_steps=128, batch_size=32, n_epochs=1, seed=0, device="cpu")
    before = [parameter.detach().clone() for parameter in model.policy.parameters()]
    model.learn(384)
    assert model.num_timesteps == 384
    assert any((now != then).any() for now, then in zip(model.policy.parameters(), before, strict=True))
    lengths = env.get_episode_lengths()
    full = round(1.0 / env.unwrapped.task.dt)
    assert lengths
    assert all(0 < length <= full for length in lengths)
    assert np.isfinite(env.get_episode_rewards()).all()


def example(page: str) -> str:
    """Return the only block of Python of a page of docs/."""
    (code,) = re.findall(r"```python\n(.*?)```", (DOCS / page).read_text(encoding="utf-8"), flags=re.DOTALL)
    return code


def run(code: str) -> dict:
    names: dict = {}
    exec(compile(code, "an example of docs/", "exec"), names)
    return names


@pytest.mark.slow
def test_the_example_of_the_page_runs(pictures):
    found = run(example("gymnasium.md"))
    assert found["observations"].shape == (64, 48)
    assert found["truncated"]
    assert found["picture"].shape == (270, 480, 3)


@pytest.mark.slow
def test_the_learner_of_the_lab_learns(capsys):
    """Few and small updates: the code runs, episodes end within them, and the networks change."""
    code = example("lab/ppo_cheetah.md")
    numbers = "ENVS, STEPS, UPDATES = 64, 32, 150\n"
    assert numbers in code
    task = "DEVICE, to_numpy=False)"
    assert task in code
    code = code.replace(numbers, "ENVS, STEPS, UPDATES = 4, 6, 10\n")
    code = code.replace(task, 'DEVICE, to_numpy=False, config={"env.episode_length_s": 0.2, "sim.threads": 1})')
    with torch.random.fork_rng():
        found = run(code)
    assert found["ended"].any()
    assert (found["log_std"] != -0.5).any()
    assert re.fullmatch(r"update 10: -?\d+ reward in 1000 steps\n", capsys.readouterr().out)
