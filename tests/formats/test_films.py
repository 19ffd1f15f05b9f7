"""Films: opened frame by frame, refused in one line, and exported in the formats that have time."""

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
from filmed import SIZE, light_field_at, write_film
from programs import one_line, program
from watching import Recorder

from emmc_rig.errors import AppError
from emmc_rig.formats.displays import in_time
from emmc_rig.formats.exports import film_of, open_film
from emmc_rig.formats.registry import FORMATS
from emmc_rig.formats.scenes import open_scene
from emmc_rig.model.lightfield import centre_view
from emmc_rig.model.srgb import codes_of, srgb_of
from emmc_rig.store.folders import result_folder


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    return open_film(write_film(tmp_path_factory.mktemp("film") / "slide"))


def test_frames_stand_at_their_places_in_time_and_a_missing_one_leaves_its_place_empty(film):
    assert (film.rate, film.shape) == (8.0, (3, 3, *SIZE, 3))
    assert film.times_s == (0, 0.125, 0.25, 0.375, 0.5, 0.625)
    assert (list(film.frames), film.missing) == ([0, 1, 2, 4, 5], [3])
    np.testing.assert_array_equal(film.opened(4).light_field, light_field_at(4))
    assert film.opened(4).disparity is not None
    assert [place for place, _ in film.each()] == [0, 1, 2, 4, 5]


def test_one_result_and_a_camera_s_frames_are_no_films_and_that_of_a_session_is(film, tmp_path):
    assert film_of(str(film.folder)) == film
    assert film_of(str(film.frames[0])) is None
    (tmp_path / "frames").mkdir()
    assert film_of(str(tmp_path)) is None  # of a camera, by `devices snap`
    for name in ("session.json", "journal.jsonl", "metrics.json"):
        (tmp_path / name).touch()
    assert film_of(str(tmp_path)) is None
    shutil.copytree(film.folder, tmp_path / "reconstruction")
    found = film_of(str(tmp_path))
    assert found is not None
    assert found.folder == tmp_path / "reconstruction"


def cut_metrics(folder):
    path = folder / "metrics.json"
    path.write_bytes(path.read_bytes()[:60])


def drop_times(folder):
    about = json.loads((folder / "metrics.json").read_text())
    about["film"]["times_s"].pop()
    (folder / "metrics.json").write_text(json.dumps(about))


def drop_film(folder):
    (folder / "metrics.json").write_text("{}")


def drop_frames(folder):
    shutil.rmtree(folder / "frames")
    (folder / "frames").mkdir()


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (cut_metrics, "metrics.json: cannot be read"),
        (drop_times, "5 times for 6 frames"),
        (drop_film, "metrics.json: not that of a film"),
        (drop_frames, "a film without a frame"),
    ],
)
def test_what_is_no_whole_film_is_one_clear_line(tmp_path, film, damage, words):
    folder = tmp_path / "film"
    shutil.copytree(film.folder, folder)
    damage(folder)
    with pytest.raises(AppError) as refused:
        open_film(folder)
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_frame_that_was_written_and_is_gone_is_no_frame_that_could_not_be_made(tmp_path):
    out = tmp_path / "film"
    with result_folder(out, "reconstruct") as folder:
        write_film(folder)
    assert open_film(out).missing == [3]
    shutil.rmtree(out / "frames/000001")
    with pytest.raises(AppError, match=r"frames/000001/light_field\.h5 is missing; copy"):
        open_film(out)


def exported(tmp_path, film, name):
    """Write a film; returns the folder and how many frames were shown as done."""
    watcher = Recorder()
    FORMATS[name].write_whole_film(tmp_path, replace(film, watcher=watcher))
    return tmp_path, len(watcher.details)


def centre_codes(place):
    return codes_of(srgb_of(centre_view(light_field_at(place)))).astype(float)


