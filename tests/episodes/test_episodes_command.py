"""The command: records, lists, makes pages, sums up joints; and refuses what cannot be before anything is built."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from helpers import POLICY, TASK, call, tiny_run

from legged.cli.episodes import compare, list_, record, statistics
from legged.episodes.stored import ABOUT, ARRAYS
from legged.errors import RunError
from legged.policies import restore

pytestmark = pytest.mark.usefixtures("workplace")
FEW = ["--physics", "mujoco", "--episodes", "3", "--num-envs", "2", "sim.threads=1"]
HERE = [str(POLICY), *FEW, "env.episode_length_s=1.2"]


@pytest.mark.slow
def test_a_policy_is_recorded_listed_and_summed_up(capsys):
    assert call(record.main, [*HERE, "--out", "out", "--sort", "energy"]) == 0
    out = capsys.readouterr().out
    assert "3 episodes, 0 failed; ended: 3 by time; by energy" in out
    assert call(statistics.main, ["out", "--out", "out"]) == 0
    assert {path.name for path in Path("out").iterdir()} == {
        ARRAYS,
        ABOUT,
        "episodes.yaml",
        "episodes.md",
        "joint_statistics.md",
        "joint_statistics.html",
        "joint_statistics.png",
    }
    about = json.loads(Path("out", ABOUT).read_text())
    assert (about["task"], about["checkpoint"], about["physics"], about["robots"]) == (TASK, "model.pt", "mujoco", 2)
    with np.load(Path("out", ARRAYS)) as file:
        assert np.diff(file["episode_start"]).tolist() == [60, 60, 60]
        work = np.abs(file["torque"] * file["joint_vel"]).sum(axis=1).reshape(3, 60).sum(axis=1) * about["dt"]
    rows = [line.split("|")[1:-1] for line in Path("out/episodes.md").read_text().splitlines() if re.match(r"\| \d", line)]
    assert [int(row[0]) for row in rows] == np.argsort(-work).tolist()
    assert [float(row[6]) for row in rows] == pytest.approx(sorted(work, reverse=True), abs=0.6)
    page = Path("out/joint_statistics.html").read_text()
    assert "data:image/png;base64," in page
    assert not re.findall(r"""(?:src|href)=["'](?!data:)""", page), "it fetches nothing"


@pytest.mark.slow
def test_a_run_has_its_episodes_beside_it_and_they_are_listed_again(capsys, monkeypatch):
    run = tiny_run("env.episode_length_s=0.4")
    capsys.readouterr()
    assert call(record.main, [TASK, *FEW]) == 0
    assert (run / "episodes" / ARRAYS).is_file()
    monkeypatch.setattr(restore, "make_task", lambda *_: pytest.fail("simulated"))
    capsys.readouterr()
    assert call(list_.main, [str(run / "episodes"), "--sort", "torque", "--top", "1"]) == 0
    out = capsys.readouterr().out
    assert len(re.findall(r"(?m)^│ +\d+ │", out)) == 1
    assert call(list_.main, [str(run / "episodes"), "--page", "3"]) == 2
    assert "--page: there is no episode 3; episodes are numbered 0 to 2" in capsys.readouterr().err


