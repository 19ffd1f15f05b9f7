"""Films: frames at their places in time, from the camera's stream or with the mask stepped."""

import threading
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml
from capture_rigs import PreparedCamera, begun, still_rig
from pydantic import ValidationError
from simulated_disk import PowerCutError, SimulatedDisk

from emmc_rig.bench.hardware import Fitted, simulated_rig
from emmc_rig.captures import film as films
from emmc_rig.captures.control import Control
from emmc_rig.captures.film import Ring, refuse_impossible_film
from emmc_rig.captures.plan import Plan, new_plan, planned_camera
from emmc_rig.captures.run import estimated
from emmc_rig.captures.sequencer import Sequencer
from emmc_rig.drivers.clock import SYSTEM_CLOCK
from emmc_rig.drivers.dng import encode_dng
from emmc_rig.drivers.errors import CaptureError
from emmc_rig.drivers.raw import RawFrame, decode_raw
from emmc_rig.errors import AppError
from emmc_rig.formats.cameras import find_camera
from emmc_rig.formats.scenes import fine_scene
from emmc_rig.progress import Watcher
from emmc_rig.session.frame_file import decode_frame
from emmc_rig.session.journal import DroppedEntry, FilmEntry, LateEntry, RetryEntry, of_kind
from emmc_rig.session.session import Session
from emmc_rig.session.verify import verify

ROOT = Path("/disk")
SIZE = (24, 32)
FILM = """
camera: rgbw-bayer-1shot
shots: [{exposure_s: 0.02}]
film: {frames: 12, rate: 10}
whiteboards: null
darks: {repeats: 2}
"""
STEPPED = """
camera: rgbw-bayer-1shot
shots:
  - {exposure_s: 0.02, mask_cells: [0, 0]}
  - {exposure_s: 0.02, mask_cells: [2, 0]}
  - {exposure_s: 0.02, mask_cells: [0, 2]}
film: {frames: 7, rate: 2}
whiteboards: null
darks: {repeats: 2}
"""


@cache
def moving(at_s):
    return fine_scene("moving-toys", 1, 1, size=SIZE, time_s=at_s).samples


def bench_rig(text=FILM, camera="u3v"):
    """Return the simulated rig before the moving toys, and its bench."""
    planned = planned_camera(Plan.model_validate(yaml.safe_load(text)))
    return simulated_rig(planned, moving, SIZE, 0, fitted=Fitted(camera=camera))


class Run:
    """A plan on the simulated rig; each `go` is a run, on a disk that stays."""

    def __init__(self, text=FILM, camera="u3v"):
        self.text, self.camera, self.disk = text, camera, SimulatedDisk()
        self.rig, self.bench = bench_rig(text, camera)
        self.session, self.plan = begun(ROOT, self.disk, self.rig, text)

    def go(self, control=None, watcher=None, rig=None):
        rig = rig or self.rig
        self.session = Session(self.session.folder, self.disk)
        outcome = Sequencer(self.session, self.plan, rig, watcher, control).run()
        self.session = Session(self.session.folder, self.disk)
        return outcome

    @property
    def lines(self):
        """The journal lines of the film's frames, in the order of time."""
        stored = self.session.stored
        return [stored[frame.id] for frame in self.session.frames if frame.film is not None
                and frame.id in stored]  # fmt: skip

    @property
    def places(self):
        return [int(line.id.removeprefix("film-")) for line in self.lines]

    @property
    def dropped(self):
        entries = of_kind(self.session.journal.entries, DroppedEntry)
        return {int(name[5:]): entry.reason for entry in entries for name in entry.ids}

    @property
    def segments(self):
        return of_kind(self.session.journal.entries, FilmEntry)


def test_a_film_of_a_still_mask_comes_from_the_cameras_stream_at_its_rate():
    run = Run()
    assert run.go().complete
    assert verify(run.session).is_complete
    assert run.places == list(range(12))
    film_s, camera_s = (
        np.array([getattr(line, name) for line in run.lines], dtype=float)
        for name in ("film_s", "camera_time_s")
    )
    np.testing.assert_allclose(film_s, np.arange(12) / 10, atol=1e-6)
    np.testing.assert_allclose(np.diff(camera_s), 0.1, atol=1e-6)
    assert [int(line.metadata["block_id"]) for line in run.lines] == list(range(12))
    assert [(segment.segment, segment.id, segment.rate_hz) for segment in run.segments] == [
        (0, "film-000000", 10.0)
    ]
    assert not run.dropped


