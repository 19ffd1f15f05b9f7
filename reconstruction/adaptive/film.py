"""Frame after frame of a film: what earlier frames showed is carried along by the scene's motion.

Of the frame before, disparity, texture and beliefs about disparities are carried to the present by
optical flow (`times`). The present texture is then fitted to the present frame and to the last
few: an earlier frame saw the present surfaces where the flow since then says (`OtherTime`). In
the next frame the same point of a surface meets other cells of the mask: time is a code.

Nothing carried is believed further than readings go. A reading of an earlier frame counts with the
variance that what is foretold misses around it, so that where flow is wrong, or something is hidden
meanwhile, the present frame decides alone. Where readings stay what they were, within their noise,
the scene rests, and its light field is kept (`resting`). Where the carried scene foretells the
present frame no better than total variation does over more than NEW_SHARE of the picture, it is a
first frame. A frame with a larger residual beside motion than the first frame's also begins a new
film: detail finer than the pixels changes as it moves, and nothing carried is right of it.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from emmc_rig.model.bands import in_views
from emmc_rig.model.frames import even_frames
from emmc_rig.model.json_text import parse_json
from emmc_rig.model.sensing import Psi
from emmc_rig.model.settings import Settings
from emmc_rig.reconstruction.adaptive import mixture, search
from emmc_rig.reconstruction.adaptive.fits import Fits
from emmc_rig.reconstruction.adaptive.joint import (
    FittedScene,
    TextureSettings,
    margin_of,
    solve,
    surfaces_of,
)
from emmc_rig.reconstruction.adaptive.parts import from_arrays, to_arrays
from emmc_rig.reconstruction.adaptive.rays import Surfaces
from emmc_rig.reconstruction.adaptive.resting import Rest
from emmc_rig.reconstruction.adaptive.settings import AdaptiveSettings
from emmc_rig.reconstruction.adaptive.survey import Plain, checked, plain_of, unseen_by
from emmc_rig.reconstruction.adaptive.sweep import STRIDE, mean_around, swept
from emmc_rig.reconstruction.adaptive.times import (
    HELD_WINDOW_PX,
    OtherTime,
    at_places,
    flow_between,
    padded,
    rested,
    sampled,
)
from emmc_rig.reconstruction.errors import ReconstructionError
from emmc_rig.reconstruction.inputs import Readings
from emmc_rig.reconstruction.result import Reconstruction

Array = NDArray[np.floating]


class FilmSettings(Settings):
    """Settings of films: of the frames after the first.

    segment: frames after which one begins as a first frame does; 0: never.
    """

    texture: TextureSettings = TextureSettings(
        steps=8, first_noise=0.1, refine_steps=4, shared_steps=0, sweeps=(0, 3)
    )
    misfit: float = Field(
        default=0.002, gt=0, description="deviation of readings that no texture explains"
    )
    earlier: int = Field(default=2, ge=1, description="frames before that are fitted, too")
    together: int = Field(
        default=4, ge=1, description="frames before that are searched, too, of masks that step"
    )
    segment: int = Field(default=0, ge=0)

    @field_validator("texture", mode="before")
    @classmethod
    def _rest_as_films_have_it(cls, given: object) -> object:
        """Complete a part of the texture's settings by the defaults of films."""
        own = cls.model_fields["texture"].default.model_dump()
        return {**own, **given} if isinstance(given, dict) else given


KEPT = 0.8
"""Part of the belief in a disparity that the next frame keeps; the rest is spread over all."""
NEW_SHARE = 0.4
"""Share of the picture that the carried scene predicts worse than total variation does, from which
on a frame begins anew."""
STILL = 1.05
"""Ratio of the squared residual of the scene carried without flow to that of the scene carried with
it, up to which nothing flows."""
RESTING_PX = 0.25
"""Flow up to which the light field of the frame before stands for that of the present one."""
WORSE, MOVING_SHARE = 1.2, 0.02
"""Residual of a following frame over that of first frames, from which on the film begins anew: with
this limit films of group A that pan lose 0.01 dB, and `panning-desk` loses 4.9 dB less (96x128,
`benchmarks/films.py`). And the least share of moving pixels for which the residual is compared."""
UNDERSTATED = 2.6
"""Of two fits of a capture the spread shows what closeness to the readings changes; a frame that
follows has one. Films of group A (96x128, `benchmarks/films.py`) stated 3.2 to 5.4 dB more than
their frames alone did, beside what each reached."""
ROOM_PX = 1.0
"""By which disparities may grow while a film goes on."""


