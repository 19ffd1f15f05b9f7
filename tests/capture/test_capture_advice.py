"""Errors that a capture can end in: their advice, carried out, ends in a complete session.

A walk brings the fault about, yields what the program said, and does as it says.
"""

import errno
import hashlib
import inspect
import io
import os
import shutil
import signal
from contextlib import contextmanager
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import typer
import yaml
from capture_rigs import BLACK, WHITE, NamedFrames, still_rig
from programs import done, one_line

import emmc_rig
import emmc_rig.drivers.errors
from emmc_rig import cli
from emmc_rig.bench.hands import AskingAttendant
from emmc_rig.bench.rig_config import opened_rig
from emmc_rig.captures import engine
from emmc_rig.captures import run as capture_run
from emmc_rig.captures.faults import HOPELESS, SaturatedError
from emmc_rig.drivers.dng import encode_dng
from emmc_rig.drivers.errors import DriverError
from emmc_rig.model.files import Disk
from emmc_rig.session import session as session_module
from emmc_rig.session.board_sets import whiteboards
from emmc_rig.session.journal import RetryEntry, of_kind
from emmc_rig.session.lock import held
from emmc_rig.session.session import Session
from emmc_rig.session.verify import verify

PLAN = {
    "camera": "rgbw-bayer-3shots",
    "shots": [{"exposure_s": 0.01}, {"exposure_s": 0.02}],
    "whiteboards": {"views": [[2, 2]], "repeats": 1, "references": 2, "exposure_s": 0.02},
    "darks": {"repeats": 2},
    "retries": {"per_frame": 1},
}
CAPTURE = ("capture", "plan.yaml", "--rig", "simulated")
AGAIN = "shot-1-e0-r0"
"""The last frame of the plan."""
WALKS = {}
WRITTEN = {}
"""The plan of `emmc-rig calibrate --plan`, once written: it takes seconds."""


def walk(text):
    """Register a walk by a part of the text that the program says, as it is in the source."""

    def registered(function):
        WALKS[text] = function
        return function

    return registered


class Light(NamedFrames):
    """Frames of their own name again, whose brightness is the exposure's, and what goes wrong.

    factor: by the beginning of a frame's name, what its light is multiplied with. faults: errors to
    be raised by the beginning of the frame's name. swapped: names of the frames shown, by name.
    """

    def __init__(self):
        super().__init__()
        self.factor, self.faults, self.swapped, self.last = {}, {}, {}, b""
        self.repeats = False

    def capture(self, exposure_s):
        for start, fault in self.faults.items():
            if self.name.startswith(start):
                raise fault
        if self.repeats and self.last:
            return self.last
        name = self.swapped.get(self.name, self.name)
        digest = hashlib.sha256(name.encode()).digest()
        rng = np.random.default_rng(int.from_bytes(digest[:8], "big"))
        factor = next((f for start, f in self.factor.items() if name.startswith(start)), 1.0)
        span = factor * 20 if name.startswith("dark") else factor * 1e5 * min(exposure_s, 0.03)
        counts = BLACK + span * rng.uniform(0.5, 1.0, self.size)
        counts = np.clip(counts, BLACK, WHITE).astype(np.uint16)
        self.last = encode_dng(counts, "rggb", BLACK, WHITE, exposure_s)
        return self.last


