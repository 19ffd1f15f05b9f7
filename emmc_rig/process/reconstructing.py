"""The one way from frames and Psi to a result, for the Python API and the command line."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from numbers import Real
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numba import get_num_threads
from numpy.typing import ArrayLike, NDArray

from emmc_rig.errors import ERRORS, AppError
from emmc_rig.formats.scenes import open_scene
from emmc_rig.model.arguments import NAMES, numbers_of, path_of, refusal, required
from emmc_rig.model.camera import camera_of, pixel_light
from emmc_rig.model.frames import Frames
from emmc_rig.model.reading import read_yaml
from emmc_rig.model.sensing import Psi, PsiLayout
from emmc_rig.model.settings import validated
from emmc_rig.model.view_axes import ATTRIBUTE, stored_as
from emmc_rig.process.block_tasks import Blocks, block_job, compute_blocks
from emmc_rig.process.captures import Capture, opened_capture
from emmc_rig.process.cost import (
    BASE_BYTES,
    assumed_grid,
    own_bytes,
    task_bytes,
)
from emmc_rig.process.result import Result, compared, figures, open_result
from emmc_rig.progress import Notes, Watcher
from emmc_rig.reconstruction.dictionary import Dictionary, open_dictionary
from emmc_rig.reconstruction.inputs import check_frames
from emmc_rig.reconstruction.methods import DEFAULT_METHOD, MethodSettings, find_method
from emmc_rig.reconstruction.result import Progress
from emmc_rig.reconstruction.tiles import reconstruct_in_blocks
from emmc_rig.reconstruction.verdict.run import reconstruct_judged
from emmc_rig.store.folders import KEPT, WRITTEN_BY, kept_folder, refuse_missing, result_folder
from emmc_rig.store.jobs import kept_words
from emmc_rig.store.pool import Ceiling, Pool, opened_pool
from emmc_rig.store.psi import FRAMES, StoredPsi
from emmc_rig.store.result_files import LIGHT_FIELD, MAPS, RESULT_GROUP, holds_light_field
from emmc_rig.store.results import PSI_ASSUMED, save_frames, write_metrics
from emmc_rig.store.shards import opened_array

OnStep = Callable[[Progress], None]
PSI_TAKES = (
    "a Psi: camera.psi(size), Psi.load(file), Psi.from_scipy(matrix, ...), or "
    "Psi.from_weights(weights)"
)
FRAMES_TAKES = "frames, or an array (shot, pixel_y, pixel_x) of real readings"
LARGEST_READING = 8.0
"""A white board without masks reads 1; a reading that large is none."""
CODES, FEW_CODES = 255, 32
"""Of pictures of 8 bits; fewer different ones may be a drawing in readings."""
Place = tuple[Capture, Path]
"""A capture, and the folder of its result; a session has a single folder for results."""


def reconstruct(
    psi: Psi,
    frames: Frames | ArrayLike,
    method: str = DEFAULT_METHOD,
    *,
    noise_sigma: float | None = None,
    usable: NDArray[np.bool_] | None = None,
    dictionary: Dictionary | str | None = None,
    settings: MethodSettings | Mapping[str, Any] | None = None,
    on_step: OnStep | None = None,
) -> Result:
    """Return the light field estimated from frames and Psi, with a verdict on it.

    Args:
        psi: the imaging matrix of the camera that took the frames.
        frames: the frames of `Camera.expose`, `open_frames` or `frames`, or an array (shot,
            pixel_y, pixel_x) of readings, such as `psi @ scene`. White reads 1 without masks.
        method: a name that `emmc-rig reconstruct --list` lists.
        noise_sigma: one standard deviation for all readings, in readings. None: that of the frames;
            for an array, that of the sensor of Psi's camera at these readings.
        usable: which readings to use, boolean, (shot, pixel_y, pixel_x). None: those usable in the
            frames, or all of an array.
        dictionary: for methods that need one: a dictionary, the path of its file, or "lambertian",
            which None stands for, too.
        settings: settings of the methods, or a dict with the keys of a settings file, such as
            {"tv": {"max_steps": 50}}. None: the defaults.
        on_step: a function that is called after each step with its `Progress`: step,
            relative_change, objective and total.

    Returns:
        A `Result`: `light_field`, `sigma` and `disparity` are arrays, `verdict` says whether to
        trust them. A solver that did not converge returns a result, too: see its `status`.

    Raises:
        AppError: an array without `noise_sigma`, where Psi does not know its camera; an array of
            raw values of a sensor, or of the codes of a picture; wrong settings.
        ReconstructionError: an unknown method, frames that do not fit Psi, a file that is no
            dictionary.
        ArgumentError: an argument of another type.

    >>> import emmc_rig as emmc
    >>> scene = emmc.scene("near-planar", size=(24, 32))
    >>> psi = emmc.camera("rgbw-bayer-1shot").psi(scene.size)
    >>> emmc.reconstruct(psi, psi @ scene, "tv").light_field.shape
    (5, 5, 24, 32, 3)
    """
    required(psi, Psi, "psi", PSI_TAKES)
    required(method, str, "method", "the name of a method, such as 'adaptive'")
    needs_dictionary = find_method(method).needs_dictionary
    chosen = settings_of(settings)
    if on_step is not None and not callable(on_step):
        raise refusal(on_step, "on_step", "a function of the progress")
    if needs_dictionary and dictionary is not None and not isinstance(dictionary, Dictionary):
        required(dictionary, NAMES, "dictionary", "a dictionary, its file, or a built-in name")
    readings = as_frames(psi, frames, noise_sigma, usable)
    return _solved(psi, readings, method, dictionary, chosen, on_step)


def settings_of(settings: MethodSettings | Mapping[str, Any] | None) -> MethodSettings:
    """Return the settings of methods that a caller gave; raises AppError or ArgumentError."""
    if isinstance(settings, Mapping):
        return validated(MethodSettings, dict(settings), "settings", AppError)
    if settings is None:
        return MethodSettings()
    required(settings, MethodSettings, "settings", "MethodSettings, or a dict of settings")
    return settings


def _solved(
    psi: Psi,
    frames: Frames,
    method: str,
    dictionary: Dictionary | str | None,
    settings: MethodSettings,
    on_step: OnStep | None,
) -> Result:
    """Return the result of arguments that were checked, in this process."""
    if not find_method(method).needs_dictionary:
        dictionary = None
    elif not isinstance(dictionary, Dictionary):
        dictionary = open_dictionary(dictionary, psi.views, psi.binning)
    solve = reconstruct_judged if is_one_block(psi.size, settings) else reconstruct_in_blocks
    solved, verdict = solve(method, psi, frames, dictionary, settings, on_step)
    kind = None if dictionary is None else dictionary.kind
    return Result(solved, verdict, psi, frames, kind, settings)


def as_frames(
    psi: Psi,
    frames: Frames | ArrayLike,
    noise_sigma: float | None,
    usable: NDArray[np.bool_] | None,
) -> Frames:
    """Return frames as a method takes them: with a deviation, and which are usable."""
    if noise_sigma is not None:
        is_level = isinstance(noise_sigma, Real) and 0 <= noise_sigma < np.inf
        if not is_level:
            raise refusal(noise_sigma, "noise_sigma", "the readings' standard deviation, 0 or more")
    if isinstance(frames, Frames):
        taken = frames
    else:
        readings = numbers_of(frames, "frames", FRAMES_TAKES)
        check_frames(psi.frames_shape, readings)
        _refuse_codes(readings)
        everywhere = np.ones(readings.shape, dtype=bool)
        if noise_sigma is None:
            deviation = sensor_deviation(psi, readings)
            everywhere &= np.isfinite(deviation)
        else:
            deviation = np.zeros(readings.shape)
        taken = Frames(readings, deviation, everywhere)
    if noise_sigma is not None:
        taken = replace(taken, deviation=np.full(taken.shape, noise_sigma))
    if usable is None:
        return taken
    if not (isinstance(usable, np.ndarray) and usable.dtype.kind == "b"):
        raise refusal(usable, "usable", "a boolean array (shot, pixel_y, pixel_x)")
    if usable.shape == taken.shape:
        # Unknown reason: the readings are no lower bound of the light, unlike saturated readings.
        taken = replace(taken, readings=np.where(usable, taken.readings, 0))
    return replace(taken, usable=usable)


def _refuse_codes(readings: NDArray) -> None:
    """Raise AppError for an array of raw values, or of a picture's codes scaled to [0, 1]."""
    finite = readings[np.isfinite(readings)]
    top = float(finite.max(initial=0))
    if top > LARGEST_READING and not np.mod(finite, 1).any():
        gamma = "; codes of a picture have a gamma: gamma=2.2" if top <= CODES else ""
        raise AppError(
            f"frames: whole numbers up to {top:.6g} are raw values, no readings: "
            f"emmc_rig.frames(dn, dark=..., white_level=...) makes readings of them{gamma}"
        )
    codes = CODES * finite
    if np.abs(codes - np.round(codes)).max(initial=0) < 1e-3 and len(np.unique(codes)) > FEW_CODES:
        raise AppError(
            "frames: multiples of 1/255 are codes of a picture, whose light has a gamma: "
            "emmc_rig.frames(codes, gamma=2.2) makes readings of them, or with gamma=1 where the "
            "sensor itself writes 8 bits"
        )


