"""GenICam features: what a camera's XML describes, read and written by name through a port.

EMVA's reference implementation (the package `genicam`, extra `u3v`) follows the description. Here
are the few accesses that a bench needs, with errors that name the feature. Nothing is cached: a
value is what the camera says now. Source: EMVA GenICam Standard 2.1.1 and the Standard Features
Naming Convention.
"""

from __future__ import annotations

import math
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Protocol

from emmc_rig.drivers.errors import (
    CameraDescriptionError,
    CameraSettingError,
    DriverError,
    GenicamMissingError,
)

XML_LIMIT = 32 << 20
Number = int | float
Value = Number | str
Limits = tuple[Number, Number]


class Port(Protocol):
    """The camera's memory."""

    def read(self, address: int, length: int) -> bytes:
        """Return `length` bytes from `address` on."""
        ...

    def write(self, address: int, data: bytes) -> None:
        """Store `data` from `address` on."""


class Features:
    """A camera's features, by their GenICam names; safe to use from several threads.

    Every method raises `CameraDescriptionError` for a feature that is missing or described in a
    way that cannot be followed, and what the port raises.
    """

    def __init__(self, xml: bytes, port: Port) -> None:
        try:
            from genicam import genapi
        except ImportError as error:
            raise GenicamMissingError from error
        if len(xml) > XML_LIMIT:
            raise CameraDescriptionError(f"its {len(xml)} bytes are more than {XML_LIMIT}")

        class Memory(genapi.AbstractPort):
            def read(self, address: int, length: int) -> bytes:
                return port.read(address, length)

            def write(self, address: int, data: bytes) -> None:
                port.write(address, bytes(data))

            def get_access_mode(self) -> int:
                return genapi.EAccessMode.RW

        self._genapi: Any = genapi
        # The library would wait for its own lock with Python's held, which the holder's port needs.
        self._lock = threading.RLock()
        self._memory, self._map = Memory(), genapi.NodeMap()
        try:
            self._map.load_xml_from_string(xml.decode())
            self._ports = [node.node for node in self._map.nodes if isinstance(node, genapi.IPort)]
            for node in self._ports:
                self._map.connect(self._memory, node.name)
        except (genapi.GenericException, UnicodeDecodeError) as error:
            raise CameraDescriptionError(f"it cannot be followed ({_shown(error)})") from error

    def __contains__(self, name: str) -> bool:
        return self._map.has_node(name)

    def has(self, name: str) -> bool:
        """Whether the camera describes the feature and offers it now."""
        if name not in self:
            return False
        with self._node(name) as node:
            return self._genapi.is_available(node)

    def is_writable(self, name: str) -> bool:
        """Whether the feature is there and may be changed now."""
        if name not in self:
            return False
        with self._node(name) as node:
            return self._genapi.is_writable(node)

    def value(self, name: str) -> Value:
        """Return a number, a truth, a text, or the name of a choice."""
        with self._node(name, "IInteger", "IFloat", "IBoolean", "IString", "IEnumeration") as node:
            return node.value

    def number(self, name: str) -> Number:
        """Return a number; a choice gives its code."""
        with self._node(name, "IInteger", "IFloat", "IBoolean", "IEnumeration") as node:
            if isinstance(node, self._genapi.IEnumeration):
                return node.get_int_value()
            return node.value

    def limits(self, name: str) -> Limits:
        """Return the least and the greatest value of a number; infinite where it has none."""
        with self._node(name, "IInteger", "IFloat") as node:
            return _limits(node)

    def unit(self, name: str) -> str:
        """Return a number's unit, "" where it has none."""
        with self._node(name) as node:
            return str(getattr(node, "unit", "")).strip()

    def choices(self, name: str) -> tuple[str, ...]:
        """Return the choices of an enumeration that are offered now."""
        with self._node(name, "IEnumeration") as node:
            return self._choices(node)

    def set(self, name: str, value: Value) -> None:
        """Store a number, a truth, or a choice by name.

        Raises `CameraSettingError`, before anything is sent, for a value that the feature cannot
        take or while it may not be changed.
        """
        with self._node(name, "IInteger", "IFloat", "IBoolean", "IEnumeration") as node:
            if not self._genapi.is_writable(node):
                raise CameraSettingError(name, "cannot be changed now: stop the acquisition first")
            if isinstance(node, self._genapi.IEnumeration):
                offered = self._choices(node)
                if value not in offered:
                    raise CameraSettingError(name, f"offers {', '.join(offered)}, not {value}")
                node.value = value
            elif isinstance(value, str):
                raise CameraSettingError(name, f"is a number, not {value!r}")
            elif isinstance(node, self._genapi.IBoolean):
                node.value = bool(value)
            elif isinstance(node, self._genapi.IInteger):
                node.value = _checked(name, node, round(value), node.inc)
            else:
                low, high = node.min, node.max
                node.value = min(max(_checked(name, node, float(value)), low), high)

    def set_nearest(self, name: str, value: Number) -> None:
        """Store the nearest to a number that the feature can take; raises as `set`."""
        with self._node(name, "IInteger", "IFloat") as node:
            low, high = _limits(node)
            value = min(max(value, low), high)
            if isinstance(node, self._genapi.IInteger):
                value = int(low) + round((value - low) / node.inc) * node.inc
                value -= node.inc if value > high else 0
        self.set(name, value)

    def execute(self, name: str) -> None:
        """Carry a command out."""
        with self._node(name, "ICommand") as node:
            if not self._genapi.is_writable(node):
                raise CameraSettingError(name, "cannot be carried out now")
            node.execute()

    @contextmanager
    def _node(self, name: str, *kinds: str) -> Iterator[Any]:
        """Yield a feature, of one of the library's interfaces if they are named."""
        with self._lock:
            if name not in self:
                raise CameraDescriptionError(f"it has no {name[:80]}")
            node = self._map.get_node(name)
            if kinds and type(node).__name__ not in kinds:
                kind = type(node).__name__.removeprefix("I")
                raise CameraDescriptionError(f"{name} ({kind}) has no such value")
            try:
                for port in self._ports:
                    port.invalidate_node()  # and with it every value read through it before
                yield node
            except DriverError:
                raise
            except (self._genapi.GenericException, ArithmeticError, ValueError) as error:
                raise CameraDescriptionError(
                    f"{name} cannot be worked out ({_shown(error)})"
                ) from error

    def _choices(self, node: Any) -> tuple[str, ...]:
        readable = self._genapi.is_readable
        return tuple(entry.symbolic for entry in node.entries if readable(entry))


def _limits(node: Any) -> Limits:
    """Return the limits of a number; the library states the greatest float for none."""
    low, high = node.min, node.max
    if low <= -sys.float_info.max:
        low = -math.inf
    return low, math.inf if high >= sys.float_info.max else high


def _checked(name: str, node: Any, value: Number, step: int = 1) -> Number:
    """Return a number that a feature takes; raises `CameraSettingError` for another number."""
    low, high = _limits(node)
    # Limits that a formula converts are rounded.
    slack = 1e-9 * max(abs(low), abs(high)) if isinstance(value, float) else 0
    if not low - slack <= value <= high + slack:
        raise CameraSettingError(name, f"goes from {low:g} to {high:g}, not to {value:g}")
    if isinstance(value, int) and step > 1 and (value - int(low)) % step:
        raise CameraSettingError(name, f"goes in steps of {step} from {low}, not {value}")
    return value


def _shown(error: Exception) -> str:
    """Return the first line of an error; the library adds the place in its own source."""
    return str(error).partition("\n")[0].partition(" (file ")[0][:200]
