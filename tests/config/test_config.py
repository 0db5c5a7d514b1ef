"""Task files, what they extend, the cpu section, overrides; and that every mistake in them is named precisely."""

from pathlib import Path

import pytest
import yaml
from helpers import TASK

from legged import registry
from legged.config import LeggedConfig, TaskConfig, from_dict, load_config, override, parse_override, to_dict, to_yaml
from legged.config.loader import read_yaml
from legged.errors import ConfigError
from legged.process.paths import data_folder

SHIPPED = sorted(data_folder("cfg").glob("*.yaml"))


@pytest.fixture
def write(tmp_path):
    """Write a YAML file of that name into an empty folder."""

    def write(name: str, text: str) -> Path:
        path = tmp_path / f"{name}.yaml"
        path.write_text(text)
        return path

    return write


@pytest.fixture
def registered(monkeypatch):
    """The registry, without what a test registers after it."""
    monkeypatch.setattr(registry, "_REGISTERED", {})
    return registry


def error_of(source, overrides=(), on_cpu=False) -> str:
    with pytest.raises(ConfigError) as caught:
        load_config(source, "mine", overrides, on_cpu)
    return str(caught.value)


# ---- extends ---------------------------------------------------------------------------------------------------------


def test_maps_merge_over_the_parent_while_lists_and_scalars_replace(write):
    write(
        "parent",
        "robot: anymal_c\n"
        "rewards: {tracking_sigma: 0.5, scales: {torques: -0.1, lin_vel_z: -3.0}}\n"
        "observations: {groups: {actor: {terms: [base_lin_vel, commands, dof_pos]}}}\n"
        "domain_rand: {friction_range: [0.1, 0.2]}\n",
    )
    child = write(
        "child",
        "extends: parent\n"
        "rewards: {scales: {torques: -0.2}}\n"
        "observations: {groups: {actor: {terms: [dof_vel]}}}\n"
        "domain_rand: {friction_range: [0.7, 0.9]}\n",
    )
    cfg = load_config(child, "child")
    assert cfg.robot == "anymal_c"
    assert cfg.rewards.tracking_sigma == 0.5  # the parent's, untouched
    assert cfg.rewards.scales["torques"] == -0.2  # the child's
    assert cfg.rewards.scales["lin_vel_z"] == -3.0  # the parent's, beside it
    assert cfg.rewards.scales["action_rate"] == -0.01  # the schema's, below both
    assert cfg.observations.groups["actor"].terms == ("dof_vel",)
    assert cfg.observations.groups["actor"].noise
    assert cfg.domain_rand.friction_range == (0.7, 0.9)


def test_a_file_may_extend_a_task_of_the_package_from_anywhere(write):
    cfg = load_config(write("mine", f"extends: {TASK}\nrewards: {{scales: {{orientation: -7}}}}\n"), "mine")
    assert cfg.robot == "anymal_c"
    assert cfg.rewards.scales["orientation"] == -7.0
    assert (
        cfg.rewards.scales["feet_air_time"]
        == load_config(data_folder("cfg") / f"{TASK}.yaml", TASK).rewards.scales["feet_air_time"]
    )


def test_a_grandparent_is_reached_and_its_mistake_is_blamed_on_its_file(write):
    grand = write("grand", "rewards: {tracking_sigmaa: 1}\n")
    write("parent", "extends: grand\nenv: {num_envs: 3}\n")
    message = error_of(write("child", "extends: parent\n"))
    assert str(grand) in message
    assert "rewards.tracking_sigmaa" in message
    grand.write_text("rewards: {tracking_sigma: 0.125}\n")
    cfg = load_config(write("child", "extends: parent\n"), "child")
    assert (cfg.rewards.tracking_sigma, cfg.env.num_envs) == (0.125, 3)


def test_extending_in_a_circle_is_refused(write):
    write("one", "extends: two\n")
    message = error_of(write("two", "extends: one\n"))
    assert "extends itself" in message
    assert "one.yaml" in message
    assert "two.yaml" in message


def test_a_missing_parent_is_named_with_its_nearest_neighbour(write):
    message = error_of(write("mine", "extends: anymal_c_flaat\n"))
    assert "mine.yaml" in message
    assert "'anymal_c_flaat'" in message
    assert "did you mean 'anymal_c_flat'?" in message


def test_a_mapping_can_be_registered_and_extends_a_task(registered):
    config = {"extends": TASK, "env": {"num_envs": 5}, "rewards": {"scales": {"orientation": -1}}}
    registered.register("mine", config)
    cfg = registered.task_config("mine")
    assert cfg.task == "mine"
    assert cfg.robot == "anymal_c"
    assert cfg.env.num_envs == 5
    assert cfg.rewards.scales["orientation"] == -1.0
    assert config["extends"] == TASK  # the user's mapping is left alone
    assert "mine" in registered.task_names()
    assert TASK in registered.task_names()


