"""The sequencer: frames, retries, refusals, resumption, and the bench after a capture."""

import os
import signal
import threading
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from capture_rigs import begun, frames_in, plan_and_camera, request_for, still_rig
from simulated_disk import SimulatedDisk
from watching import Acting

from emmc_rig.bench.hardware import simulated_rig
from emmc_rig.bench.registration import registered
from emmc_rig.captures.control import Control, interruptible
from emmc_rig.captures.faults import GaveUpError
from emmc_rig.captures.plan import Retries
from emmc_rig.captures.run import (
    begun_session,
    new_session,
    planned_frames,
    refuse_other_devices,
)
from emmc_rig.captures.sequencer import Sequencer
from emmc_rig.drivers.dng import encode_dng
from emmc_rig.drivers.raw import decode_raw
from emmc_rig.errors import AppError
from emmc_rig.formats.scenes import fine_scene
from emmc_rig.session.journal import ComparedEntry, FrameEntry, RetryEntry, RunEntry, of_kind
from emmc_rig.session.session import Session
from emmc_rig.session.verify import verify
from emmc_rig.simulators.clock import ManualClock

ROOT = Path("/disk")
SIZE = (24, 32)
SMALL = """
camera: rgbw-bayer-3shots
shots: [{}, {}]
whiteboards: {views: [[2, 2], [0, 4]], repeats: 1, references: 2}
darks: {repeats: 2}
"""
ONE_SHOT = """
camera: rgbw-bayer-1shot
shots: [{exposure_s: 0.05, repeats: 3}]
whiteboards: null
darks: null
"""


class HelpfulClock(ManualClock):
    """Somebody at the bench plugs the stage in again while the program waits."""

    chain: Any = None

    def sleep(self, duration_s):
        super().sleep(duration_s)
        if self.chain is not None and self.chain.unplugged:
            self.chain.replug()


@cache
def scene_samples():
    return fine_scene("near-planar", 1, 1, size=SIZE).samples


def bench_rig(text=SMALL, seed=0):
    """Return the simulated rig before a scene: real drivers on simulated wires."""
    camera = plan_and_camera(text)[1]
    clock = HelpfulClock()
    rig, bench = simulated_rig(camera, scene_samples(), SIZE, seed, clock)
    clock.chain = rig.chain
    return rig, bench


def started(rig, text=SMALL, disk: Any = None, **changes):
    disk = SimulatedDisk() if disk is None else disk
    session, plan = begun(ROOT, disk, rig, text)
    return session, plan.model_copy(update=changes)


@pytest.fixture(scope="module")
def undisturbed():
    rig, _ = bench_rig()
    session, plan = started(rig)
    outcome = Sequencer(session, plan, rig).run()
    return session, outcome


def test_a_session_holds_every_frame_that_the_plan_asks_for(undisturbed):
    session, outcome = undisturbed
    assert outcome.complete
    assert outcome.taken == len(session.frames) == 2 + 2 * 3 + 2 * 2 + 2
    assert verify(session).is_complete


def test_the_journal_records_where_everything_stood_and_by_what_it_was_taken(undisturbed):
    session, _ = undisturbed
    entry = session.stored["board-s1-v0-u4-white-r0"]
    assert entry.commanded_um["mask_x"] == 270
    assert entry.read_um["aperture_x"] == pytest.approx(2 * 5000, abs=0.5)
    assert entry.lamp == "white"
    assert entry.shape == SIZE
    assert set(entry.spans_s) >= {"attend", "move", "expose", "read back", "check", "write"}
    run = next(iter(of_kind(session.journal.entries, RunEntry)))
    assert run.camera["serial"] == "S1"
    assert run.stage["mask_x"]["zero_um"] == 12_700
    assert "numpy" in run.versions


def test_references_are_exposed_where_metering_aims(undisturbed):
    session, _ = undisturbed
    for frame in session.frames:
        if frame.kind in ("reference", "whiteboard"):
            entry = session.stored[frame.id]
            level = entry.figures.bright_dn / (65_535 - 256)
            assert 0.55 < level < 0.8
            assert entry.figures.saturated == 0


def stopped_after(count, text=SMALL):
    """Return a session that was stopped by Ctrl-C once, and what a resume needs."""
    rig, bench = bench_rig(text)
    session, plan = started(rig, text)
    control = Control()

    def stop(event):
        if len(taken) + 1 == count:
            control.stop()
        taken.append(event.facts["id"])

    taken = []
    outcome = Sequencer(session, plan, rig, Acting(frame_taken=stop), control).run()
    assert not outcome.complete
    assert len(session.stored) == count
    return session, plan, rig, bench


