"""Students: a training by distillation from any policy of ours, what it writes, how it goes on, and what does not fit."""

import shutil
from pathlib import Path

import pytest
import torch
from helpers import POLICY, POLICY_ITERATION, TASK, TINY_TRAINING, call, checkpoints, tiny_run
from test_resume import EVENTFUL, content, same

from legged.cli.play import play
from legged.cli.train import train
from legged.config import to_dict
from legged.envs.checks import check_sizes
from legged.errors import ConfigError
from legged.evaluation.learning_curves import read_scalars
from legged.learning.run_folder import run_config
from legged.learning.student_rollout import StudentRollout
from legged.learning.student_runner import StudentRunner
from legged.learning.teacher import find_teacher, teacher_in, with_teacher
from legged.registry import make_task, task_config

pytestmark = pytest.mark.usefixtures("workplace")

STUDENT = ["--task", "anymal_c_student", "terrain.mesh_type=plane", "train.distillation.gradient_length=2"]
SMALL = [
    ("sim.physics", "mujoco"),
    ("sim.threads", 1),
    ("env.num_envs", 12),
    ("terrain.mesh_type", "plane"),
    ("train.distillation.teacher", TASK),
    ("train.policy.actor_hidden_dims", [8]),
    ("train.runner.num_steps_per_env", 8),
]
LSTM = ["train.policy.rnn_type=lstm", "train.policy.rnn_hidden_dim=6"]


def student(*arguments: str, teacher: str = TASK, **options) -> object:
    """A run folder of a student of the shipped policy."""
    return tiny_run(*STUDENT, "--teacher", teacher, *arguments, **options)


def built(*overrides) -> StudentRunner:
    """A student in its task, of robots whose episodes end soon, and at different steps."""
    cfg = task_config("anymal_c_student", [*SMALL, *overrides], on_cpu=True)
    teacher = find_teacher(cfg)
    task = make_task(with_teacher(cfg, teacher))
    torch.manual_seed(3)
    runner = StudentRunner(task, teacher)
    torch.manual_seed(7)
    task.reset()
    task.episode_length_buf = torch.arange(12) + task.max_episode_length - 6
    return runner


# ---- the rollout ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_student_acts_and_the_teacher_labels():
    """Actions are the student's with its noise; labels are the teacher's means for the state that the student got into."""
    runner = built()
    rollout, storage = StudentRollout(runner.env, runner.alg), runner.alg.storage
    rollout.collect()
    with torch.no_grad():
        for t in (0, 5):
            mean = runner.alg.student(storage.observations[t])
            noise = (storage.actions[t] - mean) / 0.1
            assert 0.7 < float(noise.std()) < 1.3
            torch.testing.assert_close(storage.privileged_actions[t], runner.alg.teacher(storage.observations[t]))
    seen = storage.observations["teacher_actor"]
    assert seen.shape[-1] == 48
    assert storage.observations["actor"].shape[-1] == 6 * 45
    far = (storage.privileged_actions - storage.actions).abs().mean()
    assert float(far) > 0.2, "they do not do the same yet"


@pytest.mark.slow
def test_the_teacher_sees_without_noise_and_the_student_with():
    runner = built()
    scales = runner.env.observation_scales()
    velocity = runner.env.dof_vel * scales["dof_vel"]
    assert torch.equal(runner.env.observation_groups["teacher_actor"].buffer[:, 24:36], velocity)
    assert not torch.equal(runner.env.observation_groups["actor"].buffer[:, -24:-12], velocity)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["none", "gru"])
def test_a_rollout_is_that_of_rsl_rl(kind):
    """Observations, actions and ends of episodes bit by bit, with noise, commands and resets drawn alike. The standard
    deviation is a power of 2: rsl-rl rounds its product with the noise before it adds the mean.
    """
    settings = [("train.policy.rnn_type", kind), ("train.policy.rnn_hidden_dim", 6), ("train.policy.init_noise_std", 0.125)]
    stock, ours = (built(*settings) for _ in range(2))
    for runner in (stock, ours):  # from the same state
        torch.manual_seed(7)
        runner.env.reset()
        runner.env.episode_length_buf = torch.arange(12) + runner.env.max_episode_length - 6
    torch.manual_seed(9)
    with torch.inference_mode():
        observations = stock.env.get_observations()
        for _ in range(8):
            observations, rewards, dones, extras = stock.env.step(stock.alg.act(observations))
            stock.alg.process_env_step(observations, rewards, dones, extras)
    rollout = StudentRollout(ours.env, ours.alg)
    torch.manual_seed(9)
    rollout.collect()
    wanted, found = stock.alg.storage, ours.alg.storage
    assert wanted.dones.sum() > 3
    for name in ("actions", "dones", "rewards"):
        assert torch.equal(getattr(found, name), getattr(wanted, name)), name
    for name, group in wanted.observations.items():
        assert torch.equal(found.observations[name], group), name
    torch.testing.assert_close(found.privileged_actions, wanted.privileged_actions)


