"""Wrong input ends with exit code 2 and one message that helps, without a traceback and before anything is built."""

import json
import shutil
import sys
from pathlib import Path

import pytest
import torch
from helpers import TASK, call, kept_global_state, run_folders, tiny_run

import legged.cli.train
import legged.policies.restore
import legged.registry
from legged.cli.benchmark import step
from legged.cli.evaluate import grid
from legged.cli.play import play
from legged.cli.train import train
from legged.commandline.arguments import pick_device
from legged.registry import task_config

SMALLER = (
    'observations.groups.actor.terms=["base_ang_vel", "projected_gravity", "commands", "dof_pos", "dof_vel"]'  # 33 numbers
)

pytestmark = pytest.mark.usefixtures("workplace")


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """logs/ with one short run, to copy."""
    folder = tmp_path_factory.mktemp("trained")
    with pytest.MonkeyPatch.context() as patch, kept_global_state():
        patch.chdir(folder)
        tiny_run(num_envs=4, iterations=1)
    return folder / "logs"


@pytest.fixture
def run(trained, tmp_path) -> Path:
    """A run in the working directory: one iteration, checkpoint 0."""
    shutil.copytree(trained, tmp_path / "logs")
    (folder,) = run_folders()
    return folder


@pytest.fixture
def fails(monkeypatch, capsys):
    """fails(main, arguments, words...): exit code 2, all the words on stderr, nothing built, nothing left behind."""

    def built(*_args, **_kwargs):
        pytest.fail("the task was built before the mistake was found")

    monkeypatch.setattr(legged.registry, "make_task", built)
    monkeypatch.setattr(legged.cli.train, "make_task", built)
    monkeypatch.setattr(legged.policies.restore, "make_task", built)
    monkeypatch.setattr("legged.cli.benchmark.make_task", built)

    def fails(main, arguments, *words):
        before = run_folders() if Path("logs").is_dir() else []
        code = call(main, arguments)
        out, err = capsys.readouterr()
        assert code == 2, err
        assert "Traceback" not in out + err
        for word in words:
            assert word in err
        assert (run_folders() if Path("logs").is_dir() else []) == before, "a run folder was left behind"
        return err

    return fails


def task(*arguments: str) -> list[str]:
    return [TASK, "--sim_device", "cpu", *arguments]


# ---- tasks and their settings ----------------------------------------------------------------------------------------


NAMES = [(train.main, "TASK"), (play.main, "POLICY"), (grid.main, "POLICY"), (step.main, "TASK")]


@pytest.mark.parametrize(("main", "name"), NAMES)
def test_an_unknown_task(fails, main, name):
    err = fails(main, ["anymal_c_flatt"], "anymal_c_flatt", f"did you mean '{TASK}'?")
    assert err.startswith(f"error: {name}: ")


