"""What the whiteboards say is wrong with the bench, and what to measure again, in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from emmc_rig.calibration.board_angle import BoardAngle, Leaning
from emmc_rig.calibration.boards import Board
from emmc_rig.calibration.causes import (
    BLUR,
    CREEP,
    EXPOSURE,
    HANDS,
    HOLES,
    LAMP,
    LENS,
    PLATE,
    SIZE,
    STAGE,
    TURN,
    FoundCause,
    through_pinhole,
)
from emmc_rig.calibration.choice import HeldOut
from emmc_rig.calibration.colours import Crosstalk
from emmc_rig.calibration.fit import MOST_MORE_BOARDS, Fit, Power
from emmc_rig.calibration.glare import Glare
from emmc_rig.calibration.levels import Levels
from emmc_rig.calibration.placement import Placement
from emmc_rig.calibration.planning import PinholeWorth
from emmc_rig.calibration.shadow import ShadowMask, openings
from emmc_rig.model.pupil import LEAST_SHARE

Array = NDArray[np.floating]
LARGEST_FLICKER = 0.01
"""Of a whiteboard's brightness against the others: more is named."""
LARGEST_MOVE_UM = 1.0
"""Of the mask from its place: more is named."""
LEAST_HOLES, LEAST_EXPOSURE, LEAST_TURN_DEG = 0.01, 3e-3, 0.2
"""Relative light through a hole, and of all; degrees of the plate: more is named."""
SIGNIFICANT = 5.0
"""Standard deviations, from which on a parameter is named: by chance once in two million."""
LEAST_MOVE_UM = 0.2
NOTEWORTHY = {
    "tilt_x_rad": (
        5e-4,
        "the mask is tilted by {degrees:+.2f} +- {spread_degrees:.2f} degrees in x",
    ),
    "tilt_y_rad": (
        5e-4,
        "the mask is tilted by {degrees:+.2f} +- {spread_degrees:.2f} degrees in y",
    ),
    "bow_um": (1.0, "the mask is bowed by {value:+.1f} +- {spread:.1f} um at the picture's corner"),
    "glass_um": (20.0, "{value:.0f} +- {spread:.0f} um of glass lie between mask and sensor"),
    "clear": (
        0.1,
        "clear cells of the mask let {at:.0%} of the light through: if they should pass more, the "
        "references had more light than the other whiteboards",
    ),
    "distance_share": (
        0.02,
        "the mask's distance differs from the design by {percent:+.1f} %; Psi follows it",
    ),
}
USUAL = Placement()
LEAST_OPEN = 0.995
"""Of every view: a pupil that covers less is not worth a word."""


def mask_findings(fit: Fit, names: Sequence[str] = tuple(NOTEWORTHY)) -> list[str]:
    """Return what of the mask's placement is off, and far outside its deviation."""
    found = []
    for name in names:
        least, words = NOTEWORTHY[name]
        value = getattr(fit.placement, name) - getattr(USUAL, name)
        spread = fit.deviation(name)
        if abs(value) > max(least, SIGNIFICANT * spread):
            found.append(
                words.format(
                    at=getattr(fit.placement, name),
                    value=value,
                    spread=spread,
                    percent=100 * value,
                    degrees=np.degrees(value),
                    spread_degrees=np.degrees(spread),
                )
            )
    return found


