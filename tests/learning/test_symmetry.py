"""The mirror: a robot in a mirrored world moves as the mirror image of the robot in ours."""

import dataclasses

import mujoco
import pytest
import torch
from helpers import call, small_config, small_task, tiny_run
from reference import States, random_states
from tensordict import TensorDict

from legged.cli.train import train
from legged.envs import LeggedRobot
from legged.errors import ConfigError
from legged.learning import closed_form
from legged.learning.captured import CapturedRunner
from legged.learning.runner import Runner
from legged.learning.symmetry import augment
from legged.mdp.mirror_images import MirrorImages
from legged.registry import make_task, task_config
from legged.robots.mirror import Mirror

SYMMETRIC = ("train.algorithm.symmetry", True)
ONE_CORE = ("sim.physics", "mujoco"), ("sim.threads", 1)

pytestmark = pytest.mark.usefixtures("workplace")


def rough_task(name: str) -> LeggedRobot:
    return make_task(task_config(name, [("env.num_envs", 2), *ONE_CORE, SYMMETRIC], on_cpu=True))


def test_partners_of_anymal_c(robot):
    """Left and right change places front and hind; abduction turns around, flexion does not."""
    assert robot.joint_names[:6] == ("LF_HAA", "LF_HFE", "LF_KFE", "RF_HAA", "RF_HFE", "RF_KFE")
    assert robot.mirror.joints == (3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8)
    assert robot.mirror.signs == (-1.0, 1.0, 1.0) * 4
    assert [robot.feet_names[i] for i in robot.mirror.feet] == ["RF_FOOT", "LF_FOOT", "RH_FOOT", "LH_FOOT"]


def test_a_lopsided_robot_has_no_mirror():
    legs = "".join(
        f'<body pos="0 {y} 0"><joint name="j{i}" axis="0 1 0"/><geom name="f{i}" size="0.1" pos="0 0 -0.3"/></body>'
        for i, y in enumerate((0.2, -0.25))
    )
    spec = f'<mujoco><worldbody><body><freejoint/><geom size="0.1"/>{legs}</body></worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(spec)
    assert Mirror.of(model, [1, 2], [["f0"], ["f1"]]) is None
    level = mujoco.MjModel.from_xml_string(spec.replace("-0.25", "-0.2"))
    assert Mirror.of(level, [1, 2], [["f0"], ["f1"]]) == Mirror((1, 0), (1.0, 1.0), (1, 0))


def test_a_mirrored_world_goes_on_as_the_mirror_image(robot):
    """Six robots and their mirror images, thrown, under the same actions seen in the mirror: in the air what they observe
    stays mirrored; after the landing, where small differences grow, so do height and attitude. (ANYmal C's own inertia
    differs a little left and right.)
    """
    task = small_task(num_envs=12)
    images = task.mirror_images()
    state = random_states(robot, 6, seed=3)
    state.base_pos[:, 2] += 0.3
    flip, turn = torch.tensor([1.0, -1.0, 1.0]), torch.tensor([-1.0, 1.0, -1.0])
    columns, signs = images.actions

    def both(ours, seen):
        return torch.cat([ours, seen])

    task.reset()
    quat = state.base_quat * torch.tensor([1.0, -1.0, 1.0, -1.0])
    States(
        both(state.base_pos, state.base_pos * flip),
        both(state.base_quat, quat),
        both(state.base_lin_vel, state.base_lin_vel * flip),
        both(state.base_ang_vel, state.base_ang_vel * turn),
        both(state.dof_pos, state.dof_pos[:, columns] * signs),
        both(state.dof_vel, state.dof_vel[:, columns] * signs),
    ).write(task.physics)
    torch.manual_seed(0)
    command = torch.rand(6, 3) - 0.5
    task.hold_commands(both(command, command * torch.tensor([1.0, -1.0, -1.0])))
    pick, sign = images.groups["critic"]
    for _ in range(8):
        actions = 0.3 * torch.randn(6, 12)
        seen = task.step(both(actions, actions[:, columns] * signs))[0]["critic"]
    assert not task.contacts.in_contact.any()
    torch.testing.assert_close(seen[:6, pick] * sign, seen[6:], atol=0.01, rtol=0)
    assert (seen[:6] - seen[6:]).abs().max() > 0.5  # the two worlds do differ
    for _ in range(12):
        task.step(torch.zeros(12, 12))
    assert task.contacts.in_contact.any(dim=1).all()
    torch.testing.assert_close(task.base_pos[:6] * flip, task.base_pos[6:], atol=0.03, rtol=0)
    torch.testing.assert_close(task.projected_gravity[:6] * flip, task.projected_gravity[6:], atol=0.05, rtol=0)


