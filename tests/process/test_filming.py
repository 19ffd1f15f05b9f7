"""Films of a session to light fields: frame after frame, and the same bytes whatever is killed."""

import gc
import json
import shutil
import tracemalloc
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from pools import Here, Posting
from programs import one_line, program
from watching import Recorder

import emmc_rig as emmc
from emmc_rig.errors import AppError, StoppedError
from emmc_rig.formats.exports import open_film
from emmc_rig.model.arguments import ArgumentError
from emmc_rig.model.frames import Frames
from emmc_rig.model.lightfield import load_hdf5
from emmc_rig.process import filming
from emmc_rig.process.filming import reconstruct_film_session
from emmc_rig.process.reconstructing import sensor_deviation
from emmc_rig.process.session_capture import SessionCapture
from emmc_rig.reconstruction.adaptive.film import Film, FilmSettings
from emmc_rig.reconstruction.methods import MethodSettings
from emmc_rig.session.readings import film_places
from emmc_rig.session.session import Session

FRAMES, RATE, METHOD = 6, 10, "adaptive-fast"
PLAN = f"""
camera: rgbw-bayer-1shot
shots: [{{exposure_s: 0.1}}]
film: {{frames: {FRAMES}, rate: {RATE}}}
whiteboards: null
darks: {{repeats: 2}}
"""
TIMES = {
    "commit",  # a checkout that other tests write to is "-dirty"
    "compiling_seconds",
    "threads",
    "seconds",
    "search_seconds",
    "seconds_per_frame",
    "peak_gib",
    "program_peak_gib",
    "command",
}
"""What differs from run to run."""


class KilledError(Exception):
    """The program ended there."""


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """A session with a film of toys that move, captured on the simulated rig."""
    folder = tmp_path_factory.mktemp("film")
    (folder / "plan.yaml").write_text(PLAN)
    (folder / "rig.yaml").write_text("kind: simulated\nusb_camera: u3v\n")
    code, _, err = program(
        "capture", folder / "plan.yaml", "--rig", folder / "rig.yaml", "--scene", "moving-toys",
        "--size", "40x48", "--out", folder / "session",
    )  # fmt: skip
    assert code == 0, err
    return folder / "session"


def reconstructed(session, *given, **named):
    """Reconstruct the film of a session; the capture is opened anew."""
    return reconstruct_film_session(SessionCapture(Session(session)), *given, **named)


@pytest.fixture(scope="module")
def whole(session):
    """The film's result of one run that nothing interrupted."""
    out = session.parent / "whole"
    reconstructed(session, out, METHOD)
    return out


def content(out):
    """Return the bytes of every file by name; of metrics all but what differs from run to run."""
    found = {}
    for path in sorted(out.rglob("*")):
        if path.name == "metrics.json":
            found[path.relative_to(out)] = without_times(json.loads(path.read_text()))
        elif path.is_file() and path != out / "files.json":
            found[path.relative_to(out)] = path.read_bytes()
    return found


def without_times(part):
    if isinstance(part, dict):
        return {name: without_times(value) for name, value in part.items() if name not in TIMES}
    return [without_times(value) for value in part] if isinstance(part, list) else part


def film_metrics(out):
    return json.loads((out / "metrics.json").read_text())["film"]


def changed_frames(monkeypatch, change):
    """Let `change` replace the frames of a film; None leaves a frame out."""
    real = filming.film_frames

    def frames(*given):
        changed = ((at, change(at.place, frames)) for at, frames in real(*given))
        return ((at, frames) for at, frames in changed if frames is not None)

    monkeypatch.setattr(filming, "film_frames", frames)


def kill():
    raise KilledError


def test_every_frame_has_its_result_at_its_time(session, whole):
    film = open_film(whole)
    assert list(film.frames) == list(range(FRAMES))
    assert film.rate == RATE
    np.testing.assert_allclose(film.times_s, np.arange(FRAMES) / RATE, atol=1e-6)
    about, verdicts = film_metrics(whole), []
    for place, frame in film.each():
        metrics = json.loads((film.frames[place] / "metrics.json").read_text())
        verdicts.append(metrics["verdict"]["level"])
        assert metrics["frame"] == place
        assert frame.light_field.shape == (5, 5, 40, 48, 3)
        assert ("still_share" in metrics["parameters"]) == (place not in {0, *about["begun_anew"]})
    assert about["verdicts"] == about["verdicts"] | {
        level: verdicts.count(level) for level in verdicts
    }
    assert about["trusted_share"] == verdicts.count("trust") / FRAMES
    assert sum(about["verdicts"].values()) == FRAMES
    assert about["missing"] == []
    first, last = (film.opened(place).light_field for place in (0, FRAMES - 1))
    assert np.abs(first - last).max() > 0.2 * first.max()


