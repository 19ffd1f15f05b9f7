"""Files and folders that appear whole; journals of lines."""

import os
from pathlib import Path

import pytest
from programs import contents

from emmc_rig.model.files import (
    SYSTEM_DISK,
    is_abandoned,
    is_part,
    part_of,
    whole_file,
    whole_folder,
    write_text,
)
from emmc_rig.store.journal import Lines


@pytest.mark.parametrize("fault", [ValueError, KeyboardInterrupt, OSError])
def test_after_an_error_the_earlier_file_stays_and_no_part_of_the_new_one(tmp_path, fault):
    write_text(tmp_path / "a.txt", "old")

    def write():
        with whole_file(tmp_path / "a.txt") as part:
            part.write_text("half")
            assert is_part(part.name)
            raise fault

    with pytest.raises(fault):
        write()
    assert contents(tmp_path) == {"a.txt": b"old"}


@pytest.mark.parametrize("fault", [ValueError, KeyboardInterrupt])
def test_a_folder_takes_its_name_with_all_its_files_or_not_at_all(tmp_path, fault):
    def write(text, raised=None):
        with whole_folder(tmp_path / "frame") as part:
            (part / "inner").mkdir()
            (part / "inner/a.txt").write_text(text)
            if raised is not None:
                raise raised

    with pytest.raises(fault):
        write("half", fault)
    assert not list(tmp_path.iterdir())
    write("first")
    with pytest.raises(fault):
        write("half", fault)
    assert contents(tmp_path / "frame") == {"inner": None, "inner/a.txt": b"first"}
    write("second")
    assert contents(tmp_path / "frame") == {"inner": None, "inner/a.txt": b"second"}
    assert [path.name for path in tmp_path.iterdir()] == ["frame"]


def test_every_file_and_name_is_synced_before_and_after_the_rename(tmp_path, monkeypatch):
    order, replace, fsync = [], os.replace, os.fsync

    def synced(descriptor):
        order.append(Path(os.readlink(f"/proc/self/fd/{descriptor}")).name)
        fsync(descriptor)

    def replaced(source, target):
        order.append("replaced")
        replace(source, target)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", replaced)
    with whole_folder(tmp_path / "frame") as part:
        (part / "a.txt").write_text("a")
    assert order == ["a.txt", part.name, "replaced", tmp_path.name]
    order.clear()
    with whole_file(tmp_path / "b.txt") as part:
        part.write_text("b")
    assert order == [part.name, "replaced", tmp_path.name]


def test_a_part_is_abandoned_once_its_program_has_ended(tmp_path):
    assert not is_abandoned("a.txt")
    assert is_abandoned(part_of(tmp_path / "a.txt").name)  # this program's own, from before
    assert not is_abandoned(f".a.txt.{os.getppid()}-0123abcd.part")
    assert is_abandoned(".a.txt.999999999-0123abcd.part")


def test_removing_a_link_to_a_folder_leaves_the_folder(tmp_path):
    (tmp_path / "album").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "album")
    SYSTEM_DISK.remove(tmp_path / "link")
    assert [path.name for path in tmp_path.iterdir()] == ["album"]


def test_a_torn_line_is_closed_by_the_next_one(tmp_path):
    path = tmp_path / "journal.jsonl"
    path.write_bytes(b'{"a": 1}\n{"b": ')
    journal = Lines(path)
    assert journal.lines == [b'{"a": 1}', b'{"b": ']
    journal.append(b'{"c": 3}\n')
    journal.append(b'{"d": 4}\n')
    assert path.read_bytes() == b'{"a": 1}\n{"b": \n{"c": 3}\n{"d": 4}\n'


def test_a_line_that_could_not_be_written_is_closed_by_the_next_one(tmp_path, monkeypatch):
    path = tmp_path / "journal.jsonl"
    path.touch()
    journal, write = Lines(path), os.write

    def half(descriptor, data):
        if write(descriptor, data[:3]):
            raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", half)
        with pytest.raises(OSError, match="space"):
            journal.append(b"first\n")
    journal.append(b"second\n")
    assert path.read_bytes() == b"fir\nsecond\n"
