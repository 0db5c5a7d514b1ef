"""Figures: how one is drawn into a file, and the colours that all of them share."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from legged.process.paths import make_folder, replacing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLORS = ("#1f6fb4", "#d9541e", "#3a923a", "#8a56b8", "#6b5b4b")
"""Of curves and bars, in this order."""
DPI = 110
"""Pixels an inch."""


@contextmanager
def figure(
    path: Path, size: tuple[float, float], rows: int = 1, columns: int = 1, share_y: bool = False, **saving: Any
) -> Iterator[tuple["Figure", np.ndarray]]:
    """Give a figure of `size` (width, height) [inches] and its (rows, columns) axes to draw into; it is then written to
    `path` as a PNG file that is whole or not there. With `share_y` all axes have one scale of y; `saving` are options of
    matplotlib's savefig.

    No window system is asked: matplotlib's choice of one (MPLBACKEND) has no say here.

    Raises:
        RunError: the file can't be written.
    """
    from matplotlib.figure import Figure  # takes a while; commands that fail early do without

    drawn = Figure(figsize=size, layout="constrained")
    yield drawn, drawn.subplots(rows, columns, squeeze=False, sharey=share_y)
    make_folder(path.parent)
    with replacing(path) as part:
        drawn.savefig(part, **{"dpi": DPI, "format": "png", **saving})
