"""One self-contained HTML page from the outcome of a run; it opens offline and asks for nothing."""

import base64
import html
import itertools
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.files import write_text
from emmc_rig.version import __version__

Array = NDArray[np.floating]

JPEG_QUALITY = 88
ERROR_JPEG_QUALITY = 72  # an error map is mostly noise, and noise is what costs bytes
TILE_MULTIPLE_PX = 16  # a JPEG block never straddles two views
SPRITE_PIXELS = 24_000_000  # canvases above this fail on small machines; larger views are reduced
DETAIL_PX = 40  # side of the piece of a Psi slice shown pixel for pixel
THUMBNAIL_PX = 120  # side of a whole Psi slice
HEAT = (
    (13, 16, 38),
    (62, 46, 128),
    (160, 56, 132),
    (234, 104, 80),
    (250, 206, 104),
    (255, 252, 232),
)


@dataclass(frozen=True)
class ReportContent:
    """What the report shows. Pictures are linear, float, nominally in [0, 1].

    Shapes: light fields (v, u, y, x, c) with c 1 or 3; frames (shot, y, x); whiteboards (y, x);
    psi and psi_std (v, u, y, x), the weights of shot 0; cfa_tile (y, x, rgb), the colour each
    pixel of the tile lets through. Under a sensor that bins, frames are smaller than views.
    disparity_range_px is in pixels per view step; None where it is not known.
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
    """The page as text."""
    template = resources.files("emmc_rig.pages").joinpath("report.html").read_text("utf-8")
    curve = DisplayCurve.fitted_to(content.estimate if content.truth is None else content.truth)
    errors = None if content.truth is None else Errors.between(content.estimate, content.truth)
    parts = {
        "title": text_of(content.title),
        "generator": text_of(f"emmc-rig {__version__}"),
        "scene": text_of(content.scene),
        "camera": text_of(content.camera),
        "camera_line": text_of(content.camera_line),
        "camera_reference": text_of(content.camera_reference),
        "warnings": _warnings(content),
        "cards": _cards(content),
        "capture_note": _capture_note(content),
        "display_note": _display_note(content, curve),
        "has_truth": "yes" if content.truth is not None else "no",
        "view_psnr": "" if errors is None else _view_psnr(errors),
        "error_figures": "" if errors is None else _error_figures(errors),
        "psi": _psi(content),
        "convergence": _convergence(content.objective),
        "timings": _timings(content.stage_s),
        "metrics": _metrics_table(content.metrics),
        "provenance": _provenance(content),
        "heat": ", ".join(f"rgb{stop}" for stop in HEAT),
        "data": _page_data(content, curve, errors),
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], template)


@dataclass(frozen=True)
class DisplayCurve:
    """How linear values become screen values: (gain x value) ^ (1 / gamma), 8 bits."""

    gain: float
    gamma: float

    @classmethod
    def fitted_to(cls, picture: Array) -> "DisplayCurve":
        """Highlights at white, and the median of a dark scene lifted towards middle grey."""
        sample = _finite(picture.reshape(-1)[::7])
        white = max(float(np.percentile(sample, 99.7)), 1e-6)
        median = min(max(float(np.median(sample)) / white, 1e-3), 0.99)
        return cls(1 / white, min(max(math.log(median) / math.log(0.36), 1.0), 2.2))

    def encode(self, linear: Array) -> NDArray[np.uint8]:
        """Screen values of linear ones, any shape."""
        levels = np.clip(_finite(linear) * np.float32(self.gain), 0, 1)
        np.power(levels, np.float32(1 / self.gamma), out=levels)
        return (levels * 255 + 0.5).astype(np.uint8)


@dataclass(frozen=True)
class Errors:
    """Estimate less truth, averaged over colours: absolute and squared, both (v, u, y, x)."""

    absolute: Array
    squared: Array

    @classmethod
    def between(cls, estimate: Array, truth: Array) -> "Errors":
        """Errors of an estimate; values that are not finite count as 0, or 1 for +infinity."""
        difference = _finite(estimate) - _finite(truth)
        return cls(np.abs(difference).mean(axis=-1), np.square(difference).mean(axis=-1))


def _expect_axes(name: str, array: Array, axes: str) -> None:
    if array.ndim != len(axes.split()) or array.size == 0:
        raise ValueError(f"{name} has shape {array.shape}; expected axes ({axes})")


def _finite(values: Array) -> NDArray[np.float32]:
    values = np.asarray(values, np.float32)
    if np.isfinite(values.sum(dtype=np.float64)):  # cheaper than asking every value
        return values
    return np.nan_to_num(values, nan=0.0, posinf=1.0, neginf=0.0)


def text_of(value: object) -> str:
    """Text for the page, escaped."""
    return html.escape(str(value), quote=True)


# Pictures


def _data_uri(image: NDArray[np.uint8], extension: str, *options: int) -> str:
    done, encoded = cv2.imencode(extension, image, options)
    if not done:
        raise ValueError(f"cannot encode a picture of shape {image.shape} as {extension}")
    kind = {".jpg": "image/jpeg", ".png": "image/png"}[extension]
    return f"data:{kind};base64,{base64.b64encode(encoded.tobytes()).decode()}"


def png_of(image: NDArray[np.uint8]) -> str:
    """A lossless picture as an address that holds it."""
    return _data_uri(image, ".png", cv2.IMWRITE_PNG_COMPRESSION, 6)


def _sprite(views: NDArray[np.uint8], quality: int) -> str:
    """All views of (v, u, y, x, c) in one JPEG, each padded to whole JPEG blocks.

    Colour is kept at full resolution: half-resolution chroma bleeds from view to view.
    """
    rows, columns, height, width, colours = views.shape
    padding = [(0, -height % TILE_MULTIPLE_PX), (0, -width % TILE_MULTIPLE_PX)]
    padded = np.pad(views, [(0, 0), (0, 0), *padding, (0, 0)], mode="edge")
    tiled = padded.transpose(0, 2, 1, 3, 4).reshape(
        rows * padded.shape[2], columns * padded.shape[3], colours
    )
    if colours == 3:
        tiled = np.ascontiguousarray(tiled[..., ::-1])  # OpenCV's channel order
    return _data_uri(
        tiled,
        ".jpg",
        cv2.IMWRITE_JPEG_QUALITY,
        quality,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
    )


def _reduced(views: Array) -> Array:
    """Views small enough for one sprite; the same array when they already are."""
    rows, columns, height, width, colours = views.shape
    shrink = math.sqrt(SPRITE_PIXELS / (rows * columns * height * width))
    if shrink >= 1:
        return views
    size = (max(1, int(width * shrink)), max(1, int(height * shrink)))
    small = [
        cv2.resize(_finite(view), size, interpolation=cv2.INTER_AREA)
        for view in views.reshape(-1, height, width, colours)
    ]
    shape = (rows, columns, size[1], size[0], colours)
    return np.asarray(small, np.float32).reshape(shape)


def _three_colours(views: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.repeat(views, 3, axis=-1) if views.shape[-1] == 1 else views


def _round_up(value: float) -> float:
    """The next of 1, 1.5, 2, 3, 5, 7 times a power of ten: a readable end of a scale."""
    if not math.isfinite(value) or value <= 0:
        return 1.0
    decade = 10.0 ** math.floor(math.log10(value))
    end = next(step * decade for step in (1, 1.5, 2, 3, 5, 7, 10) if step * decade >= value)
    return float(f"{end:.2g}")  # 0.15, not 0.15000000000000002


def _page_data(content: ReportContent, curve: DisplayCurve, errors: "Errors | None") -> str:
    estimate = _reduced(content.estimate)
    rows, columns, height, width, _ = estimate.shape
    shots_curve = DisplayCurve.fitted_to(content.frames)  # one for all, so that shots compare
    data = {
        "views": {"rows": rows, "columns": columns, "height": height, "width": width},
        "nativeWidth": content.estimate.shape[3],
        "tileMultiple": TILE_MULTIPLE_PX,
        "gamma": curve.gamma,
        "disparity": _slider_range(content.disparity_range_px),
        "heat": HEAT,
        "estimate": _sprite(_three_colours(curve.encode(estimate)), JPEG_QUALITY),
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
        truth = _reduced(content.truth)
        data["truth"] = _sprite(_three_colours(curve.encode(truth)), JPEG_QUALITY)
        data["error"] = _error_data(errors)
    return json.dumps(data, allow_nan=False).replace("<", "\\u003c")


def _error_data(errors: "Errors") -> dict[str, object]:
    """Pictures of the error per view, and averaged over views, on one scale."""
    views = _reduced(errors.absolute[..., None])
    scale = _round_up(float(np.percentile(views, 99.5)))
    encode = DisplayCurve(1 / scale, 1.0).encode
    return {
        "scale": scale,
        "views": _sprite(encode(views), ERROR_JPEG_QUALITY),
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
    rgb = _finite(tile)
    brightest = np.maximum(rgb.max(axis=-1, keepdims=True), 1e-6)
    return (rgb / brightest).round(3).tolist()


def _slider_range(disparity_px: tuple[float, float] | None) -> list[float]:
    """The slider's ends: the scene's disparities and a quarter of their span to either side."""
    if disparity_px is None or not all(math.isfinite(end) for end in disparity_px):
        return [-2.0, 2.0]
    low, high = min(disparity_px), max(disparity_px)
    margin = max(0.25 * (high - low), 0.2)
    return [round(low - margin, 2), round(high + margin, 2)]


# Figures as text


@dataclass(frozen=True)
class Figure:
    """How one metric is written: label, format, unit, and what it means."""

    label: str
    format: str
    unit: str
    meaning: str


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
        "Noise of the readings", ".2e", "", "standard deviation that the reconstruction was told"
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


def card(label: str, value: str, note: str, tone: str = "") -> str:
    """A figure in a frame: good, watch, bad or plain."""
    words = "" if any(letter.isdigit() for letter in value) else "words"
    return (
        f'<div class="card {words} {tone}"><h3>{text_of(label)}</h3>'
        f'<p class="value">{text_of(value)}</p><p class="note">{text_of(note)}</p></div>'
    )


def _cards(content: ReportContent) -> str:
    metrics = content.metrics
    compared = content.truth is not None
    no_truth = "" if compared else "no true light field to compare with"
    psnr, replicate = _number(metrics.get("psnr_db")), _number(metrics.get("replicate_psnr_db"))
    exact, cost = metrics.get("exact_psi_psnr_db"), metrics.get("calibration_cost_db")
    if psnr is not None and replicate is not None:
        gain = psnr - replicate
        versus = card(
            "Over centre view",
            f"{gain:+.2f} dB",
            f"copying the true centre view gives {replicate:.2f} dB",
            "good" if gain > 0 else "bad",
        )
    else:
        versus = card("Over centre view", "not measured", no_truth)
    psi_error = _number(metrics.get("psi_relative_error"))
    known_psi = "not measured" if psi_error is None else f"{100 * psi_error:.2f} %"
    status = str(metrics.get("status") or "not measured")
    total_s = sum(seconds for seconds in content.stage_s.values() if math.isfinite(seconds))
    stages = {name: s for name, s in content.stage_s.items() if math.isfinite(s)}
    longest = max(stages, key=lambda name: stages[name], default=None)
    return "".join(
        (
            card(
                "PSNR",
                _written(metrics.get("psnr_db"), ".2f", "dB"),
                "peak 1, all views, pixels and colours" if compared else no_truth,
            ),
            versus,
            card("SSIM", _written(metrics.get("ssim"), ".4f"), "1 is identical"),
            card("Error of Psi", known_psi, "|measured - exact| / |exact|"),
            card(
                "Calibration costs",
                _written(cost, "z.2f", "dB"),
                f"with the exact Psi: {_written(exact, '.2f', 'dB')}"
                if _number(exact) is not None
                else "needs a run with the exact Psi",
            ),
            card(
                "Time",
                f"{total_s:.1f} s" if stages else "not measured",
                "" if longest is None else f"of which {longest} {stages[longest]:.1f} s",
            ),
            _verdict_card(metrics.get("verdict")),
            card(
                "Solver",
                status,
                str(metrics.get("advice") or metrics.get("method") or ""),
                "good" if status.startswith("converged") else "watch",
            ),
        )
    )


def _verdict_card(verdict: object) -> str:
    """Return whether to trust the light field, with the gravest reason."""
    if not isinstance(verdict, dict):
        return card("Verdict", "not judged", "")
    told = [f"{reason['what']}; {reason['remedy']}" for reason in verdict["reasons"]]
    level = verdict["level"]
    return card(
        "Verdict",
        level,
        told[0] if told else "nothing in frames, Psi and light field speaks against it",
        {"trust": "good", "doubt": "watch"}.get(level, "bad"),
    )


def _warnings(content: ReportContent) -> str:
    warnings = list(content.warnings)
    broken = int(content.estimate.size - np.count_nonzero(np.isfinite(content.estimate)))
    if broken:
        warnings.append(f"The estimate holds {broken} values that are not finite; drawn black.")
    if not warnings:
        return ""
    items = "".join(f"<li>{text_of(warning)}</li>" for warning in warnings)
    return (
        f'<aside class="warnings" aria-label="Warnings"><h2>Warnings</h2><ul>{items}</ul></aside>'
    )


def _capture_note(content: ReportContent) -> str:
    shots, height, width = content.frames.shape
    values = _finite(content.frames)
    plural = "shot" if shots == 1 else "shots"
    return (
        f"{shots} {plural} of {width} × {height} pixels, colour filter {text_of(content.cfa)}. "
        f"Normalised values: least {values.min():.3f}, mean {values.mean():.3f}, "
        f"greatest {values.max():.3f} (1 is an open camera before a white scene)."
    )


def _display_note(content: ReportContent, curve: DisplayCurve) -> str:
    rows, columns, height, width, _ = content.estimate.shape
    shown = _reduced(content.estimate).shape
    small = "" if shown[3] == width else f" Shown at {shown[3]} × {shown[2]} pixels."
    brightness = f"{curve.gain:.2f} × linear value"
    if curve.gamma > 1:
        brightness = f"({brightness})<sup>1/{curve.gamma:.2f}</sup>"
    return (
        f"{rows} × {columns} views of {width} × {height} pixels.{small} "
        f"Screen value = {brightness}, "
        f"the same for both sides; pictures are JPEG at quality {JPEG_QUALITY}. "
        "Every figure is computed on the linear values, not on these pictures."
    )


def _view_psnr(errors: Errors) -> str:
    """PSNR of each view as a grid of buttons that choose the view."""
    with np.errstate(divide="ignore"):
        psnr_db = -10 * np.log10(errors.squared.mean(axis=(2, 3)))
    finite = psnr_db[np.isfinite(psnr_db)]
    low, span = (float(finite.min()), float(np.ptp(finite))) if finite.size else (0.0, 0.0)
    buttons = []
    for (v, u), value in np.ndenumerate(psnr_db):
        share = 1.0 if not math.isfinite(value) else (value - low) / span if span > 0 else 0.5
        shade = f"background:hsl(212 60% {96 - 26 * share:.0f}%)"
        figure = f"{value:.1f}" if math.isfinite(value) else "exact"
        buttons.append(
            f'<button type="button" data-v="{v}" data-u="{u}" style="{shade}" '
            f'aria-label="View row {v}, column {u}: {figure} dB">{figure}</button>'
        )
    return "".join(buttons)


def _error_figures(errors: Errors) -> str:
    """How the error is spread, as the rows of a table."""
    squared = errors.squared.reshape(-1)
    worst = max(1, squared.size // 20)
    worst_sum = float(np.partition(squared, -worst)[-worst:].sum(dtype=np.float64))
    total = float(squared.sum(dtype=np.float64))
    mean = float(errors.absolute.mean(dtype=np.float64))
    median, high, highest = np.percentile(errors.absolute, [50, 95, 99])
    rows = (
        ("Mean", f"{mean:.4f}"),
        ("Median", f"{median:.4f}"),
        ("95 % of pixels below", f"{high:.4f}"),
        ("99 % of pixels below", f"{highest:.4f}"),
        (
            "Squared error in the worst 5 % of pixels",
            f"{100 * worst_sum / total:.0f} %" if total > 0 else "no error",
        ),
    )
    return "".join(f'<tr><th scope="row">{name}</th><td>{value}</td></tr>' for name, value in rows)


# Psi


def _montage(tiles: NDArray[np.uint8], gap_px: int) -> NDArray[np.uint8]:
    """(v, u, y, x) or (v, u, y, x, c) as one picture with white gaps."""
    around = [(0, 0)] * tiles.ndim
    around[2] = around[3] = (0, gap_px)
    padded = np.pad(tiles, around, constant_values=255)
    order = (0, 2, 1, 3, *range(4, tiles.ndim))
    rows, columns, height, width = padded.shape[:4]
    sheet = padded.transpose(order).reshape(rows * height, columns * width, *tiles.shape[4:])
    return np.ascontiguousarray(sheet[:-gap_px, :-gap_px])


def _heat(levels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Grey levels through the heat colours, in OpenCV's channel order."""
    at = np.linspace(0, 255, len(HEAT))
    table = [np.interp(np.arange(256), at, channel) for channel in zip(*HEAT, strict=True)]
    return np.stack(table[::-1], axis=-1).round().astype(np.uint8)[levels]


