"""Registration of two frames: the shift to a fraction of a pixel, and their correlation after it.

Colour tiles are averaged first: their pattern stands still whatever moves, and the pixels of one
colour lie too far apart to locate an edge between them.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.drivers.raw import RawFrame
from emmc_rig.model.errors import CameraError
from emmc_rig.model.masks import cfa_tile

SMOOTH_PX = 8.0
"""What varies more slowly than this is light, not edges."""
LEAST_LIKENESS = 0.3
"""Of two frames, below which their shift is not believed."""
FURTHEST_REFINED_PX = 1.0
MOST_STEPS, ENOUGH = 30, 1e-5

Plane = NDArray[np.float32]


@dataclass(frozen=True)
class Shift:
    """How one frame lies over another: x, y in pixels, and their likeness there, up to 1."""

    x_px: float
    y_px: float
    likeness: float

    @property
    def length_px(self) -> float:
        """How far in all."""
        return float(np.hypot(self.x_px, self.y_px))


def registered(now: RawFrame, then: RawFrame, longest_px: int | None = None) -> Shift:
    """Return how the frame `now` is shifted against `then`, in sensor pixels.

    longest_px: only so much of the frames' middle is compared. Frames of different sizes are not
    alike at all.
    """
    (plane, tile), (reference, _) = (without_tile(frame, longest_px) for frame in (now, then))
    found = shift_of(plane, reference)
    return Shift(found.x_px * tile, found.y_px * tile, found.likeness)


def without_tile(frame: RawFrame, longest_px: int | None = None) -> tuple[Plane, int]:
    """Return a frame averaged over its colour tile, (y, x), and the tile's side in pixels.

    A tile that is not known counts as 2 x 2. longest_px: only so much of the middle.
    """
    try:
        side = max(cfa_tile(frame.cfa).shape[:2])
    except CameraError:
        side = 2
    cuts = []
    for length in frame.mosaic.shape:
        kept = min(length, longest_px or length) // side * side
        start = (length - kept) // (2 * side) * side
        cuts.append(slice(start, start + kept))
    plane = frame.mosaic[tuple(cuts)].astype(np.float32)
    if side == 1:
        return plane, 1
    rows, columns = (n // side for n in plane.shape)
    return plane.reshape(rows, side, columns, side).mean(axis=(1, 3)), side


def shift_of(now: Plane, then: Plane) -> Shift:
    """Return how the picture `now` (y, x) is shifted against `then`, in its own pixels.

    Phase correlation under a Hann window finds the shift wherever it is; enhanced correlation
    (Evangelidis and Psarakis 2008) refines it, and is believed within a pixel of that. Likeness is
    the correlation coefficient of the two once shifted back, without what varies slowly.
    """
    if now.shape != then.shape:
        return Shift(0.0, 0.0, 0.0)
    seen, before = (image - cv2.GaussianBlur(image, (0, 0), SMOOTH_PX) for image in (now, then))
    if not (seen.any() and before.any()):
        return Shift(0.0, 0.0, 0.0)
    window = cv2.createHanningWindow(seen.shape[::-1], cv2.CV_32F)
    (x, y), _ = cv2.phaseCorrelate(before, seen, window)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, MOST_STEPS, ENOUGH)
    with suppress(cv2.error):
        _, found = cv2.findTransformECC(before, seen, _moving(x, y), cv2.MOTION_TRANSLATION, stop)
        finer_x, finer_y = (float(value) for value in found[:, 2])
        if np.hypot(finer_x - x, finer_y - y) <= FURTHEST_REFINED_PX:
            x, y = finer_x, finer_y
    moved = cv2.warpAffine(before, _moving(x, y), seen.shape[::-1], borderMode=cv2.BORDER_REFLECT)
    inner = tuple(slice(n // 8, n - n // 8) for n in seen.shape)
    a, b = seen[inner].ravel(), moved[inner].ravel()
    spread = float(a.std() * b.std())
    likeness = float(np.mean((a - a.mean()) * (b - b.mean()))) / spread if spread else 0.0
    return Shift(float(x), float(y), likeness)


def _moving(x: float, y: float) -> Plane:
    return np.array([[1, 0, x], [0, 1, y]], dtype=np.float32)
