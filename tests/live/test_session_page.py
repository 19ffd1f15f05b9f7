"""The page of a running capture: pause, retake, finish."""

import http.client
import json
import os
import re
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from contextlib import ExitStack, suppress
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest
import yaml
from asked_person import manned
from pages import order
from programs import PROGRAM, wait_until

import emmc_rig as emmc
from emmc_rig.captures.control import Control
from emmc_rig.captures.run import FrontEnd, capture_session
from emmc_rig.captures.sequencer import ALL_TAKEN
from emmc_rig.errors import AppError, StoppedError
from emmc_rig.live import server
from emmc_rig.live.server import MOST_CONNECTIONS, MOST_WAITING, application, served
from emmc_rig.live.session_page import SessionPage
from emmc_rig.progress import Event
from emmc_rig.session.session import Session

PLAN = {
    "camera": "rgbw-bayer-2shots",
    "shots": [{"exposure_s": "auto"}, {"exposure_s": 0.02}],
    "whiteboards": {"views": [[2, 2]], "repeats": 1, "references": 2},
    "darks": {"repeats": 2},
}


def answer(url, values=None):
    """Return the answer to GET, or to a POST of values."""
    body = None if values is None else json.dumps(values).encode()
    request = urllib.request.Request(url, body, {"Content-Type": "application/json"})
    with urllib.request.urlopen(request, timeout=60) as answered:
        return json.load(answered)


def nobody(what):
    raise AssertionError(f"asked to {what}")


@pytest.fixture
def plan(tmp_path):
    path = tmp_path / "plan.yaml"
    path.write_text("# mine\n" + yaml.safe_dump(PLAN))
    return path


def rig(size=(24, 32)):
    return emmc.rig("simulated", scene="near-planar", size=size, rays=16).description


class Acting(SessionPage):
    """A page on which somebody acts whenever the capture waits; each action once, then finish."""

    def __init__(self, folder, *actions):
        self.control = Control(stays=True)
        super().__init__(folder, self.control, computes=False)
        self.todo = list(actions)
        self.reasons = []

    def event(self, event):
        super().event(event)
        if event.name != "pause":
            return
        self.reasons.append(event.facts["reason"])
        if self.todo:
            self.todo.pop(0)(self)
        else:
            order(self, "stop")

    def run(self, plan):
        front = FrontEnd(self, nobody, control=self.control)
        done = capture_session(plan, rig(), None, None, front)
        assert done is not None
        return done


def test_a_frame_is_taken_again_where_somebody_wants_it_and_the_session_stays_whole(plan):
    page = Acting(
        plan.with_name("plan-session"), lambda page: order(page, "retake", ids=["shot-1-e0-r0"])
    )
    session, outcome = page.run(plan)
    assert outcome.complete
    lines = [e for e in session.journal.entries if getattr(e, "id", "") == "shot-1-e0-r0"]
    assert [line.kind for line in lines] == ["frame", "discarded", "frame"]
    assert page.reasons == [ALL_TAKEN, ALL_TAKEN]
    state = page.state.snapshot()
    assert state["done"] == state["planned"] == len(session.needed)
    assert Session(session.folder).is_complete


def test_the_page_shows_every_frame_with_its_brightness_and_what_goes_wrong(plan):
    page = Acting(plan.with_name("plan-session"))
    session, _ = page.run(plan)
    state = page.state.snapshot()
    json.dumps(state, allow_nan=False)
    shown = {frame["id"]: frame for frame in state["frames"]}
    assert set(shown) == set(session.stored)
    assert all(frame["stored"] for frame in state["frames"])
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
    for ids, why in (
        (["shot-9"], "not on the disk"),
        (["meter-shot-0"], "exposed by it"),
        ([], "choose"),
    ):
        with pytest.raises(AppError, match=why):
            order(page, "retake", ids=ids)


def test_the_page_of_a_resumed_session_shows_what_was_taken_before(plan):
    folder = plan.with_name("plan-session")
    Acting(folder).run(plan)
    page = Acting(folder)
    session, _ = page.run(folder)
    assert {frame["id"] for frame in page.state.snapshot()["frames"]} == set(session.stored)
    wanted = page.pictures["frame.jpg"]({"id": "shot-0-e0-r0"})
    assert wanted is not None
    assert wanted.make()[:2] == b"\xff\xd8"