def test_a_mistake_in_a_registered_mapping_names_its_task_or_source(registered):
    registered.register("mine", {"extends": TASK, "env": {"num_env": 5}})
    with pytest.raises(ConfigError, match=r"registered config.*env\.num_env\b.*did you mean 'num_envs'"):
        registered.task_config("mine")


# ---- numbers and overrides -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "value"), [("1e-4", 1e-4), ("-2E-5", -2e-5), ("+3e2", 300.0), (".5e1", 5.0), ("1.5e3", 1500.0), ("4e+1", 40.0)]
)
def test_an_exponent_without_a_dot_is_a_number(write, text, value):
    cfg = load_config(write("mine", f"rewards: {{scales: {{torques: {text}}}}}\n"), "mine")
    assert cfg.rewards.scales["torques"] == value
    assert parse_override(f"rewards.scales.torques={text}") == ("rewards.scales.torques", value)


def test_an_override_is_dotted_is_yaml_and_wins_over_everything(write):
    path = write("mine", "robot: anymal_c\nenv: {num_envs: 3}\ncpu: {env: {num_envs: 4}}\n")
    texts = [
        "env.num_envs=7",
        "rewards.only_positive_rewards=false",
        "commands.ranges.lin_vel_x=[-2, 1.5]",
        "custom.a.b=hello",
    ]
    cfg = load_config(path, "mine", [parse_override(text) for text in texts], on_cpu=True)
    assert cfg.env.num_envs == 7
    assert cfg.rewards.only_positive_rewards is False
    assert cfg.commands.ranges.lin_vel_x == (-2.0, 1.5)
    assert cfg.custom == {"a": {"b": "hello"}}


@pytest.mark.parametrize("text", ["env.num_envs", "=3", "env.num_envs=[1"])
def test_a_malformed_override_is_refused(text):
    with pytest.raises(ConfigError, match="command line"):
        parse_override(text)


def test_a_mistake_in_an_override_is_blamed_on_the_command_line(write):
    message = error_of(write("mine", "env: {num_envs: 3}\n"), [("env.num_envz", 1)])
    assert message.startswith("command line: env.num_envz: unknown key 'num_envz'")
    assert "did you mean 'num_envs'?" in message


# ---- rewards of one's own --------------------------------------------------------------------------------------------


def rewards_of(cfg) -> dict[str, float]:
    return {name: scale for name, scale in cfg.rewards.scales.items() if scale}


def test_with_own_rewards_only_the_scales_of_the_file_and_its_children_count(write):
    write(
        "first",
        "rewards: {tracking_sigma: 0.5, scales: {orientation: -3.0, torques: -1.0}}\n"
        "cpu: {rewards: {scales: {stumble: -1, dof_acc: -1}}}\n",
    )
    text = "extends: first\nown_rewards: true\nrewards: {scales: {torques: -0.2}}\ncpu: {rewards: {scales: {torques: -9}}}\n"
    own = load_config(write("own", text), "own")
    assert rewards_of(own) == {"torques": -0.2}
    assert own.rewards.tracking_sigma == 0.5
    assert "orientation" not in own.rewards.scales
    assert own.origins.where("rewards.scales.action_rate").endswith("own.yaml: rewards.scales.action_rate")
    assert rewards_of(from_dict(to_dict(own))) == {"torques": -0.2}
    child = load_config(write("child", "extends: own\nrewards: {scales: {collision: -1.0}}\n"), "child", on_cpu=True)
    assert rewards_of(child) == {"torques": -9.0, "collision": -1.0}


def test_own_rewards_need_no_parent_and_stand_at_the_top_of_a_file(write):
    assert rewards_of(load_config(write("alone", "own_rewards: true\n"), "alone")) == {}
    assert rewards_of(load_config({"own_rewards": False}, "same")) == LeggedConfig().rewards.scales
    assert error_of(write("mine", "own_rewards: 1\n")).endswith("mine.yaml: own_rewards: expected true or false, got 1")
    assert "cpu: own_rewards: unknown key" in error_of(write("mine", "cpu: {own_rewards: true}\n"))
    assert "rewards.own_rewards: unknown key" in error_of(write("mine", "rewards: {own_rewards: true}\n"))
    assert "command line: own_rewards: unknown key" in error_of(write("mine", ""), [("own_rewards", True)])


# ---- the cpu section -------------------------------------------------------------------------------------------------

CPU = "env: {num_envs: 100, seed: 5}\ncpu:\n  env: {num_envs: 10}\n  rewards: {scales: {torques: -9}}\n"


