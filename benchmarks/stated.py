"""A stated deviation is the truth's: 68 % of the errors lie within one of it, 95 % within two."""

from __future__ import annotations

import lab
import numpy as np

from emmc_rig.study.trial import Capture, trial_of


def measure(
    scene: str, camera: str, size: tuple[int, int], seed: int, method: str, noise: float
) -> dict:
    """Return the true and the stated PSNR, and shares of the errors within the deviation.

    Pictures too small for readings to be held out have no stated deviation.
    """
    given = trial_of(Capture(scene, camera, size, seed, noise=noise))
    result = given.solved(method)
    unknown = np.full(result.light_field.shape[:4], np.nan)
    sigma = result.maps.get("sigma", unknown).astype(np.float64)[..., None]
    error = np.abs(result.light_field - given.truth)
    return {
        "psnr_db": given.psnr_db(result.light_field),
        "stated_db": -10 * np.log10(np.mean(np.square(sigma))),
        "within_one": _share(error <= sigma, sigma),
        "within_two": _share(error <= 2 * sigma, sigma),
    }


def _share(within, sigma) -> float:
    return float(np.where(np.isnan(sigma), np.nan, within).mean())


def main() -> None:
    """Measure every scene at two noises."""
    args = lab.parsed(lab.arguments(__doc__))
    points = [
        {
            "scene": scene, "camera": args.camera, "size": args.size, "seed": args.seed,
            "method": "adaptive", "noise": noise,
        }
        for scene in args.scenes
        for noise in (0.0005, 0.004)
    ]  # fmt: skip
    rows = lab.measured(points, measure, "stated", args)
    axes = rows.plot.scatter("psnr_db", "stated_db")
    axes.axline((30, 30), slope=1, color="grey", linewidth=1)
    lab.finished(rows, axes, "stated", args)
    print(rows[["within_one", "within_two"]].agg(["mean", "min", "max"]))


if __name__ == "__main__":
    main()
