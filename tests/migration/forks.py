"""Configurations in the style of legged_gym and its forks, and the tasks that they become."""

import re
from pathlib import Path

import torch

from legged import registry
from legged.config.yaml_files import read_yaml
from legged.registry import make_task, task_config

BASE = "from legged_gym.envs.base.legged_robot_config import LeggedRobotCfg, LeggedRobotCfgPPO\n"
FLAT = """
class PlainCfg(LeggedRobotCfg):
    class env(LeggedRobotCfg.env):
        num_observations = 48
    class terrain(LeggedRobotCfg.terrain):
        mesh_type = 'plane'
        measure_heights = False
    class asset(LeggedRobotCfg.asset):
        file = '{LEGGED_GYM_ROOT_DIR}/resources/robots/anymal_c/urdf/anymal_c.urdf'
        name = 'anymal_c'
        self_collisions = 1
"""

ANYMAL_FLAT = """
from legged_gym.envs import AnymalCRoughCfg, AnymalCRoughCfgPPO

class AnymalCFlatCfg( AnymalCRoughCfg ):
    class env( AnymalCRoughCfg.env ):
        num_observations = 48

    class terrain( AnymalCRoughCfg.terrain ):
        mesh_type = 'plane'
        measure_heights = False

    class asset( AnymalCRoughCfg.asset ):
        self_collisions = 0

    class rewards( AnymalCRoughCfg.rewards ):
        max_contact_force = 350.
        class scales ( AnymalCRoughCfg.rewards.scales ):
            orientation = -5.0
            torques = -0.000025
            feet_air_time = 2.

    class commands( AnymalCRoughCfg.commands ):
        heading_command = False
        resampling_time = 4.
        class ranges( AnymalCRoughCfg.commands.ranges ):
            ang_vel_yaw = [-1.5, 1.5]

    class domain_rand( AnymalCRoughCfg.domain_rand):
        friction_range = [0., 1.5]

class AnymalCFlatCfgPPO( AnymalCRoughCfgPPO ):
    class policy( AnymalCRoughCfgPPO.policy ):
        actor_hidden_dims = [128, 64, 32]
        critic_hidden_dims = [128, 64, 32]
    class runner ( AnymalCRoughCfgPPO.runner):
        experiment_name = 'flat_anymal_c'
        max_iterations = 300
"""

GO2 = """
import numpy as np
from legged_gym.envs.base.legged_robot_config import LeggedRobotCfg, LeggedRobotCfgPPO

KP = 40.
LEGS = ('LF', 'LH', 'RF', 'RH')

class Go2RoughCfg(LeggedRobotCfg):
    class env(LeggedRobotCfg.env):
        num_one_step = 45
        num_observations = num_one_step * 6
        num_privileged_obs = 3 + num_one_step + 187
    class init_state(LeggedRobotCfg.init_state):
        pos = [0.0, 0.0, 0.62]
        default_joint_angles = {**{f'{leg}_HAA': 0.1 for leg in LEGS},
                                **{f'{leg}_HFE': 0.5 if 'F_' in leg + '_' else -0.5 for leg in LEGS}, 'torso_joint': 0.}
    class control(LeggedRobotCfg.control):
        stiffness = {'H': KP, 'KFE': 2 * KP, 'wheel': 1.}
        damping = {'HAA': 1., 'HFE': 1., 'KFE': 1.}
        action_scale = 0.25
        hip_reduction = 0.5
    class commands(LeggedRobotCfg.commands):
        curriculum = True
        max_curriculum = 2.
        class ranges(LeggedRobotCfg.commands.ranges):
            ang_vel_yaw = [-np.pi / 2, np.pi / 2]
            body_pitch = [-0.1, 0.1]
    class asset(LeggedRobotCfg.asset):
        file = '{LEGGED_GYM_ROOT_DIR}/resources/robots/hound/urdf/hound.urdf'
        name = 'hound_of_them'
        foot_name = 'FOOT'
        penalize_contacts_on = ['THIGH', 'tail']
        terminate_after_contacts_on = ['base']
        self_collisions = 1
    class domain_rand(LeggedRobotCfg.domain_rand):
        randomize_payload_mass = True
        payload_mass_range = [-1, 2]
        randomize_link_mass = True
        link_mass_range = [0.9, 1.1]
        randomize_motor_strength = True
        motor_strength_range = [0.8, 1.2]
        randomize_restitution = False
        restitution_range = [0., 1.]
        randomize_com_displacement = True
        com_displacement_range = [-0.05, 0.05]
    class rewards(LeggedRobotCfg.rewards):
        base_height_target = 0.5
        clearance_height_target = -0.2
        class scales:
            tracking_lin_vel = 1.0
            tracking_ang_vel = 0.5
            lin_vel_z = -2.0
            ang_vel_xy = -0.05
            dof_acc = -2.5e-7
            joint_power = -2e-5
            feet_stumble = -0.1
            action_rate = -0.01

class Go2RoughCfgPPO(LeggedRobotCfgPPO):
    runner_class_name = 'HIMOnPolicyRunner'
    class policy:
        init_noise_std = 0.8
        rnn_type = 'lstm'
        rnn_hidden_size = 64
    class runner(LeggedRobotCfgPPO.runner):
        policy_class_name = 'ActorCriticRecurrent'
        max_iterations = 200000
        resume = True
"""

