"""The paper's qualitative findings, each tested on cells: does it hold, and by how many dB.

Each is a difference per scene, mostly the worst of what should be better less the best of what
should be worse. It holds when the mean over the scenes is above zero.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from emmc_rig.study.tables import paper
from emmc_rig.study.tables.cells import METHODS, PARTS, SCENARIOS, Capture, Cell, scenes_of
from emmc_rig.study.tables.paper import Scenario

Measured = Mapping[Cell, Mapping[str, object]]
"""Figures of each cell by name, `psnr_db` among them."""
CHROMA = "chroma_psnr_db"


@dataclass(frozen=True)
class Spread:
    """A difference in dB over scenes: mean, range, and in how many it is above zero."""

    mean_db: float
    low_db: float
    high_db: float
    scenes: int
    holding: int

    @property
    def holds(self) -> bool:
        """Whether the mean is above zero."""
        return self.mean_db > 0

    def __str__(self) -> str:
        return f"{self.mean_db:+.2f} ({self.low_db:+.2f} to {self.high_db:+.2f})"


@dataclass(frozen=True)
class SceneFigures:
    """Looks up one scene's figures; raises KeyError where a cell was not measured."""

    measured: Measured
    scene: str

    def __call__(self, capture: Capture, method: str, what: str = "psnr_db") -> float:
        """Return one figure."""
        value = self.measured[Cell(self.scene, capture, method)][what]
        if not isinstance(value, int | float):
            raise KeyError(what)
        return float(value)


Gain = Callable[[SceneFigures, str], float]


@dataclass(frozen=True)
class Claim:
    """What the paper says, where, and what is compared here.

    part: whose scenes. by_method: the paper's method. methods: all that it is evaluated for.
    """

    name: str
    says: str
    sentence: str
    compares: str
    part: str
    gain: Gain
    by_method: str = "tv-dict"
    methods: tuple[str, ...] = METHODS


@dataclass(frozen=True)
class Finding:
    """A claim and its test: by method on the given scenes, and in the paper's numbers."""

    claim: Claim
    ours: Mapping[str, Spread]
    printed: Spread | None

    @property
    def spread(self) -> Spread | None:
        """The difference by the paper's method; None when its cells were not measured."""
        return self.ours.get(self.claim.by_method)

    @property
    def verdict(self) -> str:
        """In words."""
        if self.spread is None:
            return "not measured"
        return "holds" if self.spread.holds else "does not hold"


def _over(better: Sequence[Capture], worse: Sequence[Capture], what: str = "psnr_db") -> Gain:
    """Return the gain of the worst of some captures over the best of others."""

    def gain(figure: SceneFigures, method: str) -> float:
        least = min(figure(capture, method, what) for capture in better)
        return least - max(figure(capture, method, what) for capture in worse)

    return gain


def _over_dict_admm(captures: Sequence[Capture]) -> Gain:
    """Return the mean gain of a method over Dict-ADMM."""

    def gain(figure: SceneFigures, method: str) -> float:
        return float(np.mean([figure(c, method) - figure(c, "dict-admm") for c in captures]))

    return gain


def _lost_to_noise(figure: SceneFigures, method: str) -> float:
    """Return by how much less (ii) loses than the better of (i) and (iii)."""

    def lost(capture: Capture) -> float:
        return figure(capture, method) - figure(replace(capture, noisy=True), method)

    return min(lost(_RGB), lost(_MONO_3)) - lost(_CFA)


def _smallest_step(scenario: Scenario) -> Gain:
    """Return the smallest gain from one number of shots to the next."""
    captures = [c for c in PARTS["table4"].captures if c.scenario == scenario]

    def gain(figure: SceneFigures, method: str) -> float:
        return min(figure(b, method) - figure(a, method) for a, b in pairwise(captures))

    return gain


