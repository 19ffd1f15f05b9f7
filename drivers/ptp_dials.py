"""What differs between makers of PTP cameras: how the shutter is released, and its settings."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

from drivers import ptp_codec as codec
from drivers.camera import Limits
from drivers.errors import CameraSettingError
from drivers.ptp_codec import Message, Operation, Property

if TYPE_CHECKING:
    from drivers.ptp import PtpSession

EXPOSURE_UNIT_S = 1e-4
EXPOSURE_SPECIALS = frozenset((0xFFFFFFFF, 0xFFFFFFFE, 0xFFFFFFFD))
"""Bulb and time, by which no exposure can be asked for."""
ISO_SPECIALS = frozenset((0xFFFF,))
"""Automatic."""


class Dial(Protocol):
    """One setting, in seconds or as ISO."""

    @property
    def value(self) -> float | None:
        """What it is; None where the camera does not say, or it is automatic."""

    @property
    def limits(self) -> Limits | None:
        """Lowest and highest value; None where it cannot be chosen."""

    def choose(self, target: float) -> None:
        """Set the nearest value that the camera has; raises `CameraSettingError`."""


class Body(Protocol):
    """How one maker's cameras take a picture.

    `on_card`: whether pictures lie on a card that can be listed; others are gone once fetched.
    """

    exposure: Dial
    iso: Dial
    on_card: bool

    def release(self) -> None:
        """Release the shutter; raises a `CaptureError` where the camera refuses to."""

    def event(self, timeout_s: float) -> Message | None:
        """Return the next event in the standard's form, None when none came in time."""


class StandardBody:
    """A camera that does as ISO 15740 says."""

    on_card = True

    def __init__(self, session: PtpSession) -> None:
        self._session = session
        self.exposure: Dial = StandardDial(
            session, Property.EXPOSURE_TIME, EXPOSURE_UNIT_S, EXPOSURE_SPECIALS
        )
        self.iso: Dial = StandardDial(session, Property.EXPOSURE_INDEX, 1.0, ISO_SPECIALS)

    def release(self) -> None:
        """Release the shutter."""
        self._session.request(Operation.INITIATE_CAPTURE, 0, 0)

    def event(self, timeout_s: float) -> Message | None:
        """Return the next event."""
        return self._session.next_event(timeout_s)


class StandardDial:
    """A property of the standard, in multiples of `unit`; `special` values are no numbers."""

    def __init__(
        self, session: PtpSession, code: int, unit: float, special: frozenset[int] = frozenset()
    ) -> None:
        self._session = session
        self._unit = unit
        self._special = special
        self._described = session.describe(code)
        self._now = self._described.current if self._described else None

    @property
    def value(self) -> float | None:
        """What it is."""
        now = self._now
        if not isinstance(now, int) or now <= 0 or now in self._special:
            return None
        return now * self._unit

    @property
    def limits(self) -> Limits | None:
        """Lowest and highest value."""
        if self._described is None or not self._described.writable:
            return None
        low, high = codec.limits(self._described, self._special)
        return low * self._unit, high * self._unit

    def choose(self, target: float) -> None:
        """Set the nearest value."""
        described = self._described
        if described is None or not described.writable:
            return
        value = codec.nearest(described, target / self._unit, self._special)
        try:
            self._now = self._session.write(described, value)
        except ValueError as error:
            raise CameraSettingError(f"property {described.code:#06x}", str(error)) from error


class CodedDial:
    """A property whose values are a maker's codes; `codes`: its values; `read`: its present one.

    meaning: of a code, None for those that are no numbers. write: sets a code.
    """

    def __init__(
        self,
        meaning: Callable[[int], float | None],
        read: Callable[[], int | None],
        codes: Callable[[], tuple[int, ...]],
        write: Callable[[int], None],
    ) -> None:
        self._meaning, self._read, self._codes, self._write = meaning, read, codes, write

    @property
    def value(self) -> float | None:
        """What it is."""
        code = self._read()
        return None if code is None else self._meaning(code)

    @property
    def limits(self) -> Limits | None:
        """Lowest and highest value."""
        values = self._values()
        return (min(values), max(values)) if values else None

    def choose(self, target: float) -> None:
        """Set the value that is nearest in ratio."""
        values = self._values()
        if values:
            self._write(values[min(values, key=lambda one: abs(math.log(one / target)))])

    def _values(self) -> dict[float, int]:
        found = {self._meaning(code): code for code in self._codes()}
        return {value: code for value, code in found.items() if value}


class NoDial:
    """A setting of which the camera says nothing that is understood here."""

    value: float | None = None
    limits: Limits | None = None

    def choose(self, target: float) -> None:
        """Leave it as it is."""
