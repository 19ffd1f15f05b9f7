"""Normalised readings of a session's shots: brackets fused, one frame in memory at a time."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.bracket import LinearFrame, fuse
from calibration.frames import MeanFrame, SensorGain
from emmc_rig.errors import AppError
from emmc_rig.model.sensing import ImagingMatrix
from emmc_rig.session.frame_means import camera_of, decoded
from emmc_rig.session.measured_psi import Scale, session_scale
from emmc_rig.session.planned import PlannedFrame
from emmc_rig.session.session import Session


@dataclass(frozen=True, eq=False)
class SessionReadings:
    """What was captured, normalised as Psi is, all (shot, y, x).

    readings: see `Frames`. variance: of the readings; infinite where not usable.
    """

    psi: ImagingMatrix
    readings: NDArray[np.float32]
    variance: NDArray[np.float32]
    usable: NDArray[np.bool_]

    @property
    def noise_sigma(self) -> float:
        """Root mean variance of the usable readings, which solvers take as their typical noise."""
        usable = self.variance[self.usable]
        return float(np.sqrt(np.mean(usable, dtype=np.float64))) if usable.size else 0.0


def shot_frames(session: Session) -> dict[int, list[PlannedFrame]]:
    """Return the frames of each shot of the scene that is needed: its bracket and repeats."""
    shots: dict[int, list[PlannedFrame]] = defaultdict(list)
    for frame in session.needed:
        if frame.kind == "shot":
            shots[frame.bench.shot].append(frame)
    return dict(sorted(shots.items()))


def fused_shot(
    session: Session,
    frames: list[PlannedFrame],
    darks: Sequence[MeanFrame],
    gain: SensorGain,
) -> LinearFrame:
    """Return a shot's bracket as one linear frame, at a gain of 1."""
    mosaics, exposures_s, white_dn = [], [], 0
    for frame, exposure_s in decoded(session, frames):
        mosaics.append(frame.mosaic)
        exposures_s.append(exposure_s)
        white_dn = frame.white_level_dn
    amplified = {frame.gain for frame in frames}
    if len(amplified) > 1:
        raise AppError(f"{session.folder}: the gain differs within one shot; plan it alike")
    factor = amplified.pop()
    if factor == 1:
        return fuse(mosaics, exposures_s, darks, gain, white_dn)
    # The signal above the black grows with the gain, its shot noise per DN too.
    amplified_gain = SensorGain(
        gain.gain_dn_per_electron * factor, gain.dark_variance_dn2 * factor**2
    )
    black = np.mean(session.stored[frames[0].id].black_level_dn)
    lifted = [
        replace(
            dark,
            mean_dn=(black + factor * (dark.mean_dn - black)).astype(np.float32),
            variance_dn2=dark.variance_dn2 * factor**2,
            extra_variance_dn2=dark.extra_variance_dn2 * factor**2,
        )
        for dark in darks
    ]
    fused = fuse(mosaics, exposures_s, lifted, amplified_gain, white_dn)
    return LinearFrame(fused.dn_per_s / factor, fused.variance / factor**2, fused.usable)


def taken_shots(session: Session) -> tuple[int, ...]:
    """Return the shots of the scene that the session needs, by their place in the plan."""
    return tuple(sorted({f.bench.shot for f in session.needed if f.kind == "shot"}))


def camera_json_of(session: Session, shots: Sequence[int]) -> str:
    """Return the camera with some of its shots alone, as `ImagingMatrix.camera_json`.

    "" where no camera is made of them: where a mask shows another pattern in every shot.
    """
    camera = camera_of(session)
    count = len(camera.shots)
    if any(mask.pattern.frame_count(count) > 1 for mask in camera.masks.values()):
        return ""
    exposures_s = camera.exposures_s()
    chosen = [
        camera.shots[shot].model_copy(update={"exposure_s": float(exposures_s[shot])})
        for shot in shots
    ]
    return camera.model_copy(update={"shots": tuple(chosen)}).model_dump_json()


def scaled_readings(session: Session, scale: Scale, shots: Sequence[int]) -> SessionReadings:
    """Return what some shots read, and their Psi, in the order given."""
    whole = list(shots) == list(range(scale.psi.shots))
    psi = scale.psi if whole else scale.psi.of_shots(shots, camera_json_of(session, shots))
    frames = shot_frames(session)
    readings = np.empty(psi.frames_shape, dtype=np.float32)
    variance = np.empty(psi.frames_shape, dtype=np.float32)
    usable = np.empty(psi.frames_shape, dtype=bool)
    for place, shot in enumerate(shots):
        linear = fused_shot(session, frames[shot], scale.darks, scale.gain)
        seen = scale.white_dn_per_s[shot] > 0
        white = np.where(seen, scale.white_dn_per_s[shot], 1.0)
        readings[place] = linear.dn_per_s / white
        variance[place] = linear.variance / white**2
        usable[place] = linear.usable & seen & scale.good
        # What a pixel that is not to be used reads says nothing, not even how much at least.
        readings[place] *= seen & scale.good
    return SessionReadings(psi, readings, variance, usable)


def session_readings(session: Session) -> SessionReadings:
    """Return what the shots read that a session needs, by the Psi of its whiteboards.

    Raises AppError or CalibrationError.
    """
    return scaled_readings(session, session_scale(session), taken_shots(session))
