"""The calibration as one HTML page that opens offline: what was chosen and why, and how sure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibration.choice import HeldOut
from calibration.routes import Outcome
from calibration.sensor import SensorSheet
from emmc_rig.model.files import write_text
from emmc_rig.pages.display import png_of
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
from emmc_rig.pages.psi_panels import psi_panels

Array = NDArray[np.floating]
RESIDUAL_SCALE = 5.0
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
    calibration = outcome.calibration
    weights, deviation = calibration.psi.weights, calibration.deviation
    panels = psi_panels(
        calibration.psi.light_field_shape[:2],
        lambda v, u: weights[0, v, u].sum(axis=1),
        lambda v, u: deviation[0, v, u].sum(axis=1),
    )
    return fragment("calibration_psi.html", panels=panels)


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
