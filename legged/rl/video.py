"""The film of a play: frames from the camera, written as play.mp4 and play.gif."""

import time
from pathlib import Path

import imageio.v3
import numpy as np
from PIL import Image

from legged.envs import LeggedRobot
from legged.errors import ConfigError
from legged.paths import relative, replacing
from legged.rendering import Camera

FPS = 25
GIF_S = 12.0
"""Length of a GIF; as many seconds of the film as a page can take [s]."""


class Video:
    """Collects pictures of a task's first robots while it is stepped; without a folder it does nothing."""

    def __init__(self, task: LeggedRobot, count: int, folder: Path | None) -> None:
        """Raises ConfigError where nothing can be rendered."""
        self.task, self.folder = task, folder
        self.camera = Camera(task, count) if folder else None
        if folder:
            folder.mkdir(parents=True, exist_ok=True)
        self.every = max(1, round(1.0 / (FPS * task.dt)))
        """Control steps from one frame to the next."""
        self.frames: list[np.ndarray] = []
        self._start = time.perf_counter()

    def follow(self, robot: int) -> None:
        """On terrain, the robot that is in the middle of the picture from now on."""
        if self.camera:
            self.camera.followed = robot

    def due(self, step: int) -> bool:
        """Whether a frame is to be taken after this control step."""
        return self.camera is not None and step % self.every == 0

    def take(self, robots: slice, *lines: str) -> None:
        """A frame, with the velocities of `robots` and `lines` written on it."""
        if self.camera:
            self.frames.append(self.camera.picture([*velocities(self.task, robots), *lines]))

    def write(self, gif: bool) -> None:
        """Write play.mp4 and, if asked for, a smaller play.gif."""
        if not (self.camera and self.folder):
            return
        self.camera.close()
        _write_mp4(self.frames, self.folder / "play.mp4")
        if gif:
            _write_gif(self.frames, self.folder / "play.gif")
        print(f"recorded {len(self.frames)} frames in {time.perf_counter() - self._start:.1f} s")


def velocities(task: LeggedRobot, robots: slice) -> list[str]:
    """Commanded velocity of the first of `robots`, and the mean of their actual ones."""
    wanted = task.commands[robots][0, :3].tolist()
    actual = [*task.base_lin_vel[robots, :2].mean(dim=0).tolist(), float(task.base_ang_vel[robots, 2].mean())]
    return [
        f"{name}  {v[0]:+.2f}  {v[1]:+.2f} m/s  {v[2]:+.2f} rad/s" for name, v in (("commanded", wanted), ("actual", actual))
    ]


def _write_mp4(frames: list[np.ndarray], path: Path) -> None:
    try:
        with replacing(path) as part:
            imageio.v3.imwrite(part, np.stack(frames), fps=FPS, codec="libx264", quality=7, macro_block_size=2)
    except (ImportError, OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot write video ({error}); pip install 'imageio[ffmpeg]'") from error
    print(f"video {relative(path)}")


def _write_gif(frames: list[np.ndarray], path: Path) -> None:
    shown = frames[: round(GIF_S * FPS) : FPS // 8]
    pictures = [Image.fromarray(frame).resize((416, 234), Image.Resampling.LANCZOS) for frame in shown]
    pictures = [picture.quantize(64, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE) for picture in pictures]
    first, *rest = pictures
    with replacing(path) as part:
        first.save(part, save_all=True, append_images=rest, duration=1000 * (FPS // 8) // FPS, loop=0)
    print(f"video {relative(path)}")
