"""Films of `play`, with text in the frames (MP4, GIF), and films of a robot that walks straight ahead (GIF, PNG)."""

import errno
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from PIL import Image

from legged.config import LeggedConfig, follows_velocities, override
from legged.envs import BaseTask
from legged.errors import ConfigError, RunError
from legged.play.playground import SETTING, Playground
from legged.policies.restore import TrainedPolicy, restore, undisturbed
from legged.process.paths import DISK_FULL, make_folder, relative, replacing
from legged.rendering.camera import RobotsCamera, camera_of

Film = list[np.ndarray]
"""Pictures of a film, each (height, width, 3) uint8."""
PLAY_FPS = 25
"""Frames per second of a film of `play`; the film has fewer if control steps are longer than a frame."""
GIF_FPS, GIF_S, GIF_SIZE = 8, 12.0, (416, 234)
"""Frames per second, length [s], and width and height [pixels] of a GIF of `play`."""
FPS = 12.5
"""Pictures per second of the film of a walk. In a GIF each picture lasts a whole number of hundredths of a second, here 8."""
FILM_S, WARM_UP_S = 4.0, 2.0
"""Length of the film of a walk, and time for which the robot walks before the film begins [s]."""
SPEED = 0.6
"""Commanded forward velocity of a walk as a share of the largest trained one."""
FILL, GLIDE = 0.82, 0.5
"""FILL: share of the picture's width or height that the robot fills in its default pose. GLIDE: how far the camera's target
moves towards the robot in each picture, as a share of their distance."""
SHARP = 2
"""Factor by which pictures of a walk are rendered larger. They are then scaled down, which smooths edges."""
MOST_BYTES = 2_000_000
"""Size limit of the GIF of a walk [bytes]."""
SMALLER: tuple[tuple[int, float], ...] = (
    *((96, 1.0), (64, 1.0), (48, 1.0), (48, 0.92), (48, 0.84), (48, 0.76)),
    *((40, 0.7), (40, 0.6), (32, 0.5), (24, 0.4), (16, 0.3)),
)
"""Pairs (number of colours, scale) of a GIF. They are tried in this order until the GIF is small enough."""


class Video:
    """Recorder of a film of a task's first robots: play.mp4 and, with `gif`, a smaller play.gif. Without a folder it records
    nothing. The end of the `with` block completes the files. Only there does it raise what keeps the film from being made,
    because the robots are measured all the same.
    """

    def __init__(self, task: BaseTask, count: int, folder: Path | None, gif: bool = False) -> None:
        """Create the camera and the folder.

        Raises:
            RunError: the folder cannot be created.
        """
        self.folder, self.gif = folder, gif
        self.camera: Any = None
        self.every = max(1, round(1.0 / (PLAY_FPS * task.dt)))
        """Number of control steps from one frame to the next."""
        self.fps = 1.0 / (self.every * task.dt)
        """Frames per second with which the film runs in real time."""
        self.count = 0
        """Number of recorded frames."""
        self._failure: RunError | BrokenPipeError | None = None
        self._film = ExitStack()
        self._append: Callable[[np.ndarray], object] | None = None
        self._small: Film = []
        self._small_every = max(1, round(self.fps / GIF_FPS))
        if folder:
            try:
                self.camera = camera_of(task, count)
            except RunError as error:
                self._failure = RunError(f"{error}, or play with --no-video")
            make_folder(folder)
        self._start = time.perf_counter()

    def __enter__(self) -> Self:
        return self

    def due(self, step: int) -> bool:
        """Return whether a frame is due after this control step."""
        return self.camera is not None and step % self.every == 0

    def take(self, *lines: str, followed: int = 0) -> None:
        """Record a frame with `lines` of text. On terrain the camera follows the robot with index `followed`."""
        assert self.folder is not None
        self.camera.followed = followed
        picture = self.camera.picture(lines)
        if self.gif and self.count % self._small_every == 0 and self.count < max(1, round(GIF_S * self.fps)):
            self._small.append(resized(picture, *GIF_SIZE))
        self.count += 1
        if self._failure is not None:
            return
        try:
            if self._append is None:
                height, width, _ = picture.shape
                self._append = self._film.enter_context(mp4(self.folder / "play.mp4", self.fps, width, height))
            self._append(picture)
        except (RunError, BrokenPipeError) as error:
            self._failure = error

    def __exit__(self, *raised: Any) -> None:
        """Complete the files; if the block failed, remove them.

        Raises:
            RunError: this machine cannot render, or a file cannot be written.
        """
        with self._film:
            if self.camera is not None:
                self.camera.close()
            if raised[1] is not None:
                raise raised[1]
            if self._small and self.folder is not None:  # the GIF needs no encoder that may fail
                write_film(self._small, self.folder / "play.gif", self.fps / self._small_every)
                print(f"video {relative(self.folder / 'play.gif')}")
            if self._failure is not None:
                raise self._failure
        if self.count:
            print(f"recorded {self.count} frames in {time.perf_counter() - self._start:.1f} s")


