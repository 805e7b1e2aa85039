"""Curvatures of two meshes at a contact point, from quadrics fitted to local patches."""

from dataclasses import dataclass

import numpy as np

from tkamb.geometry.frames import Array, inverse, rotate, transform
from tkamb.geometry.rays import RayCaster


@dataclass(frozen=True)
class CurvatureSettings:
    """Curvatures at a contact point, from a patch of rays."""

    samples: int = 21
    """Rays along the diameter of a patch: about 350 for the six coefficients of a quadric average
    out the facets.
    """
    max_iterations: int = 12
    """Largest number of iterations for the contact point. Not studied."""
    position_tolerance: float = 1e-7
    """m: the contact point has converged when an iteration moves it by less. It is
    far below the size of a triangle."""
    max_distance: float = 3.0
    """1: largest distance of the contact point from first touch, in radii of the patch. Farther
    away the quadrics do not describe the surfaces."""
    least_cover: float = 0.6
    """1: smallest share of a patch that both meshes must cover. With a smaller share the quadric
    is an extrapolation."""


CURVATURE = CurvatureSettings()


@dataclass(frozen=True, eq=False)
class OsculatingContact:
    """Normal, gap and curvatures of two surfaces at their contact point, from fitted quadrics.

    Args:
        point: (3,) m, insert frame, on the insert's quadric.
        normal: (3,) unit, out of the insert.
        axes: (2, 3) unit tangents along the smaller and the larger relative curvature.
        gap: m, distance of the two quadrics at the point, along the normal.
        relative: (2,) 1/m, relative curvatures k along `axes`, ascending; at a distance s from the
            point the gap is larger by k s²/2.
        insert_curvature: (2,) 1/m along `axes`, negative where the insert is concave.
        femoral_curvature: (2,) 1/m along `axes`, positive where the femur is convex.
    """

    point: Array
    normal: Array
    axes: Array
    gap: float
    relative: Array
    insert_curvature: Array
    femoral_curvature: Array


def osculate(
    insert: RayCaster, femoral: RayCaster, pose: Array, start: Array, radius: float
) -> OsculatingContact | None:
    """Fit quadrics to both surfaces, and find the contact point where the quadrics are nearest.

    Evenly spaced rays along the normal sample both meshes over a disc in the tangent plane. A
    quadric z = c0 + c1 u + c2 v + c3 u² + c4 uv + c5 v² is fitted to each by least squares. Each
    iteration moves the disc to the minimum of the quadrics' difference, and aligns its axis with
    their mean normal. Facets smaller than the disc average out. On a sphere of radius R the
    relative error of the curvature is radius²/(4 R²), from the quartic term.

    Args:
        pose: (4, 4) pose_femoral_in_insert close to first touch.
        start: (3,) m, place of first touch, insert frame.
        radius: m, radius of the disc.

    Returns:
        The quadrics at the contact point. None if a mesh covers too little of a patch, or if the
        iteration does not converge because the surfaces do not curve apart.
    """
    point, normal = start, _start_normal(insert, start)
    # Point and normal depend on each other: each iteration fits, moves the point, turns the normal.
    for _ in range(CURVATURE.max_iterations):
        frame = np.stack([*_tangents(normal), normal])
        fits = _fit(insert, femoral, pose, point, frame, radius)
        if fits is None:
            return None
        of_insert, of_femoral = fits
        # The gap is itself a quadric; its minimum is the contact point.
        difference = of_femoral - of_insert
        step = _nearest_place(difference, radius)
        if step is None or np.linalg.norm(point - start) > CURVATURE.max_distance * radius:
            return None
        if np.linalg.norm(step) < CURVATURE.position_tolerance:
            return _described(point, frame, of_insert, of_femoral)
        point = point + np.append(step, _value(of_insert, step)) @ frame
        # At the contact point both surfaces have the same normal; before convergence the mean is
        # the best estimate.
        slope = (_slope(of_insert, step) + _slope(of_femoral, step)) / 2
        normal = np.append(-slope, 1.0) @ frame
        normal /= np.linalg.norm(normal)
    return None


