"""Single settings of legged_gym and of its robots: where they go, and what has no place here."""

import random
from pathlib import Path

import pytest
from forks import ANYMAL_FLAT, BASE, FLAT, GO2, built, line_of, sections

from legged.config import from_dict
from legged.config.loader import to_dict
from legged.config.schema import LeggedConfig
from legged.config.yaml_files import parse
from legged.envs import LeggedRobot
from legged.migration.found import Found, Place
from legged.migration.legged_gym_defaults import ENVIRONMENT, LEARNING
from legged.migration.mapping import map_settings
from legged.migration.robot_entries import map_robot
from legged.migration.settings import SAME_REWARDS
from legged.migration.writer import robot_yaml, task_yaml
from legged.robots.robot import load_robot

pytestmark = pytest.mark.usefixtures("workplace", "own_registry")

# ---- single settings -----------------------------------------------------------------------------------------------------


SETTINGS = [
    ("env", "num_envs = 64", "env.num_envs", 64),
    ("commands", "resampling_time = 5.", "commands.resampling_time_s", 5.0),
    ("control", "control_type = 'T'", "control.control_type", "T"),
    ("control", "decimation = 2", "control.decimation", 2),
    ("domain_rand", "push_robots = False", "domain_rand.push_robots", False),
    ("domain_rand", "randomize_friction = False", "domain_rand.randomize_friction", False),
    ("rewards", "only_positive_rewards = False", "rewards.only_positive_rewards", False),
    ("rewards", "soft_dof_pos_limit = 0.9", "rewards.soft_dof_pos_limit", 0.9),
    ("normalization", "clip_actions = 6.", "control.clip_actions", 6.0),
    ("normalization", "clip_observations = 18.", "observations.clip", 18.0),
    ("noise", "noise_level = 0.5", "observations.noise_level", 0.5),
    ("noise", "add_noise = False", "observations.add_noise", False),
    ("sim", "dt = 0.002", "sim.dt", 0.002),
]


@pytest.mark.parametrize(("section", "line", "path", "value"), SETTINGS, ids=[setting[2] for setting in SETTINGS])
def test_a_setting_goes_where_it_means_the_same(migrated, section, line, path, value):
    found = migrated(sections(**{section: line}))
    data = found.data
    for key in path.split("."):
        data = data[key]
    assert data == value
    assert found.lost == []


def test_a_reward_of_the_forks_own_is_not_taken_for_ours_of_that_name(migrated):
    """legged_gym has no feet_clearance: it is set, and said."""
    found = migrated(
        sections(rewards="class scales(LeggedRobotCfg.rewards.scales):\n    feet_clearance = -2.0\n    stumble = -1.0")
    )
    assert found.data["rewards"]["scales"]["feet_clearance"] == -2.0
    (line,) = found.lost
    assert "rewards.scales.feet_clearance = -2.0: is the reward of that name here" in line
    assert "_reward_feet_clearance" in line


def test_rewards_of_legged_gym_are_all_here():
    assert LeggedRobot.terms("_reward_") >= SAME_REWARDS


NESTED = [
    (
        "noise",
        "class noise_scales(LeggedRobotCfg.noise.noise_scales):\n    gravity = 0.1",
        "noise",
        {"projected_gravity": 0.1},
    ),
    (
        "normalization",
        "class obs_scales(LeggedRobotCfg.normalization.obs_scales):\n    lin_vel = 1.0",
        "scales",
        {"base_lin_vel": 1.0},
    ),
]


@pytest.mark.parametrize(("section", "lines", "name", "value"), NESTED, ids=["noise", "scales"])
def test_scales_of_observations_go_by_our_names(migrated, section, lines, name, value):
    assert migrated(sections(**{section: lines})).data["observations"] == {name: value}