@pytest.mark.slow
def test_the_mirror_of_the_mirror_is_the_sample():
    task = rough_task("anymal_c_proprio")
    images = task.mirror_images()
    observations = TensorDict({"actor": torch.randn(3, 270), "critic": torch.randn(3, 235)}, batch_size=[3])
    actions = torch.randn(3, 12)
    seen, done = augment(images, task, observations, actions)
    assert seen.batch_size == (6,)
    back, undone = augment(images, task, seen[3:], done[3:])
    for name in ("actor", "critic"):
        torch.testing.assert_close(seen[name][:3], observations[name])
        torch.testing.assert_close(back[name][3:], observations[name])
        assert not torch.equal(seen[name][3:], observations[name])
    torch.testing.assert_close(undone[3:], actions)
    assert augment(images, task, None, actions)[0] is None
    assert augment(images, task, observations, None)[1] is None


@pytest.mark.slow
def test_heights_on_the_left_are_seen_on_the_right():
    """A ground that rises to the left by 1 m/m, so that heights are y: mirrored, it falls."""
    task = rough_task("anymal_c")
    images = task.mirror_images()
    columns, signs = images.groups["critic"]
    y = torch.zeros(1, 235)
    y[0, 48:] = task.height_scan.points[:, 1]
    torch.testing.assert_close((y[:, columns] * signs)[0, 48:], -task.height_scan.points[:, 1])


@pytest.mark.slow
def test_every_step_of_a_history_is_mirrored_in_its_place():
    """Gravity to the left, 1 to 6 in six steps: to the right in the same steps."""
    task = rough_task("anymal_c_proprio")
    columns, signs = task.mirror_images().groups["actor"]
    history = torch.zeros(1, 6, 45)
    history[0, :, 4] = torch.arange(1.0, 7.0)  # after three rates: projected gravity's y
    torch.testing.assert_close((history.flatten(1)[:, columns] * signs).view(1, 6, 45), -history)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [Runner, CapturedRunner])
def test_rsl_rl_learns_from_both(kind, monkeypatch):
    """Twice the samples in a mini-batch, and how far the policy is from its mirror image is logged."""
    task = small_task(SYMMETRIC, num_envs=4)
    runner = kind(task, None, "cpu")
    seen = []
    first_layer = runner.alg.critic.mlp[0]
    linear, forward = torch.nn.functional.linear, closed_form.forward

    def watched_linear(x, weight, bias=None):
        if weight is first_layer.weight:
            seen.append(len(x))
        return linear(x, weight, bias)

    def watched_forward(layers, x):
        if layers is runner.alg.critic.mlp:
            seen.append(len(x))
        return forward(layers, x)

    monkeypatch.setattr(torch.nn.functional, "linear", watched_linear)
    monkeypatch.setattr(closed_form, "forward", watched_forward)
    losses = []
    log = runner.logger.log
    runner.logger.log = lambda **values: (losses.append(values["loss_dict"]), log(**values))
    runner.learn(1)
    samples = 4 * task.cfg.train.runner.num_steps_per_env // task.cfg.train.algorithm.num_mini_batches
    assert seen.count(2 * samples) == 20
    assert losses[0]["symmetry"] > 0.0


@pytest.mark.slow
def test_a_training_with_symmetry_runs_from_the_command_line():
    tiny_run("train.algorithm.symmetry=true")


class Looking(LeggedRobot):
    def _obs_foot_contact(self):
        return self.contacts.in_contact.float()


class Knowing(Looking):
    MIRRORED = {**LeggedRobot.MIRRORED, "foot_contact": "feet"}


def test_own_observations_need_to_say_how_they_are_mirrored():
    cfg = small_config(SYMMETRIC)
    groups = cfg.observations.groups
    groups["critic"] = dataclasses.replace(groups["critic"], terms=(*groups["critic"].terms, "foot_contact"))
    with pytest.raises(ConfigError, match=r"Looking\.MIRRORED does not say how observation 'foot_contact'"):
        Looking(cfg)
    columns, _ = Knowing(cfg).mirror_images().groups["critic"]
    assert columns[48:].tolist() == [49, 48, 51, 50]


