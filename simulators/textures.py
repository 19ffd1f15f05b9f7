"""Procedural textures: painters from a random generator and colours to a square of RGBA.

A texture is (side, side, 4) RGBA in [0, 1], side a power of two; its texture coordinates p (along
columns) and q (along rows) run from 0 to 1. Tiled ones join at their edges. Colours are written as
in HTML.
"""

import cv2
import numpy as np


def grid(side: int) -> tuple[np.ndarray, np.ndarray]:
    """Texture coordinates p (along columns) and q (along rows) of every texel."""
    q, p = (np.indices((side, side), dtype=np.float32) + 0.5) / side
    return p, q


def noise(
    rng: np.random.Generator,
    side: int,
    lowest: float = 2,
    highest: float = 90,
    slope: float = 1.0,
    along: tuple[float, float] = (1.0, 1.0),
) -> np.ndarray:
    """Periodic noise with amplitude frequency^-slope: mean 0, deviation 1, `along` (p, q) longer.

    Frequencies are cycles per side of the texture.
    """
    fq = np.fft.fftfreq(side, 1 / side)[:, np.newaxis] * along[1]
    fp = np.fft.rfftfreq(side, 1 / side)[np.newaxis, :] * along[0]
    f = np.hypot(fp, fq).astype(np.float32)
    amplitude = np.where(f >= lowest, np.maximum(f, 1) ** -slope, 0) * np.exp(-((f / highest) ** 2))
    phases = rng.standard_normal((*f.shape, 2), dtype=np.float32).view(np.complex64)[..., 0]
    import scipy.fft  # SciPy loads for a third of a second, which a measured scene need not

    noise = np.asarray(scipy.fft.irfft2(amplitude * phases, s=(side, side), workers=-1))
    return (noise / noise.std()).astype(np.float32)


def painted(shade: np.ndarray, *colours: str, alpha: np.ndarray | None = None) -> np.ndarray:
    """RGBA from a shade in [0, 1] through evenly spaced colours, written as in HTML."""
    stops = np.array([[int(c[i : i + 2], 16) / 255 for i in (1, 3, 5)] for c in colours])
    places = np.linspace(0, 1, len(colours))
    channels = [np.interp(shade, places, stops[:, k]).astype(np.float32) for k in range(3)]
    opaque = np.ones_like(channels[0]) if alpha is None else alpha.astype(np.float32)
    return np.stack([*channels, opaque], axis=-1)


def mixed(below: np.ndarray, above: np.ndarray, amount: np.ndarray) -> np.ndarray:
    """Blend of two textures: `below` where `amount` (y, x) is 0, `above` where it is 1."""
    return below + (above - below) * amount[..., np.newaxis]


def step(x: np.ndarray, edge: float, softness: float) -> np.ndarray:
    """0 below the edge, 1 above, smooth over `softness` on either side."""
    k = np.clip((x - edge) / (2 * softness) + 0.5, 0, 1)
    return k * k * (3 - 2 * k)


def rectangle(side: int, margin: float = 0.02) -> np.ndarray:
    """Alpha that fades at the edges of a card, for smooth edges in every view."""
    p, q = grid(side)
    inside = np.minimum(np.minimum(p, 1 - p), np.minimum(q, 1 - q))
    return step(inside, margin / 2, margin / 3)


def wood(rng: np.random.Generator, *colours: str, planks: int = 5, side: int = 1024) -> np.ndarray:
    """Planks along p, each with its own tone, rings and fibres; tiled."""
    q = grid(side)[1]
    row = np.floor(q * planks).astype(int)
    tone, offset = rng.normal(0, 0.09, planks)[row], rng.uniform(0, 1, planks)[row]
    bends = noise(rng, side, 1, 12, 1.5, along=(4, 1))
    rings = np.sin(2 * np.pi * (9 * (q * planks % 1) + 5 * offset + 0.55 * bends))
    fibres = noise(rng, side, 8, 150, 0.4, along=(14, 1))
    shade = 0.55 + tone + 0.14 * rings + 0.09 * fibres + 0.05 * bends
    seam = np.abs((q * planks) % 1 - 0.5)
    return painted(np.clip(shade - 0.6 * step(seam, 0.485, 0.01), 0, 1), *colours)


