"""The area of a surface that is in contact, and the area above a given pressure."""

import numpy as np

from tkamb.contact.materials import Material
from tkamb.geometry.compiled import compiled_as_written
from tkamb.geometry.frames import Array, Index

# 1: share of a triangle's side that counts as in contact where the edge of contact is unknown: the
# femoral surface ends between the side's nodes, or is steeper than 45 deg. Contact
# may end anywhere between the nodes.
UNKNOWN_EDGE_SHARE = 0.5
# m: smallest gap of a node that is not in contact. It prevents a division by zero;
# gaps that matter are above 1e-7 m.
LEAST_GAP = 1e-12


def covered_areas(
    points: Array,
    triangles: Index,
    triangle_area: Array,
    pressure: Array,
    gap: Array,
    material: Material,
) -> Array:
    """Return the area in contact around each node (n,), m²; its sum is the contact area.

    The edge of contact crosses a triangle's side between a node in contact and one that is not. At
    a distance d from the edge of a smooth frictionless contact of any shape,

        p = C sqrt(d) inside,   gap = 4 C / (3 E*) d^(3/2) outside,   E* = E / (1 - nu²)

    The two distances add up to the length h of the side: with y = C^(-2/3), p² y³ + (3 E* gap /
    4)^(2/3) y = h. The area of a triangle inside the edge is divided evenly among its nodes in
    contact.

    Args:
        pressure: (n,) Pa, nodal force divided by tributary area; positive in contact.
        gap: (n,) m, gap of the deformed body near the contact.

    Reference:
        Johnson, Contact Mechanics, Cambridge 1985, sections 4.2 (line contact) and 5.1 (any smooth
        edge behaves like that of a line contact), doi:10.1017/CBO9781139171731.
    """
    touched = pressure > 0
    a, b, c = touched[triangles.T].view(np.int8)
    # A triangle with all corners in contact counts whole; the edge of contact cuts a mixed one.
    count = a + b + c
    touching = np.flatnonzero(count)
    corners, count = triangles[touching], count[touching]
    part = triangle_area[touching]
    mixed = np.flatnonzero(count < 3)
    # The odd corner is the only one in contact, or the only one out of contact. The edge of contact
    # cuts the two sides that meet at the odd corner.
    single = count[mixed] == 1
    odd = np.argmax(touched[corners[mixed]] == single[:, None], axis=1)
    odd_node, other_nodes = (
        corners[mixed, odd],
        corners[mixed[:, None], (odd[:, None] + [1, 2]) % 3],
    )
    inside = np.where(single[:, None], odd_node[:, None], other_nodes)
    outside = np.where(single[:, None], other_nodes, odd_node[:, None])
    share = _share(points, inside, outside, pressure, gap, material)
    # A cut at the shares s and t of two sides separates the part s t of the area at their corner.
    cut = np.where(single, share.prod(axis=1), 1.0 - (1.0 - share).prod(axis=1))
    part[mixed] *= cut
    in_contact = touched[corners]
    shares = np.repeat(part / count, count)
    return np.asarray(np.bincount(corners[in_contact], shares, len(points)), float)


def _share(
    points: Array,
    inside: Index,
    outside: Index,
    pressure: Array,
    gap: Array,
    material: Material,
) -> Array:
    """Return the shares in contact (m, 2) of the two cut sides of each triangle.

    `inside` and `outside` (m, 2) are these sides' ends in contact and out of contact.
    """

    distance = np.linalg.norm(points[inside] - points[outside], axis=2)
    smooth = gap[outside] < distance
    opening = np.where(smooth, np.maximum(gap[outside], LEAST_GAP), distance)
    modulus = material.young_modulus / (1.0 - material.poisson_ratio**2)
    # Inside the edge p² is proportional to the distance d, outside the gap is proportional to
    # d^(3/2). Both laws share the factor C, which determines the place of the edge.
    square, rise = pressure[inside] ** 2, (0.75 * modulus * opening) ** (2 / 3)
    scale = np.sqrt(rise / (3.0 * square))
    # Closed form of the only real root of the cubic, without cancellation for small gaps.
    root = 2.0 * scale * np.sinh(np.arcsinh(1.5 * distance / (rise * scale)) / 3.0)
    return np.where(smooth, np.minimum(square * root**3 / distance, 1.0), UNKNOWN_EDGE_SHARE)


