"""A film of a policy that walks straight ahead, and the GIF or PNG of it."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from legged.config import LeggedConfig, override
from legged.envs import LeggedRobot
from legged.errors import ConfigError, RunError
from legged.play.playground import SETTING, Playground
from legged.policies.actor import Actor
from legged.policies.restore import TrainedPolicy, restore, undisturbed
from legged.process.paths import make_folder, relative, replacing
from legged.rendering import RobotsCamera

FPS = 12.5
"""Pictures per second; the duration of one, in hundredths of a second, must be whole in a GIF."""
FILM_S, WARM_UP_S = 4.0, 2.0
"""Length of the film, and of the walk before it [s]."""
SPEED = 0.6
"""Commanded forward velocity as a share of the largest trained one."""
FILL, GLIDE = 0.82, 0.5
"""Share of a picture that the robot fills in its default pose; share of the gap that the camera closes per picture."""
SHARP = 2
"""Pictures are rendered this many times larger, and scaled down to smooth edges."""
MOST_BYTES = 2_000_000
"""Size limit of a GIF."""
SMALLER: tuple[tuple[int, float], ...] = (
    *((96, 1.0), (64, 1.0), (48, 1.0), (48, 0.92), (48, 0.84), (48, 0.76)),
    *((40, 0.7), (40, 0.6), (32, 0.5), (24, 0.4), (16, 0.3)),
)
"""Colours and scale of a GIF, tried in this order until it is small enough."""

Film = list[np.ndarray]
"""Pictures, each (height, width, 3) uint8."""


def film(policy: TrainedPolicy, side: int) -> Film:
    """Let a robot walk straight ahead in C MuJoCo on the CPU, on its most frequent terrain type of training.

    Returns:
        Pictures of `side` x `side` pixels.

    Raises:
        ConfigError: the policy follows no commands, or does not fit its task.
        RunError: this machine cannot render.
    """
    cfg = walker(policy)
    task, act, playground = _on_ground(policy, cfg)
    camera = RobotsCamera(task, 1, SHARP * side, SHARP * side, instead="")
    camera.come_near(FILL, GLIDE)
    try:
        return [_shown(picture, side) for picture in _walk(task, act, playground, camera)]
    finally:
        camera.close()


def walker(policy: TrainedPolicy, where: str = "") -> LeggedConfig:
    """Return the configuration of a policy that follows velocity commands; `where` is the beginning of an error.

    Raises:
        ConfigError: the policy follows no commands.
    """
    if not isinstance(policy.cfg, LeggedConfig):
        raise ConfigError(f"{where}'{policy.cfg.task}' follows no commands: there is no way to ask it to walk")
    return policy.cfg


def _on_ground(policy: TrainedPolicy, cfg: LeggedConfig) -> tuple[LeggedRobot, Actor, Playground | None]:
    """Build the task of one robot on a plane, or on tiles of its most frequent terrain."""
    shares = cfg.terrain.proportions
    rough = cfg.terrain.mesh_type != "plane"
    playground = Playground.of(cfg, max(shares, key=lambda name: shares[name]), None) if rough else None
    still: list[tuple[str, Any]] = [
        ("sim.physics", "mujoco"),
        ("sim.threads", 1),
        ("init_state.yaw", [0.0, 0.0]),
        ("init_state.dof_pos_factor", [1.0, 1.0]),
        ("init_state.base_velocity", [0.0, 0.0]),
    ]
    changes = [*undisturbed(1, WARM_UP_S + FILM_S), *still]
    if playground is None:
        return *restore(policy, changes, torch.device("cpu"), graph=False), None
    changes += [*SETTING, *playground.changes(cfg)]
    terrain = playground.build(override(cfg, changes))  # type: ignore[arg-type]
    return *restore(policy, changes, torch.device("cpu"), False, terrain), playground


@torch.inference_mode()
def _walk(task: LeggedRobot, act: Actor, playground: Playground | None, camera: RobotsCamera) -> Iterator[np.ndarray]:
    """Yield the pictures of the film."""
    if playground is not None:
        playground.place(task)
    task.reset()
    fastest = float(task.command_sampler.full_ranges[0, 1])
    heading = None if playground is None else torch.zeros(1)
    observations = task.hold_commands(torch.tensor([SPEED * fastest, 0.0, 0.0]), heading)
    warm_up, every = round(WARM_UP_S / task.dt), max(1, round(1.0 / (FPS * task.dt)))
    for step in range(warm_up + round(FILM_S / task.dt)):
        observations, _, _, _ = task.step(act(observations))
        if step >= warm_up and (step - warm_up) % every == 0:
            yield camera.picture()


def _shown(picture: np.ndarray, side: int) -> np.ndarray:
    return np.asarray(Image.fromarray(picture).resize((side, side), Image.Resampling.LANCZOS))


def write_film(pictures: Film, path: Path) -> str:
    """Write a GIF of at most MOST_BYTES, or the film's middle picture if the name ends with .png; return a line on the file.

    Raises:
        RunError: the file can't be written, or the GIF is too large at the smallest scale.
    """
    make_folder(path.parent)
    if path.suffix == ".png":
        with replacing(path) as part:
            Image.fromarray(pictures[len(pictures) // 2]).save(part)
        return f"written: {relative(path)}, {path.stat().st_size / 1e6:.2f} MB"
    for colors, scale in SMALLER:
        with replacing(path) as part:
            size = _write_gif(pictures, part, colors, scale)
        if size[0] <= MOST_BYTES:
            shown = f"{size[1]} x {size[2]} pixels, {colors} colours"
            return f"written: {relative(path)}, {size[0] / 1e6:.2f} MB, {len(pictures)} pictures of {shown}"
    path.unlink(missing_ok=True)
    raise RunError(f"{relative(path)}: would be larger than {MOST_BYTES / 1e6:g} MB; make its pictures smaller")


def _write_gif(pictures: Film, path: Path, colors: int, scale: float) -> tuple[int, int, int]:
    """Write pictures in that many colours, which all of them share, and at that scale; return bytes, width and height."""
    height, width = (round(scale * length) for length in pictures[0].shape[:2])
    small = [Image.fromarray(picture).resize((width, height), Image.Resampling.LANCZOS) for picture in pictures]
    palette = _palette(np.concatenate([np.asarray(picture) for picture in small[:: max(1, len(small) // 6)]]), colors)
    first, *rest = (picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in small)
    first.save(path, save_all=True, append_images=rest, duration=round(1000 / FPS), loop=0, optimize=True)
    return path.stat().st_size, width, height


def _palette(pixels: np.ndarray, colors: int) -> Image.Image:
    """Return a palette for pixels (..., 3) uint8. The weight of a colour is the square root of its frequency, so that the
    floor does not take all colours.
    """
    fine = (pixels.reshape(-1, 3) >> 2).astype(np.int64)
    found, counts = np.unique(fine @ np.array([1 << 12, 1 << 6, 1]), return_counts=True)
    color = np.stack([found >> 12, found >> 6 & 63, found & 63], axis=1) * 4 + 2
    weighted = np.repeat(color, np.sqrt(counts).astype(int), axis=0).astype(np.uint8)
    return Image.fromarray(weighted[None]).quantize(colors, Image.Quantize.MEDIANCUT, kmeans=2)
