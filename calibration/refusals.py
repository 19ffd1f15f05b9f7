"""Refusals of whiteboards that are unfit for a Psi: CalibrationErrors that name the remedy.

Saturated, dark, lit darks, without the mask, of another camera, of a bench or a board that moved.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from emmc_rig.calibration.board_angle import BoardAngle
from emmc_rig.calibration.boards import Board, BoardSet, Sample, lit_boards
from emmc_rig.calibration.causes import CREEP, OF_PLATE, through_pinhole
from emmc_rig.calibration.choice import HeldOut
from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.fit import Fit
from emmc_rig.calibration.frames import MeanFrame
from emmc_rig.calibration.locator import ORIENTATIONS, register
from emmc_rig.calibration.openings import views_open
from emmc_rig.calibration.placement import SCALARS, Placement, Tolerances, designed_placement
from emmc_rig.calibration.robust import correlation, deviation_of
from emmc_rig.calibration.shadow import Shadow, ShadowMask
from emmc_rig.calibration.whiteboard import DARKEST_REFERENCE_DN
from emmc_rig.model.camera import Camera

Array = NDArray[np.floating]
BRIGHTEST_MASK = 0.95
"""No mask that codes lets nearly all light through everywhere."""
LEAST_CONTRAST = 0.6
"""Of a mask's dark cells over its clear ones through one view; without it falloff leaves 0.9."""
LEAST_GAIN_SHARE = 0.5
"""Of the noise per DN that other frames have: a full pixel is without shot noise."""
PLATEAU_WIDTH, PLATEAU_SHARE = 0.3, 0.03
"""Deviations of shot noise about the brightest pixels, and the share of pixels there: of normal
noise it is below 0.01."""
LARGEST_LEAK = 0.01
"""Of a whiteboard's light in a dark frame; the dark current of a hot sensor is a tenth of it."""
LARGEST_MISS = 0.08
"""Of a held-out whiteboard's level; a bench of 64 rays, the grainiest that was tried, has 4 %, with
3x3 views of 32x40 samples 6 %."""
BRIGHTNESS_DIFFERS = 0.05
CUT_BRIGHTNESS = 0.6
"""By which a pinhole off its hole may be darker: half of it lies beyond the aperture."""
ALIKE_BRIGHTNESS, ALIKE_UM = 0.2, 5.0
"""Differences between whiteboards with the mask in one place: lamps flicker, masks creep."""
CLEAREST = 1.05
"""What clear cells let through, of no mask; beyond 1 only by the fit's error."""
BRIGHTEST_VIEWS = 1.12
"""The same of the middle view and the corners' on average, whose falloff is not fitted."""
UNLIKELY = 4.0
"""Times the tolerances of the fit."""
LARGEST_GRADIENT = {True: 0.03, False: 0.1}
"""Over the picture, of the open aperture and of one view, whose falloff is but modelled."""
FREE_GRADIENT = {True: 0.015, False: 0.1}
"""The same of the free route, whose whiteboards are many: benches within tolerances have
at most 0.003 with the aperture open. Small pictures of few whiteboards show 0.02."""
LARGEST_UNEVENNESS = 0.25
"""Of the white board over angle: more is a tilted board."""
LARGEST_DISAGREEMENT = 0.005
SURE = 5.0
"""Standard deviations, from which on a difference is no chance."""
MANY_OUTLIERS = 0.1
"""Share of a whiteboard's pixels: noise has 0.001, dust less than a tenth."""
UNEXPLAINED = 4.0
"""Mean squared residual of a whiteboard over the noise, from which on its view is checked."""
MIRRORED = 0.02
"""By which the views in another order must correlate better with the design's."""
SAMPLED, SAMPLED_GRADIENT = 3_000, 200_000
"""Pixels that distinguish whiteboards' views, and brightness over the picture."""


