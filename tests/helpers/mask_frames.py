"""Frames of a white board through one mask, by the ray caster, at a place that a test knows."""

import numpy as np

from emmc_rig.drivers.raw import RawFrame
from emmc_rig.formats.scenes import fine_scene
from emmc_rig.model.camera import shipped_cameras
from emmc_rig.simulators.bench import Bench, MountingErrors

SIZE = (72, 96)
CAMERAS = shipped_cameras()
BLACK, WHITE = 256, 4095


def frame_of(mosaic, cfa="rggb", white=WHITE):
    return RawFrame(
        mosaic=mosaic.astype(np.uint16),
        cfa=cfa,
        black_level_dn=np.full((2, 2), BLACK, np.float64),
        white_level_dn=white,
        exposure_s=0.01,
        original=b"",
        sha256="",
    )


def bench_frame(camera, target="whiteboard", exposure_s=0.05, lamp="white", **errors):
    """A frame of a bench whose mask is misplaced by that much."""
    fine = fine_scene("near-planar", 2, 2, size=SIZE, views=camera.views)
    aperture_um = max(camera.views) * camera.lens.aperture_cell_um
    standing = {"mask_x": 0.0, "mask_y": 0.0, "aperture_x": 2 * aperture_um, "aperture_y": 0.0}
    bench = Bench(
        camera,
        fine.samples,
        SIZE,
        lambda: standing,
        2 * aperture_um,
        np.random.default_rng(0),
        MountingErrors(**errors),
        rays_per_view=32,
    )
    bench.lamp, bench.target = lamp, target
    noise = camera.sensor.noise
    return frame_of(bench.expose(exposure_s), camera.sensor.cfa_name, noise.white_level_dn)
