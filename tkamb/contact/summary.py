"""What each condyle carries, summed from a pressure map."""

import numpy as np
from numpy.typing import NDArray

from tkamb.contact.result import CondyleContact
from tkamb.geometry.frames import Array, inverse, transform


def medial_points(points: Array, pose: Array, split: float | None) -> NDArray[np.bool_]:
    """Say which map points (n, 3) lie under the medial condyle.

    A point belongs to the condyle on whose side of the femoral component it lies: femoral
    z < split is medial (right knee; left ones are mirrored at input).

    Args:
        points: (n, 3) m, insert frame.
        pose: (4, 4) pose_femoral_in_insert.
        split: z between the condyles in the femoral frame, m; None: one condyle, all medial.
    """
    if split is None:
        return np.ones(len(points), bool)
    return np.asarray(transform(inverse(pose), points)[:, 2] < split)


def summarise_condyles(
    medial: NDArray[np.bool_],
    points: Array,
    pressure: Array,
    area: Array,
    nodal_force: Array,
    thickness: Array,
) -> tuple[CondyleContact | None, CondyleContact | None]:
    """Return what the medial and the lateral condyle carry, None where there is no pressure.

    A condyle's area is at least its force over its peak pressure: where contact is smaller
    than the cells the mean pressure is not above the peak.

    Args:
        medial: (n,) which points belong to the medial condyle, see `medial_points`.
        points: (n, 3) m, insert frame.
        pressure: (n,) Pa.
        area: (n,) m², in contact around each point; its tributary area where a model knows
            no better.
        nodal_force: (n, 3) N on the insert.
        thickness: (n,) m, insert below each point along y.
    """
    loaded = pressure > 0
    arrays = (points, pressure, area, nodal_force, thickness)
    return (
        _summarise(loaded & medial, *arrays),
        _summarise(loaded & ~medial, *arrays),
    )


def area_above(points: Array, triangles: NDArray[np.int64], pressure: Array, level: float) -> float:
    """Return the area (m²) where the pressure exceeds a level.

    On each triangle q = p² is linear between the corners, plus the mean by which a curved q
    rises over that, sum over edges of (g_i - g_j).(x_j - x_i) / 24 for gradients g at the
    corners: exact in the mean for a Hertzian pressure, whose square is quadratic in place.
    The area grows steadily with the pressures, where whole nodes would come and go.

    Args:
        points: (n, 3) m.
        triangles: (k, 3) of them.
        pressure: (n,) Pa.
        level: Pa, positive.
    """
    near = np.zeros(len(points), bool)
    near[triangles[(pressure[triangles] > 0).any(axis=1)]] = True
    corners = triangles[near[triangles].any(axis=1)]
    square, places = (pressure**2)[corners], points[corners]
    edges = np.roll(places, -2, axis=1) - np.roll(places, -1, axis=1)  # opposite each corner
    cross = np.cross(edges[:, 0], edges[:, 1])
    size = 0.5 * np.linalg.norm(cross, axis=1)
    across = np.cross(cross[:, None], edges)
    slope = np.einsum("ki,kij->kj", square, across) / (4.0 * size**2)[:, None]
    total = np.zeros((len(points), 4))
    np.add.at(total, corners.T, np.column_stack([size[:, None] * slope, size]))
    gradient = total[corners, :3] / total[corners, 3:]
    bend = np.roll(gradient, -1, axis=1) - np.roll(gradient, -2, axis=1)
    square += np.einsum("kij,kij->k", bend, edges)[:, None] / 24.0
    return float(size @ _share_above(square, level**2))


def _share_above(values: Array, level: float) -> Array:
    """Return the share (k,) of triangles where linear values (k, 3) exceed a level."""
    low, middle, high = np.sort(values, axis=1).T
    with np.errstate(divide="ignore", invalid="ignore"):  # what is not chosen below
        tip = (high - level) ** 2 / ((high - low) * (high - middle))
        rest = 1.0 - (level - low) ** 2 / ((middle - low) * (high - low))
    chosen = [level >= high, level >= middle, level > low]
    return np.select(chosen, [np.zeros_like(tip), tip, rest], 1.0)


def wrench_of(points: Array, nodal_force: Array) -> Array:
    """Return force (N) and moment about the insert origin (N·m), (6,), of nodal forces."""
    carrying = nodal_force.any(axis=1)
    force = nodal_force[carrying]
    return np.concatenate([force.sum(axis=0), np.cross(points[carrying], force).sum(axis=0)])


def _summarise(
    chosen: NDArray[np.bool_],
    points: Array,
    pressure: Array,
    area: Array,
    nodal_force: Array,
    thickness: Array,
) -> CondyleContact | None:
    if not chosen.any():
        return None
    force = np.linalg.norm(nodal_force[chosen].sum(axis=0))
    weight = np.linalg.norm(nodal_force[chosen], axis=1)
    centre = weight @ points[chosen] / weight.sum()
    peak = float(pressure[chosen].max())
    covered = max(float(area[chosen].sum()), float(force) / peak)
    return CondyleContact(
        force=float(force),
        area=covered,
        mean_pressure=float(force) / covered,
        peak_pressure=peak,
        centre_of_pressure=centre,
        thickness=thickness_under(centre, points, thickness),
    )


def thickness_under(place: Array, points: Array, thickness: Array) -> float:
    """Return the insert's thickness (m) under a place (3,), between the nearest map points.

    Inverse-distance weights of the four points nearest in x and z.
    """
    away = np.hypot(*(points[:, [0, 2]] - place[[0, 2]]).T)
    near = np.argpartition(away, 3)[:4] if len(points) > 4 else np.arange(len(points))
    weight = 1.0 / np.maximum(away[near], 1e-9)
    return float(weight @ thickness[near] / weight.sum())