def _start_normal(insert: RayCaster, start: Array) -> Array:
    above = start + np.array([0.0, 1e-3, 0.0])
    _, face = insert.first(above[None], np.array([0.0, -1.0, 0.0]))
    up = np.array([0.0, 1.0, 0.0])
    return insert.surface.face_normals[face[0]] if face[0] >= 0 else up


def _tangents(normal: Array) -> tuple[Array, Array]:
    """The first tangent lies in the sagittal plane."""
    first = np.cross(normal, [0.0, 0.0, 1.0])
    first /= np.linalg.norm(first)
    return first, np.cross(normal, first)


def _fit(
    insert: RayCaster, femoral: RayCaster, pose: Array, point: Array, frame: Array, radius: float
) -> tuple[Array, Array] | None:
    """Return coefficients (6,) of insert and femur over the tangent plane."""
    ticks = np.linspace(-radius, radius, CURVATURE.samples)
    u, v = (grid.ravel() for grid in np.meshgrid(ticks, ticks))
    disc = u**2 + v**2 <= radius**2 * 1.0001
    u, v = u[disc], v[disc]
    places = point + np.stack([u, v], axis=1) @ frame[:2]
    back, normal = inverse(pose), frame[2]
    insert_distance, _ = insert.first(places + radius * normal, -normal)
    femoral_distance, _ = femoral.first(
        transform(back, places - radius * normal), rotate(back, normal)
    )
    of_insert, of_femoral = radius - insert_distance, femoral_distance - radius
    # A ray that misses a mesh, or meets another part of it, is no sample of this patch.
    covered = (np.abs(of_insert) < radius) & (np.abs(of_femoral) < radius)
    if covered.mean() < CURVATURE.least_cover:
        return None
    u, v = u[covered], v[covered]
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)
    heights = np.stack([of_insert[covered], of_femoral[covered]], axis=1)
    # Scaling the columns to equal size keeps the least squares well conditioned.
    scale = radius ** np.array([0, 1, 1, 2, 2, 2])
    coefficients = np.linalg.lstsq(terms / scale, heights, rcond=None)[0] / scale[:, None]
    return coefficients[:, 0], coefficients[:, 1]


def _hessian(quadric: Array) -> Array:
    return np.array([[2 * quadric[3], quadric[4]], [quadric[4], 2 * quadric[5]]])


def _value(quadric: Array, place: Array) -> float:
    u, v = place
    return float(quadric @ np.array([1, u, v, u * u, u * v, v * v]))


def _slope(quadric: Array, place: Array) -> Array:
    return quadric[1:3] + _hessian(quadric) @ place


def _nearest_place(difference: Array, radius: float) -> Array | None:
    """Return a quadric's minimum (2,), m, at most a radius away, or None."""
    values, vectors = np.linalg.eigh(_hessian(difference))
    # Not convex in all directions: the bodies conform, and no nearest point exists.
    if values[0] <= 0:
        return None
    step = -vectors @ ((vectors.T @ difference[1:3]) / values)
    length = float(np.linalg.norm(step))
    # The quadric describes the patch only; the step is therefore at most one radius long.
    return np.asarray(step * min(1.0, radius / length)) if length > 0 else step


def _described(
    point: Array, frame: Array, of_insert: Array, of_femoral: Array
) -> OsculatingContact:
    values, vectors = np.linalg.eigh(_hessian(of_femoral - of_insert))
    along = vectors.T
    return OsculatingContact(
        point=point + of_insert[0] * frame[2],
        normal=frame[2],
        axes=along @ frame[:2],
        gap=float(of_femoral[0] - of_insert[0]),
        relative=values,
        insert_curvature=-np.einsum("ij,jk,ik->i", along, _hessian(of_insert), along),
        femoral_curvature=np.einsum("ij,jk,ik->i", along, _hessian(of_femoral), along),
    )
