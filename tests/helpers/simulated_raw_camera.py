"""A simulated camera: exposes whatever scene it is given and answers with RAW files."""

from collections.abc import Callable

import numpy as np

from emmc_rig.drivers.clock import Clock
from emmc_rig.drivers.dng import encode_dng
from emmc_rig.simulators.faults import Faults

Array = np.ndarray

FAULTS = ("torn_raw", "wrong_size")


class SimulatedRawCamera:
    """A `drivers.camera.CaptureTransport` over a scene.

    `render(exposure_s)` returns the uint16 `(y, x)` mosaic in DN that the sensor reads, called
    when the exposure has passed on the clock. Faults, armed with `faults.inject`: `torn_raw`
    loses the end of a file, `wrong_size` loses the last rows of the mosaic.
    """

    def __init__(
        self,
        render: Callable[[float], Array],
        clock: Clock,
        cfa: str = "rggb",
        black_level_dn: float | Array = 64,
        white_level_dn: int = 4095,
    ) -> None:
        self.faults = Faults(FAULTS)
        self._render = render
        self._clock = clock
        self._cfa = cfa
        self._black_level_dn = black_level_dn
        self._white_level_dn = white_level_dn

    def capture(self, exposure_s: float) -> bytes:
        """Expose for `exposure_s` and return the DNG's bytes; raises as `encode_dng` does."""
        self._clock.sleep(exposure_s)
        mosaic = self._render(exposure_s)
        if self.faults.strikes("wrong_size"):
            mosaic = mosaic[:-2]
        data = encode_dng(mosaic, self._cfa, self._black_level_dn, self._white_level_dn, exposure_s)
        if self.faults.strikes("torn_raw"):
            return data[: -len(data) // 4]
        return data
