"""The unknown loads of the knee at one frame, their contact points, and which of them act.

    sum_k J_k(q)^T w_k x_k = RNEA(q, v, a) - sum_known J^T w_known

Each unknown x_k is the magnitude of a load w_k with a known line of action or axis (the reduction
method), as many as equations of motion. All points and directions are in the insert frame, SI
units. The two loads of a pair are equal and opposite: only hip and ground exert external loads on
the leg.

Lines pull and contacts push: the two normal forces, the tensions of muscle and patellar ligament
and the patellofemoral normal force are >= 0. A load that would have the wrong sign is zero, and a
residual moment replaces it as unknown. There are at most six load states: both condyles loaded, the
medial or the lateral one lifted, each with the extensor mechanism taut or slack. The recorded gap
may exclude some.

Reference: Komistek et al., J Biomech 38:215 (2005), doi:10.1016/j.jbiomech.2004.02.041.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np

from tkamb.geometry.frames import Array, cross
from tkamb.knee.load import PointForces
from tkamb.units import DEGREE, MILLIMETRE

# 1: condition number (unit columns) above which a frame counts as singular. The number is about 7
# to 9 m / d, where d is the moment arm of the patellar ligament about the femorotibial contact.
# At the limit, d = 0.8 mm, an error of 1 mm in a line of action changes the force
# by more than 100 %.
MAX_CONDITION = 1e4


@dataclass(frozen=True)
class ContactPointSettings:
    """Limits of lift-off, gap and sliding speed."""

    lift_off_angle: float = 0.5 * DEGREE
    """rad: a condyle is lifted off if the coronal angle from both gaps exceeds this angle, and the
    condyle's gap exceeds `lift_off_gap`. Source: error of fluoroscopy (Sharma 2008, 4.3)."""
    lift_off_gap: float = 0.5 * MILLIMETRE
    """m: gap above which a condyle may be lifted off, see `lift_off_angle`. Source as for
    `lift_off_angle`.
    """
    max_gap: float = 3e-3
    """m: a femoral component with a larger gap or penetration is misplaced. It is
    larger than the errors of fluoroscopy."""
    standstill_speed: float = 1e-3
    """m/s: v0 of the regularised friction. Friction fades below this sliding speed.
    It is far below the sliding speed of a moving knee."""


CONTACT_POINT = ContactPointSettings()


@dataclass(frozen=True, eq=False)
class CondylePoint:
    """The contact point of one condyle on the insert, insert frame, m.

    Args:
        normal: unit normal from the insert to the femur, (3,).
        sliding: velocity of the femur relative to the insert at the point, (3,), m/s.
        gap: gap, positive when apart, m.
    """

    point: Array
    normal: Array
    sliding: Array
    gap: float

    def direction(self, friction: float) -> Array:
        """Return the contact force on the femur (3,) per unit normal force.

        It is n - mu t with t = v / sqrt(|v|² + v0²) for the tangential velocity v: Coulomb friction
        that fades below v0 = 1 mm/s.
        """
        tangential = self.sliding - (self.sliding @ self.normal) * self.normal
        # Without v0 the direction of the force would jump when the sliding reverses.
        speed = np.sqrt(tangential @ tangential + CONTACT_POINT.standstill_speed**2)
        return np.asarray(self.normal - friction * tangential / speed)


@dataclass(frozen=True, eq=False)
class Unknown:
    """A load of unknown magnitude.

    Args:
        loads: loads on the links at a magnitude of one, insert frame.
    """

    name: str
    loads: tuple[PointForces, ...]


@dataclass(frozen=True, eq=False)
class Solution:
    """Magnitudes of the unknowns; NaN if the system is singular.

    Args:
        values: name -> magnitude, N or N·m.
        condition: 2-norm condition number of the matrix with unit columns.
    """

    values: dict[str, float]
    condition: float
    regular: bool


def solve(names: Sequence[str], columns: Array, right: Array) -> Solution:
    """Solve the equations of motion of one frame.

    `columns` (k, k), generalised forces per unit of each unknown, must add up to `right` (k,).

    Raises:
        ValueError: the system is not square.
    """
    if columns.shape != (len(right), len(right)):
        raise ValueError(f"{columns.shape[1]} unknown loads for {len(right)} equations")
    size = np.linalg.norm(columns, axis=0)
    # With unit columns the condition number measures the geometry, not the units N and N·m.
    scaled = columns / np.where(size > 0, size, 1.0)
    condition = float(np.linalg.cond(scaled))
    regular = bool(np.isfinite(condition) and condition < MAX_CONDITION)
    magnitudes = np.linalg.solve(scaled, right) / size if regular else np.full(len(right), np.nan)
    return Solution(dict(zip(names, magnitudes.tolist(), strict=True)), condition, regular)


