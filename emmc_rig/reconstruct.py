"""Reconstruct a folder of frames by any method: frames.h5 and psi.h5 -> light_field.h5, pictures.

The folder is what `demo` and `simulate` write: readings, their standard deviation, and which
pixels are usable, with the imaging matrix beside them. Or it is a session of `emmc-rig capture`:
then the imaging matrix is measured from its whiteboards, and brackets are fused.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from emmc_rig.advice.recommend import (
    Advice,
    Problem,
    advised,
    parse_budget,
    parse_wanted,
    read_rows,
)
from emmc_rig.advice.reference import reference
from emmc_rig.errors import AppError
from emmc_rig.files.results import command_line, versions, write_metrics
from emmc_rig.files.scenes import open_scene
from emmc_rig.model.lightfield import (
    export_pictures,
    focus_disparities,
    psnr_db,
    replicate_centre,
    save_hdf5,
    ssim,
)
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.model.settings import read_yaml, validated
from emmc_rig.session.readings import session_readings
from emmc_rig.session.session import Session, is_session
from reconstruction.dictionary import Dictionary, dct_dictionary, lambertian_dictionary
from reconstruction.methods import MethodSettings, find_method
from reconstruction.result import Progress, Reconstruction, Status
from reconstruction.tiles import SavedPsi, reconstruct_in_tiles
from reconstruction.verdict.kept import kept_readings
from reconstruction.verdict.rules import Verdict
from reconstruction.verdict.run import reconstruct_judged, verdict_of

JUDGED = 512
"""Rows and columns of the window that a verdict on tiles is by."""
FRAMES, PSI, LIGHT_FIELD, MAPS = "frames.h5", "psi.h5", "light_field.h5", "maps.h5"


@dataclass(frozen=True, eq=False)
class Capture:
    """readings, their standard deviation, which are usable: (shot, y, x) each."""

    readings: NDArray[np.float32]
    deviation: NDArray[np.floating]
    usable: NDArray[np.bool_]

    @property
    def noise_sigma(self) -> float:
        """Their typical deviation: the root mean square of the usable ones."""
        judged = self.deviation[self.usable]
        return float(np.sqrt(np.mean(np.square(judged, dtype=np.float64)))) if judged.size else 0.0


def read_capture(folder: Path) -> Capture:
    """Read frames.h5 of a folder; raises AppError when it is missing, damaged or incomplete."""
    path = folder / FRAMES
    if not path.is_file():
        raise AppError(
            f"{folder}: holds no {FRAMES}; name a folder that `emmc-rig demo`, `simulate` or "
            "`capture` wrote"
        )
    try:
        with h5py.File(path, "r") as file:
            readings, deviation, usable = (
                np.asarray(file[name]) for name in ("readings", "deviation", "usable")
            )
    except (OSError, KeyError) as fault:
        why = " ".join(str(fault).split())
        raise AppError(f"{path}: cannot be read ({why}); make the frames again") from fault
    usable = usable.astype(bool)
    if readings.ndim != 3 or not readings.shape == deviation.shape == usable.shape:
        raise AppError(f"{path}: readings, deviation and usable differ in shape")
    return Capture(readings, deviation, usable)


def read_session(folder: Path, psi_out: Path) -> Capture:
    """Read the shots of a session, and write the imaging matrix that they were normalised by.

    Raises AppError or CalibrationError, each one line.
    """
    taken = session_readings(Session(folder))
    taken.psi.save(psi_out)
    return Capture(taken.readings, np.sqrt(taken.variance), taken.usable)


def _read(folder: Path, out: Path, psi_path: Path | None) -> tuple[Capture, Path]:
    """Return what was captured, and where its imaging matrix is."""
    if is_session(folder):
        capture = read_session(folder, out / PSI)
        return capture, psi_path or out / PSI
    return read_capture(folder), psi_path or folder / PSI


def open_dictionary(spec: str | None, views: tuple[int, int], binning: int) -> Dictionary:
    """Return a dictionary by file, or by the name of one that needs no training.

    None takes `lambertian`. Those made here have patches of 9 x 9 samples, or the nearest
    multiple of the pixels' k below.
    """
    if spec in (None, "lambertian", "dct"):
        side = 9 // binning * binning or binning
        make = dct_dictionary if spec == "dct" else lambertian_dictionary
        return make(views, (side, side))
    return Dictionary.load(spec)


def load_settings(path: Path | None) -> MethodSettings:
    """Read method settings from YAML; misspelt keys name the nearest valid one."""
    if path is None:
        return MethodSettings()
    return validated(MethodSettings, read_yaml(path, AppError), str(path), AppError)


def advice_for(
    folder: Path,
    psi_path: Path | None,
    budget: str | None,
    want: str | None,
    chart: Path | None,
) -> Advice:
    """Return the method to take for a folder's frames, by a chart and this machine's yardstick.

    budget, want: as typed, such as "30s" and "28dB". chart: the folder of one; None takes the
    shipped one. Raises AppError for what cannot be read.
    """
    budget_s = None if budget is None else parse_budget(budget)
    wanted_db = None if want is None else parse_wanted(want)
    rows = read_rows(chart)
    psi = ImagingMatrix.load(psi_path or folder / PSI)
    values = int(np.prod(psi.light_field_shape))
    problem = Problem(values, psi.shots, psi.colour is not None)
    return advised(rows, problem, reference().seconds, budget_s, wanted_db)


def run_reconstruct(
    folder: Path,
    out: Path,
    method: str,
    psi_path: Path | None = None,
    dictionary_spec: str | None = None,
    settings: MethodSettings | None = None,
    truth: str | None = None,
    on_step: Callable[[Progress], None] | None = None,
    chosen: str | None = None,
) -> dict:
    """Reconstruct a folder's frames into an existing folder `out`; return the metrics.

    dictionary_spec: see `open_dictionary`. truth: the scene that was captured, when known, to
    compare with. chosen: why this method, for the metrics.
    """
    needs_dictionary = find_method(method).needs_dictionary
    capture, psi_path = _read(folder, out, psi_path)
    psi = ImagingMatrix.load(psi_path)
    views = psi.light_field_shape[:2]
    dictionary = open_dictionary(dictionary_spec, views, psi.binning) if needs_dictionary else None
    result, verdict = reconstruct_judged(
        method,
        psi,
        capture.readings,
        # Not of each: estimated from the reading itself, it is least where noise made that small.
        capture.noise_sigma,
        dictionary,
        settings,
        capture.usable,
        on_step,
    )
    metrics = {
        "method": result.method,
        "chosen": chosen,
        "status": result.status,
        "advice": result.advice,
        "left_out": list(result.left_out),
        "screening": list(result.screening),
        "verdict": verdict.as_dict(),
        "steps": result.steps,
        "seconds": result.seconds,
        "parameters": result.parameters,
        "noise_sigma": capture.noise_sigma,
        "usable_share": float(capture.usable.mean()),
        "shots": psi.shots,
        "size": list(psi.size),
        "psi_sha256": psi.checksum(),
        "dictionary": dictionary.kind if dictionary is not None else None,
        "command": command_line(),
        "versions": versions(),
    }
    if truth is not None:
        true = open_scene(truth, size=psi.size, views=psi.light_field_shape[:2]).light_field
        metrics["truth"] = truth
        metrics["psnr_db"] = psnr_db(result.light_field, true)
        metrics["ssim"] = ssim(result.light_field, true)
        metrics["replicate_psnr_db"] = psnr_db(replicate_centre(true), true)
    save_hdf5(out / LIGHT_FIELD, result.light_field, {"method": result.method})
    export_pictures(out / "pictures", result.light_field, focus_disparities(result.light_field))
    if result.maps:
        save_maps(out / MAPS, result.maps)
    write_metrics(out, metrics)
    return metrics


def save_maps(path: Path, maps: Mapping[str, NDArray]) -> None:
    """Write what a method found beside the light field, one HDF5 data set for each name."""
    with h5py.File(path, "w") as file:
        for name, values in maps.items():
            file.create_dataset(name, data=values, compression="lzf")


def _judged_middle(
    method: str,
    psi: SavedPsi,
    capture: Capture,
    kept: NDArray[np.bool_],
    dataset: h5py.Dataset,
    settings: MethodSettings | None,
) -> Verdict:
    """Return the verdict on the middle of a light field in a file, as much as fits into memory."""
    k = psi.binning
    rows, columns = (
        slice(first, first + min(JUDGED, whole))
        for whole in psi.size
        for first in [max(0, (whole - JUDGED) // 2 // k * k)]
    )
    seen = np.s_[:, rows.start // k : rows.stop // k, columns.start // k : columns.stop // k]
    found = np.asarray(dataset[:, :, rows, columns])
    result = Reconstruction(method, found, Status.IN_TILES, "", 0, (), 0.0, {})
    screening = (settings or MethodSettings()).screening
    return verdict_of(
        psi.window(rows, columns),
        capture.readings[seen],
        capture.noise_sigma,
        capture.usable[seen],
        kept[seen],
        result,
        screening,
    )


def run_in_tiles(
    folder: Path,
    out: Path,
    method: str,
    tile: int,
    psi_path: Path | None = None,
    dictionary_spec: str | None = None,
    settings: MethodSettings | None = None,
    on_tile: Callable[[int, int], None] | None = None,
) -> dict:
    """Reconstruct a folder's frames tile by tile into light_field.h5; return the metrics.

    For captures that do not fit into memory: writes no pictures. The arguments are those of
    `run_reconstruct`; tile: samples a side.
    """
    needs_dictionary = find_method(method).needs_dictionary
    capture, psi_path = _read(folder, out, psi_path)
    psi = SavedPsi(psi_path)
    views = psi.window(slice(0, psi.binning), slice(0, psi.binning)).light_field_shape[:2]
    dictionary = open_dictionary(dictionary_spec, views, psi.binning) if needs_dictionary else None
    kept = kept_readings(capture.usable)
    started = time.perf_counter()
    with h5py.File(out / LIGHT_FIELD, "w") as file:
        dataset = file.create_dataset("light_field", (*views, *psi.size, 3), "f4")
        dataset.attrs["method"] = method
        results = reconstruct_in_tiles(
            method,
            psi,
            capture.readings,
            capture.noise_sigma,
            dataset,
            dictionary,
            settings,
            capture.usable & ~kept,
            tile,
            on_tile=on_tile,
        )
        verdict = _judged_middle(method, psi, capture, kept, dataset, settings)
    metrics = {
        "method": method,
        "status": Status.IN_TILES,
        "advice": "",
        "verdict": verdict.as_dict(),
        "tiles": len(results),
        "tile": tile,
        "seconds": time.perf_counter() - started,
        "parameters": results[0].parameters if results else {},
        "noise_sigma": capture.noise_sigma,
        "size": list(psi.size),
        "psi_sha256": psi.checksum,
        "command": command_line(),
        "versions": versions(),
    }
    write_metrics(out, metrics)
    return metrics
