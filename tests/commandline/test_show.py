"""--show: the configuration as YAML, and behind it, as comments, what it comes to."""

import pytest
import yaml
from helpers import TASK, call, small_config

from legged.cli.train import train
from legged.commandline.show import summary
from legged.config import from_dict, to_yaml
from legged.registry import task_config

pytestmark = pytest.mark.usefixtures("workplace")


def rows(lines: list[str], title: str) -> list[list[str]]:
    """The cells of each row below a title, which are apart by two blanks or more; the header is left out."""
    start = next(i for i, line in enumerate(lines) if line.startswith(f"# {title}"))
    found = []
    for line in lines[start + 2 :]:
        if line == "#":
            break
        found.append([cell.strip() for cell in line.removeprefix("#").split("  ") if cell.strip()])
    return found


def test_it_is_yaml_still_and_builds_nothing_that_lasts(capsys, tmp_path):
    assert call(train.main, ["--task", TASK, "--sim_device", "cpu", "--show"]) == 0
    out = capsys.readouterr().out
    assert from_dict(yaml.safe_load(out)) == task_config(TASK, on_cpu=True)
    assert "# observations 'actor': 48 numbers" in out
    assert not (tmp_path / "logs").exists()


def test_observation_terms_have_columns_scales_and_noise():
    lines = summary(small_config(("observations.add_noise", True), ("observations.groups.actor.history", 3)))
    actor, critic = (
        rows(lines, "observations 'actor': 48 numbers x 3 steps"),
        rows(lines, "observations 'critic': 48 numbers"),
    )
    assert actor[0][:4] == ["0:3", "base_lin_vel", "2", "+-0.1"]
    assert actor[3][:4] == ["9:12", "commands", "2, 2, 0.25", "-"]
    assert actor[-1][:4] == ["36:48", "actions", "1", "-"]
    assert [row[3] for row in critic] == ["-"] * 7
    assert actor[0][4] == "Linear velocity (x, y, z) of the base, in the base frame [m/s]"


def test_motors_and_sensors_that_are_not_ideal_are_told():
    lines = summary(
        small_config(
            ("observations.add_noise", True),
            ("observations.bias", {"dof_pos": 0.02}),
            ("observations.delay", {"dof_pos": [0, 2]}),
            ("observations.dropped", {"dof_vel": 0.01}),
            ("control.actuator.model", "dc_motor"),
            ("control.actuator.no_load_speed", {"KFE": 12.0}),
            ("control.actuator.armature", {"KFE": 0.05}),
            ("control.actuator.coulomb_friction", {"KFE": 1.5}),
            ("control.actuator.delay", [0, 4]),
        )
    )
    actor, critic = (rows(lines, f"observations '{name}'") for name in ("actor", "critic"))
    assert [row[3] for row in actor[4:6]] == ["+-0.01, bias +-0.02, delay 0 to 2 steps", "+-1.5, dropped 0.01"]
    assert [row[3] for row in critic] == ["-"] * 7
    actions = rows(lines, "actions: 12 numbers")
    motor = "80 N m at rest, none at 12 rad/s, friction 1.5 N m (1.5 to break away) + 0 N m s/rad, delay 0 to 4 physics steps"
    assert actions[2][2].endswith(f"torque at most 80 N m, rotor 0.05 kg m^2; {motor}")


def test_rewards_terminations_actions_and_joints_of_a_legged_robot():
    lines = summary(small_config(("rewards.scales.collision", 0.0), ("terminations.max_tilt", 1.0)))
    rewards = {row[0]: row[1] for row in rows(lines, "rewards, times the control step of 0.02 s; off: collision")}
    assert rewards["tracking_lin_vel"] == "2"
    assert "collision" not in rewards
    assert [row[:2] for row in rows(lines, "terminations")] == [
        ["contact", "failure"],
        ["tilt", "failure"],
        ["(time)", "time-out"],
        ["(numbers)", "failure"],
    ]
    actions = rows(lines, "actions: 12 numbers, clipped at +-100")
    assert actions[1] == ["1", "LF_HFE", "LF_HFE: position 0.4 + 0.5 a [rad], stiffness 90, damping 4, torque at most 80 N m"]
    joints = rows(lines, "joints: 19 positions, 18 velocities")
    assert joints[0] == ["root", "free", "0:7", "0:6", "-"]
    assert joints[1] == ["LF_HAA", "hinge", "7:8", "6:7", "-0.72 to 0.49"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "expected"),
    [
        (
            "go2_flat",
            "# robot: go2, 15.02 kg, 0.324 m high; numbers written for anymal_c are rescaled: masses x 0.288,"
            " lengths x 0.589, times x 0.768",
        ),
        ("anymal_c", "# robot: anymal_c, 52.13 kg, 0.549 m high; its settings are written for this robot"),
    ],
)
def test_by_what_numbers_were_carried_to_the_robot(task, expected):
    """By hand: 15.02 / 52.13, 0.3235 / 0.5488 and the root of that; of two files that say so, once."""
    assert summary(task_config(task, on_cpu=True))[1] == expected


