"""Files of another program as a session, as if the sequencer had taken their frames.

Everything is read and checked before anything is written; the session is then written beside its
place, verified, and takes its name. Each frame keeps the bytes of its file, as frames of an unknown
camera do (see `emmc_rig.session.frame_file`); of a file with several frames the first one does.
"""

from __future__ import annotations

import hashlib
import tempfile
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import count, groupby
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from emmc_rig.bench.rig_config import IMPORTED
from emmc_rig.captures.expand import fittings, mask_offsets_um
from emmc_rig.captures.import_table import LONGEST_S, Listed
from emmc_rig.captures.plan import Checks, Plan, planned_camera
from emmc_rig.drivers.camera import EXPOSURE_AGREEMENT
from emmc_rig.drivers.capture_order import capture_order
from emmc_rig.drivers.raw import RawFrame, captured_at
from emmc_rig.errors import ERRORS, AppError
from emmc_rig.formats.cameras import find_camera
from emmc_rig.formats.own_arrays import OwnFrames, read_own
from emmc_rig.model.camera import Camera, build_imaging_matrix, pixel_light
from emmc_rig.model.files import whole
from emmc_rig.model.geometry import centred_grid
from emmc_rig.model.json_text import shown_path
from emmc_rig.model.settings import validated
from emmc_rig.session.brightness import BRIGHT_PERCENTILE, figures
from emmc_rig.session.frame_file import frame_entry, frame_file
from emmc_rig.session.journal import CompleteEntry, ImportedEntry, RunEntry
from emmc_rig.session.lock import held
from emmc_rig.session.planned import SHOT_DARK, VALIDATION, Bench, PlannedFrame
from emmc_rig.session.session import Frozen, Session, wall_time
from emmc_rig.session.verify import verify_frames
from emmc_rig.store.folders import refuse_filled, refuse_inside_session
from emmc_rig.store.results import command_line, versions

KIND_ORDER = ("dark", "reference", "whiteboard", "open", "check", "turned", VALIDATION, "shot")
OF_FIRST_SHOT = ("open", VALIDATION, "check", "turned")
"""Kinds of whiteboards through the whole aperture."""
TOP_DN = 65_535
BRIGHTEST = 0.9
"""Reading of the brightest part of a scene where nothing states how bright white is."""
FAIR_NOISE = 0.01
"""Of the brightest reading, for values of an unknown unit: three published cameras of other groups
have 0.008 to 0.01."""
PROBE = 64
"""Rows and columns at most of the Psi that says how much light a camera's masks let through."""
FEWEST_TO_HOLD_OUT = 3
UNIT = 1000.0
"""Ratio of s to ms, of mm to um and of um to nm: values in the wrong unit differ by it."""
LEAST_MOVE = 50.0
"""Of a cell: nobody moves a mask or pinhole by less, but 0.02 to 2 cells in mm look like that."""
MOST_MOVE = 500.0
"""Cells: half a cell in nm looks like that, and masks are hardly larger."""
ONE_CLOCK_S = 3e7
"""Between frames of a session: a year. Seconds from a start and dates lie farther apart."""
WHITE_ABOVE = 4.0
"""Times the highest value: two bits that no frame uses are hardly a camera's."""
MOST_SATURATED = 0.5
"""Of a shot's pixels: what is left shows no scene."""
FEWEST_PIXELS = 4
"""Rows or columns: checks look at neighbours two pixels away."""


@dataclass(frozen=True, eq=False)
class Imported:
    """The session, and a line for each assumption where no file states the value."""

    session: Session
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Item:
    """A frame of a file, with the row of the file, the number of the frame and its pixels.

    read: returns the pixels, (y, x), of the file's own type. raw: the frame of a RAW file, without
    pixels. stated_s, time_s: exposure and time that the file states. shot, exposure_s: as in the
    session, once all rows are known.
    """

    listed: Listed
    place: int
    digest: str
    read: Callable[[], NDArray]
    raw: RawFrame | None
    stated_s: float | None
    time_s: float | None
    shot: int = 0
    exposure_s: float = 0.0

    @property
    def is_shot(self) -> bool:
        """Whether the frame shows the scene."""
        return self.listed.row.kind == "shot"

    @property
    def taken_s(self) -> float | None:
        """Time of the frame: that of the row, else of the file."""
        return self.time_s if self.listed.row.time is None else self.listed.row.time

    def error(self, text: str) -> AppError:
        """Return an error that begins with the place of the frame's row."""
        return AppError(f"{self.listed.where}: {text}")


