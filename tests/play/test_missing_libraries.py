"""Libraries that draw, encode or open windows may be missing: what does not need them works, the rest says so in a line."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import POLICY

import legged

pytestmark = pytest.mark.slow

PLAY = str(Path(legged.__file__).parents[1] / "play.py")
ARGUMENTS = ["--task", "anymal_c_flat", "--load_run", str(POLICY), "--sim_device", "cpu", "--num_envs", "1", "--out", "out"]
ARGUMENTS += ["sim.threads=1", "sim.physics=mujoco"]


def ends(code: str, folder: Path, missing: tuple[str, ...], **environment: str) -> subprocess.CompletedProcess:
    """How a process ends in which some modules can't be imported."""
    code = f"import sys\nsys.modules.update(dict.fromkeys({missing!r}))\n{code}"
    everything = {**os.environ, **environment}
    return subprocess.run(
        [sys.executable, "-c", code], cwd=folder, env=everything, capture_output=True, text=True, check=False
    )


def test_playing_without_a_film_needs_neither_encoder_nor_windows(tmp_path):
    code = f"sys.argv = {[PLAY, '--no-video', *ARGUMENTS]!r}\nfrom legged.cli.play import play\nsys.exit(play.main())"
    done = ends(code, tmp_path, ("imageio_ffmpeg", "imageio", "glfw", "mujoco.viewer"))
    assert (done.returncode, done.stderr) == (0, "")
    assert "following commands" in done.stdout
    assert (tmp_path / "out/exported/policy.onnx").is_file()


def test_a_film_without_an_encoder_is_one_line_after_the_table_and_a_gif_is_there(tmp_path):
    """Pictures are black, so that nothing needs to be drawn."""
    code = (
        "import numpy as np\n"
        "from legged.play import demonstrations, films\n"
        "class Camera:\n"
        "    def __init__(self, task, count): ...\n"
        "    def picture(self, lines): return np.zeros((18, 32, 3), dtype=np.uint8)\n"
        "    def close(self): ...\n"
        "films.camera_of = Camera\n"
        "demonstrations.SCHEDULE = ((0.2, (0.5, 0.0, 0.0)),)\n"
        "from legged.cli.play import play\n"
        f"sys.exit(play.main({['--headless', '--gif', *ARGUMENTS]!r}))"
    )
    done = ends(code, tmp_path, ("imageio_ffmpeg",))
    assert done.returncode == 1
    assert done.stderr.startswith("error: out/play.mp4: videos need ffmpeg: pip install 'imageio[ffmpeg]' (")
    assert len(done.stderr.splitlines()) == 1
    assert "following commands" in done.stdout
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["exported", "play.gif"]


def test_modules_of_one_system_alone_are_not_imported(tmp_path):
    """Windows has none of them; torch and Warp do without, too."""
    modules = "legged.deploy.udp, legged.cli.play, legged.cli.train, legged.cli.benchmark"
    done = ends(f"import {modules}", tmp_path, ("fcntl", "termios", "pwd", "grp", "resource"))
    assert done.returncode == 0, done.stderr


def test_figures_are_drawn_whatever_mplbackend_says(tmp_path):
    code = (
        "from pathlib import Path\n"
        "from legged.figures import figure\n"
        "for name in 'ab':\n"
        "    with figure(Path(f'{name}.png'), (1.0, 1.0)): ...\n"
    )
    done = ends(code, tmp_path, (), MPLBACKEND="foo")
    assert done.returncode == 0, done.stderr
    assert done.stderr == "warning: MPLBACKEND: matplotlib knows no backend 'foo'; figures are drawn without it\n"
    assert (tmp_path / "b.png").is_file()
