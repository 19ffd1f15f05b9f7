"""The equivalent multi-mask camera: a frozen description from YAML, and its imaging matrix Psi.

Source: the paper's Sections IV and V, eq. 4-7. Sizes are those of the light field (rows, columns
of samples); the sensor has `binning` times fewer pixels along each axis.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from emmc_rig.model.arguments import light_field_remedy, numbers_of, pair_of, refusal, required
from emmc_rig.model.errors import CameraError, SensingError
from emmc_rig.model.frames import SimulatedFrames
from emmc_rig.model.geometry import (
    CellWeights,
    Footprint,
    cell_weights,
    centred_grid,
    fresnel_number,
    mask_position,
)
from emmc_rig.model.json_text import parse_json
from emmc_rig.model.masks import AnyPattern, cfa_tile
from emmc_rig.model.noise import SensorNoise
from emmc_rig.model.pupil import LEAST_SHARE, Openings, Pupil, cell_openings, field_knots
from emmc_rig.model.reading import read_yaml
from emmc_rig.model.sensing import Psi, PsiLayout
from emmc_rig.model.settings import Settings, validated
from emmc_rig.model.view_axes import ANGLES, ATTRIBUTE, ViewAxis, grid_name, view_names

SHORTEST, LONGEST = 1e-6, 1e9
"""Of lengths (um or mm) and seconds: beyond them a unit was mistaken."""
MOST_CELLS = 2**27
"""Of a mask as drawn: 1.6 GB."""
Positive = Annotated[float, Field(gt=SHORTEST, lt=LONGEST)]
Offset = Annotated[float, Field(gt=-LONGEST, lt=LONGEST)]
NARROW_SHARE = 0.5
"""Of a view's opening: views that are less open are named."""
PSI_STRIPS = 8
"""Boxes of a view that is cut. Of points of the sensor they miss 0.1 % of Psi behind 5 x 5 views of
5 mm and 25 mm of round pupil; 4 miss 0.3 %, 16 miss 0.04 %."""
FILTER_COLOURS = {"none": (1, 1, 1), "red": (1, 0, 0), "green": (0, 1, 0), "blue": (0, 0, 1)}