MIXINS = """
from .base_config import OurBase, Learner

class Tall:
    class init_state:
        pos = [0., 0., 0.7]

class Rough:
    class terrain(OurBase.terrain):
        mesh_type = 'heightfield'
        num_rows, num_cols = 4, 10
        terrain_proportions = [0.1, 0., 0., 0., 0.5, 0.1, 0.1, 0.1, 0.05, 0.05]

class MixedCfg(Tall, Rough, OurBase):
    class commands(OurBase.commands):
        resampling_time = OurBase.commands.resampling_time / 2

class OtherCfg(OurBase):
    pass
"""
OUR_BASE = """
from isaacgym import gymapi

class OurBase:
    class env:
        num_envs = 1024
        num_observations = 48
        num_actions = 12
        episode_length_s = 10
    class terrain:
        mesh_type = 'plane'
        measure_heights = False
    class commands:
        resampling_time = 8.
        heading_command = False
    class asset:
        name = 'anymal_c'
        foot_name = 'FOOT'

class Learner:
    class algorithm:
        learning_rate = 5e-4
"""

REGISTERED = """
from legged_gym.envs.base.legged_robot import LeggedRobot
from .mine.config import ACfg, BCfg, SharedPPO
from legged_gym.utils.task_registry import task_registry
task_registry.register("a_walks", LeggedRobot, ACfg(), SharedPPO())
task_registry.register("b_walks", LeggedRobot, BCfg(), SharedPPO())
"""
TWO = (
    BASE
    + FLAT.replace("PlainCfg", "ACfg")
    + (
        "class BCfg(ACfg):\n    class sim(ACfg.sim):\n        dt = 0.002\n"
        "class SharedPPO(LeggedRobotCfgPPO):\n    seed = 5\n"
        "class OtherPPO(LeggedRobotCfgPPO):\n    seed = 6\n"
    )
)


def written(text: str, path: str = "fork_config.py") -> str:
    file = Path(path)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)
    return path


def sections(**sections: str) -> str:
    """A configuration like FLAT with lines of sections added: commands='x = 1'."""
    text = FLAT
    for name, lines in sections.items():
        if f"    class {name}(" in text:
            for line in lines.splitlines():
                text = re.sub(rf"        {line.partition(' = ')[0]} = .*\n", "", text)
                text = re.sub(rf"(    class {name}\(.*\n)", rf"\1        {line}\n", text)
        else:
            inherited = f"LeggedRobotCfg.{name}"
            body = "\n".join(f"        {line}" for line in lines.splitlines())
            text += f"    class {name}({inherited}):\n{body}\n"
    return BASE + text


def line_of(text: str, part: str) -> int:
    return next(i for i, line in enumerate(text.splitlines(), 1) if part in line)


class Result:
    """What the command wrote and said."""

    def __init__(self, out: str) -> None:
        self.out = out
        self.path = Path(re.search(r"written: (\S+),", out)[1])
        self.data = read_yaml(self.path)
        self.text = self.path.read_text()
        self.lost = [line.removeprefix("not mapped: ") for line in out.splitlines() if line.startswith("not mapped: ")]
        plain = re.search(r"without counterpart \(.*\): (.*)", out)
        self.plain = plain[1].split(", ") if plain else []


def built(result: Result, *overrides):
    """The task of a migrated file, with two robots on the C engine, after two steps."""
    small = [("env.num_envs", 2), ("sim.physics", "mujoco"), ("sim.threads", 1), ("train.algorithm.num_mini_batches", 1)]
    if result.data.get("terrain", {}).get("mesh_type") == "height_map":
        small += [("terrain.border_size", 5.0)]
    registry.register_file(str(result.path))
    torch.set_num_threads(1)
    task = make_task(task_config(result.path.stem, [*small, *overrides], on_cpu=True))
    for _ in range(2):
        task.step(torch.zeros(2, task.num_actions))
    return task
