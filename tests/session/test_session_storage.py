"""What a session keeps through power cuts, full disks and damage: everything it counted."""

import copy
import errno
import hashlib
import json
import os
import shutil
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from capture_rigs import (
    PLAN_YAML,
    SIZE,
    PreparedCamera,
    begun,
    frame_bytes,
    plan_and_camera,
    still_rig,
)
from simulated_disk import PowerCutError, SimulatedDisk

from emmc_rig.captures.amend import amendment
from emmc_rig.captures.expand import expand
from emmc_rig.captures.sequencer import Sequencer
from emmc_rig.drivers.raw import RawFrame
from emmc_rig.errors import AppError
from emmc_rig.model.files import SYSTEM_DISK, part_of, write_whole
from emmc_rig.progress import Watcher
from emmc_rig.session.board_sets import decoded
from emmc_rig.session.journal import (
    FrameEntry,
    RetryEntry,
    RunEntry,
    count_stored,
    decode_line,
    encode_line,
    of_kind,
)
from emmc_rig.session.lock import held
from emmc_rig.session.session import FRAMES, JOURNAL, LOCK, PLAN, Frozen, Session
from emmc_rig.session.verify import verify

ROOT = Path("/disk")


class Promised(Watcher):
    """Keeps the frames that the program said are safe."""

    def __init__(self):
        self.frames = []

    def event(self, event):
        if event.name == "frame.written":
            self.frames.append(event.facts["id"])


def run_on(disk, folder=ROOT, watcher=None):
    """Begin a session, or go on with it, as a program would that knows only the disk."""
    rig = still_rig()
    try:
        session, plan = Session(folder / "s", disk), plan_and_camera()[0]
    except AppError:
        session, plan = begun(folder, disk, rig)
    Sequencer(session, plan, rig, watcher).run()
    return session


def frames_on(disk, folder=ROOT):
    session = Session(folder / "s", disk)
    return {frame.id: session.read(frame.id) for frame in session.frames}


@pytest.fixture(scope="module")
def undisturbed():
    disk = SimulatedDisk()
    run_on(disk)
    return disk.operations, frames_on(disk)


def assert_whole(disk, expected):
    """Every frame is there once, byte for byte, and the journal counts each once."""
    session = Session(ROOT / "s", disk)
    assert verify(session).is_complete
    assert session.is_complete
    assert frames_on(disk) == expected
    files = [name for name in disk.sizes(ROOT / "s" / FRAMES) if not name.startswith(".")]
    assert len(files) == len(expected)


def test_a_frame_is_the_bytes_that_the_camera_gave(undisturbed):
    _, frames = undisturbed
    assert frames["shot-0-e1-r0"] == frame_bytes("shot-0-e1-r0", 0.04)
    assert len(frames) == 2 + 2 * 2 + 2 * 1 + 1 + 3


DUMP = {"black_level_dn": np.array([[100.5, 99], [98, 100]]), "white_level_dn": 4000}


def dumped(mosaic, name="", cfa="rggb"):
    """A frame of a plug-in's camera: its own bytes are the bare samples, big-endian."""
    data = mosaic.astype(">u2").tobytes()
    digest = hashlib.sha256(data).hexdigest()
    return RawFrame(mosaic, **DUMP, cfa=cfa, exposure_s=0.01, original=data, sha256=digest,
                    metadata={"name": name, "maker": "Plug & Co"})  # fmt: skip


