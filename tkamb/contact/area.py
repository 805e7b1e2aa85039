"""How much of a surface is in contact, and how much of it is above a pressure."""

import numpy as np

from tkamb.contact.materials import Material
from tkamb.geometry.frames import Array, Index

NO_EDGE = 0.5
"""Share of a side where the femoral surface ends, or rises more than it goes along, before the
neighbour: contact may end anywhere between the two."""
LEAST_GAP = 1e-12
"""m; a node that is not in contact is at least this far off."""


def covered_areas(
    points: Array,
    triangles: Index,
    triangle_area: Array,
    pressure: Array,
    gap: Array,
    material: Material,
) -> Array:
    """Return the area in contact around each node (n,), m²; its sum is the contact area.

    The edge of contact crosses the sides of the triangles from nodes in contact to others. At
    a distance d from the edge of a smooth frictionless contact, whatever the bodies' shapes,

        p = C sqrt(d) inside,   gap = 4 C / (3 E*) d^(3/2) outside,   E* = E / (1 - nu²)

    so that p at a node, the gap at its neighbour and the distance h between them say where it
    is: y = C^(-2/3) solves p² y³ + (3 E* gap / 4)^(2/3) y = h. A triangle's part within the
    edge is shared evenly by its nodes in contact.

    Args:
        points: (n, 3) m.
        triangles: (k, 3) nodes.
        triangle_area: (k,) m².
        pressure: (n,) Pa, a node's force over its tributary area; positive in contact.
        gap: (n,) m, of the deformed body where contact is near.
        material: of the body.

    Reference:
        Johnson, Contact Mechanics, Cambridge 1985, sections 4.2 (line contact) and 5.1 (every
        smooth edge is like its), doi:10.1017/CBO9781139171731.
    """
    touched = pressure > 0
    a, b, c = touched[triangles.T].view(np.int8)
    count = a + b + c
    near = np.flatnonzero(count)
    corners, count = triangles[near], count[near]
    part = triangle_area[near]
    mixed = np.flatnonzero(count < 3)
    single = count[mixed] == 1
    odd = np.argmax(touched[corners[mixed]] == single[:, None], axis=1)
    own, others = corners[mixed, odd], corners[mixed[:, None], (odd[:, None] + [1, 2]) % 3]
    inside = np.where(single[:, None], own[:, None], others)
    outside = np.where(single[:, None], others, own[:, None])
    share = _share(points, inside, outside, pressure, gap, material)
    cut = np.where(single, share.prod(axis=1), 1.0 - (1.0 - share).prod(axis=1))
    part[mixed] *= cut
    held = touched[corners]
    shares = np.repeat(part / count, count)
    return np.asarray(np.bincount(corners[held], shares, len(points)), float)


def _share(
    points: Array,
    inside: Index,
    outside: Index,
    pressure: Array,
    gap: Array,
    material: Material,
) -> Array:
    """Return which share of the sides from nodes in contact (m, 2) to others is in contact."""
    distance = np.linalg.norm(points[inside] - points[outside], axis=2)
    smooth = gap[outside] < distance
    opening = np.where(smooth, np.maximum(gap[outside], LEAST_GAP), distance)
    modulus = material.young_modulus / (1.0 - material.poisson_ratio**2)
    square, rise = pressure[inside] ** 2, (0.75 * modulus * opening) ** (2 / 3)
    scale = np.sqrt(rise / (3.0 * square))
    root = 2.0 * scale * np.sinh(np.arcsinh(1.5 * distance / (rise * scale)) / 3.0)
    return np.where(smooth, np.minimum(square * root**3 / distance, 1.0), NO_EDGE)


def area_above(points: Array, triangles: Index, pressure: Array, level: float) -> float:
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
    square, positions = (pressure**2)[corners], points[corners]
    edges = np.roll(positions, -2, axis=1) - np.roll(positions, -1, axis=1)  # opposite each corner
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
