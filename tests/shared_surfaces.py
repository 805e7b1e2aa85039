"""The implants of the shipped knee, read once for all tests of a process.

Reading them, finding the insert frame and building search trees takes as long as ten frames. A mesh
with another content is read as usual.
"""

import hashlib
from contextlib import contextmanager
from functools import cache, wraps

import pytest

from scenes import MODEL
from tkamb.io.scene.parts import ImplantParts


@cache
def shipped():
    """Return the SHA-256 of the shipped meshes."""
    return {_digest(path) for path in MODEL.glob("*.stl")}


def _digest(path):
    return hashlib.sha256(path.read_bytes()).hexdigest()


@contextmanager
def shared_surfaces():
    """Let scenes with equal tables of a shipped mesh share its surface while the block runs."""
    places = {"_place": lambda name, table: table, "_place_insert": lambda s: s.implant.insert}
    with pytest.MonkeyPatch.context() as patch:
        for method, table_of in places.items():
            patch.setattr(ImplantParts, method, _shared(getattr(ImplantParts, method), table_of))
        yield


def _shared(place, table_of):
    """Return a method of `ImplantParts` that remembers its result and the attributes it sets."""
    results = {}

    @wraps(place)
    def remembered(parts, *arguments):
        table = table_of(*arguments)
        digest = _digest(table.mesh) if table.mesh.is_file() else None
        if digest not in shipped():
            return place(parts, *arguments)
        key = (digest, table.model_dump_json(exclude={"mesh"}), parts._left)
        if key not in results:
            before = dict(vars(parts))
            surface = place(parts, *arguments)
            changed = {k: v for k, v in vars(parts).items() if v is not before.get(k)}
            results[key] = surface, changed
        surface, changed = results[key]
        vars(parts).update(changed)
        return surface

    return remembered
