"""Transfer: a training that begins with the networks of another task's run, says what it took, and goes on from there."""

import re
import shutil
from pathlib import Path

import pytest
import torch
from helpers import POLICY, POLICY_ITERATION, TASK, TINY_TRAINING, call, checkpoints, run_folders, tiny_run

import legged
from legged.cli.play import play
from legged.cli.train import train
from legged.learning.captured import CapturedRunner
from legged.learning.checkpoint import read_checkpoint
from legged.learning.run_folder import run_config
from legged.learning.runner import Runner
from legged.learning.transfer import first_difference
from legged.registry import make_task, task_config

pytestmark = [pytest.mark.usefixtures("workplace"), pytest.mark.slow]

OTHER = "transfer_target"
"""Another task on the same observations: as the flat one, with other rewards and commands."""


@pytest.fixture(autouse=True, scope="module")
def another_task():
    settings = {
        "extends": TASK,
        "rewards": {"scales": {"torques": -3e-4}},
        "commands": {"ranges": {"lin_vel_x": [0.2, 0.4]}},
        "train": {"policy": {"init_noise_std": 0.9}},
    }
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(legged.registry, "_REGISTERED", {})
        legged.register(OTHER, settings)
        yield


def transfer(*arguments: str, iterations: int = 2) -> Path:
    return tiny_run("--task", OTHER, "--transfer", *arguments, iterations=iterations)


def content(folder: Path, iteration: int) -> dict:
    return torch.load(folder / f"model_{iteration}.pt", weights_only=True)


def moments(saved: dict) -> list[torch.Tensor]:
    return [tensor for state in saved["optimizer_state_dict"]["state"].values() for tensor in state.values()]


@pytest.mark.parametrize("loop", ["stock", "captured"])
@pytest.mark.parametrize("normalised", [False, True])
def test_networks_moments_normaliser_and_learning_rate_are_taken_and_nothing_else(loop, normalised):
    settings = ["--runner", loop, f"train.policy.obs_normalization={str(normalised).lower()}"]
    folder = tiny_run(*settings, "commands.curriculum.threshold=0.0", "commands.curriculum.window_s=0.02")
    before = content(folder, 1)
    cfg = task_config(OTHER, [(key, value) for key, value in settings_of(folder)], on_cpu=True)
    runner = (CapturedRunner if loop == "captured" else Runner)(make_task(cfg))
    runner.transfer(str(folder / "model_1.pt"))
    now = runner.alg.save()
    for network in ("actor_state_dict", "critic_state_dict"):
        assert now[network].keys() == before[network].keys()
        for name, tensor in before[network].items():
            assert torch.equal(now[network][name], tensor), name
    assert any("obs_normalizer" in name for name in now["actor_state_dict"]) is normalised
    assert all(torch.equal(a, b) for a, b in zip(moments(now), moments(before), strict=True))
    assert len(moments(now)) > 20
    rate = before["infos"]["learning_rate"]
    assert rate != 1e-3
    assert runner.alg.learning_rate == pytest.approx(rate)
    assert float(runner.alg.optimizer.param_groups[0]["lr"]) == pytest.approx(rate)
    assert runner.current_learning_iteration == 0
    shares = [progress["command_curriculum"]["share"] for progress in (before["infos"]["task_state"], runner.env.progress())]
    assert not torch.equal(*shares), "the curriculum is this task's own"


def settings_of(folder: Path) -> list[tuple[str, object]]:
    """The sizes of a tiny run, as overrides."""
    train_cfg = run_config(folder).train
    return [
        ("env.num_envs", 8),
        ("sim.physics", "mujoco"),
        ("sim.threads", 1),
        ("train.runner.num_steps_per_env", 4),
        ("train.runner.loop", train_cfg.runner.loop),
        ("train.policy.actor_hidden_dims", list(train_cfg.policy.actor_hidden_dims)),
        ("train.policy.critic_hidden_dims", list(train_cfg.policy.critic_hidden_dims)),
        ("train.policy.obs_normalization", train_cfg.policy.obs_normalization),
    ]