def pupil_finding(fit: Fit, mask: ShadowMask) -> list[str]:
    """Return size and centre of pupil and rim, and the views that are less than half open."""
    at = fit.placement
    pupil = at.fitted_pupil()
    if pupil is None or at.pupil is None:
        return []
    opened = openings(mask, at).shares(mask.views)
    alone = replace(at, pupil=at.pupil.model_copy(update={"rim": None}))
    cuts = openings(mask, alone).shares(mask.views).min() <= LEAST_OPEN
    if not cuts and pupil.rim is None:
        return []
    phrases = list[str]()
    if pupil.rim is not None:
        share = fit.deviation("rim_share") / (1 + at.rim_share)
        phrases.append(
            f"a rim of {pupil.rim.diameter_mm:.2f} +- {pupil.rim.diameter_mm * share:.3f} mm cuts "
            f"the views (vignetting); it moves by {pupil.rim.shift:+.2f} +- "
            f"{fit.deviation('rim_shift'):.3f} mm for each mm of the pixel"
        )
    if cuts:
        x_mm, y_mm = pupil.centre_mm
        share = fit.deviation("pupil_share") / (1 + at.pupil_share)
        spread = max(fit.deviation("pupil_x_um"), fit.deviation("pupil_y_um")) / 1e3
        phrases.append(
            f"the lens's {pupil.shape} pupil is {pupil.diameter_mm:.2f} +- "
            f"{pupil.diameter_mm * share:.2f} mm across, its middle at ({x_mm:+.2f}, {y_mm:+.2f}) "
            f"+- {spread:.2f} mm from the middle of the views"
        )
    words = "; ".join(phrases)
    for names, least, most in (
        ("less than half open", LEAST_SHARE, 0.5),
        ("shut", -1, LEAST_SHARE),
    ):
        views = [
            f"({v}, {u})" for v, u in np.argwhere((opened > least) & (opened <= most)).tolist()
        ]
        if views:
            words += f"; {names}: view{'s' * (len(views) > 1)} {', '.join(views)}"
    return [words]


def level_findings(levels: Levels | None) -> list[str]:
    """Return what lamp and response did."""
    if levels is None:
        return []
    found = []
    if levels.drifting:
        found.append(
            f"the lamp drifted by {levels.drift:.2%} (its colours apart by "
            f"{levels.colour_drift:.2%}): corrected for; let it warm up"
        )
    if levels.bent:
        loss = levels.bend_per_dn * levels.brightest_dn
        found.append(
            f"the sensor's response loses {loss:.2%} at {levels.brightest_dn:.0f} DN: corrected for"
        )
    return found


UNWATCHED = {
    "lamp": ("drift of the lamp", "1 % of drift makes Psi 0.6 % wrong", "lamp_checks: 6"),
    "response": (
        "nonlinearity of the sensor",
        "1 % of loss at full well makes Psi 0.2 % wrong",
        "response: [0.25, 0.5, 0.75]",
    ),
    "colours": (
        "crosstalk of the colour filters",
        "1 % of crosstalk makes Psi 1.4 % wrong",
        "colours: 2",
    ),
    "turned": (
        "unevenness of the white board over angle",
        "1 % over the aperture makes Psi 0.25 % wrong",
        "turned: 2",
    ),
}
"""Influences, the error of Psi by each, and the plan's line whose whiteboards measure it: with
lamp, response, colours and the turned board left out of the plan (48x64, 1024 rays) the effects of
these names in `simulators.effects` make Psi 1.27, 0.36, 6.76 and 2.54 % wrong at 2, 1, 5 and 10 %;
an ordinary bench has 0.32 %."""


def unwatched(missing: Sequence[str]) -> list[str]:
    """Return in words the influences that were not measured, and the error of Psi by each."""
    lacking = (UNWATCHED[name] for name in missing)
    return [
        f"not measured: {what} ({cost}); add `{line}` under whiteboards in the plan"
        for what, cost, line in lacking
    ]


def glare_findings(glare: Glare | None) -> list[str]:
    """Return how much of the light is spread over the picture."""
    if glare is None:
        return []
    kinds = ("in front of", glare.in_front), ("behind", glare.behind)
    where = " and ".join(
        f"{share:.2%} {place}" if glare.in_front and glare.behind else place
        for place, share in kinds
        if share
    )
    return [
        f"veiling glare of {glare.total:.2%} +- {glare.deviation:.2%}, {where} the colour filters: "
        "Psi has it as of an even scene; what scatters between mask and sensor (bare metal, glass "
        "without coating, dust on it) can be blackened or cleaned"
    ]


def crosstalk_finding(seen: Crosstalk) -> str:
    """Return what the colour filters pass of other colours."""
    return (
        f"the colour filters pass up to {seen.largest:.1%} of the other colours: Psi "
        "has three colours for every pixel"
    )


