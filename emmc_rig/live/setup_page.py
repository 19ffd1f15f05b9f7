"""The page to set up by, as the server needs it: pictures and actions of a `Watch`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from emmc_rig.errors import AppError
from emmc_rig.live.field_pictures import field_pictures
from emmc_rig.live.picture import KINDS, View, encoded, picture
from emmc_rig.live.server import COMMON_FILES, Action, Picture, Pictured, Query, finite, number_of
from emmc_rig.live.steps import LONGEST_UNASKED_S
from emmc_rig.live.watch import Watch


class SetupPage:
    """A `emmc_rig.live.server.Page` over a Watch.

    following: the command to go on with once a plan was saved; "": none is known.
    """

    files = ("page.html", "page.js", *COMMON_FILES)
    urgent = frozenset({"stop", "cancel"})

    def __init__(self, watch: Watch, following: str = "") -> None:
        self._watch = watch
        self.pictures: dict[str, Pictured] = {
            "picture.jpg": self._picture,
            **field_pictures(lambda: watch.light_field and watch.light_field.pictures()),
        }
        self.actions: dict[str, Action] = {
            "exposure": lambda seconds: watch.set_exposure_s(finite(seconds)),
            "gain": lambda factor: watch.set_gain(finite(factor)),
            "autoexpose": lambda longest_s=LONGEST_UNASKED_S: watch.auto_expose(finite(longest_s)),
            "cancel": watch.cancel,
            "jog": lambda axis, distance_um: watch.jog(str(axis), finite(distance_um)),
            "go": lambda axis, place_um: watch.go(str(axis), finite(place_um)),
            "home": lambda: watch.home(),
            "centre": watch.centre,
            "stop": watch.stop,
            "look": watch.look_at,
            "reference": lambda taken: watch.take_reference(taken),
            "refocus": watch.forget_focus,
            "autofocus": lambda span_um: watch.autofocus(finite(span_um)),
            "preview": watch.preview,
            "save": lambda: {**watch.save(), "next": following},
        }

    @property
    def version(self) -> int:
        """Grows with every change of the state."""
        return self._watch.version

    def state(self) -> dict[str, Any]:
        """Return what the Watch knows."""
        return self._watch.state()

    def touch(self) -> None:
        """Let frames be taken."""
        self._watch.newest()

    def listen(self, listener: Callable[[], None]) -> None:
        """Let `listener` be called after every change."""
        self._watch.listen(listener)

    def _picture(self, query: Query) -> Picture | None:
        view = _view(query)
        newest = self._watch.newest()
        if newest is None:
            return None

        def make() -> bytes:
            frame = self._watch.frame()
            assert frame is not None
            return encoded(picture(frame, view))

        return Picture(view, newest.number, make)


def _view(query: Query) -> View:
    kind = query.get("kind", "colour")
    if kind not in KINDS:
        raise AppError(f"kind={kind}: choose one of {', '.join(KINDS)}")
    whole = View()
    return replace(
        whole,
        kind=kind,
        x=number_of(query, "x", whole.x),
        y=number_of(query, "y", whole.y),
        part=number_of(query, "part", whole.part),
        longest_px=number_of(query, "px", whole.longest_px, int),
        marked=query.get("marked", "1") != "0",
        bright=query.get("bright", "0") != "0",
    )
