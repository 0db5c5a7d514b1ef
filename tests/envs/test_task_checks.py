"""What is wrong with a user's task class or its settings is said in one line before anything is built."""

from dataclasses import dataclass, field

import pytest
import torch
from helpers import TASK, small_config

import legged
from legged.config.legged import LeggedConfig
from legged.config.task import TaskConfig
from legged.envs import BaseTask, LeggedRobot
from legged.envs.half_cheetah import HalfCheetah
from legged.errors import ConfigError
from legged.physics.fields import FIELDS
from legged.policies.restore import TrainedPolicy, restore, undisturbed
from legged.process.paths import data_folder
from legged.registry import make_task, register, task_class, task_config

ENGINE = [("sim.physics", "mujoco"), ("sim.threads", 1), ("env.num_envs", 2)]


@pytest.fixture(autouse=True)
def own_registry(monkeypatch):
    monkeypatch.setattr(legged.registry, "_REGISTERED", {})


@dataclass(frozen=True)
class Gait:
    """A section."""

    frequency: float = field(default=2.0, metadata={"min": 0.1, "max": 10.0})


@dataclass(frozen=True)
class GaitConfig(LeggedConfig):
    """A schema with it."""

    gait: Gait = Gait()


class Forgotten(LeggedConfig):
    """A schema without its decorator."""

    gait: Gait = Gait()


def test_a_class_brings_sections_of_its_own():
    register("gaits", {"extends": TASK, "gait": {"frequency": 3.0}}, type("Gaits", (LeggedRobot,), {"Config": GaitConfig}))
    register("child", {"extends": "gaits"})
    assert task_config("child", on_cpu=True).gait.frequency == 3.0
    with pytest.raises(ConfigError, match=r"command line: gait\.frequency: must be at most 10"):
        task_config("child", [("gait.frequency", 11)], on_cpu=True)


@pytest.mark.parametrize("schema", [TaskConfig, Forgotten, object, None, GaitConfig()])
def test_a_schema_that_is_none_is_refused_by_class(schema):
    register("mine", {"extends": TASK}, type("Mine", (LeggedRobot,), {"Config": schema}))
    with pytest.raises(ConfigError, match=r"Mine\.Config: expected LeggedConfig, or a class with @dataclass"):
        task_config("mine", on_cpu=True)


def test_a_class_of_a_user_does_not_take_the_place_of_ours():
    register("other", {"class": "HalfCheetah"}, type("HalfCheetah", (BaseTask,), {}))
    assert task_class("half_cheetah") is HalfCheetah
    assert task_class("other") is not HalfCheetah


@pytest.mark.parametrize(
    ("task", "field_name", "limits", "text"),
    [
        (
            TASK,
            "friction",
            [-1.0, 1.0],
            r"ranges\.friction: its lowest value, -1 .* makes geom_friction -1",
        ),
        (
            "humanoid",
            "link_mass",
            [0.0, 1.0],
            r"ranges\.link_mass: its lowest value, 0 .* makes body_mass 0",
        ),
        ("half_cheetah", "added_base_mass", [0.0, 1.0], r"ranges\.added_base_mass: .*half_cheetah\.xml has no floating base"),
    ],
)
def test_ranges_are_held_against_the_model(task, field_name, limits, text):
    cfg = task_config(task, [*ENGINE, (f"domain_rand.ranges.{field_name}", limits)], on_cpu=True)
    with pytest.raises(ConfigError, match=rf"command line: domain_rand\.{text}"):
        make_task(cfg)


def test_who_asked_for_an_engine_that_cannot_is_named():
    cfg = task_config("half_cheetah", [("sim.physics", "newton"), ("env.num_envs", 2)], on_cpu=True)
    with pytest.raises(ConfigError, match=r"command line: sim\.physics: newton simulates robots with a floating base"):
        make_task(cfg)


@pytest.mark.slow
def test_a_policy_is_measured_on_the_nominal_model_unless_told_otherwise(tmp_path):
    cfg = small_config(*((f"domain_rand.ranges.{name}", [0.9, 1.1]) for name in ("friction", "link_mass")))
    folder = data_folder("resources") / "policies" / TASK
    policy = TrainedPolicy(cfg, folder / "model.pt")
    task, _ = restore(policy, undisturbed(policy.cfg, 2, 1.0), torch.device("cpu"))
    assert task.randomization.fields == {}
    other, _ = restore(
        policy, [*undisturbed(policy.cfg, 2, 1.0), ("domain_rand.ranges.friction", [0.7, 0.7])], torch.device("cpu")
    )
    assert list(other.randomization.fields) == ["friction"]


def test_a_metric_that_every_task_has_is_refused():
    kind = type("Mine", (LeggedRobot,), {"_metric_falls": lambda self: self.rew_buf})
    with pytest.raises(ConfigError, match=r"Mine\._metric_falls: every task logs Metrics/falls already"):
        kind.check(small_config())


def test_a_quantity_that_there_is_not_is_refused():
    kind = type("Mine", (HalfCheetah,), {"QUANTITIES": ("cvell",)})
    with pytest.raises(ConfigError, match=r"Mine\.QUANTITIES: there is no quantity 'cvell'; did you mean 'cvel'"):
        kind.check(task_config("half_cheetah", on_cpu=True))


def test_a_term_ends_episodes_in_one_way_only():
    with pytest.raises(ConfigError, match=r"terminations\.time_outs: 'contact' is also in terminations\.failures"):
        small_config(("terminations.time_outs", ["contact"]))


@pytest.mark.slow
def test_an_own_limit_is_kept_where_ours_is_off():
    own = {"_terminate_tilt": lambda self: self.projected_gravity[:, 2] > 0.0}
    task = type("Mine", (LeggedRobot,), own)(small_config())
    assert "tilt" in task.terminations.names
    assert "tilt" not in LeggedRobot(small_config()).terminations.names


def test_a_state_that_does_not_fit_leaves_physics_and_what_was_drawn_in_step():
    task = small_task_randomised()
    state = task.state_dict()
    state["randomization"]["friction"] = torch.full((4,), 5.0)
    state["task"] = {}
    with pytest.raises(legged.state.StateError):
        task.load_state_dict(state)
    shapes = task.physics.batch.expand("geom_friction")[:, task.physics.model.geom("LF_FOOT").id, 0]
    assert shapes.tolist() == pytest.approx(task.randomization.friction.tolist())


def small_task_randomised():
    return LeggedRobot(small_config(("domain_rand.randomize_friction", True)))


def test_every_field_can_be_asked_for():
    assert {"friction", "added_base_mass", "actuator_gain"} <= set(FIELDS)
