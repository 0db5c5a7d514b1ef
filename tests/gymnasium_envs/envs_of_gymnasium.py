"""Tasks as environments of Gymnasium's, on the C engine."""

import gymnasium
import numpy as np

ONE_THREAD = {"sim.threads": 1}


def single(task: str, config: dict | None = None, **arguments):
    """One environment, without the wrappers of `make`."""
    return gymnasium.make(f"legged/{task}", config={**ONE_THREAD, **(config or {})}, **arguments).unwrapped


def vector(task: str, num_envs: int, config: dict | None = None, **arguments):
    return gymnasium.make_vec(f"legged/{task}", num_envs, config={**ONE_THREAD, **(config or {})}, **arguments)


def actions_of(env, steps: int, seed: int = 0) -> list[np.ndarray]:
    """Random actions within -1 and 1 of the shape of the action space."""
    rng = np.random.default_rng(seed)
    return [rng.uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32) for _ in range(steps)]
