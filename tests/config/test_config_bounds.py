"""Every number of the schema has bounds and a meaning; what is beyond them is refused with path, value and bound."""

import ast
import dataclasses
import math
import types
import typing
from pathlib import Path

import pytest
from helpers import TASK, small_config

from legged import config
from legged.config import LeggedConfig, load_config, override
from legged.config.bounds import FLOAT32_MAX
from legged.config.loader import nest
from legged.errors import ConfigError
from legged.registry import task_config
from legged.robots.robot import RobotFile

LIMIT = {"min": -1, "max": 1}


def fields_of(schema: type, prefix: str = "") -> dict[str, tuple[typing.Any, dataclasses.Field]]:
    """Dotted path -> (type, field), of all fields that are no sections."""
    found = {}
    hints = typing.get_type_hints(schema)
    for field in dataclasses.fields(schema):
        if not field.compare:
            continue
        entry = typing.get_args(hints[field.name])[1:]
        if dataclasses.is_dataclass(hints[field.name]):
            found |= fields_of(hints[field.name], f"{prefix}{field.name}.")
        elif entry and dataclasses.is_dataclass(entry[0]):  # a map of sections
            found |= fields_of(entry[0], f"{prefix}{field.name}.actor.")
        else:
            found[prefix + field.name] = hints[field.name], field
    return found


def numbers_in(kind: typing.Any) -> bool:
    return kind in (int, float) or any(numbers_in(part) for part in typing.get_args(kind))


def whole_in(kind: typing.Any) -> bool:
    return kind is int or any(whole_in(part) for part in typing.get_args(kind))


FIELDS = fields_of(LeggedConfig)
NUMBERS = {path: found for path, found in FIELDS.items() if numbers_in(found[0])}


def holding(kind: typing.Any, number: float) -> tuple[str, typing.Any]:
    """(what follows the path in an error, the value of a field of that type) for one number in it."""
    origin = typing.get_origin(kind)
    if origin is types.UnionType and any(dataclasses.is_dataclass(part) for part in typing.get_args(kind)):
        return holding(typing.get_args(kind)[0], number)  # the short form
    if origin is dict:
        at, value = holding(typing.get_args(kind)[1], number)
        return f".torques{at}", {"torques": value}
    if origin is tuple:
        items = typing.get_args(kind)
        return "[0]", [number] if items[1] is Ellipsis else [number] * len(items)
    return "", number


def test_the_fields_are_found():
    assert len(NUMBERS) > 70
    assert {"env.num_envs", "rewards.scales", "train.policy.actor_hidden_dims", "commands.ranges.heading"} <= set(NUMBERS)


@pytest.mark.parametrize("path", NUMBERS)
def test_every_number_has_finite_bounds_that_are_named(path):
    """Beyond them, and beyond what float32 or Python's floats hold."""
    kind, field = NUMBERS[path]
    for limit, sign in LIMIT.items():
        bound = field.metadata[limit]
        assert abs(bound) < FLOAT32_MAX
        whole = whole_in(kind)
        beyond = bound + sign if whole else bound + sign * max(1.0, abs(bound))
        for number in (beyond, sign * 10**400):
            at, value = holding(kind, number)
            with pytest.raises(ConfigError) as error:
                override(LeggedConfig(), [(path, value)])
            text = str(error.value)
            assert text.startswith(f"command line: {path}{at}: ")
            assert "got " in text
            assert "\n" not in text
            if number == beyond and not (limit == "min" and "above" in field.metadata):
                assert f"must be at {'most' if sign > 0 else 'least'} {bound}, got " in text


@pytest.mark.parametrize("path", [path for path, (kind, _) in NUMBERS.items() if kind is not int])
@pytest.mark.parametrize("number", [math.inf, -math.inf, math.nan, 1e308])
def test_no_number_may_be_infinite(path, number):
    at, value = holding(NUMBERS[path][0], number)
    with pytest.raises(ConfigError, match=path.replace(".", r"\.")) as error:
        override(LeggedConfig(), [(path, value)])
    assert str(error.value).startswith(f"command line: {path}{at}: ")


@pytest.mark.parametrize("value", [math.inf, math.nan, [1.0, {"a": -math.inf}], 10**400])
def test_not_even_in_the_free_space(value):
    with pytest.raises(ConfigError, match=r"command line: custom\.mine: expected finite numbers"):
        override(LeggedConfig(), [("custom.mine", value)])


def test_bounds_leave_room():
    """What large machines, small robots and long experiments ask for."""
    generous = [
        ("env.num_envs", 262_144),
        ("env.episode_length_s", 1e6),
        ("env.seed", 2**53),
        ("sim.dt", 0.0005),
        ("sim.threads", 512),
        ("control.decimation", 200),
        ("train.policy.actor_hidden_dims", [4096] * 8),
        ("train.runner.max_iterations", 1_000_000),
        ("rewards.scales.termination", -10_000),
        ("control.stiffness.J", 20_000),
        ("terrain.measured_points_x", [0.01 * i for i in range(400)]),
    ]
    cfg = override(LeggedConfig(), generous)
    assert cfg.env.num_envs == 262_144
    assert cfg.train.policy.actor_hidden_dims == (4096,) * 8


