"""Where readings are missed: a map of what the light field leaves unexplained, in deviations."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.sensing import ImagingMatrix

Array = NDArray[np.floating]
WINDOW_PX = 9
"""Side of the square that a place is judged by: 81 readings a shot distinguish 1 from 1.25."""


def missed_readings(
    psi: ImagingMatrix,
    light_field: Array,
    readings: Array,
    deviation: Array | float,
    usable: NDArray[np.bool_],
) -> NDArray[np.float32]:
    """Return how far readings are missed around each place, (y, x) of the samples.

    The root mean square of (reading - Psi light field) / deviation, over shots and a window: about
    1 where the light field explains the readings. 1 where no reading is usable, or has no noise.

    readings, usable: (shot, pixel_y, pixel_x). deviation: of each, or of all.
    """
    noise = np.broadcast_to(np.asarray(deviation, np.float32), readings.shape)
    counts = usable & np.isfinite(noise) & (noise > 0)
    times = np.zeros(readings.shape, np.float32)
    np.divide(readings - psi.forward(light_field), noise, out=times, where=counts)
    window = (WINDOW_PX, WINDOW_PX)
    squares = cv2.blur(np.square(times).mean(axis=0), window)
    shares = cv2.blur(counts.mean(axis=0, dtype=np.float32), window)
    missed = np.ones_like(squares)
    np.divide(squares, shares, out=missed, where=shares > 0)
    rows, columns = psi.size
    return cv2.resize(np.sqrt(missed), (columns, rows), interpolation=cv2.INTER_NEAREST)
