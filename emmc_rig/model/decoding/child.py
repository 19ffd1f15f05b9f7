"""Arrays of files whose decoders take whatever a file claims: read in a child with little memory.

SciPy, tifffile and OpenEXR unpack without a limit. `python -m emmc_rig.model.decoding.child` is the
child. Its input is JSON, the files to read; its output a line of JSON, the facts that the file
states, and then the array as .npy, or a line of complaint.
"""

from __future__ import annotations

import io
import json
import subprocess
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.decoding.regular import check_regular
from emmc_rig.model.json_text import one_line, parse_json
from emmc_rig.model.memory_limit import held_bytes, limit_memory
from emmc_rig.model.reading import FREE_BYTES, MOST_COMPRESSED

COPIES = 4
"""Of an array at once: as packed, as unpacked, as float32, as sent."""
PATIENCE_S = 600
TOO_LARGE = "it unpacks to more than a file of its size can hold"


def read_in_child(
    kind: str, paths: Sequence[Path], name: str = "", apart: Collection[Path] = ()
) -> tuple[NDArray, dict[str, Any]]:
    """Return the array of a file, or of several stacked, and what the first states.

    kind: of READERS. name: of the array, in a file that may hold several; "": the only one of two
    axes or more. apart: files that are read for themselves, see `read_tiff`. Raises ValueError,
    with the complaint, for what cannot be read, or not within the memory that a data set of HDF5
    may take.
    """
    size_bytes = sum(check_regular(path, ValueError) for path in paths)
    job = {
        "kind": kind,
        "most_bytes": COPIES * (MOST_COMPRESSED * size_bytes + FREE_BYTES),
        "paths": [str(path) for path in paths],
        "name": name,
        "apart": [str(path) for path in apart],
    }
    command = [sys.executable, "-P", "-m", "emmc_rig.model.decoding.child"]
    try:
        done = subprocess.run(
            command, input=json.dumps(job).encode(), capture_output=True, timeout=PATIENCE_S
        )
    except subprocess.TimeoutExpired as fault:
        raise ValueError(f"not read within {PATIENCE_S} s: save it in another format") from fault
    if done.returncode != 0:
        lines = done.stderr.decode(errors="replace").strip().splitlines()
        raise ValueError(
            one_line(lines[-1] if lines else "the decoder crashed: copy it again, or save it anew")
        )
    stream = io.BytesIO(done.stdout)
    facts = parse_json(stream.readline(), "the child", ValueError)
    return np.lib.format.read_array(stream, allow_pickle=False), facts


def only_array(shapes: Mapping[str, Sequence[int]], name: str) -> str:
    """Return which array of a file is meant, by their shapes; raises ValueError.

    name: as asked for; "": the only one with two axes or more.
    """
    known = [key for key, shape in shapes.items() if sum(size > 1 for size in shape) > 1]
    if name in shapes:
        return name
    if name or len(known) != 1:
        missing = f"no array '{name}'" if name else "not one array of two axes or more"
        raise ValueError(f"it holds {missing}; write FILE@ARRAY with one of: {', '.join(shapes)}")
    return known[0]


Reader = Callable[[str], tuple[NDArray, dict[str, Any]]]


def _reader_of_mat(name: str, apart: Collection[str]) -> Reader:
    import scipy.io

    def read(path: str) -> tuple[NDArray, dict[str, Any]]:
        shapes = {key: shape for key, shape, _ in scipy.io.whosmat(path)}
        wanted = only_array(shapes, name)
        return scipy.io.loadmat(path, variable_names=[wanted])[wanted], {}

    return read


def _reader_of_npz(name: str, apart: Collection[str]) -> Reader:
    def read(path: str) -> tuple[NDArray, dict[str, Any]]:
        with np.load(path, allow_pickle=False) as stored:
            arrays = dict(stored)
        return arrays[only_array({key: array.shape for key, array in arrays.items()}, name)], {}

    return read


def _reader_of_tiff(name: str, apart: Collection[str]) -> Reader:
    from emmc_rig.model.decoding.tiff import read_tiff

    return lambda path: read_tiff(path, apart)


def _reader_of_exr(name: str, apart: Collection[str]) -> Reader:
    try:
        import OpenEXR
    except ImportError:
        raise ValueError('EXR needs OpenEXR: pip install "emmc-rig[formats]"') from None
    from emmc_rig.model.decoding.pictures import without_alpha

    def read(path: str) -> tuple[NDArray, dict[str, Any]]:
        with OpenEXR.File(path) as file:
            channels = file.channels()
            known = [key for key in ("RGB", "RGBA", "Y", "YA") if key in channels]
            if len(file.parts) > 1 or len(known) != 1:
                raise ValueError(
                    f"its parts, {len(file.parts)}, have the channels {', '.join(channels)}, where "
                    "a picture has one part with R, G and B, or Y"
                )
            codes = channels[known[0]].pixels
        opaque = True
        if known[0].endswith("A"):
            codes, opaque = without_alpha(codes, 1)
        return codes[None], {"full_scale": None, "opaque": opaque}

    return read


READERS: dict[str, Callable[[str, Collection[str]], Reader]] = {
    "mat": _reader_of_mat,
    "npz": _reader_of_npz,
    "tif": _reader_of_tiff,
    "exr": _reader_of_exr,
}


def _stacked(arrays: Sequence[NDArray], paths: Sequence[str]) -> NDArray:
    """Return arrays on a new first axis; raises ValueError where shapes or types differ."""
    for array, path in zip(arrays, paths, strict=True):
        if array.shape != arrays[0].shape or array.dtype != arrays[0].dtype:
            raise ValueError(
                f"{Path(path).name} holds {'x'.join(map(str, array.shape))} {array.dtype}, and "
                f"{Path(paths[0]).name} {'x'.join(map(str, arrays[0].shape))} {arrays[0].dtype}"
            )
    return np.stack(arrays) if len(arrays) > 1 else np.asarray(arrays[0])


class _Pipe:
    """The output: NumPy would ask a file for its position, which a pipe has not."""

    @staticmethod
    def write(data: bytes) -> None:
        """Send a part of the array."""
        sys.stdout.buffer.write(data)


def main() -> int:
    """Read what standard input asks for; return the exit code."""
    job = parse_json(sys.stdin.buffer.read(), "the job", ValueError)
    try:
        read = READERS[job["kind"]](job["name"], job["apart"])
        limit_memory(held_bytes() + job["most_bytes"], TOO_LARGE)
        found = [read(path) for path in job["paths"]]
        array = _stacked([array for array, _ in found], job["paths"])
        facts = [facts for _, facts in found]
        if len({each.get("full_scale") for each in facts}) > 1:
            raise ValueError("files of different depths")
        opaque = all(each.get("opaque", True) for each in facts)
        _Pipe.write(json.dumps({**facts[0], "opaque": opaque}).encode() + b"\n")
        np.lib.format.write_array(_Pipe(), array, allow_pickle=False)
    except MemoryError:
        print(TOO_LARGE, file=sys.stderr)
        return 1
    except Exception as fault:  # decoders raise whatever they run into
        print(one_line(fault) or type(fault).__name__, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
