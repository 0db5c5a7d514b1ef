"""Robots on wheels: Go2-W stands and drives; the angle of a wheel is neither observed nor rewarded, nor set by a law."""

import pytest
import torch
from helpers import CALM, ENGINE, TINY_TRAINING, kept_global_state, zero_actions

from legged.cli.train import train
from legged.errors import ConfigError
from legged.policies.description import describe
from legged.registry import make_task, task_config
from legged.robots.robot import load_robot

WHEELS = slice(3, None, 4)
STILL = [("init_state.base_velocity", [0.0, 0.0]), ("init_state.dof_pos_factor", [1.0, 1.0])]


def config(*overrides, name="go2w_flat"):
    return task_config(name, [("env.num_envs", 2), *ENGINE, *CALM, *STILL, *overrides], on_cpu=True)


@pytest.fixture(scope="module")
def task():
    return make_task(config())


def test_it_stands_and_its_wheels_drive_it(task):
    """Wheels of 0.086 m at 10 rad/s roll at 0.86 m/s; the robot stands 0.408 m high, less what its legs give way."""
    actions = zero_actions(task)
    task.reset()
    for _ in range(75):
        task.step(actions)
    assert task.base_pos[:, 2].tolist() == pytest.approx([0.395, 0.395], abs=0.01)
    assert (task.base_lin_vel[:, :2].norm(dim=1) < 0.05).all()
    actions[:, WHEELS] = 1.0
    for _ in range(100):
        _, _, done, _ = task.step(actions)
        assert not done.any()
    assert task.base_lin_vel[:, 0].tolist() == pytest.approx([0.86, 0.86], abs=0.05)
    assert (task.base_pos[:, 2] > 0.38).all()
    assert (task.projected_gravity[:, 2] < -0.99).all()


def test_no_term_reads_the_angle_of_a_wheel(task):
    """12 of 16 joints have an angle; 3 + 3 + 3 + 3 + 12 + 16 + 16 numbers are observed."""
    assert task.get_observations()["actor"].shape[1] == 56
    entry = next(term for term in describe(task)["observation"] if term["name"] == "dof_pos")
    assert entry["size"] == len(entry["joints"]) == 12
    assert not any("wheel" in name for name in entry["joints"])
    terms = [getattr(task, f"_reward_{name}") for name in ("stand_still", "posture", "dof_pos_limits", "dof_vel", "dof_acc")]
    task.is_moving[:] = False
    before = [task._obs_dof_pos(), *(term() for term in terms)]
    task.dof_pos[:, WHEELS] += 100.0
    task.dof_vel[:, WHEELS] += 10.0
    for was, now in zip(before, [task._obs_dof_pos(), *(term() for term in terms)], strict=True):
        assert torch.equal(was, now)
    task.reset()


def test_the_mirror_image_leaves_out_wheels_too(task):
    images = task.mirror_images()
    columns, signs = images.groups["actor"]
    assert columns[12:24].tolist() == [12 + i for i in (3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8)]
    assert signs[12:15].tolist() == [-1.0, 1.0, 1.0]
    assert images.actions[0].tolist() == [4, 5, 6, 7, 0, 1, 2, 3, 12, 13, 14, 15, 8, 9, 10, 11]


def test_the_description_says_which_law_each_joint_has(task):
    told = describe(task)
    assert told["control_type"] == ["P", "P", "P", "V"] * 4
    assert "P joints: stiffness * (action_scale * action + default" in told["conventions"]["torque"]
    assert "V joints: stiffness * (action_scale * action - dq)" in told["conventions"]["torque"]


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        ([("control.control_type", "P")], "'FL_wheel_joint' of 'go2w' is a wheel, and law P would turn it to an angle"),
        ([("control.control_type.FL_calf", "T")], r"control_type: left and right .* different values \(FL_calf_joint 'T'"),
        ([("control.control_type.wheel", "W")], "control.control_type.wheel: unknown value 'W'"),
        ([("control.control_type", 3)], "control.control_type: expected a name, or a mapping from names to"),
        ([("control.held", ["wheel"])], "control.held: joints are held by control_type P only, not V"),
    ],
)
def test_a_law_that_fits_no_wheel_is_refused(overrides, says):
    with pytest.raises(ConfigError, match=says):
        make_task(config(*overrides))


def test_each_joint_of_a_table_needs_a_law():
    with pytest.raises(ConfigError, match=r"control\.control_type: no pattern matches joint 'FL_hip_joint'"):
        make_task(config(("robot", "go2w"), ("control.control_type", {"wheel": "V"}), name="go2_flat"))


def test_wheels_may_be_held():
    scales = ("control.action_scale", 0.5)
    held = make_task(config(("control.held", ["wheel"]), ("control.control_type", "P"), scales))
    assert held.num_actions == 12


@pytest.mark.parametrize(("rotor", "gain"), [(0.005, 23.7 / 30.1), (0.0001, 0.0013 / 0.005)])
def test_a_rule_gives_wheels_a_gain_on_their_speed(tmp_path, rotor, gain):
    """The whole effort of 23.7 N m at an error of 30.1 rad/s; less for a wheel of 0.0012 kg m^2 whose rotor is light."""
    own = load_robot("go2w").folder
    lines = (own / "robot.yaml").read_text().splitlines()
    (tmp_path / "robot.yaml").write_text("\n".join(line for line in lines if not line.startswith(("stiffness", "damping"))))
    (tmp_path / "go2w.xml").write_text((own / "go2w.xml").read_text().replace('armature="0.005"', f'armature="{rotor}"'))
    robot = load_robot(str(tmp_path))
    assert robot.stiffness[WHEELS] == pytest.approx([gain] * 4, rel=0.02)
    assert robot.damping[WHEELS].tolist() == [0.0] * 4


@pytest.mark.slow
@pytest.mark.parametrize("name", ["go2w_flat", "go2w"])
def test_it_trains(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with kept_global_state():
        flags = ["--task", name, "--sim_device", "cpu", "--num_envs", "8", "--max_iterations", "2"]
        assert train.main([*flags, *TINY_TRAINING]) == 0
