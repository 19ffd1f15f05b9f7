"""The page's server under people who connect and never end a request: strangers, a bad network."""

import http.client
import json
import socket
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager

import pytest
from test_live import PATIENCE_S, TOKEN, FakeCamera, SlowStage, watching

from emmc_rig.live import connections as connections_module
from emmc_rig.live.server import application, served
from emmc_rig.live.setup_page import SetupPage

HOST = "127.0.0.1"
HALVES = (
    b"",
    b"GET /secret/st",
    b"POST /secret/do/exposure HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 99\r\n"
    b"Content-Type: application/json\r\n\r\n{",
    b"GET /secret/page.css HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\nGET /secret/page.js HTT",
)
"""Nothing, half a head, half a body, and half a second request."""


@contextmanager
def serving(*arguments):
    with watching(*arguments) as watch, served(application(SetupPage(watch), TOKEN)) as port:
        yield port


def ask(port, method="GET", path="state", body=None, **headers):
    link = http.client.HTTPConnection(HOST, port, timeout=PATIENCE_S)
    sent = {"Content-Type": "application/json"} if method == "POST" else {}
    link.request(method, f"/{TOKEN}/{path}", body, {**sent, **headers})
    answer = link.getresponse()
    data = answer.read()
    link.close()
    return answer.status, data


def connected(opened, port, sent):
    link = opened.enter_context(socket.create_connection((HOST, port), PATIENCE_S))
    link.sendall(sent)
    return link


def is_open(link):
    """Whether the other side has not closed; reads away what it sent."""
    link.setblocking(False)
    try:
        while data := link.recv(1 << 16):
            assert data
    except BlockingIOError:
        return True
    except ConnectionError:
        return False
    return False


def still_open(links, most):
    """Return how many are open, once that is `most`, or after a patience."""
    end_s = time.monotonic() + 4
    while (count := sum(map(is_open, links))) > most and time.monotonic() < end_s:
        time.sleep(0.05)
    return count


def looking(opened, port):
    """Return a connection that states are pushed to."""
    link = connected(opened, port, b"GET /secret/events HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
    assert link.recv(1 << 16).startswith(b"HTTP/1.1 200")
    return link


def test_whoever_ends_no_request_is_let_go_and_whoever_looks_is_not(monkeypatch):
    monkeypatch.setattr(connections_module, "LONGEST_REQUEST_S", 0.2)
    monkeypatch.setattr(connections_module, "SWEEP_S", 0.1)
    with serving(FakeCamera()) as port, ExitStack() as opened:
        page = looking(opened, port)
        halves = [connected(opened, port, half) for half in HALVES]
        assert still_open(halves, 0) == 0
        assert is_open(page)


def test_beyond_the_most_connections_the_oldest_half_sent_request_makes_room(monkeypatch):
    monkeypatch.setattr(connections_module, "MOST_CONNECTIONS", 8)
    with serving(FakeCamera()) as port, ExitStack() as opened:
        page = looking(opened, port)
        halves = [connected(opened, port, HALVES[1 + i % 2]) for i in range(20)]
        assert ask(port)[0] == 200
        assert 1 <= still_open(halves, 7) <= 7
        assert is_open(page)


def test_pages_that_take_every_connection_do_not_keep_a_stop_out(monkeypatch):
    monkeypatch.setattr(connections_module, "MOST_CONNECTIONS", 8)
    stage = SlowStage()
    with serving(FakeCamera(), stage) as port, ExitStack() as opened:
        pages = [looking(opened, port) for _ in range(8)]
        assert ask(port, "POST", "do/stop", "{}")[0] == 200
        assert stage.stops
        assert [is_open(one) for one in pages] == [False] + [True] * 7


FLOOD = """
import resource, socket, sys
most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
resource.setrlimit(resource.RLIMIT_NOFILE, (min(most, 4096), most))
halves, links = eval(sys.argv[2]), []
for number in range(1100):
    link = socket.socket()
    link.setblocking(False)
    link.connect_ex(("127.0.0.1", int(sys.argv[1])))
    links.append(link)
for number, link in enumerate(links):
    try:
        link.send(halves[number % len(halves)])
    except OSError:
        pass
print("sent", flush=True)
sys.stdin.read()
"""


@pytest.mark.timing("computing time grows where two processes share a core's caches")
def test_the_stage_has_a_stop_within_50_ms_while_1100_connect_and_send_half_a_request():
    """Counted is the time that this process computes: others use this computer too."""

    class Timed(SlowStage):
        def stop(self, axes=None):
            self.stopped_s = time.process_time()
            super().stop(axes)

    stage, taken_s = Timed(), []
    with serving(FakeCamera(), stage) as port:
        ask(port, "POST", "do/stop", "{}")
        for _ in range(3):
            command = [sys.executable, "-c", FLOOD, str(port), repr(HALVES[1:3])]
            with subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
            ) as crowd:
                assert crowd.stdout is not None
                assert crowd.stdout.readline() == "sent\n"
                begun_s = time.process_time()
                assert ask(port, "POST", "do/stop", "{}")[0] == 200
                taken_s.append(stage.stopped_s - begun_s)
                crowd.communicate()
    assert min(taken_s) < 0.05, taken_s


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
def test_only_the_page_itself_by_scheme_host_and_port_may_act(origin, status):
    with serving(FakeCamera()) as port:
        body = json.dumps({"seconds": 0.05})
        given = {"Origin": origin.format(port=port)}
        assert ask(port, "POST", "do/exposure", body, **given)[0] == status


def test_who_goes_in_the_middle_of_a_request_leaves_no_traceback(capfd):
    with serving(FakeCamera()) as port:
        with ExitStack() as opened:
            for half in HALVES:
                connected(opened, port, half)
            ask(port)
        ask(port)
    assert capfd.readouterr().err == ""
