"""The calibration as one HTML page that opens offline: what was chosen and why, and how sure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.choice import HeldOut
from calibration.routes import Outcome
from calibration.sensor import SensorSheet
from emmc_rig.model.files import write_text
from emmc_rig.pages.display import DisplayCurve, finite, heat, montage, png_of, round_up
from emmc_rig.pages.drawing import ACCENT, INK, sheet, svg_of, titled
from emmc_rig.pages.page import (
    Card,
    Head,
    Section,
    data_address,
    fragment,
    framed,
    provenance_section,
    typed,
)

Array = NDArray[np.floating]
RESIDUAL_SCALE = 5.0
DETAIL_PX = 40
"""Side of the piece of a slice of Psi that is shown pixel for pixel."""
THUMBNAIL_PX = 120
"""Side of a whole slice."""
WORDS = {
    "offset_x_um": ("Offset x", "um"),
    "offset_y_um": ("Offset y", "um"),
    "rotation_rad": ("Rotation", "rad"),
    "scale": ("Scale of the cells", ""),
    "skew": ("Skew", ""),
    "distance_share": ("Error of the distance d", "of d"),
    "distortion_um": ("Distortion at the corner", "um"),
    "blur_um": ("Edge blur", "um"),
    "clear": ("Transmittance, open", ""),
    "leak": ("Transmittance, closed", ""),
    "vignetting": ("Vignetting", ""),
    "falloff": ("Falloff over the aperture", ""),
    "tilt_x_rad": ("Tilt, x", "rad"),
    "tilt_y_rad": ("Tilt, y", "rad"),
    "bow_um": ("Bow at the corner", "um"),
    "glass_um": ("Glass between mask and sensor", "um"),
}


GOOD_CHI2 = 1.5
"""Held-out residual, in variances of the noise, above which something is not modelled."""


def write_calibration_report(
    path: Path,
    outcome: Outcome,
    metrics: Mapping,
    sensor: SensorSheet | None = None,
) -> None:
    """Write the page whole or not at all.

    metrics: as `emmc_rig.calibrate` makes them.
    """
    unwatched = [one.removeprefix("not measured: ") for one in outcome.unwatched]
    sections = [
        Section("choice", "Chosen", _choice(outcome, metrics)),
        *_listed("found", "Found and taken into account", outcome.findings),
        *_listed("unwatched", "Not measured", unwatched),
    ]
    if outcome.parametric is not None:
        sections.append(Section("fit", "Fit", _fit(metrics)))
    body = _kinds(outcome.judged[outcome.chosen]) + _residuals(list(outcome.judged.values()))
    sections += [Section("residuals", "Residual maps", body), Section("psi", "Psi", _psi(outcome))]
    if sensor is not None:
        sections.append(Section("sensor", "Sensor", _sensor(sensor)))
    sections.append(provenance_section(_provenance(metrics)))
    title = f"Calibration of {metrics['camera']}"
    write_text(
        path, framed(title, (), (), sections, ["calibration.css"], head=_head(outcome, metrics))
    )


def _head(outcome: Outcome, metrics: Mapping) -> Head:
    """Return whether the whiteboards agree with the Psi chosen, and what to measure again."""
    good = outcome.judged[outcome.chosen].chi2 < GOOD_CHI2 and not outcome.advice
    return Head(
        "trust" if good else "doubt",
        outcome.why,
        outcome.advice or [_use(metrics)],
        "good" if good else "watch",
    )


def _use(metrics: Mapping) -> str:
    if not metrics["session"]:
        return "get the light field with this Psi: `emmc_rig.reconstruct(psi, report.frames(dn))`"
    return f"get the light field with this Psi: `emmc-rig reconstruct {typed(metrics['session'])}`"


def _choice(outcome: Outcome, metrics: Mapping) -> str:
    judged = outcome.judged[outcome.chosen]
    cards = [
        Card("Route", outcome.chosen, "the surest at the noise", "good"),
        Card(
            "Held-out residual",
            f"{judged.chi2:.2f}",
            "times the noise's variance",
            "good" if judged.chi2 < GOOD_CHI2 else "watch",
        ),
        Card("Frames", str(outcome.frames[outcome.chosen]), "for this route"),
        Card("Bad pixels", f"{metrics['bad_pixels']:.2%}", "found and left out"),
    ]
    rows = [
        (
            name,
            outcome.frames[name],
            f"{one.chi2:.2f}",
            f"{one.relative_error:.3%}",
        )
        for name, one in outcome.judged.items()
    ]
    chosen = list(outcome.judged).index(outcome.chosen)
    return fragment("calibration_choice.html", cards=cards, rows=rows, chosen=chosen)


def _listed(name: str, title: str, lines: Sequence[str]) -> list[Section]:
    """Return the section of some lines; none without any."""
    return [Section(name, title, fragment("advice.html", lines=lines))] if lines else []


def _kinds(judged: HeldOut) -> str:
    """Return how every kind of whiteboard is predicted, the worst first."""
    order = sorted(judged.groups.items(), key=lambda item: -item[1])
    rows = [(name, f"{value:.2f}") for name, value in order]
    heads = ("Whiteboards, by the route chosen", "Residual / noise")
    return fragment("figures.html", heads=heads, rows=rows, pictures={})


def _fit(metrics: Mapping) -> str:
    rows = []
    for name, (words, unit) in WORDS.items():
        found = metrics["parameters"][name]
        rows.append([words, f"{found['value']:.6g}", f"{found['deviation']:.2g}", unit])
    return fragment(
        "calibration_fit.html",
        fit=metrics["fit"],
        heads=["Parameter", "Fitted", "Standard deviation", "Unit"],
        rows=rows,
    )


def _residuals(judged: Sequence[HeldOut]) -> str:
    pictures = {}
    for one in judged:
        grey = np.clip(one.residual / (2 * RESIDUAL_SCALE) + 0.5, 0, 1)
        pictures[one.route] = png_of((grey * 255 + 0.5).astype(np.uint8))
    return fragment("calibration_residuals.html", pictures=pictures, scale=RESIDUAL_SCALE)


def _psi(outcome: Outcome) -> str:
    """Return slices of Psi and of its deviation, (v, u, y, x) of the first shot."""
    psi, deviation = outcome.calibration.psi, outcome.calibration.deviation
    views = psi.light_field_shape[:2]
    slices: list[list[Array]] = [[], [], []]
    medians = []
    for v, u in np.ndindex(views):  # one view in memory at a time
        weights, spread = (finite(of[0, v, u].sum(axis=1)) for of in (psi.weights, deviation))
        for found, one in zip(
            slices, (_thumbnail(weights), _centre(weights), _centre(spread)), strict=True
        ):
            found.append(one)
        medians.append(np.median(spread))
    whole, piece, unsure = (
        np.reshape(np.array(one, np.float32), (*views, *one[0].shape)) for one in slices
    )
    layout = f"rows are v 0 to {views[0] - 1} downwards, columns u 0 to {views[1] - 1}"
    side = f"{piece.shape[-1]} × {piece.shape[-2]}"
    note = f"same pixels; of the views' medians the median is {np.median(medians):.2g}"
    panels = [
        _panel("Whole field", f"one tile per view, averaged down; {layout}", whole, 3),
        _panel(
            "Centre, pixel for pixel", f"the middle {side} pixels of each view's weights", piece, 2
        ),
        _panel("Its standard deviation", note, unsure, 2, "heat"),
    ]
    return fragment("calibration_psi.html", panels=panels)


def _panel(
    name: str, note: str, slices: Array, gap_px: int, ramp: str = "grey"
) -> dict[str, object]:
    """Return a figure of slices (v, u, y, x) side by side; ramp: its scale of colours."""
    scale = round_up(float(np.percentile(slices, 99.9)))
    codes = DisplayCurve(1 / scale, 1.0).encode(slices)
    picture = png_of(montage(heat(codes) if ramp == "heat" else codes, gap_px))
    return {"name": name, "note": note, "picture": picture, "scale": scale, "ramp": ramp}


def _centre(view: Array) -> Array:
    height, width = view.shape
    top, left = max((height - DETAIL_PX) // 2, 0), max((width - DETAIL_PX) // 2, 0)
    return view[top : top + DETAIL_PX, left : left + DETAIL_PX]


def _thumbnail(view: Array) -> Array:
    height, width = view.shape
    shrink = min(1.0, THUMBNAIL_PX / max(height, width))
    size = (max(1, round(width * shrink)), max(1, round(height * shrink)))
    return np.asarray(cv2.resize(view, size, interpolation=cv2.INTER_AREA), np.float32)


def _sensor(sheet_: SensorSheet) -> str:
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
    drawn = {"Photon transfer curve": first, "Linearity": second}
    pictures = {name: data_address(svg_of(one), ".svg") for name, one in drawn.items()}
    return fragment("figures.html", heads=heads, rows=_figures(sheet_.rows()), pictures=pictures)


def _figures(rows: Iterable[tuple[str, float, float | None, str]]) -> list[tuple[str, ...]]:
    """Return quantities with their deviations as rows of a table."""
    return [
        (name, f"{value:.5g}", "" if deviation is None else f"{deviation:.2g}", unit)
        for name, value, deviation, unit in rows
    ]


def _provenance(metrics: Mapping) -> dict[str, str]:
    return {
        "command": metrics["command"],
        "camera": metrics["camera"],
        "size": "x".join(map(str, metrics["size"])),
        "session": metrics["session"],
        "seconds to calibrate": f"{metrics['calibration_seconds']:.1f}",
        **metrics["versions"],
    }