LOST = [
    ("sim", "substeps = 2", "sim.substeps = 2: sim.dt is the step of the physics"),
    ("asset", "fix_base_link = True", "asset.fix_base_link = True: the base of a legged robot floats here"),
    ("viewer", "pos = [1, 2, 3]", "viewer.pos = [1, 2, 3]: play.py"),
    ("commands", "num_commands = 7", "commands.num_commands = 7: commands here are"),
    (
        "control",
        "action_scale = -1.",
        "control.action_scale = -1.0: control.action_scale takes no such value: must be above 0",
    ),
    ("control", "decimation = undefined", "control.decimation: uses undefined, which is set nowhere"),
    ("rewards", "max_contact_force = 'x'", "rewards.max_contact_force = 'x': rewards.max_contact_force takes no such value"),
    ("env", "num_observations = 50", "env.num_observations = 50: base_lin_vel, base_ang_vel, projected_gravity"),
    ("init_state", "rot = [0., 0., 1., 0.]", "init_state.rot = [0.0, 0.0, 1.0, 0.0]: robots start level"),
    ("domain_rand", "delay = True", "domain_rand.delay = True: domain_rand.ranges draws of the model"),
    ("noise", "noise_levl = 2.", "noise.noise_levl = 2.0: no setting here has that meaning; the nearest name is"),
]


@pytest.mark.parametrize(("section", "line", "words"), LOST, ids=[entry[1] for entry in LOST])
def test_what_has_no_counterpart_is_listed_by_file_and_line(migrated, section, line, words):
    text = sections(**{section: line})
    result = migrated(text)
    (lost,) = result.lost
    assert lost.startswith(f"fork_config.py:{line_of(text, line)}: {words}")
    assert words[:30] in " ".join(part.removeprefix("#").strip() for part in result.text.splitlines())
    built(result)


RANGES = "motor_strength_range = [0.8, 1.2]"


@pytest.mark.parametrize(
    ("lines", "lost", "ranges"),
    [
        (f"randomize_motor_strength = True\n{RANGES}", [], {"motor_strength": [0.8, 1.2]}),
        (f"randomize_motor_strength = False\n{RANGES}", [], None),
        (f"randomize_motor = True\n{RANGES}", ["randomize_motor = True", RANGES], None),
        (RANGES, [RANGES], None),
        ("randomize_kp = True", ["randomize_kp = True"], None),
        ("randomize_kp = True\nkp_range = [0.9]", ["randomize_kp = True", "kp_range = [0.9]"], None),
        ("randomize_gains = True\nstiffness_multiplier_range = [0.9, 1.1]", [], {"p_gain": [0.9, 1.1]}),
    ],
)
def test_what_a_fork_draws_of_the_model_is_mapped_or_listed_or_off(migrated, lines, lost, ranges):
    """A range whose switch has another name than the known one was neither in the task nor in the list."""
    result = migrated(sections(domain_rand=lines))
    assert [line.split(": ")[1] for line in result.lost] == [f"domain_rand.{line}" for line in lost]
    assert result.data.get("domain_rand", {}).get("ranges") == ranges


def test_legged_gyms_own_settings_that_mean_nothing_here_are_not_listed(migrated):
    """physx, viewer and the like are in every configuration."""
    assert migrated(BASE + FLAT).lost == []


# ---- robots --------------------------------------------------------------------------------------------------------------


def test_a_robot_that_is_not_here_is_said_with_its_commands(migrated):
    text = GO2.replace("'FOOT'", "'foot'")
    result = migrated(text, "--out", "there")
    assert "  legged robot add resources/robots/hound/urdf/hound.urdf --name hound_of_them --out there/robots\n" in result.out
    assert "  legged migrate fork_config.py --robot there/robots/hound_of_them --out there --force\n" in result.out
    assert result.data["robot"] == "robots/hound_of_them"
    assert result.data["control"]["stiffness"] == {"H": 40.0, "KFE": 80.0, "wheel": 1.0}
    assert "#   feet: [foot]" in result.text
    assert "#   spawn_height: 0.62" in result.text
    assert not Path("there/robots").exists()


