"""Frames of a light field through any camera, by its designed Psi and the sensor's noise (eq. 14).

Quick, and an inverse crime when the same Psi reconstructs them; the demo traces rays instead.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from emmc_rig.model.camera import Camera, build_imaging_matrix, pixel_light
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.output import command_line, save_frames, versions, write_metrics
from emmc_rig.scene import open_scene


def simulate(
    scene_spec: str,
    camera_name: str,
    camera: Camera,
    size: tuple[int, int] | None,
    seed: int,
    folder: Path,
) -> dict:
    """Write frames.h5, psi.h5 and metrics.json into an existing folder; return the metrics.

    frames.h5 holds `frames_dn` (shot, y, x) uint16, `readings`, their standard `deviation`, which
    pixels are `usable`, and `noise_free` readings.
    sensor_psnr_db compares readings with noise to those without, peak 1, as the paper's Figure 5.
    """
    scene = open_scene(scene_spec, size=size, views=camera.views, seed=seed)
    psi = build_imaging_matrix(camera, (scene.light_field.shape[2], scene.light_field.shape[3]))
    noise = camera.sensor.noise
    light = pixel_light(camera, psi.size)
    exposures_s = camera.exposures_s()[:, None, None]
    clean = psi.forward(scene.light_field)
    frames_dn = noise.expose_dn(clean, exposures_s, light, np.random.default_rng(seed))
    readings = noise.normalise(frames_dn, exposures_s, light)
    usable = ~noise.saturated(frames_dn) & (light > 0)
    save_frames(
        folder / "frames.h5",
        frames_dn,
        readings,
        camera.exposures_s(),
        deviation=np.sqrt(noise.variance(readings, exposures_s, light)),
        usable=usable,
        noise_free=clean,
    )
    psi.save(folder / "psi.h5")
    metrics = {
        "scene": scene_spec,
        "scene_provenance": scene.provenance,
        "camera": camera_name,
        "shots": psi.shots,
        "size": list(psi.size),
        "sensor_psnr_db": psnr_db(readings, clean),
        "electrons_per_s": noise.electrons_per_s,
        "saturated_share": float(1 - usable.mean()),
        "light_efficiency": psi.light_efficiency(),
        "seed": seed,
        "warnings": camera.warnings(),
        "command": command_line(),
        "versions": versions(),
    }
    write_metrics(folder, metrics)
    return metrics
