"""Numbers written for one robot and rescaled for another: units, fields, terms, and numbers that are never rescaled."""

import pytest
import yaml

from legged.config.legged import LeggedConfig
from legged.config.rescale import rescale
from legged.config.units import exponents, factor, is_unit
from legged.envs.half_cheetah import HalfCheetah
from legged.envs.humanoid import Humanoid
from legged.envs.legged_robot import LeggedRobot
from legged.envs.marks import unit, unit_of
from legged.errors import ConfigError
from legged.registry import register, task_config

BY_HAND = [
    ("m", (0, 1, 0)),
    ("kg", (1, 0, 0)),
    ("m^2/s^2", (0, 2, -2)),
    ("rad^2/s^4", (0, 0, -4)),
    ("N m", (1, 2, -2)),
    ("N^2 m^2", (2, 4, -4)),
    ("m/s, m/s, rad/s", (0, 1, -1)),
    ("(m/s)^2", (0, 2, -2)),
    ("N/(kg m)", (0, 0, -2)),
    ("m s^-1", (0, 1, -1)),
    ("m²·s⁻²", (0, 2, -2)),
    ("N*m", (1, 2, -2)),
    ("Nm", (1, 2, -2)),
    ("N**2 m**2", (2, 4, -4)),
    ("1/s", (0, 0, -1)),
    ("1", (0, 0, 0)),
    ("0 to 1", (0, 0, 0)),
    ("(m", (0, 0, 0)),
    ("m)", (0, 0, 0)),
    ("m^", (0, 0, 0)),
    ("m apart", (0, 0, 0)),
    ("", (0, 0, 0)),
]


@pytest.mark.parametrize(("unit", "expected"), BY_HAND)
def test_exponents_of_mass_length_and_time(unit, expected):
    assert exponents(unit) == expected


def test_a_robot_twice_as_high_and_eight_times_as_heavy():
    """Speeds grow by sqrt(2), torques by 8 * 2, times by sqrt(2), all with gravity as it is."""
    scale = {"kg": 8.0, "m": 2.0, "s": 2.0**0.5}
    assert factor("m/s", scale) == pytest.approx(2.0**0.5)
    assert factor("N m", scale) == pytest.approx(16.0)
    assert factor("m/s^2", scale) == pytest.approx(1.0)
    assert factor("rad", scale) == 1.0


def test_what_is_a_unit():
    assert all(is_unit(text) for text in ("m", "N^2 m^2", "m/s, m/s, rad/s", "m, 1, rad", "1", "(m/s)^2", "m²·s⁻²"))
    assert not any(is_unit(text) for text in ("", "metres", "0 to 1", "(m", "m)", "m^", "m,", "m apart"))


def test_fields_grow_by_their_unit_and_scales_of_terms_against_it():
    data = {
        "rewards": {"base_height_target": 0.5, "tracking_sigma": 0.25, "scales": {"torques": -1e-5, "collision": -1.0}},
        "domain_rand": {"added_mass_range": [-5.0, 5.0]},
        "terrain": {"proportions": {"flat": 1.0}, "measured_points_x": [-0.1, 0.1]},
        "observations": {"scales": {"heights": 5.0}, "noise": {"heights": 0.1}},
    }
    units = {"_reward_torques": "N^2 m^2", "_reward_collision": "1", "_obs_heights": "m"}
    grown = rescale(data, LeggedConfig, lambda unit: factor(unit, {"kg": 0.5, "m": 0.25, "s": 0.5}), units.__getitem__)
    assert grown == {
        "rewards": {"base_height_target": 0.125, "tracking_sigma": 0.25, "scales": {"torques": -0.00064, "collision": -1.0}},
        "domain_rand": {"added_mass_range": [-2.5, 2.5]},
        "terrain": {"proportions": {"flat": 1.0}, "measured_points_x": [-0.025, 0.025]},
        "observations": {"scales": {"heights": 20.0}, "noise": {"heights": 0.025}},
    }


@pytest.mark.parametrize("kind", [LeggedRobot, HalfCheetah, Humanoid])
def test_every_reward_and_observation_declares_its_unit(kind):
    for prefix in ("_reward_", "_obs_"):
        for name in kind.terms(prefix):
            assert is_unit(unit_of(getattr(kind, prefix + name)) or ""), name


def test_rewards_whose_unit_is_one():
    """A reward that measures something physical must have its number rescaled, and these do not."""
    counted = {name for name in LeggedRobot.terms("_reward_") if unit_of(getattr(LeggedRobot, f"_reward_{name}")) == "1"}
    tracking = {"tracking_lin_vel", "tracking_ang_vel"}
    counts = {"collision", "self_collision", "termination", "stumble", "no_fly"}
    assert counted == tracking | counts | {"orientation", "tilt_error", "action_rate"}


