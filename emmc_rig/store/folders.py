"""Results on the disk: a result knows the files it wrote, and only these are ever replaced.

    OUT/
        metrics.json, ...    what a command wrote
        files.json           the command, and the SHA-256 of every file it wrote
        .emmc-rig.partial/   while a command writes: new/, kept/, lock, and at its end files.json

A command writes into `new`. Once all of it is on the disk, so is the hidden folder's files.json:
from then on the new result holds, and whoever comes next finishes what a kill interrupts. Files
that only the earlier files.json lists are deleted, those in `new` renamed into their places, and
files.json last of all.

Nothing is written where a session of `emmc-rig capture` lies: see `refuse_inside_session`.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from emmc_rig.errors import AppError
from emmc_rig.model.files import SYSTEM_DISK
from emmc_rig.model.json_text import parse_json
from emmc_rig.store.locks import TakenError, take_lock

FILES = "files.json"
PARTIAL = ".emmc-rig.partial"
NEW, KEPT, LOCK = "new", "kept", "lock"
MOVES = "moves.json"
"""Of version 0.2, while it replaced a result."""
SESSION_HEADER, SESSION_JOURNAL = "session.json", "journal.jsonl"
SESSION_RECONSTRUCTION = "reconstruction"
"""A folder of a session, by default of what `reconstruct` writes."""


@dataclass(frozen=True)
class Listing:
    """The command that wrote a result, and the SHA-256 of its files by name.

    Names are relative to the folder, with slashes.
    """

    command: str
    files: Mapping[str, str] = field(default_factory=dict)

    def text(self) -> str:
        """Return files.json: the digest at its end shows whether it was edited."""
        body = {"command": self.command, "files": dict(sorted(self.files.items()))}
        digest = hashlib.sha256(json.dumps(body).encode()).hexdigest()
        return json.dumps({**body, "sha256": digest}, indent=1) + "\n"

    @classmethod
    def read(cls, folder: Path) -> Listing | None:
        """Return what a folder's files.json says; None where there is none.

        Raises AppError for a file that was edited.
        """
        path = folder / FILES
        try:
            text = path.read_bytes().decode()
            data = parse_json(text, FILES, ValueError)
            listing = cls(data["command"], data["files"])
            whole = listing.text() == text and all(map(_stays_inside, listing.files))
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            whole = False
        if not whole:
            raise AppError(
                f"{path}: was edited, so it does not state which files may be replaced; choose "
                "another folder"
            )
        return listing


def _stays_inside(name: str) -> bool:
    parts = PurePosixPath(name).parts
    return bool(parts) and not name.startswith("/") and ".." not in parts and parts[0] != PARTIAL


@contextmanager
def result_folder(
    out: Path,
    command: str,
    *,
    belongs_to: Path | None = None,
    adds: bool = False,
    resumes: bool = False,
) -> Iterator[Path]:
    """Yield a folder to write into; its files appear in `out` together when the block succeeds.

    The files of an earlier result of the same command are replaced; whatever else is in the folder
    stays. After a failure everything is as it was; after one in the moves, they are finished.

    Args:
        out: the folder; made where missing.
        command: as typed, such as "calibrate --plan".
        belongs_to: the one folder in a session, or the session itself, where this may be written.
        adds: the folder may hold other things too, and files of the earlier result that are not
            written again stay.
        resumes: what the block put into `kept_folder` stays when it fails or is killed, for the
            next command that resumes there.

    Raises:
        AppError: `out` is, holds or lies inside a session; the folder holds what no earlier
            result of this command wrote, or a file that was edited since; another program writes
            there, or nothing can be written.
    """
    folder = Path(os.path.realpath(out))
    refuse_inside_session(out, belongs_to)
    if os.path.isfile(folder):
        raise AppError(f"{out}: a file of that name exists; choose another folder")
    try:
        with made_folder(folder), _workplace(folder / PARTIAL, resumes):
            _finish(folder)
            earlier = _replaceable(folder, out, command, adds)
            if not adds:
                _refuse_holding(folder, out)
            new = folder / PARTIAL / NEW
            new.mkdir()
            yield new
            _take_place(folder, out, earlier, adds)
            if resumes:
                _clear(folder / PARTIAL)
    except OSError as fault:
        raise AppError(f"{out}: cannot be written ({fault.strerror or fault})") from fault


@contextmanager
def made_folder(folder: Path) -> Iterator[None]:
    """Make a folder and those above it; those that were missing and are empty at the end go again.

    Raises OSError.
    """
    missing = [place for place in (folder, *folder.parents) if not place.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        yield
    finally:
        for place in missing:
            with suppress(OSError):
                place.rmdir()


def kept_folder(new: Path) -> Path:
    """Return the folder that outlives a command that fails, see `result_folder`, made if missing.

    new: what `result_folder` yielded.
    """
    kept = new.parent / KEPT
    kept.mkdir(exist_ok=True)
    return kept


def emptied(folder: Path) -> None:
    """Remove all in a folder; links are not followed."""
    for path in list(folder.iterdir()):
        SYSTEM_DISK.remove(path)


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Yield a name to write to; the file becomes `path`, which must be free, when the block ends.

    After a failure nothing is left. Raises AppError where something of that name is there, also
    when it came meanwhile, where a session is, and where nothing can be written.
    """
    path = _free(path)
    place = path.with_name(f".{path.name}{PARTIAL}")
    try:
        with _workplace(place):
            yield place / path.name
            SYSTEM_DISK.sync(place / path.name)
            try:
                os.link(place / path.name, path)
            except OSError:
                # It came meanwhile, or the file system has no links, as on a memory stick.
                os.rename(place / path.name, _free(path))
    except OSError as fault:
        raise AppError(
            f"{path}: cannot be written ({fault.strerror or fault}); choose another place"
        ) from fault


