"""One self-contained HTML page from the outcome of a run; it opens offline and asks for nothing."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from emmc_rig.files.formats import Export
from emmc_rig.model.files import write_text
from emmc_rig.pages.display import (
    HEAT,
    PART_BYTES,
    PART_PIXELS,
    TILE_MULTIPLE_PX,
    DisplayCurve,
    finite,
    png_of,
    reduced,
    round_up,
    sprite,
    three_colours,
)
from emmc_rig.pages.page import Card, data_address, fragment, light_field_head
from emmc_rig.pages.psi_panels import psi_panels
from emmc_rig.pages.viewer import poster, viewer_data

Array = NDArray[np.floating]


@dataclass(frozen=True)
class ReportContent:
    """What the report shows. Pictures are linear, float, nominally in [0, 1].

    Shapes: light fields (v, u, y, x, c) with c 1 or 3; frames (shot, y, x); whiteboards (y, x);
    psi and psi_std (v, u, y, x), the weights of shot 0; cfa_tile (y, x, rgb), the colour each
    pixel of the tile lets through. Under a sensor that bins, frames are smaller than views.
    disparity_range_px is in pixels per view step; None where it is not known. maps: what is laid
    over the picture in the viewer, by name, see `Export`. source: the result's folder, as typed.
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
    cfa_tile: Array | None = None
    whiteboards: Sequence[tuple[str, Array]] = ()
    psi: Array | None = None
    psi_std: Array | None = None
    stage_s: Mapping[str, float] = field(default_factory=dict)
    objective: Sequence[float] = ()
    disparity_range_px: tuple[float, float] | None = None
    warnings: Sequence[str] = ()
    command: str = ""
    source: str = ""
    maps: Mapping[str, NDArray] = field(default_factory=dict)

    def __post_init__(self):
        _expect_axes("estimate", self.estimate, "v u y x c")
        _expect_axes("frames", self.frames, "shot y x")
        if self.estimate.shape[-1] not in (1, 3):
            raise ValueError(f"estimate has {self.estimate.shape[-1]} colours; give 1 or 3")
        if self.truth is not None and self.truth.shape != self.estimate.shape:
            raise ValueError(f"truth {self.truth.shape} and estimate {self.estimate.shape} differ")
        if self.psi is not None:
            _expect_axes("psi", self.psi, "v u y x")
        psi_shape = None if self.psi is None else self.psi.shape
        if self.psi_std is not None and self.psi_std.shape != psi_shape:
            raise ValueError("psi_std needs a psi of the same shape")
        for label, frame in self.whiteboards:
            _expect_axes(f"whiteboard {label!r}", frame, "y x")
        if self.cfa_tile is not None:
            _expect_axes("cfa_tile", self.cfa_tile, "y x rgb")


def write_report(path: str | Path, content: ReportContent) -> None:
    """Write the page to `path`, whole or not at all.

    Raises OSError when the folder cannot be written.
    """
    write_text(Path(path), render(content))


def render(content: ReportContent) -> str:
    """Return the page as text."""
    curve = DisplayCurve.fitted_to(content.estimate if content.truth is None else content.truth)
    errors = None if content.truth is None else Errors.between(content.estimate, content.truth)
    rows, columns, height, width, _ = content.estimate.shape
    shown = reduced(content.estimate, PART_PIXELS)
    frames = finite(content.frames)
    disparity, sigma, model, misfit = (
        content.maps.get(name) for name in ("disparity", "sigma", "model", "misfit")
    )
    export = Export(
        content.title, "", content.estimate, content.truth, disparity, sigma, model, misfit
    )
    psi, psi_std = content.psi, content.psi_std
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
        capture={
            "shots": frames.shape[0],
            "height": frames.shape[1],
            "width": frames.shape[2],
            "least": frames.min(),
            "mean": frames.mean(),
            "greatest": frames.max(),
        },
        views={"rows": rows, "columns": columns, "height": height, "width": width},
        shown={"height": shown.shape[2], "width": shown.shape[3]},
        curve=curve,
        view_psnr=[] if errors is None else _view_psnr(errors),
        error_figures={} if errors is None else _error_figures(errors),
        psi=None
        if psi is None
        else psi_panels(
            (rows, columns),
            lambda v, u: psi[v, u],
            None if psi_std is None else lambda v, u: psi_std[v, u],
        ),
        convergence=_convergence(content.objective),
        timings=_timings(content.stage_s),
        figures=_figures(content.metrics),
        provenance=_provenance(content),
        data={
            "data": _page_data(content, shown, curve, errors),
            "viewer-data": viewer_data(export, atlases=False, most_pixels=PART_PIXELS),
        },
        poster=poster(export, PART_PIXELS),
        scripts=("viewer.js", "report.js"),
    )


