"""Frames of a light field through any camera, by its designed Psi and the sensor's noise (eq. 14).

Quick, and an inverse crime when the same Psi reconstructs them; the demo traces rays instead.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from emmc_rig.files.results import command_line, save_frames, versions, write_metrics
from emmc_rig.files.scenes import open_scene
from emmc_rig.model.camera import Camera, build_imaging_matrix, pixel_light
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.model.sensing import ImagingMatrix


@dataclass(frozen=True, eq=False)
class Exposed:
    """Frames, (shot, pixel_y, pixel_x) each: raw values, normalised readings, their deviation."""

    frames_dn: NDArray[np.uint16]
    readings: NDArray[np.floating]
    deviation: NDArray[np.floating]
    usable: NDArray[np.bool_]
    noise_free: NDArray[np.floating]

    @property
    def noise_sigma(self) -> float:
        """Root mean variance of the usable readings, which solvers take as their typical noise."""
        judged = self.deviation[self.usable]
        return float(np.sqrt(np.mean(np.square(judged, dtype=np.float64)))) if judged.size else 0.0


def exposed(
    camera: Camera,
    psi: ImagingMatrix,
    light_field: NDArray[np.floating],
    rng: np.random.Generator,
) -> Exposed:
    """Return the frames of a light field (v, u, y, x, c), with the sensor's noise."""
    return exposed_readings(camera, psi.size, psi.forward(light_field), rng)


def exposed_readings(
    camera: Camera,
    size: tuple[int, int],
    clean: NDArray[np.floating],
    rng: np.random.Generator,
) -> Exposed:
    """Return the frames whose noise-free readings (shot, pixel_y, pixel_x) are `clean`.

    size: rows and columns of the light field.
    """
    noise = camera.sensor.noise
    light = pixel_light(camera, size)
    exposures_s = camera.exposures_s()[:, None, None]
    frames_dn = noise.expose_dn(clean, exposures_s, light, rng)
    readings = noise.normalise(frames_dn, exposures_s, light)
    deviation = np.sqrt(noise.variance(readings, exposures_s, light))
    usable = ~noise.saturated(frames_dn) & (light > 0)
    return Exposed(frames_dn, readings, deviation, usable, clean)


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
    shots = exposed(camera, psi, scene.light_field, np.random.default_rng(seed))
    save_frames(
        folder / "frames.h5",
        shots.frames_dn,
        shots.readings,
        camera.exposures_s(),
        deviation=shots.deviation,
        usable=shots.usable,
        noise_free=shots.noise_free,
    )
    psi.save(folder / "psi.h5")
    metrics = {
        "scene": scene_spec,
        "scene_provenance": scene.provenance,
        "camera": camera_name,
        "shots": psi.shots,
        "size": list(psi.size),
        "sensor_psnr_db": psnr_db(shots.readings, shots.noise_free),
        "electrons_per_s": camera.sensor.noise.electrons_per_s,
        "saturated_share": float(1 - shots.usable.mean()),
        "light_efficiency": psi.light_efficiency(),
        "seed": seed,
        "warnings": camera.warnings(),
        "command": command_line(),
        "versions": versions(),
    }
    write_metrics(folder, metrics)
    return metrics
