"""Folders of results: what a command may replace, and what an error or a kill leaves behind."""

import errno
import json
import os
import subprocess
import sys
from contextlib import suppress

import pytest
from programs import contents

from emmc_rig.errors import AppError
from emmc_rig.store.folders import FILES, PARTIAL, new_file, result_folder

OPERATIONS = ("rename", "replace", "unlink", "rmdir", "mkdir", "link", "fsync")


def write(out, files, command="simulate", **more):
    with result_folder(out, command, **more) as folder:
        for name, text in files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_text(text)


OLD = {"metrics.json": "old", "frames.h5": "old frames", "pictures/a.png": "old a"}
NEW = {"metrics.json": "new", "light_field.h5": "new field", "pictures/b/c.png": "new c"}


@pytest.fixture
def out(tmp_path):
    """An earlier result with a thesis and a folder of somebody else in it."""
    write(tmp_path / "out", OLD)
    (tmp_path / "out/thesis.txt").write_text("years of work")
    (tmp_path / "out/pictures/holiday.jpg").write_text("sun")
    return tmp_path / "out"


def test_a_result_lists_its_files_and_replaces_these_and_no_others(out):
    assert set(json.loads((out / FILES).read_text())["files"]) == set(OLD)
    write(out, NEW)
    kept = {"thesis.txt": b"years of work", "pictures/holiday.jpg": b"sun"}
    found = {name: data for name, data in contents(out).items() if data is not None}
    assert found == {**{k: v.encode() for k, v in NEW.items()}, **kept, FILES: found[FILES]}
    assert set(json.loads(found[FILES])["files"]) == set(NEW)


def test_a_result_that_adds_keeps_its_earlier_files(out):
    write(out, {"metrics.json": "newer"}, adds=True)
    assert (out / "frames.h5").read_text() == "old frames"
    assert set(json.loads((out / FILES).read_text())["files"]) == set(OLD)
    write(out, NEW)
    assert not (out / "frames.h5").exists()


def _edit(out):
    (out / "pictures/a.png").write_text("retouched")


def _edit_listing(out):
    data = json.loads((out / FILES).read_text())
    data["files"]["thesis.txt"] = "0" * 64
    (out / FILES).write_text(json.dumps(data, indent=1) + "\n")


def _replace_by_folder(out):
    (out / "frames.h5").unlink()
    (out / "frames.h5").mkdir()


def _link_pictures_elsewhere(out):
    (out / "pictures").rename(out.parent / "album")
    (out / "pictures").symlink_to(out.parent / "album")


def _take_a_new_name(out):
    (out / "light_field.h5").write_text("mine")


def _take_a_new_folder(out):
    (out / "pictures/b").write_text("mine")


def _hold_a_session(out):
    (out / "deep/plan-session").mkdir(parents=True)
    (out / "deep/plan-session/session.json").write_text("{}")


HARMS = {
    "frames.h5 is not what": _replace_by_folder,
    "pictures/a.png is not what": _edit,
    "files.json: was edited": _edit_listing,
    "is not what simulate wrote": _link_pictures_elsewhere,
    "light_field.h5 is there and of no earlier": _take_a_new_name,
    "pictures/b is there and of no earlier": _take_a_new_folder,
    "holds the session deep/plan-session": _hold_a_session,
}


@pytest.mark.parametrize("message", HARMS)
def test_what_a_command_did_not_write_makes_it_refuse_and_stays(out, message):
    HARMS[message](out)
    before = contents(out.parent)
    with pytest.raises(AppError, match=message) as fault:
        write(out, NEW)
    assert "\n" not in str(fault.value)
    assert contents(out.parent) == before


def test_a_result_of_another_command_and_foreign_folders_are_refused(out, tmp_path):
    before = contents(tmp_path)
    with pytest.raises(AppError, match="holds the result of simulate"):
        write(out, NEW, command="reconstruct")
    with pytest.raises(AppError, match="something other"):
        write(tmp_path, NEW)
    with pytest.raises(AppError, match="a file of that name"):
        write(out / "thesis.txt", NEW)
    assert contents(tmp_path) == before


