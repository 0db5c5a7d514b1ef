"""What the README and the pages of docs/ show works: the example task, commands, links, and the shipped policies."""

import json
import re
import shlex
from pathlib import Path

import pytest
import torch
from helpers import POLICY
from legged.tools import (
    benchmark,
    compare,
    episodes,
    evaluate,
    experiments,
    play,
    plot,
    report,
    show_terrain,
    train,
    warmup,
)

from legged import registry
from legged.registry import import_tasks, make_task, task_config

ROOT = Path(__file__).resolve().parents[1]
PAGES = {path: path.read_text(encoding="utf-8") for path in (*ROOT.glob("*.md"), *sorted((ROOT / "docs").glob("*.md")))}
README = PAGES[ROOT / "README.md"]
ONE_LINE = re.sub(r"(?<!`)`[^`]+`(?!`)", lambda code: code[0].replace("\n", " "), "\n".join(PAGES.values()))
"""All pages, without line ends in commands that are part of a sentence."""
TASKS = sorted(path.stem for path in (ROOT / "cfg").glob("*.yaml"))
ROUGH = ROOT / "resources" / "policies" / "anymal_c"


def test_the_example_task_trains_without_touching_the_package(tmp_path, monkeypatch):
    (code,) = re.findall(r"```python\n# slip.py\n(.*?)```", README, flags=re.DOTALL)
    path = tmp_path / "readme_tasks.py"
    path.write_text(code, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(registry, "_REGISTERED", {})
    options = [
        "train.runner.report=false",
        "env.num_envs=4",
        "train.runner.num_steps_per_env=4",
        "--max_iterations",
        "1",
        "--sim_device",
        "cpu",
    ]
    assert train.main(["--import", str(path), "--task", "careful", *options]) == 0
    assert list(tmp_path.glob("logs/careful/*/model_0.pt"))

    import_tasks(str(path))
    task_config("careful")  # with a GPU's settings
    task = make_task(task_config("careful", [("env.num_envs", 2), ("sim.physics", "mujoco")], on_cpu=True))
    assert "foot_slip" in task.rewards.names


def test_the_readme_is_short_and_its_tree_names_every_folder():
    assert len(README.splitlines()) <= 150
    (tree,) = re.findall(r"```text\n(train\.py .*?)```", README, flags=re.DOTALL)
    folders = {path.name for path in (ROOT / "legged").iterdir() if (path / "__init__.py").is_file()}
    assert set(re.findall(r"^  (\w+)/ +\w", tree, flags=re.MULTILINE)) == folders


def test_the_readme_names_every_task():
    first_cells = re.findall(r"^\| (`\w+`(?:, `\w+`)*) \| ", README, flags=re.MULTILINE)
    named = [name for cell in first_cells for name in re.findall(r"`(\w+)`", cell)]
    assert set(TASKS) <= set(named)


@pytest.mark.parametrize(
    ("name", "main"),
    [
        ("python train.py", train.main),
        ("python play.py", play.main),
        ("python -m legged.tools.evaluate", evaluate.main),
        ("python -m legged.tools.episodes", episodes.main),
        ("python -m legged.tools.benchmark", benchmark.main),
        ("python -m legged.tools.compare", compare.main),
        ("python -m legged.tools.plot", plot.main),
        ("python -m legged.tools.warmup", warmup.main),
        ("python -m legged.tools.show_terrain", show_terrain.main),
        ("python -m legged.tools.report", report.main),
        ("python -m legged.tools.experiments", experiments.main),
    ],
)
def test_every_flag_that_is_shown_exists(name, main, capsys):
    shown = {
        word.split("=")[0] for line in re.findall(rf"{re.escape(name)}([^\n`#&]*)", ONE_LINE) for word in shlex.split(line)
    }
    with pytest.raises(SystemExit) as stop:
        main(["--help"])
    assert stop.value.code == 0
    usage = capsys.readouterr().out
    for flag in sorted(word for word in shown if word.startswith("--")):
        assert re.search(rf"{flag}\b(?!-)", usage), f"{name} has no {flag}"


def test_links_and_pictures_are_there():
    for page, text in PAGES.items():
        for target in re.findall(r"\]\((?!http)([^)]+)\)", text):
            path = (page.parent / target.partition("#")[0]).resolve()
            assert path.is_file(), f"{page.name}: {target}"


def test_paths_in_the_text_are_there():
    """Whatever is written as code and begins with a folder of the repository is one of its files, or a task in Gymnasium."""
    for page, text in PAGES.items():
        for path in re.findall(r"`((?:legged|tests|docs|cfg|resources)/[\w./-]+)`", text):
            of_gymnasium = path.removeprefix("legged/") in TASKS
            assert (ROOT / path).exists() or of_gymnasium, f"{page.name}: {path}"


def test_shipped_policy_follows_commands_in_c_mujoco(tmp_path, capsys):
    grid = ["--vx=-1:1:1", "--vy=-1:1:1", "--yaw=-1:1:1", "--robots", "1", "--physics", "mujoco"]
    arguments = ["--task", "anymal_c_flat", "--load_run", str(POLICY), "--out", str(tmp_path), *grid]
    assert evaluate.main(arguments) == 0
    result = json.loads((tmp_path / "evaluation_mujoco.json").read_text())
    # 27 of the 125 cells, one robot each instead of 16: the corners and the axes, the hardest part of the grid.
    assert result["rmse_lin"]["mean"] < 0.10
    assert result["rmse_ang"]["mean"] < 0.12
    assert result["falls"] == 0.0


def test_shipped_policy_climbs_stairs_in_c_mujoco(tmp_path, monkeypatch):
    """Six robots of each step height; up to 0.15 m, all of them. 0.3 m is beyond what it can, so the test can tell."""
    monkeypatch.chdir(tmp_path)
    grid = ["--vx=0.5", "--vy=0", "--yaw=0", "--robots", "4", "--physics", "mujoco"]
    success = ["--types", "stairs_up", "--robots-per-point", "6"]
    assert evaluate.main(["--task", "anymal_c", "--load_run", str(ROUGH), "--out", ".", *grid, *success]) == 0
    result = json.loads(Path("evaluation_mujoco.json").read_text())
    share = {point["size"]: point["share"] for point in result["success"]["types"]["stairs_up"]["points"]}
    assert share[0.05] == share[0.1] == share[0.15] == 1.0
    assert share[0.3] < 1.0
    assert result["rough"]["rmse_lin"]["mean"] < 0.15
    assert result["rough"]["falls"] == 0.0


@pytest.mark.parametrize("policy", sorted(ROUGH.parent.iterdir()), ids=lambda path: path.name)
def test_shipped_checkpoint_is_finite_and_of_its_task(policy):
    saved = torch.load(policy / "model.pt", weights_only=True, map_location="cpu")
    assert saved["infos"]["task"] == policy.name
    assert all(torch.isfinite(tensor).all() for tensor in saved["actor_state_dict"].values())


def test_a_policy_without_its_optimiser_is_exported(tmp_path):
    """As the one for rough terrain is shipped."""
    assert "optimizer_state_dict" not in torch.load(ROUGH / "model.pt", weights_only=True, map_location="cpu")
    arguments = ["--task", "anymal_c", "--load_run", str(ROUGH), "--out", str(tmp_path), "--no-video", "--headless"]
    assert play.main([*arguments, "--terrain", "flat", "--num_envs", "1"]) == 0
    described = json.loads((tmp_path / "exported" / "policy.json").read_text())
    assert sum(term["size"] for term in described["observation"]) == 235
    assert described["observation_history"] == 1
