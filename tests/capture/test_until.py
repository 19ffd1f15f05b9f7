"""`emmc-rig capture --until`: shots taken one by one; a session ends when it has enough."""

import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
import yaml
from capture_rigs import begun, frame_in, frames_in, still_rig
from programs import done, program
from simulated_disk import SimulatedDisk

from emmc_rig.captures.until import Until, stated_psnr_db
from emmc_rig.errors import AppError
from emmc_rig.model.sensing import Psi
from emmc_rig.reconstruction.result import Reconstruction, Status
from emmc_rig.report.session_sheet import events, sheet
from emmc_rig.session.journal import DecidedEntry, UntilEntry, of_kind
from emmc_rig.session.session import JOURNAL, Session
from emmc_rig.session.verify import summary, verify

pytestmark = pytest.mark.slow

RIG = ("--rig", "simulated", "--scene", "deep-occlusions", "--size", "32x40", "--rays", "64")
CAMERA = {
    "title": "nine views",
    "views": [3, 3],
    "sensor": {"cfa": "rggb"},
    "masks": {
        "mask": {"distance_mm": 0.24, "cell_um": 36, "pattern": {"kind": "random_rgbw", "seed": 1}}
    },
    "more_shots_step_um": {"mask": [270, 162]},
}
PLAN = {
    "camera": "camera.yaml",
    "shots": [{"exposure_s": 0.05}] * 3,
    "whiteboards": {
        "views": [[1, 1]],
        "shots": [0],
        "open": [{"repeats": 2}, {"validation": True}],
    },
    "darks": {"repeats": 2},
}


def plan_file(folder, **changes):
    path = folder / "plan.yaml"
    (folder / "camera.yaml").write_text(yaml.safe_dump(CAMERA))
    path.write_text(yaml.safe_dump({**PLAN, **changes}))
    return path


def decided(session):
    """What was decided, without when."""
    when = {"spans_s": {}, "wall": "", "run": 0}
    decisions = of_kind(session.journal.entries, DecidedEntry)
    return [entry.model_copy(update=when) for entry in decisions]


@pytest.fixture(scope="module", autouse=True)
def _judged_once():
    """The rig's frames are the same each time, so that the same shots are judged but once."""
    judge, known = Until._stated, {}

    def remembered(self, shots):
        if shots not in known:
            known[shots] = judge(self, shots)
        return known[shots]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Until, "_stated", remembered)
        yield


def session_until(folder, target, reason):
    plan_file(folder)
    out = done(
        program("capture", folder / "plan.yaml", *RIG, "--until", target, "--out", folder / "s")
    )
    assert reason in out
    return folder / "s"


@pytest.fixture(scope="module")
def enough(tmp_path_factory):
    """A session that needed one shot of three."""
    folder = tmp_path_factory.mktemp("enough")
    return session_until(folder, "12dB", "the target is reached, shots not needed: 2")


@pytest.fixture(scope="module")
def every(tmp_path_factory):
    """A session whose target lies beyond its three shots."""
    return session_until(tmp_path_factory.mktemp("every"), "70", "every planned shot is taken")


def test_a_session_ends_when_the_scene_needs_no_more_shots(enough):
    session = Session(enough)
    (only,) = of_kind(session.journal.entries, DecidedEntry)
    assert only.stated_db >= only.target_db == 12
    assert (only.shots, only.next, only.spared) == ([0], None, [1, 2])
    assert session.is_complete
    assert not session.missing()
    assert {f.bench.shot for f in session.needed if f.kind == "shot"} == {0}
    assert not any(name.startswith(("shot-1", "shot-2")) for name in session.stored)
    # Whiteboards and darks come first: Psi of every shot must be known to judge by it.
    assert session.journal.entries[-2] == only
    kinds = {frame.id: frame.kind for frame in session.frames}
    assert [kinds[name] for name in session.stored].index("shot") == len(session.stored) - 1


def test_show_verify_and_list_take_a_session_that_ended_early_as_complete(enough):
    out = done(program("session", "verify", enough))
    assert "not needed: 2 more of the planned frames" in out
    _, out, _ = program("session", "show", enough)
    assert "shot         1 of 1" in out
    assert "target 12 dB; done, the target is reached" in out
    reported = summary(Session(enough))
    assert (reported.state, reported.stored) == ("complete", reported.planned)
    verdict = verify(Session(enough))
    assert (verdict.is_complete, verdict.missing, verdict.spared) == (True, (), 2)


def test_its_page_shows_what_was_decided_and_when(every):
    page = sheet(Session(every))
    assert "Choice of shots" in page
    assert "estimated accuracy " in page
    metrics = json.loads((every / "metrics.json").read_text())
    assert metrics["decided"][0]["shots"] == [0]
    assert metrics["spared"] == 0


