"""The rules: figures beyond a limit become reasons, each with its remedy, and reasons a verdict.

The limits are tuned, not derived: `benchmarks/verdicts.py` measures how many broken results and how
many good ones they flag, over 22 faults. The rules of further faults were not judged by it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from emmc_rig.model.view_axes import picture_name, shows_parallax
from emmc_rig.reconstruction.method import Sensitivity
from emmc_rig.reconstruction.methods import METHODS
from emmc_rig.reconstruction.verdict.evidence import Evidence
from emmc_rig.reconstruction.verdict.orientation import Seen

Level = Literal["trust", "cannot tell", "doubt", "do not use"]
LEVELS: tuple[Level, ...] = ("trust", "cannot tell", "doubt", "do not use")
"""Graver ones later. `trust`: consistent, and of an accuracy that is stated. `cannot tell`: nothing
speaks against the light field, but its accuracy is not known, or a wrong Psi, or wrong colours,
would not show in these readings."""
CONSISTENT = "consistent with frames, Psi and noise"


@dataclass(frozen=True)
class Limit:
    """A limit of a figure: above it the verdict is doubt, above REFUSED times it do not use."""

    doubt: float

    def level(self, figure: float) -> Level:
        """Return the verdict that a figure alone leads to; larger is worse."""
        if figure > REFUSED * self.doubt:
            return "do not use"
        return "doubt" if figure > self.doubt else "trust"

    def times(self, factor: float) -> Limit:
        """Return the limit scaled."""
        return Limit(self.doubt * factor)


REFUSED = 2.5
DISPLACED_PX = Limit(0.28)
"""Of the masks' shadow."""
STRENGTH_LOST = Limit(0.19)
"""Contrast of the masks' shadow that is missing, as a share of what Psi predicts."""
VIGNETTING = Limit(0.2)
"""Light that the outermost rays lose beyond what Psi says, as a share."""
FLICKER = Limit(0.05)
"""Difference of a shot's brightness from the shots' mean, over that."""
MOTION = Limit(1.0)
"""Ratio by which shots saw different scenes; refused only where the shots in question are unknown,
as nothing mends that. Motion that costs 7 dB or more has ratios of 2 to 13
(built-in scenes, 64x80, two and three shots, `tv`)."""
BAD = Limit(0.01)
"""Share of pixels that the clean-up calls bad. Above it further bad pixels are overlooked."""
SATURATED = Limit(0.14)
SHORT = Limit(0.02)
"""Share of the readings."""
UNUSABLE = Limit(0.35)
"""Share of the readings. At 40 % one shot loses 1 to 4 dB (group A, 64x80; the fish 0.8)."""
BLIND = Limit(0.05)
NOISE = Limit(0.3)
"""Standard deviation of the readings over their mean."""
UNDECIDED = 0.75
"""Share of the textured patches: above it depth is not known."""
NOISY, LEFT_OPEN = 0.08, 0.35
"""Noise over the mean reading, and share of undecided patches, that together cost 3 dB. In six
scenes of group A (64x80) 500 electrons do: 0.08 to 0.21, and 39 to 77 %. No scene that loses 1 dB
at most has both."""
SLIGHT_PX, UNLIKE_SURFACES = 0.09, 0.5
"""A displacement too small for the limit above; and the mean square residual of surfaces over total
variation's from which on it does harm. Clean captures of group A and the built-in scenes, by the
RGBW masks of the shipped cameras, lie 0.08 px off at most."""
HARM, HARM_STATED, LEAST_EFFECT = 0.8, 0.38, 0.02
"""Relative change of the masks' modulation, above which a cause does harm: over the relative error
of held-out readings, or over that which the method states for the light field, and alone. In one
shot whose black level is wrong by 3 or 6 % of the mean (96x96), six scenes of group A and two built
in by adaptive-fast, it is 0.38 to 0.65 of what is stated where 3 dB are lost, 0.37 at most where 1
dB at most is; in four scenes by tv 0.85 and 1.8 of the held-out error, and elsewhere 0.6."""
NAMED_LOST = 0.1
"""Relative change of the masks' modulation by blur or distance, above which it is doubted whatever
is stated. Edges blurred by 0.4 pixels change 0.09 to 0.1, and cost 0.5 to 14 dB in eight scenes by
adaptive-fast, 3 in four; a distance wrong by 10 % changes 0.07 to 0.08, and costs 0.4 to 14, 3 in
five."""
GAMMA = Limit(0.05)
"""Of the power of the light that readings follow, less 1. It is wrong brightness, whatever else."""
AS_LIKELY = 0.9
"""Of the likeliest cause's gain, from which on vignetting is likely as well: under 30 % it is 0.96
at least in eight scenes, under a black level that is wrong 0.29 at most."""
SURE = 3
"""Deviations by which a cause must differ from none to be named."""
BLOCKINESS = Limit(0.44)
"""See `blockiness`. In group A at 96x96 0.08 at most as they were read; by JPEG of quality 95, at a
loss of 0.1 to 2.3 dB, 0.12 to 0.41; of quality 85, at 2.1 to 15 dB, 0.47 to 1.2."""
STEPS_SHARE = 0.7
"""Noise by quantisation over the error of held-out readings."""
AT_END = 0.01
"""Share of the patches that fit best at the limit of what is searched."""
SHIFT_PX = 0.1
"""From a band to the next. Captures behind a prism of 2 pixels have 1.98 and 1.99 where the scene
shows it, and 0.24 to 0.49, or 5.2, elsewhere."""
MISFIT = 12.0
"""Residual of the readings over their noise, at the worst place. In clean shots of 10^6 electrons
it is 11 at most (16 scenes, 64x80)."""
COLOUR_ERROR = 0.1
"""Root mean square. One shot of `scenario-iii-mono`: 0.08 to 0.16, of `rgbw-mono` 0.04 to 0.13
(64x80, three scenes of group A, two built in)."""
LEAST_PARALLAX = 0.005
"""Root mean square by which the views differ, over the middle one's."""
DARK = 0.3
"""Brightness over the shots' mean below which a shot is called dark."""
DRIFT = "calibrate the drift of the masks since then, or calibrate again"
ANOTHERS = 0.5
"""Shots are confused where another shot's masks show more strongly than this, and a shot's own
less."""
LEAST_STRENGTH = 0.25
"""Displacements are measured by first differences, which scale with the shadow's strength. The
divisor is that strength, at least this."""


