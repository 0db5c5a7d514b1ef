"""Run by torchrun: DevicePPO and rsl-rl's PPO on the same made-up data, different for each process, must stay together.

Prints `rank <r> <case> equal` for each case that holds.
"""

import sys

import torch
from learners import MIRROR, SAMPLES, fill, learner
from rsl_rl.algorithms import PPO

from legged.graph.step_graph import ForbidHostReads
from legged.learning.distributed import any_rank, join, leave
from legged.learning.ppo import DevicePPO
from legged.process.ranks import Ranks

CASES = {
    "normalised, per mini-batch": {"normalized": True, "normalize_advantage_per_mini_batch": True},
    "fixed rate": {"schedule": "fixed"},
    "symmetric": {"symmetry_cfg": MIRROR},
}


def parameters(alg):
    """All parameters and normalisers of a learner in one vector."""
    states = [alg.actor.state_dict(), alg.critic.state_dict()]
    return torch.cat([tensor.flatten().float() for state in states for tensor in state.values()])


def check(ranks, **options):
    """Three updates of both learners."""
    groups = {"global_rank": ranks.rank, "local_rank": ranks.local_rank, "world_size": ranks.count}
    stock, ours = (learner(kind, multi_gpu_cfg=groups, **options) for kind in (PPO, DevicePPO))
    assert not ours.why_stock
    rates = [ours.learning_rate]
    for update in range(3):
        for alg in (stock, ours):
            fill(alg, seed=10 * update + ranks.rank)
        order = torch.randperm(SAMPLES, generator=torch.Generator().manual_seed(update))
        torch.randperm = lambda *_, order=order, **__: order
        ours._order = lambda _, order=order: order
        stock.update()
        with ForbidHostReads():
            ours.learn()
        ours.storage.clear()
        rates.append(ours.learning_rate)
        assert abs(ours.learning_rate / stock.learning_rate - 1.0) < 1e-5
    torch.testing.assert_close(parameters(ours), parameters(stock), rtol=1e-3, atol=2e-5)
    assert len(set(rates)) > 1 or options.get("schedule") == "fixed"
    mine = parameters(ours)
    others = [torch.empty_like(mine) for _ in range(ranks.count)]
    torch.distributed.all_gather(others, mine)
    assert all(other.equal(mine) for other in others), "processes have come apart"


def check_guard(ranks):
    """Values of the second process that were no numbers, and pass no gradient on, keep both from taking a step."""
    groups = {"global_rank": ranks.rank, "local_rank": ranks.local_rank, "world_size": ranks.count}
    alg = learner(DevicePPO, multi_gpu_cfg=groups)
    fill(alg, seed=ranks.rank)
    if ranks.rank == 1:
        alg.storage.values[:] = torch.nan
    before = parameters(alg)
    alg.learn()
    assert parameters(alg).equal(before)


def main():
    """All cases; then what processes agree on."""
    torch.set_num_threads(1)
    ranks = Ranks.now()
    join(ranks, torch.device("cpu"))
    randperm = torch.randperm
    for case, options in CASES.items():
        check(ranks, **options)
        torch.randperm = randperm
        print(f"rank {ranks.rank} {case} equal", flush=True)
    check_guard(ranks)
    print(f"rank {ranks.rank} guard equal", flush=True)
    asked = any_rank(*(ranks.rank == who for who in (0, 1, 2)))
    assert asked == [True, True, False], asked
    leave()


if __name__ == "__main__":
    sys.exit(main())
