"""legged_gym's configurations become tasks that load and step, and what has no counterpart is listed with file and line."""

import re
from pathlib import Path

import pytest
from forks import ANYMAL_FLAT, BASE, FLAT, GO2, MIXINS, OUR_BASE, REGISTERED, TWO, built, line_of, written
from helpers import call

from legged.cli.migrate import migrate
from legged.cli.train import train
from legged.config import from_dict
from legged.config.legged import STATE_TERMS
from legged.config.yaml_files import read_yaml
from legged.robots.robot import load_robot

pytestmark = pytest.mark.usefixtures("workplace", "own_registry")

# ---- configurations in the style of forks --------------------------------------------------------------------------------


def test_a_plain_configuration_has_what_differs_only(migrated):
    """legged_gym's own numbers but for names of the robot: forces of 100 N and heights of 1 m are its defaults."""
    result = migrated(BASE + FLAT)
    assert result.data == {
        "robot": "robots/plain",
        "domain_rand": {"friction_range": [0.75, 1.125]},
        "rewards": {"base_height_target": 1.0, "max_contact_force": 100.0},
    }
    assert result.path.name == "plain.yaml"
    assert result.lost == []
    task = built(result)
    assert task.robot.folder == Path("robots/plain").resolve()
    assert (task.robot.file.spawn_height, task.robot.mass) == (1.0, load_robot("anymal_c").mass)
    # Nothing is penalised and nothing ends an episode, as in legged_gym's base configuration.
    assert (task.robot.penalised_indices, task.robot.termination_indices) == ((), ())
    assert task.robot.feet_indices == load_robot("anymal_c").feet_indices


def test_legged_gyms_flat_anymal(migrated):
    """Friction of 0 to 1.5, averaged with a ground of 1, is 0.5 to 1.25: the default here. A task of that name is here."""
    result = migrated(ANYMAL_FLAT)
    assert result.path.name == "anymal_c_flat.yaml".replace("anymal", "my_anymal")
    assert result.data == {
        "robot": "anymal_c",
        "commands": {"resampling_time_s": 4.0, "heading_command": False, "ranges": {"ang_vel_yaw": [-1.5, 1.5]}},
        "sim": {"self_collisions": True},
        "domain_rand": {"randomize_base_mass": True},
        "rewards": {
            "max_contact_force": 350.0,
            "scales": {"torques": -2.5e-5, "feet_air_time": 2.0, "orientation": -5.0},
        },
        "train": {
            "policy": {"actor_hidden_dims": [128, 64, 32], "critic_hidden_dims": [128, 64, 32]},
            "runner": {"max_iterations": 300, "experiment_name": "flat_anymal_c"},
        },
    }
    (lost,) = result.lost
    assert lost.startswith(
        "legged_gym's AnymalCRoughCfg: control.use_actuator_network = True: legged_gym's network file is not read"
    )
    task = built(result)
    assert task.control.stiffness.tolist() == [90.0] * 12  # the robot's own stand for the network


@pytest.mark.slow
def test_legged_gyms_rough_anymal(migrated):
    text = "from legged_gym.envs import AnymalCRoughCfg\nclass MineCfg(AnymalCRoughCfg):\n    pass\n"
    result = migrated(text)
    terms = [*STATE_TERMS, "heights"]
    assert result.data["terrain"]["proportions"] == {
        "slope_up": 0.05,
        "slope_down": 0.05,
        "rough_slope_down": 0.1,
        "stairs_up": 0.35,
        "stairs_down": 0.25,
        "obstacles": 0.2,
    }
    assert result.data["observations"] == {"groups": {"actor": {"terms": terms}, "critic": {"terms": terms}}}
    task = built(result)
    assert task.num_obs == 235


