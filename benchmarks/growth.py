"""Seconds and memory grow with the size of the problem as the operations counted say.

Pixels, views, shots, the range of disparities: one is varied, all else equal. The exponent is the
slope of the logarithms. The largest sizes take minutes: `--largest 512x640`.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import lab
import numpy as np
from matplotlib import pyplot as plt

from emmc_rig.reconstruction.methods import MethodSettings
from emmc_rig.study.chart.chart_points import ChartSettings, Configuration, Point, measured
from emmc_rig.study.trial import Capture

METHODS = {
    "adaptive": {},
    "adaptive-fast": {},
    "tv": {"tv": {"max_steps": 30, "rtol": 1e-12}},
    "dict-admm": {"sparse": {"solver": {"max_steps": 60, "rtol": 1e-12}}},
}
"""Settings with a fixed number of steps, where a method has any."""


def measure(
    scene: str, camera: str, seed: int, method: str, axis: str, size: tuple[int, int], views: int,
    shots: int, zoom: int,
) -> dict:  # fmt: skip
    """Return CPU seconds and peak memory, measured in a process of its own."""
    capture = Capture(scene, camera, size, seed, zoom, shots, (views, views))
    settings = MethodSettings.model_validate(METHODS[method])
    point = Point(capture, Configuration(method, axis, settings))
    chart = ChartSettings(scenes=(scene,), cameras=(camera,), repeats=3, enough_s=20)
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        result = pool.submit(measured, point, chart).result()
    return {name: result[name] for name in ("seconds", "cpu_seconds", "peak_mib")}


def main() -> None:
    """Measure every axis by every method."""
    parser = lab.arguments(__doc__, camera="rgbw-bayer-1shot", size="64x80", methods=tuple(METHODS))
    parser.add_argument("--largest", default="128x160", help="rows x columns")
    args = lab.parsed(parser)
    largest = 24 if args.smallest else int(args.largest.split("x")[0])
    rows_px, columns_px = args.size
    base = {"size": args.size, "views": 5, "shots": 1, "zoom": 1}
    varied = {
        "pixels": [
            {"size": (rows_px * k, columns_px * k)} for k in (1, 2, 4, 8) if rows_px * k <= largest
        ],
        "views": [{"views": n} for n in (3, 5, 7)],
        "shots": [{"shots": n} for n in (1, 2, 3)],
        "disparity range": [{"zoom": n} for n in (1, 2, 4)],
    }
    if args.smallest:
        varied = {"views": varied["views"][:2]}
    args.scenes = args.scenes[:1]
    choices = [
        {"method": method, "axis": axis, **base, **change}
        for method in args.methods
        for axis, changes in varied.items()
        for change in changes
    ]
    rows = lab.measured(lab.points(args, choices), measure, "growth", args)
    _, panels = plt.subplots(1, len(varied), figsize=(4 * len(varied), 3.2), squeeze=False)
    exponents = []
    for (axis, changes), panel in zip(varied.items(), panels[0], strict=True):
        at = [
            float(np.prod(next(iter(change.values())))) ** (1 + (axis == "views"))
            for change in changes
        ]
        for method, some in rows[rows.axis == axis].groupby("method"):
            panel.loglog(at, some.cpu_seconds, "-o", label=method)
            slope = np.polyfit(np.log(at), np.log(some.cpu_seconds), 1)[0]
            exponents.append((axis, method, slope, some.peak_mib.max()))
        panel.set(xlabel=axis, ylabel="CPU s")
    panels[0][0].legend()
    columns = ["axis", "method", "exponent", "peak MiB"]
    lab.finished(lab.pd.DataFrame(exponents, columns=columns), panels[0][0], "growth", args)


if __name__ == "__main__":
    main()
