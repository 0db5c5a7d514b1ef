"""Forks with classes of their own: formulas, observations, terrains and settings that legged_gym does not have."""

import shlex
import textwrap
from pathlib import Path

import pytest
from forks import ANYMAL_FLAT, BASE, FLAT, built, line_of, sections, written
from helpers import call
from importing_fixtures import urdf

from legged.cli import main as legged
from legged.cli.migrate import migrate
from legged.config.yaml_files import read_yaml
from legged.migration import reading

pytestmark = pytest.mark.usefixtures("workplace", "own_registry")

CONFIG = """
    import wandb
    from isaacgym import gymapi
    from .parents import Parent

    class DogCfg(Parent):
        class env:
            num_envs = 64
            num_observations = 47
            frame_stack = 3
            num_actions = 12
            episode_length_s = 10
        class terrain:
            mesh_type = 'trimesh'
            measure_heights = False
            static_friction = 0.5
            num_rows, num_cols = 5, 10
            terrain_proportions = [0.2, 0.3, 0.5]
        class commands:
            resampling_time = 5.
            num_commands = 5
            class ranges:
                lin_vel_x = [0., 1.]
                body_height = [-0.1, 0.1]
        class control:
            control_type = 'P'
            action_scale = 0.25
            decimation = 5
        class asset:
            name = 'anymal_c'
            project = wandb.config.project
        class domain_rand:
            friction_range = [0.5, 1.5]
        class rewards:
            tracking_sigma = 5
            base_height_target = 0.5
            class scales:
                lin_vel_z = -2.
                orientation = 1.
                tracking_lin_vel = 1.2
                tracking_ang_vel = 0.5
                prance = 0.3
        class viewer:
            pos = [1, 2, 3]
        class sim:
            dt = 0.004
            class physx:
                num_threads = 4
    """
PARENTS = """
    from abc import ABC
    from params_proto import Proto
    class Parent(Proto, ABC):
        pass
    """
ENV = """
    import numpy as np
    import torch
    from isaacgym.torch_utils import *
    from rsl_rl.env import VecEnv
    from .extra import anything

    class Dog(VecEnv):
        def compute_observations(self):
            phase = torch.sin(2 * np.pi * self.clock)
            self.obs_buf = torch.cat((self.projected_gravity, self.base_ang_vel * self.obs_scales.ang_vel, phase,
                                      self.commands[:, :3] * self.commands_scale,
                                      (self.dof_pos - self.default_dof_pos) * self.obs_scales.dof_pos, self.actions), dim=-1)
            if self.cfg.terrain.measure_heights:
                self.obs_buf = torch.cat((self.obs_buf, self.measured_heights), dim=-1)
            self.obs_buf += torch.rand_like(self.obs_buf) * self.noise_scale_vec

        def _resample_commands(self, ids):
            self.commands[ids, 3] = 0.1

        def _reward_lin_vel_z(self):
            "A docstring does not change the formula."
            return self.base_lin_vel[:, 2] ** 2

        def _reward_orientation(self):
            return torch.exp(-10. * self.projected_gravity[:, :2].norm(dim=1))

        def _reward_tracking_lin_vel(self):
            error = (self.commands[:, :2] - self.base_lin_vel[:, :2]).square().sum(dim=1)
            return torch.exp(-error * self.cfg.rewards.tracking_sigma)

        def _reward_prance(self):
            return (self.root_states[:, 2] - self.commands[:, 3]).abs()
    """
TERRAIN = """
    from isaacgym import terrain_utils

    def puddle_terrain(terrain, depth):
        terrain.height_field_raw[0:5, 0:5] = -depth

    class Terrain:
        def make_terrain(self, choice, difficulty):
            terrain = terrain_utils.SubTerrain("terrain", width=self.width, length=self.width)
            if choice < self.proportions[0]:
                pass
            elif choice < self.proportions[1]:
                terrain_utils.pyramid_stairs_terrain(terrain, step_width=0.3, step_height=-0.1 * difficulty)
            else:
                puddle_terrain(terrain, 0.1)
            return terrain
    """
EXTRA = """
    from legged_gym.utils.task_registry import task_registry
    from .terrain import Terrain
    anything = 1
    """


