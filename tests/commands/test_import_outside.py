"""Files of a bench that shares no code with the program, by the commands that the page prints."""

import csv
import re
from dataclasses import replace
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import tifffile
import yaml
from outside_bench import Bench, Optics, Sensor
from outside_boards import agreement, camera_of
from programs import done

from emmc_rig.calibration.shadow import shadow_mask
from emmc_rig.model.json_text import parse_json
from emmc_rig.process.reconstructing import open_frames

pytestmark = pytest.mark.slow

PAGE = Path(__file__).parents[2] / "docs/own-data.md"
SECTION = PAGE.read_text(encoding="utf-8").partition("## An example")[2].partition("\n## ")[0]
FENCED = re.findall(r"^```(\w*)\n(.*?)^```$", SECTION, re.M | re.S)
BLOCKS = dict(FENCED)
COMMANDS = [text.split()[1:] for language, text in FENCED if not language]
MADE, *STEPS = COMMANDS
OWN = Path(MADE[-1])
CELLS = np.where(np.random.default_rng(1).random((64, 64)) < 0.5, 0.92, 0.02)
OPTICS = Optics(
    mask_um=500, pitch_um=24, cell_um=24, aperture_cell_um=2000, offset_um=(0, 0), rotation_rad=0
)


def photograph(cells, seed=2):
    """Return 16 bits of a camera that looks at cells in a dark frame, from a little aside."""
    drawn = np.pad(np.kron(cells, np.ones((8, 8))), 60)
    rows, columns = drawn.shape
    corners = [[0, 0], [columns, 0], [columns, rows], [0, rows]]
    seen = [[10, 14], [columns - 20, 4], [columns - 6, rows - 12], [4, rows - 3]]
    turn = cv2.getPerspectiveTransform(np.array(corners, np.float32), np.array(seen, np.float32))
    light = cv2.warpPerspective(cv2.GaussianBlur(drawn, (0, 0), 1.0), turn, (columns, rows))
    noise = np.random.default_rng(seed).normal(0, 200, light.shape)
    return np.clip(40_000 * light + 500 + noise, 0, 65_535).astype(np.uint16)


def scene(size, views=(5, 5), disparity=0.6):
    """Return a textured plane of pale colours, (v, u, y, x, colour)."""
    rng = np.random.default_rng(5)
    drawn = [cv2.GaussianBlur(rng.random((size[0] + 24, size[1] + 24)), (0, 0), 2) for _ in "rgb"]
    drawn = np.stack([(plane - plane.min()) / np.ptp(plane) * 0.8 + 0.1 for plane in drawn], -1)
    drawn = 0.75 * drawn[..., 1:2] + 0.25 * drawn
    field = np.empty((*views, *size, 3))
    for v, u in np.ndindex(views):
        by = [
            disparity * (at - (count - 1) / 2) - 12 for at, count in ((u, views[1]), (v, views[0]))
        ]
        shift = np.array([[1, 0, by[0]], [0, 1, by[1]]], np.float32)
        field[v, u] = cv2.warpAffine(drawn, shift, size[::-1], flags=cv2.INTER_CUBIC)
    return field


def filmed(folder, sensor, change=lambda dn: dn, cells=CELLS):
    """Write the page's example without whiteboards; return the scene, (v, u, y, x, colour)."""
    folder /= OWN
    folder.mkdir()
    (folder / "mine.yaml").write_text(BLOCKS["yaml"])
    names, *lines = BLOCKS["csv"].splitlines()
    table = [names, *(line for line in lines if line.split(",")[1] in ("dark", "shot"))]
    (folder / "table.csv").write_text("\n".join(table))
    tifffile.imwrite(folder / "photo.tif", photograph(CELLS))
    bench, field = Bench(cells, (56, 56), optics=OPTICS, sensor=sensor), scene((56, 56))
    for row in csv.DictReader(table):
        lit = row["kind"] == "shot"
        dn = bench.take(float(row["exposure_s"]), lit=lit, scene=field if lit else None)
        tifffile.imwrite(folder / row["file"], change(dn))
    return field


def metrics_of(session):
    metrics = session / "reconstruction/metrics.json"
    return parse_json(metrics.read_bytes(), "metrics", ValueError)


def verdict(session):
    return metrics_of(session)["verdict"]


def test_a_photograph_of_the_mask_and_four_files_become_the_light_field(tmp_path, run):
    truth = filmed(tmp_path, Sensor(bayer=False, electrons_per_s=800_000))[..., 1]
    assert [command[0] for command in STEPS] == ["mask", "import", "reconstruct"]
    for command in STEPS:
        done(run(*command))
    with h5py.File(tmp_path / "bench/reconstruction/light_field.h5") as file:
        field = np.array(file["light_field"]).mean(-1)
    field *= np.sum(field * truth) / np.sum(field**2)
    assert 10 * np.log10(1 / np.mean((field - truth) ** 2)) > 34
    found = verdict(tmp_path / "bench")
    assert found["level"] == "trust", found["reasons"]
    assert "not calibrated" in metrics_of(tmp_path / "bench")["assumed"]


def with_gamma(dn):
    """Return codes of 8 bits with a gamma, as a program for pictures writes them."""
    return np.round(255 * np.clip((dn - 64.0) / (4095 - 64), 0, 1) ** (1 / 2.2)).astype(np.uint8)


def camera_changed(folder, change):
    camera = yaml.safe_load((folder / OWN / "mine.yaml").read_text())
    change(camera)
    (folder / OWN / "mine.yaml").write_text(yaml.safe_dump(camera))


