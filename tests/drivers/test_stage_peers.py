"""Independent clients, which know nothing of this project, drive its simulated firmware.

They come with the extra `peers`, and talk over real pseudo-terminals and TCP in real time.
"""

import io
import struct
import time
from contextlib import contextmanager
from dataclasses import replace

import pytest
from tcp_server import TcpServer

from emmc_rig.drivers import apt_codec
from emmc_rig.drivers.apt_codec import Id
from emmc_rig.drivers.clock import SYSTEM_CLOCK
from emmc_rig.simulators.apt import COUNTS_PER_UM, Z825, AptController
from emmc_rig.simulators.grbl import BENCH_AXES, GrblController
from emmc_rig.simulators.wire import PtyServer
from emmc_rig.simulators.zaber import AxisSpec, ZaberChain

pytestmark = pytest.mark.peers
EARLY_READER = pytest.mark.timing(
    "thorlabs_apt_device may read before its constructor has made what its reader writes to"
)

PATIENCE_S = 30.0
QUICK = AxisSpec(max_speed_um_s=200_000.0, acceleration_um_s2=2e7)


def wait_until(condition):
    """Return when the condition holds; peers work in threads of their own."""
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline_s, "the peer never got there"
        time.sleep(0.005)


@contextmanager
def zaber_peer():
    """Yield a chain, and the devices that zaber-motion finds on it."""
    ascii_protocol = pytest.importorskip("zaber_motion.ascii", reason="needs the extra `peers`")
    axes = {(device, axis): QUICK for device in (1, 2) for axis in (1, 2)}
    chain = ZaberChain(SYSTEM_CLOCK, axes)
    with (
        PtyServer(chain) as server,
        ascii_protocol.Connection.open_serial_port(server.port) as connection,
    ):
        yield chain, connection.detect_devices(identify_devices=False)


@pytest.mark.slow
def test_zaber_motion_finds_homes_moves_stops_and_is_refused():
    with zaber_peer() as (chain, devices):
        refusals = pytest.importorskip("zaber_motion.exceptions")
        assert [device.device_address for device in devices] == [1, 2]
        axis = devices[0].get_axis(2)
        assert {"WR", "WH"} <= axis.warnings.get_flags()
        axis.home()
        assert axis.get_position() == 0.0
        assert axis.warnings.get_flags() == set()
        axis.move_absolute(100_000)
        axis.move_absolute(75_000)
        assert axis.get_position() == 75_000.0
        there_um = 75_000 * QUICK.microstep_um
        assert chain.position_um(1, 2) == pytest.approx(there_um, abs=QUICK.backlash_um + 0.1)
        assert not axis.is_busy()

        axis.settings.set("maxspeed", 200_000.0)
        assert axis.settings.get("maxspeed") == 200_000.0
        axis.move_absolute(500_000, wait_until_idle=False)
        assert axis.is_busy()
        axis.stop()
        assert 75_000 < axis.get_position() < 400_000
        assert not axis.is_busy()

        with pytest.raises(refusals.BadDataException):
            axis.move_absolute(99_999_999)
        with pytest.raises(refusals.BadCommandException):
            axis.generic_command("sing")
        assert devices[1].generic_command("get system.serial").data == "73003"

        axis.settings.set("maxspeed", 1_000_000.0)
        devices[0].all_axes.home()
        chain.faults.inject("stall")
        with pytest.raises(refusals.MovementFailedException, match="FS"):
            axis.move_absolute(400_000)
        assert "WR" in axis.warnings.get_flags()


@pytest.mark.slow
def test_zaber_motion_finds_the_axis_where_its_last_session_left_it():
    ascii_protocol = pytest.importorskip("zaber_motion.ascii", reason="needs the extra `peers`")
    chain = ZaberChain(SYSTEM_CLOCK, {(1, 1): QUICK})
    with TcpServer(chain) as server:
        before = 0.0
        for target in (100_000, 40_000):
            with ascii_protocol.Connection.open_tcp(*server.address) as connection:
                (device,) = connection.detect_devices(identify_devices=False)
                axis = device.get_axis(1)
                if not before:
                    axis.home()
                assert axis.warnings.get_flags() == set()
                assert axis.get_position() == before
                axis.move_absolute(target)
                assert axis.settings.get("resolution") == 64
            before = float(target)