@pytest.fixture
def fork(monkeypatch):
    """A package with the files above, whose `_reward_lin_vel_z` counts as legged_gym's."""

    def fork(**changed: str) -> str:
        files = {"dog_config": CONFIG, "parents": PARENTS, "dog": ENV, "terrain": TERRAIN, "extra": EXTRA} | changed
        for name, text in files.items():
            written(textwrap.dedent(text), f"fork/envs/{name}.py")
        written(
            "from .dog_config import DogCfg\nfrom .dog import Dog\nfrom legged_gym.utils import task_registry\n"
            "task_registry.register('dog', Dog, DogCfg(), None)\n",
            "fork/envs/__init__.py",
        )
        return "fork/envs/dog_config.py"

    fork()
    found = reading.run_child(Path("fork/envs/dog.py"), "dog")
    digest = found["methods"]["_reward_lin_vel_z"][0]["digest"]
    monkeypatch.setitem(reading.DIGESTS, "_reward_lin_vel_z", digest)
    return fork


def place(text: str, part: str, file: str) -> str:
    return f"fork/envs/{file}.py:{line_of(textwrap.dedent(text), part)}"


@pytest.mark.slow
def test_formulas_of_the_forks_own_get_no_scale_until_their_methods_are_pasted(fork, migrated):
    """Its orientation and tracking pay with an exp(); with these scales our penalty would have been paid."""
    result = migrated(textwrap.dedent(CONFIG), path=fork())
    scales = result.data["rewards"]["scales"]
    assert "orientation" not in scales
    assert "prance" not in scales
    assert (scales["tracking_lin_vel"], scales["torques"]) == (0.0, 0.0)
    assert "lin_vel_z" not in scales  # -2, the default here: its formula is legged_gym's
    assert "tracking_sigma" not in result.data["rewards"]
    assert any(
        line.startswith(f"{place(CONFIG, 'tracking_sigma', 'dog_config')}: rewards.tracking_sigma = 5: divides")
        for line in result.lost
    )
    for name, scale in (("orientation", "1"), ("tracking_lin_vel", "1.2"), ("prance", "0.3")):
        where = place(ENV, f"def _reward_{name}", "dog")
        assert f"paste: _reward_{name} ({where}), then set rewards.scales.{name}: {scale}\n" in result.out
    # The class has no method for this one, so that the fork itself would fail.
    where = place(CONFIG, "tracking_ang_vel", "dog_config")
    assert (
        f"paste: nothing for rewards.scales.tracking_ang_vel: 0.5 ({where}): the fork's classes have no _reward" in result.out
    )
    assert "rewards: 1 of 5 scales are mapped, with legged_gym's formulas; 4 wait" in result.out
    built(result)


@pytest.mark.slow
def test_a_formula_of_legged_gyms_with_a_comment_at_the_margin_is_recognised(fork, migrated):
    """Such a comment made the method a fork's own."""
    path, env = fork(), Path("fork/envs/dog.py")
    body = "        return self.base_lin_vel[:, 2] ** 2"
    assert body in env.read_text()
    env.write_text(env.read_text().replace(body, f"# return self.base_lin_vel[:, 2]\n{body}"))
    result = migrated(textwrap.dedent(CONFIG), path=path)
    assert "rewards: 1 of 5 scales are mapped, with legged_gym's formulas; 4 wait" in result.out


@pytest.mark.slow
def test_the_first_lines_are_those_that_matter(fork, migrated):
    lines = migrated(textwrap.dedent(CONFIG), path=fork()).out.splitlines()
    assert [line.partition(":")[0] for line in lines[1:4]] == ["rewards", "observations", "robot"]
    assert "anymal_c has 12 joints in the order LF_HAA, LF_HFE, LF_KFE, RF_HAA," in lines[3]
    assert "Isaac Gym's order may differ: index them by name" in lines[3]
    # What changes no task is one line; nothing is said of those that are not there.
    assert [line for line in lines if "viewer" in line or "physx" in line] == []
    assert "not mapped, without effect: 2 settings of the simulator, of drawing and of the command line" in lines


@pytest.mark.slow
def test_observations_are_those_that_the_class_joins(fork, migrated):
    result = migrated(textwrap.dedent(CONFIG), path=fork())
    terms = ["projected_gravity", "base_ang_vel", "commands", "dof_pos", "actions"]
    groups = result.data["observations"]["groups"]
    assert groups["actor"] == {"terms": terms, "history": 3}
    assert groups["critic"] == {"terms": terms}
    where = place(ENV, "def compute_observations", "dog")
    assert f"{', '.join(terms)}; write a method _obs_<name> for clock ({where})\n" in result.out
    assert built(result).num_obs == 3 * (3 + 3 + 3 + 12 + 12)


