"""The notebook runs from its first to its last cell, and is kept without outputs."""

import base64
import json
import os
from importlib.util import find_spec
from pathlib import Path

import pytest
from helpers import HANG_S, TINY_TRAINING

SEARCH = {
    "trials": 2,
    "overrides": {
        "env.num_envs": 8,
        "sim.physics": "mujoco",
        "train.runner.max_iterations": 2,
        "train.runner.num_steps_per_env": 4,
        "train.runner.evaluate_interval": 1,
        "train.runner.evaluate_envs": 2,
    },
}
ROOT = Path(__file__).resolve().parents[1]
NOTEBOOK = ROOT / "docs" / "notebooks" / "first_walk.ipynb"
SMALL = {
    "anymal_c_flat": f"""
TASK = "anymal_c_flat"
TRAINING = ["--num-envs", "8", "--max-iterations", "2", "--sim-device", "cpu", *{TINY_TRAINING!r}]
PLAYING = ["--num-envs", "1", "--sim-device", "cpu", "sim.physics=mujoco", "sim.threads=1"]
EVALUATION = [f"evaluation.{{axis}}=[0, 0.5, 0.5]" for axis in ("vx", "vy", "yaw")]
EVALUATION += ["--physics", "mujoco", "sim.threads=1"]
SWEEP = {SEARCH!r}
""",
    "half_cheetah": f"""
TASK = "half_cheetah"
TRAINING = ["--num-envs", "8", "--max-iterations", "2", "--sim-device", "cpu", "sim.physics=mujoco", *{TINY_TRAINING!r}]
PLAYING = ["--num-envs", "1", "--sim-device", "cpu", "sim.physics=mujoco", "sim.threads=1", "env.episode_length_s=1"]
EVALUATION = ["--physics", "mujoco", "sim.threads=1", "env.episode_length_s=1"]
SWEEP = {SEARCH!r}
""",
}


def test_outputs_are_stripped():
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert code
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in code)


@pytest.mark.slow
@pytest.mark.skipif(not (find_spec("nbclient") and find_spec("ipykernel")), reason="needs nbclient and ipykernel")
@pytest.mark.parametrize("task", SMALL)
def test_the_notebook_runs(task, tmp_path, monkeypatch):
    import nbformat
    from nbclient import NotebookClient

    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbformat.validate(notebook)
    (parameters,) = [cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", ())]
    parameters.source = SMALL[task]
    NotebookClient(notebook, timeout=int(HANG_S), resources={"metadata": {"path": str(tmp_path)}}).execute()

    shown = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    pictures = [output.data["image/png"] for output in shown if "image/png" in output.get("data", {})]
    assert base64.b64decode(pictures[0]).startswith(b"\x89PNG")
    (video,) = [output.data["text/html"] for output in shown if "<video" in output.get("data", {}).get("text/html", "")]
    assert "data:video/mp4;base64," in video
    said = "".join(output.text for output in shown if output.output_type == "stream" and output.name == "stdout")
    assert said.count("finished after 2 iterations") == 2
    (table,) = [output.data["text/markdown"] for output in shown if "text/markdown" in output.get("data", {})]
    rows = [line.strip("| ").split(" | ") for line in table.splitlines()]
    assert [row[0] for row in rows[2:]] == [task, "calm"]
    assert rows[0][1] == ("return" if task == "half_cheetah" else "velocity RMSE [m/s]")
    assert all(abs(float(row[1])) < 1000.0 for row in rows[2:])
    assert len(pictures) >= 2  # curves, and a figure of the search
    assert (tmp_path / "logs" / "sweep_search" / "table.md").is_file()
    (run,) = (tmp_path / "logs" / "calm").iterdir()
    assert "effort: -0.05" in (run / "config.yaml").read_text()