def import_session(
    listed: Sequence[Listed],
    camera: str,
    out: Path,
    planes: bool = False,
    on_file: Callable[[str], None] = lambda name: None,
) -> Imported:
    """Write the session of some files.

    listed: the files, see `emmc_rig.captures.import_table`. camera: a shipped camera, or a YAML
    file. planes: take the red, green and blue of a colour file as three shots of a monochrome
    sensor. on_file: gets the name of each file that was read. Raises AppError or CameraError,
    with nothing written.
    """
    known = find_camera(camera)
    if planes and known.sensor.cfa_name not in ("mono", "custom"):
        raise AppError(
            f"planes are three shots of a monochrome sensor, and the camera's sensor.cfa is "
            f"{known.sensor.cfa_name}: take no planes, or write cfa: mono"
        )
    refuse_inside_session(out)
    refuse_filled(out)
    try:
        with held(out), tempfile.TemporaryDirectory(prefix="emmc-import-") as spool:
            notes: list[str] = []
            found = list(_items(listed, known, planes, Path(spool), on_file, notes))
            items = _in_capture_order(found, notes)
            return _Import(items, known, camera, notes).write(out)
    except ERRORS:
        raise
    except OSError as fault:
        why = fault.strerror or fault
        raise AppError(f"{fault.filename or out}: {why}; nothing was imported") from fault


# Read and check.


def _items(
    listed: Sequence[Listed], camera: Camera, planes: bool, spool: Path,
    on_file: Callable[[str], None], notes: list[str],
) -> Iterator[_Item]:  # fmt: skip
    """Yield the frames of the files, their pixels written to `spool`; raises AppError.

    A file of a series brings those of its files that no row names.
    """
    seen: dict[object, str] = {}
    first: tuple[str, tuple[int, ...], np.dtype] | None = None
    apart = {row.path.resolve() for row in listed}
    wanted_cfa, white_dn = camera.sensor.cfa_name, camera.sensor.noise.white_level_dn
    for row in listed:
        name = shown_path(row.path)
        own = read_own(row.path, row.array, apart)
        apart.update(member.resolve() for member in own.members)
        notes += own.notes
        frames, raw = _mosaics(own, name, planes), own.raw
        if raw is not None and wanted_cfa not in (raw.cfa, "custom"):
            raise AppError(
                f"{name}: its colours are {raw.cfa}, the camera's sensor.cfa is {wanted_cfa}"
            )
        key = row.path.resolve(), row.array
        if key in seen:
            raise AppError(f"{row.where}: {name} is there twice, also in {seen[key]}")
        seen[key] = row.where
        digest = hashlib.sha256(own.data or frames.tobytes()).hexdigest()
        # Frames of one value throughout may be equal by right: darks without noise.
        if (digest, row.array) in seen and frames.min() != frames.max():
            raise AppError(f"{name}: the same bytes as in {seen[digest, row.array]}; leave one out")
        seen[digest, row.array] = name
        _check_values(frames, name, white_dn if raw is None else raw.white_level_dn)
        native = np.dtype(frames.dtype.newbyteorder("=")) if frames.dtype.kind == "u" else None
        kind = native or frames.dtype
        if first is None:
            first = name, frames.shape[1:], kind
        size, first_size = ("x".join(map(str, pixels)) for pixels in (frames.shape[1:], first[1]))
        if size != first_size:
            raise AppError(f"{name}: {size} pixels (y x), and {first[0]} has {first_size}")
        if min(first[1]) < FEWEST_PIXELS:
            raise AppError(f"{name}: {size} pixels (y x), fewer than a frame has")
        if kind.itemsize != first[2].itemsize or kind.kind != first[2].kind:
            raise AppError(
                f"{name}: values of {kind.name}, and {first[0]} has {first[2].name}; write all "
                "with the same depth"
            )
        for place, frame in enumerate(frames):
            page = place // 3 if planes and len(frames) == 3 * len(own.frames) else place
            stated_s, time_s = (
                float(values[page]) if np.isfinite(values[page]) else None
                for values in (own.exposures_s, own.times_s)
            )
            read = _spooled(frame, spool / f"{len(seen)}-{place}")
            levels = None if raw is None else replace(raw, original=b"", mosaic=frame[:0])
            yield _Item(row, place, digest, read, levels, stated_s, time_s)
        on_file(name)


