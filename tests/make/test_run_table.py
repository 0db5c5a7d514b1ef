"""Many trainings in one table: means, the height of the stairs that are stated and Markdown, worked by hand."""

import json
import shutil
from dataclasses import replace

import pytest
from evaluated_run import EvaluatedRun, find_runs, read_run
from helpers import POLICY, POLICY_ITERATION, small_config
from run_table import markdown, stairs_height, summary

from legged.config import override
from legged.errors import ConfigError
from legged.learning.timing import Timing
from legged.robots.robot import load_robot

FLAT = small_config()
"""The base of its robot is to be 0.5 m high, so steps of 0.18 m are wanted."""
TIMING = Timing("anymal_c_flat", True, 4096, 300, False, 2_000_000, 5.0, 20.0, 27.0, "NVIDIA H200", 0)


def tracking(lin=(0.04, 0.1), ang=(0.03, 0.08), falls=0.001):
    errors = {name: dict(zip(("mean", "worst"), values, strict=True)) for name, values in (("lin", lin), ("ang", ang))}
    return {"rmse_lin": errors["lin"], "rmse_ang": errors["ang"], "falls": falls}


def rough(up, down, **figures):
    """An evaluation on terrain: size -> share, up and down."""
    types = {
        name: {"points": [{"size": size, "share": share} for size, share in shares.items()]}
        for name, shares in (("stairs_up", up), ("stairs_down", down))
    }
    return {"rough": tracking(**figures), "success": {"types": types}}


def run(seed, results=None, timing=None, **other):
    return EvaluatedRun(FLAT, seed, None, timing, results or {}, **other)


def cells_of(text):
    """The rows of a table of Markdown, without the line below its head."""
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("|")]
    return [rows[0], *rows[2:]]


def test_a_seed_a_line_and_their_mean_with_the_worst_cell_of_all():
    runs = [
        run(1, {"mujoco_warp": tracking(), "mujoco": tracking(lin=(0.06, 0.2))}, TIMING),
        run(2, {"mujoco_warp": tracking((0.06, 0.15), (0.05, 0.06), 0.003)}, replace(TIMING, loop_s=30.0, start_up_s=7.0)),
    ]
    (task,) = summary(runs)
    assert (task["task"], task["robot"], task["stairs"]) == ("anymal_c_flat", "anymal_c", None)
    mean = task["mean"]
    assert mean["engines"]["mujoco_warp"] == {
        "rmse_lin": {"mean": pytest.approx(0.05), "worst": 0.15},
        "rmse_ang": {"mean": pytest.approx(0.04), "worst": 0.08},
        "falls": pytest.approx(0.002),
        "stairs": None,
    }
    assert mean["loop_s"] == 25.0
    assert mean["steps_per_s"] == pytest.approx((2e6 / 20 + 2e6 / 30) / 2)
    text = markdown([task])
    head, of_all, first, second = cells_of(text)
    assert head[:8] == ["task", "seed", "robots", "iterations", "loop [s]", "start-up [s]", "in all [s]", "steps/s"]
    assert head[8:10] == ["velocity RMSE [m/s], mujoco-warp", "velocity RMSE [m/s], C MuJoCo"]
    assert of_all[1:8] == ["mean of 2", "4,096", "300", "25.0", "6.0", "27.0", "83,333"]
    assert first[1:8] == ["1", "4,096", "300", "20.0", "5.0", "27.0", "100,000"]
    assert first[8:] == ["0.040 (0.100)", "0.060 (0.200)", "0.030 (0.080)", "0.030 (0.080)", "0.10", "0.10"]
    assert second[8:] == ["0.060 (0.150)", "-", "0.050 (0.060)", "-", "0.30", "-"]
    assert "Trained on NVIDIA H200. Errors:" in text
    assert "stairs" not in " ".join(head)
    json.dumps(task, allow_nan=False)


