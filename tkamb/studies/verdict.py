"""The verdict on one case of the stability study: converged, flagged, or failed.

Each extreme case is tested in three ways:

- Checks that every contact result must pass (`complaints`): nodal forces and pressures sum to the
  load, no pressure is negative, no solved node lies inside the femoral component, and the condyle
  forces agree with the pressure map.
- A stored result of CalculiX on the same hexahedra (C3D8I), if there is one (`peer_distances`). The
  elements differ, so the bounds are the largest measured differences, rounded up.
- Newton's method on the same grid, which shows errors of the solver alone.

A closed form is tested with its formula. docs/studies.md has the kinds of verdict.

- hang: the model exceeds its limit of processor time.
"""

import json
import math
import time as clock
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from tkamb.contact.model import ContactModel
from tkamb.contact.pressing import press_by_search
from tkamb.contact.registry import contact_class, contact_model
from tkamb.contact.result import ContactResult, ContactStatus, Guess
from tkamb.errors import ComputationError, InputError, TkambError
from tkamb.studies.cases import Extreme, content_hash
from tkamb.studies.measures import Quantities, errors, quantities
from tkamb.studies.references import (
    TOLERANCES,
    ClosedForm,
    press_closed_form,
    relative_errors,
)
from tkamb.units import MILLIMETRE

# Largest relative difference of forces and pressures from the load. A few times the
# solver's tolerance.
FORCE_TOLERANCE = 0.005
# Largest penetration of a node into the femoral component over the approach. A few times
# the solver's tolerance.
PENETRATION_TOLERANCE = 5e-3


PEER_ANSWERS = Path(__file__).with_name("peer_answers.json")
PEER_BOUNDS = {"approach": 0.035, "force": 0.01, "mean_pressure": 0.09, "peak_pressure": 0.09}
"""Largest accepted relative differences from CalculiX."""
PEER_MODELS = ("lattice", "lattice-linear", "fe")