def test_a_film_is_exported_as_one_page(whole, run):
    code, _, err = run("export", whole, "--out", "page")
    assert code == 0, err


@pytest.mark.parametrize("done", [4, FRAMES])
def test_after_a_kill_the_same_command_goes_on_to_the_same_bytes(session, whole, tmp_path, done):
    out, watcher = tmp_path / "out", Recorder()
    with pytest.raises(KilledError):
        reconstructed(session, out, METHOD, watcher=Recorder(done, kill))
    assert not (out / "metrics.json").exists()
    kept = out / ".emmc-rig.partial/kept/frames"
    before = {path: path.stat().st_mtime_ns for path in kept.rglob("light_field.h5")}
    assert len(before) == done
    reconstructed(session, out, METHOD, watcher=watcher)
    assert watcher.notes == [f"goes on with an earlier run; frames done: {done}"]
    after = {path.stat().st_mtime_ns for path in out.rglob("light_field.h5")}
    assert set(before.values()) < after or done == FRAMES
    assert content(out) == content(whole)


@pytest.mark.parametrize("where", ["in a frame", "after it"])
def test_a_frame_after_which_nothing_was_noted_is_made_again(
    session, whole, tmp_path, monkeypatch, where
):
    out, write, saved = tmp_path / "out", filming.Result.write, filming.Latest.saved

    def cut(result, folder, metrics):
        if metrics["frame"] == 2 and where == "in a frame":
            (folder / "light_field.h5").write_bytes(b"half")
            raise KilledError
        write(result, folder, metrics)

    def late(latest, *given):
        if latest.place == 2:
            raise KilledError
        return saved(latest, *given)

    monkeypatch.setattr(filming.Result, "write", cut)
    monkeypatch.setattr(filming.Latest, "saved", late)
    with pytest.raises(KilledError):
        reconstructed(session, out, METHOD)
    monkeypatch.undo()
    reconstructed(session, out, METHOD)
    assert content(out) == content(whole)


@pytest.mark.parametrize(
    ("damaged", "note"),
    [
        (None, "starts anew"),  # of other settings
        ("next-000.npz", "goes on with an earlier run; frames done"),
        ("calibration.h5", "starts anew"),
        ("psi.h5", "starts anew"),
    ],
)
def test_what_an_earlier_run_left_damaged_or_of_another_film_is_not_gone_on_from(
    session, whole, tmp_path, damaged, note
):
    out, watcher = tmp_path / "out", Recorder()
    other = MethodSettings(screening=damaged is not None)
    with pytest.raises(KilledError):
        reconstructed(session, out, METHOD, settings=other, watcher=Recorder(1, kill))
    if damaged is not None:
        path = out / ".emmc-rig.partial/kept" / damaged
        path.write_bytes(path.read_bytes()[:-1000])
    reconstructed(session, out, METHOD, watcher=watcher)
    assert [note.split(":")[0] for note in watcher.notes] == [note]
    assert content(out) == content(whole)


def test_ctrl_c_says_that_frames_are_kept(session, tmp_path):
    def stop():
        raise KeyboardInterrupt

    with pytest.raises(StoppedError, match="1 of 6 frames are kept in"):
        reconstructed(session, tmp_path / "out", METHOD, watcher=Recorder(1, stop))


def test_a_missing_frame_keeps_its_place_and_the_next_goes_on_from_the_one_before(
    session, tmp_path, monkeypatch
):
    changed_frames(monkeypatch, lambda place, frames: None if place == 2 else frames)
    reconstructed(session, tmp_path / "out", METHOD)
    film = open_film(tmp_path / "out")
    assert film.missing == film_metrics(tmp_path / "out")["missing"] == [2]
    np.testing.assert_allclose(film.times_s, np.arange(FRAMES) / RATE, atol=1e-6)


def test_frames_that_rest_follow_and_one_of_another_scene_begins_anew(
    session, tmp_path, monkeypatch
):
    first = []

    def rests_then_mirrored(place, frames):
        first.append(frames)
        shown = first[0].readings
        return replace(frames, readings=shown if place < 3 else shown[:, ::-1, ::-1])

    changed_frames(monkeypatch, rests_then_mirrored)
    reconstructed(session, tmp_path / "out", METHOD)
    about = film_metrics(tmp_path / "out")
    assert about["begun_anew"] == [3]
    assert about["still_share"] == pytest.approx(4 / FRAMES, abs=0.02)