def test_a_transferred_run_counts_from_0_says_where_it_comes_from_and_is_resumed(capsys):
    source = tiny_run(iterations=3)
    folder = transfer(f"{TASK}/{source.name}")
    assert folder.parent == Path("logs") / OTHER
    assert checkpoints(folder) == [0, 1]
    assert run_config(folder).task == OTHER
    saved = content(folder, 1)
    origin = {"file": f"{source}/model_2.pt", "task": TASK, "iteration": 2}
    assert saved["infos"]["transferred_from"] == origin
    assert saved["infos"]["task"] == OTHER
    steps = {int(state["step"]) for state in saved["optimizer_state_dict"]["state"].values()}
    assert steps == {(3 + 2) * 20}
    before, after = content(source, 2)["actor_state_dict"], saved["actor_state_dict"]
    assert not torch.equal(before["mlp.0.weight"], after["mlp.0.weight"])  # it has trained on
    # From where it was, not from new weights, which differ by as much as they are long, times the root of two.
    assert (before["mlp.0.weight"] - after["mlp.0.weight"]).norm() < 0.5 * before["mlp.0.weight"].norm()
    resumed = tiny_run("--resume", "--task", OTHER, "--load_run", str(folder), iterations=4)
    assert content(resumed, 3)["infos"]["transferred_from"] == origin
    assert "transferred_from" not in content(source, 2)["infos"]
    again = transfer(str(resumed))
    assert content(again, 1)["infos"]["transferred_from"] == {"file": f"{resumed}/model_3.pt", "task": OTHER, "iteration": 3}


def said(capsys, *arguments: str) -> str:
    capsys.readouterr()
    flags = ["--task", OTHER, "--sim_device", "cpu", "--num_envs", "8", "--max_iterations", "1", *TINY_TRAINING]
    assert call(train.main, [*flags, "--transfer", *arguments]) == 0
    return capsys.readouterr().out


def test_what_was_taken_is_said(capsys):
    source = tiny_run("train.policy.obs_normalization=true", "train.policy.critic_hidden_dims=[16, 8]")
    rate = content(source, 1)["infos"]["learning_rate"]
    std = content(source, 1)["actor_state_dict"]["distribution.std_param"]
    sizes = ["train.policy.obs_normalization=true", "train.policy.critic_hidden_dims=[16, 8]"]
    out = said(capsys, str(source), *sizes)
    assert (
        f"took from {source} ({TASK}, iteration 1): actor (8) and critic (16, 8), observation normaliser, Adam's state,"
        f" learning rate {rate:.2g}, std {float(std.min()):.2f} to {float(std.max()):.2f}\n"
        "iterations, curricula and robots begin anew; the std is the learned one, not train.policy.init_noise_std\n"
    ) in out
    assert "going on with" not in out


def test_a_fixed_learning_rate_is_the_configurations(capsys):
    source = tiny_run()
    out = said(capsys, str(source), "train.algorithm.schedule=fixed", "train.algorithm.learning_rate=3e-4")
    assert "learning rate 0.0003 (fixed, the configuration's)" in out
    (folder,) = Path("logs", OTHER).iterdir()
    (group,) = content(folder, 0)["optimizer_state_dict"]["param_groups"]
    assert group["lr"] == pytest.approx(3e-4)


def test_an_optimiser_of_another_kind_begins_anew(capsys):
    source = tiny_run("train.algorithm.optimizer=rmsprop")
    assert "no state of Adam (the checkpoint's optimiser is RMSprop)" in said(capsys, str(source))
    saved = content(source, 1)
    del saved["optimizer_state_dict"]
    torch.save(saved, source / "model_1.pt")
    out = said(capsys, str(source), "train.algorithm.optimizer=rmsprop")
    assert "no state of RMSprop (not in the checkpoint)" in out


