"""Configuration of stage, camera and lights: `NAME:ADDRESS`, or a YAML file with more settings.

A stage is `PROTOCOL:PORT`; single settings may follow,
`zaber:/dev/ttyUSB0,microstep_um=0.49609375`; its file wires names to axes. A camera is
`DRIVER:ADDRESS`.

Another package brings stages, cameras and lights by entry point, see `docs/plugins.md`: it names a
factory in the group `emmc_rig.stages`, `emmc_rig.cameras` or `emmc_rig.lights`, whose name then
goes wherever ours do.

    stage factory(address, settings: StageSettings, clock: Clock, **options) -> drivers.stage.Stage
    camera factory(address, clock: Clock, **options) -> drivers.camera.Camera
    lights factory(address, clock: Clock, **options) -> drivers.lights.Lights
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path, PureWindowsPath
from typing import Annotated, Any, Literal, Self, get_type_hints

from pydantic import (
    Field,
    TypeAdapter,
    ValidationError,
    create_model,
    field_validator,
    model_validator,
)

from emmc_rig.drivers.apt import ACTUATORS
from emmc_rig.drivers.errors import DriverError
from emmc_rig.drivers.lights import COLOURS
from emmc_rig.drivers.stage import StageSettings
from emmc_rig.errors import AppError
from emmc_rig.model.json_text import shown_path
from emmc_rig.model.reading import one_line, parse_yaml, read_yaml
from emmc_rig.model.settings import Settings, explain, validated

STAGE_PLUG_INS, CAMERA_PLUG_INS = "emmc_rig.stages", "emmc_rig.cameras"
LIGHT_PLUG_INS = "emmc_rig.lights"


def plug_ins(group: str) -> set[str]:
    """Return the names of a group's plug-ins."""
    return set(entry_points(group=group).names)


def open_plug_in(group: str, name: str, *arguments: object, **options: Any) -> Any:
    """Return the device that a plug-in's factory opens; it must be closed.

    Raises AppError with one line for a plug-in that cannot be loaded, does not take the options,
    or fails, and for a name that two packages use; a `DriverError` of its own passes.
    """
    entry, *others = entry_points(group=group, name=name)
    if others:
        packages = " and ".join(map(_package, (entry, *others)))
        raise AppError(f"plug-in {name} is in {packages}: uninstall all but one")
    package = f"plug-in {name} ({_package(entry)})"
    try:
        factory = entry.load()
    except (ImportError, AttributeError) as fault:
        raise AppError(f"{package} cannot be loaded: {fault}") from fault
    try:
        return factory(*arguments, **options)
    except (DriverError, AppError):
        raise
    except Exception as fault:
        text = one_line(fault) or type(fault).__name__
        raise AppError(f"{package} could not open its device: {text}") from fault


def _package(entry: EntryPoint) -> str:
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist else entry.value


Positive = Annotated[float, Field(gt=0)]


class _Common(Settings):
    """Settings of every stage; see `drivers.stage.StageSettings`."""

    approach_um: Annotated[float, Field(ge=0)] = 10.0
    tolerance_um: Positive = 1.0
    settle_s: Annotated[float, Field(ge=0)] = 0.05
    soft_limits_um: dict[str, tuple[float, float]] = Field(default_factory=dict)
    speeds_um_s: dict[str, Positive] = Field(default_factory=dict)
    top_speeds_um_s: dict[str, Positive] = Field(default_factory=dict)

    def stage_settings(self) -> StageSettings:
        """Return the part that concerns how carefully the stage moves."""
        return StageSettings(**{name: getattr(self, name) for name in _Common.model_fields})


class ZaberConfig(_Common):
    """A chain of Zaber devices; without `axes` every axis found is used.

    microstep_um: of axes whose model is not known. resolution: the device's, where it holds.
    """

    protocol: Literal["zaber"] = "zaber"
    port: str
    axes: dict[str, tuple[int, int]] | None = None
    microstep_um: Positive | dict[str, Positive] | None = None
    resolution: int | dict[str, int] | None = None


