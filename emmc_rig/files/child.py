"""Arrays of files whose decoders take whatever a file claims: read in a child with little memory.

SciPy, tifffile and OpenEXR unpack without a limit. `python -m emmc_rig.files.child` is the child:
JSON of what to read on its input, the array as .npy on its output, or one line of complaint.
"""

from __future__ import annotations

import io
import json
import resource
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.json_text import one_line, parse_json
from emmc_rig.model.reading import FREE_BYTES, MOST_COMPRESSED

COPIES = 4
"""Of an array at once: as packed, as unpacked, as float32, as sent."""
PATIENCE_S = 600


def read_in_child(kind: str, paths: Sequence[Path], name: str = "") -> NDArray:
    """Return the array of a file, or of several stacked; kind: of READERS.

    name: of the array, in a file that may hold several; "": the only one of two axes or more.
    Raises ValueError, with the complaint, for what cannot be read, or not within the memory that a
    data set of HDF5 may take.
    """
    size_bytes = sum(path.stat().st_size for path in paths)
    most_bytes = COPIES * (MOST_COMPRESSED * size_bytes + FREE_BYTES)
    job = json.dumps(
        {
            "kind": kind,
            "most_bytes": most_bytes,
            "paths": [str(path) for path in paths],
            "name": name,
        }
    )
    command = [sys.executable, "-P", "-m", "emmc_rig.files.child"]
    try:
        done = subprocess.run(command, input=job.encode(), capture_output=True, timeout=PATIENCE_S)
    except subprocess.TimeoutExpired as fault:
        raise ValueError(f"not read within {PATIENCE_S} s") from fault
    if done.returncode != 0:
        lines = done.stderr.decode(errors="replace").strip().splitlines()
        raise ValueError(one_line(lines[-1] if lines else "the decoder ended; is it damaged?"))
    return np.lib.format.read_array(io.BytesIO(done.stdout), allow_pickle=False)


def only_array(shapes: Mapping[str, Sequence[int]], name: str) -> str:
    """Return which array of a file is meant, by their shapes; raises ValueError.

    name: as asked for; "": the only one with two axes or more.
    """
    known = [one for one, shape in shapes.items() if sum(size > 1 for size in shape) > 1]
    if name in shapes:
        return name
    if name or len(known) != 1:
        missing = f"no array '{name}'" if name else "not one array of two axes or more"
        raise ValueError(f"it holds {missing}; write FILE@ARRAY with one of: {', '.join(shapes)}")
    return known[0]


def _reader_of_mat(name: str) -> Callable[[str], Any]:
    import scipy.io

    def read(path: str) -> NDArray:
        shapes = {one: shape for one, shape, _ in scipy.io.whosmat(path)}
        wanted = only_array(shapes, name)
        return scipy.io.loadmat(path, variable_names=[wanted])[wanted]

    return read


def _reader_of_npz(name: str) -> Callable[[str], Any]:
    def read(path: str) -> NDArray:
        with np.load(path, allow_pickle=False) as stored:
            arrays = dict(stored)
        return arrays[only_array({one: array.shape for one, array in arrays.items()}, name)]

    return read


def _reader_of_tiff(name: str) -> Callable[[str], Any]:
    import tifffile

    return tifffile.imread


def _reader_of_tiff_times(name: str) -> Callable[[str], Any]:
    """Read (page, 2): exposure and time of every page in seconds, NaN where it states none."""
    import xml.etree.ElementTree

    import tifffile

    seconds = {"s": 1.0, "ms": 1e-3, "\u00b5s": 1e-6, "us": 1e-6, "ns": 1e-9}

    def read(path: str) -> NDArray:
        with tifffile.TiffFile(path) as tiff:
            known = np.full((len(tiff.pages), 2), np.nan)
            if tiff.ome_metadata:
                root = xml.etree.ElementTree.fromstring(tiff.ome_metadata)
                planes = [one for one in root.iter() if one.tag.endswith("}Plane")]
                for place, plane in enumerate(planes[: len(known)]):
                    for column, key in enumerate(("ExposureTime", "DeltaT")):
                        unit = seconds[plane.get(f"{key}Unit", "s")]
                        known[place, column] = float(plane.get(key, "nan")) * unit
            for place, page in enumerate(tiff.pages):
                tag = page.aspage().tags.get("MicroManagerMetadata")
                if tag is not None:
                    for column, key in enumerate(("Exposure-ms", "ElapsedTime-ms")):
                        known[place, column] = float(tag.value.get(key, "nan")) / 1000
        return known

    return read


def _reader_of_exr(name: str) -> Callable[[str], Any]:
    import OpenEXR

    def read(path: str) -> NDArray:
        with OpenEXR.File(path) as file:
            return file.channels()["RGB"].pixels

    return read


READERS = {
    "mat": _reader_of_mat,
    "npz": _reader_of_npz,
    "tif": _reader_of_tiff,
    "tif times": _reader_of_tiff_times,
    "exr": _reader_of_exr,
}


def _data_bytes() -> int:
    """Return what the process holds of what RLIMIT_DATA counts."""
    pages = int(Path("/proc/self/statm").read_text().split()[5])
    return pages * resource.getpagesize()


class _Pipe:
    """The output: NumPy would ask a file for its position, which a pipe has not."""

    @staticmethod
    def write(data: bytes) -> None:
        """Send a part of the array."""
        sys.stdout.buffer.write(data)


def main() -> int:
    """Read what standard input asks for; return the exit code."""
    job = parse_json(sys.stdin.buffer.read(), "the job", ValueError)
    read = READERS[job["kind"]](job["name"])
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    resource.setrlimit(resource.RLIMIT_DATA, (_data_bytes() + job["most_bytes"], hard))
    try:
        arrays = [read(path) for path in job["paths"]]
        array = np.stack(arrays) if len(arrays) > 1 else np.asarray(arrays[0])
        np.lib.format.write_array(_Pipe(), array, allow_pickle=False)
    except MemoryError:
        print("it unpacks to more than a file of its size can hold", file=sys.stderr)
        return 1
    except Exception as fault:  # decoders raise whatever they run into
        print(one_line(fault) or type(fault).__name__, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
