"""Where the shadow of a design's mask lies in a frame: place, deviation and correlation.

Every search for a mask's shadow goes this way. `search` correlates the design's shadow, drawn in
every colour, with the mosaic as it is, each pixel with the colour it sees: a phase correlation of
demosaiced pictures would see the colour filters, which do not move with the mask. All shifts within
the search range are tried at once, by FFT. `register` does so at several rotations, and refuses
another mask. `refine` goes on from there by Gauss-Newton steps, with light and level of every
colour free. `locate` does all of it for a frame without a reference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from emmc_rig.calibration.boards import Board, Opening, Sample
from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.placement import SCALARS, Placement, Tolerances, designed_placement
from emmc_rig.calibration.repeats import convolved, vertex
from emmc_rig.calibration.robust import correlation, deviation_of, tukey_weights
from emmc_rig.calibration.shadow import SEARCH_UM, Shadow, ShadowMask
from emmc_rig.model.camera import Camera
from emmc_rig.model.frames import local_mean

Array = NDArray[np.floating]
CROP_PX = 160
"""Sides of the picture's middle that `search` correlates."""
LEAST_CORRELATION = 0.3
"""Of frame and shadow, below which the mask is not the design's."""
CLEAR_CORRELATION = 0.6
"""Ends the search over rotations; a mirrored mask is named from this correlation on."""
ROTATIONS_DEG = (0.0, 0.5, -0.5, 1.0, -1.0, 1.5, -1.5, 2.0, -2.0)
"""A quarter of a degree moves the rim of CROP_PX by a third of a pixel."""
ORIENTATIONS = {
    "mirrored left to right": lambda cells: cells[:, :, ::-1],
    "mirrored top to bottom": lambda cells: cells[:, ::-1],
    "turned by 180 degrees": lambda cells: cells[:, ::-1, ::-1],
    "turned by 90 degrees": lambda cells: cells.transpose(0, 2, 1, 3)[:, ::-1],
    "turned by 270 degrees": lambda cells: cells.transpose(0, 2, 1, 3)[:, :, ::-1],
    "mirrored and turned by 90 degrees": lambda cells: cells.transpose(0, 2, 1, 3),
    "mirrored and turned by 270 degrees": lambda cells: cells.transpose(0, 2, 1, 3)[:, ::-1, ::-1],
}
"""Of cells or views, (shot, y, x, colour)."""
LEVEL_CELLS = 8.0
"""Light varies more slowly than this over the picture, the mask faster."""
LEAST_LEVEL = 0.05
"""Of the mean: what is darker has no contrast to see."""
POSE = ("offset_x_um", "offset_y_um", "rotation_rad", "scale")
"""Parameters of the placement that `refine` fits."""
OFFSETS = POSE[:2]
SOFT_EDGES = 0.1
"""Of a cell: how soft edges are taken to be before they are fitted."""
FIRST_HALF_PX = 24
"""Half the first window that is refined; each next one is twice as large, so that a turn of a
degree or a stretch of a per cent stays below a cell."""
REFINED_PIXELS = 4_000
"""Of a window, drawn evenly at random: the deviations are those of so many."""
FEWEST_PIXELS = 16
"""Of every colour in a window."""
STEPS, ENOUGH = 12, 0.02
"""Gauss-Newton steps in a window, and the step, in standard deviations, that ends them."""
MODEL_FACTOR = 2.0
"""On deviations by the residuals alone: what the model of the shadow lacks is alike in neighbouring
pixels. On whiteboards of the shipped cameras, by the ray caster, errors were up to 3 of those."""


@dataclass(frozen=True)
class Location:
    """Where a mask's shadow lies, and the correlation of frame and shadow there, up to 1.

    deviations: of the parameters that were refined, by name; none where `search` alone was made.
    """

    placement: Placement
    correlation: float
    deviations: dict[str, float] = field(default_factory=dict)

    @property
    def offset_um(self) -> tuple[float, float]:
        """Of the mask, x and y, from where the stage should have it."""
        return self.placement.offset_x_um, self.placement.offset_y_um

    @property
    def offset_deviation_um(self) -> float:
        """The larger of both axes'."""
        return max(self.deviations[name] for name in OFFSETS)


def starting_placement(camera: Camera, mask: ShadowMask) -> Placement:
    """Return the placement as designed, with edges as soft as a sharp picture has them."""
    return replace(designed_placement(camera), blur_um=SOFT_EDGES * mask.cell_um)