def refuse_unfit(sets: Sequence[BoardSet]) -> None:
    """Raise CalibrationError for darks that are lit, and for frames dark or saturated."""
    for boards in sets:
        _refuse_lit_darks(boards)
        for (_, lamp), frame in boards.references.items():
            above = _above_dn(frame, boards)
            brightest = max(np.median(above[y::2, x::2]) for y, x in np.ndindex(2, 2))
            if float(brightest) < DARKEST_REFERENCE_DN:
                raise CalibrationError(
                    f"the reference whiteboard under the {lamp} lamp is less than "
                    f"{DARKEST_REFERENCE_DN:g} DN above the dark: is the lamp on? If it is, "
                    "brighten it or expose longer"
                )
        for _ in lit_boards(boards):
            pass
        _refuse_saturated(boards)


def _refuse_lit_darks(boards: BoardSet) -> None:
    first, last = boards.dark, max(boards.darks, key=lambda frame: frame.exposure_s)
    reference = boards.references.get((0, "white"))
    if reference is None or last.exposure_s == first.exposure_s:
        return
    seconds = last.exposure_s - first.exposure_s
    rate = float(np.median(last.mean_dn) - np.median(first.mean_dn)) / seconds
    black = float(np.median(first.mean_dn)) - rate * first.exposure_s
    lit = (float(np.median(reference.mean_dn)) - black) / reference.exposure_s
    if rate * last.exposure_s > DARKEST_REFERENCE_DN and rate > LARGEST_LEAK * lit:
        raise CalibrationError(
            f"the dark frames have {rate / lit:.0%} of the whiteboard's light: switch the lamp off "
            "and cover the camera for darks, and capture them again"
        )


def _refuse_saturated(boards: BoardSet) -> None:
    """Raise CalibrationError for frames that are saturated below the white level."""

    def lit() -> Iterator[tuple[str, MeanFrame]]:
        for (_, lamp), frame in boards.references.items():
            yield f"the reference whiteboard, {lamp} lamp", frame
        for board in boards.frames:
            frame = board.frame
            if np.mean(_above_dn(frame, boards)) > DARKEST_REFERENCE_DN:
                yield board.name, frame

    gains = {name: _gain(frame, boards) for name, frame in lit() if frame.count > 1}
    if not gains:
        return
    typical = float(np.median(list(gains.values())))
    for number, (name, frame) in enumerate(lit()):
        less = gains.get(name, typical) < LEAST_GAIN_SHARE * typical
        flat = _plateau(_above_dn(frame, boards), typical, frame.count) > PLATEAU_SHARE
        if less and not flat and number < len(boards.references):
            raise CalibrationError(
                f"{name}: saturated below the white level, or the mask moves from frame to frame: "
                "this one has less than half the noise of frames with the mask in, of the same "
                f"light; shorten the exposure ({frame.exposure_s:g} s) or dim the lamp, or fasten "
                "the mask and let the bench settle"
            )
        if less or flat:
            raise CalibrationError(
                f"{name}: saturated below the white level, its brightest pixels have less noise "
                f"than their light makes; shorten the exposure ({frame.exposure_s:g} s) or dim the "
                "lamp"
            )


def _above_dn(frame: MeanFrame, boards: BoardSet) -> Array:
    return frame.mean_dn - boards.dark_at(frame.exposure_s).mean_dn


def _gain(frame: MeanFrame, boards: BoardSet) -> float:
    """Return the noise's variance per DN of light."""
    dark_dn = boards.dark_at(frame.exposure_s).mean_dn
    light = float(np.mean(frame.mean_dn - dark_dn))
    return (frame.noise_dn2(dark_dn) - boards.dark.variance_dn2) / light


def _plateau(above_dn: Array, gain: float, count: int) -> float:
    """Return the share of pixels that are as bright as the brightest, to far below shot noise."""
    top = float(np.percentile(above_dn, 99.5))
    noise = float(np.sqrt(max(gain * top, 1e-9) / count))
    return float(np.mean(np.abs(above_dn - top) < PLATEAU_WIDTH * noise))


