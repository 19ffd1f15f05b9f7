"""The set-up page: pictures and figures of a frame, moves and exposures, refused requests."""

import http.client
import json
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from programs import exit_code
from pydantic import ValidationError
from test_live_alignment import BLACK, WHITE, frame_of

from emmc_rig.bench.hardware import simulated_rig
from emmc_rig.drivers.camera import CameraIdentity
from emmc_rig.drivers.errors import (
    DriverError,
    ExposureStoppedError,
    PositionMismatchError,
    RawFrameError,
    TransportTimeoutError,
)
from emmc_rig.errors import AppError
from emmc_rig.formats.cameras import find_camera
from emmc_rig.formats.scenes import fine_scene
from emmc_rig.live import server
from emmc_rig.live import watch as watch_module
from emmc_rig.live.driving import Driving
from emmc_rig.live.picture import CLIPPED_BGR, SATURATED_BGR, View, encoded, picture, window
from emmc_rig.live.server import application
from emmc_rig.live.server import served as serving
from emmc_rig.live.watch import Watch
from emmc_rig.report.page import source

PATIENCE_S = 60.0
TOKEN = "secret"


@pytest.mark.parametrize("cfa", ["rggb", "bggr", "grbg", "gbrg"])
def test_a_red_scene_is_shown_red_whatever_the_colour_phase(cfa):
    tile = np.array([3000.0 if letter == "r" else BLACK for letter in cfa]).reshape(2, 2)
    shown = picture(frame_of(np.tile(tile, (16, 16)), cfa), View(px=32))
    blue, green, red = shown[8:-8, 8:-8].reshape(-1, 3).mean(axis=0)
    assert red > 200
    assert max(blue, green) < 10


@pytest.mark.slow
def test_one_saturated_pixel_of_a_large_frame_is_seen():
    mosaic = np.full((1200, 1600), 1000)
    mosaic[601, 801] = WHITE
    mosaic[3, 5] = 0
    shown = picture(frame_of(mosaic), View(kind="mosaic", px=200))
    assert (shown == SATURATED_BGR).all(axis=2).sum() in (1, 2, 4)
    assert (shown == CLIPPED_BGR).all(axis=2).sum() in (1, 2, 4)
    plain = picture(frame_of(mosaic), View(kind="mosaic", px=200, marked=False))
    assert not (plain == SATURATED_BGR).all(axis=2).any()


def test_a_zoomed_view_shows_its_part_pixel_by_pixel():
    mosaic = np.full((64, 64), BLACK)
    mosaic[40:44, 20:24] = WHITE - 1
    view = View(kind="mosaic", x=22 / 64, y=42 / 64, part=1 / 16, px=64)
    assert window(view, (64, 64)) == (slice(40, 44), slice(20, 24))
    shown = picture(frame_of(mosaic), view)
    assert shown.shape == (64, 64, 3)
    assert (shown > 250).all()
    assert encoded(shown)[:2] == b"\xff\xd8"


def test_a_dark_view_is_brightened_until_its_brightest_part_is_white():
    mosaic = np.full((64, 64), BLACK)
    mosaic[:, 32:] = BLACK + 40
    dark, bright = (
        picture(frame_of(mosaic), View(kind="mosaic", px=64, bright=chosen))
        for chosen in (False, True)
    )
    assert dark[:, 40:].max() < 40
    assert bright[:, 40:].min() > 250
    assert bright[:, :24].max() == 0


def test_views_stay_inside_the_frame_and_refuse_nonsense():
    assert window(View(x=1.0, y=0.0, part=0.25), (100, 200)) == (slice(0, 24), slice(150, 200))
    wrongs: tuple[dict[str, Any], ...] = (
        {"kind": "xray"},
        {"x": 2.0},
        {"x": float("nan")},
        {"part": 0.0},
        {"part": 3.0},
        {"px": 10**6},
    )
    for wrong in wrongs:
        with pytest.raises(ValidationError):
            View(**wrong)


