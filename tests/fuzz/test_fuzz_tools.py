"""Drawn command lines, damaged results and users' modules for the other commands: success, or one line."""

import json
import shutil
import sys
from pathlib import Path

import pytest
from draws import HOW, TEXTS, VALUES, changed_text, mutated, places
from helpers import TASK, TINY_TRAINING
from hypothesis import given
from hypothesis import strategies as st

from legged.cli.benchmark import step
from legged.cli.evaluate import checkpoints, grid
from legged.cli.evaluate import terrain as success
from legged.cli.play import play
from legged.cli.runs import compare, curves, evaluations, report
from legged.cli.runs import runs as table
from legged.cli.terrain import terrain
from legged.cli.train import train
from legged.process.paths import data_folder
from legged.registry import _REGISTERED

pytestmark = pytest.mark.slow

POLICIES = data_folder("resources") / "policies"
EVALUATIONS = [POLICIES / "anymal_c" / "evaluation_mujoco.json", POLICIES / TASK / "evaluation_mujoco.json"]
SMALL_NUMBERS = st.sampled_from(["-1", "0", "1", "2", "0.5", "1e9", "nan", "inf", "10000000000", "x", ""])


def flags_of(choices: dict[str, st.SearchStrategy[str]]) -> st.SearchStrategy[list[str]]:
    """Some flags with values, as `--flag=value`, so that a value may begin with a dash."""
    one = st.sampled_from(sorted(choices)).flatmap(lambda flag: choices[flag].map(lambda value: f"{flag}={value}"))
    return st.lists(one, max_size=3)


WORDS = st.one_of(TEXTS, SMALL_NUMBERS)
TYPES = st.lists(st.sampled_from(["stairs_up", "gap", "flat", "pit", "", "x", " "]), max_size=3).map(",".join)
GRID = st.one_of(st.sampled_from(["0", "0.5:0:1", "-1:1:1", "0:1:1e-9", "1:0:1", "0:inf:1", "1e30", ":", "0:0:0"]), WORDS)


@given(
    data=st.data(),
    how=HOW,
    value=VALUES,
    flags=flags_of({"--types": st.one_of(TYPES, WORDS), "--out": st.sampled_from(["a", "b/c", ".", "/proc/x"])}),
)
def test_a_table_of_a_damaged_evaluation(data, how, value, flags, run, in_new_folder):
    source = data.draw(st.sampled_from(EVALUATIONS))
    content = json.loads(source.read_text())
    content.get("rough", content)["cells"] = content.get("rough", content)["cells"][:2]
    path = data.draw(st.sampled_from(places(content)))
    with in_new_folder():
        Path("evaluation_mujoco.json").write_text(json.dumps(mutated(content, path, how, value)), encoding="utf-8")
        assert run(evaluations.main, ["evaluation_mujoco.json", str(source), *flags]).code in (0, 1, 2)


def damaged(data, path: Path) -> None:
    """Change some bytes of a file, and cut it off somewhere."""
    content = bytearray(path.read_bytes())
    for place in data.draw(st.lists(st.integers(0, len(content) - 1), max_size=4)):
        content[place] ^= data.draw(st.integers(1, 255))
    path.write_bytes(bytes(content[: data.draw(st.one_of(st.just(len(content)), st.integers(0, len(content))))]))


@given(data=st.data(), how=HOW, value=VALUES)
def test_reports_of_damaged_runs(data, how, value, trained, run, in_new_folder):
    """A report is made of whatever can still be read; two runs are compared whatever their evaluations hold."""
    source = data.draw(st.sampled_from(EVALUATIONS))
    content = json.loads(source.read_text())
    path = data.draw(st.sampled_from(places(content)))
    with in_new_folder() as folder:
        runs = [folder / "logs" / TASK / name for name in ("a", "b")]
        for one in runs:
            shutil.copytree(trained, one)
            shutil.copy(source, one / "evaluation_mujoco.json")
        (runs[0] / "evaluation_mujoco.json").write_text(json.dumps(mutated(content, path, how, value)), encoding="utf-8")
        files = [*runs[0].glob("events.*"), *(runs[0] / name for name in ("config.yaml", "timing.json", "code.diff"))]
        damaged(data, data.draw(st.sampled_from(files)))
        assert run(report.main, [str(one) for one in runs]).code == 0
        assert run(table.main, []).code == 0
        assert run(compare.main, [*map(str, runs)]).code == 0


@given(data=st.data(), out=st.sampled_from(["a", "b/c", ".", "/proc/a"]))
def test_curves_of_damaged_events(data, out, trained, run, in_new_folder):
    with in_new_folder() as folder:
        shutil.copytree(trained, folder / "run")
        (events,) = (folder / "run").glob("events.*")
        damaged(data, events)
        assert run(curves.main, ["run", "--out", out]).code in (0, 1, 2)