def bricks(rng: np.random.Generator, rows: int, columns: int, side: int = 1024) -> np.ndarray:
    """A running bond of uneven bricks in light mortar; tiled where `rows` is even."""
    p, q = grid(side)
    row = np.floor(q * rows).astype(int)
    across = p * columns + 0.5 * (row % 2)
    column = np.floor(across).astype(int) % columns
    tone = rng.normal(0, 0.16, (rows, columns))[row, column]
    grain = noise(rng, side, 3, 100, 0.7)
    brick = painted(np.clip(0.5 + tone + 0.12 * grain, 0, 1), "#5a2c22", "#a5583f", "#d29a78")
    mortar = painted(np.clip(0.5 + 0.2 * grain, 0, 1), "#8d8578", "#cfc8b8")
    wobble = 0.02 * noise(rng, side, 8, 60, 0.6)
    edge = np.minimum(0.5 - np.abs(q * rows % 1 - 0.5), 2 * (0.5 - np.abs(across % 1 - 0.5)))
    return mixed(mortar, brick, step(edge + wobble, 0.09, 0.03))


def gingham(
    rng: np.random.Generator, colour: str, squares: int, weave: float = 0.06, side: int = 1024
) -> np.ndarray:
    """Checked cloth, `squares` pairs of stripes each way, its threads as dark as `weave`; tiled."""
    p, q = grid(side)
    warp, weft = np.sin(np.pi * squares * p * 2) > 0, np.sin(np.pi * squares * q * 2) > 0
    threads = weave * np.sin(2 * np.pi * 96 * p) * np.sin(2 * np.pi * 96 * q)
    shade = 0.5 * warp + 0.42 * weft + threads + 0.04 * noise(rng, side, 2, 60)
    soft = cv2.GaussianBlur(shade.astype(np.float32), (0, 0), side / 700)
    return painted(np.clip(soft, 0, 1), "#f4f0e6", colour)


def stone(
    rng: np.random.Generator,
    *colours: str,
    veins: float = 0.0,
    finest: float = 110,
    side: int = 512,
) -> np.ndarray:
    """A cloudy mix of the colours, darkened along `veins` by that much; tiled.

    finest: detail, cycles per side.
    """
    cloud = noise(rng, side, 1, finest, 1.0)
    vein = np.exp(-((noise(rng, side, 2, 30, 1.3) / 0.06) ** 2))
    return painted(np.clip(0.5 + 0.2 * cloud - veins * vein, 0, 1), *colours)


def segments(rng: np.random.Generator, *colours: str, side: int = 512) -> np.ndarray:
    """A beach ball: sectors about the middle, a cap, some scuffs."""
    p, q = grid(side)
    angle = (np.arctan2(q - 0.46, p - 0.53) / (2 * np.pi) + rng.uniform()) % 1
    sector = angle * len(colours)
    shade = (np.floor(sector) % len(colours)) / (len(colours) - 1)
    paint = painted(shade, *colours)
    cap = painted(np.ones_like(p), "#000000", "#f6f2e8")
    paint = mixed(paint, cap, step(-np.hypot(p - 0.53, q - 0.46), -0.07, 0.006))
    scuffs = 1 - 0.05 * np.abs(noise(rng, side, 6, 90, 0.5))
    paint = cv2.GaussianBlur(paint, (0, 0), 1.0)
    paint[..., :3] *= np.clip(scuffs, 0, 1)[..., np.newaxis]
    return paint


