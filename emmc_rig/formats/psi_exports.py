"""Psi as a sparse matrix, and its frames, in files that MATLAB, SciPy and NumPy read.

Rows are readings in the order (shot, pixel_y, pixel_x), columns samples of the light field in the
order (v, u, y, x, colour), the last index the fastest: Psi times a flattened light field are the
flattened frames.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
from scipy import sparse

from emmc_rig.errors import AppError
from emmc_rig.model.frames import Frames
from emmc_rig.model.sensing import Psi

LARGEST_MAT_BYTES = 2**31
"""Of a variable in a MAT file of version 5, the only one that SciPy writes."""
ORDER = "rows (shot, pixel_y, pixel_x), columns (v, u, y, x, colour), the last index the fastest"
IN_MATLAB = "; of light_field(v, u, y, x, colour) x = reshape(permute(light_field, 5:-1:1), [], 1)"
"""Columns first, as MATLAB has them."""


def write_npz(folder: Path, psi: Psi, frames: Frames | None) -> None:
    """Write psi.npz as `scipy.sparse.load_npz` reads it, layout.json, and frames.npz."""
    sparse.save_npz(folder / "psi.npz", psi.to_scipy())
    (folder / "layout.json").write_text(json.dumps(_layout(psi), indent=1) + "\n")
    if frames is not None:
        np.savez_compressed(folder / "frames.npz", **_arrays(frames))


def write_mat(folder: Path, psi: Psi, frames: Frames | None) -> None:
    """Write psi.mat: Psi, its layout, and columns of readings, deviation and usable.

    Raises AppError for a Psi that MAT files do not hold.
    """
    matrix = psi.to_scipy().astype(np.float64).tocsc()
    if matrix.data.nbytes >= LARGEST_MAT_BYTES:
        raise AppError(
            f"Psi has {matrix.nnz} entries, more than a MAT file holds: export npz, or a "
            "window of it"
        )
    # Of double precision: MATLAB does not multiply a sparse matrix with singles.
    columns = {} if frames is None else _arrays(frames)
    layout = _layout(psi)
    layout["order"] += IN_MATLAB
    scipy.io.savemat(
        folder / "psi.mat",
        {
            "Psi": matrix,
            **layout,
            **{name: values.reshape(-1, 1).astype(float) for name, values in columns.items()},
        },
        do_compression=True,
    )


def _arrays(frames: Frames) -> dict[str, Any]:
    return {
        "readings": frames.readings,
        "deviation": frames.deviation,
        "usable": frames.usable.astype(np.uint8),
    }


def _layout(psi: Psi) -> dict[str, Any]:
    return {
        "order": ORDER,
        "frames_shape": psi.frames_shape,
        "light_field_shape": psi.light_field_shape,
        "binning": psi.binning,
        "checksum": psi.checksum(),
    }


PSI_FORMATS: dict[str, Callable[[Path, Psi, Frames | None], None]] = {
    "npz": write_npz,
    "mat": write_mat,
}
