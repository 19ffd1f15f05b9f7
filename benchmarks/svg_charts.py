"""Small charts as SVG text, light or dark as the reader's screen is: dots, lines, points."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from html import escape

WIDTH, TEXT_PX = 560, 14
"""Of the drawing: at this size its words are readable on a phone 390 pixels wide, too."""
CHARACTER_PX = 7.6
"""Width of a character, to keep labels apart."""
ROW_PX, PLOT_PX = 26, 250
MOST_POWERS = 4
"""Of ten on a logarithmic axis, with figures between them."""
STYLE = """
svg{--paper:#fff;--ink:#1d2730;--soft:#55626d;--grid:#dfe5ea;--c0:#0b63c4;--c1:#c2570c;--c2:#2b8a4b;
--c3:#8b3fa8;--c4:#7b8894;font:14px system-ui,sans-serif}
@media(prefers-color-scheme:dark){svg{--paper:#181c20;--ink:#e8edf1;--soft:#a9b6c1;--grid:#333c44;
--c0:#6db3ff;--c1:#ff9d57;--c2:#6fd08f;--c3:#d79bf0;--c4:#8e9ba6}}
text{fill:var(--ink)}.soft{fill:var(--soft)}.title{font-weight:600;font-size:16px}
.grid{stroke:var(--grid)}.paper{fill:var(--paper);stroke:var(--grid)}
"""
COLOURS = [f"var(--c{k})" for k in range(5)]

Points = Sequence[tuple[float, float]]


def dots(
    title: str,
    unit: str,
    rows: Sequence[str],
    series: Mapping[str, Sequence[float]],
    mark: float | None = None,
) -> str:
    """Return a chart with a row for each name and a dot for each series, along one axis.

    mark: a value that the axis holds and that a line stands at.
    """
    marks = () if mark is None else (mark,)
    low, high = _span([*marks, *(value for values in series.values() for value in values)])
    left = 24 + CHARACTER_PX * max(map(len, rows))
    frame = _Frame(title, list(series), left, ROW_PX * len(rows), (low, high))
    bottom = frame.top + frame.height

    def parts() -> Iterator[str]:
        yield from frame.vertical(_ticks(low, high), unit)
        for at in map(frame.x, marks):
            yield _line(at, frame.top, at, bottom, "var(--soft)", 2)
        for row, name in enumerate(rows):
            y = frame.top + (row + 0.5) * ROW_PX
            yield _text(left - 10, y + 5, name, "end")
            at = [values[row] for values in series.values()]
            yield _line(frame.x(min(at)), y, frame.x(max(at)), y, "var(--grid)", 5)
            for colour, value in zip(COLOURS, at, strict=False):
                yield _dot(frame.x(value), y, colour, f"{name}: {value:g} {unit}")

    return frame.framed(parts(), bottom)


def lines(
    title: str,
    axes: tuple[str, str],
    series: Mapping[str, Points],
    beside: Sequence[Points] = (),
    log: bool = False,
) -> str:
    """Return lines over an axis; those `beside` are thin and without a name.

    axes: what x and y are, with units. log: whether x is logarithmic.
    """
    frame = _plot(title, axes, [*series.values(), *beside], list(series), log)

    def parts() -> Iterator[str]:
        for line in beside:
            yield _path(frame, line, COLOURS[4], 1)
        for colour, line in zip(COLOURS, series.values(), strict=False):
            yield _path(frame, line, colour, 3)
            yield from (_dot(frame.x(x), frame.y(y), colour, f"{x:g}: {y:.2f}") for x, y in line)

    return frame.plotted(axes, parts())


def points(
    title: str, axes: tuple[str, str], series: Mapping[str, Mapping[str, tuple[float, float]]]
) -> str:
    """Return named points over a logarithmic x, in a colour for each series."""
    frame = _plot(
        title, axes, [list(named.values()) for named in series.values()], list(series), True
    )

    def parts() -> Iterator[str]:
        taken: list[tuple[float, float, float]] = []
        for colour, named in zip(COLOURS, series.values(), strict=False):
            for name, (x, y) in sorted(named.items(), key=lambda item: -item[1][1]):
                at, wide = frame.x(x) + 9, CHARACTER_PX * len(name)
                if at + wide > WIDTH - 8:
                    at -= 18 + wide
                high = frame.y(y) + 5
                while any(
                    abs(high - other) < TEXT_PX and at < end and start < at + wide
                    for other, start, end in taken
                ):
                    high += 3
                taken.append((high, at, at + wide))
                yield _dot(frame.x(x), frame.y(y), colour, f"{name}: {x:.2g} s, {y:.2f} dB")
                yield _text(at, high, name, style="soft")

    return frame.plotted(axes, parts())


class _Frame:
    """Where a chart's title, legend and axes lie; x and y turn values into places."""

    def __init__(
        self, title: str, names: Sequence[str], left: float, height: float,
        across: tuple[float, float], up: tuple[float, float] = (0, 1), log: bool = False,
    ):  # fmt: skip
        self.title = textwrap.wrap(title, int((WIDTH - 24) / 9.4))
        self.names = list(names)
        self.legend = _laid(names, WIDTH - 24)
        self.left, self.height, self.log = left, height, log
        self.top = 26 + 21 * len(self.title) + 24 * (self.legend[-1][1] + 1 if names else 0)
        self.across, self.up = across, up

    def x(self, value: float) -> float:
        scale = math.log if self.log else float
        low, high, at = map(scale, (*self.across, value))
        return self.left + (at - low) / (high - low) * (WIDTH - 24 - self.left)

    def y(self, value: float) -> float:
        low, high = self.up
        return self.top + self.height * (1 - (value - low) / (high - low))

    def vertical(self, ticks: Sequence[float], name: str) -> Iterator[str]:
        """Yield the grid of x, with its figures and its name below the plot."""
        bottom = self.top + self.height
        for tick in ticks:
            yield _line(self.x(tick), self.top, self.x(tick), bottom, "var(--grid)")
            figure = f"{tick:,.10g}"
            at = min(self.x(tick), WIDTH - 6 - CHARACTER_PX * len(figure) / 2)
            yield _text(at, bottom + 18, figure, "middle", "soft")
        yield _text((self.left + WIDTH - 24) / 2, bottom + 38, name, "middle", "soft")

    def plotted(self, axes: tuple[str, str], parts: Iterator[str]) -> str:
        """Return the chart of lines or points with both axes."""

        def both() -> Iterator[str]:
            low, high = self.across
            yield from self.vertical((_decades if self.log else _ticks)(low, high), axes[0])
            for tick in _ticks(*self.up):
                yield _line(self.left, self.y(tick), WIDTH - 24, self.y(tick), "var(--grid)")
                yield _text(self.left - 8, self.y(tick) + 5, f"{tick:g}", "end", "soft")
            yield _text(12, self.top - 9, axes[1], style="soft")
            yield from parts

        return self.framed(both(), self.top + self.height)

    def framed(self, parts: Iterator[str], bottom: float) -> str:
        """Return the whole drawing: paper, title, legend, parts."""
        high = bottom + 50

        def every() -> Iterator[str]:
            yield (
                f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{high:.0f}" '
                f'viewBox="0 0 {WIDTH} {high:.0f}" role="img" '
                f'aria-label="{escape(" ".join(self.title), quote=True)}">'
            )
            yield f"<style>{STYLE}</style>"
            yield (
                f'<rect class="paper" x=".5" y=".5" width="{WIDTH - 1}" height="{high - 1:.0f}" '
                'rx="6"/>'
            )
            for number, words in enumerate(self.title):
                yield _text(12, 26 + 21 * number, words, style="title")
            for colour, name, (x, row) in zip(COLOURS, self.names, self.legend, strict=False):
                y = 26 + 21 * len(self.title) + 24 * row
                yield _dot(18 + x, y - 5, colour, name)
                yield _text(28 + x, y, name)
            yield from parts
            yield "</svg>"

        return "\n".join(every()) + "\n"


def _plot(
    title: str, axes: tuple[str, str], every: Sequence[Points], names: Sequence[str], log: bool
) -> _Frame:
    xs = [x for line in every for x, _ in line]
    low, high = _span([y for line in every for _, y in line])
    across = (min(xs) / 1.3, max(xs) * 1.3) if log else _span(xs)
    frame = _Frame(title, names, 52, PLOT_PX, across, (low, high), log)
    frame.top += 22 if axes[1] else 0
    return frame


def _laid(names: Sequence[str], wide: float) -> list[tuple[float, int]]:
    """Return where each name of the legend begins, and in which row."""
    places, x, row = [], 0.0, 0
    for name in names:
        takes = 32 + CHARACTER_PX * len(name)
        if x and x + takes > wide:
            x, row = 0.0, row + 1
        places.append((x, row))
        x += takes
    return places


def _span(values: Sequence[float]) -> tuple[float, float]:
    """Return ends of an axis that holds the values and begins and ends on a tick."""
    low, high = min(values), max(values)
    step = _step(high - low or 1)
    return math.floor(low / step + 1e-9) * step, math.ceil(high / step - 1e-9) * step


def _step(length: float) -> float:
    """Return the round distance of about five ticks over a length."""
    rough = length / 5
    power = 10 ** math.floor(math.log10(rough))
    return next(times * power for times in (1, 2, 5, 10) if times * power >= rough * 0.8)


def _ticks(low: float, high: float) -> list[float]:
    step = _step(high - low)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [round(number * step, 10) for number in range(first, last + 1)]


def _decades(low: float, high: float) -> list[float]:
    """Return 1, 2 and 5 of every power of ten between the ends of a logarithmic axis.

    Of many powers, 1 alone: there is no room for more.
    """
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    of_each = (1, 2, 5) if len(powers) <= MOST_POWERS else (1,)
    every = [round(times * 10.0**power, 10) for power in powers for times in of_each]
    return [value for value in every if low <= value <= high]


def _line(x: float, y: float, to_x: float, to_y: float, colour: str, wide: float = 1) -> str:
    return (
        f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{to_x:.1f}" y2="{to_y:.1f}" '
        f'stroke="{colour}" stroke-width="{wide}"/>'
    )


def _dot(x: float, y: float, colour: str, says: str) -> str:
    return (
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="5" fill="{colour}" stroke="var(--paper)">'
        f"<title>{escape(says)}</title></circle>"
    )


def _text(x: float, y: float, words: str, anchor: str = "start", style: str = "") -> str:
    kind = f' class="{style}"' if style else ""
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"{kind}>{escape(words)}</text>'


def _path(frame: _Frame, line: Points, colour: str, wide: float) -> str:
    places = " ".join(f"{frame.x(x):.1f},{frame.y(y):.1f}" for x, y in line)
    faint = ' stroke-opacity=".55"' if wide == 1 else ""
    return (
        f'<polyline points="{places}" fill="none" stroke="{colour}" stroke-width="{wide}"{faint}/>'
    )