class FakeCamera:
    """Frames at once; `fault` is raised instead of one when set."""

    identity = CameraIdentity(model="fake")
    shape, cfa = (16, 16), "rggb"
    exposure_limits_s, gain_limits = (0.001, 1.0), (1.0, 1.0)

    def __init__(self):
        self.exposure_s, self.gain, self.taken = 0.01, 1.0, 0
        self.light = 1.0
        self.fault: DriverError | None = None

    def set_exposure_s(self, exposure_s):
        if not 0.001 <= exposure_s <= 1:
            raise ValueError(f"the exposure {exposure_s:g} s is not offered")
        self.exposure_s = exposure_s

    def set_gain(self, gain):
        self.gain = gain

    def snap(self):
        if self.fault is not None:
            raise self.fault
        self.taken += 1
        signal = (WHITE - BLACK) * self.light * self.exposure_s * 30
        mosaic = np.full((16, 16), min(BLACK + signal, WHITE))
        return replace(frame_of(mosaic), exposure_s=self.exposure_s)

    def close(self):
        pass


@contextmanager
def watching(*arguments):
    watch = Watch(*arguments)
    watch.start()
    try:
        yield watch
    finally:
        watch.close()


def until(watch, holds):
    """Return the first state of which that holds."""

    def looked():
        watch.touch()
        return holds(watch.state.snapshot())

    end_s = time.monotonic() + PATIENCE_S
    with watch.state.changed:
        while not watch.state.changed.wait_for(looked, 0.1):  # who looks asks for frames
            assert time.monotonic() < end_s, f"never came: {watch.state.snapshot()}"
        return watch.state.snapshot()


def test_frames_follow_each_other_and_wishes_are_carried_out_between_them():
    with watching(FakeCamera()) as watch:
        first = until(watch, lambda state: state["frame"] >= 2 and state["figures"])
        assert first["figures"]["histogram"].keys() == {"red", "green", "blue"}
        watch.set_exposure_s(0.02)
        until(watch, lambda state: state["settings"]["exposure_s"] == 0.02)
        watch.set_exposure_s(5.0)
        refused = until(watch, lambda state: state["trouble"]["setting"])
        assert "5 s is not offered" in refused["trouble"]["setting"]
        assert refused["settings"]["exposure_s"] == 0.02
        watch.set_exposure_s(0.03)
        until(watch, lambda state: not state["trouble"]["setting"])


def test_a_camera_in_trouble_is_reported_and_asked_again(monkeypatch):
    monkeypatch.setattr(watch_module, "RETRY_S", 0.01)
    camera = FakeCamera()
    with watching(camera) as watch:
        until(watch, lambda state: state["frame"])
        camera.fault = RawFrameError("torn")
        until(watch, lambda state: "torn" in state["trouble"]["camera"])
        camera.fault = None
        until(watch, lambda state: not state["trouble"]["camera"])


@pytest.mark.slow
def test_no_frame_is_taken_when_nobody_looks(monkeypatch):
    monkeypatch.setattr(watch_module, "IDLE_S", 0.4)
    camera = FakeCamera()
    with watching(camera) as watch:
        until(watch, lambda state: state["frame"])
        time.sleep(1.0)
        before = camera.taken
        time.sleep(0.3)
        assert camera.taken == before
        until(watch, lambda state: state["frame"] > before)


@pytest.fixture
def rig():
    camera, size = find_camera("rgbw-bayer-1shot"), (32, 48)
    fine = fine_scene("near-planar", 2, 2, size=size, views=camera.views)
    made, _ = simulated_rig(camera, fine.samples, size, 0)
    made.attendant.set_lamp("white")
    return made


def centred_um(rig):
    return {**rig.zero_um, "aperture_x": rig.zero_um["aperture_x"] + rig.window_um}


