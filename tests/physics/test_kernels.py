"""Kernels are compiled ahead: all that a model launches, and no others; once, though several processes ask."""

import gc
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import warp as wp
from helpers import HANG_S

from legged.cli.warmup import warmup
from legged.physics.warp.compile import Build, Line, compile_ahead, launched

# Two modules with a kernel each, one of them launched with two block sizes, and a third that nothing launches.
MODELS = """
import os, time
from pathlib import Path
import warp as wp
wp.config.log_level = wp.LOG_WARNING

def kernel(name, factor):
    @wp.kernel(module=wp.get_module(name), enable_backward=False)
    def scale(x: wp.array[float]):
        x[wp.tid()] = x[wp.tid()] * factor
    return scale

first, second, third = (kernel(name, factor) for name, factor in (("one", 2.0), ("two", 3.0), ("three", 5.0)))
x = wp.full(4, 1.0, dtype=float, device="cpu")

def run():
    wp.launch(first, dim=4, inputs=[x], device="cpu")
    wp.launch(second, dim=4, inputs=[x], device="cpu")
    wp.launch(third, dim=0, inputs=[x], device="cpu")

from legged.physics.warp.compile import Build, compile_ahead
compile_one = Build.compile

def noted(build, device):
    if not build.cached(device):
        with open("compiled.txt", "a") as file:
            file.write(build.module.name + " ")
    compile_one(build, device)

Build.compile = noted
Path(f"started{os.getpid()}").touch()
while len(list(Path().glob("started*"))) < 2:
    time.sleep(0.01)
print("count", compile_ahead(wp.get_device("cpu"), [run]))
print("untouched", x.numpy().tolist())
run()
print("scaled", x.numpy().tolist())
print("again", compile_ahead(wp.get_device("cpu"), [run]))
"""


def start(folder: Path, cache: Path) -> subprocess.Popen:
    (folder / "models.py").write_text(MODELS)
    environment = {**os.environ, "WARP_CACHE_PATH": str(cache), "TMPDIR": str(folder)}
    command = [sys.executable, folder / "models.py"]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True, cwd=folder)


def finish(process: subprocess.Popen) -> str:
    out, _ = process.communicate(timeout=HANG_S)
    assert process.returncode == 0
    assert "untouched [1.0, 1.0, 1.0, 1.0]" in out
    assert "scaled [6.0, 6.0, 6.0, 6.0]" in out
    assert "again 0" in out
    return out


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux only")
def test_missing_modules_are_compiled_once_though_two_processes_start_together(tmp_path):
    cache = tmp_path / "cache"
    together = [start(tmp_path, cache), start(tmp_path, cache)]
    first, second = (finish(process) for process in together)
    assert "compiling 1 of 2 kernel modules" in first + second
    objects = [path.name for path in cache.rglob("*.o")]
    assert sorted(re.match(r"wp_([a-z]+)_", name).group(1) for name in objects) == ["one", "two"]
    assert sorted((tmp_path / "compiled.txt").read_text().split()) == ["one", "two"]
    assert not list(tmp_path.glob("legged_*"))
    assert not list(tmp_path.glob("wp_pch*"))


def test_a_dry_run_of_a_step_names_the_modules_that_a_step_loads(make_physics, monkeypatch):
    physics = make_physics("mujoco_warp", step="library")
    device = wp.get_device("cpu")
    functions = (physics._step, physics._state_io.kinematics, physics._state_io.contact_forces)
    before = physics.robot_state.base_pos.clone()
    noted = {build.module for build in launched(device, functions)}
    assert physics.robot_state.base_pos.equal(before)
    loaded = set()
    module_class = type(next(iter(noted)))
    load = module_class.load
    monkeypatch.setattr(module_class, "load", lambda self, *a, **k: loaded.add(self) or load(self, *a, **k))
    for function in functions:
        with wp.ScopedDevice(device):
            function()
    assert noted == loaded
    assert len(noted) > 30


def test_warp_is_itself_again_after_a_dry_run():
    before = (wp.launch, wp.launch_tiled, wp.capture_while, wp.capture_if)

    def fails():
        raise RuntimeError

    with pytest.raises(RuntimeError):
        launched(wp.get_device("cpu"), [fails])
    assert (wp.launch, wp.launch_tiled, wp.capture_while, wp.capture_if) == before


@pytest.mark.slow
def test_warmup_leaves_nothing_to_compile(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    arguments = ["anymal_c_flat", "--num-envs", "2", "--sim_device", "cpu", "sim.physics=mujoco_warp"]
    assert warmup.main(arguments) == 0
    out = capsys.readouterr().out
    assert "anymal_c_flat: ready in" in out
    assert str(wp.config.kernel_cache_dir) in out
    assert warmup.main(arguments) == 0
    assert "compiling" not in capsys.readouterr().out
    assert not list(tmp_path.iterdir())


def test_warmup_has_nothing_to_do_for_the_c_engine(capsys):
    assert warmup.main(["anymal_c_flat", "--sim-device", "cpu", "sim.physics=mujoco"]) == 0
    assert "nothing to do" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux only")
def test_what_cannot_be_compiled_ahead_is_left_to_warp(tmp_path, monkeypatch, capfd):
    """Compiling processes that fail, or crash, cost nothing but their time."""
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    x = wp.zeros(4, dtype=float, device="cpu")

    @wp.kernel(module="unique", enable_backward=False)
    def count(x: wp.array[float]):
        x[wp.tid()] = 7.0 + float(wp.tid())

    def run():
        wp.launch(count, dim=4, inputs=[x], device="cpu")

    monkeypatch.setattr(Build, "compile", lambda *_: os.kill(os.getpid(), signal.SIGKILL))
    assert compile_ahead(wp.get_device("cpu"), [run]) == 0
    assert "compiled 0 kernel modules" in capfd.readouterr().out
    run()
    assert x.numpy().tolist() == [7.0, 8.0, 9.0, 10.0]


@pytest.mark.slow
def test_compiling_processes_collect_no_garbage_of_their_parent(monkeypatch, tmp_path):
    """An object in a cycle, which may have to wait for a thread that no forked process has, is its parent's to end."""
    ended = tmp_path / "ended"

    class Session:
        def __init__(self) -> None:
            self.itself = self

        def __del__(self) -> None:
            with ended.open("a") as file:
                file.write(f"{os.getpid()} ")

    @wp.kernel(module=wp.get_module("compiled_beside_garbage"), enable_backward=False)
    def count(x: wp.array[float]):
        x[wp.tid()] = float(wp.tid()) + 7.0

    x = wp.zeros(4, dtype=float, device="cpu")
    monkeypatch.setattr(Build, "compile", lambda *_: gc.isenabled() and gc.collect())
    Session()
    compile_ahead(wp.get_device("cpu"), [lambda: wp.launch(count, dim=4, inputs=[x], device="cpu")])
    gc.collect()
    assert set(ended.read_text().split()) == {str(os.getpid())}


def test_a_terminal_sees_one_line(monkeypatch, capsys):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    with Line(3) as line:
        line.show(1)
        line.end(3)
    out = capsys.readouterr().out
    assert out.count("\n") == 1
    assert out.count("\r") == 3
    assert "compiling 2 of 3 kernel modules" in out
    assert "compiled 3 kernel modules in 0.0 s\n" in out
