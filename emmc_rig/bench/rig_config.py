"""Which rig is meant: a simulated one before a scene, or real devices named in a YAML file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal, get_args

from pydantic import Field, ValidationError, field_validator

from emmc_rig.bench.device_config import file_beside, lights_of
from emmc_rig.bench.environment import Source, SourceConfig
from emmc_rig.bench.hands import Ask, AskingAttendant, NoAttendant
from emmc_rig.bench.hardware import (
    NO_FLAWS,
    NO_STAGE,
    STAGE_AXES,
    Fitted,
    Rig,
    default_pupil,
    open_camera,
    open_lights,
    open_stages,
    simulated_rig,
    whole_pupil,
)
from emmc_rig.drivers.clock import SYSTEM_CLOCK
from emmc_rig.drivers.stage import Stage
from emmc_rig.errors import AppError
from emmc_rig.formats.scenes import APERTURE_FACTOR, PIXEL_FACTOR, fine_scene
from emmc_rig.model.arguments import path_of
from emmc_rig.model.camera import Camera
from emmc_rig.model.json_text import shown_path
from emmc_rig.model.pupil import Pupil
from emmc_rig.model.reading import read_yaml
from emmc_rig.model.settings import Settings, explain, validated
from emmc_rig.simulators.bench import RAYS_PER_VIEW
from emmc_rig.simulators.effects import EFFECTS, TOGETHER, flawed
from emmc_rig.simulators.scenes import MOVING_SCENES
from emmc_rig.simulators.still import StillStage

SIMULATED = "simulated"
IMPORTED = "imported"
"""Kind of rig of a session with files of another program."""
RECORDING, ANYWHERE_UM = "folder:", (-1e6, 1e6)
StageSpec = str | dict[str, Any]
AxisName = Literal["mask_x", "mask_y", "aperture_x", "aperture_y"]
NO_SETTINGS = ("kind", "trigger")
"""What a description has, or had in version 0.2, beside the settings of a rig."""


class Mounting(Settings):
    """How `emmc-rig live` found the mask to sit: its rotation, and its scale over the design's."""

    rotation_deg: float
    rotation_deviation_deg: float = Field(ge=0)
    scale: float = Field(gt=0)
    scale_deviation: float = Field(ge=0)


class AnyRig(Settings):
    """What a rig's file may say of every rig.

    fixed_positions_um: positions of axes that no plan moves, such as `focus`. mask: its measured
    mounting, which sessions keep. environment: sources that are read beside every frame. lights:
    settings of the lights, see `emmc_rig.bench.device_config`, or `simulated`; None: a person
    switches the lamp.
    """

    renamed: ClassVar = {"stands_um": "fixed_positions_um"}
    fixed_positions_um: dict[str, float] = Field(default_factory=dict)
    mask: Mounting | None = None
    environment: tuple[SourceConfig, ...] = ()
    lights: dict[str, Any] | Literal["simulated"] | None = None

    @field_validator("lights", mode="before")
    @classmethod
    def _lights_known(cls, lights: object) -> object:
        if not isinstance(lights, dict):
            return lights
        try:
            config = lights_of(lights, "")
        except AppError as fault:
            raise ValueError(str(fault).removeprefix(": ")) from fault
        kept = config.model_dump(mode="json", exclude_defaults=True)
        return {"protocol": config.protocol, **kept}

    @field_validator("environment")
    @classmethod
    def _names_once(cls, sources: tuple[SourceConfig, ...]) -> tuple[SourceConfig, ...]:
        names = [source.name for source in sources]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"two sources are named {name}: give one another name")
        return sources

    @field_validator("fixed_positions_um")
    @classmethod
    def _not_the_plans(cls, fixed_positions_um: dict[str, float]) -> dict[str, float]:
        for axis in fixed_positions_um:
            if axis in STAGE_AXES:
                raise ValueError(f"{axis} is moved by plans: give its zero_um instead")
        return fixed_positions_um