@pytest.mark.parametrize("text", ["metres", "", "m^", "[m]", 3])
def test_a_mark_with_a_wrong_unit_is_refused(text):
    with pytest.raises(
        ConfigError, match=r'^@unit\(.*\): expected powers and products of m, .* such as @unit\("m\^2/s\^2"\)'
    ):
        unit(text)


def test_docstrings_change_no_number(monkeypatch):
    """All terms have another unit in their docstring, and Go2 has the same numbers, worked by hand: torques grow by the mass
    and the height, accelerations of joints and velocities with the height.
    """
    for prefix in ("_reward_", "_obs_"):
        for name in LeggedRobot.terms(prefix):
            monkeypatch.setattr(getattr(LeggedRobot, prefix + name), "__doc__", "Something else [kg^3 m^5].")
    cfg = task_config("go2_flat")
    mass, height = 15.019 / 52.13485, 0.3235036 / 0.5488202
    assert cfg.rewards.scales["torques"] == pytest.approx(-1.0e-5 / (mass * height) ** 2, rel=1e-4)
    assert cfg.rewards.scales["dof_acc"] == pytest.approx(-2.5e-7 * height**2, rel=1e-4)
    assert cfg.rewards.scales["lin_vel_z"] == pytest.approx(-2.0 / height, rel=1e-4)
    assert cfg.rewards.scales["base_height"] == pytest.approx(-57.6, abs=0.05)
    assert cfg.rewards.scales["tracking_lin_vel"] == 2.0
    assert cfg.rewards.base_height_target == pytest.approx(0.5 * height, rel=1e-4)


SLIP = {"rewards": {"scales": {"slip": -0.1}}}
FOR_GO2 = {"written_for": "anymal_c", "extends": "anymal_c_flat", "robot": "go2"}


class Bare(LeggedRobot):
    def _reward_slip(self):
        """Squared speed of feet [m^2/s^2]."""
        return self.feet_vel.square().sum(dim=(1, 2))


class Marked(LeggedRobot):
    @unit("m^2/s^2")
    def _reward_slip(self):
        return self.feet_vel.square().sum(dim=(1, 2))


class Overridden(LeggedRobot):
    def _reward_torques(self):
        return self.torques.abs().sum(dim=1)


def test_a_user_defined_reward_is_rescaled_by_its_mark():
    register("rescale_marked", {**FOR_GO2, **SLIP}, Marked)
    speed = 0.3235036 / 0.5488202  # squared
    assert task_config("rescale_marked").rewards.scales["slip"] == pytest.approx(-0.1 / speed, rel=1e-4)


@pytest.mark.parametrize(
    ("kind", "config", "message"),
    [
        (Bare, {**FOR_GO2, **SLIP}, r'rewards\.scales\.slip: .* Bare\._reward_slip declares no unit\..*@unit\("m\^2/s\^2"\)'),
        (
            Overridden,
            {"extends": "go2_flat"},
            r'rewards\.scales\.torques: .* Overridden\._reward_torques declares no unit\..*@unit\("N\^2 m\^2"\)',
        ),
    ],
)
def test_a_rescaled_term_without_a_unit_is_refused(kind, config, message):
    """With a unit in its docstring, too, for that is not read; and where it overrides a term with a unit."""
    register("rescale_bare", config, kind)
    with pytest.raises(ConfigError, match=message):
        task_config("rescale_bare")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "config"),
    [
        (Bare, {"extends": "go2_flat", **SLIP}),
        (Bare, {**FOR_GO2, "robot": "anymal_c", **SLIP}),
        (Bare, {**FOR_GO2, "rewards": {"scales": {"slip": 0.0}}}),
        (Overridden, {"extends": "go2_flat", "rewards": {"scales": {"torques": -0.1}}}),
        (Overridden, {"extends": "go2_flat", "rewards": {"scales": {"torques": 0.0}}}),
        (Overridden, {"extends": "anymal_c_flat"}),
    ],
)
def test_a_term_whose_number_is_not_rescaled_needs_no_unit(kind, config):
    register("rescale_none", config, kind)
    scales = config.get("rewards", {}).get("scales", {"torques": -1e-5})
    assert scales.items() <= task_config("rescale_none").rewards.scales.items()


@pytest.fixture
def tasks(tmp_path):
    def add(name, text):
        path = tmp_path / f"{name}.yaml"
        path.write_text(yaml.safe_dump(text))
        register(name, path)
        return path

    return add


def test_the_robot_it_was_written_for_has_the_numbers_as_they_are(tasks):
    tasks("rescale_same", {"written_for": "anymal_c", "robot": "anymal_c", "rewards": {"base_height_target": 0.123456789}})
    assert task_config("rescale_same").rewards.base_height_target == 0.123456789


