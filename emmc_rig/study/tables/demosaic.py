"""Demosaic a Bayer frame by gradient-corrected linear interpolation, the paper's reference [53].

Malvar, He, Cutler 2004, "High-quality linear interpolation for demosaicing of Bayer-patterned
color images", Figure 2: bilinear interpolation plus a share of the Laplacian of the colour that
the pixel has.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_GREEN = np.array(
    [[0, 0, -2, 0, 0], [0, 0, 4, 0, 0], [-2, 4, 8, 4, -2], [0, 0, 4, 0, 0], [0, 0, -2, 0, 0]]
)
_ALONG_ROW = np.array(
    [[0, 0, 1, 0, 0], [0, -2, 0, -2, 0], [-2, 8, 10, 8, -2], [0, -2, 0, -2, 0], [0, 0, 1, 0, 0]]
)
_ACROSS = np.array(
    [[0, 0, -3, 0, 0], [0, 4, 0, 4, 0], [-3, 0, 12, 0, -3], [0, 4, 0, 4, 0], [0, 0, -3, 0, 0]]
)


def demosaiced_rggb(frame: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return (colour, y, x) of a frame (y, x) whose first pixel is red, the next one green."""
    frame = np.asarray(frame, dtype=np.float32)

    def filtered(kernel: NDArray[np.int_]) -> NDArray[np.float32]:
        weights = (kernel / 16).astype(np.float32)
        # Reflection about the edge pixel keeps the phase of the Bayer tile.
        found = cv2.filter2D(frame, -1, weights, borderType=cv2.BORDER_REFLECT_101)
        return found.astype(np.float32, copy=False)

    green, row, column, across = (
        filtered(kernel) for kernel in (_GREEN, _ALONG_ROW, _ALONG_ROW.T, _ACROSS)
    )
    colours = np.repeat(frame[None], 3, axis=0)
    red, blue = (slice(0, None, 2),) * 2, (slice(1, None, 2),) * 2
    beside_red, beside_blue = (red[0], blue[1]), (blue[0], red[1])
    for place in (red, blue):
        colours[(1, *place)] = green[place]
    for colour, own, other, own_row, other_row in (
        (0, red, blue, beside_red, beside_blue),
        (2, blue, red, beside_blue, beside_red),
    ):
        colours[(colour, *own_row)] = row[own_row]
        colours[(colour, *other_row)] = column[other_row]
        colours[(colour, *other)] = across[other]
        colours[(colour, *own)] = frame[own]
    return colours
