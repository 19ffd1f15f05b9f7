"""The light field while the camera watches: coarse at once, then as `reconstruct` gives it."""

import json
import threading
import time
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from test_live_alignment import frame_of

import emmc_rig as emmc
from emmc_rig.calibration.scale import designed_scale
from emmc_rig.errors import AppError
from emmc_rig.formats.scenes import open_scene
from emmc_rig.live.light_field import LiveLightField, disparity_of, live_scale
from emmc_rig.model.errors import ModelError
from emmc_rig.model.frames import even_frames
from emmc_rig.model.lightfield import psnr_db, shifted
from emmc_rig.model.sensing import Psi
from emmc_rig.reconstruction.errors import ReconstructionError
from emmc_rig.reconstruction.preview import Preview, coarser
from emmc_rig.reconstruction.result import Progress, Reconstruction, Status
from emmc_rig.reconstruction.verdict.rules import Verdict
from emmc_rig.reconstruction.verdict.run import reconstruct_judged

SIZE = (48, 64)
PATIENCE_S = 60.0


class Seconds:
    """A clock that is set by hand."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


def blocks_of(coarse, factor):
    """A light field that is constant over blocks, from one value of each."""
    return coarse.repeat(factor, axis=2).repeat(factor, axis=3)


def random_psi(binning, colours, seed=0, size=(8, 12), shots=2):
    rng = np.random.default_rng(seed)
    weights = rng.random((shots, 2, 3, size[0], colours, size[1])).astype(np.float32)
    colour = None
    if colours == 1:
        pixels = rng.integers(0, 3, (shots, size[0] // binning, size[1] // binning))
        colour = pixels.repeat(binning, axis=1).repeat(binning, axis=2).astype(np.uint8)
    return Psi(weights, colour, binning)


@pytest.mark.parametrize(("binning", "colours"), [(1, 1), (1, 3), (2, 1), (2, 3)])
def test_the_coarser_psi_reads_what_psi_reads_of_a_light_field_of_blocks(binning, colours):
    psi = random_psi(binning, colours)
    small = np.random.default_rng(1).random((2, 3, 2, 3, 3)).astype(np.float32)
    read, part = psi @ blocks_of(small, 4), 4 // binning
    coarse = coarser(psi, 4) @ small
    for shot, y, x in np.ndindex(read.shape):
        place = (shot * part + y % part) * part + x % part
        assert coarse[place, y // part, x // part] == pytest.approx(read[shot, y, x], rel=1e-5)


def test_a_block_that_cuts_pixels_is_refused():
    with pytest.raises(ValueError, match="cut pixels"):
        coarser(random_psi(2, 1), 3)


def small_views(light_field, factor):
    v, u, rows, columns, _ = light_field.shape
    cut = light_field.reshape(v, u, rows // factor, factor, columns // factor, factor, 3)
    return np.ascontiguousarray(cut.mean(axis=(3, 5)))


@pytest.mark.parametrize("name", ["deep-occlusions", "wide-disparity"])
def test_a_few_steps_give_views_nearer_than_the_copied_centre_view(name):
    camera = emmc.camera("rgbw-bayer-3shots")
    scene = open_scene(name, size=(96, 128), views=camera.views).light_field
    psi = camera.psi((96, 128))
    frames = camera.expose(scene, 0, psi)
    preview = Preview(psi, 4, even_frames(frames.readings, frames.noise_sigma))
    for _ in range(3):
        preview.follow(frames.readings, 3)
    true = small_views(scene, 4)
    copied = np.ascontiguousarray(np.broadcast_to(true[2, 2], true.shape))
    assert psnr_db(preview.light_field, true) > psnr_db(copied, true) + 0.5


def test_frames_of_a_changed_scene_take_the_preview_along():
    camera = emmc.camera("rgbw-bayer-1shot")
    psi = camera.psi(SIZE)
    first, second = (
        open_scene("deep-occlusions", size=SIZE, views=camera.views, seed=seed).light_field
        for seed in (0, 1)
    )
    preview = Preview(psi, 4, even_frames(psi @ first, 0.002))
    preview.follow(psi @ first, 20)
    before = psnr_db(preview.light_field, small_views(second, 4))
    preview.follow(psi @ second, 20)
    afresh = Preview(psi, 4, even_frames(psi @ second, 0.002))
    afresh.follow(psi @ second, 20)
    after = psnr_db(preview.light_field, small_views(second, 4))
    assert after > before + 3
    assert after == pytest.approx(psnr_db(afresh.light_field, small_views(second, 4)), abs=1)


def test_the_disparity_of_small_views_is_that_of_the_scene_and_unknown_where_it_is_plain():
    rng = np.random.default_rng(0)
    base = rng.random((40, 60, 3)).astype(np.float32)
    base[:, 30:] = 0.5
    views = np.stack(
        [
            np.stack([shifted(base, -0.3 * (v - 1), -0.3 * (u - 1)) for u in range(3)])
            for v in range(3)
        ]
    )
    views = np.stack([np.stack([_softened(view) for view in row]) for row in views])
    found = disparity_of(views)
    assert np.nanmedian(found[8:-8, 8:22]) == pytest.approx(0.3, abs=0.05)
    assert np.isnan(found[:, 40:]).all()


def _softened(view):
    import cv2

    return cv2.GaussianBlur(view, (0, 0), 1.5)


def live_frames(camera, psi, scene, seed=0):
    """Frames as the designed camera sends them, one for each shot."""
    taken = camera.expose(scene, seed, psi)
    exposure_s = camera.exposures_s()
    made = []
    for shot, mosaic in enumerate(taken.frames_dn):
        frame = frame_of(mosaic, camera.sensor.cfa_name, camera.sensor.noise.white_level_dn)
        made.append(frame.__class__(**{**vars(frame), "exposure_s": float(exposure_s[shot])}))
    return made


@pytest.fixture(scope="module")
def one_shot():
    camera = emmc.camera("rgbw-bayer-1shot")
    psi = camera.psi(SIZE)
    scene = open_scene("near-planar", size=SIZE, views=camera.views).light_field
    return camera, psi, scene


def until(holds):
    end_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < end_s:
        found = holds()
        if found:
            return found
        time.sleep(0.02)
    raise AssertionError("never came")


def test_what_stands_still_becomes_exactly_what_reconstruct_gives(one_shot):
    camera, psi, scene = one_shot
    first, second = (live_frames(camera, psi, scene, seed)[0] for seed in (0, 1))
    clock = Seconds()
    live = LiveLightField(designed_scale(psi), "tv", clock=clock)
    assert live.update(first)["stage"] == "preview"
    clock.now = 10.0
    live.update(second)

    def finished():
        reported = live.update(second)
        return reported if reported["verdict"] else None

    reported = until(finished)
    refined = live.refined()
    assert refined is not None
    noise = camera.sensor.noise
    light, exposure_s = 1.0, first.exposure_s
    expected = emmc.reconstruct(
        psi,
        noise.normalise(first.mosaic[None], exposure_s, light),
        "tv",
        noise_sigma=refined[0].parameters["noise_sigma"],
    )
    assert np.abs(refined[0].light_field - expected.light_field).max() < 1e-5
    assert reported["verdict"]["level"] == expected.verdict.level
    assert "as by reconstruct" in reported["stage"]
    shown = live.pictures()
    assert shown is not None
    assert shown.export.light_field is refined[0].light_field
    drawn = json.loads(shown.encoded())
    assert drawn["scale"] == 1
    missed, _ = drawn["overlays"]
    assert missed["label"] == "unexplained residual"


def test_a_preview_states_disparities_in_the_cameras_samples(one_shot):
    camera, psi, scene = one_shot
    live = LiveLightField(designed_scale(psi), "tv", clock=Seconds())
    live.update(live_frames(camera, psi, scene)[0])
    shown = live.pictures()
    assert shown is not None
    given = json.loads(shown.encoded())
    assert given["views"]["width"] == SIZE[1] // 4
    assert given["scale"] == 1 / 4


def test_noise_is_no_change_and_a_changed_scene_ends_the_reconstruction(one_shot):
    camera, psi, scene = one_shot
    other = open_scene("deep-occlusions", size=SIZE, views=camera.views).light_field
    clock, given_up = Seconds(), []

    def endless(method, psi, frames, dictionary, settings, on_step, film):
        try:
            for step in range(10**6):
                on_step(Progress(step, None, None))
                time.sleep(0.001)
        except Exception as fault:
            given_up.append(fault)
            raise
        raise AssertionError

    live = LiveLightField(designed_scale(psi), "tv", endless, clock)
    frames = [live_frames(camera, psi, scene, seed)[0] for seed in range(4)]
    for number, frame in enumerate(frames):
        clock.now = float(number)
        reported = live.update(frame)
    assert "at work" in reported["stage"]
    assert live.update(live_frames(camera, psi, other, 9)[0])["stage"] == "preview"
    until(lambda: given_up)
    live.close()


def test_shots_are_held_until_the_scene_changes():
    camera = emmc.camera("rgbw-bayer-3shots")
    psi = camera.psi(SIZE)
    scenes = [
        open_scene("near-planar", size=SIZE, views=camera.views, seed=seed).light_field
        for seed in (0, 1)
    ]
    live = LiveLightField(designed_scale(psi), "tv", clock=Seconds())
    first, second = (live_frames(camera, psi, scene) for scene in scenes)
    assert live.update(first[0], 0)["shots"] == [1, 3]
    assert live.update(first[2], 2)["shots"] == [2, 3]
    assert "no shot" in live.update(first[1], None)["why"]
    assert live.update(first[1], 1)["shots"] == [3, 3]
    assert live.update(second[1], 1)["shots"] == [1, 3]


def test_frames_that_do_not_fit_and_dark_ones_are_refused_in_words(one_shot):
    _, psi, _ = one_shot
    live = LiveLightField(designed_scale(psi), "tv")
    with pytest.raises(AppError, match="48x64"):
        live.update(frame_of(np.full((16, 16), 900), "mono"))
    dark = live.update(frame_of(np.full(SIZE, 256)))
    assert "dark" in dark["why"]
    assert dark["pictures"] is None


def test_a_frame_without_an_exposure_is_one_line_however_often_it_comes(one_shot):
    camera, psi, scene = one_shot
    live = LiveLightField(designed_scale(psi), "tv")
    good = live_frames(camera, psi, scene)[0]
    unknown = replace(good, exposure_s=None)
    for frame in (unknown, unknown, good, unknown):
        why = live.update(frame)["why"]
        assert ("does not state how long" in why) == (frame is unknown)
    live.close()


def test_a_psi_is_opened_with_what_lies_beside_it(tmp_path, one_shot):
    _, psi, _ = one_shot
    psi.save(tmp_path / "psi.h5")
    assert live_scale(tmp_path).psi.checksum() == psi.checksum()
    assert live_scale(tmp_path / "psi.h5").white_dn_per_s.shape == psi.frames_shape
    with pytest.raises(AppError, match="no Psi"):
        live_scale(tmp_path / "elsewhere")
    nameless = Psi(psi.weights, psi.colour)
    nameless.save(tmp_path / "nameless.h5")
    with pytest.raises(ModelError, match="does not know its camera"):
        live_scale(tmp_path / "nameless.h5")


def test_a_solver_that_fails_is_reported(one_shot):
    camera, psi, scene = one_shot

    def failing(*_):
        raise ReconstructionError("no luck")

    clock = Seconds()
    live = LiveLightField(designed_scale(psi), "tv", failing, clock)
    frame = live_frames(camera, psi, scene)[0]
    live.update(frame)
    clock.now = 5.0
    until(lambda: live.update(frame)["why"] == "no luck")


class Solver:
    """A solver that notes its arguments and ends a frame when the test calls `end`.

    Each frame becomes the same light field; the film that it returns is the frame's number, from 1.
    """

    def __init__(self, light_field, clock):
        self.light_field, self._clock = light_field, clock
        self.fault = ""
        self.asked, self.before, self.left = [], [], 0
        self._ends = threading.Semaphore(0)

    def __call__(self, method, psi, frames, dictionary, settings, on_step, film):
        self.before.append(film.known)
        self.asked.append(frames.readings)
        try:
            while not self._ends.acquire(timeout=0.005):
                on_step(Progress(1, None, None))
        finally:
            self.left += 1
        if self.fault:
            raise ReconstructionError(self.fault)
        film = replace(film, known=cast(Any, len(self.asked)))
        status = Status.CONVERGED
        result = Reconstruction(method, self.light_field, status, "", 9, (), 1.2, {}, film=film)
        return result, Verdict("trust", (), cast(Any, None))

    def end(self, took_s=1.25):
        """End the frame at work, once it is alone (one given up may still end), so much later."""
        until(lambda: len(self.asked) == self.left + 1)
        self._clock.now += took_s
        self._ends.release()
        until(lambda: not threads_at_work())


def threads_at_work():
    return [thread for thread in threading.enumerate() if thread.name == "live reconstruction"]


@pytest.fixture(scope="module")
def scenes(one_shot):
    """A frame of each of five scenes."""
    camera, psi, _ = one_shot
    seen = (
        open_scene("deep-occlusions", size=SIZE, views=camera.views, seed=seed).light_field
        for seed in range(5)
    )
    return [live_frames(camera, psi, scene)[0] for scene in seen]


@pytest.fixture
def filmed(one_shot, scenes):
    """A live light field by a method that takes films; its solver and clock; frames that differ."""
    psi, clock = one_shot[1], Seconds()
    solver = Solver(np.full(psi.light_field_shape, 0.5, np.float32), clock)
    live = LiveLightField(designed_scale(psi), "adaptive", solver, clock)
    yield live, solver, clock, scenes
    live.close()


def readings_of(camera, frame):
    return camera.sensor.noise.normalise(frame.mosaic[None], frame.exposure_s, 1.0)


def test_while_the_scene_moves_the_newest_frame_goes_on_from_the_last_one_done(filmed, one_shot):
    live, solver, _, frames = filmed
    for frame in frames[:3]:
        assert live.update(frame)["verdict"] is None
    for frame in frames[3:]:
        solver.end()
        assert live.update(frame)["verdict"]["level"] == "trust"
        assert live.pictures().export.light_field is solver.light_field
    until(lambda: len(solver.asked) == 3)
    assert solver.before == [None, 1, 2]
    for readings, frame in zip(solver.asked, (frames[0], *frames[3:]), strict=True):
        assert readings == pytest.approx(readings_of(one_shot[0], frame), abs=1e-5)


def test_the_page_says_how_often_there_is_a_light_field_and_how_often_a_frame(filmed):
    live, solver, clock, frames = filmed
    live.update(frames[0], 0, 7)
    for frame, took_s in zip(frames[1:], (8, 1.3, 1.3), strict=False):
        solver.end(took_s)
        reported = live.update(frame, 0, 7 + round(10 * clock.now))
    said = "; a light field every 1.3 s (0.77 frames/s); the camera sends 10"
    assert reported["stage"].endswith(said)
    clock.now += 2
    assert "every" not in live.update(frames[3], 0, 130)["stage"]


def test_of_a_scene_that_stands_still_one_frame_is_reconstructed_until_it_changes(filmed):
    live, solver, clock, frames = filmed
    live.update(frames[0])
    solver.end()
    for second in range(5):
        clock.now += 1
        reported = live.update(replace(frames[0], mosaic=frames[0].mosaic + second % 2))
        assert reported["stage"] == "adaptive: converged in 1.2 s, as by reconstruct"
    assert len(solver.asked) == 1
    drawn = live.pictures().number
    live.update(frames[1])
    solver.end()
    assert live.update(frames[1])["pictures"]["number"] == drawn + 1
    assert solver.before == [None, 1]
    assert not threads_at_work()


def test_the_preview_is_shown_before_the_first_light_field_and_after_a_cut_only(filmed, one_shot):
    live, solver, _, frames = filmed
    camera, psi, scene = one_shot
    (still,), (moved,) = (
        live_frames(camera, psi, np.roll(scene, by_px, axis=3)) for by_px in (0, 2)
    )
    live.update(still)
    assert live.pictures().block == 4
    solver.end()
    for _ in range(2):
        assert live.update(moved)["verdict"] is not None
        assert live.pictures().block == 1
    until(lambda: len(solver.asked) == 2)
    assert live.update(frames[0])["stage"].startswith("preview; adaptive at work")
    assert live.pictures().block == 4
    # The frame at work was of before the cut: it is given up, and the new scene begins at once.
    until(lambda: len(solver.asked) == 3)
    solver.end()
    assert live.update(frames[0])["verdict"] is not None
    assert live.pictures().block == 1
    assert solver.before == [None, 1, 1]


def test_frames_far_apart_are_of_one_scene_that_moves_however_they_differ(filmed, one_shot):
    live, solver, clock, frames = filmed
    camera, psi, scene = one_shot
    live.update(*live_frames(camera, psi, scene))
    solver.end()
    live.update(frames[0])
    until(lambda: live._run.step)
    clock.now += 6
    assert "; the next one at work for 6 s, step 1" in live.update(frames[1])["stage"]
    assert live.pictures().block == 1
    assert len(solver.asked) == 2


def test_a_frame_that_cannot_be_reconstructed_is_reported_and_the_next_goes_on(filmed):
    live, solver, _, frames = filmed
    live.update(frames[0])
    solver.end()
    live.update(frames[1])
    until(lambda: len(solver.asked) == 2)
    solver.fault = "no luck"
    solver.end()
    reported = live.update(frames[2])
    assert (reported["why"], reported["verdict"]) == ("no luck", None)
    assert live.pictures().block == 4
    until(lambda: len(solver.asked) == 3)
    solver.fault = ""
    solver.end()
    reported = live.update(frames[2])
    assert (reported["why"], reported["verdict"]["level"]) == ("", "trust")
    assert solver.before == [None, 1, 1]


def test_a_dark_frame_drops_what_is_at_work_and_is_not_reconstructed(filmed):
    live, solver, clock, frames = filmed
    live.update(frames[0])
    until(lambda: len(solver.asked) == 1)
    clock.now += 5
    noise = np.random.default_rng(0).normal(257, 1, SIZE).round().astype(np.uint16)
    for _ in range(2):
        reported = live.update(replace(frames[0], mosaic=noise))
        assert (reported["why"][:19], reported["verdict"]) == ("the picture is dark", None)
    until(lambda: not threads_at_work())
    live.update(frames[1])
    until(lambda: len(solver.asked) == 2)


def test_closing_ends_a_film_within_a_step(filmed):
    live, solver, _, frames = filmed
    live.update(frames[0])
    until(lambda: len(solver.asked) == 1)
    live.close()
    until(lambda: not threads_at_work())
    assert solver.left == 1
    assert live.refined() is None


def test_a_live_film_is_what_reconstruct_film_gives_of_its_frames_a_cut_included(one_shot, scenes):
    camera, psi, scene = one_shot
    given = []

    def noted(*taken):
        given.append(taken)
        return reconstruct_judged(*taken)

    live = LiveLightField(designed_scale(psi), "adaptive-fast", noted)
    moved = np.roll(scene, 1, axis=3)
    shown = []
    for frame in (*live_frames(camera, psi, scene), *live_frames(camera, psi, moved), scenes[0]):
        live.update(frame)
        until(lambda frame=frame: live.update(frame) and live._run is None)
        shown.append(live.refined())
    film = (frames for _, _, frames, *_ in given)
    expected = list(emmc.reconstruct_film(psi, film, "adaptive-fast"))
    for (found, verdict), result in zip(shown, expected, strict=True):
        np.testing.assert_allclose(found.light_field, result.light_field, atol=1e-4)
        assert verdict.level == result.verdict.level
    assert ["new_share" in found.parameters for found, _ in shown] == [False, True, False]
