"""One frame of a session as planned: how the bench must stand, and how to expose it."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal, get_args

Kind = Literal[
    "dark", "metering", "reference", "whiteboard", "open", "held-out", "check", "turned", "shot"
]
KINDS: tuple[Kind, ...] = get_args(Kind)
VALIDATION: Kind = "held-out"
"""What sessions call the open whiteboards that no fit uses, since version 0.2."""


def kind_name(kind: str) -> str:
    """Return what a kind of frame is called before users."""
    return "validation" if kind == VALIDATION else kind


SHOT_DARK = "dark-shot"
"""How ids of darks begin that are exposed as the shots are."""


@dataclass(frozen=True)
class Bench:
    """How the bench stands for a frame.

    target: what is before the camera. fitting: the first shot with the same masks and filter;
    masks_in: whether these masks are in the beam. offsets_um: stage axes by name, from where each
    is centred; an axis not named stays. board_turn_deg: how the white board is turned in its plane.
    """

    target: Literal["scene", "whiteboard"]
    lamp: str
    shot: int
    fitting: int
    masks_in: bool
    offsets_um: Mapping[str, float] = field(default_factory=dict)
    board_turn_deg: float = 0.0

    def set_by_hand(self, axes: Collection[str] = ()) -> tuple:
        """Return what somebody has to do at the bench: the same where no hand is needed between.

        axes: those that a hand moves.
        """
        places = tuple(self.offsets_um.get(axis) for axis in sorted(axes))
        return self.target, self.fitting, self.masks_in, self.board_turn_deg, *places


@dataclass(frozen=True)
class PlannedFrame:
    """One frame; `id` is unique in its session.

    exposure_s: None where it is metered, by the frame `metered_by`: then it is exposed `light`
    times as long as that frame asks for, a whiteboard because so much less light comes to the
    sensor. view: (v, u) of a whiteboard's pinhole. A bracket is the frames of a shot with
    different exposures; `repeat` counts equal frames. part: parts are captured in this order,
    frames of a part in any. window: by how many aperture cells the plate's window is
    moved, x and y. film: its place in time, from 0, of a frame of a film.
    """

    id: str
    kind: Kind
    bench: Bench
    exposure_s: float | None
    gain: float = 1.0
    repeat: int = 0
    view: tuple[int, int] | None = None
    metered_by: str | None = None
    light: float = 1.0
    part: int = 0
    window: tuple[int, int] = (0, 0)
    film: int | None = None

    @property
    def is_still_shot(self) -> bool:
        """Whether it is a shot of the scene that is no frame of a film."""
        return self.kind == "shot" and self.film is None

    @property
    def is_metered_shot(self) -> bool:
        """Whether it shows the scene, exposed as metering asks for."""
        return self.kind == "shot" and self.exposure_s is None

    @property
    def is_exposed_as_shots(self) -> bool:
        """Whether it is a metered shot of the scene, or a dark of one."""
        return self.exposure_s is None and self.bench.target == "scene"

    @property
    def is_dark_of_shots(self) -> bool:
        """Whether it is a dark for the shots of the scene alone."""
        return self.kind == "dark" and self.id.startswith(SHOT_DARK)

    @property
    def is_optional(self) -> bool:
        """Whether it is only taken where metering asks for it: a longer one of a bracket."""
        return self.is_metered_shot and self.light > 1

    def as_dict(self) -> dict[str, Any]:
        """Return plain data, for JSON."""
        own = asdict(self)
        if self.film is None:
            del own["film"]
        return {"id": own.pop("id"), "kind": own.pop("kind"), **own.pop("bench"), **own}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> PlannedFrame:
        """Return the frame that `as_dict` described; raises `KeyError` or `TypeError`.

        Keys that came after version 0.2 may be missing.
        """
        bench = {own.name for own in fields(Bench)}
        own = {key: value for key, value in data.items() if key not in bench}
        for name in ("view", "window"):
            own[name] = tuple(own[name]) if own.get(name) is not None else getattr(cls, name)
        return cls(bench=Bench(**{key: data[key] for key in bench & data.keys()}), **own)
