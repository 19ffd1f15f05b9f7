"""Captures whose light is switched by the rig: without a hand, and with faults.

The simulated lamp is an Arduino that restarts when its port opens, and answers late.
"""

import math
from dataclasses import replace
from pathlib import Path

import pytest
from capture_rigs import begun, plan_and_camera, request_for
from programs import done, refused
from simulated_disk import SimulatedDisk

from emmc_rig.bench.hardware import Fitted, simulated_rig
from emmc_rig.captures.faults import GaveUpError, refuse_impossible
from emmc_rig.captures.run import begun_session, new_session, planned_frames
from emmc_rig.captures.sequencer import Sequencer
from emmc_rig.drivers.lights import COLOURS
from emmc_rig.errors import AppError
from emmc_rig.formats.scenes import fine_scene
from emmc_rig.session.journal import RetryEntry, RunEntry, of_kind
from emmc_rig.session.verify import verify

SIZE = (24, 32)
PLAN = """
camera: rgbw-bayer-1shot
shots: [{exposure_s: 0.05, repeats: 2}, {camera_shot: 0, exposure_s: 0.05, lamp: red}]
whiteboards: {views: [[2, 2]], repeats: 1, references: 2, colours: 2}
darks: {repeats: 2}
retries: {per_frame: 2}
"""


def lit_rig(lights=True):
    """Return the simulated rig whose lamp no hand may switch, and what its bench saw."""
    samples = fine_scene("near-planar", 1, 1, size=SIZE).samples
    rig, bench = simulated_rig(
        plan_and_camera(PLAN)[1], samples, SIZE, 0, fitted=Fitted(lights=lights)
    )
    if lights:
        rig.attendant.set_lamp = lambda colour: pytest.fail("a hand was asked for")
    return rig, bench


def lamp_of(rig):
    assert rig.lamp is not None
    return rig.lamp


def captured(rig):
    session, plan = begun(Path("/disk"), SimulatedDisk(), rig, PLAN)
    assert Sequencer(session, plan, rig).run().complete
    return session


def test_every_frame_is_lit_as_planned_and_the_journal_has_the_lights_answer():
    rig, bench = lit_rig()
    session = captured(rig)
    for planned in session.frames:
        entry = session.stored[planned.id]
        assert (entry.lamp, entry.lamp_read) == (planned.bench.lamp, f"ok {planned.bench.lamp}")
    assert {entry.lamp for entry in session.stored.values()} == set(COLOURS)
    run = next(iter(of_kind(session.journal.entries, RunEntry)))
    assert run.lights == {"name": "simulator", "colours": [*COLOURS]}
    assert bench.lamp == "off"


def test_lights_that_do_not_answer_stop_the_capture_and_it_goes_on_afterwards():
    rig, bench = lit_rig()
    session, plan = begun(Path("/disk"), SimulatedDisk(), rig, PLAN)
    lamp_of(rig).faults.inject(
        "drop_reply", math.inf, when=lambda occasion: b"red" in occasion.reply
    )
    with pytest.raises(
        GaveUpError, match=r"the lights \(simulator\) cannot be set to red, .* answ"
    ):
        Sequencer(session, plan, rig).run()
    kept = {name: session.read(name) for name in session.stored}
    assert kept
    assert bench.lamp == "off"
    lamp_of(rig).faults.clear()
    assert Sequencer(session, plan, rig).run().complete
    assert {name: session.read(name) for name in kept} == kept
    assert not verify(session).damaged


@pytest.mark.parametrize("fault", ["drop_reply", "late_reply", "garble_reply", "drop_command"])
def test_one_fault_of_the_lights_costs_no_frame_and_homes_nothing(fault):
    rig, _ = lit_rig()
    session, plan = begun(Path("/disk"), SimulatedDisk(), rig, PLAN)
    homed, home = [], rig.stage.home
    rig.stage.home = lambda axes=None: homed.append(home(axes))
    lamp_of(rig).faults.inject(fault, times=2, skip=3)
    assert Sequencer(session, plan, rig).run().complete
    assert len(homed) == 1
    faults = [entry.fault for entry in of_kind(session.journal.entries, RetryEntry)]
    assert all("the lights" in fault for fault in faults)


def test_an_unplugged_lamp_that_is_plugged_in_again_goes_on_by_itself():
    rig, _ = lit_rig()
    session, plan = begun(Path("/disk"), SimulatedDisk(), rig, PLAN)
    lamp_of(rig).faults.inject("unplug", skip=2)
    sleep = rig.clock.sleep

    def somebody_plugs_in(duration_s):
        sleep(duration_s)
        if lamp_of(rig).unplugged:
            lamp_of(rig).replug(power_lost=True)

    rig.clock.sleep = somebody_plugs_in
    assert Sequencer(session, plan, rig).run().complete
    (fault,) = [entry.fault for entry in of_kind(session.journal.entries, RetryEntry)]
    assert fault == (
        "the lights (simulator) cannot be set to red, serial port simulator went away: check "
        "their cable and power"
    )


def test_a_colour_that_the_lights_lack_is_refused_before_anything_is_lit():
    rig, bench = lit_rig()
    frames = planned_frames(request_for(Path("/disk"), text=PLAN), rig)
    assert rig.lights is not None
    rig.lights.colours = ("off", "white")
    with pytest.raises(AppError, match=r"have no red, only off, white: name it under lights: in"):
        refuse_impossible(rig, frames)
    assert bench.lamp == "off"


def test_settings_of_lights_may_be_corrected_in_a_session_that_has_begun(tmp_path):
    rig, _ = lit_rig()
    request = replace(request_for(tmp_path / "session", text=PLAN), rig={"kind": "real"})
    session = new_session(request, planned_frames(request, rig))
    Sequencer(session, request.plan, rig).run()
    lights = {"protocol": "command", "colours": {"off": ["lamp", "0"]}}
    assert begun_session(replace(request, rig={"kind": "real", "lights": lights})) is not None
    with pytest.raises(AppError, match="begun with another rig"):
        begun_session(replace(request, rig={"kind": "real", "window_um": 3.0}))


def test_the_command_lists_and_switches_lights_and_says_what_is_wrong(run, tmp_path):
    assert "off, white, red, green, blue" in done(run("devices", "lights", "--rig", "simulated"))
    assert "confirmed by 'ok red'" in done(run("devices", "lights", "red", "--rig", "simulated"))
    rig = tmp_path / "rig.yaml"
    rig.write_text(
        "camera: simulated\n"
        "lights: {protocol: command, colours: {off: ['true'], white: ['false']}}\n"
    )
    assert "off, confirmed" in done(run("devices", "lights", "off", "--rig", rig))
    assert "exit code 1" in refused(run("devices", "lights", "white", "--rig", rig))
    assert "have no pink, only off, white" in refused(
        run("devices", "lights", "pink", "--rig", rig)
    )
    rig.write_text("camera: simulated\n")
    assert "names no lights" in refused(run("devices", "lights", "off", "--rig", rig))
    rig.write_text("kind: simulated\nlights: {protocol: mm, port: x, shutter: y}\n")
    assert "write lights: simulated" in refused(run("devices", "lights", "off", "--rig", rig))