@pytest.mark.slow
def test_the_light_field_so_far_follows_the_shots_without_until(tmp_path):
    path = tmp_path / "plan.yaml"
    path.write_text(yaml.safe_dump({**PLAN, "whiteboards": {"repeats": 1, "references": 2}}))
    shown = threading.Event()

    class Waiting(Acting):
        def _show_result(self, shots, result):
            super()._show_result(shots, result)
            if len(shots) == 2:
                shown.set()

    page = Waiting(tmp_path / "plan-session", lambda page: (shown.wait(60), page.control.stop()))
    page._computes = True
    page.start()
    try:
        front = FrontEnd(page, nobody, control=page.control)
        capture_session(path, rig((32, 40)), None, None, front)
    finally:
        page.close()
    reported = page.state.snapshot()["light_field"]
    assert reported["shots"] == [2, 2]
    assert "estimated accuracy" in reported["stage"]
    assert reported["pictures"]["views"] == [5, 5]
    wanted = page.pictures["light-field.json"]({})
    assert wanted is not None
    given = json.loads(wanted.make())
    assert given["views"] == {"rows": 5, "columns": 5, "height": 32, "width": 40}
    assert {overlay["key"] for overlay in given["overlays"]} >= {"disparity", "sigma"}
    assert page.state.snapshot()["ended"]


def test_the_last_state_reaches_who_looks_though_the_program_ends_at_once(tmp_path, monkeypatch):
    monkeypatch.setattr(server, "PAUSE_S", 3600)  # the end comes before the next round of states
    page = SessionPage(tmp_path / "session", Control(), computes=False)
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
    page = SessionPage(tmp_path / "session", Control(), computes=False)
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


