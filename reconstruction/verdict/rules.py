"""The rules: figures beyond a limit become reasons, each with its remedy, and reasons a verdict."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Literal

from reconstruction.verdict.evidence import Evidence

Level = Literal["trust", "doubt", "do not use"]
LEVELS: tuple[Level, ...] = ("trust", "doubt", "do not use")


@dataclass(frozen=True)
class Limits:
    """Of a figure: beyond the first a result is doubted, beyond the second not to be used."""

    doubt: float
    refuse: float

    def level(self, figure: float) -> Level:
        """Return what a figure speaks for; larger is worse."""
        return LEVELS[(figure > self.doubt) + (figure > self.refuse)]


DISPLACED_PX = Limits(0.15, 0.4)
DISTANCE_PX = Limits(0.15, 0.4)
WEAKER = Limits(0.12, 0.3)
"""What is missing of the masks' shadow, or too much of it."""
FLICKER = Limits(0.02, 0.1)
MOTION_PX = Limits(0.3, 1.0)
OFF = Limits(0.002, 0.02)
HOLE_PX = Limits(4.0, 12.0)
UNUSABLE = Limits(0.15, 0.5)
NOISE_SHARE = Limits(0.6, 0.9)
UNEXPLAINED = Limits(0.6, 1.0)
DARK = 0.3
"""Brightness over the shots' mean below which a shot is called dark."""


@dataclass(frozen=True)
class Reason:
    """what: in words. figure: behind it. remedy: what to do. level: what it alone speaks for."""

    what: str
    figure: float
    remedy: str
    level: Level


@dataclass(frozen=True)
class Verdict:
    """level: of the gravest reason; reasons: the gravest first; evidence: all the figures."""

    level: Level
    reasons: tuple[Reason, ...]
    evidence: Evidence

    @property
    def words(self) -> str:
        """The verdict in one line."""
        if not self.reasons:
            return "trust: readings, masks and noise agree with the light field"
        return f"{self.level}: " + "; ".join(f"{one.what}: {one.remedy}" for one in self.reasons)

    def as_dict(self) -> dict:
        """Return the verdict as plain data."""
        return {
            "level": self.level,
            "reasons": [asdict(one) for one in self.reasons],
            "features": asdict(self.evidence),
        }


def judged(evidence: Evidence) -> Verdict:
    """Return the verdict that the evidence leads to."""
    found = [
        reason
        for rule in (_shots, _masks, _pixels, _noise, _fit)
        for reason in rule(evidence)
        if reason.level != "trust"
    ]
    found.sort(key=lambda one: -LEVELS.index(one.level))
    return Verdict(found[0].level if found else "trust", tuple(found), evidence)


def _shots(e: Evidence) -> Iterator[Reason]:
    if len(e.brightness) < 2:
        return
    for shot, bright in enumerate(e.brightness, 1):
        if bright < DARK:
            yield Reason(
                f"shot {shot} is dark",
                bright,
                "take it again, or leave it out",
                "do not use",
            )
            return
    apart = max(abs(bright - 1) for bright in e.brightness)
    shot = max(range(len(e.brightness)), key=lambda s: abs(e.brightness[s] - 1)) + 1
    yield Reason(
        f"shot {shot} differs in brightness by {apart:.1%}",
        apart,
        "steady the lamp, or normalise the frames by a reference",
        FLICKER.level(apart),
    )
    for shot, row in enumerate(e.other_strengths):
        other = max((t for t in range(len(row)) if t != shot), key=lambda t: row[t])
        if row[other] > 0.5 and row[shot] < 0.5:
            yield Reason(
                f"shot {shot + 1} shows the masks of shot {other + 1}",
                row[other],
                "the stage did not move, or the order of frames is wrong: take it again",
                "do not use",
            )
            return
    if e.motion_px is not None and _masks_fit(e):
        shot, y, x = e.moved_at
        yield Reason(
            f"between shots 1 and {shot + 1} the picture moves by {e.motion_px:.1f} pixels at row "
            f"{y}, column {x}",
            e.motion_px,
            "hold scene and camera still, or reconstruct one shot by adaptive",
            MOTION_PX.level(e.motion_px),
        )


def _masks_fit(e: Evidence) -> bool:
    return all(abs(1 - one) < WEAKER.refuse for one in e.strengths)


def _masks(e: Evidence) -> Iterator[Reason]:
    drift = "run `emmc-rig calibrate --drift`, or take one whiteboard"
    if e.displaced_px is not None:
        yield Reason(
            f"the masks' shadow lies {e.displaced_px:.2f} pixels from where Psi says",
            e.displaced_px,
            drift,
            DISPLACED_PX.level(e.displaced_px),
        )
    weakest = min(zip(e.strengths, e.strength_errors, strict=True), key=lambda one: one[0])
    lost = 1 - weakest[0] - 2 * weakest[1]
    if lost > 0:
        yield Reason(
            f"the masks show at {weakest[0]:.0%} of the strength that Psi says",
            weakest[0],
            "Psi is not that of these frames, or the shadow is blurred: " + drift,
            WEAKER.level(lost),
        )


def _pixels(e: Evidence) -> Iterator[Reason]:
    yield Reason(
        f"{e.off:.1%} of the readings are far off all around them",
        e.off,
        "list dead and hot pixels (a dark and a reference frame tell them), or expose less",
        OFF.level(e.off),
    )
    yield Reason(
        f"no shot sees anything in a hole {2 * e.hole_px:.0f} pixels wide at row {e.hole_at[0]}, "
        f"column {e.hole_at[1]}",
        e.hole_px,
        "expose less, or bracket",
        HOLE_PX.level(e.hole_px),
    )
    yield Reason(
        f"{e.unusable:.0%} of the readings are saturated or excluded",
        e.unusable,
        "expose less, or bracket",
        UNUSABLE.level(e.unusable),
    )


def _noise(e: Evidence) -> Iterator[Reason]:
    if e.noise_share is not None:
        yield Reason(
            f"noise makes {e.noise_share:.0%} of what readings kept from the fit are missed by",
            e.noise_share,
            "more light or longer exposure",
            NOISE_SHARE.level(e.noise_share),
        )


def _fit(e: Evidence) -> Iterator[Reason]:
    if e.explained is not None:
        yield Reason(
            f"only {max(e.explained, 0):.0%} of what readings kept from the fit show is explained",
            e.explained,
            "another method, or more shots",
            UNEXPLAINED.level(1 - e.explained),
        )