def test_a_frame_without_usable_pixels_is_named_and_the_others_are_made(
    session, tmp_path, monkeypatch
):
    def dark(place, frames):
        return replace(frames, usable=frames.usable & (place != 3))

    changed_frames(monkeypatch, dark)
    reconstructed(session, tmp_path / "out", METHOD)
    about = film_metrics(tmp_path / "out")
    assert about["missing"] == [3]
    assert "no usable pixel" in about["failed"]["3"]


def test_a_film_without_a_usable_frame_is_one_line(session, tmp_path, monkeypatch):
    changed_frames(monkeypatch, lambda place, frames: replace(frames, usable=frames.usable & False))
    with pytest.raises(AppError, match="no usable pixel"):
        reconstructed(session, tmp_path / "out", METHOD)


def test_a_segments_first_frame_is_that_of_a_capture_of_its_own(
    session, tmp_path, monkeypatch, run
):
    def broken(session):
        return [replace(at, segment=int(at.place >= 3)) for at in film_places(session)]

    monkeypatch.setattr(filming, "film_places", broken)
    reconstructed(session, tmp_path / "out", METHOD)
    assert 3 not in film_metrics(tmp_path / "out")["begun_anew"]
    code, _, err = run("reconstruct", session, "--frame", 3, "--method", METHOD, "--out", "alone")
    assert code == 0, err
    of_film = load_hdf5(tmp_path / "out/frames/000003/light_field.h5")
    np.testing.assert_array_equal(of_film, load_hdf5(tmp_path / "alone/light_field.h5"))


def test_the_command_says_how_a_film_went_and_where_it_is_worst(session, run):
    copy = session.parent / "copy"
    shutil.copytree(session, copy)
    code, out, err = run("reconstruct", copy, "--method", METHOD)
    assert code == 0, err
    about = film_metrics(copy / "reconstruction")
    assert f"{FRAMES} of {FRAMES} frames in" in out
    assert f"trusted: {about['verdicts']['trust']}; worst: frame {about['worst']['frame']}" in out
    anew = ", ".join(map(str, about["begun_anew"])) or "none"
    kept = f"{about['still_share']:.0%} of the pixels; frames that begin anew: {anew}"
    assert kept in " ".join(out.split())
    assert not list((copy / "reconstruction").rglob("*.png"))


@pytest.mark.parametrize(
    ("options", "what"),
    [
        (["--method", "tv"], "'tv' takes no films: choose adaptive or adaptive-fast, or a single"),
        (["--truth", "moving-toys"], "--truth: no effect on a whole film"),
        (["--zarr"], "--zarr: no effect on a whole film"),
        (["--frame", "99"], "no frame 99"),
        (["--memory", "100MiB"], "memory of 100 MiB"),
        (["--psi", "absent.h5"], "absent.h5"),
    ],
)
def test_what_a_film_does_not_take_is_refused_in_a_line(session, run, options, what):
    code, _, err = run("reconstruct", session, "--out", "out", *options)
    assert code in (1, 2)
    assert what in (one_line(err) if code == 1 else " ".join(err.split()))


TWO = MethodSettings.model_validate({"film": {"segment": 4}})


@pytest.fixture(scope="module")
def in_two(session):
    """The film's result in segments of four frames and two, computed one after the other."""
    out = session.parent / "in-two"
    reconstructed(session, out, METHOD, settings=TWO)
    return out


def shared(session, out, pool, monkeypatch, **more):
    """Reconstruct the film in two segments by the workers of a pool."""
    monkeypatch.setattr(filming, "opened_pool", lambda *_: nullcontext(pool))
    reconstructed(session, out, METHOD, settings=TWO, workers=2, **more)


def test_a_segment_begins_as_a_first_frame_does(session, whole, in_two, tmp_path, run):
    anew = [film_metrics(out)["begun_anew"] for out in (in_two, whole)]
    assert [place for place in anew[0] if place < 4] == [place for place in anew[1] if place < 4]
    code, _, err = run("reconstruct", session, "--frame", 4, "--method", METHOD, "--out", tmp_path)
    assert code == 0, err
    names = [f"frames/{place:06d}/light_field.h5" for place in (3, 4, 5)]
    alone = load_hdf5(tmp_path / "light_field.h5")
    np.testing.assert_array_equal(load_hdf5(in_two / names[1]), alone)
    before, _, last = ((in_two / name, whole / name) for name in names)
    assert before[0].read_bytes() == before[1].read_bytes()
    assert last[0].read_bytes() != last[1].read_bytes()