def of_8_bits(camera):
    levels = {"black_level_dn": 0, "white_level_dn": 255}
    camera["sensor"]["noise"].update(levels, gain_dn_per_electron=0.08)


UNKNOWABLE = {
    "a gamma": (Sensor(bayer=False), with_gamma, of_8_bits, "to the power of"),
    "cells of another size": (
        Sensor(bayer=False), np.copy, lambda camera: camera["masks"]["film"].update(cell_um=27),
        "masks",
    ),
}  # fmt: skip


@pytest.mark.parametrize("mistake", UNKNOWABLE)
def test_a_mistake_that_no_file_shows_is_named_by_the_verdict(mistake, tmp_path, run):
    sensor, written, described, words = UNKNOWABLE[mistake]
    filmed(tmp_path, replace(sensor, electrons_per_s=400_000), written)
    camera_changed(tmp_path, described)
    mask, imported, reconstruct = STEPS
    for command in (mask, imported, [*reconstruct, "--method", "tv"]):
        done(run(*command))
    found = verdict(tmp_path / "bench")
    assert found["level"] != "trust"
    assert any(words in reason["what"] for reason in found["reasons"]), found["reasons"]


PHASES = {"rggb": ("trust", "doubt"), "bggr": ("doubt", "do not use"), "grbg": ("do not use",)}


@pytest.mark.parametrize("cfa", PHASES)
def test_another_phase_of_the_filters_is_another_mask_to_the_verdict(cfa, tmp_path, run):
    rgbw = np.array([[1, 1, 1], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    cells = 0.02 + 0.9 * rgbw[np.random.default_rng(3).integers(0, 4, (64, 64))]
    filmed(tmp_path, Sensor(electrons_per_s=800_000), cells=cells)
    codes = np.round(65_535 * cells[..., ::-1]).astype(np.uint16)
    cv2.imwrite(str(tmp_path / OWN / "mine.png"), codes)
    camera_changed(tmp_path, lambda camera: camera["sensor"].update(cfa=cfa))
    _, imported, reconstruct = STEPS
    for command in (imported, [*reconstruct, "--method", "tv"]):
        done(run(*command))
    found = verdict(tmp_path / "bench")
    assert found["level"] in PHASES[cfa], found["reasons"]
    assert (found["features"]["strengths"][0] > 0.95) == (cfa == "rggb")


def whiteboards(folder, bench, pinhole_s):
    """Write the files of whiteboards and two shots, and the table that names them."""
    rows, field = [], scene(bench.size, bench.optics.views)

    def take(count, kind, exposure_s, **row):
        how = {"lit": kind != "dark", "scene": field if kind == "shot" else None}
        at = row.get("mask_x_um", 0), row.get("mask_y_um", 0)
        v, u = row.pop("view", (None, None))
        if v is not None:
            middle, cell_um = (bench.optics.views[0] - 1) / 2, bench.optics.aperture_cell_um
            row |= {
                "aperture_x_um": (u - middle) * cell_um,
                "aperture_y_um": (v - middle) * cell_um,
            }
        for _ in range(count):
            dn = bench.take(
                exposure_s, view=None if v is None else (v, u),
                mask=None if kind == "reference" else at, **how,
            )  # fmt: skip
            name = f"{len(rows)}.npy"  # a TIFF is read by a process of its own
            np.save(folder / name, dn)
            rows.append({"file": name, "kind": kind, "exposure_s": exposure_s,
                         "time": bench.clock_s, **row})  # fmt: skip

    take(4, "dark", 0.15)
    take(4, "dark", pinhole_s)
    take(4, "reference", 0.15)
    for x, y in ((0, 0), (37, 11), (-23, 31)):
        take(4, "open", 0.15, mask_x_um=x, mask_y_um=y)
    for view in np.ndindex(bench.optics.views):
        take(4, "whiteboard", pinhole_s, view=view)
    for x, y in ((0, 0), (15, -21)):
        take(4, "validation", 0.15, mask_x_um=x, mask_y_um=y)
    take(2, "shot", 0.15, shot=0)
    with (folder / "table.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(dict.fromkeys(name for row in rows for name in row)))
        writer.writeheader()
        writer.writerows(rows)
    return field


def test_psi_of_whiteboards_of_another_bench_errs_as_much_as_it_says(tmp_path, run):
    optics = Optics(views=(3, 3), aperture_cell_um=2_500)
    camera, size = camera_of(optics), (32, 40)
    bench = Bench(shadow_mask(camera, size).cells[0, :, :, :3], size, optics=optics)
    whiteboards(tmp_path, bench, 0.15 * 9)
    described = camera.model_dump(mode="json", exclude_unset=True)
    described["sensor"]["noise"] = {
        "black_level_dn": 64, "white_level_dn": 4095, "gain_dn_per_electron": 0.08
    }  # fmt: skip
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(described))
    for command in (
        ("import", "table.csv", "--camera", "mine.yaml", "--out", "bench"),
        ("calibrate", "bench"),
        ("reconstruct", "bench", "--method", "tv"),
    ):
        done(run(*command))
    psi, _ = open_frames(tmp_path / "bench")
    with h5py.File(tmp_path / "bench/calibration/calibration.h5") as file:
        found = agreement(bench, psi.weights, np.array(file["deviation"]), np.array(file["good"]))
    assert 0.4 < found["true"] / found["stated"] < 1.6, found
    assert 0.45 < found["within_1"] < 0.95, found
    assert found["within_2"] > 0.88, found
    assert found["true"] < 0.01, found
    assert verdict(tmp_path / "bench")["level"] != "do not use"
