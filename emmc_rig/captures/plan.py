"""The plan of a capture, frozen and validated; and a commented one to begin with."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import (
    BeforeValidator,
    Discriminator,
    Field,
    Tag,
    field_validator,
    model_validator,
)

from emmc_rig.errors import AppError
from emmc_rig.model.reading import read_yaml
from emmc_rig.model.settings import Settings, validated

if TYPE_CHECKING:
    from emmc_rig.model.camera import Camera, Shot

METERING_EXPOSURE_S = 0.01

Lamp = Literal["white", "red", "green", "blue"]
Positive = Annotated[float, Field(gt=0)]
Gain = Annotated[float, Field(ge=1, description="1: the camera's lowest ISO")]
Repeats = Annotated[int, Field(ge=1, le=10_000)]


def _several(value: object) -> object:
    return (value,) if isinstance(value, (int, float)) and not isinstance(value, bool) else value


AUTO = "auto"
Exposures = Annotated[tuple[Positive, ...], BeforeValidator(_several), Field(min_length=1)]
"""One exposure in seconds, or several: a bracket."""
MeteredExposures = Annotated[
    Annotated[Literal["auto"], Tag(AUTO)] | Annotated[Exposures, Tag("seconds")],
    Discriminator(lambda value: AUTO if isinstance(value, str) else "seconds"),
]
"""As `Exposures`, or metered."""


class PlannedShot(Settings):
    """One shot of the scene.

    The masks in the beam, their place and the filter are those of one of the camera's shots;
    `mask_um` or `mask_cells` (x, y) move every mask on the stage elsewhere.
    """

    camera_shot: int | None = Field(
        default=None, ge=0, description="from 0; default: this shot's own place in the list"
    )
    mask_um: tuple[float, float] | None = Field(default=None, description="x, y from the axis")
    mask_cells: tuple[float, float] | None = Field(default=None, description="x, y in mask cells")
    exposure_s: MeteredExposures | None = Field(
        default=None,
        description="auto: metered; or seconds, several are a bracket; default: the camera's own",
    )
    gain: Gain = 1.0
    repeats: Repeats = 1
    lamp: Lamp = "white"

    @model_validator(mode="after")
    def _one_place(self) -> PlannedShot:
        if self.mask_um is not None and self.mask_cells is not None:
            raise ValueError("give mask_um or mask_cells, not both")
        return self


class OpenBoard(Settings):
    """A whiteboard through the masks with the aperture open, for fits of the mask.

    mask_um: x, y beyond the first shot's mask position. validation: kept out of all fits, to judge
    them.
    """

    renamed: ClassVar = {"held_out": "validation"}

    mask_um: tuple[float, float] = (0.0, 0.0)
    window: tuple[int, int] = Field(
        default=(0, 0),
        description="x, y: by how many aperture cells the plate's window is moved, so that a part "
        "of the aperture is open",
    )
    repeats: Repeats = 2
    validation: bool = False


class Boards(Settings):
    """Whiteboards: the pinhole before every view, and the open aperture without masks."""

    views: Literal["all"] | tuple[tuple[int, int], ...] = Field(
        default="all", description="all, or a list of [v, u]; [] for none"
    )
    open: tuple[OpenBoard, ...] = Field(
        default=(), description="masks in, whole aperture: for the calibration method parametric"
    )
    shots: Literal["all"] | tuple[Annotated[int, Field(ge=0)], ...] = Field(
        default="all", description="for which shots the pinhole is stepped: all, or a list"
    )
    lamps: tuple[Lamp, ...] | None = Field(
        default=None, min_length=1, description="default: what the sensor needs"
    )
    repeats: Repeats = 2
    references: Annotated[int, Field(ge=2, le=10_000)] = 4
    lamp_checks: Annotated[int, Field(ge=0, le=10_000)] = Field(
        default=0,
        description="the open whiteboard of the first shot again, so often, spread over the "
        "others, and the reference once more at the end: how the lamp drifts",
    )
    response: tuple[Annotated[float, Field(gt=0, lt=1)], ...] = Field(
        default=(), description="references at these shares of their exposure too: the response"
    )
    colours: Annotated[int, Field(ge=0, le=10_000)] = Field(
        default=0, description="references under red, green, blue lamps: crosstalk of the filters"
    )
    turned: Annotated[int, Field(ge=0, le=10_000)] = Field(
        default=0,
        description="open whiteboards and references with the board turned: how uneven the board "
        "is over angle",
    )
    turns_deg: tuple[Annotated[float, Field(gt=0, lt=360)], ...] = Field(
        default=(90.0,),
        min_length=1,
        description="by how much it is turned in its plane; 90, 180 and 270 also show which way, "
        "and what does not turn with the board",
    )
    level: float = Field(default=0.7, gt=0, lt=1, description="brightness to meter for, 1 at white")
    exposure_s: Positive | None = Field(
        default=None, description="of the references; default: metered"
    )

    @field_validator("turns_deg")
    @classmethod
    def _each_once(cls, turns_deg: tuple[float, ...]) -> tuple[float, ...]:
        if len(set(turns_deg)) < len(turns_deg):
            raise ValueError("write each turn once")
        return turns_deg


class Metering(Settings):
    """Of shots with `exposure_s: auto`: where their exposure is aimed at."""

    level: float = Field(
        default=0.7, gt=0, lt=1, description="of the brightest readings, 1 at white"
    )
    bracket: bool = Field(
        default=True, description="longer exposures too, where most of a scene is far darker"
    )
    alike: bool = Field(default=True, description="the same for all shots of one lamp and gain")
    longest_s: Positive = Field(default=30.0, description="no exposure is made longer than this")


class Darks(Settings):
    """Dark frames, the lamp off."""

    exposure_s: Exposures = (METERING_EXPOSURE_S,)
    repeats: Annotated[int, Field(ge=2, le=10_000)] = 4
    of_boards: Annotated[int, Field(ge=0, le=10_000)] = Field(
        default=0,
        description="at every exposure of the whiteboards too, so many before and after them",
    )
    of_shots: Annotated[int, Field(ge=0, le=10_000)] = Field(
        default=0,
        description="so many at the longest exposure of the shots, before them; 0, or at least 2",
    )

    @field_validator("of_shots")
    @classmethod
    def _repeated(cls, count: int) -> int:
        if count == 1:
            raise ValueError("write 0, or 2 or more: one frame does not tell its own noise")
        return count


class Retries(Settings):
    """How often a frame is tried again before the capture stops, everything kept."""

    per_frame: int = Field(default=4, ge=0)
    per_session: int = Field(default=200, ge=0, description="between start and end of the program")


class Checks(Settings):
    """What a frame must pass before it counts."""

    largest_saturated_share: float = Field(
        default=0.02, ge=0, le=1, description="of a frame's pixels; a bracket's shortest exposure"
    )
    smallest_signal: float = Field(
        default=0.002, ge=0, le=1, description="brightest pixels above black, 1 at white"
    )
    largest_dark: float = Field(default=0.05, gt=0, le=1, description="mean of a dark frame")
    stage_um: float = Field(default=2.0, gt=0, description="read-back after the exposure")
    places_by_hand: bool = Field(
        default=True,
        description="whether whiteboards must show pinhole and mask where hands were to put them",
    )
    registration_px: float = Field(
        default=0.5, gt=0, description="shift against the last good frame, on resuming"
    )


class Focusing(Settings):
    """When the focus axis is brought to where the scene is sharpest: before shots of the scene.

    Before the first one of every run, and again before one whenever `every` frames were taken
    since.
    """

    every: Annotated[int, Field(ge=1)] | None = Field(
        default=None, description="frames, of any kind; null: once a run"
    )
    span_um: Positive = Field(default=400.0, description="to either side of where the axis stands")


class Trigger(Settings):
    """A pulse on a line of the camera, as of the stage or the lamp, begins every frame."""

    source: str = Field(min_length=1, description="the camera's name of the line, as Line1")
    edge: Literal["rising", "falling"] = "rising"
    limit_s: Positive = Field(default=10.0, description="a pulse that comes later is lost")


class Film(Settings):
    """A film of the scene: frame after frame, each at its time, by the plan's shots in turn.

    With one shot the masks stand still. With several, frame t is taken by shot t modulo their
    number, so that the masks are stepped between frames and come back after a cycle.
    """

    frames: Annotated[int, Field(ge=1, le=1_000_000)]
    rate: Annotated[float, Field(gt=0, le=10_000, description="frames per second")]


BEFORE_SHOTS = "before-shots"


class Plan(Settings):
    """What to capture; see `new_plan` for a commented one."""

    removed: ClassVar = ("suspend",)
    title: str = ""
    camera: str = Field(description="a shipped camera, or a YAML file")
    shots: tuple[PlannedShot, ...] = Field(min_length=1)
    whiteboards: Boards | None = Boards()
    darks: Darks | None = Darks()
    metering: Metering = Metering()
    film: Film | None = Field(
        default=None, description="frames and rate: the shots are taken as a film of the scene"
    )
    order: Literal["least-travel", "as-planned"] = "least-travel"
    between: str | None = Field(
        default=None,
        description="module:function, called before every frame and after the last, see "
        "`emmc_rig.captures.between`",
    )
    trigger: Trigger | None = Field(
        default=None, description="a line of the camera begins every frame; default: the program"
    )
    exposure_output: str | None = Field(
        default=None, min_length=1, description="line of the camera that is high while it exposes"
    )
    focus: Focusing | None = Field(
        default=None, description=f"`{BEFORE_SHOTS}`, or when: needs an axis named focus"
    )
    settle_s: float = Field(
        default=0.0, ge=0, le=3600, description="after a move, beyond the stage's own"
    )
    retries: Retries = Retries()
    checks: Checks = Checks()

    @field_validator("between")
    @classmethod
    def _a_name(cls, between: str | None) -> str | None:
        if between is not None and not re.fullmatch(r"[\w.]+:[\w.]+|[\w-]+", between):
            raise ValueError(f"write module:function, as lab:hook, not {between!r}")
        return between

    @field_validator("focus", mode="before")
    @classmethod
    def _by_name(cls, focus: object) -> object:
        if isinstance(focus, str) and focus != BEFORE_SHOTS:
            raise ValueError(f"write {BEFORE_SHOTS}, or {{every: 50}}, not {focus!r}")
        return {} if focus == BEFORE_SHOTS else focus

    @property
    def longest_s(self) -> float:
        """The longest exposure that metering may choose for the scene: at most a film's period."""
        longest_s = self.metering.longest_s
        return longest_s if self.film is None else min(longest_s, 1 / self.film.rate)

    @model_validator(mode="after")
    def _filmed_alike(self) -> Plan:
        asked = {(shot.exposure_s, shot.gain, shot.lamp, shot.repeats) for shot in self.shots}
        exposures = self.shots[0].exposure_s
        bracket = isinstance(exposures, tuple) and len(exposures) > 1
        alike = len(asked) == 1 and self.metering.alike
        if self.film is not None and (bracket or not alike or self.shots[0].repeats > 1):
            raise ValueError(
                "film: its frames are exposed alike and once: give its shots one exposure_s, gain "
                "and lamp, and leave brackets, repeats and metering.alike out"
            )
        return self


