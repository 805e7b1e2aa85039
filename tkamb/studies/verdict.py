"""One extreme judged: converged, flagged, or failed, against full Newton on the same grid.

- converged: status ok and within 2 % of the reference in approach, condyle force and peak.
- flagged: no answer or a doubtful one, and a reason that says so.
- unflagged_wrong: status ok, no flag, and farther than 2 % from the reference.
- unverified: status ok, but the reference did not converge; counts as failed.
- exception: anything but the library's own clean errors; hang: the model beyond its time limit.
"""

import math
import time as clock
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

from tkamb.contact.model import ContactModel, ContactResult, ContactStatus
from tkamb.contact.pressing import press_by_search
from tkamb.contact.registry import contact_class, contact_model
from tkamb.errors import ComputationError, TkambError
from tkamb.studies.extremes import Extreme
from tkamb.studies.quantities import errors, quantities

WRONG = 0.02
"""Relative distance from the reference that counts as wrong."""
JUDGED = ("approach", "force", "peak_pressure")
TOLERANCES = (1e-6, 1e-4, 1e-3)
"""Of the reference: the tightest that Newton's method reaches."""
LOAD_STEPS = (0.1, 0.25, 0.4, 0.55, 0.7, 0.85, 1.0)
"""Shares of the load in which Newton's method goes where it does not get at once."""
KINDS = ("converged", "flagged", "unflagged_wrong", "unverified", "exception", "hang")


@dataclass(frozen=True)
class Verdict:
    """How a case ended.

    Args:
        case: what was driven out.
        contact: model.
        kind: one of `KINDS`.
        reason: plain words; empty where all is well.
        error: largest relative distance from the reference; None if there is nothing to compare.
        seconds: of preparing and pressing, without the reference.
        iterations: of the model's solver.
    """

    case: str
    contact: str
    kind: str
    reason: str = ""
    error: float | None = None
    seconds: float = 0.0
    iterations: int = 0

    def as_dict(self) -> dict[str, Any]:
        """Return the row as JSON."""
        return asdict(self)


def judge(extreme: Extreme, pressed: Callable[[], None] = lambda: None) -> Verdict:
    """Press an extreme and compare with its reference.

    Args:
        extreme: the case.
        pressed: called once the model has answered, before the reference is computed.
    """
    start = clock.perf_counter()
    try:
        model = _model(extreme)
        state = model.prepare(extreme.pair)
        result = model.press(state, extreme.load_N, extreme.pose)
    except TkambError as error:
        seconds = clock.perf_counter() - start
        return Verdict(extreme.says, extreme.model, "flagged", str(error), seconds=seconds)
    seconds = clock.perf_counter() - start
    pressed()
    if result.status is not ContactStatus.OK:
        reason = "; ".join((result.status.value.replace("_", " "), *result.flags))
        return _verdict(extreme, "flagged", reason, None, seconds, result)
    try:
        reference = _reference(extreme, state, result)
    except TkambError as error:
        return _verdict(extreme, "unverified", str(error), None, seconds, result)
    return compared(extreme, result, reference, seconds)


def compared(
    extreme: Extreme, result: ContactResult, reference: ContactResult, seconds: float
) -> Verdict:
    """Return the verdict on a result that calls itself ok."""
    found = errors(quantities(result), quantities(reference))
    apart = max(found[key] for key in JUDGED)
    right = math.isfinite(apart) and apart <= WRONG
    flags = "; ".join(result.flags)
    kind = "converged" if right else "flagged" if flags else "unflagged_wrong"
    reason = flags if right or flags else f"{100 * apart:.3g} % from the reference"
    return _verdict(extreme, kind, reason, apart, seconds, result)


def _verdict(
    extreme: Extreme,
    kind: str,
    reason: str,
    apart: float | None,
    seconds: float,
    result: ContactResult,
) -> Verdict:
    known = apart if apart is not None and math.isfinite(apart) else None
    return Verdict(
        extreme.says, extreme.model, kind, reason, known, seconds, int(result.iterations)
    )


def _model(extreme: Extreme, **options: Any) -> ContactModel:
    fields = getattr(contact_class(extreme.model), "__dataclass_fields__", {})
    if "cache" in fields:
        options["cache"] = False
    return contact_model(extreme.model, extreme.resolution_mm, **options)


def _reference(extreme: Extreme, state: Any, result: ContactResult) -> ContactResult:
    """Return the answer by another way: full Newton, or the generic search for the load."""
    fields = getattr(contact_class(extreme.model), "__dataclass_fields__", {})
    if "newton" not in fields:
        searched = press_by_search(_model(extreme), state, extreme.load_N, extreme.pose)
        if searched.status is not ContactStatus.OK:
            raise ComputationError("the generic search finds no such load", "reference")
        return searched
    for tolerance in TOLERANCES:
        newton = _model(extreme, newton=True, tolerance=tolerance)
        for shares, start in (((1.0,), None), (LOAD_STEPS, None), ((1.0,), result)):
            found = _by_steps(newton, extreme, state, shares, start)
            if found is not None:
                return found
    raise ComputationError("Newton's method does not get there, at once or in steps", "reference")


def _by_steps(
    newton: ContactModel,
    extreme: Extreme,
    state: Any,
    shares: tuple[float, ...],
    guess: ContactResult | None,
) -> ContactResult | None:
    """Return Newton's answer after shares of the load; None where it finds none."""
    for share in shares:
        try:
            guess = newton.press(state, share * extreme.load_N, extreme.pose, guess)
        except ComputationError:
            return None
        if guess.status is not ContactStatus.OK:
            return None
    return guess
