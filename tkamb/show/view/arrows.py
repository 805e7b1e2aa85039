"""The forces of a drawing: magnitudes from results.csv, lines of action from the geometry."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tkamb.geometry.frames import Array
from tkamb.knee.equations import KneeGeometry
from tkamb.knee.load import PointForces
from tkamb.show.style import BLACK, FORCE_COLOURS
from tkamb.show.view.drawing import Arrow, Marker
from tkamb.units import MILLIMETRE

if TYPE_CHECKING:
    from tkamb.run.results import Results

NOTHING = np.full(3, np.nan)


@dataclass(frozen=True)
class ArrowSettings:
    """Arrows of the viewer."""

    contact_point_radius: float = 0.6 * MILLIMETRE
    """m; radius of the sphere at a centre of pressure. Chosen: it is seen and hides little."""


ARROW = ArrowSettings()


def force_arrows(
    results: "Results", geometries: Sequence[KneeGeometry], friction: float
) -> tuple[Arrow, ...]:
    """Return the forces on the leg that are modelled.

    The condyles' arrows are the forces on the insert with their friction: their sum is the
    contact force of results.csv.

    Args:
        results: of the same frames.
        geometries: the frames.
        friction: Coulomb coefficient of the femorotibial contact.
    """
    columns = {
        "ground reaction": _vector(results, "ground_reaction_{}_N"),
        "hip": _vector(results, "hip_force_{}_N"),
    }
    result = [
        _arrow(
            "ground reaction",
            geometries,
            centre_of_pressure,
            columns["ground reaction"],
            "on the foot",
        ),
        _arrow("hip", geometries, _hip, columns["hip"], "on the femur, at the hip"),
        *_extensor(results, geometries),
        *_condyles(results, geometries, friction),
    ]
    return tuple(arrow for arrow in result if np.isfinite(arrow.forces).any())


def contact_markers(geometries: Sequence[KneeGeometry]) -> tuple[Marker, ...]:
    """Return a ball at each condyle's contact point and at the patella's."""
    result = {
        f"{side} contact point": [_condyle_point(one, side) for one in geometries]
        for side in ("medial", "lateral")
    }
    patella = "patellofemoral contact point"
    result[patella] = [
        one.extensor.contact_point if one.extensor else NOTHING for one in geometries
    ]
    return tuple(
        Marker(
            name,
            "patella" if name == patella else "contact points",
            BLACK,
            np.stack(points),
            ARROW.contact_point_radius,
        )
        for name, points in result.items()
        if np.isfinite(points).any()
    )


def _arrow(
    name: str,
    geometries: Sequence[KneeGeometry],
    point: Callable[[KneeGeometry], Array],
    forces: Array,
    meaning: str,
) -> Arrow:
    points = np.stack([point(one) for one in geometries])
    return Arrow(name, FORCE_COLOURS[name], points, forces, name == "hip", meaning)


def centre_of_pressure(geometry: KneeGeometry) -> Array:
    """Return where the ground reaction acts (3,) m; NaN without one."""
    return geometry.ground.points[0] if geometry.ground else NOTHING


def _hip(geometry: KneeGeometry) -> Array:
    return geometry.state.point("hip", np.zeros(3))


def _extensor(results: "Results", geometries: Sequence[KneeGeometry]) -> list[Arrow]:
    """Return the forces of the tendons, and the force of the femur on the patella."""
    arrows = []
    for name, column, meaning in (
        ("quadriceps", "quadriceps_N", "on the patella"),
        ("patellar ligament", "patellar_ligament_N", "on the tibia"),
    ):
        ends = [_distal_end(one, name) for one in geometries]
        points = np.stack([point for point, _ in ends])
        forces = results[column][:, None] * np.stack([pull for _, pull in ends])
        arrows.append(Arrow(name, FORCE_COLOURS[name], points, forces, False, meaning))
    normal, across, points = (
        np.stack(rows) for rows in zip(*map(_patella, geometries), strict=True)
    )
    forces = (
        results["patellofemoral_N"][:, None] * normal
        + results["patellofemoral_tangential_N"][:, None] * across
    )
    name = "patellofemoral"
    arrows.append(Arrow(name, FORCE_COLOURS[name], points, -forces, True, "on the femur"))
    return arrows


def _distal_end(geometry: KneeGeometry, name: str) -> tuple[Array, Array]:
    """Return where a tendon ends and the pull (3,) of one newton there."""
    if geometry.extensor is None:
        return NOTHING, NOTHING
    (muscle,) = geometry.muscles
    loads = muscle.loads if name == "quadriceps" else geometry.extensor.patellar_ligament
    end: PointForces = loads[1]
    return end.points[0], end.forces[0]


def _patella(geometry: KneeGeometry) -> tuple[Array, Array, Array]:
    """Return the patellofemoral normal, tangent and contact point."""
    extensor = geometry.extensor
    if extensor is None:
        return NOTHING, NOTHING, NOTHING
    tangent = np.cross(geometry.state.pose("femur")[:3, 2], extensor.contact_normal)
    return extensor.contact_normal, tangent, extensor.contact_point


def _condyles(
    results: "Results", geometries: Sequence[KneeGeometry], friction: float
) -> list[Arrow]:
    if not any(one.condyles for one in geometries):
        forces = np.stack(
            [
                results["force_ap_N"],
                -results["force_si_N"],
                results["force_ml_N"],
            ],
            axis=1,
        )
        points = np.stack([one.state.pose("femur")[:3, 3] for one in geometries])
        return [Arrow("knee", FORCE_COLOURS["knee"], points, forces, True, "on the tibia")]
    arrows = []
    for side in ("medial", "lateral"):
        points = np.stack([_condyle_point(one, side) for one in geometries])
        ways = np.stack(
            [
                one.condyles[side].direction(friction) if side in one.condyles else NOTHING
                for one in geometries
            ]
        )
        forces = -results[f"{side}_force_equilibrium_N"][:, None] * ways
        name = f"{side} condyle"
        arrows.append(Arrow(name, FORCE_COLOURS[name], points, forces, True, "on the insert"))
    return arrows


def _condyle_point(geometry: KneeGeometry, side: str) -> Array:
    return geometry.condyles[side].point if side in geometry.condyles else NOTHING


def _vector(results: "Results", pattern: str) -> Array:
    return np.stack([results[pattern.format(axis)] for axis in ("ap", "si", "ml")], axis=1)
