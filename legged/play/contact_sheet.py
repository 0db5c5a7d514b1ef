"""Contact sheets: pictures of many robots, each in its own named tile."""

from collections.abc import Iterator, Sequence
from math import ceil, sqrt
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from legged.config import LeggedConfig, override
from legged.envs import LeggedRobot
from legged.errors import ConfigError, RunError
from legged.play.playground import SETTING, Playground
from legged.policies.actor import Actor
from legged.policies.restore import TrainedPolicy, restore, undisturbed
from legged.process.paths import make_folder, relative, replacing
from legged.rendering import RobotsCamera
from legged.rendering.camera import INK

FPS = 12.5
"""Picture rate; GIFs count time in hundredths of a second [1/s]."""
FILM_S, WARM_UP_S = 4.0, 2.0
"""Length of the film, and of the walk before it [s]."""
SPEED = 0.6
"""Commanded forward velocity, as a share of the fastest one of the training."""
FILL, GLIDE = 0.82, 0.5
"""Share of a tile that a robot fills in its default pose, and share of the distance that the camera covers per picture."""
SHARP = 2
"""Factor by which pictures are rendered larger than shown, to smooth edges."""
MOST_BYTES = 2_000_000
"""Largest GIF; colours and size are reduced to reach it [bytes]."""
SMALLER: tuple[tuple[int, float], ...] = (
    *((96, 1.0), (64, 1.0), (48, 1.0), (48, 0.92), (48, 0.84), (48, 0.76)),
    *((40, 0.7), (40, 0.6), (32, 0.5), (24, 0.4), (16, 0.3)),
)
"""Colours and scales that are tried, in this order."""
PAPER = (255, 255, 255)

Tile = list[np.ndarray]
"""Pictures (height, width, 3) uint8 of a robot."""


def film(policy: TrainedPolicy, side: int) -> Tile:
    """Return pictures of `side` x `side` pixels of a robot that walks straight ahead, on the most frequent ground of its
    training, in C MuJoCo on the CPU.

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
    """Return the configuration of a policy that follows commands; `where` begins the error message.

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


def sheet(tiles: Sequence[Tile], names: Sequence[str], columns: int | None = None) -> Tile:
    """Return the pictures of films side by side, each with its name below. By default the sheet is about twice as wide as
    high.
    """
    columns = min(len(tiles), columns or ceil(sqrt(2 * len(tiles))))
    rows = ceil(len(tiles) / columns)
    side = tiles[0][0].shape[0]
    font = ImageFont.load_default(size=max(10, side // 12))
    step = side + max(14, side // 8)
    pictures = []
    for k in range(min(map(len, tiles))):
        picture = Image.new("RGB", (columns * side, rows * step), PAPER)
        draw = ImageDraw.Draw(picture)
        for i, (tile, name) in enumerate(zip(tiles, names, strict=True)):
            x, y = i % columns * side, i // columns * step
            picture.paste(Image.fromarray(tile[k]), (x, y))
            draw.text((x + side // 2, y + (side + step) // 2), name, fill=INK, font=font, anchor="mm")
        pictures.append(np.asarray(picture))
    return pictures


def write_sheet(pictures: Tile, path: Path) -> str:
    """Write a film as a GIF of at most MOST_BYTES, or its middle picture as a PNG, by the suffix of `path`; return a line
    about the file.

    Raises:
        RunError: the file cannot be written, or exceeds MOST_BYTES at every scale.
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
    raise RunError(f"{relative(path)}: would be larger than {MOST_BYTES / 1e6:g} MB; show fewer robots, or smaller ones")


def _write_gif(pictures: Tile, path: Path, colors: int, scale: float) -> tuple[int, int, int]:
    """Write pictures with a shared palette of some colours, scaled; return the size in bytes, the width and the height."""
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
