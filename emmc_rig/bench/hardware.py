"""The only place that chooses devices: real ones by name, or simulated ones on the same bytes.

The stage chain: device 1 carries the coded mask (axes x, y), device 2 the aperture plate (axes
x, y), which has a pinhole of one aperture cell and, beside it, a window that leaves the whole
aperture open.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from emmc_rig.bench.device_config import (
    CAMERA_PLUG_INS,
    LIGHT_PLUG_INS,
    STAGE_PLUG_INS,
    AptConfig,
    CameraChoice,
    CommandLightsConfig,
    GrblConfig,
    MicroManagerConfig,
    MicroManagerLightsConfig,
    PluginConfig,
    PluginLightsConfig,
    SerialConfig,
    TextLightsConfig,
    ZaberConfig,
    lights_of,
    open_plug_in,
    parse_camera,
    parse_stage,
    plug_ins,
    settings_of,
    stage_of,
    stages_of_rig,
)
from emmc_rig.bench.environment import Source
from emmc_rig.bench.hands import Attendant
from emmc_rig.drivers.apt import ACTUATORS, AptAxis, AptStage
from emmc_rig.drivers.apt import identify as identify_apt
from emmc_rig.drivers.camera import Camera as CameraDevice
from emmc_rig.drivers.cameras import CAMERA_HELP, CAMERAS
from emmc_rig.drivers.clock import SYSTEM_CLOCK, Clock
from emmc_rig.drivers.combined import CombinedStage
from emmc_rig.drivers.dng import SMALLEST_SIDE_PX
from emmc_rig.drivers.errors import DriverError, FirmwareError, TransportTimeoutError
from emmc_rig.drivers.grbl import GrblStage
from emmc_rig.drivers.grbl import identify as identify_grbl
from emmc_rig.drivers.lights import (
    CommandLights,
    Exchange,
    Lights,
    MicroManagerLights,
    TextLights,
)
from emmc_rig.drivers.ports import find_port, guess_of, list_serial_ports
from emmc_rig.drivers.ptp import open_camera as open_ptp
from emmc_rig.drivers.stage import HostStage, Stage, StageSettings
from emmc_rig.drivers.transport import SerialTransport, Transport
from emmc_rig.drivers.u3v import open_camera as open_u3v
from emmc_rig.drivers.zaber import ZaberStage, find_devices
from emmc_rig.errors import AppError
from emmc_rig.formats.scenes import open_scene
from emmc_rig.model.camera import Camera, Sensor
from emmc_rig.model.masks import cfa_tile
from emmc_rig.model.pupil import Pupil
from emmc_rig.model.settings import validated
from emmc_rig.model.view_axes import ANGLES
from emmc_rig.simulators.apt import AptController
from emmc_rig.simulators.bench import RAYS_PER_VIEW, Bench, window_side_um
from emmc_rig.simulators.clock import ManualClock
from emmc_rig.simulators.effects import Flaws
from emmc_rig.simulators.firmware import SimulatedController
from emmc_rig.simulators.grbl import LETTERS, GrblController
from emmc_rig.simulators.lamp import LAMP_EXCHANGES, READY, ArduinoLamp
from emmc_rig.simulators.ptp import ANY_EXPOSURE, THIRD_STOPS, PtpCameraSimulator, PtpUsbFunction
from emmc_rig.simulators.u3v import U3vCameraSimulator
from emmc_rig.simulators.usb import SimulatedUsb, UsbFunction
from emmc_rig.simulators.wire import PtyServer
from emmc_rig.simulators.zaber import AxisSpec, ZaberChain

_log = logging.getLogger(__name__)

STAGE_AXES = {
    "mask_x": (1, 1),
    "mask_y": (1, 2),
    "aperture_x": (2, 1),
    "aperture_y": (2, 2),
}
FOCUS, FOCUS_ADDRESS = "focus", (3, 1)
"""The axis that moves the lens along the optical axis, where a stage has one."""
MASK_TRAVEL_UM = 25_400.0
POSITION_TOLERANCE_UM, GRBL_TOLERANCE_UM = 0.5, 2.0
SIMULATED = "simulated"
NO_STAGE = "none"
PROBE_TIMEOUT_S = 0.2
MICROMETER = 0.1
"""By how much surer a hand puts a mask on its micrometer than a pinhole on its hole."""
PUPIL_OF_VIEWS = 10 / 7
"""Diameter of the simulated lens's round pupil, over the side of the square of all views: docs/
day-one.md recommends 25 mm around 5 x 3.5 mm, so that the corner views lie just inside."""
NO_FLAWS = Flaws()
"""But for a mask that sits a few um off, as every one does."""
SIMULATED_SCALES = {
    "zaber": f",microstep_um={AxisSpec().microstep_um}",
    "grbl": "",
    "apt": ",actuator=z825",
}
"""What must be stated of simulated devices: models that no table has, an unnamed actuator."""


def _unheard(name: str) -> None:
    """Take no notice: real noise needs no name."""


@dataclass(frozen=True)
class Rig:
    """The devices of one bench.

    zero_um: where each stage axis centres the mask or the pinhole on the optical axis.
    window_um: aperture_x, from its zero, that brings the plate's open window onto the axis.
    clock: the devices' own. reopen_camera: opens the camera again after it went away.
    about_to_expose: called with a frame's name before its exposure. window_side_um: side of that
    square window, to put its edges between views; None: not known. fixed_positions_um: where
    axes are in a capture that no plan moves, as the focus. recorded_s: of a recording that is
    replayed, the exposure of each frame by its name. hands: axes that the stage has not, which the
    attendant moves; left: axes among these with the same place in every frame, which nobody moves.
    sources: what is read beside every frame. lights: what switches the light; None: the attendant
    does.
    """

    stage: Stage
    camera: CameraDevice
    attendant: Attendant
    zero_um: Mapping[str, float]
    window_um: float
    clock: Clock = SYSTEM_CLOCK
    reopen_camera: Callable[[], CameraDevice] | None = None
    about_to_expose: Callable[[str], None] = _unheard
    window_side_um: float | None = None
    fixed_positions_um: Mapping[str, float] = field(default_factory=dict)
    recorded_s: Mapping[str, float] = field(default_factory=dict)
    hands: frozenset[str] = frozenset()
    left: frozenset[str] = frozenset()
    sources: tuple[Source, ...] = ()
    lights: Lights | None = None

    def set_lamp(self, colour: str) -> str:
        """Light scene or board in this colour, or not for `off`.

        Returns what the lights confirmed, "" where the attendant switches. Raises `LightError`.
        """
        if self.lights is not None:
            return self.lights.set(colour)
        self.attendant.set_lamp(colour)
        return ""


RigType = TypeVar("RigType", bound=Rig)


@dataclass(frozen=True)
class Fitted:
    """Which of the four axes a simulated rig has, and those among them of a second controller.

    hands_um: how far, at most, a hand that moves the others puts them off their places. camera:
    what its camera speaks, ptp or u3v. lights: whether an Arduino switches its lamp, not a hand.
    """

    names: tuple[str, ...] = tuple(STAGE_AXES)
    second: tuple[str, ...] = ()
    hands_um: float = 0.0
    camera: str = "ptp"
    lights: bool = False


ALL_FITTED = Fitted()


@dataclass(frozen=True)
class SimulatedRig(Rig):
    """A rig, and the firmware of stage, camera and lamp, whose faults can be armed.

    still: of the camera. lamp: None where a hand switches it.
    """

    chain: ZaberChain = field(kw_only=True)
    still: PtpCameraSimulator | U3vCameraSimulator = field(kw_only=True)
    lamp: ArduinoLamp | None = field(kw_only=True)


class SimulatedAttendant(Attendant):
    """An `Attendant` that acts on the simulated bench.

    at_um: gets where a hand puts what no axis moves; hands_um: how far off at most.
    """

    def __init__(self, bench: Bench, at_um: dict[str, float], hands_um: float, seed: int) -> None:
        self._bench, self._at_um, self._hands_um = bench, at_um, hands_um
        self._rng = np.random.default_rng(seed)
        self._wanted_um: dict[str, float] = {}

    def set_lamp(self, colour: str) -> None:
        """Switch the bench's lamp."""
        self._bench.lamp = colour

    def place(self, target: str, turn_deg: float = 0.0) -> None:
        """Change what the camera looks at."""
        self._bench.target, self._bench.board_turn_deg = target, turn_deg

    def fit_masks(self, shot: int, fitted: bool = True) -> None:
        """Change what is in the beam."""
        self._bench.shot = shot
        self._bench.masks_in = fitted

    def move(self, offsets_um: Mapping[str, float]) -> None:
        """Put mask or pinhole there, as well as a hand does; an open aperture is just open."""
        opened = offsets_um.get("aperture_x") == self._bench.window_um
        for axis, um in offsets_um.items():
            if self._wanted_um.get(axis) == um:
                continue
            self._wanted_um[axis] = um
            exact = opened and axis.startswith("aperture")
            off_um = self._rng.uniform(-self._hands_um, self._hands_um)
            if axis.startswith("mask"):
                off_um *= MICROMETER
            self._at_um[axis] = um + (0.0 if exact else off_um)

    def again(self, axes: Collection[str]) -> None:
        """Move these once more when they are next wanted."""
        for axis in axes:
            self._wanted_um.pop(axis, None)