def _free(path: Path) -> Path:
    refuse_inside_session(path)
    if os.path.lexists(path):
        raise AppError(f"{path}: exists already; choose another name, or move it away first")
    return Path(os.path.abspath(path))


WRITTEN_BY = "name a session, or the folder of simulated frames"
"""Remedy for a folder without frames."""


def refuse_missing(folder: Path, remedy: str) -> None:
    """Raise AppError, with the remedy, where the folder is missing."""
    if not folder.exists():
        raise AppError(f"{folder}: no such folder; {remedy}")


def refuse_filled(out: Path) -> None:
    """Raise AppError unless the folder is missing or empty."""
    try:
        if out.exists() and not out.is_dir():
            raise AppError(f"{out}: a file of that name exists; choose another folder")
        if out.exists() and any(out.iterdir()):
            raise AppError(f"{out}: holds something already; choose another folder")
    except OSError as fault:
        raise AppError(f"{out}: cannot be read ({fault.strerror or fault})") from fault


def is_session(folder: Path) -> bool:
    """Return whether a folder is a session."""
    return (folder / SESSION_JOURNAL).is_file() and (folder / SESSION_HEADER).is_file()


def refuse_inside_session(out: Path, belongs_to: Path | None = None) -> None:
    """Raise AppError where `out` is a session or lies inside one, also through links.

    A damaged session is one too. belongs_to: see `result_folder`.
    """
    real = Path(os.path.realpath(out))
    if belongs_to is not None and real == Path(os.path.realpath(belongs_to)):
        return
    for place in (real, *real.parents):
        if any(os.path.isfile(place / name) for name in (SESSION_JOURNAL, SESSION_HEADER)):
            where = "is" if place == real else "lies inside"
            raise AppError(
                f"{out}: {where} the session {place}, where nothing else is written; choose "
                "another place"
            )


def _refuse_holding(folder: Path, out: Path) -> None:
    for place, _, names in os.walk(folder):
        if SESSION_JOURNAL in names or SESSION_HEADER in names:
            raise AppError(
                f"{out}: holds the session {os.path.relpath(place, folder)}; choose another folder"
            )


@contextmanager
def _workplace(place: Path, resumes: bool = False) -> Iterator[None]:
    """Make a hidden folder for this program alone, and remove it with its files at the end.

    Files of a killed program are removed too, except a result on its way to its place, and kept
    files if `resumes`. Raises AppError if another program works in the folder, and OSError.
    """
    release = None
    while release is None:
        place.mkdir(exist_ok=True)
        try:
            release = take_lock(place / LOCK)
        except TakenError as taken:
            raise AppError(
                f"{place.parent}: another emmc-rig command writes there: {taken}"
            ) from None
        except FileNotFoundError:
            continue  # whoever held it has removed it meanwhile
    try:
        _clear(place, KEPT if resumes else None)
        yield
    finally:
        try:
            with suppress(OSError):
                _clear(place, KEPT if resumes else None)
        finally:
            with suppress(OSError):
                release()
                place.rmdir()


def _clear(place: Path, spared: str | None = None) -> None:
    """Empty a hidden folder, unless it holds a result on its way; links are not followed.

    spared: the name of a subfolder that stays, unless it is empty.
    """
    if (place / FILES).exists() or (place / MOVES).exists():
        return
    for path in list(place.iterdir()):
        is_folder = path.is_dir() and not path.is_symlink()
        if path.name == LOCK or (path.name == spared and is_folder and any(path.iterdir())):
            continue
        SYSTEM_DISK.remove(path)


