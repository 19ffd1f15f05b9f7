"""A format of light fields: how it is written and read, and how much of a light field it keeps."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.errors import AppError
from emmc_rig.model.view_axes import ANGLES, ViewAxes, picture_name, shows_parallax
from emmc_rig.progress import Watcher

if TYPE_CHECKING:
    from emmc_rig.model.camera import Camera

Array = NDArray[np.floating]


@dataclass(frozen=True, eq=False)
class Export:
    """What is written: a light field (v, u, y, x, c), linear, in [0, 1], and its maps if any.

    disparity, disparity_sigma: (y, x) of the centre view and its deviation, pixels per view step.
    sigma: standard deviation (v, u, y, x). misfit: (y, x), readings missed, in deviations of their
    noise. truth: as light_field. caption: one line. metrics: as in metrics.json of a result.
    source: what was opened, as typed. view_axes: what rows and columns of views are. camera: that
    took it, if known.
    """

    title: str
    caption: str
    light_field: Array
    truth: Array | None = None
    disparity: Array | None = None
    sigma: Array | None = None
    misfit: Array | None = None
    metrics: Mapping[str, object] = field(default_factory=dict)
    source: str = ""
    view_axes: ViewAxes = ANGLES
    camera: Camera | None = None
    disparity_sigma: Array | None = None


@dataclass(frozen=True)
class Film:
    """A film of light fields, none of them in memory.

    rate: Hz. times_s: of every place in time, from the first. frames: by place in time, in that
    order, the folder of the result; places without one are missing. shape: of every light field,
    (v, u, y, x, c). open_result: opens the folder of a result. watcher: gets a step for each
    frame that is done.
    """

    folder: Path
    rate: float
    times_s: tuple[float, ...]
    frames: Mapping[int, Path]
    shape: tuple[int, ...]
    open_result: Callable[[str], Export]
    watcher: Watcher = field(default_factory=Watcher, repr=False, compare=False)

    @property
    def missing(self) -> list[int]:
        """Places in time that have no frame."""
        return [place for place in range(len(self.times_s)) if place not in self.frames]

    @property
    def first(self) -> Export:
        """The first frame that there is."""
        return self.opened(min(self.frames))

    def opened(self, place: int) -> Export:
        """Return the frame of a place in time; raises AppError, or KeyError where it is missing."""
        return self.open_result(str(self.frames[place]))

    def each(self) -> Iterator[tuple[int, Export]]:
        """Yield places in time with their frames, one in memory at once."""
        for place in self.frames:
            yield place, self.opened(place)
            self.watcher.step()


@dataclass(frozen=True)
class Format:
    """One format that others read.

    name: as typed after --format. title: what it is. keeps: what survives. write: an export into an
    existing folder. parallax: whether it shows depth or views between the views, which need views
    at angles, not bands or times. holds: whether a path is of this format, and read: that path as a
    light field; None where it cannot be a scene. write_film: a film into an existing folder; None
    where the format has nothing in time.
    """

    name: str
    title: str
    keeps: str
    write: Callable[[Path, Export], None]
    holds: Callable[[Path], bool] | None = None
    read: Callable[[Path], Array] | None = None
    parallax: bool = False
    write_film: Callable[[Path, Film], None] | None = None

    def write_whole(self, folder: Path, export: Export) -> None:
        """Write an export; raises AppError where its views have not what the format shows."""
        self._refuse_without_parallax(export)
        self.write(folder, export)

    def write_whole_film(self, folder: Path, film: Film) -> None:
        """Write a film; raises AppError as `write_whole`, and where the format has no time."""
        if self.write_film is None:
            raise AppError(
                f"format {self.name} holds no films: choose one that does, or export a single "
                f"frame, such as {film.first.source}",
                "list-formats",
            )
        self._refuse_without_parallax(film.first)
        self.write_film(folder, film)

    def _refuse_without_parallax(self, export: Export) -> None:
        if self.parallax and not shows_parallax(export.view_axes):
            named = picture_name(export.view_axes)
            raise AppError(
                f"format {self.name} shows parallax, and {export.title} has {named}s for views: "
                "choose another format"
            )


def extra_module(name: str, what: str, extra: str = "formats") -> ModuleType:
    """Return a package of an extra; raises AppError where it is not installed."""
    try:
        return import_module(name)
    except ImportError:
        package = name.partition(".")[0].replace("_", "-")
        raise AppError(f'{what} needs {package}: pip install "emmc-rig[{extra}]"') from None


def write_picture(path: Path, rgb: NDArray) -> None:
    """Write a picture (y, x, 3) or (y, x) in the format of its ending; raises AppError."""
    ordered = np.ascontiguousarray(rgb[..., ::-1]) if rgb.ndim == 3 else rgb
    done, data = cv2.imencode(path.suffix, ordered)
    if not done:
        raise AppError(f"{path}: OpenCV cannot write {path.suffix}")
    path.write_bytes(data.tobytes())
