"""The original Grbl 1.1h, compiled for this computer, from the folder in EMMC_PEER_FILES.

The program behind the port moves a carriage with limit switches at both ends of its travel. It logs
the carriage's true place, which the tests compare with what our driver reads and moves.
"""

import os
import re
import shutil
import subprocess
from contextlib import closing, contextmanager, suppress
from pathlib import Path

import pytest
import yaml
from programs import done, refused, wait_until
from stage_rigs import after_first_sleep

from emmc_rig.drivers import grbl_codec as codec
from emmc_rig.drivers.clock import SYSTEM_CLOCK, SystemClock
from emmc_rig.drivers.errors import (
    AxisFaultError,
    LimitExceededError,
    LostPositionError,
    NotHomedError,
    PortError,
    PositionMismatchError,
    PressedSwitchError,
    StalledError,
    TransportTimeoutError,
)
from emmc_rig.drivers.grbl import GrblStage, identify
from emmc_rig.drivers.stage import Direction, StageSettings
from emmc_rig.drivers.transport import SerialTransport
from emmc_rig.session.journal import FrameEntry, of_kind
from emmc_rig.session.session import Session
from emmc_rig.simulators.clock import ManualClock
from emmc_rig.simulators.grbl import GrblController

pytestmark = [
    pytest.mark.peers,
    pytest.mark.slow,
    pytest.mark.timing(
        "interrupts of the compiled firmware are not atomic: rarely it loses a flag"
    ),
]

AXES = {"x": "X", "y": "Y"}
STEPS_PER_MM = 200
SETTINGS = {22: 1, 20: 1, 21: 1, 23: 0, 24: 300, 25: 1200, 27: 1, 10: 1, 13: 0}
OF_AXES = {100: STEPS_PER_MM, 110: 1500, 120: 200, 130: 70}
"""70 mm of travel: more than the 63 mm between the switches, as where `$130` was never set."""
ZERO_MM = (3.0, 4.0, 5.0)
"""Where the switches at the upper ends are, on the scale of the log; Grbl's machine zero."""
LOWER_SWITCH_MM = -60.0
PULL_OFF_MM = 1.0
CARE = StageSettings(tolerance_um=5.0)
SPEED = "4"
"""Times real time."""
NEAR_MM = 0.02
"""A few steps, and the rounding of the log."""