def test_a_robot_folder_of_the_users_is_taken_where_it_lies(migrated):
    robot = load_robot("anymal_c")
    folder = Path("elsewhere/spotty")
    folder.mkdir(parents=True)
    text = (robot.folder / "robot.yaml").read_text().replace("model: anymal_c.xml", f"model: {robot.model_path}")
    (folder / "robot.yaml").write_text(text)
    result = migrated(ANYMAL_FLAT, "--robot", "elsewhere/spotty")
    assert result.data["robot"] == str(folder.resolve())
    built(result)


def test_gains_of_which_the_last_pattern_counts_are_given_by_joint(migrated):
    """legged_gym takes the last pattern that is part of a name, a table here the longest."""
    text = sections(control="stiffness = {'LF_KFE': 10., 'KFE': 20., 'H': 30.}\ndamping = {'H': 1., 'KFE': 1.}")
    result = migrated(text)
    stiffness = result.data["control"]["stiffness"]
    assert stiffness["LF_KFE"] == 20.0
    assert stiffness["LF_HAA"] == 30.0
    assert stiffness["LH_KFE"] == 30.0  # its leg is called LH


def test_joints_without_gains_have_none_and_are_listed(migrated):
    result = migrated(sections(control="stiffness = {'HAA': 30., 'HFE': 30.}\ndamping = {'H': 1., 'KFE': 1.}"))
    assert result.data["control"]["stiffness"]["LF_KFE"] == 0.0
    (lost,) = result.lost
    assert "says nothing of LF_KFE, RF_KFE, LH_KFE, RH_KFE; legged_gym gives such joints none" in lost


def test_what_is_known_of_legged_gym_is_complete():
    """Every setting of its base configuration goes somewhere: its defaults and ours, a task of both, are one task."""
    assert set(ENVIRONMENT) >= {"env", "terrain", "commands", "init_state", "control", "asset", "domain_rand", "rewards"}
    ours = to_dict(LeggedConfig())
    for name, scale in ENVIRONMENT["rewards"]["scales"].items():
        assert ours["rewards"]["scales"].get(name, 0.0) == scale
    for name in ("learning_rate", "gamma", "entropy_coef", "num_mini_batches"):
        assert ours["train"]["algorithm"][name] == LEARNING["algorithm"][name]
    assert ours["terrain"]["measured_points_x"] == ENVIRONMENT["terrain"]["measured_points_x"]


VALUES = [
    *(None, True, False, 0, 1, -1, 5, 1e9, -0.5, float("inf"), float("nan"), 10**400, 1j, b"x", object),
    *("", "abc", "trimesh", "plane", [], [1], [1, 2], (1, 2), [1, 2, 3], ["FOOT"], [[1]], [0.5] * 9),
    *({}, {"HAA": 3}, {"a": "b"}, {1: 2}, {"LF_HAA": 0.3}),
]


def spoiled(name: str, data: dict, draw: random.Random) -> type:
    """A configuration of which some settings are missing, unknown, or anything at all."""
    members: dict[str, object] = {}
    for key, value in data.items():
        is_section = isinstance(value, dict) and key not in ("default_joint_angles", "stiffness", "damping")
        if is_section and draw.random() < 0.97:
            members[key] = spoiled(key, value, draw)
        elif draw.random() < 0.9:
            given = draw.choice(VALUES) if draw.random() < 0.25 else value
            members[key] = Found(given, Place("x.py", 1), "nobody knows" if draw.random() < 0.02 else "")
    return type(name, (), members)


@pytest.mark.parametrize("seed", range(20))
def test_any_values_at_all_become_a_task_that_loads(robot, seed):
    draw = random.Random(seed)
    result = map_settings(spoiled("Env", ENVIRONMENT, draw), spoiled("Learner", LEARNING, draw))
    for known in (None, robot):
        robot_yaml([], map_robot(result, known))
    text = task_yaml([], result.settings, result.comments, result.lost)
    from_dict(parse(text, "the task"))
    assert all(entry.reason for entry in result.lost)
