"""libgphoto2 as our camera, against our own simulated camera over PTP/IP (extra `gphoto2`).

The simulated cameras run in a process of their own: libgphoto2 holds Python's lock while it waits.
"""

import json
import os
import subprocess
import sys
from contextlib import closing

import numpy as np
import pytest

pytest.importorskip("gphoto2", reason="the extra `gphoto2` is not installed")

from emmc_rig.bench.conformance.cameras import *  # noqa: F403
from emmc_rig.bench.hardware import open_camera
from emmc_rig.drivers.errors import (
    CameraClosedError,
    CameraSettingError,
    CaptureError,
    GphotoError,
    RawFrameError,
)
from emmc_rig.drivers.gphoto import GphotoCamera, seconds_of
from emmc_rig.drivers.ptp_codec import Property
from emmc_rig.errors import AppError

SERVER = """
import json, sys
from contextlib import ExitStack
import numpy as np
from emmc_rig.drivers.clock import SystemClock
from emmc_rig.simulators.ptp import PtpCameraSimulator
from simulated_eos import EosCameraSimulator
from ptpip_server import PtpIpServer

mosaic = np.random.default_rng(0).integers(0, 4095, (40, 48), dtype=np.uint16)
cameras, ports = {}, {}
with ExitStack() as servers:
    for name, given in json.loads(sys.argv[1]).items():
        make = EosCameraSimulator if name.startswith("eos") else PtpCameraSimulator
        quality = given.get("quality", "raw")
        camera = make(lambda exposure_s: mosaic, SystemClock(), "grbg", quality=quality)
        if "hidden" in given:
            camera.hidden = tuple(given["hidden"])
        for fault in given.get("faults", ()):
            camera.faults.inject(fault)
        cameras[name] = camera
        ports[name] = servers.enter_context(PtpIpServer(camera)).port
    print(json.dumps(ports), flush=True)
    for name in sys.stdin:
        print(sum(bool(data) for _, data in cameras[name.strip()].objects.values()), flush=True)
"""
CAMERAS = {
    "plain": {},
    "eos": {},
    "eos that shows every property": {"hidden": []},
    "without settings": {"hidden": [int(item) for item in Property]},
    "jpeg": {"quality": "jpeg"},
    "torn": {"quality": "raw+jpeg", "faults": ["torn_raw"]},
}
"""hidden: the properties that a camera hides; each class hides some unless this list is given."""
MOSAIC = np.random.default_rng(0).integers(0, 4095, (40, 48), dtype=np.uint16)


class Served:
    """CAMERAS in a process: libgphoto2's name of each, and how many files are on its card."""

    def __init__(self, process):
        self._process = process
        ports = json.loads(process.stdout.readline())
        self.names = {name: f"ptpip:127.0.0.1:{port}:{port}" for name, port in ports.items()}

    def files_on_card(self, name):
        self._process.stdin.write(f"{name}\n")
        self._process.stdin.flush()
        return int(self._process.stdout.readline())