@pytest.mark.parametrize(
    ("name", "cfa"), [("", "rggb"), ("x.raw", "mono"), ("x.dng", "rgbw-random")]
)
def test_frames_that_only_a_plug_in_could_decode_are_read_back_without_it(tmp_path, name, cfa):
    taken, rig = [], still_rig()

    def give(exposure_s):
        rng = np.random.default_rng(len(taken))
        taken.append(dumped(rng.integers(100, 150, SIZE, np.uint16), name, cfa))
        return taken[-1]

    rig = replace(rig, camera=PreparedCamera(give, cfa), about_to_expose=lambda name: None)
    text = "{camera: rgbw-bayer-1shot, shots: [{exposure_s: 0.01}], whiteboards: null, "
    session, plan = begun(tmp_path, SYSTEM_DISK, rig, text + "darks: {repeats: 2}}")
    Sequencer(session, plan, rig).run()
    again = Session(session.folder)
    assert verify(again).is_complete
    assert not again.unexpected_files()[1]
    for frame, back in zip(taken, decoded(again, again.frames), strict=True):
        np.testing.assert_array_equal(back.mosaic, frame.mosaic)
        np.testing.assert_array_equal(back.black_level_dn, frame.black_level_dn)
        assert (back.white_level_dn, back.cfa) == (frame.white_level_dn, frame.cfa)
        assert (back.original, back.sha256) == (frame.original, frame.sha256)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_a_power_cut_at_any_operation_loses_and_doubles_nothing(undisturbed, seed):
    operations, expected = undisturbed
    rng = np.random.default_rng(seed)
    for cut in range(1, operations + 1):
        disk, promised = SimulatedDisk(), Promised()
        disk.cut_power_at(cut)
        with pytest.raises(PowerCutError):
            run_on(disk, watcher=promised)
        survived = disk.after_power_cut(rng)
        run_on(survived)
        assert_whole(survived, expected)
        # What was said to be safe before the cut was not taken again.
        entries = Session(ROOT / "s", survived).journal.entries
        lines = [entry.id for entry in of_kind(entries, FrameEntry)]
        assert all(lines.count(name) == 1 for name in promised.frames), cut
        if promised.frames:
            runs = [entry.resumed for entry in of_kind(entries, RunEntry)]
            assert runs == [False, True], cut


def test_power_cuts_in_every_run_after_another_still_end_complete(undisturbed):
    _, expected = undisturbed
    rng = np.random.default_rng(7)
    disk = SimulatedDisk()
    for _ in range(200):
        disk.cut_power_at(int(rng.integers(1, 60)))
        try:
            run_on(disk)
            break
        except PowerCutError:
            disk = disk.after_power_cut(rng)
    assert_whole(disk, expected)


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EIO])
def test_any_operation_that_fails_stops_the_run_and_a_resume_completes_it(undisturbed, number):
    operations, expected = undisturbed
    for failing in range(1, operations + 1, 4):
        disk = SimulatedDisk()

        def fail(now, name, failing=failing):
            if now >= failing:
                raise OSError(number, "injected")

        disk.before = fail
        with pytest.raises((OSError, AppError)):
            run_on(disk)
        disk.before = lambda now, name: None
        run_on(disk)
        assert_whole(disk, expected)


