"""Whiteboards of the outside bench as calibration takes them: the only place that knows both."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from outside_bench import Bench, Optics

from emmc_rig.calibration.boards import BoardFrame, BoardSet
from emmc_rig.calibration.frames import average
from emmc_rig.calibration.shadow import shadow_mask
from emmc_rig.calibration.whiteboard import LAMP_COLOURS
from emmc_rig.model.camera import Camera

REPEATS = 4
OPEN_S = 0.15


def camera_of(optics: Optics, cfa: str = "rggb", pattern: Any = None) -> Camera:
    """Return the camera as its owner would describe it: the design, without what is wrong."""
    return Camera.model_validate(
        {
            "title": "Outside",
            "views": optics.views,
            "lens": {
                "distance_mm": optics.lens_um / 1e3,
                "aperture_cell_mm": optics.aperture_cell_um / 1e3,
            },
            "sensor": {"cfa": cfa, "sample_pitch_um": optics.pitch_um},
            "masks": {
                "mask": {
                    "distance_mm": optics.mask_um / 1e3,
                    "cell_um": optics.cell_um,
                    "pattern": pattern or {"kind": "random_rgbw", "seed": 1},
                }
            },
            "more_shots_step_um": {"mask": (60.0, 40.0)},
        }
    )


def bench_of(camera: Camera, size: tuple[int, int], **parts: Any) -> Bench:
    """Return the outside bench with the mask as designed; parts: optics, sensor, course, seed."""
    return Bench(shadow_mask(camera, size).cells[0, :, :, :3], size, **parts)


class Photographer:
    """Takes whiteboards of the outside bench in the order that a plan would."""

    def __init__(self, bench: Bench, repeats: int = REPEATS) -> None:
        self.bench, self.repeats = bench, repeats

    def mean(self, exposure_s: float, **how: Any) -> Any:
        """Return the mean of repeated frames."""
        frames = [self.bench.take(exposure_s, **how) for _ in range(self.repeats)]
        white, lit = self.bench.sensor.white_dn, how.get("lit", True)
        return average(frames, exposure_s, white, str(how), self.bench.clock_s, lit)

    def sets(
        self,
        open_um: Sequence[tuple[float, float]] = ((0, 0), (37, 11), (-23, 31)),
        held_um: Sequence[tuple[float, float]] = ((0, 0), (15, -21)),
        pinholes: Sequence[tuple[int, int]] = (),
        turns: Sequence[float] = (),
        colours: bool = False,
        loose: bool = False,
    ) -> dict[str, Any]:
        """Return held_out, few, pinholes and turned, as `calibrate` takes them.

        colours: whether the references are taken under coloured lamps as well. loose: whether the
        table says that hands put the pinhole.
        """
        views = self.bench.optics.views[0] * self.bench.optics.views[1]
        dark = [self.mean(OPEN_S, lit=False), self.mean(OPEN_S * views, lit=False)]
        lamps = ("white", "red", "green", "blue") if colours else ("white",)
        white = {(0, lamp): self.mean(OPEN_S, mask=None, lamp=lamp) for lamp in lamps}
        boards = BoardSet(tuple(dark), white, ())
        few = [BoardFrame.held(self.mean(OPEN_S, mask=at), at) for at in open_um]
        free = [
            BoardFrame.held(self.mean(OPEN_S * views, view=view), (0.0, 0.0), 0, view, loose=loose)
            for view in pinholes
        ]
        held = [BoardFrame.held(self.mean(OPEN_S, mask=at), at) for at in held_um]
        turned = {}
        for turn in turns:
            frame = BoardFrame.held(self.mean(OPEN_S, turned_deg=turn), (0.0, 0.0))
            even = {(0, "white"): self.mean(OPEN_S, turned_deg=turn, mask=None)}
            turned[turn] = BoardSet(tuple(dark), even, (frame,))
        return {
            "held_out": boards.with_frames(held),
            "few": boards.with_frames([*few, *free]),
            "pinholes": boards.with_frames(free) if len(free) == views else None,
            "turned": turned or None,
        }


def agreement(
    bench: Bench,
    weights: np.ndarray,
    deviation: np.ndarray,
    good: Any,
    mask: tuple[float, float] = (0.0, 0.0),
) -> dict[str, float]:
    """Return true and stated error of Psi, relative, and shares within one and two deviations.

    weights, deviation: (shot, v, u, y, stored colour, x), the first shot counts. mask: its true
    place. Of a Psi in three colours of a bench without crosstalk the sum counts.
    """
    if weights.shape[4] == 3 and bench.sensor.crosstalk:
        truth = np.stack([bench.psi_of(*mask, lamp) for lamp in LAMP_COLOURS], 3)
        off, stated = weights[0] - truth, deviation[0]
        good = np.asarray(good)[:, None]
    else:
        truth = bench.psi(*mask)
        off = weights[0].sum(3) - truth
        stated = np.sqrt(np.square(deviation[0]).sum(3))
    use = np.broadcast_to(good, truth.shape)
    off, stated = off[use], stated[use]
    scale = float(np.sqrt(np.mean(truth[use] ** 2)))
    return {
        "true": float(np.sqrt(np.mean(off**2))) / scale,
        "stated": float(np.sqrt(np.mean(stated**2))) / scale,
        "within_1": float(np.mean(np.abs(off) < stated)),
        "within_2": float(np.mean(np.abs(off) < 2 * stated)),
    }
