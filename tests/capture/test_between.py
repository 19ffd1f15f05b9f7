"""Hooks of a plan: called between frames, they may do much, and lose nothing whatever they do."""

import json
import os
import signal
import subprocess
import sys
import textwrap
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from capture_rigs import begun, still_rig
from simulated_disk import SimulatedDisk

import emmc_rig as emmc
from emmc_rig.captures.between import Between, HookError, load_hook, plain
from emmc_rig.captures.sequencer import Sequencer
from emmc_rig.session.journal import HaltEntry, HookEntry, of_kind
from emmc_rig.session.session import Session
from emmc_rig.session.verify import verify
from emmc_rig.simulators.still import StillStage

ROOT = Path("/disk")
PLAN = """
camera: rgbw-bayer-3shots
shots: [{exposure_s: 0.01}, {mask_um: [48, 24], exposure_s: 0.02}]
whiteboards: {views: [[2, 2], [0, 4]], repeats: 1, references: 2, exposure_s: 0.02}
darks: null
"""


def run(hook, rig=None, session=None, text=PLAN):
    """Return the session of a run with a hook, and how it ended; session: to go on with."""
    rig = rig or still_rig()
    disk = SimulatedDisk() if session is None else session.disk
    if session is None:
        session, plan = begun(ROOT, disk, rig, text)
    else:
        session, plan = Session(session.folder, disk), begun(ROOT, SimulatedDisk(), rig, text)[1]
    between = None if hook is None else Between("lab:hook", hook, __file__)
    return session, Sequencer(session, plan, rig, between=between).run()


def noted(session):
    return of_kind(session.journal.entries, HookEntry)


def test_a_hook_is_called_before_every_frame_and_after_the_last():
    called = []

    def hook(rig, frame, note):
        lamp = rig.attendant.lamp
        called.append((frame and frame.id, len(session_frames()), lamp))
        note(power_w=np.float32(0.5), spectrum=np.arange(3))
        note(bad=float("nan"))

    rig = still_rig()
    disk = SimulatedDisk()
    session, plan = begun(ROOT, disk, rig, PLAN)

    def session_frames():
        """What another program would find on the disk now."""
        return Session(session.folder, disk).stored

    Sequencer(session, plan, rig, between=Between("lab:hook", hook)).run()
    ids = [frame.id for frame in session.frames]
    assert [call[0] for call in called] == [*ids, None]
    # Every frame before is on the disk, and the bench is lit as the next one asks.
    assert [call[1] for call in called] == list(range(len(ids) + 1))
    assert {call[2] for call in called} == {"white"}
    assert [entry.id for entry in noted(session)] == [*ids, ""]
    assert noted(session)[0].notes == {"power_w": 0.5, "spectrum": [0, 1, 2], "bad": "NaN"}
    assert "between" in session.stored[ids[0]].spans_s


@pytest.mark.parametrize("when", [0, 1, 5, 10])
def test_a_hook_that_raises_loses_nothing_and_the_capture_goes_on(when):
    calls = []

    def hook(rig, frame, note):
        calls.append(frame)
        note(call=len(calls))
        if len(calls) == when + 1:
            raise RuntimeError("the meter\nis off")

    rig = still_rig()
    disk = SimulatedDisk()
    session, plan = begun(ROOT, disk, rig, PLAN)
    with pytest.raises(HookError) as fault:
        Sequencer(session, plan, rig, between=Between("lab:hook", hook, __file__)).run()
    name = [*[frame.id for frame in session.frames], None][when]
    ended = f"before frame {name}" if name else "after the last frame"
    line = (
        "between: lab:hook raised RuntimeError: the meter is off \\(test_between.py, line \\d+\\)"
    )
    assert fault.match(f"^{line}, {ended}$")
    assert rig.attendant.lamp == "off"
    assert rig.stage.stops == 1
    again = Session(session.folder, disk)
    assert len(again.stored) == when
    assert not again.is_complete
    assert noted(again)[-1].notes == {"call": when + 1}
    assert "the meter is off" in str(noted(again)[-1])
    before = dict(again.stored)
    rest = []
    again, outcome = run(lambda rig, frame, note: rest.append(frame), session=again)
    assert outcome.complete
    assert again.is_complete
    assert outcome.taken == len(session.frames) - when
    assert {name: again.stored[name] for name in before} == before
    assert rest[-1] is None
    assert verify(again).is_complete