@dataclass(frozen=True)
class Reason:
    """what: in words. figure: behind it. remedy: what to do. level: the verdict by it alone."""

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

    def with_reasons(self, more: Iterable[Reason]) -> Verdict:
        """Return the verdict with further reasons in it, none of which speaks for trust."""
        return _of(self.evidence, (*self.reasons, *more))

    @property
    def words(self) -> str:
        """The verdict in one line."""
        if not self.reasons:
            return f"trust: {CONSISTENT}"
        return f"{self.level}: " + "; ".join(f"{r.what}: {r.remedy}" for r in self.reasons)

    def __str__(self) -> str:
        return self.words

    def __repr__(self) -> str:
        return f"Verdict({self.level!r}, {len(self.reasons)} reasons, {self.evidence.method})"

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Verdict:
        """Return a verdict from what `as_dict` gave, also through JSON, or by an earlier version.

        Figures that the earlier version did not have are None.
        """
        reasons = tuple(Reason(**reason) for reason in data["reasons"])
        figures = {**dict.fromkeys(Evidence.__dataclass_fields__), **data["features"]}
        return cls(data["level"], reasons, Evidence.from_dict(figures))

    def as_dict(self) -> dict:
        """Return the verdict as plain data."""
        return {
            "level": self.level,
            "reasons": [asdict(reason) for reason in self.reasons],
            "features": asdict(self.evidence),
        }


def verdict_from(evidence: Evidence) -> Verdict:
    """Return the verdict that the evidence leads to."""
    reasons = [reason for rule in RULES for reason in rule(evidence) if reason.level != "trust"]
    return _of(evidence, reasons or _accuracy(evidence))


def _of(evidence: Evidence, reasons: Iterable[Reason]) -> Verdict:
    gravest = sorted(reasons, key=lambda reason: -LEVELS.index(reason.level))
    return Verdict(gravest[0].level if gravest else "trust", tuple(gravest), evidence)


def _sensitivity(e: Evidence) -> Sensitivity:
    return METHODS[e.method].sensitivity if e.method in METHODS else Sensitivity()


def _accuracy(e: Evidence) -> Iterator[Reason]:
    """Whether the method states how far a light field, consistent as it is, lies from the truth."""
    if e.stated is None:
        yield Reason(
            f"{CONSISTENT}, but the accuracy is not known: {e.method} states none",
            0.0,
            "reconstruct by adaptive or adaptive-fast, which state it",
            "cannot tell",
        )


