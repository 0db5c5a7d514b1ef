"""Checkpoints are plain data: they run nothing, fit what they say, and what is wrong with one is said in one line."""

import pickle
import zipfile
from pathlib import Path

import pytest
import torch
from helpers import TASK, call, checkpoints, kept_global_state, tiny_run

from legged.cli.evaluate import checkpoints as evaluate_checkpoints
from legged.cli.evaluate import grid as evaluate_grid
from legged.cli.play import play
from legged.cli.train import train
from legged.config import to_yaml
from legged.envs import LeggedRobot
from legged.errors import ConfigError
from legged.learning.checkpoint import FORMAT, digests, networks, read_checkpoint
from legged.learning.resume import resumed
from legged.learning.run_folder import shipped_policy
from legged.registry import task_config

pytestmark = pytest.mark.usefixtures("workplace")
COMMANDS = {
    "resume": (train.main, ["--resume", "--max_iterations", "9"]),
    "play": (play.main, ["--no-video"]),
    "evaluate grid": (evaluate_grid.main, ["--vx=0", "--vy=0", "--yaw=0", "--robots", "1"]),
    "evaluate checkpoints": (evaluate_checkpoints.main, ["--robots", "1"]),
}


@pytest.fixture(scope="module")
def good(tmp_path_factory) -> bytes:
    """The bytes of a checkpoint, beside the configuration of its run."""
    with pytest.MonkeyPatch.context() as patch, kept_global_state():
        patch.chdir(tmp_path_factory.mktemp("trained"))
        folder = tiny_run(num_envs=4, iterations=1)
        return (folder / "model_0.pt").read_bytes(), (folder / "config.yaml").read_text()


@pytest.fixture
def model(good) -> Path:
    """A checkpoint in a run folder of its own."""
    folder = Path("logs") / TASK / "run"
    folder.mkdir(parents=True)
    (folder / "model_0.pt").write_bytes(good[0])
    (folder / "config.yaml").write_text(good[1])
    return folder / "model_0.pt"


def change(model: Path, **parts: object) -> None:
    saved = torch.load(model, weights_only=True)
    for name, value in parts.items():
        saved[name] = value
    torch.save(saved, model)


class RunsCode:
    """What a foreign file may hold."""

    def __reduce__(self):
        return (Path.touch, (Path("it_ran"),))


def in_infos(model: Path) -> None:
    change(model, infos={"note": RunsCode()})


def as_the_whole_file(model: Path) -> None:
    torch.save(RunsCode(), model)


def as_a_bare_pickle(model: Path) -> None:
    model.write_bytes(pickle.dumps(RunsCode()))


def as_an_old_torch_file(model: Path) -> None:
    torch.save({"actor_state_dict": RunsCode()}, model, _use_new_zipfile_serialization=False)


def in_a_state_file(model: Path) -> None:
    torch.save({"format": 1, "task": RunsCode()}, model.with_name("state_0.pt"))