def area_above(points: Array, triangles: Index, pressure: Array, level: float) -> float:
    """Return the area (m²) where the pressure exceeds a level.

    On each triangle q = p² is interpolated linearly between the corners, plus the mean difference
    between a quadratic q and this interpolation: the sum over the edges of (g_i - g_j).(x_j - x_i)
    / 24, with the gradient g of q at a corner. For a Hertzian pressure, where q is quadratic, the
    mean of q is exact. The area is continuous in the pressures.

    Points (n, 3), m, and pressure (n,), Pa, are those of the nodes. `level`, Pa, is positive.
    """
    # p² is interpolated, because it is linear at the rim of a Hertzian contact while p has a
    # vertical slope there.
    return float(_area_above(points, triangles, pressure**2, level**2))


@compiled_as_written
def _area_above(points: Array, triangles: Index, square: Array, level: float) -> float:
    near, total = np.zeros(len(points), np.bool_), np.zeros((len(points), 4))
    for k in range(len(triangles)):
        a, b, c = triangles[k, 0], triangles[k, 1], triangles[k, 2]
        if square[a] > 0.0 or square[b] > 0.0 or square[c] > 0.0:
            near[a] = near[b] = near[c] = True
    edges, across = np.empty((3, 3)), np.empty(3)
    for k in range(len(triangles)):
        if near[triangles[k, 0]] or near[triangles[k, 1]] or near[triangles[k, 2]]:
            size = _shape(points, triangles[k], edges, across)
            for axis in range(3):
                slope = 0.0  # gradient of the linear q, times 4 size²
                for i in range(3):
                    j, m = (axis + 1) % 3, (axis + 2) % 3
                    cross = across[j] * edges[i, m] - across[m] * edges[i, j]
                    slope += square[triangles[k, i]] * cross
                for i in range(3):
                    total[triangles[k, i], axis] += slope / (4.0 * size)
            for i in range(3):
                total[triangles[k, i], 3] += size
    for n in range(len(points)):
        if near[n]:
            for axis in range(3):
                total[n, axis] /= total[n, 3]
    area, values = 0.0, np.empty(3)
    for k in range(len(triangles)):
        corners = triangles[k]
        if near[corners[0]] or near[corners[1]] or near[corners[2]]:
            size, rise = _shape(points, corners, edges, across), 0.0
            for i in range(3):
                first, second = corners[(i + 1) % 3], corners[(i + 2) % 3]
                for axis in range(3):
                    rise += (total[first, axis] - total[second, axis]) * edges[i, axis]
            for i in range(3):
                # Linear interpolation underestimates a concave p²; the nodal slopes give the mean
                # of the quadratic term.
                values[i] = square[corners[i]] + rise / 24.0
            area += size * _share_above(values, level)
    return area


@compiled_as_written
def _shape(points: Array, corners: Index, edges: Array, across: Array) -> float:
    """Return the area; write edges (3, 3), each opposite its corner, and `across`."""
    for i in range(3):
        for axis in range(3):
            edges[i, axis] = points[corners[(i + 2) % 3], axis] - points[corners[(i + 1) % 3], axis]
    for axis in range(3):
        j, m = (axis + 1) % 3, (axis + 2) % 3
        across[axis] = edges[0, j] * edges[1, m] - edges[0, m] * edges[1, j]
    return 0.5 * np.sqrt(across[0] ** 2 + across[1] ** 2 + across[2] ** 2)


@compiled_as_written
def _share_above(values: Array, level: float) -> float:
    """Return the share above a level, by the corners' values (3,); sort them."""
    values.sort()
    low, middle, high = values[0], values[1], values[2]
    if level >= high:
        return 0.0
    if level >= middle:
        return (high - level) ** 2 / ((high - low) * (high - middle))
    if level > low:
        return 1.0 - (level - low) ** 2 / ((middle - low) * (high - low))
    return 1.0
