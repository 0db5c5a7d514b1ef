"""Drawings of reports: the places of lines, their names and values, and that they are whole documents."""

import re
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from legged.evaluation.reports.charts import (
    BOTTOM,
    HEIGHT,
    LEFT,
    MOST_POINTS,
    RIGHT,
    TOP,
    WIDTH,
    Chart,
    Line,
    curves,
    draw_charts,
    draw_panel,
    heat_map,
    shade,
    sheet,
    short,
    stacked,
    ticks,
)
from legged.figures import COLORS

NS = "{http://www.w3.org/2000/svg}"


def parsed(drawing: str) -> ElementTree.Element:
    return ElementTree.fromstring(drawing)


def points(element: ElementTree.Element) -> np.ndarray:
    return np.array([[float(v) for v in pair.split(",")] for pair in element.get("points").split()])


def texts(drawing: str) -> list[str]:
    return [element.text for element in parsed(drawing).iter(f"{NS}text")]


def test_a_line_goes_from_corner_to_corner():
    """y from 0 to 100 on axes from 0 to 106: so much room is left above."""
    drawing = curves(Chart("speed [m/s]", "iteration", [Line("", np.array([1.0, 2.0, 5.0]), np.array([0.0, 50.0, 100.0]))]))
    (line,) = parsed(drawing).iter(f"{NS}polyline")
    inside, tall = WIDTH - LEFT - RIGHT, HEIGHT - BOTTOM - TOP
    wanted = [
        [LEFT, HEIGHT - BOTTOM],
        [LEFT + inside / 4, HEIGHT - BOTTOM - tall * 50 / 106],
        [WIDTH - RIGHT, TOP + tall * 6 / 106],
    ]
    assert points(line) == pytest.approx(np.array(wanted), abs=0.06)
    assert line.get("data-name") == "speed [m/s]"
    assert line.get("data-x").split() == ["1", "2", "5"]
    assert line.get("data-v").split() == ["0", "50", "100"]
    assert {"speed [m/s]", "iteration", "0", "50", "100"} <= set(texts(drawing))


def test_lines_differ_by_colour_and_by_dashes_and_names_stand_beside_them():
    x = np.arange(4.0)
    drawing = curves(Chart("level", "iteration", [Line(f"type {i}", x, x + i) for i in range(6)]))
    lines = list(parsed(drawing).iter(f"{NS}polyline"))
    assert [line.get("stroke") for line in lines] == list(COLORS[:6])
    assert len({line.get("stroke-dasharray") for line in lines}) == 6
    assert {f"type {i}" for i in range(6)} <= set(texts(drawing))


def test_no_name_leaves_the_drawing():
    """A long legend takes another row."""
    names = [f"a rather long name {i}" for i in range(5)]
    drawing = parsed(curves(Chart("x", "iteration", [Line(name, np.arange(3.0), np.ones(3)) for name in names])))
    at = [(float(e.get("x")), float(e.get("y"))) for e in drawing.iter(f"{NS}text") if e.text in names]
    assert len(at) == 5
    assert len({y for _, y in at}) == 3
    assert max(x for x, _ in at) + 6.3 * len(names[0]) <= WIDTH
    box = float(drawing.get("viewBox").split()[3])
    assert box == HEIGHT + 3 * 16 + 6


def test_values_that_are_no_numbers_are_left_out():
    y = np.array([np.nan, 1.0, np.inf, 2.0])
    (line,) = parsed(curves(Chart("x", "iteration", [Line("", np.arange(4.0), y)]))).iter(f"{NS}polyline")
    assert line.get("data-x").split() == ["1", "3"]
    (line,) = parsed(curves(Chart("x", "i", [Line("", np.arange(3.0), np.array([0.0, 0.1, 1.0]))], log=True))).iter(
        f"{NS}polyline"
    )
    assert line.get("data-x").split() == ["1", "2"]
    assert (
        list(parsed(curves(Chart("nothing", "iteration", [Line("", np.array([]), np.array([]))]))).iter(f"{NS}polyline"))
        == []
    )


def test_powers_of_ten_are_equally_far_on_a_logarithmic_axis():
    drawing = curves(Chart("rate", "i", [Line("", np.arange(3.0), np.array([1e-4, 1e-3, 1e-2]))], log=True))
    (line,) = parsed(drawing).iter(f"{NS}polyline")
    heights = points(line)[:, 1]
    assert heights[0] - heights[1] == pytest.approx(heights[1] - heights[2], abs=0.11)
    assert {"0.0001", "0.001", "0.01"} <= set(texts(drawing))


def test_a_long_line_keeps_its_ends_and_its_mean():
    x = np.arange(10_001.0)
    y = 3.0 + np.sin(x)
    (line,) = parsed(curves(Chart("x", "iteration", [Line("", x, y)]))).iter(f"{NS}polyline")
    at = [float(text) for text in line.get("data-x").split()]
    values = [float(text) for text in line.get("data-v").split()]
    assert len(at) == len(values) == MOST_POINTS
    assert (at[0], at[-1]) == (0.0, 10_000.0)
    assert np.mean(values) == pytest.approx(3.0, abs=0.01)


