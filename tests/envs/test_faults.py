"""NaN and infinite numbers never reach the weights: robots are reset and counted, terms are named, hopeless trainings end."""

import re
from pathlib import Path

import pytest
import torch
from helpers import CALM, ENGINE, TASK, TINY_TRAINING, call, checkpoints, run_folders, small_task, tiny_run
from learners import SAMPLES, fill, learner
from rsl_rl.algorithms import PPO

from legged.cli.train import train
from legged.envs import LeggedRobot
from legged.errors import RunError
from legged.evaluation.learning_curves import read_scalars
from legged.learning.divergence import PATIENCE, DivergenceDetector
from legged.learning.gradient_guard import GradientGuard
from legged.learning.ppo import DevicePPO
from legged.learning.runner import Runner
from legged.mdp.nan_guard import LARGEST, LARGEST_STATE
from legged.registry import _REGISTERED, make_task, register, task_config

pytestmark = pytest.mark.usefixtures("workplace")
NAN, INF = float("nan"), float("inf")
BAD = [NAN, INF, -INF, 1e30]


class Broken(LeggedRobot):
    """A task in which robot 2, or everybody, gets a bad number where `custom` says."""

    def bad(self, kind: str, good: torch.Tensor) -> torch.Tensor:
        value = float(self.cfg.custom.get(kind, 0.0))
        robots = (torch.arange(self.num_envs, device=good.device) == 2) | bool(self.cfg.custom.get("everybody"))
        return torch.where(robots & (value != 0.0), value, good)

    def _reward_mine(self) -> torch.Tensor:
        return self.bad("reward", self.base_pos[:, 2])

    def _obs_mine(self) -> torch.Tensor:
        return self.bad("obs", self.base_pos[:, 2]).unsqueeze(1)


GROUP = ["base_lin_vel", "base_ang_vel", "projected_gravity", "commands", "dof_pos", "dof_vel", "actions", "mine"]


@pytest.fixture(autouse=True)
def broken():
    """The task 'broken', registered for a test."""
    config = {"extends": TASK, "rewards": {"scales": {"mine": 1.0}}, "observations": {"groups": {"critic": {"terms": GROUP}}}}
    register("broken", {**config, "train": {"algorithm": {"symmetry": False}}}, Broken)
    yield
    del _REGISTERED["broken"]


def broken_task(graph: bool = True, **custom: float) -> LeggedRobot:
    """Five robots; `custom` says what is bad, as text, which YAML and its checks pass on."""
    settings = [("env.num_envs", 5), *ENGINE, *CALM, ("custom", {kind: str(value) for kind, value in custom.items()})]
    return make_task(task_config("broken", settings, on_cpu=True), graph=graph)


def logged(task: LeggedRobot) -> dict[str, float]:
    return {name: float(value) for name, value in task.log_rollout().items() if not torch.isnan(value)}


# ---- the task --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("value", BAD)
@pytest.mark.parametrize("kind", ["reward", "obs"])
def test_a_bad_number_of_one_robot_is_counted_and_resets_that_robot_only(kind, value):
    task, sound = broken_task(**{kind: value}), broken_task()
    for each in (task, sound):
        torch.manual_seed(1)
        each.reset()
        each.log_rollout()
    ended = torch.zeros(5)
    for _ in range(6):
        results = []
        for each in (task, sound):
            torch.manual_seed(2)
            results.append(each.step(torch.full((5, 12), 0.1)))
        observations, rewards, dones, _ = results[0]
        ended += dones
        for tensor in (observations["actor"], observations["critic"], rewards, task.rewards.sums):
            assert torch.isfinite(tensor).all()
        others = torch.tensor([0, 1, 3, 4])  # know nothing of it, bit by bit
        assert torch.equal(results[0][1][others], results[1][1][others])
        assert torch.equal(observations["actor"][others], results[1][0]["actor"][others])
    # The reward of a step that ends a robot is not looked at; an observation is bad again right after the reset.
    assert ended.tolist() == [0, 0, 3 if kind == "reward" else 6, 0, 0]
    log = logged(task)
    assert log[f"Faults/{kind}_mine"] == 1.0
    assert {name for name in log if name.startswith("Faults/")} == {f"Faults/{kind}_mine"}
    assert log["Metrics/non_finite_worlds"] == ended[2]
    assert not any(name.startswith("Faults/") for name in logged(sound))


