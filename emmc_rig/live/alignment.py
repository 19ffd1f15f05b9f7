"""How the mask lies before the sensor, from one frame: its shadow is registered with the design's.

Placement and deviations come from the shadow's model (`calibration.shadow`), begun by correlation
(`calibration.registration`) and refined by Gauss-Newton steps in offset, rotation and scale, with
a gain and a level for every colour. Nothing is returned that the frame does not decide.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.boards import Board, channels_of
from calibration.errors import CalibrationError
from calibration.placement import Placement, designed_placement
from calibration.registration import LEAST_CORRELATION, register
from calibration.shadow import Shadow, ShadowMask, shadow_mask
from drivers.raw import RawFrame
from emmc_rig.model.camera import Camera, psi_layout
from emmc_rig.pages.frame_view import thinned

Array = NDArray[np.floating]

NOISE_QUANTILE = 0.9
"""Of the gradients, the strongest tenth: edges of cells, hardly noise."""
STRAIGHT = 0.3
"""Of straightness, from which on edges say where to begin."""
BLUR_CELLS = 0.1
"""Of the design's cells; the gain of every colour takes up what more or less there is."""
SAMPLED_PIXELS = 4_000
"""Of a window, drawn evenly at random: the deviations are those of so many."""
FIRST_HALF_PX = 24
"""Half the first window, registered by correlation; each next one is twice as large, so that a
turn of a degree or a stretch of a per cent stays below a cell."""
STEPS, ENOUGH = 12, 0.02
"""Gauss-Newton steps in a window, and the step, in standard deviations, that ends them."""
TUKEY = 4.685
MODEL_FACTOR = 2.0
"""On deviations by the residuals alone: what the model of the shadow lacks is no noise of single
pixels. On whiteboards of the shipped cameras, by the ray caster, errors were up to 3 of those."""
LEVEL_CELLS = 8.0
"""Light varies more slowly than this over the picture, the mask faster."""
WANTED_DEG, WANTED_SHARE = 0.1, 1e-3
"""A figure with a larger deviation is not shown."""
DARK_SHARE = 0.002
"""Of the range from black to white, by which the 99th percentile lies above black in any frame
that shows something."""
FITTED = slice(0, 4)
"""Of the placement's parameters: offset x and y, rotation, scale."""


@dataclass(frozen=True)
class MaskPlace:
    """Where the mask's shadow lies against the design's; every figure with its deviation.

    rotation_deg: of the mask, counterclockwise in the picture. scale: 1 as designed; the shadow
    cannot distinguish a stretched mask from one at another distance. offset_um: of the mask, x and
    y, from where the stage should have it; None where it is not seen. correlation: of frame and
    shadow, up to 1. ambiguity: what the offset leaves open, in words, "" for nothing.
    """

    rotation_deg: float
    rotation_deviation_deg: float
    scale: float
    scale_deviation: float
    offset_um: tuple[float, float] | None
    offset_deviation_um: float
    correlation: float
    ambiguity: str = ""


def grid_direction(plane: Array) -> tuple[float, float]:
    """Return rotation in degrees and straightness (0 to 1) of the edges in a picture (y, x).

    The mean of (g_x + i g_y)^4 over the strongest gradients g: the fourth power makes the four
    directions of a square grid one (the structure tensor's idea, for four-fold symmetry).
    """
    smooth = cv2.GaussianBlur(plane, (0, 0), 1.0)
    along_x = cv2.Scharr(smooth, cv2.CV_32F, 1, 0)[1:-1, 1:-1].ravel()
    along_y = cv2.Scharr(smooth, cv2.CV_32F, 0, 1)[1:-1, 1:-1].ravel()
    strength = np.hypot(along_x, along_y)
    if not strength.size or not strength.max() > 0:
        return 0.0, 0.0
    strong = strength >= np.quantile(strength, NOISE_QUANTILE)
    unit = (along_x[strong] + 1j * along_y[strong]) / strength[strong]
    mean = np.average(unit**4, weights=strength[strong].astype(np.float64) ** 2)
    # Rows count downwards: a positive angle from x to y looks clockwise.
    return float(-np.degrees(np.angle(mean)) / 4), float(np.abs(mean))


def is_dark(frame: RawFrame) -> bool:
    """Return whether a frame shows nothing but black."""
    frame = frame.with_one_black()
    black = float(frame.black_level_dn.mean())
    bright = float(np.percentile(thinned(frame.mosaic), 99)) - black
    return bright < DARK_SHARE * max(1.0, frame.white_level_dn - black)