@dataclass(frozen=True, eq=False)
class Known:
    """What a frame leaves for the next one.

    Attributes:
        scale: of the scene, see `Plain`.
        margin: samples by which texture and centre are padded.
        rest: what stands at rest.
        texture: (c, y, x), padded.
        centre: the centre view's disparity (y, x), padded.
        beliefs: about disparities.
        missed: least root mean square residual of first frames, over their noise.
        earlier: frames before, the latest last.
    """

    scale: float
    margin: int
    rest: Rest
    texture: Array
    centre: Array
    beliefs: search.Volume
    missed: float
    earlier: tuple[OtherTime, ...]


@dataclass(frozen=True, eq=False)
class Film:
    """A film up to a frame. known: None before the first one."""

    settings: FilmSettings = field(default_factory=FilmSettings)
    known: Known | None = None

    def arrays(self) -> dict[str, NDArray]:
        """Return all but Psi as arrays by name, to be stored: `restored` makes a film of them."""
        arrays: dict[str, NDArray] = {}
        about = json.dumps(to_arrays(self, arrays))
        return {"about": np.array(about), **arrays}

    @classmethod
    def restored(cls, arrays: Mapping[str, NDArray], psis: Sequence[Psi]) -> Film:
        """Return the film whose `arrays` these are.

        psis: the Psi of one shot for each frame of `known.earlier`, as given to `reconstruct`.
        """
        fitted = (checked(psi, even_frames(np.zeros(psi.frames_shape), 1.0)).psi for psi in psis)
        kinds = (cls, FilmSettings, Known, Rest, OtherTime, Readings, search.Volume)
        about = parse_json(str(arrays["about"]), "a stored film", ReconstructionError)
        return from_arrays(about, arrays, kinds, lambda: next(fitted))

    def after(
        self,
        plain: Plain,
        scene: FittedScene,
        result: Reconstruction,
        beliefs: search.Volume,
        missed: float,
        earlier: Sequence[OtherTime] = (),
    ) -> Film:
        """Return what is known after a frame; earlier: frames before, none of a first one."""
        margin, texture = scene.surfaces.margin, scene.clean
        if self.known is not None:
            missed = min(missed, self.known.missed)
        room_px = ROOM_PX + self.settings.texture.room_px
        # Where disparities shrank as they were fitted, there is more margin than needed.
        wider = max(margin_of(plain.given.psi, scene.centre, room_px) - margin, 0)
        margin += wider
        texture = np.pad(texture, ((0, 0), (wider, wider), (wider, wider)), mode="edge")
        centre = np.pad(scene.centre, margin, mode="edge")
        still = np.zeros((*scene.centre.shape, 2), dtype=np.float32)
        used = plain.given.usable & ~plain.held
        this = OtherTime(plain.bright, used, plain.picture, still, still)
        kept = (*earlier, this)[-max(self.settings.earlier, self.settings.together) :]
        rest = Rest.of(result, plain.given, plain.picture)
        known = Known(plain.scale, margin, rest, texture, centre, beliefs, missed, kept)
        return replace(self, known=known)

    def shown(self, psi: Psi) -> list[tuple[Readings, Array]]:
        """Return frames before, each with its picture, where masks move; none of masks that rest.

        psi: of the present frame. Raises ReconstructionError for another size.
        """
        if self.known is None:
            return []
        latest, scale = self.known.earlier[-self.settings.together :], self.known.scale
        before = latest[-1].readings.psi
        if before.size != psi.size:
            raise ReconstructionError(
                f"frames before were of {'x'.join(map(str, before.size))} samples, this Psi is of "
                f"{'x'.join(map(str, psi.size))}: use the Psi of the film"
            )
        if np.array_equal(before.weights, psi.weights):
            return []
        return [
            (frame.readings.over(1 / scale), np.float32(scale) * frame.picture) for frame in latest
        ]


