"""The cells of each table and figure: scenes, captures and methods."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal

from emmc_rig.errors import AppError
from emmc_rig.model.camera import Camera, shipped_cameras
from emmc_rig.model.errors import nearest_of
from emmc_rig.model.masks import AnyPattern, GaussianColour, RandomBinary, RandomRGBW, UniformColour
from emmc_rig.study.tables import paper
from emmc_rig.study.tables.paper import Scenario

METHODS = ("dict-admm", "tv-dict", "tv")
METHOD_TITLES = {"dict-admm": "Dict-ADMM", "tv-dict": "TV-Dict", "tv": "TV alone"}
SCENARIOS: dict[Scenario, str] = {"i": "RGB", "ii": "CFA", "iii": "mono"}
CAMERAS = {"i": "scenario-i-rgb", "ii": "scenario-ii-cfa", "iii": "scenario-iii-mono"}
_MASK_SEED = 1
MASKS: dict[str, AnyPattern] = {
    "rgbw": RandomRGBW(kind="random_rgbw", seed=_MASK_SEED),
    "binary": RandomBinary(kind="random_binary", seed=_MASK_SEED),
    "uniform": UniformColour(kind="uniform_colour", seed=_MASK_SEED),
    "gaussian": GaussianColour(kind="gaussian_colour", seed=_MASK_SEED),
}
MASK_TITLES = {
    "rgbw": "RGBW",
    "binary": "random binary",
    "uniform": "uniform colour",
    "gaussian": "Gaussian colour",
}


@cache
def _shipped() -> dict[str, Camera]:
    return shipped_cameras()


@dataclass(frozen=True)
class Capture:
    """How a scene is measured, always with the same total exposure.

    shots: of (i), three make one full-colour image. binning: k, r = 1/k^2. demosaiced: the CFA
    frame is interpolated to full colour first, and reconstructed as scenario (i).
    """

    scenario: Scenario
    shots: int
    binning: int = 1
    noisy: bool = False
    mask: str = "rgbw"
    demosaiced: bool = False

    @property
    def label(self) -> str:
        """In words, such as "(ii) CFA x 2, r = 1/4, noisy"."""
        parts = [f"({self.scenario}) {SCENARIOS[self.scenario]} × {self.shots}"]
        if self.demosaiced:
            parts.append("demosaiced first")
        if self.mask != "rgbw":
            parts.append(f"{MASK_TITLES[self.mask]} mask")
        if self.binning > 1:
            parts.append(f"r = 1/{self.binning**2}")
        parts.append("noisy" if self.noisy else "noise-free")
        return ", ".join(parts)

    def camera(self) -> Camera:
        """Return the shipped camera of the scenario with these shots, pixels and mask."""
        camera = _shipped()[CAMERAS[self.scenario]].with_shots(self.shots)
        sensor = camera.sensor.model_copy(update={"binning": self.binning})
        masks = {
            name: mask.model_copy(update={"pattern": MASKS[self.mask]})
            for name, mask in camera.masks.items()
        }
        return camera.model_copy(update={"sensor": sensor, "masks": masks})

    def solved_as(self) -> Capture:
        """Return the capture whose Psi the frames are reconstructed with."""
        return Capture("i", 3, mask=self.mask, noisy=self.noisy) if self.demosaiced else self


@dataclass(frozen=True)
class Cell:
    """One reconstruction."""

    scene: str
    capture: Capture
    method: str

    @property
    def label(self) -> str:
        """In words."""
        return f"{self.scene}, {self.capture.label}, {METHOD_TITLES[self.method]}"

    @property
    def paper_psnr_db(self) -> float | None:
        """What the paper prints for this scene, capture and method; None where it does not."""
        capture, scene = self.capture, paper.known_as(self.scene)
        if scene is None or capture.mask != "rgbw" or capture.demosaiced:
            return None
        place = paper.Printed(
            scene, capture.scenario, capture.shots, capture.binning, capture.noisy, self.method
        )
        return paper.PSNR_DB.get(place)


@dataclass(frozen=True)
class Part:
    """A table, or a figure that compares. scenes: of those given; "shown": one of them only."""

    name: str
    title: str
    scenes: Literal["synthetic", "other", "shown synthetic", "shown other"]
    captures: tuple[Capture, ...]
    methods: tuple[str, ...] = METHODS


_SCENARIOS_OF_TABLE_2 = (Capture("i", 3), Capture("ii", 1), Capture("iii", 3))
_NOISY = tuple(replace(capture, noisy=True) for capture in _SCENARIOS_OF_TABLE_2)
PARTS = {
    part.name: part
    for part in (
        Part(
            "table2",
            "Table II: three scenarios at equal total exposure, without and with noise",
            "synthetic",
            (*_SCENARIOS_OF_TABLE_2, *_NOISY),
        ),
        Part(
            "table3",
            "Table III: scenarios and numbers of shots, noise-free",
            "other",
            (
                Capture("i", 3),
                *(Capture("ii", shots) for shots in (1, 2, 3)),
                *(Capture("iii", shots) for shots in (1, 2, 3)),
            ),
        ),
        Part(
            "table4",
            "Table IV: pixels of 2x2 samples (r = 1/4) and numbers of shots, noise-free",
            "other",
            (
                *(Capture("i", shots, 2) for shots in (3, 6, 9, 12)),
                *(Capture("ii", shots, 2) for shots in (1, 2, 3, 4)),
                *(Capture("iii", shots, 2) for shots in (1, 2, 3, 4)),
            ),
        ),
        Part(
            "figure6",
            "Figure 6: a colour filter array, and demosaiced first",
            "shown synthetic",
            (Capture("ii", 1), Capture("ii", 1, demosaiced=True)),
            ("tv-dict",),
        ),
        Part(
            "figure8",
            "Figure 8: mask patterns before a CFA sensor, with noise",
            "synthetic",
            tuple(Capture("ii", 1, noisy=True, mask=mask) for mask in MASKS),
        ),
    )
}


def chosen_parts(only: str | None) -> tuple[Part, ...]:
    """Return the parts named in a list with commas, all without one, in the paper's order.

    Raises AppError naming the nearest for a name that is not known.
    """
    if only is None:
        return tuple(PARTS.values())
    names = [name.strip().lower() for name in only.split(",") if name.strip()]
    for name in names:
        if name not in PARTS:
            raise AppError(f"--only {name}: {nearest_of(name, PARTS)}")
    if not names:
        raise AppError(f"--only names nothing: known are {', '.join(PARTS)}")
    return tuple(part for part in PARTS.values() if part.name in names)


def scenes_of(part: Part, scenes: Sequence[str]) -> list[str]:
    """Return which of the given scenes a part is about.

    Table II's four and the rest; either kind stands in for the other where it is missing.
    """
    synthetic = [scene for scene in scenes if paper.known_as(scene) in paper.SYNTHETIC]
    other = [scene for scene in scenes if scene not in synthetic]
    kind = part.scenes.removeprefix("shown ")
    found = (synthetic or other) if kind == "synthetic" else (other or synthetic)
    found.sort(key=lambda scene: (_rank(scene), scene))
    return found[:1] if part.scenes.startswith("shown ") else found


def _rank(scene: str) -> int:
    known = paper.known_as(scene)
    return len(paper.TITLES) if known is None else list(paper.TITLES).index(known)


def cells_of(part: Part, scenes: Sequence[str]) -> list[Cell]:
    """Return the cells of a part, all methods of a capture one after the other."""
    return [
        Cell(scene, capture, method)
        for scene in scenes_of(part, scenes)
        for capture in part.captures
        for method in part.methods
    ]