# ---- a training ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_student_is_trained_logged_played_and_exported(capsys):
    folder = student(iterations=8)
    saved = content(folder, 7)
    assert "critic_state_dict" not in saved
    assert saved["infos"]["teacher"]["task"] == TASK
    cfg = run_config(folder)
    assert cfg.train.distillation.teacher == TASK
    assert [*cfg.observations.groups] == ["actor", "critic"], "a policy is played without what its teacher saw"
    losses = read_scalars(folder)["Loss/behavior"][1]
    assert len(losses) == 8
    assert losses[-4:].mean() < losses[:4].mean()
    capsys.readouterr()
    flags = ["--task", "anymal_c_student", "--load_run", str(folder), "--sim_device", "cpu", "--headless", "--no-video"]
    assert call(play.main, flags) == 0
    assert "largest difference to the policy" in capsys.readouterr().out


@pytest.mark.slow
def test_the_loss_and_the_teacher_are_told(capsys):
    arguments = [*STUDENT, "--teacher", TASK, "--sim_device", "cpu", "--num_envs", "8", "--max_iterations", "1"]
    assert call(train.main, [*arguments, *TINY_TRAINING]) == 0
    out = capsys.readouterr().out
    assert "teacher: " in out
    assert f"{TASK}/model.pt ({TASK}, iteration {POLICY_ITERATION})" in out
    assert "behaviour loss 0." in out


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [["train.policy.obs_normalization=true"], ["--runner", "stock"], [*LSTM], [*LSTM, "--runner", "stock"]],
    ids=["captured, normalised", "stock", "lstm", "lstm, stock"],
)
def test_two_and_two_iterations_are_four(settings):
    """Weights, moments and memory bit by bit, after the teacher's run has gone."""
    teacher = tiny_run("train.policy.obs_normalization=true", iterations=1)
    flags = [*settings, *EVENTFUL]
    four, two = (student(*flags, teacher=str(teacher), num_envs=24, iterations=n) for n in (4, 2))
    shutil.rmtree(teacher)
    rest = tiny_run(*STUDENT[:2], "--resume", "--load_run", str(two), num_envs=24, iterations=4)
    for part in ("actor_state_dict", "teacher_state_dict", "optimizer_state_dict"):
        assert same(content(rest, 3)[part], content(four, 3)[part]), part
    states = [torch.load(folder / "state_3.pt", weights_only=True) for folder in (four, rest)]
    for name in ("task", "episodes", "memory", "generators"):
        assert same(states[0][name], states[1][name]), name


