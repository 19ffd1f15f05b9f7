"""A bench with fewer axes than the plan moves: a person moves the rest, frames show where."""

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml
from programs import done

from emmc_rig.bench.hands import AskingAttendant, NoAttendant, hole_name
from emmc_rig.bench.hardware import Fitted, simulated_rig
from emmc_rig.captures import bench_check
from emmc_rig.captures.bench_check import ability
from emmc_rig.captures.by_hand import HandPlaces, with_hands
from emmc_rig.captures.expand import expand
from emmc_rig.captures.plan import Plan, planned_camera
from emmc_rig.captures.schedule import ordered
from emmc_rig.errors import AppError
from emmc_rig.formats.cameras import find_camera
from emmc_rig.formats.scenes import fine_scene
from emmc_rig.session.journal import RetryEntry, of_kind
from emmc_rig.session.session import Session

SIZE = (48, 64)
PLAN = {
    "camera": "rgbw-bayer-1shot",
    "shots": [{"exposure_s": 0.02}],
    "whiteboards": {
        "views": [[0, 0], [1, 1], [2, 2], [4, 3]],
        "open": [{"validation": True, "repeats": 1}],
        "repeats": 1,
        "references": 2,
        "exposure_s": 0.002,
    },
    "darks": {"repeats": 2},
}


@pytest.fixture(scope="module", autouse=True)
def _ways_once():
    """The calibrations open to a camera depend on the camera alone: they are planned but once."""
    with pytest.MonkeyPatch.context() as patch:
        known, plan = {}, bench_check._ways

        def ways(camera):
            key = camera.model_dump_json()
            return known[key] if key in known else known.setdefault(key, plan(camera))

        patch.setattr(bench_check, "_ways", ways)
        yield


def bench_of(axes, hands_um=0.0, plan=PLAN, second=(), seed=0, rays=64):
    """Return rig, its bench, camera and ordered frames."""
    read = Plan.model_validate(plan)
    camera = planned_camera(read)
    fine = fine_scene("deep-occlusions", 1, 1, size=SIZE, views=camera.views, seed=0)
    fitted = Fitted(tuple(axes), tuple(second), hands_um)
    rig, bench = simulated_rig(camera, fine.samples, SIZE, seed, None, rays, fitted=fitted)
    frames = expand(read, camera, rig.window_um, rig.window_side_um)
    rig = with_hands(rig, frames)
    return rig, bench, camera, ordered(frames, read.order, rig.hands)


def exposed(rig, planned, offsets_um=None):
    """Return a frame as planned, but for what a hand does otherwise."""
    rig.attendant.place(planned.bench.target)
    rig.attendant.fit_masks(planned.bench.fitting, planned.bench.masks_in)
    rig.attendant.set_lamp(planned.bench.lamp)
    wanted = dict(planned.bench.offsets_um) | (offsets_um or {})
    rig.attendant.move({axis: um for axis, um in wanted.items() if axis in rig.hands})
    rig.stage.move_to_um(
        {axis: rig.zero_um[axis] + um for axis, um in wanted.items() if axis in rig.stage.axes}
    )
    rig.camera.set_exposure_s(planned.exposure_s)
    return rig.camera.snap()


def test_what_the_stage_lacks_is_asked_of_a_person_or_left_where_it_is():
    rig, _, _, frames = bench_of(["mask_x"])
    assert rig.hands == {"aperture_x", "aperture_y"}
    assert rig.left == {"mask_y"}
    holes = [frame.view for frame in frames if frame.kind != "metering" and frame.bench.masks_in
             and frame.bench.target == "whiteboard"]  # fmt: skip
    assert holes[0] is None
    assert None not in holes[1:]


def test_nobody_there_to_move_an_axis_is_told_what_works_without_it():
    rig, _, camera, _ = bench_of(["mask_x", "mask_y"])
    frames = expand(Plan.model_validate(PLAN), camera, rig.window_um)
    with pytest.raises(AppError, match=r"moves aperture_x and aperture_y.*`views: \[\]`"):
        with_hands(replace(rig, attendant=NoAttendant()), frames)


def test_a_person_is_asked_for_holes_and_for_what_the_micrometer_reads():
    asked = []
    _, _, camera, _ = bench_of([])
    someone = AskingAttendant(camera, asked.append, {"mask_x": 3250.0}, 40_000.0)
    someone.move({"aperture_x": -5000.0, "aperture_y": -5000.0})
    someone.move({"aperture_x": -5000.0, "aperture_y": -5000.0})
    someone.move({"aperture_x": 40_000.0, "aperture_y": 0.0})
    someone.move({"mask_x": 250.0})
    assert asked == [
        "put the pinhole on hole 7 of 25 (row 2, column 2)",
        "open the whole aperture, no pinhole before it",
        "set the mask's micrometer, mask_x to 3.500 mm",
    ]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rgbw-bayer-1shot", "scenario-ii-cfa"])
