"""Behind a coded aperture of others with 8x8 views in grey, `adaptive` is as good as their network.

Three shots of the light field Lego Knights (Stanford archive) behind the apertures that the authors
of Coded-E2LF learned, 256x256 samples in the middle, readings with a deviation of 0.005. Their
network has 27.24 dB in 4 s of processor time on that crop. The folder peers/coded-aperture-8x8 of
EMMC_PEER_FILES has views and apertures.
"""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path

import cv2
import lab
import numpy as np

import emmc_rig as emmc
from emmc_rig.model.lightfield import psnr_db

METHODS = ("adaptive", "adaptive-fast", "tv", "tv-dict")
VIEWS, MIDDLE, SEED, WARM = 8, 256, 1, (64, 64)


def measure(folder: Path, size: tuple[int, int], method: str, noise: float) -> dict:
    """Return PSNR, that of a middle view in all places, processor seconds and verdict."""
    solved(folder, WARM, method, noise)  # compiles, or reads what was compiled
    truth, result, cpu_s = solved(folder, size, method, noise)
    found = np.asarray(result).mean(axis=-1) if np.ndim(result) == 5 else np.asarray(result)
    return {
        "psnr_db": psnr_db(found.clip(0, 1), truth),
        "baseline_db": psnr_db(np.broadcast_to(truth[3:4, 3:4], truth.shape), truth),
        "cpu_s": cpu_s,
        "verdict": result.verdict.level,
    }


def solved(
    folder: Path, size: tuple[int, int], method: str, noise: float
) -> tuple[np.ndarray, emmc.Result, float]:
    """Return the true views (v, u, y, x) of the middle, the result, and its processor seconds."""
    views = [
        [cv2.imread(str(folder / f"views/view_{v}_{u}.png"), 0) for u in range(VIEWS)]
        for v in range(VIEWS)
    ]
    cut = (slice(MIDDLE - side // 2, MIDDLE + side // 2) for side in size)
    truth = (np.array(views, dtype=np.float32) / 255)[:, :, *cut]
    codes = np.load(folder / "apertures.npy").astype(np.float32)
    codes = codes / codes.sum(axis=(1, 2)).max()
    weights = np.broadcast_to(codes[..., None, None], (*codes.shape, *size))
    psi = emmc.Psi.from_weights(np.ascontiguousarray(weights))
    noisy = np.random.default_rng(SEED).normal(0, noise, (len(codes), *size))
    frames = np.einsum("svu,vuyx->syx", codes, truth) + noisy
    given = psi, frames.astype(np.float32), method
    return truth, *lab.timed(emmc.reconstruct, *given, noise_sigma=noise)


def main() -> None:
    """Measure every method."""
    args = lab.parsed(lab.arguments(__doc__, size="256x256", methods=METHODS))
    folder = Path(os.environ.get("EMMC_PEER_FILES", ".")) / "peers" / "coded-aperture-8x8"
    if not folder.is_dir():
        raise SystemExit(f"no {folder}: EMMC_PEER_FILES names the folder that has it")
    points = [{"size": args.size, "method": method, "noise": 0.005} for method in args.methods]
    rows = lab.measured(points, partial(measure, folder), "coded-aperture", args)
    lab.finished(rows, rows.set_index("method").psnr_db.plot.barh(), "coded-aperture", args)


if __name__ == "__main__":
    main()
