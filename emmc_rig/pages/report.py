"""One self-contained HTML page from the outcome of a run; it opens offline and asks for nothing."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from emmc_rig.files.formats import Export
from emmc_rig.model.files import write_text
from emmc_rig.model.view_axes import axes_of, middle_name, picture_name, shows_parallax
from emmc_rig.pages.display import (
    PART_PIXELS,
    DisplayCurve,
    finite,
    heat,
    png_of,
    reduced,
    round_up,
)
from emmc_rig.pages.page import Card, fragment, light_field_head
from emmc_rig.pages.viewer import poster, viewer_data

Array = NDArray[np.floating]
FRAME_PIXELS = 1_500_000
"""Of all frames together, and of the error map; larger ones are shown smaller."""


@dataclass(frozen=True)
class ReportContent:
    """What the report shows. Pictures are linear, float, nominally in [0, 1].

    Shapes: light fields (v, u, y, x, c) with c 1 or 3; frames (shot, y, x); whiteboards (y, x).
    maps: what is laid over the picture in the viewer, by name, see `Export`. source: the result's
    folder, as typed.
    """

    title: str
    scene: str
    camera: str
    camera_line: str
    camera_reference: str
    estimate: Array
    frames: Array
    cfa: str
    metrics: Mapping[str, object]
    truth: Array | None = None
    whiteboards: Sequence[tuple[str, Array]] = ()
    stage_s: Mapping[str, float] = field(default_factory=dict)
    warnings: Sequence[str] = ()
    command: str = ""
    source: str = ""
    maps: Mapping[str, NDArray] = field(default_factory=dict)


def write_report(path: str | Path, content: ReportContent) -> None:
    """Write the page to `path`, whole or not at all.

    Raises OSError when the folder cannot be written.
    """
    write_text(Path(path), render(content))


def render(content: ReportContent) -> str:
    """Return the page as text."""
    rows, columns, height, width, _ = content.estimate.shape
    disparity, sigma, misfit = (content.maps.get(name) for name in ("disparity", "sigma", "misfit"))
    axes = axes_of(content.metrics)
    export = Export(
        content.title, "", content.estimate, content.truth, disparity, sigma, misfit,
        view_axes=axes,
    )  # fmt: skip
    return fragment(
        "report.html",
        title=content.title,
        content=content,
        caveats=(),
        lead="",
        styles=("viewer.css",),
        warnings=_warnings(content),
        summary=light_field_head(content.metrics, content.source),
        cards=_cards(content),
        frames=_frames(content.frames),
        whiteboards=[
            (label, _frames(frame[None])["pictures"][0]) for label, frame in content.whiteboards
        ],
        parallax=shows_parallax(axes),
        picture=picture_name(axes),
        views={"rows": rows, "columns": columns, "height": height, "width": width},
        error=None if content.truth is None else _error(content.estimate, content.truth),
        timings=_timings(content.stage_s),
        figures=_figures(content.metrics),
        provenance=_provenance(content),
        data={"viewer-data": viewer_data(export, most_pixels=PART_PIXELS)},
        poster=poster(export, PART_PIXELS),
        scripts=("viewer.js",),
    )


def _frames(frames: Array) -> dict[str, Any]:
    """Return frames (shot, y, x) as pictures on one scale, so that shots compare, and its ends."""
    frames = finite(frames)
    curve = DisplayCurve.fitted_to(frames)
    small = reduced(frames[None, ..., None], FRAME_PIXELS)[0, ..., 0]
    return {
        "pictures": [png_of(curve.encode(frame)) for frame in small],
        "shape": frames.shape,
        "least": frames.min(),
        "mean": frames.mean(),
        "greatest": frames.max(),
    }


def _error(estimate: Array, truth: Array) -> dict[str, object]:
    """Return the error averaged over views and colours as a picture, and its scale."""
    absolute = np.abs(finite(estimate) - finite(truth)).mean(axis=(0, 1, -1))
    mean = reduced(absolute[None, None, ..., None], FRAME_PIXELS)[0, 0, ..., 0]
    scale = round_up(float(np.percentile(mean, 99.5)))
    return {
        "scale": scale,
        "picture": png_of(heat(DisplayCurve(1 / scale, 1.0).encode(mean))),
    }


class Figure(NamedTuple):
    """How one metric is written: label, format, unit, and what it means."""

    label: str
    format: str = ""
    unit: str = ""
    meaning: str = ""


FIGURES = {
    "psnr_db": Figure("PSNR", ".2f", "dB", "peak 1, over all {picture}s, pixels and colours"),
    "stated_db": Figure("Stated PSNR", ".2f", "dB", "by the method, without the truth"),
    "stated_interval_db": Figure("Interval of the stated PSNR", ".1f", "",
        "dB, from and to; it holds the true one in 9 of 10 captures"),
    "ssim": Figure("SSIM", ".4f", "",
        "structural similarity, averaged over {picture}s; 1 is identical"),
    "replicate_psnr_db": Figure("PSNR of the copied {middle}", ".2f", "dB",
        "the true {middle} copied to all {picture}s: below it, {lost}"),
    "psi_relative_error": Figure("Relative error of Psi", ".2e", "",
        "|measured - exact| / |exact|, Euclidean norms"),
    "exact_psi_psnr_db": Figure("PSNR with the exact Psi", ".2f", "dB",
        "same frames, reconstructed without calibration"),
    "calibration_cost_db": Figure("What calibration costs", "z.2f", "dB",
        "PSNR with the exact Psi less PSNR with the measured"),
    "design_relative_error": Figure("Relative error of the design", ".2e", "",
        "|designed - exact| / |exact|: what Psi would be off by without calibration"),
    "psi_mean_deviation": Figure("Mean standard deviation of Psi", ".2e", "",
        "of one coefficient, as calibration states it"),
    "noise_sigma": Figure("Noise of the readings", ".2e", "",
        "their standard deviation, as the reconstruction took it"),
    "saturated_share": Figure("Saturated readings", ".2%", "", "share left out as clipped"),
    "whiteboard_frames": Figure("Whiteboard frames", meaning="exposures taken to measure Psi"),
    "status": Figure("Status", meaning="how the solver stopped"),
    "advice": Figure("Advice", meaning="what the solver suggests"),
    "seed": Figure("Seed", meaning="same seed, same result"),
    "steps": Figure("Steps", meaning="of the solver"),
    "size": Figure("Size", meaning="height and width of a {picture}, pixels"),
    "scene_provenance": Figure("Origin of the scene"),
    "finer": Figure("Finer scene",
        meaning="{picture}s and pixels of the simulated scene for each here"),
}  # fmt: skip
"""By the name in metrics.json; a figure without a row here is listed under its own name. In braces:
what pictures are called, the one in the middle, what it is to fall short of it."""
SHOWN_ELSEWHERE = {"verdict", "versions", "seconds", "warnings", "command"}


def _number(value: object) -> float | None:
    """The value as a float; None when it is not a finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        return None
    number = float(value)
    return number if math.isfinite(number) else None