@pytest.mark.slow
def test_a_page_says_what_was_changed_for_its_episodes(capsys):
    tiny_run("env.episode_length_s=0.1")
    asked = ["observations.add_noise=true", "domain_rand.push_robots=true"]
    assert call(record.main, [TASK, *FEW, "--page", "0", "--out", "out", *asked]) == 0
    about = json.loads(Path("out/episodes.json").read_text())
    assert about["changes"] == {"observations.add_noise": True, "domain_rand.push_robots": True}
    said = "randomisation, but with domain_rand.push_robots=True, observations.add_noise=True"
    assert said in Path("out/episode_000.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_where_nothing_can_be_drawn_a_page_has_a_stick_figure(monkeypatch, capsys):
    def fail(*_):
        raise RunError("cannot render here")

    monkeypatch.setattr("legged.episodes.page.camera_of", fail)
    assert call(record.main, [*HERE, "--out", "out", "--worst", "1"]) == 0
    (page,) = Path("out").glob("episode_*.html")
    text = page.read_text()
    data = json.loads(text.partition('id="data">')[2].partition("</script>")[0])
    assert data["film"]["why"] == "cannot render here"
    parents, places = data["film"]["parents"], np.array(data["film"]["places"])
    assert places.shape == (len(range(0, 60, data["film"]["every"])), len(parents), 3)
    assert parents[0] == -1
    assert all(0 <= parent < i for i, parent in enumerate(parents) if i)
    with np.load(Path("out", ARRAYS)) as file:
        number = int(page.stem.rpartition("_")[2])
        base = file["qpos"][file["episode_start"][number], :3]
    np.testing.assert_allclose(places[0, 0], base, atol=6e-4)


@pytest.mark.slow
def test_other_tasks_show_what_they_have(capsys, monkeypatch):
    monkeypatch.setattr("legged.episodes.page.MOST_PICTURES", 4)
    policy = POLICY.parent / "half_cheetah"
    few = [str(policy), *FEW, "env.episode_length_s=1"]
    assert call(record.main, [*few, "--out", "out", "--page", "0"]) == 0
    assert "mean power [W]" in Path("out/episodes.md").read_text()
    text = Path("out/episode_000.html").read_text()
    data = json.loads(text.partition('id="data">')[2].partition("</script>")[0])
    assert [section["title"] for section in data["sections"]][:3] == ["Generalised coordinates", "Reward parts", "Torques"]
    assert data["steps"] == 20
    assert len(data["film"].get("pictures") or data["film"]["places"]) == 4
    capsys.readouterr()
    assert call(list_.main, ["out", "--sort", "tracking"]) == 2
    assert "--sort: tracking: these episodes have no such figure" in capsys.readouterr().err


def test_a_table_of_all_steps_is_written(monkeypatch, capsys):
    parquet = pytest.importorskip("pyarrow.parquet")
    assert call(record.main, [*HERE, "--out", "out", "--parquet"]) == 0
    table = parquet.read_table("out/episodes.parquet").to_pydict()
    with np.load("out/episodes.npz") as file:
        for column, want in (
            ("torque.LF_KFE", file["torque"][:, 2]),
            ("feet_force.RH_FOOT.z", file["feet_force"][:, 3, 2]),
            ("reward", file["reward"]),
            ("episode", file["episode"]),
            ("qpos.root.qw", file["qpos"][:, 3]),
        ):
            np.testing.assert_array_equal(table[column], want, err_msg=column)


def test_without_its_package_a_table_is_refused(monkeypatch, capsys):
    monkeypatch.setattr("legged.cli.episodes.find_spec", lambda _: None)
    assert call(record.main, [*HERE, "--parquet"]) == 2
    assert capsys.readouterr().err == (
        "error: --parquet: needs pyarrow, which is not installed; run `pip install 'legged[parquet]'`\n"
    )


@pytest.mark.slow
def test_two_policies_are_compared(capsys):
    changes = ["env.episode_length_s=1.2", *FEW]
    assert call(record.main, [*HERE, "--out", "out"]) == 0
    other = str(POLICY.parent / "anymal_c_step")
    assert call(compare.main, ["out", other, *changes, "--out", "both"]) == 0
    text = Path("both/joint_statistics.md").read_text().replace("\\", "")
    assert "difference of the means" in text
    assert "anymal_c_flat (shipped)" in text
    assert "anymal_c_step (shipped)" in text
    capsys.readouterr()
    cheetah = str(POLICY.parent / "half_cheetah")
    assert call(compare.main, ["out", cheetah, "--episodes", "1", "--physics", "mujoco", "sim.threads=1"]) == 2
    assert "POLICY: the joints of the two policies differ" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["anymal_c_flt"], "POLICY: there is no task and no run 'anymal_c_flt'; did you mean 'anymal_c_flat'?"),
        ([*HERE, "--sort", "energi"], "--sort: cannot sort by 'energi'; did you mean 'energy'?"),
        ([*HERE, "--episodes", "0"], "--episodes: must be at least 1, got 0"),
        ([*HERE, "--episodes", "100000"], "--episodes: must be at most 4,096, got 100,000"),
        ([*HERE, "--num-envs", "9"], "--num-envs: 9 robots are too many for 3 episodes"),
        ([*HERE, "--ended", "contakt"], "--ended: contakt: no such term ends episodes; did you mean 'contact'?"),
        ([*HERE, "--page", "two"], "--page: expected numbers of episodes like 3 or 3,17, got 'two'"),
        ([*HERE, "--page", "7"], "--page: there is no episode 7; episodes are numbered 0 to 2"),
        ([*HERE, "--top", "-1"], "--top: must be at least 0"),
        ([*HERE, "--command", "1,0,nan"], "--command: expected three numbers from -100 to 100 like 0.5,0,0.2; got '1,0,nan'"),
        ([*HERE, "--command", "1,0"], "--command: expected three numbers from -100 to 100 like 0.5,0,0.2; got '1,0'"),
        ([*HERE, "--terrain", "stares_up"], "--terrain: "),
        ([*HERE, "--as-trained", "--terrain", "pit"], "--terrain: --as-trained takes the ground of the training"),
        ([*HERE, "--difficulty", "2"], "--difficulty: must be between 0 and 1"),
        (["half_cheetah", "--command=-1,0,0"], "--command: 'half_cheetah' follows no commands"),
        (["half_cheetah", "--terrain", "pit"], "--terrain: 'half_cheetah' has no terrain to choose"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_built(arguments, words, capsys, monkeypatch):
    monkeypatch.setattr(restore, "make_task", lambda *_: pytest.fail("built"))
    assert call(record.main, arguments) == 2
    err = capsys.readouterr().err
    assert words in err
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("command", "arguments", "words"),
    [
        (list_, ["nowhere"], "FOLDER: nowhere holds no episodes.npz"),
        (list_, ["nowhere", "--sort", "energi"], "--sort: cannot sort by 'energi'; did you mean 'energy'?"),
        (list_, ["nowhere", "--episodes", "3"], "unrecognized arguments: --episodes"),
        (compare, ["a", "b"], "POLICY: there is no task and no run 'a'"),
        (compare, [TASK, "b"], "POLICY: there is no task and no run 'b'"),
        (compare, [TASK, TASK, "--worst", "1"], "unrecognized arguments: --worst"),
        (statistics, ["a", "--episodes", "0"], "--episodes: must be at least 1, got 0"),
        (statistics, ["a"], "POLICY: there is no task and no run 'a'"),
    ],
)
def test_the_other_commands_refuse_too(command, arguments, words, capsys, monkeypatch):
    monkeypatch.setattr(restore, "make_task", lambda *_: pytest.fail("built"))
    assert call(command.main, arguments) == 2
    assert words in capsys.readouterr().err