def sensor_deviation(psi: Psi, readings: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the standard deviation that the sensor of Psi's camera adds to readings.

    Infinite where no light reaches a pixel. Raises AppError where Psi does not know its camera.
    """
    if not psi.camera_json:
        raise AppError(
            "this Psi does not know its camera: give the readings' noise_sigma, or make frames of "
            "raw values by emmc_rig.frames, which estimates it"
        )
    camera = camera_of(psi)
    light = pixel_light(camera, psi.size)
    variance = camera.sensor.noise.variance(readings, camera.exposures_s()[:, None, None], light)
    return np.sqrt(variance)


def is_one_block(size: tuple[int, int], settings: MethodSettings | None) -> bool:
    """Return whether a light field of this size is reconstructed as a whole."""
    return size[0] * size[1] <= (settings or MethodSettings()).blocks.whole


def reconstruct_undrawn(
    capture: Capture,
    out: Path,
    method: str = DEFAULT_METHOD,
    psi_path: Path | None = None,
    dictionary_spec: str | None = None,
    settings: MethodSettings | None = None,
    truth: str | None = None,
    watcher: Watcher | None = None,
    chosen: str | None = None,
    pool: Pool | None = None,
    as_zarr: bool = False,
    without_shots: Sequence[int] = (),
    frame: int | None = None,
) -> tuple[dict, Callable[..., None] | None]:
    """Reconstruct a capture's frames into an existing folder `out`, all but the page.

    Returns the metrics, and what writes the page, given its folder: None for a light
    field too large for a page.

    A light field of more than one block, see `reconstruction.tiles`, is computed by the pool, from
    what an earlier run left of it. dictionary_spec: see `open_dictionary`. truth: the scene that
    was captured, when known, to compare with. chosen: why this method, for the metrics. pool: by
    default as many processes as threads; if one is given, it computes small light fields, too.
    as_zarr: write light field and maps as one Zarr group, by the pool, and no page.
    without_shots: counted from 1, that are not used. frame: of a session's film, alone.
    watcher: gets steps, and the name of Psi as a note.
    """
    find_method(method)
    settings, watcher = settings or MethodSettings(), watcher or Watcher()
    assumed = psi_path is None and capture.assumed
    frames, psi_path = capture.frames(psi_path, frame, out, watcher)
    frames = _without(frames, without_shots)
    saved = StoredPsi(psi_path)
    in_memory = is_one_block(saved.size, settings) and not as_zarr
    further: dict[str, Any] = {"chosen": chosen, "source": str(capture.folder)}
    if psi_path.parent != out:
        further["psi_file"] = str(psi_path.absolute())
    if assumed:
        further["assumed"] = PSI_ASSUMED
    if in_memory and pool is None:
        result = _solved(saved.load(), frames, method, dictionary_spec, settings, watcher.advance)
    else:
        saved.verify()
        check_frames(saved.frames_shape, frames.readings)
        kept = kept_folder(out).absolute()
        job = block_job(kept, psi_path.absolute(), frames, method, dictionary_spec, settings)
        with nullcontext(pool) if pool is not None else opened_pool(get_num_threads()) as workers:
            blocks = compute_blocks(job, frames, workers, watcher)
            if as_zarr:
                blocks.write_shards(out / RESULT_GROUP, workers)
        further |= blocks.metrics()
        if not in_memory:
            return _write_blocks(blocks, frames, capture, out, truth, further), None
        result = _result_of_blocks(blocks, saved.load(), frames)
    result = replace(result, verdict=result.verdict.with_reasons(capture.exposure_reasons()))
    true = None if truth is None else _true(truth, result.psi)
    metrics = {
        **result.metrics(),
        **further,
        **_compared(result.light_field, truth, true, result.solved.measured),
    }
    result.write(out, metrics)
    return metrics, partial(result.draw, metrics=metrics, truth=true)


def _result_of_blocks(blocks: Blocks, psi: Psi, frames: Frames) -> Result:
    """Return the result of a capture whose blocks are done, its arrays in memory."""
    arrays = {name: np.empty(*shape) for name, shape in blocks.shapes().items()}
    for name, array in arrays.items():
        blocks.write(name, array)
    light_field = arrays.pop("light_field")
    solved = replace(blocks.result(), light_field=light_field, maps=arrays)
    return Result(solved, blocks.verdict(), psi, frames, settings=blocks.job.settings)


def _write_blocks(
    blocks: Blocks,
    frames: Frames,
    capture: Capture,
    out: Path,
    truth: str | None,
    further: Mapping[str, Any],
) -> dict:
    """Write what does not fit into memory, unless it is a Zarr group already; return the metrics.

    further: metrics besides those of the result.
    """
    psi, verdict = blocks.job.psi, blocks.verdict().with_reasons(capture.exposure_reasons())
    metrics = {
        **figures(blocks.result(), verdict, frames, blocks.job.settings),
        "shots": psi.shots,
        "size": list(psi.size),
        "view_axes": list(psi.view_axes),
        "psi_sha256": psi.checksum,
        "dictionary": blocks.job.dictionary,
        **further,
    }
    true = None if truth is None else _true(truth, psi)
    save_frames(out / FRAMES, frames)
    if (out / RESULT_GROUP).exists():
        metrics |= _compared(
            opened_array(out / RESULT_GROUP, "light_field"), truth, true, blocks.measured
        )
    else:
        with h5py.File(out / LIGHT_FIELD, "w") as file, h5py.File(out / MAPS, "w") as maps:
            file.attrs["method"] = blocks.job.method
            maps.attrs[ATTRIBUTE] = stored_as(psi.view_axes)
            for name, (shape, dtype) in blocks.shapes().items():
                home = file if name == "light_field" else maps
                made = home.create_dataset(name, shape, dtype)
                if home is file:
                    made.attrs[ATTRIBUTE] = stored_as(psi.view_axes)
                blocks.write(name, made)
            metrics |= _compared(file["light_field"], truth, true, blocks.measured)
    write_metrics(out, metrics)
    return metrics


def _true(truth: str, psi: PsiLayout) -> NDArray:
    """Return the true light field of a scene that was captured."""
    return np.asarray(open_scene(truth, size=psi.size, views=psi.views))


def _compared(
    light_field: Any,
    truth: str | None,
    true: NDArray | None,
    measured: NDArray[np.bool_] | None,
) -> dict[str, Any]:
    """Return how near a light field, an array or dataset, is to the scene captured, if known."""
    return {} if true is None else {"truth": truth, **compared(light_field, true, measured)}


def ceiling_for(
    memory: int,
    captures: Sequence[Capture],
    psi: Path | None,
    settings: MethodSettings,
    as_zarr: bool,
    compares: bool,
) -> tuple[Ceiling, int, int]:
    """Return a ceiling, and how many workers and captures at a time fit below it.

    Workers become fewer where a survey finds larger disparities than assumed here. Raises AppError
    where not even one worker fits.
    """  # fmt: skip
    need = own = 0
    for capture in captures:
        saved = StoredPsi(psi or capture.psi_file())
        need = max(need, task_bytes(saved, assumed_grid(saved, settings)))
        own = max(own, own_bytes(saved, settings, as_zarr, compares))
    single, double = (Ceiling(memory, BASE_BYTES + captures * own) for captures in (1, 2))
    if len(captures) > 1 and double.total - double.own >= 2 * need:
        return double, double.workers(need), 2
    return single, single.workers(need), 1


def reconstruct_captures(
    places: Sequence[Place],
    workers: int | None,
    cluster: str | None,
    memory: int | None,
    watcher: Watcher,
    **given: Any,
) -> Iterator[tuple[Place, dict | Exception]]:
    """Yield each capture with its metrics, or with its error, in the order of completion.

    workers: processes; None, for a single capture of a single block: threads of this process.
    memory: bytes of all processes together, kept by computing less at a time. watcher: gets the
    steps of a single capture, or the captures done. given: see `reconstruct_undrawn`.
    Raises WorkersError, and AppError for a ceiling that is too low.
    """
    alone = len(places) == 1
    count, ceiling = workers or get_num_threads(), None
    # One more than the pool computes at a time is read ahead, or written behind.
    at_a_time = len(places)
    if memory is not None:
        ceiling, most, at_a_time = ceiling_for(
            memory, [capture for capture, _ in places], given.get("psi_path"),
            given.get("settings") or MethodSettings(), given.get("as_zarr", False),
            given.get("truth") is not None,
        )  # fmt: skip
        count = min(count, most)
    shared = not alone or workers is not None or cluster is not None or memory is not None
    with opened_pool(count, cluster, ceiling) if shared else nullcontext() as pool:
        if pool is None or alone:
            yield places[0], _outcome(places[0], pool=pool, watcher=watcher, **given)
            return
        notes = Notes(watcher)
        with ThreadPoolExecutor(min(at_a_time, pool.size + 1)) as threads:
            futures = {
                threads.submit(_outcome, place, pool=pool, watcher=notes, **given): place
                for place in places
            }
            try:
                for done, future in enumerate(as_completed(futures), 1):
                    outcome = future.result()
                    watcher.at(done, len(places))
                    yield futures[future], outcome
            except BaseException:
                for future in futures:
                    future.cancel()
                pool.end()
                raise


def _outcome(place: Place, **given: Any) -> dict | Exception:
    """Return a capture's metrics, or what it failed by; raises StoppedError by Ctrl-C."""
    capture, out = place
    try:
        with result_folder(
            out, "reconstruct", belongs_to=capture.own_place, resumes=True
        ) as folder:

            def kept() -> str:
                return "blocks that are done are" if (folder.parent / KEPT).is_dir() else ""

            with kept_words(out, kept):
                metrics, draw = reconstruct_undrawn(capture, folder, **given)
        if draw is not None:  # the result is on the disk, whatever happens to its page
            with result_folder(
                out, "reconstruct", belongs_to=capture.own_place, adds=True
            ) as folder:
                draw(folder, source=str(out))
        return metrics
    except ERRORS as fault:
        return fault


def open_frames(
    folder: str | Path, psi: str | Path | None = None, frame: int | None = None
) -> tuple[Psi, Frames]:
    """Return Psi and the frames of a folder: a session, a result, or an output of `simulate`.

    Args:
        folder: the folder.
        psi: the file of another imaging matrix. None: psi.h5 beside the frames, or the calibration
            of a session. A session with whiteboards and no calibration is calibrated first.
        frame: of a session with a film, the frame to return, counted from 0.

    Returns:
        Psi, and frames (shot, pixel_y, pixel_x) of normalised readings.

    Raises:
        AppError: a folder without frames, a session whose shots are not captured.
        SensingError: no Psi, or a damaged one.
        CalibrationError: whiteboards of the session that measure no Psi.
        ArgumentError: a folder or file that is no path.

    >>> import emmc_rig as emmc
    >>> psi = emmc.camera("rgbw-bayer-1shot").psi((24, 32))
    >>> emmc.reconstruct(psi, psi @ emmc.scene("near-planar", size=(24, 32)), "tv").save("kept")
    >>> psi, frames = emmc.open_frames("kept")
    >>> frames.shape
    (1, 24, 32)
    """
    takes = "the folder of a session, or of frames with their Psi"
    folder = path_of(folder, "folder", takes)
    if psi is not None:
        psi = path_of(psi, "psi", "the file of a Psi, psi.h5")
    refuse_missing(folder, WRITTEN_BY)
    if folder.is_file():
        raise AppError(
            f"{folder}: a file; open_frames takes {takes}; readings of your own are given to "
            "`reconstruct` as an array (shot, pixel_y, pixel_x)"
        )
    if holds_light_field(folder):
        result = open_result(folder)
        frames = result.frames
        return (result.psi if psi is None else StoredPsi(Path(psi)).load()), frames
    return opened_capture(folder).loaded(None if psi is None else Path(psi), frame)


def _without(frames: Frames, shots: Sequence[int]) -> Frames:
    """Return frames of which some shots, counted from 1, are not used.

    Raises AppError for unknown shots, and where every shot would be left out.
    """
    count = len(frames.readings)
    wrong = [shot for shot in shots if not 1 <= shot <= count]
    if wrong or len(set(shots)) == count:
        raise AppError(
            f"without shots {' '.join(map(str, wrong or shots))}: the capture has shots 1 to "
            f"{count}, and one of them must be left"
        )
    out = np.isin(np.arange(1, count + 1), shots)[:, None, None]
    return replace(frames, readings=np.where(out, 0, frames.readings), usable=frames.usable & ~out)


def load_settings(path: Path | None) -> MethodSettings:
    """Read method settings from YAML; misspelt keys name the nearest valid one."""
    if path is None:
        return MethodSettings()
    return validated(MethodSettings, read_yaml(path, AppError), str(path), AppError)