def _spooled(frame: NDArray, path: Path) -> Callable[[], NDArray]:
    """Write the pixels of a frame to the disk, and return a function that reads them."""
    np.ascontiguousarray(frame).tofile(path)
    dtype, shape = frame.dtype, frame.shape
    return lambda: np.fromfile(path, dtype).reshape(shape)


def _in_capture_order(items: Sequence[_Item], notes: list[str]) -> list[_Item]:
    """Return the frames, the files of each glob in the order of capture; add notes on the order."""
    ordered = []
    for pattern, group in groupby(items, key=lambda item: item.listed.pattern):
        files = [list(file) for _, file in groupby(group, key=lambda item: item.listed.where)]
        if pattern:
            names = [file[0].listed.path.name for file in files]
            raws = [file[0].raw for file in files]
            times = [None if raw is None else captured_at(raw.metadata) for raw in raws]
            order = capture_order(names, times)
            files = [files[place] for place in order.places]
            notes += [f"{pattern}: {note}" for note in order.notes]
        ordered += [item for file in files for item in file]
    return ordered


def _mosaics(own: OwnFrames, name: str, planes: bool) -> NDArray:
    """Return frames (frame, y, x); raises AppError for colour files unless `planes` is set."""
    frames = own.frames
    if frames.ndim == 3:
        return frames
    if all(np.array_equal(frames[..., 0], frames[..., c]) for c in (1, 2)):
        raise AppError(f"{name}: a grey picture in three equal colours; write it with one")
    if not planes:
        raise AppError(
            f"{name}: colours of every pixel, which no mosaic has: export the RAW file, or take "
            "its planes, red, green and blue, as three shots of a monochrome sensor"
        )
    return np.moveaxis(frames, -1, 1).reshape(-1, *frames.shape[1:3])


def _check_values(frames: NDArray, name: str, white_dn: int) -> None:
    """Raise AppError for values that no sensor reads out; white_dn: in the file's own units."""
    if frames.dtype.kind == "f" and not np.isfinite(frames).all():
        bad = int(np.count_nonzero(~np.isfinite(frames)))
        raise AppError(
            f"{name}: pixels that are no numbers (NaN or infinite): {bad}; correct the file"
        )
    low, high = frames.min(), frames.max()
    if low < 0:
        raise AppError(
            f"{name}: values down to {low:g}: import frames with the black level still in them"
        )
    if high > white_dn:
        raise AppError(
            f"{name}: values up to {high:g}, above sensor.noise.white_level_dn {white_dn}: write "
            "the camera's own white level"
        )
    if frames.dtype.kind == "u" and np.iinfo(frames.dtype).max < white_dn:
        bits = 8 * frames.dtype.itemsize
        raise AppError(
            f"{name}: {bits} bits a pixel, which never reach sensor.noise.white_level_dn "
            f"{white_dn}: write white_level_dn {2**bits - 1} or less, or import the 16-bit file"
        )


def _numbered(items: Sequence[_Item]) -> list[_Item]:
    """Return the frames with their shots: that of the row, further frames of a file after it."""
    unnumbered = all(item.listed.row.shot is None for item in items if item.is_shot)
    found, following = [], count()
    for item in items:
        row = item.listed.row
        if words := row.misuse():
            raise item.error(words)
        if not item.is_shot:
            shot = row.shot or 0
        elif unnumbered:
            shot = next(following)
        elif row.shot is None:
            raise item.error("kind shot without a shot number, which other shots have")
        else:
            shot = row.shot + item.place
        found.append(replace(item, shot=shot))
    return found


# Units, which nobody checks but the light of the frames and the size of the mask's cells.


