"""From a set of whiteboards to Psi: every calibration method asked for, judged by validation."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from emmc_rig.calibration import findings as words
from emmc_rig.calibration import refusals
from emmc_rig.calibration.board_angle import add_error, board_over_angle, leaning, take_out
from emmc_rig.calibration.boards import (
    Board,
    BoardSet,
    as_readings,
    channels_of,
    gain_of,
    sensor_blemishes,
    unsteadiness2,
)
from emmc_rig.calibration.choice import (
    LARGEST_CHI2,
    OPEN,
    HeldOut,
    choose,
    explain,
    judge,
    predicted_by_psi,
    predicted_by_shadow,
    prediction_variance,
    worst,
)
from emmc_rig.calibration.colours import (
    Crosstalk,
    crosstalk,
    in_three_colours,
    lamp_shares,
    mixing,
    other_colours,
)
from emmc_rig.calibration.defects import find_defects, moved_dust
from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.fit import OFFSETS, SIDES, Fit, fit_placement, settled
from emmc_rig.calibration.frames import MeanFrame
from emmc_rig.calibration.glare import STEP as GLARE_STEP
from emmc_rig.calibration.glare import Glare, measure_glare
from emmc_rig.calibration.levels import Levels, fit_levels
from emmc_rig.calibration.locator import SOFT_EDGES
from emmc_rig.calibration.misfit import Misfit, beyond_chance, combined, measured_misfit
from emmc_rig.calibration.parametric import (
    Parametric,
    Stages,
    coefficient_plane,
    of_samples,
    psi_deviation,
    shot_stages,
    widening_planes,
)
from emmc_rig.calibration.planning import pinhole_worth
from emmc_rig.calibration.shadow import Shadow, ShadowMask, shadow_mask
from emmc_rig.calibration.whiteboard import (
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

GLARE_ROUNDS = 2
"""Fits without the glare, which is then measured again: what is left of 1 % is linear to 1e-4."""
REGISTERED_MISS = 3.0
"""Residual of a mask that is registered alone, over that of a fitted mask."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """Psi by every route asked for, how each does on held-out whiteboards, and the choice.

    frames: exposures that each route used. findings: faults of the bench that Psi takes into
    account. whiteboard: through the fewest and most central views of those read, the mask's shadow.
    advice: measurements to repeat. unwatched: influences that no whiteboard measured, with
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
    whiteboard: Board
    findings: tuple[str, ...] = ()
    unwatched: tuple[str, ...] = ()
    crosstalk: Crosstalk | None = None

    @property
    def calibration(self) -> Calibration:
        """Psi by the route chosen."""
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
    captured = _Whiteboards(held_out, few, pinholes, dict(turned or {}))
    refusals.refuse_unfit(captured.sets)
    good = np.logical_and.reduce([sensor_blemishes(boards) for boards in captured.sets])
    steady, levels = _correct_lamp_and_response(captured, design)
    task = _Task(
        camera=camera,
        design=design,
        routes=frozenset(routes),
        stages=shot_stages(camera),
        captured=captured,
        steady=steady,
        crosstalk=crosstalk(steady.held_out, channels_of(design), good),
        on_stage=on_stage,
    )
    readings = _Readings(good, _validation_readings(steady.held_out, design, good), [])
    advice, findings = [], words.level_findings(levels)
    shadow, modelled = None, _Modelled(readings, None)
    if not task.modelled or pinholes is not None:
        compared = _compare_with_design(task, readings)
        shadow, task = compared.shadow, replace(task, crosstalk=compared.crosstalk)
        findings += compared.findings
    if task.modelled:
        modelled = _fit_models(task, readings)
        readings, shadow = modelled.readings, modelled.shadow
        task = replace(task, crosstalk=modelled.crosstalk)
        advice += modelled.advice
        findings += modelled.findings
    psis = dict(modelled.psis)
    if {"free", "combined"} & task.routes:
        psis |= _measure_views(task, modelled, empty, on_plane)
    _count_common_errors(task, modelled, psis)
    judged = {name: psi.judged for name, psi in psis.items() if name in routes}
    stated = {name: psi.calibration.stated_error for name, psi in psis.items()}
    chosen = choose(list(judged.values()), stated)
    refusals.refuse_another_bench(chosen)
    if modelled.best is not None and not (levels is not None and levels.bend_known):
        powers = [model.fit.power for model in modelled.models.values()]
        power = max(powers, key=lambda power: power.explained)
        advice[:0] = words.power_advice(power)
        for psi in psis.values() if power.sure else ():
            add_error(psi.calibration, power.error)
    advice += _count_residual(chosen, psis[chosen.route].calibration)
    calibrations = {name: psi.calibration for name, psi in psis.items()}
    if task.crosstalk is not None:
        findings.append(words.crosstalk_finding(task.crosstalk))
        calibrations = _separate_colours(task, modelled, task.crosstalk, calibrations)
    findings += _correct_board_and_views(task, modelled, shadow, calibrations, chosen.route)
    return Outcome(
        chosen=chosen.route,
        why=explain(chosen, calibrations[chosen.route].stated_error),
        calibrations={name: known for name, known in calibrations.items() if name in routes},
        judged=judged,
        frames={name: psi.exposures for name, psi in psis.items()},
        parametric=modelled.models.get("parametric"),
        mixed=modelled.models.get("mixed"),
        good=readings.good,
        advice=tuple(advice),
        whiteboard=min([*readings.seen, *readings.judges], key=_opening_around_centre),
        findings=tuple(findings),
        unwatched=tuple(_list_unwatched(task, modelled, levels, calibrations[chosen.route])),
        crosstalk=task.crosstalk,
    )


