"""How many whiteboards of which kind to take, and the plan that `emmc-rig capture` executes."""

from __future__ import annotations

from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml

from emmc_rig.calibration.openings import parts
from emmc_rig.calibration.placement import Placement, designed_placement
from emmc_rig.calibration.planning import (
    FEW_MODEL_ERROR,
    MODEL_ERROR,
    MOST_FRAMES,
    REFERENCE_FRAMES,
    Kind,
    Light,
    PlannedFrames,
    plan_combined,
    plan_parametric,
)
from emmc_rig.calibration.shadow import ShadowMask, shadow_mask
from emmc_rig.captures.expand import expand
from emmc_rig.captures.plan import (
    METERING_EXPOSURE_S,
    Boards,
    Darks,
    OpenBoard,
    Plan,
    PlannedShot,
)
from emmc_rig.errors import AppError
from emmc_rig.model.camera import Camera
from emmc_rig.store.results import write_metrics

PLAN = "plan.yaml"
PLAN_HEAD = """\
# Whiteboards of every view and of all together, then shots: capture this plan, then calibrate or
# reconstruct its session.
"""
METERING_DARKS, BOARD_DARKS, SHOT_DARKS = 2, 1, 2
LAMP_CHECKS, COLOUR_REPEATS, TURNED_REPEATS = 6, 2, 2
TURNS_DEG = 90.0, 180.0, 270.0
STAGE_KINDS_UM = ((0.0, 0.0), (270.0, 162.0))
MORE_STAGES_UM = ((-151.0, 293.0), (133.0, -245.0))
"""Beside them where the aperture stays open: the mask's moves show single views in their sums."""
VERIFY_UM = (-207.0, 118.0)
"""Where the mask stage has not been before: the whiteboards to judge by."""
SERIES_SHARES = (0.25, 0.5, 0.75)
"""Of a reference's exposure: they show whether the response is linear."""
BOARD_LEVEL = 0.7
"""Of the sensor's range, that a whiteboard without masks fills."""


WATCHES = {
    "lamp": "open whiteboards between the others, and the reference again at the end",
    "response": "references at several exposures",
    "colours": "references under red, green and blue lamps",
    "turned": "the white board turned by 90, 180 and 270 degrees",
    "aperture": "whiteboards of single views, or of parts of the aperture",
    "mask": "whiteboards with the mask moved",
}
"""Whiteboards that may be left out of a plan; all but the last two show errors of other parts than
the mask."""


@dataclass(frozen=True)
class PlanSettings:
    """What to plan whiteboards for: camera, size, and the relative error of Psi.

    most_frames: of the plan, None: as many as it takes. skip: names of WATCHES that the rig
    cannot take. few: plan for the fitted mask alone, without the pinhole before every view.
    """

    camera_name: str
    camera: Camera
    size: tuple[int, int]
    target: float = 0.005
    most_frames: int | None = None
    skip: frozenset[str] = frozenset()
    few: bool = False

    def __post_init__(self) -> None:
        for name in sorted(self.skip):
            if name not in WATCHES:
                raise AppError(f"skip {name}: use some of {', '.join(WATCHES)}")

    @property
    def moves_masks(self) -> bool:
        """Whether whiteboards are planned with the mask elsewhere, too."""
        return bool(self.camera.moving_masks) and "mask" not in self.skip


def plan_light(camera: Camera, mask: ShadowMask) -> Light:
    """Return what the plan counts on: the exposure of a whiteboard, and how many pixels see it."""
    rows, columns = mask.pixel_shape()
    noise = camera.sensor.noise
    light = (1 if camera.sensor.cfa_name != "mono" else 3) * camera.sensor.binning**2
    range_electrons = (noise.white_level_dn - noise.black_level_dn) / noise.gain_dn_per_electron
    board_s = BOARD_LEVEL * range_electrons / (noise.electrons_per_s * light)
    return Light(noise, board_s, camera.views, light, rows * columns)