_RGB, _CFA, _MONO_3 = Capture("i", 3), Capture("ii", 1), Capture("iii", 3)
_MONO, _MONO_2 = Capture("iii", 1), Capture("iii", 2)
_TABLE_2 = PARTS["table2"].captures
_MASKED = {c.mask: c for c in PARTS["figure8"].captures}
_MORE_SHOTS = (
    "One can observe the PSNR values significantly improve when increasing the number of shots. "
    "(VII-C)"
)
_TV_DICT = "The former method [TV-Dict] obtains higher PSNR values in most cases (VII-B1b)"
CLAIMS = (
    Claim(
        "tv-dict-noise-free",
        "TV-Dict is above Dict-ADMM, noise-free, on Table II's scenes",
        _TV_DICT,
        "mean over the three scenarios of Table II without noise: method less Dict-ADMM",
        "table2",
        _over_dict_admm([c for c in _TABLE_2 if not c.noisy]),
        methods=("tv-dict", "tv"),
    ),
    Claim(
        "tv-dict-noisy",
        "TV-Dict is above Dict-ADMM with noise",
        _TV_DICT,
        "mean over the three scenarios of Table II with noise: method less Dict-ADMM",
        "table2",
        _over_dict_admm([c for c in _TABLE_2 if c.noisy]),
        methods=("tv-dict", "tv"),
    ),
    Claim(
        "tv-dict-real",
        "TV-Dict is above Dict-ADMM on Table III's scenes",
        "the TV-Dict algorithm improves the results for the three acquisition scenarios (VII-B2)",
        "mean over the seven captures of Table III: method less Dict-ADMM",
        "table3",
        _over_dict_admm(PARTS["table3"].captures),
        methods=("tv-dict", "tv"),
    ),
    Claim(
        "tv-dict-quarter",
        "TV-Dict is above Dict-ADMM at r = 1/4",
        "Table IV (no sentence compares the two there)",
        "mean over the twelve captures of Table IV: method less Dict-ADMM",
        "table4",
        _over_dict_admm(PARTS["table4"].captures),
        methods=("tv-dict", "tv"),
    ),
    Claim(
        "rgb-per-acquisition",
        "One RGB acquisition beats one CFA and one monochrome shot, noise-free",
        "Table III shows that scenario (i) gives a better reconstruction quality with both the "
        "dictionary-based and TV-based approaches. However, its compression ratio is "
        "three-time-lower (VII-B2)",
        "Table III: (i), which is three readings per pixel, less the better of (ii) × 1 and "
        "(iii) × 1, one reading per pixel each",
        "table3",
        _over([_RGB], [_CFA, _MONO]),
    ),
    Claim(
        "mono-per-reading",
        "At three readings per pixel, noise-free, monochrome is best, not RGB",
        "In this noiseless situation, the three-shot acquisition with monochrome sensor gets the "
        "best PSNR score compared to one-shot RGB and CFA acquisitions (Figure 6)",
        "Table III: (iii) × 3 less the better of (i) and (ii) × 3, three readings per pixel each",
        "table3",
        _over([_MONO_3], [_RGB, Capture("ii", 3)]),
    ),
    Claim(
        "cfa-noise",
        "The CFA capture loses least to noise at equal exposure",
        "the one-shot CFA acquisition scheme provides very close reconstruction results for the "
        "noise-free and noisy cases (Figure 6)",
        "Table II, loss = noise-free less noisy: the smaller loss of (i) and (iii) × 3 less the "
        "loss of (ii)",
        "table2",
        _lost_to_noise,
    ),
    Claim(
        "mono-colour",
        "One monochrome shot fails in colour",
        "all tested algorithms [...] often fail to correctly reconstruct colors of the original "
        "light fields from one single-shot acquisition [with a monochrome sensor] (VII-B2)",
        "PSNR of the chrominances, Table III: (ii) × 1 less (iii) × 1",
        "table3",
        _over([_CFA], [_MONO], CHROMA),
    ),
    Claim(
        "mono-colour-recovered",
        "Two monochrome shots recover colour",
        "Two acquisitions, i.e. two shots, are required when using a monochrome sensor for a good "
        "recovery of both colour and parallax (VII-B2)",
        "PSNR of the chrominances, Table III: (iii) × 2 less the better of (iii) × 1 and (ii) × 1",
        "table3",
        _over([_MONO_2], [_MONO, _CFA], CHROMA),
    ),
    Claim(
        "masks",
        "RGBW and binary masks are best under noise",
        "best PSNR performances are obtained using the RGBW mask and the binary mask, compared to "
        "the uniform and Gaussian masks (Figure 8)",
        "Figure 8: the worse of RGBW and binary less the better of uniform and Gaussian colour",
        "figure8",
        _over([_MASKED["rgbw"], _MASKED["binary"]], [_MASKED["uniform"], _MASKED["gaussian"]]),
        by_method="dict-admm",
    ),
    *(
        Claim(
            f"shots-{scenario}",
            f"At r = 1/4 PSNR grows with every further shot, ({scenario}) {title}",
            _MORE_SHOTS,
            "Table IV: the smallest step from one number of shots to the next",
            "table4",
            _smallest_step(scenario),
        )
        for scenario, title in SCENARIOS.items()
    ),
    Claim(
        "joint-demosaicing",
        "Reconstructing from the CFA mosaic beats demosaicing first",
        "the reconstruction from pre-demosaiced coded projection [...] suffers from heavy "
        "noise-like artifacts (VII-B1a)",
        "Figure 6, noise-free, one scene: (ii) less (ii) demosaiced and solved as (i)",
        "figure6",
        _over([_CFA], [replace(_CFA, demosaiced=True)]),
        methods=("tv-dict",),
    ),
)


def spread_of(
    measured: Measured, claim: Claim, scenes: Sequence[str], method: str
) -> Spread | None:
    """Return a claim's difference over the scenes that were measured; None without any."""
    gains = []
    for scene in scenes:
        try:
            gains.append(claim.gain(SceneFigures(measured, scene), method))
        except KeyError:
            continue
    if not gains:
        return None
    return Spread(
        float(np.mean(gains)), min(gains), max(gains), len(gains), sum(gain > 0 for gain in gains)
    )


def printed_figures() -> dict[Cell, dict[str, object]]:
    """Return the paper's numbers as measured cells."""
    return {
        Cell(
            place.scene,
            Capture(place.scenario, place.shots, place.binning, place.noisy),
            place.method,
        ): {"psnr_db": psnr_db}
        for place, psnr_db in paper.PSNR_DB.items()
    }


def findings_from(measured: Measured, scenes: Sequence[str]) -> list[Finding]:
    """Return all claims tested on cells of the given scenes."""
    printed = printed_figures()
    findings = []
    for claim in CLAIMS:
        about = scenes_of(PARTS[claim.part], scenes)
        found = {method: spread_of(measured, claim, about, method) for method in claim.methods}
        ours = {method: value for method, value in found.items() if value is not None}
        theirs = spread_of(
            printed, claim, scenes_of(PARTS[claim.part], list(paper.TITLES)), claim.by_method
        )
        findings.append(Finding(claim, ours, theirs))
    return findings
