"""From a set of whiteboards to Psi: every calibration method asked for, judged by validation."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.board_angle import add_error, board_over_angle, leaning, take_out
from calibration.boards import (
    Board,
    BoardSet,
    as_readings,
    channels_of,
    gain_of,
    sensor_blemishes,
    unsteadiness2,
)
from calibration.choice import (
    LARGEST_CHI2,
    HeldOut,
    choose,
    judge,
    predicted_by_psi,
    predicted_by_shadow,
    prediction_variance,
    worst,
)
from calibration.colours import Crosstalk, crosstalk, in_three_colours, mixing, other_colours
from calibration.defects import View, find_defects, loss_variance
from calibration.dust import moved_dust
from calibration.errors import CalibrationError
from calibration.findings import (
    angle_findings,
    dust_finding,
    leaning_findings,
    level_findings,
    mask_findings,
    unwatched,
    views_assumed,
)
from calibration.fit import MOST_MORE_BOARDS, OFFSETS, Fit, fit_placement
from calibration.frames import MeanFrame
from calibration.levels import Levels, fit_levels
from calibration.locator import SOFT_EDGES
from calibration.misfit import Misfit, beyond_chance, combined, measured_misfit
from calibration.openings import views_open
from calibration.parametric import (
    Parametric,
    Stages,
    coefficient_plane,
    coefficient_planes,
    of_samples,
    psi_deviation,
    shot_stages,
)
from calibration.planning import pinhole_worth
from calibration.refusals import (
    FREE_GRADIENT,
    refuse_another_bench,
    refuse_another_mask,
    refuse_odd_fit,
    refuse_tilted_board,
    refuse_uneven_board,
    refuse_unfit,
    refuse_without_mask,
)
from calibration.shadow import Shadow, ShadowMask, shadow_mask
from calibration.whiteboard import (
    LAMP_COLOURS,
    Calibration,
    NewArray,
    in_memory,
    lamps_needed,
    measure_psi,
)
from emmc_rig.model.blas import one_blas_thread
from emmc_rig.model.camera import Camera
from emmc_rig.model.sensing import PsiLayout

LARGEST_FLICKER = 0.01
LEAST_LOSS = 1e-5
"""Of a reading, where a defect is in it."""
LARGEST_MOVE_UM = 1.0
FEWEST_FOR_DRIFT, DRIFT_LEAVES = 5, 0.2
"""Whiteboards, and the share of their squared moves that a drift at an even rate leaves."""
REGISTERED_MISS = 3.0
"""Residual of a mask that is registered alone, over that of a fitted mask."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """Psi by every route asked for, how each does on held-out whiteboards, and the choice.

    frames: exposures that each route used. findings: faults of the bench that Psi takes into
    account. advice: measurements to repeat. unwatched: influences that no whiteboard measured, with
    the error they may leave. crosstalk: of the colour filters, where it matters.
    """

    chosen: str
    why: str
    calibrations: Mapping[str, Calibration]
    judged: Mapping[str, HeldOut]
    frames: Mapping[str, int]
    parametric: Parametric | None
    mixed: Parametric | None
    good: NDArray[np.bool_]
    advice: tuple[str, ...]
    findings: tuple[str, ...] = ()
    unwatched: tuple[str, ...] = ()
    crosstalk: Crosstalk | None = None

    @property
    def calibration(self) -> Calibration:
        """The chosen one."""
        return self.calibrations[self.chosen]


@one_blas_thread()
def calibrate(
    camera: Camera,
    design: PsiLayout,
    routes: Sequence[str],
    held_out: BoardSet,
    few: BoardSet | None = None,
    pinholes: BoardSet | None = None,
    on_stage: Callable[[str], None] = lambda name: None,
    turned: Mapping[float, BoardSet] | None = None,
    empty: NewArray = in_memory,
    on_plane: Callable[[str], None] = lambda what: None,
) -> Outcome:
    """Return Psi by the routes named (parametric, mixed, free, combined), and the one to use.

    design, empty, on_plane: of the free route, see `measure_psi`. few: whiteboards for the
    parametric routes. pinholes: for the free one, every view of every shot. held_out: whiteboards
    through the open aperture under a white lamp that no route sees; one at the position of shot 0,
    which the free route can predict. turned: an open whiteboard at that position and its
    references, by the degrees that the board was turned.
    Raises CalibrationError for whatever makes the whiteboards unfit.
    """
    advice: list[str] = []
    turned = turned or {}
    sets = [held_out, *filter(None, (few, pinholes)), *turned.values()]
    refuse_unfit(sets)
    good = np.logical_and.reduce([sensor_blemishes(boards) for boards in sets])
    channels = channels_of(design)
    levels = fit_levels(list(dict.fromkeys(check for boards in sets for check in boards.checks)))
    findings = level_findings(levels)
    if levels is not None:
        how = levels, channels, dict[int, MeanFrame]()
        held_out = held_out.levelled(*how)
        few = None if few is None else few.levelled(*how)
        pinholes = None if pinholes is None else pinholes.levelled(*how)
        turned = {turn: boards.levelled(*how) for turn, boards in turned.items()}
    seen_colours = crosstalk(held_out, channels, good)
    judges = as_readings(held_out, design, good)
    if not judges:
        raise CalibrationError(
            "no validation whiteboard: capture one more with the aperture open, to judge Psi by"
        )
    for board in judges:
        refuse_without_mask(board)
    stage_um = shot_stages(camera)[0]
    modelled = bool({"parametric", "mixed", "combined"} & set(routes))
    shadow: Shadow | None = None
    if not modelled or pinholes is not None:
        boards = pinholes or held_out
        odd, shadow = _unlike_the_design(
            camera, design, boards, judges, good, seen_colours, not modelled
        )
        findings += odd
    calibrations: dict[str, Calibration] = {}
    bare: dict[str, Calibration] = {}
    judged: dict[str, HeldOut] = {}
    frames: dict[str, int] = {}
    parametric = mixed = plain = None
    seen: list[Board] = []
    if modelled:
        if few is None:
            raise CalibrationError("the calibration method parametric was given no whiteboards")
        on_stage("parametric fit")
        seen = as_readings(few, design, good)
        for board in seen:
            refuse_without_mask(board)
        plain = shadow_mask(camera, design.size)
        mask = plain if seen_colours is None else mixing(plain, seen_colours.seen)
        fit = fit_placement(seen, camera, mask)
        advice += fit_advice(fit)
        refuse_odd_fit(fit, seen)
        dusty = moved_dust(Shadow(mask, fit.placement), seen)
        if dusty.any():
            findings.append(dust_finding(dusty))
            good = good & ~dusty
            seen, judges = ([board.without(dusty) for board in some] for some in (seen, judges))
            fit = fit_placement(seen, camera, mask, start=fit.placement)
        findings += _hands_finding(fit, seen, mask)
        parametric = with_misfit(Parametric(fit, mask), seen)
        if {"mixed", "combined"} & set(routes) and design.binning == 1:
            on_stage("defects of the mask")
            mixed = with_misfit(_mixed(seen, camera, parametric), seen)
        for name, model in (("parametric", parametric), ("mixed", mixed)):
            if model is not None:
                model = replace(model, of_defects=_missed_at_defects(model, [*seen, *judges]))
                on_stage(f"Psi, {name}")
                bare[name] = _calibration(model, camera, design, few, good)
                calibrations[name] = _with_misfit_variance(bare[name], model)
                judged[name] = _judged(name, model, judges, seen)
                frames[name] = few.exposures
    best = mixed or parametric
    if best is not None:
        refuse_tilted_board(best.shadow, [*judges, *seen])
        findings += mask_findings(best.fit)
        findings += filter(None, [best.mask.repeats.words])
    if {"free", "combined"} & set(routes):
        if pinholes is None:
            raise CalibrationError("the calibration method free was given no whiteboards")
        on_stage("Psi, free")
        free = replace(measure_psi(pinholes, design, empty, on_plane), good=good)
        if best is not None:
            _correct_pinhole_places(free, best, seen, design)
        calibrations["free"] = free
        at_first = (b for b in judges if b.shot == 0 and np.allclose(b.stage_um, stage_um))
        if (still := next(at_first, None)) is None:
            raise CalibrationError(
                "the calibration method free is judged by an open whiteboard with the mask where "
                "the first shot has it: capture a validation whiteboard there"
            )
        judged["free"] = _judged_measured("free", free, still, design.binning)
        frames["free"] = pinholes.exposures
        if "combined" in routes and best is not None and few is not None:
            on_stage("Psi, combined")
            both = combined(free, bare["mixed" if mixed is not None else "parametric"], good)
            calibrations["combined"] = both
            judged["combined"] = _judged_measured("combined", both, still, design.binning)
            frames["combined"] = few.exposures
    for name, known in calibrations.items():
        add_error(known, _unsteady(name, sets, [*judges, *seen], parametric))
        if name in ("free", "combined") and parametric is not None and parametric.fit.moved_um:
            _add_mask_moves(known, parametric, design, shot_stages(camera))
    chosen, why = choose([judged[name] for name in judged if name in routes])
    refuse_another_bench(chosen)
    if chosen.chi2 > LARGEST_CHI2:
        missed = float(np.sqrt(max(1 - 1 / chosen.chi2, 0.0))) * chosen.relative_error
        add_error(calibrations[chosen.route], missed)
        advice.append(
            f"the validation whiteboards differ from Psi by {chosen.relative_error:.2%} of their "
            f"level: residual {chosen.chi2:.1f} x noise variance, largest of "
            f"{_worst_groups(chosen)}; look at the residual map in the report"
        )
    if seen_colours is not None:
        findings.append(
            f"the colour filters pass up to {seen_colours.largest:.1%} of the other colours: Psi "
            "has three colours for every pixel"
        )
        if plain is None or best is None:
            raise CalibrationError(
                "the colour filters pass other colours, and the calibration method free does not "
                "show which: add open whiteboards, for the method parametric"
            )
        others = other_colours(best, plain, seen_colours, design, shot_stages(camera))
        calibrations = {
            name: in_three_colours(known, others) for name, known in calibrations.items()
        }
    board = None
    if turned:
        open_boards = {turn: as_readings(own, design, good)[0] for turn, own in turned.items()}
        shadow = shadow if best is None else best.shadow
        board = board_over_angle(calibrations[chosen.route].psi, open_boards, shadow)
        refuse_uneven_board(board)
        findings += angle_findings(board)
        if board.uneven:
            for known in calibrations.values():
                take_out(board, known)
    if parametric is not None:
        leans = leaning(parametric.fit, parametric.mask, board)
        findings += leaning_findings(leans, bool(turned))
        for known in calibrations.values():
            add_error(known, leans.lopsided)
    not_known = unwatched(_missing(sets, levels, design, bool(turned)))
    if best is not None and all(board.views_open.all() for board in seen):
        stated = calibrations[chosen.route].stated_error
        not_known.append(views_assumed(pinhole_worth(best, seen, stated)))
    return Outcome(
        chosen.route,
        why,
        {name: known for name, known in calibrations.items() if name in routes},
        {name: held for name, held in judged.items() if name in routes},
        frames,
        parametric,
        mixed,
        good,
        tuple(advice),
        tuple(findings),
        tuple(not_known),
        seen_colours,
    )


def _unsteady(
    route: str, sets: Sequence[BoardSet], boards: Sequence[Board], parametric: Parametric | None
) -> float:
    """Return the relative error that shutter and lamp leave in all of a Psi alike.

    Every whiteboard is divided by the references, which are as unsteady as it is: from frame to
    frame, as repeats show, which their number averages; and slowly, as the fit shows. Of single
    views as measured through a pinhole each has its own beside.
    """
    references = list({id(f): f for boards in sets for f in boards.references.values()}.values())
    dark_dn = sets[0].dark.mean_dn
    fast2 = unsteadiness2(
        boards, [(reference.count, reference.unsteady2(dark_dn)) for reference in references]
    )
    slow2 = 0.0 if parametric is None else parametric.fit.brightness_spread**2
    spread2 = slow2 + fast2 * float(np.mean([1 / reference.count for reference in references]))
    if route == "free":
        pinholes = [frame.count for boards in sets for frame in boards.frames if frame.pinhole]
        spread2 += slow2 + fast2 * float(np.mean([1 / count for count in pinholes]))
    return float(np.sqrt(spread2))


def _missing(
    sets: Sequence[BoardSet], levels: Levels | None, layout: PsiLayout, turned: bool
) -> list[str]:
    """Return what was not watched, by the names of `findings.UNWATCHED`."""
    lamps = {lamp for boards in sets for _, lamp in boards.references}
    coloured = layout.colour is None or layout.binning > 1 or lamps >= set(LAMP_COLOURS)
    seen_again = any(check.masks_in for boards in sets for check in boards.checks)
    watched = {
        "lamp": seen_again,
        "response": levels is not None and levels.bend_known,
        "colours": coloured,
        "turned": turned,
    }
    return [name for name, known in watched.items() if not known]


def _unlike_the_design(
    camera: Camera,
    layout: PsiLayout,
    boards: BoardSet,
    judges: Sequence[Board],
    good: NDArray[np.bool_],
    crosstalk: Crosstalk | None,
    fitted: bool,
) -> tuple[list[str], Shadow | None]:
    """Return what of the mask is off, and its shadow.

    Raises CalibrationError for another mask, or a tilted board. Nothing for cameras whose mask is
    not modelled. Of those through the pinhole the middle view
    and two corners' are enough. fitted: the mask is fitted to these as well, which distinguishes
    another distance and references with less light from whiteboards that every coefficient follows.
    """
    try:
        mask = shadow_mask(camera, layout.size)
    except CalibrationError:
        return [], None
    if crosstalk is not None:
        mask = mixing(mask, crosstalk.seen)
    v, u = camera.views
    wanted = [(v // 2, u // 2), (0, 0), (v - 1, u - 1)]
    some = [frame for frame in boards.frames if frame.shot == 0 and frame.pinhole in wanted]
    some.sort(key=lambda frame: wanted.index(frame.pinhole or wanted[0]))
    seen = as_readings(boards.with_frames(some), layout, good)
    placement = refuse_another_mask(seen or judges, camera, mask)
    refuse_tilted_board(Shadow(mask, placement), judges, REGISTERED_MISS)
    if not fitted:
        return [], Shadow(mask, placement)
    seen = [*seen, *judges]
    start = replace(placement, blur_um=SOFT_EDGES * mask.cell_um)
    fit = fit_placement(seen, camera, mask, start=start)
    refuse_odd_fit(fit, seen)
    refuse_tilted_board(Shadow(mask, fit.placement), seen, limits=FREE_GRADIENT)
    # Smaller differences are left to the measured Psi: few whiteboards do not determine them.
    return mask_findings(fit, ("distance_share", "clear")), Shadow(mask, fit.placement)


def _mixed(seen: Sequence[Board], camera: Camera, parametric: Parametric) -> Parametric:
    """Return the fit with defects: found, and the placement refined with them in the mask."""
    start = parametric.fit.placement
    defects = find_defects(seen, parametric.mask, start)
    if defects.count == 0:
        return Parametric(parametric.fit, parametric.mask, defects)
    fit = fit_placement(seen, camera, defects.mask, start=start)
    return Parametric(fit, parametric.mask, find_defects(seen, parametric.mask, fit.placement))


def with_misfit(model: Parametric, seen: Sequence[Board]) -> Parametric:
    """Return the model with its misfit, from its residuals of whiteboards of few views.

    The misfit of a view is measured on whiteboards that open this view alone, or else on those
    that open the fewest views with it; their views are then taken to err independently. Many pixels
    determine few parameters, so that a board the fit has seen is as good as held out.
    """
    shadow = model.shadow
    found: dict[tuple[int, int], list[tuple[int, Misfit]]] = defaultdict(list)
    of_few = [board for board in seen if not board.views_open.all()]
    if not of_few:
        return model
    misfits = []
    for board in of_few:
        predicted = predicted_by_shadow(shadow, board)
        squares = (board.reading - predicted) ** 2
        misfits.append(measured_misfit(squares, board.variance, predicted, board.usable))
    for board, misfit in zip(of_few, beyond_chance(misfits), strict=True):
        count = int(board.views_open.sum())
        for v, u in np.argwhere(board.views_open).tolist():
            found[v, u].append((count, Misfit(misfit.level / count, misfit.per_slope)))
    every = {}
    for view, several in found.items():
        fewest = min(count for count, _ in several)
        every[view] = max(
            (misfit for count, misfit in several if count == fewest),
            key=lambda misfit: misfit.level,
        )
    # A view that none opens has the largest of the others.
    worst_of = max(every.values(), key=lambda misfit: misfit.level)
    return replace(
        model, misfit={view: every.get(view, worst_of) for view in np.ndindex(shadow.mask.views)}
    )


def _missed_at_defects(model: Parametric, boards: Sequence[Board]) -> float:
    """Return the mean square that whiteboards miss at defects, over that of what defects take.

    Half cells do not draw the outline of a speck. Give it those held out as well: to those fitted
    the losses of the grains are fitted too.
    """
    if model.defects is None or model.defects.count == 0:
        return 0.0
    clean, soiled = Shadow(model.mask, model.fit.placement), model.shadow
    missed = taken = 0.0
    for board in boards:
        predicted = predicted_by_shadow(soiled, board)
        lost = np.abs(predicted - predicted_by_shadow(clean, board)) > LEAST_LOSS
        excess = np.square(board.reading - predicted, dtype=np.float64) - board.variance
        there, elsewhere = (board.usable & chosen for chosen in (lost, ~lost))
        if not there.any() or not elsewhere.any():
            continue
        missed += float(excess[there].sum() - there.sum() * excess[elsewhere].mean())
        where = np.argwhere(there), board.channels[there], board.stage_um, board.shot
        of_views = clean.coefficients(*where) - soiled.coefficients(*where)
        taken += float(np.square(of_views[:, board.views_open]).sum())
    return max(missed / taken, 0.0) if taken > 0 else 0.0


def _judged(
    name: str, model: Parametric, judges: Sequence[Board], seen: Sequence[Board]
) -> HeldOut:
    """Return the worst of the held-out whiteboards and of those that open single views or parts."""
    slow2, fast2 = model.fit.brightness_spread**2, unsteadiness2([*judges, *seen])

    def judged(board: Board) -> HeldOut:
        predicted = predicted_by_shadow(model.shadow, board)
        unsteady2 = slow2 + fast2 / board.repeats
        return judge(name, board, predicted, unsteady=float(np.sqrt(unsteady2)))

    groups = {
        ("open aperture" if i == 0 else "mask moved"): judged(board)
        for i, board in enumerate(judges)
    }
    for board in seen:
        if not board.views_open.all():
            v, u = np.argwhere(board.views_open)[[0, -1]].T
            through = f"view ({v[0]}, {u[0]})"
            if board.views_open.sum() > 1:
                through = f"views ({v[0]}, {u[0]}) to ({v[1]}, {u[1]})"
            groups[through] = judged(board)
    return worst(groups)


def _judged_measured(name: str, known: Calibration, board: Board, binning: int) -> HeldOut:
    """Return how a measured Psi, summed over its views, fits the open whiteboard."""
    predicted = predicted_by_psi(known.psi, board)
    variance = prediction_variance(known.deviation, board, binning)
    return worst({"open aperture": judge(name, board, predicted, variance)})


def _worst_groups(held: HeldOut) -> str:
    order = sorted(held.groups, key=lambda name: -held.groups[name])
    return ", ".join(f"{name} ({held.groups[name]:.1f})" for name in order[:4])


def _light_cut_off(moved_um: tuple[float, float], board: Board, mask: ShadowMask) -> float:
    """Return the share of a single pinhole's light that the aperture's edge keeps from it.

    moved_um: of the mask, as its shadow shows it. What lies beyond the views passes no light: of a
    pinhole pushed outward by d the middle of what is left is d / 2 further. The fit
    takes part of it for another distance: the loss counts in the deviation.
    """
    ratio = mask.distance_um / mask.lens_um
    left = 1.0
    view = np.argwhere(board.views_open)[0].tolist()
    for place, count, moved in zip(view, mask.views, reversed(moved_um), strict=True):
        # A pinhole further out shows the mask further in.
        outward_um = -moved / ratio * (place == count - 1) + moved / ratio * (place == 0)
        left *= 1 - min(max(2 * outward_um / mask.aperture_cell_um, 0.0), 0.5)
    return 1 - left


def _correct_pinhole_places(
    known: Calibration, model: Parametric, seen: Sequence[Board], layout: PsiLayout
) -> None:
    """Take out of a measured Psi that hands put the pinhole a little off.

    Each view changes by what the fitted mask says that the way to its hole changes.
    """
    weights, deviation = known.psi.weights, known.deviation
    shadow = of_samples(model.shadow)
    for check, board in zip(model.fit.boards, seen, strict=True):
        if not (board.loose and board.views_open.sum() == 1):
            continue
        (v, u), (x_um, y_um) = np.argwhere(board.views_open)[0].tolist(), board.stage_um
        off_x, off_y = check.moved_um
        unsure_um = check.moved_deviation_um
        lost = _light_cut_off(check.moved_um, board, model.mask)
        for stored in range(layout.weights_shape[4]):
            place = board.shot, v, u, stored

            def at(x: float, y: float, place: tuple = place) -> NDArray[np.float32]:
                return coefficient_plane(shadow, layout, place, (x, y))

            right = at(x_um, y_um)
            index = board.shot, v, u, slice(None), stored
            weights[index] = weights[index] + right - at(x_um + off_x, y_um + off_y)
            variance = sum(
                np.square(at(x_um + by_x, y_um + by_y) - right)
                for by_x, by_y in ((unsure_um, 0.0), (0.0, unsure_um))
            )
            variance += np.square(lost * right)
            deviation[index] = np.sqrt(deviation[index] ** 2 + variance)


def _hands_finding(fit: Fit, seen: Sequence[Board], mask: ShadowMask) -> list[str]:
    """Return how far hands put pinholes off their holes; nothing where no hand did."""
    loose = [
        float(np.hypot(*check.moved_um)) * mask.lens_um / mask.distance_um
        for check, board in zip(fit.boards, seen, strict=True)
        if board.loose
    ]
    if not loose:
        return []
    return [f"hands put pinholes up to {max(loose):.0f} um off their holes: corrected for"]


def _add_mask_moves(
    known: Calibration, model: Parametric, layout: PsiLayout, stages: Stages
) -> None:
    """Count in a measured Psi's deviation that the mask may stand elsewhere: models have it."""
    covariance = np.zeros_like(model.fit.covariance)
    covariance[OFFSETS, OFFSETS] = np.eye(2) * model.fit.moved_um**2
    moved = psi_deviation(model.shadow, layout, stages, covariance)
    np.sqrt(np.square(known.deviation) + np.square(moved), out=known.deviation)