def _centre(slices: Array) -> Array:
    height, width = slices.shape[2:]
    top, left = max((height - DETAIL_PX) // 2, 0), max((width - DETAIL_PX) // 2, 0)
    return slices[:, :, top : top + DETAIL_PX, left : left + DETAIL_PX]


def _thumbnails(slices: Array) -> Array:
    rows, columns, height, width = slices.shape
    shrink = min(1.0, THUMBNAIL_PX / max(height, width))
    size = (max(1, round(width * shrink)), max(1, round(height * shrink)))
    small = [
        cv2.resize(_finite(one), size, interpolation=cv2.INTER_AREA)
        for one in slices.reshape(-1, height, width)
    ]
    return np.asarray(small, np.float32).reshape(rows, columns, size[1], size[0])


def _psi_panel(name: str, note: str, picture: str, scale: float, ramp: str) -> str:
    return (
        f"<figure><figcaption><strong>{text_of(name)}</strong> {text_of(note)}</figcaption>"
        f'<img class="pixels" src="{picture}" alt="{text_of(name)}: {text_of(note)}">'
        f'<div class="bar"><span>0</span><i class="{ramp}"></i><span>{scale:.3g}</span></div>'
        "</figure>"
    )


def _psi(content: ReportContent) -> str:
    if content.psi is None:
        return '<p class="quiet">No imaging matrix was handed to this report.</p>'
    return psi_panels(content.psi, content.psi_std)


def psi_panels(psi: Array, psi_std: Array | None) -> str:
    """Slices of Psi, and of its standard deviation, both (v, u, y, x), as figures of a page."""
    rows, columns = psi.shape[:2]
    layout = f"rows are v 0 to {rows - 1} downwards, columns u 0 to {columns - 1}"
    whole = _thumbnails(psi)
    whole_scale = _round_up(float(np.percentile(whole, 99.9)))
    piece = _finite(_centre(psi))
    piece_scale = _round_up(float(np.percentile(piece, 99.9)))
    side = f"{piece.shape[3]} × {piece.shape[2]}"
    panels = [
        _psi_panel(
            "Whole field",
            f"one tile per view, averaged down; {layout}",
            png_of(_montage(DisplayCurve(1 / whole_scale, 1.0).encode(whole), 3)),
            whole_scale,
            "grey",
        ),
        _psi_panel(
            "Centre, pixel for pixel",
            f"the middle {side} pixels of each view's weights",
            png_of(_montage(DisplayCurve(1 / piece_scale, 1.0).encode(piece), 2)),
            piece_scale,
            "grey",
        ),
    ]
    if psi_std is not None:
        std = _finite(_centre(psi_std))
        std_scale = _round_up(float(np.percentile(std, 99.9)))
        typical = float(np.median(_finite(psi_std)))
        panels.append(
            _psi_panel(
                "Its standard deviation",
                f"same pixels; median over all coefficients {typical:.2g}",
                png_of(_montage(_heat(DisplayCurve(1 / std_scale, 1.0).encode(std)), 2)),
                std_scale,
                "heat",
            )
        )
    return f'<div class="psi">{"".join(panels)}</div>'


# Charts


def _ticks(low: float, high: float, about: int) -> list[float]:
    if high <= low:
        return [low]
    raw = (high - low) / about
    decade = 10.0 ** math.floor(math.log10(raw))
    step = next(s * decade for s in (1, 2, 2.5, 5, 10) if s * decade >= raw * 0.999)
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]