class MaskGauge:
    """Measures where the mask of a design lies in frames of one size; raises CalibrationError
    where frames of this design show no mask's shadow to measure.
    """

    def __init__(self, camera: Camera, pixels: tuple[int, int]) -> None:
        self._camera, self._pixels = camera, pixels
        k = camera.sensor.binning
        size = pixels[0] * k, pixels[1] * k
        _require_one_mask(camera)
        self._mask = shadow_mask(camera, size)
        blur_um = BLUR_CELLS * self._mask.cell_um
        self._start = replace(designed_placement(camera), blur_um=blur_um)
        self._layout = psi_layout(camera, size)
        self._last: Placement | None = None

    def measure(
        self, frame: RawFrame, stage_um: tuple[float, float] = (0.0, 0.0), shot: int = 0
    ) -> MaskPlace:
        """Return where the mask lies in a frame.

        stage_um: where the mask stage stands, x and y, from where it centres the mask. shot: of
        the camera, whose filter is in. Raises CalibrationError with the reason where the frame
        does not show.
        """
        board = self._board(frame, stage_um, shot)
        if self._last is not None:
            try:
                place, self._last = self._fitted(board, self._last, max(self._pixels) / 2)
                return place
            except CalibrationError:
                self._last = None
        place, self._last = self._fitted(board, self._registered(board), FIRST_HALF_PX)
        return place

    def _registered(self, board: Board) -> Placement:
        """Return a placement to begin with; raises CalibrationError where no shadow is seen."""
        angle_deg, straightness = grid_direction(_without_colours(board))
        starts = [self._start]
        if straightness > STRAIGHT:
            turn = -float(np.deg2rad(angle_deg))
            starts.insert(0, replace(self._start, rotation_rad=turn))
        for place, start in enumerate(starts):
            try:
                return register(board, self._mask, start).placement
            except CalibrationError as fault:
                if place == len(starts) - 1:
                    raise CalibrationError(
                        f"the mask's shadow is not seen; if this is a white board: {fault}"
                    ) from fault
        raise AssertionError

    def _board(self, frame: RawFrame, stage_um: tuple[float, float], shot: int) -> Board:
        if frame.mosaic.shape != self._pixels:
            raise CalibrationError(f"the frame has not {self._pixels[0]}x{self._pixels[1]} pixels")
        expected = self._camera.sensor.cfa_name
        if frame.cfa != expected:
            raise CalibrationError(
                f"the camera's colour filters are {frame.cfa}, the design's {expected}"
            )
        if is_dark(frame):
            raise CalibrationError("the picture is dark")
        channels = channels_of(self._layout, shot)
        reading, usable = _levelled(frame, channels, self._mask)
        variance = np.where(usable, 1.0, np.inf).astype(np.float32)
        views = np.ones(self._mask.views, dtype=bool)
        return Board("the frame", reading, variance, channels, views, stage_um, shot)

    def _fitted(self, board: Board, start: Placement, half: float) -> tuple[MaskPlace, Placement]:
        """Return the place by windows that widen from half a side of `half` pixels on."""
        whole = max(self._pixels) / 2
        rng = np.random.default_rng(0)
        placement = start
        while True:
            half = min(half, whole)
            sample = _sample(board, half, rng)
            placement, deviations, correlation = _descended(board, self._mask, placement, sample)
            if correlation < LEAST_CORRELATION:
                raise CalibrationError(
                    f"the mask's shadow is not seen (correlation {correlation:.2f}, at least "
                    f"{LEAST_CORRELATION} is needed): look at a white board, lamp on"
                )
            if half == whole:
                break
            half *= 2
        deviations = MODEL_FACTOR * deviations
        turn, stretch = np.degrees(deviations[2]), deviations[3]
        if turn > WANTED_DEG or stretch > WANTED_SHARE:
            raise CalibrationError(
                f"the mask's rotation is known to {turn:.2g} degrees and its scale to "
                f"{100 * stretch:.2g} % only: look at a white board, expose longer"
            )
        repeats = self._mask.repeats
        offset = None if repeats.uniform else (placement.offset_x_um, placement.offset_y_um)
        place = MaskPlace(
            -float(np.degrees(placement.rotation_rad)),
            float(turn),
            placement.scale,
            float(stretch),
            offset,
            float(max(deviations[:2])),
            correlation,
            repeats.words,
        )
        return place, placement


def _require_one_mask(camera: Camera) -> None:
    """Raise CalibrationError unless the design has one mask, and that throws a shadow."""
    masks = camera.masks.values()
    if masks and all(mask.distance_mm >= camera.lens.distance_mm for mask in masks):
        raise CalibrationError(
            "this design's masks lie at the lens: they throw no shadow to measure"
        )
    if len(masks) != 1:
        raise CalibrationError(
            f"this design has {len(masks)} masks: the shadow of one alone can be measured"
        )


