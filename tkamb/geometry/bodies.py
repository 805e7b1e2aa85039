"""The separate bodies of a triangulated surface, each with the voids inside it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tkamb.geometry.boundary import open_edges
from tkamb.geometry.frames import Array
from tkamb.geometry.repair import connected_parts, signed_volumes

Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Body:
    """A connected part of a surface, with the voids within it.

    Args:
        faces: (m,) indices of its faces.
        extents: (3,) size along the axes, units of the surface.
        centre: (3,) of its bounding box, units of the surface.
        area: of its outer skin, square units of the surface.
        closed: whether its skin has no open edge.
    """

    faces: Indices
    extents: Array
    centre: Array
    area: float
    closed: bool


def separate_bodies(vertices: Array, faces: Indices) -> list[Body]:
    """Return the bodies of a surface, the one with the largest skin first.

    A closed part of negative volume (its normals point to its inside) whose bounding box lies
    within another closed part's is a void of that one, not a body.

    Args:
        vertices: (n, 3).
        faces: (k, 3), as `tkamb.geometry.repair.repair` leaves them.
    """
    label = connected_parts(faces)
    parts = [np.flatnonzero(label == part) for part in range(int(label.max(initial=-1)) + 1)]
    loose = np.unique(open_edges(faces))
    found = [_body(vertices, faces, part, loose) for part in parts]
    volume = np.bincount(label, signed_volumes(vertices, faces))
    outer = [k for k in range(len(found)) if volume[k] >= 0 or not found[k].closed]
    held: dict[int, list[Indices]] = {k: [found[k].faces] for k in outer}
    for k in set(range(len(found))) - set(outer):
        around = [q for q in outer if found[q].closed and _within(found[k], found[q])]
        held.setdefault(min(around, key=lambda q: found[q].area, default=k), []).append(parts[k])
    bodies = [
        Body(np.sort(np.concatenate(own)), b.extents, b.centre, b.area, b.closed)
        for b, own in ((found[k], own) for k, own in held.items())
    ]
    return sorted(bodies, key=lambda body: -body.area)


def _body(vertices: Array, faces: Indices, part: Indices, loose: Indices) -> Body:
    corners = vertices[faces[part]]
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = float(np.linalg.norm(cross, axis=1).sum() / 2.0)
    closed = not np.isin(faces[part], loose).any()
    return Body(part, high - low, (low + high) / 2.0, area, closed)


def _within(inner: Body, outer: Body) -> bool:
    reach = np.abs(inner.centre - outer.centre) + inner.extents / 2.0
    return bool((reach < outer.extents / 2.0).all())