@dataclass(frozen=True)
class Errors:
    """Estimate less truth, averaged over colours: absolute and squared, both (v, u, y, x)."""

    absolute: Array
    squared: Array

    @classmethod
    def between(cls, estimate: Array, truth: Array) -> Errors:
        """Errors of an estimate; values that are not finite count as 0, or 1 for +infinity."""
        difference = finite(estimate) - finite(truth)
        return cls(np.abs(difference).mean(axis=-1), np.square(difference).mean(axis=-1))


def _expect_axes(name: str, array: Array, axes: str) -> None:
    if array.ndim != len(axes.split()) or array.size == 0:
        raise ValueError(f"{name} has shape {array.shape}; expected axes ({axes})")


def _page_data(
    content: ReportContent, estimate: Array, curve: DisplayCurve, errors: Errors | None
) -> dict[str, object]:
    """Return what report.js draws; estimate: the views, small enough for one picture."""
    rows, columns, height, width, _ = estimate.shape
    shots_curve = DisplayCurve.fitted_to(content.frames)  # one for all, so that shots compare
    data = {
        "views": {"rows": rows, "columns": columns, "height": height, "width": width},
        "nativeWidth": content.estimate.shape[3],
        "tileMultiple": TILE_MULTIPLE_PX,
        "gamma": curve.gamma,
        "disparity": _slider_range(content.disparity_range_px),
        "heat": HEAT,
        "estimate": sprite(three_colours(curve.encode(estimate)), PART_BYTES),
        "truth": None,
        "error": None,
        "shots": [
            _frame(f"Shot {i + 1}", frame, shots_curve) for i, frame in enumerate(content.frames)
        ],
        "whiteboards": [
            _frame(label, frame, DisplayCurve.fitted_to(frame))
            for label, frame in content.whiteboards
        ],
        "cfaTile": None if content.cfa_tile is None else _cfa_colours(content.cfa_tile),
    }
    if content.truth is not None and errors is not None:
        truth = reduced(content.truth, PART_PIXELS)
        data["truth"] = sprite(three_colours(curve.encode(truth)), PART_BYTES)
        data["error"] = _error_data(errors)
    return data


