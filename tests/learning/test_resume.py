"""A resumed training goes on as if it had never stopped, with the run's own settings; or says what begins anew."""

import shutil

import pytest
import torch
from helpers import TASK, call, run_folders, tiny_run

from legged.cli.train import train
from legged.envs import LeggedRobot
from legged.learning.run_folder import run_config
from legged.policies.restore import policy_of  # noqa: F401  (imports every loader of checkpoints)

pytestmark = [pytest.mark.usefixtures("workplace"), pytest.mark.slow]

EVENTFUL = ["env.episode_length_s=0.3", "commands.resampling_time_s=0.1", "domain_rand.push_interval_s=0.06"]
"""Episodes, commands and pushes that end, change and come within a few iterations of four steps."""
VARIANTS = {
    "curriculum of commands, normalised, rmsprop": [
        *("commands.curriculum.window_s=0.02", "commands.curriculum.threshold=0.0"),
        *("train.policy.obs_normalization=true", "train.algorithm.optimizer=rmsprop"),
    ],
    "stock, std by state": ["--runner", "stock", "train.policy.state_dependent_std=true"],
    "terrain, torques from velocities": ["--task", "anymal_c", "control.control_type=V"],
    "history": ["--task", "anymal_c_proprio"],
    "estimator, bounds of the std": [
        *("--task", "anymal_c_estimator", "train.policy.estimator.latent=2"),
        *("train.policy.min_noise_std=0.498", "train.policy.noise_std_type=log"),
    ],
    "lstm": ["train.policy.rnn_type=lstm", "train.policy.rnn_hidden_dim=6", "train.algorithm.symmetry=false"],
    "gru, forces": [
        *("train.policy.rnn_type=gru", "train.policy.rnn_num_layers=2", "train.algorithm.symmetry=false"),
        "domain_rand.forces={pull: {y: [-80, 80], interval_s: [0.02, 0.06], duration_s: [0.06, 0.1]}}",
    ],
}


def content(folder, iteration: int) -> dict:
    return torch.load(folder / f"model_{iteration}.pt", weights_only=True)


def same(a, b) -> bool:
    """Whether nested values are equal, tensors bit by bit."""
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(same, a, b))
    return torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b


@pytest.mark.parametrize("arguments", VARIANTS.values(), ids=VARIANTS)
def test_two_and_two_iterations_are_four(arguments):
    """Weights, moments, curricula, robots, their memory and random generators, bit by bit."""
    four = tiny_run(*arguments, *EVENTFUL, num_envs=24, iterations=4)
    two = tiny_run(*arguments, *EVENTFUL, num_envs=24, iterations=2)
    task = arguments[:2] if "--task" in arguments else []
    rest = tiny_run("--resume", *task, "--load_run", str(two), num_envs=24, iterations=4)
    wanted, found = content(four, 3), content(rest, 3)
    for part in ("actor_state_dict", "critic_state_dict", "optimizer_state_dict"):
        assert same(found[part], wanted[part]), part
    assert same(found["infos"]["task_state"], wanted["infos"]["task_state"])
    assert found["infos"]["learning_rate"] == wanted["infos"]["learning_rate"]
    states = [torch.load(folder / "state_3.pt", weights_only=True) for folder in (four, rest)]
    assert states[0].pop("id") != states[1].pop("id")
    assert same(*states)
    assert not same(content(two, 1)["actor_state_dict"], wanted["actor_state_dict"])


def test_only_the_newest_checkpoint_keeps_the_state_of_the_robots():
    folder = tiny_run("train.runner.save_interval=1", iterations=3)
    assert sorted(path.name for path in folder.glob("*.pt")) == ["model_0.pt", "model_1.pt", "model_2.pt", "state_2.pt"]


def start_anew(capsys, folder, *arguments: str) -> str:
    """What a resumed training says, whose robots begin anew."""
    capsys.readouterr()
    assert train.main(["--task", TASK, "--sim_device", "cpu", "--resume", "--load_run", str(folder), *arguments]) == 0
    out = capsys.readouterr().out
    assert "all robots begin anew" in out
    return out


