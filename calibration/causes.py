"""Why whiteboards differ among themselves: single causes, compared by the evidence of the readings.

Every whiteboard has parameters of its own beside the placement: its brightness, by how much the
mask seems to have moved, x and y, and by how much wider and higher its hole is than a view. A cause
gives these a pattern over the whiteboards: a lamp that is not steady changes every brightness by
chance, holes of unequal size only those of whiteboards through the pinhole, a plate that is turned
moves the shadow of every hole by its distance from the axis. A pinhole moved by du on the plate
shows the shadow of a mask moved by -rho du, rho = d / D.

With the readings linear in the parameters, what the whiteboards say of their own parameters p, the
placement's taken out, is an information S and a pull h. A cause of pattern A and width tau makes p
normal about 0 with covariance Sigma = tau^2 A A^T, several causes sum, and with Sigma = F F^T

    log evidence = 1/2 (F^T h)^T (1 + F^T S F)^-1 F^T h - 1/2 log|1 + F^T S F|

Causes are taken in one by one, each time the cause that raises the evidence most. A cause that
raises it nearly as much is named beside it: the whiteboards do not tell the two apart.

Source of the evidence: MacKay 1992.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from emmc_rig.calibration.boards import Board
from emmc_rig.model.pupil import Pupil, cell_openings

Array = NDArray[np.floating]
OWN = 5
"""Parameters of one whiteboard: relative brightness, by how much the mask moved (x, y), um, and by
how much wider and higher its hole is than a view, relative."""
LEAST_OWN = (2e-5, 0.001, 0.001, 1e-4, 1e-4)
"""Standard deviations of these without any cause: far below what noise shows."""
LEAST_MOVED_UM = 0.25
"""Moves below it are taken for what the model misses of neighbouring pixels alike: a bench of 256
rays a pixel leaves three times the noise, which as moves were 0.05 to 0.2 um."""
MOVED_STEPS, BRIGHTNESSES = np.geomspace(1 / 16, 64.0, 17), np.geomspace(5e-5, 0.1, 12)
"""Widths that are tried: of moves in units of LEAST_MOVED_UM; of brightness relative."""
LEAST_LIGHT = 0.005
"""Likewise of brightness, relative: times the deviation of what the model misses, in noise. Without
it, diffraction and the grain of few rays passed for holes of other areas
(`benchmarks/calibration_checks.py effects`)."""
LEAST_GAIN = 1.0
"""Of the log evidence by a cause: less tells nothing."""
NEARLY = 3.0
"""Difference of the log evidence of causes that fit nearly alike: a factor of 20."""
FEWEST_PINHOLES = 4
"""Whiteboards of fewer do not tell their pinholes' places from the mask's distance."""
AREA_STEP = 1e-3
LONE = 0.9
"""Of the squared moves of all pinholes: more in a single whiteboard may be a mask that moved."""
LAMP, STAGE, CREEP, LENS, BLUR = "lamp", "stage", "creep", "lens", "blur"
HOLES, HANDS, EXPOSURE, PLATE, TURN = "holes", "hands", "exposure", "plate", "turn"
SIZE = "size"
OF_HOLES = (HANDS, HOLES, EXPOSURE, PLATE, SIZE, TURN)
"""Causes of whiteboards through the pinhole alone."""
OF_LIGHT = (LAMP, HOLES, EXPOSURE, SIZE)
"""Causes by which whiteboards are brighter or darker."""
OF_PLATE = (HANDS, PLATE, TURN)
"""Causes by which pinholes stand off their holes."""
SHIFTING = (STAGE, HANDS, HOLES, PLATE, SIZE, TURN)
"""Causes that aberrations of the views imitate."""


@dataclass(frozen=True, eq=False)
class Cause:
    """A possible cause. columns: (own parameter of all whiteboards, coefficient), for a coefficient
    of 1. widths: standard deviations of the coefficients that are tried, in the cause's unit:
    LAMP, HOLES and SIZE (area), EXPOSURE relative; STAGE, CREEP (over the whole capture) and LENS
    (aberrations that displace every view's shadow) um of the mask; HANDS, PLATE um of the plate;
    TURN rad.
    """

    name: str
    columns: NDArray[np.float64]
    widths: NDArray[np.float64]
    least: float = 0.0
    """A smaller width is taken for what the model misses, see LEAST_MOVED_UM."""


@dataclass(frozen=True, eq=False)
class FoundCause:
    """A cause that the whiteboards show.

    width: standard deviation of its coefficients. size, deviation: every coefficient as found.
    gain: of the log evidence. instead: other causes that fit nearly as well.
    """

    name: str
    width: float
    gain: float
    instead: tuple[str, ...] = ()
    size: tuple[float, ...] = ()
    deviation: tuple[float, ...] = ()


class OwnInformation(NamedTuple):
    """What readings say of the whiteboards' own parameters, the placement's taken out."""

    information: NDArray[np.float64]
    """(own, own)."""
    pull: NDArray[np.float64]
    """(own,): gradient of the log likelihood, at all of them 0."""


class Light(NamedTuple):
    """The light through a pinhole."""

    share: float
    """Of the light through the hole on its place."""
    middle_um: NDArray[np.float64]
    """(x, y), from the middle of the view."""
    sides: NDArray[np.float64]
    """Width and height of the hole, over the view's."""


@dataclass(frozen=True)
class Geometry:
    """Of the camera: what a plate's place makes of the mask's shadow.

    ratio: rho = d / D. cell_um: side of a view and of a hole. views: (v, u). pupil: None: what lies
    beyond the outermost views passes no light.
    """

    ratio: float
    cell_um: float
    views: tuple[int, int]
    pupil: Pupil | None = None

    def light(self, view: tuple[int, int], hole: Array) -> Light:
        """Return the light through a pinhole; hole: (x, y) off its view, um, and area over 1."""
        side = float(np.sqrt(1 + hole[2]))
        if self.pupil is None:
            cells = np.array(self.views[::-1])
            place, off = np.array(view[::-1]) - (cells - 1) / 2, hole[:2] / self.cell_um
            begin = np.maximum(place + off - side / 2, -cells / 2)
            end = np.minimum(place + off + side / 2, cells / 2)
            sides = np.maximum(end - begin, 0.0)
            return Light(float(np.prod(sides)), ((begin + end) / 2 - place) * self.cell_um, sides)
        shares, middles_um = zip(
            *(self._through_pupil(view, hole[:2] * along) for along in ([1, 1], [1, 0], [0, 1])),
            strict=True,
        )
        # A cut hole is narrower by what a move across alone takes of its light; lower likewise.
        whole = max(self._through_pupil(view, np.zeros(2))[0], 0.01)
        return Light(shares[0] * side**2, middles_um[0], side * np.array(shares[1:]) / whole)

    def _through_pupil(self, view: tuple[int, int], off_um: Array) -> tuple[float, Array]:
        """Return the open share of a hole behind the pupil, and its middle from the view's, um."""
        assert self.pupil is not None
        x_mm, y_mm = np.array(self.pupil.centre_mm) - np.asarray(off_um) / 1e3
        rim = self.pupil.rim
        # Seen from a hole that is off, pupil and rim are off the other way, as by a shift of -1.
        moved = None if rim is None else rim.model_copy(update={"shift": -1.0})
        centre_mm = float(x_mm), float(y_mm)
        seen = self.pupil.model_copy(update={"centre_mm": centre_mm, "rim": moved})
        at_um = float(off_um[0]), float(off_um[1])
        opened = cell_openings(seen, self.views, self.cell_um, pixel_um=at_um)
        boxes = opened.of_view(*view)
        shares = opened.share[boxes]
        total = max(float(shares.sum()), 1e-9)
        places = np.stack([opened.x_um[boxes], opened.y_um[boxes]], axis=1)
        return total, shares @ places / total + off_um

    def own(self, view: tuple[int, int], hole: Array) -> NDArray[np.float64]:
        """Return the own parameters of a whiteboard through a pinhole, (OWN,), see `light`."""
        on, off = self.light(view, np.zeros(3)), self.light(view, hole)
        brighter = off.share / max(on.share, 0.01) - 1
        return np.array(
            [brighter, *(-self.ratio * (off.middle_um - on.middle_um)), *(off.sides - 1)]
        )

    def about(self, board: Board, hole: Array) -> tuple[Array, Array]:
        """Return a whiteboard's own parameters, (OWN,), and their slopes by its pinhole, (OWN, 3).

        hole: see `light`; the slopes are taken there. What opens some views moves with the plate,
        without an edge.
        """
        if board.views_open.sum() > 1:
            slopes = np.zeros((OWN, 3))
            slopes[0, 2], slopes[1:3, :2] = 1.0, -self.ratio * np.eye(2)
            return slopes @ hole, slopes
        v, u = np.argwhere(board.views_open)[0].tolist()
        slopes = [
            (self.own((v, u), hole + by) - self.own((v, u), hole - by)) / (2 * by.sum())
            for by in np.diag([self.cell_um / 100, self.cell_um / 100, AREA_STEP])
        ]
        return self.own((v, u), hole), np.stack(slopes, axis=1)


def through_pinhole(board: Board) -> bool:
    """Return whether a whiteboard opens one view, or some."""
    return not bool(board.views_open.all())


def possible_causes(
    boards: Sequence[Board], geometry: Geometry, holes: Array | None = None
) -> list[Cause]:
    """Return the causes that these whiteboards could tell from a perfect bench.

    holes: (board, 3), see `Geometry.light`, as far as they are known: one that is pushed beyond
    the outermost views loses light, and its middle moves half as far.
    """
    count = len(boards)
    known, holes = holes is not None, np.zeros((count, 3)) if holes is None else holes
    few, by_hand = _pinholes(boards)
    loose = np.array([board.loose for board in boards])
    moved = MOVED_STEPS * LEAST_MOVED_UM
    # Where pinholes stand off their holes, a lone open whiteboard is the only sure level.
    lit = np.eye(count)
    if (loose.any() or holes[:, :2].any()) and (~few).sum() == 1:
        lit[~few] = 0.0
    causes = [
        Cause(LAMP, _own_columns(lit, 0), BRIGHTNESSES),
        Cause(STAGE, _moves(np.eye(count)), moved, LEAST_MOVED_UM),
    ]
    times = np.array([board.taken_s for board in boards])
    if np.ptp(times) > 0 and count > 2:
        when = (times - times.mean()) / np.ptp(times)
        causes.append(Cause(CREEP, _moves(when[:, None]), 2 * moved, 2 * LEAST_MOVED_UM))
    if few.sum() < (1 if loose.any() else FEWEST_PINHOLES):
        return causes
    # By the place and area of every pinhole: (board, OWN, board of the pinhole, 3).
    slopes = np.zeros((count, OWN, count, 3))
    for index in np.flatnonzero(few):
        slopes[index, :, index] = geometry.about(boards[index], holes[index])[1]
    if not known:
        # Of larger and smaller holes the aperture's edge cuts the larger alone.
        slopes[:, :, :, 2] = np.diag(few)[:, None] * np.array([1, 0, 0, 0.5, 0.5])[:, None]
    by_place, by_area = np.split(slopes.reshape(count * OWN, count, 3), [2], axis=2)
    on_plate, least = moved / geometry.ratio, LEAST_MOVED_UM / geometry.ratio
    causes.append(Cause(HANDS, by_place[:, by_hand].reshape(count * OWN, -1), on_plate, least))
    if few.sum() > 1:
        causes.append(Cause(HOLES, by_area[:, few, 0], BRIGHTNESSES))
        if not few.all():
            causes.append(Cause(SIZE, by_area.sum(axis=1), BRIGHTNESSES))
    if few.all():
        return causes
    common = few[:, None].astype(np.float64)
    causes.append(Cause(EXPOSURE, _own_columns(common, 0), BRIGHTNESSES))
    causes.append(Cause(PLATE, by_place.sum(axis=1), on_plate, least))
    turned = turned_by(boards, geometry.cell_um)
    far_um = float(np.hypot(*turned.T)[few].max())
    if few.sum() > 1 and far_um > 0:
        columns = np.einsum("obk,bk->o", by_place, turned)[:, None]
        causes.append(Cause(TURN, columns, on_plate / far_um, least / far_um))
    return causes


def _pinholes(boards: Sequence[Board]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return whether each whiteboard opens only some views, and whether its pinhole is hand-held.

    If no whiteboard states a hand-held pinhole, every pinhole counts as hand-held.
    """
    few = np.array([through_pinhole(board) for board in boards])
    loose = np.array([board.loose for board in boards])
    return few, few & loose if loose.any() else few


def turned_by(boards: Sequence[Board], cell_um: float) -> NDArray[np.float64]:
    """Return by how much holes move, (board, 2), for each rad that the plate turns from x to y.

    A hole lies in the middle of a whiteboard's open views.
    """
    middles = np.array([np.argwhere(board.views_open).mean(axis=0) for board in boards])
    views = np.array(boards[0].views_open.shape)
    return (middles - (views - 1) / 2) * cell_um * [-1, 1]


def pinholes_found(
    found: Sequence[FoundCause], boards: Sequence[Board], cell_um: float
) -> NDArray[np.float64]:
    """Return the pinholes by the causes found, (board, 3): see `Geometry.light`."""
    few, by_hand = _pinholes(boards)
    holes = np.zeros((len(boards), 3))
    for cause in found:
        if cause.name == HANDS:
            holes[by_hand, :2] += np.reshape(cause.size, (-1, 2))
        elif cause.name == PLATE:
            holes[few, :2] += cause.size
        elif cause.name == TURN:
            holes[:, :2] += few[:, None] * cause.size[0] * turned_by(boards, cell_um)
        elif cause.name in (HOLES, SIZE):
            holes[few, 2] += cause.size
    return holes


def _own_columns(of_boards: Array, which: int) -> NDArray[np.float64]:
    """Return columns (own, k) of one own parameter from those of the whiteboards, (board, k)."""
    columns = np.zeros((len(of_boards), OWN, of_boards.shape[1]))
    columns[:, which] = of_boards
    return columns.reshape(len(of_boards) * OWN, -1)


def _moves(of_boards: Array) -> NDArray[np.float64]:
    """Return the same for moves along x, then along y."""
    return np.hstack([_own_columns(of_boards, 1), _own_columns(of_boards, 2)])


def with_lens(causes: Sequence[Cause], displaced: Array) -> list[Cause]:
    """Return the causes with LENS and BLUR, over the own parameters and then the views' own.

    displaced: (views' own,), whether each is a displacement, um, or a blur, um.
    """
    own, count = len(causes[0].columns), len(displaced)
    more = [replace(cause, columns=np.pad(cause.columns, ((0, count), (0, 0)))) for cause in causes]
    of_views = np.vstack([np.zeros((own, count)), np.eye(count)])
    widths = MOVED_STEPS * LEAST_MOVED_UM / 5
    of_lens = ((LENS, displaced), (BLUR, ~displaced))
    return [*more, *(Cause(name, of_views[:, which], widths) for name, which in of_lens)]


def covariance_of(
    causes: Mapping[str, Cause], widths: Mapping[str, float], own2: Array
) -> NDArray[np.float64]:
    """Return the covariance of the own parameters, (own, own), beforehand.

    own2: (own,), variances known beside the causes.
    """
    total = np.diag(own2)
    for name, width in widths.items():
        total += width**2 * causes[name].columns @ causes[name].columns.T
    return total


def log_evidence(own: OwnInformation, covariance: Array) -> float:
    """Return the log evidence of a covariance of the own parameters, but for a constant."""
    return _factors(own, covariance).evidence


class _Factors(NamedTuple):
    """Of a covariance Sigma of the own parameters, and what the readings say of these."""

    factor: NDArray[np.float64]
    """F, with Sigma = F F^T."""
    root: NDArray[np.float64]
    """R, with 1 + F^T S F = R R^T."""
    whitened: NDArray[np.float64]
    """R^-1 F^T h."""

    @property
    def evidence(self) -> float:
        """Log evidence of the covariance."""
        return float(0.5 * self.whitened @ self.whitened - np.log(np.diag(self.root)).sum())


def _factors(own: OwnInformation, covariance: Array) -> _Factors:
    factor = np.linalg.cholesky(covariance)
    root = np.linalg.cholesky(np.eye(len(factor)) + factor.T @ own.information @ factor)
    whitened = solve_triangular(root, factor.T @ own.pull, lower=True, check_finite=False)
    return _Factors(factor, root, whitened)


def find_causes(
    own: OwnInformation, causes: Sequence[Cause], own2: Array, always: Sequence[str] = ()
) -> list[FoundCause]:
    """Return the causes that the whiteboards show, the one that explains most first.

    always: names of causes that are known to act, whatever the evidence.
    """
    known = {cause.name: cause for cause in causes}
    widths = {name: float(known[name].widths[0]) for name in always if name in known}
    gains = dict.fromkeys(widths, 0.0)
    instead: dict[str, tuple[str, ...]] = {}
    reached = _fit_widths(own, known, widths, own2)
    while len(widths) < len(known):
        tried = {}
        for name in known.keys() - widths.keys():
            more = widths | {name: 0.0}
            evidence, width = _best_width(own, known, more, name, own2)
            if width >= known[name].least * (1 - 1e-9):
                tried[name] = evidence, width
        if not tried:
            break
        best = max(tried, key=lambda name: tried[name][0])
        gain = tried[best][0] - reached
        if gain < LEAST_GAIN:
            break
        instead[best] = tuple(
            name
            for name in sorted(tried, key=lambda name: -tried[name][0])
            if name != best and tried[name][0] > max(tried[best][0] - NEARLY, reached + LEAST_GAIN)
        )
        widths[best], gains[best] = tried[best][1], gain
        reached = _fit_widths(own, known, widths, own2)
        reached = _drop_idle(own, known, widths, own2, always, reached)
    order = sorted(widths, key=lambda name: -gains[name])
    return [FoundCause(name, widths[name], gains[name], instead.get(name, ())) for name in order]


def _best_width(
    own: OwnInformation,
    known: Mapping[str, Cause],
    widths: Mapping[str, float],
    name: str,
    own2: Array,
) -> tuple[float, float]:
    """Return the largest evidence over the widths of one cause, and the width.

    Of the others' covariance Sigma, a cause of pattern A and width tau adds to the log evidence

        1/2 sum_i (tau^2 q_i^2 / (1 + tau^2 g_i) - log(1 + tau^2 g_i))

    with g_i the eigenvalues of G = B^T B - W^T W, B = F^-1 A, W = R^-1 B, and q the pull
    W^T R^-1 F^T h along the eigenvectors.
    """
    rest = {other: width for other, width in widths.items() if other != name}
    without = _factors(own, covariance_of(known, rest, own2))
    columns = known[name].columns
    pattern = solve_triangular(without.factor, columns, lower=True, check_finite=False)
    seen = solve_triangular(without.root, pattern, lower=True, check_finite=False)
    values, vectors = np.linalg.eigh(pattern.T @ pattern - seen.T @ seen)
    pull2 = np.square(vectors.T @ (seen.T @ without.whitened))
    widths2 = np.square(known[name].widths)[:, None]
    grown = 1 + widths2 * np.maximum(values, 0.0)
    found = without.evidence + 0.5 * (widths2 * pull2 / grown - np.log(grown)).sum(axis=1)
    best = int(np.argmax(found))
    return float(found[best]), float(known[name].widths[best])


def _fit_widths(
    own: OwnInformation, known: Mapping[str, Cause], widths: dict[str, float], own2: Array
) -> float:
    """Set every width to its likeliest in turn, twice; return the evidence reached."""
    reached = log_evidence(own, covariance_of(known, widths, own2))
    if not widths:
        return reached
    for _ in range(1 if len(widths) == 1 else 2):
        for name in widths:
            reached, widths[name] = _best_width(own, known, widths, name, own2)
    return reached


def _drop_idle(
    own: OwnInformation,
    known: Mapping[str, Cause],
    widths: dict[str, float],
    own2: Array,
    always: Sequence[str],
    reached: float,
) -> float:
    """Take out causes that others explain by now; return the evidence."""
    for name in [name for name in widths if name not in always]:
        rest = {other: width for other, width in widths.items() if other != name}
        without = log_evidence(own, covariance_of(known, rest, own2))
        if reached - without < LEAST_GAIN:
            del widths[name]
            reached = without
    return reached


def doubt_lone_move(found: Sequence[FoundCause], boards: Sequence[Board]) -> list[FoundCause]:
    """Return the causes; a single pinhole that is off may be a mask that moved once as well."""
    if any(board.loose for board in boards) or any(cause.name == STAGE for cause in found):
        return list(found)

    def doubted(cause: FoundCause) -> FoundCause:
        if cause.name != HANDS or STAGE in cause.instead:
            return cause
        moves2 = np.square(np.reshape(cause.size, (-1, 2))).sum(axis=1)
        lone = moves2.max() > LONE * moves2.sum()
        return replace(cause, instead=(*cause.instead, STAGE)) if lone else cause

    return [doubted(cause) for cause in found]


def with_sizes(
    found: Sequence[FoundCause],
    causes: Sequence[Cause],
    own: Array,
    own_covariance: Array,
    own2: Array,
) -> tuple[FoundCause, ...]:
    """Return the causes with their coefficients, from the own parameters as fitted.

    Of normal c and p = A c + rest, with what is known of p afterwards (mean, covariance C):

        gain = tau^2 A^T Sigma^-1,    c = gain p,    cov c = tau^2 - gain A tau^2 + gain C gain^T

    own: (own,). own_covariance: (own, own). Causes in views are left as they are.
    """
    known = {cause.name: cause for cause in causes}
    widths = {cause.name: cause.width for cause in found if cause.name in known}
    inverse = np.linalg.inv(covariance_of(known, widths, own2))
    sized = []
    for cause in found:
        if cause.name not in known:
            sized.append(cause)
            continue
        columns, tau2 = known[cause.name].columns, cause.width**2
        gain = tau2 * columns.T @ inverse
        spread = tau2 * (np.eye(len(gain)) - gain @ columns) + gain @ own_covariance @ gain.T
        deviation = np.sqrt(np.maximum(np.diag(spread), 0.0))
        size = tuple(map(float, gain @ own))
        sized.append(replace(cause, size=size, deviation=tuple(map(float, deviation))))
    return tuple(sized)
