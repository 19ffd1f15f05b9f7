"""Files as a bench of one's own writes them, made by the simulated bench: a first own-data folder.

    mine.yaml    the camera, without the brightness of white, which nobody knows
    photo.tif    a photograph of its mask
    table.csv    a row for each frame, as `emmc-rig import` reads it
    *.tif        the frames: scene, darks, white board without and behind the mask

The mask stands a few um off and turned, as on every simulated bench, so that Psi must be measured.
Same seed, same bytes.
"""

from __future__ import annotations

import csv
from collections import Counter
from pathlib import Path
from typing import Any, cast

import numpy as np
import tifffile

from emmc_rig.bench.hardware import simulated_rig
from emmc_rig.captures.plan import Boards, Darks, OpenBoard, Plan, PlannedShot
from emmc_rig.demo import simulated_session
from emmc_rig.formats.cameras import find_camera
from emmc_rig.formats.scenes import APERTURE_FACTOR, PIXEL_FACTOR, fine_scene
from emmc_rig.model.errors import CameraError
from emmc_rig.model.reading import parse_yaml
from emmc_rig.progress import Watcher
from emmc_rig.session.board_sets import decoded
from emmc_rig.session.planned import kind_name
from emmc_rig.simulators.photograph import photographed

SCENE, SIZE, EXPOSURE_S = "toy-table", (56, 56), 0.1
CLEAR, SHUT = 0.92, 0.02
CAMERA_FILE, PHOTO, TABLE = "mine.yaml", "photo.tif", "table.csv"
CAMERA = """\
# mine.yaml
title: my own mask
views: [5, 5]
lens: {distance_mm: 50, aperture_cell_mm: 2}
sensor:
  cfa: [R]                      # no filters, a grey light field
  sample_pitch_um: 24
  noise: {black_level_dn: 64, white_level_dn: 4095, gain_dn_per_electron: 0.08}
masks:
  film:
    distance_mm: 0.5
    cell_um: 24
    pattern: {kind: picture, path: mine.png}
"""
CELLS, CELL_UM = (64, 64), 24
ELECTRONS_PER_S, RAYS_PER_VIEW = 300_000, 512
"""Rays of one pixel: with 128, whiteboards are grainy by more than their noise."""
PLAN = Plan(
    camera=CAMERA_FILE,
    shots=(PlannedShot(exposure_s=(EXPOSURE_S,), repeats=2),),
    whiteboards=Boards(
        views=(),
        references=2,
        open=(OpenBoard(repeats=4), OpenBoard(validation=True)),
        exposure_s=EXPOSURE_S,
    ),
    darks=Darks(exposure_s=(EXPOSURE_S,), repeats=2),
)


def write_own_data(folder: Path, seed: int, watcher: Watcher | None = None) -> Counter[str]:
    """Write the files into an existing folder; return the number of frames of each kind.

    Raises the errors of the layers below, each one line, or OSError.
    """
    watcher = watcher or Watcher()
    rng = np.random.default_rng(seed)
    film = np.where(rng.random(CELLS) < 0.5, CLEAR, SHUT)
    described = cast(dict[str, Any], parse_yaml(CAMERA, CAMERA_FILE, CameraError))
    described["sensor"]["noise"]["electrons_per_s"] = ELECTRONS_PER_S
    described["masks"]["film"]["pattern"] = film
    camera = find_camera(described)
    watcher.begin("scene")
    fine = fine_scene(
        SCENE, APERTURE_FACTOR, PIXEL_FACTOR, size=SIZE, views=camera.views, seed=seed
    )
    grey = np.repeat(fine.samples.mean(axis=-1, keepdims=True), 3, axis=-1)
    rig, _ = simulated_rig(camera, grey, SIZE, seed, rays_per_view=RAYS_PER_VIEW)
    seeded = f"{CAMERA}# files: simulated, seed {seed}\n"
    (folder / CAMERA_FILE).write_text(seeded, encoding="utf-8")
    tifffile.imwrite(folder / PHOTO, photographed(film, rng))
    rows: list[tuple] = []
    counts: Counter[str] = Counter()
    watcher.begin("capture")
    with simulated_session(PLAN, camera, rig, watcher) as session:
        for planned, frame in zip(session.frames, decoded(session, session.frames), strict=True):
            kind = kind_name(planned.kind)
            counts[kind] += 1
            name = f"{'scene' if kind == 'shot' else kind}-{counts[kind]}.tif"
            tifffile.imwrite(folder / name, frame.mosaic.astype(np.uint16))
            shot = planned.bench.shot if kind == "shot" else ""
            rows.append((name, kind, shot, session.stored[planned.id].exposure_s))
    with (folder / TABLE).open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(("file", "kind", "shot", "exposure_s"))
        table.writerows(rows)
    return counts