def _replaceable(folder: Path, out: Path, command: str, adds: bool) -> Listing:
    """Return the earlier result, empty where there is none; raises AppError."""
    earlier = Listing.read(folder)
    if earlier is None:
        if not adds and any(path.name != PARTIAL for path in folder.iterdir()):
            raise AppError(
                f"{out}: the folder holds something other than an earlier result; choose "
                "another folder or empty it"
            )
        return Listing(command)
    if earlier.command != command:
        raise AppError(f"{out}: holds the result of {earlier.command}; choose another folder")
    _refuse_foreign(folder, out, earlier.files, earlier)
    return earlier


def refuse_edited(out: Path, command: str) -> None:
    """Raise what `result_folder` would of an earlier result, where it adds to a folder."""
    if out.is_dir():
        _replaceable(Path(os.path.realpath(out)), out, command, adds=True)


def _refuse_foreign(folder: Path, out: Path, names: Iterable[str], earlier: Listing) -> None:
    """Raise AppError where a file of these names is not the file of the earlier result."""
    for name in names:
        for path in (folder / name, *_above(folder, name)):
            is_in_the_way = path.is_file() or path == folder / name
            inside = path.relative_to(folder).as_posix()
            if path.is_symlink() or (
                is_in_the_way and path.exists() and _digest(path) != earlier.files.get(inside)
            ):
                what = (
                    f"{name} is not what {earlier.command} wrote"
                    if name in earlier.files
                    else f"{inside} is there and of no earlier result"
                )
                raise AppError(f"{out}: {what}; move it away or choose another folder")


def _above(folder: Path, name: str) -> list[Path]:
    """Return the folders of a file within a result's folder, the innermost first."""
    return [path for path in (folder / name).parents if folder in path.parents]


def _digest(path: Path) -> str:
    """Return a file's SHA-256, "" for what is no file."""
    if not path.is_file():
        return ""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _take_place(folder: Path, out: Path, earlier: Listing, adds: bool) -> None:
    """Replace the earlier result by what lies in `new`: all of it or, after an error, nothing."""
    new, partial, files = folder / PARTIAL / NEW, folder / PARTIAL, {}
    for path in sorted(new.rglob("*")):
        if not path.is_dir():
            SYSTEM_DISK.sync(path)
            files[path.relative_to(new).as_posix()] = _digest(path)
    kept = {name: sha for name, sha in earlier.files.items() if adds and name not in files}
    # Somebody may have edited it since the command began.
    if (Listing.read(folder) or Listing(earlier.command)) != earlier:
        raise AppError(f"{out}: {FILES} is not what {earlier.command} wrote")
    _refuse_foreign(folder, out, {**earlier.files, **files}, earlier)
    (new / FILES).write_bytes(Listing(earlier.command, {**kept, **files}).text().encode())
    SYSTEM_DISK.sync(new / FILES)
    os.replace(new / FILES, partial / FILES)
    try:
        _finish(folder)
    except BaseException:
        # After Ctrl-C, or a fault that has passed; otherwise the next command finishes it.
        with suppress(OSError):
            _finish(folder)
        raise


def _finish(folder: Path) -> None:
    """Let the result that the hidden folder's files.json lists take its place, if there is one.

    Raises AppError where somebody changed, after a kill, what would be replaced.
    """
    partial = folder / PARTIAL
    if (partial / MOVES).exists():
        raise AppError(
            f"{partial}: version 0.2 was interrupted as it replaced a result; choose another folder"
        )
    listing = Listing.read(partial)
    if listing is None:
        return
    earlier = Listing.read(folder) or Listing(listing.command)
    left = [name for name in listing.files if (partial / NEW / name).exists()]
    obsolete = [name for name in earlier.files if name not in listing.files]
    _refuse_foreign(folder, folder, (*left, *obsolete), earlier)
    for name in obsolete:
        (folder / name).unlink(missing_ok=True)
    above = {path for name in obsolete for path in _above(folder, name)}
    for path in sorted(above, key=lambda path: len(path.parts), reverse=True):
        with suppress(OSError):
            path.rmdir()
    for name in left:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        os.replace(partial / NEW / name, folder / name)
    _sync_folders(folder, [*obsolete, *left])
    os.replace(partial / FILES, folder / FILES)
    _sync_folders(folder, [FILES])
    with suppress(OSError):
        SYSTEM_DISK.remove(partial / NEW)


def _sync_folders(folder: Path, names: Iterable[str]) -> None:
    """Return when the names are on the disk."""
    for place in {folder, *((folder / name).parent for name in names)}:
        with suppress(FileNotFoundError):
            SYSTEM_DISK.sync(place)