def _opening_around_centre(board: Board) -> tuple[int, float, int]:
    """Return how many views a whiteboard opens, how far from the centre they lie, and its shot."""
    away = np.argwhere(board.views_open) - (np.array(board.views_open.shape) - 1) / 2
    return len(away), float(np.square(away).sum()), board.shot


@dataclass(frozen=True, eq=False)
class _Whiteboards:
    """The sets of whiteboards of a calibration, see `calibrate`."""

    held_out: BoardSet
    few: BoardSet | None
    pinholes: BoardSet | None
    turned: Mapping[float, BoardSet]

    @property
    def sets(self) -> list[BoardSet]:
        """All sets."""
        return [
            self.held_out, *filter(None, (self.few, self.pinholes)), *self.turned.values()
        ]  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Task:
    """What every step of a calibration needs, and none changes.

    captured, steady: the whiteboards as captured, and as under a steady lamp and a straight
    response. stages: (x, y) of the mask in um, per shot. crosstalk: None for negligible crosstalk.
    """

    camera: Camera
    design: PsiLayout
    routes: frozenset[str]
    stages: Stages
    captured: _Whiteboards
    steady: _Whiteboards
    crosstalk: Crosstalk | None
    on_stage: Callable[[str], None]

    @property
    def modelled(self) -> bool:
        """Whether a route asked for fits the mask."""
        return bool({"parametric", "mixed", "combined"} & self.routes)

    def as_filtered(self, mask: ShadowMask) -> ShadowMask:
        """Return the mask as the pixels see it through their colour filters."""
        return mask if self.crosstalk is None else mixing(mask, self.crosstalk.seen)


@dataclass(frozen=True, eq=False)
class _Readings:
    """Whiteboards as readings, and the pixels to use.

    good: (pixel_y, pixel_x). judges: held out. seen: for the models' fits.
    """

    good: NDArray[np.bool_]
    judges: list[Board]
    seen: list[Board]

    def without(self, pixels: NDArray[np.bool_]) -> _Readings:
        """Return the same without these pixels, (pixel_y, pixel_x)."""
        judges, seen = (
            [board.without(pixels) for board in boards] for boards in (self.judges, self.seen)
        )
        return _Readings(self.good & ~pixels, judges, seen)


class _RoutePsi(NamedTuple):
    """Psi by one route."""

    calibration: Calibration
    judged: HeldOut
    exposures: int
    """Frames that the route used."""


@dataclass(frozen=True, eq=False)
class _Modelled:
    """The fits of the mask, by the routes that model it.

    plain: the mask as designed. models: by route (parametric, mixed). bare: their calibrations
    without the misfit in the deviations. psis: with it. crosstalk: of the colour filters, without
    glare, which is in all Psi.
    """

    readings: _Readings
    plain: ShadowMask | None
    models: Mapping[str, Parametric] = field(default_factory=dict)
    bare: Mapping[str, Calibration] = field(default_factory=dict)
    psis: Mapping[str, _RoutePsi] = field(default_factory=dict)
    advice: Sequence[str] = ()
    findings: Sequence[str] = ()
    crosstalk: Crosstalk | None = None
    glare: Glare | None = None

    @property
    def best(self) -> Parametric | None:
        """The mask as fitted, with its defects where they are known."""
        return self.models.get("mixed") or self.models.get("parametric")

    @property
    def shadow(self) -> Shadow | None:
        """That of the best."""
        return None if self.best is None else self.best.shadow


