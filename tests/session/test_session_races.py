"""Two programs meet at one session at random offsets: nothing is doubled, overwritten or torn.

EMMC_FUZZ multiplies the number of offsets for each pair of programs.
"""

import json
import os
import re
import shutil
from typing import Any

import h5py
import numpy as np
import pytest
from capture_rigs import frame_bytes
from fuzzing import FUZZ
from programs import line_server

from emmc_rig.model.files import part_of
from emmc_rig.session.journal import FrameEntry, of_kind
from emmc_rig.session.session import FRAMES, Session
from emmc_rig.session.verify import verify

OFFSETS = 5 * FUZZ
PLAN = """
camera: rgbw-bayer-1shot
shots: [{exposure_s: 0.01, repeats: 6}]
whiteboards: {views: [[2, 2], [0, 0]], repeats: 1, references: 2, exposure_s: 0.02}
darks: {repeats: 2}
"""
CAPTURE = ["capture", "plan.yaml", "--rig", "simulated", "--out", "s"]
GO_ON = ["capture", "s"]
EXPORT = ["session", "export", "s", "--out", "s.h5"]
CALIBRATE = ["calibrate", "s", "--out", "c"]
NOTHING, PARTLY, COMPLETE = "nothing", "partly", "complete"
MEETINGS = {
    "create/create": (NOTHING, CAPTURE, CAPTURE, 0.02),
    "capture/capture": (NOTHING, CAPTURE, CAPTURE, 1.0),
    "capture/capture that goes on": (PARTLY, GO_ON, GO_ON, 1.0),
    "export/capture": (COMPLETE, EXPORT, GO_ON, 1.0),
    "calibrate/capture": (PARTLY, CALIBRATE, GO_ON, 1.0),
}
"""What is there before, who comes first and second, and the longest offset as a share of the
first one's time."""
READERS = (EXPORT, CALIBRATE)

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked")


@pytest.fixture(scope="module")
def meet():
    """Run command lines in a folder at an offset; returns what the server answers."""
    with line_server("session_races.py") as answer:

        def call(folder, offset_s, *commands):
            (folder / "commands.json").write_text(json.dumps(commands))
            return json.loads(answer(f"{offset_s} {folder}"))

        yield call


@pytest.fixture(scope="module")
def prepared(memory_folder, meet):
    """Folders to copy: with a plan alone, a session that was killed, and a complete one."""
    folders = {name: memory_folder / name for name in (NOTHING, PARTLY, COMPLETE)}
    folders[NOTHING].mkdir()
    (folders[NOTHING] / "plan.yaml").write_text(PLAN)
    shutil.copytree(folders[NOTHING], folders[COMPLETE])
    assert meet(folders[COMPLETE], 0, CAPTURE)["codes"] == [0]
    shutil.copytree(folders[COMPLETE], folders[PARTLY])
    leave_what_a_kill_leaves(folders[PARTLY] / "s")
    part_of(folders[COMPLETE] / "s" / FRAMES / "00001-x.dng").write_bytes(b"half a frame")
    return folders


def leave_what_a_kill_leaves(session):
    """Tear the journal in the middle of a line; the files of the lines that are gone stay."""
    journal = session / "journal.jsonl"
    data = journal.read_bytes()
    cut = data.index(b'"id":"shot-0-e0-r1"')
    journal.write_bytes(data[: cut + 40])
    (session / "session.lock").write_text('{"command": "killed", "process": 1, "host": "x"')
    part_of(session / FRAMES / "00009-x.dng").write_bytes(b"half a frame")
    part_of(session).mkdir()


def text_of(folder, place):
    text = (folder / f"{place}.log").read_text()
    assert "Traceback" not in text, text
    return text


def assert_loser_knows(folder, answer, commands):
    """Check that the failed program names the session's holder, and that a program succeeded."""
    assert set(answer["codes"]) <= {0, 1}, [text_of(folder, place) for place in (0, 1)]
    assert 0 in answer["codes"], [text_of(folder, place) for place in (0, 1)]
    for place, code in enumerate(answer["codes"]):
        text = text_of(folder, place)
        if code == 0:
            continue
        if commands[place] in READERS:
            assert "resume the capture" in text or "2 pinholes read" in text
            continue
        found = re.search(r"held by `(.*)` \(process (\d+) on ", text)
        assert found, text
        assert int(found[2]) == answer["pids"][1 - place]
        assert found[1] == " ".join(["emmc-rig", *commands[1 - place]])


def assert_nothing_is_doubled_or_torn(folder, meet):
    """The session is made whole; every frame was journalled once and has the camera's bytes."""
    assert meet(folder, 0, GO_ON)["codes"] == [0], text_of(folder, 0)
    session = Session(folder / "s")
    verdict = verify(session)
    assert verdict.is_complete
    assert not verdict.leftovers
    assert not verdict.foreign
    names = [entry.id for entry in of_kind(session.journal.entries, FrameEntry)]
    assert sorted(names) == sorted(frame.id for frame in session.frames)
    assert not [e for e in session.journal.entries if e.kind in ("retry", "discarded")]
    for name, entry in session.stored.items():
        assert session.read(name) == frame_bytes(name, entry.exposure_s)
    hidden = [path for path in folder.rglob("*") if path.name.startswith(".")]
    assert not hidden
    assert not (folder / "s" / "session.lock").exists()


@pytest.mark.slow
@pytest.mark.parametrize("meeting", MEETINGS)
def test_two_programs_that_meet_at_a_session_spoil_nothing(memory_folder, meet, prepared, meeting):
    before, *commands, longest = MEETINGS[meeting]
    alone = memory_folder / "alone"
    shutil.copytree(prepared[before], alone)
    alone_s = meet(alone, 0, commands[0])["seconds"]
    shutil.rmtree(alone)
    rng = np.random.default_rng(0)
    refused = 0
    for number in range(OFFSETS):
        folder = memory_folder / f"{meeting.replace('/', '-')}-{number}"
        shutil.copytree(prepared[before], folder)
        answer = meet(folder, rng.uniform(0, longest * alone_s), *commands)
        assert_loser_knows(folder, answer, commands)
        refused += 1 in answer["codes"]
        if EXPORT in commands and answer["codes"][commands.index(EXPORT)] == 0:
            with h5py.File(folder / "s.h5") as file:
                frames: Any = file["entry/data/data"]
                assert frames.shape[0] == len(Session(folder / "s").frames)
        assert_nothing_is_doubled_or_torn(folder, meet)
        shutil.rmtree(folder)
    print(f"{meeting}: {OFFSETS} offsets, {refused} refused, alone {alone_s:.3f} s")
