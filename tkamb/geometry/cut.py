"""A closed surface cut by a plane across an axis, its parts closed again by flat fans."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tkamb.errors import InputError
from tkamb.geometry.frames import Array, Index


@dataclass(frozen=True)
class CutSettings:
    """How a plane that cuts a mesh avoids its vertices."""

    vertex_clearance: float = 1e-9
    """m; the plane keeps at least this distance from every vertex (see `plane_shift`). Chosen:
    above rounding."""
    plane_shift: float = 1e-7
    """m; distance by which the plane is moved until it keeps `vertex_clearance`. Chosen: it changes
    no result."""


CUT = CutSettings()


def split_faces(
    vertices: Array, faces: Index, axis: int, level: float
) -> tuple[Array, Index, Index]:
    """Return the vertices with those of the cut, and the faces below and above the plane.

    Triangles that the plane crosses are divided; the parts share the vertices of the cut, on
    edges of the mesh.

    Args:
        vertices: (n, 3) m; vertices at one place are one.
        faces: (k, 3).
        axis: 0, 1 or 2: the plane's normal.
        level: m, where it stands; moved by a fraction of a micrometre off the vertices.
    """
    height = vertices[:, axis] - level
    while (np.abs(height) < CUT.vertex_clearance).any():
        height -= CUT.plane_shift
    above = height[faces] > 0
    count = above.sum(axis=1)
    crossed = np.flatnonzero((count == 1) | (count == 2))
    # turned so that the corner that is alone on its side comes first
    lone = np.where((count[crossed] == 1)[:, None], above[crossed], ~above[crossed]).argmax(axis=1)
    a, b, c = (faces[crossed, (lone + i) % 3] for i in range(3))
    edges = np.sort(np.stack([np.stack([a, b], 1), np.stack([a, c], 1)]), axis=-1)
    unique, number = np.unique(edges.reshape(-1, 2), axis=0, return_inverse=True)
    first, second = height[unique[:, 0]], height[unique[:, 1]]
    share = (first / (first - second))[:, None]
    start, end = vertices[unique[:, 0]], vertices[unique[:, 1]]
    p, q = (len(vertices) + number).reshape(2, -1)
    tips = np.stack([a, p, q], axis=1)
    rests = np.concatenate([np.stack([p, b, c], axis=1), np.stack([p, c, q], axis=1)])
    tip_above = count[crossed] == 1
    rest_above = np.tile(~tip_above, 2)
    lower = [faces[count == 0], tips[~tip_above], rests[~rest_above]]
    upper = [faces[count == 3], tips[tip_above], rests[rest_above]]
    joined = np.concatenate([vertices, start + share * (end - start)])
    return joined, np.concatenate(lower), np.concatenate(upper)


def pieces(vertices: Array, faces: Index) -> Index:
    """Return the number of the connected piece that each face (k,) belongs to."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    shape = (len(vertices), len(vertices))
    graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape)
    return np.asarray(connected_components(graph, directed=False)[1][faces[:, 0]], np.int64)


def closed_by_fans(vertices: Array, faces: Index, name: str) -> tuple[Array, Index]:
    """Return vertices and faces of the surface with every hole closed by triangles to its middle.

    Args:
        vertices: (n, 3) m.
        faces: (k, 3), whose open edges lie in planes.
        name: what to call the part in a message.

    Raises:
        InputError: a hole's outline is not seen whole from its middle.
    """
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    key, back = (edges * [len(vertices), 1]).sum(1), (edges * [1, len(vertices)]).sum(1)
    rim = edges[~np.isin(key, back)]
    for number in np.unique(loops := _loops(rim, len(vertices))):
        own = rim[loops == number]
        start, end = vertices[own[:, 0]], vertices[own[:, 1]]
        length = np.linalg.norm(end - start, axis=1)
        middle = length @ (start + end) / 2 / length.sum()
        normals = np.cross(start - middle, end - middle)
        if (normals @ normals.sum(axis=0) < 0).any():
            raise InputError(
                "its outline where it is cut off cannot be closed",
                name,
                "give a post with a convex outline, or leave out [contact] post",
            )
        fan = np.column_stack([own[:, ::-1], np.full(len(own), len(vertices))])
        vertices, faces = np.vstack([vertices, middle]), np.concatenate([faces, fan])
    used, faces = np.unique(faces, return_inverse=True)
    return vertices[used], faces.reshape(-1, 3).astype(np.int64)


def _loops(edges: Index, count: int) -> Index:
    """Return the number of the loop that each edge (m,) belongs to."""
    graph = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), (count, count))
    return np.asarray(connected_components(graph, directed=False)[1][edges[:, 0]], np.int64)


def merged(vertices: Array, faces: Index) -> tuple[Array, Index]:
    """Return the surface with vertices at the same place made one."""
    places, number = np.unique(vertices, axis=0, return_inverse=True)
    return places, number.reshape(-1)[faces].astype(np.int64)