def test_stopping_ends_after_the_frame_and_a_resume_takes_only_what_is_missing(undisturbed):
    session, plan, _, _ = stopped_after(9)
    before = dict(session.stored)
    rig, _ = bench_rig()
    again = Session(session.folder, session.disk)
    outcome = Sequencer(again, plan, rig).run()
    assert outcome.complete
    assert outcome.taken == len(session.frames) - 9
    assert frames_in(again) == frames_in(undisturbed[0])
    assert all(again.stored[name] == entry for name, entry in before.items())


def test_a_resume_agrees_with_the_last_whiteboard_under_other_noise(undisturbed):
    session, plan, _, _ = stopped_after(10)
    rig, _ = bench_rig(seed=1)
    again = Session(session.folder, session.disk)
    Sequencer(again, plan, rig).run()
    assert frames_in(again)["shot-0-e0-r0"] != frames_in(undisturbed[0])["shot-0-e0-r0"]
    entry = next(iter(of_kind(again.journal.entries, ComparedEntry)))
    assert entry.kind == "registered"
    assert entry.id.startswith("board")
    assert np.hypot(entry.x_px, entry.y_px) < 0.05
    assert entry.likeness > 0.9


def test_a_resume_refuses_a_bench_whose_mask_has_slipped():
    session, plan, _, _ = stopped_after(10)
    rig, _ = bench_rig()
    slipped = replace(rig, zero_um={**rig.zero_um, "mask_x": rig.zero_um["mask_x"] + 72.0})
    again = Session(session.folder, session.disk)
    with pytest.raises(AppError, match="the bench has changed"):
        Sequencer(again, plan, slipped).run()
    assert len(again.stored) == 10
    assert any(entry.kind == "refused" for entry in again.journal.entries)


def test_a_shift_is_registered_to_a_tenth_of_a_pixel():
    rng = np.random.default_rng(0)
    fine = cv2.blur(rng.uniform(0, 1, (130 * 4, 170 * 4)), (12, 12))

    def frame(dx_quarter):
        cut = fine[16 : 16 + 480, 16 - dx_quarter : 16 - dx_quarter + 640]
        dn = 300 + 3000 * cut.reshape(120, 4, 160, 4).mean(axis=(1, 3))
        return decode_raw(encode_dng(dn.astype(np.uint16), "mono", 100, 4000, 0.01))

    for quarters in (-8, -3, 0, 1, 6):
        shift = registered(frame(quarters), frame(0))
        assert shift.x_px == pytest.approx(quarters / 4, abs=0.1)
        assert shift.y_px == pytest.approx(0, abs=0.1)
        assert shift.likeness > 0.9


def test_a_resume_refuses_another_stage_unless_it_is_meant():
    rig, _ = bench_rig(ONE_SHOT)
    session, plan = started(rig, ONE_SHOT)
    Sequencer(session, plan, rig).run()
    refuse_other_devices(session, rig)

    def of_serial(serial):
        """Return the rig with another controller for mask_y."""
        stage: Any = rig.stage

        class Exchanged:
            def __getattr__(self, name):
                return getattr(stage, name)

            def identity(self, axis):
                own = stage.identity(axis)
                return replace(own, serial=serial) if axis == "mask_y" else own

        return replace(rig, stage=Exchanged())

    with pytest.raises(AppError, match=r"begun with mask_y on .*, now it is on .* 999") as refused:
        refuse_other_devices(session, of_serial("999"))
    assert refused.value.advice == "other-devices"
    # Later runs are compared with the stage that was meant.
    refuse_other_devices(session, of_serial("999"), meant=True)
    again = Session(session.folder, session.disk)
    again.discard(next(iter(again.stored)), "wanted once more")
    assert Sequencer(again, plan, of_serial("999")).run().complete
    refuse_other_devices(again, of_serial("999"))
    with pytest.raises(AppError, match="999"):
        refuse_other_devices(again, rig)
    # A controller that does not say its serial number is not compared.
    refuse_other_devices(again, of_serial(""))


