"""`emmc-rig calibrate --drift`: does Psi still fit these captures, and the Psi that does.

Takes the calibration of any method. Parametric and mixed calibrations store the position of the
mask; to a free calibration's Psi the position is fitted here.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from emmc_rig.calibration.boards import Board
from emmc_rig.calibration.colours import mixing
from emmc_rig.calibration.defects import mask_with_losses
from emmc_rig.calibration.drift import Drift, DriftSettings, find_drift
from emmc_rig.calibration.fit import fit_placement
from emmc_rig.calibration.openings import views_open
from emmc_rig.calibration.parametric import SAMPLED, Stages, psi_at, shot_stages
from emmc_rig.calibration.placement import SCALARS, Placement, as_weights, with_aperture_mean_one
from emmc_rig.calibration.shadow import ANY_COLOUR, Shadow, ShadowMask, shadow_mask
from emmc_rig.errors import AppError
from emmc_rig.model.camera import camera_of, psi_layout
from emmc_rig.model.pupil import Pupil
from emmc_rig.model.reading import StoredArrays, stored_arrays
from emmc_rig.model.sensing import Psi
from emmc_rig.process.session_calibration import CALIBRATION_FILE
from emmc_rig.store.folders import refuse_missing
from emmc_rig.store.psi import FRAMES, PSI, read_frames
from emmc_rig.store.results import write_metrics

Array = NDArray[np.floating]


@dataclass(frozen=True, eq=False)
class Known:
    """A calibration on disk: Psi, its camera, and the position of the mask with its defects.

    seen: crosstalk, the share of each colour that every filter sees, (filter, colour); None without
    a measurement. colour: of every sensor pixel, (shot, pixel_y, pixel_x); None where pixels see
    all colours.
    """

    psi: Psi
    mask: ShadowMask
    placement: Placement
    stages: Stages
    seen: Array | None
    colour: NDArray[np.uint8] | None

    @property
    def seen_mask(self) -> ShadowMask:
        """The mask as the pixels see it in white light."""
        return self.mask if self.seen is None else mixing(self.mask, self.seen)

    def psi_after(self, placement: Placement) -> Psi:
        """Return Psi with the mask there."""
        shadow = Shadow(self.mask, placement)
        psi = psi_at(shadow, self.psi, self.stages)
        if self.seen is None or self.colour is None:
            return psi
        share = np.moveaxis(self.seen[self.colour], -1, 2)[:, None, None]
        return replace(psi, weights=(3 * share * psi.weights).astype(np.float32))


def read_calibration(folder: Path) -> Known:
    """Read the folder of a calibration; raises AppError when it is none, or damaged."""
    path = folder / CALIBRATION_FILE
    remedy = "name the folder of a calibration"
    refuse_missing(folder, remedy)
    if not path.is_file() or not (folder / PSI).is_file():
        raise AppError(f"{folder}: holds no {CALIBRATION_FILE} and {PSI}; {remedy}")
    psi = Psi.load(folder / PSI)
    camera = camera_of(psi)
    stages, k = shot_stages(camera), psi.binning
    placement = lost = seen = None
    with stored_arrays(path, AppError, "calibrate again") as stored:
        deviation = stored.array("deviation")
        good = stored.array("good").astype(bool) if "good" in stored else None
        if "aperture" in stored:
            placement = _stored_placement(stored)
        if "lost" in stored:
            lost = stored.array("lost")
        if "crosstalk" in stored:
            seen = stored.array("crosstalk")
    layout = psi_layout(camera, psi.size)
    colour = None if layout.colour is None else layout.colour[:, ::k, ::k]
    mask = shadow_mask(camera, psi.size)
    if placement is None:
        boards = _planes_as_boards(psi, deviation, good, colour, stages)
        seen_mask = mask if seen is None else mixing(mask, seen)
        placement = fit_placement(boards, camera, seen_mask).placement
    elif lost is not None:
        mask = mask_with_losses(mask, placement, lost)
    known = Known(psi, mask, placement, stages, seen, colour)
    return replace(known, placement=_with_views_of_psi(known))


def _stored_placement(stored: StoredArrays) -> Placement:
    """Return the placement in a calibration's file; older files know neither pupil nor rim.

    Raises KeyError or ValueError.
    """
    attributes, rows = stored.attributes, stored.array("aperture")
    later = ("pupil_", "rim_")
    names = [name for name in SCALARS if name in attributes or not name.startswith(later)]
    scalars = {name: float(np.asarray(attributes[name])) for name in names}
    pupil = Pupil.model_validate_json(str(attributes["pupil"])) if "pupil" in attributes else None
    return Placement(**scalars, aperture=as_weights(rows), pupil=pupil)


def _pixel_coefficients(psi: Psi, values: Array) -> Array:
    """Return coefficients of the first shot by pixel, (v, u, stored colour, pixel_y, pixel_x).

    Each as what a white board before that view alone reads.
    """
    _, v, u, rows, stored, columns = values.shape
    k = psi.binning
    shape = (v, u, rows // k, k, stored, columns // k, k)
    return np.moveaxis(values[0].reshape(shape).sum(axis=(3, 6)), 3, 2)


def _planes_as_boards(
    psi: Psi,
    deviation: Array,
    good: NDArray[np.bool_] | None,
    colour: NDArray[np.uint8] | None,
    stages: Stages,
) -> list[Board]:
    """Return every view's coefficients as the whiteboard that measured them."""
    values, spread = (_pixel_coefficients(psi, item) for item in (psi.weights, deviation))
    stored = values.shape[2]
    if colour is not None and stored > 1:
        # Three colours by crosstalk: what white light gives is their sum.
        values, spread, stored = values.sum(2, keepdims=True), spread.sum(2, keepdims=True), 1
    boards = []
    for v, u, c in np.ndindex(*values.shape[:2], stored):
        opened = views_open(psi.views, (v, u))
        reading, sure = stored * values[v, u, c], stored * spread[v, u, c]
        variance = np.square(sure) + 1e-12
        if good is not None:
            variance = np.where(good, variance, np.inf)
        channels = np.full(reading.shape, c, np.uint8) if colour is None else colour[0]
        seen = reading.astype(np.float32), variance.astype(np.float32), channels
        boards.append(Board(f"view ({v}, {u})", *seen, opened, stages[0], 0))
    return boards


