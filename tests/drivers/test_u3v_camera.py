"""USB3 Vision cameras: frames come exact, every fault is cured or one clear line, never a hang."""

import errno
import itertools
import math
import struct
from contextlib import closing, nullcontext, suppress
from random import Random

import numpy as np
import pytest
import usb.core
from fuzzing import fuzz
from hypothesis import strategies as st

from emmc_rig.drivers import u3v_codec as codec
from emmc_rig.drivers.errors import (
    CameraBusyError,
    CameraDescriptionError,
    CameraFormatError,
    CameraRefusedError,
    CameraSettingError,
    CaptureError,
    DriverError,
    ExposureStoppedError,
    RawFrameError,
    UsbGoneError,
    UsbNotFoundError,
    UsbStalledError,
    UsbTimeoutError,
    UsbTransferError,
)
from emmc_rig.drivers.transport import QUERY_ATTEMPTS
from emmc_rig.drivers.u3v import UNZIPPED_LIMIT, decode_frame
from emmc_rig.drivers.u3v import open_camera as open_u3v
from emmc_rig.drivers.u3v_codec import CONTROL
from emmc_rig.drivers.u3v_control import BUSY_LIMIT_S
from emmc_rig.drivers.u3v_stream import plan_sizes
from emmc_rig.drivers.usb import TRANSFER_BYTES, list_devices
from emmc_rig.simulators import u3v as simulation
from emmc_rig.simulators.clock import ManualClock
from emmc_rig.simulators.u3v import U3vCameraSimulator
from emmc_rig.simulators.usb import SimulatedUsb

SHAPE = (40, 48)
MOSAIC = np.random.default_rng(0).integers(64, 4096, SHAPE, dtype=np.uint16)


class Bench:
    """A camera on a bus, and the clock they share."""

    def __init__(self, mosaic=MOSAIC, cfa="rggb", **settings):
        self.clock = ManualClock()
        self.mosaic = mosaic
        self.exposures = []
        self.simulator = U3vCameraSimulator(self.see, self.clock, mosaic.shape, cfa, **settings)
        self.bus = SimulatedUsb(self.clock, self.simulator)

    def see(self, exposure_s):
        self.exposures.append(exposure_s)
        return self.mosaic

    def open(self, serial=""):
        return open_u3v(serial, self.clock, self.bus)


@pytest.fixture
def bench():
    return Bench()


@pytest.fixture
def faults(bench):
    return bench.simulator.faults


@pytest.mark.parametrize("depth", ["8", "10", "10p", "10Packed", "12", "12Packed", "12p"])
@pytest.mark.parametrize("zipped", [True, False])
def test_frames_of_every_depth_come_as_the_sensor_read_them(depth, zipped):
    bench = Bench(depths=(depth,), zipped=zipped)
    with_camera = bench.open()
    bits = int(depth.rstrip("pPacked"))
    frame = with_camera.snap()
    assert with_camera.pixel_format == "BayerRG" + depth
    np.testing.assert_array_equal(frame.mosaic, MOSAIC >> (12 - bits))
    assert frame.white_level_dn == (1 << bits) - 1
    np.testing.assert_array_equal(frame.black_level_dn, np.full((2, 2), 64 / 2 ** (12 - bits)))


@pytest.mark.parametrize("cfa", ["rggb", "grbg", "gbrg", "bggr", "mono"])
def test_colours_are_those_of_the_pixel_format(cfa):
    camera = Bench(cfa=cfa).open()
    assert (camera.cfa, camera.snap().cfa) == (cfa, cfa)


def test_opening_makes_an_automatic_triggered_camera_manual(bench):
    camera = bench.open()
    for name in ("ExposureAuto", "GainAuto", "TriggerMode"):
        assert camera.features.value(name) == "Off"


def test_a_camera_is_listed_and_says_who_made_it(bench):
    (listing,) = list_devices(CONTROL, bench.bus)
    assert (listing.maker, listing.model, listing.serial) == ("EMMC", "U3V simulator", "U1")
    identity = bench.open(serial="U1").identity
    assert (identity.maker, identity.serial, identity.firmware) == ("EMMC", "U1", "1.0")
    with pytest.raises(UsbNotFoundError, match="USB3 Vision camera with serial U2"):
        bench.open(serial="U2")


def test_a_camera_tells_its_temperature(bench):
    assert bench.open().temperatures_c() == {"DeviceTemperature": 38.5}