def refuse_without_mask(board: Board) -> None:
    """Raise CalibrationError for a whiteboard that reads as if no mask were in the beam."""
    readings = board.reading[board.usable]
    if readings.size == 0:
        return
    if board.views_open.all():
        bare = np.percentile(readings, 2) > BRIGHTEST_MASK
    else:
        each = [readings[board.channels[board.usable] == c] for c in np.unique(board.channels)]
        ends = [np.percentile(colour, (2, 98)) for colour in each if colour.size]
        dark, clear = np.mean(ends, axis=0)
        bare = board.views_open.sum() == 1 and dark > LEAST_CONTRAST * clear
    if bare:
        raise CalibrationError(
            f"{board.name}: it reads {np.median(readings):.2f} of the whiteboard without masks, "
            "and no pixel much less than another: is the mask in the beam?"
        )


def refuse_another_mask(boards: Iterable[Board], camera: Camera, mask: ShadowMask) -> Placement:
    """Return where the mask is registered; raises CalibrationError where it is not the design's.

    boards: the first is registered; of those of single views the order is checked.
    """
    rng = np.random.default_rng(0)
    own, others, clearest = [], [], []
    shadow = None
    for board in boards:
        refuse_without_mask(board)
        if shadow is None:
            shadow = Shadow(mask, register(board, mask, designed_placement(camera)).placement)
        if board.views_open.sum() > 1:
            continue
        # Of the light that the pupil, as described, leaves to this view.
        share = float(shadow.opened[board.views_open][0] / shadow.opened.sum())
        clearest.append(np.percentile(board.reading[board.usable], 98) / share)
        sample = board.sampled(np.inf, SAMPLED, rng)
        own.append(_correlation(sample, shadow, board.views_open))
        opened = board.views_open[None, :, :, None]
        orders = (turned(opened)[0, :, :, 0] for turned in ORIENTATIONS.values())
        own_shape = board.views_open.shape
        others.append(
            [_correlation(sample, shadow, o) if o.shape == own_shape else -1.0 for o in orders]
        )
    assert shadow is not None
    if own:
        # A middle view alone is brighter where a round pupil shuts others.
        if len(clearest) > 1 and np.mean(clearest) > BRIGHTEST_VIEWS:
            _raise_dim_references(float(np.mean(clearest)))
        means = np.mean(others, axis=0)
        if means.max() > np.mean(own) + MIRRORED:
            order = list(ORIENTATIONS)[int(np.argmax(means))]
            raise CalibrationError(
                "the views are not those that the whiteboards are named for: they are "
                f"{order}; check the axes of the aperture's stage"
            )
    return shadow.placement


def _correlation(sample: Sample, shadow: Shadow, opened: NDArray[np.bool_]) -> float:
    how = sample.pixels, sample.channels, opened, sample.board.stage_um, sample.board.shot
    return correlation(sample.reading, shadow.readings(*how), sample.channels)


def _raise_dim_references(clear: float) -> None:
    raise CalibrationError(
        f"the mask would let {clear:.2f} times as much light through as no mask: the references "
        "were taken with less light, or not through the whole aperture; capture all whiteboards "
        "again, in one go"
    )


