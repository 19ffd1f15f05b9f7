"""On whole frames of real light fields, one shot, `adaptive` leads the methods with a dictionary.

The paper's Bayer camera with its own noise, nothing trained; the rows are the charts at the top of
docs/results.md.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

import lab

import emmc_rig as emmc

METHODS = ("adaptive", "adaptive-fast", "tv", "tv-dict")
WARM = (64, 80)
WHOLE = (*lab.GROUP_A, *lab.GROUP_B[:2])
"""The scenes whose frames are more than a crop."""


def measure(scene: str, camera: str, size: tuple[int, int] | None, seed: int, method: str) -> dict:
    """Return size, PSNR of a method and of the baseline, and processor and wall time.

    As `emmc-rig simulate` and `reconstruct` do it: frames are cleaned up, and the result is judged.
    """
    through = emmc.camera(camera)
    for part in (WARM, size):  # a part first, which compiles, or reads what was compiled
        seen = emmc.scene(scene, size=part)
        psi = through.psi(seen.size)
        frames = through.expose(seen, seed=seed, psi=psi)
        started = time.perf_counter()
        result, cpu_s = lab.timed(emmc.reconstruct, psi, frames, method)
        seconds = time.perf_counter() - started
    reached = result.compare(seen)
    return {
        "rows": seen.size[0],
        "columns": seen.size[1],
        "psnr_db": round(reached["psnr_db"], 2),
        "baseline_db": round(reached["replicate_psnr_db"], 2),
        "cpu_s": round(cpu_s, 1),
        "seconds": round(seconds, 1),
    }


def main() -> None:
    """Measure every method on every scene."""
    args = lab.parsed(lab.arguments(__doc__, methods=METHODS))
    if not args.smallest and not args.scene:
        args.scenes = [str(Path(os.environ["EMMC_LIGHTFIELDS"]) / name) for name in WHOLE]
    args.size = args.size if args.smallest else None
    choices = [{"method": method} for method in args.methods]
    rows = lab.measured(lab.points(args, choices), measure, "full-frames", args)
    table = rows.pivot_table(index="scene", columns="method", values="psnr_db")
    lab.finished(rows, table.plot.barh(), "full-frames", args)


if __name__ == "__main__":
    main()