@pytest.mark.slow
def test_a_fork_with_history_computed_values_and_rewards_of_its_own(migrated):
    result = migrated(GO2, "--robot", "anymal_c")
    data = result.data
    assert data["observations"]["groups"] == {
        "actor": {"terms": list(STATE_TERMS[1:]), "history": 6},
        "critic": {"terms": [*STATE_TERMS, "heights"]},
    }
    assert data["control"] == {
        "stiffness": {"H": 40.0, "KFE": 80.0},
        "damping": {"HAA": 1.0, "HFE": 1.0, "KFE": 1.0},
        "action_scale": 0.25,
    }
    assert data["commands"]["curriculum"] == {"enabled": True, "start": 0.5}
    assert data["commands"]["ranges"]["lin_vel_x"] == [-2.0, 2.0]
    assert "ang_vel_yaw" not in data["commands"]["ranges"]  # the fork does not use it in heading mode
    assert data["domain_rand"] == {
        "ranges": {
            "link_mass": [0.9, 1.1],
            "motor_strength": [0.8, 1.2],
            "base_com_x": [-0.05, 0.05],
            "base_com_y": [-0.05, 0.05],
            "base_com_z": [-0.05, 0.05],
        },
        "friction_range": [0.75, 1.125],
        "randomize_base_mass": True,
        "added_mass_range": [-1, 2],
    }
    # A section that extends nothing has only what it names.
    assert data["rewards"]["scales"] == {"torques": 0.0, "feet_air_time": 0.0, "collision": 0.0, "stumble": -0.1}
    assert data["custom"] == {"clearance_height_target": -0.2}
    assert data["train"]["policy"] == {
        "actor_hidden_dims": [256, 256, 256],
        "critic_hidden_dims": [256, 256, 256],
        "init_noise_std": 0.8,
        "rnn_type": "lstm",
        "rnn_hidden_dim": 64,
    }
    lost = {}
    for line in result.lost:
        place, setting = re.match(r"(\S+): ([\w.]+)", line).groups()
        lost[setting] = (place, line)
    assert set(lost) == {
        "init_state.default_joint_angles",
        "control.stiffness",
        "asset.penalize_contacts_on",
        "commands.ranges.ang_vel_yaw",
        "runner_class_name",
    }
    assert sorted(result.plain) == ["commands.ranges.body_pitch", "control.hip_reduction", "env.num_one_step"]
    for setting, (place, line) in lost.items():
        assert place == f"fork_config.py:{line_of(GO2, setting.rpartition('.')[2] + ' = ')}", line
    where = f"fork_config.py:{line_of(GO2, 'joint_power = ')}"
    assert f"paste: _reward_joint_power ({where}), then set rewards.scales.joint_power: -2e-05\n" in result.out
    assert "'tail' is part of no body or shape" in lost["asset.penalize_contacts_on"][1]
    assert "'wheel' is part of no joint" in lost["control.stiffness"][1]
    assert "torso_joint" in lost["init_state.default_joint_angles"][1]
    task = built(result, ("train.algorithm.num_mini_batches", 1))
    assert task.num_obs == 270
    angles = dict(zip(task.dof_names, task.default_dof_pos.tolist(), strict=True))
    assert angles["LF_HAA"] == pytest.approx(0.1)
    assert (angles["LF_HFE"], angles["LH_HFE"]) == pytest.approx((0.5, -0.5))
    assert angles["LF_KFE"] == pytest.approx(-0.8)  # theirs says nothing of it: the robot's own
    gains = dict(zip(task.dof_names, task.p_gains.tolist(), strict=True))
    assert (gains["LF_HAA"], gains["LF_KFE"]) == (40.0, 80.0)
    assert [task.robot.contact_names[i] for i in task.robot.penalised_indices] == [
        name for name in task.robot.contact_names if "THIGH" in name
    ]