@dataclass(frozen=True, eq=False)
class Followed:
    """The models of a frame that follows others.

    Attributes:
        plain: readings and the light field without surfaces.
        fits: the models.
        beliefs: about disparities, after the fit.
        earlier: frames before, with the flow to this one.
        moving: readings that were fitted where something moves, (shot, pixel_y, pixel_x).
        parameters: figures that the result reports.
    """

    plain: Plain
    fits: Fits
    beliefs: search.Volume
    earlier: list[OtherTime]
    moving: NDArray[np.bool_]
    parameters: dict[str, float]

    def worse(self, before: Known, light_field: Array) -> bool:
        """Return whether its light field leaves more where something moves than the first did."""
        given, moving = self.plain.given, self.moving
        if moving.mean() < MOVING_SHARE:
            return False
        left = given.frames - given.psi.forward(light_field)
        relative = np.square(left[moving]) / given.noise[moving]
        return float(relative.mean()) > (WORSE * before.missed) ** 2

    @property
    def slow(self) -> bool:
        """Whether motion is so small that the next frame, too, continues from the last frame.

        Fits that go on from each other lose more than so little motion gains: films that pan by
        0.1 pixels a frame are up to 1.5 dB better for it (buttercup), or 0.9 (dragons).
        """
        return self.parameters["flow_px"] < RESTING_PX


def followed(
    film: Film,
    given: Readings,
    settings: AdaptiveSettings,
    on_step: Callable[[int], None],
) -> Followed | None:
    """Return the models of a frame that follows; None where the film begins anew with it.

    1. Total variation of the present frame (`plain_of`), for flow and for held-out readings.
    2. The scene of the frame before is carried along the flow; places that rest have none.
    3. Where it predicts held-out readings worse than total variation does, the scene is new.
    4. The texture is fitted to this frame and the last few, the disparity swept again on the way.
    5. The fit is averaged with what stands at rest (`_models`).
    """
    before, own, psi = film.known, film.settings, given.psi
    assert before is not None
    margin, nearer = before.margin, 1 if settings.nearer == "larger" else -1
    plain = plain_of(given, before.scale, unseen_by(given), settings.start_steps)
    bright, used = plain.bright, given.usable & ~plain.held
    there, back, (centre, texture, missed) = _motion(before, plain, used, nearer)
    new = _share_new(missed, plain)
    if new > NEW_SHARE:
        return None
    earlier = [frame.since(there, back) for frame in before.earlier[-own.earlier :]]
    seen = [frame.seen(centre, margin, texture, nearer, own.misfit) for frame in earlier]
    beliefs = _carried(before.beliefs, back, psi.binning)
    fitted = replace(bright, usable=used)

    def again(texture: Array, surfaces: Surfaces) -> Array:
        nonlocal beliefs
        beliefs = swept(beliefs, fitted, texture, surfaces, settings)
        return search.per_pixel(beliefs, psi.size, psi.binning)

    inner = np.s_[margin : margin + psi.size[0], margin : margin + psi.size[1]]
    scene = solve(
        psi,
        np.ascontiguousarray(centre[inner]),
        nearer,
        bright.frames,
        bright.precision(plain.held, own.misfit),
        np.moveaxis(texture, 0, -1)[inner],
        own.texture,
        on_step=on_step,
        again=again,
        others=lambda *_: seen,
        margin=margin,
    )
    scene.surfaces.release()
    fits = _models(before, plain, scene, back)
    k = psi.binning
    return Followed(
        plain=plain,
        fits=fits,
        beliefs=beliefs,
        earlier=earlier,
        moving=used & (np.linalg.norm(back[::k, ::k], axis=-1) > RESTING_PX),
        parameters={
            "flow_px": float(np.median(np.linalg.norm(there, axis=-1))),
            "new_share": new,
            "still_share": 0.0,
        },
    )


def _motion(
    before: Known, plain: Plain, used: NDArray[np.bool_], nearer: int
) -> tuple[Array, Array, tuple[Array, Array, Array]]:
    """Return the flows since the frame before and back, (y, x, 2), and the scene carried.

    Of the scene: disparity of the present centre view (y, x) and texture (c, y, x), both padded;
    and the present frame less what these predict, over the scale, (shot, pixel_y, pixel_x).

    A place flows where the squared residual of the scene carried without flow exceeds STILL times
    that of the scene carried with it, in the mean around. used: readings that are fitted.
    """
    bright = plain.bright

    def carried_along(back: Array) -> tuple[Array, Array, Array]:
        at = at_places(before.centre.shape) + padded(back, before.margin)
        centre = sampled(before.centre, at)
        texture = np.stack([sampled(colour, at, cubic=True) for colour in before.texture])
        surfaces = surfaces_of(bright.psi, centre, before.margin, nearer, len(texture))
        return centre, texture, bright.frames - surfaces.forward(texture)

    there, back = flow_between(before.earlier[-1].picture, plain.picture)
    scene, unmoved = carried_along(back), carried_along(np.zeros_like(back))
    missed, missed_unmoved = (
        mean_around(np.square(left), used.astype(np.float32)).sum(axis=0)
        for *_, left in (scene, unmoved)
    )
    flows = missed_unmoved > STILL * missed
    if not flows.all():
        there, back = rested(there, back, (~flows).astype(np.float32))
        scene = carried_along(back)
    return there, back, scene


