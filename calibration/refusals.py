"""Whiteboards that no Psi may be made of: saturated, dark, without the mask, of a bench that moved.

Each is named with its remedy as a CalibrationError.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calibration.boards import Board, BoardSet
from calibration.choice import HeldOut
from calibration.errors import CalibrationError
from calibration.frames import MeanFrame
from calibration.whiteboard import DARKEST_REFERENCE_DN

BRIGHTEST_MASK = 0.95
"""No mask that codes lets nearly all light through everywhere."""
LEAST_GAIN_SHARE = 0.5
"""Of the noise per DN that other frames have: a full pixel is without shot noise."""
LARGEST_MISS = 0.1
"""Of a held-out whiteboard's level; a bench of 64 rays, the grainiest that was tried, has 4 %."""
BRIGHTNESS_DIFFERS = 0.05


def refuse_unfit(sets: Sequence[BoardSet]) -> None:
    """Raise CalibrationError for references that are dark or saturated."""
    for one in sets:
        for (_, lamp), frame in one.references.items():
            above = frame.mean_dn - one.dark_at(frame.exposure_s).mean_dn
            if float(np.percentile(above, 99)) < DARKEST_REFERENCE_DN:
                raise CalibrationError(
                    f"the reference whiteboard under the {lamp} lamp is less than "
                    f"{DARKEST_REFERENCE_DN:g} DN above the dark: is the lamp on? Else raise it, "
                    "or the exposure"
                )
        reference = one.references.get((0, "white"))
        seen = [
            _gain(board.frame, one)
            for board in one.frames
            if board.frame.count > 1 and _light_dn(board.frame, one) > DARKEST_REFERENCE_DN
        ]
        if reference is None or reference.count < 2 or not seen:
            continue
        if _gain(reference, one) < LEAST_GAIN_SHARE * float(np.median(seen)):
            raise CalibrationError(
                "the reference whiteboard is saturated below the white level: its noise is less "
                f"than {LEAST_GAIN_SHARE:.0%} of what its light has; shorten the exposure "
                f"({reference.exposure_s:g} s) or dim the lamp"
            )


def _gain(frame: MeanFrame, boards: BoardSet) -> float:
    """Return the noise's variance per DN of light."""
    return (frame.variance_dn2 - boards.dark.variance_dn2) / _light_dn(frame, boards)


def _light_dn(frame: MeanFrame, boards: BoardSet) -> float:
    return float(np.mean(frame.mean_dn - boards.dark_at(frame.exposure_s).mean_dn))


def refuse_without_mask(board: Board) -> None:
    """Raise CalibrationError for an open whiteboard that reads as if no mask were in the beam."""
    readings = board.reading[board.usable]
    if readings.size and np.percentile(readings, 2) > BRIGHTEST_MASK:
        raise CalibrationError(
            f"{board.name}: it reads {np.median(readings):.2f} of the whiteboard without masks, "
            "and no pixel much less: is the mask in the beam?"
        )


def refuse_another_bench(chosen: HeldOut) -> None:
    """Raise CalibrationError where a whiteboard is of another bench than the Psi of the others."""
    if chosen.relative_error <= LARGEST_MISS:
        return
    why = "the mask, the lens or the camera moved between them, or it is of another day or camera"
    if abs(chosen.brightness - 1) > BRIGHTNESS_DIFFERS:
        why = (
            f"it is {chosen.brightness:.2f} times as bright as the others tell: was the aperture "
            "wholly open, and the lamp the same?"
        )
    name = max(chosen.groups, key=lambda group: chosen.groups[group])
    raise CalibrationError(
        f"a whiteboard ({name}) differs from the Psi of the others by "
        f"{chosen.relative_error:.0%} of its level: {why}; capture all whiteboards again, in one go"
    )
