"""Codecs and whole drivers against bytes that nobody meant to send.

Never a hang, never an exception outside the drivers' own, never a position that was not read.
"""

import random
import re

import pytest
from fuzzing import DRIVER_CASES, FUZZ, damage, errors_of_the_driver_allowed, fuzz
from hypothesis import strategies as st

from emmc_rig.drivers import apt_codec
from emmc_rig.drivers.apt import ACTUATORS, AptAxis, AptStage
from emmc_rig.drivers.grbl import GrblStage
from emmc_rig.drivers.stage import StageSettings
from emmc_rig.drivers.zaber import ZaberStage
from emmc_rig.simulators.apt import COUNTS_PER_UM, Z825, AptController
from emmc_rig.simulators.clock import ManualClock
from emmc_rig.simulators.grbl import GrblController
from emmc_rig.simulators.wire import MemoryTransport
from emmc_rig.simulators.zaber import AxisSpec, ZaberChain

Z825_MOTOR = ACTUATORS["z825"]
CARELESS = StageSettings(poll_s=0.2, settle_s=0.0)
MOST_WRITES = 3000
"""A driver that writes more often for one call counts as hung."""
SIMULATED_LIMIT_S = 600.0

ZABER_LINES = (
    b"@01 1 10 OK BUSY -- 0:E6\r\n",
    b"@02 1 07 OK IDLE WR 02 WR WH\r\n",
    b"@01 2 99 RJ IDLE -- BADDATA\r\n",
    b"!01 1 IDLE FS\r\n",
    b"#01 0 03 ranges: 0 to 5\r\n",
)
GRBL_LINES = (
    b"ok\r\n",
    b"error:15\r\n",
    b"ALARM:1\r\n",
    b"Grbl 1.1h ['$' for help]\r\n",
    b"$110=500.000\r\n",
    b"[MSG:Reset to continue]\r\n",
    b">G54G20:ok\r\n",
    b"<Idle|MPos:0.000,-10.000,5.000|FS:0,0|WCO:0.000,1.551,5.664>\r\n",
    b"<Hold:1|WPos:-2.500,0.000,11.000|Bf:15,128|FS:500,8000|Pn:XZ>\r\n",
)
APT_MESSAGES = (
    bytes.fromhex("44 04 01 00 01 50"),
    bytes.fromhex("91 04 0e 00 81 50 01 00 40 0d 03 00 fe ff 00 00 10 05 00 80"),
    bytes.fromhex("15 04 0e 00 81 50 01 00 00 00 00 00 05 01 00 00 87 b5 0b 00"),
    bytes.fromhex("81 00 44 00 81 50") + bytes(68),
)


PARTS = DRIVER_CASES // 4
"""A whole driver answers in the time of many codec calls."""


class Liar:
    """Firmware whose answers pass through hands that spoil them."""

    def __init__(self, firmware, clock):
        self.firmware = firmware
        self.clock = clock
        self.moods = []
        self.random = random.Random(0)
        self.heard = b""
        self.writes = 0
        self.unplugged = False
        self.plugs = 1
        self._old = b""

    def lie(self, seed, moods):
        self.random = random.Random(seed)
        self.moods = list(moods)

    def feed(self, data):
        self.writes += 1
        assert self.writes < MOST_WRITES, "hung"
        assert self.clock.now_s() < SIMULATED_LIMIT_S, "hung"
        return self._pass_on(self.firmware.feed(data), self.moods.pop(0) if self.moods else "t")

    def due(self):
        return self._pass_on(self.firmware.due(), "t")

    def next_due_s(self):
        return self.firmware.next_due_s()

    def _pass_on(self, answer, mood):
        if mood == "n":  # nothing
            answer = b""
        elif mood == "r":  # random bytes
            answer = self.random.randbytes(self.random.randrange(60))
        elif mood == "s":  # spoilt
            answer = damage(answer, self.random.random())
        elif mood == "o":  # an older answer
            answer = self._old
        elif mood == "d":  # twice
            answer += answer
        elif mood == "l":  # lines of the protocols, of whatever kind
            answer = self.random.choice(ZABER_LINES + GRBL_LINES + APT_MESSAGES)
        if answer and mood == "t":
            self._old = answer
        self.heard += answer
        return answer


MOODS = st.lists(st.sampled_from("ttnrsodl"), max_size=30)
STEPS = ("position", "homed", "move", "jog", "stop", "home", "settle")
PLANS = st.lists(st.sampled_from(STEPS), max_size=4)