def test_another_camera_is_taken_where_it_is_meant_and_has_the_same_frames():
    rig = still_rig()
    session, plan = started(rig)
    Sequencer(session, plan, rig).run()
    wire = rig.camera
    other = replace(rig, camera=SimpleCamera(wire, "8", wire.shape))
    with pytest.raises(AppError, match="say that other devices are meant"):
        refuse_other_devices(session, other)
    refuse_other_devices(session, other, meant=True)
    larger = replace(rig, camera=SimpleCamera(wire, "7", (48, 64)))
    with pytest.raises(AppError, match="48x64: connect that one, or begin another session"):
        refuse_other_devices(session, larger, meant=True)


class SimpleCamera:
    """A camera of another serial number and frame size."""

    def __init__(self, camera, serial, shape):
        self.identity, self.shape = replace(camera.identity, serial=serial), shape


def test_stopping_now_keeps_what_was_taken_and_leaves_the_bench_safe():
    rig = still_rig()
    session, plan = started(rig)

    def stop(event):
        if event.facts == {"id": "reference-s1-white-r0", "step": "expose"}:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Sequencer(session, plan, rig, Acting(step=stop)).run()
    assert rig.attendant.lamp == "off"
    assert rig.stage.stops == 1
    assert session.journal.entries[-1].kind == "stopped"
    assert not verify(session).damaged
    assert 0 < len(session.stored) < len(session.frames)


def test_ctrl_c_stops_after_the_frame_and_the_second_one_now():
    control, reported = Control(), []
    with interruptible(control, reported.append):
        signal.raise_signal(signal.SIGINT)
        assert control.stopping
        assert "stopping after this frame" in reported[0]
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


CAMERA_FAULTS = (
    "torn_raw", "wrong_size", "drop_event", "drop_complete", "unplug_in_download",
    "stall_in_download", "lost_bytes", "garbled_header", "silent", "stuck_exposure",
)  # fmt: skip
STAGE_FAULTS = ("drop_reply", "garble_reply", "late_reply", "unplug", "stall")


@pytest.mark.parametrize("fault", [*CAMERA_FAULTS, *STAGE_FAULTS])
def test_a_fault_of_camera_or_stage_costs_a_try_and_no_frame(undisturbed, fault):
    rig, _ = bench_rig()
    session, plan = started(rig)
    device = rig.still if fault in CAMERA_FAULTS else rig.chain
    device.faults.inject(fault, skip=5 if fault in (*CAMERA_FAULTS, "stall") else 30)
    assert Sequencer(session, plan, rig).run().complete
    assert frames_in(session) == frames_in(undisturbed[0])


def test_a_stage_pushed_during_the_exposure_costs_the_frame(undisturbed):
    rig, _ = bench_rig()
    session, plan = started(rig)
    pushed = []

    def push(event):
        frame = event.objects["planned"]
        if event.facts["step"] == "read back" and frame.kind == "whiteboard" and not pushed:
            rig.chain.displace(1, 1, 30.0)
            pushed.append(frame.id)

    assert Sequencer(session, plan, rig, Acting(step=push)).run().complete
    retry = next(iter(of_kind(session.journal.entries, RetryEntry)))
    assert retry.id == pushed[0]
    assert "off its place" in retry.fault or "home" in retry.fault
    assert frames_in(session) == frames_in(undisturbed[0])


@pytest.mark.parametrize(
    ("fault", "skip", "reason", "attempts"),
    [("busy_forever", 5, "still moves after", 99), ("emergency_stop", 40, "emergency", 1)],
)
def test_a_stage_that_cannot_go_on_stops_the_capture_with_a_reason(fault, skip, reason, attempts):
    rig, _ = bench_rig()
    session, plan = started(rig)
    rig.chain.faults.inject(fault, skip=skip)
    with pytest.raises(GaveUpError, match=reason):
        Sequencer(session, plan, rig).run()
    assert session.journal.entries[-1].kind == "stopped"
    assert not verify(session).damaged
    assert all(e.attempt <= attempts for e in of_kind(session.journal.entries, RetryEntry))


def test_a_disk_that_damages_frames_again_and_again_spends_the_budget_of_the_session():
    rig, _ = bench_rig(ONE_SHOT)
    session, plan = started(rig, ONE_SHOT, retries=Retries(per_session=3))
    spoilt, written = {frame.id for frame in session.frames[:2]}, []

    def spoil(event):
        name = event.facts["id"]
        if name in spoilt:
            session.disk.write(session.path_of(session.stored[name]), b"rot")
            written.append(name)
            assert len(written) < 20, "taken for ever"

    with pytest.raises(GaveUpError, match=r"all 3 retries.*instead of"):
        Sequencer(session, plan, rig, Acting(frame_written=spoil)).run()
    assert len(written) == 4
    assert set(session.stored) == {frame.id for frame in session.frames} - spoilt


