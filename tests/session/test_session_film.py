"""A session's film read back: readings at their times, and films that cannot be used."""

import hashlib
import struct
from pathlib import Path

import numpy as np
import pytest
import yaml
from capture_rigs import begun
from simulated_disk import SimulatedDisk

from emmc_rig.bench.hardware import Fitted, simulated_rig
from emmc_rig.captures.plan import Plan, planned_camera
from emmc_rig.captures.sequencer import Sequencer
from emmc_rig.errors import AppError
from emmc_rig.formats.scenes import fine_scene
from emmc_rig.model.frames import Exposure
from emmc_rig.session.board_sets import decoded, taken_shots
from emmc_rig.session.frame_file import FrameFile
from emmc_rig.session.journal import FilmEntry
from emmc_rig.session.measured_psi import session_scale
from emmc_rig.session.readings import film_frames, film_places, session_frames
from emmc_rig.session.session import Session

SIZE = (24, 32)
STILL = """
camera: rgbw-bayer-1shot
shots:
  - {exposure_s: 0.05, mask_cells: [0, 0]}
  - {exposure_s: 0.05, mask_cells: [3, 1]}
whiteboards: null
darks: {repeats: 8}
"""
STEPPED = f"{STILL}film: {{frames: 6, rate: 2}}\n"
STREAMED = STEPPED.replace("  - {exposure_s: 0.05, mask_cells: [3, 1]}\n", "")


def captured(text, camera="u3v"):
    """Run a plan before a scene that stands still; return its session."""
    planned = planned_camera(Plan.model_validate(yaml.safe_load(text)))
    samples = fine_scene("near-planar", 1, 1, size=SIZE).samples
    rig, _ = simulated_rig(planned, samples, SIZE, 0, fitted=Fitted(camera=camera))
    session, plan = begun(Path("/disk"), SimulatedDisk(), rig, text)
    assert Sequencer(session, plan, rig).run().complete
    return Session(session.folder, session.disk)


def test_a_films_frames_read_what_shots_of_their_exposure_do_to_their_deviation():
    film = captured(STEPPED, "ptp")
    assert taken_shots(film) == (0, 1)
    _, shots = session_frames(captured(STILL, "ptp"))
    frames = list(film_frames(film, session_scale(film)))
    assert [(at.place, at.shot, at.segment) for at, _ in frames] == [
        (place, place % 2, 0) for place in range(6)
    ]
    np.testing.assert_allclose([at.time_s for at, _ in frames], np.arange(6) / 2, atol=0.25)
    for at, taken in frames:
        assert taken.shape == (1, *SIZE)
        both = taken.usable[0] & shots.usable[at.shot]
        assert both.mean() > 0.9
        spread = np.hypot(taken.deviation[0], shots.deviation[at.shot])[both]
        off = (taken.readings[0] - shots.readings[at.shot])[both] / spread
        assert 0.8 < np.sqrt(np.mean(off**2)) < 1.25
        assert np.isinf(taken.deviation[~taken.usable]).all()
        assert taken.exposures == (Exposure(at.shot, (at.entry.exposure_s,), 1.0, at.time_s),)


def test_the_time_of_a_streamed_frame_is_that_of_the_cameras_stamps():
    session = captured(STREAMED)
    frames = film_places(session)
    stamps = np.array([frame.entry.camera_time_s for frame in frames])
    np.testing.assert_allclose([frame.time_s for frame in frames], stamps - stamps[0], atol=1e-9)


def test_a_second_segment_goes_on_in_time_at_its_place():
    session = captured(STREAMED)
    session.note(FilmEntry(segment=1, id="film-000004", rate_hz=2.0))
    for place in (4, 5):
        entry = session.stored[f"film-00000{place}"]
        session.note(entry.model_copy(update={"segment": 1, "film_s": (place - 4) / 2 + 0.0}))
    frames = film_places(session)
    np.testing.assert_allclose([frame.time_s for frame in frames], np.arange(6) / 2, atol=1e-6)
    assert [frame.segment for frame in frames] == [0, 0, 0, 0, 1, 1]


def altered(place, **changes):
    def alter(session):
        entry = session.stored[f"film-00000{place}"]
        session.note(entry.model_copy(update=changes))

    return alter


def stored_again(session):
    """Store a frame's pixels again as the next one, with another number and time stamp."""
    data = bytearray(session.read("film-000002"))
    struct.pack_into("<Q", data, 20, 77)
    file = FrameFile(".bin", bytes(data), hashlib.sha256(data).hexdigest())
    planned = next(frame for frame in session.frames if frame.id == "film-000003")
    entry = session.stored["film-000003"]
    session.store(planned, file, lambda: entry)


@pytest.mark.parametrize(
    ("alter", "what"),
    [
        (altered(3, film_s=0.4), "film-000003 was not exposed after film-000002: out of order"),
        (altered(3, metadata={"block_id": "2"}), "film-000003 is film-000002 again: doubled"),
        (altered(4, exposure_s=0.06), "film-000004 was exposed for 0.06 s, not 0.05 s"),
        (altered(4, gain=2.0), "film-000004 was exposed for"),
        (altered(2, film_s=None), "film-000002: its line in the journal does not say when"),
        (stored_again, "film-000003 shows the same as the frame before it"),
    ],
)
def test_a_film_that_cannot_be_trusted_is_refused_naming_the_frame(alter, what):
    session = captured(STREAMED)
    alter(session)
    with pytest.raises(AppError, match=what):
        list(film_frames(session, session_scale(session)))


def test_a_mask_that_did_not_step_is_named_with_the_axis():
    session = captured(STEPPED, "ptp")
    before = session.stored["film-000002"].read_um
    altered(3, read_um=before)(session)
    with pytest.raises(AppError, match="film-000003: mask_x did not step"):
        list(film_frames(session, session_scale(session)))


def test_a_film_is_not_taken_for_shots_of_one_light_field():
    with pytest.raises(AppError, match="holds a film"):
        session_frames(captured(STREAMED))


def test_a_session_without_a_film_says_what_its_plan_needs():
    with pytest.raises(AppError, match="holds no film"):
        film_places(captured(STILL, "ptp"))


def test_a_frame_of_a_film_reads_what_it_reads_alone():
    session = captured(STREAMED)
    scale = session_scale(session)
    (first, *_) = film_places(session)
    _, frames = session_frames(session, scale, 0)
    alone = scale.of_shots([first.shot]).frames(
        lambda shot: list(decoded(session, [first.planned]))
    )
    assert frames.readings.tobytes() == alone.readings.tobytes()
    assert frames.deviation.tobytes() == alone.deviation.tobytes()
