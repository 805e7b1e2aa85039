"""The reduction method: the unknown loads of the knee, as many as equations of motion, per frame.

    sum_k J_k(q)^T w_k x_k = RNEA(q, v, a) - sum_known J^T w_known

Each unknown x_k is the magnitude of a load w_k: a line of action or an axis, per unit magnitude.
All points and directions are in the insert frame, SI. A pair of loads is equal and opposite, so
that only the hip and the ground act on the leg from outside.

Reference: Komistek et al., J Biomech 38:215 (2005), doi:10.1016/j.jbiomech.2004.02.041.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tkamb.geometry.frames import Array, cross
from tkamb.knee.contact_points import CondylePoint
from tkamb.knee.load import PointForces


@dataclass(frozen=True)
class UnknownsSettings:
    """Solvability of the equations for the unknown forces."""

    max_condition: float = 1e4
    """1: condition number (unit columns) above which a frame counts as singular. Chosen: it grows
    as one over the arm d at which the patellar ligament passes the femorotibial contact: 7 to 9 m /
    d. The shipped knee has d = 43 to 45 mm and 148 to 218. The limit is d = 0.8 mm, where an error
    of 1 mm in a line of action exceeds the whole force."""


UNKNOWNS = UnknownsSettings()


@dataclass(frozen=True, eq=False)
class Unknown:
    """A load of unknown magnitude.

    Args:
        name: of the magnitude in the solution.
        loads: what one unit of it does to each link, insert frame.
    """

    name: str
    loads: tuple[PointForces, ...]


@dataclass(frozen=True, eq=False)
class Solution:
    """Magnitudes of the unknown loads at one frame; NaN where the system is singular.

    Args:
        values: name -> N or N·m.
        condition: 2-norm condition number of the matrix with unit columns.
        regular: whether the values may be used.
    """

    values: dict[str, float]
    condition: float
    regular: bool


def solve(names: Sequence[str], columns: Array, right: Array) -> Solution:
    """Solve the equations of motion of one frame for the magnitudes of the unknown loads.

    Args:
        names: of the k unknowns.
        columns: (k, k) generalised force of one unit of each.
        right: (k,) what they must add up to.

    Raises:
        ValueError: the system is not square.
    """
    if columns.shape != (len(right), len(right)):
        raise ValueError(f"{columns.shape[1]} unknown loads for {len(right)} equations")
    size = np.linalg.norm(columns, axis=0)
    # Unit columns: the condition number then measures the geometry, not newtons against newton
    # metres.
    scaled = columns / np.where(size > 0, size, 1.0)
    condition = float(np.linalg.cond(scaled))
    regular = bool(np.isfinite(condition) and condition < UNKNOWNS.max_condition)
    magnitudes = np.linalg.solve(scaled, right) / size if regular else np.full(len(right), np.nan)
    return Solution(dict(zip(names, magnitudes.tolist(), strict=True)), condition, regular)


AXES = {"ap": np.array([1.0, 0, 0]), "si": np.array([0, 1.0, 0]), "ml": np.array([0, 0, 1.0])}
"""Insert axes: x anterior, y superior, z to the right."""

MUSCLE = "muscle_"
"""First part of the names of the muscles' tensions."""


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
    """Return the name of a muscle's tension among the unknown loads."""
    return MUSCLE + name


def hip(point: Array) -> list[Unknown]:
    """Return hip force and moment on the femur at the hip centre (3,)."""
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
    """Return the knee's force and moment on the femur, as if one joint carried all of it.

    Args:
        point: (3,) knee centre.
        rotation_axes: name -> unit axis, the three moments' axes.
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

    Args:
        point: (3,) contact point.
        normal: (3,) unit, out of the femur into the patella, in the sagittal plane.
        femur_ml: (3,) the femur's ML axis.
    """
    # The second component, along the groove, is zero in a frictionless contact. Its size shows how
    # far the place is from equilibrium.
    tangent = cross(femur_ml, normal)
    return [
        Unknown("patellofemoral", pair("patella", "femur", point, normal)),
        Unknown("patellofemoral_tangential", pair("patella", "femur", point, tangent)),
    ]


def unloaded_patella(point: Array, femur_ml: Array) -> list[Unknown]:
    """Return the loads that hold the patella's own weight when the extensor mechanism is slack.

    Args:
        point: (3,) where it rests on the femur.
        femur_ml: (3,) the femur's ML axis, normal to the patella's plane.
    """
    # Any two directions across the medial-lateral axis span what holds an unloaded patella in its
    # plane.
    first = cross(femur_ml, AXES["ap"])
    first /= np.linalg.norm(first)
    return [
        Unknown("patella_rest_1", pair("patella", "femur", point, first)),
        Unknown("patella_rest_2", pair("patella", "femur", point, cross(femur_ml, first))),
        Unknown("patella_rest_moment", moment_pair("patella", "femur", femur_ml)),
    ]


def condyle(side: str, contact: CondylePoint, friction: float) -> Unknown:
    """Return the contact force of one condyle; its magnitude is the normal force."""
    force = contact.direction(friction)
    return Unknown(f"{side}_normal", pair("femur", "tibia", contact.point, force))


def residuals(point: Array, lifted: bool, extensor: bool) -> list[Unknown]:
    """Return what an exact model would make zero, on the tibia.

    Args:
        point: (3,) where the residual forces act: midpoint of the contact points.
        lifted: one condyle is off, a coronal moment takes the place of its force.
        extensor: muscles act; without them the flexion moment joins the residuals.
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