def refuse_odd_fit(fit: Fit, boards: Sequence[Board], mask: ShadowMask) -> None:
    """Raise CalibrationError for a fit that no bench has, and for whiteboards unlike the others."""
    at = fit.placement
    _refuse_wrong_holes(fit, boards, mask)
    if at.clear > max(CLEAREST, 1 + SURE * fit.deviation("clear")):
        _raise_dim_references(at.clear)
    usual = Placement(aperture=at.aperture).vector()[: len(SCALARS)]
    off = (at.vector()[: len(SCALARS)] - usual) / Tolerances().deviations((1, 1))[: len(SCALARS)]
    worst = int(np.argmax(np.abs(off)))
    if abs(off[worst]) > UNLIKELY:
        raise CalibrationError(
            f"the fitted mask has {SCALARS[worst]} {getattr(at, SCALARS[worst]):.4g}, "
            f"{abs(off[worst]):.1f} times as far from the design as benches are: these whiteboards "
            "are of another camera or mask, or its description is wrong"
        )
    creep = next((cause for cause in fit.causes if cause.name == CREEP), None)
    if creep is not None and np.hypot(*creep.size) > ALIKE_UM:
        raise CalibrationError(
            f"the mask drifts: by ({creep.size[0]:+.1f}, {creep.size[1]:+.1f}) um over the "
            "whiteboards, or it moved between them; fasten it, let the bench settle, and capture "
            "all again, in one go"
        )
    # Where the plate explains what pinholes show, the mask has not moved.
    off_plate = any(cause.name in OF_PLATE for cause in fit.causes)
    half_hole_um = mask.aperture_cell_um * mask.distance_um / mask.lens_um / 2
    for check, board in zip(fit.boards, boards, strict=True):
        alike = sum(np.allclose(board.stage_um, other.stage_um) for other in boards) > 1
        moved_um = float(np.hypot(*check.moved_um))
        alike_to = CUT_BRIGHTNESS if off_plate and through_pinhole(board) else ALIKE_BRIGHTNESS
        if abs(check.brightness - 1) > max(alike_to, SURE * check.brightness_deviation):
            raise CalibrationError(
                f"{check.name}: {check.brightness:.2f} times as bright as the others suggest: was "
                "the aperture where it should be, the mask in the beam, and the lamp the same? "
                "Capture it again"
            )
        if off_plate and through_pinhole(board):
            if moved_um > max(half_hole_um, ALIKE_UM):
                off_um = moved_um / mask.distance_um * mask.lens_um
                raise CalibrationError(
                    f"{check.name}: the pinhole stands {off_um:.0f} um off its hole, half a hole "
                    "or more: put it on its hole and capture this whiteboard again; if the mask "
                    "moved instead, capture all again"
                )
        elif alike and moved_um > max(ALIKE_UM, SURE * check.moved_deviation_um):
            raise CalibrationError(
                f"{check.name}: the mask stands {moved_um:.1f} um from where the others have it: "
                "it moved between them, or this one is of another day; capture all again, in one go"
            )


def _refuse_wrong_holes(fit: Fit, boards: Sequence[Board], mask: ShadowMask) -> None:
    """Raise CalibrationError for a whiteboard that shows the shadow through another hole."""
    shadow, rng = Shadow(mask, fit.placement), np.random.default_rng(0)
    quarter_um = mask.aperture_cell_um * mask.distance_um / mask.lens_um / 4
    for check, board in zip(fit.boards, boards, strict=True):
        usual = np.hypot(*check.moved_um) < quarter_um and check.outliers < MANY_OUTLIERS
        usual = usual and check.chi2 < UNEXPLAINED
        if board.views_open.sum() != 1 or usual:
            continue
        sample = board.sampled(np.inf, SAMPLED, rng)
        alike = {
            view: _correlation(sample, shadow, views_open(mask.views, view))
            for view in np.ndindex(*mask.views)
        }
        named, shown = np.argwhere(board.views_open)[0].tolist(), max(alike, key=lambda v: alike[v])
        if alike[shown] > alike[tuple(named)] + MIRRORED:
            raise CalibrationError(
                f"{check.name}: it shows the shadow through the hole of view {shown}: the pinhole "
                "was in the wrong hole, or the whiteboard is named for the wrong view; capture it "
                "again, or correct its name; if the mask moved instead, capture all again"
            )