def _shots(e: Evidence) -> Iterator[Reason]:
    """Whether the shots belong together; of dark and confused ones nothing more is known."""
    if len(e.brightness) < 2:
        return
    kept = [shot for shot in range(len(e.brightness)) if shot not in e.left_out]
    bright = [(b or 0.0) if shot in kept else 1.0 for shot, b in enumerate(e.brightness)]
    spoilt = [*_dark(bright), *_confused(e, kept)]
    if spoilt:
        yield spoilt[0]
        return
    # Another scene often has another brightness: motion is the cause.
    yield from _motion(e)
    yield from _evened(e, kept)
    apart = [abs(brightness - 1) for brightness in bright]
    worst = apart.index(max(apart))
    yield Reason(
        f"shot {worst + 1} differs in brightness by {apart[worst]:.1%}",
        apart[worst],
        "let the lamp warm up, or divide the frames by a reference",
        FLICKER.level(apart[worst]),
    )


def _dark(brightness: Sequence[float]) -> Iterator[Reason]:
    """Shots that saw no light, by each shot's brightness over the mean."""
    for shot, of_shot in enumerate(brightness, 1):
        if of_shot < DARK:
            remedy = f"capture it again, or reconstruct without shot {shot}"
            yield Reason(f"shot {shot} is dark", of_shot, remedy, "do not use")


def _confused(e: Evidence, kept: Sequence[int]) -> Iterator[Reason]:
    """Shots that show the masks of another shot instead of their own."""
    for shot in kept if len(kept) > 1 else []:
        row = e.other_strengths[shot]
        strongest, other = max((s or 0.0, t) for t, s in enumerate(row) if t != shot)
        if strongest > ANOTHERS and (row[shot] or 0.0) < ANOTHERS:
            yield Reason(
                f"shot {shot + 1} shows the masks of shot {other + 1}",
                strongest,
                "the stage did not move, or frames are out of order: capture it again",
                "do not use",
            )


def _motion(e: Evidence) -> Iterator[Reason]:
    """Where shots saw different scenes: in a known shot, its readings there were left out."""
    if e.motion is None or e.motion <= MOTION.doubt or not (e.moved_at and e.moved_px):
        return
    shot, row, column = e.moved_at
    rows, columns = e.moved_px
    what, remedy = "shots saw different scenes", "hold scene and camera still"
    if shot is not None:
        what = f"shot {shot + 1} saw another scene than the others"
        remedy += f", or reconstruct without shot {shot + 1}"
    excluded = ", and is excluded there" if shot is not None and e.moved else ""
    yield Reason(
        f"{what} in {rows}x{columns} pixels about row {row}, column {column}{excluded}",
        e.motion,
        remedy,
        MOTION.level(e.motion) if shot is None else "doubt",
    )


def _evened(e: Evidence, kept: Sequence[int]) -> Iterator[Reason]:
    """Whether it is open which of two shots has the right brightness.

    kept: shots that were not left out. Three and more are scaled to their mean without a loss.
    """
    gains = [e.gains[shot] for shot in kept if e.gains]
    if len(gains) == 2:
        apart = float(np.ptp(gains))
        yield Reason(
            f"the two shots differ in brightness by {apart:.1%}: which is right is not known, and "
            "the light field has their mean brightness",
            apart,
            "let the lamp warm up, or divide the frames by a reference",
            "doubt" if apart / 2 > FLICKER.doubt else "trust",
        )


class Strength(NamedTuple):
    """How strongly the masks of a shot are seen, 1 where Psi is right, and its deviation."""

    value: float
    deviation: float


def _weakest(e: Evidence) -> Strength | None:
    """Return the masks' least strength among the shots; None if it is unknown."""
    known = [
        Strength(strength, error)
        for strength, error in zip(e.strengths, e.strength_errors, strict=True)
        if strength is not None and error is not None
    ]
    return min(known, default=None)


def _coding(e: Evidence) -> Iterator[Reason]:
    """Whether the readings show the masks so well that others, or moved ones, would be noticed.

    A loss of strength counts beyond two deviations, and is measured to within two more: where these
    four exceed the limit of doubt, twice that limit may pass unnoticed.
    """
    remedy = "calibrate beside this capture, or use masks that modulate a shot more"
    if _weakest(e) is None:
        yield Reason(
            f"the masks change neighbouring readings by {e.relief:.1%} only: the frames cannot "
            "show whether Psi is right",
            e.relief,
            remedy,
            "cannot tell",
        )
        return
    deviation = max(error for error in e.strength_errors if error is not None)
    if 4 * deviation > STRENGTH_LOST.doubt * _psi_tolerance(e, 0.85):
        yield Reason(
            f"the masks' contrast is known to {deviation:.1%} only: a wrong Psi may go unnoticed",
            deviation,
            remedy,
            "cannot tell",
        )