def test_workers_do_segments_in_any_order_to_the_same_bytes(session, in_two, tmp_path, monkeypatch):
    pool = Posting(backwards=True)
    shared(session, tmp_path / "out", pool, monkeypatch)
    assert [task.places for task in pool.done] == [range(4, 6), range(4)]
    assert content(tmp_path / "out") == content(in_two)


def test_killed_within_the_second_segment_each_goes_on_where_it_was(
    session, in_two, tmp_path, monkeypatch
):
    out, saved, watcher = tmp_path / "out", filming.Latest.saved, Recorder()

    def killed(latest, *given):
        if latest.place == 5:
            raise KilledError
        return saved(latest, *given)

    monkeypatch.setattr(filming.Latest, "saved", killed)
    with pytest.raises(KilledError):
        shared(session, out, Here(backwards=True), monkeypatch)
    monkeypatch.setattr(filming.Latest, "saved", saved)
    kept = out / ".emmc-rig.partial/kept/frames"
    assert sorted(path.name for path in kept.iterdir()) == ["000004", "000005"]
    before = (kept / "000004/light_field.h5").stat().st_mtime_ns
    shared(session, out, Here(), monkeypatch, watcher=watcher)
    assert watcher.notes == ["goes on with an earlier run; frames done: 2"]
    assert (out / "frames/000004/light_field.h5").stat().st_mtime_ns == before
    assert content(out) == content(in_two)


def test_workers_that_one_segment_leaves_idle_are_named_with_what_to_set(session, whole, tmp_path):
    watcher = Recorder()
    reconstructed(session, tmp_path / "out", METHOD, workers=2, watcher=watcher)
    assert ["film: {segment: 50}" in note for note in watcher.notes] == [True]
    assert content(tmp_path / "out") == content(whole)


def test_one_frame_is_of_a_film_only(session, run):
    (session.parent / "nothing").mkdir(exist_ok=True)
    code, _, err = run("reconstruct", session.parent / "nothing", "--frame", "1")
    assert code == 2
    assert "name one session that holds a film" in " ".join(err.split())


def test_a_film_of_more_than_a_block_is_refused_with_what_to_do(session, tmp_path):
    small = MethodSettings.model_validate({"blocks": {"whole": 1000}})
    with pytest.raises(AppError, match=r"40x48 are more than one block.*raise the setting blocks"):
        reconstructed(session, tmp_path / "out", METHOD, settings=small)


@pytest.fixture(scope="module")
def psi():
    return emmc.camera("rgbw-bayer-2shots").psi((24, 32))


def readings(psi, count, step=1):
    """Return noisy readings (t, y, x) of a scene that slides by `step` pixels a frame."""
    rng, shots = np.random.default_rng(0), psi.shots
    scene = np.asarray(emmc.scene("near-planar", size=(24, 32 + count)))
    film = []
    for place in range(count):
        moved = np.ascontiguousarray(
            scene[:, :, :, step * place : step * place + 32], dtype=np.float32
        )
        film.append((psi @ moved)[place % shots])
    return np.stack(film) + rng.normal(0, 0.003, (count, 24, 32)).astype(np.float32)


def of_readings(part):
    return Frames(part[None], np.full((1, 24, 32), 0.003), np.ones((1, 24, 32), dtype=bool))


def test_shots_of_psi_are_taken_in_turn(psi):
    film = readings(psi, 3)
    results = list(emmc.reconstruct_film(psi, film, METHOD, noise_sigma=0.003))
    alone = emmc.reconstruct(psi.of_shots([0]), film[:1], METHOD, noise_sigma=0.003)
    np.testing.assert_array_equal(results[0].light_field, alone.light_field)
    for place, result in enumerate(results):
        np.testing.assert_array_equal(result.psi.weights[0], psi.weights[place % 2])
        missed = result.psi.forward(result.light_field) - result.frames.readings
        assert np.sqrt(np.mean(missed**2)) < 0.02


def test_without_a_deviation_it_is_the_sensors_at_the_exposure_of_each_shot(psi):
    film = readings(psi, 2)
    of_both = sensor_deviation(psi, film)
    for place, result in enumerate(emmc.reconstruct_film(psi, film, METHOD)):
        np.testing.assert_allclose(result.frames.deviation[0], of_both[place], rtol=1e-6)


def test_frames_with_deviations_are_taken_one_by_one(psi):
    film = (of_readings(part) for part in readings(psi, 3))
    asked = emmc.reconstruct_film(psi, film, METHOD)
    first = next(asked)
    assert first.light_field.shape == (5, 5, 24, 32, 3)
    assert len(list(film)) == 2, "no frame is read before it is asked for"


