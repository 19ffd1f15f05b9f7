"""A camera that is a program: it exposes, writes a RAW file and ends, such as `rpicam-still --raw`.

driver: command
address: "rpicam-still --raw --immediate --shutter {exposure_us} --output {folder}/frame.jpg"
file: frame.dng
shape: [3040, 4056]
cfa: bggr

Sessions store the RAW file as it is, for LibRaw decodes it. A camera whose bytes no other program
decodes returns a `drivers.raw.RawFrame` with the mosaic and with its own bytes in `original`:
sessions then store a DNG of the mosaic with these bytes in it.
"""

import shlex
import subprocess
import tempfile
from pathlib import Path

from emmc_rig.drivers.camera import CameraIdentity, RawFileCamera
from emmc_rig.drivers.clock import Clock
from emmc_rig.drivers.errors import CaptureError

GRACE_S = 30.0


def open_camera(
    address: str, clock: Clock, *, file: str, shape: list[int], cfa: str
) -> RawFileCamera:
    """Return the camera: the factory that the entry point names.

    address: the program's command line; `{exposure_us}` and `{folder}` are filled in. file: the
    RAW file that it writes into the folder.
    """
    rows, columns = shape
    identity = CameraIdentity(model=shlex.split(address)[0])
    return RawFileCamera(Program(address, file), (rows, columns), cfa, 0.01, clock, identity)


class Program:
    """A `drivers.camera.CaptureTransport` that runs a program for each frame."""

    def __init__(self, command: str, file: str) -> None:
        self._command, self._file = command, file

    def capture(self, exposure_s: float) -> bytes:
        """Run the program and return the file that it wrote; raises `CaptureError`."""
        with tempfile.TemporaryDirectory() as folder:
            fields = {"exposure_us": round(1e6 * exposure_s), "folder": folder}
            words = [word.format(**fields) for word in shlex.split(self._command)]
            try:
                limit_s = exposure_s + GRACE_S
                subprocess.run(words, check=True, capture_output=True, timeout=limit_s)
                return (Path(folder) / self._file).read_bytes()
            except (OSError, subprocess.SubprocessError) as fault:
                advice = "run the program by hand and see what it says"
                raise CaptureError(f"the program took no picture ({fault})", advice) from fault
