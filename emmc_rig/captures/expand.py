"""Every frame that follows from a plan: darks, metering, references, whiteboards, shots.

Source of the whiteboard procedure: see `calibration.whiteboard`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from emmc_rig.calibration.openings import CENTRED, views_open, window_place_um
from emmc_rig.calibration.whiteboard import LAMP_COLOURS
from emmc_rig.captures.metering import BRACKET_STEP, MOST_STEPS
from emmc_rig.captures.plan import AUTO, METERING_EXPOSURE_S, Boards, Plan
from emmc_rig.captures.schedule import spread
from emmc_rig.errors import AppError
from emmc_rig.model.camera import Camera
from emmc_rig.model.geometry import centred_grid
from emmc_rig.model.pupil import LEAST_SHARE
from emmc_rig.session.planned import SHOT_DARK, VALIDATION, Bench, Kind, PlannedFrame

OPEN_LAMP = "white"
FIRST_TURN_DEG = 90.0
"""Of the white board: what maps no gradient and no saddle over the aperture onto itself."""
RESPONSE_REPEATS = 2


def exposures_s(plan: Plan, camera: Camera) -> list[tuple[float, ...] | None]:
    """Return each shot's exposures, shortest first, None where metered; camera: as planned."""
    own = camera.exposures_s()
    # The frames of a film are exposed alike.
    own = own if plan.film is None else [own[0]] * len(own)
    return [
        None
        if shot.exposure_s == AUTO
        else tuple(sorted(set(shot.exposure_s or (float(own[place]),))))
        for place, shot in enumerate(plan.shots)
    ]


def expand(
    plan: Plan, camera: Camera, window_um: float, window_side_um: float | None = None
) -> tuple[PlannedFrame, ...]:
    """Return every frame of a plan, in its order; camera: as planned.

    window_um: what the stage's aperture_x adds to open the aperture. window_side_um: see
    `emmc_rig.bench.hardware.Rig`; needed where the window opens a part of the aperture. Raises
    AppError for views that the camera does not have, a window that uncovers none, and a shot whose
    masks stand at several places.
    """
    lit: list[PlannedFrame] = []
    if (boards := plan.whiteboards) is not None:
        stepped = [
            *_boards(plan, boards, camera),
            *_open_boards(boards, camera, window_um, window_side_um),
        ]
        lit = [
            *_references(plan, boards, camera, window_um),
            *_response(boards, window_um),
            *spread(stepped, list(_lamp_checks(boards, camera, window_um))),
            *_turned_boards(boards, camera, window_um),
            *_last_references(boards, window_um),
        ]
    references = [frame for frame in lit if not frame.bench.masks_in and not frame.part]
    others = [frame for frame in lit if frame.bench.masks_in or frame.part]
    last = max((frame.part for frame in lit), default=0)
    frames = [
        *_darks(plan),
        *references,
        *_board_darks(plan, lit, "before", 0),
        *others,
        *_board_darks(plan, lit, "after", last),
        *_shots(plan, camera, window_um),
    ]
    return tuple(frames)


def _repeated(
    name: str,
    kind: Kind,
    bench: Bench,
    count: int,
    exposure_s: float | None = None,
    **more: Any,
) -> Iterator[PlannedFrame]:
    """Yield so many equal frames; more: what else they are, see `PlannedFrame`."""
    for repeat in range(count):
        yield PlannedFrame(f"{name}-r{repeat}", kind, bench, exposure_s, repeat=repeat, **more)


def _darks(plan: Plan) -> Iterator[PlannedFrame]:
    if plan.darks is None:
        return
    bench = Bench("scene", "off", 0, 0, masks_in=True)
    for place, exposure_s in enumerate(sorted(set(plan.darks.exposure_s))):
        repeats = plan.darks.repeats
        yield from _repeated(f"dark-{place}", "dark", bench, repeats, exposure_s=exposure_s)


def _board_darks(
    plan: Plan, boards: Sequence[PlannedFrame], when: str, part: int
) -> Iterator[PlannedFrame]:
    """Yield darks at every exposure under white light, metered as the whiteboards are.

    At shorter ones the dark current is little, and lies on a line.
    """
    if plan.darks is None or not plan.darks.of_boards:
        return
    bench = Bench("whiteboard", "off", 0, 0, masks_in=True)
    exposures = dict.fromkeys(
        (board.exposure_s, board.metered_by, board.light)
        for board in boards
        if board.kind != "metering" and board.bench.lamp == OPEN_LAMP and board.light >= 1
    )
    for place, (exposure_s, metered_by, light) in enumerate(exposures):
        yield from _repeated(
            f"dark-{when}-{place}", "dark", bench, plan.darks.of_boards,
            exposure_s=exposure_s, metered_by=metered_by, light=light, part=part,
        )  # fmt: skip


