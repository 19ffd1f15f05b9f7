"""From an unpacked box to a plan: focus and the mask's place are found, and written where asked."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from test_live import until, watching

from emmc_rig.bench.hardware import Fitted, simulated_rig
from emmc_rig.bench.rig_config import ImagedRig, rig_description
from emmc_rig.captures.focus import FocusFound, peak
from emmc_rig.commands.live import saving_wants
from emmc_rig.errors import AppError
from emmc_rig.formats.cameras import find_camera
from emmc_rig.formats.scenes import fine_scene
from emmc_rig.formats.yaml_edit import replace_text, with_values
from emmc_rig.live.alignment import MaskPlace
from emmc_rig.live.save import Files, Found
from emmc_rig.simulators.bench import MountingErrors

RIG_YAML = """# the bench in room 12
stage: stage.yaml          # four axes
camera: "ptp:"
zero_um: {mask_x: 12700, mask_y: 12700}   # by eye
"""
PLAN_YAML = """# mine
camera: rgbw-bayer-2shots
shots:
  - exposure_s: auto       # metered
  - {gain: 2}
"""


@pytest.mark.parametrize(
    ("plan", "rig", "wants"),
    [
        (
            None,
            None,
            "Saving needs `--plan PLAN` (exposure) and `--rig FILE` (centre, mask, focus).",
        ),
        (None, "rig.yaml", "Saving needs `--plan PLAN` (exposure)."),
        (Path("plan.yaml"), "simulated", "Saving needs `--rig FILE` (centre, mask, focus)."),
        (Path("plan.yaml"), "rig.yaml", ""),
    ],
)
def test_the_command_says_at_its_start_what_saving_wants(plan, rig, wants):
    assert saving_wants(plan, rig) == wants


def lit_rig(focus_um=None, errors=None):
    camera, size = find_camera("rgbw-bayer-1shot"), (48, 64)
    fine = fine_scene("near-planar", 2, 2, size=size, views=camera.views)
    rig, bench = simulated_rig(camera, fine.samples, size, 0, focus_um=focus_um)
    if errors is not None:
        bench._errors = errors
    rig.attendant.set_lamp("white")
    rig.camera.set_exposure_s(0.2)
    centre_um = {**rig.zero_um, "aperture_x": rig.zero_um["aperture_x"] + rig.window_um}
    return camera, rig, centre_um


def test_autofocus_finds_where_the_simulated_lens_has_the_scene_sharp():
    _, rig, centre_um = lit_rig(focus_um=9000.0)
    with watching(rig.camera, rig.stage, None, (), centre_um) as watch:
        watch.centre()
        until(watch, lambda state: not state["busy"] and state["axes"])
        rig.stage.home(["focus"])
        rig.stage.move_to_um({"focus": 8700.0})
        watch.autofocus(400.0)
        ended = until(watch, lambda state: not state["busy"] and state["figures"])
        assert ended["trouble"]["stage"] == ""
        found = watch._found.focus
        assert found is not None
        assert found.place_um == pytest.approx(9000.0, abs=max(10.0, 4 * found.deviation_um))
        assert rig.stage.position_um("focus") == pytest.approx(found.place_um, abs=1)
        step = next(step for step in ended["steps"] if step["name"] == "focus")
        assert step["done"]


def test_a_peak_and_its_deviation_are_those_of_the_parabola():
    rng = np.random.default_rng(0)
    places = np.linspace(90, 110, 7)
    errors = np.full(7, 0.02)
    found = [
        peak(places, 3 - ((places - 101.3) / 8) ** 2 + rng.normal(0, errors), errors)
        for _ in range(300)
    ]
    off = np.array([place - 101.3 for place, _ in found])
    stated = np.array([deviation for _, deviation in found])
    assert abs(off.mean()) < 4 * off.std() / np.sqrt(300)
    # Stated by the larger of errors and scatter, it is a little too large on average.
    assert 0.9 < np.median(stated) / off.std() < 1.5
    with pytest.raises(AppError, match="no sharpest position"):
        peak(places, places / 10, errors)


def test_without_a_focus_axis_it_is_said_why_and_what_to_do():
    _, rig, centre_um = lit_rig()
    with watching(rig.camera, rig.stage, None, (), centre_um) as watch:
        state = until(watch, lambda state: state["steps"])
        with pytest.raises(AppError, match="no axis named focus"):
            watch.autofocus(100.0)
        step = next(step for step in state["steps"] if step["name"] == "focus")
        assert "by hand" in step["text"]
        assert step["action"] == ""


def test_the_mask_is_centred_by_what_was_measured_and_written(tmp_path):
    """The true offset is (30, -20) um: with the zeros that are written it is gone."""
    path = tmp_path / "rig.yaml"
    camera, rig, centre_um = lit_rig(errors=MountingErrors(offset_um=(30.0, -20.0)))
    path.write_text(RIG_YAML.replace("12700}", f"{rig.zero_um['mask_y']:g}}}"))
    files = Files(None, path)
    arguments = (rig.camera, rig.stage, rig.attendant.place, ("scene", "whiteboard"), centre_um)
    with watching(*arguments, camera, None, files) as watch:
        watch.look_at("whiteboard")
        watch.centre()
        until(watch, lambda state: (state["mask"] or {}).get("place"))
        shown = watch.preview(["centre", "mask"])["diff"]
        assert "-zero_um" in shown
        assert path.read_text().startswith("# the bench in room 12\n")
        assert not watch.state.snapshot()["steps"][-1]["done"]
        assert watch.save() == {"written": [str(path)], "next": ""}
        last = watch.state.snapshot()["steps"][-1]
        assert (last["done"], last["text"]) == (True, "wrote rig.yaml")
    written = yaml.safe_load(path.read_text())
    for axis, off_um in (("mask_x", 30.0), ("mask_y", -20.0)):
        assert written["zero_um"][axis] == pytest.approx(rig.zero_um[axis] - off_um, abs=3)
    assert "# by eye" in path.read_text()
    assert written["mask"]["rotation_deg"] == pytest.approx(-0.03, abs=0.1)
    assert rig_description(str(path), ImagedRig(scene="dark"))["mask"]["scale"] > 0.99


def test_the_place_of_a_mask_that_repeats_is_not_written(tmp_path):
    path = tmp_path / "rig.yaml"
    path.write_text(RIG_YAML)
    camera, rig, centre_um = lit_rig()
    with watching(
        rig.camera, rig.stage, rig.attendant.place, (), centre_um, camera, None, Files(None, path)
    ) as watch:
        unique = found().mask
        assert unique is not None
        for place in (unique, replace(unique, ambiguity="it repeats")):
            watch._found = Found(mask=place)
            assert ("zero_um" in watch.preview(["centre"])["diff"]) == (place is unique)


def found():
    place = MaskPlace(-0.5, 0.01, 1.002, 1e-4, (1.0, 2.0), 0.5, 0.9)
    zero_um = {"mask_x": 12699.0, "mask_y": 12698.0}
    return Found(0.0125, place, zero_um, FocusFound("focus", 8000.0, 3.0))


def test_only_what_was_chosen_and_previewed_is_written_and_nothing_when_the_file_changed(tmp_path):
    plan, rig = tmp_path / "plan.yaml", tmp_path / "rig.yaml"
    plan.write_text(PLAN_YAML)
    rig.write_text(RIG_YAML)
    files = Files(plan, rig)
    assert files.takes == ["exposure", "centre", "mask", "focus"]
    with pytest.raises(AppError, match="previewed"):
        files.save()
    diff = files.preview(found(), ["exposure"])
    assert "+  - exposure_s: 0.0125       # metered" in diff
    assert plan.read_text() == PLAN_YAML
    assert files.save() == [str(plan)]
    assert rig.read_text() == RIG_YAML
    shots = yaml.safe_load(plan.read_text())["shots"]
    assert [shot["exposure_s"] for shot in shots] == [0.0125, 0.0125]
    files.preview(found(), ["focus", "centre"])
    rig.write_text(RIG_YAML + "by_hand: false\n")
    with pytest.raises(AppError, match="changed meanwhile"):
        files.save()
    assert rig.read_text() == RIG_YAML + "by_hand: false\n"


def test_a_place_is_written_where_a_file_of_an_earlier_version_has_it(tmp_path):
    rig = tmp_path / "rig.yaml"
    rig.write_text(RIG_YAML + "stands_um: {focus: 9000}\n")
    files = Files(rig=rig)
    files.preview(found(), ["focus"])
    files.save()
    assert rig.read_text() == RIG_YAML + "stands_um: {focus: 8000.0}\n"


def test_a_text_that_cannot_be_edited_in_place_is_left_and_the_line_to_write_is_named():
    block = "camera: x\nshots:\n  - exposure_s:\n      - 0.1\n      - 0.2\n"
    with pytest.raises(AppError, match=r"write shots\.0\.exposure_s: 0\.5"):
        with_values(block, {("shots", 0, "exposure_s"): 0.5}, "plan.yaml")
    shared = "a: &x {n: 1}\nb: *x\n"
    with pytest.raises(AppError, match=r"write b\.n"):
        with_values(shared, {("b", "n"): 2.0}, "f.yaml")


def test_a_replaced_file_keeps_its_line_ends_its_permissions_and_its_link(tmp_path):
    real, link = tmp_path / "real.yaml", tmp_path / "link.yaml"
    real.write_bytes(b"a: 1\r\n")
    real.chmod(0o600)
    link.symlink_to(real)
    replace_text(link, "a: 1\n", "a: 2\n")
    assert link.is_symlink()
    assert real.read_bytes() == b"a: 2\r\n"
    assert real.stat().st_mode & 0o777 == 0o600


def test_without_a_stage_the_mask_is_put_in_by_hand_and_light_shows_that_it_is():
    camera, rig, centre_um = lit_rig()
    rig.stage.home()
    rig.stage.move_to_um(centre_um)
    rig.attendant.set_lamp("off")
    with watching(rig.camera, None, rig.attendant.place, (), centre_um, camera) as watch:
        dark = until(watch, lambda state: state["figures"] and state["hint"])
        assert (dark["steps"][0]["done"], "by hand" in dark["steps"][0]["text"]) == (False, True)
        assert dark["hint"]["action"] == ""
        rig.attendant.set_lamp("white")
        until(watch, lambda state: state["steps"][0]["done"])


def test_a_stage_that_moves_the_mask_alone_centres_it_and_the_aperture_is_named_as_a_hands():
    camera, size = find_camera("rgbw-bayer-1shot"), (48, 64)
    fine = fine_scene("near-planar", 2, 2, size=size, views=camera.views)
    rig, _ = simulated_rig(camera, fine.samples, size, 0, fitted=Fitted(("mask_x", "mask_y")))
    centre_um = {"mask_x": 12_700.0, "mask_y": 12_700.0, "aperture_x": 0.0}
    with watching(rig.camera, rig.stage, None, (), centre_um, camera) as watch:
        watch.centre()
        ended = until(watch, lambda state: state["steps"][0]["done"] and not state["busy"])
        assert ended["trouble"]["stage"] == ""
        assert "the aperture is moved by hand" in ended["steps"][0]["text"]
        assert rig.stage.position_um("mask_x") == pytest.approx(12_700.0, abs=0.5)
