"""A lamp whose brightness is a number in a file, as Linux has it for panels and LEDs.

lights: {protocol: dimmer, port: /sys/class/leds/board/brightness, options: {level: 200}}
"""

from __future__ import annotations

from pathlib import Path

from emmc_rig.drivers.clock import Clock
from emmc_rig.drivers.errors import LightError
from emmc_rig.drivers.lights import Lights


class Dimmer(Lights):
    """White light of one level; address: the file. Nothing is kept open."""

    def __init__(self, address: str, clock: Clock, level: int = 255) -> None:
        super().__init__(address, ("off", "white"))
        self._file, self._levels = Path(address), {"off": 0, "white": level}

    def _switch(self, colour: str) -> str:
        level = self._levels[colour]
        try:
            self._file.write_text(f"{level}\n")
            read = int(self._file.read_text())
        except (OSError, ValueError) as fault:
            raise LightError(f"cannot be set to {colour} ({fault})", "check the file") from fault
        if read != level:
            raise LightError(f"are at {read} instead of {level}", "lower level")
        return str(read)

    def _reconnect(self) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""