@pytest.mark.parametrize(("main", "name"), NAMES)
def test_a_missing_task_and_an_unknown_flag(fails, main, name):
    fails(main, [], name)
    fails(main, task("--nonsense"), "--nonsense")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("argument", "words"),
    [
        ("env.num_env=3", ("command line: env.num_env:", "did you mean 'num_envs'?")),
        ("reward.scales.torques=1", ("command line: reward:", "did you mean 'rewards'?")),
        ("env.num_envs=many", ("env.num_envs: expected a whole number, got 'many'",)),
        ("env.num_envs=3.5", ("env.num_envs: expected a whole number",)),
        ("sim.dt=0", ("sim.dt: must be above 0",)),
        ("commands.ranges.lin_vel_x=[1, -1]", ("commands.ranges.lin_vel_x", "low <= high")),
        (
            "rewards.scales.torqes=-1",
            ("command line: rewards.scales.torqes", "no reward 'torqes'", "did you mean 'torques'?"),
        ),
        (
            "observations.groups.actor.terms=[dof_poss]",
            ("command line: observations.groups.actor.terms", "'dof_poss'", "did you mean 'dof_pos'?"),
        ),
        (
            "observations.groups.critic.terms=[dof_poss]",
            ("command line: observations.groups.critic.terms", "did you mean 'dof_pos'?"),
        ),
        (
            "observations.groups.actor.terms=[dof_poss]",
            ("command line: observations.groups.actor.terms", "did you mean 'dof_pos'?"),
        ),  # once
        ("terminations.failures=[contacts]", ("terminations.failures", "termination 'contacts'", "did you mean 'contact'?")),
        ("domain_rand.ranges.frictoin=[0, 1]", ("domain_rand.ranges.frictoin", "did you mean 'friction'?")),
        ("observations.scales.dof_poss=1", ("observations.scales", "did you mean 'dof_pos'?")),
        ("observations.noise.dof_poss=1", ("observations.noise", "did you mean 'dof_pos'?")),
        ("observations.groups.actor.terms=[]", ("observations.groups.actor.terms",)),
        ("control.stiffness.XYZ=1", ("command line: control.stiffness", "'XYZ'", "LF_HAA")),
        ("control.stiffness.HAA=1", ("control.stiffness", "LF_HFE")),  # then no pattern is left for the other joints
        ("robot=anymal_cc", ("command line: robot", "'anymal_cc'", "did you mean 'anymal_c'?")),
        ("sim.physics=physx", ("sim.physics", "'physx'", "mujoco_warp")),
        ("train.policy.activation=eluu", ("train.policy.activation", "'eluu'", "elu")),
        ("train.policy.actor_hidden_dims=[0]", ("train.policy.actor_hidden_dims",)),
        ("env.episode_length_s=0.001", ("command line: env.episode_length_s", "at least", "0.02 s", "got 0.001")),
        ("train.algorithm.num_mini_batches=1000000", ("command line: train.algorithm.num_mini_batches", "got 1000000")),
        ("task=another", ("task",)),
        ("num_envs", ("'num_envs' is not of the form section.key=value",)),
    ],
)
def test_a_mistake_in_an_override(fails, argument, words):
    fails(train.main, task(argument), *words)


def test_a_mistake_in_a_file_of_a_user_s_task(fails, tmp_path):
    (tmp_path / "mine.yaml").write_text(f"extends: {TASK}\nrewards:\n  scales: {{walk_nicely: 1}}\n")
    (tmp_path / "my_tasks.py").write_text("import legged\nlegged.register('mine', 'mine.yaml')\n")
    fails(train.main, ["--import", "my_tasks.py", "mine"], "mine.yaml: rewards.scales.walk_nicely", "has no reward")


@pytest.mark.slow
@pytest.mark.parametrize("main", [train.main, play.main, grid.main, step.main])
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ["--physics", "newtn"],
            ("command line: sim.physics: unknown value 'newtn'", "did you mean 'newton'?", "mujoco_warp"),
        ),
        (
            ["--physics", "newton", "--solver", "kamio"],
            ("command line: sim.solver: unknown value 'kamio'", "did you mean 'kamino'?", "featherstone"),
        ),
        (["--solver", "kamino"], ("--solver: 'kamino'", "add --physics newton")),
        (["--physics", "mujoco", "--solver", "kamino"], ("--solver: 'kamino'", "add --physics newton (got mujoco)")),
    ],
)
def test_an_engine_or_a_solver_that_is_not_there(fails, run, main, arguments, words):
    fails(main, task(*arguments), *words)


@pytest.mark.parametrize("module", ["no_such_module", "no_such_file.py"])
def test_a_module_that_is_not_there(fails, module):
    fails(train.main, task("--import", module), "--import", module)


@pytest.mark.slow
@pytest.mark.parametrize("main", [train.main, play.main, grid.main, step.main])
@pytest.mark.parametrize("number", ["0", "-3", "some"])
def test_a_number_of_robots_that_cannot_be(fails, run, main, number):
    fails(main, task("--num_envs", number), "num_envs" if number != "some" and main != grid.main else "--num-envs")


def test_a_number_of_robots_is_not_evaluate_s_to_choose(fails, run):
    """The grid says how many robots there are; another number cannot be obeyed and must not crash."""
    fails(grid.main, task("--num_envs", "5"), "--num-envs")


