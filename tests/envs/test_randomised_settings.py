"""Who may know what is randomised, and which settings of it are refused."""

from dataclasses import replace

import pytest
import torch
from helpers import small_config, small_task

from legged.errors import ConfigError
from legged.policies.restore import nominal, undisturbed
from legged.registry import make_task, task_config

FORCES = {
    "pull": {"body": "LF_THIGH", "interval_s": [0.02, 0.06], "duration_s": [0.04, 0.1], "y": [-50.0, 50.0]},
    "lift": {"interval_s": [0.02, 0.06], "duration_s": [0.04, 0.1], "z": [0.0, 50.0]},
}


def with_ranges(**ranges):
    return ("domain_rand.ranges", ranges)


# ---- observed ------------------------------------------------------------------------------------------------------------


def observing(*terms):
    return ("observations.groups.critic.terms", ["dof_pos", *terms])


def test_what_is_drawn_can_be_observed_from_minus_one_to_one():
    ranges = {
        "friction": [0.4, 1.2],
        "joint_offset": [-0.02, 0.02],
        "p_gain": {"range": [0.5, 2.0], "distribution": "log_uniform"},
    }
    task = small_task(("domain_rand.ranges", ranges), observing("rand_friction", "rand_joint_offset", "rand_p_gain"))
    task.randomization.drawn[0, 0], task.randomization.drawn[1, 0] = 0.4, 1.0
    assert task._obs_rand_friction()[:2].flatten().tolist() == pytest.approx([-1.0, 0.5])
    assert task._obs_rand_joint_offset().shape == (4, 12)
    task.randomization.drawn[0, task.randomization.columns["p_gain"]] = 1.0
    assert task._obs_rand_p_gain()[0].item() == pytest.approx(0.0, abs=1e-6)  # the middle of the logarithms
    assert task.observation_groups["critic"].buffer.shape == (4, 12 + 1 + 12 + 1)


def test_a_nominal_robot_is_observed_by_the_ranges_of_training():
    """Where a teacher is shown nothing is drawn: friction is 1, and an offset 0, on the scale that it has learned."""
    cfg = small_config(
        with_ranges(friction=[0.0, 2.0], joint_offset=[-0.1, 0.3]),
        ("domain_rand.forces", FORCES),
        observing("rand_friction", "rand_joint_offset", "push_force"),
        ("train.algorithm.symmetry", False),
    )
    task = make_task(replace(cfg, domain_rand=cfg.domain_rand.nominal()))
    assert task.randomization.fields == {}
    assert task.physics.forces is None
    assert task._obs_rand_friction().flatten().tolist() == [0.0] * 4
    torch.testing.assert_close(task._obs_rand_joint_offset(), torch.full((4, 12), -0.5))
    assert task._obs_push_force().shape == (4, 6)
    assert not task._obs_push_force().any()


def test_friction_and_mass_that_a_flag_draws_are_observed_by_their_ranges_where_nothing_is_drawn():
    """Who measures switches the flags off: friction 1 is the middle of 0.5 to 1.5, no mass a quarter of -1 to 3 kg."""
    cfg = small_config(
        ("domain_rand.randomize_friction", True),
        ("domain_rand.friction_range", [0.5, 1.5]),
        ("domain_rand.randomize_base_mass", True),
        ("domain_rand.added_mass_range", [-1.0, 3.0]),
        observing("rand_friction", "rand_added_base_mass"),
    )
    task = make_task(nominal(cfg, undisturbed(cfg, 2, 1.0)))
    assert task._obs_rand_friction().flatten().tolist() == [0.0] * 2
    assert task._obs_rand_added_base_mass().flatten().tolist() == [-0.5] * 2


def test_forces_are_observed_as_shares_of_the_largest():
    task = small_task(("domain_rand.forces", FORCES), observing("push_force"), ("train.algorithm.symmetry", False))
    task.disturbances.forces["pull"].force[0] = torch.tensor([0.0, 25.0, 0.0])
    assert task._obs_push_force()[0].tolist() == pytest.approx([0.0, 0.5, 0.0, *task._obs_push_force()[0, 3:].tolist()])