@pytest.mark.slow
def test_mixins_and_a_base_of_the_forks_own(migrated, refused):
    written(OUR_BASE, "pkg/base_config.py")
    assert "pkg/mixed.py has several configurations; name one (--task: " in refused(written(MIXINS, "pkg/mixed.py"))
    assert "did you mean 'MixedCfg'?" in refused("pkg/mixed.py", "--task", "MixdCfg")
    result = migrated(MIXINS, "--task", "MixedCfg", "--out", "tasks", path="pkg/mixed.py")
    assert result.path == Path("tasks/mixed.yaml")
    assert result.data["env"] == {"num_envs": 1024, "episode_length_s": 10}
    assert (result.data["commands"]["resampling_time_s"], result.data["commands"]["heading_command"]) == (4.0, False)
    terrain = result.data["terrain"]
    assert (terrain["num_rows"], terrain["num_cols"], terrain["max_init_terrain_level"]) == (4, 10, 3)
    # The two halves of 0.1 / 0.9 have no column of ten each, and become one; what comes after legged_gym's types is left out.
    shares = terrain["proportions"]
    assert set(shares) in ({"slope_up", "obstacles", "stepping_stones", "gap", "pit"}, {"slope_down", *list(shares)[1:]})
    assert sum(shares.values()) == pytest.approx(1.0)
    assert shares["obstacles"] == pytest.approx(0.5 / 0.9, abs=2e-4)
    assert any("unknown here, or too large for the tiles: entry 9, entry 10" in line for line in result.lost)
    task = built(result, ("terrain.border_size", 5.0))
    assert task.robot.file.spawn_height == 0.7


def test_a_task_may_be_asked_for_by_the_name_that_it_is_registered_by(migrated, refused, capsys):
    written(REGISTERED, "fork/envs/__init__.py")
    result = migrated(TWO, "--task", "b_walks", path="fork/envs/mine/config.py")
    assert (result.path.name, result.data["sim"], result.data["env"]["seed"]) == ("b_walks.yaml", {"dt": 0.002}, 5)
    assert call(migrate.main, ["fork/envs/__init__.py", "--task", "a_walks", "--run"]) == 0
    capsys.readouterr()
    assert "sim" not in read_yaml(Path("a_walks.yaml"))
    assert "choose a registered task: --task (tasks: a_walks, b_walks)" in refused("fork/envs/__init__.py")
    assert "(--task: ACfg, BCfg, a_walks, b_walks)" in refused("fork/envs/mine/config.py")


def test_the_only_configuration_may_be_given_another_name(migrated):
    assert migrated(BASE + FLAT, "--task", "walker").path.name == "walker.yaml"


# ---- the command ---------------------------------------------------------------------------------------------------------


def test_the_file_that_is_written_shows(migrated, capsys):
    result = migrated(ANYMAL_FLAT)
    assert "legged train my_anymal_c_flat.yaml --show\n" in result.out
    assert call(train.main, [str(result.path), "--sim-device", "cpu", "--show"]) == 0
    shown = capsys.readouterr().out
    assert from_dict(read_yaml(Path(written(shown, "shown.yaml")))).commands.resampling_time_s == 4.0


def test_files_are_not_written_over_unless_asked_to(migrated, refused):
    migrated(BASE + FLAT)
    before = Path("plain.yaml").read_text()
    Path("plain.yaml").write_text("mine")
    assert "--out: plain.yaml exists already; --force writes over it" in refused("fork_config.py")
    assert Path("plain.yaml").read_text() == "mine"
    migrated(BASE + FLAT, "--force")
    assert Path("plain.yaml").read_text() == before


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("class A(:\n", "fork_config.py:1: the file does not run: SyntaxError"),
        ("x = 1\n", "fork_config.py: has no configuration of an environment"),
        (BASE + "class P(LeggedRobotCfgPPO):\n    pass\n", "has no configuration of an environment"),
    ],
)
def test_a_file_without_a_configuration_is_refused(refused, text, words):
    assert words in refused(written(text))
    assert "there is no file 'nowhere.py'" in refused("nowhere.py")


def test_other_mistakes_of_the_command_line(refused):
    written(BASE + FLAT)
    assert "--robot: there is no robot 'anymal'; did you mean 'anymal_" in refused("fork_config.py", "--robot", "anymal")
    assert "--task: the name of a task must be a plain name" in refused("fork_config.py", "--task", "a/b")
    assert not Path("plain.yaml").exists()
