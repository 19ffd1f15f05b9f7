"""Of depths in mm 68 % are within the deviation that `depth_mm` states, and 95 % within two.

The true disparity of a built-in scene is known. That of a real one is the sweep of `study.scores`
over the true light field, at the more textured half of the places; it is right to 0.04 pixels.
"""

from __future__ import annotations

import cv2
import lab
import numpy as np

import emmc_rig as emmc
from emmc_rig.model.lightfield import centre_view
from emmc_rig.model.optics import Optics
from emmc_rig.study.scores import swept_disparity

CAMERAS = ("rgbw-bayer-1shot", "scenario-ii-cfa", "rgbw-bayer-3shots")
BUILT_IN = ("wide-disparity", "deep-occlusions", "toy-table", "near-planar", "non-lambertian")
SWEEP_PX = 0.04
FOCUS_MM = 700.0


def measure(scene: str, camera: str, size: tuple[int, int], seed: int) -> dict:
    """Return the shares of places whose depth is within one and two deviations of the true one."""
    described = emmc.camera(camera)
    truth = emmc.scene(scene, size)
    psi = described.psi(truth.size)
    result = emmc.reconstruct(psi, described.expose(truth, seed, psi))
    depth, disparity = result.depth_mm(FOCUS_MM), truth.disparity_px
    lens, pitch_um = described.lens, described.sensor.sample_pitch_um
    optics = Optics(FOCUS_MM, pitch_um / lens.aperture_cell_um / lens.distance_mm)
    counted, sweep_mm = np.ones(truth.size, dtype=bool), 0.0
    if disparity is None:
        ends = float(result.disparity.min()), float(result.disparity.max())
        disparity = swept_disparity(truth.light_field, *ends)
        slopes = np.gradient(centre_view(truth.light_field).mean(axis=-1))
        texture = cv2.blur(np.hypot(*slopes), (5, 5))
        counted = texture > np.median(texture)
        sweep_mm = optics.sigma_mm(depth.mm, np.float64(SWEEP_PX))
    missed = np.abs(depth.mm - optics.depth_mm(disparity)) / np.hypot(depth.sigma_mm, sweep_mm)
    return {f"within_{times}": round((missed[counted] < times).mean(), 3) for times in (1, 2)}


def main() -> None:
    """Measure the scenes behind every camera."""
    args = lab.parsed(lab.arguments(__doc__, scenes=BUILT_IN, size="96x128"))
    cameras = CAMERAS[:1] if args.smallest else CAMERAS
    rows = lab.measured(
        lab.points(args, ({"camera": camera} for camera in cameras)), measure, "depth", args
    )
    lab.finished(rows, rows.set_index("scene").within_2.plot.barh(), "depth", args)
    print(rows[["within_1", "within_2"]].describe().to_string(float_format="%.2f"))


if __name__ == "__main__":
    main()
