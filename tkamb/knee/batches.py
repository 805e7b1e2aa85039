"""`Knee.press` and `Knee.external_forces` of many configurations, with stacked results."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.contact.result import ContactStatus
from tkamb.errors import InputError
from tkamb.geometry.frames import SIDES, Array
from tkamb.knee.pressed import KneeContactResult, contact_of_user
from tkamb.units import MEGAPASCAL

if TYPE_CHECKING:
    from tkamb.knee.assembled import KneeData
    from tkamb.knee.knee import Knee
    from tkamb.knee.solution_derivatives import PressDerivatives


@dataclass(frozen=True, eq=False)
class PressBatch:
    """The presses of n poses. A press that failed has NaN; an unloaded condyle has zero.

    Args:
        results: the result of each pose.
        force: contact forces of the medial and lateral condyle, shape (n, 2), N.
        peak_pressure: their peak pressures, shape (n, 2), Pa.
        area: their contact areas, shape (n, 2), m².
        approach: travel along -y since first touch, shape (n,), m.
        pose: pose of the femoral component, shape (n, 4, 4).
        pressure: pressure at the map points, shape (n, p), Pa.
        derivatives: derivatives of each press; empty: not asked for.
    """

    results: tuple[KneeContactResult, ...]
    force: Array
    peak_pressure: Array
    area: Array
    approach: Array
    pose: Array
    pressure: Array
    derivatives: "tuple[PressDerivatives, ...]" = ()

    def __repr__(self) -> str:
        """Return the number of poses, of failures, and the largest peak pressure."""
        failed = sum(one.failed for one in self.results)
        peak = np.nanmax(self.peak_pressure, initial=0.0) / MEGAPASCAL
        return (
            f"<tkamb.PressBatch: {len(self.results)} poses, {failed} failed; peak {peak:.1f} MPa>"
        )

    @property
    def failed(self) -> Array:
        """Whether each press failed, shape (n,)."""
        return np.array([one.failed for one in self.results], bool)

    @property
    def status(self) -> tuple[ContactStatus, ...]:
        """Status of each press."""
        return tuple(one.status for one in self.results)


def press_all(
    knee: "Knee", q: Array, load: float | Array, data: "KneeData", derivatives: bool
) -> PressBatch:
    """Return the presses at q (n, nq) under one load, or a load per pose (n,), N.

    The warm start of each press is the press before it.

    Raises:
        InputError: the number of loads is neither one nor n.
    """
    count = len(q)
    if np.shape(load) not in ((), (count,)):
        raise InputError(f"the shape is {np.shape(load)}", "load", f"give a number or ({count},)")
    results, slopes = [], []
    for one, its_load in zip(np.asarray(q, float), np.broadcast_to(load, count), strict=True):
        result, start = knee._press_from(one, float(its_load), data)
        if derivatives:
            slopes.append(knee._press_slopes(result, start))
        results.append(contact_of_user(result, knee.left))
    force, peak, area = (_of_condyles(results, one) for one in ("force", "peak_pressure", "area"))
    return PressBatch(
        tuple(results),
        force,
        peak,
        area,
        np.array([one.approach for one in results]),
        np.array([one.pose.homogeneous for one in results]),
        np.array([one.pressure for one in results]),
        tuple(slopes),
    )


def _of_condyles(results: list[KneeContactResult], name: str) -> Array:
    """Return a value (n, 2) of the condyles."""
    values = np.zeros((len(results), len(SIDES)))
    for k, result in enumerate(results):
        for i, side in enumerate(SIDES):
            # An unloaded condyle has no contact: its values are zero.
            condyle = getattr(result, side)
            values[k, i] = 0.0 if condyle is None else getattr(condyle, name)
        if result.failed:
            values[k] = np.nan
    return values


def forces_of_all(knee: "Knee", q: Array, v: Array, tensions: Any, data: "KneeData") -> Array:
    """Return the forces (n, njoints, 6) of `Knee.external_forces` at q (n, nq) and v (n, nv).

    Raises:
        InputError: there are not as many velocities as configurations.
    """
    if np.shape(v) != (len(q), knee.model.nv):
        raise InputError(
            f"the shape is {np.shape(v)}", "v", f"give ({len(q)}, {knee.model.nv}), one per q"
        )
    return np.array(
        [
            [force.vector for force in knee.external_forces(one, rate, tensions, data)]
            for one, rate in zip(q, v, strict=True)
        ]
    )