def test_success_is_that_of_the_next_larger_steps_which_all_were_measured_on():
    first = rough({0.1: 1.0, 0.15: 0.98, 0.2: 0.9, 0.25: 0.5}, {0.1: 1.0, 0.2: 1.0, 0.25: 0.8})
    second = rough({0.1: 1.0, 0.175: 0.9, 0.2: 0.7, 0.3: 0.1}, {0.175: 1.0, 0.2: 0.8, 0.3: 0.0})
    runs = [run(1, {"mujoco_warp": first, "mujoco": second}), run(2, {"mujoco_warp": second})]
    assert stairs_height(runs) == 0.2  # 0.18 m are wanted
    (task,) = summary(runs)
    height = load_robot("anymal_c").height
    assert task["stairs"] == {"size": 0.2, "share_of_height": pytest.approx(0.2 / height)}
    assert task["mean"]["engines"]["mujoco_warp"]["stairs"] == {"up": pytest.approx(0.8), "down": pytest.approx(0.9)}
    assert task["mean"]["engines"]["mujoco"]["stairs"] == {"up": 0.7, "down": 0.8}
    head, of_all, one, two = cells_of(markdown([task]))
    assert head[-3:] == ["stairs [m]", "up, down [%], mujoco-warp", "up, down [%], C MuJoCo"]
    assert of_all[-3:] == [f"0.200 = {0.2 / height:.2f} h", "80.0, 90.0", "70.0, 80.0"]
    assert (one[-2:], two[-2:]) == (["90.0, 100.0", "70.0, 80.0"], ["70.0, 80.0", "-"])

    cfg = override(FLAT, [("evaluation.stairs", 0.1)])
    assert stairs_height([replace(one, cfg=cfg) for one in runs]) == 0.2  # 0.05 m would do, but 0.1 was not all of them's
    assert stairs_height([*runs[:1], run(3, {"mujoco": rough({0.25: 1.0}, {0.25: 1.0})})]) is None
    assert stairs_height([run(1, {"mujoco": rough({0.1: 1.0}, {0.1: 1.0})})]) is None
    assert stairs_height([run(1)]) is None


def test_what_failed_is_a_line_and_no_part_of_the_mean():
    runs = [
        run(1, {"mujoco": tracking()}, TIMING, notes=("evaluation in mujoco_warp failed: no memory",)),
        run(2, failure="killed by SIGKILL"),
        run(3, {"mujoco": tracking(lin=(None, None), falls=1.0)}, replace(TIMING, beside=2, kernels_compiled=3)),
    ]
    (task,) = summary(runs)
    assert task["mean"]["seeds"] == 2
    assert task["mean"]["engines"]["mujoco"]["rmse_lin"] == {"mean": 0.04, "worst": 0.1}  # nobody was measured in the other
    text = markdown([task])
    _, of_all, _, failed, third = cells_of(text)
    assert failed[1:] == ["2", "4", str(FLAT.train.runner.max_iterations), "failed", *["-"] * 6]
    assert third[4:9] == ["20.0 +2", "5.0 *", "27.0", "100,000", "- (-)"]
    assert of_all[5] == "5.0 *"
    assert "- anymal_c_flat, seed 1: evaluation in mujoco_warp failed: no memory\n" in text
    assert "- anymal_c_flat, seed 2: training failed: killed by SIGKILL\n" in text
    assert "with a +" in text
    assert "with a *" in text


@pytest.mark.slow
def test_runs_are_found_in_folders_and_beside_shipped_policies(tmp_path):
    shipped = find_runs([POLICY])
    assert [(one.seed, sorted(one.results)[:2]) for one in shipped] == [(n, ["mujoco", "mujoco_warp"]) for n in (1, 2, 3)]
    assert not any(one.failure for one in shipped)
    folder = tmp_path / "logs" / "anymal_c_flat" / "now_s1"
    folder.mkdir(parents=True)
    shutil.copy(POLICY / "config.yaml", folder)
    assert read_run(folder).failure == "it left no checkpoint"
    shutil.copy(POLICY / "model.pt", folder / "model_99.pt")
    assert read_run(folder).failure == f"stopped after 100 of {POLICY_ITERATION + 1} iterations"
    shutil.copy(POLICY / "model.pt", folder / f"model_{POLICY_ITERATION}.pt")
    for path in (folder, folder.parent, tmp_path / "logs"):
        (found,) = find_runs([path])
        assert (found.folder, found.failure, found.timing) == (folder, "", None)
    with pytest.raises(ConfigError, match="nowhere: holds no run folder"):
        find_runs([tmp_path / "nowhere"])