def _calibration(
    model: Parametric,
    camera: Camera,
    layout: PsiLayout,
    boards: BoardSet,
    good: NDArray[np.bool_],
) -> Calibration:
    stages = shot_stages(camera)
    psi = model.psi(layout, stages)
    # Whiteboards of single views show what the model misses of each; sums, how far they stray.
    astray2 = model.fit.astray2 if model.misfit is None else ()
    deviation = psi_deviation(model.shadow, layout, stages, model.fit.covariance, astray2)
    if model.defects is not None and model.defects.count:
        deviation = _with_defect_variance(deviation, model, layout, stages)
    white = np.stack([_white(boards, layout, shot) for shot in range(layout.shots)])
    return Calibration(psi, deviation, boards.dark.mean_dn, white, gain_of(boards), good)


def _with_defect_variance(
    deviation: NDArray[np.float32], model: Parametric, layout: PsiLayout, stages: Stages
) -> NDArray[np.float32]:
    """Return the deviation of Psi with what is not known of the defects of its mask."""
    assert model.defects is not None
    clean, soiled = (
        coefficient_planes(Shadow(mask, model.fit.placement), layout, stages)
        for mask in (model.mask, model.defects.mask)
    )
    for ((shot, v, u, stored), bare), (_, plane) in zip(clean, soiled, strict=True):
        touched = np.argwhere(bare != plane)
        y, x = touched.T
        opened = views_open(model.mask.views, (v, u))
        channels = np.full(len(touched), stored, dtype=np.uint8)
        if layout.colour is not None:
            channels = layout.colour[shot, y, x]
        seen = View(opened, stages[shot], shot)
        of_losses = loss_variance(
            model.defects, model.mask, model.fit.placement, touched, channels, seen
        )
        of_outline = model.of_defects * np.square(bare - plane)[y, x]
        place = (shot, v, u, y, stored, x)
        more = of_losses / deviation.shape[4] ** 2 + of_outline
        deviation[place] = np.sqrt(np.square(deviation[place]) + more)
    return deviation


