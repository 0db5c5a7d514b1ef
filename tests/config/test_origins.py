"""Errors name who set the value: a file of the chain, its cpu section, the command line, a run's configuration, or nobody."""

import pytest

from legged import registry
from legged.config import load_config, override, to_dict
from legged.config.origins import Origins
from legged.errors import ConfigError
from legged.learning.run_folder import run_config
from legged.process.paths import data_folder

BASES = data_folder("cfg") / "base"
ROUGH = BASES / "quadruped_rough.yaml"
"""What anymal_c extends, which extends what stands beside it."""


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """mine(text): registers the task 'mine', a YAML file that extends anymal_c; returns the file."""
    monkeypatch.setattr(registry, "_REGISTERED", {})

    def mine(text: str):
        path = tmp_path / "mine.yaml"
        path.write_text(f"extends: anymal_c\n{text}\n")
        registry.register("mine", path)
        return path

    return mine


def error_of(*overrides, on_cpu=False) -> str:
    with pytest.raises(ConfigError) as caught:
        registry.task_config("mine", overrides, on_cpu)
    return str(caught.value)


# ---- what is kept ----------------------------------------------------------------------------------------------------


def test_who_set_a_field_a_section_an_item_or_nothing():
    origins = Origins()
    origins.note("a.b", "one")
    origins.note("a.list", "two")
    origins.note("ab", "three")
    assert [origins.of(path) for path in ("a.b", "a.list[3]", "a", "ab")] == ["one", "two", "one, two", "three"]
    assert origins.of("a.c") == origins.of("a.b.c") == "the default"
    assert origins.where("a.b") == "one: a.b"
    origins.note("a.list", "one")
    assert origins.of("a") == "one"  # each once


def test_what_is_replaced_is_forgotten():
    origins = Origins({"a.b": "one", "a.c": "one"})
    origins.note("a", "two")
    assert origins == {"a": "two"}
    origins.note("a.d", "three")
    assert origins == {"a.d": "three"}


def test_a_configuration_knows_its_origins_but_they_are_no_setting(mine):
    path = mine("env: {num_envs: 7}")
    cfg = registry.task_config("mine", [("sim.dt", 0.004)])
    assert cfg.origins.of("env.num_envs") == str(path)
    assert cfg.origins.of("terrain.proportions.gap") == cfg.origins.of("env.seed") == "the default"
    assert cfg.origins.of("terrain.mesh_type") == str(ROUGH)
    assert cfg.origins.of("rewards.scales") == f"{ROUGH}, {BASES / 'quadruped_flat.yaml'}"
    assert override(cfg, [("env.seed", 3)]).origins.of("env") == f"{path}, command line"
    assert cfg.origins.of("env") == str(path)  # the original is left alone
    assert "origins" not in to_dict(cfg)
    path.write_text("origins: {env: me}\n")
    with pytest.raises(ConfigError, match=r"mine\.yaml: origins: unknown key 'origins'"):
        load_config(path, "mine")


# ---- mistakes that are found with the whole configuration -----------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("robot: anymal_cc", "robot: there is no robot 'anymal_cc'; did you mean 'anymal_c'?"),
        (
            "rewards: {scales: {torqes: 1}}",
            "rewards.scales.torqes: LeggedRobot has no reward 'torqes'; did you mean 'torques'",
        ),
        (
            "observations: {groups: {actor: {terms: [dof_poss]}}}",
            "observations.groups.actor.terms: LeggedRobot has no observation 'dof_poss'",
        ),
        ("observations: {noise: {dof_poss: 1}}", "observations.noise.dof_poss: LeggedRobot has no observation 'dof_poss'"),
        ("control: {stiffness: {XYZ: 1}}", "control.stiffness: pattern 'XYZ' matches nothing"),
        ("env: {episode_length_s: 0.001}", "env.episode_length_s: must be at least a control step of 0.02 s"),
        ("train: {algorithm: {num_mini_batches: 1000000}}", "train.algorithm.num_mini_batches: must be at most the 131072"),
        ("terrain: {proportions: {stair_up: 0.1}}", "terrain.proportions.stair_up: there is no terrain type 'stair_up'"),
        ("terrain: {border_size: 1}", "terrain.border_size: must be at least 2, got 1"),
    ],
)
def test_the_file_that_set_it_is_named(mine, text, message):
    path = mine(text)
    assert error_of().startswith(f"{path}: {message}")