def _is_unit(ratio: float) -> bool:
    """Return whether two exposures differ as milliseconds and seconds do."""
    return any(abs(ratio / unit - 1) < EXPOSURE_AGREEMENT for unit in (UNIT, 1 / UNIT))


def _check_agreement(item: _Item, said_s: float, other_s: float, who: str) -> None:
    """Raise AppError where another source, `who`, states another exposure."""
    if abs(said_s / other_s - 1) > EXPOSURE_AGREEMENT:
        unit = ": ms for s? write seconds" if _is_unit(said_s / other_s) else ""
        raise item.error(f"exposure_s {said_s:g}, but {who} {other_s:g} s{unit}")


def _check_mask_place(item: _Item, place: tuple[float, float], camera: Camera, shot: int) -> None:
    """Raise AppError for a place of the mask, um, that only another unit explains."""
    own = _own_place(camera, shot) if shot < len(camera.shots) else (0.0, 0.0)
    cells = [mask.cell_um for mask in camera.masks.values()]
    largest = max(map(abs, place))
    small = bool(cells) and 0 < largest < min(cells) / LEAST_MOVE
    if small or (any(own) and largest and _is_close((UNIT * place[0], UNIT * place[1]), own)):
        raise item.error(
            f"mask at {place[0]:g}, {place[1]:g} um, far less than its cells: mm for um? write um"
        )
    far = bool(cells) and largest > MOST_MOVE * max(cells) and not _is_close(place, own)
    if far or (any(own) and _is_close((place[0] / UNIT, place[1] / UNIT), own)):
        raise item.error(f"mask at {place[0]:g}, {place[1]:g} um: nm for um? write um")


def _own_place(camera: Camera, shot: int) -> tuple[float, float]:
    place = mask_offsets_um(camera, shot)
    return place.get("mask_x", 0.0), place.get("mask_y", 0.0)


def _is_close(place: tuple[float, float], other: tuple[float, float]) -> bool:
    return bool(np.allclose(place, other, rtol=0.01, atol=1e-6))


def _view_of(item: _Item, place_um: tuple[float, float], camera: Camera) -> tuple[int, int]:
    """Return the view (v, u) that a pinhole at x, y opens; raises AppError where none is."""
    cell_um, (rows, columns) = camera.lens.aperture_cell_um, camera.views
    away_um = [
        np.abs(centred_grid(count, cell_um) - at)
        for count, at in ((rows, place_um[1]), (columns, place_um[0]))
    ]
    off_um = max(along.min() for along in away_um)
    where = f"the pinhole at {place_um[0]:g}, {place_um[1]:g} um"
    if off_um > cell_um / 4:
        raise item.error(
            f"{where} is {off_um:g} um from the nearest of the camera's {rows}x{columns} views, "
            f"{cell_um:g} um apart: is the unit um?"
        )
    if 0 < max(map(abs, place_um)) < cell_um / LEAST_MOVE:
        raise item.error(f"{where}, of views {cell_um:g} um apart: mm for um? write um")
    v, u = (int(along.argmin()) for along in away_um)
    return v, u


# Plan and write.