def test_edits_made_while_the_command_runs_are_seen(out):
    with pytest.raises(AppError, match="is not what"), result_folder(out, "simulate"):
        (out / "frames.h5").write_text("meanwhile")
    assert (out / "frames.h5").read_text() == "meanwhile"
    assert (out / "metrics.json").read_text() == "old"


def test_a_session_is_refused_by_every_way_to_it(tmp_path):
    session = tmp_path / "plan-session"
    (session / "frames").mkdir(parents=True)
    (session / "journal.jsonl").write_text("hours of work")
    (tmp_path / "link").symlink_to(session)
    before = contents(tmp_path)
    for out in (session, session / "frames", session / "new/deeper", tmp_path / "link"):
        with pytest.raises(AppError, match="the session"):
            write(out, NEW)
        with pytest.raises(AppError, match="the session"), new_file(out):
            pass
    assert contents(tmp_path) == before
    write(tmp_path / "link/calibration", NEW, belongs_to=session / "calibration")
    with pytest.raises(AppError, match="the session"):
        write(session / "calibrations", NEW, belongs_to=session / "calibration")


@pytest.mark.parametrize("can_lock", [True, False])
def test_two_commands_never_write_into_one_folder_at_a_time(tmp_path, monkeypatch, can_lock):
    if not can_lock:

        def refuse(descriptor, how):
            raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

        monkeypatch.setattr("fcntl.flock", refuse)  # as on some network disks
    with result_folder(tmp_path / "out", "simulate") as folder:
        (folder / "metrics.json").write_text("first")
        with pytest.raises(AppError, match="another emmc-rig command"):
            write(tmp_path / "out", NEW)
    assert (tmp_path / "out/metrics.json").read_text() == "first"
    with new_file(tmp_path / "a.h5") as partial:
        partial.write_text("first")
        with pytest.raises(AppError, match="another emmc-rig command"), new_file(tmp_path / "a.h5"):
            pass
    assert contents(tmp_path)["a.h5"] == b"first"
    assert not partial.exists()


def test_a_new_file_never_replaces_one_that_came_meanwhile(tmp_path):
    def both():
        with new_file(tmp_path / "a.h5") as partial:
            partial.write_text("ours")
            (tmp_path / "a.h5").write_text("theirs")

    with pytest.raises(AppError, match="exists already"):
        both()
    assert contents(tmp_path) == {"a.h5": b"theirs"}


class Killed(BaseException):
    """The program is no more: after the first, every further operation raises it too."""


def interrupted(patch, at, fault, again):
    """Let the operation number `at` on the file system, and with `again` all after it, fail."""
    count = 0

    def failing(function):
        def call(*arguments, **options):
            nonlocal count
            count += 1
            if count == at + 1 or (again and count > at):
                raise fault
            return function(*arguments, **options)

        return call

    for name in OPERATIONS:
        patch.setattr(os, name, failing(getattr(os, name)))
    return lambda: count


def failing_command(out):
    with suppress(ZeroDivisionError), result_folder(out, "simulate") as folder:
        (folder / "metrics.json").write_text("half")
        raise ZeroDivisionError


FAULTS = {
    "kill": (Killed, True),
    "Ctrl-C": (KeyboardInterrupt, False),
    "full disk": (lambda: OSError(errno.ENOSPC, "No space left on device"), False),
    "broken disk": (lambda: OSError(errno.EIO, "Input/output error"), True),
}


