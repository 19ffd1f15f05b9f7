"""Locks: their holders, kills, and disks that cannot lock files."""

import errno
import fcntl
import json
import os
import signal
import socket
import subprocess
import sys

import pytest

from emmc_rig.store.locks import TakenError, take_lock

HOLD = """
import sys, time
from pathlib import Path
from emmc_rig.store.locks import take_lock
release = take_lock(Path(sys.argv[1]))
print("held", flush=True)
time.sleep(600)
"""
RACE = """
import sys
from pathlib import Path
from emmc_rig.store.locks import TakenError, take_lock
folder, taken = Path(sys.argv[1]), 0
sys.stdin.readline()
while taken < 100:
    try:
        release = take_lock(folder / "lock")
    except TakenError:
        continue
    count = int((folder / "count").read_text())
    (folder / "count").write_text(str(count + 1))
    release()
    taken += 1
"""


@pytest.fixture
def holder(tmp_path):
    """Another program that holds the lock."""
    typed = [sys.executable, "-c", HOLD, str(tmp_path / "lock")]
    with subprocess.Popen(typed, stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None
        assert program.stdout.readline() == "held\n"
        yield program
        program.kill()


@pytest.fixture
def no_locks(monkeypatch):
    """A disk on which files cannot be locked, as some in a network."""

    def refuse(descriptor, how):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr("fcntl.flock", refuse)


def test_a_lock_names_its_holder_and_goes_with_it(tmp_path, holder):
    with pytest.raises(TakenError, match=rf"`-c .*lock` \(process {holder.pid} on .*, since 20"):
        take_lock(tmp_path / "lock")
    holder.send_signal(signal.SIGKILL)
    holder.wait()
    assert json.loads((tmp_path / "lock").read_text())["process"] == holder.pid
    release = take_lock(tmp_path / "lock")
    assert json.loads((tmp_path / "lock").read_text())["process"] == os.getpid()
    release()
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked")
def test_a_process_that_was_forked_meanwhile_keeps_no_lock(tmp_path):
    release = take_lock(tmp_path / "lock")
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        os.read(reader, 1)
        os._exit(0)
    try:
        release()
        take_lock(tmp_path / "lock")()
    finally:
        os.write(writer, b"x")
        os.waitpid(child, 0)


def test_a_lock_of_version_0_4_holds(tmp_path):
    """It locked the file itself by `flock`, and wrote the same line into it."""
    name = {"command": "emmc-rig capture", "process": 7, "host": "bench", "since": "noon"}
    with open(tmp_path / "lock", "w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        file.write(json.dumps(name))
        file.flush()
        with pytest.raises(TakenError, match=r"`emmc-rig capture` \(process 7 on bench, since"):
            take_lock(tmp_path / "lock")
    take_lock(tmp_path / "lock")()


def test_the_holder_is_read_without_the_byte_that_windows_locks(tmp_path, holder):
    content = (tmp_path / "lock").read_bytes()
    (tmp_path / "lock").write_bytes(b"?" + content[1:])
    with pytest.raises(TakenError, match=rf"process {holder.pid} on "):
        take_lock(tmp_path / "lock")


@pytest.mark.parametrize(
    ("host", "advice"),
    [
        ("bench", "wait until it ends, or stop it; if it ended without a word, delete"),
        (socket.gethostname(), "it has ended: delete"),
    ],
)
def test_a_lock_by_file_holds_and_says_what_to_delete_after_a_kill(tmp_path, host, advice):
    """Version 0.4 wrote the same line. No program has the number."""
    name = {"command": "emmc-rig capture", "process": 2**31 - 1, "host": host, "by_file": True}
    (tmp_path / "lock").write_text(json.dumps(name))
    with pytest.raises(TakenError, match=f"{advice} {tmp_path}/lock"):
        take_lock(tmp_path / "lock")
    assert json.loads((tmp_path / "lock").read_text()) == name


@pytest.mark.usefixtures("no_locks")
def test_where_files_cannot_be_locked_the_file_is_the_lock(tmp_path):
    release = take_lock(tmp_path / "lock")
    with pytest.raises(TakenError, match=f"process {os.getpid()} on .*; wait until it ends"):
        take_lock(tmp_path / "lock")
    release()
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("no_locks")
def test_a_lock_that_its_owner_was_told_to_delete_is_not_taken_from_the_next(tmp_path):
    release = take_lock(tmp_path / "lock")
    (tmp_path / "lock").rename(tmp_path / "deleted")
    theirs = take_lock(tmp_path / "lock")
    release()
    with pytest.raises(TakenError):
        take_lock(tmp_path / "lock")
    theirs()


def test_what_is_wrong_with_the_file_is_no_disk_without_locks(tmp_path):
    with pytest.raises(FileNotFoundError):
        take_lock(tmp_path / "missing/lock")
    (tmp_path / "lock").mkdir()
    with pytest.raises(IsADirectoryError):
        take_lock(tmp_path / "lock")


@pytest.mark.slow
def test_programs_that_take_turns_never_hold_it_together(tmp_path):
    (tmp_path / "count").write_text("0")
    typed = [sys.executable, "-c", RACE, str(tmp_path)]
    programs = [subprocess.Popen(typed, stdin=subprocess.PIPE) for _ in range(4)]
    for program in programs:
        program.communicate(b"\n", timeout=300)
    assert [program.returncode for program in programs] == [0] * 4
    assert (tmp_path / "count").read_text() == "400"
    assert not (tmp_path / "lock").exists()
