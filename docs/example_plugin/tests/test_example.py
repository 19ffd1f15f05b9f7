"""The example's stage and camera against what every stage and camera must do."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from emmc_rig_example.camera import open_camera
from emmc_rig_example.codec import Status, decode_status, seal
from emmc_rig_example.simulator import ExampleController
from emmc_rig_example.stage import ExampleStage

from emmc_rig.bench.conformance.cameras import *  # noqa: F403
from emmc_rig.bench.conformance.stages import *  # noqa: F403
from emmc_rig.drivers.clock import SYSTEM_CLOCK
from emmc_rig.drivers.errors import CaptureError, GarbledReplyError
from emmc_rig.drivers.stage import DEFAULT_SETTINGS
from emmc_rig.simulators.clock import ManualClock

PROGRAM = """
import sys
import numpy as np
from emmc_rig.drivers.dng import encode_dng
mosaic = np.full((40, 48), 100, np.uint16)
data = encode_dng(mosaic, "bggr", 64, 4095, float(sys.argv[1]) / 1e6)
open(sys.argv[2], "wb").write(data)
"""


class ExampleRig:
    """Opens the stage over new firmware, in time that passes at once."""

    def make_stage(self, **settings):
        clock = ManualClock()
        transport = ExampleController(clock).transport()
        return ExampleStage(transport, clock, replace(DEFAULT_SETTINGS, **settings))


@pytest.fixture
def rig():
    return ExampleRig()


@pytest.fixture
def camera(tmp_path):
    program = tmp_path / "take.py"
    program.write_text(PROGRAM)
    command = f"{sys.executable} {program} {{exposure_us}} {{folder}}/frame.dng"
    return open_camera(command, SYSTEM_CLOCK, file="frame.dng", shape=[40, 48], cfa="bggr")


def test_a_reply_is_read_as_it_was_written():
    status = Status(7, True, -12, 50_000, "idle")
    assert seal("AB") == b"AB*03\n"
    assert decode_status(seal("7 ok -12 50000 idle")) == status
    for line in (b"7 ok -12 50000 idle*00\n", seal("7 ok -12 idle"), seal("7 ok 1 1 asleep")):
        with pytest.raises(GarbledReplyError):
            decode_status(line)


def test_a_frame_is_the_programs_file(camera):
    np.testing.assert_array_equal(camera.snap().mosaic, np.full((40, 48), 100))


def test_a_program_that_fails_is_one_line():
    broken = open_camera("false", SYSTEM_CLOCK, file="frame.dng", shape=[40, 48], cfa="bggr")
    with pytest.raises(CaptureError, match="took no picture"):
        broken.snap()
