"""Figures: drawing into a file, and the colours that all figures share."""

import os
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from legged.process.paths import make_folder, replacing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#8C8C00")
"""Colours of curves, bars and areas, in this order. They are those of Okabe and Ito ("Color universal design", 2008), which
are distinct for any colour vision. The last colour is a dark yellow for a white background.
"""
STYLES = ("-", "--", "-.", ":")
"""Line styles, in this order, for curves that colours alone do not tell apart."""
DPI = 110
"""Pixels per inch."""


def without_common_words(names: Sequence[str]) -> list[str]:
    """Return labels without the words that all names share: LF_FOOT and RF_FOOT become LF and RF. A name with only shared
    words stays whole.
    """
    words = [[word for word in re.split(r"[\W_]+", name) if word] for name in names]
    common = set.intersection(*map(set, words)) if words else set()
    return [" ".join(w for w in own if w not in common) or name for own, name in zip(words, names, strict=True)]


def import_matplotlib() -> None:
    """Import matplotlib, which takes a while. An unknown MPLBACKEND is ignored with a warning, because figures are only
    written to files.
    """
    if "matplotlib" in sys.modules:
        return
    backend = os.environ.pop("MPLBACKEND", None)
    import matplotlib

    if backend:
        os.environ["MPLBACKEND"] = backend
        try:
            matplotlib.rcParams["backend"] = backend
        except ValueError:
            said = f"warning: MPLBACKEND: matplotlib knows no backend '{backend}'; figures are drawn without it"
            print(said, file=sys.stderr, flush=True)


@contextmanager
def figure(
    path: Path, size: tuple[float, float], rows: int = 1, columns: int = 1, share_y: bool = False, **saving: Any
) -> Iterator[tuple["Figure", np.ndarray]]:
    """Provide a figure of `size` (width, height) [inches] and its (rows, columns) axes in a `with` block, then write it to
    `path` as a PNG file. The file is written completely or not at all. Curves have the colours `COLORS`. With `share_y` all
    axes share one y scale. `saving` are options of matplotlib's savefig.

    No window system is needed, even if MPLBACKEND names a backend that has windows.

    Raises:
        RunError: the file can't be written.
    """
    import_matplotlib()
    from matplotlib import rc_context
    from matplotlib.figure import Figure
    from matplotlib.rcsetup import cycler

    with rc_context({"axes.prop_cycle": cycler(color=COLORS)}):
        drawn = Figure(figsize=size, layout="constrained")
        yield drawn, drawn.subplots(rows, columns, squeeze=False, sharey=share_y)
        make_folder(path.parent)
        with replacing(path) as part:
            drawn.savefig(part, **{"dpi": DPI, "format": "png", **saving})