def test_exposure_and_gain_are_what_the_camera_took(bench):
    camera = bench.open()
    camera.set_exposure_s(0.0012345)
    assert camera.exposure_s == pytest.approx(0.0012345, abs=0.25e-6)
    camera.set_gain(3.0)
    assert 20 * np.log10(camera.gain) == pytest.approx(9.5)
    frame = camera.snap()
    assert bench.exposures == [pytest.approx(camera.exposure_s)]
    assert (frame.exposure_s, frame.gain) == (camera.exposure_s, camera.gain)


def test_gain_multiplies_the_light_above_black(bench):
    camera = bench.open()
    camera.set_gain(10 ** (6 / 20))
    expected = np.clip(np.rint((MOSAIC - 64.0) * 10 ** (6 / 20) + 64), 0, 4095)
    np.testing.assert_array_equal(camera.snap().mosaic, expected)


def test_an_exposure_begins_after_it_was_asked_for_and_is_timed_by_the_camera(bench):
    camera = bench.open()
    camera.set_exposure_s(0.5)
    bench.clock.sleep(100.0)
    before_s = bench.clock.now_s()
    frame = camera.snap()
    assert frame.camera_time_s == pytest.approx(before_s)
    assert frame.host_time_s == pytest.approx(before_s + 0.5)


def test_a_stream_numbers_its_frames_and_stops_when_closed(bench):
    camera = bench.open()
    stream = camera.stream()
    frames = list(itertools.islice(stream, 5))
    assert [frame.metadata["block_id"] for frame in frames] == list("01234")
    assert {frame.metadata["frames_lost"] for frame in frames} == {"0"}
    steps = np.diff([frame.camera_time_s for frame in frames])
    np.testing.assert_allclose(steps, 1 / 30, rtol=1e-6)
    assert bench.simulator.streaming
    stream.close()
    assert not bench.simulator.streaming
    np.testing.assert_array_equal(camera.snap().mosaic, MOSAIC)


def test_a_stream_at_a_rate_keeps_it_and_the_camera_has_its_own_back(bench):
    camera = bench.open()
    with closing(camera.stream_at(8.0)) as stream:
        steps = np.diff([frame.camera_time_s for frame in itertools.islice(stream, 4)])
    np.testing.assert_allclose(steps, 1 / 8, rtol=1e-6)
    with closing(camera.stream()) as stream:
        steps = np.diff([frame.camera_time_s for frame in itertools.islice(stream, 4)])
    np.testing.assert_allclose(steps, 1 / 30, rtol=1e-6)


def test_a_rate_beyond_the_cameras_is_refused_before_it_streams(bench):
    camera = bench.open()
    assert camera.rate_limits_hz == (0.001, 1000)
    with pytest.raises(CameraSettingError, match="frame rate in Hz"):
        next(camera.stream_at(1001.0))
    assert not bench.simulator.streaming


def test_a_stream_is_broken_off_in_the_middle_of_a_long_exposure(bench, monkeypatch):
    camera = bench.open()
    camera.set_exposure_s(10.0)
    stream, before_s, pass_time = camera.stream(), bench.clock.now_s(), bench.clock.sleep

    def sleep(duration_s):
        pass_time(duration_s)
        if bench.clock.now_s() - before_s > 3:
            assert camera.stop_exposure()

    monkeypatch.setattr(bench.clock, "sleep", sleep)
    with pytest.raises(ExposureStoppedError):
        next(stream)
    assert 3 < bench.clock.now_s() - before_s < 5
    assert not bench.simulator.streaming
    camera.set_exposure_s(0.01)
    assert next(camera.stream()).exposure_s == pytest.approx(0.01)


def test_what_a_slow_reader_misses_is_counted(bench):
    stream = bench.open().stream()
    next(stream)
    bench.clock.sleep(1.0)
    lost = [int(next(stream).metadata["frames_lost"]) for _ in range(3)]
    assert lost[0] == pytest.approx(28, abs=2)
    assert lost[1:] == [0, 0]


def test_frames_begun_before_a_change_do_not_claim_the_new_exposure(bench):
    camera = bench.open()
    stream = camera.stream()
    assert next(stream).exposure_s == pytest.approx(0.01)
    camera.set_exposure_s(0.02)
    reported = [next(stream).exposure_s for _ in range(5)]
    assert reported == [None, None, None, pytest.approx(0.02), pytest.approx(0.02)]