def test_parts_are_stacked_by_their_sign_and_sum_up():
    """2 and 3 upwards, -1 downwards: areas meet at 2, end at 5 and -1, and the sum is 4."""
    parts = {"a": np.full(3, 2.0), "b": np.full(3, -1.0), "c": np.full(3, 3.0)}
    drawing = parsed(stacked(Chart("parts", "iteration"), np.arange(3.0), parts))
    areas = [points(element)[:, 1] for element in drawing.iter(f"{NS}polygon")]
    a, b, c = ((float(area.min()), float(area.max())) for area in areas)
    unit = a[1] - a[0]  # of 2
    assert b == pytest.approx((a[1], a[1] + unit / 2), abs=0.11)
    assert c == pytest.approx((a[0] - 1.5 * unit, a[0]), abs=0.11)
    (line,) = drawing.iter(f"{NS}polyline")
    assert points(line)[:, 1] == pytest.approx(a[1] - 2 * unit, abs=0.11)
    assert [e.get("data-name") for e in drawing.iter() if e.get("data-name")] == ["a", "b", "c", "sum"]
    assert line.get("data-v").split() == ["4"] * 3


def test_cells_are_darker_the_larger_they_are_and_say_their_value():
    values = np.array([[0.0, 0.5], [1.0, np.nan]])
    drawing = heat_map("error [m/s]", "vx [m/s]", "vy [m/s]", (-1.0, 1.0), (-0.5, 0.5), values)
    cells = [element.get("fill") for element in parsed(drawing).iter(f"{NS}rect")]
    assert cells == [shade(0.0), shade(0.5), shade(1.0), shade(0.0)]
    lightness = [sum(int(cell[i : i + 2], 16) for i in (1, 3, 5)) for cell in cells[:3]]
    assert lightness == sorted(lightness, reverse=True)
    assert {"0.00", "0.50", "1.00", "-", "-1", "-0.5", "vx [m/s]", "vy [m/s]", "error [m/s]"} <= set(texts(drawing))


@pytest.mark.parametrize(
    ("low", "high", "count", "wanted"),
    [
        (0.0, 1.0, 5, [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]),
        (-3.0, 7.0, 5, [-2.0, 0.0, 2.0, 4.0, 6.0]),
        (0.0, 24.0, 6, [0.0, 5.0, 10.0, 15.0, 20.0]),
        (1.0, 1500.0, 6, [500.0, 1000.0, 1500.0]),
        (0.0012, 0.0019, 3, [0.0015]),
    ],
)
def test_ticks_are_round(low, high, count, wanted):
    assert ticks(low, high, count) == pytest.approx(wanted)


def test_large_numbers_are_short():
    assert [short(v) for v in (0.0, 0.25, 1500.0, 20_000.0, 1.5e6, 2e9)] == ["0", "0.25", "1500", "20k", "1.5M", "2G"]


def test_a_sheet_has_all_drawings_side_by_side():
    one = curves(Chart("first", "iteration", [Line("", np.arange(3.0), np.ones(3))]))
    whole = parsed(sheet([one.replace("first", name) for name in ("a1", "b2", "c3")], columns=2))
    places = [(float(e.get("x")), float(e.get("y"))) for e in whole.iter(f"{NS}svg") if e.get("x")]
    assert places == [(0.0, 0.0), (WIDTH + 12, 0.0), (0.0, HEIGHT + 12)]
    assert {"a1", "b2", "c3"} <= {e.text for e in whole.iter(f"{NS}text")}


def test_what_is_written_is_not_read_as_a_drawing():
    name = '<script>"&'
    drawing = curves(Chart(name, name, [Line(name, np.arange(2.0), np.ones(2))], unit=name))
    assert name in texts(drawing)
    assert not re.search("<script", drawing)


def drawn(*charts: Chart, path, **how) -> np.ndarray:
    """The pixels of charts in a PNG file."""
    draw_charts(charts, path, **how)
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB"))


def has(pixels: np.ndarray, color: str) -> bool:
    return bool((pixels == [int(color[i : i + 2], 16) for i in (1, 3, 5)]).all(axis=2).any())


@pytest.mark.slow
def test_a_chart_is_a_panel_of_a_picture(tmp_path):
    """Three panels take two rows; each line has its colour, and a single point is a marker with its interval."""
    point = Line("point", np.array([0.2]), np.array([0.5]), (np.array([0.4]), np.array([0.7])), markers=True)
    lines = [Line("a", np.arange(3.0), np.ones(3)), Line("b", np.arange(3.0), np.array([0.0, np.nan, 2.0]))]
    one, two = Chart("x", "iteration", lines), Chart("y", "size", [point], percent=True, walls=(("end", 0.3),))
    low = drawn(one, two, path=tmp_path / "low.png")
    high = drawn(one, two, one, path=tmp_path / "high.png", iteration_s=2.0)
    assert high.shape[0] > 1.8 * low.shape[0]
    assert has(low, COLORS[0])
    assert has(low, COLORS[1])
    axis = Figure().subplots()
    draw_panel(axis, two)
    (interval, *_) = axis.collections
    assert interval.get_segments()[0].tolist() == [[0.2, 0.4], [0.2, 0.7]]
