"""GenTL cameras against Viky, the simulated producer that EMVA's genicam wheel brings."""

from contextlib import closing
from pathlib import Path

import pytest

pytest.importorskip("genicam", reason="harvesters and genicam are not installed")
pytest.importorskip("harvesters", reason="harvesters and genicam are not installed")

import genicam
from emmc_rig_gentl.camera import open_camera

from emmc_rig.bench.conformance.cameras import *  # noqa: F403
from emmc_rig.drivers.clock import SYSTEM_CLOCK
from emmc_rig.drivers.errors import CameraSettingError, DriverError

VIKY = Path(genicam.__file__).with_name("viky.cti")
pytestmark = pytest.mark.skipif(
    not VIKY.is_file(), reason="this genicam wheel brings no simulated producer"
)


@pytest.fixture
def camera():
    with closing(open_camera(str(VIKY), SYSTEM_CLOCK, serial="1", exposure_s=0.02)) as opened:
        yield opened


def test_a_frame_is_the_producers_picture(camera):
    frame = camera.snap()
    assert (frame.mosaic.shape, frame.cfa, frame.white_level_dn) == ((400, 400), "mono", 255)
    assert frame.mosaic.min() < frame.mosaic.max() <= 255
    assert frame.metadata["pixel_format"] == "Mono8"


def test_a_serial_number_that_is_not_there_names_those_that_are():
    with pytest.raises(DriverError, match="those there are: 0, 1, 2"):
        open_camera(str(VIKY), SYSTEM_CLOCK, serial="7")


def test_a_camera_without_a_feature_for_its_exposure_needs_it_stated():
    with (
        closing(open_camera(str(VIKY), SYSTEM_CLOCK)) as opened,
        pytest.raises(CameraSettingError, match="state exposure_s"),
    ):
        opened.snap()