def load_plan(path: Path) -> Plan:
    """Read a plan; raises AppError for a missing file, or naming the nearest valid key."""
    if not path.exists():
        raise AppError(f"{path}: no such file; write a plan", "new-plan")
    return validated(Plan, read_yaml(path, AppError), str(path), AppError)


def planned_camera(plan: Plan, beside: Path | None = None) -> Camera:
    """Return the camera of a plan, with the shots of the plan.

    beside: the folder that a camera file is looked for in first. Raises AppError or CameraError.
    """
    from emmc_rig.formats.cameras import find_camera  # takes a second to load

    spec = plan.camera
    if beside is not None and (beside / spec).is_file():
        spec = str(beside / spec)
    camera = find_camera(spec)
    wanted = max(_own_shot(camera, place, shot) for place, shot in enumerate(plan.shots))
    if wanted >= len(camera.shots):
        camera = camera.with_shots(wanted + 1)
    changing = [
        name
        for name, mask in camera.masks.items()
        if mask.pattern.frame_count(len(camera.shots)) > 1
    ]
    for place, shot in enumerate(plan.shots):
        if changing and shot.camera_shot not in (None, place):
            raise AppError(
                f"shots.{place}.camera_shot: mask '{changing[0]}' has another pattern in every "
                "shot, so that camera_shot has no effect: leave it out"
            )
    shots = tuple(_camera_shot(camera, place, shot) for place, shot in enumerate(plan.shots))
    return camera.model_copy(update={"shots": shots})