def test_ome_zarr_has_time_in_seconds_and_views_along_z(tmp_path, film):
    ngff = pytest.importorskip("ngff_zarr", reason="extra `formats`")
    folder, done = exported(tmp_path, film, "ome-zarr")
    stored = ngff.from_ngff_zarr(str(folder / "film.ome.zarr"), validate=True)
    image = stored.images[0]
    assert image.dims == ("t", "c", "z", "y", "x")
    assert image.data.shape == (6, 3, 9, *SIZE)
    assert (image.scale["t"], image.axes_units["t"], image.scale["z"]) == (0.125, "second", 1)
    assert [picture.data.shape[-2:] for picture in stored.images] == [SIZE, (18, 24)]
    frames = np.asarray(image.data)
    for place in film.frames:
        views = light_field_at(place).reshape(9, *SIZE, 3)
        np.testing.assert_array_equal(frames[place], views.transpose(3, 0, 1, 2))
    assert np.isnan(frames[3]).all()
    coarse = np.asarray(stored.images[1].data)
    blocks = frames.reshape(6, 3, 9, 18, 2, 24, 2).mean(axis=(4, 6))
    np.testing.assert_allclose(coarse, blocks, atol=1e-6)
    attributes = json.loads((folder / "film.ome.zarr/.zattrs").read_text())["emmc_rig"]
    assert attributes["views"] == [3, 3]
    assert attributes["film"] == {"times_s": list(film.times_s), "missing": [3]}
    assert done == 5
    with pytest.raises(AppError, match="holds a film; open a frame"):
        open_scene(str(folder / "film.ome.zarr"))


@pytest.mark.parametrize(("name", "ending"), [("mp4", "mp4"), ("webm", "webm")])
def test_a_video_shows_the_centre_view_at_the_film_s_rate(tmp_path, film, name, ending):
    av = pytest.importorskip("av", reason="extra `peers`")
    folder, done = exported(tmp_path, film, name)
    with av.open(str(folder / f"film.{ending}")) as stream:
        assert float(stream.streams.video[0].average_rate) == pytest.approx(film.rate, rel=0.01)
        shown = [picture.to_ndarray(format="rgb24") for picture in stream.decode(video=0)]
    assert (len(shown), done) == (6, 5)
    for place, picture in enumerate(shown):
        missed = [np.abs(centre_codes(other) - picture).mean() for other in film.frames]
        # A missing frame shows the one before it.
        assert list(film.frames)[int(np.argmin(missed))] == (2 if place == 3 else place)


def test_what_comes_before_the_first_frame_shows_that_frame(tmp_path):
    film = open_film(write_film(tmp_path / "film", missing=(0, 1, 5)))
    shown = list(in_time(film, lambda picture: centre_view(picture.light_field)))
    assert len(shown) == 6
    for place, picture in zip((2, 2, 2, 3, 4, 4), shown, strict=True):
        np.testing.assert_array_equal(picture, centre_view(light_field_at(place)))


def test_a_film_of_quilts_is_named_and_laid_out_as_one_quilt_is(tmp_path, film):
    folder, _ = exported(tmp_path, film, "quilt")
    (path,) = folder.iterdir()
    assert path.name == "quilt_qs8x6a1.33.webm"
    FORMATS["quilt"].write(tmp_path, film.opened(4))
    quilt = np.asarray(cv2.imread(str(tmp_path / "quilt_qs8x6a1.33.png")), float)
    video = cv2.VideoCapture(str(path))
    shown = [np.asarray(video.read()[1], float) for _ in range(6)]
    assert not video.read()[0]
    assert np.abs(shown[4] - quilt).mean() < 6 < np.abs(shown[0] - quilt).mean()


def test_the_command_exports_a_film_and_says_what_a_film_is_not_for(tmp_path, monkeypatch, film):
    monkeypatch.chdir(tmp_path)
    code, _, err = program("export", film.folder, "--format", "hci", "--out", "hci")
    assert code == 1
    said = one_line(err)
    assert "holds no films: choose one that does" in said
    assert said.endswith("`emmc-rig export --list` marks them")
    assert "frames/000000" in said
    assert not (tmp_path / "hci").exists()
    assert program("export", film.folder, "--truth", "near-planar")[0] == 2
    code, reported, err = program("export", film.folder, "--format", "video")
    assert code == 0, err
    assert "emmc-video/film.mp4" in reported  # the name of version 0.4, in its folder
    about = json.loads((tmp_path / "emmc-video/metrics.json").read_text())
    assert (about["format"], about["missing_frames"]) == ("mp4", [3])
    assert about["shape"] == [3, 3, *SIZE, 3]
    assert "; films" in program("export", "--list")[1].splitlines()[0]
