"""What all figures have in common."""

import numpy as np
from matplotlib import rcParams
from matplotlib.colors import to_rgb
from PIL import Image

from legged.figures import COLORS, figure, without_common_words


def test_curves_take_the_colours_of_all_figures(tmp_path):
    before = rcParams["axes.prop_cycle"]
    with figure(tmp_path / "some.png", (3.0, 2.0)) as (_, axes):
        for height in range(3):
            axes[0, 0].plot([0, 1], [height, height], linewidth=6.0)
        axes[0, 0].plot([0, 1], [3, 3], color="C4", linewidth=6.0)
    assert rcParams["axes.prop_cycle"] == before
    pixels = {tuple(pixel) for pixel in np.asarray(Image.open(tmp_path / "some.png").convert("RGB")).reshape(-1, 3).tolist()}
    wanted = {color: tuple(round(255 * part) for part in to_rgb(color)) for color in COLORS}
    assert [color for color, pixel in wanted.items() if pixel in pixels and color != "#000000"] == [*COLORS[:3], COLORS[4]]


def test_labels_lack_the_words_that_all_have():
    assert without_common_words(("LF_FOOT", "RF_FOOT", "LH_FOOT", "RH_FOOT")) == ["LF", "RF", "LH", "RH"]
    assert without_common_words(("foot_left", "foot_right")) == ["left", "right"]
    assert without_common_words(("FL_calf_contact", "FR_calf_contact")) == ["FL", "FR"]
    assert without_common_words(("only",)) == ["only"]
