"""A method that nothing would call is an error which says what takes its place."""

import dataclasses
import functools
import re

import pytest
from helpers import call, small_config

from legged.cli.train import train
from legged.envs import LeggedRobot
from legged.envs.class_checks import EXTENDED, HOOKS, never_called
from legged.errors import LONGEST, ConfigError

pytestmark = pytest.mark.usefixtures("workplace")


def told(value: object) -> str:
    """Return the name of a case, the same in every process."""
    return re.sub(r" at 0x\w+", "", str(value))


LEGGED_GYM = [
    "_parse_cfg",
    "_prepare_reward_function",
    "post_physics_step",
    "_post_physics_step_callback",
    "compute_observations",
    "_get_noise_scale_vec",
    "_resample_commands",
    "_compute_torques",
    "_reset_dofs",
    "_reset_root_states",
    "_push_robots",
    "_update_terrain_curriculum",
    "update_command_curriculum",
    "_get_heights",
    "_process_rigid_shape_props",
    "_process_dof_props",
    "_process_rigid_body_props",
    "_create_envs",
    "_draw_debug_vis",
    "create_sim",
    "render",
    "set_camera",
    "get_privileged_observations",
    "_init_height_points",
    "_create_ground_plane",
    "_create_heightfield",
    "_create_trimesh",
    "_get_env_origins",
]
FORKS = [
    "_init_foot",
    "update_feet_state",
    "_reset_buffers",
    "compute_self_observations",
    "compute_termination_observations",
    "_disturbance_robots",
    "_step_contact_targets",
    "_call_train_eval",
    "_randomize_dof_props",
    "_randomize_rigid_body_props",
    "_randomize_gravity",
    "refresh_actor_rigid_shape_props",
    "pre_physics_step",
    "post_decimation_step",
    "_fill_extras",
    "compute_group_observations",
    "compute_proprioception_observations",
    "_compute_observations",
]
ISAAC_LAB = [
    "_setup_scene",
    "_pre_physics_step",
    "_apply_action",
    "_get_observations",
    "_get_rewards",
    "_get_dones",
    "_reset_idx",
]


def subclass(name: str = "Mine", bases=(LeggedRobot,), **members) -> type[LeggedRobot]:
    return type(name, bases, members)


def hook(self, *args) -> None:
    """Something of a fork."""


@pytest.mark.slow
@pytest.mark.parametrize("name", [*LEGGED_GYM, *FORKS, *ISAAC_LAB])
def test_a_hook_that_nobody_calls_is_refused_by_class_file_and_line(name):
    line = hook.__code__.co_firstlineno
    with pytest.raises(ConfigError) as error:
        subclass(**{name: hook}).check(small_config())
    text = str(error.value)
    assert text.splitlines() == [text]
    assert f"test_overrides.py:{line}: Mine.{name} would never be called: " in text
    assert never_called(name) in text
    assert f"OWN_HELPERS = ('{name}',)" in text


def test_no_hook_of_the_table_is_one_of_this_package():
    """Whoever makes one of these names mean something takes it out of the table."""
    assert [name for name in HOOKS if hasattr(LeggedRobot, name)] == []


def test_what_the_table_names_is_there():
    """The methods, settings and files that take the place of a hook."""
    text = " ".join(HOOKS.values())
    for method in ("_step", "advance", "disturb", "compute_reward", "reset_idx", "remember", "make_terrain"):
        assert method in text
        assert callable(getattr(LeggedRobot, method))
    cfg = small_config()
    for path in (
        "init_state.dof_pos_factor",
        "init_state.yaw",
        "init_state.base_velocity",
        "control.control_type",
        "rewards.scales",
        "terminations.failures",
        "terminations.time_outs",
        "observations.noise",
        "observations.add_noise",
        "commands.ranges",
        "commands.resampling_time_s",
        "commands.curriculum",
        "domain_rand.push_robots",
        "domain_rand.ranges",
        "domain_rand.forces",
        "domain_rand.randomize_friction",
        "domain_rand.randomize_base_mass",
        "terrain.curriculum",
        "terrain.measured_points_x",
        "terrain.spawn_range",
    ):
        assert path in text
        functools.reduce(getattr, path.split("."), cfg)


def test_all_wrong_methods_of_a_class_are_named_at_once():
    """A class and its parent with three hooks that nothing calls, one that replaces what is done here, and a constructor."""
    parent = subclass("Parent", compute_group_observations=hook)
    mine = subclass(bases=(parent,), _fill_extras=hook, __init__=lambda self, sim: None, _push_robots=hook, remember=hook)
    with pytest.raises(ConfigError) as error:
        mine.check(small_config())
    text = str(error.value)
    for method in ("Mine._fill_extras", "Mine.__init__", "Mine._push_robots", "Mine.remember", "Parent.compute_group_observ"):
        assert text.count(method) == 1
    assert text.endswith("(if your own code calls it, write OWN_HELPERS = (...) in the class)")


def test_no_wrong_method_is_lost_if_there_are_many():
    with pytest.raises(ConfigError) as error:
        subclass(**dict.fromkeys(LEGGED_GYM, hook)).check(small_config())
    text = str(error.value)
    assert all(re.search(rf"\b{name}\b", text) for name in LEGGED_GYM)
    assert len(text) <= LONGEST
    assert " ... " not in text  # which replaces the middle of a text that is too long


