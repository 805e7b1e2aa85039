"""Answers of CalculiX to some extremes, stored; `scripts/make_stability_answers` makes them.

CalculiX (C3D8I) solves the same hexahedra, so that cells as coarse as those of the quick study do.
Where contact is a few cells wide the two differ by what their elements differ; the bounds are the
largest of those distances as measured, rounded up.
"""

import hashlib
import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import numpy as np

from tkamb.contact.result import ContactResult
from tkamb.errors import InputError
from tkamb.studies.extremes import Extreme
from tkamb.studies.quantities import Quantities, errors, quantities

STORED = Path(__file__).with_name("peer_answers.json")
FARTHEST = {"approach": 0.035, "force": 0.01, "mean_pressure": 0.09, "peak_pressure": 0.09}
"""Largest relative distance from CalculiX."""
MODELS = ("lattice", "lattice-linear", "fe")


def body_hash(extreme: Extreme) -> str:
    """Return the SHA-256 of an extreme's bodies, material, pose, load and grid."""
    pair, digest = extreme.pair, hashlib.sha256()
    surfaces = (pair.femoral, pair.insert)
    for array in (*(a for s in surfaces for a in (s.vertices, s.faces)), extreme.pose):
        digest.update(np.ascontiguousarray(np.round(array, 12)).tobytes())
    words = (pair.material, pair.bearing, extreme.load_N, extreme.resolution_mm)
    digest.update(repr(words).encode())
    return digest.hexdigest()


@cache
def stored_answers(path: Path = STORED) -> Mapping[str, tuple[str, Quantities]]:
    """Return case -> (hash, quantities in SI)."""
    content = json.loads(path.read_text(encoding="utf-8"))
    return {name: (row["hash"], row["quantities"]) for name, row in content.items()}


def peer_distances(extreme: Extreme, result: ContactResult) -> dict[str, float]:
    """Return the relative distances from CalculiX; nothing where it was not asked.

    Raises:
        InputError: the case has changed since it was asked.
    """
    if extreme.model not in MODELS or extreme.says not in stored_answers():
        return {}
    known, answer = stored_answers()[extreme.says]
    if known != body_hash(extreme):
        raise InputError(
            "CalculiX's answer is to an earlier version of the case",
            f"case '{extreme.says}'",
            "run scripts/make_stability_answers",
        )
    found = errors(quantities(result), answer)
    return {name: found[name] for name in FARTHEST}
