"""docs/make/tables.py: tables from hand-made files, stale pages, and wrong markers."""

import json
import shutil
from pathlib import Path

import pytest
import tables

TIMING = {
    "task": "x",
    "finished": True,
    "resumed": False,
    "steps": 1,
    "robots": 4096,
    "iterations": 250,
    "start_up_s": 4.2,
    "loop_s": 17.61,
    "wall_s": 23.57,
    "device": "NVIDIA H200",
    "kernels_compiled": 0,
    "beside": 4,
}
POINTS = {"trained_to": 0.21, "points": [{"size": 0.1 * i, "share": 1.0 - 0.125 * i} for i in (1, 2, 3)]}


def evaluation(**changes):
    numbers = {"rmse_lin": {"mean": 0.0547, "worst": 0.1103}, "rmse_ang": {"mean": 0.0488, "worst": 0.0808}, "falls": 0.0005}
    return {"task": "x"} | numbers | changes


@pytest.fixture
def root(tmp_path):
    """A repository with a page, and writing(folder, name, result) for its policies."""
    (tmp_path / "docs").mkdir()
    (tmp_path / "README.md").write_text("# mine\n")
    return tmp_path


def write(root, folder, **files):
    place = root / "resources" / "policies" / folder
    place.mkdir(parents=True, exist_ok=True)
    (place / "config.yaml").write_text("env: {num_envs: 64}\ntrain: {runner: {max_iterations: 7}}\n")
    for name, result in files.items():
        (place / f"{name}.json").write_text(json.dumps(result))


def test_a_row_has_training_and_quality_of_the_shipped_run(root):
    """The other seed counts in the column of all seeds only; a policy without timing.json has no time."""
    for task in (f"{robot}_flat" for robot in tables.FLAT):
        write(root, task, timing=TIMING, evaluation_mujoco=evaluation(), evaluation_mujoco_warp=evaluation())
    second = evaluation(rmse_lin={"mean": 0.0347, "worst": 0.9})
    write(root, "a1_flat/seed_2", timing=TIMING | {"loop_s": 99.0}, evaluation_mujoco=second)
    write(root, "g1_flat", timing=TIMING | {"device": "NVIDIA H100 80GB HBM3", "kernels_compiled": 3, "beside": 0})
    (root / "resources/policies/h1_flat/timing.json").unlink()
    rows = {line.split("|")[1]: line for line in tables.flat(root / "resources/policies").splitlines()}
    quality = "0.055 (0.110)|0.049 (0.081)|0.05|0.055"
    assert rows["`a1_flat`"] == f"|`a1_flat`|H200|4096 x 250|24 (4, 17.6)|4|{quality}|0.045 (0.035 to 0.055)|"
    assert rows["`g1_flat`"] == f"|`g1_flat`|H100|4096 x 250|24 (4*, 17.6)|0|{quality}|-|"
    assert rows["`h1_flat`"] == f"|`h1_flat`|-|64 x 7|not recorded|-|{quality}|-|"


def test_success_is_that_of_the_last_trained_step_height_and_the_next(root):
    success = {"robots_per_point": 8, "types": dict.fromkeys(tables.CROSSED, POINTS)}
    for task in tables.REAL:
        write(root, task, timing=TIMING, evaluation_mujoco={"rough": evaluation(), "task": "x", "success": success})
    row = tables.real(root / "resources/policies").splitlines()[2]
    assert row.endswith("|0.055 (0.110)|0.049 (0.081)|0.05|0.20, 0.30|75, 62|75, 62|75, 62|8|")


def test_what_was_not_measured_is_a_dash():
    """Robots that all fell, terrain types and sizes that were not evaluated, and a single size beyond the training's."""
    assert tables.errors(evaluation(rmse_lin={"mean": None, "worst": None}, falls=1.0))[::2] == ["-", "100.00"]
    assert tables.crossings(evaluation()) == ["-"] * 5
    one = {"trained_to": None, "points": [{"size": 0.3, "share": 0.5}]}
    success = {"robots_per_point": 8, "types": {"stairs_up": one, "stairs_down": POINTS | {"points": []}}}
    assert tables.crossings(evaluation(success=success)) == ["0.30", "50", "-", "-", "8"]


def test_a_changed_digit_is_found_and_mended(root, capsys):
    shutil.copytree(tables.ROOT / "resources/policies/anymal_c_flat", root / "resources/policies/anymal_c_flat")
    page = root / "docs" / "results.md"
    page.write_text("# Results\n\n<!-- table: engines -->\n<!-- end -->\n\nThe end.\n")
    assert tables.main(["--check"], root) == 1
    assert tables.main([], root) == 0
    assert tables.main(["--check"], root) == 0
    text = page.read_text()
    assert text.startswith("# Results\n\n<!-- table: engines -->\n\n|trained in|")
    assert text.endswith("|\n\n<!-- end -->\n\nThe end.\n")
    capsys.readouterr()
    digit = next(i for i in range(text.index("(shipped)"), len(text)) if text[i].isdigit())
    page.write_text(text[:digit] + str((int(text[digit]) + 1) % 10) + text[digit + 1 :])
    assert tables.main(["--check"], root) == 1
    said = capsys.readouterr().out
    assert [line[0] for line in said.splitlines() if "(shipped)" in line] == ["-", "+"]
    assert page.read_text() != text  # --check writes nothing
    assert tables.main([], root) == 0
    assert page.read_text() == text


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<!-- table: enginess -->\n<!-- end -->\n", "docs/page.md: there is no table 'enginess'"),
        ("<!-- table: engines -->\n", "docs/page.md: the table 'engines' has no <!-- end -->"),
        ("<!-- table: engines -->\n<!-- table: flat -->\n<!-- end -->\n", "the table 'engines' has no <!-- end -->"),
        ("<!-- table: real -->\n<!-- end -->\n", "resources/policies/anymal_c_real/evaluation_mujoco.json is not there"),
    ],
)
def test_a_wrong_marker_or_a_missing_file_is_named(text, words, root, capsys):
    (root / "docs" / "page.md").write_text(text)
    assert tables.main([], root) == 2
    assert words in capsys.readouterr().err
    assert (root / "docs" / "page.md").read_text() == text


def test_every_table_is_on_a_page():
    pages = [tables.ROOT / "README.md", *Path(tables.ROOT / "docs").glob("*.md")]
    named = {match[2] for page in pages for match in tables.MARKED.finditer(page.read_text(encoding="utf-8"))}
    assert named == {*tables.TABLES}
