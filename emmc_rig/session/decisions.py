"""What a session decided about its shots, from journal lines: which come next, which are spared.

A capture that ends when the scene needs no more shots writes two kinds of line. `until`: from now
on the wanted PSNR is `target_db`. `decided`: of the `shots` taken the PSNR stated is `stated_db`;
`next` is the shot to take now; without one the `spared` shots are not taken, of `spared_frames`
frames, for the reason in `why`. After an amendment of the plan it is decided anew.
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


def decided_words(entry: Entry) -> str:
    """Return a decision for people."""
    taken = ", ".join(str(shot) for shot in entry["shots"])
    stated = f"shots {taken}: {entry['stated_db']:.2f} dB stated, {entry['target_db']:g} wanted"
    if entry["next"] is None:
        spared = f", {len(entry['spared'])} shots spared" if entry["spared"] else ""
        return f"{stated}; no more, {entry['why']}{spared}"
    return f"{stated}; next shot {entry['next']}, {entry['why']}"
