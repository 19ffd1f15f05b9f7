"""The original Grbl 1.1h, compiled for this computer, from the folder in EMMC_PEER_FILES."""

import shutil
import subprocess
import time
from contextlib import closing

import pytest

from emmc_rig.drivers.clock import SYSTEM_CLOCK
from emmc_rig.drivers.errors import LimitExceededError, NotHomedError
from emmc_rig.drivers.grbl import GrblStage, identify
from emmc_rig.drivers.stage import StageSettings
from emmc_rig.drivers.transport import SerialTransport

pytestmark = [pytest.mark.peers, pytest.mark.slow]

AXES = {"x": "X", "y": "Y"}
SETTINGS = {22: 1, 20: 1, 21: 1, 23: 0, 24: 300, 25: 1200, 27: 1, 10: 1, 13: 0}
OF_AXES = {100: 200, 110: 1500, 120: 200, 130: 50}
"""200 steps/mm and 50 mm of travel."""
CARE = StageSettings(tolerance_um=5.0)
SPEED = "3"
"""Times real time."""


@pytest.fixture
def firmware(peer_files, tmp_path):
    """The port of a controller that runs, and a function for its true position in mm."""
    build = peer_files / "firmware/grbl/build.sh"
    if not (build.is_file() and shutil.which("gcc")):
        pytest.skip("needs gcc, and firmware/grbl in the folder that EMMC_PEER_FILES names")
    program, link, steps = tmp_path / "grbl", tmp_path / "port", tmp_path / "steps"
    subprocess.run(["bash", build, program], check=True, capture_output=True)
    settings = {"LINK": str(link), "STEPLOG": str(steps), "SPEED": SPEED}

    def true_mm():
        time.sleep(0.3)
        return [float(number) for number in steps.read_text().splitlines()[-1].split()[1:4]]

    with subprocess.Popen(
        [program], env=settings, cwd=tmp_path, stdout=subprocess.DEVNULL
    ) as process:
        try:
            while not link.exists():
                time.sleep(0.05)
            with closing(opened(link)) as port:
                time.sleep(1)
                axes = {first + n: of for first, of in OF_AXES.items() for n in range(3)}
                for number, value in (axes | SETTINGS).items():
                    port.write(f"${number}={value}\n".encode())
                    while b"ok" not in port.read_until(b"\n"):
                        pass
            yield link, true_mm
        finally:
            process.kill()


def opened(link):
    return SerialTransport(str(link), timeout_s=0.5, flow_control=False)


def test_the_firmware_as_it_is_shipped_homes_moves_and_is_homed_anew_by_each_connection(
    firmware, caplog
):
    link, true_mm = firmware
    with closing(opened(link)) as port:
        assert identify(port) == "version 1.1h.20190830:, options V,15,128"
        stage = GrblStage(port, AXES, SYSTEM_CLOCK, CARE)
        with pytest.raises(NotHomedError):
            stage.move_to_um({"x": -5000.0})
        stage.home(["x"])
        assert "homes all axes together: x, y" in caplog.text
        assert stage.position_um("y") == pytest.approx(-1000.0, abs=5)
        begun_mm = true_mm()
        assert stage.move_to_um({"x": -5000.0, "y": -3000.0}) == pytest.approx(
            {"x": -5000.0, "y": -3000.0}, abs=5
        )
        moved_mm = [after - before for before, after in zip(begun_mm, true_mm(), strict=True)]
        assert moved_mm == pytest.approx([-4.0, -2.0, 0.0], abs=0.01)
        with pytest.raises(LimitExceededError):
            stage.move_to_um({"x": 0.0})
    with closing(opened(link)) as port:
        # Idle also follows `$X`, so this state is no proof of homing.
        assert not GrblStage(port, AXES, SYSTEM_CLOCK, CARE).is_homed("x")