def test_it_is_calibrated_reconstructed_and_exported_with_the_shots_it_has(enough, tmp_path):
    done(program("calibrate", enough, "--out", tmp_path / "c"))
    psi = Psi.load(tmp_path / "c" / "psi.h5")
    assert psi.shots == 1
    settings = tmp_path / "s.yaml"
    settings.write_text("tv: {max_steps: 3}")
    for out, more in (("a", ()), ("b", ("--psi", tmp_path / "c" / "psi.h5"))):
        done(program("reconstruct", enough, "--settings", settings, *more, "--out", tmp_path / out))
        assert json.loads((tmp_path / out / "metrics.json").read_text())["shots"] == 1
    done(program("session", "export", enough, "--out", tmp_path / "x.h5"))
    with h5py.File(tmp_path / "x.h5") as file:
        ids = file["entry/data/frame_id"].asstr()[:].tolist()  # type: ignore[union-attr]
    assert "shot-0-e0-r0" in ids
    assert "shot-1-e0-r0" not in ids


def test_shots_follow_in_the_order_of_the_plan_while_the_target_is_not_stated(every):
    taken = decided(Session(every))
    assert [entry.shots for entry in taken] == [[0], [0, 1], [0, 1, 2]]
    assert [entry.next for entry in taken] == [1, 2, None]
    assert all(entry.stated_db < entry.target_db for entry in taken)


def test_a_higher_target_goes_on_with_a_session_that_had_enough(enough, every, tmp_path):
    copy = shutil.copytree(enough, tmp_path / "copy")
    out = done(program("capture", copy))
    assert "0 taken" in out
    _, _, err = program("capture", copy, "--until", "70", "--dry-run")
    assert "at most 2 frames to take" in err
    out = done(program("capture", copy, "--until", "70"))
    assert "2 taken" in out
    again = Session(copy)
    assert frames_in(again) == frames_in(Session(every))
    assert decided(again)[-1] == decided(Session(every))[-1]
    assert any(kind == "until" and "70 dB" in line for kind, line in events(again))


def test_a_session_cut_off_at_any_line_of_its_journal_goes_on_to_the_same_end(every, tmp_path):
    """What a kill leaves: a journal up to a line, and perhaps a file that no line tells of."""
    whole = (every / JOURNAL).read_bytes().splitlines(keepends=True)
    first = next(n for n, line in enumerate(whole) if b'"shot-0-e0-r0"' in line)
    expected, frames = decided(Session(every)), frames_in(Session(every))
    for count in range(first, len(whole)):
        copy = tmp_path / str(count)
        shutil.copytree(every, copy)
        (copy / JOURNAL).write_bytes(b"".join(whole[:count]))
        done(program("capture", copy))
        session = Session(copy)
        assert decided(session) == expected
        assert frames_in(session) == frames
        assert verify(session).is_complete
        shutil.rmtree(copy)


def test_a_damaged_shot_of_a_session_that_had_enough_is_taken_again(enough, tmp_path):
    copy = shutil.copytree(enough, tmp_path / "copy")
    session = Session(copy)
    path = session.path_of(session.stored["shot-0-e0-r0"])
    good = path.read_bytes()
    path.write_bytes(good[:-10])
    out = done(program("capture", copy))
    assert "1 taken" in out
    assert frame_in(path.read_bytes()) == frame_in(good)
    assert len(of_kind(Session(copy).journal.entries, DecidedEntry)) == 1


def test_what_a_session_needs_follows_from_the_last_instruction(tmp_path: Path):
    session, _ = begun(tmp_path, SimulatedDisk(), still_rig())
    shots = {f.bench.shot for f in session.frames if f.kind == "shot"}
    assert shots == {0, 1}
    assert session.target_db is None
    reported = {"shots": [0], "stated_db": 31.0, "target_db": 30.0, "why": "", "spared_frames": 1}
    session.note(UntilEntry(target_db=30.0))
    session.note(DecidedEntry(next=1, spared=[], **reported))
    assert session.needed == session.frames
    session.note(DecidedEntry(next=None, spared=[1], **reported))
    assert {f.bench.shot for f in session.needed if f.kind == "shot"} == {0}
    session.note(UntilEntry(target_db=33.0))
    assert session.needed == session.frames
    assert session.target_db == 33.0


def test_the_stated_psnr_is_that_of_the_deviation_less_what_few_large_errors_cost():
    def result_with(parameters=None, **maps):
        light_field = np.full((3, 3, 8, 8, 3), 0.5, np.float32)
        return Reconstruction(
            "tv", light_field, Status.CONVERGED, "", 1, (), 1.0, parameters or {}, maps
        )

    even = np.full((3, 3, 8, 8), 0.1)
    assert stated_psnr_db(result_with(sigma=even)) == pytest.approx(20)
    few = result_with({"stated_tails_db": 1.5, "stated_within_db": 2.0}, sigma=even)
    assert stated_psnr_db(few) == pytest.approx(18.5)
    assert few.stated["stated_interval_db"] == pytest.approx([16.5, 20.5])
    assert few.stated["stated_worst_db"] == pytest.approx(18.5)
    assert result_with().stated == {"stated_db": None, "stated_interval_db": None}
    with pytest.raises(AppError, match="estimates no accuracy"):
        stated_psnr_db(result_with())