def frame_board(
    mosaic: NDArray[np.uint16],
    black_dn: Array,
    white_dn: int,
    channels: NDArray[np.uint8],
    opening: Opening,
) -> Board:
    """Return a frame without a reference as a whiteboard for `locate`.

    mosaic, black_dn, channels: (pixel_y, pixel_x); the latter the colours that pixels see.
    """
    lit = mosaic < white_dn
    reading = mosaic - black_dn.astype(np.float32)
    reading /= max(float(reading[lit].mean()), 1e-3) if lit.any() else 1.0
    variance = np.where(lit, np.float32(1), np.float32(np.inf))
    return Board("the frame", reading, variance, channels, *opening)


def locate(
    board: Board, mask: ShadowMask, start: Placement, reach_um: float | None = None
) -> Location:
    """Return offset, rotation and scale of a mask in a frame of uneven light, deviations too.

    reach_um: to search for the offset alone, by so much along either axis; None: `register` it.
    Raises CalibrationError where the shadow is not there.
    """
    sigma_px = LEVEL_CELLS * mask.cell_um / (mask.pitch_um * mask.binning)
    sigma_px = min(max(sigma_px, 4.0), min(board.reading.shape) / 4)
    flat, variance = over_local_level(board.reading, board.usable, board.channels, sigma_px)
    board = replace(board, variance=variance)
    levelled = replace(board, reading=flat)
    _require_usable(int(board.usable.sum()), board)
    if reach_um is None:
        return refine(board, mask, register(levelled, mask, start).placement)
    return refine(board, mask, search(levelled, mask, start, reach_um).placement, OFFSETS)


