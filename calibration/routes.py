"""From a set of whiteboards to Psi: every route asked for, judged on whiteboards held out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.boards import Board, BoardSet, as_readings, gain_of, sensor_blemishes
from calibration.choice import (
    HeldOut,
    choose,
    judge,
    predicted_by_psi,
    predicted_by_shadow,
    prediction_variance,
)
from calibration.defects import Defects, find_defects
from calibration.errors import CalibrationError
from calibration.fit import MOST_MORE, Fit, FitSettings, fit_placement
from calibration.parametric import Stages, psi_at, psi_deviation, shot_stages
from calibration.placement import Tolerances
from calibration.shadow import Shadow, ShadowMask, shadow_mask
from calibration.whiteboard import Calibration, lamps_needed, measure_psi
from emmc_rig.model.camera import Camera
from emmc_rig.model.sensing import ImagingMatrix

MOST_PIXELS_WITH_DEVIATION = 2_000_000
LARGEST_FLICKER = 0.01
LARGEST_MOVE_UM = 1.0


@dataclass(frozen=True, eq=False)
class Parametric:
    """What the parametric routes know of the bench: fit and mask, with its defects if sought."""

    fit: Fit
    mask: ShadowMask
    defects: Defects | None = None

    @property
    def shadow(self) -> Shadow:
        """The shadow as fitted."""
        return Shadow(self.mask if self.defects is None else self.defects.mask, self.fit.placement)

    def psi(self, design: ImagingMatrix, stages: Stages) -> ImagingMatrix:
        """Return Psi with the mask stage at `stages`, (x, y) in um per shot."""
        return psi_at(self.shadow, design.layout, stages)


@dataclass(frozen=True, eq=False)
class Outcome:
    """Psi by every route asked for, how each does on the held-out whiteboards, and the choice.

    frames: exposures that each route used. advice: what to measure again.
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

    @property
    def calibration(self) -> Calibration:
        """The chosen one."""
        return self.calibrations[self.chosen]


def calibrate(
    camera: Camera,
    design: ImagingMatrix,
    routes: Sequence[str],
    held_out: BoardSet,
    few: BoardSet | None = None,
    pinholes: BoardSet | None = None,
    fit_settings: FitSettings | None = None,
    tolerances: Tolerances | None = None,
    on_stage: Callable[[str], None] = lambda name: None,
) -> Outcome:
    """Return Psi by the routes named (parametric, mixed, free), and the one to use.

    few: whiteboards for the parametric routes. pinholes: for the free one, every view of every
    shot. held_out: whiteboards through the open aperture under a white lamp that no route sees;
    the first at the position of shot 0, which the free route can predict. Raises
    CalibrationError for whatever makes the whiteboards unfit.
    """
    calibrations: dict[str, Calibration] = {}
    judged: dict[str, HeldOut] = {}
    frames: dict[str, int] = {}
    advice: list[str] = []
    good = sensor_blemishes(held_out)
    for boards in (few, pinholes):
        if boards is not None:
            good &= sensor_blemishes(boards)
    judges = as_readings(held_out, design.layout, good)
    if not judges:
        raise CalibrationError("no held-out whiteboard: keep one, with the aperture open")
    parametric = mixed = None
    if {"parametric", "mixed"} & set(routes):
        if few is None:
            raise CalibrationError("the parametric route was given no whiteboards")
        on_stage("parametric fit")
        seen = as_readings(few, design.layout, good)
        mask = shadow_mask(camera, design.size)
        fit = fit_placement(seen, camera, mask, fit_settings, tolerances)
        advice += fit_advice(fit)
        parametric = Parametric(fit, mask)
        if "mixed" in routes:
            on_stage("defects of the mask")
            mixed = _mixed(seen, camera, parametric, fit_settings, tolerances)
        for name, one in (("parametric", parametric), ("mixed", mixed)):
            if one is not None and name in routes:
                on_stage(f"Psi, {name}")
                calibrations[name] = _calibration(one, camera, design, few, good)
                judged[name] = _judged(name, one.shadow, judges)
                frames[name] = few.exposures
    if "free" in routes:
        if pinholes is None:
            raise CalibrationError("the free route was given no whiteboards")
        on_stage("Psi, free")
        free = measure_psi(pinholes.pinholes(), design)
        calibrations["free"] = replace(free, good=good)
        first = judges[0]
        predicted = predicted_by_psi(free.psi, first)
        variance = prediction_variance(free.deviation, first, design.binning)
        judged["free"] = judge("free", first, predicted, variance)
        frames["free"] = pinholes.exposures
    chosen, why = choose([judged[name] for name in routes if name in judged])
    if chosen.chi2 > 4:
        advice.append(
            f"the held-out whiteboard differs from the chosen Psi by {chosen.chi2:.1f} times the "
            "noise: look at its residual map, and measure Psi by the free route"
        )
    return Outcome(
        chosen.route, why, calibrations, judged, frames, parametric, mixed, good, tuple(advice)
    )


