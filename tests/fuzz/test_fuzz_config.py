"""Drawn configurations: refused in one line, or a task that steps and learns."""

import math
from pathlib import Path

import pytest
import torch
import yaml
from draws import OVERRIDES, TEXTS, VALUES, changed_text
from helpers import TASK
from hypothesis import given
from hypothesis import strategies as st
from outcomes import refused_in_a_line

from legged.cli.train import train
from legged.config import from_dict, load_config, to_yaml
from legged.config.loader import parse_override
from legged.learning.runner import Runner
from legged.process.paths import data_folder
from legged.registry import make_task, task_config

pytestmark = pytest.mark.slow

TASKS = ["anymal_c_flat", "anymal_c", "anymal_c_proprio"]
CHEAP = [("sim.physics", "mujoco"), ("sim.threads", 1), ("env.num_envs", 4), ("train.runner.num_steps_per_env", 2)]


def small_enough(cfg) -> bool:
    """Whether a task of this configuration can be built within a fuzzer's patience and memory."""
    policy, terrain = cfg.train.policy, cfg.terrain
    layers = [*policy.actor_hidden_dims, *policy.critic_hidden_dims]
    cells = math.prod(
        count * size + 2.0 * terrain.border_size
        for count, size in ((terrain.num_rows, terrain.terrain_length), (terrain.num_cols, terrain.terrain_width))
    )
    return (
        cfg.control.decimation <= 20
        and all(group.history <= 20 for group in cfg.observations.groups.values())
        and all(size <= 256 for size in layers)
        and len(layers) <= 12
        and cfg.train.algorithm.num_learning_epochs * cfg.train.algorithm.num_mini_batches <= 50
        and len(terrain.measured_points_x) * len(terrain.measured_points_y) <= 500
        and (terrain.mesh_type == "plane" or cells / terrain.horizontal_scale**2 < 2e6)
        and max(cfg.sim.iterations, cfg.sim.ls_iterations) <= 100
        and cfg.domain_rand.friction_buckets <= 10_000
    )


@given(task=st.sampled_from(TASKS), overrides=OVERRIDES)
def test_an_override_is_refused_in_a_line_or_gives_a_task_that_learns(task, overrides):
    with refused_in_a_line():
        cfg = task_config(task, [*overrides, *CHEAP], on_cpu=True)
        assert from_dict(yaml.safe_load(to_yaml(cfg))) == cfg
        if not small_enough(cfg):
            return
        runner = Runner(make_task(cfg))
        runner.learn(1)
        for model in (runner.alg.actor, runner.alg.critic):
            assert all(torch.isfinite(tensor).all() for tensor in model.state_dict().values()), "weights are NaN"


@given(text=st.one_of(TEXTS, st.text(max_size=60), st.tuples(TEXTS, VALUES).map(lambda pair: f"{pair[0]}={pair[1]}")))
def test_any_text_for_an_override(text):
    with refused_in_a_line():
        parse_override(text)


YAML_TOKENS = st.one_of(
    TEXTS,
    VALUES.map(str),
    st.sampled_from(
        [
            "&a",
            "*a",
            "<<: *a",
            "- ",
            "? x",
            "!!python/object:os.system",
            "---",
            "...",
            "{",
            "]",
            "|",
            ">",
            "cpu:",
            "a: &a [*a]",
        ]
    ),
)


@given(data=st.data(), name=st.sampled_from([*TASKS, "anymal_c_blind"]))
def test_a_damaged_task_file(data, name, in_new_folder):
    text = data.draw(changed_text((data_folder("cfg") / f"{name}.yaml").read_text(), YAML_TOKENS))
    with in_new_folder():
        Path("mine.yaml").write_text(text, encoding="utf-8", errors="surrogatepass")
        with refused_in_a_line("mine.yaml"):
            load_config(Path("mine.yaml").resolve(), "mine", on_cpu=True)


@given(content=st.binary(max_size=200))
def test_any_bytes_for_a_task_file(content, in_new_folder):
    with in_new_folder():
        Path("mine.yaml").write_bytes(content)
        with refused_in_a_line("mine.yaml"):
            load_config(Path("mine.yaml").resolve(), "mine")


@given(data=VALUES)
def test_any_mapping_for_a_registered_task(data):
    if not isinstance(data, dict):
        data = {"robot": data}
    with refused_in_a_line():
        load_config({"extends": TASK, **data}, "mine", on_cpu=True)


FLAGS = ["--num_envs", "--seed", "--max_iterations", "--physics", "--solver", "--sim_device", "--rl_device", "--run_name"]
FLAGS += ["--experiment_name", "--load_run", "--checkpoint", "--task", "--import", "--runner"]
SWITCHES = ["--resume", "--headless", "--no-graph", "--show"]


@given(
    flags=st.lists(st.tuples(st.sampled_from(FLAGS), st.one_of(TEXTS, st.integers(-3, 40).map(str))), max_size=4),
    switches=st.lists(st.sampled_from(SWITCHES), max_size=2),
    overrides=OVERRIDES,
    with_overrides=st.booleans(),
)
def test_any_command_line_of_train(flags, switches, overrides, with_overrides, run, in_new_folder):
    texts = [f"{path}={yaml.safe_dump(value, default_flow_style=True, width=10**6).strip()}" for path, value in overrides]
    arguments = ["--task", TASK, "--sim_device", "cpu", "--show"]
    arguments += [text.removesuffix("...").strip() for text in texts] if with_overrides else []
    arguments += [part for flag in flags for part in flag] + switches
    with in_new_folder() as folder:
        outcome = run(train.main, arguments)
        assert not list(folder.iterdir()), "--show wrote something"
        assert outcome.code != 1
