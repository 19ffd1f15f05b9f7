"""Conformance suite of cameras, simulated or real.

A test module that imports all of this defines the fixture `camera`: opened, and closed after the
test.
"""

import hashlib
import itertools

import numpy as np
import pytest

from emmc_rig.drivers.errors import CameraSettingError, DriverError
from emmc_rig.session.frame_file import NO_FIGURES, decode_frame, frame_entry, frame_file
from emmc_rig.session.planned import Bench, PlannedFrame
from emmc_rig.session.session import Frozen, Session


def choose(limits, most=0.2):
    """A value well inside the limits, not longer than `most` where that is inside too."""
    low, high = limits
    return float(min(np.sqrt(low * high), max(low, most)))


def test_a_frame_has_the_size_and_colours_that_the_camera_states(camera):
    frame = camera.snap()
    assert frame.mosaic.shape == camera.shape
    assert frame.cfa == camera.cfa
    assert frame.mosaic.dtype == np.uint16
    assert not frame.mosaic.flags.writeable


def test_the_levels_of_a_frame_are_in_order(camera):
    frame = camera.snap()
    assert frame.black_level_dn.shape == (2, 2)
    assert (frame.black_level_dn >= 0).all()
    assert (frame.black_level_dn < frame.white_level_dn).all()


def test_a_frame_keeps_the_cameras_bytes_and_their_digest(camera):
    frame = camera.snap()
    assert hashlib.sha256(frame.original).hexdigest() == frame.sha256


def test_a_frame_that_a_session_stored_is_read_back_without_the_camera(camera, tmp_path):
    frame = camera.snap()
    planned = PlannedFrame("shot-0", "shot", Bench("scene", "white", 0, 0, True), None)
    about = {"title": "conformance", "created": "", "command": "", "versions": {}}
    session = Session.create(tmp_path / "session", Frozen("", {}, {}, (planned,)), about)
    file = frame_file(frame)
    exposure_s = camera.exposure_s if frame.exposure_s is None else frame.exposure_s
    gain = camera.gain if frame.gain is None else frame.gain
    entry = frame_entry(frame, exposure_s, gain, figures=NO_FIGURES)
    session.store(planned, file, lambda: entry)
    again = Session(session.folder)
    back = decode_frame(again.read(planned.id), again.stored[planned.id])
    np.testing.assert_array_equal(back.mosaic, frame.mosaic)
    np.testing.assert_array_equal(back.black_level_dn, frame.black_level_dn)
    assert (back.white_level_dn, back.cfa) == (frame.white_level_dn, frame.cfa)
    assert back.original == frame.original
    assert frame.exposure_s in (None, back.exposure_s)
    assert frame.gain in (None, back.gain)


def test_frames_are_stamped_in_their_order(camera):
    first, second = camera.snap(), camera.snap()
    assert first.host_time_s is not None
    assert second.host_time_s >= first.host_time_s


def test_the_exposure_that_was_taken_is_reported(camera):
    low, high = camera.exposure_limits_s
    asked_s = choose((low, high))
    camera.set_exposure_s(asked_s)
    taken_s = camera.exposure_s
    assert low <= taken_s <= high
    assert camera.snap().exposure_s == pytest.approx(taken_s, rel=0.1, abs=1e-4)
    camera.set_exposure_s(taken_s)
    assert camera.exposure_s == pytest.approx(taken_s)


def test_the_gain_that_was_taken_is_reported(camera):
    low, high = camera.gain_limits
    camera.set_gain(choose((low, high), most=high))
    assert low <= camera.gain <= high
    assert camera.snap().gain in (None, pytest.approx(camera.gain))
    camera.set_gain(camera.gain)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_what_is_out_of_reach_is_refused_and_changes_nothing(camera, factor):
    for limits, ask, read in (
        (camera.exposure_limits_s, camera.set_exposure_s, lambda: camera.exposure_s),
        (camera.gain_limits, camera.set_gain, lambda: camera.gain),
    ):
        before = read()
        with pytest.raises(CameraSettingError):
            ask(limits[0] * factor if factor < 1 else limits[1] * factor)
        assert read() == before


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan")])
def test_what_is_not_positive_is_refused(camera, value):
    with pytest.raises(ValueError, match="not positive"):
        camera.set_exposure_s(value)
    with pytest.raises(ValueError, match="not positive"):
        camera.set_gain(value)


def test_a_camera_says_who_made_it(camera):
    identity = camera.identity
    for text in (identity.maker, identity.model, identity.serial, identity.firmware):
        assert isinstance(text, str)


def test_a_closed_camera_gives_no_frame_and_may_be_closed_again(camera):
    camera.snap()
    camera.close()
    camera.close()
    with pytest.raises(DriverError):
        camera.snap()


def test_a_stream_gives_frames_and_stops_when_it_is_closed(camera):
    if not hasattr(camera, "stream"):
        pytest.skip("this camera takes one frame at a time")
    stream = camera.stream()
    for frame in itertools.islice(stream, 3):
        assert frame.mosaic.shape == camera.shape
    stream.close()
    assert camera.snap().mosaic.shape == camera.shape
