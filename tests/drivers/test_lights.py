"""Lights: the bytes sent, the answers that confirm a colour, and missing answers."""

import math
import sys
from contextlib import closing

import pytest
from tcp_server import TcpServer

from emmc_rig.bench.hardware import open_lights, simulated_lights
from emmc_rig.drivers.clock import SYSTEM_CLOCK
from emmc_rig.drivers.errors import LightError, PortBusyError, PortNotFoundError
from emmc_rig.drivers.lights import Exchange, MicroManagerLights, TextLights
from emmc_rig.errors import AppError
from emmc_rig.simulators import lamp as lamps
from emmc_rig.simulators.clock import ManualClock
from emmc_rig.simulators.lamp import ANSWER_S, BOOT_S, READY, ArduinoLamp
from emmc_rig.simulators.wire import PtyServer

EXCHANGES = {colour: Exchange(f"{colour}\n", f"ok {colour}") for colour in ("off", "white", "red")}


class Bench:
    """A simulated lamp, its driver, and the colours that the bench was lit in."""

    def __init__(self, ready=READY):
        self.clock, self.seen = ManualClock(), []
        self.lamp = ArduinoLamp(self.clock, self.seen.append)
        self.sent = []
        feed = self.lamp.feed
        self.lamp.feed = lambda data: (self.sent.append(data), feed(data))[1]
        self.lights = TextLights(self.lamp.transport(), EXCHANGES, self.clock, ready)


def test_a_colour_is_one_line_and_is_lit_when_the_late_answer_has_come():
    bench = Bench()
    assert bench.clock.now_s() == pytest.approx(BOOT_S)
    assert bench.lights.set("red") == "ok red"
    assert bench.seen[-1] == "red"
    assert bench.sent == [b"red\n"]
    assert bench.clock.now_s() == pytest.approx(BOOT_S + ANSWER_S)


def test_bytes_that_an_arduino_loses_while_it_starts_are_sent_again():
    bench = Bench(ready="")
    assert bench.lights.set("white") == "ok white"
    assert bench.sent == [b"white\n", b"white\n"]
    assert bench.seen[-1] == "white"


def test_a_controller_that_never_says_that_it_started_is_used_after_the_limit():
    bench = Bench(ready="hello")
    assert bench.lights.set("white") == "ok white"
    assert bench.sent == [b"white\n"]


@pytest.mark.parametrize("fault", ["drop_command", "drop_reply", "garble_reply", "late_reply"])
def test_a_single_fault_on_the_wire_is_met_by_asking_again(fault):
    bench = Bench()
    bench.lamp.late_by_s = 5.0
    bench.lamp.faults.inject(fault)
    assert bench.lights.set("white") == "ok white"
    assert bench.lights.set("off") == "ok off"
    assert bench.seen[-1] == "off"


def test_a_late_answer_to_another_colour_confirms_nothing():
    bench = Bench()
    bench.lamp.faults.inject("duplicate_reply")
    bench.lights.set("white")
    bench.lamp.faults.inject("drop_reply", math.inf)
    with pytest.raises(LightError, match=r"the lights \(simulator\) cannot be set to red"):
        bench.lights.set("red")


def test_silence_another_answer_and_another_colour_are_one_line_each():
    bench = Bench()
    bench.lamp.faults.inject("drop_command", math.inf)
    with pytest.raises(LightError, match=r"answered nothing within 3 s: check their power"):
        bench.lights.set("white")
    bench.lamp.faults.clear()
    wrong = EXCHANGES | {"white": Exchange("light\n", "ok white")}
    with pytest.raises(LightError, match="answered 'error light' instead of 'ok white': check the"):
        TextLights(bench.lamp.transport(), wrong, bench.clock, READY).set("white")
    with pytest.raises(LightError, match="have no blue, only off, white, red: name it under"):
        bench.lights.set("blue")


def test_an_unplugged_lamp_is_named_and_comes_back():
    bench = Bench()
    bench.lamp.unplug()
    for act in (lambda: bench.lights.set("white"), bench.lights.reconnect):
        with pytest.raises(LightError, match=r"the lights \(simulator\) cannot .* cable") as caught:
            act()
        assert "home" not in str(caught.value)
    bench.lamp.replug(power_lost=True)
    bench.lights.reconnect()
    assert bench.lights.set("white") == "ok white"