@pytest.mark.parametrize("number", [["--num-envs", "1000000"], ["env.num_envs=4097"]])
def test_a_film_of_more_robots_than_can_be_built_soon(fails, number):
    fails(play.main, task(*number), "--num-envs: must be from 1 to 4096, got", "a film shows at most 9")


def test_a_training_without_a_reward(fails, tmp_path):
    scales = task_config(TASK).rewards.scales
    nothing = dict.fromkeys(scales, 0.0)
    (tmp_path / "unpaid.yaml").write_text(f"extends: {TASK}\nrewards: {{scales: {json.dumps(nothing)}}}\n")
    expected = "unpaid: rewards.scales: no reward has a scale other than 0 (rewards: action_rate, ang_vel_xy,"
    fails(train.main, ["unpaid.yaml", "--sim-device", "cpu"], expected)
    assert call(train.main, ["unpaid.yaml", "--sim-device", "cpu", "--show", "rewards.scales.torques=-1"]) == 0


def test_a_number_of_iterations_that_cannot_be(fails):
    fails(train.main, task("--max_iterations", "0"), "train.runner.max_iterations: must be at least 1")


@pytest.mark.parametrize("name", ["a\nb", "x" * 5000, "\x1b[31m"])
def test_an_odd_name_is_still_one_line(fails, name):
    err = fails(
        train.main,
        task(f"observations.groups.actor.terms=[{json.dumps(name)}]"),
        "observations.groups.actor.terms",
        "no observation",
    )
    assert err.count("\n") == 1
    assert len(err) < 2100
    assert "\x1b" not in err


# ---- devices ---------------------------------------------------------------------------------------------------------


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
@pytest.mark.parametrize("flag", ["--sim-device", "--rl-device"])
@pytest.mark.parametrize("name", ["cuda", "cuda:0", "cuda:7"])
def test_a_gpu_where_there_is_none(fails, flag, name):
    fails(train.main, [TASK, flag, name], flag, f"'{name}'", "no GPU")


@pytest.mark.parametrize("main", [train.main, play.main, grid.main, step.main])
@pytest.mark.parametrize("name", ["nonsense", "gpu", "cuda:x", "meta", "mps"])
def test_a_device_that_is_none(fails, main, name):
    fails(main, [TASK, "--sim_device", name], "--sim-device", f"'{name}'", "allowed: cpu, cuda")


def test_a_number_of_the_cpu(fails):
    fails(train.main, [TASK, "--sim-device", "cpu:5"], "--sim-device: 'cpu:5': there is one device 'cpu'", "sim.threads")
    assert pick_device("cpu:0") == pick_device("cpu") == torch.device("cpu")


# ---- runs and checkpoints --------------------------------------------------------------------------------------------

HIDDEN = ["train.policy.actor_hidden_dims=[8]", "train.policy.critic_hidden_dims=[8]"]
LOADING = [(train.main, "--resume"), (play.main, "--no-video"), (grid.main, "--vx=0")]


def test_no_run_to_resume(fails):
    fails(train.main, task("--resume"), f"'{TASK}': there is no run with a checkpoint", f"logs/{TASK}; train one first")


@pytest.mark.parametrize(("main", "flag"), LOADING[1:])
def test_no_run_of_a_task_without_a_shipped_policy(fails, main, flag):
    Path("never_trained.yaml").write_text("extends: anymal_c_flat\n")
    words = "POLICY: 'never_trained' has neither a run in logs/never_trained nor a shipped policy; train it first"
    fails(main, ["never_trained.yaml", flag], words)


@pytest.mark.parametrize(("main", "flag"), LOADING[:2])
def test_a_run_of_the_task_that_is_not_there_names_those_that_are(fails, run, main, flag):
    name = run.name[:-1] + "x"
    fails(main, task(flag, "--load_run", name), "--load-run", f"'{name}'", f"did you mean '{run.name}'?")


@pytest.mark.parametrize(("main", "flag"), LOADING[1:])
def test_a_run_that_is_not_there_names_those_that_are(fails, run, main, flag):
    name = f"{TASK}/{run.name[:-1]}x"
    fails(main, [name, flag], "POLICY", f"'{name}'", f"did you mean '{TASK}/{run.name}'?")