def quick(spec):
    """The axis, so quick that a test spends its time on answers and not on waiting."""
    return AxisSpec(
        travel_um=5000.0,
        microstep_um=spec.microstep_um,
        max_speed_um_s=50_000.0,
        acceleration_um_s2=1e7,
        start_um=300.0,
    )


def zaber(clock):
    liar = Liar(ZaberChain(clock, {(1, 1): quick(AxisSpec())}), clock)
    wire = MemoryTransport(liar, clock)
    return liar, ZaberStage(wire, {"x": (1, 1)}, AxisSpec().microstep_um, clock, CARELESS)


def grbl(clock):
    liar = Liar(GrblController(clock, {"X": quick(AxisSpec(microstep_um=0.5))}), clock)
    return liar, GrblStage(MemoryTransport(liar, clock), {"x": "X"}, clock, CARELESS)


def apt(clock):
    liar = Liar(AptController(clock, {apt_codec.USB_UNIT: quick(Z825)}), clock)
    return liar, AptStage({"x": AptAxis(MemoryTransport(liar, clock), Z825_MOTOR)}, clock, CARELESS)


def zaber_positions_um(heard):
    found = re.findall(rb"@\d\d \d (?:\d\d )?OK \S+ \S\S (-?\d+(?:\.\d+)?)", heard)
    return [float(number) * AxisSpec().microstep_um for number in found]


def grbl_positions_um(heard):
    found = re.findall(rb"[MW](?:Pos|CO):(-?[\d.]+)", heard)
    return [float(number) * 1e3 for number in found if re.fullmatch(rb"-?\d+(\.\d+)?", number)]


def apt_positions_um(heard):
    places = [place.start() for place in re.finditer(rb"(?=\x91\x04\x0e\x00)", heard)]
    return [
        int.from_bytes(heard[place + 8 : place + 12], "little", signed=True) / COUNTS_PER_UM
        for place in places
    ]


DRIVERS = {
    "zaber": (zaber, zaber_positions_um),
    "grbl": (grbl, grbl_positions_um),
    "apt": (apt, apt_positions_um),
}


@pytest.mark.slow
@pytest.mark.parametrize("protocol", DRIVERS)
def test_no_answers_make_a_driver_hang_fail_or_tell_a_position_that_it_did_not_read(protocol):
    make, positions_um = DRIVERS[protocol]
    reported = []

    def check(seed, moods, plan):
        clock = ManualClock()
        liar, stage = make(clock)
        stage.home()
        low_um, high_um = stage.limits_um("x")
        middle_um = (low_um + high_um) / 2
        calls = {
            "position": lambda: stage.position_um("x"),
            "homed": lambda: stage.is_homed("x"),
            "move": lambda: stage.move_to_um({"x": middle_um})["x"],
            "jog": lambda: stage.move_by_um({"x": 30.0})["x"],
            "stop": stage.stop,
            "home": stage.home,
            "settle": stage.wait_until_settled,
        }
        liar.lie(seed, moods)
        for name in plan:
            liar.heard, liar.writes = b"", 0
            with errors_of_the_driver_allowed():
                answer = calls[name]()
                if name in ("position", "move", "jog"):
                    reported.append(answer)
                    read_um = positions_um(liar.heard)
                    assert any(abs(answer - um) < 1e-6 for um in read_um), (answer, read_um)

    fuzz(check, st.integers(0, 2**32), MOODS, PLANS, cases=PARTS)

    assert len(reported) > PARTS * FUZZ / 20


@pytest.mark.parametrize("protocol", DRIVERS)
def test_no_answers_make_connecting_hang_or_fail_outside_the_drivers_errors(
    protocol,
):
    makers = {"zaber": ZaberChain, "grbl": GrblController, "apt": AptController}
    connected = []

    def check(seed, moods):
        clock = ManualClock()
        liar = Liar(makers[protocol](clock), clock)
        liar.lie(seed, moods)
        wire = MemoryTransport(liar, clock)
        with errors_of_the_driver_allowed():
            if protocol == "zaber":
                stage = ZaberStage(wire, {"x": (1, 1)}, AxisSpec().microstep_um, clock)
            elif protocol == "grbl":
                stage = GrblStage(wire, {"x": "X"}, clock)
            else:
                stage = AptStage({"x": AptAxis(wire, Z825_MOTOR)}, clock)
            connected.append(stage)
            low_um, high_um = stage.limits_um("x")
            assert low_um < high_um

    fuzz(check, st.integers(0, 2**32), MOODS, cases=PARTS)

    assert connected
