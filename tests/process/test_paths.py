"""Files are written whole or not at all, and it is known beforehand whether they can be."""

import errno
import os
import shutil
import time
from pathlib import Path

import pytest

from legged.errors import ConfigError, RunError
from legged.process.paths import (
    ABANDONED_S,
    make_folder,
    ready_to_write,
    replacing,
    write_bytes,
    write_text,
)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_file_takes_its_place_when_it_is_written(tmp_path):
    path = tmp_path / "a.png"
    path.write_text("old")
    with replacing(path) as part:
        assert (part.parent, part.suffix) == (tmp_path, ".png")  # the same disk; writers choose a format by the ending
        part.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert names(tmp_path) == ["a.png"]


@pytest.mark.parametrize(
    ("failure", "kind", "words"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), RunError, "a.png: no space left on the disk"),
        (OSError(errno.EDQUOT, "Disk quota exceeded"), RunError, "a.png: no space left on the disk"),
        (OSError(errno.EROFS, "Read-only file system"), RunError, "a.png: Read-only file system"),
        (PermissionError(errno.EACCES, "Permission denied"), RunError, "a.png: Permission denied"),
        (ValueError("no such format"), ValueError, "^no such format$"),
        (KeyboardInterrupt("now"), KeyboardInterrupt, "now"),
    ],
)
def test_what_fails_half_way_leaves_the_old_file_and_nothing_else(failure, kind, words, tmp_path):
    path = tmp_path / "a.png"
    path.write_text("old")

    def write():
        with replacing(path) as part:
            part.write_text("ne")
            raise failure

    with pytest.raises(kind, match=words):
        write()
    assert path.read_text() == "old"
    assert names(tmp_path) == ["a.png"]


def test_two_who_write_the_same_file_do_not_meet(tmp_path):
    path = tmp_path / "a.png"
    with replacing(path) as first, replacing(path) as second:
        assert first != second
        first.write_text("first")
        second.write_text("second")
    assert path.read_text() == "first"  # the outer one ended last
    assert names(tmp_path) == ["a.png"]


def test_what_a_killed_process_has_left_goes_and_what_another_writes_now_stays(tmp_path):
    old, new, foreign = tmp_path / ".a.77-0.png", tmp_path / ".a.78-0.png", tmp_path / ".a.mine.png"
    for path in (old, new, foreign):
        path.write_text("half")
    long_ago = time.time() - ABANDONED_S - 1.0
    for path in (old, foreign):
        os.utime(path, (long_ago, long_ago))
    write_bytes(tmp_path / "a.png", b"whole")
    assert names(tmp_path) == [".a.78-0.png", ".a.mine.png", "a.png"]


def test_a_device_that_is_always_full_is_called_that(monkeypatch, tmp_path):
    """/dev/full takes no byte: the file beside the target is a link to it."""
    if not Path("/dev/full").exists():
        pytest.skip("a device of Linux")

    def write():
        with replacing(tmp_path / "a.txt") as part:
            part.symlink_to("/dev/full")
            part.write_text("something")

    with pytest.raises(RunError, match="no space left on the disk"):
        write()
    assert names(tmp_path) == []


def test_text_is_written_in_utf_8(tmp_path):
    write_text(tmp_path / "a.txt", "größer")
    assert (tmp_path / "a.txt").read_bytes() == "größer".encode()


# ---- before long work ------------------------------------------------------------------------------------------------


def test_a_look_at_a_folder_leaves_nothing(tmp_path):
    ready_to_write(tmp_path / "a" / "b")
    ready_to_write(tmp_path)
    assert names(tmp_path) == []


def test_room_is_looked_for(tmp_path, monkeypatch):
    free = 3 * 2**20
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(2**30, 2**30 - free, free))
    ready_to_write(tmp_path / "new", 2.9)
    with pytest.raises(RunError, match=r"new: cannot write there: no space left on the disk$"):
        ready_to_write(tmp_path / "new", 3.1)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_may_not_be_written(tmp_path):
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(RunError, match="new: cannot write there: Permission denied"):
            ready_to_write(tmp_path / "new")
        with pytest.raises(RunError, match="new: cannot make the folder: Permission denied"):
            make_folder(tmp_path / "new")
    finally:
        tmp_path.chmod(0o700)


@pytest.mark.parametrize("check", [ready_to_write, make_folder])
@pytest.mark.parametrize("name", ["file", "file/below", "file/far/below", "dangling", "long" * 100, "zero\0byte"])
def test_a_folder_that_cannot_be_is_the_users_mistake(check, name, tmp_path):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "dangling").symlink_to(tmp_path / "gone")
    with pytest.raises(ConfigError, match="cannot make the folder"):
        check(tmp_path / name)
    assert names(tmp_path) == ["dangling", "file"]