def angle_findings(board: BoardAngle) -> list[str]:
    """Return how uneven the white board is over angle, and whether the mask moved meanwhile."""
    found = []
    moved = [
        (turn_deg, float(np.hypot(x, y)), deviation)
        for turn_deg, (x, y, deviation) in board.moved_um.items()
        if np.hypot(x, y) > max(LEAST_MOVE_UM, SIGNIFICANT * deviation)
    ]
    if moved:
        turn_deg, moved_um, deviation = min(moved)
        found.append(
            f"the mask moved by {moved_um:.2f} +- {deviation:.2f} um before the board turned by "
            f"{turn_deg:g} degrees: corrected for; let the mount settle, and capture the turned "
            "boards right after the others"
        )
    if not board.uneven:
        return found
    words = (
        f"the white board is uneven by {np.ptp(board.radiance):.1%} over the directions into the "
        "aperture: corrected for, except for what is symmetric about its normal, which cannot be "
        "measured"
    )
    if board.sense == 0:
        words += (
            "; whether it was turned clockwise is not known, and both are allowed for: turn it by "
            "180 degrees as well"
        )
    elif board.sense < 0:
        words += "; it was turned counterclockwise in the camera's picture"
    return [*found, words]


def leaning_findings(leans: Leaning, turned: bool) -> list[str]:
    """Return what of the views' light may be board or lamp as well as the lens.

    turned: the board was turned, and does not send it.
    """
    found = []
    moved = "capture the whiteboards again with the lamp moved: what stays is the camera's"
    if leans.lopsided.any():
        found.append(
            f"the views' light differs by {np.ptp(leans.lopsided):.1%} from one side of the "
            "aperture to the other, as lenses alone do not do: it may be "
            f"{'the lamp' if turned else 'lamp or board'}, and Psi's deviation includes it; {moved}"
        )
    if leans.falling:
        found.append(
            f"the outermost views have {leans.falling:.1%} less light than the middle one, the "
            "same on every side: taken for the lens's vignetting; a glossy board, or one that does "
            f"not fill the aperture, looks the same: if the lens has less vignetting, {moved}"
        )
    return found


def views_assumed(worth: PinholeWorth) -> str:
    """Return in words what whiteboards of the whole aperture leave to be assumed."""
    v, u = worth.view
    return (
        "not measured: each view alone; the views' shares of the light are those of the design, "
        f"uncertain by {worth.weights:.1%} each, which Psi's deviation includes; expected error of "
        f"Psi {worth.now:.2%}, with one whiteboard through the pinhole before view ({v}, {u}) "
        f"{worth.with_best:.2%}, with one before every view {worth.every:.2%}"
    )


def dust_finding(dusty: NDArray[np.bool_]) -> str:
    """Return in words that pixels, (pixel_y, pixel_x), lie under dust that moved."""
    return (
        f"dust moved on the sensor between references and whiteboards: {int(dusty.sum())} pixels "
        f"({dusty.mean():.1%}) are excluded; clean the sensor, and capture all again"
    )


def residual_advice(held: HeldOut) -> str:
    """Return by how much held-out whiteboards differ from Psi, the worst kinds first."""
    order = sorted(held.groups, key=lambda name: -held.groups[name])
    worst = ", ".join(f"{name} ({held.groups[name]:.1f})" for name in order[:4])
    return (
        f"the validation whiteboards differ from Psi by {held.relative_error:.2%} of their "
        f"level: residual {held.chi2:.1f} x noise variance, largest of {worst}; look at the "
        "residual map in the report"
    )


def fit_advice(fit: Fit, boards: Sequence[Board]) -> list[str]:
    """Return what the fit says to measure again: too few whiteboards.

    boards: those fitted. Pinholes are asked for where some view has no whiteboard of its own.
    """
    if not fit.undecided:
        return []
    shown = ", ".join(fit.undecided[:4]) + (" ..." if len(fit.undecided) > 4 else "")
    alone = np.any([board.views_open for board in boards if through_pinhole(board)], axis=0)
    kinds = [
        *([f"{fit.more_boards} more of the same kinds"] * (fit.more_boards < MOST_MORE_BOARDS)),
        *([] if alone.all() else ["a few through a pinhole"]),
    ]
    more = f"capture {', or '.join(kinds) or 'each with more frames'}"
    return [
        f"too few whiteboards to measure {shown}: Psi takes the value of the camera's file "
        f"instead; {more}"
    ]


