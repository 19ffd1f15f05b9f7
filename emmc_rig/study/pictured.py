"""Studies whose points have pictures: thumbnails beside the journal, and how a page shows them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.files import whole_file
from emmc_rig.model.lightfield import centre_view, epi_horizontal
from emmc_rig.pages.page import embedded
from emmc_rig.pages.pictures import epipolar_lines
from emmc_rig.study.points import NotApplicableError, Study
from emmc_rig.study.rows import dictionary_identity, digest_of, machine
from reconstruction.methods import METHODS

PICTURES = "pictures"
LARGEST_PX = 256
P = TypeVar("P")


def save_thumbnail(path: Path, light_field: NDArray, line: int) -> None:
    """Write the centre view over the epipolar image of a row, as WebP. Raises OSError."""
    done, data = cv2.imencode(".webp", _composed(light_field, line), [cv2.IMWRITE_WEBP_QUALITY, 90])
    assert done
    with whole_file(path) as partial:
        partial.write_bytes(data.tobytes())


def _composed(light_field: NDArray, line: int) -> NDArray[np.uint8]:
    """Return the centre view over an epipolar image, as 8-bit BGR.

    Light is shown with the display's gamma; pixels are repeated, never blurred.
    """
    centre = centre_view(light_field)
    height, width = centre.shape[:2]
    left = max(0, (width - LARGEST_PX) // 2)
    top = min(max(0, line - LARGEST_PX // 2), max(0, height - LARGEST_PX))
    across = slice(left, left + LARGEST_PX)
    view = centre[top : top + LARGEST_PX, across]
    scale = max(1, round(320 / view.shape[1]))
    view = view.repeat(scale, axis=0).repeat(scale, axis=1)
    lines = epi_horizontal(light_field, light_field.shape[0] // 2, line)
    epi = lines[:, across].repeat(8, axis=0).repeat(scale, axis=1)
    gap = np.ones((6, view.shape[1], 3), dtype=view.dtype)
    stacked = np.clip(np.concatenate([view, gap, epi]), 0, 1) ** (1 / 2.2)
    return np.ascontiguousarray(np.rint(stacked[..., ::-1] * 255).astype(np.uint8))


@dataclass
class PicturedStudy(Study[P]):
    """A study of methods whose points keep a thumbnail of what was reconstructed, and the truth."""

    def picture(self, point: P) -> Path:
        """Return where the picture of a point is kept."""
        return self.folder / PICTURES / f"{self.digest(point)}.webp"

    def truth_picture(self, point: P) -> Path:
        """Return where the picture of what should have been reconstructed is kept."""
        return self.folder / PICTURES / f"{digest_of(self.trial_inputs(point))}-truth.webp"

    def trial_inputs(self, point: P) -> dict[str, object]:
        """Return what the truth of a point depends on, as plain data."""
        raise NotImplementedError

    def method_inputs(self, name: str) -> dict[str, object]:
        """Return what any method's figures depend on: machine, method, dictionary.

        Raises NotApplicableError for a method that is not installed.
        """
        method = METHODS[name]
        if not method.installed:
            raise NotApplicableError(f"{method.name} needs {method.package}: not installed")
        dictionary = self.settings.dictionary
        return {
            "machine": machine(),
            "method": method.name,
            "dictionary": dictionary_identity(dictionary) if method.needs_dictionary else None,
        }

    def is_whole(self, point: P, result: dict) -> bool:
        """Return whether a point that has figures has its picture."""
        return "failed" in result or self.picture(point).is_file()


def save_pair(picture: Path, truth_picture: Path, estimate: NDArray, truth: NDArray) -> None:
    """Write the thumbnail of an estimate, and of the truth where there is none yet."""
    line = epipolar_lines(truth)[0]
    picture.parent.mkdir(exist_ok=True)
    save_thumbnail(picture, estimate, line)
    if not truth_picture.exists():
        save_thumbnail(truth_picture, truth, line)


@dataclass(frozen=True)
class ShownMark:
    """What a page shows of a mark: a heading, a line, and pictures.

    pairs: a line, the picture of the reconstruction and that of the truth.
    """

    label: str
    words: str
    pairs: Sequence[tuple[str, Path, Path]]


def marks_data(marks: Mapping[str, ShownMark]) -> dict[str, object]:
    """Return what chart.js reads, see `framed`; marks: by their names in the drawings."""
    points = {
        name: {
            "label": mark.label,
            "words": mark.words,
            "pictures": [
                {"words": words, "estimate": estimate.name, "truth": truth.name}
                for words, estimate, truth in mark.pairs
            ],
        }
        for name, mark in marks.items()
    }
    paths = {path.name: path for mark in marks.values() for pair in mark.pairs for path in pair[1:]}
    return {"points": points, "pictures": {name: embedded(path) for name, path in paths.items()}}