def test_two_acquisitions_at_once_are_refused(bench):
    camera = bench.open()
    stream = camera.stream()
    next(stream)
    with pytest.raises(CameraSettingError, match="close its stream first"):
        camera.snap()
    next(stream)


def test_closing_the_camera_stops_its_stream(bench):
    camera = bench.open()
    stream = camera.stream()
    next(stream)
    camera.close()
    assert not bench.simulator.streaming
    with pytest.raises(UsbGoneError):
        next(stream)


def test_an_acquisition_left_running_is_stopped_on_opening(bench):
    first = bench.open()
    stream = first.stream()
    next(stream)
    first._device.close()
    np.testing.assert_array_equal(bench.open().snap().mosaic, MOSAIC)
    with suppress(DriverError):
        stream.close()


def test_a_region_of_the_sensor_is_what_was_set_before():
    bench = Bench()
    for offset, value in ((0x00, 32), (0x04, 24), (0x08, 6), (0x0C, 2)):
        assert bench.simulator._store(0x100000 + offset, struct.pack("<I", value)) == 0
    frame = bench.open().snap()
    np.testing.assert_array_equal(frame.mosaic, MOSAIC[2:26, 6:38])
    assert (frame.metadata["offset_x"], frame.metadata["offset_y"]) == ("6", "2")


def test_the_recorded_bytes_decode_to_the_same_frame(bench):
    frame = bench.open().snap()
    again = decode_frame(frame.original, black_level_dn=64)
    np.testing.assert_array_equal(again.mosaic, frame.mosaic)
    assert (again.sha256, again.cfa, again.metadata) == (frame.sha256, frame.cfa, frame.metadata)
    assert again.camera_time_s == frame.camera_time_s


def test_recorded_bytes_of_another_format_or_size_are_refused(bench):
    original = bytearray(bench.open().snap().original)
    struct.pack_into("<I", original, 28, 0x02180014)
    with pytest.raises(RawFrameError, match="0x02180014 is not raw"):
        decode_frame(bytes(original))
    struct.pack_into("<I", original, 28, 0x010C0059)
    struct.pack_into("<Q", original, len(original) - 12, 100)
    with pytest.raises(RawFrameError, match="100 bytes are not the 2880 of 40x48"):
        decode_frame(bytes(original))
    for width, needed in ((60_000, 3_600_000), (0, 0)):
        struct.pack_into("<II", original, 28, 0x010C0059, width)
        with pytest.raises(RawFrameError, match=f"100 bytes are not the {needed} of"):
            decode_frame(bytes(original))


SIZES = [(2, 2), (38, 46), (40, 48), (200, 514)]


@pytest.mark.parametrize("shape", SIZES)
@pytest.mark.parametrize("alignment_bits", [0, 2, 10, 12])
@pytest.mark.parametrize("packet", [512, 1024])
def test_payloads_of_any_size_pass_whatever_alignment_and_packets(shape, alignment_bits, packet):
    mosaic = np.random.default_rng(1).integers(0, 4096, shape, dtype=np.uint16)
    bench = Bench(mosaic, alignment_bits=alignment_bits, packet=packet)
    camera = bench.open()
    np.testing.assert_array_equal(camera.snap().mosaic, mosaic)
    for frame in itertools.islice(camera.stream(), 3):
        np.testing.assert_array_equal(frame.mosaic, mosaic)