@pytest.mark.slow
def test_observations_that_cannot_be_told_are_not_guessed_by_their_number(fork, migrated):
    """They are 48, as legged_gym's, and something else."""
    env = ENV.replace("+= torch.rand_like(self.obs_buf)", "= self.obs_buf[:, :9]")
    config = textwrap.dedent(
        CONFIG.replace("num_observations = 47", "num_observations = 48").replace("            frame_stack = 3\n", "")
    )
    result = migrated(config, path=fork(dog=env))
    assert "groups" not in result.data["observations"]
    assert (
        f"observations: {place(env, 'def compute_observations', 'dog')} joins them in an unknown way: the default"
        in result.out
    )


@pytest.mark.slow
def test_ranges_and_switches_that_a_fork_does_not_have_are_off(fork, migrated):
    """An absent lin_vel_y was [-1, 1], and pushes of 1 m/s were added."""
    result = migrated(textwrap.dedent(CONFIG), path=fork())
    data = result.data
    assert data["commands"] == {
        "ranges": {"lin_vel_x": [0.0, 1.0], "lin_vel_y": [0.0, 0.0], "ang_vel_yaw": [0.0, 0.0]},
        "resampling_time_s": 5.0,
        "heading_command": False,
    }
    assert data["domain_rand"] == {"randomize_friction": False, "push_robots": False}
    assert any("terrain.static_friction = 0.5: the ground has no friction here" in line for line in result.lost)
    assert "domain_rand.friction_range" in result.plain
    assert data["rewards"]["only_positive_rewards"] is False
    assert data["observations"]["add_noise"] is False


@pytest.mark.slow
def test_a_fourth_command_and_methods_that_no_setting_carries_over_are_said(fork, migrated):
    out = migrated(textwrap.dedent(CONFIG), path=fork()).out
    where = place(ENV, "def _reward_prance", "dog")
    assert f"commands: commands[:, 3] is the heading here, and no column follows it; check _reward_prance ({where})\n" in out
    assert f"_resample_commands ({place(ENV, 'def _resample', 'dog')})" in out
    assert "commands.num_commands = 5: commands here are vx, vy, yaw rate and heading" in out


@pytest.mark.slow
def test_terrain_types_are_those_that_the_forks_class_makes(fork, migrated):
    """In legged_gym's order they would be slopes and stairs. Half of the columns of 0.2 + 0.3 are level."""
    result = migrated(textwrap.dedent(CONFIG), path=fork())
    assert result.data["terrain"]["proportions"] == {"flat": 0.4, "stairs_up": 0.6}
    assert any("terrain.terrain_proportions" in line and "puddle_terrain" in line for line in result.lost)


def test_terrain_types_that_do_not_fit_on_the_tiles_are_left_out(migrated):
    """They were written, and the task was refused."""
    lines = "mesh_type = 'trimesh'\nterrain_length = 4.\nterrain_width = 4.\nterrain_proportions = [0.5"
    result = migrated(sections(terrain=f"{lines}, 0., 0., 0., 0., 0., 0., 0.5]"))
    assert "does not load yet" not in result.out
    assert set(result.data["terrain"]["proportions"]) <= {"slope_up", "slope_down", "flat"}
    assert any("unknown here, or too large for the tiles: pit" in line for line in result.lost)


def test_rows_that_make_no_terrain_at_all_are_said(migrated):
    result = migrated(sections(terrain="mesh_type = 'trimesh'\nnum_rows = 900\nnum_cols = 900"))
    assert "does not load yet" not in result.out
    assert any("terrain.num_rows = 900: the terrain would be refused" in line for line in result.lost)


WALKS = """
from params_proto import PrefixProto

class Cfg(PrefixProto, cli=False):
    class env(PrefixProto, cli=False):
        num_envs = 4000
        num_observations = 42
    class commands(PrefixProto, cli=False):
        lin_vel_x = [-0.6, 0.7]
        lin_vel_y = [-0.5, 0.5]
        ang_vel_yaw = [-2., 2.]
        heading_command = False
    class rewards(PrefixProto, cli=False):
        only_positive_rewards = True
    class reward_scales(PrefixProto, cli=False):
        tracking_lin_vel = 1.5
        dof_vel = -1e-4
    class obs_scales(PrefixProto, cli=False):
        dof_vel = 0.1
    class noise(PrefixProto, cli=False):
        add_noise = True
    class noise_scales(PrefixProto, cli=False):
        dof_pos = 0.02

def config_dog(Cnfg):
    Cnfg.commands.ang_vel_yaw = [-1.5, 1.5]
"""


