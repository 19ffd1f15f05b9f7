"""What makes a running capture wait: a lamp, a temperature, a user's function out of range."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from drivers.errors import DriverError
from emmc_rig.acquisition.plan import Suspender
from emmc_rig.errors import AppError

Suspend = Callable[[], str]
"""Says why the capture has to wait, "" when it may go on; asked before each frame."""


def suspended_by(
    suspenders: Iterable[Suspender],
    details: Callable[[], Mapping[str, str]],
    further: Suspend | None = None,
) -> Suspend:
    """Return a function that says why a capture has to wait; details: of the camera, by name.

    Raises AppError with one line for a figure that cannot be read even now.
    """
    suspenders = tuple(suspenders)
    for place, one in enumerate(suspenders):
        try:
            _value(one, details)
        except (OSError, ValueError, KeyError, DriverError) as fault:
            raise AppError(
                f"suspend.{place}: {one.name} cannot be read ({_why(fault)}): correct its "
                f"{'file' if one.file is not None else 'camera'}, or leave it out"
            ) from fault

    def suspended() -> str:
        for one in suspenders:
            reason = _out_of_range(one, details)
            if reason:
                return reason
        return "" if further is None else further()

    return suspended


def _out_of_range(one: Suspender, details: Callable[[], Mapping[str, str]]) -> str:
    """Return in what a figure is out of its range, "" where it is not."""
    try:
        value = _value(one, details)
    except (OSError, ValueError, KeyError, DriverError) as fault:
        return f"{one.name} cannot be read ({_why(fault)})"
    if one.low is not None and not value >= one.low:
        return f"{one.name} is {value:g}, below {one.low:g}"
    if one.high is not None and not value <= one.high:
        return f"{one.name} is {value:g}, above {one.high:g}"
    return ""


def _value(one: Suspender, details: Callable[[], Mapping[str, str]]) -> float:
    if one.file is not None:
        text = Path(one.file).read_text(encoding="utf-8")
    else:
        assert one.camera is not None
        text = details()[one.camera]
    if not text.split():
        raise ValueError("it is empty")
    return float(text.split()[0])


def _why(fault: Exception) -> str:
    if isinstance(fault, OSError):
        return fault.strerror or str(fault)
    if isinstance(fault, KeyError):
        return f"the camera reports no {fault.args[0]}"
    return str(fault).partition("\n")[0]
