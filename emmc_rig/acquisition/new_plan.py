"""A commented plan for a camera, to be edited."""

from __future__ import annotations

from emmc_rig.acquisition.plan import schema_path
from emmc_rig.model.camera import Camera


def new_plan(name: str, camera: Camera) -> str:
    """Return the YAML of a plan that takes every shot of a camera, as the camera describes it."""
    rows, columns = camera.views
    shots = "\n".join(_shot(camera, place) for place in range(len(camera.shots)))
    return f"""\
# yaml-language-server: $schema={schema_path().as_uri()}
# A capture for `emmc-rig capture`. What stands behind a # is the default, or an example.

title: {name}
camera: {name}              # a shipped camera (`emmc-rig cameras`), or a YAML file beside this one

# The shots of the scene. Each takes masks, mask place and filter from the camera's own shot.
#   mask_um: [x, y]         moves the mask stage elsewhere; or in cells: mask_cells: [x, y]
#   exposure_s: auto        metered on the scene, see `metering`; or seconds
#   exposure_s: [0.004, 0.016, 0.064]   a bracket, fused to one linear frame with its variance
#   gain: 1   repeats: 1   lamp: white   camera_shot: which of the camera's shots this is
shots:
{shots}

# Before calibration: the pinhole before each of {rows} x {columns} views, and the open aperture
# without masks. `whiteboards: null` leaves them out.
whiteboards:
  views: all                # or a list: [[0, 0], [2, 2]]
  open:                     # masks in, whole aperture
    - {{held_out: true}}      # by which `emmc-rig calibrate` judges the Psi that it measures
    # - {{mask_um: [0, 0]}}   # for the parametric route: few frames, see `calibrate --plan`
  # lamps: [white]          # default: what the sensor needs
  repeats: 2
  references: 4
  level: 0.7                # of white, where metering aims; or exposure_s: of the references

metering:                   # of shots with exposure_s: auto
  level: 0.7                # of white, where the brightest readings come
  bracket: true             # longer exposures too, where most of the scene is far darker
  alike: true               # the same for all shots of one lamp and gain
  longest_s: 30

darks:
  exposure_s: [0.01]
  repeats: 4
  of_shots: 4               # at the longest exposure of the shots, for their dark current

order: least-travel         # or as-planned
settle_s: 0                 # after a move, beyond the stage's own

retries:
  per_frame: 4
  per_session: 200

checks:
  largest_saturated_share: 0.02
  smallest_signal: 0.002    # brightest pixels, 1 at white
  largest_dark: 0.05        # mean of a dark frame, 1 at white
  stage_um: 2.0             # read-back after the exposure
  registration_px: 0.5      # against the last good frame, on resuming
"""


def _shot(camera: Camera, place: int) -> str:
    offsets = [
        f"{name} at x {x:g}, y {y:g} um"
        for name, (x, y) in camera.shots[place].offset_um.items()
        if name in camera.shot_masks(place)
    ]
    chosen = camera.shots[place].filter
    notes = [*offsets, *([] if chosen == "none" else [f"{chosen} filter"])]
    line = "  - exposure_s: auto"
    return f"{line:<28}# {'; '.join(notes)}" if notes else line
