"""Draw the pictures of docs/which-cameras.md: `python docs/pictures/draw_cameras.py`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import product
from pathlib import Path

INK, GLASS, RAY = "#22303c", 'fill="#bfe3f2" fill-opacity="0.65" stroke="#22303c"', "#d98200"
SPECTRUM = ("#c8322d", "#e08a00", "#3f9b3a", "#1f6fb5", "#6b3fa0")
WIDTH, HEIGHT, MIDDLE = 640, 220, 100
POINT, LENS, MASK, SENSOR = 50, 260, 500, 560
CELL, CELLS = 24, 5

Parts = Iterator[str]


def line(x: float, y: float, to_x: float, to_y: float, colour: str = INK, wide: float = 1.5) -> str:
    """Return a line."""
    return (
        f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{to_x:.1f}" y2="{to_y:.1f}" '
        f'stroke="{colour}" stroke-width="{wide}"/>'
    )


def box(x: float, y: float, wide: float, high: float, fill: str, edge: str = INK) -> str:
    """Return a rectangle."""
    return (
        f'<rect x="{x:.1f}" y="{y:.1f}" width="{wide}" height="{high}" fill="{fill}" '
        f'stroke="{edge}"/>'
    )


def lens(x: float, y: float, wide: float, high: float) -> str:
    """Return a lens; wide, high: half of what it measures."""
    return f'<ellipse cx="{x}" cy="{y}" rx="{wide}" ry="{high}" {GLASS}/>'


def glass(path: str) -> str:
    """Return a piece of glass of another form."""
    return f'<path d="{path}" {GLASS}/>'


def words(x: float, text: str, y: float = HEIGHT - 16) -> str:
    """Return a label, below what it names."""
    return f'<text x="{x}" y="{y}" text-anchor="middle">{text}</text>'


def column(x: float, fills: Sequence[str], cell: float = CELL, wide: float = 8) -> Parts:
    """Yield cells above one another, in the middle of the picture."""
    top = MIDDLE - cell * len(fills) / 2
    for k, fill in enumerate(fills):
        yield box(x, top + k * cell, wide, cell, fill)


def heights(count: int = CELLS, cell: float = CELL) -> list[float]:
    """Return the middles of cells that `column` draws."""
    return [MIDDLE + (k - (count - 1) / 2) * cell for k in range(count)]


def lens_camera(openings: Sequence[str], rays: Sequence[str]) -> Parts:
    """Yield a point, the lens with its openings, the sensor and a ray through each opening.

    openings: their colours, INK where closed. rays: their colours, "" for none.
    """
    yield f'<circle cx="{POINT}" cy="{MIDDLE}" r="5" fill="{RAY}"/>'
    for y, ray in zip(heights(), rays, strict=True):
        if ray:
            yield line(POINT, MIDDLE, LENS, y, ray)
            yield line(LENS, y, SENSOR, MIDDLE, ray)
    yield lens(LENS, MIDDLE, 16, 76)
    yield from column(LENS - 4, openings)
    yield from column(SENSOR, ["#fff"] * 9, 14, 12)
    yield words(POINT, "scene")
    yield words(SENSOR, "sensor")


def coded_aperture() -> Parts:
    """A mask in the lens: a view is open or closed for all pixels."""
    code = (1, 0, 1, 1, 0)
    yield from lens_camera(
        ["#fff" if item else INK for item in code], [RAY * item for item in code]
    )
    yield words(LENS, "code in the lens, another in each shot")


def sensor_mask() -> Parts:
    """A mask before the sensor: a pixel sees each view through another cell."""
    yield from lens_camera(["#fff"] * CELLS, [RAY] * CELLS)
    cells = (1, 0, 0, 1, 1, 0, 1, 0, 1, 1, 0)
    yield from column(MASK, [INK if cell else "#fff" for cell in cells], 9, 5)
    yield words(LENS, "lens: views are its parts")
    yield words(MASK - 30, "mask")


def coloured_openings() -> Parts:
    """Openings of one colour each: each colour plane of the picture is a shot."""
    seen = [SPECTRUM[0], INK, SPECTRUM[2], INK, SPECTRUM[3]]
    yield from lens_camera(seen, [item if item != INK else "" for item in seen])
    yield words(LENS, "openings behind colour filters")


def spectral() -> Parts:
    """A mask, then a prism: each band sees the mask displaced."""
    yield f'<circle cx="{POINT}" cy="{MIDDLE}" r="5" fill="{RAY}"/>'
    yield line(POINT, MIDDLE, 330, MIDDLE, RAY, 3)
    yield from column(200, [INK if (k + 1) % 3 else "#fff" for k in range(11)], 12)
    for k, colour in enumerate(SPECTRUM):
        yield line(330, MIDDLE, SENSOR, MIDDLE + (k - 2) * 18, colour, 2)
    yield glass("M330 50 L372 150 L288 150 Z")
    yield from column(SENSOR, ["#fff"] * 11, 14, 12)
    labels = ((POINT, "scene"), (200, "mask"), (330, "prism"), (SENSOR, "sensor"))
    yield from (words(x, text) for x, text in labels)


def coded_exposure() -> Parts:
    """A shutter for each pixel: a time is open for some pixels."""
    side, many = 16, 5
    for at in range(many):
        x, y = 40 + 70 * at, 40 + 8 * at
        for row, col in product(range(many), repeat=2):
            fill = "#fff" if (3 * row + 2 * col + at) % many < 2 else INK
            yield box(x + col * side * 0.7, y + row * side, side * 0.7, side, fill)
        yield words(x + 28, f"time {at}", y + many * side + 18)
    yield line(400, MIDDLE, 450, MIDDLE)
    yield words(425, "summed", MIDDLE - 10)
    for row, col in product(range(many), repeat=2):
        yield box(470 + col * side, 56 + row * side, side, side, "#ffe3b3")
    yield words(510, "one frame")


def dense_psf() -> Parts:
    """A diffuser alone: a point lights the whole sensor."""
    yield f'<circle cx="{POINT}" cy="{MIDDLE}" r="5" fill="{RAY}"/>'
    tops = range(34, 170, 11)
    for k, y in enumerate(tops):
        yield line(POINT, MIDDLE, 330, y, RAY, 0.8)
        yield line(330, y, SENSOR, MIDDLE + 66 * ((k * 5) % 13 - 6) / 6, RAY, 0.8)
    wave = " ".join(f"Q {322 + 16 * (k % 2)} {28 + 12 * k} 330 {34 + 12 * k}" for k in range(12))
    yield glass(f"M330 22 {wave} L340 166 L340 22 Z")
    yield from column(SENSOR, ["#fff"] * 11, 14, 12)
    labels = ((POINT, "scene"), (330, "diffuser, no lens"), (SENSOR, "sensor"))
    yield from (words(x, text) for x, text in labels)


def microlenses() -> Parts:
    """Lenslets before the sensor: each view has pixels of its own."""
    rays = [SPECTRUM[0], "", SPECTRUM[2], "", SPECTRUM[3]]
    yield from lens_camera(["#fff"] * CELLS, rays)
    for y in heights(5, 28):
        yield lens(SENSOR - 14, y, 5, 14)
    for y, k in zip(heights(3, 8), (4, 2, 0), strict=True):
        yield box(SENSOR, y - 4, 12, 8, rays[k])
    yield words(LENS, "lens")
    yield words(SENSOR - 100, "lenslets")


PICTURES: dict[str, Callable[[], Parts]] = {
    "coded-aperture": coded_aperture,
    "sensor-mask": sensor_mask,
    "coloured-openings": coloured_openings,
    "spectral": spectral,
    "coded-exposure": coded_exposure,
    "dense-psf": dense_psf,
    "microlenses": microlenses,
}


def drawn(name: str) -> str:
    """Return a picture as SVG."""
    return framed(PICTURES[name]())


def framed(parts: Parts, wide: int = WIDTH, high: int = HEIGHT) -> str:
    """Return a picture as SVG, on white."""
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{wide}" viewBox="0 0 {wide} {high}" '
        f'font-family="sans-serif" font-size="14" fill="{INK}">'
    )
    return "\n".join([head, box(0, 0, wide, high, "#fff", "none"), *parts, "</svg>"]) + "\n"


if __name__ == "__main__":
    for picture in PICTURES:
        (Path(__file__).parent / f"camera-{picture}.svg").write_text(drawn(picture))