def test_jogging_moves_the_simulated_stage_and_the_picture_changes(rig):
    with watching(rig.camera, rig.stage, rig.attendant.place, ("scene",), centred_um(rig)) as watch:
        watch.jog("mask_x", 100.0)
        reported = until(watch, lambda state: state["trouble"]["stage"])
        assert "home" in reported["trouble"]["stage"]
        watch.centre()
        lit = until(
            watch, lambda state: state["axes"]["mask_x"]["position_um"] and not state["busy"]
        )
        place_um = lit["axes"]["mask_x"]["position_um"]
        assert place_um == pytest.approx(rig.zero_um["mask_x"], abs=0.5)
        until(watch, lambda state: state["frame"] > lit["frame"] + 1)
        before = mosaic_of(watch)
        watch.jog("mask_x", 200.0)
        moved = until(
            watch,
            lambda state: (
                not state["busy"] and (state["axes"]["mask_x"]["position_um"] or 0) > place_um + 100
            ),
        )
        assert moved["axes"]["mask_x"]["position_um"] == pytest.approx(place_um + 200, abs=0.5)
        until(watch, lambda state: state["frame"] > moved["frame"] + 1)
        after = mosaic_of(watch)
        assert before.mean() > 2 * rig.camera.snap().black_level_dn.mean()
        assert np.abs(after.astype(float) - before).mean() > 30
        watch.look_at("scene")
        with pytest.raises(AppError, match="cannot look at"):
            watch.look_at("moon")
        with pytest.raises(AppError, match="no axis 'x'"):
            watch.jog("x", 1.0)


def mosaic_of(watch):
    newest = watch.newest()
    assert newest is not None
    return newest.frame.mosaic


class SlowStage:
    """A stage of one axis whose legs end only when it is stopped, with an error as drivers do."""

    axes = ("mask_x",)

    def __init__(self, legs=1):
        self.legs, self.begun = legs, 0
        self.moving, self.stopped = threading.Event(), threading.Event()
        self.place_um, self.stops = 0.5, 0

    def move_by_um(self, steps_um):
        for _ in range(self.legs):
            self.begun += 1
            self.moving.set()
            assert self.stopped.wait(PATIENCE_S)
            self.stopped.clear()
        raise PositionMismatchError("mask_x", 1.0, self.place_um, 0.5)

    def stop(self, axes=None):
        self.stops += 1
        self.stopped.set()

    def limits_um(self, axis):
        return 0.0, 1.0

    def position_um(self, axis):
        return self.place_um


@contextmanager
def moving(stage):
    """Watch a camera, and the stage while a move of it is under way."""
    with watching(FakeCamera(), stage) as watch:
        watch.jog("mask_x", 1.0)
        assert stage.moving.wait(PATIENCE_S)
        yield watch


def test_a_stop_by_hand_is_reported_as_one_and_a_second_move_is_refused():
    stage = SlowStage()
    with moving(stage) as watch:
        with pytest.raises(AppError, match="busy"):
            watch.jog("mask_x", 1.0)
        watch.stop()
        ended = until(watch, lambda state: not state["busy"] and state["stopped"])
        assert ended["trouble"]["stage"] == ""


def test_a_move_that_ends_short_by_itself_is_trouble_and_no_stop():
    stage = SlowStage()
    with moving(stage) as watch:
        stage.stopped.set()
        ended = until(watch, lambda state: state["trouble"]["stage"])
        assert "mask_x" in ended["trouble"]["stage"]
        assert not ended["stopped"]


def test_stopping_is_repeated_until_a_move_of_several_legs_has_ended():
    stage = SlowStage(legs=3)
    with moving(stage) as watch:
        watch.stop()
        until(watch, lambda state: not state["busy"])
    assert stage.stops >= 3


def test_positions_are_shown_while_an_axis_moves():
    stage = SlowStage()
    with watching(FakeCamera(), stage) as watch:
        until(watch, lambda state: state["axes"])
        watch.jog("mask_x", 1.0)
        assert stage.moving.wait(PATIENCE_S)
        for stage.place_um in (0.6, 0.7):
            shown = until(
                watch, lambda state: state["axes"]["mask_x"]["position_um"] == stage.place_um
            )
            assert shown["busy"]
        watch.stop()
        until(watch, lambda state: not state["busy"])