def walker(policy: TrainedPolicy, where: str = "") -> LeggedConfig:
    """Return the configuration of a policy that follows velocity commands. Error messages begin with `where`.

    Raises:
        ConfigError: the policy follows no commands.
    """
    if not follows_velocities(policy.cfg):
        raise ConfigError(f"{where}'{policy.cfg.task}' follows no commands, so it cannot be told to walk")
    return policy.cfg


def film(policy: TrainedPolicy, side: int) -> Film:
    """Let a robot walk straight ahead in C MuJoCo on the CPU, and return pictures of `side` x `side` pixels. The robot walks
    on a plane or, if it was trained on terrain, on tiles of the most frequent terrain type of the training.

    Raises:
        ConfigError: the policy follows no commands, or does not fit its task.
        RunError: this machine cannot render.
    """
    cfg = walker(policy)
    shares, rough = cfg.terrain.proportions, cfg.terrain.mesh_type != "plane"
    playground = Playground.of(cfg, max(shares, key=lambda name: shares[name]) if rough else None, None)
    changes: list[tuple[str, Any]] = [
        *undisturbed(cfg, 1, WARM_UP_S + FILM_S),
        ("sim.physics", "mujoco"),
        ("sim.threads", 1),
        ("init_state.yaw", [0.0, 0.0]),
        ("init_state.dof_pos_factor", [1.0, 1.0]),
        ("init_state.base_velocity", [0.0, 0.0]),
    ]
    terrain = None
    if playground is not None:
        changes += [*SETTING, *playground.changes(cfg)]
        terrain = playground.build(override(cfg, changes))
    task, act = restore(policy, changes, torch.device("cpu"), graph=False, terrain=terrain)
    camera = RobotsCamera(task, 1, SHARP * side, SHARP * side)
    camera.come_near(FILL, GLIDE)
    camera.arrows = False
    warm_up, every = round(WARM_UP_S / task.dt), max(1, round(1.0 / (FPS * task.dt)))
    pictures = []
    with torch.inference_mode(), closing(camera):
        if playground is not None:
            playground.place(task)
        task.reset()
        fastest = float(task.command_sampler.full_ranges[0, 1])
        heading = None if playground is None else torch.zeros(1)
        observations = task.hold_commands(torch.tensor([SPEED * fastest, 0.0, 0.0]), heading)
        for step in range(warm_up + round(FILM_S / task.dt)):
            observations, _, _, _ = task.step(act(observations))
            if step >= warm_up and (step - warm_up) % every == 0:
                pictures.append(resized(camera.picture(), side, side))
    return pictures


# ---- files -----------------------------------------------------------------------------------------------------------


