"""Plans: their frames in order, estimates, and a clear line for a bad plan."""

import json
import operator
from itertools import accumulate, pairwise

import numpy as np
import pytest
import yaml

from emmc_rig.captures.expand import expand, exposures_s, fittings
from emmc_rig.captures.plan import (
    Boards,
    Darks,
    OpenBoard,
    Plan,
    differences,
    load_plan,
    new_plan,
    planned_camera,
)
from emmc_rig.captures.schedule import Pace, ordered, spread
from emmc_rig.errors import AppError
from emmc_rig.formats.cameras import find_camera
from emmc_rig.model.camera import shipped_cameras
from emmc_rig.model.settings import validated
from emmc_rig.session.planned import Bench, PlannedFrame
from emmc_rig.store.results import shown_bytes, shown_seconds

WINDOW_UM = 40_000.0


def plan_of(**changes):
    base = {"camera": "rgbw-bayer-3shots", "shots": [{}, {}, {}]}
    return Plan.model_validate({**base, **changes})


def frames_of(plan):
    return expand(plan, planned_camera(plan), WINDOW_UM)


def plan_file(tmp_path, **changes):
    base = {"camera": "rgbw-bayer-3shots", "shots": [{}]}
    path = tmp_path / "plan.yaml"
    path.write_text(yaml.safe_dump({**base, **changes}))
    return path


def test_a_plan_of_three_shots_has_a_frame_for_every_view_lamp_and_repeat():
    kinds = [frame.kind for frame in frames_of(plan_of())]
    assert kinds.count("dark") == 4
    assert kinds.count("metering") == 3
    assert kinds.count("reference") == 3 * 4
    assert kinds.count("whiteboard") == 3 * 25 * 2
    assert kinds.count("shot") == 3


def test_a_monochrome_sensor_behind_a_colour_mask_needs_three_lamps():
    plan = plan_of(camera="moving-colour-mask")
    lamps = {frame.bench.lamp for frame in frames_of(plan) if frame.kind == "whiteboard"}
    assert lamps == {"red", "green", "blue"}


def test_mask_places_in_cells_are_those_in_micrometres():
    in_cells = planned_camera(plan_of(shots=[{"mask_cells": [2, -1]}]))
    in_um = planned_camera(plan_of(shots=[{"mask_um": [72, -36]}]))
    assert in_cells == in_um
    assert in_um.shots[0].offset_um["mask"] == (72, -36)


def test_a_plan_may_take_the_camera_s_shots_in_any_order():
    camera = planned_camera(plan_of(shots=[{"camera_shot": 2}, {"camera_shot": 0}]))
    own = find_camera("rgbw-bayer-3shots")
    assert camera.shots == (own.shots[2], own.shots[0])


def test_shots_with_equal_masks_and_filter_need_no_hand_between_them():
    assert fittings(planned_camera(plan_of())) == [0, 0, 0]
    sequence = Plan.model_validate({"camera": "programmable-aperture", "shots": [{}] * 25})
    assert fittings(planned_camera(sequence)) == list(range(25))


def travel_um(frames):
    """How far the stage goes in all, the longest axis of each move counted."""
    places = [frame.bench.offsets_um for frame in frames]
    moves = zip(accumulate(places, operator.or_), places[1:], strict=False)
    return sum(
        max((abs(um - at.get(axis, um)) for axis, um in goal.items()), default=0.0)
        for at, goal in moves
    )


def test_least_travel_goes_less_far_and_takes_the_same_frames():
    frames = frames_of(plan_of())
    short = ordered(frames, "least-travel")
    assert sorted(f.id for f in short) == sorted(f.id for f in frames)
    assert travel_um(short) < 0.5 * travel_um(frames)
    assert ordered(frames, "as-planned") == frames


def test_a_metered_exposure_comes_after_its_metering():
    for order in ("least-travel", "as-planned"):
        names = [frame.id for frame in ordered(frames_of(plan_of()), order)]
        for frame in frames_of(plan_of()):
            if frame.metered_by:
                assert names.index(frame.metered_by) < names.index(frame.id)