def _own_shot(camera: Camera, place: int, shot: PlannedShot) -> int:
    """Return which of the camera's shots a planned one is; one of a place of its own goes round."""
    if shot.camera_shot is not None:
        return shot.camera_shot
    placed = shot.mask_um is not None or shot.mask_cells is not None
    return place % len(camera.shots) if placed else place


def _camera_shot(camera: Camera, place: int, shot: PlannedShot) -> Shot:
    own = camera.shots[_own_shot(camera, place, shot)]
    if shot.mask_um is None and shot.mask_cells is None:
        return own
    moving = camera.moving_masks or tuple(camera.masks)
    if not moving:
        raise AppError(f"shots.{place}: the camera has no mask to move: leave its place out")
    if shot.mask_um is not None:
        offsets = dict.fromkeys(moving, shot.mask_um)
    else:
        assert shot.mask_cells is not None
        x, y = shot.mask_cells
        offsets = {
            name: (x * camera.masks[name].cell_um, y * camera.masks[name].cell_um)
            for name in moving
        }
    return own.model_copy(update={"offset_um": offsets})


def differences(plan: Plan, other: Plan) -> list[str]:
    """Return what differs between two plans, in words; nothing for equal ones."""
    return list(_differences(plan.model_dump(), other.model_dump(), ""))


