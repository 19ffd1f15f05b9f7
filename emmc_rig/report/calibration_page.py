"""The calibration as one HTML page that opens offline: what was chosen and why, and how sure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.calibration.choice import HeldOut
from emmc_rig.calibration.routes import Outcome
from emmc_rig.calibration.sensor import SensorSheet
from emmc_rig.model.files import write_text
from emmc_rig.model.sensing import Psi
from emmc_rig.report.display import finite, round_up
from emmc_rig.report.maps import Map, maps_svg, pixel_ticks
from emmc_rig.report.page import (
    Card,
    Head,
    Section,
    data_address,
    framed,
    number,
    part,
    provenance_section,
    typed,
)

Array = NDArray[np.floating]
RESIDUAL_SCALE = 5.0
DETAIL_PX = 40
"""Side of the piece of the shadow that is shown pixel for pixel."""
MAP_PX, REGIONS = 640, 24
"""Longest side of a map of pixels, and of one of regions; larger ones are shown averaged."""
GOOD_CHI2 = 1.5
"""Validation residual, in variances of the noise, above which something is not modelled."""
GOOD_BAD_PIXELS = 0.02
"""Share of pixels, from which on a reconstruction is doubted (`reconstruction.verdict.rules`)."""
MEASURED = (
    "What a whiteboard reads behind the mask, {board}: 1 is the same pixel with the mask out and "
    "the aperture open. Beside it the error that the calibration states of Psi, first shot."
)
SURE = 2.0
"""Deviations by which a parameter differs from the design before the page says so."""


class _Parameter(NamedTuple):
    """How a fitted parameter is written: in units of `unit`, each `per_unit` of the fit's.

    design: its value as designed, in the fit's units; None where it differs from mask to mask. of:
    the part of the camera to blame for a difference.
    """

    words: str
    unit: str
    of: str
    per_unit: float = 1.0
    design: float | None = 0.0


PARAMETERS = {
    "offset_x_um": _Parameter("Mask's offset, x", "um", "the mount"),
    "offset_y_um": _Parameter("Mask's offset, y", "um", "the mount"),
    "rotation_rad": _Parameter("Mask's rotation", "mrad", "the mount", 1e-3),
    "scale": _Parameter("Scale of the mask's cells", "% of design", "the mask", 0.01, 1.0),
    "skew": _Parameter("Mask's skew", "mrad", "the mask", 1e-3),
    "distance_share": _Parameter("Mask's distance", "% from the design's", "the mount", 0.01),
    "distortion_um": _Parameter("Distortion at the corner", "um", "the lens"),
    "blur_um": _Parameter("Blur of the mask's edges", "um", "the mask"),
    "clear": _Parameter("Transmittance of open cells", "%", "the mask", 0.01, None),
    "leak": _Parameter("Transmittance of closed cells", "%", "the mask", 0.01, None),
    "vignetting": _Parameter("Vignetting", "%", "the lens", 0.01),
    "falloff": _Parameter("Falloff over the aperture", "%", "the lens", 0.01),
    "tilt_x_rad": _Parameter("Mask's tilt, x", "mrad", "the mount", 1e-3),
    "tilt_y_rad": _Parameter("Mask's tilt, y", "mrad", "the mount", 1e-3),
    "bow_um": _Parameter("Mask's bow at the corner", "um", "the mask"),
    "glass_um": _Parameter("Glass between mask and sensor", "um", "the mount"),
}


def write_calibration_report(
    path: Path,
    outcome: Outcome,
    metrics: Mapping,
    sensor: SensorSheet | None = None,
) -> None:
    """Write the page whole or not at all.

    metrics: as `emmc_rig.calibrate` makes them.
    """
    unwatched = [text.removeprefix("not measured: ") for text in outcome.unwatched]
    measured, error = _measured(outcome)
    chosen = outcome.judged[outcome.chosen]
    sections = [
        *_listed("found", "Found and taken into account", outcome.findings),
        *_listed("unwatched", "Not measured", unwatched),
        Section("psi", "Shadow and error", measured),
        Section(
            "residuals", "Residuals", _residuals(chosen),
            about="Whiteboards kept from the fit, less what this calibration predicts of them.",
        ),
        Section(
            "methods", "Calibration methods", _methods(outcome),
            about=f"Why {outcome.chosen} was chosen, and what the others predict.",
        ),
    ]  # fmt: skip
    if outcome.parametric is not None:
        about = "Placement and shape of the mask, each figure with its standard deviation."
        sections.append(Section("fit", "Mask as fitted", _fit(metrics), about=about))
    if sensor is not None:
        about = "Gain, noise and linearity after EMVA 1288."
        sections.append(Section("sensor", "Sensor", _sensor(sensor), about=about))
    sections.append(provenance_section(_provenance(metrics)))
    title = f"Calibration of {metrics['camera']}"
    text = framed(
        title, sections=sections, styles=["calibration.css"], head=_head(outcome, metrics),
        lead=part("cards", _cards(outcome, metrics, error)),
    )  # fmt: skip
    write_text(path, text)


def _head(outcome: Outcome, metrics: Mapping) -> Head:
    """Return whether the whiteboards agree with the Psi chosen, and what to measure again."""
    agrees = outcome.judged[outcome.chosen].chi2 < GOOD_CHI2
    words = "This calibration does not describe the bench"
    if agrees:
        words = "You can use this calibration"
        words += ", and make it better" if outcome.advice else ""
    good = agrees and not outcome.advice
    use = "emmc_rig.reconstruct(calibration.psi, calibration.frames(dn))"
    if metrics["session"]:
        use = f"emmc-rig reconstruct {typed(metrics['session'])}"
    advice = outcome.advice or [f"get the light field with this Psi: `{use}`"]
    return Head(words, outcome.why, advice, "good" if good else "watch")


def _cards(outcome: Outcome, metrics: Mapping, error: float) -> list[Card]:
    judged, bad = outcome.judged[outcome.chosen], metrics["bad_pixels"]

    def card(label: str, value: str, note: str, good: bool) -> Card:
        return Card(label, value, note, "good" if good else "watch")

    return [
        card(
            "Validation residual", f"{judged.chi2:.2f} x noise",
            f"mean square, over the noise's variance; good: below {GOOD_CHI2:g}",
            judged.chi2 < GOOD_CHI2,
        ),
        Card(
            "Deviation of Psi", f"{error:.2f}%",
            "standard deviation of its coefficients, over their root mean square",
        ),
        card(
            "Excluded pixels", f"{bad:.2%}",
            f"found bad; good: below {GOOD_BAD_PIXELS:.0%}", bad < GOOD_BAD_PIXELS,
        ),
    ]  # fmt: skip


def _methods(outcome: Outcome) -> str:
    heads = (
        "Calibration method", "Frames", "Validation residual, x noise",
        f"Good (below {GOOD_CHI2:g})", "Residual, of the signal",
    )  # fmt: skip
    rows = [
        (name, outcome.frames[name], f"{judged.chi2:.2f}",
         "yes" if judged.chi2 < GOOD_CHI2 else "no", f"{judged.relative_error:.3%}")
        for name, judged in outcome.judged.items()
    ]  # fmt: skip
    chosen = list(outcome.judged).index(outcome.chosen)
    return part("table", heads, rows, numbers=True, chosen=chosen)


def _listed(name: str, title: str, lines: Sequence[str]) -> list[Section]:
    """Return the section of some lines; none without any."""
    return [Section(name, title, part("bullets", lines))] if lines else []


def _fit(metrics: Mapping) -> str:
    fit = metrics["fit"]
    rows = [
        _fitted(parameter, metrics["parameters"][name], name in fit["undecided"])
        for name, parameter in PARAMETERS.items()
    ]
    heads = ("Parameter", "Fitted ± standard deviation", "What that says")
    words = (
        f"The fit {fit['status']} after {fit['steps']} steps; correlation with the design's shadow "
        f"{number(fit['correlation'], '.4f')} (1 is the design's); residual "
        f"{number(fit['chi2'], '.2f')} of the noise's variance (good: below {GOOD_CHI2}; above, "
        "the mask has more than these parameters describe), "
        f"{number(fit['outliers'], '.2%')} of the pixels excluded."
    )
    of_boards = (
        "Whiteboard", "Brightness", "Mask moved x, y (um)", "Residual, x noise", "Excluded pixels"
    )  # fmt: skip
    boards = [
        (
            board["name"],
            number(board["brightness"] - 1, "+z.2%"),
            ", ".join(number(um, "+z.3f") for um in board["moved_um"]),
            number(board["chi2"], ".2f"),
            number(board["outliers"], ".2%"),
        )
        for board in fit["boards"]
    ]
    about = f"{len(boards)} whiteboards: brightness, movement and residual."
    table = part("table", of_boards, boards, numbers=True)
    return (
        part("table", heads, rows)
        + part("lead", words)
        + part("folded", "boards", "Each whiteboard against the fit", about, table)
    )


def _fitted(parameter: _Parameter, found: Mapping[str, float], undecided: bool) -> tuple[str, ...]:
    """Return a parameter as a row: name, value with deviation, and their meaning."""
    value, deviation = found["value"] / parameter.per_unit, found["deviation"] / parameter.per_unit
    digits = max(0, 1 - math.floor(math.log10(deviation))) if deviation > 0 else 2
    written = f"{value:.{digits}f} ± {deviation:.{digits}f} {parameter.unit}"
    if undecided:
        return parameter.words, written, "not known from these whiteboards: taken as designed"
    if parameter.design is None:
        return parameter.words, written, "measured; Psi has it"
    away = abs(value - parameter.design / parameter.per_unit)
    if away <= SURE * deviation:
        return parameter.words, written, "as designed, within its deviation"
    return parameter.words, written, f"{parameter.of}, not an error: Psi has it"


def _residuals(judged: HeldOut) -> str:
    """Return the residuals of a prediction: a map (pixel_y, pixel_x), and kinds of whiteboards.

    The kinds are in a table, the worst first.
    """
    look = {
        "scale": (-RESIDUAL_SCALE, RESIDUAL_SCALE),
        "bar": "validation whiteboard less prediction,\nstandard deviations of the noise",
        "colours": "blue-red",
    }
    shown = _shrunk(judged.residual, MAP_PX)
    drawn = _over_sensor(judged.route, shown, judged.residual.shape, look)
    order = sorted(judged.groups.items(), key=lambda item: -item[1])
    rows = [(name, f"{value:.2f}") for name, value in order]
    heads = ("Validation whiteboard", f"Residual, x noise (good: below {GOOD_CHI2:g})")
    return _drawn({"Residual map": maps_svg([drawn])}) + part("table", heads, rows, numbers=True)


def _drawn(figures: Mapping[str, bytes]) -> str:
    """Return SVG files as parts of the page, by name."""
    addresses = {name: data_address(svg, ".svg") for name, svg in figures.items()}
    return part("drawings", addresses)


def _measured(outcome: Outcome) -> tuple[str, float]:
    """Return the mask's shadow and the error of Psi as pictures, and the error over all pixels."""
    board, calibration = outcome.whiteboard, outcome.calibration
    errors, error = error_of_psi(calibration.psi, calibration.deviation)
    reading = finite(board.reading)
    pixels, middle = reading.shape, _centre(reading)
    shadow = {
        "scale": (0, round_up(float(np.percentile(reading[board.usable], 99.9)))),
        "bar": "reading of the whiteboard",
        "colours": "gray",
    }
    of_psi = {
        "scale": (0, round_up(float(np.nanmax(errors)))),
        "bar": "standard deviation of coefficients,\n% of their root mean square",
        "colours": "magma",
    }
    of_middle = f"Its middle, {middle.shape[1]} x {middle.shape[0]} pixels"
    panels = [_over_sensor("Shadow of the mask", _shrunk(reading, MAP_PX), pixels, shadow)]
    if middle.shape != pixels:
        panels.append(_over_sensor(of_middle, middle, middle.shape, shadow))
    panels.append(_over_sensor("Error of Psi, by regions", errors, pixels, of_psi))
    words = part("lead", MEASURED.format(board=board.name))
    return words + _drawn({panel.title: maps_svg([panel]) for panel in panels}), error


