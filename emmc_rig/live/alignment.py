"""How the mask lies before the sensor, from one frame: what the live page shows of it.

`calibration.locator` locates the shadow. Nothing is returned that the frame does not decide.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from emmc_rig.calibration.boards import Board, channels_of
from emmc_rig.calibration.errors import CalibrationError
from emmc_rig.calibration.locator import Location, frame_board, locate, refine, starting_placement
from emmc_rig.calibration.openings import views_open
from emmc_rig.calibration.placement import Placement
from emmc_rig.calibration.shadow import shadow_mask
from emmc_rig.drivers.raw import RawFrame
from emmc_rig.model.camera import Camera, psi_layout
from emmc_rig.session.brightness import is_dark

WANTED_DEG, WANTED_SHARE = 0.1, 1e-3
"""A figure with a larger deviation is not shown."""


@dataclass(frozen=True)
class MaskPlace:
    """Where the mask's shadow lies against the design's; every figure with its deviation.

    rotation_deg: of the mask, counterclockwise in the picture. scale: 1 as designed; the shadow
    cannot distinguish a stretched mask from one at another distance. offset_um: of the mask, x and
    y, from the place that the stage states; None for a uniform pattern. correlation: of frame and
    shadow, up to 1. ambiguity: what the offset leaves open, in words, "" for nothing.
    """

    rotation_deg: float
    rotation_deviation_deg: float
    scale: float
    scale_deviation: float
    offset_um: tuple[float, float] | None
    offset_deviation_um: float
    correlation: float
    ambiguity: str = ""


class MaskGauge:
    """Measures where the mask of a design lies in frames of one size; raises CalibrationError
    where frames of this design show no mask's shadow to measure.
    """

    def __init__(self, camera: Camera, pixels: tuple[int, int]) -> None:
        self._camera, self._pixels = camera, pixels
        k = camera.sensor.binning
        size = pixels[0] * k, pixels[1] * k
        self._mask = shadow_mask(camera, size)
        self._start = starting_placement(camera, self._mask)
        self._layout = psi_layout(camera, size)
        self._last: Placement | None = None

    def measure(
        self, frame: RawFrame, stage_um: tuple[float, float] = (0.0, 0.0), shot: int = 0
    ) -> MaskPlace:
        """Return where the mask lies in a frame.

        stage_um: where the mask stage stands, x and y, from where it centres the mask. shot: of
        the camera, whose filter is in. Raises CalibrationError with the reason where the frame
        does not show.
        """
        board = self._board(frame, stage_um, shot)
        if self._last is not None:
            last, self._last = self._last, None
            with suppress(CalibrationError):
                return self._followed(
                    refine(board, self._mask, last, half_px=max(self._pixels) / 2)
                )
        try:
            found = locate(board, self._mask, self._start)
        except CalibrationError as fault:
            raise CalibrationError(
                f"the mask's shadow is not seen; if this is a white board: {fault}"
            ) from fault
        return self._followed(found)

    def _board(self, frame: RawFrame, stage_um: tuple[float, float], shot: int) -> Board:
        if frame.mosaic.shape != self._pixels:
            raise CalibrationError(
                f"the frame has {frame.mosaic.shape[0]}x{frame.mosaic.shape[1]} pixels instead of "
                f"{self._pixels[0]}x{self._pixels[1]}: set the camera back to its whole frame"
            )
        expected = self._camera.sensor.cfa_name
        if frame.cfa != expected:
            raise CalibrationError(
                f"the camera's colour filters are {frame.cfa}, the design's {expected}: choose the "
                "design of this camera"
            )
        if is_dark(frame):
            raise CalibrationError("the picture is dark")
        channels = channels_of(self._layout, shot)
        opening = views_open(self._mask.views, None), stage_um, shot
        black_dn = frame.black_by_place()
        return frame_board(frame.mosaic, black_dn, frame.white_level_dn, channels, opening)

    def _followed(self, found: Location) -> MaskPlace:
        """Return what is shown of a location, from which the next frame begins.

        Raises CalibrationError where it is too uncertain.
        """
        turn = float(np.degrees(found.deviations["rotation_rad"]))
        stretch = found.deviations["scale"]
        if turn > WANTED_DEG or stretch > WANTED_SHARE:
            raise CalibrationError(
                f"the mask's rotation is known to {turn:.2g} degrees and its scale to "
                f"{100 * stretch:.2g} % only: look at a white board, expose longer"
            )
        self._last = found.placement
        repeats = self._mask.repeats
        return MaskPlace(
            -float(np.degrees(found.placement.rotation_rad)),
            turn,
            found.placement.scale,
            stretch,
            None if repeats.uniform else found.offset_um,
            found.offset_deviation_um,
            found.correlation,
            repeats.words,
        )
