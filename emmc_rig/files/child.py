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
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emmc_rig.model.json_text import one_line, parse_json
from emmc_rig.model.reading import FREE_BYTES, MOST_COMPRESSED

COPIES = 4
"""Of an array at once: as packed, as unpacked, as float32, as sent."""
PATIENCE_S = 600


def read_in_child(kind: str, paths: Sequence[Path]) -> NDArray:
    """Return the array of a file, or of several stacked; kind: of READERS.

    Raises ValueError, with the complaint, for what cannot be read, or not within the memory that a
    data set of HDF5 may take.
    """
    size_bytes = sum(path.stat().st_size for path in paths)
    most_bytes = COPIES * (MOST_COMPRESSED * size_bytes + FREE_BYTES)
    job = json.dumps({"kind": kind, "most_bytes": most_bytes, "paths": [str(p) for p in paths]})
    command = [sys.executable, "-P", "-m", "emmc_rig.files.child"]
    try:
        done = subprocess.run(command, input=job.encode(), capture_output=True, timeout=PATIENCE_S)
    except subprocess.TimeoutExpired as fault:
        raise ValueError(f"not read within {PATIENCE_S} s") from fault
    if done.returncode != 0:
        lines = done.stderr.decode(errors="replace").strip().splitlines()
        raise ValueError(one_line(lines[-1] if lines else "the decoder ended; is it damaged?"))
    return np.lib.format.read_array(io.BytesIO(done.stdout), allow_pickle=False)


def _reader_of_mat() -> Callable[[str], Any]:
    import scipy.io

    return lambda path: scipy.io.loadmat(path, variable_names=["LF"])["LF"]


def _reader_of_tiff() -> Callable[[str], Any]:
    import tifffile

    return tifffile.imread


def _reader_of_exr() -> Callable[[str], Any]:
    import OpenEXR

    def read(path: str) -> NDArray:
        with OpenEXR.File(path) as file:
            return file.channels()["RGB"].pixels

    return read


READERS = {"mat": _reader_of_mat, "tif": _reader_of_tiff, "exr": _reader_of_exr}


def _data_bytes() -> int:
    """Return what the process holds of what RLIMIT_DATA counts."""
    pages = int(Path("/proc/self/statm").read_text().split()[5])
    return pages * resource.getpagesize()


def main() -> int:
    """Read what standard input asks for; return the exit code."""
    job = parse_json(sys.stdin.buffer.read(), "the job", ValueError)
    read = READERS[job["kind"]]()
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    resource.setrlimit(resource.RLIMIT_DATA, (_data_bytes() + job["most_bytes"], hard))
    try:
        arrays = [read(path) for path in job["paths"]]
        array = np.stack(arrays) if len(arrays) > 1 else np.asarray(arrays[0])
        np.lib.format.write_array(sys.stdout.buffer, array, allow_pickle=False)
    except MemoryError:
        print("it unpacks to more than a file of its size can hold", file=sys.stderr)
        return 1
    except Exception as fault:  # decoders raise whatever they run into
        print(one_line(fault) or type(fault).__name__, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