def test_fields_of_a_robot_are_bounded_too():
    for path, (kind, field) in fields_of(RobotFile).items():
        if numbers_in(kind):
            assert field.metadata["min"] < field.metadata["max"] < FLOAT32_MAX, path


def test_every_field_says_what_it_means():
    """A docstring right below it, in every dataclass of the schema."""
    for file in Path(config.__file__).parent.glob("*.py"):
        for cls in (node for node in ast.parse(file.read_text()).body if isinstance(node, ast.ClassDef)):
            if not cls.name.endswith("Config") and cls.name != "CommandRanges":
                continue
            for node, below in zip(cls.body, [*cls.body[1:], None], strict=True):
                if isinstance(node, ast.AnnAssign):
                    documented = isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant)
                    assert documented, f"{cls.name}.{node.target.id}"


# ---- lists and names -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("group", ["actor", "critic"])
def test_an_observation_named_twice_is_refused(group):
    with pytest.raises(ConfigError, match=rf"command line: observations\.groups\.{group}\.terms: 'dof_pos' is named twice"):
        small_config((f"observations.groups.{group}.terms", ["dof_pos", "dof_vel", "dof_pos"]))


def test_a_list_must_not_be_endless():
    with pytest.raises(ConfigError, match=r"actor_hidden_dims: must have at most 64 items, got 65"):
        override(LeggedConfig(), [("train.policy.actor_hidden_dims", [8] * 65)])


@pytest.mark.slow
@pytest.mark.parametrize("field", ["experiment_name", "run_name"])
@pytest.mark.parametrize("name", ["a/b", "a\\b", "..", ".hidden", "/abs", "a\nb", "a\x1b[31m", "x" * 101, " x", "\udcff"])
def test_a_folder_s_name_is_a_plain_name(field, name):
    with pytest.raises(ConfigError) as error:
        small_config((f"train.runner.{field}", name))
    text = str(error.value)
    assert text.startswith(f"command line: train.runner.{field}: expected a plain name")
    assert text.isprintable()


def test_plain_names_are_allowed():
    assert small_config(("train.runner.run_name", "läuft 2-3_b (lr=1e-3)")).train.runner.run_name.startswith("läuft")
    assert small_config(("train.runner.run_name", "")).train.runner.run_name == ""


# ---- what does not fit together ------------------------------------------------------------------------------------------


def test_the_lightest_base_must_weigh_something():
    """ANYmal C's base has 26.37 kg."""
    lightest = ("domain_rand.added_mass_range", [-26.3, 1.0])
    assert small_config(("domain_rand.randomize_base_mass", True), lightest)
    too_light = ("domain_rand.added_mass_range", [-26.4, 1.0])
    small_config(too_light)  # it is not drawn
    with pytest.raises(ConfigError, match=r"added_mass_range: the base of 'anymal_c' weighs 26\.37 kg.*got -26\.4"):
        small_config(("domain_rand.randomize_base_mass", True), too_light)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ([("sim.nconmax", 10_000)], "sim.nconmax: 10000 for each of 1000000 robots"),
        ([("sim.njmax", 3000)], "sim.njmax: 3000 for each of 1000000 robots"),
        ([("train.runner.num_steps_per_env", 300)], "train.runner.num_steps_per_env: 300 steps of 1000000 robots"),
    ],
)
def test_sizes_that_no_engine_numbers_are_refused(changes, words):
    with pytest.raises(ConfigError, match="command line") as error:
        small_config(*changes, num_envs=1_000_000)
    assert words in str(error.value)


@pytest.mark.parametrize("network", ["actor", "critic"])
def test_weights_are_counted(network):
    """Four times 16384^2 are 2^30, as many as there may be."""
    path = f"train.policy.{network}_hidden_dims"
    assert small_config((path, [16384] * 5))
    with pytest.raises(ConfigError, match=rf"command line: {path}: these widths make 1,342,177,280 weights"):
        small_config((path, [16384] * 6))


def test_measuring_points_are_counted():
    grid = [("terrain.measured_points_x", [0.1] * 101), ("terrain.measured_points_y", [0.0] * 100)]
    with pytest.raises(ConfigError, match=r"measured_points_x: the height scan has 10,100 points"):
        small_config(*grid)


# ---- one layer must not hide another's mistake ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("wrong", "hiding"),
    [
        (("env", 3), ("env.num_envs", 4)),
        (("train.runner", 3), ("train.runner.max_iterations", 4)),
        (("train.runner", None), ("train.runner.loop", "stock")),
        (("rewards.scales", []), ("rewards.scales.torques", -1.0)),
        (("env.num_envs", "many"), ("env.num_envs", 4)),
        (("sim.dt", -1.0), ("sim.dt", 0.005)),
        (("observations.groups.actor.terms", []), ("observations.groups.actor.terms", ["dof_pos"])),
    ],
)
def test_a_later_override_hides_no_earlier_one(wrong, hiding):
    with pytest.raises(ConfigError) as error:
        small_config(wrong, hiding)
    assert str(error.value).startswith(f"command line: {wrong[0]}: ")


