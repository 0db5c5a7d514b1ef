"""The command that runs a simulated robot and its program: what it makes of their ends."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from helpers import HANG_S, call, tiny_run
from importing_fixtures import urdf

from legged import registry
from legged.cli import deploy
from legged.cli.robot import add
from legged.errors import RunError

LISTENS = "import os, time; print('listening at 127.0.0.1:1', flush=True); "
GOOD_REPORT = (
    "import sys; open(sys.argv[sys.argv.index('--out') + 1] + '/report.json', 'w').write('"
    '{"fell": false, "time": 1.0, "distance": 0.5, "climbed": 0.0, "largest_lean": 0.1, "lost": 0, "sent": 9, "received": 9}'
    "')"
)


@pytest.fixture
def run(policy_folder, tmp_path, monkeypatch):
    """A function that runs the command on two stand-ins, each a line of Python; it returns the exit code."""
    starts = subprocess.Popen

    def run(simulator, program):
        def start(command, **settings):
            source = program if "legged.deploy" in command else simulator
            return starts([sys.executable, "-c", source, *command[3:]], **settings)

        monkeypatch.setattr(deploy.subprocess, "Popen", start)
        return call(deploy.sim.main, [str(policy_folder), "--out", str(tmp_path)])

    return run


def test_the_report_of_a_run_is_told(run, capsys):
    assert run(LISTENS + GOOD_REPORT, "raise SystemExit(3)") == 3
    assert "did not fall, 1.0 s, 0.50 m away" in capsys.readouterr().out


@pytest.mark.parametrize(("end", "code"), [("os.kill(os.getpid(), 9)", -9), ("raise SystemExit(1)", 1)])
def test_a_simulator_that_fails_is_told_and_an_older_report_is_not(end, code, run, tmp_path, capsys):
    assert run(LISTENS + GOOD_REPORT, "") == 0
    capsys.readouterr()
    assert run(LISTENS + end, "raise SystemExit(3)") == 1
    told = capsys.readouterr()
    assert told.err == f"error: the simulated robot failed (exit code {code}): there is no report of this run\n"
    assert told.out == ""
    assert not (tmp_path / "report.json").exists()


def test_a_program_that_does_not_end_leaves_no_simulator_behind(policy_folder, tmp_path, monkeypatch):
    """As one that writes a long log."""
    starts, started = subprocess.Popen, []

    def start(command, **settings):
        busy = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print(flush=True); time.sleep(3600.0)"
        source = busy if "legged.deploy" in command else LISTENS + "time.sleep(3600.0)"
        own = {"stdout": subprocess.PIPE} if source is busy else {}
        started.append(starts([sys.executable, "-c", source], **{**settings, **own}))
        return started[-1]

    def fails(program):
        program.stdout.readline()
        raise RunError("what goes wrong here")

    monkeypatch.setattr(deploy.subprocess, "Popen", start)
    monkeypatch.setattr(deploy, "_wait", fails)
    monkeypatch.setattr(deploy, "END_S", 0.2)
    try:
        with pytest.raises(subprocess.TimeoutExpired):
            deploy.sim.main([str(policy_folder), "--out", str(tmp_path)])
        assert started[0].poll() is not None
    finally:
        for process in started:
            process.kill()
            process.wait()
            process.stdout.close()


@pytest.mark.parametrize("code", [2, 130])
def test_a_program_that_refuses_ends_the_simulator_at_once(code, run, capsys):
    began = time.perf_counter()
    assert run(LISTENS + "time.sleep(3600.0)", f"raise SystemExit({code})") == code
    assert time.perf_counter() - began < HANG_S
    assert capsys.readouterr() == ("", "")


def test_a_policy_without_commands_is_none_for_a_robot(capsys):
    assert call(deploy.sim.main, ["half_cheetah"]) == 2
    assert "POLICY: 'half_cheetah' follows no commands" in capsys.readouterr().err


@pytest.fixture
def own_run(workplace, monkeypatch, capsys):
    """A run of a robot of one's own, in mine/, whose task no later command knows by its name."""
    monkeypatch.setattr(registry, "_REGISTERED", {})
    Path("toy.urdf").write_text(urdf())
    assert call(add.main, ["toy.urdf", "--out", "mine"]) == 0
    folder = tiny_run("--task", "mine/toy_flat.yaml", iterations=1)
    registry._REGISTERED.clear()
    capsys.readouterr()
    return folder


@pytest.mark.slow
def test_a_robot_of_ones_own_is_simulated_without_naming_it(own_run, monkeypatch, capsys):
    """Its task is its YAML file; an export in its run folder has the robot that the run's configuration names; where it was
    moved away from there, and where a run is named whose task nobody knows, an error says what to name.
    """
    simulated = []
    monkeypatch.setattr(deploy, "_run_both", lambda args, exported, robot, folder: (simulated.append(robot), (0, None))[1])

    def error(*flags):
        assert call(deploy.sim.main, [*map(str, flags)]) == 2
        return capsys.readouterr().err

    assert "POLICY: logs/toy_flat/" in (said := error(own_run))
    assert "was trained on a user-defined task, 'toy_flat'; to name the file that defines it, use --import FILE" in said
    robot = Path("mine/toy").resolve()
    assert call(deploy.sim.main, ["mine/toy_flat.yaml"]) == 0
    assert call(deploy.sim.main, [str(own_run / "exported")]) == 0
    assert simulated == [str(robot)] * 2
    (own_run / "exported").rename("moved")
    assert "moved/policy.json: robot: 'toy' does not come with this package; give its folder with --robot FOLDER" in error(
        "moved"
    )
    assert call(deploy.sim.main, ["moved", "--robot", "mine/toy"]) == 0
    assert simulated[-1] == str(robot)


@pytest.mark.slow
def test_a_run_that_has_gone_on_is_exported_again(workplace, monkeypatch, capsys):
    """Its export was once taken for its newest policy, whatever had been learned since. Who names the export gets it."""
    folder = tiny_run(iterations=1)
    monkeypatch.setattr(deploy, "_run_both", lambda args, exported, robot, folder: (0, None))
    policy, (checkpoint,) = folder / "exported" / "policy.onnx", folder.glob("model_*.pt")

    def says(name):
        capsys.readouterr()
        assert call(deploy.sim.main, [str(name)]) == 0
        return "exported" in capsys.readouterr().out

    assert says(folder)
    assert not says(folder)
    os.utime(checkpoint, (policy.stat().st_mtime + 9.0,) * 2)
    assert not says(folder / "exported")
    assert not says(policy)
    assert says(folder)


def test_a_policy_that_is_not_there_is_named(workplace, capsys):
    assert call(deploy.sim.main, ["nonsense"]) == 2
    assert capsys.readouterr().err.startswith("error: POLICY: there is no task and no run 'nonsense'")
    assert call(deploy.sim.main, ["nonsense.yaml"]) == 2
    assert capsys.readouterr().err == "error: POLICY: there is no file 'nonsense.yaml'\n"
