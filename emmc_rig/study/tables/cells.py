"""The cells of each table: scenes, setups and methods, and the paper's number for each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

from emmc_rig.errors import AppError
from emmc_rig.model.camera import Camera, shipped_cameras
from emmc_rig.model.errors import nearest_of
from emmc_rig.study.tables import paper
from emmc_rig.study.tables.paper import Scenario

METHODS = {"dict-admm": "Dict-ADMM", "tv-dict": "TV-Dict", "tv": "TV alone"}
SCENARIOS: dict[Scenario, str] = {"i": "RGB", "ii": "CFA", "iii": "mono"}
CAMERAS = {"i": "scenario-i-rgb", "ii": "scenario-ii-cfa", "iii": "scenario-iii-mono"}

_shipped = cache(shipped_cameras)


@dataclass(frozen=True)
class Setup:
    """How a scene is measured, always with the same total exposure.

    shots: of (i), three make one full-colour image. binning: k, r = 1/k^2.
    """

    scenario: Scenario
    shots: int
    binning: int = 1
    noisy: bool = False

    @property
    def label(self) -> str:
        """In words, such as "(ii) CFA × 2, r = 1/4, noisy"."""
        parts = [f"({self.scenario}) {SCENARIOS[self.scenario]} × {self.shots}"]
        if self.binning > 1:
            parts.append(f"r = 1/{self.binning**2}")
        parts.append("noisy" if self.noisy else "noise-free")
        return ", ".join(parts)

    def camera(self) -> Camera:
        """Return the shipped camera of the scenario with these shots and pixels."""
        camera = _shipped()[CAMERAS[self.scenario]].with_shots(self.shots)
        sensor = camera.sensor.model_copy(update={"binning": self.binning})
        return camera.model_copy(update={"sensor": sensor})


@dataclass(frozen=True)
class Cell:
    """One reconstruction."""

    scene: str
    setup: Setup
    method: str

    @property
    def label(self) -> str:
        """In words."""
        return f"{self.scene}, {self.setup.label}, {METHODS[self.method]}"

    @property
    def paper_psnr_db(self) -> float | None:
        """What the paper prints for this scene, setup and method; None where it does not."""
        setup, scene = self.setup, paper.known_as(self.scene)
        if scene is None:
            return None
        place = (scene, setup.scenario, setup.shots, setup.binning, setup.noisy, self.method)
        return paper.PSNR_DB.get(paper.Printed(*place))


@dataclass(frozen=True)
class Part:
    """A table or a part of one: setups beside each other.

    name: as --only takes it. synthetic: whether about the paper's synthetic scenes, or the others.
    """

    name: str
    title: str
    synthetic: bool
    setups: tuple[Setup, ...]

    @property
    def columns(self) -> list[str]:
        """What heads the columns: in what the setups differ."""
        return [setup.label.partition(",")[0] for setup in self.setups]


_THREE = (Setup("i", 3), Setup("ii", 1), Setup("iii", 3))
PARTS = (
    Part("table2", "Table II, noise-free: three scenarios at equal total exposure", True, _THREE),
    Part(
        "table2",
        "Table II, with noise: three scenarios at equal total exposure",
        True,
        tuple(replace(setup, noisy=True) for setup in _THREE),
    ),
    Part(
        "table3",
        "Table III: scenarios and numbers of shots, noise-free",
        False,
        (
            Setup("i", 3),
            *(Setup("ii", shots) for shots in (1, 2, 3)),
            *(Setup("iii", shots) for shots in (1, 2, 3)),
        ),
    ),
    *(
        Part(
            "table4",
            f"Table IV, ({scenario}) {title}: pixels of 2x2 samples (r = 1/4), noise-free",
            False,
            tuple(Setup(scenario, shots, 2) for shots in numbers),
        )
        for (scenario, title), numbers in zip(
            SCENARIOS.items(), ((3, 6, 9, 12), (1, 2, 3, 4), (1, 2, 3, 4)), strict=True
        )
    ),
)


def chosen_parts(only: str | None) -> tuple[Part, ...]:
    """Return the parts of the tables named in a list with commas, all without one.

    Raises AppError naming the nearest for a name that is not known.
    """
    known = list(dict.fromkeys(part.name for part in PARTS))
    if only is None:
        return PARTS
    names = [name.strip().lower() for name in only.split(",") if name.strip()]
    for name in names:
        if name not in known:
            raise AppError(f"table {name}: {nearest_of(name, known)}")
    if not names:
        raise AppError(f"no table is named: known are {', '.join(known)}")
    return tuple(part for part in PARTS if part.name in names)


def scenes_of(part: Part, scenes: Sequence[str]) -> list[str]:
    """Return which of the given scenes a part is about, in the paper's order.

    A part is about the paper's synthetic scenes, or about the rest. Where scenes of that kind are
    missing, all scenes are returned.
    """
    synthetic = [scene for scene in scenes if paper.known_as(scene) in paper.SYNTHETIC]
    other = [scene for scene in scenes if scene not in synthetic]
    chosen = (synthetic or other) if part.synthetic else (other or synthetic)
    order = {name: rank for rank, name in enumerate(paper.TITLES)}
    return sorted(
        chosen, key=lambda scene: (order.get(paper.known_as(scene) or "", len(order)), scene)
    )


def cells_of(part: Part, scenes: Sequence[str]) -> list[Cell]:
    """Return the cells of a part, all methods of a setup one after the other."""
    return [
        Cell(scene, setup, method)
        for scene in scenes_of(part, scenes)
        for setup in part.setups
        for method in METHODS
    ]