def test_without_syncs_a_power_cut_does_lose_what_was_counted(undisturbed):
    """The simulated disk is not kinder than a real one: the tests above could fail."""
    operations, _ = undisturbed

    class Forgetful(SimulatedDisk):
        def sync(self, path):
            self.operations += 1

    rng = np.random.default_rng(0)
    lost = 0
    for cut in range(operations // 2, operations, 5):
        disk = Forgetful()
        disk.cut_power_at(cut)
        with pytest.raises(PowerCutError):
            run_on(disk)
        before = set(Session(ROOT / "s", disk).stored)
        survived = disk.after_power_cut(rng)
        try:
            session = Session(ROOT / "s", survived)
            lost += bool(verify(session).damaged) or set(session.stored) != before
        except AppError:
            lost += 1
    assert lost > 3


RETRY = RetryEntry(id="a", fault='\u00e9"', attempt=1)
FRAME_OF_0_2 = {
    "kind": "frame",
    "id": "a",
    "file": "00000-a.dng",
    "bytes": 12,
    "sha256": "0",
    "shape": [24, 32],
    "cfa": "rggb",
    "black_level_dn": [[100, 100], [100, 100]],
    "white_level_dn": 4000,
    "exposure_s": 0.01,
    "gain": 1.0,
    "figures": {"saturated": 0.0, "mean_dn": 70.0, "bright_dn": 2050.0},
}
"""What every program since 0.2 writes."""


def checked(entry):
    """Return an entry as a line of the journal, with its checksum."""
    body = json.dumps(entry)[:-1]
    return f'{body},"crc32":"{zlib.crc32(body.encode()):08x}"}}'.encode()


def test_a_line_that_is_torn_anywhere_does_not_count():
    line = encode_line(RETRY)
    assert decode_line(line[:-1]) == RETRY
    for length in range(len(line) - 1):
        assert decode_line(line[:length]) is None


def test_a_frame_that_version_0_2_journalled_counts():
    entry = decode_line(checked(FRAME_OF_0_2))
    assert isinstance(entry, FrameEntry)
    assert count_stored([entry]) == {"a": entry}
    assert entry.level == pytest.approx(2050 / 3900)
    assert (entry.camera_sha256, entry.triggered) == (None, False)
    assert decode_line(encode_line(entry)[:-1]) == entry


@pytest.mark.parametrize(
    "entry",
    [
        {key: value for key, value in FRAME_OF_0_2.items() if key != "sha256"},
        FRAME_OF_0_2 | {"file": 3},
        {"kind": "created", "frames": 3},
        {"kind": 3},
        {"id": "a"},
    ],
)
def test_a_line_without_what_its_kind_needs_does_not_count(entry):
    assert decode_line(checked(entry)) is None


def test_a_line_of_a_kind_that_only_later_programs_know_says_nothing():
    entry = decode_line(checked({"kind": "cleaned", "by": "hand"}))
    assert entry is not None
    assert (entry.kind, str(entry)) == ("cleaned", "")


def test_a_line_with_any_flipped_bit_does_not_count():
    line = encode_line(RETRY)[:-1]
    for place in range(len(line)):
        for bit in range(8):
            damaged = bytearray(line)
            damaged[place] ^= 1 << bit
            assert decode_line(bytes(damaged)) is None


def test_a_linked_name_leads_no_bytes_out_of_the_session(tmp_path, monkeypatch):
    monkeypatch.setattr("secrets.token_hex", lambda count: "0" * 2 * count)
    outside = tmp_path / "outside"
    outside.write_bytes(b"precious")
    target = tmp_path / "frame.dng"
    part_of(target).symlink_to(outside)
    with pytest.raises(OSError, match=r"."):
        write_whole(SYSTEM_DISK, target, b"new")
    assert outside.read_bytes() == b"precious"


@pytest.fixture
def on_disk(tmp_path):
    return run_on(SYSTEM_DISK, tmp_path)


def test_a_torn_raw_file_is_found_and_taken_again(on_disk, tmp_path, undisturbed):
    path = on_disk.path_of(on_disk.stored["shot-1-e0-r0"])
    path.write_bytes(path.read_bytes()[:-7])
    verdict = verify(Session(on_disk.folder))
    assert "has" in verdict.damaged["shot-1-e0-r0"]
    assert not verdict.is_complete
    again = run_on(SYSTEM_DISK, tmp_path)
    assert verify(again).is_complete
    assert path.read_bytes() == undisturbed[1]["shot-1-e0-r0"]


def test_a_torn_journal_line_costs_one_frame(on_disk, tmp_path):
    path = on_disk.folder / JOURNAL
    lines = path.read_bytes().splitlines(keepends=True)
    last_frame = max(i for i, line in enumerate(lines) if b'"kind":"frame"' in line)
    path.write_bytes(b"".join(lines[:last_frame]) + lines[last_frame][:100])
    torn = Session(on_disk.folder)
    assert len(torn.missing()) == 1
    assert verify(torn).unreadable == 1
    again = run_on(SYSTEM_DISK, tmp_path)
    assert verify(again).is_complete
    assert json.loads(path.read_bytes().splitlines()[-1])["kind"] == "complete"


def test_an_edited_plan_in_the_session_is_reported(on_disk):
    with open(on_disk.folder / PLAN, "a") as file:
        file.write("# an afterthought\n")
    verdict = verify(Session(on_disk.folder))
    assert "was changed after the session began" in verdict.frozen[0]
    assert not verdict.is_complete


def test_a_foreign_file_is_named_and_left_alone(on_disk, tmp_path):
    notes, stray = on_disk.folder / "notes.txt", on_disk.folder / FRAMES / "IMG_0001.DNG"
    notes.write_text("mine")
    stray.write_bytes(b"mine too")
    verdict = verify(Session(on_disk.folder))
    assert verdict.foreign == ("frames/IMG_0001.DNG", "notes.txt")
    assert verdict.is_complete
    run_on(SYSTEM_DISK, tmp_path)
    assert notes.read_text() == "mine"
    assert stray.read_bytes() == b"mine too"


def test_leftovers_are_named_and_go_with_the_next_capture(on_disk, tmp_path):
    entry = on_disk.stored["dark-0-r0"]
    on_disk.discard("dark-0-r0", "for the test")
    part = part_of(on_disk.folder / FRAMES / "x.dng")
    part.write_bytes(b"half")
    named = (f"{FRAMES}/{part.name}", f"{FRAMES}/{entry.file}")
    assert verify(Session(on_disk.folder)).leftovers == tuple(sorted(named))
    verdict = verify(run_on(SYSTEM_DISK, tmp_path))
    assert verdict.is_complete
    assert not verdict.leftovers
    assert not part.exists()


def test_a_folder_of_frames_that_somebody_removed_is_filled_again(on_disk, tmp_path, undisturbed):
    shutil.rmtree(on_disk.folder / FRAMES)
    verdict = verify(Session(on_disk.folder))
    assert len(verdict.damaged) == len(undisturbed[1])
    again = run_on(SYSTEM_DISK, tmp_path)
    assert verify(again).is_complete
    assert {name: again.read(name) for name in undisturbed[1]} == undisturbed[1]


def amended(disk):
    """Let the second shot be taken once more, and be exposed otherwise from now on."""
    session = Session(ROOT / "s", disk)
    text = PLAN_YAML.replace(
        "{mask_um: [48, 24], exposure_s: auto}",
        "{mask_um: [48, 24], exposure_s: 0.03, repeats: 2}",
    )
    plan, camera = plan_and_camera(text)
    rig = {"kind": "x"}
    edit = amendment(session, plan, camera, rig, expand(plan, camera, still_rig().window_um))
    if edit is None:
        return session, plan
    camera_data = camera.model_dump(mode="json")
    return session.amend(Frozen(text, camera_data, rig, edit.frames), edit.changes), plan


def test_a_power_cut_in_an_amendment_leaves_the_plan_before_or_the_one_after(undisturbed):
    _, taken = undisturbed
    rng = np.random.default_rng(3)
    begun_disk = SimulatedDisk()
    run_on(begun_disk)
    whole = copy.deepcopy(begun_disk)
    amended(whole)
    held_by = []
    for cut in range(begun_disk.operations + 1, whole.operations + 1):
        disk = copy.deepcopy(begun_disk)
        disk.cut_power_at(cut)
        with pytest.raises(PowerCutError):
            amended(disk)
        survived = disk.after_power_cut(rng)
        held_by.append(Session(ROOT / "s", survived).amendments)
        session, plan = amended(survived)
        assert session.amendments == 1
        Sequencer(session, plan, still_rig()).run()
        verdict = verify(Session(ROOT / "s", survived))
        assert verdict.is_complete
        assert not verdict.leftovers
        now = frames_on(survived)
        assert len(now) == len(taken) + 1
        assert {name: now[name] for name in taken} == taken
    assert held_by[0] == 0
    assert len(held_by) == 4 * 5 + 2


def test_two_programs_do_not_work_on_one_session(on_disk):
    who = rf"held by `.*` \(process {os.getpid()} on .*, since "
    with held(on_disk.folder), pytest.raises(AppError, match=who), held(on_disk.folder):
        pass
    assert not (on_disk.folder / LOCK).exists()


def test_a_folder_that_is_no_session_is_reported(tmp_path):
    with pytest.raises(AppError, match="no session"):
        Session(tmp_path)
