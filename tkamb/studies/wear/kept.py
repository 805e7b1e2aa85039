"""Finished blocks of a wear simulation, stored in its folder, so that a kill loses one block."""

import hashlib
import json
import math
from dataclasses import fields
from io import BytesIO
from pathlib import Path

import numpy as np

from tkamb import code_identity
from tkamb.errors import InputError
from tkamb.files import FILE_LIMITS, read_bytes, replaced_file
from tkamb.run.identity import foreign_code
from tkamb.run.recorder import UNREADABLE
from tkamb.studies.wear.setup import WearSetup
from tkamb.studies.wear.simulation import WearCase, WearState

STATE_NAME = ".wear.npz"


def wear_identity(setup: WearSetup, case: WearCase, cycles: int, updates: int) -> str:
    """Return the hash that identifies a simulation: bodies, motion, laws, numbers, code."""
    digest = hashlib.sha256()
    bodies = (setup.engine.femoral, case.articular.surface)
    arrays = [array for body in bodies for array in (body.vertices, body.faces)]
    drive = case.motion.drive
    if drive is not None:
        arrays += [drive.coordinates, drive.applied, drive.zero]
    motion = case.motion
    arrays += [one for one in (motion.seconds, *(motion.path or ())) if one is not None]
    for array in (*arrays, case.motion.poses, case.motion.load):
        digest.update(np.ascontiguousarray(array, "<f8").tobytes())
    words = (setup.engine.model, setup.engine.material, setup.engine.bearing, case.law, case.creep)
    numbers = (case.density, case.motion.duration, case.motion.passes, cycles, updates)
    machine = () if drive is None else (drive.free, drive.springs)
    others = (foreign_code(setup.engine.model), foreign_code(case.law))
    digest.update(repr((words, numbers, machine, code_identity(), *others)).encode())
    return digest.hexdigest()


def keep_state(folder: Path, state: WearState, identity: str) -> None:
    """Put the state in the folder, whole or not at all.

    Raises:
        InputError: the folder cannot be written.
    """
    arrays = {f.name: np.asarray(getattr(state, f.name)) for f in fields(state) if f.name != "rows"}
    rows = np.asarray(json.dumps(state.rows))
    with replaced_file(folder / STATE_NAME) as temporary, open(temporary, "wb") as file:
        np.savez(file, allow_pickle=False, identity=np.asarray(identity), rows=rows, **arrays)


def kept_state(folder: Path, identity: str, count: int) -> WearState | None:
    """Return the state that a folder keeps; None where there is none.

    Args:
        folder: of the simulation.
        identity: of the simulation to go on with.
        count: of articular vertices.

    Raises:
        InputError: it is of another simulation, or cannot be read.
    """
    path = folder / STATE_NAME
    if not path.is_file():
        return None
    try:
        with np.load(BytesIO(read_bytes(path, FILE_LIMITS.mesh_bytes)), allow_pickle=False) as file:
            content = dict(file)
    except UNREADABLE as error:
        raise _damaged(path, str(error) or type(error).__name__) from None
    if str(content.pop("identity", "")) != identity:
        what = "is of another simulation: bodies, motion, law, numbers or code differ"
        raise InputError(what, path, "leave --resume out, or choose another folder with --out")
    try:
        rows = json.loads(str(content.pop("rows")))
        values = {name: one.item() if one.ndim == 0 else one for name, one in content.items()}
        state = WearState(rows=tuple(rows), **values)
        whole = all(isinstance(row, dict) for row in rows)
    except (ValueError, KeyError, TypeError) as error:
        raise _damaged(path, str(error)) from None
    numbers = (state.cycles, state.step, state.volume, state.creep_volume, state.map_error)
    if not (whole and all(isinstance(one, float) and math.isfinite(one) for one in numbers)):
        raise _damaged(path, "its values are not numbers")
    arrays = (state.wear, state.creep, state.fall)
    if not all(isinstance(one, np.ndarray) and one.shape == (count,) for one in arrays):
        raise _damaged(path, f"its arrays are not of {count} vertices")
    return state


def _damaged(path: Path, why: str) -> InputError:
    return InputError(f"is damaged ({why})", path, "leave --resume out to begin again")