class GrblConfig(_Common):
    """A Grbl controller, axes by letter; steps_per_mm: values that its `$100`, ... must have."""

    protocol: Literal["grbl"] = "grbl"
    port: str
    axes: dict[str, Literal["X", "Y", "Z", "A", "B", "C"]] = Field(
        default_factory=lambda: {"x": "X", "y": "Y"}
    )
    tolerance_um: Positive = 5.0
    steps_per_mm: dict[str, Positive] = Field(default_factory=dict)


class AptAxisConfig(Settings):
    """One channel of a Thorlabs controller; counts_per_um replaces the actuator's own."""

    port: str
    actuator: str
    counts_per_um: Positive | None = None
    destination: int = 0x50
    channel: int = 1


class AptConfig(_Common):
    """Thorlabs controllers, each axis with its own port or channel."""

    protocol: Literal["apt"] = "apt"
    axes: dict[str, AptAxisConfig]


APT_AXIS_OPTIONS = ("actuator", "counts_per_um", "destination", "channel")


class MicroManagerConfig(_Common):
    """Stages of a Micro-Manager configuration; see `drivers.micromanager.StageSetup`.

    port: the configuration file. axes: `XY.x`, `XY.y` or a label, by our names; all where left
    out.
    """

    protocol: Literal["mm"] = "mm"
    port: str
    axes: dict[str, str] | None = None
    travel_um: dict[str, tuple[float, float]] = Field(default_factory=dict)
    homes: bool = True
    speed_property: str = ""
    speed_unit_um_s: Positive = 1.0
    speed_um_s: Positive = 100.0


class PluginConfig(_Common):
    """A stage of a plug-in; its factory gets `options` unchanged."""

    protocol: str
    port: str = ""
    options: dict[str, Any] = Field(default_factory=dict)


SerialConfig = ZaberConfig | GrblConfig | AptConfig
StageConfig = SerialConfig | MicroManagerConfig | PluginConfig
PROTOCOLS: Mapping[str, type[SerialConfig]] = {
    "zaber": ZaberConfig,
    "grbl": GrblConfig,
    "apt": AptConfig,
}
"""Those with simulated firmware."""


def stage_protocols() -> dict[str, type[StageConfig]]:
    """Return every protocol that `--stage` takes; a plug-in replaces none of ours."""
    known: dict[str, type[StageConfig]] = {**PROTOCOLS, "mm": MicroManagerConfig}
    return known | dict.fromkeys(sorted(plug_ins(STAGE_PLUG_INS) - known.keys()), PluginConfig)


def parse_stage(spec: str, overrides: Mapping[str, Any] | None = None) -> StageConfig:
    """Return the stage that `PROTOCOL:PORT` or the name of a YAML file describes.

    `overrides` replace single settings. Raises AppError with one line.
    """
    shown = shown_path(spec)
    protocol, colon, port = spec.partition(":")
    known = stage_protocols()
    chosen: dict[str, Any] = {}
    if protocol in PROTOCOLS:
        port, *options = port.split(",")
        chosen = dict(_option(shown, option) for option in options)
    if colon and protocol in known and (port or known[protocol] is PluginConfig):
        data: dict[str, Any] = {"protocol": protocol, "port": port} | chosen
        if protocol == "apt":
            axis = {key: chosen.pop(key) for key in APT_AXIS_OPTIONS if key in chosen}
            data = {"protocol": protocol, "axes": {"x": {"port": port} | axis}} | chosen
    elif spec.endswith((".yaml", ".yml")):
        read = read_yaml(Path(spec), AppError)
        if not isinstance(read, dict):
            raise AppError(f"{shown}: expected a mapping of settings")
        data = dict(read)
    else:
        raise AppError(
            f"stage {shown}: write PROTOCOL:PORT with one of {', '.join(known)}, such as "
            "zaber:/dev/ttyUSB0, or the name of a YAML file"
        )
    return stage_of(data | dict(overrides or {}), shown)