def foliage(
    rng: np.random.Generator,
    leaves: int,
    length: float,
    *colours: str,
    upright: bool = False,
    side: int = 1024,
) -> np.ndarray:
    """A card of scattered leaves, or of `upright` blades that grow from its lower edge."""
    stops = painted(rng.uniform(0, 1, (leaves, 1)), *colours)[:, 0, :3] * 255
    canvas = np.zeros((side, side, 4), np.uint8)
    canvas[..., :3] = stops.mean(axis=0)
    along = np.linspace(0, 1, 12)
    for colour in stops:
        size = length * rng.uniform(0.6, 1.25)
        if upright:
            foot = np.array([rng.uniform(0.02, 0.98), 1.0])
            lean, thick = rng.normal(0, 0.22), 0.022 * size
            spine = np.stack([lean * size * along**2, -size * along], axis=1)
            half = np.stack([thick * (1 - along**2), 0 * along], axis=1)
        else:
            foot = rng.uniform(0.08, 0.92, 2) * (1 - size) + size / 2
            angle = rng.uniform(0, 2 * np.pi)
            axis, normal = (
                np.array([np.cos(angle), np.sin(angle)]),
                np.array([-np.sin(angle), np.cos(angle)]),
            )
            spine = np.outer(size * (along - 0.5), axis)
            half = np.outer(0.21 * size * np.sin(np.pi * along**0.8), normal)
        # Two halves of unlike brightness, and a rib between them, make a leaf look folded.
        for edge, light in ((half, 1.08), (-half, 0.86)):
            outline = np.concatenate([spine + edge, spine[::-1]]) + foot
            points = np.rint(outline * side * 16).astype(np.int32)
            shade = [float(min(255.0, c * light)) for c in colour] + [255.0]
            cv2.fillPoly(canvas, [points], shade, cv2.LINE_AA, shift=4)
        rib = np.rint((spine + foot) * side * 16).astype(np.int32)
        rib_shade = [float(min(255.0, 1.18 * c + 12)) for c in colour] + [255.0]
        cv2.polylines(canvas, [rib], False, rib_shade, max(1, side // 600), cv2.LINE_AA, 4)
    paint = canvas.astype(np.float32) / 255
    # Half a card repeated is as good; blades stand on wide, low cards and are streaked upwards.
    streaks = (0.3, 3.0) if upright else (1.0, 1.0)
    mottle = np.tile(1 + 0.10 * noise(rng, side // 2, 2, 55, 0.7, along=streaks), (2, 2))
    paint[..., :3] = np.clip(paint[..., :3] * mottle[..., np.newaxis], 0, 1)
    return paint


def blossom(
    rng: np.random.Generator, *colours: str, petals: int = 5, side: int = 256
) -> np.ndarray:
    """One flower, seen from the front: lobed, streaked petals around a yellow heart."""
    p, q = grid(side)
    angle, radius = np.arctan2(q - 0.5, p - 0.5), 2 * np.hypot(p - 0.5, q - 0.5)
    lobe = np.abs(np.cos(petals / 2 * angle + rng.uniform(0, np.pi))) ** 0.55
    reach = 0.42 + 0.5 * lobe
    streaks = 0.08 * np.sin(petals * 7 * angle) + 0.06 * noise(rng, side, 3, 60)
    shade = np.clip(radius / reach + streaks - 0.25 * (1 - lobe), 0, 1)
    paint = painted(shade, *colours, alpha=step(reach - radius, 0, 0.02))
    heart = painted(np.clip(0.5 + 0.3 * noise(rng, side, 8, 70, 0.3), 0, 1), "#8a5a10", "#ffe27a")
    return mixed(paint, heart, step(-radius, -0.2, 0.03) * (paint[..., 3] > 0))


def star_chart(side: int = 512) -> np.ndarray:
    """A resolution target: Siemens star, zone rings and bars of rising frequency."""
    p, q = grid(side)
    angle, radius = np.arctan2(q - 0.42, p - 0.5), np.hypot(p - 0.5, q - 0.42)
    star = 0.5 + 0.5 * np.tanh(4 * np.sin(24 * angle) * np.minimum(1, radius * 8))
    bars = 0.5 + 0.5 * np.tanh(3 * np.sin(2 * np.pi * (8 * p + 14 * p * p)))
    shade = np.ones_like(p)
    shade = np.where(radius < 0.33, star, shade)
    shade = np.where((np.abs(radius - 0.345) < 0.008), 0, shade)
    shade = np.where((np.abs(q - 0.88) < 0.055) & (np.abs(p - 0.5) < 0.42), bars, shade)
    shade = cv2.GaussianBlur(shade.astype(np.float32), (0, 0), 1.2)
    return painted(shade, "#161616", "#f3f1ea", alpha=rectangle(side))


def letter_block(letter: str, paint: str, side: int = 256) -> np.ndarray:
    """The face of a toy block: a letter and a frame in `paint` on pale wood."""
    ink = np.zeros((side, side), np.uint8)
    cv2.rectangle(ink, (side // 12,) * 2, (side - side // 12,) * 2, 255, side // 11, cv2.LINE_AA)
    font, scale, thick = cv2.FONT_HERSHEY_SIMPLEX, side / 40, side // 8
    (wide, high), _ = cv2.getTextSize(letter, font, scale, thick)
    cv2.putText(
        ink, letter, ((side - wide) // 2, (side + high) // 2), font, scale, 255, thick, cv2.LINE_AA
    )  # fmt: skip
    shade = cv2.GaussianBlur(ink.astype(np.float32) / 255, (0, 0), side / 200)
    return painted(shade, "#f3e2bf", paint, alpha=rectangle(side))


def postcard(rng: np.random.Generator, side: int = 512) -> np.ndarray:
    """A painted landscape with a white border: sky, sun, three ranges of hills, a lake."""
    p, q = grid(side)
    clouds = np.clip(0.6 * noise(rng, side, 2, 40, 1.3, along=(2.5, 1)), 0, 1)
    sky = painted(np.clip(q * 1.7, 0, 1), "#3f7fc4", "#9cc8e8", "#f7dcb4")
    paint = mixed(sky, np.ones_like(sky), 0.7 * clouds * (q < 0.55))
    sun = np.hypot(p - rng.uniform(0.25, 0.75), q - 0.3)
    paint = mixed(paint, painted(0 * p, "#fff3c4", "#fff3c4"), step(-sun, -0.06, 0.01))
    grain = noise(rng, side, 4, 100, 0.6)
    for base, colours in (
        (0.5, ("#5c7391", "#93a7bd")),
        (0.6, ("#2f5a4a", "#6d9a70")),
        (0.74, ("#2b3f1e", "#7d9440")),
    ):
        ridge = base + 0.045 * noise(rng, side, 1, 14, 1.2)[side // 2][np.newaxis, :]
        hill = painted(np.clip(0.5 + 0.22 * grain + 0.8 * (q - base), 0, 1), *colours)
        paint = mixed(paint, hill, step(q - ridge, 0, 0.004))
    border = np.minimum(np.minimum(p, 1 - p), np.minimum(q, 1 - q))
    paint = mixed(np.full_like(paint, 0.95), paint, step(border, 0.06, 0.004))
    paint[..., 3] = rectangle(side)
    return paint


def printed_page(rng: np.random.Generator, side: int = 512) -> np.ndarray:
    """A page of invented letters in words and lines, under a coloured headline."""
    p, q = grid(side)
    lines, letters = 17, 44
    row, column = np.floor(q * lines).astype(int), np.floor(p * letters).astype(int)
    is_letter = rng.uniform(size=(lines, letters)) > 0.17
    is_letter[:, :3] = is_letter[:, -3:] = False
    is_letter[[0, 1, 2, 3, -1], :] = False
    stroke = noise(rng, side, 25, 60, 0.0) > 0.15
    body = (np.abs(q * lines % 1 - 0.5) < 0.3) & (np.abs(p * letters % 1 - 0.5) < 0.42)
    ink = (is_letter[row, column] & body & stroke).astype(np.float32)
    page = painted(1 - cv2.GaussianBlur(ink, (0, 0), 1.0), "#1c1a18", "#f1ead9")
    headline = (np.abs(q - 0.14) < 0.035) & (np.abs(p - 0.5) < 0.4) & (stroke | (p % 0.09 < 0.05))
    red = painted(0 * p, "#a32a22", "#a32a22")
    page = mixed(page, red, cv2.GaussianBlur(headline.astype(np.float32), (0, 0), 1.0))
    page[..., 3] = rectangle(side)
    return page


def leaf(rng: np.random.Generator, *colours: str, side: int = 512) -> np.ndarray:
    """One big leaf with its veins, tip to the right."""
    p, q = grid(side)
    half = 0.34 * np.sin(np.pi * np.clip(p * 1.04 - 0.02, 0, 1) ** 0.75)
    half = half * (1 + 0.04 * np.sin(2 * np.pi * 19 * p))
    off = q - 0.5 - 0.03 * np.sin(2 * np.pi * p)
    veins = np.exp(-((((p - 0.55 * np.abs(off)) * 11 % 1) - 0.5) ** 2) / 0.006)
    rib = np.exp(-((off / 0.008) ** 2))
    shade = 0.42 + 0.13 * noise(rng, side, 2, 100, 0.9) + 0.28 * np.maximum(veins * 0.7, rib)
    shade = shade + 0.08 * np.sign(off)
    return painted(np.clip(shade, 0, 1), *colours, alpha=step(half - np.abs(off), 0, 0.006))


def film(colour: str, opacity: float, side: int = 256) -> np.ndarray:
    """A clear coloured sheet with a light rim."""
    p, q = grid(side)
    border = np.minimum(np.minimum(p, 1 - p), np.minimum(q, 1 - q))
    rim = 1 - step(border, 0.045, 0.008)
    paint = mixed(painted(0 * p, colour, colour), np.full((side, side, 4), 0.93), 0.8 * rim)
    paint[..., 3] = np.maximum(opacity, 0.85 * rim) * rectangle(side)
    return paint


def lattice(rng: np.random.Generator, cells: int, side: int = 1024) -> np.ndarray:
    """Round wires, woven diagonally, shaded across."""
    p, q = grid(side)
    rising, falling = (p + q) * cells, (p - q) * cells
    near = np.minimum(np.abs(rising % 1 - 0.5), np.abs(falling % 1 - 0.5)) / 0.075
    light = np.sqrt(np.clip(1 - near * near, 0, 1))
    rust = 0.16 * noise(rng, side, 3, 80)
    shade = np.clip(0.15 + 0.65 * light + rust, 0, 1)
    return painted(shade, "#3c4438", "#93a08c", "#e8ecdc", alpha=step(1 - near, 0, 0.12))


def soft_shadow(strength: float, side: int = 128) -> np.ndarray:
    """What a lifted sheet of paper leaves on the table: a dark card with blurred edges."""
    inside = np.pad(np.full((side * 3 // 4, side * 3 // 4), strength, np.float32), side // 8)
    alpha = cv2.GaussianBlur(inside, (0, 0), side / 28)
    return painted(np.zeros_like(alpha), "#140c06", "#140c06", alpha=alpha)


def surroundings(
    rng: np.random.Generator, *colours: str, lamp: float = 2.5, side: int = 512
) -> np.ndarray:
    """A room, from floor through walls to ceiling, with a window and a strip of light.

    Lambert's equal-area map of directions, middle towards the viewer; a lamp may exceed 1.
    """
    p, q = grid(side)
    x, y = 2 * (p - 0.5), 2 * (q - 0.5)
    z = np.clip(1 - 2 * (x * x + y * y), -1, 1)
    scale = np.sqrt(2 * (1 + z))
    x, y = x * scale, y * scale
    room = painted(np.clip(0.5 - 0.5 * y + 0.06 * noise(rng, side, 2, 40), 0, 1), *colours)
    shelves = (np.sin(26 * x + 3 * np.sin(5 * y)) > 0.2) & (np.abs(y - 0.12) < 0.16)
    room[..., :3] *= 1 - 0.45 * shelves[..., np.newaxis]
    ahead = np.maximum(z, 0.05)
    across, down = x / ahead + 0.75, y / ahead + 0.95
    window = (np.abs(across) < 0.42) & (np.abs(down) < 0.5) & (z > 0.1)
    window &= (np.abs(across) > 0.035) & (np.abs(down + 0.05) > 0.035)
    strip = (np.abs(x - 0.8) < 0.05) & (np.abs(y + 0.1) < 0.4) & (z > 0)
    light = cv2.GaussianBlur((window + 0.7 * strip).astype(np.float32), (0, 0), side / 250)
    room[..., :3] += lamp * light[..., np.newaxis] * np.array([1.0, 0.97, 0.9], np.float32)
    return room
