"""A plan that focuses: the axis goes to where the scene is sharpest, and what is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from capture_rigs import begun, plan_and_camera
from simulated_disk import SimulatedDisk

import emmc_rig as emmc
from emmc_rig.bench.hardware import simulated_rig
from emmc_rig.captures.sequencer import Sequencer
from emmc_rig.drivers.errors import DriverError, NotHomedError
from emmc_rig.formats.scenes import fine_scene
from emmc_rig.session.journal import FocusEntry, HaltEntry, RetryEntry, of_kind

FOCUS_UM = 9000.0
PLAN = """
camera: rgbw-bayer-1shot
shots: [{exposure_s: 0.05, repeats: 4}]
whiteboards: null
darks: {repeats: 2}
"""


def captured(
    tmp_path, focus, rig=f"focus_um: {FOCUS_UM}\nfixed_positions_um: {{focus: 8800}}", **more
):
    """Return the session of a plan that focuses so, on a simulated rig of that file."""
    (tmp_path / "plan.yaml").write_text(f"{PLAN}focus: {focus}\n")
    (tmp_path / "rig.yaml").write_text(f"kind: simulated\n{rig}\n")
    chosen = emmc.rig(tmp_path / "rig.yaml", scene="deep-occlusions", size=(64, 80), rays=64)
    return emmc.capture(tmp_path / "plan.yaml", chosen, **more)


def focused(session):
    return of_kind(session.journal.entries, FocusEntry)


def test_the_axis_goes_to_where_the_scene_is_sharpest_before_the_shots(tmp_path):
    session = captured(tmp_path, "before-shots")
    (found,) = focused(session)
    assert found.id == "shot-0-e0-r0"
    assert found.from_um == pytest.approx(8800, abs=1)
    assert found.place_um is not None
    assert found.deviation_um is not None
    assert abs(found.place_um - FOCUS_UM) < 4 * max(found.deviation_um, 3.0)
    assert abs(found.place_um - FOCUS_UM) < 50
    assert "sharpest at" in str(found)


def test_it_focuses_again_when_so_many_frames_were_taken(tmp_path):
    session = captured(tmp_path, "{every: 2, span_um: 300}")
    assert [entry.id for entry in focused(session)] == ["shot-0-e0-r0", "shot-0-e0-r2"]
    again = focused(session)[1]
    # A later run begins at the last position.
    assert again.from_um == pytest.approx(focused(session)[0].place_um, abs=1)


@pytest.mark.parametrize("focus", ["before-shots", "{every: 3}"])
def test_a_rig_without_a_focus_axis_is_refused_before_anything_is_made(tmp_path, focus):
    with pytest.raises(emmc.ERRORS, match=r"^focus: the rig has no axis named focus, only mask_x"):
        captured(tmp_path, focus, rig="")
    assert not (tmp_path / "plan-session").exists()


@pytest.mark.parametrize("focus", ["often", "{every: 0}", "{evry: 3}"])
def test_a_plan_that_says_nothing_of_the_kind_is_refused(tmp_path, focus):
    with pytest.raises(emmc.ERRORS, match="focus"):
        captured(tmp_path, focus)


def test_where_no_peak_is_seen_the_axis_is_left_where_it_stood_and_the_capture_goes_on(tmp_path):
    told = []
    rig = f"focus_um: {FOCUS_UM}\nfixed_positions_um: {{focus: 2000}}"
    session = captured(
        tmp_path, "{span_um: 20}", rig=rig,
        on_event=lambda event: told.append(event.facts.get("text", "")),
    )  # fmt: skip
    assert session.is_complete
    (found,) = focused(session)
    assert found.place_um is None
    assert found.fault
    assert any("not focused" in text for text in told)
    assert not of_kind(session.journal.entries, HaltEntry)
    assert np.isclose(found.from_um, 2000, atol=1)


class Faltering:
    """A camera whose n-th frame, from 1, is lost."""

    def __init__(self, camera, lost, fault):
        self._camera, self._left, self._fault = camera, lost, fault

    def __getattr__(self, name):
        return getattr(self._camera, name)

    def snap(self):
        self._left -= 1
        if self._left == 0:
            raise self._fault
        return self._camera.snap()


@pytest.mark.parametrize(
    ("lost", "fault", "at"),
    [
        (4, DriverError("the cable was touched"), "while it focuses"),
        # 32 are of focusing; what makes the stage home must not undo it.
        (34, NotHomedError("mask_x"), "of a later frame"),
    ],
)
def test_a_fault_is_met_by_focusing_from_where_it_began_or_by_going_back_there(lost, fault, at):
    text = PLAN.replace("darks: {repeats: 2}", "darks: null") + "focus: before-shots\n"
    size = (48, 64)
    camera = plan_and_camera(text)[1]
    fine = fine_scene("deep-occlusions", 2, 2, size=size, views=camera.views)
    rig, _ = simulated_rig(
        camera, fine.samples, size, 0, focus_um=FOCUS_UM, fixed_positions_um={"focus": 8800.0}
    )
    rig = replace(rig, camera=Faltering(rig.camera, lost, fault))
    session, plan = begun(Path("/disk"), SimulatedDisk(), rig, text)
    assert Sequencer(session, plan, rig).run().complete
    (retry,) = of_kind(session.journal.entries, RetryEntry)
    assert retry.fault == str(fault)
    assert (retry.id == "shot-0-e0-r1") == (at == "of a later frame")
    (found,) = focused(session)
    assert found.from_um == pytest.approx(8800, abs=1)
    assert found.place_um == pytest.approx(FOCUS_UM, abs=50)
    for frame in session.frames:
        assert session.stored[frame.id].stands_um["focus"] == pytest.approx(found.place_um, abs=1)