def complaints(result: ContactResult, load: float, solved: bool, source_rule: bool) -> list[str]:
    """Return one line for each check that a result fails.

    Args:
        load: force along -y, N.
        solved: whether the gaps are those of deformed nodes, so that penetration and peak pressure
            are checked.
        source_rule: whether pressure is the normal force over a uniform area; otherwise it is the
            force over the node's tributary area.
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
    if by_sides < (1 - FORCE_TOLERANCE) * load or by_sides > (1 + FORCE_TOLERANCE) * force.sum():
        problems.append(f"the condyles carry {by_sides:.4g} N of {load:.4g} N")
    if solved and abs(peak - highest) > FORCE_TOLERANCE * highest:
        problems.append(f"the condyles' peak is {peak / highest:.4g} of the map's peak")
    deepest = -float(np.nanmin(result.gap))
    if solved and deepest > PENETRATION_TOLERANCE * result.approach:
        problems.append(f"a node is {1e6 * deepest:.3g} µm inside the femoral component")
    return [words for words in problems if words]


def _off(what: str, value: float, expected: float) -> str:
    if math.isclose(value, expected, rel_tol=FORCE_TOLERANCE):
        return ""
    return f"{what} {value / expected:.4f} of the expected value"


def body_hash(extreme: Extreme) -> str:
    """Return the SHA-256 of an extreme case: bodies, material, pose, load and grid."""
    words = (extreme.pair.material, extreme.pair.bearing, extreme.load_N, extreme.resolution_mm)
    return content_hash(extreme.pair, [extreme.pose], words)


@cache
def stored_answers(path: Path = PEER_ANSWERS) -> Mapping[str, tuple[str, Quantities]]:
    """Return case -> (hash of the case, quantities in SI units of CalculiX's result)."""
    content = json.loads(path.read_text(encoding="utf-8"))
    return {name: (row["hash"], row["quantities"]) for name, row in content.items()}


def peer_distances(extreme: Extreme, result: ContactResult) -> dict[str, float]:
    """Return the relative differences from CalculiX's stored result; empty if there is none."""
    if extreme.model not in PEER_MODELS or extreme.label not in stored_answers():
        return {}
    stored_hash, peer = stored_answers()[extreme.label]
    if stored_hash != body_hash(extreme):
        raise InputError(
            "CalculiX's result belongs to an earlier version of the case",
            f"case '{extreme.label}'",
            "run scripts/make/stability_answers",
        )
    differences = errors(quantities(result), peer)
    return {name: differences[name] for name in PEER_BOUNDS}


# Relative difference from the reference above which a result is wrong. Below the published
# differences between models and experiments.
MAX_ERROR = 0.02


JUDGED = ("approach", "force", "peak_pressure")
NEWTON_TOLERANCES = (1e-6, 1e-4, 1e-3)
"""Tolerances of the reference; the first that converges is used."""
LOAD_STEPS = (0.1, 0.25, 0.4, 0.55, 0.7, 0.85, 1.0)
"""Load steps, as shares of the load, if Newton's method does not converge in one step."""
KINDS = ("converged", "flagged", "unflagged_wrong", "unverified", "exception", "hang")
PASSED_KINDS = ("converged", "flagged")


@dataclass(frozen=True)
class Verdict:
    """Verdict on a case.

    Args:
        reason: reason of a verdict other than converged, or the flags of the result.
        error: largest relative difference from the reference; None without a comparison.
        seconds: time of preparation and press without the reference, s.
        expected: kind of the stored verdict; None if there is none.
    """

    case: str
    contact: str
    kind: str
    reason: str = ""
    error: float | None = None
    seconds: float = 0.0
    iterations: int = 0
    expected: str | None = None

    @property
    def key(self) -> str:
        """Name under which the verdict is stored."""
        return f"{self.contact}: {self.case}"

    @property
    def worse(self) -> bool:
        """Whether the case is flagged although its stored verdict is converged."""
        return self.kind == "flagged" and self.expected == "converged"

    @property
    def failed(self) -> bool:
        """Whether the verdict makes the study fail."""
        return self.worse or self.kind not in PASSED_KINDS


def judge(extreme: Extreme, pressed: Callable[[], None] = lambda: None) -> Verdict:
    """Press an extreme case and compare the result with its reference.

    Args:
        pressed: function that is called between the model's result and the reference.
    """
    start = clock.perf_counter()
    try:
        model = _model(extreme)
        state = model.prepare(extreme.pair)
        result = model.press(state, extreme.load_N, extreme.pose)
    except TkambError as error:
        seconds = clock.perf_counter() - start
        return Verdict(extreme.label, extreme.model, "flagged", str(error), seconds=seconds)
    seconds = clock.perf_counter() - start
    pressed()
    if result.status is not ContactStatus.OK:
        return _verdict(extreme, "flagged", _words(result), None, seconds, result)
    try:
        problems = [
            *_failed_checks(extreme.model, result, extreme.load_N),
            *_differences_from_peer(extreme, result),
        ]
        if problems:
            kind, reason = _kind_and_reason(result, problems)
            return _verdict(extreme, kind, reason, None, seconds, result)
        reference = _reference(extreme, state, result)
    except TkambError as error:
        return _verdict(extreme, "unverified", str(error), None, seconds, result)
    return compared(extreme, result, reference, seconds)


def judge_closed_form(case: ClosedForm, pressed: Callable[[], None] = lambda: None) -> Verdict:
    """Press a case and compare the result with its closed form; see `judge`."""
    start = clock.perf_counter()
    result, _ = press_closed_form(case)
    seconds = clock.perf_counter() - start
    pressed()
    if result.status is not ContactStatus.OK:
        return _verdict(case, "flagged", _words(result), None, seconds, result)
    distances = relative_errors(case, result)
    bounds = dict(zip(distances, TOLERANCES[case.kind], strict=True))
    problems = [
        f"{name} {100 * value:.3g} % from the closed form"
        for name, value in distances.items()
        if not value <= bounds[name]
    ]
    problems += _failed_checks(case.model, result, case.load_N)
    kind, reason = _kind_and_reason(result, problems)
    return _verdict(case, kind, reason, max(distances.values()), seconds, result)


def _kind_and_reason(result: ContactResult, problems: list[str]) -> tuple[str, str]:
    kind = "converged" if not problems else "flagged" if result.flags else "unflagged_wrong"
    return kind, "; ".join((*result.flags, *problems))


def _words(result: ContactResult) -> str:
    return "; ".join((result.status.value.replace("_", " "), *result.flags))


def _failed_checks(model: str, result: ContactResult, load: float) -> list[str]:
    fields = getattr(contact_class(model), "__dataclass_fields__", {})
    rule = fields["pressure_rule"].default if "pressure_rule" in fields else None
    return complaints(result, load, "newton" in fields, rule == "source")


def _differences_from_peer(extreme: Extreme, result: ContactResult) -> list[str]:
    return [
        f"{name.replace('_', ' ')} {100 * value:.3g} % from CalculiX"
        for name, value in peer_distances(extreme, result).items()
        if not value <= PEER_BOUNDS[name]
    ]


def compared(
    extreme: Extreme, result: ContactResult, reference: ContactResult, seconds: float
) -> Verdict:
    """Return the verdict on a result with status ok."""
    differences = errors(quantities(result), quantities(reference))
    distance = max(differences[key] for key in JUDGED)
    correct = math.isfinite(distance) and distance <= MAX_ERROR
    flags = "; ".join(result.flags)
    kind = "converged" if correct else "flagged" if flags else "unflagged_wrong"
    reason = flags if correct or flags else f"{100 * distance:.3g} % from the reference"
    return _verdict(extreme, kind, reason, distance, seconds, result)


def _verdict(
    case: Extreme | ClosedForm,
    kind: str,
    reason: str,
    distance: float | None,
    seconds: float,
    result: ContactResult,
) -> Verdict:
    finite = distance if distance is not None and math.isfinite(distance) else None
    return Verdict(case.label, case.model, kind, reason, finite, seconds, int(result.iterations))


def _model(extreme: Extreme, **options: Any) -> ContactModel:
    fields = getattr(contact_class(extreme.model), "__dataclass_fields__", {})
    if "cache" in fields:
        options["cache"] = False
    return contact_model(extreme.model, resolution=extreme.resolution_mm * MILLIMETRE, **options)


def _reference(extreme: Extreme, state: Any, result: ContactResult) -> ContactResult:
    """Return the result of another method: full Newton, or the generic search for the load."""
    fields = getattr(contact_class(extreme.model), "__dataclass_fields__", {})
    if "newton" not in fields:
        searched = press_by_search(_model(extreme), state, extreme.load_N, extreme.pose)
        if searched.status is not ContactStatus.OK:
            raise ComputationError("the generic search does not reach the load", "reference")
        return searched
    for tolerance in NEWTON_TOLERANCES:
        newton = _model(extreme, newton=True, tolerance=tolerance)
        for shares, guess in (((1.0,), None), (LOAD_STEPS, None), ((1.0,), result)):
            press = _by_steps(newton, extreme, state, shares, guess)
            if press is not None:
                return press
    raise ComputationError("Newton's method does not converge, at once or in steps", "reference")


def _by_steps(
    newton: ContactModel,
    extreme: Extreme,
    state: Any,
    shares: tuple[float, ...],
    guess: Guess | None,
) -> ContactResult | None:
    """Return Newton's result at the last share of the load; None without convergence."""
    for share in shares:
        try:
            load = share * extreme.load_N
            result, guess = newton.press_from(state, load, extreme.pose, guess)
        except ComputationError:
            return None
        if result.status is not ContactStatus.OK:
            return None
    return result