def resized(picture: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return a picture (height, width, 3) uint8 scaled to another size [pixels]."""
    return np.asarray(Image.fromarray(picture).resize((width, height), Image.Resampling.LANCZOS))


@contextmanager
def mp4(path: Path, fps: float, width: int, height: int) -> Iterator[Callable[[np.ndarray], object]]:
    """Provide a function that appends a picture (`height`, `width`, 3) uint8 to a film with `fps` pictures per second. Each
    picture is encoded at once. The film replaces `path` after the block, or is removed if the block fails.

    Raises:
        RunError: the film cannot be written.
    """
    try:
        import imageio_ffmpeg  # imported here, because only films need it

        program = imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError) as error:
        raise RunError(f"{relative(path)}: videos need ffmpeg: pip install 'imageio[ffmpeg]' ({error})") from error
    given = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{fps:g}", "-i", "-"]
    wanted = ["-an", "-codec:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "20", "-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2"]
    with replacing(path) as part, tempfile.TemporaryFile() as output:
        command = [program, "-y", "-loglevel", "error", *given, *wanted, str(part)]
        encoder = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=output, stderr=output)
        # If ffmpeg ends early, the pipe breaks. Its exit code and its output tell the reason, such as a full disk.
        with suppress(BrokenPipeError), encoder:
            assert encoder.stdin is not None
            pipe = encoder.stdin
            yield lambda picture: pipe.write(picture.tobytes())
        if encoder.returncode:
            output.seek(0)
            said = output.read().decode("utf-8", errors="replace").strip().splitlines()
            if any("No space left" in line or "quota" in line for line in said):
                raise OSError(errno.ENOSPC, DISK_FULL)
            reason = said[0] if said else f"exit code {encoder.returncode}"
            raise RunError(f"{relative(path)}: ffmpeg could not write the video: {reason}")
    print(f"video {relative(path)}")


def write_film(pictures: Film, path: Path, fps: float = FPS) -> str:
    """Write a GIF of at most MOST_BYTES, or the middle picture if the file's name ends with .png. Return a line to print.

    Raises:
        RunError: the file can't be written, or the GIF is too large at the smallest scale.
    """
    make_folder(path.parent)
    if path.suffix == ".png":
        with replacing(path) as part:
            Image.fromarray(pictures[len(pictures) // 2]).save(part)
        return f"written: {relative(path)}, {path.stat().st_size / 1e6:.2f} MB"
    for colors, scale in SMALLER:
        height, width = (round(scale * length) for length in pictures[0].shape[:2])
        small = [Image.fromarray(resized(picture, width, height)) for picture in pictures]
        palette = _palette(np.concatenate([np.asarray(picture) for picture in small[:: max(1, len(small) // 6)]]), colors)
        first, *rest = (picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in small)
        with replacing(path) as part:
            first.save(part, save_all=True, append_images=rest, duration=round(1000 / fps), loop=0, optimize=True)
        size = path.stat().st_size
        if size <= MOST_BYTES:
            shown = f"{len(pictures)} pictures of {width} x {height} pixels, {colors} colours"
            return f"written: {relative(path)}, {size / 1e6:.2f} MB, {shown}"
    path.unlink(missing_ok=True)
    raise RunError(f"{relative(path)}: the GIF would be larger than {MOST_BYTES / 1e6:g} MB; make its pictures smaller")


def _palette(pixels: np.ndarray, colors: int) -> Image.Image:
    """Return a palette of `colors` colours for pixels (..., 3) uint8. Colours are weighted by the square root of their
    frequency, so that not all entries of the palette are colours of the floor.
    """
    fine = (pixels.reshape(-1, 3) >> 2).astype(np.int64)
    found, counts = np.unique(fine @ np.array([1 << 12, 1 << 6, 1]), return_counts=True)
    color = np.stack([found >> 12, found >> 6 & 63, found & 63], axis=1) * 4 + 2
    weighted = np.repeat(color, np.sqrt(counts).astype(int), axis=0).astype(np.uint8)
    return Image.fromarray(weighted[None]).quantize(colors, Image.Quantize.MEDIANCUT, kmeans=2)
