"""Checks that every contact result must pass, whatever its model; they need only the result.

- The nodal forces carry the load.
- The pressures, times their areas, carry it too.
- No pressure is negative, and no solved node lies inside the femoral component.
- The forces of the condyles are the sums over the map under them.

Some extremes are also compared with stored results of CalculiX, which
`scripts/make_stability_answers` makes. CalculiX (C3D8I) solves the same hexahedra, so that the
coarse cells of the quick study suffice. Where contact is a few cells wide, the two programs differ
because their elements differ. The bounds are the largest differences that were measured, rounded
up."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from tkamb.contact.result import ContactResult
from tkamb.errors import InputError
from tkamb.studies.cases import content_hash
from tkamb.studies.extremes import Extreme
from tkamb.studies.quantities import Quantities, errors, quantities


@dataclass(frozen=True)
class AuditSettings:
    """Tolerances of the checks that need no reference."""

    force_tolerance: float = 0.005
    """Relative: forces, pressures and condyles against the load. Chosen: a few times the solver's
    tolerance."""
    penetration_tolerance: float = 5e-3
    """1: largest depth of a node inside the femoral component, as a share of the approach. Chosen:
    a few times the solver's tolerance."""


AUDIT = AuditSettings()

PEER_ANSWERS = Path(__file__).with_name("peer_answers.json")
PEER_BOUNDS = {"approach": 0.035, "force": 0.01, "mean_pressure": 0.09, "peak_pressure": 0.09}
"""Largest relative distance from CalculiX."""
PEER_MODELS = ("lattice", "lattice-linear", "fe")


def complaints(result: ContactResult, load: float, solved: bool, source_rule: bool) -> list[str]:
    """Return in words which checks a result fails.

    Args:
        result: a result with status ok.
        load: N, along -y.
        solved: the gaps are those of deformed nodes; else penetration is the model's measure.
        source_rule: pressure is the force along the insert's normal over an even area; else
            the force over the node's own area.
    """
    force = np.linalg.norm(result.nodal_force, axis=1)
    along_y = -result.nodal_force[:, 1]
    expected = force
    if source_rule:
        expected = np.maximum(-np.einsum("ij,ij->i", result.nodal_force, result.normals), 0.0)
    share = np.divide(along_y, expected, out=np.zeros_like(force), where=expected > 0)
    by_pressure = float((result.pressure * result.area * share).sum())
    sides = [side for side in (result.medial, result.lateral) if side is not None]
    peak, highest = max((s.peak_pressure for s in sides), default=0.0), result.pressure.max()
    by_sides = sum(side.force for side in sides)
    problems = [
        _off("the nodal forces sum to", float(along_y.sum()), load),
        _off("the pressures integrate to", by_pressure, load),
        _off("mean pressure times area is", sum(s.mean_pressure * s.area for s in sides), by_sides),
    ]
    if result.pressure.min() < 0:
        problems.append("a pressure is negative")
    if (
        by_sides < (1 - AUDIT.force_tolerance) * load
        or by_sides > (1 + AUDIT.force_tolerance) * force.sum()
    ):
        problems.append(f"the condyles carry {by_sides:.4g} N of {load:.4g} N")
    if solved and abs(peak - highest) > AUDIT.force_tolerance * highest:
        problems.append(f"the condyles' peak is {peak / highest:.4g} of the map's")
    deepest = -float(np.nanmin(result.gap))
    if solved and deepest > AUDIT.penetration_tolerance * result.approach:
        problems.append(f"a node is {1e6 * deepest:.3g} µm inside the femoral component")
    return [words for words in problems if words]


def _off(what: str, value: float, expected: float) -> str:
    if math.isclose(value, expected, rel_tol=AUDIT.force_tolerance):
        return ""
    return f"{what} {value / expected:.4f} of what they must"


def body_hash(extreme: Extreme) -> str:
    """Return the SHA-256 of an extreme's bodies, material, pose, load and grid."""
    words = (extreme.pair.material, extreme.pair.bearing, extreme.load_N, extreme.resolution_mm)
    return content_hash(extreme.pair, [extreme.pose], words)


@cache
def stored_answers(path: Path = PEER_ANSWERS) -> Mapping[str, tuple[str, Quantities]]:
    """Return case -> (hash, quantities in SI)."""
    content = json.loads(path.read_text(encoding="utf-8"))
    return {name: (row["hash"], row["quantities"]) for name, row in content.items()}


def peer_distances(extreme: Extreme, result: ContactResult) -> dict[str, float]:
    """Return the relative distances from CalculiX's stored result; empty if there is none.

    Raises:
        InputError: the case has changed since that result was computed.
    """
    if extreme.model not in PEER_MODELS or extreme.label not in stored_answers():
        return {}
    stored, answer = stored_answers()[extreme.label]
    if stored != body_hash(extreme):
        raise InputError(
            "CalculiX's answer is to an earlier version of the case",
            f"case '{extreme.label}'",
            "run scripts/make_stability_answers",
        )
    misses = errors(quantities(result), answer)
    return {name: misses[name] for name in PEER_BOUNDS}