def test_the_stage_moves_on_while_a_frame_is_written():
    """The disk holds each frame's write back until the stage has moved to another place."""
    rig = still_rig()
    places = "[[0, 0], [1, 1], [2, 2], [3, 3]]"
    text = SMALL.replace("[[2, 2], [0, 4]]", places).replace("[{}, {}]", "[{}]")
    disk = SimulatedDisk()
    session, plan = started(rig, text, disk)
    moves_when_written = []
    moved = threading.Event()
    move = rig.stage.move_to_um

    def moving(targets_um):
        done = move(targets_um)
        moved.set()
        return done

    boards = [frame.id for frame in session.frames if frame.kind == "whiteboard"]
    last = boards[-1]

    def hold(event):
        frame, step = event.objects["planned"], event.facts["step"]
        if step == "hand over" and frame.kind == "whiteboard":
            moved.clear()
        if step == "write" and frame.kind == "whiteboard" and frame.id != last:
            moves_when_written.append(moved.wait(10))

    rig.stage.move_to_um = moving
    assert Sequencer(session, plan, rig, Acting(step=hold)).run().complete
    assert moves_when_written == [True] * (len(boards) - 1)


def test_a_clock_that_jumps_back_changes_no_span_and_no_order():
    rig = still_rig()
    session, plan = started(rig)
    days = iter(range(1000, 0, -1))
    outcome = Sequencer(session, plan, rig, wall=lambda: f"day {next(days)}").run()
    assert outcome.complete
    for entry in session.stored.values():
        for began_s, ended_s in entry.spans_s.values():
            assert 0 <= began_s <= ended_s
    names = [e.id for e in of_kind(session.journal.entries, FrameEntry)]
    assert names == [frame.id for frame in session.frames]


def test_a_session_goes_on_whose_rig_was_described_by_keys_of_an_earlier_version(tmp_path):
    rig = still_rig()
    earlier = replace(request_for(tmp_path, text=ONE_SHOT), rig={"stands_um": {"focus": 9.0}})
    session = new_session(earlier, planned_frames(earlier, rig))
    Sequencer(session, earlier.plan, rig).run()
    assert begun_session(replace(earlier, rig={"fixed_positions_um": {"focus": 9.0}})) is not None
    with pytest.raises(AppError, match="another rig"):
        begun_session(replace(earlier, rig={"fixed_positions_um": {"focus": 8.0}}))


def resident_bytes():
    """How much memory this process has now; 0 where the system does not tell so simply."""
    statm = Path("/proc/self/statm")
    return int(statm.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") if statm.exists() else 0


@pytest.mark.slow
def test_four_hundred_frames_with_faults_in_one_operation_in_twenty_complete():
    text = """
camera: rgbw-bayer-1shot
shots: [SHOTS]
whiteboards: null
darks: null
retries: {per_frame: 8, per_session: 2000}
""".replace("SHOTS", ", ".join(f"{{mask_um: [{24 * i}, 0], repeats: 50}}" for i in range(8)))
    rig, _ = bench_rig(text)
    disk = SimulatedDisk()
    session, plan = started(rig, text, disk)
    rng = np.random.default_rng(11)
    injected = []

    def sabotage(event):
        where = {
            "move": (rig.chain.faults, STAGE_FAULTS),
            "read back": (rig.chain.faults, ("drop_reply", "garble_reply", "unplug")),
            "expose": (rig.still.faults, CAMERA_FAULTS),
        }.get(event.facts["step"])
        if where is not None and rng.random() < 0.05:
            fault = str(rng.choice(where[1]))
            where[0].inject(fault)
            injected.append(fault)

    def measure(event):
        if event.facts["done"] in (100, 400):
            memory.append(resident_bytes())

    memory = []
    outcome = Sequencer(session, plan, rig, Acting(step=sabotage, frame_written=measure)).run()
    assert outcome.complete
    assert outcome.taken == 400
    assert verify(session).is_complete
    assert len(injected) > 30
    assert outcome.retries > 15
    # What grows is the journal, some kB for each frame, and the disk, which is in memory too.
    assert memory[1] - memory[0] < disk.used_bytes + 300 * 20_000
