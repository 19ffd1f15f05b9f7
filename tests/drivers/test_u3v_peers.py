"""Independent peers: Aravis takes frames from our simulated camera through a real libusb, our
driver does so too, and Aravis's constants and descriptions read the same here.

They need the Debian packages gir1.2-aravis-0.8, gir1.2-umockdev-1.0, umockdev and python3-gi.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from emmc_rig.drivers.pixel_formats import FORMATS

pytestmark = pytest.mark.peers

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "tests" / "peers" / "u3v_over_libusb.py"
WRAPPER = shutil.which("umockdev-wrapper")
TIME_LIMIT_S = 60


def has_aravis():
    code = (
        "import sys; sys.path.append('/usr/lib/python3/dist-packages'); import gi; "
        "gi.require_version('Aravis', '0.8'); gi.require_version('UMockdev', '1.0')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    return done.returncode == 0


@pytest.fixture(scope="module")
def peer():
    if WRAPPER is None or not has_aravis():
        pytest.skip("needs umockdev and Aravis (Debian: see this file's head)")

    wrapper = WRAPPER

    def run(what):
        done = subprocess.run(
            [wrapper, sys.executable, str(SCRIPT), what],
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            timeout=TIME_LIMIT_S,
            check=False,
        )
        assert done.stdout, done.stderr
        return json.loads(done.stdout)

    return run


@pytest.mark.slow
def test_aravis_takes_exact_frames_from_the_simulated_camera_through_libusb(peer):
    seen = peer("aravis")
    assert seen["faults"] == []
    assert (seen["maker"], seen["model"]) == ("EMMC", "U3V simulator")
    assert seen["exposure_us"] == 5000
    assert seen["exposure_limits_us"] == [10, 10_000_000]
    assert seen["gain_db"] == pytest.approx(6)
    assert seen["gain_limits_db"] == [0, 24]
    assert seen["sensor"] == [1022, 1024]
    assert seen["payload"] == 1022 * 1024 * 12 // 8
    assert "BayerGB12Packed" in seen["formats"]
    assert [len(frames) for frames in seen["sessions"]] == [4, 4]
    for frames in seen["sessions"]:
        for frame in frames:
            assert frame["whole"]
            assert frame["equal"]
            assert frame["format"] == "BayerGB12p"
        # The second may begin with a frame of the first that was still under way.
        assert len({frame["block"] for frame in frames}) == len(frames)


@pytest.mark.slow
def test_our_driver_takes_exact_frames_through_libusb(peer):
    seen = peer("driver")
    assert seen["faults"] == []
    assert seen["listed"] == [["EMMC", "U3V simulator", "U1"]]
    assert seen["exposure_s"] == pytest.approx(0.005)
    assert seen["frames"] == [True] * 10
    assert not seen["streaming"]


@pytest.mark.slow
def test_aravis_fake_camera_reads_the_same_through_our_features(peer):
    seen = peer("fake")
    for name, ours, theirs in seen["read"] + seen["written"] + seen["limits"]:
        assert ours == pytest.approx(theirs) if not isinstance(ours, str) else ours == theirs, name
    written = {name: ours for name, ours, _ in seen["written"]}
    assert written["Width"] == 320
    assert written["PixelFormat"] == "Mono16"


@pytest.mark.slow
def test_our_pixel_format_codes_are_those_of_aravis(peer):
    theirs = {
        name.removeprefix("PIXEL_FORMAT_").replace("_", "").lower(): code
        for name, code in peer("fake")["formats"].items()
    }
    ours = {form.name.lower(): form.code for form in FORMATS}
    shared = ours.keys() & theirs.keys()
    assert len(shared) >= 35
    assert {name: ours[name] for name in shared} == {name: theirs[name] for name in shared}