def lamps_of(plan: Plan, camera: Camera) -> tuple[str, ...]:
    """Return the lamps of the whiteboards: white alone where a pixel sees one colour only."""
    if plan.whiteboards is not None and plan.whiteboards.lamps is not None:
        return plan.whiteboards.lamps
    several = camera.seen_tile().sum(axis=-1).max() > 1
    filtered = all(shot.filter != "none" for shot in camera.shots)
    return LAMP_COLOURS if several and not filtered else ("white",)


def _metering_id(shot: int, lamp: str) -> str:
    return f"meter-s{shot}-{lamp}"


def _references(
    plan: Plan, boards: Boards, camera: Camera, window_um: float
) -> Iterator[PlannedFrame]:
    window = {"aperture_x": window_um, "aperture_y": 0.0}
    fitted = fittings(camera)
    lamps = lamps_of(plan, camera)
    if boards.open and OPEN_LAMP not in lamps:
        lamps = (*lamps, OPEN_LAMP)
    for shot in range(len(camera.shots)):
        repeats = dict.fromkeys(lamps, boards.references)
        if shot == 0 and boards.colours:
            repeats |= {lamp: boards.colours for lamp in LAMP_COLOURS if lamp not in repeats}
        for lamp, count in repeats.items():
            bench = Bench("whiteboard", lamp, shot, fitted[shot], False, window)
            metered_by = None
            if boards.exposure_s is None:
                metered_by = _metering_id(shot, lamp)
                yield PlannedFrame(metered_by, "metering", bench, METERING_EXPOSURE_S)
            yield from _repeated(
                f"reference-s{shot}-{lamp}", "reference", bench, count,
                exposure_s=boards.exposure_s, metered_by=metered_by,
            )  # fmt: skip


def _boards(plan: Plan, boards: Boards, camera: Camera) -> Iterator[PlannedFrame]:
    rows, columns = camera.views
    views = boards.views
    if views == "all":
        # Before a view outside of the lens's pupil no light reaches the pinhole.
        views = tuple((int(v), int(u)) for v, u in np.argwhere(camera.views_measured()))
    for v, u in views:
        if not (0 <= v < rows and 0 <= u < columns):
            raise AppError(
                f"whiteboards.views: [{v}, {u}] is none of the camera's {rows}x{columns} views; "
                "rows and columns count from 0"
            )
    cell_um = camera.lens.aperture_cell_um
    y_um, x_um = centred_grid(rows, cell_um), centred_grid(columns, cell_um)
    shots = range(len(camera.shots)) if boards.shots == "all" else boards.shots
    for shot in shots:
        if shot >= len(camera.shots):
            raise AppError(
                f"whiteboards.shots: {shot} is none of the {len(camera.shots)} shots, from 0"
            )
    # The pinhole lets one view's light pass, the reference that of all. Views that the pupil cuts
    # are exposed as whole ones, so that their readings compare.
    light = camera.open_views()
    fitted = fittings(camera)
    for shot in shots:
        masks_um = mask_offsets_um(camera, shot)
        for v, u in views:
            pinhole = {"aperture_x": float(x_um[u]), "aperture_y": float(y_um[v])}
            for lamp in lamps_of(plan, camera):
                bench = Bench("whiteboard", lamp, shot, fitted[shot], True, masks_um | pinhole)
                exposed = _white(boards, light, shot, lamp)
                name = f"board-s{shot}-v{v}-u{u}-{lamp}"
                yield from _repeated(
                    name, "whiteboard", bench, boards.repeats, view=(v, u), **exposed
                )


