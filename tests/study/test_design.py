"""Designing a mask: theory against draws, masks as printed, files read back by other means."""

import json
import re
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from programs import done

from emmc_rig.calibration.boards import Board
from emmc_rig.calibration.locator import register
from emmc_rig.calibration.placement import designed_placement
from emmc_rig.calibration.shadow import shadow_mask
from emmc_rig.model.camera import build_imaging_matrix, load_camera
from emmc_rig.model.lightfield import OPPONENT
from emmc_rig.model.masks import FILTERS
from emmc_rig.study.design.bench import DesignBench
from emmc_rig.study.design.expected import (
    SIZE,
    Block,
    SceneTexture,
    _shift,
    expected,
    prior_covariance,
)
from emmc_rig.study.design.mask_file import (
    LAYERS,
    PICTURE,
    mask_cells,
    with_picture,
    write_gdsii,
    write_picture,
)
from emmc_rig.study.design.printed import Print, printed_psi
from emmc_rig.study.design.search import MASK, Candidate, candidates

RGBW = Candidate("random_rgbw", 0.5, 36.0, 0.12)
SMALL = DesignBench(size=(48, 64), stage_travel_um=(200.0, 200.0))
PLAIN = Print(diffraction=False)


def test_the_error_of_two_textures_is_that_of_the_posterior_mean_drawn(random_psi):
    side, d, e = 4, 0.3, -0.4
    psi = random_psi(shots=2, views=(2, 3), size=(4, 4))
    block = Block.of(psi, np.full(psi.frames_shape, 1e-3), (0, 0), side)
    texture = SceneTexture(apart=0.0, chroma=0.3)
    prior = prior_covariance(texture.prior, side)
    rng = np.random.default_rng(0)
    root = np.linalg.cholesky(prior + 1e-9 * np.eye(side**2))
    halves = np.sqrt(texture.variances / 2)[:, None, None]
    both = [halves * (root @ rng.standard_normal((3, side**2, 4000))) for _ in (d, e)]
    rays = np.zeros((2, 3, side, side, 3, 4000))
    for v, u in np.ndindex(2, 3):
        for disparity, drawn in zip((d, e), both, strict=True):
            move = np.kron(_shift(disparity * (v - 1), side), _shift(disparity * (u - 1), side))
            moved = (move @ drawn).reshape(3, side, side, -1)
            rays[v, u] += np.einsum("oyxn,oc->yxcn", moved, OPPONENT)
    flat = rays.reshape(-1, 4000)
    readings = psi.to_scipy() @ flat
    readings += np.sqrt(1e-3) * rng.standard_normal(readings.shape)
    # The best linear estimate that the draws themselves show: regression.
    weights = np.linalg.lstsq(readings.T, flat.T, rcond=None)[0]
    found = np.mean(np.square(flat - weights.T @ readings))
    assert block.error(d, e, texture) == pytest.approx(found, rel=0.04)


def test_one_texture_is_two_at_the_same_disparity_and_easier(coded_psi):
    psi = coded_psi(size=(16, 16))
    block = Block.of(psi, np.full(psi.frames_shape, 1e-5), (0, 0))
    texture = SceneTexture()
    whole = texture.variances.sum() / 3
    assert block.error(0.5, 0.5, texture) < block.error(0.5, 1.5, texture) < whole


def test_a_mask_in_perfect_print_without_diffraction_has_the_cameras_own_psi():
    camera = RGBW.camera(SMALL)
    psi, printed = camera.psi(SIZE), printed_psi(camera, SIZE, PLAIN)
    np.testing.assert_allclose(printed.weights, psi.weights, atol=2e-6)


def test_over_etching_lets_as_much_more_light_through_as_the_openings_grow():
    lone = Candidate("random_binary", 0.5, 72.0, 0.06).camera(SMALL)
    light = [
        printed_psi(lone, SIZE, Print(over_etch_um=by, diffraction=False)).light_efficiency()
        for by in (-2.0, 0.0, 2.0)
    ]
    # Half of the edges between cells part an open one from an opaque one: 2 per cell are moved.
    grown = 2 * 0.5 * 2.0 / 72.0
    assert np.diff(light) == pytest.approx([grown, grown], rel=0.25)


