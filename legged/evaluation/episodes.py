"""Evaluation of tasks without commands. It runs full episodes, in an engine of this package or in a Gymnasium environment."""

import io
import json
import time
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console

from legged.errors import ConfigError, RunError
from legged.evaluation.measurement import Setting, warn_of_overflows
from legged.evaluation.result_file import file_name, write_result
from legged.policies.episodes import episodes_table, for_episodes, measure_episodes, spread_of
from legged.policies.export import EXPORTED, export
from legged.policies.restore import restore
from legged.process.paths import relative
from legged.registry import task_class

MOST_EPISODES = 2**16
"""Largest number of episodes that are simulated at once."""
GYMNASIUM = "gymnasium"
"""Name of Gymnasium in files and tables, in place of the name of an engine."""
REWARD = "reward_"
"""Prefix that marks parts of the reward in the `info` of a step in Gymnasium."""


def evaluate_episodes(setting: Setting, episodes: int) -> int:
    """Run `episodes` robots for one episode each, without noise and randomisation. Print a table, write
    evaluation_<physics>.json, and return the exit code.

    Raises:
        RunError: the file can't be written.
    """
    start = time.perf_counter()
    head = {**setting.head, **setting.changes}
    task, act = restore(
        setting.policy, [*for_episodes(setting.policy.cfg, episodes), *setting.asked], setting.device, setting.graph
    )
    measured = measure_episodes(task, act)
    _report({**head, "wall_s": time.perf_counter() - start, "episodes": measured}, setting.folder)
    warn_of_overflows("episodes", measured["contact_overflows"])
    return 0


def evaluate_in_gymnasium(setting: Setting, episodes: int) -> int:
    """Export the policy into the folder of the result. Run the exported TorchScript in the Gymnasium environment GYMNASIUM_ID
    of the task's class, for `episodes` episodes with the seeds 0, 1, ... Print a table, write evaluation_gymnasium.json, and
    return the exit code.

    Raises:
        ConfigError: the task's class has no GYMNASIUM_ID, Gymnasium has no environment with this ID, or the shapes of
            observations or actions differ between the environment and the policy.
        RunError: the policy's input is a history of observations, or a file can't be written.
    """
    start = time.perf_counter()
    setting = replace(setting, device=torch.device("cpu"))
    kind, exported = task_class(setting.policy.cfg.task), setting.folder / EXPORTED
    name = getattr(kind, "GYMNASIUM_ID", None)
    if not isinstance(name, str):
        asked = setting.policy.cfg.task
        raise ConfigError(f"POLICY: '{asked}' is not a task of Gymnasium: {kind.__name__} has no GYMNASIUM_ID")
    task, act = restore(setting.policy, [*for_episodes(setting.policy.cfg, 1), *setting.asked], setting.device, graph=False)
    export(task, act.network, exported, trained=setting.policy.cfg)
    measured = run_exported(exported, name, episodes)
    head = {**setting.head, "physics": GYMNASIUM, **setting.changes, "environment": name}
    _report({**head, "wall_s": time.perf_counter() - start, "episodes": measured}, setting.folder)
    return 0


def _report(result: dict[str, Any], folder: Path) -> None:
    title = f"{result['task']} ({result['checkpoint']}) in {result.get('environment', result['physics'])}"
    Console(width=110).print(episodes_table(result["episodes"], title))
    path = folder / file_name(result["physics"])
    write_result(path, result)
    print(f"written: {relative(path)}")


@torch.inference_mode()
def run_exported(exported: Path, name: str, episodes: int) -> dict[str, Any]:
    """Run policy.pt, which is in the folder `exported`, in the Gymnasium environment `name`. Return the figures of
    `measure_episodes`, except `contact_overflows`. Rewards are Gymnasium's; `terms` come from the `info` of each step.

    Raises:
        ConfigError: Gymnasium has no environment `name`, or its observations or actions do not fit the policy.
        RunError: the policy's input is a history of observations.
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
        raise ConfigError(f"evaluate gymnasium: shapes of observations and actions differ: {name} {shapes}, policy {own}")
    if history != 1:
        raise RunError(f"evaluate gymnasium: the policy wants the last {history} observations, but {name} gives only one")
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
