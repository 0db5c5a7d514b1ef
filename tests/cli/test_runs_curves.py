"""Curves of runs: what is read, averaged and drawn."""

import numpy as np
import pytest
import yaml
from PIL import Image
from torch.utils.tensorboard import SummaryWriter

from legged.cli.runs import curves
from legged.errors import ConfigError
from legged.evaluation import learning_curves
from legged.evaluation.learning_curves import levels, outcomes


def write_run(folder, levels):
    """TensorBoard files of a run on terrain: five iterations."""
    writer = SummaryWriter(str(folder))
    for step in range(5):
        writer.add_scalar("Metrics/lin_vel_rmse", 1.0 - 0.1 * step, step)
        writer.add_scalar("Terrain/level_pit", levels + step, step)
        if step != 2:  # no episode of that type ended
            writer.add_scalar("Terrain/promoted_pit", 0.5, step)
            writer.add_scalar("Terrain/demoted_pit", 0.25, step)
    writer.close()


def test_runs_are_read_and_averaged_over_common_iterations(tmp_path):
    write_run(tmp_path / "a", 1.0)
    runs = [learning_curves.read_scalars(tmp_path / "a")]
    steps, values = runs[0]["Terrain/level_pit"]
    assert steps.tolist() == [0, 1, 2, 3, 4]
    assert values == pytest.approx([1.0, 2.0, 3.0, 4.0, 5.0])
    runs.append({"Terrain/level_pit": (np.array([1, 3, 9]), np.array([4.0, 8.0, 1.0]))})
    steps, values = learning_curves.mean_of(runs, "Terrain/level_pit")
    assert steps.tolist() == [2, 4]  # counted from 1
    assert values == pytest.approx([3.0, 6.0])


@pytest.mark.slow
def test_levels_get_charts_of_their_own(tmp_path):
    write_run(tmp_path / "rough", 1.0)
    log = learning_curves.Log(learning_curves.read_scalars(tmp_path / "rough"), {"terrain": {"num_rows": 5}})
    level, up, down = levels([log, log])
    assert level.lines[0].name == "pit"
    assert level.lines[0].y == pytest.approx([1.0, 2.0, 3.0, 4.0, 5.0])
    assert level.level == ("always promoted", pytest.approx(8 / 3))
    assert [chart.lines[0].y.tolist() for chart in (up, down)] == [[0.5] * 4, [0.25] * 4]
    assert levels([learning_curves.Log({}, {})]) == []
    write_config(tmp_path / "rough")
    assert curves.main([str(tmp_path / "rough"), "--out", str(tmp_path)]) == 0
    assert (tmp_path / "learning_curve.png").read_bytes().startswith(b"\x89PNG")


def test_a_folder_without_events_is_named(tmp_path):
    with pytest.raises(ConfigError, match="holds no TensorBoard file"):
        learning_curves.read_scalars(tmp_path)


def write_config(folder, name=""):
    config = {"task": "anymal_c", "env": {"seed": 3}, "terrain": {"num_rows": 5}, "train": {"runner": {"run_name": name}}}
    (folder / "config.yaml").write_text(yaml.safe_dump(config))


def test_runs_are_called_what_they_are(tmp_path):
    folders = [tmp_path / name for name in ("a", "b", "c", "d")]
    for folder in folders:
        folder.mkdir()
    write_config(folders[0])
    write_config(folders[1], name="[wide]")
    write_config(folders[2])
    configs = [learning_curves.read_config(folder) for folder in folders]
    assert learning_curves.labels(folders, configs) == [
        "anymal_c, seed 3 (a)",  # as the third
        "anymal_c, [wide], seed 3",
        "anymal_c, seed 3 (c)",
        "d",  # no configuration
    ]
    twice = learning_curves.labels([folders[0]] * 2, [configs[0]] * 2)
    assert twice == [
        "anymal_c, seed 3 (a) [1]",
        "anymal_c, seed 3 (a) [2]",
    ]


@pytest.mark.parametrize("text", ["[1, 2]", "env: 3\ntask: x", "{", "train: {runner: [1]}"])
def test_a_configuration_that_someone_broke_costs_the_label_only(text, tmp_path):
    (tmp_path / "config.yaml").write_text(text)
    config = learning_curves.read_config(tmp_path)
    assert learning_curves.labels([tmp_path], [config]) == ["x" if "task" in text else tmp_path.name]
    assert learning_curves.always_promoted(config) is None