@pytest.mark.parametrize("shape", [(60, 1), (5, 5)])
def test_places_of_a_line_or_a_grid_are_hardly_more_than_a_step_from_the_one_before(shape):
    """Axes move at once: a step along a grid's diagonal is no longer than one along an axis."""
    places_um = 100.0 * np.random.default_rng(0).permutation(list(np.ndindex(shape)))
    frames = []
    for place_um in places_um:
        bench = Bench("scene", "white", 0, 0, True, dict(zip("xy", place_um, strict=True)))
        frames.append(PlannedFrame(f"f{len(frames)}", "shot", bench, 0.1))
    assert travel_um(ordered(frames, "least-travel")) <= 1.05 * 100 * (len(frames) - 1)


def test_the_bench_is_changed_by_hand_as_rarely_as_can_be():
    def changes(frames):
        stood = [f.bench.set_by_hand() for f in frames if f.bench.lamp != "off"]
        return sum(a != b for a, b in pairwise(stood))

    assert changes(ordered(frames_of(plan_of()), "least-travel")) == 2


def test_checks_are_spread_evenly_and_repeats_of_a_whiteboard_stay_together():
    bench = Bench("whiteboard", "white", 0, 0, True)
    frames = [PlannedFrame(f"b{i}", "open", bench, 0.1, repeat=i % 3) for i in range(6)]
    checks = [PlannedFrame(f"c{i}", "check", bench, 0.1) for i in range(4)]
    names = [frame.id for frame in spread(frames, checks)]
    assert names == ["c0", "b0", "b1", "b2", "c1", "b3", "b4", "b5", "c2", "c3"]


def test_frames_survive_the_way_through_json():
    for frame in frames_of(plan_of(shots=[{"exposure_s": [0.01, 0.1]}])):
        assert PlannedFrame.from_dict(json.loads(json.dumps(frame.as_dict()))) == frame


def test_an_estimate_counts_exposures_moves_and_bytes():
    bench = [Bench("scene", "white", 0, 0, True, {"mask_x": um}) for um in (0.0, 4000.0, 2000.0)]
    bench.append(bench[-1])
    frames = [PlannedFrame(f"f{i}", "shot", stood, 2.0) for i, stood in enumerate(bench)]
    pace = Pace({"mask_x": 1000.0}, settle_s=1.0, frame_bytes=1_000_000)
    reported = pace.estimate(frames, lambda frame: frame.exposure_s)
    assert reported.exposing_s == 8.0
    assert reported.guessed == 0
    # Three moves, the first from an unknown place, settle for 1 s and begin and end in 0.2 s each.
    # They go 0 mm, 4 mm up and 2 mm down at 1 mm/s: not upwards, 10 um further down and up again.
    # The fourth frame needs no move.
    assert reported.moving_s == pytest.approx(3 * 1.2 + 0.02 + 4 + 2.02)
    # Each a megabyte of pixels, 4 KiB of the file's own and 1500 bytes of the journal's.
    assert reported.bytes == 4 * (1_000_000 + 4096 + 1500)
    assert reported.by_hand == 0


@pytest.mark.parametrize(
    ("seconds", "shown"),
    [(12.4, "12 s"), (207.4, "3 min 27 s"), (600, "10 min"), (7200 * 2, "4.0 h")],
)
def test_durations_are_shown_for_people(seconds, shown):
    assert shown_seconds(seconds) == shown


def test_sizes_are_shown_for_people():
    assert [shown_bytes(n) for n in (12, 4.2e6, 4.8e10)] == ["12 B", "4.2 MB", "48 GB"]


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"setle_s": 1}, "did you mean 'settle_s'"),
        ({"whiteboards": {"lamp": ["white"]}}, "did you mean 'lamps'"),
        ({"shots": []}, "at least 1 item"),
        ({"shots": [{"exposure_s": 0}]}, "greater than 0"),
        ({"shots": [{"exposure_s": float("nan")}]}, "finite"),
        ({"shots": [{"lamp": "purple"}]}, "'white'"),
        ({"order": "fastest"}, "least-travel"),
        ({"darks": {"repeats": 1}}, "greater than or equal to 2"),
    ],
)
def test_a_bad_plan_gives_one_line_that_names_what_is_wrong(tmp_path, changes, line):
    with pytest.raises(AppError) as reported:
        frames_of(load_plan(plan_file(tmp_path, **changes)))
    assert line in str(reported.value)
    assert "\n" not in str(reported.value)