@pytest.mark.slow
@pytest.mark.parametrize("loop", ["stock", "captured"])
@pytest.mark.parametrize("of_ppo", [[], ["train.algorithm.schedule=fixed", "train.algorithm.learning_rate=0.07"]])
def test_a_resumed_student_learns_at_the_rate_of_the_configuration(loop, of_ppo):
    folder = student("--runner", loop)
    resume = ["--resume", "--load_run", str(folder), "train.distillation.learning_rate=0.00001"]
    saved = content(tiny_run(*STUDENT[:2], *resume, *of_ppo, num_envs=12, iterations=3), 2)
    assert saved["optimizer_state_dict"]["param_groups"][0]["lr"] == pytest.approx(1e-5)
    assert saved["infos"]["learning_rate"] == pytest.approx(1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("loop", ["stock", "captured"])
def test_a_teacher_with_a_memory_teaches(loop):
    teacher = tiny_run("train.policy.rnn_type=gru", "train.policy.rnn_hidden_dim=6", "train.algorithm.symmetry=false")
    folder = student("--runner", loop, *EVENTFUL, teacher=str(teacher))
    assert max(checkpoints(folder)) == 1
    taught = teacher_in(folder / "model_1.pt", content(folder, 1))
    assert taught.policy.rnn_type == "gru"
    assert same(dict(taught.weights), content(teacher, 1)["actor_state_dict"])


@pytest.mark.slow
def test_evaluations_during_training_are_of_the_student():
    folder = student("train.runner.evaluate_interval=2", "train.runner.evaluate_share=1", "train.runner.evaluate_s=0.5")
    assert (folder / "model_best.pt").is_file()


@pytest.mark.slow
def test_the_sequel_goes_on_from_rewards(capsys):
    """PPO begins with what the student has learned, a new value function that learns alone at first, and a std of its own."""
    source = student(num_envs=24)
    sequel = ["--task", "anymal_c_student_ppo", "terrain.mesh_type=plane", "--transfer", str(source)]
    folder = tiny_run(*sequel, "train.algorithm.critic_warmup_iterations=1", "train.runner.save_interval=1", iterations=2)
    learned, begun, now = (content(f, i)["actor_state_dict"] for f, i in ((source, 1), (folder, 0), (folder, 1)))
    assert torch.equal(begun.pop("distribution.std_param"), torch.full((12,), 0.2))
    del learned["distribution.std_param"]
    assert same(begun, learned)
    assert not same({name: now[name] for name in begun}, begun)
    assert content(folder, 1)["critic_state_dict"]
    assert run_config(folder).train.algorithm.class_name == "PPO"


# ---- what does not fit ---------------------------------------------------------------------------------------------------

TEACHER = "train.distillation.teacher"
UNFIT = {
    "scale": (["observations.scales.dof_vel=0.1"], "observations.scales.dof_vel 0.05 there, 0.1 here"),
    "commands": (
        ["observations.scales.base_lin_vel=1.0"],
        "observations.scales.base_lin_vel 2 there, 1 here; observations.scales.commands (2.0, 0.25) there, (1.0, 0.25) here",
    ),
    "action": (["control.action_scale=0.25"], "control.action_scale 0.5 there, 0.25 here"),
    "step": (["control.decimation=5"], "the control step 0.02 there, 0.025 here"),
    "clip": (["observations.clip=5.0"], "observations.clip 100 there, 5 here"),
    "robot": (["robot=go2"], "made for another robot: 'anymal_c' with 12 joints"),
    "nobody": (["--teacher", "anymal_x"], "there is no task and no run 'anymal_x'"),
    "divisor": (["train.distillation.gradient_length=3"], "must divide train.runner.num_steps_per_env=4"),
    "estimator": (["train.policy.estimator.targets=[base_lin_vel]"], "a student can't train an estimator"),
    "std": (["train.policy.state_dependent_std=true"], "a student learns only the mean of the actions"),
}


@pytest.mark.slow
@pytest.mark.parametrize(("arguments", "says"), UNFIT.values(), ids=UNFIT)
def test_a_teacher_that_does_not_fit_ends_the_start_with_one_line(arguments, says, capsys):
    assert call(train.main, [*STUDENT, "--teacher", TASK, *TINY_TRAINING, "--sim_device", "cpu", *arguments]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("error: ")
    assert says in line


@pytest.mark.slow
def test_a_teacher_needs_the_same_points_of_the_ground(capsys):
    flags = ["--task", "anymal_c_student", "--teacher", "anymal_c", *TINY_TRAINING, "--sim_device", "cpu"]
    assert call(train.main, [*flags, "train.distillation.gradient_length=2", "terrain.measured_points_x=[0.0,0.5]"]) == 2
    line = capsys.readouterr().err
    assert "terrain.measured_points_x 17 from -0.8 to 0.8 there, (0.0, 0.5) here" in line


def test_a_teacher_needs_the_same_reading_of_the_ground(capsys):
    flags = ["--task", "anymal_c_student", "--teacher", "anymal_c", *TINY_TRAINING, "--sim_device", "cpu"]
    assert call(train.main, [*flags, "train.distillation.gradient_length=2", "terrain.scan=highest"]) == 2
    assert "terrain.scan own there, highest here" in capsys.readouterr().err


def test_the_teacher_that_comes_with_the_package_fits_the_task_that_names_it():
    """A new default of rough ground, terrain.scan, once ended `train.py --task anymal_c_student` at its start."""
    teacher = find_teacher(task_config("anymal_c_student", on_cpu=True))
    assert teacher.origin["task"] == "anymal_c"
    assert Path(str(teacher.origin["file"])).parent.resolve() == POLICY.parent / "anymal_c"


@pytest.mark.slow
def test_what_a_teacher_knows_of_the_randomisation_must_be_on_its_scale(capsys):
    """A property is observed as a share of its range, a force as one of the largest."""
    privileged = "observations.groups.actor.terms=[base_lin_vel,commands,dof_pos,dof_vel,actions,rand_friction,push_force]"
    symmetry = "train.algorithm.symmetry=false"
    mild = ["domain_rand.ranges.friction=[0.5,1.5]", "domain_rand.forces.pull={x: [-20,20]}"]
    teacher = str(tiny_run("--task", TASK, privileged, symmetry, *mild, iterations=1))
    strong = ["domain_rand.ranges.friction=[0.1,1.5]", "domain_rand.forces.pull={x: [-20,50]}"]
    flags = [*STUDENT, "--teacher", teacher, *TINY_TRAINING, "--sim_device", "cpu"]
    assert call(train.main, [*flags, *strong]) == 2
    error = capsys.readouterr().err
    assert "domain_rand.observed_ranges.friction [0.5, 1.5] there, [0.1, 1.5] here" in error
    assert "domain_rand.forces pull up to 20 N there, pull up to 50 N here" in error
    assert call(train.main, [*flags, *mild[1:], "domain_rand.randomize_friction=false"]) == 2
    assert "domain_rand.observed_ranges.friction [0.5, 1.5] there, not drawn here" in capsys.readouterr().err
    shown = "domain_rand.observed_ranges.friction=[0.5,1.5]"
    assert student(strong[0], shown, *mild[1:], teacher=teacher, iterations=1).is_dir()


@pytest.mark.slow
def test_a_policy_with_an_estimator_is_no_teacher(capsys):
    folder = tiny_run("--task", TASK, "train.policy.estimator.targets=[base_lin_vel]", iterations=1)
    assert call(train.main, [*STUDENT, "--teacher", str(folder), *TINY_TRAINING, "--sim_device", "cpu"]) == 2
    assert "has an estimator; a teacher can't have one" in capsys.readouterr().err


def test_observations_that_a_students_task_has_not_are_named(capsys):
    flags = ["--task", "half_cheetah", "train.algorithm.class_name=Distillation", "--teacher", TASK]
    assert call(train.main, [*flags, "train.distillation.gradient_length=2", *TINY_TRAINING, "--sim_device", "cpu"]) == 2
    assert "observes 'base_lin_vel', 'base_ang_vel', 'projected_gravity'" in capsys.readouterr().err


@pytest.mark.slow
def test_flags_that_do_not_go_together_are_refused(capsys):
    small = [*TINY_TRAINING, "--sim_device", "cpu"]
    assert call(train.main, ["--task", TASK, "--teacher", TASK, *small]) == 2
    assert f"--teacher: '{TASK}' learns from rewards" in capsys.readouterr().err
    assert call(train.main, [*STUDENT, "--transfer", TASK, *small]) == 2
    assert "--transfer: 'anymal_c_student' learns from a teacher, and can't begin with a policy" in capsys.readouterr().err
    assert call(train.main, [*STUDENT, "--teacher", "", *small]) == 2
    assert "error: --teacher: 'anymal_c_student' learns from a teacher; name one" in capsys.readouterr().err
    folder = student()
    resume = [*STUDENT[:2], "--resume", "--load_run", str(folder), "--max_iterations", "9", *small]
    assert call(train.main, [*resume, "--teacher", "anymal_c"]) == 2
    assert f"{TEACHER}: a resumed training can't change '{TASK}'; got 'anymal_c'" in capsys.readouterr().err


@pytest.mark.slow
def test_a_checkpoint_without_its_teacher_is_not_resumed(capsys):
    folder = student()
    saved = content(folder, 1)
    del saved["teacher_state_dict"]
    torch.save(saved, folder / "model_1.pt")
    resume = [*STUDENT[:2], "--resume", "--load_run", str(folder), "--max_iterations", "9", "--sim_device", "cpu"]
    assert call(train.main, resume) == 2
    assert "holds no teacher to continue with" in capsys.readouterr().err


def test_a_group_of_the_students_own_keeps_its_name():
    group = {"terms": ["dof_pos"]}
    cfg = task_config("anymal_c_student", [*SMALL, ("observations.groups.teacher_actor", group)], on_cpu=True)
    with pytest.raises(ConfigError, match=r"observations\.groups\.teacher_actor: the teacher's group has this name"):
        find_teacher(cfg)


@pytest.mark.slow
def test_a_checkpoint_file_can_be_the_teacher():
    folder = tiny_run(iterations=2)
    cfg = task_config("anymal_c_student", [*SMALL, (TEACHER, str(folder / "model_0.pt"))], on_cpu=True)
    teacher = find_teacher(cfg)
    assert teacher.origin["iteration"] == 0
    assert same(dict(teacher.weights), content(folder, 0)["actor_state_dict"])
    assert to_dict(with_teacher(cfg, teacher))["observations"]["groups"]["teacher_actor"]["noise"] is False


def test_mini_batches_of_ppo_are_nothing_to_a_student():
    """Three robots and one step make fewer samples than PPO's four mini-batches want."""
    small = [("env.num_envs", 3), ("train.runner.num_steps_per_env", 1)]
    check_sizes(task_config("anymal_c_student", [*small, ("train.distillation.gradient_length", 1)]))
    with pytest.raises(ConfigError, match="num_mini_batches: must be at most the 3 samples"):
        check_sizes(task_config("anymal_c_proprio", small))