def test_diffraction_blurs_small_cells_far_away_and_large_ones_near_hardly():
    def changed(cell_um, distance_mm):
        camera = replace(RGBW, cell_um=cell_um, distance_mm=distance_mm).camera(SMALL)
        plain = printed_psi(camera, SIZE, PLAIN)
        return printed_psi(camera, SIZE, Print()).relative_difference(plain)

    assert changed(24.0, 0.48) > 3 * changed(72.0, 0.06)


def test_a_thick_layer_shades_what_slants():
    camera = replace(RGBW, family="random_binary").camera(SMALL)
    thin, thick = (
        printed_psi(camera, SIZE, Print(thickness_um=t, diffraction=False)) for t in (0, 40)
    )
    assert thick.light_efficiency() < thin.light_efficiency()
    assert thick.camera_json == thin.camera_json


def test_less_light_and_more_noise_is_a_larger_expected_error():
    def expect(share, exposure_s):
        bench = SMALL.model_copy(update={"total_exposure_s": exposure_s})
        camera = Candidate("random_binary", share, 36.0, 0.12).camera(bench)
        return expected(camera, printed_psi(camera, SIZE, PLAIN), (-1, 1)).psnr_db

    assert expect(0.5, 0.05) > max(expect(0.5, 0.0005), expect(0.1, 0.05))


def test_shots_stay_within_the_stage_s_travel():
    bench = DesignBench(shots=3, stage_travel_um=(150.0, 80.0))
    for candidate in candidates(bench):
        places = [shot.offset_um.get(MASK, (0, 0)) for shot in candidate.camera(bench).shots]
        assert len(set(places)) == 3
        assert (np.ptp(places, axis=0) <= (150, 80)).all()


def gdsii_rectangles(path):
    """Yield layer and corners in um of every boundary, by the format's records alone.

    Source: GDSII Stream Format Manual, release 6.0; lengths in the file are multiples of 1 nm.
    """
    data, at, layer = path.read_bytes(), 0, 0
    while at < len(data):
        length, kind = struct.unpack_from(">HH", data, at)
        if kind == 0x0D02:
            (layer,) = struct.unpack_from(">h", data, at + 4)
        if kind == 0x1003:
            points = np.frombuffer(data[at + 4 : at + length], ">i4").reshape(-1, 2) * 1e-3
            yield layer, points.min(axis=0), points.max(axis=0)
        at += length or len(data)


def test_the_mask_file_read_back_by_its_records_has_the_same_cells(tmp_path):
    pytest.importorskip("gdstk")
    camera = RGBW.camera(SMALL)
    cells = mask_cells(camera, SMALL)
    write_gdsii(cells, 36.0, tmp_path / "mask.gds")
    read = np.zeros_like(cells)
    filters = {LAYERS[letter]: np.array(colours) for letter, colours in FILTERS.items()}
    middle = np.array(cells.shape[1::-1]) / 2
    for layer, low, high in gdsii_rectangles(tmp_path / "mask.gds"):
        first, last = (
            np.rint(low / 36 + middle).astype(int),
            np.rint(high / 36 + middle).astype(int),
        )
        np.testing.assert_allclose((first - middle) * 36, low, atol=1e-3)
        read[first[1] : last[1], first[0] : last[0]] = filters[layer]
    np.testing.assert_array_equal(read, cells)


@pytest.mark.peers
def test_klayout_reads_the_same_area_of_every_filter(tmp_path):
    pytest.importorskip("gdstk")
    database = pytest.importorskip("klayout.db")
    cells = mask_cells(RGBW.camera(SMALL), SMALL)
    write_gdsii(cells, 36.0, tmp_path / "mask.gds")
    layout = database.Layout()
    layout.read(str(tmp_path / "mask.gds"))
    for letter, layer in LAYERS.items():
        index = layout.find_layer(layer, 0)
        region = database.Region(layout.top_cell().begin_shapes_rec(index))
        count = (cells == np.array(FILTERS[letter])).all(axis=-1).sum()
        assert region.area() * layout.dbu**2 == pytest.approx(count * 36.0**2)


