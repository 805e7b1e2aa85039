"""Radii of a mesh, measured by circles that are fitted to its plane sections."""

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from tkamb.geometry.frames import Array
from tkamb.studies.designs.design import Design
from tkamb.studies.designs.femoral import Cam, FemoralComponent, SagittalProfile, normal
from tkamb.studies.designs.insert import Insert


@dataclass(frozen=True)
class RadiusSettings:
    """Areas in which the radii of a design are measured."""

    coronal_reach_mm: float = 6.0
    """mm: distance from the ridge or the lowest line within which a coronal radius is fitted.
    Chosen as the width of a contact."""
    dish_reach_mm: float = 14.0
    """mm: distance from the lowest point within which a sagittal radius of a dish is fitted. Chosen
    as the extent of the dish."""
    arc_margin_deg: float = 1.5
    """deg: angle that is omitted at both ends of an arc. Chosen because facets of two arcs meet
    there."""


RADIUS = RadiusSettings()

CONTACT_PHI = (-25.0, 125.0)
"""deg: angles of the normals between which arcs touch the insert."""


@dataclass(frozen=True)
class Radius:
    """A documented radius, and the radius of the mesh, mm."""

    name: str
    documented: float
    measured: float


def circle_radius(points: ArrayLike) -> float:
    """Return the radius of the circle through points (n, 2), by algebraic least squares.

    The fit is x² + y² = 2 a x + 2 b y + c with r² = c + a² + b² (Kasa 1976,
    doi:10.1109/TIM.1976.6312298).
    """
    points = np.asarray(points, float)
    x, y = (points - points.mean(axis=0)).T
    columns = np.column_stack([2.0 * x, 2.0 * y, np.ones_like(x)])
    (a, b, c), *_ = np.linalg.lstsq(columns, x**2 + y**2, rcond=None)
    return float(np.sqrt(c + a * a + b * b))


def section(mesh: trimesh.Trimesh, normal_of: ArrayLike, through: ArrayLike) -> Array:
    """Return the points (n, 3) at which a plane cuts the edges of a mesh."""
    lines = trimesh.intersections.mesh_plane(mesh, np.asarray(normal_of), np.asarray(through))
    return np.asarray(lines).reshape(-1, 3)


def measured_radii(design: Design) -> list[Radius]:
    """Return all radii of a design that touch the other part, measured on its meshes."""
    femoral, insert = design.femoral, design.insert
    body, dish = _mesh(*femoral.mesh()), _mesh(*insert.mesh())
    result = []
    for side, sign in (("medial", -1.0), ("lateral", 1.0)):
        profile = femoral.profile if sign < 0 else femoral.lateral_profile
        result += _femoral(body, femoral, profile, sign, side)
        result += _dish(dish, insert, sign, side)
    if femoral.cam is not None:
        result.append(_cam(femoral, femoral.cam))
    return result


def _cam(femoral: FemoralComponent, cam: Cam) -> Radius:
    cut = section(_mesh(*femoral.mesh_with_cam()), [0.0, 0.0, 1.0], np.zeros(3))[:, :2]
    near = np.linalg.norm(cut - [cam.centre_ap, cam.centre_si], axis=1) < 2.0 * cam.radius
    return Radius("cam", cam.radius, circle_radius(cut[near]))


def _mesh(vertices: Array, faces: NDArray[np.int64]) -> trimesh.Trimesh:
    return trimesh.Trimesh(vertices, faces, process=False)


def _femoral(
    body: trimesh.Trimesh,
    femoral: FemoralComponent,
    profile: SagittalProfile,
    sign: float,
    side: str,
) -> list[Radius]:
    z = sign * femoral.ridge_half
    cut = section(body, [0.0, 0.0, 1.0], [0.0, 0.0, z])[:, :2]
    ends = np.degrees([profile.range[0], *profile.joints, profile.range[1]])
    result = []
    for i, radius in enumerate(profile.radii):
        start, end = max(ends[i], CONTACT_PHI[0]), min(ends[i + 1], CONTACT_PHI[1])
        if end - start < 4.0 * RADIUS.arc_margin_deg:
            continue
        arm = cut - profile.centres[i]
        phi = np.degrees(np.arctan2(-arm[:, 0], -arm[:, 1]))
        on_arc = (phi > start + RADIUS.arc_margin_deg) & (phi < end - RADIUS.arc_margin_deg)
        on_arc &= np.linalg.norm(arm, axis=1) > radius - 2.0
        name = f"{side} sagittal {start:g} to {end:g} deg"
        result.append(Radius(name, float(radius), circle_radius(cut[on_arc])))
        result.append(_coronal(body, femoral, profile, np.radians((start + end) / 2.0), z, side))
    return result


def _coronal(
    body: trimesh.Trimesh,
    femoral: FemoralComponent,
    profile: SagittalProfile,
    phi: float,
    z: float,
    side: str,
) -> Radius:
    outward = np.append(normal(phi), 0.0)
    along = np.array([-outward[1], outward[0], 0.0])
    apex = np.append(profile.point(phi), z)
    cut = section(body, along, apex) - apex
    high, across = cut @ outward, cut[:, 2]
    near = (np.abs(across) < RADIUS.coronal_reach_mm) & (high > -2.0)
    radius = circle_radius(np.column_stack([high, across])[near])
    name = f"{side} coronal at {np.degrees(phi):g} deg"
    return Radius(name, femoral.coronal_radius, radius)


def _dish(dish: trimesh.Trimesh, insert: Insert, sign: float, side: str) -> list[Radius]:
    z, low = sign * insert.dish_half, insert.low_point_ap
    radii = insert.medial_dish_radii if sign < 0 else insert.lateral_dish_radii
    cut = section(dish, [0.0, 0.0, 1.0], [0.0, 0.0, z])
    cut = cut[cut[:, 1] > 0.5 * insert.thickness]
    result = []
    for radius, sense, name in ((radii[0], 1.0, "anterior"), (radii[1], -1.0, "posterior")):
        distance = sense * (cut[:, 0] - low)
        part = cut[(distance > 0.7) & (distance < RADIUS.dish_reach_mm)]
        result.append(Radius(f"{side} dish, {name}", radius, circle_radius(part[:, :2])))
    cut = section(dish, [1.0, 0.0, 0.0], [low, 0.0, 0.0])
    near = (np.abs(cut[:, 2] - z) < RADIUS.coronal_reach_mm) & (cut[:, 1] > 0.5 * insert.thickness)
    measured = circle_radius(cut[near][:, 1:])
    return [*result, Radius(f"{side} dish, coronal", insert.coronal_radius, measured)]
