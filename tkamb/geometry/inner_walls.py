"""Walls inside a part: touching or overlapping bodies of one file, joined where possible.

CAD systems export touching bodies with the wall between them still there. Its two sides face one
another, each towards the other's material. A triangle whose outer side lies in material separates
nothing. Where all of the wall is made of such triangles, they are taken out, and the two skins are
joined along the wall's rim: an open edge is divided where vertices of the other skin lie on it.
Where bodies overlap, or a triangle reaches beyond the wall, the wall stays. That does no harm:
what is inside is decided by the winding number (`tkamb.geometry.winding`), which ignores walls.
"""

from collections import defaultdict
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from tkamb.geometry.frames import Array, Index, Mask
from tkamb.geometry.polygons import ears
from tkamb.geometry.surface import Surface
from tkamb.geometry.topology import connected_parts, is_closed, open_edges


@dataclass(frozen=True)
class InnerWallSettings:
    """Walls inside a part."""

    probe_distance: float = 2e-5
    """m: distance from a triangle at which the program checks for material. Chosen: bodies with a
    wider gap are separate."""
    edge_distance: float = 1e-6
    """m: a vertex this near to an open edge lies on it. Chosen: above the rounding of a mesh."""
    least_area: float = 2e-6
    """m²: smaller areas are not a wall. Chosen: triangles in a narrow corner have less."""


INNER_WALL = InnerWallSettings()

SAMPLES = np.array(
    [[1 / 3, 1 / 3, 1 / 3], [0.8, 0.1, 0.1], [0.1, 0.8, 0.1], [0.1, 0.1, 0.8], [0.45, 0.45, 0.1],
     [0.1, 0.45, 0.45], [0.45, 0.1, 0.45]]
)  # fmt: skip
"""Barycentric coordinates of the places at which a triangle is tested."""


@dataclass(frozen=True, eq=False)
class InnerWall:
    """A wall inside a part, and the part without it.

    Args:
        faces: (m,) the triangles of the wall, both sides.
        area: m², of one side.
        centre: (3,) m.
        without: vertices and faces of the part without the wall; None where it has to stay.
    """

    faces: Index
    area: float
    centre: Array
    without: tuple[Array, Index] | None


def facing_material(surface: Surface, faces: Index) -> Mask:
    """Say which triangles (m,) of a closed surface have material on their outer side."""
    points = np.einsum("sc,kcx->ksx", SAMPLES, surface.triangles[faces])
    points += INNER_WALL.probe_distance * surface.face_normals[faces][:, None]
    within = surface.winding.inside(points.reshape(-1, 3)).reshape(len(faces), -1)
    return np.asarray(within.all(axis=1))


def find_inner_wall(vertices: Array, faces: Index) -> InnerWall | None:
    """Return the walls inside a closed surface as one; None if there are none.

    None, too, where a whole body lies within another one: that may be a void with wrong winding.

    Args:
        vertices: (n, 3) m.
        faces: (k, 3), outward.
    """
    surface = Surface(vertices, faces, merged=True)
    within = facing_material(surface, np.arange(len(faces)))
    part = connected_parts(faces)
    if len(np.setdiff1d(part, part[~within])):
        return None
    inner = np.flatnonzero(within)
    area = surface.areas[inner]
    if area.sum() / 2.0 < INNER_WALL.least_area:
        return None
    centre = area @ surface.triangles[inner].mean(axis=1) / area.sum()
    rest = _joined_along_rims(vertices, np.delete(faces, inner, axis=0))
    whole = None
    if len(rest) and is_closed(rest):
        used, number = np.unique(rest, return_inverse=True)
        whole = vertices[used], number.reshape(-1, 3).astype(np.int64)
    return InnerWall(inner, float(area.sum() / 2.0), centre, whole)


def touching_groups(vertices: Array, bodies: list[Index], faces: Index, wall: Index) -> int:
    """Return how many groups of bodies there are that touch or overlap one another.

    Args:
        vertices: (n, 3) m.
        bodies: the triangles of each.
        faces: (k, 3).
        wall: (m,) triangles of the walls inside.
    """
    group = list(range(len(bodies)))
    skins = [Surface(vertices, faces[own], merged=True) for own in bodies]
    for a, own in enumerate(bodies):
        part = np.intersect1d(own, wall)
        if not len(part):
            continue
        whole = Surface(vertices, faces[part], merged=True)
        points = whole.triangles.mean(axis=1) + INNER_WALL.probe_distance * whole.face_normals
        for b in range(len(bodies)):
            if group[a] != group[b] and skins[b].winding.inside(points).any():
                group = [group[a] if each == group[b] else each for each in group]
    return len(set(group))


def _joined_along_rims(vertices: Array, faces: Index) -> Index:
    """Return the triangles with open edges divided where other open vertices lie on them."""
    edges = open_edges(faces)
    if not len(edges):
        return faces
    loose = np.unique(edges)
    tree = cKDTree(vertices[loose])
    dividing: dict[tuple[int, int], Index] = {}
    for start, end in edges:
        along = vertices[end] - vertices[start]
        length = float(np.linalg.norm(along))
        middle = (vertices[start] + vertices[end]) / 2.0
        near = loose[tree.query_ball_point(middle, length / 2.0 + INNER_WALL.edge_distance)]
        near = near[(near != start) & (near != end)]
        share = (vertices[near] - vertices[start]) @ along / length**2
        off = np.linalg.norm(vertices[near] - vertices[start] - share[:, None] * along, axis=1)
        on = (
            (off < INNER_WALL.edge_distance)
            & (share * length > INNER_WALL.edge_distance)
            & ((1 - share) * length > INNER_WALL.edge_distance)
        )
        if on.any():
            dividing[int(start), int(end)] = near[on][np.argsort(share[on])]
    return _divided(vertices, faces, dividing)


def _divided(vertices: Array, faces: Index, dividing: dict[tuple[int, int], Index]) -> Index:
    """Return the triangles (k, 3) with vertices put into some of their directed edges."""
    by_face: dict[int, list[int]] = defaultdict(list)
    starts = {start for start, _ in dividing}
    for face in np.flatnonzero(np.isin(faces, list(starts)).any(axis=1)):
        for corner in range(3):
            edge = int(faces[face, corner]), int(faces[face, (corner + 1) % 3])
            if edge in dividing:
                by_face[int(face)].append(corner)
    added: list[tuple[int, int, int]] = []
    for number, corners in by_face.items():
        ring: list[int] = []
        for corner in range(3):
            ring.append(int(faces[number, corner]))
            if corner in corners:
                edge = ring[-1], int(faces[number, (corner + 1) % 3])
                ring.extend(int(vertex) for vertex in dividing[edge])
        a, b, c = vertices[faces[number]]
        cut = ears(vertices, np.array(ring), np.cross(b - a, c - a))
        added.extend((int(x), int(y), int(z)) for x, y, z in cut)
    whole_faces = np.delete(faces, list(by_face), axis=0)
    return np.concatenate([whole_faces, np.array(added, np.int64).reshape(-1, 3)])