@pytest.mark.parametrize("on_cpu", [False, True])
@pytest.mark.parametrize(
    "wrong", [("env.num_envs", -5), ("env.num_envs", "many"), ("commands.ranges.lin_vel_x", [1, -1]), ("env.number", 3)]
)
def test_a_file_s_mistake_is_named_under_its_parent_s_cpu_section(tmp_path, wrong, on_cpu):
    """`anymal_c_flat` sets the first three on a CPU."""
    mine = {"extends": TASK, **nest(*wrong)}
    path = tmp_path / "mine.yaml"
    path.write_text(config.yaml_files.dump(mine))
    with pytest.raises(ConfigError) as error:
        load_config(path, "mine", on_cpu=on_cpu)
    assert str(error.value).startswith(f"{path}: {wrong[0]}: ")


@pytest.mark.parametrize("section", ["cpu:", "cpu: 3", "cpu: []", "cpu: {env: 3}", "cpu: {cpu: {}}", "cpu: {task: other}"])
def test_a_wrong_cpu_section_is_named(tmp_path, section):
    path = tmp_path / "mine.yaml"
    path.write_text(f"extends: {TASK}\n{section}\n")
    with pytest.raises(ConfigError) as error:
        load_config(path, "mine")
    assert str(error.value).startswith(f"{path}: cpu: ")


def test_a_task_is_named_by_its_file(tmp_path):
    """The key `task` is in the configuration of a run, which somebody may copy."""
    for name in ("mine", "child"):
        (tmp_path / f"{name}.yaml").write_text(f"extends: {TASK if name == 'mine' else 'mine.yaml'}\ntask: {name}\n")
        assert load_config(tmp_path / f"{name}.yaml", name).task == name
    path = tmp_path / "mine.yaml"
    path.write_text(f"extends: {TASK}\ntask: {TASK}\n")
    for name in ("mine", "child"):
        with pytest.raises(ConfigError) as error:
            load_config(tmp_path / f"{name}.yaml", name)
        assert str(error.value).startswith(f"{path}: task: the name of this task is 'mine', got '{TASK}'; remove this key")


def test_keys_are_text(tmp_path):
    path = tmp_path / "mine.yaml"
    for text, words in (
        ("1: 2", "1: unknown key 1"),
        ("rewards: {scales: {1: 2}}", "rewards.scales: expected a mapping whose keys are text"),
    ):
        path.write_text(text)
        with pytest.raises(ConfigError, match=words):
            load_config(path, "mine")


def test_sections_inside_each_other_end_somewhere():
    with pytest.raises(ConfigError, match="nested sections"):
        small_config((".".join(["custom"] + ["a"] * 5000), 1))
    endless: dict = {}
    endless["a"] = endless
    with pytest.raises(ConfigError, match="nested"):
        load_config({"extends": TASK, "custom": endless}, "mine")


@pytest.mark.parametrize("axis", [[1.0, -1.0, 0.5], [-1.0, 1.0, 0.0], [-1.0, 1.0, -0.5]])
def test_an_axis_of_the_command_grid_goes_from_low_to_high_in_steps(axis):
    with pytest.raises(ConfigError) as error:
        task_config(TASK, [("evaluation.vy", axis)])
    expected = "expected [low, high, step] with low <= high and step > 0"
    assert str(error.value) == f"command line: evaluation.vy: {expected}, got {axis}"


def test_an_axis_of_the_command_grid_has_a_limited_number_of_values():
    with pytest.raises(ConfigError, match=r"^command line: evaluation\.yaw: .* makes 20,001 values; at most 10,000"):
        task_config(TASK, [("evaluation.yaw", [-10.0, 10.0, 0.001])])


def test_a_number_in_a_map_names_the_file_that_set_it(tmp_path):
    """Beside entries of the map from other sources."""
    path = tmp_path / "mine.yaml"
    path.write_text(f"extends: {TASK}\nrewards: {{scales: {{torques: -1.0e-4, collision: -1.0e+30}}}}\n")
    with pytest.raises(ConfigError) as error:
        load_config(path, "mine")
    assert str(error.value) == f"{path}: rewards.scales.collision: must be at least -1000000.0, got -1e+30"
    with pytest.raises(ConfigError, match=r"^command line: rewards\.scales\.torques: must be at most"):
        small_config(("rewards.scales.torques", 1e30))


def test_the_nearest_key_may_be_one_that_only_files_have(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(f"extend: {TASK}\n")
    with pytest.raises(ConfigError, match=r"mine\.yaml: extend: unknown key 'extend'; did you mean 'extends'\?"):
        load_config(path, "mine")