def test_whoever_sees_that_a_move_ended_sees_where_and_how():
    stage, ended, published = SlowStage(), threading.Event(), []

    def publish(trouble=None, **news):
        published.append({**news, **(trouble or {})})
        if news.get("busy") == "":
            ended.set()

    driving = Driving(stage, publish)  # pyright: ignore[reportArgumentType]
    driving.start()
    try:
        driving.ask("jog", lambda moved: moved.move_by_um({}))
        assert stage.moving.wait(PATIENCE_S)
        stage.place_um = 0.9
        stage.stopped.set()
        assert ended.wait(PATIENCE_S)
    finally:
        driving.close()
    (end,) = [news for news in published if news.get("busy") == ""]
    assert end["axes"]["mask_x"]["position_um"] == 0.9
    assert "mask_x" in end["stage"]
    after = published[published.index(end) + 1 :]
    assert all(news["axes"]["mask_x"]["position_um"] == 0.9 for news in after if "axes" in news)


def test_a_stop_that_the_stage_refuses_is_trouble():
    class Deaf(SlowStage):
        def stop(self, axes=None):
            raise TransportTimeoutError("ttyUSB0", 0.5)

    stage = Deaf()
    with moving(stage) as watch:
        watch.stop()
        reported = until(watch, lambda state: state["trouble"]["stage"])
        assert reported["trouble"]["stage"].startswith("not stopped")
        stage.stopped.set()


def test_the_end_stops_a_moving_stage():
    stage = SlowStage()
    with moving(stage):
        assert not stage.stops
    assert stage.stops


def test_a_dark_picture_with_the_mask_away_offers_to_centre_it():
    camera = FakeCamera()
    camera.light = 0.0
    stage = SlowStage()
    with watching(camera, stage, None, (), {"mask_x": 100.0}) as watch:
        reported = until(watch, lambda state: state["hint"] and state["axes"])
        assert reported["hint"]["action"] == "centre"
        assert "mask_x" in reported["hint"]["text"]
        stage.place_um = 100.0
        watch.jog("mask_x", 1.0)
        assert stage.moving.wait(PATIENCE_S)
        watch.stop()
        lamp = until(watch, lambda state: state["hint"] and not state["hint"]["action"])
        assert "lamp" in lamp["hint"]["text"]


@pytest.mark.parametrize("light", [0.03, 20.0])
def test_automatic_exposure_brings_the_brightest_near_white_but_not_to_it(light):
    camera = FakeCamera()
    camera.light = light
    with watching(camera) as watch:
        until(watch, lambda state: state["figures"])
        watch.auto_expose()
        until(
            watch,
            lambda state: (
                0.7 <= max(state["figures"]["brightest"].values()) <= 0.9
                and state["figures"]["saturated"] == 0
            ),
        )


def test_a_hot_pixel_is_no_reason_to_give_up_an_automatic_exposure():
    class Hot(FakeCamera):
        shape = (64, 64)

        def snap(self):
            frame = super().snap()
            mosaic = np.full(self.shape, frame.mosaic[0, 0])
            mosaic[20, 30] = WHITE
            return replace(frame, mosaic=mosaic)

    with watching(Hot()) as watch:
        until(watch, lambda state: state["figures"])
        watch.auto_expose()
        reported = until(watch, lambda state: 0.7 <= state["figures"]["level"] <= 0.9)
        done = until(watch, lambda state: state["frame"] > reported["frame"] + 2)
        assert done["trouble"]["setting"] == ""
        assert done["steps"][1]["done"]


def test_an_exposure_beyond_the_camera_is_said_to_be():
    camera = FakeCamera()
    camera.light = 1e-4
    with watching(camera) as watch:
        until(watch, lambda state: state["figures"])
        watch.auto_expose()
        reported = until(watch, lambda state: state["trouble"]["setting"])
        assert "no better exposure" in reported["trouble"]["setting"]


def test_in_the_dark_an_exposure_climbs_to_4_s_and_comes_back_and_says_what_to_do():
    asked_s = []

    class Asked(FakeCamera):
        exposure_limits_s = (0.001, 60.0)

        def set_exposure_s(self, exposure_s):
            asked_s.append(exposure_s)
            self.exposure_s = exposure_s

    camera = Asked()
    camera.light = 0.0
    with watching(camera) as watch:
        until(watch, lambda state: state["figures"])
        watch.auto_expose()
        dark = until(watch, lambda state: state["trouble"]["setting"])
        assert "dark at 4 s too: switch the lamp on" in dark["trouble"]["setting"]
        until(watch, lambda state: state["settings"]["exposure_s"] == 0.01)
        assert max(asked_s) == 4.0
        camera.light = 2.0
        lit = until(watch, lambda state: not state["trouble"]["setting"])
        assert "lamp" not in str([lit["hint"], lit["steps"]])


