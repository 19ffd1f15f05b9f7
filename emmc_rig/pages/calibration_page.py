"""The calibration as one HTML page that opens offline: what was chosen and why, and how sure."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from calibration.choice import HeldOut
from calibration.routes import Outcome
from calibration.sensor import SensorSheet
from calibration.stage_map import StageMap
from emmc_rig.model.files import write_text
from emmc_rig.pages.drawing import ACCENT, FAINT, INK, sheet, titled
from emmc_rig.pages.page import Section, framed, provenance_table
from emmc_rig.pages.report import card, png_of, psi_panels, text_of

Array = NDArray[np.floating]
RESIDUAL_SCALE = 5.0
NUMBER = ' class="number"'
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


def write_calibration_report(
    path: Path,
    outcome: Outcome,
    metrics: Mapping,
    truth: Mapping[str, float] | None = None,
    sensor: SensorSheet | None = None,
    stage: StageMap | None = None,
) -> None:
    """Write the page whole or not at all.

    metrics: as `emmc_rig.calibrate` makes them. truth: parameters of a simulated bench, shown
    beside the fit.
    """
    sections = [("choice", "Chosen", _choice(outcome, metrics))]
    sections.append(("found", "Found and taken into account", _findings(outcome.findings)))
    sections.append(("redo", "What to measure again", _advice(outcome.advice)))
    best = outcome.mixed or outcome.parametric
    first = outcome.parametric
    if best is not None and first is not None:
        sections.append(("fit", "Fit", _fit(metrics, truth or {}, first.fit.history)))
    maps = _kinds(outcome.judged[outcome.chosen]) + _residuals(list(outcome.judged.values()))
    sections.append(("residuals", "Residual maps", maps))
    sections.append(("psi", "Psi", _psi(outcome)))
    if sensor is not None:
        sections.append(("sensor", "Sensor", _sensor(sensor)))
    if stage is not None:
        sections.append(("stage", "Stage map", _stage(stage)))
    sections.append(("provenance", "Provenance", _provenance(metrics)))
    style = resources.files("emmc_rig.pages").joinpath("calibration.css").read_text("utf-8")
    page = framed(
        f"Calibration of {metrics['camera']}",
        [outcome.why],
        (),
        [Section(key, name, name, body) for key, name, body in sections],
        style,
    )
    write_text(path, page)


def _table(heads: Sequence[str], rows: Sequence[Sequence[object]], chosen: int = -1) -> str:
    """Return a table: the first column names, the others figures."""
    cells = "".join(
        f'<th scope="col"{"" if i == 0 else NUMBER}>{text_of(head)}</th>'
        for i, head in enumerate(heads)
    )
    body = ""
    for index, row in enumerate(rows):
        marked = ' class="chosen"' if index == chosen else ""
        values = "".join(f"<td{NUMBER}>{text_of(value)}</td>" for value in row[1:])
        body += f'<tr{marked}><th scope="row">{text_of(row[0])}</th>{values}</tr>'
    return f"<table><thead><tr>{cells}</tr></thead><tbody>{body}</tbody></table>"


def _choice(outcome: Outcome, metrics: Mapping) -> str:
    judged = outcome.judged[outcome.chosen]
    errors = metrics.get("psi_relative_error", {})
    known = errors.get(outcome.chosen)
    cards = "".join(
        (
            card("Route", outcome.chosen, "the surest at the noise", "good"),
            card(
                "Held-out residual",
                f"{judged.chi2:.2f}",
                "times the noise's variance",
                "good" if judged.chi2 < 1.5 else "watch",
            ),
            card("Frames", str(outcome.frames[outcome.chosen]), "for this route"),
            card(
                "Error of Psi",
                "not known" if known is None else f"{known:.2%}",
                "against the simulated bench's own",
            ),
            card("Bad pixels", f"{metrics['bad_pixels']:.2%}", "found and left out"),
        )
    )
    names = list(outcome.judged)
    rows = [
        (
            name,
            outcome.frames[name],
            f"{one.chi2:.2f}",
            f"{one.trimmed:.2f}",
            f"{one.whiteness:+.3f}",
            f"{one.relative_error:.3%}",
            "not known" if errors.get(name) is None else f"{errors[name]:.3%}",
        )
        for name, one in outcome.judged.items()
    ]
    heads = (
        "Route", "Frames", "Held-out residual / noise", "without the worst 1 %",
        "Correlation of neighbours", "Relative residual", "Relative error of Psi",
    )  # fmt: skip
    table = _table(heads, rows, names.index(outcome.chosen))
    return f'<div class="cards">{cards}</div>{table}'


def _advice(advice: Sequence[str]) -> str:
    if not advice:
        return '<p class="lead">Nothing: every whiteboard agrees with the others.</p>'
    return f"<ul>{''.join(f'<li>{text_of(line)}</li>' for line in advice)}</ul>"


def _findings(findings: Sequence[str]) -> str:
    if not findings:
        return '<p class="lead">Lamp, board, filters and mask are as designed.</p>'
    return f"<ul>{''.join(f'<li>{text_of(line)}</li>' for line in findings)}</ul>"


def _kinds(judged: HeldOut) -> str:
    """Return how every kind of whiteboard is predicted, the worst first."""
    rows = sorted(judged.groups.items(), key=lambda item: -item[1])
    return _table(
        ("Whiteboards, by the route chosen", "Residual / noise"),
        [(name, f"{value:.2f}") for name, value in rows],
    )


def _fit(metrics: Mapping, truth: Mapping[str, float], history: Sequence[float]) -> str:
    rows = []
    for name, (words, unit) in WORDS.items():
        found = metrics["parameters"][name]
        row = [words, f"{found['value']:.6g}", f"{found['deviation']:.2g}", unit]
        known = [f"{truth[name]:.6g}" if name in truth else ""] if truth else []
        rows.append([*row, *known])
    heads = ["Parameter", "Fitted", "Standard deviation", "Unit"]
    table = _table([*heads, *(["Simulated bench"] if truth else [])], rows)
    boards = _table(
        (
            "Whiteboard", "Brightness", "Mask moved x, y (um)", "Residual / noise", "Outliers",
        ),
        [
            (
                one["name"],
                f"{one['brightness'] - 1:+.2%}",
                f"{one['moved_um'][0]:+.3f}, {one['moved_um'][1]:+.3f}",
                f"{one['chi2']:.2f}",
                f"{one['outliers']:.2%}",
            )
            for one in metrics["fit"]["boards"]
        ],
    )  # fmt: skip
    figure, (axes,) = sheet(1, 5.2, label="typical residual / noise")
    axes.plot(np.arange(1, len(history) + 1), history, "o-", color=ACCENT, markersize=3)
    axes.set_ylim(bottom=0)
    axes.set_xlabel("step, over widening windows", color=FAINT, fontsize=9)
    titled(axes, "Convergence")
    fit = metrics["fit"]
    told = (
        f"{fit['status']} after {fit['steps']} steps; correlation with the design's shadow "
        f"{fit['correlation']:.4f}; residual {fit['chi2']:.2f} of the noise's variance, "
        f"{fit['outliers']:.2%} of the pixels set aside."
    )
    return (
        f'<p class="lead">{text_of(told)}</p>{table}<h3 class="sub">Each whiteboard against the '
        f'fit of all</h3>{boards}<div class="pictures">{_drawn(figure, "Convergence")}</div>'
    )


def _drawn(figure: Figure, alt: str) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    data = base64.b64encode(buffer.getvalue()).decode()
    return (
        f'<figure><img class="drawn" src="data:image/svg+xml;base64,{data}" alt="{alt}"></figure>'
    )


def _residuals(judged: Sequence[HeldOut]) -> str:
    pictures = []
    for one in judged:
        grey = np.clip(one.residual / (2 * RESIDUAL_SCALE) + 0.5, 0, 1)
        image = png_of((grey * 255 + 0.5).astype(np.uint8))
        pictures.append(
            f"<figure><figcaption><strong>{text_of(one.route)}</strong>: held-out whiteboard less "
            f"prediction; black and white are -+{RESIDUAL_SCALE:g} deviations</figcaption>"
            f'<img src="{image}" alt="Residual map, {text_of(one.route)}"></figure>'
        )
    return f'<div class="pictures">{"".join(pictures)}</div>'


def _psi(outcome: Outcome) -> str:
    calibration = outcome.calibration
    weights = calibration.psi.weights[0].sum(axis=3)
    deviation = np.asarray(calibration.deviation)[0].sum(axis=3)
    known = deviation if np.isfinite(deviation).all() else None
    return (
        '<p class="lead">Coefficients of shot 1; 1 / number of views is an open camera.</p>'
        + psi_panels(weights, known)
    )


def _sensor(sheet_: SensorSheet) -> str:
    rows = [
        (name, f"{value:.5g}", "" if deviation is None else f"{deviation:.2g}", unit)
        for name, value, deviation, unit in sheet_.rows()
    ]
    figure, (transfer, linearity) = sheet(2, 5.0, label="temporal variance, DN²")
    curve = sheet_.curve
    transfer.plot(curve.mean_dn, curve.variance_dn2, "o", color=ACCENT, markersize=4)
    grid = np.linspace(0, max(curve.mean_dn), 50)
    line = sheet_.dark_variance_dn2 + sheet_.gain_dn_per_electron * grid
    transfer.plot(grid, line, color=INK, linewidth=1)
    transfer.set_xlabel("signal above the dark, DN", color=FAINT, fontsize=9)
    titled(transfer, "Photon transfer")
    linearity.plot(curve.exposure_s, sheet_.linearity_residual, "o", color=ACCENT, markersize=4)
    linearity.axhline(0, color=INK, linewidth=0.8)
    linearity.set_xlabel("exposure, s", color=FAINT, fontsize=9)
    linearity.set_ylabel("deviation from the line, %", color=FAINT, fontsize=9)
    titled(linearity, "Linearity")
    heads = ("Quantity (EMVA 1288)", "Value", "Standard deviation", "Unit")
    drawn = _drawn(figure, "Photon transfer curve and linearity")
    return f"{_table(heads, rows)}{drawn}"


def _stage(stage: StageMap) -> str:
    rows = [
        (name, f"{value:.5g}", f"{deviation:.2g}", unit)
        for name, value, deviation, unit in stage.rows()
    ]
    return _table(("Quantity", "Value", "Standard deviation", "Unit"), rows)


def _provenance(metrics: Mapping) -> str:
    shown = {
        "command": metrics["command"],
        "camera": metrics["camera"],
        "size": "x".join(map(str, metrics["size"])),
        **({"session": metrics["session"]} if "session" in metrics else {"seed": metrics["seed"]}),
        "seconds to calibrate": f"{metrics['calibration_seconds']:.1f}",
        **metrics["versions"],
    }
    return provenance_table(shown)