@pytest.mark.parametrize("wrong", [3, Frames(*(np.ones((2, 24, 32), dtype=t) for t in "ff?"))])
def test_what_is_no_film_is_refused(psi, wrong):
    with pytest.raises(ArgumentError, match="an array \\(t, pixel_y, pixel_x\\)"):
        emmc.reconstruct_film(psi, wrong, METHOD)
    with pytest.raises(AppError, match="'tv' takes no films"):
        emmc.reconstruct_film(psi, readings(psi, 2), "tv")


@pytest.mark.parametrize(
    ("steps", "changed"),
    [
        (False, {"earlier": 1}),
        (False, {"misfit": 0.02}),
        (False, {"texture": {"steps": 5}}),
        (False, {"segment": 2}),
        (True, {"together": 1}),
    ],
)
def test_settings_of_films_reach_the_frames_after_the_first(psi, steps, changed):
    masks = psi if steps else psi.of_shots([0])
    # At rest no frame is fitted with earlier ones.
    step = 0 if steps or "segment" in changed else 1
    given = masks, readings(masks, 3, step), METHOD
    usual, other = (
        [
            result.light_field
            for result in emmc.reconstruct_film(*given, noise_sigma=0.003, settings=settings)
        ]
        for settings in ({"film": {"earlier": 2}}, {"film": changed})
    )
    np.testing.assert_array_equal(usual[0], other[0])
    assert not np.array_equal(usual[2], other[2])


def test_a_part_of_the_textures_settings_leaves_the_rest_as_films_have_it():
    given = MethodSettings.model_validate({"film": {"texture": {"steps": 5}}})
    assert given.film.texture == FilmSettings().texture.model_copy(update={"steps": 5})


@pytest.mark.parametrize(
    ("wrong", "what"),
    [
        ({"earlier": 0}, "film.earlier: input should be greater than or equal to 1"),
        ({"segmnt": 50}, "unknown key 'film.segmnt': did you mean 'segment'?"),
        ({"texture": {"step": 5}}, "unknown key 'film.texture.step'"),
        ({"texture": 5}, "film.texture: input should be a mapping"),
    ],
)
def test_settings_of_films_that_cannot_be_are_refused_in_a_line(psi, wrong, what):
    with pytest.raises(AppError) as refused:
        emmc.reconstruct_film(psi, readings(psi, 1), METHOD, settings={"film": wrong})
    assert what in str(refused.value)


def test_memory_does_not_grow_with_the_number_of_frames(psi):
    """Results that were kept would grow it by ten light fields, frames by five times the film."""
    of_shot, latest, settings = psi.of_shots([0]), filming.Latest(), MethodSettings()
    carried, held, light_field = [], [], 5 * 5 * 24 * 32 * 3 * 4
    tracemalloc.start()
    for part in readings(of_shot, 12):
        _, latest = latest.next(of_shot, 0, of_readings(part), METHOD, settings)
        carried.append(sum(array.nbytes for array in latest.film.arrays().values()))
        gc.collect()
        held.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    assert carried[11] < 1.3 * carried[2]
    assert held[11] < held[2] + 2 * light_field


def test_a_film_at_rest_restored_goes_on_as_the_film_it_was_of():
    size = 40, 48
    psi = emmc.camera("rgbw-bayer-1shot").psi(size)
    scene = np.asarray(emmc.scene("near-planar", size=size), dtype=np.float32)
    other = scene.copy()
    other[:, :, 8:14, 8:14] = 1 - scene[:, :, 8:14, 8:14]
    rng, settings, latest = np.random.default_rng(0), MethodSettings(), filming.Latest()
    deviation, usable, shares = np.full((1, *size), 0.003), np.ones((1, *size), dtype=bool), []
    for shown in (scene, scene, other, other):
        noise = rng.normal(0, 0.003, (1, *size)).astype(np.float32)
        frames = Frames((psi @ shown) + noise, deviation, usable)
        restored = Film.restored(latest.film.arrays(), [psi] * len(latest.shots))
        again, _ = replace(latest, film=restored).next(psi, 0, frames, METHOD, settings)
        result, latest = latest.next(psi, 0, frames, METHOD, settings)
        np.testing.assert_array_equal(result.light_field, again.light_field)
        assert result.solved.stated == again.solved.stated
        for name, values in result.maps.items():
            np.testing.assert_array_equal(values, again.maps[name])
        shares.append(result.solved.parameters.get("still_share"))
    assert shares[0] is None
    assert min(shares[1], shares[3]) > 0.99
    assert 0.95 < shares[2] < 0.99
