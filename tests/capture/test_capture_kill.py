"""Captures killed by SIGKILL, at every step and at random lines: a resume makes them whole."""

import os
import shutil
import signal

import numpy as np
import pytest
from capture_kills import HOOKED, capture_into
from capture_rigs import frame_in
from programs import line_server

from emmc_rig.session.journal import HookEntry, of_kind
from emmc_rig.session.session import FRAMES, LOCK, Session
from emmc_rig.session.verify import verify

RANDOM_LINES = 60

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked")


@pytest.fixture(scope="module")
def killed():
    """Run a capture that kills itself at an event; returns its exit code and their number."""
    with line_server("capture_kills.py") as answer:

        def call(kind, number, folder):
            code, count = answer(f"{kind} {number} {folder}").split()
            return int(code), int(count)

        yield call


@pytest.fixture(scope="module")
def undisturbed(memory_folder):
    session = capture_into(memory_folder / "undisturbed")
    return contents(session)


def contents(session):
    """Every file of the frames folder, and the frame in it."""
    return {path.name: frame_in(path.read_bytes()) for path in (session.folder / FRAMES).iterdir()}


def assert_made_whole(folder, expected):
    session = capture_into(folder)
    assert contents(session) == expected
    opened = Session(session.folder)
    verdict = verify(opened)
    assert verdict.is_complete
    assert not verdict.leftovers
    assert opened.is_complete
    assert not [
        path for path in folder.rglob("*") if path.name.startswith(".") or path.name == LOCK
    ]
    assert len(opened.stored) == len(expected)


def check(killed, memory_folder, kind, numbers, expected, ending=""):
    for number in numbers:
        folder = memory_folder / f"{kind}-{number}{ending}"
        code, _ = killed(kind, number, folder)
        assert code == -signal.SIGKILL, number
        assert_made_whole(folder, expected)
        shutil.rmtree(folder)


@pytest.mark.slow
def test_a_capture_killed_at_random_lines_of_the_storing_code_is_made_whole(
    killed, memory_folder, undisturbed
):
    code, lines = killed("line", 0, memory_folder / "all-lines")
    assert code == 0
    chosen = np.random.default_rng(0).choice(np.arange(1, lines - 20), RANDOM_LINES, replace=False)
    check(killed, memory_folder, "line", chosen.tolist(), undisturbed)


@pytest.mark.slow
def test_a_capture_with_a_hook_and_by_hand_killed_at_any_step_is_made_whole(
    killed, memory_folder, undisturbed
):
    code, steps = killed("step", 0, memory_folder / f"all-steps-{HOOKED}")
    assert code == 0
    assert steps >= 10 * len(undisturbed)  # the hook is a step too
    check(killed, memory_folder, "step", range(1, steps + 1), undisturbed, HOOKED)


@pytest.mark.slow
def test_a_capture_with_a_hook_and_by_hand_killed_at_random_lines_notes_every_frame(
    killed, memory_folder, undisturbed
):
    code, lines = killed("line", 0, memory_folder / f"all-lines-{HOOKED}")
    assert code == 0
    rng = np.random.default_rng(11)
    for number in rng.choice(np.arange(1, lines - 20), RANDOM_LINES // 2, replace=False).tolist():
        folder = memory_folder / f"line-{number}-{HOOKED}"
        assert killed("line", number, folder)[0] == -signal.SIGKILL, number
        assert_made_whole(folder, undisturbed)
        session = Session(folder / "s")
        noted = [entry.id for entry in of_kind(session.journal.entries, HookEntry)]
        assert set(noted) == {*session.stored, ""}
        shutil.rmtree(folder)