def _written(value: object, spec: str = "", unit: str = "") -> str:
    """A value as text for the page, not escaped; a NaN is said, not hidden."""
    if value is None:
        return "not measured"
    if value == "":
        return "none"
    if isinstance(value, float | np.floating) and not math.isfinite(value):
        return "not a number" if math.isnan(value) else ("infinite" if value > 0 else "-infinite")
    number = _number(value)
    if number is None:
        joined = isinstance(value, list | tuple)
        return ", ".join(_written(item, spec) for item in value) if joined else str(value)
    text = format(number, spec) if spec else (f"{number:.6g}" if isinstance(value, float) else "")
    return f"{text or value} {unit}".rstrip()


def _cards(content: ReportContent) -> list[Card]:
    metrics, stage_s = content.metrics, content.stage_s
    no_truth = "no true light field to compare with" if content.truth is None else ""
    psnr, replicate = _number(metrics.get("psnr_db")), _number(metrics.get("replicate_psnr_db"))
    axes = axes_of(metrics)
    middle, picture = middle_name(axes), picture_name(axes)
    versus = Card(f"Over {middle}", "not measured", no_truth)
    if psnr is not None and replicate is not None:
        note = f"copying the true {middle} gives {replicate:.2f} dB"
        tone = "good" if psnr > replicate else "bad"
        versus = Card(f"Over {middle}", f"{psnr - replicate:+.2f} dB", note, tone)
    psi_error = _number(metrics.get("psi_relative_error"))
    known_psi = "not measured" if psi_error is None else f"{100 * psi_error:.2f} %"
    status = str(metrics.get("status") or "not measured")
    cards = [
        Card(
            "PSNR",
            _named(metrics, "psnr_db"),
            no_truth or f"peak 1, all {picture}s, pixels, colours",
        ),
        versus,
        Card("SSIM", _named(metrics, "ssim"), "1 is identical"),
        Card("Error of Psi", known_psi, "|measured - exact| / |exact|"),
    ]
    if metrics.get("exact_psi_psnr_db") is not None:
        note = f"with the exact Psi: {_named(metrics, 'exact_psi_psnr_db')}"
        cards.append(Card("Calibration costs", _named(metrics, "calibration_cost_db"), note))
    if stage_s:
        longest = max(stage_s, key=lambda name: stage_s[name])
        note = f"of which {longest} {stage_s[longest]:.1f} s"
        cards.append(Card("Time", f"{sum(stage_s.values()):.1f} s", note))
    note = str(metrics.get("advice") or metrics.get("method") or "")
    tone = "good" if status.startswith("converged") else "watch"
    return [*cards, Card("Solver", status, note, tone)]


