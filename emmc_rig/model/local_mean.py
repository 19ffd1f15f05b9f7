"""The mean of a frame's pixels around each, among those that see the same colour."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]


def local_mean(
    values: Array, good: NDArray[np.bool_], channels: NDArray[np.integer], deviation_px: float
) -> NDArray[np.float32]:
    """Return the Gaussian-weighted mean of the good pixels around each, of its own colour.

    values, good, channels: (y, x) each; of pixels that are not good the values do not count.
    deviation_px: of the Gaussian.
    """
    found = np.zeros(values.shape, dtype=np.float32)
    for channel in np.unique(channels):
        mine = channels == channel
        use = (mine & good).astype(np.float32)
        top = cv2.GaussianBlur(use * values.astype(np.float32), (0, 0), deviation_px)
        bottom = cv2.GaussianBlur(use, (0, 0), deviation_px)
        found[mine] = (top / np.maximum(bottom, 1e-6))[mine]
    return found
