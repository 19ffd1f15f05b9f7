"""On cameras that nobody here built: readings kept from the fit are foretold better than by
interpolation, and a Psi that is not the camera's is refused.
"""

from __future__ import annotations

import argparse
import os
import time
from functools import partial
from pathlib import Path

import lab
import numpy as np
from coded_captures import BANDS, SOFTER, available, coded_capture
from matplotlib import pyplot as plt
from numpy.typing import NDArray
from scipy.interpolate import CloughTocher2DInterpolator

from reconstruction.verdict.run import reconstruct_judged

MASKS = ("right", SOFTER, "4 rows off", "mirrored")


def interpolated(readings: NDArray, known: NDArray[np.bool_]) -> NDArray:
    """Return readings (shot, pixel_y, pixel_x) by cubic interpolation of those that are known."""
    found = []
    for frame, use in zip(readings, known, strict=True):
        between = CloughTocher2DInterpolator(np.argwhere(use), frame[use], fill_value=np.nan)
        y, x = np.indices(frame.shape)
        found.append(between(y, x))
    return np.stack(found)


def measure(folder: Path, capture: str, size: tuple[int, int], method: str, mask: str) -> dict:
    """Return root mean squares of readings kept from the fit, as shares of the brightest."""
    taken = coded_capture(folder, capture, size, mask)
    kept = taken.kept
    began = time.process_time()
    result, verdict = reconstruct_judged(
        method, taken.psi, taken.readings, taken.noise, usable=~kept
    )
    seconds = time.process_time() - began
    between = interpolated(taken.readings, ~kept)
    kept = kept & np.isfinite(between)
    off = {
        "rms": taken.psi.forward(result.light_field) - taken.readings,
        "interpolation_rms": between - taken.readings,
    }
    row = {name: float(np.sqrt(np.mean(np.square(one[kept])))) for name, one in off.items()}
    row |= {"level": verdict.level, "cpu_s": seconds}
    row["reasons"] = "; ".join(reason.what for reason in verdict.reasons)
    return row


def main() -> None:
    """Measure, and draw how much better than interpolation."""
    parser = argparse.ArgumentParser(description=__doc__)
    peers = Path(os.environ.get("EMMC_PEER_FILES", "."))
    parser.add_argument("--captures", type=Path, default=peers / "captures")
    parser.add_argument("--method", action="append", help="default: adaptive-fast and tv")
    parser.add_argument("--size", default="96x160", help="rows x columns of the middle")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, default=lab.RESULTS)
    parser.add_argument("--smallest", action="store_true", help="to see that it runs: seconds")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    names = available(args.captures)
    size = tuple(int(side) for side in args.size.split("x"))
    methods, masks = args.method or ["adaptive-fast", "tv"], MASKS
    if args.smallest:
        names, size, methods, masks = names[:1], (32, 40), ["tv"], MASKS[:1]
    if not names:
        raise SystemExit(f"no captures in {args.captures}: name their folder by --captures")
    points = [
        {"capture": name, "size": size, "method": method, "mask": mask}
        for name in names
        for method in methods
        for mask in (masks if name.split("/")[0] in BANDS else masks[:1])
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