def _named(metrics: Mapping[str, object], key: str) -> str:
    """Return a metric as its row of FIGURES writes it."""
    return _written(metrics.get(key), FIGURES[key].format, FIGURES[key].unit)


def _warnings(content: ReportContent) -> list[str]:
    broken = int(content.estimate.size - np.count_nonzero(np.isfinite(content.estimate)))
    more = f"The estimate holds {broken} values that are not finite; drawn black."
    return [*content.warnings, *([more] if broken else [])]


def _timings(stage_s: Mapping[str, float]) -> list[tuple[str, str, str]]:
    """Return name, width of its bar and words of each stage."""
    total_s, longest_s = sum(stage_s.values()), max(stage_s.values(), default=0.0)
    return [
        (name, f"{s / max(longest_s, 1e-12):.1%}", f"{s:.2f} s ({s / max(total_s, 1e-12):.0%})")
        for name, s in stage_s.items()
    ]


def _flat(metrics: Mapping[str, object], prefix: str = "") -> list[tuple[str, object]]:
    rows = []
    for key, value in metrics.items():
        if not prefix and key in SHOWN_ELSEWHERE:
            continue
        if isinstance(value, Mapping):
            rows += _flat(value, f"{prefix}{key}.")
        else:
            rows.append((f"{prefix}{key}", value))
    return rows


def _figures(metrics: Mapping[str, object]) -> list[dict[str, str]]:
    """Return the rows of the table of metrics."""
    rows, axes = [], axes_of(metrics)
    lost = "no parallax has been recovered" if shows_parallax(axes) else "they are not told apart"
    words = {"picture": picture_name(axes), "middle": middle_name(axes), "lost": lost}
    for key, value in _flat(metrics):
        name = key.removeprefix("parameters.")
        unknown = Figure(
            name.replace("_", " ").capitalize(), meaning="" if name == key else "of the method"
        )
        figure = FIGURES.get(key, unknown)
        written = _written(value, figure.format, figure.unit)
        label, meaning = figure.label, figure.meaning
        if key in FIGURES:
            label, meaning = label.format(**words), meaning.format(**words)
        rows.append({"key": key, "label": label, "value": written, "meaning": meaning})
    return rows


def _provenance(content: ReportContent) -> dict[str, object]:
    versions = content.metrics.get("versions")
    named = versions if isinstance(versions, Mapping) else {}
    return {
        "Command line": content.command or "not recorded",
        "Seed": _written(content.metrics.get("seed")),
        "Scene": content.scene,
        "Camera": f"{content.camera}: {content.camera_line}",
        "Reference": content.camera_reference,
        "Colour filter": content.cfa,
        **{f"Version of {name}": version for name, version in named.items()},
    }