def _colour(e: Evidence) -> Iterator[Reason]:
    """Whether frames without colour filters show the colours."""
    if e.colour_error is not None and e.colour_error > COLOUR_ERROR:
        yield Reason(
            f"colours are uncertain by {e.colour_error:.0%} of the brightness: no pixel has a "
            "colour filter, and the masks hardly tell colours apart",
            e.colour_error,
            "capture more shots, or use a sensor with colour filters",
            "cannot tell",
        )


def _psi_tolerance(e: Evidence, power: float) -> float:
    """Return by how much errors of Psi weigh less than on one shot reconstructed by tv.

    Errors of Psi contradict each other between shots, and mislead methods with more assumptions
    than tv.
    """
    shots = sum(strength is not None for strength in e.strengths)
    return shots**-power * _sensitivity(e).psi


class Cause(NamedTuple):
    """A possible error of masks or readings, see `displaced.Change`.

    value, deviation: its size. gain: the fall of the squared residual by it alone.
    """

    name: str
    value: float
    deviation: float
    gain: float

    @property
    def surely(self) -> float:
        """The size that it has at least, by two deviations."""
        return abs(self.value) - 2 * self.deviation


NO_CAUSE = Cause("", 0.0, 0.0, 0.0)


def _orientation(e: Evidence) -> Iterator[Reason]:
    """Whether the masks are mirrored, turned, a negative, or far from their place."""
    if e.masks_seen is not None:
        seen = Seen(*e.masks_seen)
        remedy = "put mask and frames as the camera's file has them, or calibrate"
        yield Reason(str(seen), seen.strength, remedy, "do not use")


def _masks(e: Evidence) -> Iterator[Reason]:
    """The likeliest reason among possible errors of the masks, given the readings."""
    weakest = _weakest(e)
    if weakest is None or e.masks_seen is not None:
        return
    strength = weakest.value
    lost = 1 - strength - 2 * weakest.deviation
    moved = (e.displaced_px or 0.0) / max(strength, LEAST_STRENGTH)
    cause = _likeliest(_causes(e))
    # A wrong black level does several shots no more harm than one.
    tolerance = _psi_tolerance(e, 0.0 if cause.name == "offset" else 0.85)
    weak = STRENGTH_LOST.times(tolerance).level(lost)
    displaced = DISPLACED_PX.times(_psi_tolerance(e, 0.85)).level(moved)
    shift = f"the masks' shadow is about {moved:.2f} pixels from its place in Psi"
    what, remedy = _in_words(cause, strength)
    surfaces_fail = e.parameters.get("over_plain", 0.0) > UNLIKE_SURFACES
    if displaced != "trust" and strength > LEAST_STRENGTH:
        yield Reason(shift, moved, DRIFT, LEVELS[max(map(LEVELS.index, (displaced, weak)))])
    elif weak != "trust":
        yield Reason(what, strength, remedy, weak)
    elif cause.name == "gamma" and GAMMA.level(cause.surely) != "trust":
        yield Reason(what, cause.value, remedy, GAMMA.level(cause.surely))
    elif _changes_too_much(e, cause):
        yield Reason(what, strength, remedy, "doubt")
    elif surfaces_fail and moved > SLIGHT_PX:
        yield Reason(shift, moved, DRIFT, "doubt")
    else:
        yield from _vignetting(e, strength)


def _vignetting(e: Evidence, strength: float) -> Iterator[Reason]:
    """Light that the outermost rays lose, where that explains as much as any cause."""
    causes = _causes(e)
    darker = causes.get("vignetting")
    if darker and darker.gain > AS_LIKELY * max(cause.gain for cause in causes.values()):
        limits = VIGNETTING.times(_psi_tolerance(e, 0.5))
        what, remedy = _in_words(darker, strength)
        level = limits.level(darker.value - 2 * darker.deviation)
        yield Reason(what, darker.value, remedy, level)


