"""The settings of the adaptive method, and those of its fast variant."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, get_args

from pydantic import Field

from emmc_rig.model.settings import Settings
from emmc_rig.reconstruction.adaptive.joint import TextureSettings

Length = Annotated[float, Field(gt=0)]
Side = Literal["top", "bottom", "left", "right"]
SIDES: tuple[Side, ...] = get_args(Side)


class AdaptiveSettings(Settings):
    """Settings of the adaptive method.

    Twice and half of each cost what docs/results/constants.csv says, most the lengths of textures
    and the chrominance and threshold of the shrinkage (0.3 to 0.8 dB).
    """

    removed: ClassVar[tuple[str, ...]] = ("parsimony", "free", "rest", "views", "plane")

    furthest_px: float = Field(
        default=24.0, gt=0, description="largest disparity searched, to both sides"
    )
    step_px: float = Field(default=0.125, gt=0, description="between disparities compared")
    stride: int = Field(default=6, ge=1, description="pixels between patches that are compared")
    interleaved: bool = Field(
        default=True, description="compare a second grid of patches too, between the first"
    )
    second: bool = Field(default=True, description="search again, where disparities are wide")
    lengths_px: tuple[Length, ...] = Field(
        default=(3.0, 1.5), min_length=1, description="correlation lengths of a patch's texture"
    )
    slope_px: float = Field(
        default=0.04, gt=0, description="mean change of the disparity per pixel on one surface"
    )
    jump: float = Field(
        default=0.05, gt=0, lt=1, description="probability that neighbouring patches differ freely"
    )
    freedom: float = Field(
        default=3.0, gt=0, description="of the Student t of the readings; large: Gaussian"
    )
    misfit: float = Field(
        default=0.004, gt=0, description="deviation of readings that no disparity explains"
    )
    misfits: tuple[Length, ...] = Field(
        default=(0.004, 0.0015),
        min_length=1,
        description="deviation of readings that no texture explains, one for each fit",
    )
    nearer: Literal["larger", "smaller"] = Field(
        default="larger", description="disparity of what is in front; pictures may be flipped"
    )
    texture: TextureSettings = Field(default_factory=TextureSettings)
    start_steps: int = Field(
        default=13, ge=1, description="of total variation, from which textures begin"
    )
    patches: int | None = Field(
        default=2, ge=1, description="shots from which sparse patches are in the mean; none: never"
    )
    edges: tuple[Side, ...] = Field(
        default=SIDES, description="sides that may be dark because views do not reach them"
    )
    contrast: float | None = Field(
        default=None,
        gt=0,
        description="deviation of the values of the scene that this is a part of; None: its own",
    )

    def uses_patches(self, shots: int) -> bool:
        """Return whether sparse patches are in the mean of so many shots, whatever the scene."""
        return self.patches is not None and shots >= self.patches


def fast(settings: AdaptiveSettings) -> AdaptiveSettings:
    """Return the settings of `adaptive-fast`: one grid of patches, fewer disparities and steps.

    On crops of group A, patches 8 pixels apart instead cost 0.5 dB (96x96), a second search 0.03 dB
    (128x128).
    """
    quick = settings.texture.model_copy(
        update={"steps": 8, "refine_steps": 5, "shared_steps": 0, "block_step": 6, "sweeps": ()}
    )
    coarser = {"step_px": 0.25, "lengths_px": (2.0,), "interleaved": False}
    fewer = {"second": False, "patches": None, "texture": quick}
    return settings.model_copy(update=coarser | fewer)