def soft_design(camera: Camera, mask: ShadowMask) -> Placement:
    """Return the design with edges as soft as a bench's may be: what a plan is made for."""
    return replace(designed_placement(camera), blur_um=0.1 * mask.cell_um)


def capture_plan(settings: PlanSettings, planned: PlannedFrames) -> Plan:
    """Return the plan of a capture: whiteboards for every method, and the camera's shots."""
    through = {kind.pinhole: count for kind, count in planned.counts.items() if kind.pinhole}
    repeats = max(through.values(), default=1)
    every = len(through) == settings.camera.views_measured().sum()
    fitted = [
        OpenBoard(mask_um=kind.stage_um, window=kind.window, repeats=count)
        for kind, count in planned.counts.items()
        if kind.pinhole is None
    ]
    judged_um = ((0.0, 0.0), VERIFY_UM) if settings.moves_masks else ((0.0, 0.0),)
    judging = [OpenBoard(mask_um=place_um, validation=True) for place_um in judged_um]
    coloured = camera_colours(settings.camera) and "colours" not in settings.skip
    return Plan(
        title=f"{settings.camera_name}, to calibrate to {settings.target:.2%}",
        camera=settings.camera_name,
        shots=tuple(PlannedShot(exposure_s="auto") for _ in settings.camera.shots),
        whiteboards=Boards(
            views="all" if every else tuple(sorted(through)),
            shots=(0,),
            repeats=repeats,
            references=REFERENCE_FRAMES,
            open=(*fitted, *judging),
            lamp_checks=0 if "lamp" in settings.skip else LAMP_CHECKS,
            response=() if "response" in settings.skip else SERIES_SHARES,
            colours=COLOUR_REPEATS if coloured else 0,
            turned=0 if "turned" in settings.skip else TURNED_REPEATS,
            turns_deg=TURNS_DEG,
        ),
        darks=Darks(
            exposure_s=(METERING_EXPOSURE_S,),
            repeats=METERING_DARKS,
            of_boards=BOARD_DARKS,
            of_shots=SHOT_DARKS,
        ),
    )


def camera_colours(camera: Camera) -> bool:
    """Return whether the sensor's pixels see one colour each, so that crosstalk matters."""
    return camera.sensor.cfa_name != "mono" and camera.sensor.binning == 1


def frames_by_kind(settings: PlanSettings, planned: PlannedFrames) -> Counter[str]:
    """Return how many frames of each kind a capture takes before the shots of the scene."""
    frames = expand(capture_plan(settings, planned), settings.camera, 0.0, 0.0)
    return Counter(frame.kind for frame in frames if frame.kind != "shot")


def combined_plan(settings: PlanSettings, mask: ShadowMask, light: Light) -> PlannedFrames:
    """Return the whiteboards for all methods in one: the same number of every view, and open ones.

    Raises AppError, with the best there is, where the error asked for cannot be reached with the
    frames that the settings allow (default: MOST_FRAMES before every view).
    """
    camera, most_frames, target = settings.camera, settings.most_frames, settings.target
    stages = STAGE_KINDS_UM if settings.moves_masks else STAGE_KINDS_UM[:1]
    opened = {Kind(None, stage): 2 for stage in stages}
    views = [Kind((int(v), int(u))) for v, u in np.argwhere(camera.views_measured())]
    least = PlannedFrames(opened | dict.fromkeys(views, 1), 0.0)
    others = frames_by_kind(settings, least).total() - len(views)
    most = MOST_FRAMES if most_frames is None else (most_frames - others) // len(views)
    if most < 1:
        raise AppError(
            f"{most_frames} frames: a plan opens each of the {len(views)} views at least once, "
            f"and takes {others} frames besides: allow {len(views) + others} or more, or skip "
            "whiteboards of some kinds"
        )
    soft = soft_design(camera, mask)
    planned = plan_combined(mask, soft, light, target, most)
    if planned.expected_error > target:
        raise AppError(
            f"a relative error of Psi of {target:.3%} cannot be reached"
            f"{'' if most_frames is None else f' with {most_frames} frames'}: the best is "
            f"{planned.expected_error:.3%}, with {others + most * len(views)} frames; raise "
            f"the target{'' if most_frames is None else ' or the number of frames'}"
        )
    return replace(planned, counts={**opened, **planned.counts})


