"""The one way from frames and Psi to a result, for the Python API and the command line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from emmc_rig.errors import AppError
from emmc_rig.files.dictionaries import open_dictionary
from emmc_rig.files.folders import is_session
from emmc_rig.files.scenes import open_scene
from emmc_rig.model.camera import Camera, pixel_light
from emmc_rig.model.frames import Frames
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.reconstruct.exposure import with_exposure
from emmc_rig.reconstruct.inputs import stored_frames
from emmc_rig.reconstruct.result import Result
from emmc_rig.session.session import Session
from reconstruction.dictionary import Dictionary
from reconstruction.methods import DEFAULT_METHOD, MethodSettings, find_method
from reconstruction.result import Progress
from reconstruction.verdict.run import reconstruct_judged

OnStep = Callable[[Progress], None]


def reconstruct(
    psi: ImagingMatrix,
    frames: Frames | ArrayLike,
    method: str = DEFAULT_METHOD,
    *,
    noise_sigma: float | None = None,
    usable: NDArray[np.bool_] | None = None,
    dictionary: Dictionary | str | None = None,
    settings: MethodSettings | None = None,
    on_step: OnStep | None = None,
) -> Result:
    """Return the light field that frames and Psi speak for, with how far to trust it.

    Args:
        psi: the imaging matrix of the camera that took the frames.
        frames: what `Camera.expose` or `open_frames` return, or an array (shot, pixel_y, pixel_x)
            of readings, such as `psi @ scene`.
        method: a name that `emmc-rig reconstruct --list` lists.
        noise_sigma: standard deviation of the readings, all alike. By default that of the frames;
            of an array, what the sensor of Psi's camera has at these readings.
        usable: which readings to use (default: those of the frames, all of an array).
        dictionary: for methods that need one: itself, its file, or the name of a built-in one.
        settings: of the methods.
        on_step: is told the progress after each step.

    Raises:
        AppError: an array without `noise_sigma`, where Psi does not know its camera.
        ReconstructionError: a method that is not known, frames that do not fit Psi.

    >>> import emmc_rig as emmc
    >>> scene = emmc.scene("near-planar", size=(24, 32))
    >>> psi = emmc.camera("rgbw-bayer-1shot").psi(scene.size)
    >>> emmc.reconstruct(psi, psi @ scene, "tv").light_field.shape
    (5, 5, 24, 32, 3)
    """
    needs_dictionary = find_method(method).needs_dictionary
    given = _as_frames(psi, frames, noise_sigma, usable)
    atoms = None
    if needs_dictionary:
        made = isinstance(dictionary, Dictionary)
        views = psi.layout.views
        atoms = dictionary if made else open_dictionary(dictionary, views, psi.binning)
    solved, verdict = reconstruct_judged(
        method,
        psi,
        given.readings,
        # Not of each: estimated from the reading itself, it is least where noise made that small.
        given.noise_sigma,
        atoms,
        settings,
        given.usable,
        on_step,
    )
    return Result(solved, verdict, psi, given, None if atoms is None else atoms.kind)


def _as_frames(
    psi: ImagingMatrix,
    frames: Frames | ArrayLike,
    noise_sigma: float | None,
    usable: NDArray[np.bool_] | None,
) -> Frames:
    """Return frames as a method takes them: with a deviation, and which are usable."""
    if isinstance(frames, Frames):
        given = frames
    else:
        readings = np.asarray(frames)
        everywhere = np.ones(readings.shape, dtype=bool)
        if noise_sigma is None:
            deviation = sensor_deviation(psi, readings)
            everywhere &= np.isfinite(deviation)
        else:
            deviation = np.zeros(readings.shape)
        given = Frames(readings, deviation, everywhere)
    if noise_sigma is not None:
        given = replace(given, deviation=np.full(given.shape, noise_sigma))
    return given if usable is None else replace(given, usable=usable)


def sensor_deviation(psi: ImagingMatrix, readings: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the standard deviation that the sensor of Psi's camera adds to readings.

    Infinite where no light reaches a pixel. Raises AppError where Psi does not know its camera.
    """
    if not psi.camera_json:
        raise AppError("this Psi does not know its camera: give the readings' noise_sigma")
    camera = Camera.model_validate_json(psi.camera_json)
    light = pixel_light(camera, psi.size)
    if readings.shape != light.shape:
        return np.zeros(readings.shape)  # the method refuses these frames, and says why
    variance = camera.sensor.noise.variance(readings, camera.exposures_s()[:, None, None], light)
    return np.sqrt(variance)


def reconstruct_folder(
    folder: Path,
    out: Path,
    method: str = DEFAULT_METHOD,
    psi_path: Path | None = None,
    dictionary_spec: str | None = None,
    settings: MethodSettings | None = None,
    truth: str | None = None,
    on_step: OnStep | None = None,
    chosen: str | None = None,
) -> dict:
    """Reconstruct a folder's frames into an existing folder `out`; return the metrics.

    dictionary_spec: see `open_dictionary`. truth: the scene that was captured, when known, to
    compare with. chosen: why this method, for the metrics.
    """
    find_method(method)
    frames, psi_path = stored_frames(folder, out, psi_path)
    psi = ImagingMatrix.load(psi_path)
    result = reconstruct(
        psi, frames, method, dictionary=dictionary_spec, settings=settings, on_step=on_step
    )
    if is_session(folder):
        result = with_exposure(result, Session(folder))
    metrics = {**result.metrics(), "chosen": chosen}
    if truth is not None:
        scene = open_scene(truth, size=psi.size, views=psi.layout.views)
        metrics = {**metrics, "truth": truth, **result.compare(scene)}
    result.write(out, metrics)
    return metrics