def stages_of_rig(spec: str) -> list[Any] | None:
    """Return the stages that a rig's YAML file names, or None where `spec` names no rig."""
    if not spec.endswith((".yaml", ".yml")):
        return None
    read = read_yaml(Path(spec), AppError)
    if not isinstance(read, dict) or "protocol" in read or "stage" not in read:
        return None
    named = read["stage"]
    return [file_beside(stage, spec) for stage in (named if isinstance(named, list) else [named])]


def file_beside(device: Any, rig: str) -> Any:
    """Return a device, the name of a file that lies beside the rig's file as a whole path."""
    beside = Path(rig).parent
    if isinstance(device, str) and (beside / device).is_file():
        return str((beside / device).resolve())
    return device


def _require_actuators(axes: Any, source: str) -> None:
    """Raise AppError for an axis without an actuator: no controller reports what is plugged in."""
    known = ", ".join(ACTUATORS)
    for axis, channel in axes.items() if isinstance(axes, dict) else ():
        if isinstance(channel, dict) and "actuator" not in channel:
            raise AppError(
                f"{source}: {axis} must not move, its actuator is not stated: write "
                f"actuator: with one of {known} into the stage's YAML file, or "
                "apt:PORT,actuator=NAME"
            )


def _option(spec: str, text: str) -> tuple[str, Any]:
    """Return name and value of one `NAME=VALUE` behind a port; raises AppError."""
    name, equals, value = text.partition("=")
    if not (equals and name and value):
        raise AppError(f"stage {spec}: write NAME=VALUE behind the port, not {text!r}")
    return name.strip(), parse_yaml(value, f"stage {spec}", AppError)


def stage_of(data: dict[str, Any], source: str) -> StageConfig:
    """Return the stage that settings describe; raises AppError that begins with `source`."""
    protocol = str(data.get("protocol", ""))
    known = stage_protocols()
    if protocol not in known:
        raise AppError(f"{source}: protocol must be one of {', '.join(known)}")
    cls = known[protocol]
    if cls is AptConfig:
        _require_actuators(data.get("axes"), source)
    try:
        config: StageConfig = TypeAdapter(cls).validate_python(data)
    except ValidationError as fault:
        raise AppError(" ".join(f"{source}: {explain(fault, cls)}".split())) from fault
    if isinstance(config, AptConfig):
        for axis, channel in config.axes.items():
            if channel.actuator not in ACTUATORS:
                known = ", ".join(ACTUATORS)
                raise AppError(f"{source}: axes.{axis}.actuator: use one of {known}")
    return config


class _ColouredLights(Settings):
    """Settings by colour, `off` among them."""

    @field_validator("colours", mode="before", check_fields=False)
    @classmethod
    def _named(cls, colours: object) -> object:
        if not isinstance(colours, dict):
            return colours
        # YAML reads a bare off as false, and on as true.
        words = {"False": "off", "True": "on"}
        named = {words.get(str(key), str(key)): value for key, value in colours.items()}
        for colour in named:
            if colour not in COLOURS:
                raise ValueError(
                    f"{colour} is not a colour of the lights: use {', '.join(COLOURS)}"
                )
        if named and "off" not in named:
            raise ValueError("say how the lights are switched off, under off:")
        return named


class ExchangeConfig(Settings):
    """What is sent to set a colour, line end included, and the line that confirms it."""

    send: str = Field(min_length=1)
    expect: str = Field(min_length=1)


class TextLightsConfig(_ColouredLights):
    """Lights on a serial line or TCP; see `drivers.lights.TextLights`.

    ready: the line that the controller sends once it has started. limit_s: on each answer.
    """

    protocol: Literal["text"] = "text"
    port: str
    colours: dict[str, ExchangeConfig] = Field(min_length=1)
    baud: Annotated[int, Field(gt=0)] = 9600
    ready: str = ""
    end: Annotated[str, Field(min_length=1, max_length=1)] = "\n"
    limit_s: Positive = 3.0