class Bench:
    """A folder with a plan, a rig in it, and the program."""

    def __init__(self, folder, run, patch):
        self.folder, self.run, self.patch = folder, run, patch
        self.light = Light()
        self.rig = still_rig()
        self.finish = CAPTURE
        self.session = folder / "plan-session"
        patch.setattr(capture_run, "opened_rig", self.opened)
        self.plan()

    @contextmanager
    def opened(self, description, camera, ask):
        device = self.rig.camera
        device._transport = self.light
        self.light.last = b""
        yield replace(self.rig, about_to_expose=self.light.announce, reopen_camera=None)

    def plan(self, path="plan.yaml", **changes):
        """Write the plan, changed; None leaves a key out."""
        settings = {**PLAN, **changes}
        (self.folder / path).write_text(yaml.safe_dump(settings))

    def small_camera(self, **changes):
        """Write a camera of few views, and a plan for it."""
        camera = {
            "title": "few views",
            "views": [3, 3],
            "sensor": {"cfa": "rggb"},
            "masks": {"mask": MASK},
            "more_shots_step_um": {"mask": [270, 162]},
        }
        (self.folder / "camera.yaml").write_text(yaml.safe_dump(camera))
        self.plan(camera="camera.yaml", **changes)

    def refused(self, *arguments):
        """Run the program, by default the capture, and return the one line that it ends with."""
        code, _, err = self.run(*(arguments or self.finish))
        assert code in (1, 130), err
        return one_line(err)

    def begun(self):
        """Take all frames but the last one."""
        self.light.faults[AGAIN] = DriverError("a cable is loose", "fix it")
        self.refused()
        self.light.faults.clear()
        assert len(Session(self.session).missing()) == 1


