"""Parts of a numerical check: a small capture, a method's attempt on it, and a finding."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from emmc_rig.files.cameras import find_camera
from emmc_rig.files.dictionaries import open_dictionary
from emmc_rig.model.errors import ModelError
from emmc_rig.model.lightfield import psnr_db
from emmc_rig.study.stability.trial import Setup, Trial, trial_of
from reconstruction.errors import ReconstructionError
from reconstruction.methods import METHODS, MethodSettings, reconstruct
from reconstruction.result import Reconstruction

SOUND, WEAK, BROKEN = "sound", "weak", "broken"
SCENE, SIZE, VIEWS, ZOOM = "near-planar", (24, 32), (3, 3), 6


@dataclass(frozen=True)
class Finding:
    """One check. figure: what was measured, in words. verdict: sound, weak or broken."""

    name: str
    figure: str
    verdict: str
    meaning: str


@dataclass(frozen=True)
class Attempt:
    """What a method made of a capture: its PSNR, or why there is none.

    refused: the error's line, "" where it ran. db: NaN where it did not run or is not finite.
    """

    db: float
    refused: str = ""

    @property
    def words(self) -> str:
        """Return it for a table."""
        if self.refused:
            return "refused"
        return f"{self.db:.2f}" if math.isfinite(self.db) else "not finite"


def example(camera: str = "rgbw-bayer-1shot", shots: int = 1, binning: int = 1) -> Trial:
    """Return a small noisy capture of a built-in scene."""
    chosen = find_camera(camera)
    sensor = chosen.sensor.model_copy(update={"binning": binning})
    chosen = chosen.with_shots(shots).model_copy(update={"views": VIEWS, "sensor": sensor})
    return trial_of(Setup(SCENE, chosen, SIZE, zoom=ZOOM))


def solved(trial: Trial, method: str, settings: MethodSettings | None = None) -> Reconstruction:
    """Return a method's reconstruction of a trial; raises ReconstructionError."""
    psi = trial.psi
    dictionary = None
    if METHODS[method].needs_dictionary:
        dictionary = open_dictionary(None, psi.light_field_shape[:2], psi.binning)
    return reconstruct(
        method, psi, trial.readings, trial.noise_sigma, dictionary, settings, trial.usable
    )


def attempted(trial: Trial, method: str, scale: float = 1.0) -> Attempt:
    """Return the attempt of a method, its light field divided by `scale`."""
    try:
        found = np.clip(solved(trial, method).light_field.astype(np.float64) / scale, 0, 1)
    except (ReconstructionError, ModelError) as fault:
        return Attempt(math.nan, str(fault))
    if not np.isfinite(found).all():
        return Attempt(math.nan)
    return Attempt(psnr_db(found, trial.truth))