def test_what_is_set_over_it_is_taken_as_it_stands(tasks):
    """By a file that extends it, by another one of its own kind, and by the command line."""
    parent = {"written_for": "anymal_c", "rewards": {"base_height_target": 0.5, "max_contact_force": 350.0}}
    tasks("rescale_parent", {**parent, "domain_rand": {"max_push_vel_xy": 1.0}, "cpu": {"terrain": {"spawn_range": 2.0}}})
    tasks("rescale_child", {"extends": "rescale_parent", "robot": "go2", "rewards": {"max_contact_force": 99.0}})
    cfg = task_config("rescale_child", [("domain_rand.max_push_vel_xy", 0.25)], on_cpu=True)
    height = 0.3235036 / 0.5488202  # of the two bases above their feet, in their default poses
    assert cfg.rewards.base_height_target == pytest.approx(0.5 * height, rel=1e-5)
    assert cfg.terrain.spawn_range == pytest.approx(2.0 * height, rel=1e-5)
    assert cfg.rewards.max_contact_force == 99.0
    assert cfg.domain_rand.max_push_vel_xy == 0.25
    assert "rescale_parent.yaml (written for anymal_c)" in cfg.origins.of("rewards.base_height_target")
    assert "rescale_child.yaml" in cfg.origins.of("rewards.max_contact_force")


def test_the_robot_of_the_command_line_counts(tasks):
    tasks("rescale_robot", {"written_for": "anymal_c", "robot": "anymal_c", "rewards": {"max_contact_force": 350.0}})
    cfg = task_config("rescale_robot", [("robot", "go2")])
    assert cfg.rewards.max_contact_force == pytest.approx(350.0 * 15.019 / 52.13485, rel=1e-4)


def test_sizes_of_tiles_and_ranges_of_properties_grow_by_the_unit_of_each(tasks):
    """Heights of steps and added masses do, angles of slopes and factors do not."""
    ranges = {"added_base_mass": [-1.0, 2.0], "link_mass": [0.9, 1.1], "joint_friction": [0.0, 0.5]}
    sizes = {"step": 0.15, "stairs_up": [0.1, 0.2], "slope_up": 20.0}
    tasks("rescale_entries", {"written_for": "anymal_c", "domain_rand": {"ranges": ranges}, "terrain": {"sizes": sizes}})
    tasks("rescale_entries_go2", {"extends": "rescale_entries", "robot": "go2"})
    cfg = task_config("rescale_entries_go2")
    mass, height = 15.019 / 52.13485, 0.3235036 / 0.5488202
    stairs = pytest.approx((0.1 * height, 0.2 * height), rel=1e-4)
    assert cfg.terrain.sizes == {"step": pytest.approx(0.15 * height, rel=1e-4), "stairs_up": stairs, "slope_up": 20.0}
    assert cfg.domain_rand.ranges["added_base_mass"] == pytest.approx((-mass, 2.0 * mass), rel=1e-4)
    assert cfg.domain_rand.ranges["link_mass"] == (0.9, 1.1)
    assert cfg.domain_rand.ranges["joint_friction"] == pytest.approx((0.0, 0.5 * mass * height), rel=1e-4)


@pytest.mark.parametrize("robot", [3, [1], {"a": 1}])
def test_a_robot_of_the_command_line_that_is_no_name(robot):
    with pytest.raises(ConfigError, match=r"^command line: robot: expected text, got "):
        task_config("go2_flat", [("robot", robot)])


@pytest.mark.parametrize(
    ("written_for", "message"),
    [
        ("anymal_z", "written_for: there is no robot 'anymal_z'; did you mean 'anymal_"),
        (3, "written_for: expected the name"),
    ],
)
def test_a_robot_that_is_none(tasks, written_for, message):
    tasks("rescale_wrong", {"written_for": written_for, "robot": "go2"})
    with pytest.raises(ConfigError) as error:
        task_config("rescale_wrong")
    assert message in str(error.value)
    assert "rescale_wrong.yaml" in str(error.value)


@pytest.mark.parametrize("wrong", ["writen_for", "extend", "clas", "cpus"])
def test_a_key_of_files_that_is_misspelt_has_its_nearest_name(tasks, wrong):
    right = {"writen_for": "written_for", "extend": "extends", "clas": "class", "cpus": "cpu"}[wrong]
    tasks("rescale_misspelt", {"robot": "go2", wrong: "anymal_c"})
    with pytest.raises(ConfigError, match=f"rescale_misspelt.yaml: {wrong}: unknown key '{wrong}'; did you mean '{right}'"):
        task_config("rescale_misspelt")


def test_a_task_without_a_robot_has_no_robot_to_rescale_for(tasks):
    tasks("rescale_none", {"extends": "half_cheetah", "written_for": "anymal_c"})
    with pytest.raises(ConfigError, match="written_for: a task of HalfCheetah has no robot"):
        task_config("rescale_none")
