"""Text in pictures."""

from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

INK = (40, 40, 40)
"""Colour of text that has none of its own."""


def caption(picture: np.ndarray, lines: Sequence[str], colors: Sequence[Sequence[float]] = ()) -> np.ndarray:
    """Write lines of text into the upper left corner of a picture (height, width, 3) uint8, and return it; the first lines
    have the `colors` (red, green, blue, 0 to 1), a little darker.
    """
    if not lines:
        return picture
    inks = [tuple(int(255 * value * 0.8) for value in color[:3]) for color in colors]
    font = ImageFont.load_default(size=picture.shape[0] // 30)
    height = picture.shape[0] // 22
    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image, "RGBA")
    draw.rectangle((0, 0, picture.shape[1] * 0.46, height * len(lines) + 12), fill=(255, 255, 255, 170))
    for i, line in enumerate(lines):
        draw.text((10, 6 + i * height), line, fill=inks[i] if i < len(inks) else INK, font=font)
    return np.asarray(image)


def labels(picture: np.ndarray, texts: Sequence[str], at: np.ndarray) -> np.ndarray:
    """Write texts into a picture (height, width, 3) uint8, centred at the pixels `at` (N, 2), and return it."""
    font = ImageFont.load_default(size=picture.shape[0] / 42)
    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image, "RGBA")
    for text, (x, y) in zip(texts, at, strict=True):
        box = draw.textbbox((x, y), text, font=font, anchor="mm")
        draw.rounded_rectangle((box[0] - 8, box[1] - 5, box[2] + 8, box[3] + 5), radius=6, fill=(255, 255, 255, 215))
        draw.text((x, y), text, fill=INK, font=font, anchor="mm")
    return np.asarray(image)
