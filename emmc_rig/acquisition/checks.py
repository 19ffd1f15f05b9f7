"""What a frame must pass before it counts.

The checks look at some ten thousand pixels, and so take less than a millisecond.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DriverError
from drivers.raw import RawFrame
from emmc_rig.acquisition.plan import Checks
from emmc_rig.pages.frame_view import thinned
from emmc_rig.session.journal import Figures
from emmc_rig.session.planned import PlannedFrame

BRIGHT_PERCENTILE = 99.9
LEAST_LIKENESS = 0.3


class FrameRefusedError(DriverError):
    """A frame that arrived whole but cannot be right; `reason` says why."""

    def __init__(self, frame_id: str, reason: str, advice: str) -> None:
        super().__init__(f"frame {frame_id} {reason}: {advice}")
        self.reason = reason


class SaturatedError(FrameRefusedError):
    """A frame too bright for its exposure, which a second try at that exposure would be too."""


def figures(frame: RawFrame) -> Figures:
    """Return a frame's figures, from `thinned` pixels."""
    black = float(frame.black_level_dn.mean())
    counts = np.bincount(thinned(frame.mosaic).ravel())
    levels, total = np.arange(counts.size), counts.sum()
    shares = np.array([0.5, BRIGHT_PERCENTILE / 100])
    median, bright = np.searchsorted(np.cumsum(counts), shares * total)
    saturated = counts[frame.white_level_dn :].sum() / total
    mean = float(counts @ levels / total)
    return Figures(float(saturated), mean - black, float(bright) - black, float(median) - black)


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
    # Nothing can be metered from less than one DN.
    least_dn = max(checks.smallest_signal * span, planned.kind == "metering")
    if found.bright_dn < least_dn:
        raise FrameRefusedError(
            planned.id,
            f"is black, its brightest pixels {max(0.0, found.bright_dn) / span:.2%} of white",
            f"check lamp and lens cap, or raise {exposure_setting(planned)} in the plan",
        )
    if not may_saturate and found.saturated > checks.largest_saturated_share:
        raise SaturatedError(
            planned.id,
            f"is saturated in {found.saturated:.1%} of its pixels",
            f"lower {exposure_setting(planned)} in the plan",
        )


def exposure_setting(planned: PlannedFrame) -> str:
    """Return the key of the plan that sets a frame's exposure."""
    if planned.kind == "dark":
        return "darks.exposure_s"
    if planned.kind == "shot":
        metered = planned.exposure_s is None
        return "metering.level" if metered else f"shots.{planned.bench.shot}.exposure_s"
    if planned.kind == "metering" and planned.bench.target == "scene":
        return "metering.longest_s"
    return "whiteboards.exposure_s" if planned.metered_by is None else "whiteboards.level"


def _same(one: NDArray[np.uint16], other: NDArray[np.uint16]) -> bool:
    """Return whether two mosaics are equal, and not just equally empty."""
    if one.shape != other.shape or not np.array_equal(one[::256], other[::256]):
        return False
    return bool(one.min() != one.max()) and np.array_equal(one, other)