def test_a_frame_shows_the_scene_as_it_was_when_its_exposure_began():
    run = Run()
    run.go()
    entry = run.lines[7]
    shown = decode_frame(run.session.read(entry.id), entry).mosaic.astype(float)
    run.bench.lamp = "white"
    then_s = entry.camera_time_s
    assert then_s is not None
    # The camera sends 12 of the sensor's 14 bits.
    likeness = {
        at_s: np.corrcoef(shown.ravel(), run.bench.expose(entry.exposure_s, at_s).ravel())[0, 1]
        for at_s in (then_s - 0.3, then_s, then_s + 0.3)
    }
    assert max(likeness, key=lambda at_s: likeness[at_s]) == then_s


def test_a_frame_that_the_camera_drops_is_named_with_its_place_and_stays_dropped():
    run = Run()
    run.rig.still.faults.inject("dropped_frame", when=lambda block: block in (4, 5))
    assert run.go().complete
    assert 4 not in run.places
    assert set(run.places) | set(run.dropped) == set(range(12))
    assert set(run.dropped.values()) == {films.NONE_CAME}
    result = verify(run.session)
    assert result.is_complete
    assert result.dropped == len(run.dropped)
    assert any("dropped" in line for line in result.lines())
    assert run.go().taken == 0


class Acts(Watcher):
    """Does something once a frame is taken, and keeps the notes."""

    def __init__(self, place, act):
        self.place, self.act, self.messages = place, act, []

    def event(self, event):
        if event.name == "frame.taken" and event.objects["planned"].film == self.place:
            self.act()

    def tell(self, message):
        self.messages.append(message)


class Resuming(Control):
    """Goes on as soon as it waits."""

    def wait(self):
        self.resume()


@pytest.mark.parametrize("way", ["stop", "pause"])
def test_a_stop_and_a_pause_keep_every_frame_and_the_film_goes_on_in_another_segment(way):
    run, control = Run(), Resuming()
    complete = run.go(control, Acts(4, getattr(control, way))).complete
    assert complete == (way == "pause")
    if not complete:
        rig, _ = bench_rig()
        assert run.go(rig=rig).complete
    begun = int(run.segments[1].id.removeprefix("film-"))
    assert begun >= 5
    assert run.places == list(range(12))
    assert [line.segment for line in run.lines] == [0] * begun + [1] * (12 - begun)
    assert run.lines[begun].film_s == 0
    assert not run.dropped


def test_a_frame_that_is_gone_from_the_disk_is_dropped_and_not_taken_at_another_time():
    run = Run()
    run.go()
    run.disk.remove(run.session.path_of(run.lines[3]))
    rig, _ = bench_rig()
    assert run.go(rig=rig).complete
    assert run.dropped == {3: films.INTERRUPTED}
    assert run.places == [place for place in range(12) if place != 3]


@pytest.mark.parametrize("operations", [40, 63, 90])
def test_after_a_power_cut_what_is_stored_stays_and_the_rest_is_another_segment(operations):
    run = Run()
    run.disk.cut_power_at(run.disk.operations + operations)
    with pytest.raises(PowerCutError):
        run.go()
    run.disk = run.disk.after_power_cut(np.random.default_rng(operations))
    run.session = Session(run.session.folder, run.disk)
    before = run.lines
    assert before or operations == 40
    rig, _ = bench_rig()
    assert run.go(rig=rig).complete
    assert run.lines[: len(before)] == before
    assert run.places == list(range(12))
    assert {segment.segment for segment in run.lines[len(before) :]} == {run.segments[-1].segment}
    assert verify(run.session).is_complete


def test_a_camera_that_is_unplugged_in_a_film_goes_on_in_another_segment():
    run = Run()
    run.rig.still.faults.inject("unplug_in_payload", when=lambda block: block == 5)
    assert run.go().complete
    assert {line.segment for line in run.lines} == {0, 1}
    assert set(run.places) | set(run.dropped) == set(range(12))
    assert of_kind(run.session.journal.entries, RetryEntry)


def test_a_stepped_mask_goes_through_the_plans_shots_in_a_cycle():
    run = Run(STEPPED, camera="ptp")
    assert run.go().complete
    assert run.places == list(range(7))
    cell_um = planned_camera(run.plan).masks["mask"].cell_um
    stood = [[line.read_um["mask_x"], line.read_um["mask_y"]] for line in run.lines]
    cycle = np.array([[0, 0], [2, 0], [0, 2]]) * cell_um
    np.testing.assert_allclose(stood, cycle[np.arange(7) % 3], atol=1)
    times_s = np.array([line.film_s for line in run.lines])
    np.testing.assert_allclose(times_s, np.arange(7) / 2, atol=0.05)
    assert {line.film_clock for line in run.lines} == {"host"}