# ---- which run -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [TASK, f"resources/policies/{TASK}", str(POLICY)])
def test_a_shipped_policy_is_named_by_its_task_or_its_path(capsys, name):
    sizes = [f"train.policy.{network}_hidden_dims=[128, 64, 32]" for network in ("actor", "critic")]
    out = said(capsys, name, *sizes)
    assert f"policies/{TASK} ({TASK}, iteration {POLICY_ITERATION}): actor and critic (128, 64, 32)" in out


def test_the_newest_run_of_another_tasks_folder_is_taken(capsys):
    tiny_run()
    source = tiny_run(iterations=3)
    assert f"took from {source} ({TASK}, iteration 2)" in said(capsys, TASK)
    assert f"took from {source} ({TASK}, iteration 0)" in said(capsys, str(source), "--checkpoint", "0")


def refused(capsys, *arguments: str) -> str:
    """The one line of an error, before anything was built and with no folder left."""
    before = run_folders()
    capsys.readouterr()
    flags = ["--task", OTHER, "--sim_device", "cpu", "--num_envs", "8", "--max_iterations", "1", *TINY_TRAINING]
    assert call(train.main, [*flags, *arguments]) == 2
    assert run_folders() == before
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


def test_flags_that_do_not_go_together(capsys):
    source = tiny_run()
    for option in (["--resume"], ["--load-run", str(source)]):
        error = refused(capsys, "--transfer", str(source), *option)
        assert re.search(rf"{option[0]}: .*--transfer", error)
    error = refused(capsys, "--transfer", f"{TASK}/{source.name}x")
    assert f"--transfer: there is no task and no run '{TASK}/{source.name}x'; did you mean '{TASK}/{source.name}'?" in error
    assert "no checkpoint 7" in refused(capsys, "--transfer", str(source), "--checkpoint", "7")


# ---- what does not fit -----------------------------------------------------------------------------------------------

TERMS = "base_lin_vel, base_ang_vel, projected_gravity, commands, dof_pos, dof_vel"
DIFFERENT = {
    "a term less": (f"observations.groups.actor.terms=[{TERMS}]", r"actor: term 7 is none here, 'actions' \(12\) there\n"),
    "another order": (
        "observations.groups.critic.terms="
        "[base_lin_vel, base_ang_vel, commands, projected_gravity, dof_pos, dof_vel, actions]",
        r": critic: term 3 is 'commands' \(3\) here, 'projected_gravity' \(3\) there\n",
    ),
    "unknown there": (
        f"observations.groups.actor.terms=[{TERMS}, heights]",
        r"actor: term 7 is 'heights' here, 'actions' \(12\) there\n",
    ),
    "history": ("observations.groups.actor.history=3", r"actor: holds the last 3 observations here, the last 1 there\n"),
    "groups": (
        "train.policy.critic_observations=[actor]",
        r"its critic has the observations \['critic'\], the configuration has train\.policy\.critic_observations \['actor'\]",
    ),
    "sizes": ("train.policy.actor_hidden_dims=[16]", r"its actor has hidden layers \[8\], .*actor_hidden_dims \[16\]"),
    "kind": ("train.policy.activation=tanh", r"its actor has activation elu"),
    "normaliser": ("train.policy.obs_normalization=true", r"its actor has obs_normalization False"),
}


@pytest.mark.parametrize("change", DIFFERENT)
def test_what_differs_is_named_before_anything_is_built(capsys, monkeypatch, change):
    source = tiny_run()
    monkeypatch.setattr("legged.cli.train.make_task", lambda *_, **__: pytest.fail("built"))
    override, text = DIFFERENT[change]
    error = refused(capsys, "--transfer", str(source), override)
    assert re.search(rf"{source}/model_1\.pt: .*{text}", error), error


def test_every_group_that_differs_is_named(capsys):
    source = tiny_run()
    fewer = [f"observations.groups.{group}.terms=[{TERMS}]" for group in ("actor", "critic")]
    error = refused(capsys, "--transfer", str(source), *fewer)
    assert f"made for other observations than '{OTHER}': actor: term 7" in error
    assert "; critic: term 7" in error