def test_methods_with_observations_in_their_names_that_are_called_are_allowed():
    subclass(compute_observation_of_feet=hook, observations=hook).check(small_config())
    assert never_called("get_observations").startswith("would have no effect: ")
    assert never_called("advance") == ""


def test_hooks_of_a_class_between_and_of_a_mixin_are_found():
    between = subclass("Between", compute_observations=hook)
    with pytest.raises(ConfigError, match=r"Between\.compute_observations"):
        subclass("Last", (between,)).check(small_config())
    mixin = type("Mixin", (), {"_create_envs": hook})
    with pytest.raises(ConfigError, match=r"Mixin\._create_envs"):
        subclass("Last", (mixin, LeggedRobot)).check(small_config())


@pytest.mark.parametrize("kind", [property, staticmethod, classmethod, lambda function: 3], ids=told)
def test_a_hook_of_another_kind_is_found_too(kind):
    with pytest.raises(ConfigError, match=r"^\S+: Mine\._get_heights would never be called"):
        subclass(_get_heights=kind(hook)).check(small_config())


@pytest.mark.slow
@pytest.mark.parametrize("own", [("_get_heights",), ["_get_heights"], "_get_heights"])
def test_a_helper_of_that_name_which_the_class_calls_itself_is_allowed(own):
    class Mine(LeggedRobot):
        OWN_HELPERS = own

        def _get_heights(self):
            return self.measured_heights

        def _reward_lin_vel_z(self):
            return self._get_heights().mean(dim=1)

    Mine(small_config())
    with pytest.raises(ConfigError, match="_push_robots"):
        subclass("Last", (Mine,), _push_robots=hook).check(small_config())


@pytest.mark.parametrize("name", EXTENDED)
def test_a_hook_that_replaces_what_is_done_here_is_refused(name):
    """legged_gym's own check_termination writes reset_buf and calls nothing: here falls would go uncounted."""

    def replaced(self, *args):
        self.reset_buf = self.episode_length_buf > 7

    with pytest.raises(ConfigError) as error:
        subclass(**{name: replaced}).check(small_config())
    line = replaced.__code__.co_firstlineno
    assert f"test_overrides.py:{line}: Mine.{name} must call super().{name}(): {EXTENDED[name]}" in str(error.value)


def test_methods_that_are_called_here_and_those_of_another_name_are_allowed():
    class Mine(LeggedRobot):
        def check_termination(self):
            super().check_termination()

        def compute_reward(self):
            super().compute_reward()

        def reset_idx(self, mask):
            (lambda: LeggedRobot.reset_idx(self, mask))()

        def _step(self):
            super()._step()

        def my_helper(self):
            return 1

        def _reward_unused(self):
            return self.rew_buf

    Mine.check(small_config())


# ---- terms ---------------------------------------------------------------------------------------------------------------


def with_term(member: object, prefix: str = "_reward_") -> None:
    cfg = small_config()
    if prefix == "_reward_":
        cfg.rewards.scales["mine"] = 1.0
    else:
        actor = cfg.observations.groups["actor"]
        cfg.observations.groups["actor"] = dataclasses.replace(actor, terms=(*actor.terms, "mine"))
    mirrored = {**LeggedRobot.MIRRORED, "mine": "same"}
    subclass(**{f"{prefix}mine": member}, MIRRORED=mirrored).check(cfg)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("member", "text"),
    [
        (3.0, "is not a method but a float"),
        ("text", "is not a method but a str"),
        (property(lambda self: self.rew_buf), "is not a method but a property"),
        (lambda self, env_ids: None, r"takes arguments \(env_ids\)"),
        (lambda self, scale, *, power: None, r"takes arguments \(scale, power\)"),
        (staticmethod(lambda task: None), r"takes arguments \(task\)"),
        (lambda: None, "takes no self"),
    ],
    ids=told,
)
@pytest.mark.parametrize(
    ("prefix", "path"), [("_reward_", r"rewards\.scales\.mine"), ("_obs_", r"observations\.groups\.actor\.terms")]
)
def test_a_term_that_cannot_be_called_is_refused(member, text, prefix, path):
    with pytest.raises(ConfigError, match=rf"{path}: Mine\.{prefix}mine {text}"):
        with_term(member, prefix)


@pytest.mark.slow
@pytest.mark.parametrize(
    "member",
    [
        lambda self: None,
        lambda self, power=2: None,
        lambda self, *args, **kwargs: None,
        staticmethod(lambda: None),
        classmethod(lambda cls: None),
    ],
    ids=told,
)
def test_a_term_that_can_be_called_is_allowed(member):
    with_term(member)
    with_term(member, "_obs_")


def test_a_command_ends_with_one_line(tmp_path, capsys):
    (tmp_path / "mine.py").write_text(
        "from legged import LeggedRobot, register\n\n\n"
        "class Fork(LeggedRobot):\n"
        "    def compute_observations(self):\n"
        "        self.obs_buf = None\n\n\n"
        "register('forked', {'extends': 'anymal_c_flat'}, Fork)\n"
    )
    flags = ["--import", "mine.py", "--task", "forked", "--sim_device", "cpu"]
    assert call(train.main, flags) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: mine.py:5: Fork.compute_observations would never be called: write a method _obs_<name>")
    assert error.count("\n") == 1
    assert not (tmp_path / "logs").exists()