def test_frames_for_which_the_stage_comes_too_late_are_dropped_with_their_places():
    text = STEPPED.replace("frames: 7", "frames: 9")
    rig = still_rig(SIZE)
    rig.stage._move_s = 1.2
    session, plan = begun(ROOT, SimulatedDisk(), rig, text)
    assert Sequencer(session, plan, rig).run().complete
    gone = of_kind(session.journal.entries, DroppedEntry)
    assert {entry.reason for entry in gone} == {films.LATE}
    taken = [name for name in session.stored if name.startswith("film")]
    names = sorted([*taken, *(name for entry in gone for name in entry.ids)])
    assert names == [f"film-{place:06d}" for place in range(9)]
    for name in taken:
        due_s = int(name[5:]) / 2
        assert session.stored[name].film_s == pytest.approx(due_s, abs=1.2 + 0.25)


class Stream(PreparedCamera):
    """A camera whose stream gives prepared frames at times of its own."""

    def __init__(self, times_s, values=None, on_frame=lambda place: None, host_s=None):
        super().__init__(self._no_single_frame)
        self.times_s, self.on_frame, self.closed = times_s, on_frame, False
        self.host_s = host_s or [None] * len(times_s)
        self.values = values or range(100, 100 + len(times_s))

    @staticmethod
    def _no_single_frame(exposure_s: float) -> RawFrame:
        raise AssertionError("a film takes the stream")

    def stream(self):
        try:
            sent = zip(self.times_s, self.values, self.host_s, strict=True)
            for place, (at_s, value, host_s) in enumerate(sent):
                self.on_frame(place)
                mosaic = np.full(SIZE, value, np.uint16)
                mosaic[0, 0] = 200
                frame = decode_raw(encode_dng(mosaic, "rggb", 64, 4000, 0.01), SIZE)
                yield replace(frame, camera_time_s=at_s, host_time_s=host_s, gain=1.0)
        finally:
            self.closed = True


def arrived(ring):
    return [frame for frame in ring if frame is not None]


def test_frames_take_the_place_nearest_in_time_and_those_of_a_faster_camera_are_passed_over():
    camera = Stream([5.0, 5.04, 5.11, 5.13, 5.19, 5.52, 5.6])
    with Ring(camera, 10.0, range(6), room=100) as ring:
        frames = arrived(ring)
    assert [(frame.place, round(frame.film_s, 3)) for frame in frames] == [
        (0, 0.0), (1, 0.11), (2, 0.19), (5, 0.52),
    ]  # fmt: skip
    assert ring.why_missing(3) == films.NONE_CAME
    assert camera.closed


def test_the_camera_is_never_blocked_by_a_slow_disk_and_what_finds_no_room_is_named():
    all_sent = threading.Event()
    camera = Stream(
        [place / 10 for place in range(8)],
        on_frame=lambda place: all_sent.set() if place == 7 else None,
    )
    with Ring(camera, 10.0, range(8), room=3) as ring:
        # Nothing is fetched before the camera has sent its last frame.
        assert all_sent.wait(10)
        frames = arrived(ring)
    places = [frame.place for frame in frames]
    assert places[:3] == [0, 1, 2]
    assert {ring.why_missing(place) for place in range(3, 6)} == {films.SLOW_DISK}


@pytest.mark.parametrize(
    ("camera", "what"),
    [
        (Stream([0.0, 0.1, 0.2, -5.0]), "run backwards"),
        (Stream([5.0] * 4, host_s=[50.0, 50.1, 111.0, 112.0]), "clock stands still"),
    ],
)
def test_times_that_cannot_be_end_the_segment(camera, what):
    with Ring(camera, 10.0, range(6), room=9) as ring, pytest.raises(CaptureError, match=what):
        arrived(ring)
    assert camera.closed


def filmed(camera):
    """Return the session of a film of five frames at 10 Hz by this camera, and its notes."""
    rig, notes = replace(still_rig(SIZE), camera=camera), Acts(None, None)
    text = FILM.replace("frames: 12", "frames: 5").replace("darks: {repeats: 2}", "darks: null")
    session, plan = begun(ROOT, SimulatedDisk(), rig, text)
    assert Sequencer(session, plan, rig, notes).run().complete
    return session, notes.messages