@pytest.fixture(scope="module")
def quick_cli():
    """The command line, put together once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cli, "app", typer.main.get_command(cli.app))
        yield


@pytest.fixture
def bench(tmp_path, run, monkeypatch, quick_cli):
    return Bench(tmp_path, run, monkeypatch)


# What the plan says: the text, what is wrong, and what follows the advice.


def boards(**changes):
    return {"whiteboards": {**PLAN["whiteboards"], **changes}}


MASK = {"distance_mm": 0.24, "cell_um": 24.0, "pattern": {"kind": "random_rgbw", "seed": 0}}
TWO_MASKS = {
    "title": "two masks",
    "views": [5, 5],
    "sensor": {"cfa": "rggb"},
    "masks": {"near": MASK, "far": {**MASK, "distance_mm": 0.48}},
    "shots": [{"offset_um": {"near": [0, 0], "far": [24, 0]}}],
}
ONE = {"exposure_s": 0.01}
STANDING = {"camera": "coded-aperture-random", "shots": [ONE]}
PLAIN = {"views": [], "references": 2, "exposure_s": 0.02}
CHANGING = {"camera": "coded-aperture-sequential-random"}
FILM = {"frames": 3, "rate": 1}
PLACES = [{**ONE, "mask_um": [0, 0]}, {**ONE, "mask_um": [48, 0]}]
PLANS = {
    "whiteboards.views: [": (boards(views=[[7, 2]]), boards(views=[[4, 2]])),
    " uncovers none of the camera's ": (
        boards(open=[{"window": [0, 5]}]), boards(open=[{"window": [0, 0]}]),
    ),
    "needs to know where the window's edges are": (
        boards(open=[{"window": [0, 2]}]), boards(open=[{"window": [0, 0]}]),
    ),
    "write 0, or 2 or more: one frame does not tell its own noise": (
        {"darks": {**PLAN["darks"], "of_shots": 1}}, {"darks": {**PLAN["darks"], "of_shots": 2}},
    ),
    "write each turn once": (
        {"whiteboards": {"views": [], "turned": 1, "turns_deg": [90, 90]}}, {},
    ),
    " shots, from 0": (boards(shots=[0, 2]), boards(shots=[0, 1])),
    "no mask of this camera moves: leave it out": (
        {**STANDING, "whiteboards": {**PLAIN, "open": [{"mask_um": [9, 9]}]}},
        {**STANDING, "whiteboards": {**PLAIN, "open": [{}]}},
    ),
    "the camera has no mask to move: leave its place out": (
        {"camera": "conventional", "shots": [{**ONE, "mask_um": [1, 1]}]},
        {"camera": "conventional", "shots": [ONE]},
    ),
    "give mask_um or mask_cells, not both": (
        {"shots": [{"mask_um": [1, 1], "mask_cells": [1, 1]}]}, {"shots": [{"mask_um": [1, 1]}]},
    ),
    "moves two masks apart, the rig has one mask stage": (
        {"camera": "camera.yaml", "shots": [ONE]},
        {"camera": "camera.yaml", "shots": [{**ONE, "mask_um": [24, 0]}]},
    ),
    "so that camera_shot has no effect: leave it out": (
        {**CHANGING, "shots": [{**ONE, "camera_shot": 1}]}, {**CHANGING, "shots": [ONE]},
    ),
    "film: its frames are exposed alike and once": (
        {"film": FILM, "shots": [{**ONE, "repeats": 2}]}, {"film": FILM, "shots": [ONE]},
    ),
    ": lower film.rate from ": (
        {"film": {**FILM, "rate": 8}, "shots": PLACES}, {"film": FILM, "shots": PLACES},
    ),
    "film: its shots differ in what somebody does by hand": (
        {**CHANGING, "film": FILM, "shots": [ONE, ONE]}, {**CHANGING, "film": FILM, "shots": [ONE]},
    ),
}  # fmt: skip


def plan_that_is_mended(bench, wrong, right):
    (bench.folder / "camera.yaml").write_text(yaml.safe_dump(TWO_MASKS))
    bench.plan(**wrong)
    yield bench.refused()
    bench.plan(**right)


WALKS |= {text: partial(plan_that_is_mended, wrong=a, right=b) for text, (a, b) in PLANS.items()}


# A target, which needs a choice; that the plan has one then, the dry run says.


def accepted_with_a_target(bench):
    done(bench.run(*CAPTURE, "--until", "30dB", "--dry-run"))


@walk("the plan has one shot, so that no shot can be saved")
def a_target_without_a_choice(bench):
    bench.plan(shots=[{"exposure_s": 0.01}])
    yield bench.refused(*CAPTURE, "--until", "30dB")
    bench.plan(shots=[{"exposure_s": 0.01}, {"mask_um": [270, 162]}], whiteboards={})
    accepted_with_a_target(bench)
    bench.plan(shots=[{"exposure_s": 0.01}, {"exposure_s": 0.01, "mask_um": [270, 162]}])


BEYOND_PSI = {
    ", so that the Psi of its shots cannot be measured": {"darks": None},
    "the plan has neither open whiteboards nor the pinhole": {},
    "no open whiteboard of the plan has `validation: true`": boards(open=[{"repeats": 1}]),
}


def a_target_without_psi(bench, changes):
    bench.small_camera(**changes)
    yield bench.refused(*CAPTURE, "--until", "30dB")
    calibration_plan(bench)


WALKS |= {text: partial(a_target_without_psi, changes=c) for text, c in BEYOND_PSI.items()}


def calibration_plan(bench):
    """Take the whiteboards of the plan that `emmc-rig calibrate --plan` writes, as advised."""
    if not WRITTEN:
        arguments = ("calibrate", "--plan", "--camera", "camera.yaml", "--size", "16x20")
        done(bench.run(*arguments))
        path = bench.folder / "emmc-calibration" / "plan.yaml"
        WRITTEN.update(yaml.safe_load(path.read_text()))
    bench.small_camera(whiteboards=WRITTEN["whiteboards"], darks=WRITTEN["darks"])
    accepted_with_a_target(bench)


# What the devices can not do.


@walk(": the camera exposes from ")
def an_exposure_beyond_the_camera(bench):
    bench.plan(shots=[{"exposure_s": 7200.0}])
    line = bench.refused(*CAPTURE, "--dry-run")
    assert "change shots.0.exposure_s in the plan" in line
    assert bench.refused() == line
    assert not bench.session.exists()
    yield line
    bench.plan(shots=[{"exposure_s": 0.02}])


BEYOND = {
    ": the camera's gain goes from ": (
        "change shots.1.gain in the plan",
        {"shots": [ONE, {**ONE, "gain": 8}]}, {"shots": [ONE, {**ONE, "gain": 1}]},
    ),
    " um from its zero (": (
        "mask_x", {"shots": [{**ONE, "mask_um": [90_000, 0]}]},
        {"shots": [{**ONE, "mask_um": [9_000, 0]}]},
    ),
}  # fmt: skip


def plan_beyond_a_device(bench, words, wrong, right):
    bench.plan(**wrong)
    line = bench.refused(*CAPTURE, "--dry-run")
    assert words in line
    yield line
    bench.plan(**right)


WALKS |= {text: partial(plan_beyond_a_device, words=w, wrong=a, right=b)
          for text, (w, a, b) in BEYOND.items()}  # fmt: skip


@walk(" needs a stage axis '")
def a_stage_without_an_axis(bench):
    zero_um = bench.rig.zero_um
    bench.rig = replace(bench.rig, zero_um={k: um for k, um in zero_um.items() if k != "mask_y"})
    yield bench.refused(*CAPTURE, "--dry-run")
    bench.rig = replace(bench.rig, zero_um=zero_um)


def command_that_is_mended(bench, wrong, plan=None, then=None):
    """Run a command that is refused; plan: its changes. then: arguments that are right."""
    bench.plan(**(plan or {}))
    yield bench.refused(*wrong)
    if then is not None:
        done(bench.run(*then))


NEW = ("capture", "--new", PLAN["camera"])
OTHER = (*NEW, "--out", "other.yaml")
WALKS |= {
    text: partial(command_that_is_mended, **walk)
    for text, walk in {
        ": write simulated, or the name of a YAML file of devices": {
            "wrong": ("capture", "plan.yaml", "--rig", "real")
        },
        "say which rig: simulated": {"wrong": ("capture", "plan.yaml")},
        "a film is taken to its end": {
            "wrong": (*CAPTURE, "--until", "30dB"), "plan": {"film": FILM, "shots": [ONE]},
        },
        ": exists already; choose another name, or move it away first": {
            "wrong": NEW, "then": OTHER
        },
        "); choose another place": {
            "wrong": (*NEW, "--out", "nowhere/plan.yaml"), "then": OTHER
        },
    }.items()
}  # fmt: skip


# Frames that cannot be right.


@walk("is saturated in ")
def a_shot_that_is_too_bright(bench):
    bench.light.factor = {AGAIN: 10.0}
    line = bench.refused()
    assert "lower shots.1.exposure_s in the plan" in line
    before = Session(bench.session)
    assert not [e for e in of_kind(before.journal.entries, RetryEntry) if e.attempt > 1]
    yield line
    bench.plan(shots=[{"exposure_s": 0.01}, {"exposure_s": 0.002}])
    code, out, err = bench.run(*CAPTURE)
    assert code == 0, err
    assert "9 frames taken stay" in err
    assert "1 taken in" in out
    code, out, _ = bench.run("session", "show", "plan-session")
    assert "plan 0       9 frames, by plan.yaml" in out
    assert "plan 1       1 frames, by amended-1-plan.yaml" in out
    after = Session(bench.session)
    assert after.stored[AGAIN].exposure_s == 0.002
    assert all(after.stored[name] == entry for name, entry in before.stored.items())


def attribute_that_is_put_back(bench, place, name, value):
    """Change an attribute of a device; value: made of the honest one."""
    honest = getattr(place(bench), name)
    setattr(place(bench), name, value(honest))
    yield bench.refused()
    setattr(place(bench), name, honest)


def light(bench):
    return bench.light


DEVICES = {
    "is black, its brightest pixels ": (light, "factor", lambda _: {AGAIN: 0.0}),
    "is identical to the frame before it": (light, "repeats", lambda _: True),
    "would be exposed for ": (
        lambda bench: bench.rig.camera, "set_exposure_s",
        lambda honest: lambda exposure_s: honest(4 * exposure_s),
    ),
    "was exposed while ": (
        lambda bench: bench.rig.stage, "position_um",
        lambda honest: lambda axis: honest(axis) + 9.0,
    ),
}  # fmt: skip
"""Attributes of camera, stage and light while something is wrong with them."""
WALKS |= {
    text: partial(attribute_that_is_put_back, place=place, name=name, value=value)
    for text, (place, name, value) in DEVICES.items()
}


@walk("is not dark, on average ")
def a_lamp_left_on(bench):
    bench.light.factor = {"dark": 100.0}
    yield bench.refused()
    assert not bench.session.exists()
    bench.light.factor = {}


def loose_cable(bench, **plan):
    bench.plan(**plan)
    bench.light.faults[AGAIN] = DriverError("a cable is loose", "fix it")
    yield bench.refused()
    bench.light.faults.clear()


WALKS |= {
    "gave up after ": loose_cable,
    " retries of the session are spent": partial(loose_cable, retries={"per_session": 0}),
}


@walk("the bench has changed: frame ")
def a_board_that_was_moved(bench):
    bench.begun()
    bench.light.swapped = {"board-s1-v2-u2-white-r0": "elsewhere"}
    bench.light.swapped |= {"board-s0-v2-u2-white-r0": "elsewhere"}
    yield bench.refused()
    bench.light.swapped = {}


@walk("its bytes changed in this computer's memory")
def memory_that_loses_bits(bench):
    class Spoilt(Session):
        def store(self, frame, file, entry):
            super().store(frame, replace(file, sha256=file.sha256[::-1]), entry)

    bench.patch.setattr(capture_run, "Session", Spoilt)
    yield bench.refused()
    bench.patch.setattr(capture_run, "Session", Session)


# What lies in the folder.


@walk("name a plan, or write one by --new CAMERA")
def no_argument(bench):
    code, _, err = bench.run("capture")
    assert code == 2
    yield " ".join(err.split())


@walk(": no such file; write a plan")
def no_plan(bench):
    (bench.folder / "plan.yaml").unlink()
    yield bench.refused()
    assert bench.run("capture", "--new", PLAN["camera"])[0] == 0
    written = yaml.safe_load((bench.folder / "plan.yaml").read_text())
    bench.plan(camera=written["camera"])


@walk("holds something other than a session; name another folder")
def a_folder_of_something_else(bench):
    (bench.folder / "mine").mkdir()
    (bench.folder / "mine" / "thesis.txt").write_text("mine")
    yield bench.refused(*CAPTURE, "--out", "mine")
    bench.finish = (*CAPTURE, "--out", "other")
    bench.session = bench.folder / "other"


def session_that_is_restored(bench, harm):
    bench.begun()
    shutil.copytree(bench.session, bench.folder / "copy")
    harm(bench.session)
    yield bench.refused()
    shutil.rmtree(bench.session)
    shutil.copytree(bench.folder / "copy", bench.session)


def damage_journal(session):
    journal = session / "journal.jsonl"
    journal.write_bytes(b"x" + journal.read_bytes())


HARM = {
    " is gone; restore it from a copy, or name another folder": (
        lambda session: (session / "journal.jsonl").unlink()
    ),
    ": its first line is damaged; restore it from a copy": damage_journal,
    ": was changed after the session began; restore it from a copy": (
        lambda session: (session / "camera.json").write_text("{}")
    ),
    "); restore it from a copy": lambda session: (session / "frames.json").unlink(),
}
WALKS |= {text: partial(session_that_is_restored, harm=harm) for text, harm in HARM.items()}


@walk(": made by a later emmc-rig; update this one")
def a_session_of_a_later_program(bench):
    with pytest.MonkeyPatch.context() as later:
        later.setattr(session_module, "FORMAT", session_module.FORMAT + 1)
        bench.begun()
    yield bench.refused()
    bench.patch.setattr(session_module, "FORMAT", session_module.FORMAT + 1)


def raises(code):
    def refuse(*arguments):
        raise OSError(code, os.strerror(code))

    return refuse


def disk_that_fails(bench, name, refuse, begun=False):
    if begun:
        bench.begun()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Disk, name, refuse)
        line = bench.refused()
    assert begun or not bench.session.exists()
    yield line


WALKS |= {
    "); correct that": partial(disk_that_fails, name="read", refuse=raises(errno.EIO), begun=True),
    "); correct that, or name another folder": partial(
        disk_that_fails, name="make_folder", refuse=raises(errno.EROFS)
    ),
    " are free; make room, or name another folder": partial(
        disk_that_fails, name="free_bytes", refuse=lambda disk, folder: 1000
    ),
}


@walk("make that possible, or name another folder")
def a_lock_that_cannot_be_written(bench):
    lock = bench.folder / ".plan-session.lock"
    lock.mkdir()
    yield bench.refused()
    lock.rmdir()


@walk("); name another folder")
def a_file_among_the_folders_above(bench):
    yield bench.refused(*CAPTURE, "--out", "plan.yaml/in/it")
    bench.finish = (*CAPTURE, "--out", "other")
    bench.session = bench.folder / "other"


@walk(": held by ")
def another_program_at_work(bench):
    with held(bench.session):
        line = bench.refused()
    assert f"(process {os.getpid()} on " in line
    yield line


@walk(", then run the same command to go on; ")
def a_disk_that_fills(bench):
    honest = Disk.write

    def filling(disk, path, data):
        if AGAIN in path.name:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return honest(disk, path, data)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Disk, "write", filling)
        line = bench.refused()
    assert "9 of 10 frames are safe" in line
    yield line


# Going on with something else than what frames were taken by.


@walk("; name no rig, or begin another session")
def another_rig(bench):
    bench.begun()
    yield bench.refused(*CAPTURE, "--scene", "dark")
    bench.finish = ("capture", "plan.yaml")


@walk("connect that one, ")
def another_camera(bench):
    bench.begun()
    camera = bench.rig.camera
    identity = camera.identity
    camera.identity = replace(identity, serial="8")
    yield bench.refused()
    camera.identity = identity


def edit_that_is_taken_back(bench, edit):
    bench.begun()
    bench.plan(**edit)
    yield bench.refused()
    bench.plan()


EDITS = {
    "the camera was edited since session ": {"camera": "rgbw-bayer-2shots"},
    "frames of this shot are taken in session ": {"shots": [{**ONE, "mask_um": [9, 9]}, ONE]},
    " is taken, and the edited plan has ": {"shots": [{**ONE, "lamp": "red"}, ONE]},
}
WALKS |= {text: partial(edit_that_is_taken_back, edit=edit) for text, edit in EDITS.items()}


@walk("shots: a mask has another pattern in every shot")
def more_shots_of_changing_patterns(bench):
    camera = "coded-aperture-sequential-random"
    bench.plan(camera=camera)
    bench.begun()
    bench.plan(camera=camera, shots=[*PLAN["shots"], {"exposure_s": 0.01}])
    yield bench.refused()
    bench.plan(camera=camera)


# What somebody did.


@walk(" frames are still to be taken")
def a_stop_after_the_frame(bench):
    honest = engine.check

    def stopping(planned, *rest):
        if planned.id == "dark-0-r1":
            signal.raise_signal(signal.SIGINT)
        return honest(planned, *rest)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(engine, "check", stopping)
        line = bench.refused()
    bench.finish = ("capture", "plan-session")
    yield line


@walk("stopped at once; ")
def a_stop_at_once(bench):
    bench.light.faults["shot"] = KeyboardInterrupt()
    line = bench.refused()
    bench.light.faults.clear()
    bench.finish = ("capture", "plan-session")
    yield line


@walk("run this on a terminal, or automate the lamp and masks")
def work_by_hand_without_a_terminal(bench):
    quiet = bench.rig
    opened = bench.opened

    @contextmanager
    def by_hand(description, camera, ask):
        bench.rig = replace(quiet, attendant=AskingAttendant(camera, ask))
        with opened(description, camera, ask) as rig:
            yield rig

    bench.patch.setattr(capture_run, "opened_rig", by_hand)
    bench.patch.setattr("sys.stdin", io.StringIO())
    yield bench.refused()
    assert not bench.session.exists()
    terminal = io.StringIO("\n" * 40)
    terminal.isatty = lambda: True
    bench.patch.setattr("sys.stdin", terminal)


@walk(" frames by number and exposures; name them after the frames")
def a_recording_of_two_files_for_each_frame(bench):
    assert bench.run(*CAPTURE)[0] == 0
    recorded = bench.folder / "recorded"
    (bench.session / "frames").rename(recorded)
    shutil.rmtree(bench.session)
    bench.patch.setattr(capture_run, "opened_rig", opened_rig)
    rig = {"stage": "simulated", "camera": f"folder:{recorded}", "by_hand": False}
    (bench.folder / "rig.yaml").write_text(yaml.safe_dump(rig))
    bench.finish = ("capture", "plan.yaml", "--rig", "rig.yaml")
    theirs = {
        path.rename(recorded / f"{number}.dng"): path
        for number, path in enumerate(sorted(recorded.iterdir()))
    }
    for path in theirs:
        shutil.copy(path, path.with_stem(f"again-{path.stem}"))
    yield bench.refused()
    for path, named in theirs.items():
        path.rename(named)


def test_repeats_that_an_edit_made_different_are_averaged_where_most_are_alike(bench):
    bench.plan(**boards(references=3))
    bench.light.factor = {"reference-s0-white-r1": 10.0}
    assert "lower whiteboards.exposure_s in the plan" in bench.refused()
    bench.light.factor = {}
    bench.plan(**boards(references=3, exposure_s=0.01))
    assert bench.run(*CAPTURE)[0] == 0
    references = whiteboards(Session(bench.session)).references
    assert (references[0, "white"].exposure_s, references[0, "white"].count) == (0.01, 2)
    assert (references[1, "white"].exposure_s, references[1, "white"].count) == (0.01, 3)


def sample(kind):
    """An error of the drivers, made of values that its signature takes."""
    values = {str: "x", int: 1, float: 1.0, bytes: b"x", tuple[float, float]: (0.0, 1.0)}
    values_taken = [
        values.get(taken.annotation, ("x",))
        for taken in inspect.signature(kind).parameters.values()
        if taken.kind == taken.POSITIONAL_OR_KEYWORD and taken.default is taken.empty
    ]
    return kind(*values_taken)


def test_a_capture_goes_on_after_any_fault_of_a_device_that_was_mended(bench):
    kinds = [
        kind
        for kind in vars(emmc_rig.drivers.errors).values()
        if inspect.isclass(kind) and issubclass(kind, DriverError)
    ]
    assert set(HOPELESS) - set(kinds) == {SaturatedError}
    bench.begun()
    bench.rig.stage.reconnect = lambda: None
    for kind in kinds:
        fault = sample(kind)
        bench.light.faults[AGAIN] = fault
        line = bench.refused()
        assert str(fault) in line
        assert "frames kept: 9; correct it, then run the same command" in line
        retries = of_kind(Session(bench.session).journal.entries, RetryEntry)
        assert retries[-1].attempt == (1 if isinstance(fault, HOPELESS) else 2)
    bench.light.faults.clear()
    assert bench.run(*CAPTURE)[0] == 0
    assert verify(Session(bench.session)).is_complete


@pytest.mark.slow
@pytest.mark.parametrize("text", WALKS)
def test_advice_carried_out_ends_in_a_complete_session(bench, text):
    steps = WALKS[text](bench)
    line = next(steps)
    assert text in line
    assert next(steps, None) is None
    out = done(bench.run(*bench.finish))
    assert "complete: " in out
    verdict = verify(Session(bench.session))
    assert verdict.is_complete
    assert not verdict.leftovers