def test_an_exposure_beyond_4_s_is_offered_and_not_taken_unasked():
    camera = FakeCamera()
    camera.exposure_limits_s = (0.001, 60.0)
    camera.set_exposure_s = lambda exposure_s: setattr(camera, "exposure_s", exposure_s)
    camera.light = 0.8 / 30 / 20
    with watching(camera) as watch:
        until(watch, lambda state: state["figures"])
        watch.auto_expose()
        offered = until(watch, lambda state: state["hint"] and "values" in state["hint"])
        assert camera.exposure_s <= 4.0
        assert offered["hint"]["label"] == "expose for 20 s"
        step = next(step for step in offered["steps"] if step["name"] == "exposure")
        assert step["label"] == "expose for 20 s"
        watch.auto_expose(**offered["hint"]["values"])
        done = until(watch, lambda state: max(state["figures"]["brightest"].values()) > 0.7)
        assert done["settings"]["exposure_s"] == pytest.approx(20, rel=0.1)


class PatientCamera(FakeCamera):
    """Exposures beyond 4 s take until they are stopped, or ended by `ready`."""

    exposure_limits_s = (0.001, 1000.0)

    def __init__(self, stops=True):
        super().__init__()
        self.stops, self.ready, self.stopped = stops, threading.Event(), threading.Event()

    def set_exposure_s(self, exposure_s):
        self.exposure_s = exposure_s

    def snap(self):
        while self.exposure_s > 4 and not self.ready.is_set():
            if self.stopped.wait(0.01):
                self.stopped.clear()
                raise ExposureStoppedError("the camera")
        return super().snap()

    def stop_exposure(self):
        if self.stops:
            self.stopped.set()
        return self.stops


def test_a_long_exposure_is_counted_down_and_cancelled(monkeypatch):
    monkeypatch.setattr(watch_module, "COUNT_S", 0.05)
    camera = PatientCamera()
    with watching(camera) as watch:
        until(watch, lambda state: state["figures"])
        watch.set_exposure_s(900.0)
        first = until(watch, lambda state: state["exposing"])
        assert first["exposing"]["exposure_s"] == 900
        until(watch, lambda state: 899 < state["exposing"]["left_s"] < 899.9)
        watch.cancel()
        after = until(watch, lambda state: state["frame"] > first["frame"] + 1)
        assert after["settings"]["exposure_s"] == 0.01
        assert after["trouble"]["camera"] == ""
        until(watch, lambda state: state["exposing"] is None)


def test_what_is_set_during_a_long_exposure_holds_at_once_and_so_does_the_end(monkeypatch):
    monkeypatch.setattr(watch_module, "COUNT_S", 0.05)
    camera = PatientCamera()
    with watching(camera) as watch:
        until(watch, lambda state: state["figures"])
        watch.set_exposure_s(900.0)
        until(watch, lambda state: state["exposing"])
        watch.auto_expose()
        until(watch, lambda state: 0.7 < max(state["figures"]["brightest"].values()) < 0.9)
        watch.set_exposure_s(900.0)
        until(watch, lambda state: state["exposing"])
        begun_s = time.monotonic()
    assert time.monotonic() - begun_s < 5


def test_a_camera_that_cannot_break_off_says_how_long_it_takes(monkeypatch):
    monkeypatch.setattr(watch_module, "COUNT_S", 0.05)
    camera = PatientCamera(stops=False)
    with watching(camera) as watch:
        until(watch, lambda state: state["figures"])
        watch.set_exposure_s(900.0)
        until(watch, lambda state: state["exposing"])
        with pytest.raises(AppError, match=r"nothing else while it exposes: wait \d+ s"):
            watch.cancel()
        camera.ready.set()
        until(watch, lambda state: state["settings"]["exposure_s"] == 0.01)


