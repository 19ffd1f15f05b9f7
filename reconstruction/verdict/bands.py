"""How far the masks lie apart from one band to the next, as Psi has them.

Behind a prism each band shows scene and mask displaced alike. A light field whose bands lie
otherwise may fit the readings as well, and has wrong spectra.
"""

from __future__ import annotations

import itertools

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.sensing import Psi

FURTHEST_PX = 8
"""Shifts that are tried."""
ALIKE, APART_PX = 0.8, 0.25
"""Least correlation of neighbouring bands' masks, and the most that their shifts differ."""


def mask_shift_px(psi: Psi) -> float | None:
    """Return the shift of Psi's masks from a picture to the next along its only axis of pictures.

    In pixels, without a sign. None where the pictures have two axes, and where masks differ from
    picture to picture by more than a shift.
    """
    rows, columns = psi.views
    if min(rows, columns) != 1 or max(rows, columns) < 2:
        return None
    weights = np.asarray(psi.weights[0], np.float32)
    pictures = weights.reshape(rows * columns, weights.shape[2], -1, weights.shape[-1]).mean(axis=2)
    if rows > 1:
        pictures = np.ascontiguousarray(pictures.swapaxes(1, 2))
    if pictures.shape[2] < 4 * FURTHEST_PX:
        return None
    found = [_shift_px(here, there) for here, there in itertools.pairwise(pictures)]
    known = [shift for shift in found if shift is not None]
    if len(known) < len(found) or np.ptp(known) > APART_PX:
        return None
    return float(abs(np.median(known)))


def _shift_px(here: NDArray[np.float32], there: NDArray[np.float32]) -> float | None:
    """Return the shift along x, by the parabola about the largest correlation; None if low."""
    middle = np.ascontiguousarray(here[:, FURTHEST_PX:-FURTHEST_PX])
    alike = cv2.matchTemplate(there, middle, cv2.TM_CCOEFF_NORMED)[0].astype(np.float64)
    at = int(alike.argmax())
    if alike[at] < ALIKE or at in (0, 2 * FURTHEST_PX):
        return None
    before, most, after = alike[at - 1 : at + 2]
    return at - FURTHEST_PX + 0.5 * (before - after) / (before - 2 * most + after)