class Controller:
    """A Grbl with its carriage and a power switch; port: the serial device."""

    def __init__(self, program, folder):
        self._program, self._folder = program, folder
        self.port, self._log = folder / "port", folder / "places"
        self._process = None

    def start(self, at_mm=(-20.0, -15.0, -10.0), **environment):
        """Power it with the carriage at a place."""
        steps = ",".join(f"{mm * STEPS_PER_MM:.0f}" for mm in at_mm)
        self.port.unlink(missing_ok=True)
        self._process = subprocess.Popen(
            [self._program],
            env={"LINK": str(self.port), "STEPLOG": str(self._log), "SPEED": SPEED, "PHYS": steps}
            | environment,
            cwd=self._folder,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        wait_until(self.port.exists)

    def stop(self):
        """Take its power away; the port goes with it."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def places_mm(self):
        """Return every place that was logged, x, y and z; the last line may be half written."""
        lines = self._log.read_text().splitlines()[:-1] if self._log.exists() else []
        return [tuple(float(number) for number in line.split()[1:4]) for line in lines]

    def true_mm(self):
        """Return the place now: that of the next lines of the log."""
        before = len(self.places_mm())
        wait_until(lambda: len(self.places_mm()) > before + 1)
        return self.places_mm()[-1]

    def machine_mm(self):
        """Return the true place on the scale of Grbl's machine positions."""
        return [mm - zero for mm, zero in zip(self.true_mm(), ZERO_MM, strict=True)]

    def say(self, *lines):
        """Send lines as another program would; each must be accepted."""
        with closing(opened(self.port)) as port:

            def answered(begins, again=b""):
                with suppress(TransportTimeoutError):
                    return port.read_until(b"\n").startswith(begins)
                port.write(again)
                return False

            wait_until(lambda: answered(b"<", again=codec.STATUS_QUERY))
            for line in lines:
                port.write(line.encode() + b"\n")
                wait_until(lambda: answered(b"ok"))


def opened(port):
    return SerialTransport(str(port), timeout_s=0.5, flow_control=False)


@contextmanager
def powered(controller):
    """A controller that is off in the end, whatever happens."""
    try:
        yield controller
    finally:
        controller.stop()


@pytest.fixture(scope="module")
def build(tmp_path_factory):
    """The program, and the memory of its settings, for every test of this file."""
    shared = os.environ.get("EMMC_PEER_FILES", "")
    script = Path(shared) / "firmware/grbl/build.sh"
    if not (shared and script.is_file() and shutil.which("gcc")):
        pytest.skip("needs gcc, and firmware/grbl in the folder that EMMC_PEER_FILES names")
    folder = tmp_path_factory.mktemp("grbl")
    subprocess.run(["bash", script, folder / "grbl"], check=True, capture_output=True)
    axes = {first + n: of for first, of in OF_AXES.items() for n in range(3)}
    with powered(Controller(folder / "grbl", folder)) as controller:
        controller.start()
        controller.say(*(f"${number}={value}" for number, value in (axes | SETTINGS).items()))
    return folder


@pytest.fixture
def controller(build, tmp_path):
    """A controller that is set up, and off."""
    (tmp_path / "firmware").mkdir()
    shutil.copy(build / "EEPROM.DAT", tmp_path / "firmware")
    with powered(Controller(build / "grbl", tmp_path / "firmware")) as made:
        yield made


@contextmanager
def staged(controller, axes=AXES):
    """A stage on the port; homed."""
    with closing(opened(controller.port)) as port:
        stage = GrblStage(port, axes, SYSTEM_CLOCK, CARE)
        try:
            stage.home()
        except StalledError:  # interrupts on this computer are not atomic: ALARM:9 now and then
            stage.home()
        yield stage


def test_the_firmware_as_it_is_shipped_homes_moves_and_is_homed_anew_by_each_connection(
    controller, caplog
):
    controller.start()
    with closing(opened(controller.port)) as port:
        assert identify(port) == "version 1.1h.20190830:, options V,15,128"
        stage = GrblStage(port, AXES, SYSTEM_CLOCK, CARE)
        with pytest.raises(NotHomedError):
            stage.move_to_um({"x": -5000.0})
        stage.home(["x"])
        assert "homes all axes together: x, y" in caplog.text
        assert controller.machine_mm() == pytest.approx([-PULL_OFF_MM] * 3, abs=NEAR_MM)
        assert stage.position_um("y") == pytest.approx(-1000.0, abs=5)
        targets_um = {"x": -5000.0, "y": -3000.0}
        assert stage.move_to_um(targets_um) == pytest.approx(targets_um, abs=5)
        assert controller.machine_mm()[:2] == pytest.approx([-5.0, -3.0], abs=NEAR_MM)
        with pytest.raises(LimitExceededError):
            stage.move_to_um({"x": 0.0})
    with closing(opened(controller.port)) as port:
        # Idle also follows `$X`, so this state is no proof of homing.
        assert not GrblStage(port, AXES, SYSTEM_CLOCK, CARE).is_homed("x")


ASKED = (
    "$J=G91X1F100", "G0X1", "$130=0x", "$999=1", "$C1", "$X", "$J=G91X1", "$J=X5F100",
    "$J=G53X-90F100", "$J=M3X1F100", "G1X-1", "$HX",
)  # fmt: skip
"""Lines to a controller that was not homed; after the last, Grbl's state is that of homing."""


def test_the_simulated_firmware_refuses_what_the_original_does(controller):
    """Homing of one axis above all, which a kinder simulator would allow."""
    controller.start()
    with closing(opened(controller.port)) as port:
        identify(port)
        original = [answer_of(port, line) for line in ASKED]
    clock = ManualClock()
    settings = SETTINGS | {first + n: of for first, of in OF_AXES.items() for n in range(3)}
    simulated = GrblController(clock, settings=settings).transport()
    identify(simulated, clock)
    assert [answer_of(simulated, line) for line in ASKED] == original


def answer_of(port, line):
    """Return a line and the error or ok by which it is answered."""
    port.write(line.encode() + b"\n")
    while not (answer := port.read_until(b"\n").strip()).startswith((b"ok", b"error")):
        pass
    return line, answer.decode()


def test_a_soft_limit_alarm_keeps_the_position_and_a_reset_loses_it(controller):
    controller.start()
    with staged(controller) as stage:
        stage._transport.write(b"G53G0X5\n")
        with pytest.raises(AxisFaultError, match="position kept") as caught:
            stage.move_by_um({"x": -100.0})
        assert not caught.value.loses_position
        stage.home()
        stage._start_moves({"x": -30_000.0}, {"x": -1000.0})
        stage._transport.write(codec.SOFT_RESET)
        with pytest.raises(LostPositionError):
            stage.wait_until_settled()
        assert not stage.is_homed("x")


@pytest.mark.parametrize(
    ("byte", "fault"),
    [(b"!", PositionMismatchError), (b"\x84", AxisFaultError)],
    ids=["hold", "door"],
)
def test_a_move_that_is_held_is_no_success_and_homing_goes_on_from_there(
    controller, monkeypatch, byte, fault
):
    controller.start()
    with staged(controller) as stage:
        clock = stage._clock = SystemClock()
        after_first_sleep(monkeypatch, clock, 0.0, lambda: stage._transport.write(byte))
        with pytest.raises(fault):
            stage.move_to_um({"x": -40_000.0})
        at_mm = controller.machine_mm()[0]
        assert controller.machine_mm()[0] == at_mm > -39.0
        stage.home()
        assert stage.move_to_um({"x": -2000.0})["x"] == pytest.approx(-2000.0, abs=5)


def test_unplugged_in_a_move_it_is_reconnected_and_homed_anew(controller):
    controller.start()
    with staged(controller) as stage:
        stage._start_moves({"x": -30_000.0}, {"x": -1000.0})
        controller.stop()
        with pytest.raises(PortError):
            stage.wait_until_settled()
        controller.start(at_mm=controller.places_mm()[-1])
        stage.reconnect()
        with pytest.raises(NotHomedError):
            stage.move_to_um({"x": -2000.0})
        stage.home()
        assert stage.move_to_um({"x": -2000.0})["x"] == pytest.approx(-2000.0, abs=5)
        assert controller.machine_mm()[0] == pytest.approx(-2.0, abs=NEAR_MM)


def test_from_a_hard_limit_nothing_drives_deeper_and_a_step_leads_off_the_switch(controller):
    controller.start()
    with staged(controller) as stage:
        with pytest.raises(PressedSwitchError) as hit:
            stage.move_to_um({"x": -65_000.0})
        assert (hit.value.axis, hit.value.away) == ("x", "up")
        for _ in range(3):
            with pytest.raises(PressedSwitchError):
                stage.home()
        assert controller.true_mm()[0] == pytest.approx(LOWER_SWITCH_MM, abs=NEAR_MM)
        # Outside the travel, by the position after a reset, where soft limits refuse a jog.
        assert stage.move_off_switch("x", Direction.UP, 500.0)
        assert stage.pressed_switches() == {}
        assert controller.true_mm()[0] == pytest.approx(LOWER_SWITCH_MM + 0.5, abs=NEAR_MM)
        stage.home()
    assert min(x for x, _, _ in controller.places_mm()) >= LOWER_SWITCH_MM - NEAR_MM


def advised(text):
    """Return the commands that a text advises."""
    return [words.split() for words in re.findall(r"`emmc-rig ([^`]*)`", text)]


@pytest.mark.parametrize(("at_mm", "away", "moved"), [(-61.2, "up", "+1.5"), (3.8, "down", "-1")])
def test_every_advice_from_a_pressed_switch_leads_off_it_within_three_commands(
    run, controller, at_mm, away, moved
):
    controller.start(at_mm=(at_mm, -15.0, -10.0))
    stage = f"grbl:{controller.port}"
    (free,) = advised(refused(run("devices", "jog", "--stage", stage, "x", -100)))
    assert free == ["devices", "free", "x", "--stage", stage]
    assert f"--direction {away}" in refused(run(*free, "--yes"))
    out = done(run(*free, "--yes", "--direction", away))
    places_mm = [x for x, _, _ in controller.places_mm()]
    deepest_mm = min(places_mm) if away == "up" else max(places_mm)
    assert deepest_mm == pytest.approx(at_mm, abs=NEAR_MM)
    assert f"after {moved} mm" in out
    (home,) = advised(out)
    done(run(*home))
    assert controller.machine_mm() == pytest.approx([-PULL_OFF_MM] * 3, abs=NEAR_MM)


def test_a_switch_that_is_stuck_is_named_and_nothing_moves_far(run, controller):
    controller.start(STUCK="1")
    stage = f"grbl:{controller.port}"
    assert "y reports a fault, it stands" in refused(run("devices", "home", "--stage", stage))
    free = ("devices", "free", "y", "--direction", "down", "--yes", "--stage", stage)
    assert "still pressed after -3 mm" in refused(run(*free))
    assert controller.true_mm()[1] == pytest.approx(-18.0, abs=NEAR_MM)


def capture(run, controller, places_um):
    """Run the ordinary command for shots at these places of mask_x and mask_y, from their zero."""
    rig = {
        "stage": {
            "protocol": "grbl", "port": str(controller.port),
            "axes": {"mask_x": "X", "mask_y": "Y"}, "speeds_um_s": {"mask_x": 20_000},
        },
        "camera": "simulated", "by_hand": False, "zero_um": {"mask_x": -20_000, "mask_y": -20_000},
    }  # fmt: skip
    shots = [{"exposure_s": 0.01, "mask_um": list(place)} for place in places_um]
    plan = {"camera": "rgbw-bayer-1shot", "shots": shots, "whiteboards": None, "darks": None}
    Path("rig.yaml").write_text(yaml.safe_dump(rig))
    Path("plan.yaml").write_text(yaml.safe_dump(plan))
    return run("capture", "plan.yaml", "--rig", "rig.yaml", "--out", "session")


def test_seventeen_frames_are_taken_where_the_carriage_really_stands(run, controller):
    controller.start()
    places_um = [(270 * n % 1000, 162 * n % 700) for n in range(17)]
    done(capture(run, controller, places_um))
    stored = of_kind(Session(Path("session")).journal.entries, FrameEntry)
    assert len(stored) == 17
    true_um = {(round(x * 1e3 - 3000), round(y * 1e3 - 4000)) for x, y, _ in controller.places_mm()}
    for entry in stored:
        read_um = entry.read_um["mask_x"] - 20_000, entry.read_um["mask_y"] - 20_000
        assert any(abs(read_um[0] - x) <= 6 and abs(read_um[1] - y) <= 6 for x, y in true_um), entry


def test_a_capture_that_runs_into_a_switch_stops_there_and_does_not_home_into_it(run, controller):
    controller.start()
    line = refused(capture(run, controller, [(-45_000, 0)]))
    assert line.endswith("`emmc-rig devices free mask_x --direction up --stage rig.yaml`")
    # The same command again begins on the switch, and homes as little.
    again = refused(capture(run, controller, [(-45_000, 0)]))
    assert again.endswith("`emmc-rig devices free mask_x --stage rig.yaml`")
    x_mm = [x for x, _, _ in controller.places_mm()]
    hit = next(place for place, mm in enumerate(x_mm) if mm < LOWER_SWITCH_MM + NEAR_MM)
    assert x_mm[hit:] == pytest.approx([LOWER_SWITCH_MM] * len(x_mm[hit:]), abs=NEAR_MM)
    (free,) = advised(line)
    done(run(*free, "--yes"))
    assert controller.true_mm()[0] == pytest.approx(LOWER_SWITCH_MM + 0.5, abs=NEAR_MM)