@pytest.fixture
def apt_controller():
    spec = replace(Z825, max_speed_um_s=50_000.0, acceleration_um_s2=1e6, start_um=150.0)
    return AptController(SYSTEM_CLOCK, {apt_codec.USB_UNIT: spec})


@pytest.mark.slow
@EARLY_READER
def test_thorlabs_apt_device_homes_moves_and_stops(apt_controller):
    tdc001 = "thorlabs_apt_device.devices.tdc001"
    client = pytest.importorskip(tdc001, reason="needs the extra `peers`").TDC001
    with PtyServer(apt_controller) as server:
        peer = client(serial_port=server.port, home=False)
        try:
            wait_until(lambda: peer.status["msg"] and peer.velparams["msg"])
            assert not peer.status["homed"]
            assert peer.status["motor_connected"]
            assert peer.homeparams["offset_distance"] == round(300 * COUNTS_PER_UM)
            peer.set_enabled(True)
            peer.home()
            wait_until(lambda: peer.status["homed"])
            wait_until(lambda: peer.status["position"] == 0)
            peer.move_absolute(200_000)
            wait_until(lambda: peer.status["position"] == 200_000 and peer.status["settled"])
            assert apt_controller.position_um() == pytest.approx(200_000 / COUNTS_PER_UM, abs=0.1)
            peer.move_absolute(150_000)
            wait_until(lambda: peer.status["position"] == 150_000 and peer.status["settled"])
            peer.set_velocity_params(2_620, 767_367)
            wait_until(lambda: peer.velparams["max_velocity"] == 767_367)
            peer.move_absolute(800_000)
            wait_until(lambda: peer.status["moving_forward"])
            peer.stop()
            wait_until(lambda: peer.status["settled"])
            assert 150_000 < peer.status["position"] < 799_000
        finally:
            peer.close()
            peer._thread.join()


@pytest.mark.slow
@EARLY_READER
def test_thorlabs_apt_device_finds_the_axis_where_its_last_session_left_it(apt_controller):
    devices = pytest.importorskip("thorlabs_apt_device", reason="needs the extra `peers`")
    with PtyServer(apt_controller) as server:
        for session, target in enumerate((50_000, 200_000)):
            peer = devices.KDC101(serial_port=server.port, home=False)
            try:
                wait_until(lambda peer=peer: peer.status["msg"] and peer.velparams["msg"])
                if not session:
                    peer.home()
                wait_until(lambda peer=peer: peer.status["homed"])
                peer.move_absolute(target)
                wait_until(lambda peer=peer, at=target: peer.status["position"] == at)
                wait_until(lambda peer=peer: peer.status["settled"])
            finally:
                peer.close()
                peer._thread.join()
    assert apt_controller.position_um() == pytest.approx(200_000 / COUNTS_PER_UM, abs=0.1)


def test_the_apt_codec_writes_the_bytes_that_an_independent_one_writes():
    apt = pytest.importorskip("thorlabs_apt_device.protocol", reason="needs the extra `peers`")
    position = apt_codec.encode_position(1, -123_456)
    velocity = apt_codec.encode_velocity(apt_codec.VelocityParameters(1, 0, 261, 767_367))
    pace = {"min_velocity": 0, "acceleration": 261, "max_velocity": 767_367}
    of = {"chan_ident": 1}
    for name, theirs, parameters, data in (
        ("hw_req_info", {}, (), None),
        ("hw_no_flash_programming", {}, (), None),
        ("hw_stop_updatemsgs", {}, (), None),
        ("mod_set_chanenablestate", {**of, "enable_state": 1}, (1, apt_codec.ENABLE), None),
        ("mot_move_home", of, (1,), None),
        ("mot_move_absolute", {**of, "position": -123_456}, (), position),
        ("mot_move_stop", {**of, "stop_mode": 2}, (1, apt_codec.STOP_PROFILED), None),
        ("mot_set_velparams", {**of, **pace}, (), velocity),
        ("mot_req_homeparams", of, (1,), None),
        ("mot_set_genmoveparams", {**of, "backlash_distance": -123_456}, (), position),
        ("mot_req_dcstatusupdate", of, (1,), None),
    ):
        ours = apt_codec.encode(Id[name.upper()], 0x50, *parameters, data=data)
        assert ours == getattr(apt, name)(source=1, dest=0x50, **theirs), name


