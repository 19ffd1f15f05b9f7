"""An edited plan in a session that has begun: frames taken stay, the other frames follow the edit.

An edit may change everything about frames that are not taken yet, and at any time order, checks,
retries, settling and metering level. A frame that is taken keeps its exposure, and stays when the
edited plan lacks it. An edit is refused if it gives a taken frame another bench, gain, camera or
rig, or if it removes a shot with taken frames or gives the shot other masks, another filter or
another mask place.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from emmc_rig.captures.plan import Plan, differences
from emmc_rig.errors import AppError
from emmc_rig.model.camera import Camera
from emmc_rig.model.errors import CameraError
from emmc_rig.model.settings import validated
from emmc_rig.session.planned import PlannedFrame
from emmc_rig.session.session import Session

REMEDY = "take that edit back, or begin another session"


@dataclass(frozen=True)
class Amendment:
    """Another plan for a session; frames: all frames, with taken frames as first planned.

    changes: to the plan, for people. kept: how many frames taken it would expose otherwise.
    """

    changes: tuple[str, ...]
    frames: tuple[PlannedFrame, ...]
    kept: int

    def words(self, stored: int) -> str:
        """Return it in a line; stored: how many frames are taken."""
        shown = "; ".join(self.changes[:3]) + ("; ..." if len(self.changes) > 3 else "")
        stay = f"{stored} frames taken stay"
        if self.kept:
            stay += f", {self.kept} of them exposed as before (another session takes them anew)"
        return f"the plan was edited ({shown}): {stay}, the others follow it"


def amendment(
    session: Session,
    plan: Plan,
    camera: Camera,
    rig: Mapping[str, Any],
    planned: Iterable[PlannedFrame],
) -> Amendment | None:
    """Return what an edited plan makes of a session; None where nothing was edited.

    rig: may differ only while no frame is taken. planned: the frames of the edited plan, in order.
    Raises AppError for an edit that frames already taken contradict.
    """
    folder = session.folder.name
    place = str(session.folder)
    before = validated(Plan, session.plan_data(), place, AppError)
    earlier = validated(Camera, session.camera, str(session.folder), CameraError)
    changes = differences(plan, before)
    if camera != earlier and not changes:
        changes.append("camera")
    if dict(rig) != session.rig:
        changes.append("rig")
    if not changes:
        return None
    if session.stored:
        _refuse_other_camera(session, plan, camera, earlier)
    frames, kept = [], 0
    by_id = {frame.id: frame for frame in session.frames}
    for frame in planned:
        taken = by_id.get(frame.id) if frame.id in session.stored else None
        if taken is None:
            frames.append(frame)
            continue
        difference = _difference(frame, taken)
        if difference:
            raise AppError(
                f"session {folder}: frame {frame.id} is taken, and the edited plan has {difference}"
                f": {REMEDY}"
            )
        kept += frame.exposure_s != taken.exposure_s
        frames.append(taken)
    there = {frame.id for frame in frames}
    frames += [f for f in session.frames if f.id in session.stored and f.id not in there]
    return Amendment(tuple(changes), tuple(frames), kept)


def _refuse_other_camera(session: Session, plan: Plan, camera: Camera, earlier: Camera) -> None:
    """Raise AppError unless the camera is the one by which frames were taken."""
    now, then = (described.model_dump(mode="json") for described in (camera, earlier))
    if {**now, "shots": []} != {**then, "shots": []}:
        raise AppError(
            f"{plan.camera}: the camera was edited since session {session.folder.name} began; "
            f"{REMEDY}"
        )
    taken = {
        frame.bench.shot
        for frame in session.frames
        if frame.id in session.stored and frame.kind != "dark"
    }
    counts = (len(earlier.shots), len(camera.shots))
    patterned = any(
        mask.pattern.frame_count(count) > 1 for mask in camera.masks.values() for count in counts
    )
    if taken and patterned and counts[0] != counts[1]:
        raise AppError(
            "shots: a mask has another pattern in every shot, so that session "
            f"{session.folder.name} must keep {counts[0]} of them: {REMEDY}"
        )
    for shot in sorted(taken):
        if shot >= len(camera.shots) or _seen(now, shot) != _seen(then, shot):
            raise AppError(
                f"shots.{shot}: frames of this shot are taken in session {session.folder.name}, "
                f"and the edited plan has it with other masks, filter or mask place: {REMEDY}"
            )


def _seen(camera: Mapping[str, Any], shot: int) -> dict[str, Any]:
    """Return a shot of the camera without its exposure."""
    return {**camera["shots"][shot], "exposure_s": None}


def _difference(edited: PlannedFrame, taken: PlannedFrame) -> str:
    """Return in what two frames differ that shows in the picture, "" in nothing but exposure."""
    for name, item, other in (
        ("lamp", edited.bench.lamp, taken.bench.lamp),
        ("gain", edited.gain, taken.gain),
        ("view", edited.view, taken.view),
        ("place", dict(edited.bench.offsets_um), dict(taken.bench.offsets_um)),
    ):
        if item != other:
            return f"its {name} as {item}, not {other}"
    same = replace(edited.bench, fitting=0) == replace(taken.bench, fitting=0)
    return "" if same else "another bench for it"