@pytest.mark.slow
def test_privileged_observations_have_mirror_images():
    """Left and right joints change places, what points to the left changes its sign, and numbers of the whole robot stay."""
    ranges = {"friction": [0.4, 1.2], "base_com_y": [-0.1, 0.1], "motor_strength": {"range": [0.8, 1.1], "each": True}}
    terms = ["rand_friction", "rand_base_com_y", "rand_motor_strength", "push_force"]
    forces = {"pull": {"x": [-1.0, 1.0]}, "lift": {"z": [0.0, 1.0]}}
    cfg = ("domain_rand.ranges", ranges), ("domain_rand.forces", forces), ("observations.groups.critic.terms", terms)
    columns, signs = small_task(*cfg, num_envs=1).mirror_images().groups["critic"]
    assert columns.tolist() == [0, 1, 5, 6, 7, 2, 3, 4, 11, 12, 13, 8, 9, 10, 14, 15, 16, 17, 18, 19]
    assert signs.tolist() == [1.0, -1.0, *[1.0] * 12, 1.0, -1.0, 1.0, 1.0, -1.0, 1.0]
    each = {"link_mass": {"range": [0.9, 1.1], "each": True}}
    without = ("train.algorithm.symmetry", False)  # with it the configuration is refused
    task = small_task(("domain_rand.ranges", each), observing("rand_link_mass"), without, num_envs=1)
    with pytest.raises(ConfigError, match=r"'rand_link_mass' has 13 numbers, but its kind 'scalar' is for 1"):
        task.mirror_images()


# ---- what is refused -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "draw", "error"),
    [
        ("frictoin", [0.0, 1.0], r"ranges\.frictoin: there is no property 'frictoin' .*did you mean 'friction'"),
        ("friction", {"range": [0.5, 1.0], "wen": "reset"}, r"friction\.wen: unknown key 'wen'; did you mean 'when'"),
        (
            "friction",
            {"range": [0.5, 1.0], "when": "resets"},
            r"friction\.when: unknown value 'resets'; did you mean 'reset'",
        ),
        ("friction", "much", r"ranges\.friction: expected \[low, high\], or a mapping with the key range, got 'much'"),
        ("friction", {"range": [0.0, 1.0], "distribution": "log_uniform"}, r"friction\.distribution: log_uniform draws from"),
        ("friction", {"range": [0.2, 1.0], "std": 0.1}, r"friction\.std: only gaussian has a standard deviation"),
        ("friction", {"range": [0.2, 1.0], "when": "interval"}, r"friction\.when: interval needs an interval_s above 0"),
        ("friction", {"range": [0.2, 1.0], "interval_s": 3.0}, r"friction\.interval_s: needs `when: interval`, got 3"),
        ("friction", {"range": [0.2, 1.0], "grow": [0, 5]}, r"friction\.grow: .*widen if the property is drawn only"),
        ("friction", {"range": [0.2, 1.0], "when": "reset", "grow": [5, 5]}, r"friction\.grow: expected \[first, last\]"),
        ("link_mass", {"range": [0.9, 1.0], "when": "reset", "grow": [0, 5]}, r"link_mass\.grow: .*can't widen: MuJoCo"),
        ("restitution", [0.0, 1.5], r"ranges\.restitution: must be at most 1 .*got 1\.5"),
        ("motor_strength", [-0.5, 1.0], r"ranges\.motor_strength: must be at least 0 .*got -0\.5"),
    ],
)
def test_mistakes_are_named(name, draw, error):
    with pytest.raises(ConfigError, match=rf"command line: domain_rand\.(ranges\.)?{error}"):
        small_config((f"domain_rand.ranges.{name}", draw))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "error"),
    [
        (
            [with_ranges(link_mass={"range": [0.9, 1.1], "when": "reset"}, joint_armature=[0.0, 0.1])],
            r"link_mass is drawn at reset, joint_armature at the start: MuJoCo derives constants from link_mass, joint",
        ),
        (
            [with_ranges(link_mass={"range": [0.9, 1.1], "when": "reset"}), ("domain_rand.randomize_base_mass", True)],
            r"link_mass is drawn at reset, added_base_mass at the start: .*randomize_base_mass draws at the start",
        ),
        ([("control.control_type", "T"), with_ranges(p_gain=[0.9, 1.1])], r"ranges\.p_gain: control\.control_type T takes"),
        ([("control.control_type", "V"), with_ranges(joint_offset=[0.0, 0.1])], r"ranges\.joint_offset: .*V does not read"),
        (
            [("control.actuator.network", "motors.npz"), with_ranges(d_gain=[0.9, 1.1])],
            r"ranges\.d_gain: all joints have a learned actuator .*which has no gains to draw",
        ),
        ([("domain_rand.kicks", {"k": {}})], r"domain_rand\.kicks\.k: it kicks nothing"),
        ([("domain_rand.forces", {"f": {}})], r"domain_rand\.forces\.f: it pushes nothing"),
        (
            [("domain_rand.forces", {"f": {"x": [0, 1], "body": "LF_THIG"}})],
            r"domain_rand\.forces\.f\.body: 'anymal_c' has no body 'LF_THIG'; did you mean 'LF_THIGH'",
        ),
        ([observing("rand_p_gain")], r"groups\.critic\.terms: rand_p_gain: domain_rand\.ranges does not draw 'p_gain'"),
        ([observing("push_force")], r"groups\.critic\.terms: push_force: domain_rand\.forces names no force"),
        (
            [with_ranges(base_com_y=[0.0, 0.1]), observing("rand_base_com_y")],
            r"groups\.critic\.terms: rand_base_com_y: its range \[0, 0\.1\] is not symmetric about 0, so",
        ),
        (
            [with_ranges(joint_offset={"range": [-0.02, 0.04], "when": "reset"}), observing("rand_joint_offset")],
            r"groups\.critic\.terms: rand_joint_offset: its range \[-0\.02, 0\.04\] is not symmetric about 0",
        ),
    ],
)
def test_settings_that_do_not_fit_each_other_are_named(settings, error):
    with pytest.raises(ConfigError, match=error):
        small_config(*settings)