def test_terms_of_another_width_are_named_when_the_task_is_built(capsys):
    """The same names, but 2 x 3 heights instead of 2 x 2."""
    points = ["terrain.measured_points_x=[0.0, 0.5]", "terrain.measured_points_y=[-0.5, 0.5]"]
    heights = f"observations.groups.critic.terms=[{TERMS}, heights]"
    source = tiny_run(heights, *points)
    wider = ["terrain.measured_points_x=[0.0, 0.5, 1.0]", points[1]]
    error = refused(capsys, "--transfer", str(source), heights, *wider)
    assert "critic: term 7 is 'heights' (6) here, 'heights' (4) there" in error


def test_another_robots_joints_are_refused(capsys):
    source = tiny_run()
    saved = content(source, 1)
    saved["infos"]["robot"]["joints"] = ["hip", "knee"]
    torch.save(saved, source / "model_1.pt")
    error = refused(capsys, "--transfer", str(source))
    assert "made for another robot: 'anymal_c' with 2 joints" in error


def test_a_folder_without_a_configuration_is_no_run(capsys):
    source = tiny_run()
    Path("elsewhere").mkdir()
    shutil.copy(source / "model_1.pt", "elsewhere")
    assert "--transfer: 'elsewhere' holds no run" in refused(capsys, "--transfer", "elsewhere")


def test_a_checkpoint_with_other_actions_is_refused(capsys):
    """Joints say nothing of them where a checkpoint names none."""
    source = tiny_run()
    saved = content(source, 1)
    state = saved["actor_state_dict"]
    for name in ("mlp.2.weight", "mlp.2.bias", "distribution.std_param"):
        state[name] = state[name][:6]
    torch.save(saved, source / "model_1.pt")
    error = refused(capsys, "--transfer", str(source))
    assert f"its policy gives 6 actions, but '{OTHER}' takes 12" in error


def test_first_differences_of_terms():
    there = {"a": 3, "b": 2}
    assert first_difference({"a": 3, "b": 2}, there) == ""
    assert first_difference({"a": None, "b": None}, there) == ""
    assert first_difference({"a": 3, "c": 2}, there) == "term 2 is 'c' (2) here, 'b' (2) there"
    assert first_difference({"a": 3, "b": 4}, there) == "term 2 is 'b' (4) here, 'b' (2) there"
    assert first_difference({"b": 2, "a": 3}, there) == "term 1 is 'b' (2) here, 'a' (3) there"
    assert first_difference({"a": 3, "b": 2, "c": 1}, there) == "term 3 is 'c' (1) here, none there"


def test_an_origin_that_is_damaged_is_named(capsys):
    source = tiny_run()
    saved = content(source, 1)
    saved["infos"]["transferred_from"] = [1]
    torch.save(saved, source / "model_1.pt")
    with pytest.raises(legged.errors.ConfigError, match=r"its infos\.transferred_from is list, not dict"):
        read_checkpoint(source / "model_1.pt")


def test_a_policy_alone_is_played_but_not_trained_on(capsys):
    """A checkpoint without value function: it acts as before, and neither transfer nor --resume begins with it."""
    folder = tiny_run()
    path = folder / "model_1.pt"
    saved = read_checkpoint(path)
    for part in ("critic_state_dict", "optimizer_state_dict"):
        del saved[part]
    torch.save(saved, path)
    capsys.readouterr()
    assert (
        call(play.main, ["--task", TASK, "--load_run", str(folder), "--sim_device", "cpu", "--headless", "--no-video"]) == 0
    )
    assert "largest difference to the policy" in capsys.readouterr().out
    refused = ["--task", OTHER, "--transfer", str(folder), *TINY_TRAINING, "--sim_device", "cpu"]
    assert call(train.main, refused) == 2
    assert "holds a policy without a value function, so a training can't begin with it" in capsys.readouterr().err
    resume = ["--task", TASK, "--resume", "--load_run", str(folder), *TINY_TRAINING, "--max_iterations", "9"]
    assert call(train.main, [*resume, "--sim_device", "cpu"]) == 2
    assert "holds no optimiser, so its training can't be resumed" in capsys.readouterr().err
