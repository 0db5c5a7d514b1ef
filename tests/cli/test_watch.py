"""The command of the live view: wrong input, addresses, and where others name it."""

import argparse
import socket
import sys
from pathlib import Path

import pytest
from helpers import POLICY, TASK, TINY_TRAINING, call, run_folders

from legged.cli.play import play
from legged.cli.train import train
from legged.cli.watch import watch
from legged.commandline.arguments import watch_command
from legged.errors import ConfigError
from legged.play.live.page import HOST, PORT, free_port, is_loopback, is_own, url

pytestmark = pytest.mark.usefixtures("workplace")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ([], "POLICY: there is no run in logs/; train one first, or name a task whose policy is shipped"),
        (["anymal_c_flta"], "POLICY: there is no task and no run 'anymal_c_flta'; did you mean 'anymal_c_flat'?"),
        ([TASK, "--num-envs", "17"], "--num-envs: must be from 1 to 16, got 17"),
        ([TASK, "--num-envs", "0"], "--num-envs: must be from 1 to 16, got 0"),
        ([TASK, "--port", "65536"], "--port: must be from 0 to 65535, got 65536"),
        ([TASK, "--host", "192.0.2.1"], "--host: no page can be served at '192.0.2.1'"),
        ([TASK, "--terrain", "stairs"], "--terrain: there is no terrain type 'stairs'"),
        (
            [TASK, "--difficulty", "0.5"],
            "--difficulty: anymal_c_flat stands on a plane; name a type with --terrain",
        ),
        (["anymal_c", "--difficulty", "2"], "--difficulty: must be between 0 and 1, got 2"),
        (["half_cheetah", "--terrain", "flat"], "--terrain: 'half_cheetah' has no terrain to choose"),
        (["anymal_c_step", "--difficulty", "0.5"], "--difficulty: 'anymal_c_step' has no terrain to choose"),
        (["nowhere"], "POLICY: there is no task and no run 'nowhere'"),
        ([TASK, "rewards.scales.torqes=1"], "torqes"),
    ],
)
def test_wrong_input_is_one_line(flags, said, capsys, monkeypatch):
    monkeypatch.setattr("legged.cli.watch.load_viser", lambda: None)
    assert call(watch.main, flags) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert said in lines[0]


def test_without_viser_the_error_names_what_to_install(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    assert call(watch.main, [TASK]) == 2
    expected = "error: watch: needs the package viser, which is not installed here: pip install 'legged[watch]'\n"
    assert capsys.readouterr().err == expected


def test_another_port_is_found_where_the_usual_one_is_taken_but_not_where_one_was_asked_for():
    with socket.socket() as taken:
        taken.bind((HOST, 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match=f"--port: {port} can't be used at '127.0.0.1' .*leave it out"):
            free_port(HOST, port)
    assert free_port(HOST, port) == port
    with HeldPort(PORT):
        assert free_port(HOST, None) != PORT
    assert free_port(HOST, 0) > 0
    with pytest.raises(ConfigError, match=r"--host: 'no\.such\.host\.invalid' is no address"):
        free_port("no.such.host.invalid", None)


@pytest.mark.parametrize(
    ("served", "host", "origin", "allowed"),
    [
        (HOST, "127.0.0.1:8470", "http://127.0.0.1:8470", True),
        (HOST, "localhost:9000", "http://localhost:9000", True),  # a forwarded port
        (HOST, "localhost:9000", None, True),
        (HOST, "evil.example:8470", "http://evil.example:8470", False),  # a name that was led here
        (HOST, "evil.example:8470", None, False),
        (HOST, "127.0.0.1:8470", "http://evil.example", False),
        (HOST, "127.0.0.1:8470", "http://127.0.0.1:9999", False),  # another server of this machine
        (HOST, "127.0.0.1:8470", "null", False),
        (HOST, "127.0.0.1.evil.example:8470", None, False),
        (HOST, "[:8470", None, False),
        (HOST, None, None, False),
        ("0.0.0.0", "192.168.1.7:8470", "http://192.168.1.7:8470", True),
        ("0.0.0.0", f"{socket.gethostname().upper()}:8470", f"http://{socket.gethostname().upper()}:8470", True),
        ("0.0.0.0", "evil.example:8470", "http://evil.example:8470", False),
        ("::", "[fe80::1]:8470", "http://[fe80::1]:8470", True),
        ("gpu1.lab", "gpu1.lab:8470", "https://gpu1.lab:8470", True),
    ],
)
def test_a_page_answers_its_own_pages_alone(served, host, origin, allowed):
    assert is_own(served, host, origin) == allowed


class HeldPort:
    """Holds a port, unless somebody else does."""

    def __init__(self, port: int) -> None:
        self.port, self.socket = port, socket.socket()

    def __enter__(self) -> None:
        try:
            self.socket.bind((HOST, self.port))
            self.socket.listen()
        except OSError:
            pass

    def __exit__(self, *_: object) -> None:
        self.socket.close()


def test_addresses():
    assert url("127.0.0.1", 80) == "http://127.0.0.1:80"
    assert url("0.0.0.0", 80) == "http://127.0.0.1:80"
    assert url("::1", 80) == "http://[::1]:80"
    assert [is_loopback(host) for host in ("127.0.0.1", "::1", "localhost", "0.0.0.0", "192.168.0.1", "there")] == [
        *[True] * 3,
        *[False] * 3,
    ]


@pytest.mark.slow
def test_train_and_play_name_the_command(capsys):
    flags = ["--task", TASK, "--sim_device", "cpu", "sim.physics=mujoco", "sim.threads=1"]
    assert call(train.main, [*flags, "--num_envs", "4", "--max_iterations", "1", *TINY_TRAINING]) == 0
    (folder,) = run_folders()
    assert f"watch it: legged watch {folder}\n" in capsys.readouterr().out
    assert call(play.main, [*flags, "--no-video"]) == 0
    assert f"watch it: legged watch {folder}\n" in capsys.readouterr().out
    assert call(play.main, [str(POLICY), *flags[2:], "--no-video", "--out", "elsewhere"]) == 0
    assert f"watch it: legged watch {POLICY}\n" in capsys.readouterr().out


def test_what_a_run_does_not_know_by_itself_is_part_of_the_command():
    given = argparse.Namespace(module="my tasks.py", task_file="slow.yaml")
    command = "legged watch --import 'my tasks.py,slow.yaml' logs/slow/1"
    assert watch_command(given, Path("logs/slow/1")) == command