@pytest.mark.slow
def test_a_reward_that_is_no_number_counts_as_nothing():
    """Of the other terms of that robot it is told nothing: their sum stands."""
    task = broken_task(reward=NAN)
    task.reset()
    _, rewards, _, _ = task.step(torch.zeros(5, 12))
    mine = list(task.rewards.names).index("mine")
    assert task.rewards.sums[mine].tolist()[2] == 0.0
    assert rewards[2] == pytest.approx(float(task.rewards.sums[:, 2].sum()), rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("ends", ["time", "reset"])
def test_a_bad_reward_at_the_end_of_an_episode_does_not_end_the_next_one(ends):
    task = broken_task(reward=NAN)
    task.reset()
    if ends == "time":
        task.episode_length_buf = torch.full((5,), task.max_episode_length - 1)
    _, _, dones, _ = task.step(torch.zeros(5, 12))
    assert dones.all() or ends == "reset"
    assert not task.terminated_buf.any()
    if ends == "reset":
        task.reset()
    task.cfg.custom["reward"] = "0.0"  # the next one is a good one
    _, _, dones, _ = task.step(torch.zeros(5, 12))
    assert not dones.any()


@pytest.mark.slow
@pytest.mark.parametrize(("value", "faults"), [(NAN, {"Faults/action": 1.0}), (INF, {}), (-INF, {}), (1e30, {})])
def test_a_bad_action_moves_nothing(value, faults):
    """An infinite one is clipped, as a large one is; NaN asks for the default pose, and the robot begins anew."""
    task = small_task(num_envs=3)
    task.reset()
    actions = torch.zeros(3, 12)
    actions[1, 4] = value
    observations, rewards, dones, _ = task.step(actions)
    assert torch.isfinite(observations["actor"]).all()
    assert torch.isfinite(rewards).all()
    assert dones.tolist() == [False, bool(faults), False]
    assert {name: count for name, count in logged(task).items() if name.startswith("Faults/")} == faults


@pytest.mark.slow
@pytest.mark.parametrize("value", [NAN, INF, -INF, 1e30, 2.0 * LARGEST_STATE])
@pytest.mark.parametrize("graph", [True, False], ids=["checked", "no graph"])
def test_physics_that_diverges_but_stays_finite_is_reset_too(value, graph):
    task = broken_task(graph)
    task.reset()
    task.physics._qvel[3, 8] = value
    _, rewards, dones, _ = task.step(torch.zeros(5, 12))
    assert dones.tolist() == [False, False, False, True, False]
    assert rewards[3] == 0.0
    assert logged(task)["Faults/physics"] == 1.0
    for _ in range(3):
        observations, rewards, dones, _ = task.step(torch.zeros(5, 12))
        assert torch.isfinite(observations["critic"]).all()
        assert not dones.any()


@pytest.mark.slow
def test_what_is_large_but_a_number_passes():
    task = broken_task(reward=0.9 * LARGEST / 0.02, obs=0.9 * LARGEST)
    task.reset()
    observations, rewards, dones, _ = task.step(torch.zeros(5, 12))
    assert not dones.any()
    assert rewards[2] == pytest.approx(0.9 * LARGEST)
    assert observations["critic"][2, -1] == task.cfg.observations.clip
    assert not any(name.startswith("Faults/") for name in logged(task))


@pytest.mark.slow
def test_a_diverged_robot_is_not_promoted():
    """It is far from where it started, but did not walk there."""
    settings = [("env.num_envs", 6), ("sim.physics", "mujoco"), ("sim.threads", 1)]
    task = make_task(task_config("anymal_c", settings, on_cpu=True))
    before = task.terrain_curriculum.levels.clone()
    task.physics._qpos[4, 0] = 3.0 * LARGEST_STATE
    task.step(torch.zeros(6, 12))
    assert task.reset_buf[4]
    assert torch.equal(task.terrain_curriculum.levels, before)


# ---- the learner -----------------------------------------------------------------------------------------------------

POISONS = {
    "reward": lambda st, value: st.returns[0, 3].fill_(value),
    "advantage": lambda st, value: st.advantages[0, 3].fill_(value),
    "observation": lambda st, value: st.observations["actor"][0, 3].fill_(value),
    "critic": lambda st, value: st.observations["critic"][0, 3].fill_(value),
    "action": lambda st, value: st.actions[0, 3].fill_(value),
    "value": lambda st, value: st.values[0, 3].fill_(value),
}


def weights(alg) -> list[torch.Tensor]:
    models = [tensor for model in (alg.actor, alg.critic) for tensor in model.state_dict().values()]
    moments = [tensor for state in alg.optimizer.state.values() for tensor in state.values()]
    return [*models, *moments]


@pytest.mark.slow
@pytest.mark.parametrize("value", [NAN, INF])
@pytest.mark.parametrize("what", POISONS)
@pytest.mark.parametrize("kind", [DevicePPO, PPO])
def test_a_mini_batch_with_a_bad_number_is_left_out(kind, what, value):
    """One of four mini-batches holds it, in each epoch; the others are learned from."""
    alg = learner(kind)
    guard = None if kind is DevicePPO else GradientGuard(alg.optimizer)
    before = [tensor.clone() for tensor in weights(alg)]
    fill(alg, 0)
    with torch.inference_mode():
        POISONS[what](alg.storage, value)
    alg.update()
    after = weights(alg)
    assert all(torch.isfinite(tensor).all() for tensor in after)
    assert not torch.equal(before[0], after[0])
    steps = {int(state["step"]) for state in alg.optimizer.state.values()}  # of 3 epochs x 4 mini-batches
    if guard is not None and what == "value":  # the clipped loss passes no gradient on for it
        assert (guard.flush(), steps) == (0.0, {12})
        return
    assert (alg.left_out if guard is None else guard.flush()) == pytest.approx(0.25)
    assert steps == {9}


@pytest.mark.parametrize("kind", [DevicePPO, PPO])
def test_where_all_is_bad_nothing_changes(kind):
    alg = learner(kind)
    if kind is PPO:
        GradientGuard(alg.optimizer)
    fill(alg, 0)
    alg.update()
    before = [tensor.clone() for tensor in weights(alg)]
    fill(alg, 1)
    alg.storage.returns.fill_(NAN)
    losses = alg.update()
    assert all(torch.equal(a, b) for a, b in zip(before, weights(alg), strict=True))
    assert losses["value"] != losses["value"]
    fill(alg, 2)
    alg.update()
    assert not torch.equal(before[0], weights(alg)[0])


def test_losses_are_means_over_the_mini_batches_that_were_taken():
    """A left-out one counts neither in the sum nor in the number."""
    alg = learner(DevicePPO, num_learning_epochs=1, num_mini_batches=2, learning_rate=1e-12, schedule="fixed")
    alg._order = lambda count: torch.arange(count)
    fill(alg, 0)
    with torch.inference_mode():
        alg.storage.returns.view(-1)[: SAMPLES // 2] = 0.0
        alg.storage.values.view(-1)[: SAMPLES // 2] = 0.0
        alg.storage.returns.view(-1)[SAMPLES // 2 :] = NAN
        inputs = alg.storage.observations["critic"].flatten(0, 1)[: SAMPLES // 2]
        values = alg.critic.mlp(inputs).squeeze(1)
        wanted = torch.max(values.square(), values.clamp(-alg.clip_param, alg.clip_param).square()).mean()
    assert alg.update()["value"] == pytest.approx(float(wanted), rel=1e-5)
    assert alg.left_out == 0.5


# ---- a whole training ------------------------------------------------------------------------------------------------


def train_broken(*arguments: str, iterations: int = 3) -> int:
    base = ["--task", "broken", "--sim_device", "cpu", "--num_envs", "8", "--max_iterations", str(iterations)]
    return call(train.main, [*base, *TINY_TRAINING, *arguments])


LOOPS = ["captured", "stock"]


@pytest.mark.slow
@pytest.mark.parametrize("loop", LOOPS)
@pytest.mark.parametrize("kind", ["reward", "obs"])
def test_training_survives_one_bad_robot_and_names_the_term(capsys, kind, loop):
    normalise = "train.policy.obs_normalization=true"
    assert train_broken("--runner", loop, f"custom={{{kind}: 'nan'}}", normalise, iterations=4) == 0
    err = capsys.readouterr().err
    assert err.count("warning:") == 1
    assert f"_{kind}_mine of 1 robot was NaN or infinite" in err
    (folder,) = run_folders()
    saved = torch.load(folder / "model_3.pt", weights_only=True)
    for network in ("actor_state_dict", "critic_state_dict"):
        assert all(torch.isfinite(tensor).all() for tensor in saved[network].values())
    scalars = read_scalars(folder)
    assert scalars[f"Faults/{kind}_mine"][1].tolist() == [1.0] * 4
    for _, values in scalars.values():
        assert all(value == value for value in values)


@pytest.mark.slow
@pytest.mark.parametrize("loop", LOOPS)
@pytest.mark.parametrize("kind", ["reward", "obs"])
def test_training_that_goes_on_being_bad_ends_at_the_last_checkpoint(capsys, kind, loop):
    assert train_broken("--runner", loop, f"custom={{{kind}: 'inf', everybody: 'yes'}}", iterations=50) == 1
    err = capsys.readouterr().err
    assert "Traceback" not in err
    last = err.splitlines()[-1]
    assert f"stopped after iteration {PATIENCE}: numbers were NaN or infinite for {PATIENCE} iterations in a row" in last
    assert f"(_{kind}_mine)" in last
    (folder,) = run_folders()
    assert checkpoints(folder) == [0]
    assert str(folder / "model_0.pt") in last
    saved = torch.load(folder / "model_0.pt", weights_only=True)["actor_state_dict"]
    assert all(torch.isfinite(tensor).all() for tensor in saved.values())


@pytest.mark.slow
def test_a_time_step_that_blows_up_does_not_poison_the_weights():
    folder = tiny_run("sim.dt=0.02", "control.decimation=1", "train.algorithm.learning_rate=0.01", num_envs=64, iterations=15)
    saved = torch.load(folder / "model_14.pt", weights_only=True)
    for network in ("actor_state_dict", "critic_state_dict"):
        assert all(torch.isfinite(tensor).all() for tensor in saved[network].values())


def test_weights_that_are_no_numbers_are_not_written():
    task = small_task(num_envs=4)
    runner = Runner(task)
    with torch.no_grad():
        next(runner.alg.actor.parameters())[0] = NAN
    with pytest.raises(RunError, match=r"is not written: the actor is damaged \(.* holds NaN or infinite numbers\)"):
        runner.save("model_0.pt")
    assert not list(Path().glob("*.pt"))


def test_the_watch_forgets_what_mends_and_gives_up_on_what_does_not(capsys):
    detector = DivergenceDetector(steps_per_iteration=100)
    bad = {"Faults/reward_mine": 7.0, "Metrics/non_finite_worlds": 20.0}
    for _ in range(PATIENCE - 1):
        detector.update(bad, 0.0)
    detector.update({"Metrics/non_finite_worlds": 19.0}, 0.49)
    for _ in range(PATIENCE - 1):
        detector.update(bad, 0.0)
    assert detector.why_stop == ""
    detector.update({}, 0.5)
    assert re.search(r"for 10 iterations in a row: 50 % of the mini-batches were left out", detector.why_stop)
    err = capsys.readouterr().err
    assert err.count("_reward_mine of 7 robots") == 1
    assert err.count("of the mini-batches were left out, because a gradient was NaN") == 1


def test_the_guard_passes_over_nothing_else():
    parameter = torch.nn.Parameter(torch.ones(2))
    optimizer = torch.optim.SGD([parameter], lr=1.0)
    guard = GradientGuard(optimizer)
    for gradient in ([1.0, 0.0], [NAN, 0.0], [INF, 0.0], [0.0, 1e18]):
        parameter.grad = torch.tensor(gradient)
        optimizer.step()
    assert parameter.tolist() == [0.0, pytest.approx(-1e18)]
    assert guard.flush() == 0.5
    assert guard.flush() == 0.0