def _correct_lamp_and_response(
    captured: _Whiteboards, design: PsiLayout
) -> tuple[_Whiteboards, Levels | None]:
    """Return the whiteboards as under a steady lamp and a straight response, and what these did."""
    levels = fit_levels(list(dict.fromkeys(c for boards in captured.sets for c in boards.checks)))
    if levels is None:
        return captured, None
    how = levels, channels_of(design), dict[int, MeanFrame]()
    steady = _Whiteboards(
        captured.held_out.levelled(*how),
        captured.few and captured.few.levelled(*how),
        captured.pinholes and captured.pinholes.levelled(*how),
        {turn: boards.levelled(*how) for turn, boards in captured.turned.items()},
    )
    return steady, levels


def _validation_readings(
    held_out: BoardSet, design: PsiLayout, good: NDArray[np.bool_]
) -> list[Board]:
    judges = as_readings(held_out, design, good)
    if not judges:
        raise CalibrationError(
            "no validation whiteboard: capture one more with the aperture open, to judge Psi by"
        )
    for board in judges:
        refusals.refuse_without_mask(board)
    return judges


class _Compared(NamedTuple):
    """What the comparison of whiteboards with the designed mask shows."""

    shadow: Shadow | None
    findings: list[str]
    crosstalk: Crosstalk | None
    """Of the colour filters, without glare."""