@pytest.mark.slow
@pytest.mark.parametrize(("main", "flag"), LOADING)
def test_a_checkpoint_that_is_not_there_names_those_that_are(fails, run, main, flag):
    fails(main, task(flag, "--checkpoint", "7"), "--checkpoint", "no checkpoint 7", "(it has: 0)")


@pytest.mark.parametrize(("main", "flag"), LOADING)
def test_a_folder_without_checkpoint(fails, run, main, flag):
    (run.parent / "empty").mkdir()
    shutil.copy(run / "config.yaml", run.parent / "empty")
    named = task("--load_run", "empty") if main == train.main else [f"{TASK}/empty"]
    fails(main, [*named, flag], f"logs/{TASK}/empty: holds no checkpoint")


@pytest.mark.parametrize(("main", "flag"), LOADING)
def test_a_folder_that_is_no_run(fails, tmp_path, main, flag):
    (tmp_path / "other").mkdir()
    if main != grid.main:
        fails(main, task(flag, "--load_run", "other"), "--load-run", "other is not a run folder")
    if main != train.main:
        fails(main, ["other", flag], "POLICY: 'other'", "no config.yaml")


FOREIGN = {
    "text": lambda path: path.write_text("this is no checkpoint\nat all\n"),
    "empty": lambda path: path.write_bytes(b""),
    "cut": lambda path: path.write_bytes(path.read_bytes()[:1000]),
    "dictionary": lambda path: torch.save({"a": 1}, path),
    "number": lambda path: torch.save(3, path),
    "legged_gym": lambda path: torch.save({"model_state_dict": {}, "optimizer_state_dict": {}, "iter": 1500}, path),
}


@pytest.mark.slow
@pytest.mark.parametrize(("main", "flag"), LOADING)
@pytest.mark.parametrize("kind", FOREIGN)
def test_a_file_that_is_no_checkpoint(fails, run, main, flag, kind):
    FOREIGN[kind](run / "model_0.pt")
    what = "a checkpoint of rsl-rl before 5.0; docs/migrating.md" if kind == "legged_gym" else "not a checkpoint"
    fails(main, task(flag), f"model_0.pt: {what}")


def test_a_checkpoint_without_optimiser_cannot_be_trained_on(fails, run):
    saved = torch.load(run / "model_0.pt", weights_only=True)
    del saved["optimizer_state_dict"]
    torch.save(saved, run / "model_0.pt")
    fails(train.main, task("--resume", *HIDDEN), "model_0.pt", "optimi")


def test_a_checkpoint_of_another_observation_names_both_sizes(fails, run):
    err = fails(train.main, task("--resume", *HIDDEN, SMALLER), "model_0.pt", "observations")
    assert "48" in err
    assert "33" in err


@pytest.mark.slow
@pytest.mark.parametrize(("main", "flag"), LOADING[1:])
def test_other_observations_at_play(fails, run, main, flag):
    err = fails(main, task(flag, SMALLER), "model_0.pt", "observations")
    assert "48" in err
    assert "33" in err


@pytest.mark.slow
@pytest.mark.parametrize("network", ["actor", "critic"])
def test_a_checkpoint_of_another_network_names_both_shapes(fails, run, network):
    sizes = [f"train.policy.{name}_hidden_dims={'[16]' if name == network else '[8]'}" for name in ("actor", "critic")]
    fails(train.main, task("--resume", "--max_iterations", "9", *sizes), "model_0.pt", network, "[8]", "[16]")


def test_a_run_of_another_task(fails, run):
    config = run / "config.yaml"
    config.write_text(config.read_text().replace(f"task: {TASK}", "task: climbing"))
    for main, flag in LOADING[:2]:
        fails(main, task(flag, "--load_run", str(run)), "climbing", TASK)
    for main, flag in LOADING[1:]:
        fails(main, [str(run), flag], "POLICY", str(run), "'climbing'", "--import")


