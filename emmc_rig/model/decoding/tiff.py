"""TIFF files: every page is a frame, as a viewer shows it, with what the file states of it.

An OME-TIFF lists the page, and its file, of every plane. A file's own planes are taken, and those
of further files of its series unless these are read apart. A listed page that is missing is an
error, and so is a page that is not listed: tifffile's own series fill such gaps with zeros.
Runs in the child, see `emmc_rig.model.decoding.child`; whatever is wrong raises.
"""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
import tifffile
from numpy.typing import NDArray

from emmc_rig.model.decoding.pictures import upright, without_alpha
from emmc_rig.model.decoding.regular import check_regular

SECONDS = {
    "d": 86_400.0, "h": 3600.0, "min": 60.0, "s": 1.0, "ds": 0.1, "cs": 1e-2, "ms": 1e-3,
    "\u00b5s": 1e-6, "\u03bcs": 1e-6, "us": 1e-6, "ns": 1e-9, "ps": 1e-12,
}  # fmt: skip
"""Units of time of OME, with both letters that are written for micro."""
_REDUCED, _MASK = 1, 4
"""Bits of NewSubfileType: a smaller copy of another page, and its transparency."""
_NODATA, _MICRO_MANAGER, _ORIENTATION = 42113, 51123, 274
_COMPLETE_BITS = 8
_TORN = ("invalid page offset", "missing data", "corrupted", "circular")
"""Words in warnings of tifffile for pages that it could not find."""
_GREY = ("MINISBLACK", "MINISWHITE", "CFA", "LINEAR_RAW")
_COLOUR = ("RGB", "PALETTE", "YCBCR")
_TO_RGB = (6, 7, 33003, 33004, 33005, 34712, 50001)
"""Compressions that give RGB where a page states YCbCr: JPEG, JPEG 2000, WebP."""
_UNKNOWN = math.nan


@dataclass(frozen=True, eq=False)
class _Page:
    """A page with its exposure and time, NaN where its file states none."""

    page: Any
    exposure_s: float = _UNKNOWN
    time_s: float = _UNKNOWN


def read_tiff(path: str, apart: Collection[str]) -> tuple[NDArray, dict[str, Any]]:
    """Return frames (frame, y, x) or (frame, y, x, 3), and the facts of the file.

    apart: paths of files that are read for themselves. Facts: `full_scale` of whole numbers, else
    None; `exposures_s` and `times_s` of every frame; `members`, the files taken; `notes`, a
    sentence for what was left out by right; `stacked`, whether frames are written as the planes of
    a colour picture; `opaque`, whether no pixel is transparent.
    """
    with ExitStack() as files:
        check_whole = files.enter_context(_watched())
        tiff = files.enter_context(tifffile.TiffFile(path))
        members, described, notes = [path], tiff.ome_metadata, []
        if described is None:
            pages = [page.aspage() for top in tiff.pages for page in (top, *(top.pages or ()))]
            kept = [page for page in pages if not _is_copy(page)] or pages
            if len(kept) < len(pages):
                notes = [f"pages that are smaller copies are not taken: {len(pages) - len(kept)}"]
            taken = [_Page(page) for page in kept]
        else:
            series = _Series(tiff, Path(path), described, apart, files)
            taken, members = series.pages()
        taken = [_by_micro_manager(part) for part in taken]
        check_whole()
        is_alone = len(tiff.pages) == len(taken) == 1
        if described is None and is_alone and not tiff.is_micromanager:
            codes = _planes_of_one_page(tiff, taken[0].page)
            taken = taken * len(codes)
            shown = _shown(codes, taken[0].page, tiff.is_shaped)
        else:
            shown = _stack([part.page for part in taken], tiff.is_shaped)
            stated = (tiff.imagej_metadata or {}).get("images") if tiff.is_imagej else None
            if stated is not None and int(stated) > len(shown.frames):
                raise ValueError(
                    f"it states {stated} images and holds {len(shown.frames)}: cut short"
                )
        check_whole()
        facts = {
            "full_scale": _full_scale(taken[0].page, shown.frames.dtype),
            "exposures_s": _each([part.exposure_s for part in taken], len(shown.frames)),
            "times_s": _each([part.time_s for part in taken], len(shown.frames)),
            "members": members,
            "notes": notes,
            "stacked": shown.stacked,
            "opaque": shown.opaque,
        }
    return shown.frames, facts


