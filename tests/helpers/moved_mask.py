"""A camera of 3x3 views whose one random mask is moved between two shots."""

from emmc_rig.model.camera import Camera

CAMERA = Camera.model_validate(
    {
        "title": "test",
        "views": [3, 3],
        "lens": {"aperture_cell_mm": 8.0},
        "sensor": {"cfa": "rggb"},
        "masks": {"code": {"distance_mm": 0.12, "cell_um": 36, "pattern": {"kind": "random_rgbw"}}},
        "more_shots_step_um": {"code": (270, 162)},
    }
)
