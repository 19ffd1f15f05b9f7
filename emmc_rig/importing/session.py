"""Files of another program as a session, as if the sequencer had taken them, or not at all.

Everything is read and checked before anything is written; the session is then written beside its
place, verified, and takes its name. Each frame keeps the bytes of its file, as frames of a camera
that is not known do (see `emmc_rig.session.frame_file`); of a file of several, its first frame.
"""

from __future__ import annotations

import hashlib
import tempfile
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from drivers.camera import EXPOSURE_AGREEMENT
from drivers.capture_order import capture_order
from drivers.raw import RawFrame, captured_at
from emmc_rig.acquisition.expand import fittings, mask_offsets_um
from emmc_rig.acquisition.plan import Checks, Plan, planned_camera
from emmc_rig.bench.rig_config import IMPORTED
from emmc_rig.errors import AppError
from emmc_rig.files.cameras import find_camera
from emmc_rig.files.own_arrays import OwnFrames, read_own
from emmc_rig.files.results import command_line, versions
from emmc_rig.importing.table import LONGEST_S, Listed
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
from emmc_rig.store.folders import refuse_inside_session

KIND_ORDER = ("dark", "reference", "whiteboard", "open", "check", "turned", VALIDATION, "shot")
TOP_DN = 65_535
BRIGHTEST = 0.9
"""What the brightest part of a scene is taken for where nothing states how bright white is."""
FAIR_NOISE = 0.01
"""Of the brightest reading, for values of an unknown unit: three published cameras of other groups
have 0.008 to 0.01."""
PROBE = 64
"""Rows and columns at most of the Psi that says how much light a camera's masks let through."""
FEWEST_TO_HOLD_OUT = 3
UNIT = 1000.0
"""Between ms and s, um and mm, which are mistaken for one another."""
LEAST_MOVE = 50.0
"""Of a cell: nobody moves a mask or pinhole by less, but 0.02 to 2 cells in mm look like that."""
MOST_MOVE = 500.0
"""Cells: half a cell in nm looks like that, and masks are hardly larger."""
TOO_BRIGHT = 20.0
"""Times what the camera says of white: a minute has 60 s; only a lamp in the scene has as much."""
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
    """The session, and what was assumed that no file states, a line each."""

    session: Session
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Item:
    """One frame: its row, which of its file's frames it is, and where its pixels wait.

    read: returns its pixels, (y, x), of the file's own type.
    """

    listed: Listed
    place: int
    digest: str
    read: Callable[[], NDArray]
    raw: RawFrame | None
    stated_s: float | None
    time_s: float | None


