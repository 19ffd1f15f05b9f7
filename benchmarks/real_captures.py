"""On cameras that nobody here built: readings kept from the fit are foretold better than by
interpolation, and a Psi that is not the camera's is refused.
"""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path

import lab
import numpy as np
from coded_captures import BANDS, SOFTER, WINDOW, available, coded_capture
from matplotlib import pyplot as plt
from numpy.typing import NDArray
from scipy.interpolate import CloughTocher2DInterpolator

METHODS = ("adaptive-fast", "tv")
MASKS = ("right", SOFTER, "1 rows off", "2 rows off", "3 rows off", "4 rows off", "mirrored")


def interpolated(readings: NDArray, known: NDArray[np.bool_]) -> NDArray:
    """Return readings (shot, pixel_y, pixel_x) by cubic interpolation of those that are known."""
    found = []
    for frame, use in zip(readings, known, strict=True):
        between = CloughTocher2DInterpolator(np.argwhere(use), frame[use], fill_value=np.nan)
        y, x = np.indices(frame.shape)
        found.append(between(y, x))
    return np.stack(found)


def measure(
    folder: Path, capture: str, size: tuple[int, int] | None, method: str, mask: str
) -> dict:
    """Return root mean squares of readings kept from the fit, as shares of the brightest.

    within_one, within_two: of the readings kept, shares within one and two stated deviations, of
    the light field's error and the reading's noise together, of what is foretold. Views' errors
    count as alike, which is the most that their sum can be off. shift_px: from a band to the next,
    where the method estimates it; the prism makes 2.
    """
    taken = coded_capture(folder, capture, size, mask)
    psi, frames, kept = taken.psi, taken.frames, taken.kept
    result, cpu_s = lab.timed(taken.reconstruct, method)
    row: dict = {"level": result.verdict.level, "cpu_s": cpu_s}
    between = interpolated(frames.readings, frames.usable & ~kept)
    kept = kept & np.isfinite(between)
    brightest = float(frames.readings[frames.usable].max())
    off = psi.forward(result.light_field) - frames.readings
    for name, missed in {"rms": off, "interpolation_rms": between - frames.readings}.items():
        row[name] = float(np.sqrt(np.mean(np.square(missed[kept])))) / brightest
    if result.sigma is not None:
        stated = psi.forward(np.repeat(result.sigma[..., None], 3, axis=-1).astype(np.float32))
        times = (np.abs(off) / np.hypot(stated, frames.deviation))[kept]
        row |= {"within_one": np.mean(times <= 1), "within_two": np.mean(times <= 2)}
    if "shift" in result.maps:
        row["shift_px"] = float(np.median(result.maps["shift"]))
    return row | {"reasons": "; ".join(reason.what for reason in result.verdict.reasons)}


def main() -> None:
    """Measure, and draw how much better than interpolation."""
    parser = lab.arguments(__doc__, (), size="x".join(map(str, WINDOW)), methods=METHODS)
    peers = Path(os.environ.get("EMMC_PEER_FILES", "."))
    parser.add_argument("--captures", type=Path, default=peers / "captures")
    parser.add_argument("--mask", action="append", choices=MASKS, help="default: all")
    args = lab.parsed(parser)
    names, size = available(args.captures), args.size
    masks = args.mask or MASKS
    if args.smallest:
        names, masks = names[:1], MASKS[:1]
    if not names:
        raise SystemExit(f"no captures in {args.captures}: name their folder by --captures")
    points = [
        {"capture": name, "size": size, "method": method, "mask": mask}
        for name in names
        for method in args.methods
        for mask in masks
        if mask == "right" or name.split("/")[0] in BANDS
    ]
    rows = lab.measured(points, partial(measure, args.captures), "real_captures", args)
    right = rows[rows["mask"].isin(["right", SOFTER])]
    shown = right.capture + ", " + right["mask"]
    gain = (right.interpolation_rms / right.rms).groupby([shown, right.method]).first()
    axes = plt.figure(figsize=(7, 5)).add_subplot()
    gain.unstack().iloc[::-1].plot.barh(ax=axes)
    axes.axvline(1, color="0.5", linewidth=1)
    axes.set_xlabel("error of held-out readings: interpolation over method")
    axes.set_ylabel("")
    lab.finished(rows, axes, "real_captures", args)


if __name__ == "__main__":
    main()