@pytest.mark.slow
def test_an_earlier_picture_is_not_judged_once_the_stage_has_moved():
    camera, stage = FakeCamera(), SlowStage()
    camera.light = 0.0
    with watching(camera, stage) as watch:
        until(watch, lambda state: state["hint"] and "lamp" in state["hint"]["text"])
        watch.jog("mask_x", 1.0)
        assert stage.moving.wait(PATIENCE_S)
        until(watch, lambda state: state["hint"] is None)
        camera.fault = RawFrameError("no picture since")
        until(watch, lambda state: state["trouble"]["camera"])
        watch.stop()
        assert until(watch, lambda state: not state["busy"])["hint"] is None
        camera.light, camera.fault = 1.0, None
        lit = until(watch, lambda state: not state["trouble"]["camera"] and state["figures"])
        assert "lamp" not in str(lit["hint"])


@contextmanager
def served(watch, **options):
    """Serve; yield a function of method, path, body, headers to status, headers, body."""

    def ask(method, path, body=None, headers=None):
        link = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
        sent = {"Content-Type": "application/json"} if method == "POST" else {}
        link.request(method, path, body, {**sent, **(headers or {})})
        answer = link.getresponse()
        data = answer.read()
        link.close()
        return answer.status, answer.headers, data

    with serving(application(watch, TOKEN, **options)) as port:
        ask.port = port
        yield ask


@contextmanager
def fake_page(camera=None, **options):
    """Serve the page of a camera of which a frame is there; yield the watch and `ask`."""
    with watching(camera or FakeCamera()) as watch, served(watch, **options) as ask:
        until(watch, lambda state: state["frame"])
        yield watch, ask


def test_the_page_its_state_and_its_pictures_are_served():
    with fake_page() as (_, ask):
        status, headers, page = ask("GET", f"/{TOKEN}/")
        assert (status, headers["Referrer-Policy"]) == (200, "no-referrer")
        assert b"emmc-rig live" in page
        assert b"http://" not in page
        assert b"https://" not in page
        for name in Watch.files[1:]:
            assert ask("GET", f"/{TOKEN}/{name}")[0] == 200
        for name in ("viewer.js", "viewer.css"):  # the reports have the same viewer
            assert ask("GET", f"/{TOKEN}/{name}")[2].decode() == source(name)
        status, headers, data = ask("GET", f"/{TOKEN}/picture.jpg?kind=mosaic&part=0.5&px=64")
        assert (status, headers["Content-Type"]) == (200, "image/jpeg")
        decoded = cv2.imdecode(np.frombuffer(data, np.uint8), 1)
        assert decoded is not None
        assert decoded.shape == (64, 64, 3)
        state = json.loads(ask("GET", f"/{TOKEN}/state")[2])
        assert state["settings"]["camera"] == "fake"


def test_strangers_are_refused():
    camera = FakeCamera()
    good = json.dumps({"seconds": 0.05})
    with fake_page(camera) as (watch, ask):
        assert ask("GET", "/")[0] == 403
        assert ask("GET", "/wrong/state")[0] == 403
        assert ask("POST", "/wrong/do/exposure", good)[0] == 403
        assert ask("GET", f"/{TOKEN}/do/exposure?seconds=0.05")[0] == 405
        assert ask("GET", f"/{TOKEN}/state", headers={"Host": "evil.example"})[0] == 400
        evil = {"Origin": "http://evil.example"}
        assert ask("POST", f"/{TOKEN}/do/exposure", good, evil)[0] == 403
        form = {"Content-Type": "application/x-www-form-urlencoded"}
        assert ask("POST", f"/{TOKEN}/do/exposure", "seconds=1", form)[0] == 415
        assert ask("GET", f"/{TOKEN}/..%2f..%2fetc%2fpasswd")[0] in (403, 404)
        assert camera.exposure_s == 0.01
        assert ask("POST", f"/{TOKEN}/do/exposure", good)[0] == 200
        until(watch, lambda state: state["settings"]["exposure_s"] == 0.05)


