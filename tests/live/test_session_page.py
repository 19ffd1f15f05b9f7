"""The page of a running capture: what it shows, and to whom the end is told."""

import http.client
import json
import threading
import time

import cv2
import numpy as np
import pytest
import yaml

import emmc_rig as emmc
from emmc_rig.acquisition.command import FrontEnd, capture_session
from emmc_rig.errors import AppError
from emmc_rig.live import server
from emmc_rig.live.server import application, served
from emmc_rig.live.session_page import SessionPage

PLAN = {
    "camera": "rgbw-bayer-2shots",
    "shots": [{"exposure_s": "auto"}, {"exposure_s": 0.02}],
    "whiteboards": {"views": [[2, 2]], "repeats": 1, "references": 2},
    "darks": {"repeats": 2},
}


def nobody(what):
    raise AssertionError(f"asked to {what}")


@pytest.fixture
def plan(tmp_path):
    path = tmp_path / "plan.yaml"
    path.write_text("# mine\n" + yaml.safe_dump(PLAN))
    return path


def rig(size=(24, 32)):
    return emmc.rig("simulated", scene="near-planar", size=size, rays=16).description


def run(page, plan):
    """Capture before a page that watches; return the session."""
    done = capture_session(plan, rig(), None, None, FrontEnd(page, nobody))
    assert done is not None
    return done[0]


def test_the_page_shows_every_frame_with_its_brightness_and_what_goes_wrong(plan):
    page = SessionPage(plan.with_name("plan-session"), computes=False)
    session = run(page, plan)
    state = page.state()
    json.dumps(state, allow_nan=False)
    shown = {one["id"]: one for one in state["frames"]}
    assert set(shown) == set(session.stored)
    assert all(one["stored"] for one in state["frames"])
    entry = session.stored["shot-1-e0-r0"]
    span = entry.white_level_dn - np.mean(entry.black_level_dn)
    assert shown["shot-1-e0-r0"]["level"] == pytest.approx(entry.figures.bright_dn / span)
    assert state["verdict"]["level"] == "doubt"
    assert state["end"]["complete"]
    for name in ("shot-0-e0-r0", "shot-1-e0-r0"):
        wanted = page.pictures["frame.jpg"]({"id": name})
        assert wanted is not None
        small = cv2.imdecode(np.frombuffer(wanted.make(), np.uint8), 1)
        assert small is not None
    with pytest.raises(AppError, match="no frame"):
        page.pictures["frame.jpg"]({"id": "../plan.yaml"})


def test_the_page_of_a_resumed_session_shows_what_was_taken_before(plan):
    folder = plan.with_name("plan-session")
    run(SessionPage(folder, computes=False), plan)
    page = SessionPage(folder, computes=False)
    session = run(page, folder)
    assert {one["id"] for one in page.state()["frames"]} == set(session.stored)
    wanted = page.pictures["frame.jpg"]({"id": "shot-0-e0-r0"})
    assert wanted is not None
    assert wanted.make()[:2] == b"\xff\xd8"


@pytest.mark.slow
def test_the_light_field_so_far_follows_the_shots_without_until(tmp_path):
    path = tmp_path / "plan.yaml"
    path.write_text(yaml.safe_dump({**PLAN, "whiteboards": {"repeats": 1, "references": 2}}))
    shown = threading.Event()

    class Waiting(SessionPage):
        def light_field(self, shots, result):
            super().light_field(shots, result)
            if len(shots) == 2:
                shown.set()

    page = Waiting(tmp_path / "plan-session")
    page.start()
    try:
        capture_session(path, rig((32, 40)), None, None, FrontEnd(page, nobody))
        assert shown.wait(60)
    finally:
        page.close()
    reported = page.state()["light_field"]
    assert reported["shots"] == [2, 2]
    assert "states" in reported["stage"]
    assert reported["pictures"]["views"] == [5, 5]
    wanted = page.pictures["light-field.json"]({})
    assert wanted is not None
    given = json.loads(wanted.make())
    assert given["views"] == {"rows": 5, "columns": 5, "height": 32, "width": 40}
    assert {one["key"] for one in given["overlays"]} >= {"disparity", "sigma"}
    assert page.state()["ended"]


def test_the_last_state_reaches_who_looks_though_the_program_ends_at_once(tmp_path, monkeypatch):
    monkeypatch.setattr(server, "PAUSE_S", 3600)  # the end comes before the next round of states
    page = SessionPage(tmp_path / "session", computes=False)
    page.start()
    page.tell("the lamp is warm")
    with served(application(page, "a-secret")) as port:
        link = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
        link.request("GET", "/a-secret/events")
        pushed = link.getresponse()
        first = pushed.readline()
        page.close("the camera is gone: plug it in")
    states = [json.loads(line[6:]) for line in (first, *pushed) if line.startswith(b"data: ")]
    link.close()
    assert not states[0]["ended"]
    assert states[-1]["ended"]
    assert states[-1]["why"] == "the camera is gone: plug it in"


def test_the_first_state_is_not_pushed_again_and_again(tmp_path):
    page = SessionPage(tmp_path / "session", computes=False)
    page.start()
    with served(application(page, "a-secret")) as port:
        link = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
        link.request("GET", "/a-secret/events")
        pushed = link.getresponse()
        first = pushed.readline()
        time.sleep(0.3)
        page.close()
    states = [line for line in (first, *pushed) if line.startswith(b"data: ")]
    link.close()
    assert len(states) <= 3