class Lens(Settings):
    """The lens: D, and the aperture cells that the views stand for."""

    distance_mm: Positive = Field(default=50.0, description="D, from the sensor to the lens")
    aperture_cell_mm: Positive = Field(default=5.0, description="between the centres of two views")
    aperture_fill: float = Field(
        default=1.0, ge=0, le=1, description="open width of a cell; 0: a point"
    )
    pupil: Pupil | None = Field(
        default=None, description="what is open of the views; None: all that the cells are"
    )
    focus_mm: Positive | None = Field(
        default=None, description="from the lens to what is sharp; for depth in mm"
    )

    @model_serializer(mode="wrap")
    def _as_before(self, described: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Return what describes the lens; without unknown keys, as earlier versions hashed it."""
        plain = described(self)
        for name in ("pupil", "focus_mm"):
            if getattr(self, name) is None:
                plain.pop(name, None)
        return plain

    @property
    def aperture_cell_um(self) -> float:
        """Distance between the centres of two views, um."""
        return self.aperture_cell_mm * 1e3


class Sensor(Settings):
    """The sensor: its colour filters, sampling step and pixel size."""

    cfa: str | tuple[str, ...] = "mono"
    sample_pitch_um: Positive = 24.0
    pixel_fill: float = Field(
        default=1.0, ge=0, le=1, description="open width of a sample; 0: a point"
    )
    binning: int = Field(
        default=1, ge=1, le=16, description="k: a pixel sums k x k samples, r = 1/k^2"
    )
    noise: SensorNoise = SensorNoise()

    @model_validator(mode="after")
    def _known_tile(self) -> Sensor:
        cfa_tile(self.cfa)
        return self

    @property
    def cfa_name(self) -> str:
        """Name of the colour filter tile; "custom" for the user's own."""
        return self.cfa if isinstance(self.cfa, str) else "custom"


class Mask(Settings):
    """One coded mask: where it stands, its cells and their pattern."""

    distance_mm: float = Field(ge=0, description="d, from the sensor")
    cell_um: Positive
    pattern: AnyPattern
    spare_cells: int = Field(default=8, ge=0, description="beyond the beam, for a misplaced mask")

    @model_validator(mode="before")
    @classmethod
    def _placed(cls, data: object) -> object:
        """Refuse cells alone, and take those of a pattern as they are."""
        if isinstance(data, list):
            known = "{'distance_mm': ..., 'cell_um': ..., 'pattern': cells}"
            raise ValueError(f"cells alone do not say where the mask is: {known}")
        if isinstance(data, dict) and isinstance(data.get("pattern"), list):
            return {**data, "pattern": {"kind": "parameters", "cells": data["pattern"]}}
        return data


class Shot(Settings):
    """One exposure: which masks, moved by how much (x, y), behind which colour filter.

    masks: names of those in the beam; None: all. offset_um: by mask, um from where it is centred.
    exposure_s: seconds; None: the camera's `total_exposure_s`, divided evenly by the shots.
    """

    masks: tuple[str, ...] | None = None
    offset_um: dict[str, tuple[Offset, Offset]] = Field(default_factory=dict)
    exposure_s: Positive | None = None
    filter: Literal["none", "red", "green", "blue"] = "none"


class Camera(Settings):
    """A camera with coded masks: `camera.psi(size)` models it, `camera.expose(scene)` uses it.

    Fields are the keys of a camera's YAML file; `emmc_rig.camera` makes a camera of them. Lengths
    are in mm or um, times in s, as the ending of their name says.

    title: a line that names the camera. reference: where its design is published.
    views: (rows, columns) of views, the cells of the aperture.
    view_axes: what rows and columns of views are; bands are placed like views, for masks whose
    shadow moves with the band.
    lens: distance from the sensor, pitch of the views, what of them is open, focus.
    sensor: colour filters, sampling step, binning and noise.
    masks: by name: distance from the sensor, cell size and pattern of transmittances in [0, 1].
    shots: for each exposure its masks, their offsets (x, y), and its colour filter.
    more_shots_step_um: by mask, how far (x, y) each further round of shots moves it, see
    `with_shots`; None: there are no further shots.
    total_exposure_s: divided evenly by the number of shots; a shot may name its own instead.
    footprint_splits: parts of samples and openings along each axis, over which products of several
    masks are averaged; more for masks with cells as fine as their shadow.
    """

    title: str
    reference: str = ""
    views: tuple[int, int] = (5, 5)
    view_axes: tuple[ViewAxis, ViewAxis] = ("angle", "angle")
    lens: Lens = Lens()
    sensor: Sensor = Sensor()
    masks: dict[str, Mask] = Field(default_factory=dict)
    shots: tuple[Shot, ...] = Field((Shot(),), min_length=1)
    more_shots_step_um: dict[str, tuple[Offset, Offset]] | None = None
    total_exposure_s: Positive = 0.05
    footprint_splits: int = Field(default=3, ge=1, le=9)

    @model_validator(mode="after")
    def _consistent(self) -> Camera:
        if min(self.views) < 1:
            raise ValueError("'views' needs at least one row and one column")
        for name, mask in self.masks.items():
            if mask.distance_mm > self.lens.distance_mm * (1 + 1e-9):
                raise ValueError(
                    f"mask '{name}' at {mask.distance_mm:g} mm is further away than the lens "
                    f"({self.lens.distance_mm:g} mm): use 0 <= distance_mm <= lens.distance_mm"
                )
        named = [
            (name, f"shot {index}")
            for index, shot in enumerate(self.shots)
            for name in (*(shot.masks or ()), *shot.offset_um)
        ] + [(name, "more_shots_step_um") for name in self.more_shots_step_um or {}]
        for name, where in named:
            if name not in self.masks:
                known = ", ".join(self.masks) or "none"
                raise ValueError(f"{where} names mask '{name}', which is not among: {known}")
        if not self.views_measured().any():
            raise ValueError("lens.pupil leaves no view open: check its diameter_mm and centre_mm")
        return self

    @model_serializer(mode="wrap")
    def _as_before(self, described: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Return what describes the camera; of angles as earlier versions wrote and hashed it."""
        plain = described(self)
        if self.view_axes == ANGLES:
            plain.pop(ATTRIBUTE, None)
        return plain

    def view_shares(self) -> NDArray[np.float64]:
        """Return which share of every view's opening the lens leaves open on the axis, (v, u)."""
        return self._openings().shares(self.views)

    def views_measured(self) -> NDArray[np.bool_]:
        """Return which views (v, u) lie in the lens's pupil, if only in part."""
        return self.view_shares() >= LEAST_SHARE

    def open_views(self) -> float:
        """Return how many whole views pass as much light as all of them behind the pupil."""
        return float(self.view_shares().sum())

    def _openings(self, pixel_um: tuple[float, float] = (0.0, 0.0)) -> Openings:
        """Return the boxes of the views' openings that a pixel at (x, y) from the axis sees."""
        lens = self.lens
        return cell_openings(
            lens.pupil, self.views, lens.aperture_cell_um, lens.aperture_fill, pixel_um, PSI_STRIPS
        )

    def seen_tile(self) -> NDArray[np.float32]:
        """Return which colours of a light field pixels see, a tile (row, column, colour), 0 or 1.

        A band has no colours: a sensor without filters sees it as red, and red stands for all.
        """
        tile = cfa_tile(self.sensor.cfa)
        filtered = not tile.all() or any(shot.filter != "none" for shot in self.shots)
        if filtered or "band" not in self.view_axes:
            return tile
        return tile * np.array([1, 0, 0], np.float32)

    def shot_masks(self, shot: int) -> tuple[str, ...]:
        """Return the names of the masks in the beam during a shot."""
        chosen = self.shots[shot].masks
        return tuple(self.masks) if chosen is None else chosen

    @property
    def moving_masks(self) -> tuple[str, ...]:
        """Names of the masks that some shot moves: those on the mask stage."""
        moved = {name for shot in self.shots for name in shot.offset_um}
        moved.update(self.more_shots_step_um or {})
        return tuple(name for name in self.masks if name in moved)

    def exposures_s(self) -> NDArray[np.float64]:
        """Return the exposure of every shot, seconds, shape (shot,)."""
        named = [shot.exposure_s for shot in self.shots]
        shared = self.total_exposure_s / len(self.shots)
        return np.array([shared if exposure is None else exposure for exposure in named])

    def with_shots(self, count: int) -> Camera:
        """Return the camera with `count` shots: the first ones, or further rounds of them.

        A further round moves the masks by `more_shots_step_um`, and shows the next frames of
        patterns that have several.

        Raises:
            CameraError: no shots, or more than the camera has, without `more_shots_step_um`.
        """
        if count < 1:
            raise CameraError(f"{count} shots: at least one is needed")
        have = len(self.shots)
        if count > have and self.more_shots_step_um is None:
            raise CameraError(
                f"'{self.title}' has {have} shot{'s' * (have > 1)}, not {count}: ask for fewer, or "
                "write more_shots_step_um into its file"
            )
        steps = self.more_shots_step_um or {}

        def moved(index: int) -> Shot:
            shot, turn = self.shots[index % have], index // have
            names = {*shot.offset_um, *(steps if turn else ())}
            offsets = {}
            for name in names:
                (x, y), (dx, dy) = shot.offset_um.get(name, (0, 0)), steps.get(name, (0, 0))
                offsets[name] = (x + turn * dx, y + turn * dy)
            return shot.model_copy(update={"offset_um": offsets})

        return self.model_copy(update={"shots": tuple(moved(index) for index in range(count))})

    def psi(self, size: tuple[int, int]) -> Psi:
        """Return the imaging matrix, which maps a light field (v, u, y, x, c) to frames.

        It is normalised: the camera without masks reads 1 from a constant white light field.

        Args:
            size: (rows, columns) of samples of the light field; `sensor.binning` times those of
                the sensor's pixels.

        Raises:
            CameraError: a mask smaller than the beam, pixels that do not divide the light field, a
                shot that no light reaches.
            ArgumentError: a size of another type.
        """
        size = pair_of(size, "size", "rows and columns of samples, such as (192, 256)")
        return build_imaging_matrix(self, size)

    def expose(
        self,
        scene: ArrayLike,
        seed: int | np.random.Generator = 0,
        psi: Psi | None = None,
        exposure_s: ArrayLike | None = None,
    ) -> SimulatedFrames:
        """Return the frames of a light field, with the sensor's noise (the paper's eq. 14).

        A reconstruction by the Psi that made the frames is better than one of a measurement: a rig,
        simulated or real, has its own geometry.

        Args:
            scene: a scene, or a light field (v, u, y, x, 3), floating, linear RGB in [0, 1].
            seed: of the noise, or a generator of NumPy.
            psi: the camera's Psi for this size, if it was computed before. None: it is computed.
            exposure_s: seconds, a number for all shots, or for each shot. None: the camera's.

        Returns:
            Frames with `readings`, `deviation` and `usable`, and also `frames_dn`, the raw values
            in DN, and `noise_free`, the readings without noise; all (shot, pixel_y, pixel_x).

        Raises:
            ArgumentError: an argument of another type.
            CameraError: see `psi`.
            SensingError: a light field of another size than Psi's.
        """
        takes = "a scene, or a light field, a floating array (v, u, y, x, 3) in [0, 1]"
        light_field = numbers_of(scene, "scene", takes)
        if light_field.ndim != 5 or light_field.dtype.kind != "f" or light_field.shape[4] != 3:
            raise refusal(scene, "scene", f"{takes}{light_field_remedy(light_field)}")
        required(
            seed, (int, np.random.Generator), "seed", "a whole number, or a generator of NumPy"
        )
        if psi is not None:
            required(psi, Psi, "psi", "the camera's Psi, camera.psi(size)")
        psi = self.psi((light_field.shape[2], light_field.shape[3])) if psi is None else psi
        camera = self if exposure_s is None else self.with_exposures(exposure_s)
        return camera.read_out(psi.forward(light_field), seed)

    def with_exposures(self, exposure_s: ArrayLike) -> Camera:
        """Return the camera with other exposures, of every shot or of each; ArgumentError."""
        takes = f"seconds, of every shot or of each of {len(self.shots)}"
        given = numbers_of(np.atleast_1d(exposure_s), "exposure_s", takes)
        inside = (given > SHORTEST) & (given < LONGEST)
        if given.shape not in ((1,), (len(self.shots),)) or not inside.all():
            raise refusal(exposure_s, "exposure_s", takes)
        shots = zip(self.shots, np.broadcast_to(given, len(self.shots)).tolist(), strict=True)
        timed = tuple(shot.model_copy(update={"exposure_s": each}) for shot, each in shots)
        return self.model_copy(update={"shots": timed})

    def read_out(
        self, noise_free: NDArray[np.floating], seed: int | np.random.Generator = 0
    ) -> SimulatedFrames:
        """Return frames with noise whose readings (shot, pixel_y, pixel_x) without it are given."""
        noise, k = self.sensor.noise, self.sensor.binning
        light = pixel_light(self, (noise_free.shape[1] * k, noise_free.shape[2] * k))
        exposures_s = self.exposures_s()[:, None, None]
        rng = np.random.default_rng(seed)
        frames_dn = noise.expose_dn(noise_free, exposures_s, light, rng)
        readings = noise.normalise(frames_dn, exposures_s, light)
        deviation = np.sqrt(noise.variance(readings, exposures_s, light))
        usable = ~noise.saturated(frames_dn) & (light > 0)
        return SimulatedFrames(readings, deviation, usable, frames_dn, noise_free)

    def __str__(self) -> str:
        return repr(self)

    def _repr_html_(self) -> str:
        from emmc_rig.model.notebook import MIDDLE, figure_html, middle, shadow_pictures

        k = self.sensor.binning
        size = -(-MIDDLE[0] // k) * k, -(-MIDDLE[1] // k) * k
        try:
            plates, psi = draw_plates(self, size), self.psi(size)
        except CameraError as fault:
            return figure_html(f"{self!r}: {fault}", {})
        masks = {
            f"mask '{name}' at {plate.distance_mm:g} mm": middle(plate.cells[0])
            for name, plate in plates.items()
        }
        return figure_html(repr(self), masks | shadow_pictures(psi.weights, psi.colour))

    def __repr__(self) -> str:
        shots, pictures = len(self.shots), grid_name(self.view_axes, self.views)
        masks = f"{len(self.masks)} mask{'s' * (len(self.masks) != 1)}"
        return (
            f"Camera({self.title!r}, {shots} shot{'s' * (shots > 1)}, {pictures}, "
            f"{self.sensor.cfa_name}, {masks})"
        )

    def warnings(self) -> list[str]:
        """Return warnings, a sentence each: effects that the model neglects although they matter,
        and views that the lens's pupil cuts or covers.
        """
        neglected = []
        for name, mask in self.masks.items():
            number = fresnel_number(mask.cell_um, mask.distance_mm)
            if number < 1 and mask.distance_mm < self.lens.distance_mm:
                neglected.append(
                    f"mask '{name}': Fresnel number {number:.2g} < 1, diffraction blurs its "
                    "shadow and is not modelled; whiteboard calibration measures it"
                )
        return neglected + self._narrow_views()

    def _narrow_views(self) -> list[str]:
        """Return which views are wholly outside of the lens's pupil, and which open by a part."""
        measured, shares = self.views_measured(), self.view_shares()
        outside = view_names(np.argwhere(~measured))
        percent = np.round(100 * shares)
        narrow = measured & (shares < NARROW_SHARE)
        parts = [
            f"{view_names(np.argwhere(narrow & (percent == each)))} {each:.0f} % open"
            for each in np.unique(percent[narrow])
        ]
        lines = [f"{outside} outside of the lens's pupil: not measured"] if outside else []
        if parts:
            lines.append(f"{'; '.join(parts)} in the lens's pupil: less light, more noise")
        return lines


def shipped_camera_files() -> dict[str, Path]:
    """Return the files of the cameras that come with the program, by name."""
    folder = resources.files("emmc_rig") / "cameras"
    files = {
        item.name.removesuffix(".yaml"): Path(str(item))
        for item in folder.iterdir()
        if item.name.endswith(".yaml")
    }
    return dict(sorted(files.items()))


def shipped_cameras() -> dict[str, Camera]:
    """Return the cameras that come with the program, by name."""
    return {name: load_camera(path) for name, path in shipped_camera_files().items()}


def load_camera(path: Path) -> Camera:
    """Return the camera described by a YAML file; raises CameraError with one line.

    The paths of mask pictures are relative to the folder of the file.
    """
    camera = validated(Camera, read_yaml(path, CameraError), str(path), CameraError)
    masks = {
        name: mask.model_copy(update={"pattern": mask.pattern.beside(path.parent)})
        for name, mask in camera.masks.items()
    }
    return camera.model_copy(update={"masks": masks})


def camera_of(psi: PsiLayout) -> Camera:
    """Return the camera that a Psi says it is of; raises SensingError where that is no camera."""
    source = "Psi's camera"
    described = parse_json(psi.camera_json, source, SensingError)
    return validated(Camera, described, source, SensingError)


def measured_views(psi: PsiLayout) -> NDArray[np.bool_]:
    """Return which views (v, u) a Psi measures: its camera's pupil leaves them open, some light
    of theirs reaches a pixel."""
    measured = np.ones(psi.views, dtype=bool)
    if psi.camera_json:
        described = camera_of(psi)
        if described.views == psi.views:
            measured &= described.views_measured()
    if isinstance(psi, Psi):
        for v, u in np.argwhere(measured):
            measured[v, u] = psi.weights[:, v, u].any()
    return measured


def json_of_shots(camera: Camera, shots: Sequence[int]) -> str:
    """Return the camera with some of its shots alone, as `Psi.camera_json`.

    "" for cameras whose mask shows another pattern in every shot: no subset is a camera.
    """
    count = len(camera.shots)
    if any(mask.pattern.frame_count(count) > 1 for mask in camera.masks.values()):
        return ""
    timed = camera.with_exposures(camera.exposures_s())
    chosen = [timed.shots[shot] for shot in shots]
    return camera.model_copy(update={"shots": tuple(chosen)}).model_dump_json()


def psi_of_shot(psi: Psi, shot: int) -> Psi:
    """Return the Psi of one shot, counted from 0, with its camera."""
    if psi.shots == 1:
        return psi
    return psi.of_shots([shot], json_of_shots(camera_of(psi), [shot]) if psi.camera_json else "")


@dataclass(frozen=True)
class Plate:
    """A mask as manufactured: cells (frame, row, column, colour), their side and distance."""

    cells: NDArray[np.float32]
    cell_um: float
    distance_mm: float


@dataclass(frozen=True)
class BeamAxis:
    """One axis of the camera, in um: where samples and openings lie and how wide they are.

    openings_um, opening_widths_um: of every view, or of every box of views that are cut.
    """

    samples_um: NDArray[np.float64]
    openings_um: NDArray[np.float64]
    sample_width_um: float
    opening_widths_um: NDArray[np.float64]
    lens_um: float

    def split(self, splits: int, sample_part: int, opening_part: int) -> BeamAxis:
        """Return the axis of one part of `splits` in every sample and every opening."""

        def shifted(
            positions: NDArray[np.float64], width: NDArray[np.float64] | float, part: int
        ) -> NDArray[np.float64]:
            return positions + (part - (splits - 1) / 2) * (width / splits)

        return BeamAxis(
            shifted(self.samples_um, self.sample_width_um, sample_part),
            shifted(self.openings_um, self.opening_widths_um, opening_part),
            self.sample_width_um / splits,
            self.opening_widths_um / splits,
            self.lens_um,
        )

    def footprint(self, distance_um: float, opening: int) -> Footprint:
        """Return the two boxes through which a mask at a distance is seen."""
        ratio = distance_um / self.lens_um
        return Footprint(
            (1 - ratio) * self.sample_width_um, ratio * float(self.opening_widths_um[opening])
        )

    def reach_um(self, distance_um: float) -> float:
        """Return how far from the axis the beam meets a mask at a distance."""
        edge = mask_position(self.samples_um[-1], self.openings_um[-1], distance_um, self.lens_um)
        return float(edge) + self.footprint(distance_um, -1).half_width_um

    def meets_um(self, distance_um: float, opening: int) -> NDArray[np.float64]:
        """Return where the rays of every sample and one opening meet a mask at a distance."""
        return mask_position(self.samples_um, self.openings_um[opening], distance_um, self.lens_um)

    def weights(self, opening: int, plate: Plate, cell_count: int, offset_um: float) -> CellWeights:
        """Return (sample, cell): the share of every mask cell seen through one opening."""
        distance_um = plate.distance_mm * 1e3
        return cell_weights(
            self.meets_um(distance_um, opening) - offset_um,
            self.footprint(distance_um, opening),
            plate.cell_um,
            cell_count,
        )


def _axes(camera: Camera, size: tuple[int, int]) -> tuple[BeamAxis, BeamAxis]:
    """Return the y and the x axis of a camera for a light field of `size` samples, views whole."""
    lens, sensor = camera.lens, camera.sensor
    cell_um = lens.aperture_cell_um

    def axis(samples: int, views: int) -> BeamAxis:
        return BeamAxis(
            centred_grid(samples, sensor.sample_pitch_um),
            centred_grid(views, cell_um),
            sensor.sample_pitch_um * sensor.pixel_fill,
            np.full(views, cell_um * lens.aperture_fill),
            lens.distance_mm * 1e3,
        )

    return axis(size[0], camera.views[0]), axis(size[1], camera.views[1])


def _cell_count(axis: BeamAxis, mask: Mask, offsets_um: list[float], pitch_um: float) -> int:
    """Return how many cells a mask needs along an axis, with its spare ones on both sides.

    The parity puts the edges of cells that project onto one sample on the edges of the samples.
    """
    reach_um = axis.reach_um(mask.distance_mm * 1e3) + max(abs(offset) for offset in offsets_um)
    at_lens = mask.distance_mm * 1e3 > 0.5 * axis.lens_um
    count = int(np.ceil(2 * reach_um / mask.cell_um - 1e-9))
    if at_lens:
        return count
    count += 2 * mask.spare_cells
    view_span_um = axis.openings_um[-1] - axis.openings_um[0]
    ratio = mask.distance_mm * 1e3 / axis.lens_um
    span = view_span_um * ratio + (1 - ratio) * pitch_um * len(axis.samples_um)
    return count + (count - round(span / mask.cell_um)) % 2


def draw_plates(camera: Camera, size: tuple[int, int]) -> dict[str, Plate]:
    """Return every mask of a camera as manufactured for a light field of `size` (rows, columns)."""
    axis_y, axis_x = _axes(camera, size)
    pitch_um = camera.sensor.sample_pitch_um
    plates = {}
    for name, mask in camera.masks.items():
        offsets = [shot.offset_um.get(name, (0.0, 0.0)) for shot in camera.shots]
        rows = _cell_count(axis_y, mask, [y for _, y in offsets], pitch_um)
        columns = _cell_count(axis_x, mask, [x for x, _ in offsets], pitch_um)
        frames = mask.pattern.frame_count(len(camera.shots))
        if frames * rows * columns > MOST_CELLS:
            raise CameraError(
                f"mask '{name}' would have {rows} x {columns} cells: check the units of cell_um, "
                "sample_pitch_um, aperture_cell_mm and offset_um, or use a smaller size"
            )
        cells = mask.pattern.draw(frames, rows, columns, mask.cell_um)
        plates[name] = Plate(cells, mask.cell_um, mask.distance_mm)
    return plates


def sensor_response(camera: Camera, size: tuple[int, int]) -> NDArray[np.float32]:
    """Return which colours every sample's pixel sees in every shot: (shot, y, x, colour), 0 or 1.

    Raises CameraError when the pixels do not divide the light field.
    """
    k = camera.sensor.binning
    rows, columns = size
    if rows % k or columns % k:
        raise CameraError(
            f"pixels of {k} x {k} samples do not divide a light field of {rows} x {columns}: "
            f"crop it to {rows // k * k} x {columns // k * k}"
        )
    tile = camera.seen_tile()
    pixels = tile[(np.arange(rows) // k) % tile.shape[0]][
        :, (np.arange(columns) // k) % tile.shape[1]
    ]
    filters = np.array([FILTER_COLOURS[shot.filter] for shot in camera.shots], dtype=np.float32)
    return pixels[None] * filters[:, None, None, :]


def pixel_light(camera: Camera, size: tuple[int, int]) -> NDArray[np.float32]:
    """Return how much light each pixel collects, (shot, pixel_y, pixel_x); see model.noise."""
    k = camera.sensor.binning
    colours = sensor_response(camera, size).sum(axis=-1)[:, ::k, ::k]
    return colours * k**2


class _Box(NamedTuple):
    """A box of a view's opening: its share of the view's cell, its place on the y and x axis."""

    share: float
    down: int
    across: int


@dataclass(frozen=True, eq=False)
class BeamField:
    """A part of the picture and the openings that its pixels see: of all samples, or by a knot.

    boxes: of the views that are open. open: shares of all views together. rows, columns: of the
    picture. blend: (y, x), how much the part counts at its samples; 1: wholly.
    """

    axes: tuple[BeamAxis, BeamAxis]
    boxes: dict[tuple[int, int], list[_Box]]
    open: float
    rows: slice
    columns: slice
    blend: NDArray[np.float32] | float = 1.0


def beam_fields(camera: Camera, size: tuple[int, int]) -> list[BeamField]:
    """Return the parts of the picture with the openings that they see, see `field_knots`."""
    axes = _axes(camera, size)
    knots = field_knots(
        camera.lens.pupil, camera.lens.aperture_cell_um, (axes[0].samples_um, axes[1].samples_um)
    )
    whole = len(knots) == 1
    return [
        _field(
            camera,
            axes,
            (knot.x_um, knot.y_um),
            knot.rows,
            knot.columns,
            1.0 if whole else np.outer(knot.down, knot.across).astype(np.float32),
        )
        for knot in knots
    ]


def _field(
    camera: Camera,
    axes: tuple[BeamAxis, BeamAxis],
    pixel_um: tuple[float, float],
    rows: slice,
    columns: slice,
    blend: NDArray[np.float32] | float = 1.0,
) -> BeamField:
    """Return a part of the picture whose pixels see the views as the one at (x, y) does.

    Whole views share the openings of their row and their column; boxes of cut views follow them.
    """
    found = camera._openings(pixel_um)
    shares = found.shares(camera.views)
    boxes: dict[tuple[int, int], list[_Box]] = {}
    cut = []
    for v, u in np.argwhere(shares >= LEAST_SHARE):
        parts = found.of_view(v, u)
        if len(parts) == 1:
            boxes[v, u] = [_Box(float(found.share[parts[0]]), v, u)]
            continue
        parts = parts[found.share[parts] > 0]
        boxes[v, u] = [
            _Box(float(found.share[part]), camera.views[0] + place, camera.views[1] + place)
            for place, part in enumerate(parts, len(cut))
        ]
        cut.extend(parts)
    chosen = np.array(cut, dtype=np.intp)
    beside = (found.y_um[chosen], found.x_um[chosen])
    wide = (found.height_um[chosen], found.width_um[chosen])
    down, across = (
        replace(
            along,
            samples_um=along.samples_um[part],
            openings_um=np.append(along.openings_um, along.openings_um[views] + beside_um),
            opening_widths_um=np.append(along.opening_widths_um, wide_um),
        )
        for along, part, views, beside_um, wide_um in zip(
            axes, (rows, columns), found.view[chosen].T, beside, wide, strict=True
        )
    )
    return BeamField(
        (down, across), boxes, float(shares[shares >= LEAST_SHARE].sum()), rows, columns, blend
    )


def _cells_seen(
    camera: Camera, plates: dict[str, Plate], shot: int, axis: int, along: BeamAxis
) -> dict[str, list[CellWeights]]:
    """Return the matrix (sample, cell) of each opening, by mask in the beam of a shot.

    axis: 0: y, 1: x. along: that axis, or a part of every sample and opening on it. Raises
    CameraError for a mask smaller than the beam.
    """
    seen = {}
    for name in camera.shot_masks(shot):
        plate = plates[name]
        offset_um = camera.shots[shot].offset_um.get(name, (0.0, 0.0))[1 - axis]
        try:
            seen[name] = [
                along.weights(opening, plate, plate.cells.shape[1 + axis], offset_um)
                for opening in range(len(along.openings_um))
            ]
        except CameraError as fault:
            raise CameraError(f"mask '{name}', shot {shot}: {fault}") from fault
    return seen


def _transmittances(
    camera: Camera, size: tuple[int, int], plates: dict[str, Plate], shot: int
) -> Iterator[tuple[int, int, NDArray[np.float32]]]:
    """Yield (v, u, transmittance (y, x, colour)) of all masks together, averaged over footprints.

    Behind a pupil a view counts by the boxes of its opening (`_through_masks`) and their shares,

        t_view = V U / (sum of the shares of all views)  sum_boxes share_box t_box.

    Without a pupil every view is a box of share 1: t_view = t_box.
    """
    fields = beam_fields(camera, size)
    through = [_through_masks(camera, field, plates, shot) for field in fields]
    pupil = camera.lens.pupil
    scale: NDArray[np.floating] | float = 1.0
    if pupil is not None:
        everything = np.zeros(size, dtype=np.float32)
        for field in fields:
            everything[field.rows, field.columns] += field.blend * np.float32(field.open)
        scale = camera.views[0] * camera.views[1] / np.maximum(everything, LEAST_SHARE)[..., None]
    for v, u in np.ndindex(camera.views):
        if pupil is None:
            yield v, u, through[0](v, u)
            continue
        total = np.zeros((*size, 3), dtype=np.float32)
        for field, passed in zip(fields, through, strict=True):
            for box in field.boxes.get((v, u), ()):
                blend = np.atleast_2d(np.float32(box.share * field.blend))[..., None]
                total[field.rows, field.columns] += blend * passed(box.down, box.across)
        yield v, u, total * scale


def _through_masks(
    camera: Camera, field: BeamField, plates: dict[str, Plate], shot: int
) -> Callable[[int, int], NDArray[np.float32]]:
    """Return a function of the openings along y and x: the transmittance (y, x, colour) of a box.

    A footprint is the product of one along y and one along x, so that of each mask m, exactly,

        t_m[y, x] = sum_ij  D_m[y, i]  cells_m[i, j]  R_m[x, j]

    with D (down) for the opening along y and R (right) for that along x, see `_cells_seen`.

    The average of a product of masks is not the product of their averages where the footprints on
    two masks cover several cells. Samples and openings are then split into k = `footprint_splits`
    parts along each axis, and

        t = k^-4  sum over the parts along y and along x of  prod_m t_m(parts).
    """
    whole = [
        _cells_seen(camera, plates, shot, axis, along) for axis, along in enumerate(field.axes)
    ]
    split_masks = {
        name
        for seen in whole
        for name, of_openings in seen.items()
        if any(matrix.splits_cells for matrix in of_openings)
    }
    splits = camera.footprint_splits if len(split_masks) > 1 else 1
    down, right = [whole[0]], [whole[1]]
    if splits > 1:
        down, right = (
            [
                _cells_seen(camera, plates, shot, axis, along.split(splits, sample, opening))
                for sample, opening in np.ndindex(splits, splits)
            ]
            for axis, along in enumerate(field.axes)
        )
    cells = {
        name: plates[name].cells[shot % len(plates[name].cells)] for name in camera.shot_masks(shot)
    }
    shape = (*(len(along.samples_um) for along in field.axes), 3)

    @lru_cache(maxsize=1)  # views of one row follow each other
    def rows_seen(opening: int) -> list[dict[str, list[NDArray[np.float64]]]]:
        return [
            {name: [seen[name][opening] @ cells[name][:, :, c] for c in range(3)] for name in cells}
            for seen in down
        ]

    def passed(opening_y: int, opening_x: int) -> NDArray[np.float32]:
        total = np.zeros(shape, dtype=np.float32)
        for of_rows in rows_seen(opening_y):
            for seen in right:
                product = np.ones(shape, dtype=np.float32)
                for name, of_colours in of_rows.items():
                    for colour, row_of_cells in enumerate(of_colours):
                        product[:, :, colour] *= (seen[name][opening_x] @ row_of_cells.T).T
                total += product
        total /= splits**4
        return total

    return passed


def psi_layout(camera: Camera, size: tuple[int, int]) -> PsiLayout:
    """Return what the Psi of a camera looks like for `size` samples, without building it.

    Raises CameraError when the pixels do not divide the light field.
    """
    k = camera.sensor.binning
    tile = camera.seen_tile()
    # One period of the filters shows whether pixels see one colour, and which.
    period = sensor_response(camera, (tile.shape[0] * k, tile.shape[1] * k))
    single = bool((period.sum(axis=-1) <= 1).all())
    if size[0] % k or size[1] % k:
        sensor_response(camera, size)  # raises, and says what to do
    colour = None
    if single:
        sides = tile.shape[0] * k, tile.shape[1] * k
        rows, columns = np.arange(size[0]) % sides[0], np.arange(size[1]) % sides[1]
        colour = period.argmax(axis=-1).astype(np.uint8)[:, rows[:, None], columns]
    shape = (len(camera.shots), *camera.views, size[0], 1 if single else 3, size[1])
    return PsiLayout(shape, colour, k, camera.model_dump_json(), camera.view_axes)


def seen_of_white(
    camera: Camera, size: tuple[int, int], plates: dict[str, Plate]
) -> NDArray[np.float64]:
    """Return the sum over the views of Psi's weights, (shot, y, stored colour, x), without Psi.

    Arguments and errors: see `build_imaging_matrix`, which alone refuses shots without light.
    """
    layout = psi_layout(camera, size)
    colour = layout.colour
    seen = np.empty((layout.shots, *layout.weights_shape[3:]))
    for shot, share in enumerate(open_shares(camera, size)):
        passed = _passed_to_all(camera, size, plates, shot) * share
        if colour is not None:
            index = colour[shot][..., None].astype(np.intp)
            passed = np.take_along_axis(passed, index, axis=-1)
        seen[shot] = passed.transpose(0, 2, 1)
    return seen


def _passed_to_all(
    camera: Camera, size: tuple[int, int], plates: dict[str, Plate], shot: int
) -> NDArray[np.float64]:
    """Return the sum over the views of what `_transmittances` yields, (y, x, colour).

    Of a single mask behind a lens without pupil it is separable,

        sum_vu t = (sum_v D_v) cells (sum_u R_u)^T.
    """
    names = camera.shot_masks(shot)
    if len(names) != 1 or camera.lens.pupil is not None:
        every = (passed for _, _, passed in _transmittances(camera, size, plates, shot))
        return np.asarray(sum(every), dtype=np.float64)
    (name,) = names
    down, right = (
        CellWeights.summed(_cells_seen(camera, plates, shot, axis, along)[name])
        for axis, along in enumerate(_axes(camera, size))
    )
    cells = plates[name].cells[shot % len(plates[name].cells)]
    return np.stack([down @ (right @ cells[:, :, c].T).T for c in range(3)], axis=-1)


def open_shares(camera: Camera, size: tuple[int, int]) -> list[NDArray[np.float32]]:
    """Return an open camera's Psi, r / (sum_c r  V U k^2), (y, x, colour) of each shot."""
    response = sensor_response(camera, size)
    scale = camera.views[0] * camera.views[1] * camera.sensor.binning**2
    return [
        (colours / np.maximum(seen, 1)[..., None] / scale).astype(np.float32)
        for colours, seen in zip(response, response.sum(axis=-1), strict=True)
    ]


def build_imaging_matrix(
    camera: Camera, size: tuple[int, int], plates: dict[str, Plate] | None = None
) -> Psi:
    """Return Psi of a camera for a light field of `size` (rows, columns) samples (paper, eq. 6, 7).

        Psi[s, v, u, y, c, x] = t[s, v, u, y, x, c]  r[s, y, x, c] / (sum_c r  V U k^2)

    with the transmittance t of the masks (`_transmittances`), the response r of the colour filters,
    0 or 1 (`sensor_response`), V x U views, and pixels of k x k samples: the fully open camera
    reads 1 from a constant white light field. plates: the masks as they came out, by name; None:
    as drawn, see `draw_plates`.

    Raises CameraError for a mask smaller than the beam, for pixels that do not
    divide the light field, and for a shot that no light reaches.
    """
    plates = draw_plates(camera, size) if plates is None else plates
    layout = psi_layout(camera, size)
    colour, weights = layout.colour, np.empty(layout.weights_shape, dtype=np.float32)
    for shot, share in enumerate(open_shares(camera, size)):
        for v, u, passed in _transmittances(camera, size, plates, shot):
            passed *= share
            if colour is not None:
                index = colour[shot][..., None].astype(np.intp)
                weights[shot, v, u, :, 0, :] = np.take_along_axis(passed, index, axis=-1)[..., 0]
            else:
                weights[shot, v, u] = passed.transpose(0, 2, 1)
        if not weights[shot].any():
            raise CameraError(
                f"no light reaches the sensor in shot {shot}: open its masks or change its filter"
            )
    return layout.psi(weights)
