"""Reconstruction tile by tile into a file, for captures that do not fit into memory."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from emmc_rig.files.dictionaries import open_dictionary
from emmc_rig.files.results import command_line, versions, write_metrics
from emmc_rig.model.frames import Frames
from emmc_rig.reconstruct.inputs import stored_frames
from emmc_rig.reconstruct.result import LIGHT_FIELD
from reconstruction.methods import MethodSettings, find_method
from reconstruction.result import Reconstruction, Status
from reconstruction.tiles import SavedPsi, reconstruct_in_tiles
from reconstruction.verdict.kept import kept_readings
from reconstruction.verdict.rules import Verdict
from reconstruction.verdict.run import verdict_of

VERDICT_WINDOW = 512
"""Rows and columns of the middle of the light field that the verdict is by: what fits into memory
anywhere."""


def _verdict_of_middle(
    method: str,
    psi: SavedPsi,
    frames: Frames,
    kept: NDArray[np.bool_],
    dataset: h5py.Dataset,
    settings: MethodSettings | None,
) -> Verdict:
    """Return the verdict on the middle of a light field in a file, as much as fits into memory."""
    k = psi.binning
    rows, columns = (
        slice(first, first + min(VERDICT_WINDOW, whole))
        for whole in psi.size
        for first in [max(0, (whole - VERDICT_WINDOW) // 2 // k * k)]
    )
    seen = np.s_[:, rows.start // k : rows.stop // k, columns.start // k : columns.stop // k]
    found = np.asarray(dataset[:, :, rows, columns])
    result = Reconstruction(method, found, Status.IN_TILES, "", 0, (), 0.0, {})
    screening = (settings or MethodSettings()).screening
    return verdict_of(
        psi.window(rows, columns),
        frames.readings[seen],
        frames.noise_sigma,
        frames.usable[seen],
        kept[seen],
        result,
        screening,
    )


def reconstruct_folder_in_tiles(
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
    `reconstruct_folder`; tile: samples a side.
    """
    needs_dictionary = find_method(method).needs_dictionary
    frames, psi_path = stored_frames(folder, out, psi_path)
    psi = SavedPsi(psi_path)
    views = psi.window(slice(0, psi.binning), slice(0, psi.binning)).light_field_shape[:2]
    dictionary = open_dictionary(dictionary_spec, views, psi.binning) if needs_dictionary else None
    kept = kept_readings(frames.usable)
    started = time.perf_counter()
    with h5py.File(out / LIGHT_FIELD, "w") as file:
        dataset = file.create_dataset("light_field", (*views, *psi.size, 3), "f4")
        dataset.attrs["method"] = method
        results = reconstruct_in_tiles(
            method,
            psi,
            frames.readings,
            frames.noise_sigma,
            dataset,
            dictionary,
            settings,
            frames.usable & ~kept,
            tile,
            on_tile=on_tile,
        )
        verdict = _verdict_of_middle(method, psi, frames, kept, dataset, settings)
    metrics = {
        "method": method,
        "status": Status.IN_TILES,
        "advice": "",
        "verdict": verdict.as_dict(),
        "tiles": len(results),
        "tile": tile,
        "seconds": time.perf_counter() - started,
        "parameters": results[0].parameters if results else {},
        "noise_sigma": frames.noise_sigma,
        "size": list(psi.size),
        "psi_sha256": psi.checksum,
        "command": command_line(),
        "versions": versions(),
    }
    write_metrics(out, metrics)
    return metrics