def test_frames_show_where_hands_put_the_pinhole_within_what_they_state(name):
    plan = PLAN | {"camera": name, "whiteboards": PLAN["whiteboards"] | {"views": "all"}}
    off = []
    for seed in range(4):
        rig, bench, camera, frames = bench_of(
            ["mask_x", "mask_y"], 100.0, plan, seed=seed, rays=1024
        )
        rig.stage.home()
        places = HandPlaces(camera, rig.camera.shape, rig.hands)
        for planned in frames:
            if places.shows(planned):
                found = places.found(planned, exposed(rig, planned))
                if planned.view is not None:
                    assert found is not None
                    true_um = bench.positions_um()
                    off += [(found.um[a] - true_um[a]) / found.deviation_um for a in found.um]
    assert len(off) == 4 * 25 * 2
    assert np.sqrt(np.mean(np.square(off))) < 1.6


def test_wrong_holes_are_named_and_asked_for_again(tmp_path, monkeypatch, run):
    from emmc_rig.bench import hardware

    swaps = {(0, 0): (0, 1), (1, 1): (2, 2), (2, 2): (1, 1)}
    left, asked = dict(swaps), []
    well = hardware.SimulatedAttendant.move

    def wrong_once(self, offsets_um):
        cell_um = 5000.0
        hole = tuple(round(offsets_um[a] / cell_um) + 2 for a in ("aperture_y", "aperture_x"))
        asked.append(hole)
        if hole in left:
            v, u = left.pop(hole)
            offsets_um = {"aperture_x": (u - 2) * cell_um, "aperture_y": (v - 2) * cell_um}
        well(self, offsets_um)

    monkeypatch.setattr(hardware.SimulatedAttendant, "move", wrong_once)
    (tmp_path / "plan.yaml").write_text(yaml.safe_dump(PLAN))
    (tmp_path / "rig.yaml").write_text("kind: simulated\naxes: [mask_x, mask_y]\nhands_um: 100\n")
    plan, rig = tmp_path / "plan.yaml", tmp_path / "rig.yaml"
    done(run("capture", plan, "--rig", rig, "--size", "48x64", "--rays", 64))
    session = Session(tmp_path / "plan-session")
    faults = [entry.fault for entry in of_kind(session.journal.entries, RetryEntry)]
    assert len(faults) == len(swaps)
    for (v, u), wrong in swaps.items():
        named = f"v{v}-u{u}-white-r0 shows the shadow through {hole_name(wrong, (5, 5))}"
        assert sum(named in fault for fault in faults) == 1
        assert asked.count((v, u)) == 2
    for name, entry in session.stored.items():
        if name.startswith("board"):
            assert 0 < entry.deviation_um["aperture_x"] < 400
            assert abs(entry.read_um["aperture_x"] - entry.commanded_um["aperture_x"]) < 500
    assert session.is_complete


def test_a_bench_is_told_what_it_can_do_and_what_one_more_part_would_buy(tmp_path, run):
    (tmp_path / "rig.yaml").write_text("kind: simulated\naxes: [mask_x, mask_y]\n")
    code, out, err = run("devices", "check", tmp_path / "rig.yaml", "--json",
                         "--camera", "rgbw-bayer-3shots")  # fmt: skip
    assert code == 0, err
    found = json.loads(out.splitlines()[-1])["cameras"]["rgbw-bayer-3shots"]
    assert found["shots"] == 3
    assert found["calibration"] == "pinhole before every view"
    assert found["moves_by_hand"] == 26
    assert 0.001 < found["relative_error"] < 0.005


@pytest.mark.parametrize(
    ("axes", "hands", "best", "shots"),
    [
        ("", False, "aperture open, mask still", 1),
        ("mask_x,mask_y", False, "aperture open, mask moved", 3),
        ("mask_x,mask_y,aperture_x,aperture_y", False, "pinhole before every view", 3),
        ("", True, "pinhole before every view", 3),
    ],
)
def test_the_surest_calibration_is_one_that_stage_and_hands_allow(axes, hands, best, shots):
    found = ability("x", find_camera("rgbw-bayer-3shots"), axes.split(",") if axes else [], hands)
    assert found.best.name == best
    assert found.shots == shots
    errors = [way.error for way in found.calibrations if way.error is not None]
    assert errors == sorted(errors)
    assert bool(found.more(axes.split(","))) == ("aperture_x" not in axes)