def _log_ticks(low: float, high: float) -> list[float]:
    """Powers of ten between, thinned to at most seven."""
    powers = list(range(math.ceil(low - 1e-9), math.floor(high + 1e-9) + 1))
    return [float(power) for power in powers[:: max(1, math.ceil(len(powers) / 7))]]


def _curve_chart(name: str, first_step: int, values: Sequence[float], logarithmic: bool) -> str:
    """A line over the solver's steps as inline SVG; values that cannot be drawn are left out."""
    points = [
        (first_step + i, math.log10(value) if logarithmic else value)
        for i, value in enumerate(values)
        if math.isfinite(value) and (value > 0 or not logarithmic)
    ]
    if len(points) < 2:
        return ""
    width, height, left, right, top, bottom = 620, 270, 74, 14, 14, 44
    steps, levels = [p[0] for p in points], [p[1] for p in points]
    low, high = min(levels), max(levels)
    span = (high - low) or max(abs(high), 1.0) * 0.1
    low, high = low - 0.05 * span, high + 0.05 * span
    last_step = max(steps[-1], steps[0] + 1)

    def across(step: float) -> float:
        return left + (step - steps[0]) / (last_step - steps[0]) * (width - left - right)

    def up(level: float) -> float:
        return top + (high - level) / (high - low) * (height - top - bottom)

    marks = _log_ticks(low, high) if logarithmic else _ticks(low, high, 5)
    if logarithmic and len(marks) < 2:
        marks = _ticks(low, high, 4)
    grid = []
    for mark in marks:
        text = f"{10**mark:.3g}" if logarithmic else f"{mark:.6g}"
        grid.append(
            f'<line class="grid" x1="{left}" x2="{width - right}" y1="{up(mark):.1f}" '
            f'y2="{up(mark):.1f}"/><text x="{left - 8}" y="{up(mark) + 4:.1f}" '
            f'text-anchor="end">{text}</text>'
        )
    for mark in _ticks(steps[0], last_step, 6):
        if mark == int(mark):
            grid.append(
                f'<text x="{across(mark):.1f}" y="{height - bottom + 20}" '
                f'text-anchor="middle">{int(mark)}</text>'
            )
    path = " ".join(f"{across(step):.1f},{up(level):.1f}" for step, level in points)
    ends = f"{values[0]:.4g} to {values[-1]:.4g} over {len(values)} values"
    return (
        f"<figure><figcaption><strong>{text_of(name)}</strong> {text_of(ends)}</figcaption>"
        f'<svg class="chart" viewBox="0 0 {width} {height}" role="img" '
        f'aria-label="{text_of(name)}, {text_of(ends)}">{"".join(grid)}'
        f'<line class="axis" x1="{left}" x2="{width - right}" y1="{height - bottom}" '
        f'y2="{height - bottom}"/><polyline class="curve" points="{path}"/>'
        f'<text x="{(left + width - right) / 2}" y="{height - 6}" '
        f'text-anchor="middle">recorded step</text></svg></figure>'
    )