def power_advice(power: Power) -> list[str]:
    """Return the line for a response that is not linear; no line for other benches."""
    if not power.sure:
        return []
    return [
        f"the readings follow the light to the power of {1 + power.size:.3f} +- "
        f"{power.deviation:.3f}: the sensor's response is not linear, or its files are not; Psi's "
        "deviation includes it; read linear files, or add `response: [0.25, 0.5, 0.75]` under "
        "whiteboards in the plan and capture again"
    ]


class CauseLines(NamedTuple):
    """Why whiteboards differ, in words, the likeliest first."""

    findings: list[str]
    """What Psi is corrected for."""
    advice: list[str]
    """What to mend, and to capture again."""


def cause_lines(fit: Fit, boards: Sequence[Board], mask: ShadowMask) -> CauseLines:
    """Return the causes for which whiteboards differ, with their size, where it matters.

    boards: those fitted. Causes that fit nearly as well as a named cause are named beside it.
    """
    lines = CauseLines([], [])
    for cause in fit.causes:
        words = _WORDS[cause.name](cause, fit, boards, mask) if cause.name in _WORDS else ""
        if not words:
            continue
        if cause.instead:
            words += "; fits nearly as well: " + ", ".join(SHORT[name] for name in cause.instead)
        (lines.advice if cause.name in (LAMP, STAGE, CREEP) else lines.findings).append(words)
    return lines


SHORT = {
    LAMP: "a lamp that is not steady",
    STAGE: "a mask that is not where the stage reports it",
    CREEP: "a mask that drifts",
    HOLES: "holes of unequal size",
    HANDS: "pinholes off their holes",
    EXPOSURE: "other exposures of the pinhole than noted",
    PLATE: "a plate that stands off its place",
    SIZE: "holes that are not as large as views",
    TURN: "a plate that is turned",
    LENS: "aberrations of the lens",
    BLUR: "views that the lens blurs unlike each other",
}
"""Causes as alternatives are named."""


def _lamp_words(cause: FoundCause, fit: Fit, boards: Sequence[Board], mask: ShadowMask) -> str:
    # Against the others: a level that all share is the references' as well.
    size = np.array(cause.size) - np.median(cause.size)
    large = np.abs(size) > np.maximum(LARGEST_FLICKER, _by_chance(cause, fit))
    flickering = int(large.sum())
    if not flickering:
        return ""
    worst = int(np.argmax(np.abs(size) * large))
    others = f" ({flickering} of {len(boards)} whiteboards differ)" if flickering > 1 else ""
    return (
        f"{boards[worst].name}: {size[worst]:+.1%} in brightness against the other "
        f"whiteboards{others}; the lamp is not steady: let it warm up, and capture it again"
    )


def _by_chance(cause: FoundCause, fit: Fit) -> Array:
    """Return how large coefficients of a cause may be by chance, what the fit misses included."""
    return SIGNIFICANT * max(fit.chi2, 1.0) ** 0.5 * np.array(cause.deviation)


def _holes_words(cause: FoundCause, fit: Fit, boards: Sequence[Board], mask: ShadowMask) -> str:
    sizes = np.abs(cause.size)
    sure = sizes > _by_chance(cause, fit)
    if cause.width < LEAST_HOLES or not sure.any():
        return ""
    few = [board for board in boards if through_pinhole(board)]
    worst = int(np.argmax(sizes * sure))
    return (
        f"the plate's holes are unequal: their areas differ by {cause.width:.1%}, most that of "
        f"{few[worst].name} ({cause.size[worst]:+.1%}): corrected for"
    )


def _size_words(cause: FoundCause, fit: Fit, boards: Sequence[Board], mask: ShadowMask) -> str:
    larger = _share(cause, "larger", "smaller")
    return larger and f"the plate's holes are all {larger} in area than a view: corrected for"


def _exposure_words(cause: FoundCause, fit: Fit, boards: Sequence[Board], mask: ShadowMask) -> str:
    longer = _share(cause, "longer", "shorter")
    return longer and f"the exposures through the pinhole were {longer} than noted: corrected for"