@pytest.mark.slow
@pytest.mark.parametrize("first", [False, True], ids=["replacing", "first"])
@pytest.mark.parametrize("kind", FAULTS)
def test_whatever_ends_a_command_anywhere_the_folder_is_one_whole_result(
    tmp_path, monkeypatch, kind, first
):
    make, again = FAULTS[kind]
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)  # slow, and counted all the same
    write(tmp_path / "wanted", NEW)
    seen, at = set(), 0
    while True:
        place = tmp_path / f"{at}"
        place.mkdir()
        out = place / "out"
        if not first:
            write(out, OLD)
            (out / "thesis.txt").write_text("years of work")
        old = contents(place)
        new = {f"out/{name}": data for name, data in contents(tmp_path / "wanted").items()}
        new = {**new, "out": None} | ({} if first else {"out/thesis.txt": b"years of work"})
        with pytest.MonkeyPatch.context() as patch:
            count = interrupted(patch, at, make(), again)
            with suppress(Killed, KeyboardInterrupt, AppError):
                write(out, NEW)
            ended = count() <= at
        if kind == "Ctrl-C" and not any(PARTIAL in name for name in contents(place)):
            assert contents(place) in (old, new)
        failing_command(out)
        found = contents(place)
        if first and found == {"out": None}:
            found = {}  # the killed program's own empty folder
        assert found in (old, new), at
        seen.add("new" if found == new else "old")
        write(out, NEW)
        assert contents(place) == new
        if ended:
            break
        at += 1
    assert seen == {"old", "new"}
    assert at > 20


def killed_after(out, renames):
    """Write NEW over OLD, and be killed after so many files took their places."""
    done = []

    def replace(source, target, real=os.replace):
        if len(done) > renames:  # the first is that of files.json in the hidden folder
            raise Killed
        done.append(target)
        real(source, target)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "replace", replace)
        with suppress(Killed):
            write(out, NEW)
    assert (out / PARTIAL / FILES).exists()


@pytest.mark.parametrize("name", ["light_field.h5", "metrics.json"])
def test_an_edit_after_a_kill_between_two_moves_is_kept_and_reported(out, name):
    """light_field.h5 has taken its place by then, metrics.json is the earlier one yet."""
    killed_after(out, 1)
    (out / name).write_text("edited")
    for _ in range(2):
        with pytest.raises(AppError, match=f"{name} is not what simulate wrote"):
            write(out, OLD)
        assert (out / name).read_text() == "edited"
    (out / name).rename(out.parent / "mine")
    failing_command(out)
    # The moved file is where its owner put it; all other files are those of the new result.
    moved = {name} & {"light_field.h5"}
    written = {other: (out / other).read_text() for other in NEW if other not in moved}
    assert written == {other: text for other, text in NEW.items() if other not in moved}
    assert not any((out / other).exists() for other in moved)
    assert not (out / PARTIAL).exists()


def test_a_file_of_somebody_that_came_after_a_kill_is_kept_and_reported(out):
    killed_after(out, 0)
    (out / "light_field.h5").write_text("mine")
    with pytest.raises(AppError, match=r"light_field\.h5 is there and of no earlier result"):
        write(out, OLD)
    assert (out / "light_field.h5").read_text() == "mine"


def test_a_result_that_version_0_2_had_not_finished_replacing_is_refused_as_it_is(out):
    (out / PARTIAL / "earlier").mkdir(parents=True)
    (out / "metrics.json").rename(out / PARTIAL / "earlier/metrics.json")
    (out / PARTIAL / "moves.json").write_text("{}")
    before = contents(out)
    with pytest.raises(AppError, match=r"version 0\.2 was interrupted"):
        write(out, NEW)
    assert contents(out) == before


KILLED = """
import os, signal, sys
from pathlib import Path
sys.path[:0] = sys.argv[3:]
from test_result_folders import NEW, write
count, at = 0, int(sys.argv[2])
def audit(event, arguments):
    global count
    if event in ("os.rename", "os.remove", "os.rmdir", "os.mkdir", "open"):
        count += sys.argv[1] in str(arguments[0])
        if count > at:
            os.kill(os.getpid(), signal.SIGKILL)
sys.addaudithook(audit)
write(Path(sys.argv[1]), NEW)
"""


@pytest.mark.skipif(os.name == "nt", reason="SIGKILL")
@pytest.mark.parametrize("at", [3, 17, 24, 29])
def test_a_real_kill_leaves_one_whole_result_and_no_hidden_files_after_the_next_command(out, at):
    before, imported = contents(out), (os.path.dirname(__file__), *sys.path)
    typed = [sys.executable, "-c", KILLED, str(out), str(at), *imported]
    done = subprocess.run(typed, check=False)
    assert done.returncode == -9
    assert (out / PARTIAL).exists()
    failing_command(out)
    assert contents(out) == before
