"""From a set of whiteboards to Psi: every calibration method asked for, judged by validation."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

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
    HeldOut,
    choose,
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
    mixing,
    other_colours,
)
from emmc_rig.calibration.defects import find_defects, loss_variance
from emmc_rig.calibration.dust import moved_dust
from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.fit import OFFSETS, fit_placement
from emmc_rig.calibration.frames import MeanFrame
from emmc_rig.calibration.levels import Levels, fit_levels
from emmc_rig.calibration.locator import SOFT_EDGES
from emmc_rig.calibration.misfit import Misfit, beyond_chance, combined, measured_misfit
from emmc_rig.calibration.openings import views_open
from emmc_rig.calibration.parametric import (
    Parametric,
    Stages,
    coefficient_plane,
    coefficient_planes,
    of_samples,
    psi_deviation,
    shot_stages,
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

LEAST_LOSS = 1e-5
"""Of a reading, where a defect is in it."""
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
    work = _Work(camera, design, set(routes), held_out, few, pinholes, dict(turned or {}), on_stage)
    work.correct_lamp_and_response()
    work.read_validation()
    if not work.modelled or pinholes is not None:
        work.compare_with_design()
    if work.modelled:
        work.fit_models()
    if {"free", "combined"} & work.routes:
        work.measure_views(empty, on_plane)
    work.count_common_errors()
    chosen, why = work.choose_route()
    if work.crosstalk is not None:
        work.separate_colours(work.crosstalk)
    work.correct_board_and_views(chosen)
    return Outcome(
        chosen,
        why,
        {name: known for name, known in work.calibrations.items() if name in routes},
        {name: held for name, held in work.judged.items() if name in routes},
        work.frames,
        work.models.get("parametric"),
        work.models.get("mixed"),
        work.good,
        tuple(work.advice),
        tuple(work.findings),
        tuple(work.list_unwatched(chosen)),
        work.crosstalk,
    )


@dataclass
class _Work:
    """The whiteboards of a calibration, and the results of its steps.

    sets: every set as captured; the others are as under a steady lamp after
    `correct_lamp_and_response`. good: (pixel_y, pixel_x), pixels to use. judges, seen: held-out
    whiteboards and those that are fitted, as readings. plain: the mask as designed. shadow: of the
    mask as registered or fitted. bare: calibrations of the models without their misfit.
    """

    camera: Camera
    design: PsiLayout
    routes: set[str]
    held_out: BoardSet
    few: BoardSet | None
    pinholes: BoardSet | None
    turned: dict[float, BoardSet]
    on_stage: Callable[[str], None]
    levels: Levels | None = None
    crosstalk: Crosstalk | None = None
    judges: list[Board] = field(default_factory=list)
    seen: list[Board] = field(default_factory=list)
    plain: ShadowMask | None = None
    shadow: Shadow | None = None
    models: dict[str, Parametric] = field(default_factory=dict)
    bare: dict[str, Calibration] = field(default_factory=dict)
    calibrations: dict[str, Calibration] = field(default_factory=dict)
    judged: dict[str, HeldOut] = field(default_factory=dict)
    frames: dict[str, int] = field(default_factory=dict)
    advice: list[str] = field(default_factory=list)
    findings: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.sets = [
            self.held_out, *filter(None, (self.few, self.pinholes)), *self.turned.values()
        ]  # fmt: skip
        refusals.refuse_unfit(self.sets)
        self.good = np.logical_and.reduce([sensor_blemishes(boards) for boards in self.sets])
        self.stages = shot_stages(self.camera)

    @property
    def modelled(self) -> bool:
        """Whether a route asked for fits the mask."""
        return bool({"parametric", "mixed", "combined"} & self.routes)

    @property
    def best_model(self) -> Parametric | None:
        """The mask as fitted, with its defects where they are known."""
        return self.models.get("mixed") or self.models.get("parametric")

    def correct_lamp_and_response(self) -> None:
        """Fit lamp, response and crosstalk, and correct the whiteboards for the former two."""
        channels = channels_of(self.design)
        checks = dict.fromkeys(check for boards in self.sets for check in boards.checks)
        self.levels = fit_levels(list(checks))
        self.findings += words.level_findings(self.levels)
        if self.levels is not None:
            how = self.levels, channels, dict[int, MeanFrame]()
            self.held_out = self.held_out.levelled(*how)
            self.few = self.few and self.few.levelled(*how)
            self.pinholes = self.pinholes and self.pinholes.levelled(*how)
            self.turned = {turn: boards.levelled(*how) for turn, boards in self.turned.items()}
        self.crosstalk = crosstalk(self.held_out, channels, self.good)

    def read_validation(self) -> None:
        """Read the held-out whiteboards."""
        self.judges = as_readings(self.held_out, self.design, self.good)
        if not self.judges:
            raise CalibrationError(
                "no validation whiteboard: capture one more with the aperture open, to judge Psi by"
            )
        for board in self.judges:
            refusals.refuse_without_mask(board)

    def compare_with_design(self) -> None:
        """Register the mask, and fit it where no route does: another mask or board is refused.

        Cameras whose mask is not modelled are not compared. Of the whiteboards through the pinhole
        the middle view and two corners' are enough. Only a fit distinguishes another distance and
        references with less light from whiteboards that every coefficient follows.
        """
        try:
            mask = shadow_mask(self.camera, self.design.size)
        except CalibrationError:
            return
        if self.crosstalk is not None:
            mask = mixing(mask, self.crosstalk.seen)
        v, u = self.camera.views
        wanted = [(v // 2, u // 2), (0, 0), (v - 1, u - 1)]
        boards = self.pinholes or self.held_out
        some = [frame for frame in boards.frames if frame.shot == 0 and frame.pinhole in wanted]
        some.sort(key=lambda frame: wanted.index(frame.pinhole or wanted[0]))
        seen = as_readings(boards.with_frames(some), self.design, self.good)
        placement = refusals.refuse_another_mask(seen or self.judges, self.camera, mask)
        self.shadow = Shadow(mask, placement)
        refusals.refuse_tilted_board(self.shadow, self.judges, REGISTERED_MISS)
        if self.modelled:
            return
        seen = [*seen, *self.judges]
        start = replace(placement, blur_um=SOFT_EDGES * mask.cell_um)
        fit = fit_placement(seen, self.camera, mask, start=start)
        refusals.refuse_odd_fit(fit, seen)
        self.shadow = Shadow(mask, fit.placement)
        refusals.refuse_tilted_board(self.shadow, seen, limits=refusals.FREE_GRADIENT)
        # Smaller differences are left to the measured Psi: few whiteboards do not determine them.
        self.findings += words.mask_findings(fit, ("distance_share", "clear"))

    def fit_models(self) -> None:
        """Fit the mask, its dust and defects, and calibrate by the fits."""
        if self.few is None:
            raise CalibrationError("the calibration method parametric was given no whiteboards")
        self.on_stage("parametric fit")
        self.seen = as_readings(self.few, self.design, self.good)
        for board in self.seen:
            refusals.refuse_without_mask(board)
        self.plain = mask = shadow_mask(self.camera, self.design.size)
        if self.crosstalk is not None:
            mask = mixing(mask, self.crosstalk.seen)
        fit = fit_placement(self.seen, self.camera, mask)
        self.advice += words.fit_advice(fit)
        refusals.refuse_odd_fit(fit, self.seen)
        dusty = moved_dust(Shadow(mask, fit.placement), self.seen)
        if dusty.any():
            self.findings.append(words.dust_finding(dusty))
            self.good = self.good & ~dusty
            self.seen = [board.without(dusty) for board in self.seen]
            self.judges = [board.without(dusty) for board in self.judges]
            fit = fit_placement(self.seen, self.camera, mask, start=fit.placement)
        self.findings += words.hands_findings(fit, self.seen, mask)
        model = self.models["parametric"] = with_misfit(Parametric(fit, mask), self.seen)
        if {"mixed", "combined"} & self.routes and self.design.binning == 1:
            self.on_stage("defects of the mask")
            mixed = _fit_with_defects(self.seen, self.camera, model)
            self.models["mixed"] = with_misfit(mixed, self.seen)
        for name, fitted in self.models.items():
            missed = _missed_at_defects(fitted, [*self.seen, *self.judges])
            model = replace(fitted, of_defects=missed)
            self.on_stage(f"Psi, {name}")
            self.bare[name] = self._calibration_by(model, self.few)
            self.calibrations[name] = _with_misfit_variance(self.bare[name], model)
            self.judged[name] = _judged_model(name, model, self.judges, self.seen)
            self.frames[name] = self.few.exposures
        best = self.models.get("mixed", model)
        self.shadow = best.shadow
        refusals.refuse_tilted_board(self.shadow, [*self.judges, *self.seen])
        self.findings += words.mask_findings(best.fit)
        self.findings += filter(None, [best.mask.repeats.words])

    def _calibration_by(self, model: Parametric, boards: BoardSet) -> Calibration:
        layout = self.design
        psi = model.psi(layout, self.stages)
        # Whiteboards of single views show what the model misses of each; sums, how far they stray.
        astray2 = model.fit.astray2 if model.misfit is None else ()
        covariance = model.fit.covariance
        deviation = psi_deviation(model.shadow, layout, self.stages, covariance, astray2)
        if model.defects is not None and model.defects.count:
            deviation = _with_defect_variance(deviation, model, layout, self.stages)
        white = np.stack([_white_dn_per_s(boards, layout, shot) for shot in range(layout.shots)])
        return Calibration(psi, deviation, boards.dark.mean_dn, white, gain_of(boards), self.good)

    def measure_views(self, empty: NewArray, on_plane: Callable[[str], None]) -> None:
        """Measure every view through the pinhole, and combine that with the model."""
        if self.pinholes is None:
            raise CalibrationError("the calibration method free was given no whiteboards")
        self.on_stage("Psi, free")
        free = replace(measure_psi(self.pinholes, self.design, empty, on_plane), good=self.good)
        best = self.best_model
        if best is not None:
            _correct_pinhole_places(free, best, self.seen, self.design)
        at_first = (b for b in self.judges if b.shot == 0)
        still = next((b for b in at_first if np.allclose(b.stage_um, self.stages[0])), None)
        if still is None:
            raise CalibrationError(
                "the calibration method free is judged by an open whiteboard with the mask where "
                "the first shot has it: capture a validation whiteboard there"
            )
        self._add_measured("free", free, still, self.pinholes)
        if "combined" in self.routes and best is not None and self.few is not None:
            self.on_stage("Psi, combined")
            bare = self.bare.get("mixed") or self.bare["parametric"]
            self._add_measured("combined", combined(free, bare, self.good), still, self.few)

    def _add_measured(self, name: str, known: Calibration, still: Board, boards: BoardSet) -> None:
        """Take up a measured Psi, judged by its sum over the views against an open whiteboard."""
        predicted = predicted_by_psi(known.psi, still)
        variance = prediction_variance(known.deviation, still, self.design.binning)
        self.calibrations[name] = known
        self.judged[name] = worst({"open aperture": judge(name, still, predicted, variance)})
        self.frames[name] = boards.exposures

    def count_common_errors(self) -> None:
        """Add to the deviations what unsteady light and a mask that moves make of every Psi."""
        parametric = self.models.get("parametric")
        for name, known in self.calibrations.items():
            add_error(known, self._unsteady(name))
            if name in ("free", "combined") and parametric is not None and parametric.fit.moved_um:
                # A model's covariance has it.
                covariance = np.zeros_like(parametric.fit.covariance)
                covariance[OFFSETS, OFFSETS] = np.eye(2) * parametric.fit.moved_um**2
                moved = psi_deviation(parametric.shadow, self.design, self.stages, covariance)
                np.sqrt(np.square(known.deviation) + np.square(moved), out=known.deviation)

    def _unsteady(self, route: str) -> float:
        """Return the relative error that shutter and lamp leave in all of a Psi alike.

        Every whiteboard is divided by the references. Their brightness changes from frame to frame,
        as repeats show, by a variance that the number of frames divides; and slowly, as the fit
        shows. A view that is measured through a pinhole has the error of its own frames beside.
        """
        shared = {id(frame): frame for boards in self.sets for frame in boards.references.values()}
        references, dark_dn = list(shared.values()), self.sets[0].dark.mean_dn
        repeats = [(reference.count, reference.unsteady2(dark_dn)) for reference in references]
        fast2, slow2 = unsteadiness2([*self.judges, *self.seen], repeats), 0.0
        if "parametric" in self.models:
            slow2 = self.models["parametric"].fit.brightness_spread ** 2
        spread2 = slow2 + fast2 * float(np.mean([1 / reference.count for reference in references]))
        if route == "free":
            frames = [frame for boards in self.sets for frame in boards.frames if frame.pinhole]
            spread2 += slow2 + fast2 * float(np.mean([1 / frame.count for frame in frames]))
        return float(np.sqrt(spread2))

    def choose_route(self) -> tuple[str, str]:
        """Return the route to use, and why in words."""
        chosen, why = choose([held for name, held in self.judged.items() if name in self.routes])
        refusals.refuse_another_bench(chosen)
        if chosen.chi2 > LARGEST_CHI2:
            missed = float(np.sqrt(max(1 - 1 / chosen.chi2, 0.0))) * chosen.relative_error
            add_error(self.calibrations[chosen.route], missed)
            self.advice.append(words.residual_advice(chosen))
        return chosen.route, why

    def separate_colours(self, seen: Crosstalk) -> None:
        """Give every Psi three colours a pixel."""
        self.findings.append(
            f"the colour filters pass up to {seen.largest:.1%} of the other colours: Psi "
            "has three colours for every pixel"
        )
        if self.plain is None or (best := self.best_model) is None:
            raise CalibrationError(
                "the colour filters pass other colours, and the calibration method free does not "
                "show which: add open whiteboards, for the method parametric"
            )
        others = other_colours(best, self.plain, seen, self.design, self.stages)
        for name, known in self.calibrations.items():
            self.calibrations[name] = in_three_colours(known, others)

    def correct_board_and_views(self, chosen: str) -> None:
        """Take the white board's unevenness out, and count what lamp or board may make of views."""
        board = None
        if self.turned:
            open_boards = {
                turn: as_readings(boards, self.design, self.good)[0]
                for turn, boards in self.turned.items()
            }
            board = board_over_angle(self.calibrations[chosen].psi, open_boards, self.shadow)
            refusals.refuse_uneven_board(board)
            self.findings += words.angle_findings(board)
            if board.uneven:
                for known in self.calibrations.values():
                    take_out(board, known)
        if "parametric" in self.models:
            model = self.models["parametric"]
            leans = leaning(model.fit, model.mask, board)
            self.findings += words.leaning_findings(leans, bool(self.turned))
            for known in self.calibrations.values():
                add_error(known, leans.lopsided)

    def list_unwatched(self, chosen: str) -> list[str]:
        """Return what no whiteboard measured, in words."""
        sets, layout = self.sets, self.design
        lamps = {lamp for boards in sets for _, lamp in boards.references}
        watched = {
            "lamp": any(check.masks_in for boards in sets for check in boards.checks),
            "response": self.levels is not None and self.levels.bend_known,
            "colours": layout.colour is None or layout.binning > 1 or lamps >= set(LAMP_COLOURS),
            "turned": bool(self.turned),
        }
        found = words.unwatched([name for name, known in watched.items() if not known])
        best = self.best_model
        if best is not None and all(board.views_open.all() for board in self.seen):
            stated = self.calibrations[chosen].stated_error
            found.append(words.views_assumed(pinhole_worth(best, self.seen, stated)))
        return found


def _fit_with_defects(seen: Sequence[Board], camera: Camera, parametric: Parametric) -> Parametric:
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


def _judged_model(
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


def _lost_at_aperture_edge(moved_um: tuple[float, float], board: Board, mask: ShadowMask) -> float:
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
        lost = _lost_at_aperture_edge(check.moved_um, board, model.mask)
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
        how = touched, channels, (opened, stages[shot], shot)
        of_losses = loss_variance(model.defects, model.mask, model.fit.placement, *how)
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