def _open_boards(
    boards: Boards, camera: Camera, window_um: float, window_side_um: float | None
) -> Iterator[PlannedFrame]:
    own_um = mask_offsets_um(camera, 0)
    cell_um = camera.lens.aperture_cell_um
    for place, board in enumerate(boards.open):
        opened = camera.view_shares()[views_open(camera.views, None, board.window)].sum()
        if opened < LEAST_SHARE:
            raise AppError(
                f"whiteboards.open.{place}.window: {list(board.window)} uncovers none of the "
                f"camera's {camera.views[0]}x{camera.views[1]} views: move it by fewer cells"
            )
        if board.window != CENTRED and window_side_um is None:
            raise AppError(
                f"whiteboards.open.{place}.window needs to know where the window's edges are: "
                "write its side as window_side_um into the rig's file, or leave it out"
            )
        side_um = window_side_um or 0.0
        there = window_place_um(board.window, camera.views, cell_um, side_um)
        window = {"aperture_x": window_um + there[0], "aperture_y": there[1]}
        if any(board.mask_um) and not own_um:
            raise AppError(
                f"whiteboards.open.{place}.mask_um: no mask of this camera moves: leave it out"
            )
        x_um, y_um = board.mask_um
        moved = {
            axis: own_um[axis] + further
            for axis, further in (("mask_x", x_um), ("mask_y", y_um))
            if own_um
        }
        bench = Bench("whiteboard", OPEN_LAMP, 0, 0, True, moved | window)
        kind = VALIDATION if board.validation else "open"
        exposed = _white(boards, camera.open_views() / float(opened))
        yield from _repeated(
            f"{kind}-{place}", kind, bench, board.repeats, window=board.window, **exposed
        )


def _white(
    boards: Boards, light: float = 1.0, shot: int = 0, lamp: str = OPEN_LAMP
) -> dict[str, Any]:
    """Return how a whiteboard is exposed: `light` times as long as its reference."""
    if boards.exposure_s is not None:
        return {"exposure_s": boards.exposure_s * light, "light": light}
    return {"metered_by": _metering_id(shot, lamp), "light": light}


def _response(boards: Boards, window_um: float) -> Iterator[PlannedFrame]:
    bench = _open_bench(window_um, masks_in=False)
    for share in sorted(boards.response):
        exposed = _white(boards, share)
        yield from _repeated(f"response-{share:g}", "check", bench, RESPONSE_REPEATS, **exposed)


def _lamp_checks(boards: Boards, camera: Camera, window_um: float) -> Iterator[PlannedFrame]:
    bench = _open_bench(window_um, True, mask_offsets_um(camera, 0))
    return _repeated("check", "check", bench, boards.lamp_checks, **_white(boards))


def _turned_boards(boards: Boards, camera: Camera, window_um: float) -> Iterator[PlannedFrame]:
    """Yield the board turned: through the masks, which are in the beam, then without them."""
    offsets_um = mask_offsets_um(camera, 0)
    # Without the masks the other way round: one turn less by hand.
    ways = [
        *(("open", turn, offsets_um) for turn in boards.turns_deg),
        *(("reference", turn, {}) for turn in reversed(boards.turns_deg)),
    ]
    for name, turn_deg, at_um in ways:
        bench = replace(_open_bench(window_um, name == "open", at_um), board_turn_deg=turn_deg)
        # Plans of version 0.2 turned the board by 90 degrees only.
        by = "" if turn_deg == FIRST_TURN_DEG else f"{turn_deg:g}-"
        yield from _repeated(
            f"turned-{by}{name}", "turned", bench, boards.turned, part=1, **_white(boards)
        )


def _last_references(boards: Boards, window_um: float) -> Iterator[PlannedFrame]:
    bench = _open_bench(window_um, masks_in=False)
    count = RESPONSE_REPEATS if boards.lamp_checks else 0
    return _repeated("reference-again", "check", bench, count, part=2, **_white(boards))


def _open_bench(
    window_um: float, masks_in: bool, offsets_um: Mapping[str, float] | None = None
) -> Bench:
    """Return the bench of an open whiteboard of the first shot."""
    window = {"aperture_x": window_um, "aperture_y": 0.0}
    return Bench("whiteboard", OPEN_LAMP, 0, 0, masks_in, {**(offsets_um or {}), **window})


def _scene_bench(plan: Plan, camera: Camera, place: int, window_um: float) -> Bench:
    """Return how the bench stands for a shot of the scene."""
    offsets_um = mask_offsets_um(camera, place)
    offsets_um |= {"aperture_x": window_um, "aperture_y": 0.0}
    lamp = plan.shots[place].lamp
    return Bench("scene", lamp, place, fittings(camera)[place], True, offsets_um)


def _scene_meterings(plan: Plan, camera: Camera, window_um: float) -> dict[int, PlannedFrame]:
    """Return the frame that meters each shot whose exposure is metered.

    Shots that are to be exposed alike share it where masks, filter, lamp and gain are the same.
    """
    found: dict[int, PlannedFrame] = {}
    shared: dict[object, PlannedFrame] = {}
    for place, shot in enumerate(plan.shots):
        if shot.exposure_s != AUTO:
            continue
        bench = _scene_bench(plan, camera, place, window_um)
        group = (bench.fitting, shot.lamp, shot.gain) if plan.metering.alike else place
        name = f"meter-shot-{place}"
        frame = PlannedFrame(name, "metering", bench, METERING_EXPOSURE_S, shot.gain)
        found[place] = shared.setdefault(group, frame)
    return found