def test_a_frame_of_many_transfers_comes_whole():
    mosaic = np.random.default_rng(1).integers(0, 4096, (1500, 3000), dtype=np.uint16)
    bench = Bench(mosaic, depths=("12",))
    camera = bench.open()
    np.testing.assert_array_equal(camera.snap().mosaic, mosaic)
    sirm = [bench.simulator._read_u32(simulation.SIRM, offset) for offset in (0x1C, 0x20, 0x24)]
    rest = 9_000_000 - 2 * TRANSFER_BYTES
    assert sirm == [TRANSFER_BYTES, 2, -(-rest // 1024) * 1024]


@pytest.mark.parametrize(("leader", "payload"), [(0, 1), (52, 0), (1 << 20, 1), (52, 1 << 40)])
def test_a_stream_that_asks_for_absurd_sizes_is_refused(leader, payload):
    with pytest.raises(CameraDescriptionError, match="its stream has a"):
        plan_sizes(leader, payload, 32, 1024, 1024)


@pytest.mark.parametrize(
    "fault", ["drop_reply", "late_reply", "garble_reply", "duplicate_reply", "stall_control"]
)
@pytest.mark.parametrize("after", range(0, 12, 3))
def test_a_read_that_goes_wrong_is_repeated(bench, faults, fault, after):
    camera = bench.open()
    faults.inject(fault, skip=after)
    for name in ("Width", "Height", "PayloadSize", "BlackLevel") * 4:
        camera.features.number(name)
    assert camera.features.number("Width") == SHAPE[1]
    np.testing.assert_array_equal(camera.snap().mosaic, MOSAIC)


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        ("drop_reply", UsbTimeoutError),
        ("garble_reply", CameraFormatError),
        ("stall_control", UsbStalledError),
    ],
)
def test_a_write_that_goes_wrong_is_not_repeated(bench, faults, fault, error):
    camera = bench.open()
    camera.features.set("TLParamsLocked", 0)
    written = []
    store = bench.simulator._store
    bench.simulator._store = lambda address, data: written.append(address) or store(address, data)
    faults.inject(fault)
    with pytest.raises(error):
        camera._control.write(0x100040, bytes(4))
    assert len(written) <= 1
    np.testing.assert_array_equal(camera.snap().mosaic, MOSAIC)


@pytest.mark.parametrize("count", [0, 3])
def test_a_write_that_was_done_in_part_is_an_error_but_an_old_camera_states_no_count(
    bench, monkeypatch, count
):
    camera, execute = bench.open(), bench.simulator._execute

    def answer(command, request_id, body):
        if command != codec.WRITEMEM:
            return execute(command, request_id, body)
        return simulation._answer(0, codec.WRITEMEM_ACK, request_id, struct.pack("<HH", 0, count))

    monkeypatch.setattr(bench.simulator, "_execute", answer)
    in_part = pytest.raises(CameraFormatError, match="not all 4 bytes were written")
    with in_part if count else nullcontext():
        camera._control.write(0x100040, bytes(4))


def test_a_camera_that_stays_silent_is_given_up_in_bounded_time(bench, faults):
    camera = bench.open()
    faults.inject("drop_reply", times=math.inf)
    before_s = bench.clock.now_s()
    with pytest.raises(UsbTimeoutError, match="was silent"):
        camera.features.number("Width")
    assert bench.clock.now_s() - before_s < QUERY_ATTEMPTS * 1.0


def test_a_pending_acknowledge_gives_the_camera_more_time(bench, faults):
    camera = bench.open()
    faults.inject("pending")
    before_s = bench.clock.now_s()
    camera.features.set("TLParamsLocked", 1)
    assert bench.clock.now_s() - before_s == pytest.approx(simulation.PENDING_S)
    assert camera.features.number("TLParamsLocked") == 1


def test_a_camera_that_is_busy_for_ever_is_given_up(bench, faults):
    camera = bench.open()
    faults.inject("busy")
    before_s = bench.clock.now_s()
    with pytest.raises(CameraBusyError, match=r"busy for .* when asked to read 4 bytes"):
        camera.features.number("Width")
    assert BUSY_LIMIT_S <= bench.clock.now_s() - before_s < BUSY_LIMIT_S + 2


def test_a_refusal_says_what_was_asked_and_what_to_do(bench):
    camera = bench.open()
    with pytest.raises(
        CameraRefusedError, match=r"to read 4 bytes at 0xdead0000 with invalid addr"
    ):
        camera._control.read(0xDEAD0000, 4)
    with pytest.raises(CameraRefusedError, match="write protected"):
        camera._control.write(0x100010, bytes(4))


LOST = [
    ("lost_trailer", "end did not come"),
    ("torn_payload", "bytes came|end is garbled"),
    ("discarded", "camera says data discarded"),
    ("wrong_size", "rggb instead of|bytes came"),
    ("stall_stream", "halted its stream"),
    ("late_frame", "no frame came in time: check the trigger"),
    ("garbled_leader", "no frame came in time|no frame begins"),
    ("lost_leader", "no frame came in time|no frame begins"),
]


