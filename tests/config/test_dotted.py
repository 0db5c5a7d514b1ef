"""Settings by their dotted paths."""

from legged.config.dotted import MISSING, differences, flat, value_at


def test_settings_are_compared_one_by_one():
    a = {"x": {"y": 1, "z": [1, 2]}, "same": {}, "gone": 3}
    b = {"x": {"y": 2, "z": [1, 2]}, "same": {}, "new": {"deep": None}}
    assert flat(a) == {"x.y": 1, "x.z": [1, 2], "same": {}, "gone": 3}
    assert differences([a, b]) == {"x.y": [1, 2], "gone": [3, MISSING], "new.deep": [MISSING, None]}
    assert differences([a, a, b])["x.y"] == [1, 1, 2]


def test_what_was_empty_is_not_told_beside_what_it_holds_now():
    assert differences([{"sizes": {}}, {"sizes": {"step": 0.15}}]) == {"sizes.step": [MISSING, 0.15]}
    assert differences([{"sizes": {}}, {}]) == {"sizes": [{}, MISSING]}
    assert f"was {MISSING}" == "was nothing"


def test_a_setting_is_looked_up():
    assert value_at({"a": {"b": 0}}, "a.b") == 0
    assert value_at({"a": {"b": 0}}, "a.b.c") is None
    assert value_at({"a": None}, "a.b") is None