def _with_misfit_variance(known: Calibration, model: Parametric) -> Calibration:
    """Return a model's calibration with its misfit in the deviations."""
    if model.misfit is None:
        return known
    deviation = np.square(known.deviation, dtype=np.float64)
    scale = known.psi.weights.shape[4] * known.psi.binning**2
    for shot, v, u, stored in np.ndindex(deviation.shape[:3] + deviation.shape[4:5]):
        plane = known.psi.weights[shot, v, u, :, stored].astype(np.float64) * scale
        deviation[shot, v, u, :, stored] += model.misfit[v, u].variance(plane) / scale**2
    return replace(known, deviation=np.sqrt(deviation).astype(np.float32))


def _white(boards: BoardSet, layout: PsiLayout, shot: int) -> NDArray[np.float32]:
    """Return what a reading of 1 gives in DN per second: all lamp colours together."""
    white = {(shot, "white"), (0, "white")} & set(boards.references)
    lamps = ("white",) if white else lamps_needed(layout)
    total = np.zeros(layout.frames_shape[1:], dtype=np.float64)
    for lamp in lamps:
        reference = boards.references.get((shot, lamp)) or boards.references.get((0, lamp))
        if reference is None:
            raise CalibrationError(f"no reference whiteboard for shot {shot}, {lamp} lamp")
        above = reference.mean_dn - boards.dark_at(reference.exposure_s).mean_dn
        total += above / reference.exposure_s
    return total.astype(np.float32)


