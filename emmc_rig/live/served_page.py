"""A live page as its server sees it: files, pictures, a table of orders, and one state."""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Protocol

from pydantic import Field, create_model

from emmc_rig.errors import AppError
from emmc_rig.model.settings import Settings, validated

LARGEST = 1e12
"""No position, exposure or number of pixels comes near it."""
Number = Annotated[float, Field(strict=True, gt=-LARGEST, lt=LARGEST)]
Count = Annotated[int, Field(strict=True)]
Switch = Annotated[bool, Field(strict=True)]
"""Types of an order's arguments; text is not read as a number, nor a number as a switch."""
COMMON_FILES = ("page.css", "viewer.css", "common.js", "viewer.js", "field.js")
"""Of every page; the viewer is that of the reports."""


@dataclass(frozen=True)
class Picture:
    """A picture that is encoded once for all viewers: key and number name it, make returns it."""

    key: Hashable
    number: int
    make: Callable[[], bytes]
    media_type: str = "image/jpeg"


Query = Mapping[str, str]
Pictured = Callable[[Query], Picture | None]
"""Returns None before the first picture; raises AppError with one line."""


class Order:
    """An order that a page takes by POST: effect, arguments, urgency.

    effect: carries the order out, given its arguments by name; a mapping that it returns is part of
    the answer. urgent: the order has a thread of its own. arguments: by name the type, or the type
    and the default.
    """

    def __init__(
        self,
        effect: Callable[..., Mapping[str, Any] | None],
        urgent: bool = False,
        **arguments: Any,
    ) -> None:
        fields: dict[str, Any] = {
            name: kind if isinstance(kind, tuple) else (kind, ...)
            for name, kind in arguments.items()
        }
        self._effect, self.urgent = effect, urgent
        self._arguments: type[Settings] = create_model("Arguments", __base__=Settings, **fields)

    def carry_out(self, name: str, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return the answer to a POST of this order.

        Raises AppError with one line for arguments that are missing, unknown or invalid; raises
        what the effect raises.
        """
        if values and not self._arguments.model_fields:
            raise AppError(f"{name}: this order takes no arguments")
        arguments = validated(self._arguments, values, name, AppError)
        return {"done": name, **(self._effect(**dict(arguments)) or {})}


class PageState:
    """What a page shows: plain data by name, with a version that grows with every change.

    changed: its lock guards the state, and every change notifies it. derive: returns the parts that
    follow from the others.
    """

    def __init__(
        self, parts: Mapping[str, Any], derive: Callable[[], Mapping[str, Any]] = dict
    ) -> None:
        self.changed = threading.Condition()
        self._parts: dict[str, Any] = {"version": 0, "trouble": {}, **parts}
        self._derive = derive

    def __getitem__(self, name: str) -> Any:
        return self._parts[name]

    def snapshot(self) -> dict[str, Any]:
        """Return all parts of one version."""
        with self.changed:
            return dict(self._parts)

    def publish(self, trouble: Mapping[str, str] | None = None, **parts: Any) -> None:
        """Replace parts of the state, and wake the threads that wait for a change.

        trouble: lines by their source, "" for none; those of other sources stay.
        """
        with self.changed:
            self._parts |= {**parts, "trouble": {**self._parts["trouble"], **(trouble or {})}}
            self._parts |= self._derive()
            self._parts["version"] += 1
            self.changed.notify_all()


class Page(Protocol):
    """A page that is served; every member may be used by any thread.

    files: of the package `emmc_rig.live` or templates; the first is the page itself. pictures: by
    name, each takes a query. orders: by name. state: the page polls it.
    """

    files: tuple[str, ...]
    pictures: Mapping[str, Pictured]
    orders: Mapping[str, Order]
    state: PageState

    def touch(self) -> None:
        """Note that the page is being viewed."""
        ...