def refuse_tilted_board(
    shadow: Shadow,
    boards: Sequence[Board],
    model: float = 1.0,
    limits: Mapping[bool, float] = LARGEST_GRADIENT,
) -> None:
    """Raise CalibrationError where brightness changes over the picture against the references.

    model: how much rougher the shadow is than a fitted one. limits: of the change, by whether
    the whole aperture is open.
    """
    for board in boards:
        across, deviation = _fit_gradient(shadow, board)
        limit = model * limits[bool(board.views_open.all())]
        worst = int(np.argmax(np.abs(across)))
        # Refused unless it is within the limit to its deviation.
        if abs(across[worst]) > max(limit - deviation, SURE * deviation):
            raise CalibrationError(
                f"{board.name}: its brightness against the reference changes by "
                f"{abs(across[worst]):.0%} from {('top to bottom', 'left to right')[worst]}: the "
                "white board was tilted or shaded, or the lamp moved, between the two; capture "
                "all whiteboards again, in one go"
            )


def _fit_gradient(shadow: Shadow, board: Board) -> tuple[Array, float]:
    """Return by how much a whiteboard's brightness changes down and across, and the deviation.

        reading = shadow (level_colour + down (y / rows - 1/2) + across (x / columns - 1/2)) + noise

    Relative to the level; outliers beyond four deviations are left out.
    """
    sample = board.sampled(np.inf, SAMPLED_GRADIENT, np.random.default_rng(0))
    (rows, columns), (y, x), channels = board.reading.shape, sample.pixels.T, sample.channels
    at = shadow.readings(sample.pixels, channels, *board.opening)
    levels = [np.where(channels == c, at, 0) for c in np.unique(channels)]
    terms = np.stack([at * (y / rows - 0.5), at * (x / columns - 0.5), *levels], axis=1)
    value = sample.reading
    keep = np.ones(len(value), dtype=bool)
    for _ in range(3):
        normal = terms[keep].T @ terms[keep] + 1e-12 * np.eye(terms.shape[1])
        found = np.linalg.solve(normal, terms[keep].T @ value[keep])
        left = value - terms @ found
        keep = np.abs(left) < 4 * deviation_of(left) + 1e-12
    level = float(np.mean(found[2:]))
    spread = float(np.std(left[keep])) * float(np.sqrt(np.linalg.inv(normal)[:2, :2].max()))
    return found[:2] / level, spread / level


def refuse_uneven_board(board: BoardAngle) -> None:
    """Raise CalibrationError for a white board that is far from even over angle."""
    uneven = float(np.ptp(board.radiance))
    apart, deviations = board.disagreement
    if apart > LARGEST_DISAGREEMENT and deviations > SURE:
        raise CalibrationError(
            f"the turned white boards contradict each other by {apart:.1%}: no board turned in its "
            "plane does so; the lamp changed, or the board was tilted: fasten both, turn the board "
            "in its plane only, and capture the turned boards again"
        )
    if board.uneven and uneven > LARGEST_UNEVENNESS:
        raise CalibrationError(
            f"the white board is uneven by {uneven:.0%} over the directions into the aperture: it "
            "is tilted, glossy or lit from one side, or other whiteboards are of another day; "
            "face it to the camera, light it evenly and capture all again"
        )


def refuse_another_bench(chosen: HeldOut) -> None:
    """Raise CalibrationError where a whiteboard is of another bench than the Psi of the others."""
    if chosen.relative_error <= LARGEST_MISS:
        return
    why = "the mask, the lens or the camera moved between them, or it is of another day or camera"
    if abs(chosen.brightness - 1) > BRIGHTNESS_DIFFERS:
        why = (
            f"it is {chosen.brightness:.2f} times as bright as the others suggest: was the "
            "aperture wholly open, and the lamp the same?"
        )
    name = max(chosen.groups, key=lambda group: chosen.groups[group])
    raise CalibrationError(
        f"a whiteboard ({name}) differs from the Psi of the others by "
        f"{chosen.relative_error:.0%} of its level: {why}; capture all whiteboards again, in one go"
    )