def _mixed(
    seen: Sequence[Board],
    camera: Camera,
    parametric: Parametric,
    settings: FitSettings | None,
    tolerances: Tolerances | None,
) -> Parametric:
    """Return the fit with defects: found, and the placement refined with them in the mask."""
    start = parametric.fit.placement
    defects = find_defects(seen, parametric.mask, start)
    if defects.count == 0:
        return Parametric(parametric.fit, parametric.mask, defects)
    fit = fit_placement(seen, camera, defects.mask, settings, tolerances, start=start)
    return Parametric(fit, parametric.mask, find_defects(seen, parametric.mask, fit.placement))


def _judged(name: str, shadow: Shadow, judges: Sequence[Board]) -> HeldOut:
    """Return the worse of the held-out whiteboards."""
    each = [judge(name, board, predicted_by_shadow(shadow, board)) for board in judges]
    return max(each, key=lambda one: one.chi2)


def _calibration(
    one: Parametric,
    camera: Camera,
    design: ImagingMatrix,
    boards: BoardSet,
    good: NDArray[np.bool_],
) -> Calibration:
    stages = shot_stages(camera)
    psi = one.psi(design, stages)
    if np.prod(design.size) <= MOST_PIXELS_WITH_DEVIATION:
        deviation = psi_deviation(one.shadow, design.layout, stages, one.fit.covariance)
    else:
        deviation = np.broadcast_to(np.float32(np.nan), psi.weights.shape)
    white = np.stack([_white(boards, design, shot) for shot in range(design.shots)])
    return Calibration(psi, deviation, boards.dark.mean_dn, white, gain_of(boards), good)


def _white(boards: BoardSet, design: ImagingMatrix, shot: int) -> NDArray[np.float32]:
    """Return what a reading of 1 gives in DN per second: all lamp colours together."""
    white = {(shot, "white"), (0, "white")} & set(boards.references)
    lamps = ("white",) if white else lamps_needed(design)
    total = np.zeros(design.frames_shape[1:], dtype=np.float64)
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
    for one in fit.boards:
        off = one.brightness - 1
        if abs(off) > LARGEST_FLICKER and abs(off) > 5 * one.brightness_deviation:
            found.append(
                f"{one.name}: {off:+.1%} in brightness against the others; the lamp is not steady, "
                "let it warm up and capture it again"
            )
        moved = float(np.hypot(*one.moved_um))
        if moved > LARGEST_MOVE_UM and moved > 5 * one.moved_deviation_um:
            found.append(
                f"{one.name}: the mask stands {moved:.1f} um from where the stage says "
                f"({one.moved_um[0]:+.1f}, {one.moved_um[1]:+.1f}); capture it again, or measure "
                "the stage map"
            )
    if fit.undecided:
        shown = ", ".join(fit.undecided[:4]) + (" ..." if len(fit.undecided) > 4 else "")
        more = (
            "capture some through the pinhole"
            if fit.more_boards >= MOST_MORE
            else f"{fit.more_boards} more of the same kinds, or fewer through the pinhole"
        )
        found.append(
            f"too few whiteboards for {len(fit.undecided)} parameter(s) ({shown}), which stay at "
            f"the design: {more}; `emmc-rig calibrate --plan` says which"
        )
    return found