def fit_advice(fit: Fit) -> list[str]:
    """Return what the fit says to measure again: flicker, moved stage, too few frames."""
    found = []
    flickering = [
        check
        for check in fit.boards
        if abs(check.brightness - 1) > max(LARGEST_FLICKER, 5 * check.brightness_deviation)
    ]
    if flickering:
        worst_of = max(flickering, key=lambda check: abs(check.brightness - 1))
        others = (
            f" ({len(flickering)} of {len(fit.boards)} whiteboards differ)"
            if len(flickering) > 1
            else ""
        )
        found.append(
            f"{worst_of.name}: {worst_of.brightness - 1:+.1%} in brightness against the other "
            f"whiteboards{others}; the lamp is not steady: let it warm up, and capture it again"
        )
    found += _moves(fit)
    if fit.undecided:
        shown = ", ".join(fit.undecided[:4]) + (" ..." if len(fit.undecided) > 4 else "")
        more = (
            "capture some through a pinhole"
            if fit.more_boards >= MOST_MORE_BOARDS
            else f"capture {fit.more_boards} more of the same kinds, or a few through a pinhole"
        )
        found.append(
            f"too few whiteboards to measure {len(fit.undecided)} parameter(s) ({shown}), which "
            f"keep the design's values: {more}"
        )
    return found


