"""What a capture tells a lab's own code, and what makes it wait: events, conditions, time left."""

import json
from pathlib import Path

import pytest
import yaml
from capture_rigs import begun, still_rig
from simulated_disk import SimulatedDisk

import emmc_rig as emmc
from drivers.errors import DriverError
from emmc_rig.acquisition.control import Control
from emmc_rig.acquisition.estimate import Exposures, Pace, known_exposures, last_session
from emmc_rig.acquisition.events import EventWatcher
from emmc_rig.acquisition.metering import first_meterings
from emmc_rig.acquisition.plan import Suspender, load_plan
from emmc_rig.acquisition.sequencer import Sequencer
from emmc_rig.acquisition.suspend import suspended_by
from emmc_rig.errors import AppError
from emmc_rig.session.journal import metered

PLAN = {
    "camera": "rgbw-bayer-2shots",
    "shots": [{"exposure_s": "auto"}, {"exposure_s": 0.002}],
    "whiteboards": {"views": [[2, 2]], "repeats": 1, "references": 2},
    "darks": {"repeats": 2},
}


class Impatient(Control):
    """Counts the waits, and takes no time over them."""

    def __init__(self):
        super().__init__()
        self.waits = 0

    def wait(self):
        self.waits += 1


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
    assert "shot 1" in verdict["reasons"][0]["what"]
    assert (end["complete"], end["missing"]) == (True, 0)
    assert all(json.loads(event.line())["event"] == event.name for event in heard)
    assert any("metered" in event.facts["text"] for event in heard if event.name == "message")


def test_a_callback_that_raises_ends_no_capture_and_is_not_called_again(plan):
    calls = []

    def broken(event):
        calls.append(event.name)
        raise RuntimeError("the lab's own code")

    assert emmc.capture(plan, quick_rig(), on_event=broken).is_complete
    assert calls == ["begin"]


def test_a_condition_out_of_range_pauses_the_run_before_the_next_frame_and_resumes_it():
    answers = iter(["", "", "the lamp is at 0.8", "the lamp is at 0.9", ""])
    heard, control, rig = [], Impatient(), still_rig()
    session, plan = begun(Path("/disk"), SimulatedDisk(), rig)
    outcome = Sequencer(
        session,
        plan,
        rig,
        EventWatcher(heard.append),
        control,
        suspended=lambda: next(answers, ""),
    ).run()
    assert outcome.complete
    assert control.waits == 2
    names = [event.name for event in heard]
    assert names[names.index("pause") + 1] != "frame.taken"
    assert [event.facts["reason"] for event in heard if event.name == "pause"] == [
        "the lamp is at 0.8"
    ]
    taken = [event.name for event in heard[: names.index("pause")]].count("frame.taken")
    assert taken == 2
    kinds = [entry.kind for entry in session.journal.entries]
    assert kinds.index("paused") < kinds.index("resumed")


def test_a_capture_that_waits_can_be_stopped():
    control, rig = Impatient(), still_rig()

    def suspended():
        if control.waits:
            control.stop()
        return "too warm"

    session, plan = begun(Path("/disk"), SimulatedDisk(), rig)
    outcome = Sequencer(session, plan, rig, control=control, suspended=suspended).run()
    assert not outcome.complete
    assert not session.stored


def test_figures_are_read_from_files_and_from_the_camera(tmp_path):
    lamp = tmp_path / "lamp.txt"
    lamp.write_text("1.00 of its level\n")
    details = {"DeviceTemperature": "41.5"}
    asked = suspended_by(
        [
            Suspender(name="lamp", file=str(lamp), low=0.98, high=1.02),
            Suspender(name="temperature", camera="DeviceTemperature", high=45),
        ],
        lambda: details,
        lambda: "a door is open" if details.get("door") else "",
    )
    assert asked() == ""
    lamp.write_text("0.9")
    assert asked() == "lamp is 0.9, below 0.98"
    lamp.write_text("nan")
    assert asked() == "lamp is nan, below 0.98"
    lamp.write_text("")
    assert asked() == "lamp cannot be read (it is empty)"
    lamp.unlink()
    assert "lamp cannot be read (No such file" in asked()
    lamp.write_text("1")
    details["DeviceTemperature"] = "46"
    assert asked() == "temperature is 46, above 45"
    details["DeviceTemperature"], details["door"] = "40", "open"
    assert asked() == "a door is open"
    del details["DeviceTemperature"]
    assert "the camera reports no DeviceTemperature" in asked()


@pytest.mark.parametrize(
    ("suspend", "said"),
    [
        ([{"name": "lamp", "file": "/no/such", "low": 1}], "suspend.0: lamp cannot be read"),
        ([{"name": "t", "camera": "Temperature", "high": 1}], "the camera reports no Temperature"),
        ([{"name": "t", "high": 1}], "give file or camera"),
        ([{"name": "t", "file": "x"}], "give low, high or both"),
        ([{"name": "t", "file": "x", "hihg": 1}], "did you mean 'high'"),
    ],
)
def test_a_condition_that_cannot_be_is_refused_in_one_line_before_anything_is_made(
    plan, suspend, said
):
    plan.write_text(yaml.safe_dump({**PLAN, "suspend": suspend}))
    with pytest.raises(AppError, match=said) as refused:
        emmc.capture(plan, quick_rig())
    assert "\n" not in str(refused.value)
    assert not plan.with_name("plan-session").exists()


def test_the_estimate_knows_metered_exposures_from_the_last_session_of_the_same_devices(
    plan, tmp_path
):
    first = emmc.capture(plan, quick_rig())
    planned = load_plan(plan)
    rig = quick_rig().description
    assert last_session(tmp_path / "next", {**rig, "kind": "real", "stage": "x"}) is None
    earlier = last_session(tmp_path / "next", rig)
    assert earlier is not None
    assert earlier.folder == first.folder
    pace = Pace({}, 0.0, 1000)
    frames = [frame for frame in first.frames if not frame.is_optional]
    unknown = pace.estimate(frames, known_exposures(Exposures(planned), {}, None))
    assert unknown.guessed == sum(frame.exposure_s is None for frame in frames)
    truly_s = sum(entry.exposure_s for entry in first.stored.values())
    by_earlier = pace.estimate(frames, known_exposures(Exposures(planned, earlier), {}, None))
    decided = metered(first.journal.entries)
    by_metering = known_exposures(Exposures(planned), first_meterings(first), decided)
    for reported in (by_earlier, pace.estimate(frames, by_metering)):
        assert reported.guessed == 0
        assert reported.exposing_s == pytest.approx(truly_s, rel=0.02)
    assert unknown.exposing_s < truly_s / 2


def test_what_a_frame_costs_beside_its_exposure_is_learnt():
    pace = Pace({}, 0.0, 1000)
    for _ in range(100):
        pace.learn(2.5, exposure_s=2.0, moving_s=0.1)
    frames = begun(Path("/disk"), SimulatedDisk(), still_rig())[0].frames
    reported = pace.estimate(frames, lambda frame: 0.0)
    assert reported.downloading_s == pytest.approx(0.4 * len(frames), rel=0.01)


def test_a_callback_may_look_at_errors_of_devices(plan):
    # DriverError of a broken reading is a reason to wait, not the end.
    def details():
        raise DriverError("the camera is busy")

    with pytest.raises(AppError, match="the camera is busy"):
        suspended_by([Suspender(name="t", camera="x", high=1)], details)
