"""A camera that gives RAW frames: what every camera offers, and the one that sends RAW files."""

from typing import Protocol

from drivers.errors import RawFrameError
from drivers.raw import RawFrame, decode_raw

EXPOSURE_AGREEMENT = 0.1
"""Shutter times are nominal: a marked 1/30 s is 1/32 s, 7 per cent off."""


class Camera(Protocol):
    """A camera on manual exposure."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a frame."""
        ...

    @property
    def cfa(self) -> str:
        """Colour phase or tile name of a frame, as in `RawFrame`."""
        ...

    @property
    def exposure_s(self) -> float:
        """Exposure of the next frame."""
        ...

    def set_exposure_s(self, exposure_s: float) -> None:
        """Choose the exposure of the frames that follow; raises `ValueError` unless positive."""
        ...

    def snap(self) -> RawFrame:
        """Expose and return one frame; raises a `DriverError`."""
        ...


class CaptureTransport(Protocol):
    """Whatever exposes once and hands over the RAW file: PTP, or a simulated camera."""

    def capture(self, exposure_s: float) -> bytes:
        """Expose for `exposure_s` and return the file's bytes."""
        ...


class RawFileCamera:
    """A camera over a transport that yields RAW files.

    Every frame must have the `shape` and `cfa` stated here, and the exposure that was asked for
    where the file states one; a frame that does not raises `RawFrameError`.
    """

    def __init__(
        self,
        transport: CaptureTransport,
        shape: tuple[int, int],
        cfa: str,
        exposure_s: float = 0.01,
    ) -> None:
        self._transport = transport
        self._shape = shape
        self._cfa = cfa
        self.set_exposure_s(exposure_s)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a frame."""
        return self._shape

    @property
    def cfa(self) -> str:
        """Colour phase or tile name of a frame, as in `RawFrame`."""
        return self._cfa

    @property
    def exposure_s(self) -> float:
        """Exposure of the next frame."""
        return self._exposure_s

    def set_exposure_s(self, exposure_s: float) -> None:
        """Choose the exposure of the frames that follow; raises `ValueError` unless positive."""
        if not exposure_s > 0:
            raise ValueError(f"an exposure of {exposure_s:g} s is not positive")
        self._exposure_s = exposure_s

    def snap(self) -> RawFrame:
        """Expose and return one frame; raises `RawFrameError` or an error of the transport."""
        frame = decode_raw(self._transport.capture(self._exposure_s), self._shape)
        if frame.cfa != self._cfa:
            raise RawFrameError(f"its colours are {frame.cfa} instead of {self._cfa}")
        if (
            frame.exposure_s is not None
            and abs(frame.exposure_s / self._exposure_s - 1) > EXPOSURE_AGREEMENT
        ):
            raise RawFrameError(
                f"it was exposed for {frame.exposure_s:g} s instead of {self._exposure_s:g} s"
            )
        return frame