def whole_pupil(camera: Camera) -> Pupil:
    """Return the square pupil that leaves every view open."""
    side_mm = max(camera.views) * camera.lens.aperture_cell_mm
    return Pupil(shape="square", diameter_mm=side_mm)


def default_pupil(camera: Camera) -> Pupil | None:
    """Return the pupil of the simulated lens: the camera's own, or a round one; None: the views'.

    Views that are no places of the aperture, or points of it, have no pupil but the camera's own.
    """
    described = camera.lens.pupil
    apertures = camera.view_axes == ANGLES and camera.lens.aperture_fill > 0
    if described is not None or not apertures:
        return described
    return Pupil(diameter_mm=round(PUPIL_OF_VIEWS * whole_pupil(camera).diameter_mm, 6))


def simulated_rig(
    camera: Camera,
    fine_scene: NDArray[np.float32] | Callable[[float], NDArray[np.float32]],
    size: tuple[int, int],
    seed: int,
    clock: Clock | None = None,
    rays_per_view: int = RAYS_PER_VIEW,
    flaws: Flaws = NO_FLAWS,
    focus_um: float | None = None,
    fixed_positions_um: Mapping[str, float] | None = None,
    fitted: Fitted = ALL_FITTED,
) -> tuple[SimulatedRig, Bench]:
    """Return a rig of simulated devices, and the bench that they look at (for its truth).

    fine_scene: see `simulators.bench.Bench`. size: rows and columns of the light field. clock: a
    real one lets moves and exposures take their time; by default they take none. The noise of a
    frame that is announced by name follows from the name alone. The lens has the pupil of `flaws`,
    or `default_pupil`. rays_per_view: of one pixel; few rays are quick, and grainy beside a good
    sensor's noise. flaws: imperfections of the bench.
    focus_um: place of a fifth axis, `focus`, where the scene is sharp; None: no such axis.
    fixed_positions_um: see `Rig`. fitted: with which axes and camera. Raises AppError for a size
    that the camera's RAW files cannot hold.
    """
    k = camera.sensor.binning
    if min(size) // k < SMALLEST_SIDE_PX:
        least = SMALLEST_SIDE_PX * k
        raise AppError(
            f"size {size[0]}x{size[1]}: the simulated camera's RAW files hold at least "
            f"{SMALLEST_SIDE_PX}x{SMALLEST_SIDE_PX} pixels: use {least}x{least} or more"
        )
    clock = clock or ManualClock()
    aperture_um = max(camera.views) * camera.lens.aperture_cell_um
    travel_um = {1: MASK_TRAVEL_UM, 2: 4 * aperture_um, 3: MASK_TRAVEL_UM}
    addresses = STAGE_AXES if focus_um is None else STAGE_AXES | {FOCUS: FOCUS_ADDRESS}
    driven = {name for name in (*fitted.names, FOCUS) if name not in fitted.second}
    axes = {name: address for name, address in addresses.items() if name in driven}
    letters = dict(zip(fitted.second, LETTERS, strict=False))
    specs = {name: AxisSpec(travel_um=travel_um[addresses[name][0]]) for name in addresses}
    chain = ZaberChain(clock, {addresses[name]: spec for name, spec in specs.items()})
    second = GrblController(clock, {letter: specs[name] for name, letter in letters.items()})
    middle_um = {
        name: (MASK_TRAVEL_UM / 2 if device == 1 else aperture_um)
        for name, (device, _) in STAGE_AXES.items()
    }
    # What Grbl calls zero is the upper end of the travel; what a micrometer does, the middle.
    zero_um = {
        name: um - (specs[name].travel_um if name in letters else 0.0)
        for name, um in middle_um.items()
        if name in fitted.names
    }
    # Without an axis that moves it, no plate is mounted before a hand puts it there.
    window_um = 2 * aperture_um
    begun_um = dict.fromkeys(STAGE_AXES, 0.0) | {"aperture_x": window_um}
    by_hand_um = {name: um for name, um in begun_um.items() if name not in fitted.names}

    def positions_um() -> dict[str, float]:
        real = {name: chain.position_um(*address) for name, address in axes.items()}
        real |= {name: second.position_um(letter) for name, letter in letters.items()}
        centred_um = middle_um if focus_um is None else middle_um | {FOCUS: focus_um}
        return {name: um - centred_um[name] for name, um in real.items()} | by_hand_um

    rng = np.random.default_rng(seed)
    optics = replace(flaws.optics, pupil=flaws.optics.pupil or default_pupil(camera))
    bench = Bench(
        camera,
        fine_scene,
        size,
        positions_um,
        window_um,
        rng,
        flaws.mounting,
        rays_per_view,
        optics,
        flaws.sensor,
        flaws.board,
        flaws.lamp,
        clock.now_s,
    )
    care = StageSettings(tolerance_um=POSITION_TOLERANCE_UM)
    stages: list[Stage] = []
    if axes:
        scale_um = AxisSpec().microstep_um
        stages.append(ZaberStage(chain.transport(), axes, scale_um, clock, care))
    if letters:
        care = replace(care, tolerance_um=GRBL_TOLERANCE_UM)
        stages.append(GrblStage(second.transport(), letters, clock, care))
    stage = stages[0] if len(stages) == 1 else CombinedStage(stages)
    noise = camera.sensor.noise
    cfa = camera.sensor.cfa_name
    shape = (size[0] // k, size[1] // k)
    black_dn, white_dn = noise.black_level_dn, noise.white_level_dn
    if fitted.camera == "u3v":
        bits = white_dn.bit_length()
        u3v = U3vCameraSimulator(
            lambda exposure_s: bench.expose(exposure_s, u3v.exposed_from_s),
            clock, shape, cfa, black_dn, bits,
        )  # fmt: skip
        simulator = u3v
        function: UsbFunction = u3v
    else:
        simulator = PtpCameraSimulator(
            bench.expose, clock, cfa, black_dn, white_dn, span=ANY_EXPOSURE
        )
        function = PtpUsbFunction(simulator)
    bus = SimulatedUsb(clock, function)

    def opened() -> CameraDevice:
        """Open the camera; one whose cable is out is plugged in first."""
        if not any(plug.function is function and plug.present for plug in bus.enumerate_devices()):
            bus.plug(function)
        if fitted.camera == "u3v":
            return open_u3v("", clock, bus)
        # The card lies in this computer's memory, hence from_card.
        return open_ptp("", clock, bus, shape, cfa, from_card=True)

    def announced(name: str) -> None:
        digest = hashlib.blake2b(f"{seed} {name}".encode(), digest_size=8).digest()
        bench.rng = np.random.default_rng(int.from_bytes(digest))

    lamp = ArduinoLamp(clock, bench.set_lamp) if fitted.lights else None
    if lamp is not None and isinstance(simulator, U3vCameraSimulator):
        simulator.lines["Line1"] = lamp.next_edge_s
    rig = SimulatedRig(
        stage,
        opened(),
        SimulatedAttendant(bench, by_hand_um, fitted.hands_um, seed),
        zero_um,
        window_um,
        clock,
        opened,
        announced,
        window_side_um(camera.views, camera.lens.aperture_cell_um),
        fixed_positions_um or {},
        lights=None if lamp is None else simulated_lights(lamp, clock),
        chain=chain,
        still=simulator,
        lamp=lamp,
    )
    return rig, bench


def open_stages(specs: Sequence[str | Mapping[str, Any]]) -> Stage:
    """Return a stage that joins all stages named, see `open_stage`; it must be closed.

    Raises AppError, also for an axis that two of them have, or a `DriverError`.
    """
    with ExitStack() as opened:
        stages = [opened.enter_context(open_stage(spec)) for spec in specs if spec != NO_STAGE]
        if len(stages) == 1:
            combined: Stage = stages[0]
        else:
            try:
                combined = CombinedStage(stages)
            except ValueError as fault:
                raise AppError(f"the rig's stages: {fault}") from fault
        opened.pop_all()
    return combined


def open_stage(spec: str | Mapping[str, Any], settings: Mapping[str, Any] | None = None) -> Stage:
    """Return the stage that `spec` names, connected; it must be closed.

    spec: `PROTOCOL:PORT` (zaber, grbl, apt, mm or a plug-in) or a YAML file, see
    `emmc_rig.bench.device_config`, or what such a file says;
    `simulated`, `simulated:grbl` or `simulated:apt` for a simulated one, whose time passes at
    once; or a rig's YAML file, for its stages. settings: single settings that replace those of the
    file. Raises AppError or a `DriverError`.
    """
    if isinstance(spec, str):
        named = stages_of_rig(spec)
        if named is not None:
            return open_stages(named)
        name, _, protocol = spec.partition(":")
        if name == SIMULATED:
            return open_simulated(protocol or "zaber", settings)[0]
        config = parse_stage(spec, settings)
    else:
        config = stage_of({**spec, **(settings or {})}, "the rig's stage")
    if isinstance(config, PluginConfig):
        care = config.stage_settings()
        return open_plug_in(
            STAGE_PLUG_INS, config.protocol, config.port, care, SYSTEM_CLOCK, **config.options
        )
    if isinstance(config, MicroManagerConfig):
        from emmc_rig.drivers.micromanager import MicroManagerStage, StageSetup, load_core

        names = (field.name for field in fields(StageSetup))
        setup = StageSetup(**{name: getattr(config, name) for name in names})
        core = load_core(config.port)
        return MicroManagerStage(core, setup, SYSTEM_CLOCK, config.stage_settings())
    transports: dict[str, Transport] = {}
    with ExitStack() as opened:

        def transport(port: str) -> Transport:
            if port not in transports:
                flow_control = isinstance(config, AptConfig)
                transports[port] = SerialTransport(port, flow_control=flow_control)
                opened.callback(transports[port].close)
            return transports[port]

        stage = _stage(config, transport, SYSTEM_CLOCK)
        opened.pop_all()
    return stage


def open_simulated(
    protocol: str, settings: Mapping[str, Any] | None = None
) -> tuple[HostStage, SimulatedController]:
    """Return a stage over simulated firmware in memory, and that firmware."""
    clock = ManualClock()
    firmware = simulated_firmware(protocol, clock)
    wire = firmware.transport()
    config = parse_stage(f"{protocol}:{SIMULATED}{SIMULATED_SCALES[protocol]}", settings)
    assert isinstance(config, SerialConfig)
    return _stage(config, lambda port: wire, clock), firmware


def simulated_firmware(protocol: str, clock: Clock) -> SimulatedController:
    """Return a simulated controller: of the rig's four axes, or the protocol's usual ones."""
    makers = {"zaber": ZaberChain, "grbl": GrblController, "apt": AptController}
    if protocol not in makers:
        raise AppError(f"no simulated stage {protocol!r}: use one of {', '.join(makers)}")
    return makers[protocol](clock)


def probe_port(port: str) -> str:
    """Return what answers on a port, in words, "" when nothing does; nothing moves.

    Where the USB adapter states the protocol, only that protocol is tried: bytes of another
    protocol may leave the device in the middle of a message. Raises a `PortError` when it cannot be
    opened.
    """
    device = find_port(port)
    guesses = {found.device: guess_of(found) for found in list_serial_ports()}
    guess = guesses.get(device, "")
    transport = SerialTransport(port, timeout_s=PROBE_TIMEOUT_S, flow_control=guess == "apt")
    with closing(transport):
        for protocol, ask in _PROBES.items():
            if guess in ("", protocol):
                try:
                    answer = ask(transport)
                    if answer:
                        return f"{protocol}: {answer}"
                except FirmwareError as error:
                    return f"{protocol}: {error}"
                except DriverError as error:
                    _log.debug("%s is no %s: %s", port, protocol, error)
    return ""


def probe_simulated(protocol: str) -> str:
    """Return what simulated firmware answers, asked through a pseudo-terminal as a port is."""
    with PtyServer(simulated_firmware(protocol, SYSTEM_CLOCK)) as server:
        return probe_port(server.port)


def _probe_zaber(transport: Transport) -> str:
    return ", ".join(
        f"device {device.address} (id {device.device_id}, serial number {device.serial_number}, "
        f"firmware {device.firmware}, axes {device.axis_count})"
        for device in find_devices(transport)
    )


def _probe_apt(transport: Transport) -> str:
    info = identify_apt(transport)
    return f"{info.model}, serial number {info.serial_number}, firmware {info.firmware}"


_PROBES = {"apt": _probe_apt, "zaber": _probe_zaber, "grbl": identify_grbl}
"""In this order: half a line of text would leave an APT controller in the middle of a message."""


def _stage(config: SerialConfig, transport: Callable[[str], Transport], clock: Clock) -> HostStage:
    """Return the stage of a configuration over transports opened by port."""
    try:
        settings = config.stage_settings()
        if isinstance(config, ZaberConfig):
            wire = transport(config.port)
            axes = config.axes or _found_axes(wire, clock)
            return ZaberStage(wire, axes, config.microstep_um, clock, settings, config.resolution)
        if isinstance(config, GrblConfig):
            return GrblStage(
                transport(config.port),
                config.axes,
                clock,
                settings,
                steps_per_mm=config.steps_per_mm,
            )
        channels = {}
        for name, axis in config.axes.items():
            known = ACTUATORS[axis.actuator]
            actuator = replace(known, counts_per_um=axis.counts_per_um or known.counts_per_um)
            wire = transport(axis.port)
            channels[name] = AptAxis(wire, actuator, axis.destination, axis.channel)
        return AptStage(channels, clock, settings)
    except DriverError:
        raise
    except ValueError as error:
        raise AppError(f"stage {config.protocol}: {error}") from error


def _found_axes(transport: Transport, clock: Clock) -> dict[str, tuple[int, int]]:
    """Return every axis on a chain: by the rig's names where it is the rig, else by number."""
    found = [
        (device.address, axis)
        for device in find_devices(transport, clock)
        for axis in range(1, device.axis_count + 1)
    ]
    if not found:
        raise TransportTimeoutError(transport.port, 0.5)
    if set(found) == set(STAGE_AXES.values()):
        return dict(STAGE_AXES)
    return {f"{device}.{axis}": (device, axis) for device, axis in found}


def open_lights(spec: Mapping[str, Any] | str, clock: Clock = SYSTEM_CLOCK) -> Lights:
    """Return the lights that a rig's file describes, or `simulated` ones; they must be closed.

    Raises AppError or a `DriverError`.
    """
    if isinstance(spec, str):
        clock = ManualClock()
        return simulated_lights(ArduinoLamp(clock), clock)
    config = lights_of(spec, "lights")
    if isinstance(config, TextLightsConfig):
        exchanges = {colour: Exchange(x.send, x.expect) for colour, x in config.colours.items()}
        wire = SerialTransport(config.port, config.limit_s, baud=config.baud)
        try:
            return TextLights(wire, exchanges, clock, config.ready, config.end)
        except BaseException:
            wire.close()
            raise
    if isinstance(config, CommandLightsConfig):
        return CommandLights(config.colours, config.limit_s)
    if isinstance(config, MicroManagerLightsConfig):
        from emmc_rig.drivers.micromanager import load_core

        states = config.colours or {"off": 0, "white": 1}
        return MicroManagerLights(load_core(config.port), config.shutter, config.device, states)
    assert isinstance(config, PluginLightsConfig)
    return open_plug_in(LIGHT_PLUG_INS, config.protocol, config.port, clock, **config.options)


def simulated_lights(lamp: ArduinoLamp, clock: Clock) -> Lights:
    """Return the lights behind a simulated lamp's wire."""
    exchanges = {colour: Exchange(**texts) for colour, texts in LAMP_EXCHANGES.items()}
    return TextLights(lamp.transport(), exchanges, clock, READY)


def open_camera(
    spec: str | Mapping[str, Any], clock: Clock = SYSTEM_CLOCK, backend: Any = None
) -> CameraDevice:
    """Open the camera that `spec` names: a driver, a colon and its address.

    The driver is named in `drivers.cameras`, or by a plug-in, or is `simulated`. A camera may also
    be named by its YAML file (`emmc_rig.bench.device_config`), or by the content of such a file.
    `backend`: of pyusb, for a simulated bus.
    Raises AppError for any other driver, or the driver's error.
    """
    choice = parse_camera(spec)
    if choice.driver == SIMULATED:
        return open_ptp("", clock, simulated_bus(clock), from_card=True)
    if choice.driver in CAMERAS:
        driver = CAMERAS[choice.driver].load()
        return driver.open_camera(choice.address, clock, backend, *_options(choice, driver))
    others = plug_ins(CAMERA_PLUG_INS)
    if choice.driver not in others:
        known = ", ".join((CAMERA_HELP, SIMULATED, *(f"{name}:" for name in sorted(others))))
        raise AppError(f"{choice.source}: no such camera driver; use {known}")
    return open_plug_in(CAMERA_PLUG_INS, choice.driver, choice.address, clock, **choice.options)


def camera_drivers() -> set[str]:
    """Return every driver that `--camera` takes; a plug-in replaces none of ours."""
    return {*CAMERAS, SIMULATED, *plug_ins(CAMERA_PLUG_INS)}


def _options(choice: CameraChoice, driver: Any) -> tuple[Any, ...]:
    """Return the arguments of a driver for the settings of a camera's YAML file, () for none.

    Raises AppError for settings that the driver does not know.
    """
    kind = getattr(driver, "OPTIONS", None)
    if kind is not None:
        given = validated(settings_of(kind), choice.options, choice.source, AppError)
        return (kind(**{name: getattr(given, name) for name in type(given).model_fields}),)
    if choice.options:
        extra = ", ".join(choice.options)
        raise AppError(f"{choice.source}: {choice.driver} takes only an address, not {extra}")
    return ()


def simulated_bus(clock: Clock) -> SimulatedUsb:
    """Return a USB bus, for pyusb, with one simulated still camera."""
    return SimulatedUsb(clock, PtpUsbFunction(scene_simulator(clock)))


SCENE_SIZE = (240, 320)


def scene_simulator(clock: Clock) -> PtpCameraSimulator:
    """Return a simulated camera with a plain lens before a built-in scene."""
    sensor = Sensor(cfa="rggb")
    noise, rng = sensor.noise, np.random.default_rng(0)
    view = open_scene("deep-occlusions", SCENE_SIZE, (1, 1)).light_field[0, 0]
    tile = cfa_tile(sensor.cfa)
    repeats = (-(-SCENE_SIZE[0] // tile.shape[0]), -(-SCENE_SIZE[1] // tile.shape[1]), 1)
    colours = np.tile(tile, repeats)[: SCENE_SIZE[0], : SCENE_SIZE[1]]
    readings = (view * colours).sum(axis=2)
    return PtpCameraSimulator(
        lambda exposure_s: noise.expose_dn(readings, exposure_s, 1.0, rng),
        clock,
        sensor.cfa_name,
        noise.black_level_dn,
        noise.white_level_dn,
        exposures=THIRD_STOPS,
    )