def test_an_independent_apt_codec_reads_what_the_firmware_and_ours_write():
    apt = pytest.importorskip("thorlabs_apt_device.protocol", reason="needs the extra `peers`")
    status = apt_codec.MotorStatus(1, -200_000, -7, 0x8000_4610)
    wire = apt_codec.encode(
        Id.MOT_GET_DCSTATUSUPDATE, 1, data=apt_codec.encode_status(status), source=0x50
    )
    home = struct.pack("<HHHii", 1, 2, 1, 767_367, 10_291)
    wire += apt_codec.encode(Id.MOT_GET_HOMEPARAMS, 1, data=home, source=0x50)
    wire += apt_codec.encode(Id.MOT_MOVE_HOMED, 1, 1, source=0x50)
    first, second, third = apt.Unpacker(io.BytesIO(wire), on_error="raise")
    assert (first.position, first.velocity, first.chan_ident) == (-200_000, -7, 1)
    assert first.motion_error
    assert first.homed
    assert first.homing
    assert first.moving_forward
    assert first.channel_enabled
    assert (second.home_velocity, second.offset_distance) == (767_367, 10_291)
    assert third.msg == "mot_move_homed"


@contextmanager
def grbl_peer(device):
    """Yield grbl-streamer on a controller that has booted, and the list of its events."""
    streamer = pytest.importorskip("grbl_streamer", reason="needs the extra `peers`")
    reported = []
    with PtyServer(device) as server:
        peer = streamer.GrblStreamer(lambda *event: reported.append(event))
        peer.poll_interval = 0.01
        peer.cnect(server.port)
        try:
            wait_until(lambda: ("on_boot",) in reported)
            peer.poll_start()
            yield peer, reported
        finally:
            peer.disconnect()


def quick_grbl(**settings):
    quick = replace(
        BENCH_AXES["X"], max_speed_um_s=200_000.0, acceleration_um_s2=1e7, start_um=24_000.0
    )
    return GrblController(SYSTEM_CLOCK, dict.fromkeys("XYZ", quick), **settings)


@pytest.mark.slow
def test_grbl_streamer_homes_streams_and_is_alarmed():
    device = quick_grbl(settings={24: 6000, 25: 12_000})
    with grbl_peer(device) as (peer, reported):
        wait_until(lambda: peer.cmode == "Alarm")
        peer.homing()
        wait_until(lambda: peer.cmode == "Idle")
        wait_until(lambda: peer.cmpos == (-1.0, -1.0, -1.0))
        peer.incremental_streaming = True
        peer.write("G21 G90\nG53 G0 X-5 Y-3\nG1 F3000 X-6.5\nG91 G1 X1")
        peer.job_run()
        wait_until(lambda: ("on_job_completed",) in reported)
        wait_until(lambda: peer.cmpos == (-5.5, -3.0, -1.0))
        assert device.position_um("X") == pytest.approx(25_400 - 5_500, abs=3.5)
        assert not any(event[0] == "on_error" for event in reported)
        peer.send_immediately("G90 G0 X50")
        wait_until(lambda: ("on_alarm", "ALARM:2") in reported)
        peer.softreset()
        peer.killalarm()
        wait_until(lambda: peer.cmode == "Idle")
        assert peer.cmpos == (-5.5, -3.0, -1.0)


@pytest.mark.slow
def test_grbl_streamer_streams_again_in_a_second_session():
    device = quick_grbl(settings={22: 0, 20: 0})
    for place in ("1.000", "0.500"):
        with grbl_peer(device) as (peer, reported):
            wait_until(lambda peer=peer: peer.cmode == "Idle")
            peer.incremental_streaming = True
            peer.write(f"G21 G90\nG53 G1 F3000 X-{place}")
            peer.job_run()
            wait_until(lambda reported=reported: ("on_job_completed",) in reported)
            wait_until(lambda peer=peer, at=-float(place): peer.cmpos[0] == at)
            assert not any(event[0] in ("on_error", "on_alarm") for event in reported)