def test_the_cpu_section_is_laid_over_the_rest_on_a_cpu_only(write):
    path = write("mine", CPU)
    gpu, cpu = load_config(path, "mine"), load_config(path, "mine", on_cpu=True)
    assert (gpu.env.num_envs, gpu.env.seed, gpu.rewards.scales["torques"]) == (100, 5, -1e-5)
    assert (cpu.env.num_envs, cpu.env.seed, cpu.rewards.scales["torques"]) == (10, 5, -9.0)


def test_what_a_file_sets_is_not_changed_by_the_cpu_section_of_its_parent(write):
    """Two levels up as well; what it does not set is."""
    write("parent", "env: {num_envs: 10, episode_length_s: 5.0}\ncpu: {env: {num_envs: 11, episode_length_s: 6.0}}\n")
    write("child", "extends: parent\nenv: {num_envs: 12}\n")
    cfg = load_config(write("mine", "extends: child\n"), "mine", on_cpu=True)
    assert (cfg.env.num_envs, cfg.env.episode_length_s) == (12, 6.0)
    assert cfg.origins.where("env.episode_length_s").endswith("parent.yaml: cpu: env.episode_length_s")


def test_cpu_sections_of_parent_and_child_merge(write):
    write("parent", CPU)
    cfg = load_config(write("child", "extends: parent\ncpu: {env: {num_envs: 12}}\n"), "child", on_cpu=True)
    assert cfg.env.num_envs == 12
    assert cfg.rewards.scales["torques"] == -9.0


@pytest.mark.parametrize("on_cpu", [False, True])
@pytest.mark.parametrize(
    ("section", "words"),
    [("cpu: {env: {num_env: 1}}", "env.num_env"), ("cpu: {env: {num_envs: 0}}", "at least 1"), ("cpu: 3", "cpu")],
)
def test_the_cpu_section_is_checked_on_gpu_machines_too(write, section, words, on_cpu):
    message = error_of(write("mine", section + "\n"), on_cpu=on_cpu)
    assert "mine.yaml" in message
    assert words in message


# ---- mistakes --------------------------------------------------------------------------------------------------------


def test_an_unknown_key_names_file_path_nearest_name_and_what_is_allowed(write):
    path = write("mine", "commands:\n  curriculum: {treshold: 0.5}\n")
    message = error_of(path)
    assert message.startswith(f"{path}: commands.curriculum.treshold: unknown key 'treshold'")
    assert "did you mean 'threshold'?" in message
    for allowed in ("enabled", "start", "step", "window_s", "threshold"):
        assert allowed in message.partition("(allowed:")[2]


def test_an_unknown_section_is_an_unknown_key_of_the_top_level(write):
    message = error_of(write("mine", "reward: {}\n"))
    assert "reward: unknown key 'reward'; did you mean 'rewards'?" in message


def test_a_key_unlike_any_other_gets_no_suggestion_but_the_list(write):
    message = error_of(write("mine", "env: {zzz: 1}\n"))
    assert "did you mean" not in message
    assert "num_envs" in message


@pytest.mark.parametrize(
    ("text", "path", "words"),
    [
        ("env: {num_envs: many}", "env.num_envs", "expected a whole number, got 'many'"),
        ("env: {num_envs: 2.5}", "env.num_envs", "expected a whole number, got 2.5"),
        ("env: {num_envs: true}", "env.num_envs", "expected a whole number, got True"),
        ("sim: {dt: fast}", "sim.dt", "expected a number, got 'fast'"),
        ("sim: {dt: .nan}", "sim.dt", "expected a number"),
        ("sim: {dt: true}", "sim.dt", "expected a number, got True"),
        ("rewards: {only_positive_rewards: 1}", "rewards.only_positive_rewards", "expected true or false, got 1"),
        ("rewards: {scales: {torques: [1]}}", "rewards.scales.torques", "expected a number, got [1]"),
        ("rewards: {scales: 3}", "rewards.scales", "expected a mapping, got 3"),
        ("rewards: 3", "rewards", "expected a mapping"),
        ("robot: 3", "robot", "expected text, got 3"),
        (
            "observations: {groups: {actor: {terms: dof_pos}}}",
            "observations.groups.actor.terms",
            "expected a list, got 'dof_pos'",
        ),
        (
            "observations: {groups: {actor: {terms: [dof_pos, 3]}}}",
            "observations.groups.actor.terms[1]",
            "expected text, got 3",
        ),
        ("observations: {groups: {actor: 3}}", "observations.groups.actor", "expected a mapping with keys of"),
        ("observations: {groups: [actor]}", "observations.groups", "expected a mapping, got ['actor']"),
        ("domain_rand: {friction_range: [1]}", "domain_rand.friction_range", "expected a list of 2 numbers"),
        ("domain_rand: {friction_range: [a, 2]}", "domain_rand.friction_range[0]", "expected a number, got 'a'"),
        ("control: {control_type: X}", "control.control_type", "unknown value 'X'"),
        ("sim: {physics: mujoko}", "sim.physics", "did you mean 'mujoco'?"),
    ],
)
def test_a_wrong_type_names_file_path_and_what_was_expected(write, text, path, words):
    source = write("mine", text + "\n")
    message = error_of(source)
    assert message.startswith(f"{source}: {path}: ")
    assert words in message


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("env: {num_envs: 0}", "env.num_envs: must be at least 1, got 0"),
        ("sim: {dt: 0}", "sim.dt: must be above 0, got 0.0"),
        ("sim: {dt: -0.01}", "sim.dt: must be above 0, got -0.01"),
        ("commands: {standing_share: 1.1}", "commands.standing_share: must be at most 1, got 1.1"),
        ("commands: {standing_share: -0.1}", "commands.standing_share: must be at least 0, got -0.1"),
        ("train: {algorithm: {gamma: 2}}", "train.algorithm.gamma: must be at most 1, got 2.0"),
    ],
)
def test_a_number_out_of_bounds_names_the_bound(write, text, words):
    assert words in error_of(write("mine", text + "\n"))


