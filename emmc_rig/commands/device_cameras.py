"""`emmc-rig devices` for cameras: info and snap, on whatever `open_camera` opens."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from emmc_rig.commands.output import give_result, show_table, shown_progress, tell
from emmc_rig.drivers.cameras import CAMERA_HELP
from emmc_rig.drivers.errors import DriverError
from emmc_rig.errors import AppError
from emmc_rig.progress import Watcher
from emmc_rig.store.folders import new_file, refuse_inside_session

if TYPE_CHECKING:
    from emmc_rig.drivers.camera import Camera
    from emmc_rig.drivers.raw import RawFrame

CameraSpec = Annotated[
    str,
    typer.Option("--camera", help=f"{CAMERA_HELP}, simulated or a YAML file"),
]
RigOption = Annotated[
    str | None, typer.Option("--rig", help="simulated: as --camera simulated", hidden=True)
]
ExposureOption = Annotated[
    str | None,
    typer.Option("--exposure", help="seconds, or 20ms (default: as the camera is set)"),
]
GainOption = Annotated[
    float | None, typer.Option("--gain", help="1: the lowest ISO (default: as the camera is set)")
]
OutFolder = Annotated[Path, typer.Option("--out", help="folder to save frames in")]


def open_camera(spec: str) -> Camera:
    """Open a camera by name; `emmc_rig.bench.hardware` takes a second to load."""
    from emmc_rig.bench.hardware import open_camera as opened

    return opened(spec)


def register(app: typer.Typer) -> None:
    """Add the commands to the program's `devices`."""
    app.command("camera")(camera_info)
    app.command("snap")(snap)


def camera_info(camera: CameraSpec = "ptp:", rig: RigOption = None) -> None:
    """Show a camera's model and settings."""
    camera = _chosen(camera, rig)
    with closing(open_camera(camera)) as device:
        rows = list(camera_rows(device))
    show_table(("camera", camera), rows)
    give_result(camera=camera, details=dict(rows))


def snap(
    camera: CameraSpec = "ptp:",
    rig: RigOption = None,
    exposure: ExposureOption = None,
    gain: GainOption = None,
    count: Annotated[int, typer.Option("--count", min=1, help="number of frames")] = 1,
    out: OutFolder = Path("emmc-snaps"),
) -> None:
    """Take frames and save them as the camera's own files, with a PNG preview of each."""
    from emmc_rig.store.results import parse_seconds

    exposure_s = parse_seconds(exposure, "--exposure")
    with closing(open_camera(_chosen(camera, rig))) as device:
        folder = frames_folder(out)
        choose(device, exposure_s, gain)
        saved = []
        with shown_progress() as progress:
            for number in range(count):
                progress.begin(f"picture {number + 1} of {count}, MB")
                with _followed(device, progress):
                    frame = device.snap()
                saved.append(str(save_frame(folder, frame)))
                tell(f"{saved[-1]}: {frame_line(frame)}")
    give_result(out, saved=saved)


def simulated_protocol(rig: str) -> str:
    """Return the stages' protocol of `--rig simulated[:PROTOCOL]`; typer's error for any other."""
    kind, _, protocol = rig.partition(":")
    if kind != "simulated":
        raise typer.BadParameter(
            f"--rig {rig}: only simulated rigs are known; name real devices by --stage or --camera"
        )
    return protocol or "zaber"


def _chosen(camera: str, rig: str | None) -> str:
    if rig is None:
        return camera
    simulated_protocol(rig)
    return "simulated"


def camera_rows(device: Camera) -> Iterator[tuple[str, str]]:
    """Yield name and value of what a camera says of itself, without exposing a frame."""
    identity = device.identity
    for name in ("maker", "model", "serial", "firmware"):
        yield name, getattr(identity, name) or "unknown"
    low_s, high_s = device.exposure_limits_s
    yield "exposure", f"{device.exposure_s:g} s, from {low_s:g} to {high_s:g} s"
    low, high = device.gain_limits
    yield "gain", f"{device.gain:g}, from {low:g} to {high:g}"
    details = getattr(device, "details", None)
    yield from details().items() if details is not None else ()


def choose(device: Camera, exposure_s: float | None, gain: float | None) -> None:
    """Set what was asked for; raises AppError for what is not positive."""
    try:
        if exposure_s is not None:
            device.set_exposure_s(exposure_s)
        if gain is not None:
            device.set_gain(gain)
    except DriverError:
        raise
    except ValueError as fault:
        raise AppError(str(fault)) from fault


def frame_line(frame: RawFrame) -> str:
    """Return a frame's figures in one line."""
    from emmc_rig.report.frame_view import brightest
    from emmc_rig.session.brightness import figures

    rows, columns = frame.mosaic.shape
    exposed = "" if frame.exposure_s is None else f", {frame.exposure_s:g} s"
    levels = ", ".join(f"{name} {level:.0%}" for name, level in brightest(frame).items())
    return (
        f"{rows}x{columns} {frame.cfa}{exposed}; brightest {levels}; "
        f"saturated {figures(frame).saturated:.2%}"
    )


def frames_folder(out: Path) -> Path:
    """Return the folder, made if need be; raises AppError where it cannot be, or a session is."""
    refuse_inside_session(out)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as fault:
        raise AppError(f"--out {out}: cannot be made ({fault.strerror})") from fault
    return out


def save_frame(folder: Path, frame: RawFrame) -> Path:
    """Save a frame under the next free number and return the path of the camera's own bytes.

    Beside it a preview (PNG) and the facts (JSON). Every file appears whole or not at all, the
    camera's bytes last; no name comes from the camera. Raises AppError.
    """
    import cv2

    from emmc_rig.report.frame_view import preview
    from emmc_rig.session.frame_file import frame_facts, frame_file

    number = next(n for n in itertools.count(1) if not any(folder.glob(f"frame-{n:04d}.*")))
    stem = folder / f"frame-{number:04d}"
    file = frame_file(frame)
    original = stem.with_suffix(file.suffix)
    ok, png = cv2.imencode(".png", preview(frame))
    if not ok:
        raise AppError(f"{stem}: no preview can be made of this frame: take it again")
    facts = {
        "camera_bytes": original.name,
        "sha256": file.sha256,
        **frame_facts(frame),
        **({} if file.camera_sha256 is None else {"camera_sha256": file.camera_sha256}),
    }
    files = {
        stem.with_suffix(".png"): png.tobytes(),
        stem.with_suffix(".json"): (json.dumps(facts, indent=2) + "\n").encode(),
        original: file.data,
    }
    for path, data in files.items():
        with new_file(path) as partial:
            partial.write_bytes(data)
    return original


@contextmanager
def _followed(device: Any, progress: Watcher) -> Iterator[None]:
    """Show how a picture comes over the wire, where the camera reports it."""
    if not hasattr(device, "on_progress"):
        yield
        return
    before = device.on_progress

    def follow(done: int, size: int) -> None:
        before(done, size)
        progress.at(done // 1_000_000, size // 1_000_000)

    device.on_progress = follow
    try:
        yield
    finally:
        device.on_progress = before