def error_of_psi(psi: Psi, deviation: Array) -> tuple[Array, float]:
    """Return the error that is stated of Psi, by regions of the sensor (y, x), and over all pixels.

    The root mean square deviation of the first shot's coefficients over theirs, %.
    """
    squares: list[Array] = [np.zeros(psi.size), np.zeros(psi.size)]
    for v, u in np.ndindex(psi.light_field_shape[:2]):  # one view in memory at a time
        for total, of in zip(squares, (psi.weights, deviation), strict=True):
            total += np.square(finite(of[0, v, u]), dtype=np.float64).sum(axis=1)
    least = 1e-6 * float(squares[0].mean()) + 1e-30  # where no light is, no error is known
    light, missed = (_shrunk(total, REGIONS) for total in squares)
    known = 100 * np.sqrt(np.where(light > least, missed / np.maximum(light, least), np.nan))
    return known, 100 * float(np.sqrt(squares[1].sum() / max(squares[0].sum(), least)))


def _over_sensor(
    title: str, values: Array, pixels: tuple[int, ...], look: Mapping[str, Any]
) -> Map:
    """Return a map of the sensor, or of a piece of it, of so many pixels (y, x)."""
    return Map(
        title=title,
        values=values,
        across="pixel x",
        down="pixel y",
        ticks_x=pixel_ticks(pixels[1], values.shape[1]),
        ticks_y=pixel_ticks(pixels[0], values.shape[0]),
        **look,
    )