def _convergence(objective: Sequence[float]) -> str:
    values = [float(value) for value in objective]
    drawable = [value for value in values if math.isfinite(value)]
    if len(drawable) < 2:
        return '<p class="quiet">The solver recorded fewer than two objective values.</p>'
    wide = min(drawable) > 0 and max(drawable) / min(drawable) > 20
    scale = ", logarithmic" if wide else ""
    change = [
        abs(b - a) / abs(b) if math.isfinite(a) and math.isfinite(b) and b != 0 else math.nan
        for a, b in itertools.pairwise(values)
    ]
    return (
        '<div class="two">'
        + _curve_chart(f"Objective{scale}:", 1, values, wide)
        + _curve_chart("Relative change:", 2, change, True)
        + "</div>"
    )


def _timings(stage_s: Mapping[str, float]) -> str:
    stages = [(name, float(s)) for name, s in stage_s.items()]
    if not stages:
        return '<p class="quiet">No stage was timed.</p>'
    total_s = sum(s for _, s in stages if math.isfinite(s))
    longest_s = max((s for _, s in stages if math.isfinite(s)), default=0.0) or 1.0
    left, room, row = 190, 560, 30
    bars = []
    for i, (name, s) in enumerate(stages):
        middle = i * row + row / 2
        length = room * s / longest_s if math.isfinite(s) and s > 0 else 0.0
        share = f" ({100 * s / total_s:.0f} %)" if math.isfinite(s) and total_s > 0 else ""
        figure = f"{s:.2f} s{share}" if math.isfinite(s) else "not a number"
        bars.append(
            f'<text x="{left - 12}" y="{middle + 4}" text-anchor="end">{text_of(name)}</text>'
            f'<rect x="{left}" y="{middle - 9}" width="{max(length, 1.5):.1f}" height="18" rx="3"/>'
            f'<text x="{left + max(length, 1.5) + 8:.1f}" y="{middle + 4}">{figure}</text>'
        )
    spoken = ", ".join(f"{name} {_written(s, '.2f', 's')}" for name, s in stages)
    return (
        f'<svg class="chart timings" viewBox="0 0 {left + room + 120} {row * len(stages)}" '
        f'role="img" aria-label="Seconds per stage: {text_of(spoken)}">{"".join(bars)}</svg>'
        f'<p class="quiet">{total_s:.2f} s in all.</p>'
    )