def test_frames_that_arrive_late_keep_the_cameras_time_and_are_named():
    times_s, delays_s = [0.0, 0.1, 0.2, 0.3, 0.4], [0.02, 0.01, 0.03, 0.09, 0.02]
    host_s = [50 + at_s + delay_s for at_s, delay_s in zip(times_s, delays_s, strict=True)]
    session, messages = filmed(Stream(times_s, host_s=host_s))
    lines = [session.stored[f"film-{place:06d}"] for place in range(5)]
    assert [line.film_s for line in lines] == pytest.approx(times_s, abs=1e-9)
    assert {line.film_clock for line in lines} == {"camera"}
    (late,) = of_kind(session.journal.entries, LateEntry)
    assert (late.ids, late.longest_s) == (["film-000003"], pytest.approx(0.08))
    assert "1 arrived up to 80 ms late (no error of time): film-000003" in messages


def test_times_of_a_camera_without_a_clock_are_the_hosts_and_said_to_be():
    host_s = [50.0, 50.12, 50.2, 50.31, 50.4]
    session, messages = filmed(Stream([None] * 5, host_s=host_s))
    lines = [session.stored[f"film-{place:06d}"] for place in range(5)]
    expected_s = [at_s - 50 for at_s in host_s]
    assert [line.film_s for line in lines] == pytest.approx(expected_s, abs=1e-9)
    assert {line.film_clock for line in lines} == {"host"}
    assert messages.count(films.HOST_CLOCK) == 1
    assert not of_kind(session.journal.entries, LateEntry)


def test_a_frame_that_the_camera_sends_twice_is_dropped():
    session, _ = filmed(
        Stream([place / 10 for place in range(5)], values=[300, 301, 301, 302, 303])
    )
    (entry,) = of_kind(session.journal.entries, DroppedEntry)
    assert entry.ids == ["film-000002"]
    assert entry.reason == films.SENT_TWICE


def test_a_frame_of_a_film_is_not_taken_again():
    run, control = Run(), Control()
    watcher = Acts(6, lambda: control.take_again(["film-000002"]))
    assert run.go(control, watcher).complete
    assert run.places == list(range(12))
    assert any("cannot be taken again" in message for message in watcher.messages)


@pytest.mark.parametrize(
    ("text", "camera", "what"),
    [
        (
            FILM.replace("exposure_s: 0.02", "exposure_s: 0.2"),
            "u3v",
            "for 0.2 s: lower film.rate from 10 to 5",
        ),
        (FILM.replace("rate: 10", "rate: 5000").replace("0.02", "0.0001"), "u3v", "at most 1e"),
        (STEPPED.replace("rate: 2", "rate: 8"), "ptp", "the stage moves 0.2"),
        (FILM, "ptp", "takes about 0.17 s"),
    ],
)
def test_a_rate_that_camera_or_stage_cannot_reach_is_refused_in_one_line(text, camera, what):
    rig, _ = bench_rig(text, camera)
    session, plan = begun(ROOT, SimulatedDisk(), rig, text)
    with pytest.raises(AppError, match=what) as refused:
        refuse_impossible_film(plan, rig, session.frames)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "edit",
    [
        "shots: [{exposure_s: 0.01}, {exposure_s: 0.02}]",
        "shots: [{exposure_s: [0.01, 0.02]}]",
        "shots: [{repeats: 2}]",
        "metering: {alike: false}",
    ],
)
def test_the_frames_of_a_film_are_exposed_alike_and_once(edit):
    with pytest.raises(ValidationError, match="exposed alike and once"):
        Plan.model_validate(yaml.safe_load(FILM) | yaml.safe_load(edit))


def test_time_and_disk_of_a_film_are_estimated_from_its_rate():
    run = Run(FILM.replace("frames: 12", "frames: 200"))
    expected = estimated(run.session.frames, run.plan, replace(run.rig, clock=SYSTEM_CLOCK))
    assert 20 < expected.exposing_s < 21
    simulated = estimated(run.session.frames, run.plan, run.rig)
    assert simulated.seconds == pytest.approx(202 * 0.15, rel=0.01)  # its clock waits for nothing
    assert expected.bytes > 202 * 2 * SIZE[0] * SIZE[1]


def test_a_metered_film_is_exposed_within_its_period():
    text = FILM.replace("exposure_s: 0.02", "exposure_s: auto").replace("rate: 10", "rate: 40")
    run = Run(text)
    assert run.go().complete
    assert {line.exposure_s for line in run.lines} == {run.lines[0].exposure_s}
    assert run.lines[0].exposure_s <= 1 / 40


def test_a_new_plan_shows_how_a_film_is_asked_for():
    text = new_plan("rgbw-bayer-1shot", find_camera("rgbw-bayer-1shot"))
    line = next(text_line for text_line in text.splitlines() if text_line.startswith("# film:"))
    asked = Plan.model_validate(yaml.safe_load(text) | yaml.safe_load(line.removeprefix("# ")))
    assert asked.film is not None
    assert (asked.film.frames, asked.film.rate) == (200, 10)