class CommandLightsConfig(_ColouredLights):
    """A program for each colour, as a list of words; see `drivers.lights.CommandLights`."""

    protocol: Literal["command"] = "command"
    colours: dict[str, Annotated[tuple[str, ...], Field(min_length=1)]] = Field(min_length=1)
    limit_s: Positive = 10.0


class MicroManagerLightsConfig(_ColouredLights):
    """A shutter, a state device or both; see `drivers.lights.MicroManagerLights`.

    port: the configuration file. colours: positions of the device, or their names; a shutter alone
    has off and white.
    """

    protocol: Literal["mm"] = "mm"
    port: str
    shutter: str = ""
    device: str = ""
    colours: dict[str, int | str] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _some_device(self) -> Self:
        if not (self.shutter or self.device):
            raise ValueError("write shutter: or device:, with the label of that device")
        if bool(self.device) != bool(self.colours):
            raise ValueError("device: and colours:, its position for each colour, go together")
        return self


class PluginLightsConfig(Settings):
    """Lights of a plug-in; its factory gets `options` unchanged."""

    protocol: str
    port: str = ""
    options: dict[str, Any] = Field(default_factory=dict)


LightsConfig = (
    TextLightsConfig | CommandLightsConfig | MicroManagerLightsConfig | PluginLightsConfig
)


def lights_of(data: Mapping[str, Any], source: str) -> LightsConfig:
    """Return the lights that settings describe; raises AppError that begins with `source`."""
    known: dict[str, type[LightsConfig]] = {
        "text": TextLightsConfig,
        "command": CommandLightsConfig,
        "mm": MicroManagerLightsConfig,
    }
    known |= dict.fromkeys(sorted(plug_ins(LIGHT_PLUG_INS) - known.keys()), PluginLightsConfig)
    protocol = str(data.get("protocol", ""))
    if protocol not in known:
        raise AppError(f"{source}: protocol must be one of {', '.join(known)}")
    return validated(known[protocol], dict(data), source, AppError)


DRIVER_KEYS = ("driver", "kind")
"""Of a camera's YAML file: the name of its driver, now and in earlier versions."""


@dataclass(frozen=True)
class CameraChoice:
    """A driver, the address of its camera, other settings (options); `source` is for messages."""

    driver: str
    address: str = ""
    options: dict[str, Any] = field(default_factory=dict)
    source: str = ""


def settings_of(kind: type[Any]) -> type[Settings]:
    """Return the model that reads a driver's dataclass of options, and refuses unknown keys."""
    hints = get_type_hints(kind, include_extras=True)
    found: dict[str, Any] = {
        option.name: (
            hints[option.name],
            option.default
            if option.default_factory is MISSING
            else Field(default_factory=option.default_factory),
        )
        for option in fields(kind)
    }
    return create_model(kind.__name__, __base__=Settings, **found)


def _names_yaml(spec: str) -> bool:
    """Return whether a device is given by a YAML file; a drive's colon follows no driver's name."""
    return spec.endswith((".yaml", ".yml")) and (
        ":" not in spec or bool(PureWindowsPath(spec).drive)
    )


def parse_camera(spec: str | Mapping[str, Any]) -> CameraChoice:
    """Return the camera that `DRIVER:ADDRESS`, a YAML file's name, or its content describes.

    The file holds `driver` (in earlier versions `kind`), `address` and what that driver takes.
    Raises AppError with one line.
    """
    if isinstance(spec, str) and not _names_yaml(spec):
        driver, _, address = spec.partition(":")
        return CameraChoice(driver, address, source=f"camera {shown_path(spec)}")
    source = shown_path(spec) if isinstance(spec, str) else "the rig's camera"
    read = read_yaml(Path(spec), AppError) if isinstance(spec, str) else dict(spec)
    options = {str(key): value for key, value in read.items()} if isinstance(read, dict) else {}
    named = next((key for key in DRIVER_KEYS if isinstance(options.get(key), str)), None)
    if named is None:
        raise AppError(f"{source}: name the camera's driver, such as driver: mm")
    driver, address = options.pop(named), str(options.pop("address", ""))
    return CameraChoice(driver, address, options, source)