def _with_views_of_psi(known: Known) -> Placement:
    """Return the placement with the brightness of Psi's own views.

    An uneven white board is taken out of Psi, but not of the placement fitted to it.
    """
    coefficients = _pixel_coefficients(known.psi, known.psi.weights).sum(axis=2)
    rng = np.random.default_rng(0)
    pixels = np.stack([rng.integers(n, size=SAMPLED) for n in coefficients.shape[2:]], axis=1)
    y, x = pixels.T
    channels = np.full(SAMPLED, ANY_COLOUR, np.uint8)
    if known.colour is not None:
        channels = known.colour[0, y, x]
    shadow = Shadow(known.seen_mask, known.placement)
    model = shadow.coefficients(pixels, channels, known.stages[0])
    ratio = coefficients[:, :, y, x].sum(axis=-1) / model.sum(axis=0)
    weights = as_weights(np.array(known.placement.aperture) * ratio)
    return with_aperture_mean_one(replace(known.placement, aperture=weights))


def run_drift(
    known_folder: Path, frames_folder: Path, out: Path, settings: DriftSettings | None = None
) -> dict:
    """Judge the frames of a folder against a calibration; write psi.h5 mended, and metrics.json.

    The mended Psi is written even where nothing has drifted: it is then the calibration's own.
    Raises AppError where the mask is beyond what was searched, or not recognised.
    """
    known = read_calibration(known_folder)
    capture = read_frames(frames_folder)
    if capture.readings.shape != known.psi.frames_shape:
        found, expected = (
            "{} frames of {} x {} pixels".format(*shape)
            for shape in (capture.readings.shape, known.psi.frames_shape)
        )
        raise AppError(f"{frames_folder / FRAMES}: {found}; this calibration is for {expected}")
    taken = capture.of_one_deviation()
    drift = find_drift(
        taken, known.colour, known.seen_mask, known.placement, known.stages, settings
    )
    if drift.refused:
        raise AppError(f"{frames_folder}: {drift.words}")
    mended = known.psi_after(drift.placement) if drift.drifted else known.psi
    mended.save(out / PSI)
    figures = _figures(drift)
    write_metrics(out, figures)
    return figures


def _figures(drift: Drift) -> dict:
    return {
        "drifted": drift.drifted,
        "words": drift.words,
        "recognised": drift.recognised,
        "displacement_px": drift.displacement_px,
        "by_kind_px": drift.by_kind_px,
        "values": drift.values,
        "deviations": drift.deviations,
        "chi2": drift.chi2,
        "probability": drift.probability,
        "status": drift.status,
    }