def _centre(view: Array) -> Array:
    height, width = view.shape
    top, left = max((height - DETAIL_PX) // 2, 0), max((width - DETAIL_PX) // 2, 0)
    return view[top : top + DETAIL_PX, left : left + DETAIL_PX]


def _shrunk(view: Array, longest_px: int) -> Array:
    """Return a picture (y, x) averaged down where a side is longer."""
    height, width = view.shape
    shrink = min(1.0, longest_px / max(height, width))
    size = (max(1, round(width * shrink)), max(1, round(height * shrink)))
    return np.asarray(cv2.resize(view, size, interpolation=cv2.INTER_AREA), np.float32)


def _sensor(sheet_: SensorSheet) -> str:
    from emmc_rig.report.drawing import ACCENT, INK, sheet, svg_of, titled  # matplotlib: a second

    (first, (transfer,)), (second, (linearity,)) = (
        sheet(1, 4.8, label=label)
        for label in ("temporal variance, DN²", "deviation from the line, %")
    )
    curve = sheet_.curve
    transfer.plot(curve.mean_dn, curve.variance_dn2, "o", color=ACCENT, markersize=4)
    grid = np.linspace(0, max(curve.mean_dn), 50)
    line = sheet_.dark_variance_dn2 + sheet_.gain_dn_per_electron * grid
    transfer.plot(grid, line, color=INK, linewidth=1)
    titled(transfer, "Photon transfer", "signal above the dark, DN")
    linearity.plot(curve.exposure_s, sheet_.linearity_residual, "o", color=ACCENT, markersize=4)
    linearity.axhline(0, color=INK, linewidth=0.8)
    titled(linearity, "Linearity", "exposure, s")
    heads = ("Quantity (EMVA 1288)", "Value", "Standard deviation", "Unit")
    rows = [
        (
            row.title,
            f"{row.value:.5g}",
            "" if row.deviation is None else f"{row.deviation:.2g}",
            row.unit,
        )
        for row in sheet_.rows()
    ]
    table = part("table", heads, rows, numbers=True)
    return table + _drawn({"Photon transfer curve": svg_of(first), "Linearity": svg_of(second)})


def _provenance(metrics: Mapping) -> dict[str, str]:
    return {
        "command": metrics["command"],
        "camera": metrics["camera"],
        "size": "x".join(map(str, metrics["size"])),
        "session": metrics["session"],
        "seconds to calibrate": f"{metrics['calibration_seconds']:.1f}",
        **metrics["versions"],
    }
