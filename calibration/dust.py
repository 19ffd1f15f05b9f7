"""Dust that came onto the sensor, or left it, between the references and the whiteboards.

A whiteboard over its reference does not show how bright a pixel is. Dust that moved in between
does not cancel: its pixels are darker, or brighter, by the same share in every whiteboard, whatever
the mask casts there. No model of the mask says so, and the scene may be seen with either.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from emmc_rig.calibration.boards import Board
from emmc_rig.calibration.choice import predicted_by_shadow
from emmc_rig.calibration.robust import deviation_of
from emmc_rig.calibration.shadow import Shadow

FEWEST_BOARDS = 3
SURE, LEAST_SHARE = 6.0, 0.01
"""Deviations, and share of the light, from which on a pixel's change is dust."""
LARGEST_CHI2 = 3.0
"""Of what a change alike in all whiteboards leaves of a pixel: more, and it is no dust."""
SKIRT_PX = 2
MOST_OF_SENSOR = 0.25
"""More pixels than these are not dusty: whatever it is, the model misses it."""


def moved_dust(shadow: Shadow, boards: Sequence[Board]) -> NDArray[np.bool_]:
    """Return the pixels, (pixel_y, pixel_x), under dust that moved after the references."""
    shape = boards[0].reading.shape
    light, power, squares, count = (np.zeros(shape) for _ in range(4))
    for board in boards:
        weight = np.where(board.usable, 1 / board.variance.astype(np.float64), 0.0)
        predicted = predicted_by_shadow(shadow, board)
        off = board.reading - predicted
        light += weight * predicted * off
        power += weight * predicted**2
        squares += weight * off**2
        count += board.usable
    change = light / np.maximum(power, 1e-300)
    left = squares - change * light
    # All share the noise of the references, which the boards' own variances count anew each time.
    common = deviation_of(change[power > 0])
    sure = np.abs(change) > SURE * np.maximum(common, 1 / np.sqrt(np.maximum(power, 1e-300)))
    alike = left < LARGEST_CHI2 * np.maximum(count - 1, 1)
    dusty = sure & alike & (np.abs(change) > LEAST_SHARE) & (count >= FEWEST_BOARDS)
    if not 0 < dusty.mean() < MOST_OF_SENSOR:
        return np.zeros(shape, bool)
    return np.asarray(binary_dilation(dusty, iterations=SKIRT_PX), bool)