COMMON = {"--num-envs": SMALL_NUMBERS, "--seed": SMALL_NUMBERS}
NAMED = {"--checkpoint": SMALL_NUMBERS, "--load-run": WORDS, "--experiment-name": WORDS}
COMMANDS = {
    "evaluate grid": (
        grid.main,
        {"--vx": GRID, "--vy": GRID, "--robots": SMALL_NUMBERS, "--checkpoint": SMALL_NUMBERS},
        ["--yaw=0", "--robots=1", "--vx=0", "--vy=0"],
    ),
    "evaluate terrain": (
        success.main,
        {"--types": TYPES, "--robots-per-point": SMALL_NUMBERS, "--checkpoint": SMALL_NUMBERS},
        ["--robots-per-point=1"],
    ),
    "play": (
        play.main,
        {"--difficulty": SMALL_NUMBERS, "--terrain": st.one_of(TYPES, WORDS), "--checkpoint": SMALL_NUMBERS, "--out": WORDS}
        | NAMED,
        ["--no-video"],
    ),
    "evaluate checkpoints": (
        checkpoints.main,
        {"--rmse": SMALL_NUMBERS, "--falls": SMALL_NUMBERS},
        ["--robots=1", "--vx=0", "--vy=0"],
    ),
    "benchmark step": (
        step.main,
        {"--steps": SMALL_NUMBERS, "--repeats": SMALL_NUMBERS, "--iterations": SMALL_NUMBERS, "--out": WORDS},
        ["--num-envs=2", "--steps=1", "--repeats=1", "--iterations=0"],
    ),
    "terrain": (terrain.main, {"--types": TYPES, "--difficulty": SMALL_NUMBERS, "--out": WORDS}, []),
}


@given(data=st.data(), name=st.sampled_from(sorted(COMMANDS)))
def test_any_command_line(data, name, trained, run, in_new_folder):
    """Small settings come first; what is drawn, after them."""
    main, own, small = COMMANDS[name]
    others = {flag: values for flag, values in COMMON.items() if name != "terrain" or flag == "--seed"}
    flags = data.draw(flags_of({**others, **own}))
    expensive = {"--steps=1e9", "--steps=10000000000", "--repeats=10000000000", "--iterations=10000000000"}
    if expensive & {*flags}:
        return
    with in_new_folder() as folder:
        shutil.copytree(trained, folder / "logs" / TASK / "run")
        assert run(main, [TASK, "--sim-device", "cpu", "sim.threads=1", *small, *flags]).code in (0, 1, 2)


MODULE = f'''import torch
from torch import Tensor
from legged import LeggedRobot, register


class Mine(LeggedRobot):
    MIRRORED = {{**LeggedRobot.MIRRORED, "load": "feet"}}

    def __init__(self, *args, **kwargs):
        self.memory = 0.0
        super().__init__(*args, **kwargs)

    def _reward_slip(self) -> Tensor:
        speed = self.feet_vel[:, :, :2].square().sum(dim=2)
        return (speed * self.contacts.in_contact).sum(dim=1)

    def _obs_load(self) -> Tensor:
        return self.contact_forces[:, self.feet_indices, 2] / 100.0


register("mine", {{"extends": "{TASK}", "rewards": {{"scales": {{"slip": -0.1}}}},
    "observations": {{"critic": ["dof_pos", "dof_vel", "commands", "load"]}}}}, Mine)
'''
TOKENS = st.one_of(
    TEXTS,
    VALUES.map(repr),
    st.sampled_from(["self.base_pos", "float('nan')", "torch.zeros(3)", "self.nothing", "return", "raise ValueError(1)"]),
    st.sampled_from(["torch.rand(2)", "1 / 0", "exit()", "self.memory += 1", "dim=1)", "(", "print(1)", "import nothing"]),
)


@given(text=changed_text(MODULE, TOKENS))
def test_a_damaged_module_of_a_user(text, run, in_new_folder):
    before, path = dict(_REGISTERED), list(sys.path)
    try:
        with in_new_folder():
            Path("mine.py").write_text(text, encoding="utf-8", errors="replace")
            arguments = ["--import", "mine.py", "mine", "--sim-device", "cpu", "--num-envs", "4"]
            assert run(train.main, [*arguments, "--max-iterations", "1", *TINY_TRAINING]).code in (0, 1, 2)
    finally:
        _REGISTERED.clear()
        _REGISTERED.update(before)
        sys.path[:] = path
        sys.modules.pop("mine", None)
