"""How the runs of a capture spent their time, bench and disk, from the journal's spans."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass

from emmc_rig.session.exposure import shot_exposures
from emmc_rig.session.journal import DecidedEntry, Entry, FrameEntry, RetryEntry, of_kind
from emmc_rig.session.session import Session

BENCH = ("attend", "move", "settle", "expose", "read back", "check")
Span = tuple[float, float]


@dataclass(frozen=True)
class Overlap:
    """Of one run: seconds in all, and spent by the disk; of these, while the bench worked too."""

    seconds: float
    moving_s: float
    exposing_s: float
    writing_s: float
    hidden_s: float

    @property
    def hidden_share(self) -> float:
        """Share of the writing that took no time of its own."""
        return self.hidden_s / self.writing_s if self.writing_s else 0.0


def run_entries(entries: Iterable[Entry]) -> list[list[FrameEntry]]:
    """Return the frames' journal lines, run by run, those without any left out."""
    runs: dict[int, list[FrameEntry]] = {}
    for entry in of_kind(entries, FrameEntry):
        if entry.spans_s:
            runs.setdefault(entry.run, []).append(entry)
    return list(runs.values())


def overlap(entries: Sequence[FrameEntry]) -> Overlap:
    """Return how much of the writing of one run was hidden behind the bench's work."""
    bench = sorted(
        (span[0], span[1])
        for entry in entries
        for name, span in entry.spans_s.items()
        if name in BENCH
    )
    writes = sorted((span[0], span[1]) for span in (e.spans_s["write"] for e in entries))
    ends = [end for _, end in (*bench, *writes)]
    starts = [start for start, _ in (*bench, *writes)]

    def spent(name: str) -> float:
        spans = [entry.spans_s[name] for entry in entries if name in entry.spans_s]
        return sum(end - start for start, end in spans)

    return Overlap(
        max(ends, default=0.0) - min(starts, default=0.0),
        spent("move") + spent("settle"),
        spent("expose"),
        spent("write"),
        _common(bench, writes),
    )


def session_metrics(session: Session) -> dict[str, object]:
    """Return the figures of a session: frames, bytes, retries, and how its runs spent time."""
    entries, needed = session.journal.entries, session.needed
    return {
        "title": session.header["title"],
        "frames": len(needed),
        "spared": len(session.frames) - len(needed),
        "decided": [one.model_dump(mode="json") for one in of_kind(entries, DecidedEntry)],
        "stored": len(session.stored),
        "complete": session.is_complete,
        "bytes": sum(entry.bytes for entry in session.stored.values()),
        "exposures": [asdict(one) for one in shot_exposures(session)],
        "retries": len(of_kind(entries, RetryEntry)),
        "runs": [
            {"frames": len(run), **asdict(one), "hidden_share": one.hidden_share}
            for run in run_entries(entries)
            for one in (overlap(run),)
        ],
        "command": session.header["command"],
        "versions": session.header["versions"],
    }


def _common(ones: Sequence[Span], others: Sequence[Span]) -> float:
    """Return how long both of two sorted lists of spans last, neither overlapping itself."""
    total, i, j = 0.0, 0, 0
    while i < len(ones) and j < len(others):
        start, end = max(ones[i][0], others[j][0]), min(ones[i][1], others[j][1])
        total += max(0.0, end - start)
        if ones[i][1] < others[j][1]:
            i += 1
        else:
            j += 1
    return total
