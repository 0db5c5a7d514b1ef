"""The film of a play: frames from the camera, written as play.mp4 and play.gif."""

import errno
import subprocess
import time
from pathlib import Path

import numpy as np
from PIL import Image

from legged.envs import BaseTask
from legged.errors import RunError
from legged.process.paths import DISK_FULL, make_folder, relative, replacing
from legged.rendering import camera_of

FPS = 25
"""Frames per second; fewer if control steps are longer."""
GIF_FPS = 8
GIF_S = 12.0
"""Length of a GIF [s]."""


class Video:
    """Recorder of pictures of a task's first robots; without a folder it does nothing."""

    def __init__(self, task: BaseTask, count: int, folder: Path | None, gif: bool = False) -> None:
        """Create the camera and the folder.

        Raises:
            RunError: this machine cannot render, or the folder cannot be created.
        """
        self.folder, self.gif = folder, gif
        self.camera = camera_of(task, count) if folder else None
        if folder:
            make_folder(folder)
        self.every = max(1, round(1.0 / (FPS * task.dt)))
        """Control steps from one frame to the next."""
        self.fps = 1.0 / (self.every * task.dt)
        """Frames a second of the film, which shows real time."""
        self.frames: list[np.ndarray] = []
        self._start = time.perf_counter()

    def follow(self, robot: int) -> None:
        """Follow another robot from now on; on a plane all robots are visible."""
        if self.camera:
            self.camera.followed = robot

    def due(self, step: int) -> bool:
        """Return whether a frame is due after this control step."""
        return self.camera is not None and step % self.every == 0

    def take(self, *lines: str) -> None:
        """Record a frame with lines of text."""
        if self.camera:
            self.frames.append(self.camera.picture(lines))

    def write(self) -> None:
        """Write play.mp4 and, with `gif`, a smaller play.gif.

        Raises:
            RunError: a file cannot be written.
        """
        if not (self.camera and self.folder):
            return
        self.camera.close()
        if self.gif:  # written first, because it needs no encoder
            _write_gif(self.frames, self.folder / "play.gif", self.fps)
        write_mp4(self.frames, self.folder / "play.mp4", self.fps)
        print(f"recorded {len(self.frames)} frames in {time.perf_counter() - self._start:.1f} s")


def write_mp4(frames: list[np.ndarray], path: Path, fps: float) -> None:
    """Write pictures (height, width, 3) uint8 as a film with `fps` pictures per second.

    Raises:
        RunError: the film cannot be written.
    """
    try:
        import imageio_ffmpeg  # only films need imageio

        program = imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError) as error:
        raise RunError(f"{relative(path)}: videos need ffmpeg: pip install 'imageio[ffmpeg]' ({error})") from error
    height, width, _ = frames[0].shape
    given = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{fps:g}", "-i", "-"]
    wanted = ["-an", "-codec:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "20", "-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2"]
    with replacing(path) as part:
        command = [program, "-y", "-loglevel", "error", *given, *wanted, str(part)]
        # Through a pipe ffmpeg would not report a full disk; its exit code does.
        done = subprocess.run(command, input=np.stack(frames).tobytes(), capture_output=True, check=False)
        if done.returncode:
            said = done.stderr.decode("utf-8", errors="replace").strip().splitlines() or [f"exit code {done.returncode}"]
            if any("No space left" in line or "quota" in line for line in said):
                raise OSError(errno.ENOSPC, DISK_FULL)
            raise RunError(f"{relative(path)}: ffmpeg could not write the video: {said[0]}")
    print(f"video {relative(path)}")


def _write_gif(frames: list[np.ndarray], path: Path, fps: float) -> None:
    every = max(1, round(fps / GIF_FPS))
    shown = frames[: max(1, round(GIF_S * fps)) : every]
    pictures = [Image.fromarray(frame).resize((416, 234), Image.Resampling.LANCZOS) for frame in shown]
    pictures = [picture.quantize(64, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE) for picture in pictures]
    first, *rest = pictures
    with replacing(path) as part:
        first.save(part, save_all=True, append_images=rest, duration=round(1000 * every / fps), loop=0)
    print(f"video {relative(path)}")
