"""Theory orders masks as simulation does: the rank correlation over shipped and random cameras."""

from __future__ import annotations

import lab
import numpy as np
from scipy.stats import spearmanr

from emmc_rig.formats.scenes import open_scene
from emmc_rig.model.camera import Camera
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.reconstruction.methods import DEFAULT_METHOD, reconstruct
from emmc_rig.study.design.bench import DesignBench
from emmc_rig.study.design.designing import shipped_like
from emmc_rig.study.design.expected import SIZE, expected
from emmc_rig.study.design.printed import Print, printed_psi
from emmc_rig.study.design.search import candidates

RANDOM = 8
"""Masks drawn at random, beside the shipped cameras of the same sensor."""


def cameras(seed: int) -> dict[str, Camera]:
    """Return the cameras compared, at equal light and noise."""
    bench = DesignBench()
    every = candidates(bench)
    drawn = np.random.default_rng(seed).permutation(len(every))[:RANDOM]
    found = {**shipped_like(bench), **{every[i].label: every[i].camera(bench) for i in drawn}}
    noise, total_s = bench.sensor.noise, bench.total_exposure_s
    return {
        name: camera.model_copy(
            update={
                "sensor": camera.sensor.model_copy(update={"noise": noise}),
                "total_exposure_s": total_s,
            }
        )
        for name, camera in found.items()
    }


def measure(camera: str, scene: str, size: tuple[int, int], seed: int) -> dict:
    """Return what theory expects of a camera, and the PSNR of the default method."""
    described = cameras(seed)[camera]
    theory = expected(
        described, printed_psi(described, SIZE, Print()), DesignBench().disparities_px
    )
    truth = open_scene(scene, size, described.views, seed).light_field
    psi = printed_psi(described, (truth.shape[2], truth.shape[3]), Print())
    shots = described.expose(truth, seed, psi)
    result = reconstruct(DEFAULT_METHOD, psi, shots)
    return {"expected_db": theory.psnr_db, "psnr_db": psnr_db(result.light_field, truth)}


def main() -> None:
    """Compare the cameras on every scene."""
    args = lab.parsed(lab.arguments(__doc__, ("near-planar", "deep-occlusions"), size="96x96"))
    names = list(cameras(args.seed))[: 2 if args.smallest else None]
    points = lab.points(args, ({"camera": name} for name in names))
    rows = lab.measured(points, measure, "design-check", args)
    means = rows.groupby("camera")[["expected_db", "psnr_db"]].mean()
    axes = means.plot.scatter("expected_db", "psnr_db")
    lab.finished(means.reset_index(), axes, "design-check", args)
    print("rank correlation (Spearman):", spearmanr(means.expected_db, means.psnr_db)[0])


if __name__ == "__main__":
    main()
