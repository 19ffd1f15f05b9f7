"""Settings of the shipped methods together; other methods add their own part when they are read."""

from __future__ import annotations

from typing import TypeVar

from pydantic import Field

from emmc_rig.model.settings import Settings
from emmc_rig.reconstruction.adaptive.film import FilmSettings
from emmc_rig.reconstruction.adaptive.settings import AdaptiveSettings
from emmc_rig.reconstruction.sparse import SparseSettings
from emmc_rig.reconstruction.tv import TVSettings

Part = TypeVar("Part", bound=Settings)


class BlockSettings(Settings):
    """The grid of blocks of a large light field, see `reconstruction.tiles`: part of the method."""

    whole: int = Field(
        default=2**19, ge=1, description="samples up to which a light field is one block"
    )
    side: int = Field(default=384, ge=16, description="rows and columns of a block, at most")
    blend: int = Field(
        default=16, ge=1, description="samples to both sides over which neighbours are averaged"
    )


class ShippedSettings(Settings):
    """Settings of every method; each takes its own part.

    screening: whether frames are screened first, see `reconstruction.screening`.
    """

    screening: bool = True
    blocks: BlockSettings = Field(default_factory=BlockSettings)
    tv: TVSettings = Field(default_factory=TVSettings)
    sparse: SparseSettings = Field(default_factory=SparseSettings)
    adaptive: AdaptiveSettings = Field(default_factory=AdaptiveSettings)
    film: FilmSettings = Field(default_factory=FilmSettings)

    def of(self, kind: type[Part]) -> Part:
        """Return the part of a type: a method's own, which no field above names."""
        return next(part for _, part in self if type(part) is kind)