def _changes_too_much(e: Evidence, cause: Cause) -> bool:
    """Return whether the masks' modulation is changed by more than the light field allows."""
    changed = _causes(e).get("contrast", NO_CAUSE).surely
    if cause.name in ("blur", "distance") and changed > NAMED_LOST * _psi_tolerance(e, 0.85):
        return True
    if e.stated is not None:
        limit = HARM_STATED * e.stated
    elif e.noise_share:
        limit = HARM * e.noise / e.noise_share**0.5
    else:
        return False
    return changed > max(limit, LEAST_EFFECT)


def _causes(e: Evidence) -> dict[str, Cause]:
    """Return each cause that is known, by name."""
    # Outer bands or times that are darker are the light's own.
    own = () if shows_parallax(e.view_axes) else ("vignetting",)
    return {
        name: Cause(name, value, deviation, gain)
        for name, (value, deviation, gain) in e.changes.items()
        if name not in own and value is not None and deviation is not None and gain is not None
    }


def _likeliest(causes: Mapping[str, Cause]) -> Cause:
    """Return the cause that alone explains most; NO_CAUSE if it differs from none by chance.

    Contrast, which names no cause, only where it explains clearly more.
    """
    likeliest = max(
        causes.values(),
        key=lambda cause: (AS_LIKELY if cause.name == "contrast" else 1.0) * cause.gain,
        default=NO_CAUSE,
    )
    return likeliest if abs(likeliest.value) > SURE * likeliest.deviation else NO_CAUSE


def _in_words(cause: Cause, strength: float) -> tuple[str, str]:
    """Return a cause with its size, and the remedy."""
    weak = f"the masks' contrast is {strength:.0%} of that in Psi"
    size, more = abs(cause.value), cause.value > 0
    if strength < LEAST_STRENGTH:
        return weak + ", as with other masks", DRIFT
    return {
        "offset": (
            f"the black level seems {size:.1%} of the mean reading too {'low' if more else 'high'}",
            "look for stray light; without darks, capture them",
        ),
        "gamma": (
            f"the readings follow the light to the power of {1 + cause.value:.2f}",
            "store frames without gamma or tone curve, or linearise them",
        ),
        "blur": (
            f"{weak}, as if their shadow were {'blurred' if more else 'sharper'} by "
            f"{size**0.5:.1f} pixels{' more' if more else ''}",
            "calibrate the bench as it is now",
        ),
        "distance": (
            f"{weak}, as with masks {size:.0%} {'further from' if more else 'nearer to'} the "
            "sensor",
            DRIFT,
        ),
        "vignetting": (
            f"the outermost rays seem to lose {min(size, 1):.0%} {'more' if more else 'less'} than "
            "in Psi",
            "calibrate at this aperture, or close the aperture",
        ),
    }.get(cause.name, (weak, DRIFT))


def _compression(e: Evidence) -> Iterator[Reason]:
    """Whether readings were stored with loss: JPEG, or few levels."""
    if e.blockiness is not None:
        yield Reason(
            "the readings were compressed in blocks of 8 x 8 pixels, as by JPEG",
            e.blockiness,
            "store raw frames",
            BLOCKINESS.level(e.blockiness),
        )
    steps, share = e.steps or 0.0, e.noise_share or 0.0
    if steps * share**0.5 > STEPS_SHARE:
        yield Reason(
            f"the readings are quantised: steps add {steps:.1f} times the sensor's noise",
            steps,
            "store more bits, or raise the gain",
            "doubt",
        )


def _pixels(e: Evidence) -> Iterator[Reason]:
    """Shares of readings that are wrong or missing: several shots make up for each other's."""
    shots = len(e.strengths)
    bad = BAD.times(shots**0.75 * _sensitivity(e).bad_pixels)
    yield Reason(
        f"{e.bad:.1%} of the pixels are bad, and not known as such",
        e.bad,
        "mask dead and hot pixels: a dark and a reference frame show them",
        bad.level(e.bad),
    )
    yield Reason(
        f"{e.saturated:.0%} of the readings are saturated",
        e.saturated,
        "expose less, or bracket the exposure",
        SATURATED.level(e.saturated / shots**0.25),
    )
    yield Reason(
        f"{e.short:.1%} of the readings are saturated where no other shot or exposure is not",
        e.short,
        "expose less, or bracket the exposure",
        SHORT.level(e.short),
    )
    # The pixels of an excluded shot are not at fault.
    of_shots = len(e.left_out) / shots
    listed = max(e.unusable - e.saturated - of_shots, 0.0) / max(1 - of_shots, 1 / shots)
    yield Reason(
        f"{listed:.0%} of the readings are of pixels that cannot be used",
        listed,
        "capture more shots, or replace the sensor",
        UNUSABLE.level(listed / shots**0.25),
    )
    yield Reason(
        f"{e.blind:.0%} of the picture has no usable reading in any shot; the largest hole is "
        f"{2 * e.hole_px:.0f} pixels wide, at row {e.hole_at[0]}, column {e.hole_at[1]}",
        e.blind,
        "expose less, bracket the exposure, or add a shot with the camera moved",
        BLIND.level(e.blind),
    )