class RealRig(AnyRig):
    """Real devices.

    stage: as `--stage` of `emmc-rig devices`, or what its YAML file says, or a list of several;
    `none` where nothing moves. Its axes are called mask_x, mask_y, aperture_x, aperture_y, as many
    of them as there are. camera: a name for its `--camera`, or the content of a camera's YAML file.
    zero_um: place of each axis that centres the mask or the pinhole of the aperture plate; of an
    axis that a hand moves, the reading of its micrometer. window_um: aperture_x of the plate's open
    window, from there; window_side_um: side of the window, for plans that open parts of the
    aperture. A recording (camera `folder:PATH`, stage `simulated`) needs neither. by_hand: a person
    is asked for everything that no axis moves: board, masks, pinhole, and the lamp of a rig without
    lights; if false nothing of these changes, as in the replay of a recording.
    """

    stage: StageSpec | list[StageSpec] = NO_STAGE
    camera: str | dict[str, Any]
    zero_um: dict[str, float] = Field(default_factory=dict)
    window_um: float = 0.0
    window_side_um: float | None = Field(default=None, gt=0)
    by_hand: bool = True


class SimulatedAxes(AnyRig):
    """Which axes a simulated rig has.

    focus_um: place of its focus axis where the scene is sharp; None: no such axis. axes: a subset
    of mask_x, mask_y, aperture_x and aperture_y. second_stage: axes of a second controller.
    hands_um: largest error of a hand that moves the other axes. usb_camera: protocol of the camera.
    pupil: of its lens. none: the square of the views. round: as the camera describes it, else
    `default_pupil`. None, of sessions before version 0.5: as the camera describes it.
    """

    focus_um: float | None = Field(default=None, gt=0)
    axes: tuple[AxisName, ...] = get_args(AxisName)
    second_stage: tuple[AxisName, ...] = ()
    hands_um: float = Field(default=0.0, ge=0)
    usb_camera: Literal["ptp", "u3v"] = "ptp"
    pupil: Pupil | Literal["round", "none"] | None = None

    @field_validator("lights")
    @classmethod
    def _lights_of_the_bench(cls, lights: object) -> object:
        if isinstance(lights, dict):
            raise ValueError("the simulated bench has lights of its own: write lights: simulated")
        return lights

    @field_validator("pupil", mode="before")
    @classmethod
    def _pupil_of_settings(cls, pupil: object) -> object:
        if pupil in (None, "round", "none"):
            return pupil
        if not isinstance(pupil, (Mapping, Pupil)):
            raise ValueError(f"{pupil}: use round, none, or a lens such as {{diameter_mm: 27.5}}")
        try:
            return Pupil.model_validate(pupil)
        except ValidationError as fault:  # of a union, pydantic would list the faults of each part
            raise ValueError(explain(fault, Pupil)) from fault


LATER = tuple(SimulatedAxes.model_fields)
"""Settings that came after version 0.2."""


class SimulatedFile(SimulatedAxes):
    """A YAML file for the simulated rig."""

    kind: Literal["simulated"]


class ImagedRig(SimulatedAxes):
    """The simulated rig before a scene; size: rows and columns of the light field.

    rays: per view and pixel; calibration to a per cent needs 1024 or more. flaws: imperfections, by
    the names of `simulators.effects`.
    """

    scene: str
    size: tuple[int, int] | None = None
    seed: int = Field(default=0, ge=0)
    real_time: bool = False
    rays: int = Field(default=RAYS_PER_VIEW, ge=16)
    flaws: tuple[str, ...] = ()

    @field_validator("flaws")
    @classmethod
    def _known(cls, flaws: tuple[str, ...]) -> tuple[str, ...]:
        known = (*EFFECTS, TOGETHER)
        for name in flaws:
            if name not in known:
                raise ValueError(f"{name!r} is no flaw of the bench: use {', '.join(known)}")
        return flaws


