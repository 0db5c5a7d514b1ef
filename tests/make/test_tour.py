"""docs/make/tour.py: the film of a tour, and wrong input."""

import pytest
import tour
from PIL import Image


@pytest.mark.slow
def test_a_film_shows_waypoint_and_punch(tmp_path, capsys):
    """Pictures every 0.08 s: before the punch, whose arrow is drawn from 0.1 to 0.66 s, there is less red than during it."""
    out = tmp_path / "tour.gif"
    assert tour.main(["g1_teleop", "--from", "0", "--seconds", "0.8", "--side", "120", "--out", str(out)]) == 0
    assert "10 pictures of 120 x 120 pixels" in capsys.readouterr().out
    film, red = Image.open(out), []
    for number in (0, 4, 9):
        film.seek(number)
        pixels = list(film.convert("RGB").getdata())
        red.append(sum(r > 120 and g < 80 and b < 80 for r, g, b in pixels))
    assert red[1] > max(red[0], red[2]) > 0


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["anymal_c_flat"], "POLICY: the league measures this package's 'g1' and 'h1', but 'anymal_c_flat' has 'anymal_c'"),
        (["half_cheetah"], "POLICY: 'half_cheetah' follows no velocities"),
        (["g1_teleop", "--from", "90"], "--from: must be between 0 and 89"),
    ],
)
def test_wrong_input_is_refused(words, says, tmp_path, capsys):
    assert tour.main([*words, "--out", str(tmp_path / "tour.gif")]) == 2
    assert says in capsys.readouterr().err