def test_numbers_that_are_nobodys_are_not_said_to_be():
    """Those of a run's configuration, which has been carried already, and of a task that says nothing of it."""
    cfg = task_config("go2_flat", on_cpu=True)
    assert summary(from_dict(yaml.safe_load(to_yaml(cfg))))[1] == "# robot: go2, 15.02 kg, 0.324 m high"


@pytest.mark.parametrize(("law", "effect"), [("V", "velocity 0.5 a, stiffness 90"), ("T", "torque 0.5 a, torque at most")])
def test_other_control_laws_say_what_an_action_is(law, effect):
    assert effect in "\n".join(summary(small_config(("control.control_type", law))))


def test_gains_are_those_that_nothing_was_drawn_for():
    """A robot whose gains are drawn has the factors beside them, under randomisation; not one draw of them here."""
    drawn = {"p_gain": [0.8, 0.9], "d_gain": [1.1, 1.2], "torque_limit": [0.7, 0.8]}
    actions = rows(summary(small_config(("domain_rand.ranges", drawn))), "actions: 12 numbers, clipped at +-100")
    assert actions[1][2] == "LF_HFE: position 0.4 + 0.5 a [rad], stiffness 90, damping 4, torque at most 80 N m"


def test_a_task_without_a_robot_folder():
    lines = summary(task_config("humanoid", on_cpu=True))
    assert rows(lines, "actions: 17 numbers, clipped at +-1")[5] == ["5", "right_hip_y", "right_hip_y: 120 a [N m]"]
    assert rows(lines, "rewards, per control step")[0] == ["linvel", "2.5", "Forward velocity of the centre of mass [m/s]"]
    assert rows(lines, "terminations")[0][:2] == ["unhealthy", "failure"]
    assert [row[0] for row in rows(lines, "observations 'actor': 276 numbers")] == [
        "0:22",
        "22:45",
        "45:175",
        "175:253",
        "253:276",
    ]


def test_what_is_no_plain_motor_is_told_as_a_control(tmp_path, monkeypatch):
    """A servo's control is a target, and a tendon's motor has no joint."""
    path = tmp_path / "servo.xml"
    path.write_text(
        "<mujoco><worldbody><body name='b'><joint name='x' type='slide'/><joint name='y' type='slide' axis='1 0 0'/>"
        "<geom size='.1'/></body></worldbody><tendon><fixed name='t'><joint joint='x' coef='1'/></fixed></tendon>"
        "<actuator><position joint='x' kp='5'/><motor tendon='t' gear='3'/>"
        "<motor joint='y' gear='2' ctrlrange='-1 3' ctrllimited='true'/></actuator></mujoco>"
    )
    monkeypatch.setattr("legged.envs.half_cheetah.gymnasium_model", lambda _: path)
    monkeypatch.setattr("legged.envs.half_cheetah.HalfCheetah._obs_position", lambda self: self.physics.qpos)
    lines = summary(task_config("half_cheetah", on_cpu=True))
    effects = [row[2] for row in rows(lines, "actions: 3 numbers")]
    assert effects == ["control 0 + 1 a", "control 0 + 1 a", "y: 2 + 4 a [N]"]


def test_what_is_randomised_is_listed_with_range_distribution_and_moments():
    ranges = {
        "joint_offset": {"range": [-0.02, 0.02], "when": "reset", "grow": [0, 300]},
        "motor_strength": {"range": [0.8, 1.2], "distribution": "gaussian", "when": "interval", "interval_s": 4.0},
    }
    pull = {"body": "LF_THIGH", "x": [-30.0, 30.0], "interval_s": [4.0, 8.0], "duration_s": [0.1, 0.5]}
    lines = summary(
        small_config(
            ("domain_rand.ranges", ranges),
            ("domain_rand.randomize_friction", True),
            ("domain_rand.friction_range", [0.5, 1.25]),
            ("domain_rand.kicks", {"trip": {"y": [-0.5, 0.5], "interval_s": [5.0, 10.0]}}),
            ("domain_rand.forces", {"pull": pull}),
        )
    )
    assert [row[:4] for row in rows(lines, "randomised")] == [
        ["friction", "0.5 to 1.25", "uniform", "once"],
        ["joint_offset", "-0.02 to 0.02 rad", "uniform", "each episode, grows over iterations 0 to 300, for each of 12"],
        ["motor_strength", "0.8 to 1.2", "gaussian, sigma 0.1", "every 4 s"],
    ]
    assert rows(lines, "disturbances") == [
        ["trip", "adds to the base's velocity: y -0.5 to 0.5 m/s", "every 5 to 10 s"],
        ["pull", "force on LF_THIGH: x -30 to 30 N", "for 0.1 to 0.5 s, every 4 to 8 s"],
    ]
    assert not any("disturbances" in line or "randomised" in line for line in summary(small_config()))