def test_what_leans_to_a_side_may_be_observed_without_mirror_images_and_drawn_with_them():
    leaning = with_ranges(base_com_y=[0.0, 0.1])
    small_config(leaning, observing("rand_base_com_y"), ("train.algorithm.symmetry", False))
    small_config(leaning)
    small_config(with_ranges(base_com_x=[0.0, 0.1]), observing("rand_base_com_x"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "name", "each", "words"),
    [
        (
            "anymal_c_flat",
            "link_mass",
            True,
            "numbers for each of the moving bodies have no mirror image; set each to false",
        ),
        ("anymal_c_flat", "friction", True, "numbers for each of the shapes have no mirror image; set each to false"),
        ("anymal_c_flat", "joint_offset", False, "one number for all joints has no mirror image; set each to true"),
        ("anymal_c_flat", "joint_damping", True, ""),
        (
            "cassie_flat",
            "joint_damping",
            True,
            "numbers for each of the hinges and slides have no mirror image",
        ),  # passive ones
    ],
)
def test_numbers_that_are_not_in_pairs_are_observed_without_mirror_images(task, name, each, words):
    """The error names who asked for them; it was about a table of the task's class, and came from the learner."""
    low = -0.1 if name == "joint_offset" else 0.9
    drawn = ("domain_rand.ranges", {name: {"range": [low, 0.1 if low < 0.0 else 1.1], "each": each}})
    settings = [("env.num_envs", 1), drawn, observing(f"rand_{name}")]
    if words:
        with pytest.raises(ConfigError, match=rf"domain_rand.ranges.{name}.each: rand_{name} is observed, and {words}"):
            task_config(task, [*settings, ("train.algorithm.symmetry", True)])
    else:
        task_config(task, [*settings, ("train.algorithm.symmetry", True)])
    task_config(task, [*settings, ("train.algorithm.symmetry", False)])