@pytest.mark.parametrize(
    ("order", "body", "why"),
    [
        ("exposure", "not json", "not JSON"),
        ("exposure", "[" * 100_000, "not JSON"),
        ("exposure", f'{{"seconds": 1{"0" * 5000}}}', "not JSON"),
        ("exposure", "[1]", "send a JSON object"),
        ("exposure", "null", "send a JSON object"),
        ("exposure", "{}", "exposure: seconds: field required"),
        ("exposure", '{"seconds": "1"}', "exposure: seconds: input should be a number"),
        ("exposure", '{"seconds": NaN}', "exposure: seconds: input should be a finite number"),
        ("exposure", '{"seconds": 1e300}', "exposure: seconds: input should be less than 1"),
        ("exposure", '{"seconds": true}', "exposure: seconds: a number is meant, not true"),
        ("exposure", '{"second": 1}', "exposure: unknown key 'second': did you mean 'seconds'?"),
        ("jog", '{"axis": 1, "distance_um": 1}', "jog: axis: input should be text"),
        ("jog", '{"axis": "mask_x", "distance_um": 1}', "no stage here"),
        ("centre", "{}", "it is not known where the mask is centred"),
        ("home", '{"axis": "mask_x"}', "home: this order takes no arguments"),
        ("home", '{"\\ud800": "self"}', "home: this order takes no arguments"),
        ("look", '{"target": "moon"}', "cannot look at 'moon' here"),
        ("reference", '{"taken": 1}', "reference: taken: input should be true or false"),
        ("preview", '{"what": "mask"}', "preview: what: input should be a list"),
    ],
)
def test_an_order_that_makes_no_sense_is_refused_in_one_clear_line(refusing, order, body, why):
    status, _, reported = refusing("POST", f"/{TOKEN}/do/{order}", body)
    assert (status, reported.decode().count("\n")) == (400, 1)
    assert why in reported.decode()
    assert "<" not in reported.decode()


def test_unknown_orders_long_bodies_and_impossible_pictures_are_refused(refusing):
    assert refusing("POST", f"/{TOKEN}/do/explode", "{}")[0] == 404
    assert refusing("POST", f"/{TOKEN}/state", "{}")[0] == 405
    assert refusing("POST", f"/{TOKEN}/do/exposure", " " * 5_000_000)[::2] == (
        413,
        b"more than 131072 bytes\n",
    )
    for query in ("part=x", "part=nan", "kind=xray"):
        assert refusing("GET", f"/{TOKEN}/picture.jpg?{query}")[0] == 400


@pytest.fixture(scope="module")
def refusing():
    """Ask a page that no test changes."""
    with fake_page() as (_, ask):
        yield ask


def test_read_only_shows_and_does_nothing():
    camera = FakeCamera()
    with fake_page(camera, read_only=True) as (_, ask):
        status, _, reported = ask("POST", f"/{TOKEN}/do/exposure", '{"seconds": 0.05}')
        assert status == 403
        assert b"read-only" in reported
        assert json.loads(ask("GET", f"/{TOKEN}/state")[2])["read_only"]
        assert ask("GET", f"/{TOKEN}/picture.jpg")[0] == 200
    assert camera.exposure_s == 0.01


def test_a_stop_is_carried_out_while_a_hundred_pages_follow():
    stage, camera = SlowStage(), FakeCamera()
    with watching(camera, stage) as watch, served(watch) as ask:
        until(watch, lambda state: state["frame"])
        camera.fault = RawFrameError("no news")
        until(watch, lambda state: "no news" in state["trouble"]["camera"])
        watch.jog("mask_x", 1.0)
        assert stage.moving.wait(PATIENCE_S)

        def follow():
            with suppress(OSError, http.client.HTTPException):  # the server ends
                ask("GET", f"/{TOKEN}/events")

        pages = [threading.Thread(target=follow, daemon=True) for _ in range(100)]
        for page in pages:
            page.start()
        assert ask("POST", f"/{TOKEN}/do/stop", "{}")[0] == 200
        assert stage.stops
        assert all(page.is_alive() for page in pages)
    for page in pages:
        page.join(PATIENCE_S)