CODE = [in_infos, as_the_whole_file, as_a_bare_pickle, as_an_old_torch_file]


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("place", CODE)
def test_a_checkpoint_runs_no_code(model, capsys, place, command):
    place(model)
    main, arguments = COMMANDS[command]
    assert call(main, [TASK, "--sim_device", "cpu", *arguments]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "model_0.pt: not a checkpoint" in err
    assert not Path("it_ran").exists()


@pytest.mark.slow
def test_a_state_of_robots_runs_no_code(model, capsys):
    in_a_state_file(model)
    arguments = ["--resume", "--max_iterations", "2", "--num_envs", "4"]
    assert call(train.main, ["--task", TASK, "--sim_device", "cpu", *arguments]) == 0
    assert (
        "begin anew: logs/anymal_c_flat/run/state_0.pt: not a checkpoint (it holds more than plain data"
        in capsys.readouterr().out
    )
    assert not Path("it_ran").exists()


WRONG = {
    "iter": ("three", "its iter is str, not int"),
    "infos": ([1, 2], "its infos is list, not dict"),
    "actor_state_dict": ([], "its actor_state_dict is list, not dict"),
    "critic_state_dict": ({"mlp.0.weight": 3}, "its critic is damaged ('mlp.0.weight' is not a tensor)"),
    "optimizer_state_dict": (7, "its optimizer_state_dict is int, not dict"),
}


@pytest.mark.parametrize("part", WRONG)
def test_a_part_of_the_wrong_kind_is_named(model, part):
    value, words = WRONG[part]
    change(model, **{part: value})
    with pytest.raises(ConfigError, match=r"model_0\.pt") as error:
        read_checkpoint(model)
    assert words in str(error.value)


def test_an_iteration_below_zero_is_refused(model):
    change(model, iter=-1)
    with pytest.raises(ConfigError, match="its iteration is -1"):
        read_checkpoint(model)


@pytest.mark.parametrize("key", ["task_state", "observations", "networks", "robot"])
@pytest.mark.parametrize("value", [3, "text", [1]])
def test_infos_of_the_wrong_kind_are_named(model, key, value):
    infos = torch.load(model, weights_only=True)["infos"]
    change(model, infos={**infos, key: value})
    with pytest.raises(ConfigError, match=rf"its infos\.{key} is {type(value).__name__}, not dict"):
        read_checkpoint(model)


def test_a_newer_format_is_refused(model):
    infos = torch.load(model, weights_only=True)["infos"]
    assert infos["format"] == FORMAT
    change(model, infos={**infos, "format": FORMAT + 1})
    with pytest.raises(ConfigError, match=rf"format {FORMAT + 1} by a newer"):
        read_checkpoint(model)


@pytest.mark.parametrize("missing", ["format", "observations", "histories", "networks", "optimizer"])
def test_a_checkpoint_that_does_not_describe_itself_is_refused(model, missing):
    """As rsl-rl's own and those of early versions."""
    infos = torch.load(model, weights_only=True)["infos"]
    change(model, infos={name: value for name, value in infos.items() if name != missing})
    with pytest.raises(ConfigError, match=rf"model_0\.pt: not a checkpoint of this version .*its infos lack {missing}\)"):
        read_checkpoint(model)
    change(model, infos=None)
    with pytest.raises(ConfigError, match="its infos lack format, observations, histories, networks, optimizer"):
        read_checkpoint(model)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_weights_that_are_no_numbers_are_refused(model, value):
    saved = torch.load(model, weights_only=True)
    saved["actor_state_dict"]["mlp.0.weight"][1, 1] = value
    torch.save(saved, model)
    with pytest.raises(ConfigError, match=r"its actor is damaged \(mlp\.0\.weight holds NaN or infinite numbers\)"):
        read_checkpoint(model)


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_progress_of_curricula_that_is_damaged_is_said(model, capsys, command):
    infos = torch.load(model, weights_only=True)["infos"]
    change(model, infos={**infos, "task_state": {"command_curriculum": {"share": torch.ones(7)}}})
    if command == "evaluate grid":  # it switches the curriculum off, and reads nothing of it
        return
    main, arguments = COMMANDS[command]
    code = call(main, [TASK, "--sim_device", "cpu", *arguments, "commands.curriculum.enabled=true"])
    assert (code, capsys.readouterr().err.count("curricula is damaged")) == (2, 1)


def test_every_byte_cut_off_is_noticed(model):
    """Wherever a copy broke off."""
    whole = model.read_bytes()
    for share in (0.0, 0.01, 0.3, 0.6, 0.9, 0.999):
        model.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(ConfigError, match=r"model_0\.pt: not a checkpoint"):
            read_checkpoint(model)


def test_an_archive_of_something_else_is_refused(model):
    with zipfile.ZipFile(model, "w") as archive:
        archive.writestr("readme.txt", "hello")
    with pytest.raises(ConfigError, match=r"model_0\.pt: not a checkpoint"):
        read_checkpoint(model)


def test_runs_of_legged_gym_are_named_and_their_policies_have_a_way_in(tmp_path, monkeypatch, capsys):
    """As its rsl-rl and its play.py write them."""
    monkeypatch.chdir(tmp_path)
    run = Path("old/Sep30_12-00-00_")
    run.mkdir(parents=True)
    weights = {"std": torch.ones(12), "actor.0.weight": torch.zeros(12, 48), "critic.0.weight": torch.zeros(1, 48)}
    torch.save({"model_state_dict": weights, "optimizer_state_dict": {}, "iter": 300, "infos": None}, run / "model_300.pt")
    torch.jit.script(torch.nn.Linear(48, 12)).save("policy_1.pt")
    for name, what in (("old", "no config.yaml"), (str(run), "no config.yaml"), ("policy_1.pt", "is a file")):
        assert call(play.main, [name, "--sim_device", "cpu"]) == 2
        err = capsys.readouterr().err
        assert what in err
        assert "docs/migrating.md" in err
    with pytest.raises(ConfigError, match=r"model_300\.pt: a checkpoint of rsl-rl before 5\.0; docs/migrating\.md"):
        read_checkpoint(run / "model_300.pt")


def test_a_folder_of_that_name_is_said(tmp_path):
    (tmp_path / "model_3.pt").mkdir()
    with pytest.raises(ConfigError, match=r"model_3\.pt: cannot be read \(Is a directory\)"):
        read_checkpoint(tmp_path / "model_3.pt")


@pytest.mark.parametrize("task", ["anymal_c", "anymal_c_flat", "anymal_c_blind", "anymal_c_proprio"])
def test_policies_of_the_package_are_plain_data(task):
    saved = read_checkpoint(shipped_policy(task) / "model.pt")
    assert saved["infos"]["task"] == task


@pytest.mark.slow
@pytest.mark.parametrize("parameter", [0, 3])
def test_an_optimiser_without_the_moments_of_a_parameter_is_damaged(model, capsys, parameter):
    optimizer = torch.load(model, weights_only=True)["optimizer_state_dict"]
    del optimizer["state"][parameter]
    change(model, optimizer_state_dict=optimizer)
    assert call(train.main, ["--task", TASK, "--sim_device", "cpu", *COMMANDS["resume"][1]]) == 2
    assert "model_0.pt: its optimiser is damaged (the moments of some parameters are missing)" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("rate", [float("nan"), 0.0, -1.0, "fast", None])
def test_a_learning_rate_that_is_none_is_refused(model, capsys, rate):
    optimizer = torch.load(model, weights_only=True)["optimizer_state_dict"]
    optimizer["param_groups"][0]["lr"] = rate
    change(model, optimizer_state_dict=optimizer)
    assert call(train.main, ["--task", TASK, "--sim_device", "cpu", *COMMANDS["resume"][1]]) == 2
    assert "its optimiser is damaged" in capsys.readouterr().err


# ---- normalised observations -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_policy_with_normalised_observations_is_played_evaluated_and_resumed(capsys):
    """The normaliser's moments are matrices too, and no layers."""
    normalise = ["train.policy.obs_normalization=true"]
    folder = tiny_run(*normalise, "train.policy.actor_hidden_dims=[16, 8]", num_envs=4)
    base = [TASK, "--sim-device", "cpu"]
    assert play.main([*base, "--no-video", "--num_envs", "1"]) == 0
    assert evaluate_grid.main([*base, *COMMANDS["evaluate grid"][1]]) == 0
    assert train.main([*base, "--resume", "--max_iterations", "3"]) == 0
    (resumed,) = [run for run in folder.parent.iterdir() if run != folder]
    assert checkpoints(resumed) == [2]
    saved = read_checkpoint(folder / "model_1.pt")
    assert saved["infos"]["networks"]["actor"]["hidden_dims"] == [16, 8]
    assert int(saved["actor_state_dict"]["obs_normalizer.count"]) == 2 * 4 * 4


def test_a_flipped_bit_is_noticed_and_an_older_checkpoint_named(tmp_path):
    """The bit is in the fraction of a weight, so the file is a checkpoint still and the weight is finite."""
    weights = torch.full((64,), 1.5)
    infos = {"format": FORMAT, "observations": {}, "histories": {}, "networks": {}, "optimizer": "adam"}
    paths = [tmp_path / f"model_{iteration}.pt" for iteration in (3, 20, 100)]
    for path in paths:
        torch.save({"actor_state_dict": {"w": weights}, "iter": 20, "infos": infos}, path)
        assert torch.equal(read_checkpoint(path)["actor_state_dict"]["w"], weights)
    content = bytearray(paths[1].read_bytes())
    content[content.index(weights.numpy().tobytes()) + 2] ^= 1
    paths[1].write_bytes(content)
    assert not torch.equal(torch.load(paths[1], weights_only=True)["actor_state_dict"]["w"], weights)
    with pytest.raises(ConfigError, match=r"model_20\.pt: .*damaged.*--checkpoint 3 \(model_3\.pt\)$"):
        read_checkpoint(paths[1])
    paths[0].unlink()
    with pytest.raises(ConfigError, match=r"model_20\.pt: .*damaged \(wrong checksum: [\w/]+\)$"):
        read_checkpoint(paths[1])


def test_a_resumed_training_names_the_terms_whose_code_has_changed():
    cfg = task_config(TASK)
    here = digests(LeggedRobot, cfg)
    assert {"_reward_torques", "_obs_dof_pos", "_terminate_contact"} <= here.keys()

    class Edited(LeggedRobot):
        def _reward_torques(self):
            return self.torques.abs().sum(dim=1)

    assert {method for method, digest in digests(Edited, cfg).items() if digest != here[method]} == {"_reward_torques"}
    folder = Path("logs") / TASK / "run"
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(to_yaml(cfg))
    infos = {"format": FORMAT, "networks": networks(cfg), "observations": {}, "histories": {}, "optimizer": "adam"}
    infos["terms"] = digests(Edited, cfg) | {"_reward_old": "0"}
    content = {"actor_state_dict": {}, "critic_state_dict": {}, "optimizer_state_dict": {}, "iter": 0, "infos": infos}
    torch.save(content, folder / "model_0.pt")
    assert resumed(TASK, [], None, None)[2] == ["the code of _reward_torques has changed since"]
    infos["terms"] = here
    torch.save(content, folder / "model_0.pt")
    assert resumed(TASK, [], None, None)[2] == []
    del infos["terms"]
    torch.save(content, folder / "model_0.pt")
    assert resumed(TASK, [], None, None)[2] == []
