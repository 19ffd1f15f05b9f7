"""Hostile cameras: whatever bytes come, however they are cut, the driver ends in its own errors."""

import random
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import pytest
from fuzzing import damage, errors_of_the_driver_allowed, fuzz
from hypothesis import strategies as st

from emmc_rig.drivers import ptp_codec as codec
from emmc_rig.drivers.dng import encode_dng
from emmc_rig.drivers.errors import DriverError
from emmc_rig.drivers.ptp import PtpCamera, PtpSession, PtpSettings
from emmc_rig.drivers.ptp_usb import PTP_INTERFACE, PtpUsb
from emmc_rig.drivers.raw import decode_raw
from emmc_rig.drivers.usb import open_device
from emmc_rig.simulators.clock import ManualClock
from emmc_rig.simulators.ptp import PtpCameraSimulator, PtpUsbFunction
from emmc_rig.simulators.usb import SimulatedUsb, StallError, UnpluggedError

SHAPE = (24, 26)
MOSAIC = np.random.default_rng(0).integers(0, 4095, SHAPE, dtype=np.uint16)
DNG = encode_dng(MOSAIC, "rggb", 64, 4095, 0.01)
PACKET = 64
MOST_TRANSFERS = 100_000
"""More than any honest session takes by far: beyond it the driver is caught in a loop."""


def check_raw(seed):
    with errors_of_the_driver_allowed():
        decode_raw(damage(DNG, seed))


@pytest.mark.slow
def test_a_damaged_raw_file_is_refused_in_one_line_or_read():
    fuzz(check_raw, st.integers(0, 2**63))


@dataclass
class Mischief:
    """What happens to the pieces that a camera sends: a fault with some probability."""

    seed: int
    probability: float
    garbage: bool


class HostileFunction(PtpUsbFunction):
    """A camera whose answers and events are damaged, lost, doubled, cut anew or never end."""

    def __init__(self, camera, mischief):
        super().__init__(camera, PACKET)
        self._random = random.Random(mischief.seed)
        self._mischief = mischief
        self._held = []
        self.transfers = 0

    def bulk_in(self, endpoint, length, timeout_s):
        self.transfers += 1
        assert self.transfers < MOST_TRANSFERS, "the driver never ends"
        generator = self._random
        if self._held:
            self._ends = True
            return self._held.pop(0)
        if self._mischief.garbage:
            if generator.random() < 0.3:
                return None
            return generator.randbytes(generator.choice((0, 4, 12, 16, 64, 200)))
        piece = super().bulk_in(endpoint, length, timeout_s)
        if piece is None or generator.random() > self._mischief.probability:
            return piece
        data = bytes(piece)
        match generator.randrange(10):
            case 0:
                return None
            case 1:
                self._held.append(data)
            case 2:
                at = generator.randrange(len(data) + 1)
                self._held.append(data[at:])
                return data[:at]
            case 3:
                self._held.append(b"")
            case 4:
                self._held.append(generator.randbytes(generator.randrange(40)))
            case 5:
                raise StallError
            case 6 if generator.random() < 0.2:
                raise UnpluggedError
            case 7:
                self._ends = not self._ends
            case _:
                return damage(data, generator.randrange(1 << 32))
        return data

    def interrupt(self, endpoint, length, timeout_s):
        self.transfers += 1
        assert self.transfers < MOST_TRANSFERS, "the driver never ends"
        event = super().interrupt(endpoint, length, timeout_s)
        if event is None or self._random.random() > self._mischief.probability:
            return event
        return damage(event, self._random.randrange(1 << 32))[:length]

    def control(self, request_type, request, value, index, data):
        if self._random.random() < self._mischief.probability:
            return self._random.randbytes(self._random.randrange(8))
        return super().control(request_type, request, value, index, data)


@pytest.mark.slow
def test_a_hostile_camera_gives_frames_or_errors_of_the_driver_in_bounded_time():
    outcomes = {"case": 0, "success": 0}

    def check(seed, probability, garbage):
        clock = ManualClock()
        simulator = PtpCameraSimulator(lambda exposure_s: MOSAIC, clock)
        function = HostileFunction(simulator, Mischief(seed, probability, garbage))
        bus = SimulatedUsb(clock, function)
        patience = PtpSettings(busy_limit_s=2.0, capture_limit_s=3.0)
        outcomes["case"] += 1
        with errors_of_the_driver_allowed():
            device = open_device(PTP_INTERFACE, backend=bus)
            with PtpCamera(PtpSession(PtpUsb(device, clock), clock, patience)) as camera:
                for exposure_s in (0.01, 0.5):
                    with suppress(DriverError):
                        camera.set_exposure_s(exposure_s)
                        camera.set_gain(2.0)
                    assert camera.snap().mosaic.dtype == np.uint16
            outcomes["success"] += 1
        assert clock.now_s() < 20_000

    fuzz(
        check,
        st.integers(0, 2**63),
        st.sampled_from((0.01, 0.05, 0.3, 1.0)),
        st.sampled_from((False, False, False, True)),
    )
    assert 0 < outcomes["success"] < outcomes["case"]


class SplittingFunction(PtpUsbFunction):
    """A camera that cuts its answers into pieces of whole packets at random places."""

    def __init__(self, camera, seed):
        super().__init__(camera, PACKET)
        self._random = random.Random(seed)
        self._rest = []

    def bulk_in(self, endpoint, length, timeout_s):
        if self._rest:
            piece, self._ends = self._rest.pop(0)
            return piece
        piece = super().bulk_in(endpoint, length, timeout_s)
        if piece is None:
            return None
        data, ends = bytes(piece), self._ends
        if self._random.random() < 0.3 and len(data) > codec.HEADER_SIZE:
            # Some cameras send the header of a data container in a packet of its own.
            kind = codec.decode_header(data).kind if data[4:6] in (b"\x02\x00",) else None
            if kind == codec.Kind.DATA and ends:
                self._rest.append((data[codec.HEADER_SIZE :], True))
                self._ends = True
                return data[: codec.HEADER_SIZE]
        cuts = sorted(
            PACKET * self._random.randrange(1 + len(data) // PACKET)
            for _ in range(self._random.randrange(4))
        )
        pieces = [data[a:b] for a, b in zip([0, *cuts], [*cuts, len(data)], strict=True)]
        pieces = [piece for piece in pieces[:-1] if piece] + [pieces[-1]]
        self._rest = [(piece, False) for piece in pieces[:-1]] + [(pieces[-1], ends)]
        piece, self._ends = self._rest.pop(0)
        return piece


@pytest.mark.slow
def test_however_an_honest_camera_cuts_its_answers_they_arrive():
    def check(seed):
        clock = ManualClock()
        simulator = PtpCameraSimulator(lambda exposure_s: MOSAIC, clock)
        bus = SimulatedUsb(clock, SplittingFunction(simulator, seed))
        device = open_device(PTP_INTERFACE, backend=bus)
        with PtpCamera(PtpSession(PtpUsb(device, clock), clock)) as camera:
            np.testing.assert_array_equal(camera.snap().mosaic, MOSAIC)

    fuzz(check, st.integers(0, 2**63))
