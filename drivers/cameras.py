"""The camera protocols, a row each: a new protocol is a module and a row here."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any


@dataclass(frozen=True)
class CameraProtocol:
    """A protocol of cameras, and its driver's module, imported at first use.

    module: has `open_camera(address, clock, backend)`, whose backend is pyusb's; where it also has
    a dataclass OPTIONS, that is a fourth argument, and its fields are settings of a camera's YAML
    file. address: what follows the driver and a colon. interface: class, subclass and protocol on
    USB, by which such cameras are listed. frame_prefix: first bytes of frames in a format
    unknown to `drivers.raw`; `decode_frame(data, black_level_dn, white_level_dn)` of the module
    decodes these frames.
    """

    module: str
    address: str
    interface: tuple[int, int, int] | None = None
    frame_prefix: bytes = b""

    def load(self) -> Any:
        """Return the module."""
        return import_module(self.module)


CAMERAS = {
    "ptp": CameraProtocol("emmc_rig.drivers.ptp", "SERIAL", (0x06, 0x01, 0x01)),
    "u3v": CameraProtocol("emmc_rig.drivers.u3v", "SERIAL", (0xEF, 0x05, 0x00), b"U3VL"),
    "gphoto2": CameraProtocol("emmc_rig.drivers.gphoto", "PORT"),
    "mm": CameraProtocol("emmc_rig.drivers.micromanager", "CONFIG.cfg"),
    "folder": CameraProtocol("emmc_rig.drivers.folder", "PATH"),
}
CAMERA_HELP = ", ".join(f"{name}:{camera.address}" for name, camera in CAMERAS.items())
"""What `--camera` takes, for help texts and refusals."""