def over_local_level(
    signal: Array, usable: NDArray[np.bool_], channels: NDArray[np.uint8], sigma_px: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return readings over the local level of their colour, and variances as a `Board` has them."""
    signal = np.where(usable, signal, 0).astype(np.float32)
    level = local_mean(signal, usable, channels, sigma_px)
    bright = np.zeros(usable.shape, dtype=bool)
    for channel in np.unique(channels[usable]):
        seen = usable & (channels == channel)
        bright |= seen & (level > LEAST_LEVEL * max(float(level[seen].mean()), 0.0))
    reading = np.divide(signal, level, out=np.zeros_like(signal), where=bright)
    return reading, np.where(bright, np.float32(1), np.float32(np.inf))


def register(board: Board, mask: ShadowMask, start: Placement) -> Location:
    """Return the start, with the offset (and the rotation, if need be) found in a whiteboard.

    Raises CalibrationError with the correlation found when the design's shadow is not there.
    """
    best = Location(start, -1.0)
    for turn in ROTATIONS_DEG:
        turned = replace(start, rotation_rad=start.rotation_rad + np.deg2rad(turn))
        best = max(best, search(board, mask, turned), key=lambda found: found.correlation)
        if best.correlation >= CLEAR_CORRELATION:
            break
    if best.correlation >= LEAST_CORRELATION:
        return best
    for how, turned_cells in ORIENTATIONS.items():
        other = replace(mask, cells=np.ascontiguousarray(turned_cells(mask.cells)))
        found = search(board, other, start)
        if found.correlation >= CLEAR_CORRELATION:
            raise CalibrationError(
                f"{board.name}: the mask in the bench is that of the design, but {how} "
                f"(correlation {found.correlation:.2f}, as designed {best.correlation:.2f}): refit "
                "the mask, or turn its pattern in the camera's description"
            )
    raise CalibrationError(
        f"{board.name}: the mask in the bench is not the mask of the design: their best "
        f"correlation is {best.correlation:.2f}, at least {LEAST_CORRELATION} is needed; check the "
        "mask, its pattern's seed and the camera's description, or use calibration method free"
    )


def search(
    board: Board,
    mask: ShadowMask,
    start: Placement,
    reach_um: float = SEARCH_UM,
    crop_px: int = CROP_PX,
) -> Location:
    """Return the start moved to the best shift, and the correlation coefficient there.

        score(shift) = sum of centred reading x shadow(shift)
                       / sqrt(sum of reading^2 x sum of shadow(shift)^2)

    Sums over the usable pixels of all colours, each colour about its own mean; every shift at once
    by FFT, the peak by a parabola. Of a mask that repeats, the place nearest to the start that
    looks so.

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
    # Shifts at which the whole crop lies on what is drawn.
    within = tuple(slice(side - 1, side + 2 * margin) for side in (height, width))
    usable, channels = board.usable[crop], board.channels[crop]
    reading = np.where(usable, board.reading[crop], 0).astype(np.float64)
    product = energy = np.zeros((2 * margin + 1, 2 * margin + 1))
    of_reading = 0.0
    for channel in np.unique(channels[usable]):
        seen = (channels == channel) & usable
        values = reading[seen]
        centred = np.where(seen, reading - values.mean(), 0)
        # A speck or a hot pixel must not outweigh the mask.
        limit = 4 * np.std(centred[seen])
        centred = np.clip(centred, -limit, limit)
        seen_as = np.full(len(pixels), channel, np.uint8)
        drawn = shadow.readings(pixels, seen_as, *board.opening).reshape(y.shape)
        drawn -= drawn[margin:-margin, margin:-margin].mean()
        product = product + convolved(drawn, centred[::-1, ::-1])[within]
        energy = energy + convolved(drawn**2, seen[::-1, ::-1].astype(float))[within]
        of_reading += float((centred**2).sum())
    scores = product / np.sqrt(np.maximum(energy, 1e-12) * max(of_reading, 1e-12))
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
    return Location(moved, float(scores[peak]))


def refine(
    board: Board,
    mask: ShadowMask,
    start: Placement,
    fitted: Sequence[str] = POSE,
    half_px: float = FIRST_HALF_PX,
) -> Location:
    """Return the placement by windows that widen from half a side of `half_px` on, deviations too.

    fitted: parameters of the placement; the others stay. Raises CalibrationError where the shadow
    is not there, or too few pixels are usable.
    """
    rng, whole = np.random.default_rng(0), max(board.reading.shape) / 2
    found = Location(start, 0.0)
    while True:
        half_px = min(half_px, whole)
        sample = board.sampled(half_px, REFINED_PIXELS, rng)
        _require_usable(len(sample.pixels), board)
        found = _fit_window(board, mask, found.placement, sample, fitted)
        if found.correlation < LEAST_CORRELATION:
            raise CalibrationError(
                f"the mask's shadow is not seen (correlation {found.correlation:.2f}, at least "
                f"{LEAST_CORRELATION} is needed): look at a white board, lamp on"
            )
        if half_px == whole:
            return found
        half_px *= 2


def _require_usable(pixels: int, board: Board) -> None:
    """Raise CalibrationError for too few usable pixels."""
    if pixels < FEWEST_PIXELS * len(np.unique(board.channels)):
        raise CalibrationError(
            "hardly any pixel is lit without being saturated: change the exposure"
        )


def _fit_window(
    board: Board, mask: ShadowMask, placement: Placement, sample: Sample, fitted: Sequence[str]
) -> Location:
    """Return the placement after Gauss-Newton steps on one window.

        reading = light(x, y) shadow(placement) + level + noise,   light: a quadratic, by colour

    Light and level are linear in their coefficients and eliminated (variable projection, Golub and
    Pereyra 1973, with Kaufman's simplification): with Q the projection away from them,

        r = Q reading,    J = Q light d(shadow) / d(fitted),    w: Tukey's weights of r
        step = (J^T w J + diag(variance / tolerance^2))^-1 J^T w r,    variance: of r

    The tolerances hold what the shadow does not show, as the place along stripes.
    """
    indices = [SCALARS.index(name) for name in fitted]
    tolerances = Tolerances().deviations(mask.views)[indices]
    deviations, alike = tolerances, 0.0
    y, x = (sample.pixels / board.reading.shape - 0.5).T
    light = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    for _ in range(STEPS):
        seen, slopes = Shadow(mask, placement).with_slopes(
            sample.pixels, sample.channels, *board.opening
        )
        residual, rows = sample.reading.copy(), slopes[:, indices]
        for channel in np.unique(sample.channels):
            of = sample.channels == channel
            basis = np.column_stack([seen[of, None] * light[of], np.ones(int(of.sum()))])
            left = residual[of] - basis @ _least_squares(basis, residual[of])
            weight = tukey_weights(left / (deviation_of(left) + 1e-12))
            explained = _least_squares(basis, residual[of], weight)
            residual[of] -= basis @ explained
            rows[of] *= (light[of] @ explained[:-1])[:, None]
            rows[of] -= basis @ _least_squares(basis, rows[of], weight)
        alike = correlation(sample.reading, sample.reading - residual, sample.channels)
        weight = tukey_weights(residual / (deviation_of(residual) + 1e-12))
        variance = 1e-12 + np.sum(weight * residual**2) / max(np.sum(weight) - len(indices), 1.0)
        matrix = rows.T @ (rows * weight[:, None]) + np.diag(variance / tolerances**2)
        inverse = np.linalg.inv(matrix)
        deviations = MODEL_FACTOR * np.sqrt(np.diag(inverse) * variance)
        step = inverse @ (rows.T @ (weight * residual))
        move = np.zeros(len(placement.vector()))
        move[indices] = step
        placement = placement.moved(move)
        if np.all(np.abs(step) < ENOUGH / MODEL_FACTOR * deviations):
            break
    return Location(placement, alike, dict(zip(fitted, map(float, deviations), strict=True)))


def _least_squares(basis: Array, values: Array, weight: Array | None = None) -> Array:
    weighted = basis if weight is None else basis * weight[:, None]
    return np.linalg.lstsq(weighted.T @ basis, weighted.T @ values, rcond=None)[0]
