"""Films: results of `reconstruct`, one a frame, in their places in time.

OUT/
    metrics.json       "film": frames, their number; rate, Hz; times_s, of every frame
    frames/000007/     the result of frame 7; a frame that could not be made has none
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from emmc_rig.errors import AppError
from emmc_rig.files.exports import LIGHT_FIELD, open_export
from emmc_rig.files.folders import SESSION_RECONSTRUCTION, Listing, is_session
from emmc_rig.files.formats import Export
from emmc_rig.files.results import METRICS
from emmc_rig.files.scenes import path_in
from emmc_rig.model.json_text import one_line, parse_json
from emmc_rig.model.reading import stored_arrays

FRAMES = "frames"
REMEDY = "copy the folder again, or reconstruct it again"


@dataclass(frozen=True)
class Film:
    """A film of light fields, none of them in memory.

    rate: Hz. times_s: of every place in time, from the first. frames: by place in time, in that
    order, the folder of the result; places without one are missing. shape: of every light field,
    (v, u, y, x, c).
    """

    folder: Path
    rate: float
    times_s: tuple[float, ...]
    frames: Mapping[int, Path]
    shape: tuple[int, ...]

    @property
    def missing(self) -> list[int]:
        """Places in time that have no frame."""
        return [place for place in range(len(self.times_s)) if place not in self.frames]

    def opened(self, place: int) -> Export:
        """Return the frame of a place in time; raises AppError, or KeyError where it is missing."""
        return open_export(str(self.frames[place]))

    def each(self, on_frame: Callable[[], object]) -> Iterator[tuple[int, Export]]:
        """Yield places in time with their frames, one in memory at once.

        on_frame: called when the caller is done with one.
        """
        for place in self.frames:
            yield place, self.opened(place)
            on_frame()


def film_folder(spec: str) -> Path:
    """Return the folder where a result of that name is a film, if it is: inside of a session."""
    folder = path_in(spec)
    return folder / SESSION_RECONSTRUCTION if is_session(folder) else folder


def is_film(folder: Path) -> bool:
    """Return whether a folder holds a film, whole or not."""
    return (folder / METRICS).is_file() and (folder / FRAMES).is_dir() and not is_session(folder)


def open_film(folder: Path) -> Film:
    """Open a film.

    Raises:
        AppError: no film, one of which files are missing or cut short, or frames that differ in
            shape.
    """
    rate, times_s = _times(folder)
    listing = Listing.read(folder)
    gone = [name for name in listing.files if not (folder / name).is_file()] if listing else []
    if gone:
        raise AppError(f"{folder}: {gone[0]} is missing; {REMEDY}")
    paths = ((place, folder / FRAMES / f"{place:06d}") for place in range(len(times_s)))
    frames = {place: path for place, path in paths if path.is_dir()}
    if not frames:
        raise AppError(f"{folder}: a film without a frame; {REMEDY}")
    shapes = {place: _shape(path / LIGHT_FIELD) for place, path in frames.items()}
    first, shape = next(iter(shapes.items()))
    for place, other in shapes.items():
        if other != shape:
            raise AppError(
                f"{folder}: frame {place} has the shape {other}, frame {first} {shape}: no film; "
                "reconstruct it again"
            )
    return Film(folder, rate, times_s, frames, shape)


def _times(folder: Path) -> tuple[float, tuple[float, ...]]:
    """Return the rate, Hz, and the times of all places, s, that metrics.json has."""
    path = folder / METRICS
    try:
        about = parse_json(path.read_bytes(), METRICS, ValueError)["film"]
        count, rate = int(about["frames"]), float(about["rate"])
        times_s = tuple(float(time_s) for time_s in about["times_s"])
        if not (rate > 0 and count == len(times_s)):
            raise ValueError(f"{len(times_s)} times of {count} frames at {rate:g} Hz")
    except (OSError, ValueError, KeyError, TypeError) as fault:
        raise AppError(f"{path}: not that of a film ({one_line(fault)}); {REMEDY}") from fault
    return rate, times_s


def _shape(path: Path) -> tuple[int, ...]:
    with stored_arrays(path, AppError, REMEDY) as stored:
        return tuple(stored.dataset("light_field").shape)