def test_the_command_line_is_named(mine):
    mine("")
    assert error_of(("terrain.border_size", 1)).startswith("command line: terrain.border_size: must be at least 2")


def test_everyone_is_named_who_had_a_share_in_a_sum(mine):
    path = mine("terrain: {proportions: {gap: 0.2}}")
    message = error_of(("terrain.proportions.pit", 0.1))
    assert message.startswith(f"{ROUGH}, {path}, command line: terrain.proportions: must sum to 1, got 1.3")


def test_what_a_value_does_not_fit_is_named_too(mine):
    """Levels up to 5 by default, in 4 rows; a tile with starts too far apart for it."""
    path = mine("terrain: {num_rows: 4}")
    assert error_of() == f"the default: terrain.max_init_terrain_level: must be below num_rows = 4 ({path}), got 5"
    message = error_of(("terrain.num_rows", 10), ("terrain.spawn_range", 4))
    assert message.startswith("command line: terrain.spawn_range: ")
    assert message.endswith(f"(terrain_length = 8.0 ({ROUGH}), terrain_width = 8.0 ({ROUGH}))")
    message = error_of(("terrain.num_rows", 10), ("terrain.terrain_width", 2.5))
    assert message.startswith("command line: terrain.terrain_width: a tile of 8 x 2.5 m")
    assert message.endswith(f"(proportions.slope_up: {ROUGH})")
    message = error_of(("terrain.num_rows", 10), ("terrain.num_cols", 1))
    assert "is less than one column (num_cols = 1 (command line)" in message


def test_a_symmetry_that_the_points_break_is_asked_for_by_one_and_broken_by_another(mine):
    path = mine("terrain: {measured_points_y: [0.0, 0.1]}")
    message = error_of(("train.algorithm.symmetry", True))
    assert message.startswith(f"command line: train.algorithm.symmetry: terrain.measured_points_y ({path}) must be symmetric")


def test_a_cpu_section_is_blamed_on_the_file_that_it_stands_in(mine):
    """anymal_c and the flat task below it have one, too."""
    path = mine("cpu: {terrain: {max_init_terrain_level: 9}}")
    message = error_of(on_cpu=True)
    assert message == (f"{path}: cpu: terrain.max_init_terrain_level: must be below num_rows = 5 ({ROUGH}: cpu), got 9")
    registry.task_config("mine")  # the section does not count on a GPU
    path = mine("cpu: {env: {num_env: 9}}")
    assert error_of().startswith(f"{path}: cpu: env.num_env: unknown key")


def test_an_item_of_a_list_is_blamed_on_who_gave_the_list(mine):
    mine("observations: {clip: 5.0}")
    assert error_of(("observations.groups.actor.terms", ["dof_pos", 3])).startswith(
        "command line: observations.groups.actor.terms[1]: expected text"
    )


def test_a_robot_s_own_gains_are_blamed_on_its_file(robot, tmp_path):
    import shutil

    folder = shutil.copytree(robot.folder, tmp_path / "robot")
    file = folder / "robot.yaml"
    file.write_text(file.read_text().replace("stiffness: {", "stiffness: {XYZ: 1.0, "))
    with pytest.raises(ConfigError, match=r"robot\.yaml: stiffness: pattern 'XYZ' matches nothing"):
        registry.task_config("anymal_c_flat", [("robot", str(folder))])


def test_a_registered_mapping_is_named_with_its_task(monkeypatch):
    monkeypatch.setattr(registry, "_REGISTERED", {})
    registry.register("mine", {"extends": "anymal_c", "terrain": {"border_size": 1}})
    assert error_of().startswith("registered config of 'mine': terrain.border_size: must be at least 2")


def test_a_run_s_configuration_is_named(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text("task: anymal_c_flat\nrobot: anymal_c\nrewards: {scales: {torqes: 1}}\n")
    cfg = run_config(tmp_path)
    with pytest.raises(ConfigError) as caught:
        registry.task_class("anymal_c_flat").check(override(cfg, [("env.num_envs", 3)]))
    assert str(caught.value).startswith(f"{path}: rewards.scales.torqes: LeggedRobot has no reward")