def test_a_range_must_not_be_upside_down(write):
    message = error_of(write("mine", "commands: {ranges: {lin_vel_x: [1.0, -1.0]}}\n"))
    assert "commands.ranges.lin_vel_x: expected [low, high] with low <= high, got [1.0, -1.0]" in message
    assert load_config(write("mine", "commands: {ranges: {lin_vel_x: [0.5, 0.5]}}\n"), "mine").commands.ranges.lin_vel_x == (
        0.5,
        0.5,
    )


def test_a_key_given_twice_is_refused_with_file_key_and_line(write):
    path = write("mine", "env:\n  num_envs: 3\n  seed: 1\n  num_envs: 4\n")
    assert error_of(path) == f"{path}: key 'num_envs' is given twice in the block from line 2"


@pytest.mark.parametrize("text", ["env: [1", "a: b: c", "- 1\n- 2\n", "just text\n"])
def test_a_file_that_is_no_yaml_mapping_is_refused_by_name(write, text):
    path = write("mine", text)
    assert str(path) in error_of(path)


def test_a_file_that_is_not_text_is_refused_by_name(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_bytes(b"robot: \xff\xfe\x80\n")
    assert str(path) in error_of(path)


def test_a_missing_file_is_refused_by_name(tmp_path):
    assert "nowhere.yaml" in error_of(tmp_path / "nowhere.yaml")


# ---- written and read back -------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
@pytest.mark.parametrize("on_cpu", [False, True])
def test_every_shipped_task_loads_names_what_exists_and_survives_a_round_trip(path, on_cpu, tmp_path):
    cfg = registry.task_config(path.stem, on_cpu=on_cpu)
    assert cfg.task == path.stem
    written = tmp_path / "config.yaml"
    written.write_text(to_yaml(cfg))
    assert from_dict(read_yaml(written), schema=type(cfg)) == cfg
    assert from_dict(yaml.safe_load(to_yaml(cfg)), schema=type(cfg)) == cfg  # other readers of YAML understand it too


def test_the_round_trip_keeps_tiny_numbers_empty_maps_and_free_space():
    cfg = from_dict(
        {
            "rewards": {"scales": {"torques": -2.5e-7}},
            "custom": {"a": [1, {"b": None}]},
            "train": {"algorithm": {"learning_rate": 1e-5}},
        }
    )
    again = from_dict(yaml.safe_load(to_yaml(cfg)))
    assert again == cfg
    assert again.rewards.scales["torques"] == -2.5e-7
    assert again.custom == {"a": [1, {"b": None}]}


def test_a_default_configuration_is_the_schema_s():
    assert from_dict({}) == LeggedConfig()
    assert from_dict({}, schema=TaskConfig) == TaskConfig()
    assert to_dict(TaskConfig())["env"] == {"num_envs": 4096, "episode_length_s": 20.0, "seed": 1}
    assert TaskConfig().dt == pytest.approx(0.02)


def test_override_replaces_paths_checks_again_and_leaves_the_original():
    cfg = from_dict({"env": {"num_envs": 3}, "rewards": {"scales": {"torques": -1.0}}})
    changed = override(cfg, [("env.num_envs", 9), ("rewards.scales.lin_vel_z", -4)])
    assert changed.env.num_envs == 9
    assert changed.rewards.scales["lin_vel_z"] == -4.0
    assert changed.rewards.scales["torques"] == -1.0
    assert (cfg.env.num_envs, cfg.rewards.scales["lin_vel_z"]) == (3, -2.0)
    with pytest.raises(ConfigError, match=r"env\.num_envs: must be at least 1"):
        override(cfg, [("env.num_envs", 0)])
    with pytest.raises(ConfigError, match=r"env\.nope: unknown key"):
        override(cfg, [("env.nope", 0)])
