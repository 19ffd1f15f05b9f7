"""Decisions about a session's shots, from journal lines: the next ones, and those left out.

A capture that ends when the scene needs no more shots writes two kinds of line. `until`: from now
on the wanted PSNR is `target_db`. `decided`: of the `shots` taken the PSNR stated is `stated_db`;
`next` is the shot to take now; without one the `spared` shots are not taken, of `spared_frames`
frames, for the reason in `why`. After an amendment of the plan it is decided anew.

Where shots are metered, a line `metered` says before the first of them by what `exposures_s` each
shot is taken, and which longer frames of brackets, not taken otherwise, are `asked` for. This too
is decided anew after an amendment.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from emmc_rig.session.journal import Entry


def wanted_db(entries: Sequence[Entry], begun_with: float | None) -> float | None:
    """Return the PSNR at which no further shot is taken; None where all are.

    begun_with: what the session was begun with.
    """
    last = next((entry for entry in reversed(entries) if entry["kind"] == "until"), None)
    return begun_with if last is None else last["target_db"]


def decisions(entries: Iterable[Entry]) -> list[Entry]:
    """Return what was decided, oldest first."""
    return [entry for entry in entries if entry["kind"] == "decided"]


def ended(entries: Sequence[Entry]) -> Entry | None:
    """Return the decision that no more shots are needed; None while there is none, or no longer."""
    for entry in reversed(entries):
        if entry["kind"] in ("decided", "until", "amended"):
            return entry if entry.get("next", 0) is None else None
    return None


def spared_shots(entries: Sequence[Entry]) -> frozenset[int]:
    """Return the shots that need not be taken."""
    last = ended(entries)
    return frozenset(() if last is None else last["spared"])


def metered(entries: Sequence[Entry]) -> Entry | None:
    """Return what metering of the scene asks for; None while that is open."""
    for entry in reversed(entries):
        if entry["kind"] in ("metered", "amended"):
            return entry if entry["kind"] == "metered" else None
    return None


def metered_words(entry: Entry) -> str:
    """Return what metering asks for, for people."""
    by_exposure: dict[float, list[str]] = {}
    for shot, exposure_s in entry["exposures_s"].items():
        by_exposure.setdefault(exposure_s, []).append(shot)
    exposures = ", ".join(
        f"shots {', '.join(shots)} by {exposure_s:.3g} s"
        for exposure_s, shots in by_exposure.items()
    )
    longer = f"; {len(entry['asked'])} longer frames, for the dark parts" if entry["asked"] else ""
    return f"metered: {exposures}{longer}"


def decided_words(entry: Entry) -> str:
    """Return a decision for people."""
    taken = ", ".join(str(shot) for shot in entry["shots"])
    stated = f"shots {taken}: {entry['stated_db']:.2f} dB stated, {entry['target_db']:g} wanted"
    if entry["next"] is None:
        spared = f", {len(entry['spared'])} shots spared" if entry["spared"] else ""
        return f"{stated}; no more, {entry['why']}{spared}"
    return f"{stated}; next shot {entry['next']}, {entry['why']}"