def test_sections_in_other_places_and_functions_that_configure(migrated):
    """Scales outside `rewards` were zeros."""
    written(WALKS, "base.py")
    result = migrated("from base import Cfg, config_dog as made\ndef config_pup(Cnfg):\n    made(Cnfg)\n", path="pup.py")
    assert result.path == Path("pup.yaml")
    assert result.data["commands"]["ranges"] == {
        "lin_vel_x": [-0.6, 0.7],
        "lin_vel_y": [-0.5, 0.5],
        "ang_vel_yaw": [-1.5, 1.5],
    }
    scales = result.data["rewards"]["scales"]
    assert (scales["tracking_lin_vel"], scales["dof_vel"], scales["torques"]) == (1.5, -1e-4, 0.0)
    assert result.data["observations"]["scales"] == {"dof_vel": 0.1}
    assert result.data["observations"]["noise"]["dof_pos"] == 0.02
    assert "no class with rewards was found near the file" in result.out


FIELDS = [
    (
        "domain_rand",
        "randomize_motor_torque = True\nrandomize_motor_torque_range = [0.8, 1.2]",
        "ranges.motor_strength",
        [0.8, 1.2],
    ),
    ("domain_rand", "randomize_motor = True\nmotor_strength_range = [0.7, 1.1]", "ranges.motor_strength", [0.7, 1.1]),
    ("domain_rand", "randomize_Kp = True\nrandomize_Kp_range = [0.8, 1.2]", "ranges.p_gain", [0.8, 1.2]),
    ("domain_rand", "randomize_Kd_factor = True\nKd_factor_range = [0.5, 1.5]", "ranges.d_gain", [0.5, 1.5]),
    ("domain_rand", "randomize_base_com = True\nrand_com_vec = [0.03, 0.02, 0.01]", "ranges.base_com_y", [-0.02, 0.02]),
    ("domain_rand", "randomize_base_com = True\nadded_com_range = [-0.2, 0.1]", "ranges.base_com_z", [-0.2, 0.1]),
    (
        "domain_rand",
        "randomize_motor_offset = True\nmotor_offset_range = [-0.02, 0.05]",
        "ranges.joint_offset",
        [-0.05, 0.02],
    ),
    ("domain_rand", "init_dof_pos_ratio_range = [0.8, 1.2]", "init_state.dof_pos_factor", [0.8, 1.2]),
    ("domain_rand", "init_base_vel_range = [-0.2, 0.2]", "init_state.base_velocity", [-0.2, 0.2]),
    # 20 ms are four steps of 5 ms; a random share of a control step of four is at most three.
    ("domain_rand", "randomize_action_delay = True\ndelay_ms_range = [5, 20]", "control.actuator.delay", [1, 4]),
    ("domain_rand", "randomize_lag_timesteps = True\nlag_timesteps = 6", "control.actuator.delay", [6, 6]),
    ("domain_rand", "delay = True", "control.actuator", {"delay": [0, 3], "delay_varies": True}),
    ("env", "num_observations = 47\nobs_history_length = 5", "observations.groups.actor.history", 5),
    ("env", "num_one_step_observations = 30\nnum_observations = 180", "observations.groups.actor.history", 6),
    ("env", "randomize_start_yaw = True\nrand_yaw_range = 1.2", "init_state.yaw", [-1.2, 1.2]),
    ("commands", "zero_command_prob = 0.1", "commands.standing_share", 0.1),
]


@pytest.mark.slow
@pytest.mark.parametrize(("section", "lines", "path", "value"), FIELDS, ids=[entry[1].partition(" ")[0] for entry in FIELDS])
def test_settings_of_forks_go_to_the_fields_that_are_here(migrated, section, lines, path, value):
    result = migrated(sections(**{section: lines}))
    data = result.data
    for key in (path if "." in path and not path.startswith("ranges") else f"domain_rand.{path}").split("."):
        data = data[key]
    assert data == value
    assert "does not load yet" not in result.out
    if path != "observations.groups.actor.history":
        built(result)