def _moves(fit: Fit) -> list[str]:
    """Return in words that the mask stands elsewhere than the stage says, if that matters."""
    moved = [
        check
        for check in fit.boards
        if np.hypot(*check.moved_um) > max(LARGEST_MOVE_UM, 5 * check.moved_deviation_um)
    ]
    if not moved:
        return []
    worst = max(moved, key=lambda check: float(np.hypot(*check.moved_um)))
    words = (
        f"the mask is not where the stage reports it in {len(moved)} of {len(fit.boards)} "
        f"whiteboards, by up to ({worst.moved_um[0]:+.1f}, {worst.moved_um[1]:+.1f}) um in "
        f"{worst.name}; Psi's deviation includes it: "
    )
    times_s = np.array([check.taken_s for check in fit.boards])
    places_um = np.array([check.moved_um for check in fit.boards])
    times_s, places_um = times_s - times_s.mean(), places_um - places_um.mean(axis=0)
    rate = times_s @ places_um / max(float(times_s @ times_s), 1e-12)
    left = np.square(places_um - times_s[:, None] * rate).sum() / np.square(places_um).sum()
    if len(fit.boards) >= FEWEST_FOR_DRIFT and left < DRIFT_LEAVES:
        per_minute = 60 * float(np.hypot(*rate))
        words += f"it drifts by {per_minute:.2g} um/min; fasten it, let the bench settle"
    else:
        words += "let the stage approach every place from the same side, and settle"
    return [words + ", and capture again"]