@pytest.mark.parametrize(("fault", "complaint"), LOST)
@pytest.mark.parametrize("shape", [SHAPE, (1000, 1202)])
def test_a_frame_that_does_not_come_whole_is_reported_and_the_next_one_comes(
    fault, complaint, shape
):
    mosaic = np.resize(MOSAIC, shape)
    bench = Bench(mosaic)
    camera = bench.open()
    bench.simulator.faults.inject(fault)
    with pytest.raises((CaptureError, RawFrameError), match=complaint):
        camera.snap()
    assert not bench.simulator.streaming
    np.testing.assert_array_equal(camera.snap().mosaic, mosaic)


@pytest.mark.parametrize("fault", ["lost_trailer", "torn_payload", "discarded", "lost_leader"])
@pytest.mark.parametrize("shape", [SHAPE, (1000, 1202)])
def test_a_stream_passes_over_a_torn_frame_and_counts_it(fault, shape):
    mosaic = np.resize(MOSAIC, shape)
    bench = Bench(mosaic)
    stream = bench.open().stream()
    next(stream)
    bench.simulator.faults.inject(fault)
    frame = next(stream)
    np.testing.assert_array_equal(frame.mosaic, mosaic)
    block = int(frame.metadata["block_id"])
    assert int(frame.metadata["frames_lost"]) == block - 1 >= 1
    assert next(stream).metadata["frames_lost"] == "0"


def test_the_end_of_another_frame_does_not_make_this_one_whole(bench):
    camera = bench.open()
    send = bench.simulator._send

    def send_wrong_end(exposure_s, block, start_s):
        send(exposure_s, block, start_s)
        trailer = bytearray(bench.simulator._messages.pop())
        trailer[8] += 3
        bench.simulator._messages.append(bytes(trailer))

    bench.simulator._send = send_wrong_end
    with pytest.raises(CaptureError, match="begins as frame 0 and ends as 3"):
        camera.snap()


def test_the_stream_is_halted_and_cleared_before_it_is_enabled(bench, monkeypatch):
    camera = bench.open()
    done = []
    simulator = bench.simulator
    control, cleared, store = simulator.control, simulator.cleared, simulator._store

    def note_store(address, data):
        if address == simulation.SIRM + codec.SIRM_CONTROL:
            done.append("enable" if data[0] else "disable")
        return store(address, data)

    monkeypatch.setattr(simulator, "control", lambda *a: done.append("halt") or control(*a))
    monkeypatch.setattr(simulator, "cleared", lambda end: done.append("clear") or cleared(end))
    monkeypatch.setattr(simulator, "_store", note_store)
    camera.snap()
    assert done == ["disable", "halt", "clear", "enable", "disable", "halt", "clear"]


def test_settings_are_unlocked_after_an_acquisition(bench):
    camera = bench.open()
    with closing(camera.stream()) as stream:
        next(stream)
        assert not camera.features.is_writable("Width")
    assert camera.features.is_writable("Width")


def test_a_payload_may_be_smaller_than_the_camera_reserves(bench, monkeypatch):
    simulator = bench.simulator
    update = simulator._update_sizes

    def reserve_more():
        update()
        struct.pack_into("<Q", simulator._regions[simulation.SIRM], 0x08, 40 * 48 * 2 + 5000)

    monkeypatch.setattr(simulator, "_update_sizes", reserve_more)
    camera = bench.open()
    np.testing.assert_array_equal(camera.snap().mosaic, MOSAIC)
    for frame in itertools.islice(camera.stream(), 3):
        np.testing.assert_array_equal(frame.mosaic, MOSAIC)


@pytest.mark.parametrize("fault", ["unplug", "unplug_in_payload"])
def test_a_camera_that_is_unplugged_says_so_and_may_be_opened_anew(bench, faults, fault):
    camera = bench.open()
    faults.inject(fault)
    with pytest.raises(UsbGoneError, match="went away: plug it in"):
        camera.snap()
    camera.close()
    bench.bus.plug(bench.simulator)
    np.testing.assert_array_equal(bench.open().snap().mosaic, MOSAIC)