@pytest.mark.parametrize(("ground", "values"), [("0.", [0.0, 0.5]), ("0.4", [0.2, 0.7])])
def test_restitution_is_averaged_with_the_grounds(migrated, ground, values):
    """The robot's own range was taken for the contact's."""
    lines = "randomize_restitution = True\nrestitution_range = [0., 1.]"
    result = migrated(sections(domain_rand=lines, terrain=f"restitution = {ground}"))
    assert result.data["domain_rand"]["ranges"]["restitution"] == values
    assert f"PhysX averages the robot's 0 to 1 with the ground's {float(ground):g}\n" in result.out
    assert result.lost == []


def test_an_unused_range_of_yaw_rates_does_not_limit_heading_mode(migrated):
    """legged_gym clips that yaw rate to 1 rad/s; the range, 0.3 rad/s, limited it."""
    ranges = "class ranges(LeggedRobotCfg.commands.ranges):\n    ang_vel_yaw = [-0.3, 0.3]"
    result = migrated(sections(commands=ranges))
    assert "commands" not in result.data  # -1 to 1 rad/s is the default here
    (lost,) = result.lost
    assert lost.endswith("[-0.3, 0.3]: the fork does not use it in heading mode; the range here is its limit there, 1 rad/s")
    turning = migrated(sections(commands=f"heading_command = False\n{ranges}"), "--force")
    assert turning.data["commands"]["ranges"] == {"ang_vel_yaw": [-0.3, 0.3]}
    assert turning.lost == []


@pytest.mark.slow
@pytest.mark.parametrize(("given", "limit"), [("-2., 2.", 2.0), ("-1.5, 1.5", 1.5)])
def test_the_limit_of_heading_mode_is_read_from_the_forks_method(fork, migrated, given, limit):
    step = f"""
        def _post_physics_step_callback(self):
            heading = self.yaw()
            self.commands[:, 2] = torch.clip(0.5 * wrap_to_pi(self.commands[:, 3] - heading), {given})
    """
    config = CONFIG.replace("num_commands = 5", "heading_command = True")
    data = migrated(textwrap.dedent(config), path=fork(dog=ENV.rstrip() + "\n" + step)).data
    assert data["commands"]["ranges"]["ang_vel_yaw"] == [-limit, limit]


PUP = """
import torch

class Pup:
    def step(self, actions):
        return actions / 2

    def compute_observations(self):
        self.obs_buf = torch.cat((self.projected_gravity, self.actions), dim=-1)
        self.obs_buf += torch.randn_like(self.obs_buf) * self.noise_scale_vec
"""


def test_the_class_of_the_environment_is_read_if_another_class_has_the_rewards(migrated):
    """Only the class with rewards was read: observations were guessed, and no method was listed."""
    written(PUP, "pup.py")
    written("class Rewards:\n    def _reward_prance(self):\n        return self.env.prance\n", "rewards.py")
    result = migrated(sections(rewards="class scales:\n    prance = 0.5"))
    assert result.data["observations"]["groups"]["actor"]["terms"] == ["projected_gravity", "actions"]
    assert "move the fork's own methods by hand (docs/migrating.md): step (pup.py:5)\n" in result.out
    assert "paste: _reward_prance (rewards.py:2), then set rewards.scales.prance: 0.5\n" in result.out
    assert "its noise is normal, here it is uniform: 1.73 times the fork's noise_level has the same variance\n" in result.out


