"""Single settings of legged_gym and of its robots: where they go, and what has no place here."""

import random
from pathlib import Path

import pytest
from forks import ANYMAL_FLAT, BASE, FLAT, GO2, built, line_of, sections

from legged.config import from_dict
from legged.config.legged import LeggedConfig
from legged.config.loader import to_dict
from legged.config.yaml_files import parse
from legged.envs import LeggedRobot
from legged.migration.mapping import map_settings
from legged.migration.reading import DEFAULTS, DIGESTS, Fork, Found
from legged.migration.robot_entries import map_robot
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


@pytest.mark.slow
@pytest.mark.parametrize(("section", "line", "path", "value"), SETTINGS, ids=[setting[2] for setting in SETTINGS])
def test_a_setting_goes_where_it_means_the_same(migrated, section, line, path, value):
    found = migrated(sections(**{section: line}))
    data = found.data
    for key in path.split("."):
        data = data[key]
    assert data == value
    assert found.lost == []


def test_a_reward_that_legged_gym_does_not_have_is_not_taken_for_ours_of_that_name(migrated):
    """legged_gym has no feet_clearance, so its formula is the fork's own."""
    found = migrated(
        sections(rewards="class scales(LeggedRobotCfg.rewards.scales):\n    feet_clearance = -2.0\n    stumble = -1.0")
    )
    assert "feet_clearance" not in found.data["rewards"]["scales"]
    assert found.data["rewards"]["scales"]["stumble"] == -1.0
    assert "paste: _reward_feet_clearance (fork_config.py:" in found.out


def test_rewards_of_legged_gym_are_all_here():
    assert {f"_reward_{name}" for name in LeggedRobot.terms("_reward_")} >= {n for n in DIGESTS if n.startswith("_reward_")}


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
    ("commands", "num_commands = 7", "commands.num_commands = 7: commands here are"),
    (
        "control",
        "action_scale = -1.",
        "control.action_scale = -1.0: control.action_scale refuses this value: must be above 0",
    ),
    ("rewards", "max_contact_force = 'x'", "rewards.max_contact_force = 'x': rewards.max_contact_force refuses this value"),
    ("init_state", "rot = [0., 0., 1., 0.]", "init_state.rot = [0.0, 0.0, 1.0, 0.0]: robots start level"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("section", "line", "words"), LOST, ids=[entry[1] for entry in LOST])
def test_what_has_no_counterpart_is_listed_by_file_and_line(migrated, section, line, words):
    text = sections(**{section: line})
    result = migrated(text)
    (lost,) = result.lost
    assert lost.startswith(f"fork_config.py:{line_of(text, line)}: {words}")
    assert words[:30] in " ".join(part.removeprefix("#").strip() for part in result.text.splitlines())
    built(result)


RANGES = "motor_strength_range = [0.8, 1.2]"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lines", "lost", "ranges"),
    [
        (f"randomize_motor_strength = True\n{RANGES}", [], {"motor_strength": [0.8, 1.2]}),
        (f"randomize_motor_strength = False\n{RANGES}", [], None),
        (f"randomize_motors = True\n{RANGES}", ["randomize_motors = True", RANGES], None),
        (RANGES, [RANGES], None),
        ("randomize_kp = True", ["randomize_kp = True"], None),
        ("randomize_kp = True\nkp_range = [0.9]", ["randomize_kp = True", "kp_range = [0.9]"], None),
        ("randomize_gains = True\nstiffness_multiplier_range = [0.9, 1.1]", [], {"p_gain": [0.9, 1.1]}),
    ],
)
def test_what_a_fork_draws_of_the_model_is_mapped_or_listed_or_off(migrated, lines, lost, ranges):
    """A range whose switch has another name than the known one was neither in the task nor in the list."""
    result = migrated(sections(domain_rand=lines))
    also = [name for line in result.lost for name in line.partition("for the same reason: ")[2].split(", ") if name]
    named = [line.split(": ")[1].partition(" ")[0] for line in result.lost] + also + result.plain
    assert sorted(named) == sorted(f"domain_rand.{line.partition(' ')[0]}" for line in lost)
    assert result.data.get("domain_rand", {}).get("ranges") == ranges