def test_lopsided_measuring_points_are_refused(capsys):
    arguments = ["--task", "anymal_c", "train.algorithm.symmetry=true", "terrain.measured_points_y=[0.0, 0.5]", "--show"]
    assert call(train.main, arguments) == 2
    assert "must be symmetric about 0" in capsys.readouterr().err


def test_actions_that_are_scaled_differently_on_both_sides_have_no_images():
    """Half the way for the same action: the mirrored action would ask the other leg for another angle."""
    scales = {"LF": 0.5, "LH": 0.5, "RF": 0.25, "RH": 0.5}
    words = r"control\.action_scale: left and right joints have different values \(LF_HAA 0\.5, RF_HAA 0\.25\); set train"
    with pytest.raises(ConfigError, match=words):
        small_config(SYMMETRIC, ("control.action_scale", scales))
    small_config(("train.algorithm.symmetry", False), ("control.action_scale", scales))
    small_config(SYMMETRIC, ("control.action_scale", {"HAA": 0.25, "HFE": 0.5, "KFE": 0.5}))


class Misspelt(Looking):
    MIRRORED = {**LeggedRobot.MIRRORED, "foot_contact": "foot"}


class TooNarrow(Looking):
    MIRRORED = {**LeggedRobot.MIRRORED, "foot_contact": "joints"}


class Unequal(Looking):
    MIRRORED = {**LeggedRobot.MIRRORED, "foot_contact": "vector"}


def looking_config():
    return small_config(SYMMETRIC, ("observations.groups.critic.terms", ["dof_pos", "foot_contact"]))


@pytest.fixture
def looking(monkeypatch):
    """A configuration with one observation that only the classes of this file have."""
    with monkeypatch.context() as patch:
        patch.setattr(LeggedRobot, "_obs_foot_contact", Looking._obs_foot_contact, raising=False)
        patch.setattr(LeggedRobot, "MIRRORED", Knowing.MIRRORED)
        return looking_config()


def test_a_misspelt_kind_of_mirror_is_refused_at_the_start(looking):
    """It would be taken for `same`, and left and right would be learned from each other's feet."""
    words = r"Misspelt\.MIRRORED: observation 'foot_contact' has the unknown kind 'foot'; did you mean 'feet'\?"
    with pytest.raises(ConfigError, match=words):
        Misspelt.check(looking)


@pytest.mark.slow
@pytest.mark.parametrize(("task", "words"), [(TooNarrow, "kind 'joints' is for 12"), (Unequal, "kind 'vector' is for 3")])
def test_a_kind_of_mirror_of_another_width_is_refused(looking, task, words):
    with pytest.raises(ConfigError, match=rf"{task.__name__}\.MIRRORED: observation 'foot_contact' has 4 numbers.*{words}"):
        task(looking).mirror_images()
    assert Knowing(looking).mirror_images().groups["critic"][0].tolist()[12:] == [13, 12, 15, 14]


class Sideless(LeggedRobot):
    """A task that knows no left and right."""

    def mirror_images(self):
        return None


@pytest.mark.slow
def test_a_task_without_mirror_images_learns_without_symmetry_only():
    task = Sideless(small_config(SYMMETRIC))
    with pytest.raises(ConfigError, match=r"train\.algorithm\.symmetry: Sideless has no mirror images, so this must be"):
        Runner(task)
    Runner(Sideless(small_config(("train.algorithm.symmetry", False))))


def test_what_no_kind_of_mirror_fits_is_refused(robot):
    """By the images themselves too, whoever asks for them."""
    task = small_task()

    def images(kinds):
        joints = dict.fromkeys(("actions", "angles", "speeds"), range(12))
        return MirrorImages("Mine", kinds, task.observation_groups, robot, joints, task.height_scan.points)

    assert images(LeggedRobot.MIRRORED).actions[0].tolist() == list(robot.mirror.joints)
    with pytest.raises(ConfigError, match=r"Mine\.MIRRORED: there is no way to mirror 'typo'"):
        images({**LeggedRobot.MIRRORED, "dof_vel": "typo"})
    with pytest.raises(ConfigError, match=r"Mine\.MIRRORED does not say how observation 'commands' is mirrored"):
        images({name: kind for name, kind in LeggedRobot.MIRRORED.items() if name != "commands"})
    with pytest.raises(ConfigError, match=r"observation 'actions' has 12 numbers, but its kind 'feet' is for 4"):
        images({**LeggedRobot.MIRRORED, "actions": "feet"})
