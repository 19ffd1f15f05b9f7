"""Which file of a recording is which planned frame: by name, time and exposure, never a guess."""

from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from capture_rigs import begun, still_rig
from simulated_disk import SimulatedDisk

from emmc_rig.captures.replay import matched, missing_words, there
from emmc_rig.drivers.dng import encode_dng
from emmc_rig.drivers.folder import FolderCamera, Recorded
from emmc_rig.session.planned import Bench, PlannedFrame


def frames(**exposures_s):
    bench = Bench("scene", "white", 0, 0, True)
    return [PlannedFrame(name, "shot", bench, seconds) for name, seconds in exposures_s.items()]


def files(**exposures_s):
    return [Recorded(f"{name}.dng", seconds, None) for name, seconds in exposures_s.items()]


def names(planned, there):
    return {frame_id: file.name for frame_id, file in matched(planned, there).items()}


MOSAIC = np.full((24, 24), 9, np.uint16)
PLAN = frames(dark=0.01, short=0.01, long=0.04)


@pytest.mark.parametrize(
    ("there", "wanted"),
    [
        (files(a=0.0101, b=None, c=0.04), {"dark": "a", "short": "b", "long": "c"}),
        (files(a=0.04, b=0.01, c=0.01), {}),
        (files(a=0.01, b=0.01), {}),
        (files(a=0.01, long=0.04), {"long": "long"}),
        (files(a=0.01, short=0.01, c=0.04), {"dark": "a", "short": "short", "long": "c"}),
        (files(long=0.04, short=0.01), {"short": "short", "long": "long"}),
        (files(a=0.5, b=0.6, c=0.7), {}),
    ],
)
def test_files_are_matched_as_far_as_what_they_state_leaves_no_choice(there, wanted):
    assert names(PLAN, there) == {frame: f"{name}.dng" for frame, name in wanted.items()}


def test_metered_frames_are_matched_in_order_or_by_name_only():
    planned = frames(meter=None, shot=None)
    assert names(planned, files(a=0.3, b=0.1)) == {"meter": "a.dng", "shot": "b.dng"}
    assert names(planned, files(a=0.3)) == {}
    assert names(planned, [Recorded("00007-shot.dng", 0.1, None)]) == {"shot": "00007-shot.dng"}


def test_a_frame_is_taken_once_it_and_what_meters_it_have_files():
    session, _ = begun(Path("/disk"), SimulatedDisk(), still_rig())
    plain, metered, meter = "dark-0-r0", "shot-1-e0-r0", "meter-shot-1"

    def chosen(*names):
        found = dict.fromkeys(names, Recorded("x.dng", None, None))
        return [frame.id for frame in there(session, found)(lambda: 0.0)]

    assert chosen(plain, metered) == [plain]
    assert chosen(metered, meter) == [meter, metered]


def test_what_is_missing_is_named_with_its_exposure(tmp_path):
    found = matched(PLAN, files(dark=0.01, short=0.01))
    assert missing_words(tmp_path, PLAN, found) == (
        f"{tmp_path}: no file is known to be long (0.04 s); the others are taken. Add it as "
        "long.dng and run the same command"
    )
    assert missing_words(tmp_path, PLAN[:2], found) == ""


def test_files_are_in_the_order_of_their_times_where_all_state_one(tmp_path, monkeypatch):
    times = {"1.dng": "2026:11:24 10:00:02", "2.dng": "2026:11:24 10:00:01", "10.dng": ""}
    for name in times:
        (tmp_path / name).write_bytes(encode_dng(MOSAIC, "rggb", 0, 255, 0.01) + name.encode())
    camera = FolderCamera(tmp_path)
    assert [file.name for file in camera.files()] == ["1.dng", "2.dng", "10.dng"]
    (tmp_path / "10.dng").unlink()

    def stated(file):
        return 0.01, datetime.strptime(times[file.read()[-5:].decode()], "%Y:%m:%d %H:%M:%S")

    monkeypatch.setattr("emmc_rig.drivers.folder.exposure_and_time", stated)
    assert [file.name for file in FolderCamera(tmp_path).files()] == ["2.dng", "1.dng"]