class _Shown(NamedTuple):
    """Frames as a viewer shows them; stacked, opaque: as in the facts of `read_tiff`."""

    frames: NDArray
    stacked: bool
    opaque: bool


@contextmanager
def _watched() -> Iterator[Callable[[], None]]:
    """Yield a check that raises ValueError where tifffile logged pages that are missing."""
    said: list[str] = []
    handler, logger = logging.Handler(logging.WARNING), logging.getLogger("tifffile")
    handler.emit = lambda record: said.append(record.getMessage())

    def check() -> None:
        for words in said:
            if any(torn in words for torn in _TORN):
                raise ValueError(f"cut short: {words.rpartition('>')[2].strip()}")

    logger.addHandler(handler)
    try:
        yield check
    finally:
        logger.removeHandler(handler)


def _is_copy(page: Any) -> bool:
    return bool(page.subfiletype & (_REDUCED | _MASK))


def _each(values: list[float], count: int) -> list[float | None]:
    """Return a value for each of `count` frames, None where it is not known."""
    if len(values) != count:
        return [None] * count
    return [value if math.isfinite(value) else None for value in values]


def _by_micro_manager(part: _Page) -> _Page:
    """Return a page with what Micro-Manager's tag of that page states."""
    stated = part.page.tags.valueof(_MICRO_MANAGER)
    if not isinstance(stated, Mapping):
        return part
    found = {}
    for name, key in (("exposure_s", "Exposure-ms"), ("time_s", "ElapsedTime-ms")):
        if stated.get(key) is not None:
            found[name] = float(stated[key]) / 1000
    return replace(part, **found)


# From pages to frames.


def _planes_of_one_page(tiff: tifffile.TiffFile, page: Any) -> NDArray:
    """Return (plane, *page) of a file whose only page is followed by planes without a page."""
    series = tiff.series
    if len(series) == 1 and series[0].size > page.size:
        _check_strips(page)
        return series[0].asarray().reshape(-1, *page.shape)
    return _codes(page)


def _check_strips(page: Any) -> None:
    """Raise ValueError where a part of a page has no bytes, which tifffile fills."""
    parts = len(page.databytecounts)
    missing = sum(not count for count in page.databytecounts)
    if missing or not parts:
        raise ValueError(f"page {page.index}: {missing} of its {parts} parts hold nothing")


def _codes(page: Any) -> NDArray:
    _check_strips(page)
    return page.asarray()[None]


def _stack(pages: list[Any], is_shaped: bool) -> _Shown:
    """Return the frames of pages that are all alike."""
    first, stacked, opaque = _shown(_codes(pages[0]), pages[0], is_shaped)
    each = len(first)
    frames = np.empty((each * len(pages), *first.shape[1:]), first.dtype)
    frames[:each] = first
    for place, page in enumerate(pages[1:], 1):
        shown, _, solid = _shown(_codes(page), page, is_shaped)
        opaque = opaque and solid
        if shown.shape != first.shape or shown.dtype != first.dtype:
            sizes = [
                f"{'x'.join(map(str, codes.shape[1:]))} {codes.dtype}" for codes in (first, shown)
            ]
            raise ValueError(
                f"its pages differ: the first is {sizes[0]}, page {place + 1} of {len(pages)} is "
                f"{sizes[1]}; write pages of one size and depth into a file of their own"
            )
        frames[each * place : each * (place + 1)] = shown
    return _Shown(frames, stacked, opaque)


def _bits(page: Any) -> int:
    bits = page.bitspersample
    return max(bits) if isinstance(bits, tuple) else bits


def _full_scale(page: Any, dtype: np.dtype) -> int | None:
    """Return the code of white of whole numbers, None of others."""
    if dtype.kind != "u":
        return None
    bits = _bits(page)
    return 255 if bits < _COMPLETE_BITS or _coding(page) == "PALETTE" else 2**bits - 1


def _coding(page: Any) -> str:
    return str(getattr(page.photometric, "name", page.photometric))


