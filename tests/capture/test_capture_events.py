"""What a capture tells a lab's own code, and what makes it wait: events, pauses, time left."""

import json
from pathlib import Path

import pytest
import yaml
from capture_rigs import begun, still_rig
from simulated_disk import SimulatedDisk

import emmc_rig as emmc
from emmc_rig.captures.control import Control
from emmc_rig.captures.events import Listener
from emmc_rig.captures.metering import Exposures
from emmc_rig.captures.plan import load_plan
from emmc_rig.captures.schedule import Pace
from emmc_rig.captures.sequencer import Sequencer

PLAN = {
    "camera": "rgbw-bayer-2shots",
    "shots": [{"exposure_s": "auto"}, {"exposure_s": 0.002}],
    "whiteboards": {"views": [[2, 2]], "repeats": 1, "references": 2},
    "darks": {"repeats": 2},
}


@pytest.fixture
def plan(tmp_path):
    path = tmp_path / "plan.yaml"
    path.write_text(yaml.safe_dump(PLAN))
    return path


def quick_rig():
    return emmc.rig("simulated", scene="near-planar", size=(24, 32), rays=16)


def test_a_callback_hears_of_every_frame_shot_and_verdict_in_order(plan):
    heard = []
    session = emmc.capture(plan, quick_rig(), on_event=heard.append)
    names = [event.name for event in heard]
    assert names[0] == "begin"
    assert names[-2:] == ["verdict", "end"]
    for name in ("frame.taken", "frame.written"):
        ids = [event.facts["id"] for event in heard if event.name == name]
        assert sorted(ids) == sorted(session.stored)
    assert [event.facts["shot"] for event in heard if event.name == "shot.done"] == [0, 1]
    written = [event.facts["done"] for event in heard if event.name == "frame.written"]
    assert written == list(range(1, len(session.stored) + 1))
    verdict, end = heard[-2].facts, heard[-1].facts
    assert verdict["level"] == "doubt"  # the second shot is exposed for 2 ms
    assert "shot 2" in verdict["reasons"][0]["what"]
    assert (end["complete"], end["missing"]) == (True, 0)
    assert all(json.loads(event.line())["event"] == event.name for event in heard)
    said = [event.facts["text"] for event in heard if event.name == "message"]
    assert any(text.startswith("shot 1 exposure ") for text in said)


def test_a_callback_that_raises_ends_no_capture_and_is_not_called_again(plan):
    calls = []

    def broken(event):
        calls.append(event.name)
        raise RuntimeError("the lab's own code")

    assert emmc.capture(plan, quick_rig(), on_event=broken).is_complete
    assert calls == ["begin"]


class Pausing(Control):
    """Is paused after so many looks of the sequencer, for so many waits that take no time."""

    def __init__(self, after, waits):
        self.looks, self.after, self.waits = 0, after, waits
        super().__init__()

    @property
    def paused(self):
        self.looks += 1
        return self.looks > self.after and self.waits > 0

    @paused.setter
    def paused(self, value):
        pass

    def wait(self):
        self.waits -= 1


def test_a_pause_holds_the_run_before_the_next_frame_and_is_journalled():
    heard, control, rig = [], Pausing(after=3, waits=2), still_rig()
    session, plan = begun(Path("/disk"), SimulatedDisk(), rig)
    outcome = Sequencer(session, plan, rig, Listener(heard.append), control).run()
    assert outcome.complete
    assert control.waits == 0
    names = [event.name for event in heard]
    assert names.count("pause") == names.count("resume") == 1
    assert names[names.index("pause") + 1] != "frame.taken"
    reasons = [event.facts["reason"] for event in heard if event.name == "pause"]
    assert reasons == ["somebody asked for it"]
    kinds = [entry.kind for entry in session.journal.entries]
    assert kinds.index("paused") < kinds.index("resumed")


def test_a_capture_that_is_paused_can_be_stopped():
    class Stopped(Control):
        def wait(self):
            self.stop()

    control, rig = Stopped(), still_rig()
    control.pause()
    session, plan = begun(Path("/disk"), SimulatedDisk(), rig)
    outcome = Sequencer(session, plan, rig, control=control).run()
    assert not outcome.complete
    assert not session.stored


def test_the_estimate_knows_what_was_metered(plan):
    first = emmc.capture(plan, quick_rig())
    planned, pace = load_plan(plan), Pace({}, 0.0, 1000)
    frames = [frame for frame in first.frames if not frame.is_optional]
    unknown = pace.estimate(frames, Exposures(planned).known_s)
    assert unknown.guessed == sum(frame.exposure_s is None for frame in frames)
    truly_s = sum(entry.exposure_s for entry in first.stored.values())
    known = pace.estimate(frames, Exposures(planned, first).known_s)
    assert known.guessed == 0
    assert known.exposing_s == pytest.approx(truly_s, rel=0.02)
    assert unknown.exposing_s < truly_s / 2


def test_what_a_frame_costs_beside_its_exposure_is_learnt():
    pace = Pace({}, 0.0, 1000)
    for _ in range(100):
        pace.learn(2.5, exposure_s=2.0, moving_s=0.1)
    frames = begun(Path("/disk"), SimulatedDisk(), still_rig())[0].frames
    reported = pace.estimate(frames, lambda frame: 0.0)
    assert reported.downloading_s == pytest.approx(0.4 * len(frames), rel=0.01)