class _Import:
    """A session in the making, of frames in the order of their capture."""

    def __init__(
        self, items: list[_Item], camera: Camera, spec: str, notes: Sequence[str] = ()
    ) -> None:
        self._notes, self._own = list(notes), camera
        self._items = _numbered(items)
        self._plan = self._planned(self._shot_count(), spec)
        self._camera = planned_camera(self._plan)
        self._items = [replace(item, exposure_s=self._exposure_s(item)) for item in self._items]
        self._check_times()
        self._check_turns()
        self._check_darks()

    def _shot_count(self) -> int:
        """Return the number of shots; raises AppError for a shot without a file."""
        shots = {item.shot for item in self._items if item.is_shot}
        if not shots:
            raise AppError("no file is a shot: name one at least, of kind shot")
        count, have = max(shots) + 1, len(self._own.shots)
        for shot in range(count):
            if shot not in shots:
                raise AppError(f"shot {shot} has no file, of shots 0 to {count - 1}")
        for item in self._items:
            if item.shot >= count and item.listed.row.shot is not None:
                raise item.error(f"there is no shot {item.shot}, only 0 to {count - 1}")
        placed = {item.shot for item in self._items if item.listed.row.mask_um is not None}
        if count > have and count - 1 not in placed:
            raise AppError(
                f"shots 0 to {count - 1} have files, and the camera has {have} "
                f"shot{'s' * (have > 1)}: write mask_x_um and mask_y_um of the others, or more "
                "shots into its file"
            )
        if count < have:
            self._notes.append(f"{count} of the camera's {have} shots have files")
        return count

    def _planned(self, count: int, spec: str) -> Plan:
        shots = []
        for shot in range(count):
            items = [item for item in self._items if item.is_shot and item.shot == shot]
            rows = [item.listed.row for item in items]
            said: dict[str, object] = {}
            for key in ("gain", "lamp"):
                values = {getattr(row, key) for row in rows}
                if len(values) > 1:
                    raise items[-1].error(f"{key} differs within shot {shot}")
                if values != {None}:
                    said[key] = values.pop()
            places = {row.mask_um for row in rows if row.mask_um is not None}
            if len(places) > 1:
                raise items[-1].error("the mask's place differs within a shot")
            for place in places:
                _check_mask_place(items[0], place, self._own, shot)
                if shot >= len(self._own.shots) or not _is_close(
                    place, _own_place(self._own, shot)
                ):
                    said["mask_um"] = list(place)
            shots.append(said)
        path = Path(spec)
        camera = str(path.resolve()) if path.is_file() else spec
        plan = {"title": self._own.title, "camera": camera, "shots": shots}
        return validated(Plan, {**plan, "whiteboards": None, "darks": None}, "import", AppError)

    def _exposure_s(self, item: _Item) -> float:
        """Return a frame's exposure: of its row, its file, or for shots the camera's own."""
        said_s, stated_s, kind = item.listed.row.exposure_s, item.stated_s, item.listed.row.kind
        if said_s is not None and stated_s is not None:
            _check_agreement(item, said_s, stated_s, "its file states")
        known_s = stated_s if said_s is None else said_s
        if known_s is not None:
            if known_s > LONGEST_S or known_s <= 0:
                raise item.error(f"its file states an exposure of {known_s:g} s")
            planned_s = self._camera.shots[item.shot].exposure_s if item.is_shot else None
            if planned_s is not None and _is_unit(known_s / planned_s):
                _check_agreement(item, known_s, planned_s, "the camera's file says")
            return known_s
        own_s = self._camera.exposures_s()
        if kind not in ("shot", "dark"):
            raise item.error("its exposure is not known; write exposure_s into the table")
        exposure_s = float(own_s[item.shot] if item.is_shot else max(own_s))
        self._note(f"exposures that no file states are taken from the camera: {exposure_s:g} s")
        return exposure_s

    def _check_darks(self) -> None:
        """Raise AppError where darks and shots have exposures in different units."""
        darks_s, shots_s = (
            [item.exposure_s for item in self._items if item.listed.row.kind == kind]
            for kind in ("dark", "shot")
        )
        if darks_s and (
            min(darks_s) >= UNIT / 2 * max(shots_s) or max(darks_s) <= min(shots_s) * 2 / UNIT
        ):
            raise AppError(
                f"darks of {min(darks_s):g} s and shots of {max(shots_s):g} s: ms for s in one of "
                "them? write seconds"
            )

    def _check_times(self) -> None:
        timed = [item for item in self._items if item.taken_s is not None]
        known = [(item.taken_s or 0.0, item.listed.where) for item in timed]
        (first_s, first), (last_s, last) = min(known, default=(0, "")), max(known, default=(0, ""))
        if last_s - first_s > ONE_CLOCK_S:
            raise AppError(f"{last}: time is over a year after that of {first}: write one clock's")

    def _check_turns(self) -> None:
        """Raise AppError for a turned board that was not taken both with masks and without."""
        kinds: dict[float, set[str]] = defaultdict(set)
        for row in (item.listed.row for item in self._items):
            if row.turn_deg is not None:
                kinds[row.turn_deg].add(row.kind)
        for turn_deg, known in kinds.items():
            if len(known) < 2:
                raise AppError(
                    f"the board turned by {turn_deg:g} degrees has kind {known.pop()} alone; it "
                    "takes open and reference"
                )

    def _note(self, text: str) -> None:
        if text not in self._notes:
            self._notes.append(text)

    def _frames(self) -> list[tuple[PlannedFrame, _Item]]:
        """Return every frame as a plan would name it, with its file, in the order of the kinds."""
        validating = self._validating()
        named: list[tuple[PlannedFrame, _Item]] = []
        counts: Counter[str] = Counter()
        groups: dict[str, dict[object, int]] = defaultdict(dict)
        brackets: dict[int, set[float]] = defaultdict(set)
        for item in self._items:
            if item.is_shot:
                brackets[item.shot].add(item.exposure_s)
        fitted = fittings(self._camera)
        for item in self._items:
            row, shot = item.listed.row, item.shot
            kind = VALIDATION if item is validating or row.kind == "validation" else row.kind
            lamp = "off" if kind == "dark" else row.lamp or "white"
            at_um: dict[str, float] = dict(mask_offsets_um(self._camera, shot))
            view = None
            if row.mask_um is not None and kind != "shot":
                _check_mask_place(item, row.mask_um, self._own, shot)
                at_um["mask_x"], at_um["mask_y"] = row.mask_um
            if kind == "whiteboard" and row.pinhole_um is not None:
                view = _view_of(item, row.pinhole_um, self._camera)
                at_um["aperture_x"], at_um["aperture_y"] = row.pinhole_um
            elif kind == "whiteboard":
                kind = "open"
            masks_in = kind not in ("reference", "reference-check")
            if row.turn_deg is not None:
                kind = "turned"
            elif kind == "reference-check":
                kind = "check"
            if kind in OF_FIRST_SHOT and shot:
                raise item.error("whiteboards of the whole aperture must be of shot 0")

            def group(name: str, key: object) -> str:
                return f"{name}-{groups[name].setdefault(key, len(groups[name]))}"

            if kind == "dark":
                of_shot = row.shot is not None
                name = f"{SHOT_DARK}-{shot}" if of_shot else group("dark", item.exposure_s)
                bench = Bench("scene", "off", 0, 0, True)
            elif kind == "shot":
                name = f"shot-{shot}-e{sorted(brackets[shot]).index(item.exposure_s)}"
                bench = Bench("scene", lamp, shot, fitted[shot], True, at_um)
            else:
                name = {
                    "reference": f"reference-s{shot}-{lamp}",
                    "whiteboard": f"board-s{shot}-v{view and view[0]}-u{view and view[1]}-{lamp}",
                }.get(kind) or group(kind, (masks_in, row.turn_deg, *at_um.items()))
                at_um = at_um if masks_in else {}
                turn_deg = row.turn_deg or 0.0
                bench = Bench("whiteboard", lamp, shot, fitted[shot], masks_in, at_um, turn_deg)
            repeat = counts[name]
            counts[name] += 1
            exposed = item.exposure_s, row.gain, repeat, view
            named.append((PlannedFrame(f"{name}-r{repeat}", kind, bench, *exposed), item))

        def order(pair: tuple[PlannedFrame, _Item]) -> tuple:
            frame, _ = pair
            of_shots = (frame.bench.shot, frame.id) if frame.kind == "shot" else ()
            return KIND_ORDER.index(frame.kind), of_shots

        return sorted(named, key=order)

    def _validating(self) -> _Item | None:
        """Return the last whiteboard of the whole aperture, unless rows name some for validation.

        Returns None for fewer whiteboards than FEWEST_TO_HOLD_OUT, which the fit needs.
        """
        if any(item.listed.row.kind == "validation" for item in self._items):
            return None
        whole = [
            item
            for item in self._items
            if (item.listed.row.kind == "open" and item.listed.row.turn_deg is None)
            or (item.listed.row.kind == "whiteboard" and item.listed.row.pinhole_um is None)
        ]
        if len(whole) < FEWEST_TO_HOLD_OUT:
            return None
        self._note(f"{shown_path(whole[-1].listed.path)} validates the calibration: no fit uses it")
        return whole[-1]

    def _scale(self) -> int:
        """Return the factor that makes values whole numbers: 1 for those of a camera."""
        for item in self._items:
            pixels = item.read()
            if pixels.dtype.kind == "f" and not np.array_equal(pixels, np.round(pixels)):
                scale = TOP_DN // self._camera.sensor.noise.white_level_dn
                self._note(f"values that are not whole are stored {scale} times as large")
                return scale
        return 1

    def _set_noise(self, **values: float) -> None:
        sensor = self._camera.sensor
        sensor = sensor.model_copy(update={"noise": sensor.noise.model_copy(update=values)})
        self._camera = self._camera.model_copy(update={"sensor": sensor})

    def write(self, out: Path) -> Imported:
        """Write the session under its name, verified, or nothing; raises AppError."""
        planned, scale = self._frames(), self._scale()
        noise, stated = self._camera.sensor.noise, self._own.sensor.noise.model_fields_set
        gain = noise.gain_dn_per_electron
        if scale != 1 and "gain_dn_per_electron" not in stated:
            shots = [item for item in self._items if item.is_shot]
            brightest = max(float(np.percentile(item.read(), BRIGHT_PERCENTILE)) for item in shots)
            gain = brightest * FAIR_NOISE**2
            self._note(f"the noise is taken as {FAIR_NOISE:.0%} of the brightest reading")
        self._set_noise(
            gain_dn_per_electron=gain * scale,
            black_level_dn=noise.black_level_dn * scale,
            white_level_dn=noise.white_level_dn * scale,
        )
        for frame, item in planned:
            self._check_light(frame, item, scale)
        highest = max(float(item.read().max()) for item in self._items)
        if "white_level_dn" not in stated and planned[0][1].raw is None and (
            highest * WHITE_ABOVE < noise.white_level_dn
        ):  # fmt: skip
            self._note(
                f"sensor.noise.white_level_dn is taken as {noise.white_level_dn}, as nothing "
                f"states it, and no value is above {highest:g}: a camera of 12 bits has 4095"
            )
        self._set_white(planned, scale)
        plan = yaml.safe_dump(self._plan.model_dump(mode="json", exclude_unset=True))
        frozen = Frozen(
            f"# Imported: what stood in a table or globs, as a plan.\n{plan}",
            self._camera.model_dump(mode="json"),
            {"kind": IMPORTED},
            tuple(frame for frame, _ in planned),
        )
        about = {"title": self._plan.title or out.name, "created": wall_time()}
        about |= {"command": command_line(), "versions": versions()}
        with whole(out) as part:
            self._store(Session.create(part, frozen, about), planned, scale)
        return Imported(Session(out), tuple(self._notes))

    def _check_light(self, frame: PlannedFrame, item: _Item, scale: int) -> None:
        """Raise AppError for a bright dark, and for a shot's shortest frame that shows nothing."""
        found, noise = figures(self._raw(item, frame, scale)), self._camera.sensor.noise
        span = noise.white_level_dn - noise.black_level_dn
        if frame.kind == "dark" and found.mean_dn > Checks().largest_dark * span:
            raise item.error(
                f"a dark that is {found.mean_dn / span:.1%} of white on average: is it another "
                "kind, or sensor.noise.black_level_dn wrong?"
            )
        if not frame.id.startswith(f"shot-{frame.bench.shot}-e0-"):
            return
        bright, what = found.bright_dn / span, None
        if found.saturated > MOST_SATURATED:
            what = f"{found.saturated:.0%} of its pixels are at white"
        elif bright < Checks().smallest_signal:
            what = f"its brightest readings are {max(bright, 0):.1%} of white above black"
        if what is not None:
            raise item.error(
                f"shot {frame.bench.shot}: {what}: expose otherwise, or are "
                "sensor.noise.black_level_dn and white_level_dn the file's?"
            )

    def _store(
        self, session: Session, planned: list[tuple[PlannedFrame, _Item]], scale: int
    ) -> None:
        shape = list(planned[0][1].read().shape)
        files = {str(item.listed.path): item.digest for _, item in planned}
        camera = {"maker": "", "model": "files of another program", "serial": "", "shape": shape}
        session.note(RunEntry(versions=versions(), command=command_line(), camera=camera))
        session.note(ImportedEntry(files=files, notes=self._notes))
        for frame, item in planned:
            raw = _with_bytes(self._raw(item, frame, scale), item)
            entry = frame_entry(
                raw, raw.exposure_s or 0.0, frame.gain, run=1, lamp=frame.bench.lamp,
                commanded_um=dict(frame.bench.offsets_um), figures=figures(raw), wall=wall_time(),
            )  # fmt: skip
            session.store(frame, frame_file(raw), lambda entry=entry: entry)
        for fault in verify_frames(session, session.stored.values()).values():
            raise AppError(f"{fault}; nothing was imported, test disk and memory")
        session.note(CompleteEntry(frames=len(planned)))

    def _raw(self, item: _Item, frame: PlannedFrame, scale: int) -> RawFrame:
        """Return a frame as if from a camera, without the bytes of its file."""
        pixels = item.read()
        if pixels.dtype.kind == "f" or scale != 1:
            pixels = np.round(pixels * np.float64(scale))
        mosaic = np.ascontiguousarray(pixels.astype(np.uint16))
        row, path, sensor = item.listed.row, item.listed.path, self._camera.sensor
        metadata = {"name": path.name, "imported": str(path.resolve())}
        if row.temperature_c is not None:
            metadata["temperature_c"] = f"{row.temperature_c:g}"
        black, white, cfa = (
            (np.full((2, 2), float(sensor.noise.black_level_dn)), sensor.noise.white_level_dn,
             sensor.cfa_name) if item.raw is None
            else (item.raw.black_level_dn, item.raw.white_level_dn, item.raw.cfa)
        )  # fmt: skip
        if item.raw is not None:
            metadata = {**item.raw.metadata, **metadata}
        return RawFrame(
            mosaic, black, white, cfa, frame.exposure_s, b"", item.digest,
            host_time_s=item.taken_s, metadata=metadata,
        )  # fmt: skip

    def _set_white(self, planned: list[tuple[PlannedFrame, _Item]], scale: int) -> None:
        """Set the brightness of white where nothing states it, by the brightest of the scene.

        Raises AppError where the camera states it, and only another unit of time explains the
        shots.
        """
        if any(frame.kind in ("reference", "whiteboard", "open") for frame, _ in planned):
            return
        noise = self._camera.sensor.noise
        brightest_per_s = max(
            figures(self._raw(item, frame, scale)).bright_dn / (frame.exposure_s or 1.0)
            for frame, item in planned
            if frame.kind == "shot"
        )
        rows, columns = planned[0][1].read().shape
        k = self._camera.sensor.binning
        size = min(rows * k, PROBE), min(columns * k, PROBE)
        light = build_imaging_matrix(self._camera, size).light_efficiency() or 1.0
        light *= float(pixel_light(self._camera, size).mean())
        electrons_per_s = brightest_per_s / noise.gain_dn_per_electron / (BRIGHTEST * light)
        if electrons_per_s <= 0:
            raise AppError("no shot is brighter than the camera's sensor.noise.black_level_dn")
        if "electrons_per_s" in noise.model_fields_set:
            bright = electrons_per_s / noise.electrons_per_s
            if 0.02 < bright * UNIT < 2:
                raise AppError(
                    f"the shots are {bright:.2g} times as bright as the camera's electrons_per_s "
                    "says: ms for s in exposure_s? write seconds"
                )
            return
        self._note(
            f"the camera's electrons_per_s is not known: taken as {electrons_per_s:.3g}, for which "
            f"the brightest readings of the shots are {BRIGHTEST:g}"
        )
        self._set_noise(electrons_per_s=electrons_per_s)


def _with_bytes(raw: RawFrame, item: _Item) -> RawFrame:
    """Return a frame with the bytes of its file, of which only the first frame is it.

    Raises AppError for a file that has changed since it was read.
    """
    path, original = item.listed.path, b""
    if item.place == 0 and not path.is_dir():
        original = path.read_bytes()
        if hashlib.sha256(original).hexdigest() != item.digest:
            raise AppError(f"{shown_path(path)}: changed while it was imported; try again")
    if original:
        return replace(raw, original=original)
    original = f"frame {item.place} of {path.name}, SHA-256 {item.digest}".encode()
    return replace(raw, original=original, sha256=hashlib.sha256(original).hexdigest())