def test_a_frame_too_large_for_the_kernels_memory_says_how_to_raise_it(bench, monkeypatch):
    camera = bench.open()
    read = bench.bus.bulk_read

    def refuse(handle, endpoint, interface, buffer, timeout):
        if endpoint == simulation.STREAM_IN:
            raise usb.core.USBError("Insufficient memory", -11, errno.ENOMEM)
        return read(handle, endpoint, interface, buffer, timeout)

    monkeypatch.setattr(bench.bus, "bulk_read", refuse)
    with pytest.raises(UsbTransferError, match="usbfs_memory_mb"):
        camera.snap()


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda regions: struct.pack_into("<Q", regions[0x30000], 0, 1 << 40), "entries"),
        (lambda regions: struct.pack_into("<Q", regions[0x30000], 24, 1 << 40), "bytes long"),
        (lambda regions: struct.pack_into("<I", regions[0x30000], 12, 1), "names no XML"),
        (lambda regions: struct.pack_into("<I", regions[0x40000], 0, 0), "checksum"),
        (lambda regions: struct.pack_into("<20s", regions[0x30000], 32, b"") or
            struct.pack_into("<I", regions[0x40000], 0, 0), "cannot be unpacked|no XML"),
    ],
)  # fmt: skip
def test_a_camera_whose_description_is_damaged_is_refused_and_let_go(bench, change, complaint):
    change(bench.simulator._regions)
    with pytest.raises(CameraDescriptionError, match=complaint):
        bench.open()
    # Whoever fixes the camera can open it at once: nothing is still claimed.
    bench.simulator.plugged()
    bench.open()


def test_a_description_that_unpacks_without_end_is_refused(bench):
    bomb = simulation._zip(bytes(UNZIPPED_LIMIT + 10))
    bench.simulator._file = bomb
    bench.simulator.plugged()
    with pytest.raises(CameraDescriptionError, match="unpacks to more than"):
        bench.open()


def described_as(bench, old, new):
    """Return the camera, opened with another maker's wording in its description."""
    assert old in bench.simulator.description
    bench.simulator._file = simulation._zip(bench.simulator.description.replace(old, new))
    bench.simulator.plugged()
    return bench.open()


def test_a_camera_without_single_frames_gives_one_all_the_same(bench):
    camera = described_as(bench, b'"SingleFrame"', b'"MultiFrame"')
    np.testing.assert_array_equal(camera.snap().mosaic, MOSAIC)
    assert not bench.simulator.streaming


@pytest.mark.parametrize(("unit", "exposure_s"), [(b"us", 0.01), (b"ms", 10.0), (b"s", 10_000.0)])
def test_the_exposure_is_read_in_the_unit_that_the_camera_states(bench, unit, exposure_s):
    camera = described_as(bench, b"<Unit>us</Unit>", b"<Unit>%b</Unit>" % unit)
    assert camera.exposure_s == pytest.approx(exposure_s)


def renamed(bench, name):
    """Return the camera, opened with a feature that has a name of the maker's own."""
    description = bench.simulator.description
    for before, after in ((b'"', b'"'), (b">", b"<")):
        description = description.replace(before + name + after, before + b"Own" + name + after)
    return described_as(bench, bench.simulator.description, description)


def test_a_gain_that_is_no_decibels_is_linear(bench):
    camera = described_as(bench, b"<Unit>dB</Unit>", b"<Unit>x</Unit>")
    camera.set_gain(4.0)
    assert camera.features.value("Gain") == pytest.approx(4.0)


def test_a_camera_without_gain_or_black_level_has_gain_1_and_black_0(bench):
    camera = renamed(bench, b"Gain")
    assert (camera.gain, camera.gain_limits) == (1.0, (1.0, 1.0))
    camera.close()
    camera = renamed(bench, b"BlackLevel")
    assert camera.snap().black_level_dn[1, 1] == 0


def test_a_black_level_in_per_cent_is_one_of_white(bench):
    camera = described_as(
        bench, b"<pValue>BlackLevelKnife</pValue>", b"<Value>2</Value><Unit>%</Unit>"
    )
    assert camera.snap().black_level_dn[0, 0] == pytest.approx(0.02 * 4095)


def test_a_feature_of_another_kind_than_usual_does_not_stop_the_opening(bench):
    camera = described_as(
        bench, b"<Category", b'<Integer Name="GainSelector"><Value>1</Value></Integer><Category'
    )
    np.testing.assert_array_equal(camera.snap().mosaic, MOSAIC)


@pytest.mark.parametrize("where", [simulation.ANSWER_IN, simulation.STREAM_IN])
def test_ctrl_c_stops_the_camera(bench, monkeypatch, where):
    camera = bench.open()
    read, armed = bench.simulator.bulk_in, [True]

    def interrupt(endpoint, length, timeout_s):
        if armed and endpoint == where and bench.simulator.streaming:
            armed.clear()
            raise KeyboardInterrupt
        return read(endpoint, length, timeout_s)

    monkeypatch.setattr(bench.simulator, "bulk_in", interrupt)
    with pytest.raises(KeyboardInterrupt):
        camera.snap()
    assert not bench.simulator.streaming
    np.testing.assert_array_equal(camera.snap().mosaic, MOSAIC)