def _shown(codes: NDArray, page: Any, is_shaped: bool) -> _Shown:
    """Return the frames of codes (plane, *page)."""
    coding, bits = _coding(page), _bits(page)
    if page.axes not in ("YX", "YXS", "SYX"):
        raise ValueError(f"a page with the axes {page.axes}, where a frame has y and x")
    if coding == "YCBCR" and page.compression not in _TO_RGB:
        coding = "YCBCR, not as JPEG"
    if coding not in _GREY + _COLOUR:
        raise ValueError(f"its values are coded as {coding}; save it as grey or as RGB")
    if _NODATA in page.tags and page.nodata is not None:
        blank = int(np.count_nonzero(codes == page.nodata))
        if blank:
            raise ValueError(
                f"pixels with the value {page.nodata:g}, which the file calls not valid: {blank}"
            )
    if codes.dtype == bool:
        codes = codes.astype(np.uint8)
    if coding == "MINISWHITE":
        if codes.dtype.kind != "u":
            raise ValueError("white is 0 in floating values; save it as grey, black is 0")
        codes = codes.dtype.type(2**bits - 1) - codes
    if coding == "PALETTE":
        codes = _of_palette(codes, page.colormap)
    elif bits < _COMPLETE_BITS and 255 % (2**bits - 1) == 0:
        codes = codes * np.uint8(255 // (2**bits - 1))
    stacked, opaque = False, True
    if "S" in page.axes:
        if page.axes == "SYX":
            codes = np.moveaxis(codes, 1, -1)
        extras = page.extrasamples or ()
        stacked = page.axes == "SYX" and is_shaped and coding == "RGB"
        if stacked or (coding in _GREY and not any(extras)):
            codes = np.moveaxis(codes, -1, 1).reshape(-1, *codes.shape[1:3])
        elif codes.shape[-1] in (2, 4):
            white = 1 if codes.dtype.kind == "f" else 2**bits - 1
            codes, opaque = without_alpha(codes, white)
    codes = upright(codes, int(page.tags.valueof(_ORIENTATION, 1)), (1, 2))
    return _Shown(codes, stacked, opaque)


def _of_palette(codes: NDArray, palette: NDArray) -> NDArray:
    """Return colours of 8 bits, grey as one value; some writers fill only the lower byte."""
    colours = (palette >> 8 if palette.max() > 255 else palette).astype(np.uint8).T[codes]
    grey = colours[..., 0]
    return grey if np.all(colours == grey[..., None]) else colours


# OME-TIFF.


class _Series:
    """The planes that an OME-XML lists, over one file or several.

    Source: OME-TIFF specification 6.3, "The TiffData element" (defaults of its attributes).
    """

    def __init__(
        self, tiff: tifffile.TiffFile, path: Path, described: str, apart: Collection[str],
        files: ExitStack,
    ) -> None:  # fmt: skip
        self._path, self._own, self._files = path, tiff, files
        self._apart = {os.path.realpath(part) for part in apart} - {os.path.realpath(path)}
        self._tiffs: dict[str, tifffile.TiffFile] = {"": tiff}
        root = ElementTree.fromstring(described)
        self._uuid = root.get("UUID")
        pointer = next((part for part in root if _tag(part) == "BinaryOnly"), None)
        if pointer is not None:
            root = self._elsewhere(pointer.get("MetadataFile", ""))
        self._images = [part for part in root.iter() if _tag(part) == "Pixels"]

    def pages(self) -> tuple[list[_Page], list[str]]:
        """Return the pages taken, in the order of images and planes, and the files they are in."""
        found: dict[tuple[int, int], tuple[str, int]] = {}
        stated: dict[tuple[int, int], tuple[float, float]] = {}
        expected = 0
        for number, pixels in enumerate(self._images):
            order = pixels.get("DimensionOrder", "XYZCT")[2:]
            channels = [part for part in pixels if _tag(part) == "Channel"]
            samples = [int(part.get("SamplesPerPixel", 1)) for part in channels]
            sizes = {axis: int(pixels.get(f"Size{axis}", 1)) for axis in order}
            sizes["C"] = max(sizes["C"] // max(samples, default=1), 1)
            total = math.prod(sizes.values())
            expected += total
            listed = [part for part in pixels if _tag(part) == "TiffData"]
            for entry in listed or [ElementTree.Element("TiffData")]:
                file, first = self._file_of(entry), int(entry.get("IFD", 0))
                plane = _plane_number(entry, "First", order, sizes)
                default = "1" if "IFD" in entry.attrib else None
                stated_count = entry.get("PlaneCount", entry.get("NumPlanes", default))
                count = int(stated_count or len(self._pages_of(file)))
                for k in range(min(count, total - plane)):
                    found[number, plane + k] = file, first + k
            for plane in pixels:
                if _tag(plane) == "Plane" and all(f"The{axis}" in plane.attrib for axis in order):
                    times = _duration(plane, "ExposureTime"), _duration(plane, "DeltaT")
                    stated[number, _plane_number(plane, "The", order, sizes)] = times
        if len(found) < expected:
            raise ValueError(
                f"its OME-XML states {expected} planes and lists pages of {len(found)}: save it "
                "again, or as a TIFF without OME-XML"
            )
        missing = sorted(
            file for file in {file for file, _ in found.values()} - {""}
            if not self._beside(file).exists()
        )  # fmt: skip
        if missing:
            rest = f" and {len(missing) - 3} more" if len(missing) > 3 else ""
            raise ValueError(
                f"{', '.join(missing[:3])}{rest} of its series is missing: put it beside this file"
            )
        self._check_unlisted({page for file, page in found.values() if not file})
        taken, members = [], [""]
        for place, (file, number) in sorted(found.items()):
            if file and os.path.realpath(self._beside(file)) in self._apart:
                continue
            pages = self._pages_of(file)
            if number >= len(pages):
                raise ValueError(
                    f"its OME-XML names page {number + 1} of {file or self._path.name}, which has "
                    f"{len(pages)}: cut short"
                )
            taken.append(_Page(pages[number].aspage(), *stated.get(place, (_UNKNOWN, _UNKNOWN))))
            members.append(file)
        if not taken:
            raise ValueError("its OME-XML lists no page of this file")
        return taken, [str(self._beside(file)) if file else str(self._path) for file in {*members}]

    def _beside(self, file: str) -> Path:
        return self._path.with_name(Path(file).name)

    def _file_of(self, entry: ElementTree.Element) -> str:
        """Return the file that holds the planes of an entry, "" for the file that is read."""
        uuid = next((part for part in entry if _tag(part) == "UUID"), None)
        if uuid is None:
            return ""
        name, own = uuid.get("FileName", ""), self._path.name
        is_own = not name or name == own or (uuid.text is not None and uuid.text == self._uuid)
        return "" if is_own else name

    def _check_unlisted(self, listed: set[int]) -> None:
        own = list(self._own.pages)
        others = (k for k in range(len(own)) if k not in listed)
        unlisted = [k for k in others if not _is_copy(own[k].aspage())]
        if unlisted:
            raise ValueError(
                f"{len(unlisted)} of its {len(own)} pages are no planes in its OME-XML, the first "
                f"is page {unlisted[0] + 1}: save it again, or as a TIFF without OME-XML"
            )

    def _pages_of(self, file: str) -> Any:
        if file not in self._tiffs:
            path = self._beside(file)
            check_regular(path, ValueError)
            self._tiffs[file] = self._files.enter_context(tifffile.TiffFile(path))
        return self._tiffs[file].pages

    def _elsewhere(self, name: str) -> ElementTree.Element:
        """Return the OME-XML that another file holds, a companion or a TIFF."""
        path = self._beside(name)
        check_regular(path, ValueError)
        if path.suffix.lower() not in (".tif", ".tiff"):
            return ElementTree.fromstring(path.read_bytes())
        with tifffile.TiffFile(path) as tiff:
            return ElementTree.fromstring(tiff.ome_metadata or "")


def _tag(element: ElementTree.Element) -> str:
    return element.tag.rpartition("}")[2]


def _plane_number(
    element: ElementTree.Element, start: str, order: str, sizes: Mapping[str, int]
) -> int:
    """Return the number of a plane from the indices that an element states, the first fastest."""
    number, step = 0, 1
    for axis in order:
        index = int(element.get(f"{start}{axis}", 0))
        if not 0 <= index < sizes[axis]:
            raise ValueError(f"its OME-XML states {start}{axis} {index}, of {sizes[axis]}")
        number += index * step
        step *= sizes[axis]
    return number


def _duration(plane: ElementTree.Element, key: str) -> float:
    """Return a time of a plane in seconds, NaN where it states none."""
    if plane.get(key) is None:
        return _UNKNOWN
    unit = plane.get(f"{key}Unit", "s")
    if unit not in SECONDS:
        raise ValueError(f"{key}Unit '{unit}' is no unit of time: {', '.join(SECONDS)}")
    return float(plane.get(key, "nan")) * SECONDS[unit]
