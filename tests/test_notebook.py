"""The notebook runs from its first to its last cell, and is kept without outputs."""

import base64
import json
import os
from importlib.util import find_spec
from pathlib import Path

import pytest
from helpers import HANG_S, TINY_TRAINING

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOK = ROOT / "docs" / "notebooks" / "first_walk.ipynb"
SMALL = f"""
TASK = "anymal_c_flat"
TRAINING = ["--num_envs", "8", "--max_iterations", "2", "--sim_device", "cpu", *{TINY_TRAINING!r}]
PLAYING = ["--num_envs", "1", "--sim_device", "cpu", "sim.physics=mujoco", "sim.threads=1"]
EVALUATION = ["--vx=0.5", "--vy=0", "--yaw=0", "--robots", "2", "--physics", "mujoco", "sim.threads=1"]
"""


def test_outputs_are_stripped():
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert code
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in code)


@pytest.mark.skipif(not (find_spec("nbclient") and find_spec("ipykernel")), reason="needs nbclient and ipykernel")
def test_the_notebook_runs(tmp_path, monkeypatch):
    import nbformat
    from nbclient import NotebookClient

    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbformat.validate(notebook)
    (parameters,) = [cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", ())]
    parameters.source = SMALL
    NotebookClient(notebook, timeout=int(HANG_S), resources={"metadata": {"path": str(tmp_path)}}).execute()

    shown = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    pictures = [output.data["image/png"] for output in shown if "image/png" in output.get("data", {})]
    assert base64.b64decode(pictures[0]).startswith(b"\x89PNG")
    (video,) = [output.data["text/html"] for output in shown if "<video" in output.get("data", {}).get("text/html", "")]
    assert "data:video/mp4;base64," in video
    said = "".join(output.text for output in shown if output.output_type == "stream" and output.name == "stdout")
    assert said.count("finished after 2 iterations") == 2
    rows = [line.split() for line in said.splitlines()[-2:]]
    assert [row[0] for row in rows] == ["anymal_c_flat", "thrifty"]
    assert all(0.0 < float(row[1]) < 5.0 for row in rows)
    assert (
        "power"
        in (tmp_path / "logs" / "thrifty").joinpath(os.listdir(tmp_path / "logs" / "thrifty")[0], "config.yaml").read_text()
    )
