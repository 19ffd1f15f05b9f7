"""One self-contained HTML page from the outcome of a run; it opens offline and asks for nothing."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from emmc_rig.formats.format import Export
from emmc_rig.model.camera import Camera
from emmc_rig.model.files import write_text
from emmc_rig.model.view_axes import axes_of, grid_name, middle_name, picture_name, shows_parallax
from emmc_rig.reconstruction.verdict.rules import NOISE
from emmc_rig.report.display import (
    PART_PIXELS,
    DisplayCurve,
    finite,
    heat,
    png_of,
    reduced,
    round_up,
    webp_of,
)
from emmc_rig.report.page import (
    Card,
    Section,
    estimated,
    framed,
    light_field_head,
    part,
    provenance_section,
)
from emmc_rig.report.viewer import poster, viewer_data
from emmc_rig.store.results import stated_words

Array = NDArray[np.floating]
EXPLAINED = 0.25
"""Share of the detail of validation readings below which the card is red."""
CODED_PIXELS, CODED_QUALITY, MIDDLE_PX = 200_000, 75, 48
"""Of the coded frame on the first screen, and the side of the piece that is shown beside it."""
FRAME_PIXELS = 1_500_000
"""Of all frames together, and of the error map; larger ones are shown smaller."""


@dataclass(frozen=True)
class ReportContent:
    """What the report shows. Pictures are linear, float, nominally in [0, 1].

    Shapes: light fields (v, u, y, x, c) with c 1 or 3; frames (shot, y, x); whiteboards (y, x).
    metrics: as in metrics.json. maps: what is laid over the picture in the viewer, by name, see
    `Export`. described: the camera, where Psi knows it. source: the result's folder, as typed.
    """

    title: str
    estimate: Array
    metrics: Mapping[str, Any]
    frames: Array | None = None
    described: Camera | None = None
    truth: Array | None = None
    whiteboards: Sequence[tuple[str, Array]] = ()
    stage_s: Mapping[str, float] = field(default_factory=dict)
    source: str = ""
    maps: Mapping[str, NDArray] = field(default_factory=dict)


def write_report(path: str | Path, content: ReportContent) -> None:
    """Write the page to `path`, whole or not at all.

    Raises OSError when the folder cannot be written.
    """
    write_text(Path(path), render(content))


def render(content: ReportContent) -> str:
    """Return the page as text."""
    metrics, axes = content.metrics, axes_of(content.metrics)
    disparity, sigma, misfit = (content.maps.get(name) for name in ("disparity", "sigma", "misfit"))
    export = Export(
        content.title, "", content.estimate, content.truth, disparity, sigma, misfit,
        view_axes=axes, camera=content.described,
        disparity_sigma=content.maps.get("disparity_sigma"),
    )  # fmt: skip
    turning = "Drag to look from another side, click to focus, scroll to open the aperture."
    if not shows_parallax(axes):
        name = picture_name(axes)
        turning = f"Drag from {name} to {name}; scroll for a mean of several."
    coded = None
    if content.frames is not None:
        coded = _coded(content.frames, _shots(metrics, content.frames))
        views = grid_name(axes, content.estimate.shape[:2])
        turning = f"{coded.frames} in, {views} out. {turning}"
    warnings = _warnings(content)
    return framed(
        content.title,
        [_about(content)],
        head=light_field_head(metrics, content.source),
        lead=part("viewer_section", poster(export, PART_PIXELS), turning, coded)
        + part("cards", _cards(content))
        + (part("notice", "Warnings", warnings) if warnings else ""),
        sections=list(_sections(content)),
        kind="report",
        styles=("viewer.css",),
        scripts=("viewer.js",),
        data={"viewer-data": viewer_data(export, most_pixels=PART_PIXELS)},
    )


def _about(content: ReportContent) -> str:
    """Return the scene and the camera as a sentence."""
    scene, camera, described = *map(content.metrics.get, ("scene", "camera")), content.described
    title = "" if described is None else described.title
    return (
        (Markup("Scene <strong>{}</strong>, ").format(scene) if scene else Markup())
        + (Markup("camera <strong>{}</strong>").format(camera) if camera else "")
        + (": " if camera and title else "")
        + title
    )


def _sections(content: ReportContent) -> Iterator[Section]:
    """Yield the sections after the viewer, all of them folded; for experts the last."""
    if content.frames is not None:
        shots = _shots(content.metrics, content.frames)
        words = "1 shot" if shots == 1 else f"{shots} shots"
        yield Section(
            "captured", "What the sensor recorded", _captured(content.frames, content.described),
            about=f"{words} from which the light field was computed.",
        )  # fmt: skip
    if content.truth is not None:
        yield Section(
            "error", "Where it is wrong", _error(content.estimate, content.truth),
            about="|reconstructed − true| of linear values, mean over colours and "
            f"{picture_name(axes_of(content.metrics))}s; white is 1.",
        )  # fmt: skip
    if content.whiteboards:
        shown = [(label, _pictures(frame[None])[0]) for label, frame in content.whiteboards]
        about = "Three of those from which Psi was measured; 1 is the brightest pixel."
        yield Section("calibration", "Whiteboard frames", part("pictures", shown), about=about)
    if seconds := content.stage_s:
        total_s, longest_s = (max(of(seconds.values()), 1e-12) for of in (sum, max))
        bars = [
            (name, f"{s / longest_s:.1%}", f"{s:.2f} s ({s / total_s:.0%})")
            for name, s in seconds.items()
        ]
        about = f"Seconds of each stage, {sum(seconds.values()):.1f} in all."
        yield Section("timings", "Where the time went", part("bars", bars), about=about)
    listed = _figures(content.metrics)
    result, method = ([row for row in listed if row.of_method == own] for own in (False, True))
    about = "Of accuracy, calibration and capture, each with its unit and meaning."
    yield Section("figures", "All figures", part("figures", result), about=about)
    yield provenance_section(_provenance(content))
    if method:
        about = "Settings and intermediate results, for experts."
        yield Section("method", "Inside the method", part("figures", method), about=about)


class Coded(NamedTuple):
    """What the sensor recorded, as the first screen shows it.

    frames: their number in words. whole, middle: addresses of pictures of the first shot, and of
    the square in its middle. side: of that square, pixels.
    """

    frames: str
    whole: str
    middle: str
    side: int


def _shots(metrics: Mapping[str, Any], frames: Array) -> int:
    """Return the number of shots that the light field was computed from."""
    return metrics.get("shots", len(frames))


def _coded(frames: Array, shots: int) -> Coded:
    """Return the first of frames (shot, y, x) for the first screen."""
    first = finite(frames[:1])
    curve, (rows, columns) = DisplayCurve.fitted_to(first), first.shape[1:]
    side = min(MIDDLE_PX, rows, columns)
    top, left = (rows - side) // 2, (columns - side) // 2
    middle = first[0, top : top + side, left : left + side]
    whole = reduced(first[None, ..., None], CODED_PIXELS)[0, 0, ..., 0]
    words = "One coded frame" if shots == 1 else f"{shots} coded frames"
    whole, middle = curve.encode(whole), curve.encode(middle)
    return Coded(words, webp_of(whole, CODED_QUALITY), png_of(middle), side)


def _captured(frames: Array, camera: Camera | None) -> str:
    """Return frames (shot, y, x) as HTML: pictures on a common scale, and their extremes."""
    known, (_, rows, columns) = finite(frames), frames.shape
    filters = "" if camera is None else f", colour filter {camera.sensor.cfa_name}"
    words = (
        f"{columns} × {rows} pixels{filters}. Normalised values: least {known.min():.3f}, mean "
        f"{known.mean():.3f}, greatest {known.max():.3f} (1 is an open camera before a white "
        "scene)."
    )
    shown = [(f"Shot {shot}", address) for shot, address in enumerate(_pictures(known), 1)]
    return part("lead", words) + part("pictures", shown)


def _pictures(frames: Array) -> list[str]:
    """Return frames (shot, y, x) as addresses of pictures on a common scale."""
    frames = finite(frames)
    curve = DisplayCurve.fitted_to(frames)
    small = reduced(frames[None, ..., None], FRAME_PIXELS)[0, ..., 0]
    return [png_of(curve.encode(frame)) for frame in small]


def _error(estimate: Array, truth: Array) -> str:
    """Return the error averaged over views and colours as HTML: a map, and its scale."""
    absolute = np.abs(finite(estimate) - finite(truth)).mean(axis=(0, 1, -1))
    mean = reduced(absolute[None, None, ..., None], FRAME_PIXELS)[0, 0, ..., 0]
    scale = round_up(float(np.percentile(mean, 99.5)))
    picture = png_of(heat(DisplayCurve(1 / scale, 1.0).encode(mean)))
    return part("heat_map", "Error map", picture, scale)


class Figure(NamedTuple):
    """How one metric is written: label, format, unit, and what it means."""

    label: str
    format: str = ""
    unit: str = ""
    meaning: str = ""


class FigureRow(NamedTuple):
    """A metric as the table of figures shows it; key: its name in metrics.json.

    of_method: the metric describes the method's work, not the result.
    """

    key: str
    label: str
    value: str
    meaning: str
    of_method: bool


ESTIMATES = "logarithm; the accuracy is estimated from it"
FIGURES = {
    "psnr_db": Figure("PSNR", ".2f", "dB", "peak 1, over all {picture}s, pixels and colours"),
    "stated_db": Figure("Estimated accuracy", ".2f", "dB",
        "PSNR, by the method, without the truth"),
    "stated_interval_db": Figure("Its interval", ".1f", "dB",
        "from and to; the true PSNR lies inside in 9 of 10 captures"),
    "ssim": Figure("SSIM", ".4f", "",
        "structural similarity, averaged over {picture}s; 1 is identical"),
    "replicate_psnr_db": Figure("PSNR of the baseline", ".2f", "dB",
        "the true {middle} in all places: below it, {lost}"),
    "psi_relative_error": Figure("Calibration error", ".2%", "",
        "|measured - exact| / |exact|, Euclidean norms"),
    "exact_psi_psnr_db": Figure("PSNR with the exact Psi", ".2f", "dB",
        "same frames, reconstructed without calibration"),
    "calibration_cost_db": Figure("What calibration costs", "z.2f", "dB",
        "PSNR with the exact Psi less PSNR with the measured"),
    "design_relative_error": Figure("Relative error of the design", ".2e", "",
        "|designed - exact| / |exact|: what Psi would be off by without calibration"),
    "psi_mean_deviation": Figure("Mean standard deviation of Psi", ".2e", "",
        "of a coefficient, as stated by the calibration"),
    "noise_sigma": Figure("Noise of the readings", ".2e", "",
        "their standard deviation, as the reconstruction assumed it; 1 is white"),
    "saturated_share": Figure("Saturated readings", ".2%", "", "share excluded as clipped"),
    "whiteboard_frames": Figure("Whiteboard frames", meaning="exposures taken to measure Psi"),
    "status": Figure("Status", meaning="how the solver stopped"),
    "advice": Figure("Advice", meaning="what the solver suggests"),
    "steps": Figure("Steps", meaning="of the solver"),
    "seconds": Figure("Time of the method", ".2f", "s", "without compilation"),
    "compiling_seconds": Figure("Compilation", ".2f", "s", "of kernels, once for every version"),
    "size": Figure("Size", meaning="height and width of a {picture}, pixels"),
    "scene_provenance": Figure("Origin of the scene"),
    "finer": Figure("Finer scene",
        meaning="{picture}s and pixels of the simulated scene for each here"),
    "parameters.noise_sigma": Figure("Noise", ".2e", "",
        "standard deviation of a reading, as the method assumed it; 1 is white"),
    "parameters.lowest_px": Figure("Lowest disparity", ".2f", "px per view", "of the centre view"),
    "parameters.highest_px": Figure("Highest disparity", ".2f", "px per view",
        "of the centre view"),
    "parameters.disparities": Figure("Disparities searched", meaning="how many were tried"),
    "parameters.search_seconds": Figure("Search of disparities", ".2f", "s"),
    "parameters.held_readings": Figure("Validation readings",
        meaning="kept from the fit, to test it on"),
    "parameters.at_end": Figure("Patches at the end of the range", ".1%", "",
        "whose best disparity is the lowest or highest searched; good: at most 1 %"),
    "parameters.dark_edge_px": Figure("Dark edge of the picture", ".0f", "px",
        "the widest one, excluded from the fit: views do not reach there"),
    "parameters.misfit": Figure("Unexplained residual", ".2f", "x noise",
        "root mean square residual of the readings over their noise; good: about 1"),
    "parameters.misfit_row": Figure("Row of the largest residual", ".0f", "px"),
    "parameters.misfit_column": Figure("Column of the largest residual", ".0f", "px"),
    "parameters.decided": Figure("Textured patches with a depth", ".0%", "",
        "whose readings prefer one disparity; good: more than 25 %"),
    "parameters.over_plain": Figure("Residual against total variation", ".2f", "",
        "mean square residual of the validation readings beyond their noise, over that of total "
        "variation; good: below 1"),
    "parameters.stated_apart": Figure("Difference of two estimates", ".2f", "", ESTIMATES),
    "parameters.stated_disparity": Figure("Uncertainty of disparity", ".2f", "", ESTIMATES),
    "parameters.stated_spread": Figure("Spread between models", ".2f", "", ESTIMATES),
    "parameters.stated_contrast": Figure("Contrast of the scene", ".2f", "", ESTIMATES),
    "parameters.stated_tails_db": Figure("Subtracted for few large errors", ".2f", "dB",
        "from the estimated accuracy"),
    "parameters.stated_scale_db": Figure("Scale of the deviation", ".2f", "dB",
        "against what the validation readings show"),
    "parameters.stated_within_db": Figure("Half of the interval", ".2f", "dB",
        "of the estimated accuracy; the true PSNR lies inside in 9 of 10 captures"),
}  # fmt: skip
"""By the name in metrics.json; a figure without a row here is listed under its own name. Braces:
words of the view axes, {picture} and {middle}, and {lost}, the meaning of a negative margin."""
PROVENANCE = {
    "command": "Command line",
    "commit": "Commit",
    "threads": "Threads",
    "seed": "Seed",
    "source": "Frames",
    "scene": "Scene",
    "camera": "Camera",
    "frames_sha256": "SHA-256 of the frames",
    "psi_sha256": "SHA-256 of Psi",
    "psi_file": "Psi",
}
"""Rows of where a result came from, by the name in metrics.json."""
SHOWN_ELSEWHERE = {
    "verdict", "versions", "warnings", "assumed", "estimated_from_frames", "views_not_measured",
    *PROVENANCE,
}  # fmt: skip


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
    """Return the three figures that tell most, each with what is good; none is green in doubt."""
    metrics = content.metrics
    axes = axes_of(metrics)
    fine = "good" if light_field_head(metrics).tone == "good" else ""
    cards = []
    psnr, baseline = _number(metrics.get("psnr_db")), _number(metrics.get("replicate_psnr_db"))
    if psnr is not None:
        note = f"root mean square error {10 ** (-psnr / 20):.1%} of white; the higher the better"
        cards.append(Card("Accuracy (PSNR)", f"{psnr:.1f} dB", note))
    if psnr is not None and baseline is not None:
        note = f"the true {middle_name(axes)} in all places has {baseline:.1f} dB; good: above 0"
        tone = fine if psnr > baseline else "bad"
        cards.append(Card("Over the baseline", f"{psnr - baseline:+.1f} dB", note, tone))
    stated = _number(metrics.get("stated_db"))
    if stated is not None and psnr is None:
        note = f"{stated_words(metrics)}, by the method itself; the higher the better"
        cards.append(Card("Estimated accuracy", f"{stated:.1f} dB", note))
    verdict = metrics.get("verdict")
    evidence = verdict.get("features") or {} if isinstance(verdict, Mapping) else {}
    explained, noise = _number(evidence.get("explained")), _number(evidence.get("noise"))
    if explained is not None:
        note = f"of the detail in validation readings, predicted; good: above {EXPLAINED:.0%}"
        tone = fine if explained > EXPLAINED else "bad"
        cards.append(Card("Explained", f"{max(explained, 0):.0%}", note, tone))
    if noise is not None:
        note = f"of the mean reading; good: below {NOISE.doubt:.0%}"
        tone = fine if noise < NOISE.doubt else "watch"
        cards.append(Card("Noise", f"{noise:.1%}", note, tone))
    if content.stage_s:
        cards.append(Card("Time", f"{sum(content.stage_s.values()):.1f} s", "from scene to page"))
    return cards[:3]


def _warnings(content: ReportContent) -> list[str]:
    warnings = content.metrics.get("warnings") or ()
    broken = int(content.estimate.size - np.count_nonzero(np.isfinite(content.estimate)))
    more = f"The estimate holds {broken} values that are not finite; drawn black."
    return [*warnings, *estimated(content.metrics), *([more] if broken else [])]


def _flat(metrics: Mapping[str, object], prefix: str = "") -> list[tuple[str, object]]:
    rows = []
    for key, value in metrics.items():
        if not prefix and (
            key in SHOWN_ELSEWHERE or (key == "seconds" and isinstance(value, dict))
        ):
            continue
        if isinstance(value, Mapping):
            rows += _flat(value, f"{prefix}{key}.")
        else:
            rows.append((f"{prefix}{key}", value))
    return rows


def _figures(metrics: Mapping[str, object]) -> list[FigureRow]:
    """Return the rows of the table of metrics."""
    rows, axes = [], axes_of(metrics)
    lost = "no parallax has been recovered" if shows_parallax(axes) else "they are not told apart"
    words = {"picture": picture_name(axes), "middle": middle_name(axes), "lost": lost}
    for key, value in _flat(metrics):
        name = key.removeprefix("parameters.")
        figure = FIGURES.get(key, Figure(name.replace("_", " ").capitalize()))
        written = _written(value, figure.format, figure.unit)
        label, meaning = figure.label, figure.meaning
        if key in FIGURES:
            label, meaning = label.format(**words), meaning.format(**words)
        rows.append(FigureRow(key, label, written, meaning, of_method=name != key))
    return rows


def _provenance(content: ReportContent) -> dict[str, object]:
    known, camera = content.metrics, content.described
    rows = {label: known.get(key) for key, label in PROVENANCE.items()}
    if camera is not None:
        rows |= {
            "Description": camera.title,
            "Reference": camera.reference,
            "Colour filter": camera.sensor.cfa_name,
        }
    rows |= {f"Version of {name}": version for name, version in known.get("versions", {}).items()}
    return {label: value for label, value in rows.items() if value not in (None, "")}