def few_plan(settings: PlanSettings, mask: ShadowMask, light: Light) -> PlannedFrames:
    """Return the fewest whiteboards for parametric methods: open ones and parts of the aperture.

    Raises AppError, with the best there is, where the error asked for cannot be reached with the
    frames that the settings allow (default: MOST_FRAMES whiteboards).
    """
    camera, target = settings.camera, settings.target
    stages = STAGE_KINDS_UM if settings.moves_masks else STAGE_KINDS_UM[:1]
    whole = "aperture" in settings.skip
    if whole and settings.moves_masks:
        stages = STAGE_KINDS_UM + MORE_STAGES_UM
    kinds = [Kind(None, stage) for stage in stages]
    kinds += [] if whole else [Kind(None, window=window) for window in parts(camera.views)]
    others = frames_by_kind(settings, PlannedFrames(dict.fromkeys(kinds, 1), 0.0)).total()
    others -= len(kinds)
    most = MOST_FRAMES if settings.most_frames is None else settings.most_frames - others
    soft = soft_design(camera, mask)
    planned = plan_parametric(
        mask, soft, kinds, light, target, most=most, model_error=FEW_MODEL_ERROR
    )
    taken = sum(planned.counts.values())
    if taken > max(most, 0) or planned.expected_error > target:
        raise AppError(
            f"a relative error of Psi of {target:.3%} cannot be reached by few whiteboards: the "
            f"best is {planned.expected_error:.3%}, with {others + taken} frames; raise the "
            f"target or the frames, or plan {'the aperture' if whole else 'every view'}, too"
        )
    return planned


def write_plan(settings: PlanSettings, folder: Path) -> dict:
    """Write plan.yaml, for `emmc-rig capture`, and metrics.json: how many whiteboards of which
    kind reach the target. Raises AppError where none do.

    A plan of few whiteboards that would take more frames than one of every view gives way to it.
    """
    camera = settings.camera
    mask = shadow_mask(camera, settings.size)
    light = plan_light(camera, mask)
    whole = "aperture" in settings.skip
    few, more = settings.few or whole, 0
    planned = (few_plan if few else combined_plan)(settings, mask, light)
    counts = frames_by_kind(settings, planned)
    if few and not whole:
        # The frames allowed may be too few to open every view.
        with suppress(AppError):
            every = combined_plan(settings, mask, light)
            of_every = frames_by_kind(settings, every)
            if of_every.total() < counts.total():
                few, more = False, counts.total()
                planned, counts = every, of_every
    metrics = {
        "camera": settings.camera_name,
        "size": list(settings.size),
        "target_relative_error": settings.target,
        "model_error": FEW_MODEL_ERROR if few else MODEL_ERROR,
        "few_would_take_frames": more or None,
        "exposures": {
            "open_s": light.exposure_s,
            "pinhole_s": light.exposure_s * camera.open_views(),
        },
        "whiteboards": [
            {
                "pinhole": None if kind.pinhole is None else list(kind.pinhole),
                "stage_um": list(kind.stage_um),
                "window": list(kind.window),
                "frames": count,
            }
            for kind, count in planned.counts.items()
        ],
        "frames_by_kind": dict(counts),
        "frames": counts.total(),
        "shots": len(camera.shots),
        "left_out": {name: WATCHES[name] for name in sorted(settings.skip)},
        "expected_relative_error": planned.expected_error,
    }
    to_capture = capture_plan(settings, planned).model_dump(mode="json", exclude_defaults=True)
    text = yaml.safe_dump(to_capture, sort_keys=False, default_flow_style=None)
    (folder / PLAN).write_text(PLAN_HEAD + text, encoding="utf-8")
    write_metrics(folder, metrics)
    return metrics
