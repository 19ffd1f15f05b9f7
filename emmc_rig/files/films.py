"""Films: results of `reconstruct`, one a frame, in their places in time.

OUT/
    metrics.json       "film": frames, their number; rate, Hz; times_s, of every frame
    frames/000007/     the result of frame 7; a frame that could not be made has none
"""

from __future__ import annotations

from pathlib import Path

from emmc_rig.errors import AppError
from emmc_rig.files.exports import open_export
from emmc_rig.files.formats.format import Film
from emmc_rig.files.result_files import AGAIN, LIGHT_FIELD, read_metrics
from emmc_rig.files.results import METRICS
from emmc_rig.files.scenes import path_in
from emmc_rig.model.json_text import one_line
from emmc_rig.model.reading import stored_arrays
from emmc_rig.store.folders import SESSION_RECONSTRUCTION, Listing, is_session

FRAMES = "frames"


def film_of(spec: str) -> Film | None:
    """Return the film that a result, or that of a session, is; None for a single light field."""
    folder = path_in(spec)
    folder = folder / SESSION_RECONSTRUCTION if is_session(folder) else folder
    holds = (folder / METRICS).is_file() and (folder / FRAMES).is_dir()
    return open_film(folder) if holds else None


def open_film(folder: Path) -> Film:
    """Open a film.

    Raises:
        AppError: no film, or one of which files are missing.
    """
    rate, times_s = _times(folder)
    listing = Listing.read(folder)
    gone = [name for name in listing.files if not (folder / name).is_file()] if listing else []
    if gone:
        raise AppError(f"{folder}: {gone[0]} is missing; {AGAIN}")
    paths = ((place, folder / FRAMES / f"{place:06d}") for place in range(len(times_s)))
    frames = {place: path for place, path in paths if path.is_dir()}
    if not frames:
        raise AppError(f"{folder}: a film without a frame; {AGAIN}")
    with stored_arrays(next(iter(frames.values())) / LIGHT_FIELD, AppError, AGAIN) as stored:
        shape = tuple(stored.dataset("light_field").shape)
    return Film(folder, rate, times_s, frames, shape, open_export)


def _times(folder: Path) -> tuple[float, tuple[float, ...]]:
    """Return the rate, Hz, and the times of all places, s, that metrics.json has."""
    known = read_metrics(folder)
    try:
        about = known["film"]
        count, rate = int(about["frames"]), float(about["rate"])
        times_s = tuple(float(time_s) for time_s in about["times_s"])
        if not (rate > 0 and count == len(times_s)):
            raise ValueError(f"{len(times_s)} times of {count} frames at {rate:g} Hz")
    except (ValueError, KeyError, TypeError) as fault:
        what = f"{folder / METRICS}: not that of a film ({one_line(fault)})"
        raise AppError(f"{what}; {AGAIN}") from fault
    return rate, times_s