@pytest.mark.parametrize(
    ("origin", "status"),
    [
        ("http://127.0.0.1:{port}", 200),
        ("https://127.0.0.1:{port}", 403),
        ("ftp://127.0.0.1:{port}", 403),
        ("http://127.0.0.1:1{port}", 403),
        ("http://localhost:{port}", 403),
        ("127.0.0.1:{port}", 403),
        ("null", 403),
    ],
)
def test_only_the_page_itself_by_scheme_host_and_port_may_act(refusing, origin, status):
    given = {"Origin": origin.format(port=refusing.port)}
    body = json.dumps({"seconds": 0.01})
    assert refusing("POST", f"/{TOKEN}/do/exposure", body, given)[0] == status


def test_a_request_that_is_late_or_damaged_is_ended_without_a_line_in_the_log(capfd, monkeypatch):
    monkeypatch.setattr(server, "REQUEST_S", 0.2)
    post = b"POST /secret/do/exposure HTTP/1.1\r\nHost: 127.0.0.1\r\n"
    with fake_page() as (_, ask):
        for begun, answer in (
            (b"GET ", b""),
            (b"GET /secret/", b""),
            (post, b""),
            (post + b"Content-Type: application/json\r\nContent-Length: 9\r\n\r\n{", b""),
            (post + b"Content-Length: x\r\n\r\n{", b"HTTP/1.1 400 "),
            (b"nonsense\r\n\r\n", b"HTTP/1.1 400 "),
        ):
            with socket.create_connection(("127.0.0.1", ask.port), PATIENCE_S) as link:
                link.sendall(begun)
                assert link.makefile("rb").read().startswith(answer)
        assert ask("GET", f"/{TOKEN}/state")[0] == 200
    assert capfd.readouterr().err == ""


def test_who_goes_in_the_middle_of_a_request_leaves_no_traceback(capfd):
    with fake_page() as (_, ask):
        for half in (
            b"",
            b"GET /secret/st",
            b"POST /secret/do/exposure HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 99\r\n"
            b"Content-Type: application/json\r\n\r\n{",
            b"GET /secret/page.css HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\nGET /secret/page.js HTT",
        ):
            with socket.create_connection(("127.0.0.1", ask.port), PATIENCE_S) as link:
                link.sendall(half)
                ask("GET", f"/{TOKEN}/state")
        ask("GET", f"/{TOKEN}/state")
    assert capfd.readouterr().err == ""


def test_a_frame_is_encoded_once_for_all_who_ask(monkeypatch):
    made = []

    def counted(frame, view):
        made.append(view)
        return picture(frame, view)

    monkeypatch.setattr(watch_module, "picture", counted)
    camera = FakeCamera()
    with fake_page(camera) as (watch, ask):
        camera.fault = RawFrameError("no newer frame")
        until(watch, lambda state: state["trouble"]["camera"])
        for _ in range(5):
            assert ask("GET", f"/{TOKEN}/picture.jpg?px=64")[0] == 200
        assert ask("GET", f"/{TOKEN}/picture.jpg?px=32")[0] == 200
    assert [view.px for view in made] == [64, 32]


def program(*arguments):
    code = "from emmc_rig.cli import main; main()"
    return [sys.executable, "-c", code, "live", *arguments]


@pytest.mark.slow
def test_the_command_prints_its_address_and_ends_with_ctrl_c(tmp_path):
    (tmp_path / "one").mkdir()
    command = program("--rig", "simulated", "--size", "32x48", "--scene", "near-planar")
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path
    ) as running:
        assert running.stdout is not None
        address = running.stdout.readline().strip()
        assert address.startswith("http://127.0.0.1:")
        host, _, path = address.removeprefix("http://").partition("/")
        link = http.client.HTTPConnection(host, timeout=PATIENCE_S)
        link.request("GET", f"/{path}state")
        assert link.getresponse().status == 200
        link.close()
        running.send_signal(signal.SIGINT)
        out, err = running.communicate(timeout=PATIENCE_S)
    assert running.returncode == 0, err
    assert "the stage does not move" in out
    assert err == ""


def test_a_port_in_use_is_reported(capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        assert exit_code("live", "--rig", "simulated", "--port", port) == 1
    assert "choose another port" in capsys.readouterr().err