def _share(cause: FoundCause, more: str, less: str) -> str:
    """Return the single coefficient of a cause and its deviation; "" if it is small or chance."""
    share, deviation = cause.size[0], cause.deviation[0]
    if abs(share) < max(LEAST_EXPOSURE, SIGNIFICANT * deviation):
        return ""
    return f"{abs(share):.1%} +- {deviation:.1%} {more if share > 0 else less}"


def _hands_words(cause: FoundCause, fit: Fit, boards: Sequence[Board], mask: ShadowMask) -> str:
    off_um = np.hypot(*np.reshape(cause.size, (-1, 2)).T)
    if off_um.max(initial=0.0) * mask.distance_um / mask.lens_um < LEAST_MOVE_UM:
        return ""
    return f"pinholes stand up to {off_um.max():.0f} um off their holes: corrected for"


def _plate_words(cause: FoundCause, fit: Fit, boards: Sequence[Board], mask: ShadowMask) -> str:
    x_um, y_um = cause.size
    if np.hypot(x_um, y_um) * mask.distance_um / mask.lens_um < LEAST_MOVE_UM:
        return ""
    return (
        f"the plate stands ({x_um:+.0f}, {y_um:+.0f}) +- {max(cause.deviation):.0f} um off its "
        "place: corrected for"
    )


def _turn_words(cause: FoundCause, fit: Fit, boards: Sequence[Board], mask: ShadowMask) -> str:
    turn_deg, deviation_deg = np.degrees(cause.size[0]), np.degrees(cause.deviation[0])
    if abs(turn_deg) < max(LEAST_TURN_DEG, SIGNIFICANT * deviation_deg):
        return ""
    return (
        f"the plate is turned by {turn_deg:+.2f} +- {deviation_deg:.2f} degrees against the views: "
        "corrected for"
    )


def _creep_words(cause: FoundCause, fit: Fit, boards: Sequence[Board], mask: ShadowMask) -> str:
    far_um = float(np.hypot(*cause.size))
    if far_um < max(LARGEST_MOVE_UM, SIGNIFICANT * max(cause.deviation)):
        return ""
    minutes = float(np.ptp([check.taken_s for check in fit.boards])) / 60
    return (
        f"the mask is not where the stage reports it: it drifts by {far_um / minutes:.2g} um/min, "
        f"({cause.size[0]:+.1f}, {cause.size[1]:+.1f}) um over the whiteboards; Psi's deviation "
        "includes it: fasten it, let the bench settle, and capture again"
    )


def _stage_words(cause: FoundCause, fit: Fit, boards: Sequence[Board], mask: ShadowMask) -> str:
    moves_um, deviations_um = (
        np.reshape(values, (2, -1)).T for values in (cause.size, cause.deviation)
    )
    far_um = np.hypot(*moves_um.T)
    moved = far_um > np.maximum(LARGEST_MOVE_UM, 5 * deviations_um.max(axis=1))
    if not moved.any():
        return ""
    worst = int(np.argmax(far_um))
    return (
        f"the mask is not where the stage reports it in {int(moved.sum())} of {len(boards)} "
        f"whiteboards, by up to ({moves_um[worst, 0]:+.1f}, {moves_um[worst, 1]:+.1f}) um in "
        f"{boards[worst].name}; Psi's deviation includes it: let the stage approach every place "
        "from the same side, and settle, and capture again"
    )


def _lens_words(cause: FoundCause, fit: Fit, boards: Sequence[Board], mask: ShadowMask) -> str:
    if cause.width < LEAST_MOVE_UM:
        return ""
    return (
        f"aberrations of the lens displace the shadows of the views by {cause.width:.1f} um (root "
        "mean square): the deviation of the fitted Psi includes them, and whiteboards through the "
        "pinhole before every view measure them"
    )


_WORDS = {
    LAMP: _lamp_words,
    HOLES: _holes_words,
    EXPOSURE: _exposure_words,
    HANDS: _hands_words,
    PLATE: _plate_words,
    SIZE: _size_words,
    TURN: _turn_words,
    CREEP: _creep_words,
    STAGE: _stage_words,
    LENS: _lens_words,
}
