"""Learners on made-up data, for comparing one with another."""

import torch
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict

ROBOTS, STEPS = 48, 8
SAMPLES = ROBOTS * STEPS
LEARNING = {"num_mini_batches": 4, "num_learning_epochs": 3, "entropy_coef": 0.01, "learning_rate": 1e-3}


def observe(device="cpu") -> TensorDict:
    groups = {"actor": torch.randn(ROBOTS, 7), "critic": torch.randn(ROBOTS, 9)}
    return TensorDict(groups, batch_size=[ROBOTS]).to(device)


def learner(kind, normalized=False, std_type="scalar", device="cpu", **options):
    """A learner on made-up data with weights that depend on nothing else; all of it is drawn on the CPU."""
    torch.manual_seed(0)
    groups = {"actor": ["actor"], "critic": ["critic"]}
    gaussian = {"class_name": "GaussianDistribution", "init_std": 0.5, "std_type": std_type}
    actor = MLPModel(observe(), groups, "actor", 3, [16, 16], "elu", normalized, gaussian)
    critic = MLPModel(observe(), groups, "critic", 1, [16, 16], "elu", normalized)
    storage = RolloutStorage("rl", ROBOTS, STEPS, observe(device), [3], device)
    return kind(actor.to(device), critic.to(device), storage, device=device, **{**LEARNING, **options})


def fill(alg, seed):
    """A rollout of noise through rsl-rl's own functions."""
    torch.manual_seed(seed)
    with torch.inference_mode():
        for _ in range(STEPS):
            alg.act(observe(alg.device))
            ends, following, rewards = torch.rand(ROBOTS), observe(), torch.randn(ROBOTS)
            ends, following, rewards = (each.to(alg.device) for each in (ends, following, rewards))
            alg.process_env_step(following, rewards, ends < 0.1, {"time_outs": ends < 0.04})
        alg.compute_returns(observe(alg.device))


def mirrored(env, obs, actions):
    """A made-up mirror: the columns the other way round, the first with its sign changed."""

    def image(x):
        flipped = x.flip(1)
        return torch.cat([x, torch.cat([-flipped[:, :1], flipped[:, 1:]], dim=1)])

    seen = None
    if obs is not None:
        groups = {name: image(group) for name, group in obs.items()}
        seen = TensorDict(groups, batch_size=[2 * len(obs)], device=obs.device)
    return seen, None if actions is None else image(actions)


MIRROR = {"env": None, "data_augmentation_func": mirrored, "use_data_augmentation": True}