def rig_description(spec: str, imaged: ImagedRig) -> dict[str, Any]:
    """Return what a session freezes of a rig: `simulated`, or a YAML file of devices.

    A file of `kind: simulated` is the simulated rig with the file's focus. Raises AppError with one
    line.
    """
    if spec == SIMULATED:
        return _described(SIMULATED, _of_now(imaged))
    if not spec.endswith((".yaml", ".yml")):
        raise AppError(
            f"rig {shown_path(spec)}: write simulated, or the name of a YAML file of devices"
        )
    read = read_yaml(Path(spec), AppError)
    if isinstance(read, dict) and read.get("kind") == SIMULATED:
        given = validated(SimulatedFile, read, spec, AppError)
        more = {name: getattr(given, name) for name in LATER}
        return _described(SIMULATED, _of_now(imaged.model_copy(update=more)))
    described = _described("real", validated(RealRig, read, spec, AppError))
    found = [file_beside(stage, spec) for stage in _several(described["stage"])]
    described["stage"] = found if isinstance(described["stage"], list) else found[0]
    camera = described["camera"]
    if isinstance(camera, dict) or not Path(camera).is_file():
        described["camera"] = file_beside(camera, spec)
    return described


def _of_now(imaged: ImagedRig) -> ImagedRig:
    """Return a new rig, the lens round where nothing is said of it."""
    if imaged.pupil is not None:
        return imaged
    return imaged.model_copy(update={"pupil": "round"})


def _real_pupil(imaged: ImagedRig, camera: Camera) -> Pupil:
    """Return the pupil of a simulated rig's lens."""
    if isinstance(imaged.pupil, Pupil):
        return imaged.pupil
    pupils = {"round": default_pupil(camera), "none": None, None: camera.lens.pupil}
    return pupils[imaged.pupil] or whole_pupil(camera)


def _several(stages: StageSpec | list[StageSpec]) -> list[StageSpec]:
    return stages if isinstance(stages, list) else [stages]


def _described(kind: str, config: ImagedRig | RealRig) -> dict[str, Any]:
    """Return a rig as plain data, without later settings that have their defaults."""
    described = config.model_dump(mode="json")
    for name in LATER:
        if name in described and getattr(config, name) == type(config).model_fields[
            name
        ].get_default(call_default_factory=True):
            del described[name]
    return {"kind": kind, **described}


@dataclass(frozen=True)
class RigChoice:
    """Which devices a capture is to use; they are opened by `emmc_rig.capture`, not before.

    name: "simulated", or the file's name. description: plain data that a session keeps of the rig.
    """

    name: str
    description: Mapping[str, Any]

    def __repr__(self) -> str:
        settings = ", ".join(
            f"{key}={value!r}" for key, value in self.description.items() if key != "kind"
        )
        return f"RigChoice({self.name!r}, {settings})"


def rig(
    name: str | Path,
    *,
    scene: str = "deep-occlusions",
    size: tuple[int, int] | None = None,
    seed: int = 0,
    rays: int | None = None,
    real_time: bool = False,
    flaws: tuple[str, ...] = (),
) -> RigChoice:
    """Return a rig, simulated or of real devices, whose devices `capture` opens.

    Args:
        name: "simulated", or the YAML file of a rig. The other arguments are of simulated rigs
            alone: real devices ignore them.
        scene: the scene before the camera: what `emmc_rig.scene` takes by name.
        size: (rows, columns) of samples of the light field. None: (192, 256) for built-in scenes,
            all of others.
        seed: random seed of scene and noise.
        rays: rays traced per view and pixel, 16 or more; calibration to a per cent needs 1024.
            None: 128.
        real_time: whether moves and exposures take as long as on a real bench.
        flaws: imperfections of the bench, by the names in `simulators.effects`.

    Raises:
        AppError: a file that cannot be read, or with a wrong entry; an argument that the simulated
            rig does not take. The scene is opened, and its errors raised, by `capture`.
        ArgumentError: a name that is no path.

    >>> import emmc_rig as emmc
    >>> emmc.rig("simulated", scene="near-planar", size=(24, 32)).description["kind"]
    'simulated'
    """
    name = str(path_of(name, "rig", '"simulated", or the YAML file that names real devices'))
    traced: dict[str, Any] = {} if rays is None else {"rays": rays}
    given = {"scene": scene, "size": size, "seed": seed, "real_time": real_time, "flaws": flaws}
    imaged = validated(ImagedRig, {**given, **traced}, "the simulated rig", AppError)
    return RigChoice(name, rig_description(name, imaged))