def _compare_with_design(task: _Task, readings: _Readings) -> _Compared:
    """Return the registered mask's shadow and findings; another mask or board is refused.

    Where no route fits the mask it is fitted here: only a fit distinguishes another distance and
    references with less light from whiteboards that every coefficient follows. Cameras whose mask
    is not modelled are not compared. Of the whiteboards through the pinhole the middle view and two
    corners' are enough.
    """
    try:
        plain = shadow_mask(task.camera, task.design.size)
    except CalibrationError:
        return _Compared(None, [], task.crosstalk)
    mask = task.as_filtered(plain)
    v, u = task.camera.views
    wanted = [(v // 2, u // 2), (0, 0), (v - 1, u - 1)]
    boards = task.steady.pinholes or task.steady.held_out
    some = [frame for frame in boards.frames if frame.shot == 0 and frame.pinhole in wanted]
    some.sort(key=lambda frame: wanted.index(frame.pinhole or wanted[0]))
    seen = as_readings(boards.with_frames(some), task.design, readings.good)
    placement = refusals.refuse_another_mask(seen or readings.judges, task.camera, mask)
    shadow = Shadow(mask, placement)
    refusals.refuse_tilted_board(shadow, readings.judges, REGISTERED_MISS)
    if task.modelled:
        return _Compared(shadow, [], task.crosstalk)
    seen = [*seen, *readings.judges]
    start = replace(placement, blur_um=SOFT_EDGES * mask.cell_um)
    fit = fit_placement(seen, task.camera, mask, start=start)
    refusals.refuse_odd_fit(fit, seen, mask)
    shadow = Shadow(mask, fit.placement)
    refusals.refuse_tilted_board(shadow, seen, limits=refusals.FREE_GRADIENT)
    # Every coefficient is measured with its glare, which is no crosstalk of coloured references.
    glare = None if task.crosstalk is None else _glare(task, plain, mask, fit, seen)
    if glare is not None:
        task, _ = _without_glare(task, readings, glare)
    # Smaller differences are left to the measured Psi: few whiteboards do not determine them.
    found = words.mask_findings(fit, ("distance_share", "clear"))
    return _Compared(shadow, [*words.glare_findings(glare), *found], task.crosstalk)


def _fit_models(task: _Task, readings: _Readings) -> _Modelled:
    """Return the fits of the mask, its dust and defects, and Psi by them."""
    few = task.steady.few
    if few is None:
        raise CalibrationError(
            "the calibration method parametric needs open whiteboards, and there are none: "
            "capture some"
        )
    task.on_stage("parametric fit")
    readings = replace(readings, seen=as_readings(few, task.design, readings.good))
    for board in readings.seen:
        refusals.refuse_without_mask(board)
    plain = shadow_mask(task.camera, task.design.size)
    mask = task.as_filtered(plain)
    fit = fit_placement(readings.seen, task.camera, mask)
    with_glare, glare = readings, _glare(task, plain, mask, fit, readings.seen)
    for _ in range(0 if glare is None else GLARE_ROUNDS):
        assert glare is not None
        task, readings = _without_glare(task, with_glare, glare)
        mask = task.as_filtered(plain)
        fit = fit_placement(readings.seen, task.camera, mask, start=fit)
        glare = _glare(task, plain, mask, fit, readings.seen, glare) or glare
    refusals.refuse_odd_fit(fit, readings.seen, mask)
    advice, findings = words.fit_advice(fit, readings.seen), words.glare_findings(glare)
    dusty = moved_dust(Shadow(mask, fit.placement), settled(fit, readings.seen, mask))
    if dusty.any():
        findings.append(words.dust_finding(dusty))
        readings, with_glare = readings.without(dusty), with_glare.without(dusty)
        fit = fit_placement(readings.seen, task.camera, mask, start=fit)
    of_causes = words.cause_lines(fit, readings.seen, mask)
    findings, advice = [*of_causes.findings, *findings], [*of_causes.advice, *advice]
    seen = settled(fit, readings.seen, mask)
    models = {"parametric": with_misfit(Parametric(fit, mask), seen)}
    if {"mixed", "combined"} & task.routes and task.design.binning == 1:
        task.on_stage("defects of the mask")
        mixed = _fit_with_defects(readings.seen, task.camera, models["parametric"])
        models["mixed"] = with_misfit(mixed, seen)
    bare, psis = {}, {}
    for name, model in models.items():
        task.on_stage(f"Psi, {name}")
        bare[name] = _calibration_by(model, task, few, readings.good)
        if glare is not None:
            bare[name] = _with_glare(bare[name], model, task, glare)
        psis[name] = _RoutePsi(
            _with_misfit_variance(bare[name], model),
            _judged_model(name, model, readings.judges, seen),
            few.exposures,
        )
    best = models.get("mixed", models["parametric"])
    refusals.refuse_tilted_board(best.shadow, [*readings.judges, *readings.seen])
    findings += words.pupil_finding(best.fit, best.mask)
    findings += words.mask_findings(best.fit)
    findings += filter(None, [best.mask.repeats.words])
    return _Modelled(with_glare, plain, models, bare, psis, advice, findings, task.crosstalk, glare)


def _glare(
    task: _Task,
    plain: ShadowMask,
    mask: ShadowMask,
    fit: Fit,
    seen: Sequence[Board],
    known: Glare | None = None,
) -> Glare | None:
    """Return the glare that the whiteboards fitted show; plain: the mask as designed.

    known: was taken out of them.
    """
    filters, good = channels_of(task.design), np.logical_and.reduce([b.usable for b in seen])
    of_lamps, taken_out = (task.steady.held_out, filters, good), known.behind if known else 0.0
    shares = lamp_shares(*of_lamps, taken_out)

    def masks(behind: float) -> ShadowMask:
        local = lamp_shares(*of_lamps, taken_out + behind)
        # However little it is: what glare and crosstalk sum to is known.
        return mask if local is None else mixing(plain, local.seen)

    others = None
    if shares is None and filters.max() < len(LAMP_COLOURS):
        others = mixing(mask, np.eye(3) + GLARE_STEP * (0.5 - 1.5 * np.eye(3)))
    white = _white_dn_per_s(task.steady.few or task.steady.held_out, task.design, 0)
    boards = settled(fit, seen, mask)
    return measure_glare(fit.placement, boards, white, filters, masks, others, known)


def _without_glare(task: _Task, readings: _Readings, glare: Glare) -> tuple[_Task, _Readings]:
    """Return the readings as they would be without glare, and the crosstalk."""
    judges, seen = (
        [glare.taken_out(board) for board in boards] for boards in (readings.judges, readings.seen)
    )
    how = task.steady.held_out, glare.filters, readings.good, glare.behind
    return replace(task, crosstalk=crosstalk(*how)), replace(readings, judges=judges, seen=seen)


def _with_glare(known: Calibration, model: Parametric, task: _Task, glare: Glare) -> Calibration:
    """Return a model's calibration with the glare in Psi and in the deviations.

    The placement fitted depends on the glare: Psi varies by both together.
    """
    binning = task.design.binning

    def psi_with(step: NDArray[np.float64]) -> NDArray[np.float32]:
        placement = model.fit.placement.moved(glare.response @ step)
        moved = replace(model, fit=replace(model.fit, placement=placement))
        return glare.changed(step).put_in(moved.psi(task.design, task.stages).weights, binning)

    weights = glare.put_in(known.psi.weights, binning)
    variance = np.square(known.deviation, dtype=np.float64)
    values, vectors = np.linalg.eigh(glare.covariance)
    for value, direction in zip(values, vectors.T, strict=True):
        if value > 0:
            variance += np.square(psi_with(np.sqrt(value) * direction) - weights)
    deviation = np.sqrt(variance).astype(np.float32)
    return replace(known, psi=replace(known.psi, weights=weights), deviation=deviation)


def _calibration_by(
    model: Parametric, task: _Task, boards: BoardSet, good: NDArray[np.bool_]
) -> Calibration:
    """Return Psi by a model, the deviations without its misfit."""
    layout = task.design
    psi = model.psi(layout, task.stages)
    # Whiteboards of single views show what the model misses of each; sums, how far they stray.
    astray2 = model.fit.astray2 if model.misfit is None else ()
    covariance = model.fit.covariance
    deviation = psi_deviation(model.shadow, layout, task.stages, covariance, astray2)
    white = np.stack([_white_dn_per_s(boards, layout, shot) for shot in range(layout.shots)])
    return Calibration(psi, deviation, boards.dark.mean_dn, white, gain_of(boards), good)


def _measure_views(
    task: _Task, modelled: _Modelled, empty: NewArray, on_plane: Callable[[str], None]
) -> dict[str, _RoutePsi]:
    """Return Psi with every view measured through the pinhole, and combined with the model's.

    Judged by its sum over the views against an open whiteboard.
    """
    pinholes, few, readings = task.steady.pinholes, task.steady.few, modelled.readings
    if pinholes is None:
        raise CalibrationError(
            "the calibration method free needs whiteboards of every view, and there are "
            "none: capture them"
        )
    task.on_stage("Psi, free")
    free = replace(measure_psi(pinholes, task.design, empty, on_plane), good=readings.good)
    if modelled.best is not None and modelled.best.fit.causes:
        _correct_pinholes(free, modelled.best, readings.seen, task.design)
    still = _board_of_first_shot(task, readings)
    if still is None:
        raise CalibrationError(
            "the calibration method free is judged by an open whiteboard with the mask where "
            "the first shot has it: capture a validation whiteboard there"
        )

    def judged(name: str, known: Calibration, boards: BoardSet) -> _RoutePsi:
        predicted = predicted_by_psi(known.psi, still)
        variance = prediction_variance(known.deviation, still, task.design.binning)
        held = worst({OPEN: judge(name, still, predicted, variance)})
        return _RoutePsi(known, held, boards.exposures)

    psis = {"free": judged("free", free, pinholes)}
    if "combined" in task.routes and modelled.best is not None and few is not None:
        task.on_stage("Psi, combined")
        bare = modelled.bare.get("mixed") or modelled.bare["parametric"]
        psis["combined"] = judged("combined", combined(free, bare, readings.good), few)
    return psis


def _count_common_errors(task: _Task, modelled: _Modelled, psis: Mapping[str, _RoutePsi]) -> None:
    """Add to the deviations, in place, what unsteady light and a mask that moves leave in Psi."""
    parametric = modelled.models.get("parametric")
    for name, psi in psis.items():
        known = psi.calibration
        add_error(known, _unsteady(task, modelled, name))
        if name in ("free", "combined") and parametric is not None and parametric.fit.moved_um:
            # A model's covariance has it.
            covariance = np.zeros_like(parametric.fit.covariance)
            covariance[OFFSETS, OFFSETS] = np.eye(2) * parametric.fit.moved_um**2
            moved = psi_deviation(parametric.shadow, task.design, task.stages, covariance)
            np.sqrt(np.square(known.deviation) + np.square(moved), out=known.deviation)


def _unsteady(task: _Task, modelled: _Modelled, route: str) -> float:
    """Return the relative error that shutter and lamp leave in all of a Psi alike.

    Every whiteboard is divided by the references. Their brightness changes from frame to frame,
    as repeats show, by a variance that the number of frames divides; and slowly, as the fit
    shows. A view that is measured through a pinhole has the error of its own frames beside.
    """
    sets, readings = task.captured.sets, modelled.readings
    shared = {id(frame): frame for boards in sets for frame in boards.references.values()}
    references, dark_dn = list(shared.values()), sets[0].dark.mean_dn
    repeats = [(reference.count, reference.unsteady2(dark_dn)) for reference in references]
    fast2, slow2 = unsteadiness2([*readings.judges, *readings.seen], repeats), 0.0
    if "parametric" in modelled.models:
        slow2 = modelled.models["parametric"].fit.brightness_spread ** 2
    spread2 = slow2 + fast2 * float(np.mean([1 / reference.count for reference in references]))
    corrected = modelled.best is not None and modelled.best.fit.causes
    if route == "free" and not corrected:
        frames = [frame for boards in sets for frame in boards.frames if frame.pinhole]
        spread2 += slow2 + fast2 * float(np.mean([1 / frame.count for frame in frames]))
    return float(np.sqrt(spread2))


def _count_residual(chosen: HeldOut, known: Calibration) -> list[str]:
    """Add a large residual to the deviations of the route chosen, in place; return the advice."""
    if chosen.chi2 <= LARGEST_CHI2:
        return []
    missed = float(np.sqrt(max(1 - 1 / chosen.chi2, 0.0))) * chosen.relative_error
    add_error(known, missed)
    return [words.residual_advice(chosen)]


def _separate_colours(
    task: _Task, modelled: _Modelled, seen: Crosstalk, calibrations: Mapping[str, Calibration]
) -> dict[str, Calibration]:
    """Return every Psi with three colours a pixel."""
    if modelled.plain is None or modelled.best is None:
        raise CalibrationError(
            "the colour filters pass other colours, and the calibration method free does not "
            "show which: add open whiteboards, for the method parametric"
        )
    how = seen, task.design, task.stages, modelled.glare
    others = other_colours(modelled.best, modelled.plain, *how)
    return {name: in_three_colours(known, others) for name, known in calibrations.items()}


def _board_of_first_shot(task: _Task, readings: _Readings) -> Board | None:
    """Return the open validation whiteboard with the mask where the first shot has it."""
    at_first = (board for board in readings.judges if board.shot == 0)
    return next((b for b in at_first if np.allclose(b.stage_um, task.stages[0])), None)


def _correct_board_and_views(
    task: _Task,
    modelled: _Modelled,
    shadow: Shadow | None,
    calibrations: Mapping[str, Calibration],
    chosen: str,
) -> list[str]:
    """Take the white board's unevenness out of every Psi, in place, and return the findings.

    The deviations take up what lamp or board may make of the views.
    """
    findings, board, turned = list[str](), None, task.steady.turned
    if turned:
        open_boards = {
            turn: as_readings(boards, task.design, modelled.readings.good)[0]
            for turn, boards in turned.items()
        }
        if (upright := _board_of_first_shot(task, modelled.readings)) is not None:
            open_boards[0.0] = upright
        board = board_over_angle(calibrations[chosen].psi, open_boards, shadow)
        refusals.refuse_uneven_board(board)
        findings += words.angle_findings(board)
        if board.uneven:
            for known in calibrations.values():
                take_out(board, known)
    if "parametric" in modelled.models:
        model = modelled.models["parametric"]
        leans = leaning(model.fit, model.mask, board)
        findings += words.leaning_findings(leans, bool(turned))
        for known in calibrations.values():
            add_error(known, leans.lopsided)
    return findings


def _list_unwatched(
    task: _Task, modelled: _Modelled, levels: Levels | None, chosen: Calibration
) -> list[str]:
    """Return what no whiteboard measured, in words."""
    sets, layout, seen = task.captured.sets, task.design, modelled.readings.seen
    lamps = {lamp for boards in sets for _, lamp in boards.references}
    watched = {
        "lamp": any(check.masks_in for boards in sets for check in boards.checks),
        "response": levels is not None and levels.bend_known,
        "colours": layout.colour is None or layout.binning > 1 or lamps >= set(LAMP_COLOURS),
        "turned": bool(task.captured.turned),
    }
    unwatched = words.unwatched([name for name, known in watched.items() if not known])
    if modelled.best is not None and all(board.views_open.all() for board in seen):
        worth = pinhole_worth(modelled.best, seen, chosen.stated_error)
        unwatched.append(words.views_assumed(worth))
    return unwatched


def _fit_with_defects(seen: Sequence[Board], camera: Camera, parametric: Parametric) -> Parametric:
    """Return the fit with defects: found, and the placement refined with them in the mask."""
    settled_boards = settled(parametric.fit, seen, parametric.mask)
    defects = find_defects(settled_boards, parametric.mask, parametric.fit.placement)
    if defects.count == 0:
        return Parametric(parametric.fit, parametric.mask, defects)
    fit = fit_placement(seen, camera, defects.mask, start=parametric.fit)
    again = find_defects(settled(fit, seen, parametric.mask), parametric.mask, fit.placement)
    return Parametric(fit, parametric.mask, again)


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


def _judged_model(
    name: str, model: Parametric, judges: Sequence[Board], seen: Sequence[Board]
) -> HeldOut:
    """Return the worst of the held-out whiteboards and of those that open single views or parts."""
    slow2, fast2 = model.fit.brightness_spread**2, unsteadiness2([*judges, *seen])

    def judged(board: Board) -> HeldOut:
        predicted = predicted_by_shadow(model.shadow, board)
        unsteady2 = slow2 + fast2 / board.repeats
        return judge(name, board, predicted, unsteady=float(np.sqrt(unsteady2)))

    groups = {(OPEN if i == 0 else "mask moved"): judged(board) for i, board in enumerate(judges)}
    for board in seen:
        if not board.views_open.all():
            v, u = np.argwhere(board.views_open)[[0, -1]].T
            through = f"view ({v[0]}, {u[0]})"
            if board.views_open.sum() > 1:
                through = f"views ({v[0]}, {u[0]}) to ({v[1]}, {u[1]})"
            groups[through] = judged(board)
    return worst(groups)


def _correct_pinholes(
    known: Calibration, model: Parametric, seen: Sequence[Board], layout: PsiLayout
) -> None:
    """Take out of a measured Psi what the causes made of the whiteboards through the pinhole.

    Each view is divided by the brightness of its whiteboard, and changes by what the fitted mask
    says that the way to its hole changes.
    """
    weights, deviation = known.psi.weights, known.deviation
    shadow = of_samples(model.shadow)
    pinholes = (
        (board, own, unsure)
        for board, own, unsure in zip(seen, model.fit.own, model.fit.own_deviation, strict=True)
        if board.views_open.sum() == 1
    )
    for board, own, deviations in pinholes:
        brighter, off_x, off_y = own[:3].tolist()
        unsure, unsure_x, unsure_y = deviations[:3].tolist()
        (v, u), (x_um, y_um) = np.argwhere(board.views_open)[0].tolist(), board.stage_um
        for stored in range(layout.weights_shape[4]):
            place = board.shot, v, u, stored

            def at(x: float, y: float, place: tuple = place) -> NDArray[np.float32]:
                return coefficient_plane(shadow, layout, place, (x, y))

            right = at(x_um, y_um)
            index = board.shot, v, u, slice(None), stored
            there = (x_um + off_x, y_um + off_y)
            through, *by_sides = widening_planes(shadow, layout, place, there, own[SIDES])
            moved = right - through
            weights[index] = weights[index] / (1 + brighter) + moved
            variance = sum(
                np.square(at(x_um + by_x, y_um + by_y) - right)
                for by_x, by_y in ((unsure_x, 0.0), (0.0, unsure_y))
            )
            variance += np.square(unsure * right)
            variance += np.tensordot(np.square(deviations[SIDES]), np.square(by_sides), 1)
            deviation[index] = np.sqrt(deviation[index] ** 2 + variance)


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


def _white_dn_per_s(boards: BoardSet, layout: PsiLayout, shot: int) -> NDArray[np.float32]:
    """Return what a reading of 1 gives in DN per second: all lamp colours together."""
    white = {(shot, "white"), (0, "white")} & set(boards.references)
    lamps = ("white",) if white else lamps_needed(layout)
    total = np.zeros(layout.frames_shape[1:], dtype=np.float64)
    for lamp in lamps:
        reference = boards.reference(shot, lamp)
        if reference is None:
            raise CalibrationError(f"no reference whiteboard for shot {shot}, {lamp} lamp")
        above = reference.mean_dn - boards.dark_at(reference.exposure_s).mean_dn
        total += above / reference.exposure_s
    return total.astype(np.float32)