def whiteboard(camera):
    """The whiteboard as a camera's own Psi reads it, which knows nothing of the shadow's model."""
    psi = camera.psi(SMALL.size)
    reading = psi.forward(np.ones(psi.light_field_shape, np.float32))[0]
    variance, every = np.full(SMALL.size, 1e-5, np.float32), np.ones(SMALL.views, bool)
    return Board("test", reading, variance, psi.colour[0], every, (0.0, 0.0), 0)


def test_calibration_finds_a_displaced_mask_of_the_written_camera(tmp_path):
    cells = mask_cells(RGBW.camera(SMALL), SMALL)
    write_picture(cells, tmp_path / PICTURE)
    text = with_picture(RGBW.camera(SMALL)).model_dump(mode="json", exclude_defaults=True)
    (tmp_path / "camera.yaml").write_text(yaml.safe_dump(text))
    camera = load_camera(tmp_path / "camera.yaml")
    mask = shadow_mask(camera, SMALL.size)
    np.testing.assert_array_equal(mask.cells[0, :, :, :3], cells)
    moved = camera.model_copy(
        update={"shots": (camera.shots[0].model_copy(update={"offset_um": {MASK: (97.0, -41.0)}}),)}
    )
    found = register(whiteboard(moved), mask, designed_placement(camera)).placement
    assert (found.offset_x_um, found.offset_y_um) == pytest.approx((97, -41), abs=6)


def test_the_mask_covers_every_place_that_the_stage_reaches(tmp_path):
    bench = SMALL.model_copy(update={"stage_travel_um": (900.0, 900.0)})
    write_picture(mask_cells(RGBW.camera(bench), bench), tmp_path / PICTURE)
    camera = with_picture(RGBW.camera(bench))
    pattern = camera.masks[MASK].pattern.beside(tmp_path)
    masks = {MASK: camera.masks[MASK].model_copy(update={"pattern": pattern})}
    for corner in ((450.0, 450.0), (-450.0, 450.0)):
        shot = camera.shots[0].model_copy(update={"offset_um": {MASK: corner}})
        build_imaging_matrix(
            camera.model_copy(update={"masks": masks, "shots": (shot,)}), bench.size
        )


def test_the_bench_of_the_documentation_is_the_default():
    text = (Path(__file__).parents[2] / "docs/design.md").read_text(encoding="utf-8")
    (shown,) = re.findall(r"^```yaml\n(.*?)^```", text, re.M | re.S)
    assert DesignBench.model_validate(yaml.safe_load(shown)) == DesignBench()


BENCH = {
    "size": [48, 64],
    "distances_mm": [0.12],
    "cells_um": [36],
    "families": ["random_binary"],
    "open_shares": [0.5],
    "stage_travel_um": [200, 200],
}


@pytest.mark.slow
def test_the_command_writes_a_camera_a_mask_and_a_page_that_other_commands_take(
    run, tmp_path, monkeypatch
):
    monkeypatch.setattr("emmc_rig.study.design.expected.PLACES", 1)
    (tmp_path / "bench.yaml").write_text(yaml.safe_dump(BENCH))
    small = ("--scene", "near-planar", "--size", "32x40")
    out = done(run("design", "bench.yaml", *small))
    assert "best shipped camera" in out
    metrics = json.loads((tmp_path / "emmc-design/metrics.json").read_text())
    assert metrics["winner"]["family"] == "random_binary"
    assert len(metrics["tried"]) == 1
    assert {camera["name"] for camera in metrics["simulated"]} >= {
        "this design",
        "rgbw-bayer-1shot",
    }
    done(run("simulate", "--camera", "emmc-design/camera.yaml", *small))
