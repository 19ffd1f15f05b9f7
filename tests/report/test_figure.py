"""Figures for papers: panels, scales, captions, and refused settings."""

import re
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.patches import Rectangle

from emmc_rig.errors import AppError, WrongUsageError
from emmc_rig.formats.format import Export
from emmc_rig.formats.scenes import open_scene
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.report.result_figure import (
    FigureSettings,
    detailed_pieces,
    draw_results,
    epipolar_lines,
)

SIZE = (36, 48)


@pytest.fixture(scope="module")
def results():
    """Two results of one capture, the second without a deviation, and the truth with the first."""
    scene = open_scene("deep-occlusions", size=SIZE)
    rng = np.random.default_rng(1)

    def result(name, error, sigma=None):
        noise = rng.normal(0, error, scene.light_field.shape)
        estimate = np.clip(scene.light_field + noise, 0, 1).astype(np.float32)
        return Export(
            name, "", estimate, scene.light_field, scene.disparity_px, sigma,
            metrics={"method": name, "command": f"emmc-rig reconstruct --method {name}"},
        )  # fmt: skip

    sigma = np.full(scene.light_field.shape[:4], 0.2, np.float32)
    return result("careful", 0.01, sigma), result("hasty", 0.1)


def maps_of(figure):
    """Return the values and the ends of the scale of every map drawn, in order."""
    images = [image for axes in figure.axes for image in axes.images]
    drawn = [image for image in images if image.get_array().ndim == 2]
    return [(np.asarray(image.get_array()), image.get_clim()) for image in drawn]


def test_error_and_deviation_of_all_methods_share_one_scale(results):
    drawn = draw_results(results)
    careful, hasty, sigma, *disparities = maps_of(drawn.figure)
    truth = results[0].truth[2, 2]
    for (values, _), result in zip((careful, hasty), results, strict=True):
        expected = np.sqrt(((result.light_field[2, 2] - truth) ** 2).mean(-1))
        np.testing.assert_allclose(values, expected, atol=1e-6)
    assert careful[1] == hasty[1] == sigma[1]
    assert careful[1][0] == 0
    assert careful[1][1] >= 0.2
    assert len(disparities) == 2
    assert disparities[0][1] == disparities[1][1]


def test_psnr_stands_over_its_method_and_the_caption_names_every_source(results):
    drawn = draw_results(results)
    texts = [text.get_text() for text in drawn.figure.texts]
    for result in results:
        psnr = psnr_db(result.light_field, result.truth)
        assert any(text.startswith(f"{result.title}\n{psnr:.2f} dB") for text in texts)
        assert drawn.measured[result.title]["psnr_db"] == psnr
        assert result.metrics["command"] in drawn.caption
    # The second method has no deviation, which stands in its place.
    assert "estimated deviation" in texts
    assert texts.count("none") == 1
    assert "true" in texts


@pytest.mark.parametrize("count", [1, 6])
@pytest.mark.parametrize("with_truth", [True, False])
def test_the_figure_is_labelled_and_filled_for_one_to_six_methods(results, count, with_truth):
    of_methods = [
        replace(results[i % 2], title=f"method {i}", truth=None if i or not with_truth else truth)
        for i, truth in enumerate([results[0].truth] * count)
    ]
    figure = draw_results(of_methods).figure
    figure.draw_without_rendering()
    texts = [text.get_text().replace("\n", " ") for text in figure.texts]
    assert any("view u" in text for text in texts)
    assert any("disparity, px per view" in text for text in texts)
    (bar,) = figure.axes[0].texts
    assert bar.get_text() == "10 px"  # 48 px wide
    assert np.ptp(np.asarray(figure.axes[0].lines[-1].get_xdata())) == 10
    drawn = sum(
        axes.get_position().width * axes.get_position().height
        for axes in figure.axes
        if axes.images
    )
    assert drawn > 0.5
    for axes in figure.axes:
        x0, y0, x1, y1 = axes.get_position().extents
        assert min(x0, y0) >= -1e-9
        assert max(x1, y1) <= 1 + 1e-9


def test_a_flat_disparity_is_a_figure_of_the_caption_and_not_a_map_of_one_colour(results):
    flat = replace(results[0], disparity=np.full(SIZE, 0.25, np.float32), sigma=None, truth=None)
    drawn = draw_results([flat])
    assert "Disparity is 0.25 px per view everywhere" in drawn.caption
    assert maps_of(drawn.figure) == []


def test_a_close_up_shows_the_pixels_around_its_point_of_the_view_asked_for(results):
    settings = FigureSettings(view=(0, 4), at=[(20, 30), (0, 0)], side_px=8)
    drawn = draw_results(results[1:], settings)
    whole, first, corner, *_ = (
        np.asarray(image.get_array()) for axes in drawn.figure.axes for image in axes.images
    )
    np.testing.assert_array_equal(first, whole[16:24, 26:34])
    np.testing.assert_array_equal(corner, whole[:8, :8])
    picture, first_axes = drawn.figure.axes[:2]
    frame = picture.patches[0]
    assert isinstance(frame, Rectangle)
    assert (frame.get_xy(), frame.get_width(), frame.get_height()) == ((25.5, 15.5), 8, 8)
    assert frame.get_edgecolor() == first_axes.spines["left"].get_edgecolor()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (FigureSettings(view=(5, 0)), "view 5,0: there are 5x5 views"),
        (FigureSettings(at=[(36, 0)]), "at 36,0: the pictures have 36x48 pixels"),
        (FigureSettings(side_px=37), "side 37: the pictures have only 36x48 pixels"),
    ],
)
def test_places_outside_the_picture_are_refused(results, settings, message):
    with pytest.raises(WrongUsageError, match=message):
        draw_results(results, settings)


def test_results_of_different_captures_are_refused(results):
    other = Export("other", "", results[0].light_field[:3])
    with pytest.raises(AppError, match="other has shape"):
        draw_results([results[0], other])


def test_a_figure_is_written_as_vectors_with_their_fonts_and_the_caption_inside(results, tmp_path):
    drawn = draw_results(results, FigureSettings(at=[(20, 30)], side_px=20))
    drawn.save(tmp_path)
    pdf, svg = (tmp_path / "figure.pdf").read_bytes(), (tmp_path / "figure.svg").read_text()
    assert b"/FontFile2" in pdf  # TrueType
    assert b"/Type3" not in pdf
    assert "<text" not in svg
    assert "font-family" not in svg
    assert "Close-ups of 20x20 pixels around (y, x) = (20, 30)." in drawn.caption
    assert " ".join((tmp_path / "figure.txt").read_text().split()) == drawn.caption
    assert re.sub(r"\s", "", drawn.caption)[:40] in re.sub(r"\s", "", svg)


def test_the_most_telling_piece_is_where_the_texture_is():
    picture = np.full((60, 80, 3), 0.5, np.float32)
    picture[30:42, 50:62] = np.random.default_rng(0).random((12, 12, 3))
    (piece,) = detailed_pieces(picture, 16)
    assert 26 <= piece.y <= 32
    assert 46 <= piece.x <= 52


def test_epipolar_lines_are_taken_where_views_differ():
    lf = np.zeros((5, 5, 20, 30, 3), np.float32)
    lf[:, -1, 11] = 1
    lf[-1, :, :, 17] += 0.5
    assert epipolar_lines(lf) == (11, 17)