def _levelled(
    frame: RawFrame, channels: NDArray[np.uint8], mask: ShadowMask
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return readings over the local level of their colour, (y, x), and which to use."""
    signal = frame.mosaic.astype(np.float32) - frame.black_by_place().astype(np.float32)
    usable = frame.mosaic < frame.white_level_dn
    sigma = LEVEL_CELLS * mask.cell_um / (mask.pitch_um * mask.binning)
    sigma = min(max(sigma, 4.0), min(signal.shape) / 4)
    reading = np.zeros_like(signal)
    for channel in np.unique(channels):
        seen = (channels == channel) & usable
        if not seen.any():
            continue
        level, there = (
            cv2.GaussianBlur(part.astype(np.float32), (0, 0), sigma)
            for part in (np.where(seen, signal, 0), seen)
        )
        level /= np.maximum(there, 1e-6)
        least = 0.05 * float(level[seen].mean())
        bright = seen & (level > max(least, 1.0))
        reading[bright] = signal[bright] / level[bright]
        usable &= bright | (channels != channel)
    return reading, usable


def _without_colours(board: Board) -> NDArray[np.float32]:
    """Return the readings averaged over 2 x 2 pixels where pixels see different colours."""
    plane = np.where(board.usable, board.reading, 1).astype(np.float32)
    if (board.channels == board.channels[0, 0]).all():
        return plane
    return np.asarray(cv2.blur(plane, (2, 2)), np.float32)


@dataclass(frozen=True, eq=False)
class _Sample:
    pixels: NDArray[np.int64]
    channels: NDArray[np.uint8]
    reading: Array


def _sample(board: Board, half_px: float, rng: np.random.Generator) -> _Sample:
    y, x = (np.arange(count) - (count - 1) / 2 for count in board.reading.shape)
    inside = (np.abs(y) <= half_px)[:, None] & (np.abs(x) <= half_px)
    chosen = np.flatnonzero(board.usable & inside)
    if len(chosen) < 16 * len(np.unique(board.channels)):
        raise CalibrationError(
            "hardly any pixel is lit without being saturated: change the exposure"
        )
    if len(chosen) > SAMPLED_PIXELS:
        chosen = np.sort(rng.choice(chosen, SAMPLED_PIXELS, replace=False))
    pixels = np.stack(np.unravel_index(chosen, board.reading.shape), axis=1)
    return _Sample(
        pixels, board.channels.ravel()[chosen], board.reading.ravel()[chosen].astype(np.float64)
    )


def _descended(
    board: Board, mask: ShadowMask, placement: Placement, sample: _Sample
) -> tuple[Placement, Array, float]:
    """Return the placement after Gauss-Newton, the fitted parameters' deviations, correlation.

    Gain and level of every colour are eliminated: shadow and slopes are taken orthogonal to them
    (variable projection, Golub and Pereyra 1973, with Kaufman's simplification).
    """
    deviations, correlation = np.full(4, np.inf), 0.0
    for _ in range(STEPS):
        shadow = Shadow(mask, placement)
        seen, slope = shadow.with_slopes(sample.pixels, sample.channels, *board.opening)
        residual, rows = sample.reading.copy(), slope[:, FITTED].copy()
        explained = np.zeros_like(residual)
        for channel in np.unique(sample.channels):
            of = sample.channels == channel
            basis = np.stack([seen[of], np.ones(int(of.sum()))], axis=1)
            weight = _robust(residual[of] - basis @ _least_squares(basis, residual[of]))
            gain, level = _least_squares(basis, residual[of], weight)
            explained[of] = gain * (seen[of] - seen[of].mean())
            residual[of] -= basis @ (gain, level)
            rows[of] *= gain
            rows[of] -= basis @ _least_squares(basis, rows[of], weight)
        weight = _robust(residual)
        total = explained + residual
        correlation = float(
            np.sum(weight * explained * total)
            / np.sqrt(max(np.sum(weight * explained**2) * np.sum(weight * total**2), 1e-300))
        )
        matrix = rows.T @ (rows * weight[:, None])
        matrix[np.diag_indices(4)] *= 1 + 1e-9
        try:
            inverse = np.linalg.inv(matrix)
        except np.linalg.LinAlgError as fault:
            raise CalibrationError("the mask's shadow has no contrast here") from fault
        variance = np.sum(weight * residual**2) / max(np.sum(weight) - 4, 1.0)
        deviations = np.sqrt(np.maximum(np.diag(inverse), 0) * variance)
        step = inverse @ (rows.T @ (weight * residual))
        moved = np.zeros(len(placement.vector()))
        moved[FITTED] = step
        placement = placement.moved(moved)
        if np.all(np.abs(step) < ENOUGH * deviations):
            break
    return placement, deviations, correlation


def _least_squares(basis: Array, values: Array, weight: Array | None = None) -> Array:
    weighted = basis if weight is None else basis * weight[:, None]
    return np.linalg.lstsq(weighted.T @ basis, weighted.T @ values, rcond=None)[0]


def _robust(residual: Array) -> Array:
    """Return Tukey's weights of residuals."""
    spread = 1.4826 * float(np.median(np.abs(residual))) + 1e-12
    return np.clip(1 - (residual / (TUKEY * spread)) ** 2, 0, None) ** 2