AXES = {"ap": np.array([1.0, 0, 0]), "si": np.array([0, 1.0, 0]), "ml": np.array([0, 0, 1.0])}
"""Insert axes: x anterior, y superior, z to the right."""

MUSCLE = "muscle_"
"""Prefix of the name of a muscle's tension among the unknowns."""


def pair(link: str, other: str, point: Array, force: Array) -> tuple[PointForces, ...]:
    """Return `force` (3,) on `link` and its opposite on `other`, both at `point`."""
    return PointForces(link, point[None], force[None]), PointForces(
        other, point[None], -force[None]
    )


def moment_pair(link: str, other: str, moment: Array) -> tuple[PointForces, ...]:
    """Return a free `moment` (3,) on `link` and its opposite on `other`."""
    zero = np.zeros((1, 3))
    return (
        PointForces(link, zero, zero, moment),
        PointForces(other, zero, zero, -moment),
    )


def muscle_load(name: str) -> str:
    """Return the name of a muscle's tension."""
    return MUSCLE + name


def hip(point: Array) -> list[Unknown]:
    """Return the six loads of the hip on the femur, at the hip centre (3,)."""
    zero = np.zeros((1, 3))
    forces = [
        Unknown(f"hip_force_{name}", (PointForces("femur", point[None], axis[None]),))
        for name, axis in AXES.items()
    ]
    moments = [
        Unknown(f"hip_moment_{name}", (PointForces("femur", zero, zero, axis),))
        for name, axis in AXES.items()
    ]
    return forces + moments


def intersegmental(point: Array, rotation_axes: dict[str, Array]) -> list[Unknown]:
    """Return the knee's force and moment on the femur without contact.

    `point` (3,), m, is the knee centre; `rotation_axes` are unit axes (3,) of moments.
    """
    forces = [
        Unknown(f"knee_force_{name}", pair("femur", "tibia", point, axis))
        for name, axis in AXES.items()
    ]
    moments = [
        Unknown(f"knee_moment_{name}", moment_pair("femur", "tibia", axis))
        for name, axis in rotation_axes.items()
    ]
    return forces + moments


def patellofemoral(point: Array, normal: Array, femur_ml: Array) -> list[Unknown]:
    """Return the patellofemoral force in the femur's sagittal plane.

    `normal` (3,) is from femur to patella in that plane, `femur_ml` (3,) the femur's unit ML axis.
    """
    # The tangential force along the groove is zero for a massless patella in equilibrium.
    tangent = cross(femur_ml, normal)
    return [
        Unknown("patellofemoral", pair("patella", "femur", point, normal)),
        Unknown("patellofemoral_tangential", pair("patella", "femur", point, tangent)),
    ]


def unloaded_patella(point: Array, femur_ml: Array) -> list[Unknown]:
    """Return the loads that balance the patella's weight if no other loads do.

    They replace a slack extensor mechanism, or belong to a released, massless patella. `point`
    (3,), m, is the contact point on the femur.
    """
    # Any two directions in the sagittal plane can be used.
    first = cross(femur_ml, AXES["ap"])
    first /= np.linalg.norm(first)
    return [
        Unknown("patella_rest_1", pair("patella", "femur", point, first)),
        Unknown("patella_rest_2", pair("patella", "femur", point, cross(femur_ml, first))),
        Unknown("patella_rest_moment", moment_pair("patella", "femur", femur_ml)),
    ]


def condyle(side: str, contact: CondylePoint, friction: float) -> Unknown:
    """Return a condyle's contact force, whose magnitude is the normal force."""
    force = contact.direction(friction)
    return Unknown(f"{side}_normal", pair("femur", "tibia", contact.point, force))


def residuals(point: Array, lifted: bool, extensor: bool) -> list[Unknown]:
    """Return the residuals, loads on the tibia that are zero in an exact model.

    Args:
        point: midpoint of the contact points, where the residual forces act, (3,), m.
        lifted: a coronal moment replaces the force of a lifted condyle.
        extensor: if the extensor group does not act, a flexion moment is another residual.
    """
    unknowns = [
        Unknown("residual_ap", pair("tibia", "femur", point, AXES["ap"])),
        Unknown("residual_ml", pair("tibia", "femur", point, AXES["ml"])),
        Unknown("residual_axial", moment_pair("tibia", "femur", AXES["si"])),
    ]
    if lifted:
        unknowns.append(Unknown("residual_coronal", moment_pair("tibia", "femur", AXES["ap"])))
    if not extensor:
        unknowns.append(Unknown("residual_flexion", moment_pair("tibia", "femur", AXES["ml"])))
    return unknowns


