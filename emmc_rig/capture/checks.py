"""What a frame must pass before it counts, and where the bench stands after a resume.

The checks look at some ten thousand pixels, and so take less than a millisecond.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.errors import DriverError
from drivers.raw import RawFrame
from emmc_rig.capture.plan import Checks
from emmc_rig.frame_view import thinned
from emmc_rig.model.errors import CameraError
from emmc_rig.model.masks import cfa_tile
from emmc_rig.session.planned import PlannedFrame

BRIGHT_PERCENTILE = 99.9
LEAST_LIKENESS = 0.3


class FrameRefusedError(DriverError):
    """A frame that arrived whole but cannot be right; `reason` says why."""

    def __init__(self, frame_id: str, reason: str, advice: str) -> None:
        super().__init__(f"frame {frame_id} {reason}: {advice}")
        self.reason = reason


@dataclass(frozen=True)
class Figures:
    """Of one frame: share of saturated pixels; mean and 99.9th percentile above black, DN."""

    saturated: float
    mean_dn: float
    bright_dn: float

    def as_dict(self) -> dict[str, Any]:
        """Return plain data, for JSON."""
        return asdict(self)


def figures(frame: RawFrame) -> Figures:
    """Return a frame's figures, from `thinned` pixels."""
    black = float(frame.black_level_dn.mean())
    counts = np.bincount(thinned(frame.mosaic).ravel())
    levels, total = np.arange(counts.size), counts.sum()
    bright = np.searchsorted(np.cumsum(counts), BRIGHT_PERCENTILE / 100 * total)
    saturated = counts[frame.white_level_dn :].sum() / total
    return Figures(float(saturated), float(counts @ levels / total) - black, float(bright) - black)


def check(
    planned: PlannedFrame,
    frame: RawFrame,
    found: Figures,
    before: NDArray[np.uint16] | None,
    checks: Checks,
    may_saturate: bool = False,
) -> None:
    """Raise `FrameRefusedError` unless the frame can be what was planned.

    before: the mosaic of the frame before this one. may_saturate: a longer one of a bracket.
    """
    span = max(1.0, frame.white_level_dn - float(frame.black_level_dn.mean()))
    if before is not None and _same(frame.mosaic, before):
        raise FrameRefusedError(
            planned.id,
            "is the frame before it once more, bit by bit",
            "the camera repeats itself; switch it off and on if it goes on",
        )
    if planned.kind == "dark":
        if found.mean_dn > checks.largest_dark * span:
            raise FrameRefusedError(
                planned.id,
                f"is not dark, on average {found.mean_dn / span:.1%} of white",
                "switch the lamp off and cover the bench",
            )
        return
    if found.bright_dn < checks.smallest_signal * span:
        raise FrameRefusedError(
            planned.id,
            f"is black, its brightest pixels {max(0.0, found.bright_dn) / span:.2%} of white",
            "check lamp, lens cap and exposure",
        )
    if not may_saturate and found.saturated > checks.largest_saturated_share:
        raise FrameRefusedError(
            planned.id,
            f"is saturated in {found.saturated:.1%} of its pixels",
            "shorten the exposure in the plan, or dim the lamp",
        )


def _same(one: NDArray[np.uint16], other: NDArray[np.uint16]) -> bool:
    """Return whether two mosaics are equal, and not just equally empty."""
    if one.shape != other.shape or not np.array_equal(one[::256], other[::256]):
        return False
    return bool(one.min() != one.max()) and np.array_equal(one, other)


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


def registered(now: RawFrame, then: RawFrame) -> Shift:
    """Return how the frame `now` is shifted against `then`, to a fraction of a pixel.

    Colour tiles are averaged first: their pattern stands still whatever moves. Phase correlation
    under a Hann window; likeness is the correlation coefficient once shifted back.
    """
    one, other = (_without_tile(frame) for frame in (now, then))
    if one.shape != other.shape:
        return Shift(0.0, 0.0, 0.0)
    tile = now.mosaic.shape[0] // one.shape[0]
    one, other = (image - cv2.GaussianBlur(image, (0, 0), 8) for image in (one, other))
    if not (one.any() and other.any()):
        return Shift(0.0, 0.0, 0.0)
    window = cv2.createHanningWindow(one.shape[::-1], cv2.CV_32F)
    (x, y), _ = cv2.phaseCorrelate(other, one, window)
    back = np.array([[1, 0, x], [0, 1, y]], dtype=np.float32)
    moved = cv2.warpAffine(other, back, one.shape[::-1], borderMode=cv2.BORDER_REFLECT)
    inner = tuple(slice(n // 8, n - n // 8) for n in one.shape)
    a, b = one[inner].ravel(), moved[inner].ravel()
    spread = float(a.std() * b.std())
    likeness = float(np.mean((a - a.mean()) * (b - b.mean()))) / spread if spread else 0.0
    return Shift(x * tile, y * tile, likeness)


def _without_tile(frame: RawFrame) -> NDArray[np.float32]:
    """Return the mosaic averaged over its colour tile, (y, x) float32, at least 2x2."""
    try:
        side = max(cfa_tile(frame.cfa).shape[:2])
    except CameraError:
        side = 2
    if side == 1:
        return frame.mosaic.astype(np.float32)
    rows, columns = (n // side for n in frame.mosaic.shape)
    cut = frame.mosaic[: rows * side, : columns * side].astype(np.float32)
    return cut.reshape(rows, side, columns, side).mean(axis=(1, 3))