def test_a_configuration_of_a_run_that_someone_broke(fails, run):
    (run / "config.yaml").write_text("env: {num_robots: 3}\n")
    for main, flag in LOADING[1:]:
        fails(main, task(flag), "config.yaml", "num_robots", "did you mean 'num_envs'?")


def test_a_training_that_is_finished_already(fails, run):
    err = fails(train.main, task("--resume", "--max_iterations", "1", *HIDDEN), "model_0.pt", "finished 1 iterations of 1")
    assert "--max-iterations" in err


# ---- files and grids -------------------------------------------------------------------------------------------------


def test_a_file_where_the_log_folder_should_be(fails, tmp_path):
    (tmp_path / "logs").write_text("mine\n")
    fails(train.main, task(), "logs", "cannot make the folder")
    assert (tmp_path / "logs").read_text() == "mine\n"


@pytest.mark.slow
@pytest.mark.parametrize("spec", ["a:b:c", "1:0:0.1", "0:1", "0:1:0", "0:1:-1", "", "0:1:2:3", "nan", "0:inf:1", "0:1:nan"])
def test_a_grid_that_is_none(fails, run, spec):
    fails(grid.main, task(f"--vx={spec}"), "--vx", f"'{spec}'", "low:high:step")


def test_a_number_of_robots_a_cell_that_cannot_be(fails, run):
    fails(grid.main, task("--robots", "0"), "--robots", "at least 1")


# ---- a user's own code -----------------------------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def forgotten():
    """Modules and tasks of users are forgotten after a test."""
    registered, path = dict(legged.registry._REGISTERED), list(sys.path)
    yield
    legged.registry._REGISTERED.clear()
    legged.registry._REGISTERED.update(registered)
    sys.path[:] = path
    for name in ("mine", "my_tasks"):
        sys.modules.pop(name, None)


MISTAKES = {
    "reads on the host": (
        "def _reward_mine(self): return self.base_pos[:, 2] * float(self.base_pos[0, 2])",
        "_reward_mine: reads a value on the host",
    ),
    "fails": (
        "def _reward_mine(self): return self.no_such_thing",
        "_reward_mine: 'Mine' object has no attribute 'no_such_thing'",
    ),
    "wrong shape": ("def _reward_mine(self): return self.base_pos", "_reward_mine: must return a tensor (4,), got (4, 3)"),
    "constructor fails": (
        "def __init__(self, *args, **kwargs): self.nothing_of_that",
        "AttributeError: 'Mine' object has no attribute 'nothing_of_that'",
    ),
    "constructor calls nobody": (
        "def __init__(self, *args, **kwargs): pass",
        "mine.Mine: its constructor must call super().__init__ with its arguments",
    ),
}
FOUND_LATER = {"wrong shape", "constructor calls nobody"}
"""Mistakes that show when the line has been left."""


@pytest.mark.slow
@pytest.mark.parametrize("kind", MISTAKES)
def test_a_mistake_in_a_user_s_class_is_one_line_with_file_and_line(capsys, tmp_path, kind):
    method, words = MISTAKES[kind]
    scales = "{'mine': 1.0}" if "_reward_mine" in method else "{}"
    (tmp_path / "mine.py").write_text(
        "from legged import LeggedRobot, register\n"
        "class Mine(LeggedRobot):\n"
        f"    {method}\n"
        f"register('mine', {{'extends': '{TASK}', 'rewards': {{'scales': {scales}}}}}, Mine)\n"
    )
    code = call(train.main, ["mine", "--import", "mine.py", "--sim_device", "cpu", "--num_envs", "4"])
    err = capsys.readouterr().err
    assert (code, err.count("\n")) == (2, 1), err
    assert err.startswith(f"error: {words}")
    assert (f"({tmp_path / 'mine.py'}, line 3)" in err) == (kind not in FOUND_LATER)
    assert not Path("logs").exists()


def test_a_second_import_does_not_take_the_place_of_the_first(fails):
    words = ("--import: is given twice, slip.py and feel.py", "write --import slip.py,feel.py")
    fails(train.main, [TASK, "--import", "slip.py", "--import", "feel.py"], *words)
