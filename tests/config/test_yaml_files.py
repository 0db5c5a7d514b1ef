"""YAML that is odd, wrong or hostile: read as the standard says, or refused in one line that names file and line."""

import pytest

from legged.config.yaml_files import MOST_BYTES, dump, parse, read_yaml
from legged.errors import ConfigError


@pytest.fixture
def path(tmp_path):
    return tmp_path / "mine.yaml"


def refused(path, content: str | bytes) -> str:
    """The error of reading such a file."""
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ConfigError) as error:
        read_yaml(path)
    text = str(error.value)
    assert text.startswith(f"{path}: ")
    assert "\n" not in text
    return text


def test_merge_keys_are_laid_below_a_block_s_own():
    text = "a: &a {x: 1, y: 2}\nb: &b {y: 3, z: 4}\nc: {<<: *a, y: 9}\nd: {<<: [*a, *b], w: 0}\ne: {<<: {v: 1}}\n"
    data = parse(text, "here")
    assert data["c"] == {"x": 1, "y": 9}
    assert data["d"] == {"x": 1, "y": 2, "z": 4, "w": 0}  # of two the first wins
    assert data["e"] == {"v": 1}
    assert data["a"] == {"x": 1, "y": 2}


@pytest.mark.parametrize(
    "text", ["1e-3", "1e3", "7e12345", "-1E5", ".5e3", "1_0e2", "010", "-.5", "1:30", "yes", "2026-11-22"]
)
def test_text_that_looks_like_a_number_is_read_back_as_text(text):
    """A run that is named after its learning rate could be trained, and then neither played nor resumed."""
    assert parse(dump({text: [text]}), "here") == {text: [text]}


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("-.5", -0.5),
        ("+.5", 0.5),
        (".5", 0.5),
        ("-.5e1", -5.0),
        ("-5.", -5.0),
        ("-0", 0),
        ("0", 0),
        ("0x10", 16),
        ("1_0", 10),
    ],
)
def test_numbers_with_signs_and_without_zeros(text, value):
    assert parse(f"[{text}]", "here") == [value]


@pytest.mark.parametrize("text", ["010", "-010", "0_10", "1:30"])
def test_a_number_that_others_read_as_another_one_is_refused(text):
    """`env.seed=010` was seed 8, where `--seed 010` is 10."""
    with pytest.raises(ConfigError, match=rf"^here: not valid YAML: '{text}' cannot be read \(YAML 1.1 and 1.2 read"):
        parse(text, "here")


@pytest.mark.parametrize("number", [1e-3, 1e3, -1e5, 500.0, 1e20, 1e-300, 10])
def test_numbers_are_read_back_as_numbers(number):
    assert parse(dump([number]), "here") == [number]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a: &a {x: 1}\nb: {<<: *a, y: 1, y: 2}\n", "key 'y' is given twice in the block from line 2"),
        ("b: {<<: {x: 1}, <<: {y: 1}}\n", "key '<<' is given twice"),
        ("a: 3\nb: {<<: 3}\n", "expected a mapping or list of mappings for merging"),
    ],
)
def test_a_key_given_twice_stays_a_mistake_beside_merge_keys(path, text, words):
    assert words in refused(path, text)


@pytest.mark.parametrize("text", ["a: &a {x: *a}\n", "&a [*a]\n", "a: &a [1, [2, {b: *a}]]\n"])
def test_an_anchor_that_refers_to_itself_is_refused(path, text):
    assert "an anchor refers to itself" in refused(path, text)


def bomb(first: str, link: str) -> str:
    """Ten lines, each of ten times the one before: 10^10 values."""
    lines = [f"a0: &a0 {first}"]
    for i in range(10):
        lines.append(f"a{i + 1}: &a{i + 1} " + link.format(", ".join([f"*a{i}"] * 10)))
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("text", [bomb("[1, 1]", "[{}]"), bomb("{x: 1}", "{{<<: [{}]}}")], ids=["lists", "merge keys"])
def test_aliases_that_stand_for_billions_are_refused(path, text):
    assert "more than 100000 values or 40 nested blocks after aliases are expanded" in refused(path, text)


def test_aliases_in_moderation_are_read():
    assert parse("a: &a [1, 2]\nb: [*a, *a]\n", "here")["b"] == [[1, 2], [1, 2]]


@pytest.mark.parametrize(
    "text",
    ["a: " + "[" * 5000 + "]" * 5000, "a: " + "{b: " * 5000, "".join(" " * i + f"a{i}:\n" for i in range(300))],
    ids=["lists", "maps", "blocks"],
)
def test_blocks_inside_each_other_without_end_are_refused(path, text):
    assert "more than 40 nested blocks" in refused(path, text)


def test_a_huge_file_is_refused_unread(path):
    assert "larger than 250,000 bytes" in refused(path, "# " + "x" * MOST_BYTES)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"\x89PNG\r\n\x1a\n\x00\xff", "line 1 is not text in UTF-8"),
        (b"env:\n  seed: \xff\n", "line 2 is not text in UTF-8"),
        (b"\x00\x01", "unacceptable character"),
        ("env: {}\n---\nsim: {}\n", "expected a single document"),
        ("env: [1\n", "line 2"),
        ("env: @x\n", "(line 1, column 6)"),
        ("? [1, 2]\n: 3\n", "unhashable key"),
        ("a: 2026-13-45\n", "'2026-13-45' cannot be read"),
        ("a: 0b_\n", "'0b_' cannot be read"),
        ("a: !!int x\n", "'x' cannot be read"),
        ("a: " + "9" * 5000, "cannot be read"),
        ("a: !!python/object/apply:os.getcwd []\n", "could not determine a constructor"),
        ("just text\n", "expected a mapping of sections, got str"),
        ("- 1\n", "expected a mapping of sections, got list"),
    ],
)
def test_what_is_no_configuration_is_refused_in_one_line(path, content, words):
    assert words in refused(path, content)


def test_a_file_that_is_none_is_refused(tmp_path):
    for path in (tmp_path, tmp_path / "nowhere.yaml", tmp_path / ("x" * 5000)):
        with pytest.raises(ConfigError, match="cannot be read"):
            read_yaml(path)


def test_a_byte_order_mark_is_no_part_of_the_first_key(path):
    path.write_bytes(b"\xef\xbb\xbfenv: {seed: 3}\n")
    assert read_yaml(path) == {"env": {"seed": 3}}
