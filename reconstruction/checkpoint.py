"""Checkpoints of a training: the state after a step, in one file that is whole or absent."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import TypeVar

import h5py

from emmc_rig.model.files import whole_file
from emmc_rig.model.json_text import parse_json
from emmc_rig.model.reading import one_line, stored_arrays
from reconstruction.errors import DictionaryError
from reconstruction.learning import Iteration, LearningState
from reconstruction.online import OnlineState
from reconstruction.separable import SeparableState

State = LearningState | OnlineState | SeparableState
S = TypeVar("S", LearningState, OnlineState, SeparableState)
FORMAT = "emmc-rig training checkpoint 1"


def save_checkpoint(path: Path, state: State, purpose: Mapping[str, object]) -> None:
    """Write a state; `purpose`, plain data, says what it is a training of.

    Raises DictionaryError when it cannot be written.
    """
    try:
        with whole_file(path) as partial, h5py.File(partial, "w") as file:
            file.attrs["format"] = FORMAT
            file["purpose"] = json.dumps(purpose)
            file["history"] = json.dumps([asdict(done) for done in state.history])
            for field in fields(state):
                if field.name != "history":
                    file.create_dataset(
                        field.name, data=getattr(state, field.name), chunks=True, fletcher32=True
                    )
    except OSError as fault:
        raise DictionaryError(f"{path}: cannot be written ({one_line(fault)})") from fault


def load_checkpoint(path: Path, kind: type[S], purpose: Mapping[str, object]) -> S:
    """Read a state of the class `kind`, saved with the same purpose.

    Raises DictionaryError: not there, damaged, or of another training; it names what differs.
    """
    if not path.is_file():
        raise DictionaryError(f"{path}: no checkpoint to resume from; train without --resume")
    with stored_arrays(path, DictionaryError, "delete it and train anew") as stored:
        if stored.attributes.get("format") != FORMAT:
            raise DictionaryError(f"{path}: not a checkpoint of a training by this program")
        found, steps = (
            parse_json(stored.text(name), f"{path}: {name}", DictionaryError)
            for name in ("purpose", "history")
        )
        history = tuple(Iteration(**done) for done in steps)
        wanted = json.loads(json.dumps(purpose))
        differing = [k for k in wanted if found.get(k) != wanted[k]]
        if differing:
            shown = ", ".join(f"{k} {found.get(k)} (now {wanted[k]})" for k in differing)
            raise DictionaryError(
                f"{path}: of a training with {shown}: resume with the same, or delete it"
            )
        names = [field.name for field in fields(kind) if field.name != "history"]
        arrays = {name: stored.array(name) for name in names}
    return kind(**arrays, history=history)