def import_session(
    listed: Sequence[Listed],
    camera: str,
    out: Path,
    planes: bool = False,
    on_file: Callable[[str], None] = lambda name: None,
) -> Imported:
    """Write the session of some files.

    listed: the files, see `emmc_rig.importing.table`. camera: a shipped camera, or a YAML
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
    if out.exists() and not out.is_dir():
        raise AppError(f"{out}: a file, where a folder is meant; name another")
    if out.exists() and any(out.iterdir()):
        raise AppError(f"{out}: holds something already; name another folder")
    try:
        with held(out), tempfile.TemporaryDirectory(prefix="emmc-import-") as spool:
            notes: list[str] = []
            found = list(_items(listed, known, planes, Path(spool), on_file, notes))
            items, order = _in_capture_order(found)
            notes += order
            return _Import(items, known, camera, notes).write(out)
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
    for one in listed:
        name = shown_path(one.path)
        own = read_own(one.path, one.array, apart)
        apart.update(member.resolve() for member in own.members)
        notes += own.notes
        frames, tell = _mosaics(own, one, planes), _telling(own, camera)
        if own.raw is not None:
            _check_phase(own.raw, camera, name)
        key = one.path.resolve(), one.array
        if key in seen:
            raise AppError(f"{one.where}: {name} is there twice, also in {seen[key]}")
        seen[key] = one.where
        digest = hashlib.sha256(own.data or frames.tobytes()).hexdigest()
        # Bytes that say nothing may be equal by right, as those of darks without noise.
        if (digest, one.array) in seen and frames.min() != frames.max():
            raise AppError(f"{name}: the same bytes as in {seen[digest, one.array]}; leave one out")
        seen[digest, one.array] = name
        _check_values(frames, name, tell)
        kind = (
            frames.dtype if frames.dtype.kind != "u" else np.dtype(frames.dtype.newbyteorder("="))
        )
        if first is None:
            first = name, frames.shape[1:], kind
        if frames.shape[1:] != first[1]:
            sizes = ["x".join(map(str, size)) for size in (frames.shape[1:], first[1])]
            raise AppError(f"{name}: {sizes[0]} pixels (y x), and {first[0]} has {sizes[1]}")
        if min(first[1]) < FEWEST_PIXELS:
            size = "x".join(map(str, first[1]))
            raise AppError(f"{name}: {size} pixels (y x), fewer than a frame has")
        if kind.itemsize != first[2].itemsize or kind.kind != first[2].kind:
            raise AppError(
                f"{name}: values of {kind.name}, and {first[0]} has {first[2].name}; write all "
                "with the same depth"
            )
        for place, frame in enumerate(frames):
            waiting = spool / f"{len(seen)}-{place}"
            np.ascontiguousarray(frame).tofile(waiting)
            page = place // 3 if planes and len(frames) == 3 * len(own.frames) else place
            yield _Item(
                one,
                place,
                digest,
                _reader(waiting, frame.dtype, frame.shape),
                None if own.raw is None else replace(own.raw, original=b"", mosaic=frame[:0]),
                _known(own.exposures_s[page]),
                _known(own.times_s[page]),
            )
        on_file(name)


def _in_capture_order(items: Sequence[_Item]) -> tuple[list[_Item], list[str]]:
    """Return the frames, the files of each glob in the order of capture, and notes on the order."""
    ordered, notes = [], []
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
    return ordered, notes


def _reader(path: Path, dtype: np.dtype, shape: tuple[int, ...]) -> Callable[[], NDArray]:
    return lambda: np.fromfile(path, dtype).reshape(shape)


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _mosaics(own: OwnFrames, one: Listed, planes: bool) -> NDArray:
    """Return frames (frame, y, x); raises AppError for colour files that are not asked for."""
    frames = own.frames
    if frames.ndim == 3:
        return frames
    name = shown_path(one.path)
    if np.array_equal(frames[..., 0], frames[..., 1]) and np.array_equal(
        frames[..., 0], frames[..., 2]
    ):
        raise AppError(f"{name}: a grey picture in three equal colours; write it with one")
    if not planes:
        raise AppError(
            f"{name}: colours of every pixel, which no mosaic has: export the RAW file, or take "
            "its planes, red, green and blue, as three shots of a monochrome sensor"
        )
    return np.moveaxis(frames, -1, 1).reshape(-1, *frames.shape[1:3])


def _telling(own: OwnFrames, camera: Camera) -> int:
    """Return the white level of a file in its own units: a RAW file's, or the camera's."""
    return own.raw.white_level_dn if own.raw is not None else camera.sensor.noise.white_level_dn


def _check_phase(raw: RawFrame, camera: Camera, name: str) -> None:
    wanted = camera.sensor.cfa_name
    if wanted not in (raw.cfa, "custom"):
        raise AppError(f"{name}: its colours are {raw.cfa}, the camera's sensor.cfa is {wanted}")


def _check_values(frames: NDArray, name: str, white_dn: int) -> None:
    """Raise AppError for what no sensor reads out."""
    if frames.dtype.kind == "f" and not np.isfinite(frames).all():
        bad = int(np.count_nonzero(~np.isfinite(frames)))
        raise AppError(f"{name}: {bad} pixel(s) are no numbers (NaN or infinite); correct the file")
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


# Plan and write.


class _Import:
    """A session in the making."""

    def __init__(
        self, items: list[_Item], camera: Camera, spec: str, notes: Sequence[str] = ()
    ) -> None:
        self._notes = list(notes)
        self._items = self._numbered(items)
        shots = [shot for item, shot in self._items if item.listed.row.kind == "shot"]
        if not shots:
            raise AppError("no file is a shot: name one at least, of kind shot")
        count = max(shots) + 1
        for shot in range(count):
            if shot not in shots:
                raise AppError(f"shot {shot} has no file, of shots 0 to {count - 1}")
        for item, shot in self._items:
            if shot >= count and item.listed.row.shot is not None:
                raise AppError(
                    f"{item.listed.where}: there is no shot {shot}, only 0 to {count - 1}"
                )
        placed = [shot for item, shot in self._items if _placed(item.listed.row)]
        if count > len(camera.shots) and count - 1 not in placed:
            raise AppError(
                f"shots 0 to {count - 1} have files, and the camera has {len(camera.shots)} "
                "shot(s): write mask_x_um and mask_y_um of the others, or more shots into its file"
            )
        if count < len(camera.shots):
            self._notes.append(f"{count} of the camera's {len(camera.shots)} shots have files")
        self._own = camera
        self._plan = self._planned(count, spec)
        self._camera = planned_camera(self._plan)
        self._exposures_s = [self._exposure_s(item, shot) for item, shot in self._items]
        self._check_times()
        self._check_turns()
        self._check_exposures()

    def _numbered(self, items: list[_Item]) -> list[tuple[_Item, int]]:
        """Return each frame with its shot: as its row says, further frames of a file after it."""
        free = all(i.listed.row.shot is None for i in items if i.listed.row.kind == "shot")
        found, following = [], 0
        for item in items:
            row = item.listed.row
            if row.gain != 1 and row.kind != "shot":
                raise AppError(
                    f"{item.listed.where}: gain {row.gain:g}; only shots may have another than 1"
                )
            if row.lamp is not None and (row.lamp == "off") != (row.kind == "dark"):
                raise AppError(f"{item.listed.where}: kind {row.kind} with the lamp {row.lamp}")
            pinhole = (row.aperture_x_um, row.aperture_y_um) != (None, None)
            if row.kind != "whiteboard" and pinhole:
                raise AppError(
                    f"{item.listed.where}: a pinhole's place with kind {row.kind}; only a "
                    "whiteboard is taken through one"
                )
            if row.turn_deg is not None and row.kind not in ("open", "reference"):
                raise AppError(
                    f"{item.listed.where}: turn_deg with kind {row.kind}; boards that are turned "
                    "are open or reference"
                )
            if row.kind == "reference" and (row.mask_x_um or row.mask_y_um):
                raise AppError(
                    f"{item.listed.where}: a mask's place with kind reference, which is without "
                    "masks: is it open?"
                )
            if row.kind != "shot":
                found.append((item, row.shot or 0))
            elif free:
                found.append((item, following))
                following += 1
            elif row.shot is None:
                raise AppError(f"{item.listed.where}: other shots have a number, this one has none")
            else:
                found.append((item, row.shot + item.place))
        return found

    def _planned(self, count: int, spec: str) -> Plan:
        shots = []
        for shot in range(count):
            items = [i for i, own in self._items if own == shot and i.listed.row.kind == "shot"]
            rows = [item.listed.row for item in items]
            said: dict[str, object] = {}
            for key in ("gain", "lamp"):
                values = {getattr(row, key) for row in rows}
                if len(values) > 1:
                    raise AppError(f"{items[-1].listed.where}: {key} differs within shot {shot}")
                if values != {None}:
                    said[key] = values.pop()
            placed = [row for row in rows if _placed(row)]
            places = {(row.mask_x_um or 0.0, row.mask_y_um or 0.0) for row in placed}
            if len(places) > 1:
                raise AppError(f"{items[-1].listed.where}: the mask's place differs within a shot")
            for place in places:
                self._check_place(place, shot, items[0].listed.where)
                if shot >= len(self._own.shots) or not _close(place, self._own_place(shot)):
                    said["mask_um"] = list(place)
            shots.append(said)
        path = Path(spec)
        camera = str(path.resolve()) if path.is_file() else spec
        plan = {"title": self._own.title, "camera": camera, "shots": shots}
        return validated(Plan, {**plan, "whiteboards": None, "darks": None}, "import", AppError)

    def _own_place(self, shot: int) -> tuple[float, float]:
        place = mask_offsets_um(self._own, shot)
        return place.get("mask_x", 0.0), place.get("mask_y", 0.0)

    def _check_place(self, place: tuple[float, float], shot: int, where: str) -> None:
        """Raise AppError for a place that only another unit explains."""
        own = self._own_place(shot) if shot < len(self._own.shots) else (0.0, 0.0)
        cells = [mask.cell_um for mask in self._own.masks.values()]
        largest = max(map(abs, place))
        small = bool(cells) and 0 < largest < min(cells) / LEAST_MOVE
        scaled = any(own) and _close((UNIT * place[0], UNIT * place[1]), own)
        if small or (scaled and largest):
            raise AppError(
                f"{where}: mask at {place[0]:g}, {place[1]:g} um, far less than its cells: mm "
                "for um? write um"
            )
        far = bool(cells) and largest > MOST_MOVE * max(cells) and not _close(place, own)
        if far or (any(own) and _close((place[0] / UNIT, place[1] / UNIT), own)):
            raise AppError(f"{where}: mask at {place[0]:g}, {place[1]:g} um: nm for um? write um")

    def _exposure_s(self, item: _Item, shot: int) -> float:
        """Return a frame's exposure: of its row, its file, or for shots the camera's own."""
        row, where = item.listed.row, item.listed.where
        said_s, stated_s = row.exposure_s, item.stated_s
        if said_s is not None and stated_s is not None:
            self._compare_exposures(said_s, stated_s, f"{where}: ", "its file states")
        if said_s is not None or stated_s is not None:
            known_s = stated_s if said_s is None else said_s
            assert known_s is not None
            if known_s > LONGEST_S or known_s <= 0:
                raise AppError(f"{where}: its file states an exposure of {known_s:g} s")
            planned_s = self._camera.shots[shot].exposure_s if row.kind == "shot" else None
            if planned_s is not None and _is_unit(known_s / planned_s):
                self._compare_exposures(known_s, planned_s, f"{where}: ", "the camera's file says")
            return known_s
        own_s = self._camera.exposures_s()
        if row.kind not in ("shot", "dark"):
            raise AppError(f"{where}: its exposure is not known; write exposure_s into the table")
        exposure_s = float(own_s[shot] if row.kind == "shot" else max(own_s))
        self._note(f"exposures that no file states are taken from the camera: {exposure_s:g} s")
        return exposure_s

    def _compare_exposures(self, said_s: float, other_s: float, start: str, who: str) -> None:
        if abs(said_s / other_s - 1) > EXPOSURE_AGREEMENT:
            unit = ": ms for s? write seconds" if _is_unit(said_s / other_s) else ""
            raise AppError(f"{start}exposure_s {said_s:g}, but {who} {other_s:g} s{unit}")

    def _check_exposures(self) -> None:
        """Raise AppError where the light of one kind of frame shows another unit of another."""
        by_kind: dict[str, list[float]] = defaultdict(list)
        for (item, _), exposure_s in zip(self._items, self._exposures_s, strict=True):
            by_kind[item.listed.row.kind].append(exposure_s)
        for kind, exposures_s in by_kind.items():
            longest_s = max(by_kind["shot"])
            if kind == "dark" and (
                min(exposures_s) >= UNIT / 2 * longest_s
                or max(exposures_s) <= min(by_kind["shot"]) * 2 / UNIT
            ):
                raise AppError(
                    f"darks of {min(exposures_s):g} s and shots of {longest_s:g} s: ms for s in "
                    "one of them? write seconds"
                )

    def _check_times(self) -> None:
        times = [item.time_s if (own := item.listed.row.time) is None else own
                 for item, _ in self._items]  # fmt: skip
        known = [time for time in times if time is not None]
        if known and max(known) - min(known) > ONE_CLOCK_S:
            first, last = (
                self._items[times.index(one)][0].listed.where for one in (min(known), max(known))
            )
            raise AppError(f"{last}: time is over a year after that of {first}: write one clock's")

    def _check_turns(self) -> None:
        """Raise AppError for a turned board that was not taken both with masks and without."""
        kinds: dict[float, set[str]] = defaultdict(set)
        for row in (item.listed.row for item, _ in self._items):
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
        """Return every frame as a plan would name it, with where it comes from."""
        validating = self._validating()
        named: list[tuple[int, PlannedFrame, _Item]] = []
        counts: Counter[str] = Counter()
        groups: dict[str, dict[object, int]] = defaultdict(dict)
        fitted = fittings(self._camera)
        for (item, shot), exposure_s in zip(self._items, self._exposures_s, strict=True):
            row, where = item.listed.row, item.listed.where
            if item is validating or row.kind == "validation":
                kind = VALIDATION
            else:
                kind = row.kind
            lamp = "off" if kind == "dark" else row.lamp or "white"
            at_um = mask_offsets_um(self._camera, shot)
            if _placed(row) and kind != "shot":
                self._check_place((row.mask_x_um or 0.0, row.mask_y_um or 0.0), shot, where)
                at_um = {"mask_x": row.mask_x_um or 0.0, "mask_y": row.mask_y_um or 0.0}
            view = None
            if kind == "whiteboard":
                if row.aperture_x_um is None and row.aperture_y_um is None:
                    kind = "open"
                else:
                    place = row.aperture_x_um or 0.0, row.aperture_y_um or 0.0
                    view = self._view(place, where)
                    at_um |= {"aperture_x": place[0], "aperture_y": place[1]}
            masks_in = kind not in ("reference", "reference-check")
            if row.turn_deg is not None:
                kind = "turned"
            kind = "check" if kind == "reference-check" else kind
            if kind in ("open", VALIDATION, "check", "turned") and shot:
                raise AppError(f"{where}: whiteboards of the whole aperture must be of shot 0")

            def group(name: str, key: object) -> str:
                return f"{name}-{groups[name].setdefault(key, len(groups[name]))}"

            if kind == "dark":
                of_shot = row.shot is not None
                name = f"{SHOT_DARK}-{shot}" if of_shot else group("dark", exposure_s)
                bench = Bench("scene", "off", 0, 0, True)
            elif kind == "shot":
                name = f"shot-{shot}-e{_step(self._exposures_s, self._items, shot, exposure_s)}"
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
            frame = PlannedFrame(
                f"{name}-r{repeat}", kind, bench, exposure_s, row.gain, repeat, view
            )
            named.append((KIND_ORDER.index(kind), frame, item))
        named.sort(
            key=lambda one: (
                one[0],
                (one[1].bench.shot, one[1].id) if one[1].kind == "shot" else (),
            )
        )
        return [(frame, item) for _, frame, item in named]

    def _validating(self) -> _Item | None:
        """Return the whiteboard of the whole aperture that is kept to judge by, if none is said."""
        rows = [(item, item.listed.row) for item, _ in self._items]
        whole = [
            item
            for item, row in rows
            if (row.kind == "open" and row.turn_deg is None)
            or (row.kind == "whiteboard" and row.aperture_x_um is row.aperture_y_um is None)
        ]
        if len(whole) < FEWEST_TO_HOLD_OUT or any(row.kind == "validation" for _, row in rows):
            return None
        self._note(f"{shown_path(whole[-1].listed.path)} validates the calibration: no fit uses it")
        return whole[-1]

    def _view(self, place_um: tuple[float, float], where: str) -> tuple[int, int]:
        """Return the view (v, u) that a pinhole at x, y opens; raises AppError where none is."""
        cell_um = self._camera.lens.aperture_cell_um
        rows, columns = self._camera.views
        grids = centred_grid(rows, cell_um), centred_grid(columns, cell_um)
        x_um, y_um = place_um
        v, u = (
            int(np.argmin(np.abs(grid - at))) for grid, at in zip(grids, (y_um, x_um), strict=True)
        )
        off_um = max(abs(grids[0][v] - y_um), abs(grids[1][u] - x_um))
        if off_um > cell_um / 4:
            raise AppError(
                f"{where}: the pinhole at {x_um:g}, {y_um:g} um is {off_um:g} um from the nearest "
                f"of the camera's {rows}x{columns} views, {cell_um:g} um apart: is the unit um?"
            )
        if 0 < max(abs(x_um), abs(y_um)) < cell_um / LEAST_MOVE:
            raise AppError(
                f"{where}: the pinhole at {x_um:g}, {y_um:g} um, of views {cell_um:g} um apart: "
                "mm for um? write um"
            )
        return v, u

    def _scale(self) -> int:
        """Return by what values are multiplied to be whole: 1 for those of a camera."""
        for item, _ in self._items:
            pixels = item.read()
            if pixels.dtype.kind == "f" and not np.array_equal(pixels, np.round(pixels)):
                scale = TOP_DN // self._camera.sensor.noise.white_level_dn
                self._note(f"values that are not whole are stored {scale} times as large")
                return scale
        return 1

    def write(self, out: Path) -> Imported:
        """Write the session under its name, verified, or nothing; raises AppError."""
        planned, scale = self._frames(), self._scale()
        noise = self._camera.sensor.noise
        gain = noise.gain_dn_per_electron
        if scale != 1 and "gain_dn_per_electron" not in noise.model_fields_set:
            shots = [item for frame, item in planned if frame.kind == "shot"]
            brightest = max(float(np.percentile(item.read(), BRIGHT_PERCENTILE)) for item in shots)
            gain = brightest * FAIR_NOISE**2
            self._note(f"the noise is taken as {FAIR_NOISE:.0%} of the brightest reading")
        noise = noise.model_copy(
            update={
                "gain_dn_per_electron": gain * scale,
                "black_level_dn": noise.black_level_dn * scale,
                "white_level_dn": noise.white_level_dn * scale,
            }
        )
        sensor = self._camera.sensor.model_copy(update={"noise": noise})
        self._camera = self._camera.model_copy(update={"sensor": sensor})
        for frame, item in planned:
            found = figures(self._raw(item, frame, scale))
            span = noise.white_level_dn - noise.black_level_dn
            if frame.kind == "dark" and found.mean_dn > Checks().largest_dark * span:
                raise AppError(
                    f"{item.listed.where}: a dark that is {found.mean_dn / span:.1%} of white on "
                    "average: is it another kind, or sensor.noise.black_level_dn wrong?"
                )
            self._check_light(frame, item, found.saturated, found.bright_dn / span)
        highest = max(float(item.read().max()) for _, item in planned)
        if "white_level_dn" not in self._own.sensor.noise.model_fields_set and (
            highest * scale * WHITE_ABOVE < noise.white_level_dn and planned[0][1].raw is None
        ):
            self._note(
                f"sensor.noise.white_level_dn is taken as {self._own.sensor.noise.white_level_dn}, "
                f"as nothing states it, and no value is above {highest:g}: a camera of 12 bits has "
                "4095"
            )
        self._set_white(planned, scale)
        plan = yaml.safe_dump(self._plan.model_dump(mode="json", exclude_unset=True))
        plan = f"# Imported: what stood in a table or globs, as a plan.\n{plan}"
        frozen = Frozen(
            plan,
            self._camera.model_dump(mode="json"),
            {"kind": IMPORTED},
            tuple(frame for frame, _ in planned),
        )
        about = {
            "title": self._plan.title or out.name,
            "created": wall_time(),
            "command": command_line(),
            "versions": versions(),
        }
        with whole(out) as part:
            session = Session.create(part, frozen, about)
            self._store(session, planned, scale)
        return Imported(Session(out), tuple(self._notes))

    def _check_light(
        self, frame: PlannedFrame, item: _Item, saturated: float, bright: float
    ) -> None:
        """Raise AppError for a shot, of a bracket the shortest, that shows nothing."""
        if not frame.id.startswith(f"shot-{frame.bench.shot}-e0-"):
            return
        what = None
        if saturated > MOST_SATURATED:
            what = f"{saturated:.0%} of its pixels are at white"
        elif bright < Checks().smallest_signal:
            what = f"its brightest readings are {max(bright, 0):.1%} of white above black"
        if what is not None:
            raise AppError(
                f"{item.listed.where}: shot {frame.bench.shot}: {what}: expose otherwise, or are "
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
            raw = self._raw(item, frame, scale, whole=True)
            entry = frame_entry(
                raw, raw.exposure_s or 0.0, frame.gain, run=1, lamp=frame.bench.lamp,
                commanded_um=dict(frame.bench.offsets_um), figures=figures(raw), wall=wall_time(),
            )  # fmt: skip
            session.store(frame, frame_file(raw), lambda entry=entry: entry)
        for fault in verify_frames(session, session.stored.values()).values():
            raise AppError(f"{fault}; nothing was imported, test disk and memory")
        session.note(CompleteEntry(frames=len(planned)))

    def _raw(self, item: _Item, frame: PlannedFrame, scale: int, whole: bool = False) -> RawFrame:
        """Return a frame as if from a camera; whole: with the bytes of its file."""
        pixels = item.read()
        if pixels.dtype.kind == "f" or scale != 1:
            pixels = np.round(pixels * np.float64(scale))
        mosaic = np.ascontiguousarray(pixels.astype(np.uint16))
        row, path, noise = item.listed.row, item.listed.path, self._camera.sensor.noise
        metadata = {"name": path.name, "imported": str(path.resolve())}
        if row.temperature_c is not None:
            metadata["temperature_c"] = f"{row.temperature_c:g}"
        original, digest = b"", item.digest
        if whole:
            is_kept = item.place == 0 and not path.is_dir()
            original = path.read_bytes() if is_kept else b""
            if is_kept and hashlib.sha256(original).hexdigest() != digest:
                raise AppError(f"{shown_path(path)}: changed while it was imported; try again")
            if not original:
                original = f"frame {item.place} of {path.name}, SHA-256 {item.digest}".encode()
                digest = hashlib.sha256(original).hexdigest()
        levels = np.full((2, 2), float(noise.black_level_dn)), noise.white_level_dn
        if item.raw is not None:
            levels = item.raw.black_level_dn, item.raw.white_level_dn
            metadata = {**item.raw.metadata, **metadata}
        cfa = self._camera.sensor.cfa_name if item.raw is None else item.raw.cfa
        return RawFrame(
            mosaic, levels[0], levels[1], cfa, frame.exposure_s, original, digest,
            host_time_s=item.time_s if row.time is None else row.time, metadata=metadata,
        )  # fmt: skip

    def _set_white(self, planned: list[tuple[PlannedFrame, _Item]], scale: int) -> None:
        """Say how bright white is where nothing does, by the brightest of the scene.

        Raises AppError where the camera says it, and only another unit of time explains the shots.
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
            unit = "minutes" if bright > TOO_BRIGHT else "ms"
            if unit == "minutes" or 0.02 < bright * UNIT < 2:
                raise AppError(
                    f"the shots are {bright:.2g} times as bright as the camera's electrons_per_s "
                    f"says: {unit} for s in exposure_s? write seconds"
                )
            return
        self._note(
            f"the camera's electrons_per_s is not known: taken as {electrons_per_s:.3g}, for which "
            f"the brightest readings of the shots are {BRIGHTEST:g}"
        )
        noise = noise.model_copy(update={"electrons_per_s": electrons_per_s})
        sensor = self._camera.sensor.model_copy(update={"noise": noise})
        self._camera = self._camera.model_copy(update={"sensor": sensor})


def _placed(row: object) -> bool:
    return (
        getattr(row, "mask_x_um", None) is not None or getattr(row, "mask_y_um", None) is not None
    )


def _close(one: tuple[float, float], other: tuple[float, float]) -> bool:
    return bool(np.allclose(one, other, rtol=0.01, atol=1e-6))


def _is_unit(ratio: float) -> bool:
    """Return whether two exposures differ as milliseconds and seconds do."""
    return any(abs(ratio / unit - 1) < EXPOSURE_AGREEMENT for unit in (UNIT, 1 / UNIT))


def _step(
    exposures_s: Sequence[float], items: Sequence[tuple[_Item, int]], shot: int, own_s: float
) -> int:
    """Return which of its shot's bracket an exposure is, the shortest first."""
    bracket = {
        exposure_s
        for (item, of_shot), exposure_s in zip(items, exposures_s, strict=True)
        if of_shot == shot and item.listed.row.kind == "shot"
    }
    return sorted(bracket).index(own_s)