def test_without_the_state_robots_begin_anew_and_it_is_said(capsys):
    folder = tiny_run("train.runner.save_interval=1", iterations=3)
    assert "no state_0.pt next to the checkpoint" in start_anew(capsys, folder, "--checkpoint", "0", "--max_iterations", "2")
    assert "there is no state_1.pt" in start_anew(capsys, folder, "--checkpoint", "1", "--max_iterations", "3")
    (folder / "state_2.pt").rename(folder / "state_1.pt")
    assert "state_1.pt belongs to another checkpoint" in start_anew(capsys, folder, "--checkpoint", "1")
    state = torch.load(folder / "state_1.pt", weights_only=True)
    torch.save({**state, "format": torch.zeros(0)}, folder / "state_2.pt")
    assert "state_2.pt is damaged" in start_anew(capsys, folder, "--max_iterations", "4")
    torch.save({**state, "format": 99}, folder / "state_2.pt")
    assert "state_2.pt has format 99, but this version reads format 2" in start_anew(capsys, folder, "--max_iterations", "4")
    (folder / "state_2.pt").write_bytes(b"nonsense")
    assert "state_2.pt: not a checkpoint" in start_anew(capsys, folder, "--max_iterations", "4")


def test_with_another_number_of_robots_they_begin_anew(capsys):
    folder = tiny_run(num_envs=8)
    out = start_anew(capsys, folder, "--num_envs", "6", "--max_iterations", "3")
    assert "env.num_envs 8 -> 6" in out
    assert "env.num_envs was 8, and is 6 now" in out


def test_robots_that_begin_anew_stand_on_their_tiles_and_nobody_is_promoted():
    """They were reset onto the levels that were loaded, so that their first distance is measured from where they stand."""
    from legged.learning.runner import Runner
    from legged.registry import make_task

    folder = tiny_run("--task", "anymal_c", num_envs=40)
    (folder / "state_1.pt").unlink()
    saved = content(folder, 1)
    levels = torch.arange(40) % 5
    saved["infos"]["task_state"]["terrain_curriculum"]["levels"] = levels
    torch.save(saved, folder / "model_1.pt")
    task = make_task(run_config(folder))
    runner = Runner(task)
    assert runner.resume(str(folder / "model_1.pt")) == "there is no state_1.pt next to the checkpoint"
    assert task.terrain_curriculum.levels.tolist() == levels.tolist()
    away = (task.base_pos[:, :2] - task.env_origins[:, :2]).norm(dim=1)
    assert away.max() <= task.cfg.terrain.spawn_range * 2**0.5 + 1e-5
    everyone, nothing = torch.ones(40, dtype=torch.bool), torch.zeros(40, dtype=torch.long)
    task.terrain_curriculum.update(everyone, everyone, torch.zeros(40, 4), torch.zeros(40, 3), nothing)
    assert task.terrain_curriculum.levels.tolist() == levels.tolist()


# ---- settings --------------------------------------------------------------------------------------------------------


