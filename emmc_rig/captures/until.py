"""A capture that ends when the scene needs no more shots: which frames of a session come next.

Everything but the shots comes first, so that Psi of every planned shot is known: measured, or by
the parametric fit. Then shots are taken one by one, in the order of the plan. After each the light
field so far is reconstructed; its estimated deviation gives the expected PSNR. Each decision is
journalled before the next frame, so that a resumed capture follows it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from emmc_rig.calibration.scale import Scale
from emmc_rig.calibration.shadow import shadow_mask
from emmc_rig.captures.plan import Plan
from emmc_rig.errors import AppError
from emmc_rig.model.camera import Camera
from emmc_rig.progress import Event, Watcher
from emmc_rig.reconstruction.methods import reconstruct
from emmc_rig.reconstruction.result import Progress, Reconstruction
from emmc_rig.session.journal import DecidedEntry, ended, of_kind
from emmc_rig.session.measured_psi import session_scale
from emmc_rig.session.planned import PlannedFrame
from emmc_rig.session.readings import shot_readings
from emmc_rig.session.session import Session

SMALLEST = (16, 16)
METHOD = "adaptive-fast"


def refuse_unless_shots_can_be_spared(plan: Plan, camera: Camera) -> None:
    """Raise AppError or CalibrationError unless a plan has shots to spare; camera: as planned.

    Its whiteboards must determine Psi of every shot before the first one is taken.
    """
    if len(plan.shots) < 2:
        raise AppError(
            "the plan has one shot, so that no shot can be saved; list the others that "
            "may be taken, each with its mask_um"
        )
    boards = plan.whiteboards
    if boards is None or plan.darks is None:
        wanting = "darks" if boards is not None else "whiteboards"
        raise AppError(
            f"the plan has no {wanting}, so that the Psi of its shots cannot be measured",
            "plan-whiteboards",
        )
    if any(not board.validation for board in boards.open):
        if not any(board.validation for board in boards.open):
            raise AppError(
                "no open whiteboard of the plan has `validation: true`, to judge Psi by: plan one",
                "plan-whiteboards",
            )
        shadow_mask(camera, SMALLEST)
        return
    views = set(boards.views) if boards.views != "all" else None
    shots = set(boards.shots) if boards.shots != "all" else None
    rows, columns = camera.views
    if (views is not None and len(views) < rows * columns) or (
        shots is not None and len(shots) < len(plan.shots)
    ):
        raise AppError(
            "the plan has neither open whiteboards nor the pinhole before every view of every "
            "shot, so that the Psi of its shots cannot be measured: plan either",
            "plan-whiteboards",
        )


class Until:
    """Says what a `Sequencer` takes next, of a session with a target; use it within one run."""

    def __init__(self, session: Session, watcher: Watcher) -> None:
        self._session, self._watcher = session, watcher
        self._scale: Scale | None = None

    def __call__(self, now_s: Callable[[], float]) -> tuple[PlannedFrame, ...]:
        """Return the frames to take now, none when the session has what it needs.

        now_s: seconds since the run began. Raises AppError, CalibrationError, ReconstructionError
        or `OSError`.
        """
        session = self._session
        missing = session.missing()
        first = tuple(frame for frame in missing if frame.kind != "shot")
        if first:
            self._scale = None
            return first
        chosen = self._chosen()
        due = tuple(frame for frame in missing if frame.bench.shot in chosen)
        if due or ended(session.journal.entries) is not None:
            return due
        self._decide(chosen, now_s)
        return self(now_s)

    def _chosen(self) -> tuple[int, ...]:
        """Return the shots to be taken so far: the plan's first, those decided, those begun."""
        session = self._session
        shots = [frame for frame in session.frames if frame.kind == "shot"]
        decided = [entry.next for entry in of_kind(session.journal.entries, DecidedEntry)]
        begun = sorted({frame.bench.shot for frame in shots if frame.id in session.stored})
        first = min(frame.bench.shot for frame in shots)
        wanted = dict.fromkeys([first, *decided, *begun])
        # An amended plan may have fewer shots than it was once decided of.
        planned = {frame.bench.shot for frame in shots}
        return tuple(shot for shot in wanted if shot in planned)

    def _decide(self, shots: tuple[int, ...], now_s: Callable[[], float]) -> None:
        session, target_db = self._session, self._session.target_db
        assert target_db is not None
        began_s = now_s()
        self._watcher.tell(f"shots so far: {len(shots)}; reconstructing by {METHOD}")
        stated_db, advice = self._stated(shots)
        planned = {frame.bench.shot for frame in session.frames if frame.kind == "shot"}
        left = sorted(planned - set(shots))
        reached = stated_db >= target_db
        following, why = None, "the target is reached" if reached else "every planned shot is taken"
        if left and not reached:
            following, why = left[0], ""
        spared = left if reached else []
        entry = DecidedEntry(
            run=session.runs,
            shots=list(shots),
            stated_db=stated_db,
            target_db=target_db,
            next=following,
            why=why,
            spared=spared,
            spared_frames=sum(
                frame.kind == "shot" and frame.bench.shot in spared for frame in session.needed
            ),
            method=METHOD,
            advice=advice,
            spans_s={"decide": (began_s, now_s())},
        )
        session.note(entry)
        self._watcher.tell(str(entry))

    def _stated(self, shots: tuple[int, ...]) -> tuple[float, str]:
        """Return the PSNR that the light field of some shots is stated to have, and advice."""
        self._scale = self._scale or session_scale(self._session)
        result = light_field_so_far(self._session, self._scale, shots)
        self._watcher.event(Event("light field", {"shots": shots}, {"result": result}))
        return stated_psnr_db(result), result.advice


def stated_psnr_db(result: Reconstruction) -> float:
    """Return the PSNR that a result's own deviation stands for; raises AppError without one."""
    stated_db = result.stated["stated_db"]
    if stated_db is None:
        raise AppError(f"{result.method} estimates no accuracy: use {METHOD}")
    return stated_db


def light_field_so_far(
    session: Session,
    scale: Scale,
    shots: Sequence[int],
    on_step: Callable[[Progress], None] | None = None,
) -> Reconstruction:
    """Return the light field that some shots of a session give by METHOD.

    Raises AppError, CalibrationError or ReconstructionError.
    """
    scale = scale.of_shots(shots)
    return reconstruct(METHOD, scale.psi, shot_readings(session, scale), on_step=on_step)