@pytest.mark.slow
def test_who_never_reads_what_is_pushed_holds_nobody_up(tmp_path, capfd):
    page = SessionPage(tmp_path / "session", Control(), computes=False)
    page.start()
    with ExitStack() as links, served(application(page, "a-secret")) as port:
        for _ in range(3):
            link = links.enter_context(socket.create_connection(("127.0.0.1", port), 60))
            link.sendall(b"GET /a-secret/events HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        for number in range(30):  # more than the sockets hold
            page.state.publish(why=f"{number}" * 1_000_000)
            began_s = time.monotonic()
            assert answer(f"http://127.0.0.1:{port}/a-secret/state")["why"][0] == f"{number}"[0]
            assert time.monotonic() - began_s < 5
            time.sleep(0.05)
        page.close()
        began_s = time.monotonic()
    assert time.monotonic() - began_s < 5
    assert capfd.readouterr().err == ""


class Answering(SessionPage):
    """A page whose every wish is answered; stop_at: number of the wish at which it is stopped."""

    def __init__(self, folder, stop_at=None):
        self.control = Control()
        super().__init__(folder, self.control, computes=False)
        self.stop_at = stop_at
        self.asks = []

    def ask(self, what):
        asks = {"asked": what}
        self.event(Event("pause", {"reason": what}, asks))
        asked = self.state.snapshot()["asked"]
        self.asks.append((asked, self.state.snapshot()["last_hole"]))
        assert not self.control.answered
        order(self, "done", number=asked["number"] - 1)
        assert not self.control.answered  # a press for the wish before it
        if len(self.asks) == self.stop_at:
            order(self, "stop")
        else:
            order(self, "done", number=asked["number"])
        self.control.until_answered()
        self.event(Event("resume", {"seconds": 0.0}, asks))
        assert self.state.snapshot()["asked"] is None


@pytest.mark.slow
def test_the_page_asks_for_a_hole_of_the_plate_and_says_which_one_it_was_instead(
    tmp_path, monkeypatch
):
    plan, rig = manned(tmp_path, monkeypatch, {(1, 1): (1, 2)})
    page = Answering(tmp_path / "plan-session")
    capture_session(plan, rig, None, None, FrontEnd(page, page.ask, control=page.control))
    assert page.state.snapshot()["by_hand"]
    holes = [(wish["hole"], last, wish["refusal"]) for wish, last in page.asks if wish["hole"]]
    assert holes == [
        ([0, 0], None, ""),
        ([1, 1], [0, 0], ""),
        ([1, 1], [1, 2], "That was hole 8 of 25 (row 2, column 3)."),
    ]
    assert {tuple(wish["views"]) for wish, _ in page.asks if wish["hole"]} == {(5, 5)}
    others = [wish for wish, _ in page.asks if not wish["hole"]]
    assert "switch the white lamp on" in {wish["text"] for wish in others}
    # Nothing but the hole is asked for again.
    assert not any(wish["refusal"] for wish in others)
    assert [wish["text"] for wish in others].count("put the whiteboard before the camera") == 1
    numbers = [wish["number"] for wish, _ in page.asks]
    assert numbers == list(range(1, len(numbers) + 1))


def test_a_capture_that_somebody_finishes_instead_of_doing_what_is_asked_ends_at_once(
    tmp_path, monkeypatch
):
    plan, rig = manned(tmp_path, monkeypatch)
    page = Answering(tmp_path / "plan-session", stop_at=1)
    with pytest.raises(StoppedError, match="stopped at once"):
        capture_session(plan, rig, None, None, FrontEnd(page, page.ask, control=page.control))
    assert {wish["text"] for wish, _ in page.asks} == {"switch the lamp off"}
    assert not (tmp_path / "plan-session").exists()


def test_enter_at_the_terminal_answers_too():
    keys = iter(["", "x", "\n"])
    control = Control()
    control.until_answered(lambda: next(keys))
    assert next(keys, None) is None
    assert not control.answered


@pytest.mark.slow
def test_a_page_that_steers_answers_for_a_capture_without_a_terminal(tmp_path):
    (tmp_path / "plan.yaml").write_text(yaml.safe_dump(PLAN))
    axes = dict.fromkeys(("mask_x", "mask_y", "aperture_x", "aperture_y"), 12_700.0)
    rig = {"stage": "simulated", "camera": "simulated", "zero_um": axes, "window_um": 1000.0}
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(rig))
    command = [*PROGRAM, "capture", "plan.yaml", "--rig", "rig.yaml", "--steer"]
    running = subprocess.Popen(
        [*command, "--host", "localhost"], cwd=tmp_path, stdin=subprocess.DEVNULL,
        stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    with running:
        assert running.stderr is not None
        _, address = read_until(running.stderr, r"http://localhost:\d+/\S+/")

        def asked(than=0):
            for _ in range(600):
                now = answer(f"{address}state")["asked"]
                if now and now["number"] > than:
                    return now
                time.sleep(0.1)
            raise AssertionError("nothing is asked")

        first = asked()
        assert first["text"] == "switch the lamp off"
        answer(f"{address}do/done", {"number": first["number"]})
        asked(than=first["number"])
        answer(f"{address}do/stop", {})
        line = running.stderr.read()
    assert running.returncode == 130
    assert "stopped at once" in line


def answers(address):
    with suppress(OSError):
        return answer(f"{address}state")["done"]


def read_until(lines, pattern):
    """Return the lines up to the first that matches, and the match."""
    read = []
    for line in lines:
        read.append(line)
        if match := re.search(pattern, line):
            return read, match.group()
    raise AssertionError("".join(read))


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="a shell sets the limit of open files")
def test_a_flood_of_connections_neither_ends_a_capture_nor_fills_its_log(tmp_path):
    (tmp_path / "plan.yaml").write_text(yaml.safe_dump(PLAN))
    command = [*PROGRAM, "capture", "plan.yaml", "--rig", "simulated", "--steer"]
    size = ["--size", "24x32", "--scene", "near-planar", "--rays", "16"]
    few_files = ["sh", "-c", 'ulimit -n 1024; exec "$@"', "sh"]
    running = subprocess.Popen(
        [*few_files, *command, *size], cwd=tmp_path, stderr=subprocess.PIPE, text=True
    )
    with running, ExitStack() as open_things:
        open_things.callback(running.kill)
        flood = open_things.enter_context(ExitStack())
        assert running.stderr is not None
        _, address = read_until(running.stderr, r"http://\S+/")
        place = urlsplit(address)
        for _ in range(1100):
            link = socket.create_connection((place.hostname, place.port), 60)
            flood.enter_context(link)
            with suppress(ConnectionError):  # closed at once where too many are open
                link.sendall(b"GET ")
        if sys.platform == "linux":
            # The rest is the program's own, and left to it.
            open_files = len(os.listdir(f"/proc/{running.pid}/fd"))
            assert open_files <= MOST_CONNECTIONS + MOST_WAITING + 64
        log, _ = read_until(running.stderr, ALL_TAKEN)
        flood.close()
        wait_until(lambda: answers(address), 60)
        answer(f"{address}do/stop", {})
        log += running.stderr
        assert running.wait(60) == 0
    # Without a flood it prints four.
    assert len(log) <= 10 + 4, log
    assert Session(tmp_path / "plan-session").is_complete