def _error_data(errors: Errors) -> dict[str, object]:
    """Pictures of the error per view, and averaged over views, on one scale."""
    views = reduced(errors.absolute[..., None], PART_PIXELS)
    scale = round_up(float(np.percentile(views, 99.5)))
    encode = DisplayCurve(1 / scale, 1.0).encode
    return {
        "scale": scale,
        "views": sprite(encode(views), PART_BYTES // 2),
        "mean": png_of(encode(views[..., 0].mean(axis=(0, 1)))),
    }


def _frame(label: str, frame: Array, curve: DisplayCurve) -> dict[str, object]:
    """A frame as a lossless picture, with what turns its levels back into values."""
    return {
        "label": label,
        "white": 1 / curve.gain,
        "gamma": curve.gamma,
        "picture": png_of(curve.encode(frame)),
    }


def _cfa_colours(tile: Array) -> list[object]:
    rgb = finite(tile)
    brightest = np.maximum(rgb.max(axis=-1, keepdims=True), 1e-6)
    return (rgb / brightest).round(3).tolist()


def _slider_range(disparity_px: tuple[float, float] | None) -> list[float]:
    """The slider's ends: the scene's disparities and a quarter of their span to either side."""
    if disparity_px is None or not all(math.isfinite(end) for end in disparity_px):
        return [-2.0, 2.0]
    low, high = min(disparity_px), max(disparity_px)
    margin = max(0.25 * (high - low), 0.2)
    return [round(low - margin, 2), round(high + margin, 2)]


class Figure(NamedTuple):
    """How one metric is written: label, format, unit, and what it means."""

    label: str
    format: str = ""
    unit: str = ""
    meaning: str = ""


FIGURES = {
    "psnr_db": Figure("PSNR", ".2f", "dB", "peak 1, over all views, pixels and colours"),
    "ssim": Figure("SSIM", ".4f", "", "structural similarity, averaged over views; 1 is identical"),
    "replicate_psnr_db": Figure(
        "PSNR of the copied centre view",
        ".2f",
        "dB",
        "the true centre view copied to all views: below it, no parallax has been recovered",
    ),
    "psi_relative_error": Figure(
        "Relative error of Psi", ".2e", "", "|measured - exact| / |exact|, Euclidean norms"
    ),
    "exact_psi_psnr_db": Figure(
        "PSNR with the exact Psi", ".2f", "dB", "same frames, reconstructed without calibration"
    ),
    "calibration_cost_db": Figure(
        "What calibration costs",
        "z.2f",
        "dB",
        "PSNR with the exact Psi less PSNR with the measured",
    ),
    "design_relative_error": Figure(
        "Relative error of the design",
        ".2e",
        "",
        "|designed - exact| / |exact|: what Psi would be off by without calibration",
    ),
    "psi_mean_deviation": Figure(
        "Mean standard deviation of Psi", ".2e", "", "of one coefficient, as calibration states it"
    ),
    "noise_sigma": Figure(
        "Noise of the readings",
        ".2e",
        "",
        "their standard deviation, as the reconstruction took it",
    ),
    "saturated_share": Figure("Saturated readings", ".2%", "", "share left out as clipped"),
    "whiteboard_frames": Figure("Whiteboard frames", "", "", "exposures taken to measure Psi"),
    "method": Figure("Method", "", "", ""),
    "status": Figure("Status", "", "", "how the solver stopped"),
    "advice": Figure("Advice", "", "", "what the solver suggests"),
    "seed": Figure("Seed", "", "", "same seed, same result"),
    "steps": Figure("Steps", "", "", "of the solver"),
    "size": Figure("Size", "", "", "height and width of a view, pixels"),
    "shots": Figure("Shots", "", "", ""),
    "scene": Figure("Scene", "", "", ""),
    "scene_provenance": Figure("Origin of the scene", "", "", ""),
    "camera": Figure("Camera", "", "", ""),
    "finer": Figure("Finer scene", "", "", "views and pixels of the simulated scene for each here"),
}
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
        return ", ".join(_written(item) for item in value) if joined else str(value)
    text = format(number, spec) if spec else (f"{number:.6g}" if isinstance(value, float) else "")
    return f"{text or value} {unit}".rstrip()


def _cards(content: ReportContent) -> list[Card]:
    metrics = content.metrics
    compared = content.truth is not None
    no_truth = "" if compared else "no true light field to compare with"
    psnr, replicate = _number(metrics.get("psnr_db")), _number(metrics.get("replicate_psnr_db"))
    exact, cost = metrics.get("exact_psi_psnr_db"), metrics.get("calibration_cost_db")
    if psnr is not None and replicate is not None:
        gain = psnr - replicate
        versus = Card(
            "Over centre view",
            f"{gain:+.2f} dB",
            f"copying the true centre view gives {replicate:.2f} dB",
            "good" if gain > 0 else "bad",
        )
    else:
        versus = Card("Over centre view", "not measured", no_truth)
    psi_error = _number(metrics.get("psi_relative_error"))
    known_psi = "not measured" if psi_error is None else f"{100 * psi_error:.2f} %"
    status = str(metrics.get("status") or "not measured")
    total_s = sum(seconds for seconds in content.stage_s.values() if math.isfinite(seconds))
    stages = {name: s for name, s in content.stage_s.items() if math.isfinite(s)}
    longest = max(stages, key=lambda name: stages[name], default=None)
    return [
        Card(
            "PSNR",
            _written(metrics.get("psnr_db"), ".2f", "dB"),
            "peak 1, all views, pixels and colours" if compared else no_truth,
        ),
        versus,
        Card("SSIM", _written(metrics.get("ssim"), ".4f"), "1 is identical"),
        Card("Error of Psi", known_psi, "|measured - exact| / |exact|"),
        *([] if exact is None else [_cost_card(exact, cost)]),
        Card(
            "Time",
            f"{total_s:.1f} s" if stages else "not measured",
            "" if longest is None else f"of which {longest} {stages[longest]:.1f} s",
        ),
        Card(
            "Solver",
            status,
            str(metrics.get("advice") or metrics.get("method") or ""),
            "good" if status.startswith("converged") else "watch",
        ),
    ]


def _cost_card(exact_db: object, cost_db: object) -> Card:
    with_exact = f"with the exact Psi: {_written(exact_db, '.2f', 'dB')}"
    return Card("Calibration costs", _written(cost_db, "z.2f", "dB"), with_exact)


def _warnings(content: ReportContent) -> list[str]:
    warnings = list(content.warnings)
    broken = int(content.estimate.size - np.count_nonzero(np.isfinite(content.estimate)))
    if broken:
        warnings.append(f"The estimate holds {broken} values that are not finite; drawn black.")
    return warnings


def _view_psnr(errors: Errors) -> list[dict[str, object]]:
    """Return the PSNR of each view, and how light its button is."""
    with np.errstate(divide="ignore"):
        psnr_db = -10 * np.log10(errors.squared.mean(axis=(2, 3)))
    known = psnr_db[np.isfinite(psnr_db)]
    low, span = (float(known.min()), float(np.ptp(known))) if known.size else (0.0, 0.0)
    views = []
    for (v, u), value in np.ndenumerate(psnr_db):
        share = 1.0 if not math.isfinite(value) else (value - low) / span if span > 0 else 0.5
        words = f"{value:.1f}" if math.isfinite(value) else "exact"
        views.append({"v": v, "u": u, "words": words, "lightness": f"{96 - 26 * share:.0f}"})
    return views


def _error_figures(errors: Errors) -> dict[str, str]:
    """Return how the error is spread."""
    squared = errors.squared.reshape(-1)
    worst = max(1, squared.size // 20)
    worst_sum = float(np.partition(squared, -worst)[-worst:].sum(dtype=np.float64))
    total = float(squared.sum(dtype=np.float64))
    mean = float(errors.absolute.mean(dtype=np.float64))
    median, high, highest = np.percentile(errors.absolute, [50, 95, 99])
    return {
        "Mean": f"{mean:.4f}",
        "Median": f"{median:.4f}",
        "95 % of pixels below": f"{high:.4f}",
        "99 % of pixels below": f"{highest:.4f}",
        "Squared error in the worst 5 % of pixels": (
            f"{100 * worst_sum / total:.0f} %" if total > 0 else "no error"
        ),
    }


class Curve(NamedTuple):
    """A line over the solver's steps: what it is, its ends in words, its picture's address."""

    name: str
    ends: str
    picture: str


def _curve(name: str, first_step: int, values: Sequence[float], logarithmic: bool) -> list[Curve]:
    """Return a line; values that cannot be drawn are left out, and none is where few can."""
    points = [
        (first_step + i, value)
        for i, value in enumerate(values)
        if math.isfinite(value) and (value > 0 or not logarithmic)
    ]
    if len(points) < 2:
        return []
    # matplotlib loads for half a second: here only.
    from matplotlib.ticker import MaxNLocator

    from emmc_rig.pages.drawing import ACCENT, sheet, svg_of, titled

    figure, (axes,) = sheet(1, 6.2, 2.7, "")
    axes.plot(*zip(*points, strict=True), color=ACCENT, linewidth=2)
    if logarithmic:
        axes.set_yscale("log")
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    titled(axes, "", "recorded step")
    ends = f"{values[0]:.4g} to {values[-1]:.4g} over {len(values)} values"
    return [Curve(name, ends, data_address(svg_of(figure), ".svg"))]


def _convergence(objective: Sequence[float]) -> list[Curve]:
    values = [float(value) for value in objective]
    drawable = [value for value in values if math.isfinite(value)]
    if len(drawable) < 2:
        return []
    wide = min(drawable) > 0 and max(drawable) / min(drawable) > 20
    scale = ", logarithmic" if wide else ""
    change = [
        abs(b - a) / abs(b) if math.isfinite(a) and math.isfinite(b) and b != 0 else math.nan
        for a, b in itertools.pairwise(values)
    ]
    return [
        *_curve(f"Objective{scale}:", 1, values, wide),
        *_curve("Relative change:", 2, change, True),
    ]


def _timings(stage_s: Mapping[str, float]) -> dict[str, object] | None:
    """Return the seconds of each stage as bars with words, and their sum; None without any."""
    if not stage_s:
        return None
    known = {name: float(s) if math.isfinite(s) else 0.0 for name, s in stage_s.items()}
    total_s = sum(known.values())
    longest_s = max(*known.values(), 1e-12)
    stages = [
        {
            "name": name,
            "width": f"{known[name] / longest_s:.1%}",
            "words": f"{s:.2f} s ({s / max(total_s, 1e-12):.0%})"
            if math.isfinite(s)
            else _written(s),
        }
        for name, s in stage_s.items()
    ]
    return {"stages": stages, "total_s": total_s}


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


def _of_the_method(key: str) -> Figure:
    """Return how a figure is written that only its method knows."""
    name = key.removeprefix("parameters.")
    return Figure(name.replace("_", " "), "", "", "" if name == key else "of the method")


def _figures(metrics: Mapping[str, object]) -> list[dict[str, str]]:
    """Return the rows of the table of metrics."""
    rows = []
    for key, value in _flat(metrics):
        figure = FIGURES.get(key) or _of_the_method(key)
        written = _written(value, figure.format, figure.unit)
        rows.append(
            {"key": key, "label": figure.label, "value": written, "meaning": figure.meaning}
        )
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