def test_legged_gyms_own_settings_that_mean_nothing_here_are_not_listed(migrated):
    """physx, viewer and the like are in every configuration."""
    assert migrated(BASE + FLAT).lost == []


# ---- robots --------------------------------------------------------------------------------------------------------------


def test_a_robot_that_is_not_here_is_said_with_its_commands(migrated):
    text = GO2.replace("'FOOT'", "'foot'")
    result = migrated(text, "--out", "there")
    assert "  legged robot add resources/robots/hound/urdf/hound.urdf --name hound_of_them --out there/robots\n" in result.out
    assert "  legged migrate fork_config.py --robot there/robots/hound_of_them --out there --force --run\n" in result.out
    assert result.data["robot"] == "robots/hound_of_them"
    assert result.data["control"]["stiffness"] == {"H": 40.0, "KFE": 80.0, "wheel": 1.0}
    assert "#   feet: [foot]" in result.text
    assert "#   spawn_height: 0.62" in result.text
    assert not Path("there/robots").exists()


@pytest.mark.slow
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
    assert "has no value for LF_KFE, RF_KFE, LH_KFE, RH_KFE; legged_gym then uses 0" in lost


def test_rotor_inertias_that_the_fork_does_not_have_are_told(migrated):
    """The robot here has those of its motors; the fork's armature is 0."""
    result = migrated(BASE + FLAT, "--robot", "a1")
    assert "; its rotor inertias are 0.01 to 0.01 kg m^2, those of the fork 0\n" in result.out
    same = migrated(sections(asset="armature = 0.01"), "--robot", "a1", "--force")
    assert "rotor inertias" not in same.out


def test_what_is_known_of_legged_gym_is_complete():
    """Every setting of its base configuration goes somewhere: its defaults and ours, a task of both, are one task."""
    assert set(DEFAULTS) >= {"env", "terrain", "commands", "init_state", "control", "asset", "domain_rand", "rewards"}
    ours = to_dict(LeggedConfig())
    for name, scale in DEFAULTS["rewards"]["scales"].items():
        assert ours["rewards"]["scales"].get(name, 0.0) == scale
    for name in ("learning_rate", "gamma", "entropy_coef", "num_mini_batches"):
        assert ours["train"]["algorithm"][name] == DEFAULTS["algorithm"][name]
    assert list(ours["terrain"]["measured_points_x"]) == DEFAULTS["terrain"]["measured_points_x"]


VALUES = [
    *(None, True, False, 0, 1, -1, 5, 1e9, -0.5, float("inf"), float("nan"), 10**400),
    *("", "abc", "trimesh", "plane", [], [1], [1, 2], [1, 2, 3], ["FOOT"], [[1]], [0.5] * 9),
    *({}, {"HAA": 3}, {"a": "b"}, {"LF_HAA": 0.3}),
]


def spoiled(data: dict, draw: random.Random, prefix: str = "") -> dict[str, Found]:
    """Settings of which some are missing, unknown, or anything at all."""
    found: dict[str, Found] = {}
    for key, value in data.items():
        is_section = isinstance(value, dict) and key not in ("default_joint_angles", "stiffness", "damping")
        if is_section and draw.random() < 0.97:
            found |= spoiled(value, draw, f"{prefix}{key}.")
        elif draw.random() < 0.9:
            given = draw.choice(VALUES) if draw.random() < 0.25 else value
            found[f"{prefix}{key}"] = Found(given, "x.py:1", "it is unknown" if draw.random() < 0.02 else "")
    return found


@pytest.mark.parametrize("seed", range(20))
def test_any_values_at_all_become_a_task_that_loads(robot, seed):
    draw = random.Random(seed)
    functions = [[draw.choice([None, ["", 0], ["pit_terrain", 0], ["x_terrain", 1]])] for _ in range(5)]
    fork = Fork("any", "", spoiled(DEFAULTS, draw), {}, [None, None], draw.choice([None, functions]))
    result = map_settings(fork)
    for known in (None, robot):
        robot_yaml([], map_robot(result, known))
    text = task_yaml([], result.settings, result.comments, [str(entry) for entry in result.lost])
    from_dict(parse(text, "the task"))