def test_a_hook_ends_the_capture_by_stop_capture_and_what_is_taken_stays():
    def hook(rig, frame, note):
        if frame is not None and frame.kind == "shot":
            raise emmc.StopCapture("the lamp is too weak")

    session, outcome = run(hook)
    assert not outcome.complete
    assert outcome.taken == 4 + 4
    halt = of_kind(session.journal.entries, HaltEntry)[-1]
    assert halt.reason == "lab:hook ended the capture: the lamp is too weak"
    assert run(lambda *_: None, session=session)[1].complete


def test_a_mask_that_a_hook_moved_is_moved_back_before_the_next_frame():
    rig = still_rig()

    def hook(rig, frame, note):
        rig.stage.move_by_um({"mask_x": 30.0})

    # The second of two equal frames is where the first one was sent.
    session, outcome = run(hook, rig, text=PLAN.replace("repeats: 1", "repeats: 2"))
    assert outcome.complete
    assert outcome.retries == 0
    for frame in session.frames:
        entry = session.stored[frame.id]
        for axis, um in frame.bench.offsets_um.items():
            assert entry.read_um[axis] == um


def test_axes_that_a_hook_left_alone_are_not_moved_again():
    moves = []
    for hook in (None, lambda rig, frame, note: None):
        rig = still_rig()
        run(hook, rig)
        moves.append(rig.stage.moves)
    assert moves[0] == moves[1]


def test_a_hook_is_called_again_where_a_fault_made_the_stage_home():
    """A further axis, which the hook has put somewhere, is at its reference after homing."""
    rig = still_rig()
    turned = []

    class Turning(StillStage):
        faults = 1

        def move_to_um(self, targets_um):
            reached = super().move_to_um(targets_um)
            if "aperture_x" in targets_um and self.faults:
                self.faults -= 1
                self.reconnect()  # it forgets where it is
            return reached

    stage = Turning((*rig.stage.axes, "turntable"), rig.clock)
    rig = replace(rig, stage=stage)

    def hook(rig, frame, note):
        if frame is not None:
            rig.stage.move_to_um({"turntable": 5000.0})
            turned.append(frame.id)

    class Camera:
        def __init__(self, camera):
            self._camera = camera

        def __getattr__(self, name):
            return getattr(self._camera, name)

        def snap(self):
            assert stage.position_um("turntable") == 5000.0
            return self._camera.snap()

    rig = replace(rig, camera=Camera(rig.camera))
    session, outcome = run(hook, rig)
    assert outcome.complete
    assert outcome.retries == 1
    assert len(turned) == len(session.frames) + 1


def test_what_a_hook_may_note_is_what_json_keeps():
    assert plain({"b": [1.5, "x"], "c": {"d": np.inf}}) == {"b": [1.5, "x"], "c": {"d": "Infinity"}}
    with pytest.raises(TypeError, match="numbers, texts, lists and mappings, not object"):
        plain({"a": object()})


HOOK = """
from emmc_rig import StopCapture
VALUE = {value}
def hook(rig, frame, note):
    note(value=VALUE, id=frame.id if frame else "end")
class Meter:
    def __call__(self, rig, frame, note): ...
meter = Meter()
def lacking(rig): ...
def turning(rig, frame, note):
    yield
number = 3
"""


