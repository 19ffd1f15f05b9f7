"""Keys are read one at a time from a terminal."""

import os
import sys
import time
from types import SimpleNamespace

from emmc_rig.captures.control import pressed_keys

PATIENCE_S = 5.0


def test_on_windows_keys_are_read_from_a_terminal_alone(monkeypatch):
    waiting = ["q"]
    keys = SimpleNamespace(kbhit=lambda: bool(waiting), getwch=waiting.pop)
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setitem(sys.modules, "msvcrt", keys)
    for is_terminal, expected in ((False, ["", ""]), (True, ["q", ""])):
        monkeypatch.setattr(sys, "stdin", SimpleNamespace(isatty=lambda it=is_terminal: it))
        with pressed_keys() as pressed:
            assert [pressed(), pressed()] == expected


def test_keys_of_a_terminal_are_read_without_a_line_end(monkeypatch):
    host, terminal = os.openpty()
    try:
        with os.fdopen(terminal, closefd=False) as lines:
            monkeypatch.setattr(sys, "stdin", lines)
            with pressed_keys() as pressed:
                assert pressed() == ""
                os.write(host, b"q")
                deadline_s = time.monotonic() + PATIENCE_S
                while (key := pressed()) == "":
                    assert time.monotonic() < deadline_s
                    time.sleep(0.005)
                assert key == "q"
    finally:
        os.close(host)
        os.close(terminal)