def test_a_camera_file_is_looked_for_beside_the_plan(tmp_path):
    text = yaml.safe_dump({"title": "mine", "sensor": {"cfa": "rggb"}})
    (tmp_path / "mine.yaml").write_text(text)
    plan = load_plan(plan_file(tmp_path, camera="mine.yaml"))
    assert planned_camera(plan, tmp_path).title == "mine"


@pytest.mark.parametrize("order", ["as-planned", "least-travel"])
def test_darks_of_the_shots_come_after_the_scene_is_metered_and_before_the_first_shot(order):
    plan = plan_of(
        shots=[{"exposure_s": "auto"}, {"exposure_s": [0.5, 3.0]}, {"exposure_s": "auto"}],
        darks={"of_shots": 2},
    )
    frames = ordered(frames_of(plan), order)
    places = {frame.id: place for place, frame in enumerate(frames)}
    darks = [frame for frame in frames if frame.is_dark_of_shots]
    assert (
        sorted((frame.exposure_s, frame.metered_by) for frame in darks if frame.exposure_s)
        == [(3.0, None)] * 2
    )
    (meter,) = {frame.metered_by for frame in darks if frame.exposure_s is None}
    first_shot = min(place for name, place in places.items() if name.startswith("shot-"))
    for frame in darks:
        assert places[frame.id] < first_shot
        assert frame.exposure_s is not None or places[str(meter)] < places[frame.id]


def test_shots_no_longer_than_a_planned_dark_need_no_darks_of_their_own():
    darks = {"exposure_s": [0.01, 1.0], "of_shots": 2}
    for exposure_s, count in ((0.5, 0), (2.0, 2)):
        frames = frames_of(plan_of(shots=[{"exposure_s": exposure_s}], darks=darks))
        assert sum(frame.is_dark_of_shots for frame in frames) == count


@pytest.mark.parametrize("name", list(shipped_cameras()))
def test_a_new_plan_for_every_camera_says_what_the_camera_says(tmp_path, name):
    camera = find_camera(name)
    path = tmp_path / "plan.yaml"
    path.write_text(new_plan(name, camera), encoding="utf-8")
    plan = load_plan(path)
    assert planned_camera(plan).shots == camera.shots
    boards = Boards(open=(OpenBoard(validation=True),))
    # Older plans, which do not name them, are expanded as before.
    darks = Darks(of_shots=4)
    assert Plan(camera=name, shots=plan.shots, title=name, whiteboards=boards, darks=darks) == plan
    assert exposures_s(plan, camera) == [None] * len(camera.shots)  # metered


def test_what_differs_between_two_plans_is_named():
    plan, other = plan_of(), plan_of(settle_s=0.5)
    assert differences(plan, plan) == []
    assert differences(other, plan) == ["settle_s is 0.5, not 0.0"]
    assert differences(plan, plan_of(shots=[{}]))[0] == "shots has 3 entries, not 1"
    assert differences(plan_of(shots=[{}]), plan) == ["shots has 1 entries, not 3"]
    # A value that is a mapping or list in the first plan, and a single value in the second.
    assert differences(plan_of(darks=None), plan)[0].startswith("darks is null, not {")
    assert differences(plan, plan_of(darks=None))[0].endswith(", not null")
    every, few = (plan_of(whiteboards={"views": views}) for views in ("all", [[2, 2]]))
    assert differences(every, few) == ['whiteboards.views is "all", not [[2, 2]]']


def test_a_key_of_earlier_versions_is_read_under_its_new_name_and_not_beside_it():
    assert validated(OpenBoard, {"held_out": True}, "plan", AppError) == OpenBoard(validation=True)
    with pytest.raises(AppError, match="held_out is an earlier name of validation"):
        validated(OpenBoard, {"held_out": True, "validation": True}, "plan", AppError)