def test_settings_are_those_of_the_run_and_changes_are_said(capsys):
    folder = tiny_run("--seed", "7", "rewards.scales.torques=-0.123")
    capsys.readouterr()
    again = ["--task", TASK, "--sim_device", "cpu", "--resume", "--max_iterations", "3", "rewards.scales.dof_acc=-1e-6"]
    assert train.main(again) == 0
    out = capsys.readouterr().out
    assert f"going on with the settings of {folder}; rewards.scales.dof_acc -2.5e-07 -> -1e-06" in out
    (resumed,) = [run for run in run_folders() if run != folder]
    cfg = run_config(resumed)
    assert (cfg.env.seed, cfg.rewards.scales["torques"], cfg.rewards.scales["dof_acc"]) == (7, -0.123, -1e-6)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("train.policy.actor_hidden_dims=[16]", ("hidden layers [8]", "train.policy.actor_hidden_dims [16]")),
        ("train.policy.activation=relu", ("activation elu", "train.policy.activation relu")),
        ("train.policy.obs_normalization=true", ("obs_normalization False", "train.policy.obs_normalization True")),
        ("observations.groups.actor.history=2", ("history 1", "observations.groups.actor.history 2")),
        ("observations.groups.critic.terms=[dof_pos]", ("made for other observations", "critic")),
    ],
)
def test_another_network_or_observation_is_refused(capsys, change, words):
    tiny_run()
    capsys.readouterr()
    assert call(train.main, ["--task", TASK, "--sim_device", "cpu", "--resume", "--max_iterations", "3", change]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    for word in words:
        assert word in err


def test_another_robot_is_refused(capsys, tmp_path):
    from legged.process.paths import data_folder

    tiny_run()
    shutil.copytree(data_folder("resources") / "robots" / "anymal_c", tmp_path / "other")
    capsys.readouterr()
    again = ["--task", TASK, "--sim_device", "cpu", "--resume", "--max_iterations", "3", f"robot={tmp_path / 'other'}"]
    assert call(train.main, again) == 2
    assert "a resumed training keeps its robot 'anymal_c'" in capsys.readouterr().err


def test_a_robot_that_has_changed_since_is_refused(capsys, tmp_path):
    folder = tiny_run()
    saved = content(folder, 1)
    saved["infos"]["robot"]["joints"] = ["hip", "knee"]
    torch.save(saved, folder / "model_1.pt")
    capsys.readouterr()
    assert call(train.main, ["--task", TASK, "--sim_device", "cpu", "--resume", "--max_iterations", "3"]) == 2
    assert "made for another robot: 'anymal_c' with 2 joints" in capsys.readouterr().err


class Remembers(LeggedRobot):
    """A task with a buffer of its own."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.distance = torch.zeros(self.num_envs)


def test_a_user_s_own_buffers_go_on_too():
    from helpers import small_config

    first, second = (Remembers(small_config(num_envs=3)) for _ in range(2))
    first.distance += torch.tensor([1.0, 2.0, 3.0])
    second.load_state_dict(first.state_dict())
    assert second.distance.tolist() == [1.0, 2.0, 3.0]


@pytest.mark.parametrize("loop", ["captured", "stock"])
def test_a_state_is_taken_once(loop):
    """Whoever goes on learning in a notebook, call after call, goes on from where the last call ended."""
    from legged.learning.captured import CapturedRunner
    from legged.learning.runner import Runner
    from legged.registry import make_task

    folder = tiny_run(*EVENTFUL, num_envs=6)
    parts, whole = ((CapturedRunner if loop == "captured" else Runner)(make_task(run_config(folder))) for _ in range(2))
    for runner, calls in ((parts, (1, 2)), (whole, (3,))):
        assert runner.resume(str(folder / "model_1.pt")) == ""
        for count in calls:
            runner.learn(count)
            runner.current_learning_iteration += 1
    assert same(parts.alg.actor.state_dict(), whole.alg.actor.state_dict())
    assert same(parts.env.state_dict(), whole.env.state_dict())


def resumed_with(path: str, before, after):
    """A task that goes on with a run for which a setting was another one, and why its robots begin anew."""
    from legged.config import override
    from legged.learning.runner import Runner
    from legged.registry import make_task

    of = ["--task", "anymal_c"] if path.startswith("terrain") else []
    folder = tiny_run(*of, f"{path}={before}", num_envs=8)
    task = make_task(override(run_config(folder), [(path, after)]))
    return task, Runner(task).resume(str(folder / "model_1.pt"))


def test_robots_do_not_go_on_with_gains_that_were_drawn_from_another_range():
    task, why = resumed_with("domain_rand.ranges.p_gain.range", [0.5, 0.6], [1.5, 1.6])
    assert why == "domain_rand.ranges.p_gain.range was [0.5, 0.6], and is [1.5, 1.6] now"
    assert task.randomization.fields["p_gain"].min() >= 1.5


def test_a_command_curriculum_that_is_turned_off_leaves_no_narrow_ranges():
    task, why = resumed_with("commands.curriculum.enabled", "true", False)
    assert why == "commands.curriculum.enabled was True, and is False now"
    assert task.command_curriculum.share.tolist() == [1.0] * 3


def test_robots_are_spread_over_the_columns_of_a_new_ground():
    task, why = resumed_with("terrain.num_cols", 20, 10)
    assert why == "terrain.num_cols was 20, and is 10 now"
    assert task.terrain_curriculum.columns.tolist() == [0, 1, 2, 3, 5, 6, 7, 8]


@pytest.mark.parametrize("loop", ["captured", "stock"])
def test_a_fixed_learning_rate_can_be_changed(loop):
    folder = tiny_run("train.algorithm.schedule=fixed", "train.algorithm.learning_rate=0.001", f"train.runner.loop={loop}")
    rest = tiny_run("--resume", "--load_run", str(folder), "train.algorithm.learning_rate=0.00001", iterations=4)
    saved = content(rest, 3)
    assert saved["infos"]["learning_rate"] == pytest.approx(1e-5)
    assert float(saved["optimizer_state_dict"]["param_groups"][0]["lr"]) == pytest.approx(1e-5)