def test_who_is_always_promoted_has_two_thirds_of_the_levels():
    """By simulation: robots climb one row after the other, and from the top go to a random one."""
    random = np.random.default_rng(1)
    for rows in (1, 5, 10):
        levels, seen = random.integers(0, rows, 500), []
        for _ in range(400):
            moved = levels + 1
            levels = np.where(moved >= rows, random.integers(0, rows, 500), moved)
            seen.append(levels.mean())
        expected = learning_curves.always_promoted({"terrain": {"num_rows": rows}})
        assert np.mean(seen[50:]) == pytest.approx(expected, abs=0.05)
    assert learning_curves.always_promoted({"terrain": {"num_rows": 5}}) == pytest.approx(8 / 3)


def test_one_iteration_is_drawn(tmp_path):
    writer = SummaryWriter(str(tmp_path / "run"))
    writer.add_scalar("Metrics/lin_vel_rmse", 1.0, 0)
    writer.add_scalar("Perf/collection_time", 0.0, 0)
    writer.add_scalar("Perf/learning_time", 0.0, 0)
    writer.close()
    write_config(tmp_path / "run")
    assert curves.main([str(tmp_path / "run"), "--out", str(tmp_path / "new")]) == 0
    assert (tmp_path / "new" / "learning_curve.png").stat().st_size > 1000


def test_wrong_input_is_one_line(tmp_path, capsys):
    write_run(tmp_path / "run", 1.0)
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "events.out.tfevents.1").write_text("garbage")
    for name in ("quiet", "empty"):
        (tmp_path / name).mkdir()
    for name in ("run", "bad", "quiet"):
        write_config(tmp_path / name)
    for arguments, words in (
        ([tmp_path / "run", "--out", tmp_path / "run" / "config.yaml"], "config.yaml"),
        ([tmp_path / "none"], f"RUN: there is no task and no run '{tmp_path / 'none'}'"),
        ([tmp_path / "empty"], f"RUN: '{tmp_path / 'empty'}' holds no run"),
        ([tmp_path / "quiet"], "quiet: holds no TensorBoard file"),
        ([tmp_path / "bad"], "bad: its TensorBoard file holds no values"),
    ):
        assert curves.main([str(argument) for argument in arguments]) == 2
        err = capsys.readouterr().err
        assert words in err
        assert len(err.splitlines()) == 1


def test_a_run_that_was_killed_while_it_logged_is_drawn(tmp_path):
    """Between the two times of an iteration: there is no axis of time then."""
    writer = SummaryWriter(str(tmp_path / "run"))
    writer.add_scalar("Metrics/lin_vel_rmse", 0.5, 0)
    writer.add_scalar("Perf/collection_time", 1.0, 0)
    writer.close()
    write_config(tmp_path / "run")
    assert curves.main([str(tmp_path / "run"), "--out", str(tmp_path)]) == 0
    assert Image.open(tmp_path / "learning_curve.png").size[0] > 100


def test_a_run_in_which_no_episode_ended_on_some_type_has_no_share_of_it():
    """Such a run is short: it has levels, and no share of episodes yet after which robots moved."""
    iterations = np.arange(2), np.ones(2)
    scalars = {f"Terrain/level_{name}": iterations for name in ("pit", "gap")} | {"Terrain/promoted_pit": iterations}
    level, up = levels([learning_curves.Log(scalars, {})])
    assert [len(line.x) for line in level.lines] == [2, 2]
    assert [len(line.x) for line in up.lines] == [2, 0]


def timed(seconds):
    """A run whose iterations took so long, a quarter of it to learn."""
    times = {"Perf/collection_time": 0.75 * seconds, "Perf/learning_time": 0.25 * seconds}
    return {
        "Metrics/lin_vel_rmse": (np.arange(3), np.ones(3)),
        **{k: (np.arange(3), np.full(3, v)) for k, v in times.items()},
    }


@pytest.mark.parametrize(
    ("times", "shown"),
    [([2.0], 2.0), ([2.0, 2.08, 1.99], 2.0), ([2.0, 2.12], None), ([2.0, 1.8], None), ([None, 2.0], 2.0), ([None], None)],
)
def test_runs_have_an_axis_of_time_if_they_were_equally_fast(times, shown):
    untimed = {"Metrics/lin_vel_rmse": (np.arange(3), np.ones(3))}
    runs = [untimed if each is None else timed(each) for each in times]
    assert learning_curves.common_time(runs) == (None if shown is None else pytest.approx(shown))


def test_charts_are_those_of_the_kind_of_task():
    values = (np.arange(3), np.ones(3))

    def titles(*tags):
        return [chart.title for chart in outcomes([("", learning_curves.Log(dict.fromkeys(tags, values), {}))])]

    assert titles("Metrics/lin_vel_rmse", "Metrics/contact_overflows") == ["velocity error [m/s]"]
    tags = ("Train/mean_reward", "Metrics/x_velocity", "Metrics/falls", "Metrics/episode_length")
    assert titles(*tags) == [
        "return of an episode",
        "episodes that end in a fall [%]",
        "length of an episode [control steps]",
        "x velocity",
    ]
