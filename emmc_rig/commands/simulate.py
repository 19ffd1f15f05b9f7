"""The command `emmc-rig simulate`: frames of a light field through any camera, no rig."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from emmc_rig.commands.options import (
    DEFAULT_CAMERA,
    DEFAULT_SCENE,
    CameraOption,
    OutOption,
    SceneOption,
    SeedOption,
    ShotsOption,
    ZarrOption,
    size_option,
)
from emmc_rig.commands.output import give_result, shown_progress, tell

if TYPE_CHECKING:
    from emmc_rig.model.camera import Camera


def simulate(
    scene: SceneOption = DEFAULT_SCENE,
    camera: CameraOption = DEFAULT_CAMERA,
    shots: ShotsOption = None,
    seed: SeedOption = 0,
    size: Annotated[str | None, size_option("the whole; of a built-in scene 192x256")] = None,
    out: OutOption = Path("emmc-frames"),
    as_zarr: ZarrOption = False,
) -> None:
    """Simulate the frames that a camera takes of a light field."""
    import emmc_rig as emmc
    from emmc_rig.store.folders import result_folder
    from emmc_rig.store.results import parse_size

    described = emmc.camera(camera, shots)
    with result_folder(out, "simulate") as folder, shown_progress("simulate"):
        metrics = simulate_into(folder, scene, camera, described, parse_size(size), seed, as_zarr)
    tell(
        f"{metrics['shots']} frame{'s' * (metrics['shots'] > 1)}, "
        f"sensor PSNR {metrics['sensor_psnr_db']:.2f} dB, "
        f"light efficiency {metrics['light_efficiency']:.1%}; in {out}"
    )
    give_result(out)


def simulate_into(
    folder: Path,
    scene_name: str,
    camera_name: str,
    camera: Camera,
    size: tuple[int, int] | None,
    seed: int,
    as_zarr: bool = False,
) -> dict:
    """Write frames.h5, psi.h5 and metrics.json into an existing folder; return the metrics.

    frames.h5 holds `frames_dn` (shot, y, x) uint16, `readings`, their standard `deviation`, which
    pixels are `usable`, and `noise_free` readings. Quick, and an inverse crime when the same Psi
    reconstructs them; the demo traces rays instead. sensor_psnr_db compares readings with noise to
    those without, peak 1, as the paper's Figure 5. as_zarr: write
    frames.zarr and psi.zarr in their place.
    """
    import emmc_rig as emmc
    from emmc_rig.model.lightfield import psnr_db
    from emmc_rig.store.psi import FRAMES, FRAMES_GROUP, PSI, PSI_GROUP, save_shards
    from emmc_rig.store.results import save_frames, write_metrics

    scene = emmc.scene(scene_name, size=size, views=camera.views, seed=seed)
    psi = camera.psi(scene.size)
    frames = camera.expose(scene, seed, psi)
    save_frames(
        folder / (FRAMES_GROUP if as_zarr else FRAMES),
        frames,
        frames_dn=frames.frames_dn,
        exposures_s=camera.exposures_s(),
        noise_free=frames.noise_free,
    )
    if as_zarr:
        save_shards(psi, folder / PSI_GROUP)
    else:
        psi.save(folder / PSI)
    metrics = {
        "scene": scene_name,
        "scene_provenance": scene.provenance,
        "camera": camera_name,
        "shots": psi.shots,
        "size": list(psi.size),
        "sensor_psnr_db": psnr_db(frames.readings, frames.noise_free),
        "electrons_per_s": camera.sensor.noise.electrons_per_s,
        "saturated_share": float(1 - frames.usable.mean()),
        "light_efficiency": psi.light_efficiency(),
        "seed": seed,
        "warnings": camera.warnings(),
    }
    write_metrics(folder, metrics)
    return metrics