# Tables


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


def _metrics_table(metrics: Mapping[str, object]) -> str:
    rows = []
    for key, value in _flat(metrics):
        figure = FIGURES.get(key, Figure(key, "", "", ""))
        written = text_of(_written(value, figure.format, figure.unit))
        rows.append(
            f'<tr><th scope="row">{text_of(figure.label)}</th><td class="figure">{written}</td>'
            f"<td>{text_of(figure.meaning)}</td><td><code>{text_of(key)}</code></td></tr>"
        )
    return (
        '<table><thead><tr><th scope="col">Figure</th><th scope="col">Value</th>'
        '<th scope="col">What it is</th><th scope="col">Name in metrics.json</th></tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table>"
    )


def _provenance(content: ReportContent) -> str:
    versions = content.metrics.get("versions")
    rows: list[tuple[str, object]] = [
        ("Command line", content.command or "not recorded"),
        ("Seed", _written(content.metrics.get("seed"))),
        ("Scene", content.scene),
        ("Camera", f"{content.camera}: {content.camera_line}"),
        ("Reference", content.camera_reference),
        ("Colour filter", content.cfa),
    ]
    if isinstance(versions, Mapping):
        rows += [(f"Version of {name}", version) for name, version in versions.items()]
    body = "".join(
        f'<tr><th scope="row">{text_of(name)}</th><td><code>{text_of(value)}</code></td></tr>'
        for name, value in rows
    )
    return f'<table class="narrow"><tbody>{body}</tbody></table>'
