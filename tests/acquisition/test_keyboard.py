"""Keys are read one at a time: from a POSIX terminal, and from what stands for Windows' console."""

import os
import sys
import time
from types import SimpleNamespace

import pytest

from emmc_rig.acquisition.keyboard import pressed_keys

PATIENCE_S = 5.0


class Input:
    def __init__(self, terminal, number=None):
        self.isatty, self.fileno = lambda: terminal, lambda: number


def test_keys_of_a_windows_console_are_read_and_those_of_two_codes_passed_over(monkeypatch):
    waiting = list("s\xe0Hq")
    console = SimpleNamespace(kbhit=lambda: bool(waiting), getwch=lambda: waiting.pop(0))
    monkeypatch.setitem(sys.modules, "msvcrt", console)
    monkeypatch.setattr(sys, "stdin", Input(terminal=True))
    with pressed_keys() as pressed:
        assert [pressed() for _ in range(4)] == ["s", "", "q", ""]
    monkeypatch.setattr(sys, "stdin", Input(terminal=False))
    waiting.append("s")
    with pressed_keys() as pressed:
        assert pressed() == ""


@pytest.mark.skipif(os.name == "nt", reason="pseudo-terminals are POSIX")
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
