"""Where the mask's shadow lies on a whiteboard, to a fraction of a pixel, before any fit.

The design's shadow, drawn in every colour, is correlated with the mosaic as it is, each pixel with
the colour it sees: a phase correlation of demosaiced pictures would see the colour filters, which
do not move with the mask. All shifts within the search range are tried at once, by FFT.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.boards import Board
from calibration.errors import CalibrationError
from calibration.placement import Placement
from calibration.repeats import vertex
from calibration.shadow import SEARCH_UM, Shadow, ShadowMask

Array = NDArray[np.floating]
CROP_PX = 160
LEAST_CORRELATION = 0.3
CLEAR_CORRELATION = 0.6
ROTATIONS_DEG = (0.0, 0.5, -0.5, 1.0, -1.0, 1.5, -1.5, 2.0, -2.0)
ORIENTATIONS = {
    "mirrored left to right": lambda cells: cells[:, :, ::-1],
    "mirrored top to bottom": lambda cells: cells[:, ::-1],
    "turned by 180 degrees": lambda cells: cells[:, ::-1, ::-1],
    "turned by 90 degrees": lambda cells: cells.transpose(0, 2, 1, 3)[:, ::-1],
    "turned by 270 degrees": lambda cells: cells.transpose(0, 2, 1, 3)[:, :, ::-1],
    "mirrored and turned by 90 degrees": lambda cells: cells.transpose(0, 2, 1, 3),
    "mirrored and turned by 270 degrees": lambda cells: cells.transpose(0, 2, 1, 3)[:, ::-1, ::-1],
}


@dataclass(frozen=True)
class Registration:
    """The placement found, and the correlation of the whiteboard with the design there."""

    placement: Placement
    correlation: float


def register(board: Board, mask: ShadowMask, start: Placement) -> Registration:
    """Return the start, with the offset (and the rotation, if need be) found in a whiteboard.

    Raises CalibrationError with the correlation found when the design's shadow is not there.
    """
    best = Registration(start, -1.0)
    for turn in ROTATIONS_DEG:
        placement = replace(start, rotation_rad=start.rotation_rad + np.deg2rad(turn))
        found = correlated(board, mask, placement)
        if found.correlation > best.correlation:
            best = found
        if best.correlation >= CLEAR_CORRELATION:
            break
    if best.correlation >= LEAST_CORRELATION:
        return best
    for how, correlation in _otherwise(board, mask, start):
        if correlation >= CLEAR_CORRELATION:
            raise CalibrationError(
                f"{board.name}: the mask in the bench is that of the design, but {how} "
                f"(correlation {correlation:.2f}, as designed {best.correlation:.2f}): refit the "
                "mask, or turn its pattern in the camera's description"
            )
    raise CalibrationError(
        f"{board.name}: the mask in the bench is not the mask of the design: their best "
        f"correlation is {best.correlation:.2f}, at least {LEAST_CORRELATION} is needed; check the "
        "mask, its pattern's seed and the camera's description, or use calibration method free"
    )


def _otherwise(board: Board, mask: ShadowMask, start: Placement) -> Iterator[tuple[str, float]]:
    """Yield how else the mask may sit in the bench, and the correlation there."""
    for how, turned in ORIENTATIONS.items():
        other = replace(mask, cells=np.ascontiguousarray(turned(mask.cells)))
        yield how, correlated(board, other, start).correlation


def correlated(
    board: Board,
    mask: ShadowMask,
    start: Placement,
    reach_um: float = SEARCH_UM,
    crop_px: int = CROP_PX,
) -> Registration:
    """Return the start moved to the best shift, and the correlation coefficient there.

    Of a mask that repeats it is the place nearest to the start that looks so.

    reach_um: shifts tried, along either axis. crop_px: the middle of the picture that is used.
    """
    rows, columns = board.reading.shape
    height, width = min(rows, crop_px), min(columns, crop_px)
    # Colour filters repeat: an even corner keeps what each pixel sees.
    top, left = (rows - height) // 2, (columns - width) // 2
    crop = slice(top, top + height), slice(left, left + width)
    pixel_um = mask.pitch_um * mask.binning
    margin = int(np.ceil(reach_um / pixel_um))
    y, x = np.mgrid[top - margin : top + height + margin, left - margin : left + width + margin]
    pixels = np.stack([y.ravel(), x.ravel()], axis=1)
    shadow = Shadow(mask, start)
    # Half of what starting most commands takes, for a whiteboard's sake.
    from scipy.signal import fftconvolve

    usable, channels = board.usable[crop], board.channels[crop]
    reading = np.where(usable, board.reading[crop], 0).astype(np.float64)
    product = energy = 0.0
    mine = 0.0
    for channel in np.unique(channels):
        seen = (channels == channel) & usable
        values = reading[seen]
        centred = np.where(seen, reading - values.mean(), 0)
        # A speck or a hot pixel must not outweigh the mask.
        limit = 4 * np.std(centred[seen])
        centred = np.clip(centred, -limit, limit)
        seen_as = np.full(len(pixels), channel, np.uint8)
        drawn = shadow.readings(pixels, seen_as, *board.opening).reshape(y.shape)
        drawn -= drawn[margin:-margin, margin:-margin].mean()
        turned = centred[::-1, ::-1]
        product = product + fftconvolve(drawn, turned, mode="valid")
        energy = energy + fftconvolve(drawn**2, seen[::-1, ::-1].astype(float), mode="valid")
        mine += float((centred**2).sum())
    scores = product / np.sqrt(np.maximum(energy, 1e-12) * max(mine, 1e-12))
    peak = np.unravel_index(int(np.argmax(scores)), scores.shape)
    shift_px = [
        margin - (at + vertex(np.moveaxis(scores, axis, 0), peak if axis == 0 else peak[::-1]))
        for axis, at in enumerate(peak)
    ]
    # The shadow moves by 1 / (1 - rho) of what the mask does.
    ratio = mask.distance_um * (1 + start.distance_share) / mask.lens_um
    shift_um = np.array(shift_px[::-1]) * pixel_um * (1 - ratio)
    x_um, y_um = mask.repeats.nearest(shift_um)
    moved = replace(
        start, offset_x_um=start.offset_x_um + x_um, offset_y_um=start.offset_y_um + y_um
    )
    return Registration(moved, float(scores[peak]))