def _models(before: Known, plain: Plain, scene: FittedScene, back: Array) -> Fits:
    """Return the models of a frame that follows: two of surfaces, and total variation.

    The first is the present fit. In the second the light field of the frame before stands by
    exp(-|flow|^2 / RESTING_PX^2).
    """
    given = plain.given
    light_field = scene.surfaces.light_field(np.float32(before.scale) * scene.texture)
    fit = mixture.stored(np.clip(light_field, 0, 1, out=light_field))
    slow = np.exp(-np.square(back / RESTING_PX).sum(axis=-1))
    models = [fit, _standing(before.rest.light_field, fit, scene.surfaces.disparity, slow)]
    residuals: list[Array] = [
        given.frames - given.psi.forward(mixture.values(model)) for model in models
    ]
    models.append(plain.plain)
    residuals.append(plain.plain_residual)
    return Fits(models, residuals, scene, with_patches=False, understated=UNDERSTATED)


def _standing(
    before: NDArray[np.uint16], present: NDArray[np.uint16], disparity: Array, stands: Array
) -> NDArray[np.uint16]:
    """Return the light field before by the share of it that stands, the present one by the rest.

    disparity: of the present rays (v, u, y, x). stands: share of the centre view (y, x).
    """
    own, views = at_places(stands.shape), disparity.shape[:2]
    out = np.empty_like(before)

    def work(at: tuple[int, int]) -> None:
        steps = np.array([n - of // 2 for n, of in zip(at, views, strict=True)], np.float32)
        share = sampled(stands, own - disparity[at][..., None] * steps)[..., None]
        out[at] = np.rint(share * before[at] + (1 - share) * present[at])

    in_views(work, views)
    return out


def _share_new(foretold: Array, plain: Plain) -> float:
    """Return the share of pixels around which held-out readings are foretold worse by what is
    carried than by total variation; foretold: residual, over the scale."""
    if not plain.held.any():
        return 0.0
    own, others = (
        mean_around(np.square(residual), plain.held.astype(np.float32), HELD_WINDOW_PX)
        for residual in (foretold, plain.plain_residual / plain.scale)
    )
    return float(np.mean(own > others))


def _carried(beliefs: search.Volume, back: Array, binning: int) -> search.Volume:
    """Return beliefs of the frame before, on every STRIDE-th pixel of the present one."""
    rows, columns = (
        np.arange(0, length // binning, STRIDE, dtype=float) for length in back.shape[:2]
    )
    moved = back[:: STRIDE * binning, :: STRIDE * binning] / binning
    across, down = np.meshgrid(columns, rows)
    places = []
    for grid in beliefs.grids:
        where = [
            np.interp(at, centres, np.arange(len(centres))).astype(np.float32)
            for at, centres in zip(
                (across + moved[..., 1], down + moved[..., 0]), grid.centres[::-1], strict=True
            )
        ]
        places.append((where[0], where[1]))
    chances = np.stack(
        [
            search.interpolated(beliefs, lambda grid, i=i: grid.probability[..., i], places)
            for i in range(len(beliefs.disparities))
        ],
        axis=-1,
    )
    chances /= np.maximum(chances.sum(axis=-1, keepdims=True), 1e-20)
    chances = KEPT * chances + np.float32((1 - KEPT) / chances.shape[-1])
    chances = np.maximum(chances, np.float32(1e-20))
    nearest = tuple(np.rint(part).astype(int) for part in places[0][::-1])
    return replace(
        beliefs, centres=(rows, columns), probability=chances, evidence=np.log(chances),
        kind=beliefs.kind[nearest], decisive=beliefs.decisive[nearest], between=None,
    )  # fmt: skip