def test_an_evaluation_of_another_checkpoint_is_neither_in_the_table_nor_shipped(tmp_path):
    """As after evaluate --checkpoint best: it is not what the policy that would be shipped is worth."""
    for name in ("config.yaml", "evaluation_mujoco.json"):
        shutil.copy(POLICY / name, tmp_path)
    shutil.copy(POLICY / "model.pt", tmp_path / f"model_{POLICY_ITERATION}.pt")
    assert [*read_run(tmp_path).results] == ["mujoco"]
    path = tmp_path / "evaluation_mujoco.json"
    path.write_text(path.read_text().replace(f'"model_{POLICY_ITERATION}.pt"', '"model_best.pt"'))
    found = read_run(tmp_path)
    assert not found.results
    assert found.notes == ("its evaluation in mujoco is of model_best.pt, not of its last policy",)


def test_an_evaluation_with_changed_fields_is_left_out_and_one_on_another_grid_is_named(tmp_path):
    """As after evaluate --out <run folder>, and after evaluate --vx=0.5."""
    for name in ("config.yaml", "model.pt", "evaluation_mujoco.json", "evaluation_mujoco_warp.json"):
        shutil.copy(POLICY / name, tmp_path)
    assert read_run(tmp_path).notes == ()
    changed, other_grid = (tmp_path / f"evaluation_{engine}.json" for engine in ("mujoco", "mujoco_warp"))
    changed.write_text(json.dumps(json.loads(changed.read_text()) | {"changes": {"sim.dt": 0.002}}))
    one = {"vx": [0.5], "vy": [0.0], "yaw": [0.0]}
    other_grid.write_text(json.dumps(json.loads(other_grid.read_text()) | {"grid": one}))
    found = read_run(tmp_path)
    assert [*found.results] == ["mujoco_warp"]
    assert found.notes == (
        "its evaluation in mujoco_warp is not on its task's grid of commands, but on vx 0.5, vy 0, yaw 0 (1 command)",
        "its evaluation in mujoco was made with sim.dt=0.002, and is left out",
    )


def test_a_run_that_is_named_twice_is_one_seed(tmp_path):
    """Itself and by the folder above it; of the shipped one, its other seeds come once as well."""
    folder = tmp_path / "logs" / "run"
    folder.mkdir(parents=True)
    for name in ("config.yaml", "model.pt"):
        shutil.copy(POLICY / name, folder)
    assert [found.folder for found in find_runs([folder.parent, folder, tmp_path])] == [folder]
    assert [found.seed for found in find_runs([POLICY, POLICY / ".." / POLICY.name])] == [1, 2, 3]


def test_a_task_without_commands_is_no_line(tmp_path):
    with pytest.raises(ConfigError, match="'half_cheetah' follows no commands"):
        find_runs([POLICY.parent / "half_cheetah"])


def test_among_others_a_task_without_commands_is_left_out_and_named(tmp_path, capsys):
    for task in ("half_cheetah", "anymal_c_flat"):
        (tmp_path / task).mkdir()
        for name in ("config.yaml", "model.pt"):
            shutil.copy(POLICY.parent / task / name, tmp_path / task)
    (found,) = find_runs([tmp_path])
    assert found.folder == tmp_path / "anymal_c_flat"
    assert capsys.readouterr().err == f"left out, because their tasks follow no commands: {tmp_path / 'half_cheetah'}\n"
    shutil.rmtree(tmp_path / "anymal_c_flat")
    with pytest.raises(ConfigError, match="'half_cheetah' follows no commands"):  # nothing is left
        find_runs([tmp_path])


def test_among_others_a_run_that_this_version_cannot_read_is_left_out_and_why(tmp_path, capsys):
    for name in ("new", "old"):
        (tmp_path / name).mkdir()
        for file in ("config.yaml", "model.pt"):
            shutil.copy(POLICY / file, tmp_path / name)
    path = tmp_path / "old" / "config.yaml"
    path.write_text(path.read_text().replace("env:", "evn:", 1))
    (found,) = find_runs([tmp_path])
    assert found.folder == tmp_path / "new"
    said = capsys.readouterr().err
    assert said.startswith(f"left out, because its configuration can't be read ({path}: ")
    assert "did you mean 'env'" in said
    assert said.endswith(f"): {tmp_path / 'old'}\n")
    with pytest.raises(ConfigError, match="did you mean 'env'"):  # it was asked for by itself
        find_runs([tmp_path / "old"])