@pytest.fixture(scope="module")
def served():
    with subprocess.Popen(
        [sys.executable, "-c", SERVER, json.dumps(CAMERAS)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        yield Served(process)


@pytest.fixture(scope="module")
def address(served):
    return served.names["plain"]


@pytest.fixture
def camera(address):
    with closing(GphotoCamera(address)) as opened:
        opened.set_gain(1.0)
        yield opened


def test_a_frame_is_what_the_sensor_reads(camera):
    camera.set_exposure_s(0.008)
    frame = camera.snap()
    np.testing.assert_array_equal(frame.mosaic, MOSAIC)
    assert (frame.cfa, frame.exposure_s, frame.gain) == ("grbg", 0.008, 1.0)
    assert frame.metadata["name"].endswith(".DNG")
    assert camera.identity.model == "EMMC simulated camera"


@pytest.mark.slow
def test_a_second_session_exposes_as_the_first_did(address):
    for exposure_s in (0.004, 0.0166):
        with closing(GphotoCamera(address)) as camera:
            camera.set_exposure_s(exposure_s)
            assert camera.snap().exposure_s == pytest.approx(exposure_s, rel=0.02)


@pytest.mark.slow
def test_the_gain_is_the_iso_over_the_lowest(camera):
    camera.set_gain(4.0)
    frame = camera.snap()
    assert (camera.gain, frame.gain) == (4.0, 4.0)
    black = 64.0
    expected = np.clip(np.rint(black + 4 * (MOSAIC.astype(float) - black)), 0, 4095)
    np.testing.assert_array_equal(frame.mosaic, expected)
    camera.set_gain(1.0)


def test_settings_are_set_by_libgphoto2s_names_and_all_are_listed(address):
    with closing(GphotoCamera(address, settings={"iso": 200})) as camera:
        assert camera.gain == 2.0
        assert camera.details()["shutterspeed"].endswith("s")
        camera.set_gain(1.0)
    with pytest.raises(CameraSettingError, match="no_such cannot become 1"):
        GphotoCamera(address, settings={"no_such": 1})


@pytest.mark.slow
def test_a_setting_without_a_value_is_left_out_and_does_not_end_the_process(served):
    with closing(GphotoCamera(served.names["eos that shows every property"])) as camera:
        # It lists the shutter twice, first by the standard's property, whose value is no choice.
        assert camera.details()["shutterspeed"] == "1/60"
        with pytest.raises(CameraSettingError, match="is not known"):
            camera.snap()
        camera.set_exposure_s(0.008)
        assert camera.snap().exposure_s == pytest.approx(0.008)


def test_a_camera_without_any_settings_is_refused_in_one_line(served):
    name = served.names["without settings"]
    with closing(GphotoCamera(name)) as camera:
        assert camera.gain_limits == (1.0, 1.0)
        with pytest.raises(CameraSettingError, match="mode dial"):
            camera.set_exposure_s(0.01)
    with pytest.raises(CameraSettingError, match="iso cannot become 100"):
        GphotoCamera(name, settings={"iso": 100})


@pytest.mark.slow
def test_a_torn_file_is_no_frame_and_of_raw_with_jpeg_the_raw_file_is_taken_and_deleted(served):
    with closing(GphotoCamera(served.names["torn"], delete=True)) as camera:
        with pytest.raises(RawFrameError, match="torn"):
            camera.snap()
        for _ in range(2):
            np.testing.assert_array_equal(camera.snap().mosaic, MOSAIC)
    assert served.files_on_card("torn") == 3


@pytest.mark.slow
def test_an_eos_exposes_for_a_user_who_never_ran_libgphoto2(served, tmp_path):
    program = (
        "import sys; from emmc_rig.drivers.gphoto import GphotoCamera;"
        "camera = GphotoCamera(sys.argv[1]);"
        "camera.set_exposure_s(0.5); print(camera.snap().mosaic.shape); camera.close()"
    )
    home = {**os.environ, "HOME": str(tmp_path), "XDG_CONFIG_HOME": str(tmp_path / "config")}
    ran = subprocess.run(
        [sys.executable, "-c", program, served.names["eos"]],
        env=home,
        capture_output=True,
        text=True,
    )
    assert ran.stdout.strip() == "(40, 48)", ran.stderr


@pytest.mark.slow
def test_a_camera_set_to_jpeg_is_refused(served, monkeypatch):
    monkeypatch.setattr("emmc_rig.drivers.gphoto.PAIR_LIMIT_S", 0.2)
    with (
        closing(GphotoCamera(served.names["jpeg"])) as camera,
        pytest.raises(CaptureError, match=r"gave EMMC0001.JPG: set its image quality to RAW"),
    ):
        camera.snap()


def test_no_camera_is_one_line_with_a_remedy():
    with pytest.raises(GphotoError, match="plug it in") as caught:
        GphotoCamera("", model="")
    assert "\n" not in str(caught.value)
    with pytest.raises(GphotoError, match="list-cameras"):
        GphotoCamera("usb:", model="No Such Camera")


def test_a_closed_camera_takes_no_setting(address):
    camera = GphotoCamera(address)
    camera.close()
    with pytest.raises(CameraClosedError):
        camera.set_exposure_s(0.008)


@pytest.mark.slow
def test_a_short_name_and_a_file_open_it(address, tmp_path):
    with closing(open_camera(f"gphoto2:{address}")) as camera:
        assert camera.shape == (40, 48)
    file = tmp_path / "camera.yaml"
    file.write_text(f"{{driver: gphoto2, address: '{address}', settings: {{iso: 100}}}}")
    with closing(open_camera(str(file))) as camera:
        assert camera.gain == 1.0
    file.write_text("{kind: gphoto2, setings: {iso: 100}}")
    with pytest.raises(AppError, match="did you mean 'settings'"):
        open_camera(str(file))


@pytest.mark.parametrize(
    ("words", "seconds"),
    [
        ("1/125", 1 / 125),
        ("0.0080s", 0.008),
        ("30", 30.0),
        ('1.3"', 1.3),
        ("10/13", 10 / 13),
        ("bulb", None),
        ("auto", None),
        ("1/0", None),
        ("0.0000s", None),
    ],
)
def test_a_choice_of_any_maker_means_its_exposure(words, seconds):
    assert seconds_of(words) == (seconds if seconds is None else pytest.approx(seconds))