def test_a_camera_without_an_exposure_is_refused(bench):
    with pytest.raises(CameraDescriptionError, match="none of ExposureTime"):
        renamed(bench, b"ExposureTime")


SEEDS = st.integers(0, 1 << 62)
"""Of the random damage: hypothesis draws single bits more slowly than the test runs."""
KINDS = ("keep", "keep", "keep", "drop", "cut", "grow", "change", "change", "noise")


class Noise(U3vCameraSimulator):
    """The simulated camera with some of its answers and transfers damaged as drawn."""

    def __init__(self, *arguments, **settings):
        self.damage = []
        super().__init__(*arguments, **settings)

    def _mangled(self, message):
        if message is None or not self.damage:
            return message
        kind, at, value = self.damage.pop()
        raw = bytearray(message)
        if kind == "keep" or not raw:
            return message
        if kind == "drop":
            return None
        if kind == "cut":
            return bytes(raw[: at % len(raw)])
        if kind == "noise":
            return Random(value).randbytes(at)
        if kind == "grow":
            return bytes(raw + bytes(value + 1))
        raw[at % len(raw)] = value
        return bytes(raw)

    def bulk_in(self, endpoint, length, timeout_s):
        return self._mangled(super().bulk_in(endpoint, length, timeout_s))


@pytest.mark.slow
def test_no_damage_on_the_wire_makes_the_driver_hang_or_fail_outside_its_errors(caplog):
    caplog.set_level("CRITICAL")
    mosaic = MOSAIC[:4, :6].copy()
    clock = ManualClock()
    noisy = Noise(lambda exposure_s: mosaic, clock, mosaic.shape, zipped=False)
    bus = SimulatedUsb(clock, noisy)
    opened = open_u3v("", clock, bus)

    def check(seed):
        nonlocal opened
        before_s = clock.now_s()
        random = Random(seed)
        act = random.choice(("snap", "snap", "stream", "set", "open"))
        noisy.damage = [
            (random.choice(KINDS), random.randrange(600), random.randrange(256))
            for _ in range(random.randint(1, 40))
        ]
        try:
            if act == "open":
                opened.close()
                opened = open_u3v("", clock, bus)
            elif act == "set":
                opened.set_exposure_s(0.01)
                opened.set_gain(1.0)
            elif act == "snap":
                assert opened.snap().mosaic.shape == opened.shape
            else:
                with closing(opened.stream()) as frames:
                    for frame in itertools.islice(frames, 2):
                        assert frame.mosaic.shape == opened.shape
        except DriverError as error:
            reported = str(error)
            if "\n" in reported:
                raise AssertionError(reported) from error
            revive()
        assert clock.now_s() - before_s < 3600

    def revive():
        nonlocal opened
        noisy.damage = []
        try:
            opened.snap()
        except DriverError:
            # What was damaged may be what the driver remembers: a new start must cure it.
            opened.close()
            noisy.plugged()
            opened = open_u3v("", clock, bus)
            np.testing.assert_array_equal(opened.snap().mosaic, mosaic)

    fuzz(check, SEEDS)


@pytest.mark.slow
def test_no_stream_bytes_make_the_decoder_fail_outside_the_drivers_errors():
    original = Bench(MOSAIC[:4, :6].copy()).open().snap().original

    def check(seed):
        random, raw = Random(seed), bytearray(original)
        for _ in range(random.randint(0, 8)):
            raw[random.randrange(len(raw))] = random.randrange(256)
        raw = raw[: random.choice((len(raw), random.randrange(len(raw))))]
        with suppress(DriverError):
            decode_frame(bytes(raw))

    fuzz(check, SEEDS)


def test_stale_bytes_before_the_first_frame_is_passed_over(bench):
    camera = bench.open()
    leader = codec.LEADER_PREFIX.to_bytes(4, "little")
    start = bench.simulator._start

    def start_after_rubbish():
        bench.simulator._messages.extend([leader + bytes(96), bytes(3000)])
        return start()

    bench.simulator._start = start_after_rubbish
    np.testing.assert_array_equal(camera.snap().mosaic, MOSAIC)