def _differences(value: Any, other: Any, where: str) -> Iterator[str]:
    if isinstance(value, dict) and isinstance(other, dict):
        for key in value:
            yield from _differences(value[key], other.get(key), f"{where}.{key}")
    elif isinstance(value, (list, tuple)) and isinstance(other, (list, tuple)):
        if len(value) != len(other):
            yield f"{where.lstrip('.')} has {len(value)} entries, not {len(other)}"
        for place, (a, b) in enumerate(zip(value, other, strict=False)):
            yield from _differences(a, b, f"{where}.{place}")
    elif value != other:
        yield f"{where.lstrip('.')} is {_shown(value)}, not {_shown(other)}"


def _shown(value: Any) -> str:
    return json.dumps(value, default=str)


def new_plan(name: str, camera: Camera) -> str:
    """Return the YAML of a plan that takes every shot of a camera, as the camera describes it."""
    rows, columns = camera.views
    shots = "\n".join(_shot(camera, place) for place in range(len(camera.shots)))
    return f"""\
# A plan of a capture. Comments show defaults and examples.

title: {name}
camera: {name}              # a shipped camera, or a YAML file beside this one

# The shots of the scene. Each takes masks, mask place and filter from the camera's own shot.
#   mask_um: [x, y]         moves the mask stage elsewhere; or in cells: mask_cells: [x, y]
#   exposure_s: auto        metered on the scene, see `metering`; or seconds
#   exposure_s: [0.004, 0.016, 0.064]   a bracket, fused to one linear frame with its variance
#   gain: 1   repeats: 1   lamp: white   camera_shot: which of the camera's shots this is
shots:
{shots}

# Before calibration: the pinhole before each of {rows} x {columns} views, and the open aperture
# without masks. `whiteboards: null` leaves them out.
whiteboards:
  views: all                # or a list: [[0, 0], [2, 2]]
  open:                     # masks in, whole aperture
    - {{validation: true}}    # not used for Psi: calibration judges Psi by it
    # - {{mask_um: [0, 0]}}   # to fit the mask from few frames
  # lamps: [white]          # default: what the sensor needs
  repeats: 2
  references: 4
  level: 0.7                # their brightness, 1 at white; or exposure_s: of the references

metering:                   # of shots with exposure_s: auto
  level: 0.7                # of the brightest readings, 1 at white
  bracket: true             # longer exposures too, where most of the scene is far darker
  alike: true               # the same for all shots of one lamp and gain
  longest_s: 30

darks:
  exposure_s: [0.01]
  repeats: 4
  of_shots: 4               # at the longest exposure of the shots, for their dark current

# film: {{frames: 200, rate: 10}}   # the shots in turn, at 10 Hz; one shot: the masks stand still

order: least-travel         # or as-planned
settle_s: 0                 # after a move, beyond the stage's own
# between: lab:hook         # a function in lab.py, called before every frame (docs: Hooks)
# trigger: {{source: Line1}}  # pulses on this line of the camera begin the frames; edge: falling
# exposure_output: Line2    # this line of the camera is high while it exposes
# focus: before-shots       # the axis `focus` goes to where the scene is sharpest

retries:
  per_frame: 4
  per_session: 200

checks:
  largest_saturated_share: 0.02
  smallest_signal: 0.002    # brightest pixels, 1 at white
  largest_dark: 0.05        # mean of a dark frame, 1 at white
  stage_um: 2.0             # read-back after the exposure
  registration_px: 0.5      # against the last good frame, on resuming
"""


def _shot(camera: Camera, place: int) -> str:
    offsets = [
        f"{name} at x {x:g}, y {y:g} um"
        for name, (x, y) in camera.shots[place].offset_um.items()
        if name in camera.shot_masks(place)
    ]
    chosen = camera.shots[place].filter
    notes = [*offsets, *([] if chosen == "none" else [f"{chosen} filter"])]
    line = "  - exposure_s: auto"
    return f"{line:<28}# {'; '.join(notes)}" if notes else line