# N: a smaller force of the wrong sign counts as zero. It is above rounding errors.
FORCE_ROUNDING = 1e-6
# N·m: largest extension moment that may be missing if the extensor mechanism is slack.
# Weight and inertia of the patella, up to 5 N on an arm of 45 mm, cause such a moment.
PATELLA_MOMENT = 0.25


PATELLAR_LOADS = ("patellar_ligament", "patellofemoral")


class LoadState(NamedTuple):
    """The loads that are assumed to be zero.

    Args:
        lifted: condyles without load.
        slack: muscles of a slack extensor mechanism; empty: it is taut.
    """

    lifted: frozenset[str]
    slack: frozenset[str]

    @property
    def label(self) -> str:
        """Words that name the zero loads."""
        left_out = [f"{side} lifted" for side in sorted(self.lifted)]
        left_out += [f"{muscle} slack" for muscle in sorted(self.slack)]
        return " and ".join(left_out) or "all loaded"


def load_states(
    sides: Iterable[str], lifted_by_gap: frozenset[str], extensors: Iterable[str]
) -> list[LoadState]:
    """Return the load states to try, those with fewer zero loads first.

    A slack muscle comes before a lifted condyle, because the recorded gap shows contact, but no
    recording shows the muscle's activity. `sides` are the modelled condyles, `extensors` muscles;
    `lifted_by_gap`: by the recorded gap.
    """
    not_lifted = [side for side in sides if side not in lifted_by_gap]
    lifted = [
        lifted_by_gap,
        *(lifted_by_gap | {side} for side in not_lifted if len(not_lifted) == 2),
    ]
    slack = dict.fromkeys([frozenset[str](), frozenset(extensors)])
    states = [LoadState(*state) for state in product(lifted, slack)]
    return sorted(
        states, key=lambda state: (len(state.lifted) + bool(state.slack), len(state.lifted))
    )


def _muscles(values: Mapping[str, float]) -> list[str]:
    return [name for name in values if name.startswith(MUSCLE)]


def wrong_signs(state: LoadState, solution: Solution) -> list[str]:
    """Return descriptions of the loads with a wrong sign."""
    if not solution.regular:
        return ["singular equations"]
    values = solution.values
    one_sided = ("medial_normal", "lateral_normal", *_muscles(values), *PATELLAR_LOADS)
    wrong = [
        f"{name.removeprefix(MUSCLE).replace('_', ' ')} {values[name]:.3g} N"
        for name in one_sided
        if values.get(name, 0.0) < -FORCE_ROUNDING
    ]
    if state.slack:
        # The residual acts on the tibia. The moment of a knee without contact acts on the femur.
        extension = values.get("residual_flexion", 0.0) - values.get("knee_moment_flexion", 0.0)
        if extension > PATELLA_MOMENT:
            wrong.append(f"extension moment {extension:.3g} N·m needed")
    return wrong


def contradictions(
    state: LoadState, solutions: Mapping[LoadState, Solution], lifted_by_gap: frozenset[str]
) -> list[str]:
    """Return reasons why a load state is inadmissible; empty: it is admissible.

    It is a load of the wrong sign, or a zero load that would act with the right sign. `solutions`
    has those of all states.
    """
    wrong = wrong_signs(state, solutions[state])
    if state.slack:
        taut = solutions[LoadState(state.lifted, frozenset())].values
        names = (*_muscles(taut), "patellar_ligament")  # the latter only with a plane patella
        pulls = {name: taut[name] for name in names if name in taut}
        if not min(pulls.values()) < -FORCE_ROUNDING:
            name, pull = next(iter(pulls.items()))
            wrong.append(f"{name.removeprefix(MUSCLE)} would pull with {pull:.3g} N")
    for side in sorted(state.lifted - lifted_by_gap):
        alternative = solutions[LoadState(state.lifted - {side}, state.slack)]
        force = alternative.values[f"{side}_normal"]
        if not force < 0.0:
            wrong.append(f"{side} condyle would push with {force:.3g} N")
    return wrong