@pytest.mark.parametrize("server", [PtyServer, TcpServer])
def test_a_serial_line_and_tcp_of_the_rigs_file_and_who_holds_them(server, monkeypatch):
    monkeypatch.setattr(lamps, "BOOT_S", 0.0)
    monkeypatch.setattr(lamps, "ANSWER_S", 0.01)
    with server(ArduinoLamp(SYSTEM_CLOCK)) as served:
        spec = {"protocol": "text", "port": served.port, "colours": lamps.LAMP_EXCHANGES}
        with closing(open_lights(spec)) as lights:
            assert lights.set("blue") == "ok blue"
            with pytest.raises(PortBusyError, match="is held by"):
                open_lights(spec | {"ready": READY})
            assert lights.set("off") == "ok off"
    with pytest.raises(PortNotFoundError):
        open_lights(spec | {"port": "/dev/no-such-lamp"})


def test_a_program_confirms_by_its_exit_code_within_its_time():
    say = [sys.executable, "-c"]
    lights = open_lights(
        {
            "protocol": "command",
            "limit_s": 5,
            "colours": {
                False: [*say, "pass"],  # as YAML reads a bare off
                "white": [*say, "raise SystemExit('no lamp')"],
                "red": ["no-such-program"],
            },
        }
    )
    assert lights.set("off") == "exit code 0"
    with pytest.raises(LightError, match="exit code 1: no lamp: run that command by hand"):
        lights.set("white")
    with pytest.raises(LightError, match="by no-such-program: No such file or directory"):
        lights.set("red")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"colours": {"off": {"send": "o"}}}, r"colours\.off\.expect"),
        ({"colours": {"off": {"send": "o", "expct": "k"}}}, "did you mean 'expect'"),
        (
            {"colours": {"pink": {"send": "o", "expect": "k"}}},
            "pink is not a colour of the lights: use",
        ),
        ({"colours": {"white": {"send": "o", "expect": "k"}}}, "under off:"),
        ({"bauds": 9600}, "did you mean 'baud'"),
        ({"protocol": "txt"}, "must be one of text, command, mm"),
        ({"protocol": "mm", "colours": {}}, "write shutter: or device:"),
        ({"protocol": "mm", "device": "LED", "colours": {}}, "go together"),
    ],
)
def test_wrong_settings_are_one_line(change, message):
    colours = {"off": {"send": "o", "expect": "k"}}
    with pytest.raises(AppError, match=message) as caught:
        open_lights({"protocol": "text", "port": "x", "colours": colours} | change)
    assert "\n" not in str(caught.value)


def test_micromanager_sets_and_reads_back_shutters_and_state_devices():
    pytest.importorskip("pymmcore_plus", reason="the extra `micromanager` is not installed")
    pytest.importorskip("mm_test_adapters", reason="the extra `micromanager` is not installed")
    config = {"protocol": "mm", "port": "MMConfig_demo.cfg"}
    led = {"device": "LED", "colours": {"off": "Closed", "red": "635nm", "white": 1}}
    with closing(open_lights({**config, **led, "shutter": "LED Shutter"})) as lights:
        assert isinstance(lights, MicroManagerLights)
        core = lights._loaded.core
        assert lights.set("red") == "635nm, open"
        assert (core.getStateLabel("LED"), core.getShutterOpen("LED Shutter")) == ("635nm", True)
        # A frame that is exposed opens no shutter.
        assert not core.getAutoShutter()
        assert lights.set("off") == "Closed, closed"
        with pytest.raises(LightError, match="no device 'Lamp': name one of"):
            open_lights({**config, "shutter": "Lamp"})
    with closing(open_lights({**config, "shutter": "White Light Shutter"})) as lights:
        assert lights.set("white") == "open"


def test_simulated_lights_know_every_colour_of_a_plan():
    clock = ManualClock()
    seen = []
    lights = simulated_lights(ArduinoLamp(clock, seen.append), clock)
    for colour in lights.colours:
        lights.set(colour)
        assert seen[-1] == colour
