"""Light fields as folders of `view_ROW_COL.png`, for tests."""

from pathlib import Path

import numpy as np

from emmc_rig.formats.format import Export
from emmc_rig.formats.registry import FORMATS


def save_views(folder: Path, light_field: np.ndarray) -> None:
    """Write the views, 8 bits, into a folder that is made where missing."""
    folder.mkdir(parents=True, exist_ok=True)
    FORMATS["png8"].write(folder, Export("", "", light_field))