def _shot_darks(
    plan: Plan, camera: Camera, meterings: Mapping[int, PlannedFrame]
) -> Iterator[PlannedFrame]:
    """Yield darks at the longest planned exposure, and at the exposure of each metered shot.

    Shots of one metering share a dark. At shorter exposures the dark current lies on a line.
    """
    if plan.darks is None or not plan.darks.of_shots:
        return
    planned = [max(bracket) for bracket in exposures_s(plan, camera) if bracket is not None]
    exposures: list[tuple[int, float | None, str | None]] = []
    if planned and max(planned) > max(plan.darks.exposure_s):
        exposures.append((0, max(planned), None))
    kept: dict[object, int] = {}
    for place in meterings:
        shot = plan.shots[place]
        kept.setdefault((shot.lamp, shot.gain) if plan.metering.alike else place, place)
    exposures += [(place, None, meterings[place].id) for place in kept.values()]
    for place, exposure_s, metered_by in exposures:
        bench = Bench("scene", "off", place, 0, masks_in=True)
        name = f"{SHOT_DARK}-{place if metered_by else 'longest'}"
        count = plan.darks.of_shots
        yield from _repeated(
            name, "dark", bench, count, exposure_s=exposure_s, metered_by=metered_by
        )


def _shots(plan: Plan, camera: Camera, window_um: float) -> Iterator[PlannedFrame]:
    meterings = _scene_meterings(plan, camera, window_um)
    yield from {frame.id: frame for frame in meterings.values()}.values()
    yield from _shot_darks(plan, camera, meterings)
    shots = list(_exposed(plan, camera, meterings, window_um))
    if plan.film is None:
        yield from shots
        return
    for place in range(plan.film.frames):
        yield replace(shots[place % len(shots)], id=f"film-{place:06d}", film=place)


def _exposed(
    plan: Plan, camera: Camera, meterings: Mapping[int, PlannedFrame], window_um: float
) -> Iterator[PlannedFrame]:
    """Yield the frames of each shot: its bracket and repeats; one of each for a film."""
    steps = MOST_STEPS if plan.metering.bracket and plan.film is None else 0
    for place, (shot, bracket) in enumerate(
        zip(plan.shots, exposures_s(plan, camera), strict=True)
    ):
        bench = _scene_bench(plan, camera, place, window_um)
        metered_by = meterings[place].id if bracket is None else None
        exposures: list[tuple[float | None, float]] = (
            [(exposure_s, 1.0) for exposure_s in bracket]
            if bracket
            else [(None, BRACKET_STEP**step) for step in range(steps + 1)]
        )
        for step, (exposure_s, light) in enumerate(exposures):
            yield from _repeated(
                f"shot-{place}-e{step}", "shot", bench, shot.repeats,
                exposure_s=exposure_s, gain=shot.gain, metered_by=metered_by, light=light,
            )  # fmt: skip


def fittings(camera: Camera) -> list[int]:
    """Return, for each shot, the first shot with the same masks, patterns and filter in the beam.

    Nobody has to change anything between shots of one fitting.
    """
    keys = []
    for place, shot in enumerate(camera.shots):
        names = camera.shot_masks(place)
        counts = [camera.masks[n].pattern.frame_count(len(camera.shots)) for n in names]
        keys.append((names, tuple(place % count for count in counts), shot.filter))
    return [keys.index(key) for key in keys]


def mask_offsets_um(camera: Camera, shot: int) -> dict[str, float]:
    """Return where the mask stage stands for a shot, by axis; none where nothing moves.

    Raises AppError when a shot wants two masks at different places: there is one mask stage.
    """
    wanted = {
        camera.shots[shot].offset_um.get(name, (0.0, 0.0))
        for name in camera.moving_masks
        if name in camera.shot_masks(shot)
    }
    if len(wanted) > 1:
        raise AppError(
            f"shot {shot} moves two masks apart, the rig has one mask stage: give both one place, "
            f"shots.{shot}.mask_um"
        )
    return {
        axis: value for x_um, y_um in wanted for axis, value in (("mask_x", x_um), ("mask_y", y_um))
    }
