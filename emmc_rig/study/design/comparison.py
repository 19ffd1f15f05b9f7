"""Cameras compared: what theory expects of each, and the default method's error on scenes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from emmc_rig.files.scenes import open_scene
from emmc_rig.model.camera import Camera, shipped_cameras
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.progress import Watcher
from emmc_rig.study.design.bench import DesignBench
from emmc_rig.study.design.expected import SIZE, expected
from emmc_rig.study.design.printed import Print, printed_psi
from emmc_rig.study.points import Results, Study
from reconstruction.methods import DEFAULT_METHOD, reconstruct

SCENES = ("deep-occlusions", "near-planar", "non-lambertian")
SIZE_PX = (96, 96)
AS_PRINTED = Print()


@dataclass(frozen=True)
class Simulated:
    """A camera: what theory expects, and the default method's PSNR by scene, dB."""

    name: str
    expected_db: float
    psnr_db: Mapping[str, float]

    @property
    def mean_db(self) -> float:
        """Over the scenes."""
        return float(np.mean(list(self.psnr_db.values())))


def shipped_like(bench: DesignBench) -> dict[str, Camera]:
    """Return the shipped cameras of a bench's views, colour filters and sample pitch."""
    sensor = bench.sensor
    return {
        name: camera
        for name, camera in shipped_cameras().items()
        if camera.views == bench.views
        and camera.sensor.cfa == sensor.cfa
        and camera.sensor.sample_pitch_um == sensor.sample_pitch_um
    }


def buildable(camera: Camera, bench: DesignBench) -> bool:
    """Return whether a camera is no sampled model, and its maker can print its masks."""
    return camera.lens.aperture_fill > 0 and all(
        mask.cell_um >= bench.maker.smallest_cell_um for mask in camera.masks.values()
    )


@lru_cache(maxsize=8)
def _opened(
    scene: str, size: tuple[int, int], views: tuple[int, int], seed: int
) -> NDArray[np.float32]:
    return open_scene(scene, size, views, seed).light_field


@dataclass
class Simulations(Study[tuple[str, str]]):
    """Points of camera and scene; settings: DesignBench."""

    cameras: Mapping[str, Camera]
    size: tuple[int, int]
    seed: int
    journal = "simulations.jsonl"
    noun = "simulations"
    stage = "simulate the default method"
    revision = 1

    def inputs(self, point: tuple[str, str]) -> dict[str, object]:
        """Return everything that a point's figures depend on, as plain data."""
        name, scene = point
        return {
            "camera": self.cameras[name].model_dump(mode="json"),
            "scene": scene,
            "size": self.size,
            "seed": self.seed,
            "method": DEFAULT_METHOD,
        }

    def measured(self, points: Sequence[tuple[str, str]], watcher: Watcher) -> Results:
        """Yield the PSNR of each point: frames by the printed mask's Psi, which is calibrated."""
        for name, scene in points:
            camera = self.cameras[name]
            truth = _opened(scene, self.size, camera.views, self.seed)
            psi = printed_psi(camera, (truth.shape[2], truth.shape[3]), AS_PRINTED)
            shots = camera.expose(truth, self.seed, psi)
            result = reconstruct(
                DEFAULT_METHOD, psi, shots.readings, shots.noise_sigma, usable=shots.usable
            )
            yield {"psnr_db": psnr_db(result.light_field, truth)}

    def label(self, point: tuple[str, str]) -> str:
        """Return a point in words."""
        return f"{point[0]}, {Path(point[1]).stem}"


def simulated(
    bench: DesignBench,
    cameras: Mapping[str, Camera],
    scenes: Sequence[str],
    size: tuple[int, int],
    seed: int,
    folder: Path,
    watcher: Watcher,
) -> list[Simulated]:
    """Return theory and simulation of cameras; what the folder holds is not simulated again.

    Raises what scenes and methods do for wrong input.
    """
    points = [(name, scene) for name in cameras for scene in scenes]
    results = Simulations(bench, folder, cameras, size, seed).run(points, watcher)
    watcher.begin("expected error of each camera, by theory", len(cameras))
    found = []
    for name, camera in cameras.items():
        psi = printed_psi(camera, SIZE, AS_PRINTED)
        expected_db = expected(camera, psi, bench.disparities_px).psnr_db
        by_scene = {Path(scene).stem: results[name, scene]["psnr_db"] for scene in scenes}
        found.append(Simulated(name, expected_db, by_scene))
        watcher.step(name)
    return found
