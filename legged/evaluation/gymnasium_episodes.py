"""An exported policy in Gymnasium's environment, with Gymnasium's returns."""

import io
import json
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import torch

from legged.errors import ConfigError, RunError
from legged.evaluation.episodes import header, report
from legged.policies.episodes import for_episodes, spread_of
from legged.policies.export import EXPORTED, export
from legged.policies.restore import TrainedPolicy, restore
from legged.registry import task_class

ENGINE = "gymnasium"
"""Name in files and tables, like that of an engine."""
EPISODES = 20
"""Default number of episodes."""
REWARD = "reward_"
"""Prefix of the names of reward parts that Gymnasium returns with each step."""


def environment_of(task: str) -> str:
    """Return the name of a task's environment in Gymnasium (`GYMNASIUM_ID` of its class).

    Raises:
        ConfigError: the task has no environment in Gymnasium.
    """
    found = getattr(task_class(task), "GYMNASIUM_ID", None)
    if not isinstance(found, str):
        raise ConfigError(f"POLICY: '{task}' is not a task of Gymnasium: {task_class(task).__name__} has no GYMNASIUM_ID")
    return found


def evaluate_in_gymnasium(policy: TrainedPolicy, episodes: int, asked: list[tuple[str, Any]], folder: Path) -> int:
    """Export the policy into `folder`, run the exported TorchScript in Gymnasium's environment for `episodes` episodes with
    the seeds 0, 1, ..., print a table and write evaluation_gymnasium.json. Return the exit code.

    Raises:
        ConfigError: Gymnasium has no such environment, or one with other observations or actions.
        RunError: Gymnasium fails, or a file can't be written.
    """
    start = time.perf_counter()
    name = environment_of(policy.cfg.task)
    calm, changes = for_episodes(policy, 1)
    task, act = restore(calm, [*changes, ("sim.physics", "mujoco"), *asked], torch.device("cpu"), graph=False)
    export(task, act.network, folder / EXPORTED, trained=policy.cfg)
    measured = run_exported(folder / EXPORTED, name, episodes)
    result = {**header(policy, ENGINE, "cpu", asked), "environment": name, "wall_s": time.perf_counter() - start}
    return report({**result, "episodes": measured}, folder)


@torch.inference_mode()
def run_exported(exported: Path, name: str, episodes: int) -> dict[str, Any]:
    """Run policy.pt of the folder `exported` in the environment `name` of Gymnasium. Return the form of `measure_episodes`,
    with Gymnasium's returns and the reward parts that it names as terms.

    Raises:
        ConfigError: there is no such environment, or it has other observations or actions.
    """
    import gymnasium

    script = torch.jit.load(io.BytesIO((exported / "policy.pt").read_bytes()))
    described = json.loads((exported / "policy.json").read_text(encoding="utf-8"))
    middle, reach = (np.array(described[f"control_{part}"]) for part in ("middle", "reach"))
    clip, reach_seen = described["action_clip"], described["observation_clip"]
    scale = np.concatenate([np.broadcast_to(term["scale"], term["size"]) for term in described["observation"]])
    history = max(group["history"] for group in described["observation_groups"])
    try:
        environment = gymnasium.make(name)
    except gymnasium.error.Error as error:
        raise ConfigError(f"evaluate gymnasium: Gymnasium {gymnasium.__version__} has no {name}: {error}") from error
    shapes = environment.observation_space.shape, environment.action_space.shape
    own = scale.shape, middle.shape
    if shapes != own:
        raise ConfigError(f"evaluate gymnasium: {name} has observations and actions of shapes {shapes}, the policy of {own}")
    if history != 1:
        raise RunError(f"evaluate gymnasium: the policy wants the last {history} observations, {name} gives one")
    returns, lengths, failures = [], [], 0
    terms: dict[str, float] = defaultdict(float)
    low, high = environment.action_space.low, environment.action_space.high  # type: ignore[attr-defined]
    for seed in range(episodes):
        observation, _ = environment.reset(seed=seed)
        script.reset()
        total, length, over = 0.0, 0, False
        while not over:
            seen = np.clip(scale * observation, -reach_seen, reach_seen)
            action = script(torch.as_tensor(seen, dtype=torch.float32)[None])[0].numpy()
            control = middle + reach * np.clip(action, -clip, clip)
            observation, reward, failed, out_of_time, info = environment.step(np.clip(control, low, high).astype(np.float32))
            total, length, over = total + float(reward), length + 1, failed or out_of_time
            for key, value in info.items():
                if key.startswith(REWARD):
                    terms[key.removeprefix(REWARD)] += float(value) / episodes
        returns.append(total)
        lengths.append(float(length))
        failures += int(failed)
    environment.close()
    return {
        "count": episodes,
        "return": spread_of(returns),
        "terms": dict(terms),
        "length": spread_of(lengths),
        "failures": failures / episodes,
        "metrics": {},
    }
