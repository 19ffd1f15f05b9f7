"""The page to set up by, as the server needs it: pictures and actions of a `Watch`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from emmc_rig.errors import AppError
from emmc_rig.live.light_field import field_pictures
from emmc_rig.live.picture import View, encoded, picture
from emmc_rig.live.server import COMMON_FILES, Action, Picture, Pictured, Query, finite
from emmc_rig.live.steps import LONGEST_UNASKED_S
from emmc_rig.live.watch import Watch
from emmc_rig.model.settings import validated


class SetupPage:
    """A `emmc_rig.live.server.Page` over a Watch.

    following: the command to go on with once a plan was saved; "": none is known.
    """

    files: tuple[str, ...] = ("page.html", "page.js", *COMMON_FILES)
    urgent: frozenset[str] = frozenset({"stop", "cancel"})

    def __init__(self, watch: Watch, following: str = "") -> None:
        self._watch, self._following = watch, following
        self.pictures: Mapping[str, Pictured] = {
            "picture.jpg": self._picture,
            **field_pictures(lambda: watch.light_field and watch.light_field.pictures()),
        }
        self.actions: Mapping[str, Action] = {
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
        """Return what the Watch knows, and the command to go on with."""
        return {**self._watch.state(), "next": self._following}

    def touch(self) -> None:
        """Let frames be taken."""
        self._watch.newest()

    def _picture(self, query: Query) -> Picture | None:
        view = validated(View, dict(query), "the picture", AppError)
        newest = self._watch.newest()
        if newest is None:
            return None

        def make() -> bytes:
            frame = self._watch.frame()
            assert frame is not None
            return encoded(picture(frame, view))

        return Picture(view.model_dump_json(), newest.number, make)