@contextmanager
def opened_rig(description: Mapping[str, Any], camera: Camera, ask: Ask) -> Iterator[Rig]:
    """Yield the rig that a description names, its devices open; camera: as planned.

    ask: shows a task to a person, and returns when it is done. Raises AppError or what opening a
    device raises.
    """
    with ExitStack() as opened:
        rig = opened.enter_context(_opened_devices(description, camera, ask))
        read = map(SourceConfig.model_validate, description.get("environment", ()))
        sources = tuple(opened.enter_context(Source(config)) for config in read)
        yield replace(rig, sources=sources)


@contextmanager
def _opened_devices(description: Mapping[str, Any], camera: Camera, ask: Ask) -> Iterator[Rig]:
    """Yield the rig, see `opened_rig`, without what is read beside it."""
    if description["kind"] == IMPORTED:
        raise AppError("an imported session takes no further frames: import them with the others")
    settings = {key: value for key, value in description.items() if key not in NO_SETTINGS}
    if description["kind"] == SIMULATED:
        imaged = validated(ImagedRig, settings, "the simulated rig", AppError)
        opened = partial(
            fine_scene,
            imaged.scene,
            APERTURE_FACTOR,
            PIXEL_FACTOR,
            size=imaged.size,
            views=camera.views,
            seed=imaged.seed,
        )
        fine = opened()
        height, width = fine.scene.light_field.shape[2:4]
        clock = SYSTEM_CLOCK if imaged.real_time else None
        flaws = flawed(NO_FLAWS, imaged.flaws)
        rig, _ = simulated_rig(
            camera,
            (lambda at_s: opened(time_s=at_s).samples)
            if imaged.scene in MOVING_SCENES
            else fine.samples,
            (height, width),
            imaged.seed,
            clock,
            imaged.rays,
            replace(flaws, optics=replace(flaws.optics, pupil=_real_pupil(imaged, camera))),
            imaged.focus_um,
            imaged.fixed_positions_um,
            Fitted(
                imaged.axes,
                imaged.second_stage,
                imaged.hands_um,
                imaged.usb_camera,
                imaged.lights is not None,
            ),
        )
        _check_axes(imaged, rig)
        yield rig
        return
    real = validated(RealRig, settings, "the rig", AppError)
    zero_um = dict(real.zero_um)
    recorded = isinstance(real.camera, str) and real.camera.startswith(RECORDING)
    if real.stage == SIMULATED and recorded:
        # Nothing moves any more, wherever the stage of the recording was sent.
        still: Stage = StillStage(
            (*STAGE_AXES, *real.fixed_positions_um), SYSTEM_CLOCK, 0.0, ANYWHERE_UM
        )
        zero_um = dict.fromkeys(STAGE_AXES, 0.0) | zero_um
    else:
        still = open_stages(_several(real.stage))
    switched = nullcontext() if real.lights is None else closing(open_lights(real.lights))
    with still as stage, switched as lights, closing(open_camera(real.camera)) as device:
        rig = Rig(
            stage,
            device,
            AskingAttendant(camera, ask, zero_um, real.window_um)
            if real.by_hand
            else NoAttendant(),
            zero_um,
            real.window_um,
            reopen_camera=lambda: open_camera(real.camera),
            window_side_um=real.window_side_um,
            fixed_positions_um=real.fixed_positions_um,
            lights=lights,
        )
        _check_axes(real, rig)
        yield rig


def _check_axes(config: AnyRig, rig: Rig) -> None:
    """Raise AppError for an axis that the stage has not."""
    for axis in config.fixed_positions_um:
        if axis not in rig.stage.axes:
            known = ", ".join(rig.stage.axes) or "none"
            raise AppError(f"fixed_positions_um.{axis}: the stage has no such axis, only {known}")