NAMED = [
    ("domain_rand", "disturbance_interval = 8", "domain_rand.forces"),
    ("domain_rand", "max_push_vel_ang = 0.4", "domain_rand.kicks (roll, pitch, yaw)"),
    ("domain_rand", "action_delay = 0.5", "control.actuator.delay [physics steps]"),
    ("domain_rand", "gravity_range = [-1.0, 1.0]", "domain_rand.ranges.gravity_x"),
    ("commands", "lin_vel_clip = 0.3", "commands.small_command"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("section", "line", "words"), NAMED, ids=[entry[1] for entry in NAMED])
def test_fields_of_another_form_are_named(migrated, section, line, words):
    (lost,) = migrated(sections(**{section: line})).lost
    assert f"{section}.{line}: {words}" in lost


# ---- the commands that are printed ---------------------------------------------------------------------------------------


def test_both_commands_for_a_missing_robot_run_as_they_are_printed(migrated, capsys):
    """The second one failed: `stiffness: no pattern matches`, since a rule gives the gains of a new robot."""
    Path("toy.urdf").write_text(urdf())
    lines = "file = '{LEGGED_GYM_ROOT_DIR}/toy.urdf'\nname = 'pup'\nfoot_name = 'foot'"
    control = "stiffness = {'hip': 21., 'thigh': 22., 'calf': 23.}\ndamping = {'_': 0.7}"
    result = migrated(sections(asset=lines, control=control), "--out", "there")
    commands = [line.removeprefix("  legged ") for line in result.out.splitlines() if line.startswith("  legged ")]
    assert len(commands) == 2
    for line in commands:
        assert call(legged.main, shlex.split(line)) == 0, capsys.readouterr().err
    out = capsys.readouterr().out
    assert "does not load yet" not in out
    assert read_yaml(Path("there/plain.yaml"))["control"]["stiffness"] == {"hip": 21.0, "thigh": 22.0, "calf": 23.0}


def test_a_robot_whose_feet_have_several_shapes(migrated):
    """`KeyError: Invalid name 'left_foot'`: a foot's name is that of no single shape."""
    lines = (
        "name = 'g1'\nfoot_name = 'ankle'\npenalize_contacts_on = ['hip', 'knee']\nterminate_after_contacts_on = ['pelvis']"
    )
    result = migrated(sections(asset=lines))
    assert "does not load yet" not in result.out
    assert "robot: g1 has" in result.out


# ---- running the file ----------------------------------------------------------------------------------------------------


def test_nothing_is_run_unless_asked_for(capsys):
    written("open('run.txt', 'w').write('x')\n" + BASE + FLAT)
    assert call(migrate.main, ["fork_config.py"]) == 2
    assert "migrate` runs fork_config.py and the modules that it imports; allow this with --run" in capsys.readouterr().err
    assert not Path("run.txt").exists()
    assert call(migrate.main, ["fork_config.py", "--run"]) == 0
    assert Path("run.txt").exists()


FAULTS = [
    ("x = f'{1:{10**30}}'\n", "fork_config.py:1: the file does not run: ValueError: Too many decimal digits"),
    (
        "import sys\nprint('set ROBOT first')\nsys.exit(1)\n",
        "fork_config.py:3: the file does not run: SystemExit: 1; it printed: set ROBOT first",
    ),
    ("import os\nos._exit(7)\n", "fork_config.py: Python ended with code 7 while the file ran"),
    ("from .nowhere import x\n", "fork_config.py:1: the file does not run: ModuleNotFoundError"),
    ("def f(): f()\nf()\n", "fork_config.py:1: the file does not run: RecursionError"),
]


@pytest.mark.parametrize(("text", "words"), FAULTS, ids=[entry[1].rpartition(": ")[2] for entry in FAULTS])
def test_code_that_fails_is_one_line_with_its_place(refused, text, words):
    assert words in refused(written(text + BASE + FLAT))


def test_values_that_cannot_be_told_are_listed(migrated):
    text = sections(env="num_envs = wandb.config.envs", control="decimation = [0] * 10**6", sim="dt = object()")
    result = migrated("import wandb\n" + text)
    assert any("env.num_envs: comes from wandb.config.envs, which is not installed" in line for line in result.lost)
    assert any("control.decimation: is too large" in line for line in result.lost)
    assert any("sim.dt: is of type object" in line for line in result.lost)


def test_values_that_are_computed_are_taken(migrated):
    text = "import numpy as np\nfrom pathlib import Path\n" + sections(
        terrain="measure_heights = True\nmeasured_points_x = np.linspace(-0.5, 0.5, 3)\n"
        "measured_points_y = [i / 10 for i in range(2)]",
        env="num_envs = int(np.float32(3)) * len(Path('a/b').parts)",
    )
    data = migrated(text).data
    assert data["terrain"] == {"measured_points_x": [-0.5, 0.0, 0.5], "measured_points_y": [0.0, 0.1]}
    assert data["env"] == {"num_envs": 6}


def test_an_installed_package_gets_no_stand_in_for_its_optional_parts(migrated):
    """A package that finds out what there is must not find stand-ins."""
    written("import importlib.util\nfound = importlib.util.find_spec('nowhere_at_all')\n", "site-packages/probing.py")
    text = "import sys\nsys.path.append('site-packages')\nimport probing\n" + sections(
        env="num_envs = 8 if probing.found is None else 9"
    )
    assert migrated(text).data["env"] == {"num_envs": 8}


def test_legged_gyms_classes_stand_in_for_those_that_are_missing(migrated):
    text = " ".join(migrated(ANYMAL_FLAT).text.replace("\n#", " ").split())
    assert "AnymalCRoughCfg, AnymalCRoughCfgPPO from legged_gym v1.0.2." in text