def test_a_hook_lies_beside_the_plan_and_is_read_anew_for_every_capture(tmp_path):
    for value in (1, 2):
        (tmp_path / "lab.py").write_text(HOOK.format(value=value))
        hook = load_hook("lab:hook", tmp_path)
        got = {}
        hook.call(still_rig(), None, got.update)
        assert got == {"value": value, "id": "end"}
        assert hook.facts()["file"] == str(tmp_path / "lab.py")
        assert len(hook.facts()["sha256"]) == 64
    assert load_hook("lab:meter", tmp_path).facts() == {"name": "lab:meter"}
    assert not (tmp_path / "__pycache__").exists()


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("nowhere:hook", "there is no nowhere.py in {here} or .*, and no installed module nowhere"),
        ("lab:hok", "AttributeError"),
        ("lab:lacking", "no function of \\(rig, frame, note\\): too many positional"),
        ("lab:number", "no function of \\(rig, frame, note\\): 3 is not a callable"),
        ("lab:turning", "generator or coroutine"),
        ("broken:hook", "SyntaxError"),
        ("needs:hook", "cannot be loaded: No module named 'pyvisa_of_another'"),
        ("leaves:hook", "SystemExit"),
        ("'lab:'", "write module:function, as lab:hook, not 'lab:'"),
        ("../lab:hook", "write module:function, as lab:hook"),
        ("lab", "write module:function, or the name of an entry point"),
    ],
)
def test_a_hook_that_cannot_be_used_is_refused_in_one_line_before_anything_is_made(
    tmp_path, name, says
):
    (tmp_path / "lab.py").write_text(HOOK.format(value=1))
    (tmp_path / "broken.py").write_text("def hook(:")
    (tmp_path / "needs.py").write_text("import pyvisa_of_another")
    (tmp_path / "leaves.py").write_text("raise SystemExit(3)")
    plan = tmp_path / "plan.yaml"
    plan.write_text(PLAN + f"between: {name}\n")
    rig = emmc.rig("simulated", scene="near-planar", size=(24, 32), rays=16)
    with pytest.raises(emmc.ERRORS, match=says.format(here=tmp_path)) as fault:
        emmc.capture(plan, rig)
    assert "\n" not in str(fault.value)
    assert "between: " in str(fault.value)
    assert not (tmp_path / "plan-session").exists()


HANGS = """
import time
def hook(rig, frame, note):
    if frame is not None and frame.id == "shot-1-e0-r0":
        note(waiting=True)
        print("hangs", flush=True)
        while True:
            time.sleep(0.05)
"""


@pytest.mark.slow
def test_ctrl_c_ends_a_hook_that_hangs_and_nothing_is_lost(tmp_path):
    plan = "camera: rgbw-bayer-2shots\nshots: [{exposure_s: 0.05}, {exposure_s: 0.05}]\n"
    plan += "whiteboards: null\ndarks: null\n"
    (tmp_path / "plan.yaml").write_text(plan + "between: lab:hook\n")
    (tmp_path / "lab.py").write_text(HANGS)
    run = textwrap.dedent(
        """
        import emmc_rig as emmc
        rig = emmc.rig("simulated", scene="near-planar", size=(24, 32), rays=16)
        try:
            emmc.capture("plan.yaml", rig)
        except emmc.ERRORS as fault:
            print(fault, flush=True)
        """
    )
    process = subprocess.Popen(
        [sys.executable, "-c", run], cwd=tmp_path, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "hangs\n"
    os.kill(process.pid, signal.SIGINT)
    out, _ = process.communicate(timeout=60)
    assert out.startswith("stopped at once; what was captured is kept")
    session = emmc.Session(tmp_path / "plan-session")
    assert list(session.stored) == ["shot-0-e0-r0"]
    last = noted(session)[-1]
    assert (last.id, last.fault, last.notes) == ("shot-1-e0-r0", "stopped", {"waiting": True})
    (tmp_path / "lab.py").write_text("def hook(rig, frame, note): ...")
    assert emmc.capture(session.folder).is_complete
    run_lines = [
        json.loads(line) for line in (session.folder / "journal.jsonl").read_text().splitlines()
    ]
    digests = [line["between"]["sha256"] for line in run_lines if line["kind"] == "run"]
    assert len(set(digests)) == 2