def _noise(e: Evidence) -> Iterator[Reason]:
    """Whether noise hides the scene."""
    yield Reason(
        f"noise is {e.noise:.0%} of the mean reading",
        e.noise,
        "add light, expose longer or capture more shots",
        NOISE.level(e.noise),
    )


def _search(e: Evidence) -> Iterator[Reason]:
    """Reasons from the figures of methods that search disparities, or shifts between bands."""
    decided, at_end = e.parameters.get("decided"), e.parameters.get("at_end", 0.0)
    picture, parallax = picture_name(e.view_axes), shows_parallax(e.view_axes)
    searched = "disparities" if parallax else f"shifts from {picture} to {picture}"
    depth = "depth" if parallax else f"the shift from {picture} to {picture}"
    if decided is not None:
        yield Reason(
            f"{depth} cannot be determined in {1 - decided:.0%} of the textured patches: all "
            f"{searched} fit alike",
            decided,
            f"use a mask that differs from {picture} to {picture}, or capture more shots",
            "cannot tell" if 1 - decided > UNDECIDED else "trust",
        )
        if e.noise > NOISY and 1 - decided > LEFT_OPEN:
            yield Reason(
                f"noise is {e.noise:.0%} of the mean reading, and in {1 - decided:.0%} of the "
                f"textured patches several {searched} fit",
                e.noise,
                "add light, expose longer or capture more shots",
                "doubt",
            )
    yield Reason(
        f"{at_end:.0%} of the patches fit best at the limit of the {searched} searched",
        at_end,
        "raise furthest_px" + (", or focus nearer to the scene" if parallax else ""),
        "doubt" if at_end > AT_END else "trust",
    )


def _bands(e: Evidence) -> Iterator[Reason]:
    """Whether bands lie as far apart as Psi's masks: a prism displaces both alike.

    Behind a second prism, which undoes the first, bands lie in one place.
    """
    if e.shifts_px is not None:
        found, of_masks = e.shifts_px
        apart = min(abs(found - of_masks), found)
        yield Reason(
            f"the bands lie {found:.2f} pixels apart, those of Psi's masks {of_masks:.2f}: the "
            "scene does not show where they lie",
            apart,
            "do not read single bands, or capture more shots",
            "doubt" if apart > SHIFT_PX else "trust",
        )


def _misfit(e: Evidence) -> Iterator[Reason]:
    """Whether the light field leaves far more than noise of the readings somewhere."""
    times = e.parameters.get("misfit", 0.0)
    row, column = (e.parameters.get(f"misfit_{axis}", 0.0) for axis in ("row", "column"))
    yield Reason(
        f"unexplained residual of {times:.1f} sigma, largest near row {row:.0f}, column "
        f"{column:.0f}",
        times,
        "check Psi and the noise model, or capture more shots",
        "doubt" if times > MISFIT else "trust",
    )


def _fit(e: Evidence) -> Iterator[Reason]:
    """Whether the light field predicts held-out readings, better than simple guesses do."""
    if e.parallax is not None and e.parallax < LEAST_PARALLAX:
        yield Reason(
            "scene treated as flat: the frames show no parallax, and all views are alike",
            e.parallax,
            "if the scene has depth, focus nearer or farther, or capture more shots",
            "cannot tell",
        )
    for over, what in (
        (e.over_flat, f"one picture for all {picture_name(e.view_axes)}s"),
        (e.over_neighbours, "the mean of neighbouring readings"),
    ):
        if over is not None and over > 1:
            yield Reason(
                f"{what} predicts the validation readings better than the light field does",
                over,
                "check Psi and the noise, use another method, or capture more shots",
                "doubt",
            )


RULES = (
    _orientation, _compression, _shots, _coding, _colour, _masks, _pixels, _noise, _search,
    _bands, _misfit, _fit,
)  # fmt: skip
"""Of reasons of one level the first is named first: a cause before what it leads to."""
