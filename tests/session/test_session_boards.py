"""Which of a session's frames are whose whiteboards, darks and checks: each frame has its number.

Every frame is even: 100 in the dark and 1000 under the lamp, plus its place in the capture, from 1.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from capture_rigs import SIZE, PreparedCamera, begun, still_rig, stops_after
from simulated_disk import SimulatedDisk

from emmc_rig.captures.control import Control
from emmc_rig.captures.sequencer import Sequencer
from emmc_rig.errors import AppError
from emmc_rig.session import measured_psi
from emmc_rig.session.board_sets import (
    board_sets,
    mean_dark,
    mean_of,
    sensor_pairs,
    session_darks,
    whiteboards,
)
from emmc_rig.session.session import Session

CHANNELS = np.full(SIZE, 3, np.uint8)
PLAN = """
camera: rgbw-bayer-1shot
shots: [{exposure_s: 0.02}]
darks: {exposure_s: [0.04, 0.01], repeats: 2}
whiteboards: """
MANY = """
  views: [[2, 2], [0, 1]]
  open: [{}, {mask_um: [24, -12]}, {mask_um: [48, 0], validation: true}]
  repeats: 2
  references: 2
  response: [0.5, 0.25, 0.125]
  lamp_checks: 2
  turned: 1
  exposure_s: 0.02
"""
TURNED = "{views: [], turned: 1, references: 2, exposure_s: 0.02}"


class Evenly(PreparedCamera):
    """A camera whose frames are as even as said above; its clock counts them."""

    def __init__(self, still):
        super().__init__(self.frame)
        self.plain, self.count, self.name = still, 0, ""

    def announce(self, name):
        self.count, self.name = self.count + 1, name

    def frame(self, _exposure_s):
        level = self.count + (100 if self.name.startswith("dark") else 1000)
        mosaic = np.full(SIZE, level, np.uint16)
        return replace(self.plain.snap(), mosaic=mosaic, host_time_s=float(self.count))


def captured(boards, stopped_after=None):
    """Return the session of a plan with these whiteboards; stopped: a new camera goes on."""
    disk, control = SimulatedDisk(), Control()

    def rig():
        still = still_rig()
        camera = Evenly(still.camera)
        return replace(still, camera=camera, about_to_expose=camera.announce)

    session, plan = begun(Path("/disk"), disk, rig(), PLAN + boards)
    if stopped_after:
        watcher = stops_after(stopped_after, control)
        assert not Sequencer(session, plan, rig(), watcher, control).run().complete
        session = Session(session.folder, disk)
    assert Sequencer(session, plan, rig()).run().complete
    return session


@pytest.fixture(scope="module")
def session():
    return captured(MANY)


def levels(session):
    """Return by frame's name what it reads under the lamp."""
    return {name: 1000 + place for place, name in enumerate(session.stored, 1)}


def names(session, boards):
    """Return of each whiteboard the name of the two frames that it is the mean of."""
    first = {level: name.removesuffix("-r0") for name, level in levels(session).items()}
    return [first[int(board.frame.mean_dn.mean())] for board in boards.frames]


def whiteboards_of(session, routes):
    """Return the routes, and how many whiteboards judge, fit and measure by the pinhole."""
    found: Any = measured_psi.session_outcome(session, routes)
    routes, *boards = found
    return (routes, *(len(some.frames) if some else 0 for some in boards))


def test_every_whiteboard_goes_to_what_takes_it(session):
    boards = board_sets(session, CHANNELS)
    assert boards.fit is not None
    pinholes = ["board-s0-v2-u2-white", "board-s0-v0-u1-white"]
    assert names(session, boards.fit) == ["open-0", "open-1", *pinholes]
    assert names(session, boards.pinholes) == pinholes
    assert names(session, boards.held_out) == ["held-out-2"]
    assert names(session, whiteboards(session)) == pinholes
    assert [frame.stage_um for frame in boards.fit.frames[:2]] == [(0, 0), (24, -12)]
    assert [frame.pinhole for frame in boards.fit.frames] == [None, None, (2, 2), (0, 1)]
    (turned,) = boards.turned.items()
    assert turned[0] == 90
    (seen,) = turned[1].frames
    level = levels(session)
    assert seen.frame.mean_dn[0, 0] == level["turned-open-r0"]
    assert turned[1].references[0, "white"].mean_dn[0, 0] == level["turned-reference-r0"]


def test_each_method_is_given_the_whiteboards_that_it_takes(session, monkeypatch):
    monkeypatch.setattr(measured_psi, "calibrate", lambda *given, **_: given[2:])
    assert whiteboards_of(session, None) == (("parametric", "mixed"), 1, 4, 2)
    assert whiteboards_of(session, ("free", "combined")) == (("free", "combined"), 1, 4, 2)
    assert whiteboards_of(session, ("free",)) == (("free",), 1, 0, 2)
    with pytest.raises(AppError, match="the pinhole and no validation whiteboard"):
        whiteboards_of(captured(TURNED), None)


def test_checks_are_the_references_and_what_is_seen_again_above_its_dark(session):
    boards = board_sets(session, CHANNELS)
    assert boards.fit is not None
    checks = boards.fit.checks
    # Two references, two of each response, two of the lamp, two references at the end.
    assert [check.masks_in for check in checks].count(True) == 2
    assert len(checks) == 2 + 3 * 2 + 2 + 2
    # At 0.02 s a third of the way from the dark of 0.01 s to that of 0.04 s.
    darks = {dark.exposure_s: float(dark.mean_dn[0, 0]) for dark in session_darks(session)}
    dark = darks[0.01] + (darks[0.04] - darks[0.01]) / 3
    above = levels(session)["reference-s0-white-r0"] - dark
    assert checks[0].above_dn == pytest.approx((np.nan,) * 3 + (above,), abs=1e-3, nan_ok=True)


def test_a_plan_with_turned_boards_alone_has_no_others_and_one_with_none_is_refused():
    boards = board_sets(captured(TURNED), CHANNELS)
    assert (boards.fit, boards.pinholes, boards.held_out) == (None, None, None)
    assert list(boards.turned) == [90]
    none = captured("null")
    for read in (lambda: board_sets(none, CHANNELS), lambda: whiteboards(none)):
        with pytest.raises(AppError, match="its plan has no whiteboards"):
            read()


def test_darks_are_means_of_one_exposure_each_the_shortest_first(session):
    assert [(dark.exposure_s, dark.count) for dark in session_darks(session)] == [
        (0.01, 2),
        (0.04, 2),
    ]
    assert mean_dark(session).exposure_s == 0.01


def test_the_sensor_s_pairs_are_of_equal_exposures_the_shortest_first(session):
    darks, flats = sensor_pairs(session)
    assert [pair.exposure_s for pair in darks] == [0.01, 0.04]
    assert all(pair.second[0, 0] == pair.first[0, 0] + 1 for pair in darks)
    assert [pair.exposure_s for pair in flats] == [0.0025, 0.005, 0.01, 0.02]
    with pytest.raises(AppError, match="it has 2 and 1"):
        sensor_pairs(captured(TURNED))


def test_a_run_follows_the_one_before_though_its_clock_begins_anew():
    session = captured(TURNED, stopped_after="dark-0-r1")
    taken_s = [mean_of(session, [frame]).taken_s for frame in session.frames]
    # Two frames, and the new clock's first second is at the last of the old one.
    assert taken_s == [1, 2, *range(2, len(taken_s))]
