"""Terrain as a map: its heights seen from above."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from legged.figures import figure, import_matplotlib
from legged.rendering.terrain_picture import MARGIN
from legged.terrain import Terrain


def draw_map(terrain: Terrain, levels: Sequence[str], path: Path) -> None:
    """Draw the heights from above, x upward and so y to the left, with tiles, their types and `levels` (R,), and origins."""
    import_matplotlib()
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import AsinhNorm, LightSource

    ground = terrain.height_map
    rows, columns = terrain.origins.shape[:2]
    length, width = terrain.tile_size
    hidden = round(max(0.0, terrain.border - MARGIN) / ground.cell)
    shown = slice(hidden, ground.heights.shape[0] - hidden), slice(hidden, ground.heights.shape[1] - hidden)
    # Seen with x upward and y to the left; the light comes from the upper left.
    heights = ground.heights[shown][::-1, ::-1]
    largest = max(float(np.abs(heights).max()), 0.05)
    # Low steps are to be seen beside high ones: about linear up to 0.25 m, logarithmic above.
    scale, colors = AsinhNorm(linear_width=0.25, vmin=-largest, vmax=largest), colormaps["RdYlBu_r"]
    light = LightSource(azdeg=315, altdeg=45)
    shaded = light.shade(heights, colors, blend_mode="soft", norm=scale, vert_exag=2.0, dx=ground.cell, dy=ground.cell)
    half_x, half_y = (0.5 * n * ground.cell for n in heights.shape)

    across = 11.0
    high = min(max(across * half_x / half_y, 2.0), 12.0) + 1.2
    with figure(path, (across, high), dpi=130, bbox_inches="tight") as (drawn, axes):
        axis = axes[0, 0]
        axis.imshow(shaded, extent=(half_y, -half_y, -half_x, half_x), interpolation="antialiased")
        ends_x, ends_y = (np.arange(n + 1) * s - 0.5 * n * s for n, s in ((rows, length), (columns, width)))
        axis.hlines(ends_x, ends_y[0], ends_y[-1], color="black", linewidth=0.5, alpha=0.5)
        axis.vlines(ends_y, ends_x[0], ends_x[-1], color="black", linewidth=0.5, alpha=0.5)
        axis.plot(
            terrain.origins[..., 1].ravel(), terrain.origins[..., 0].ravel(), "k+", markersize=4, label="robots start here"
        )
        axis.set_xlabel("y [m]")
        axis.set_ylabel("x [m]")

        top = axis.secondary_xaxis("top")
        groups = [[c for c in range(columns) if terrain.types[c] == name] for name in dict.fromkeys(terrain.types)]
        middles = [0.5 * (ends_y[group[0]] + ends_y[group[-1] + 1]) for group in groups]
        top.set_xticks(middles, [terrain.types[group[0]] for group in groups])
        top.tick_params(length=0)
        for label, group in zip(top.get_xticklabels(), groups, strict=True):
            if 0.75 * across * len(group) / columns < 0.09 * len(label.get_text()):  # wider than its columns
                label.set(rotation=30, ha="left")
        right = axis.secondary_yaxis("right")
        right.set_yticks(0.5 * (ends_x[1:] + ends_x[:-1]), levels)
        right.tick_params(length=0)
        if any(levels):
            right.set_ylabel("difficulty")
        axis.legend(loc="upper left", bbox_to_anchor=(0.0, -0.05), fontsize="small", frameon=False)
        bar = drawn.colorbar(ScalarMappable(scale, colors), ax=axis, label="height [m]", shrink=0.8, aspect=30)
        bar.set_ticks([h for h in (-2.0, -1.0, -0.5, -0.2, -0.1, 0.0, 0.1, 0.2, 0.5, 1.0, 2.0) if abs(h) <= largest])
        bar.ax.yaxis.set_major_formatter("{x:g}")
        bar.ax.minorticks_off()
