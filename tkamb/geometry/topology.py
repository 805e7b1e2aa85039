"""Topology of a triangulated surface: its edges, open loops, connected parts and bodies.

`Ragged` stores lists of different lengths, such as the triangles at each vertex, in flat arrays.
"""

from dataclasses import dataclass

import numpy as np

from tkamb.geometry.frames import Array, Index


@dataclass(frozen=True, eq=False)
class BoundaryLoop:
    """One closed loop of open edges, in the direction of the half edges of its triangles.

    Args:
        vertices: (n,) vertex indices in order; the last edge runs from the last to the first.
        centre: (3,) mean of the vertices, units of the surface.
        width: smallest distance between two parallel lines that enclose the loop in its
            best-fitting plane, units of the surface.
        perimeter: length of the loop, units of the surface.
    """

    vertices: Index
    centre: Array
    width: float
    perimeter: float


def half_edges(faces: Index) -> Index:
    """Return the directed edges (3k, 2) of faces (k, 3), in the order of the faces."""
    return faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def edge_use(faces: Index) -> tuple[Index, Index]:
    """Return the undirected edge (3k,) of every half edge, and its faces' number (m,)."""
    ends = np.sort(half_edges(faces), axis=1)
    key = ends[:, 0] * (int(faces.max(initial=0)) + 1) + ends[:, 1]
    _, edge, count = np.unique(key, return_inverse=True, return_counts=True)
    return edge.reshape(-1), count


def is_closed(faces: Index) -> bool:
    """Return whether every edge is shared by two faces, with opposite directions."""
    edge, count = edge_use(faces)
    start, end = half_edges(faces).T
    balance = np.bincount(edge, np.sign(end - start), len(count))
    return bool((count == 2).all() and (balance == 0).all())


def same_places(points: Array) -> tuple[Index, Index]:
    """Return the first point of each group of equal points (g,), and the group (n,) of every point.

    Points (n, 3) are grouped by a hash of their bits, or sorted if it is not unique.
    """
    bits = np.ascontiguousarray(points + 0.0).view(np.uint64)  # -0 becomes 0
    mixed = bits * _ODD
    mixed ^= mixed >> np.uint64(32)
    _, first, place = np.unique((mixed * _ODD).sum(axis=1), return_index=True, return_inverse=True)
    if (bits != bits[first[place]]).any():
        rows = bits.view("V24").reshape(-1)
        _, first, place = np.unique(rows, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return first[order], rank[place.reshape(-1)]


_ODD = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
"""Multipliers of the hash: odd, so that no bit is lost."""


def open_edges(faces: Index) -> Index:
    """Return the directed edges (m, 2) that only one face uses."""
    edge, count = edge_use(faces)
    return half_edges(faces)[count[edge] == 1]


def boundary_loops(vertices: Array, faces: Index) -> list[BoundaryLoop]:
    """Return the loops of open edges, widest first.

    Two holes that share a vertex are two loops. With inconsistent winding a chain that does not
    close is one, too.
    """
    loops = [_measured(vertices, loop) for loop in _traced(open_edges(faces))]
    return sorted(loops, key=lambda loop: -loop.width)


def _traced(edges: Index) -> list[Index]:
    following: dict[int, list[int]] = {}
    for start, end in edges.tolist():
        following.setdefault(start, []).append(end)
    loops: list[Index] = []
    while following:
        path = [next(iter(following))]
        position = {path[0]: 0}
        while path:
            ends = following.get(path[-1])
            if not ends:
                if len(path) > 1:
                    loops.append(np.array(path, np.int64))
                break
            end = ends.pop()
            if not ends:
                del following[path[-1]]
            if end in position:
                start = position[end]
                loops.append(np.array(path[start:], np.int64))
                for vertex in path[start + 1 :]:
                    del position[vertex]
                del path[start + 1 :]
                if end not in following:
                    if start == 0:
                        break
                    continue
            else:
                position[end] = len(path)
                path.append(end)
    return loops


def _measured(vertices: Array, loop: Index) -> BoundaryLoop:
    points = vertices[loop]
    centre = points.mean(axis=0)
    perimeter = float(np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1).sum())
    return BoundaryLoop(loop, centre, _width(points - centre), perimeter)


def _width(points: Array) -> float:
    from scipy.spatial import ConvexHull, QhullError  # slow import, rarely needed

    plane = np.linalg.svd(points, full_matrices=False)[2][:2]
    flat = points @ plane.T
    try:
        hull = flat[ConvexHull(flat).vertices]
    except (QhullError, ValueError):
        return 0.0
    along = np.roll(hull, -1, axis=0) - hull
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return float(np.ptp(hull @ across.T, axis=0).min())


def connected_parts(faces: Index) -> Index:
    """Return the number of the connected part of every face (k,)."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    n = int(faces.max(initial=0)) + 1
    edges = half_edges(faces)
    graph = coo_matrix((np.ones(len(edges), bool), edges.T), shape=(n, n))
    label = connected_components(graph, directed=False)[1]
    return np.unique(label[faces[:, 0]], return_inverse=True)[1].reshape(-1)


def signed_volumes(vertices: Array, faces: Index) -> Array:
    """Return the signed volume (k,), m³, between each face and the centre of the vertices."""
    a, b, c = np.moveaxis(vertices[faces] - vertices.mean(axis=0), 1, 0)
    return np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0


@dataclass(frozen=True, eq=False)
class Body:
    """A connected part of a surface, with the voids within it.

    Args:
        extents: (3,) size of the bounding box, units of the surface, like its `centre`.
        area: area of the outer surface, square units of the surface.
        closed: True if the outer surface has no open edge.
    """

    faces: Index
    extents: Array
    centre: Array
    area: float
    closed: bool


def separate_bodies(vertices: Array, faces: Index) -> list[Body]:
    """Return the bodies of a surface, sorted by the area of the outer surface, largest first.

    A void's normals point into it, so its volume is negative. A closed part is a void of another
    one if its volume is negative and its bounding box lies within the other's. The faces are
    repaired (`tkamb.geometry.repair.repair`).
    """
    label = connected_parts(faces)
    parts = [np.flatnonzero(label == part) for part in range(int(label.max(initial=-1)) + 1)]
    loose = np.unique(open_edges(faces))
    parts_as_bodies = [_body(vertices, faces, part, loose) for part in parts]
    volume = np.bincount(label, signed_volumes(vertices, faces))
    outer = [
        k for k in range(len(parts_as_bodies)) if volume[k] >= 0 or not parts_as_bodies[k].closed
    ]
    contained: dict[int, list[Index]] = {k: [parts_as_bodies[k].faces] for k in outer}
    for k in set(range(len(parts_as_bodies))) - set(outer):
        around = [
            q
            for q in outer
            if parts_as_bodies[q].closed and _within(parts_as_bodies[k], parts_as_bodies[q])
        ]
        contained.setdefault(
            min(around, key=lambda q: parts_as_bodies[q].area, default=k), []
        ).append(parts[k])
    bodies = [
        Body(np.sort(np.concatenate(members)), b.extents, b.centre, b.area, b.closed)
        for b, members in ((parts_as_bodies[k], members) for k, members in contained.items())
    ]
    return sorted(bodies, key=lambda body: -body.area)


def _body(vertices: Array, faces: Index, part: Index, loose: Index) -> Body:
    corners = vertices[faces[part]]
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = float(np.linalg.norm(cross, axis=1).sum() / 2.0)
    closed = not np.isin(faces[part], loose).any()
    return Body(part, high - low, (low + high) / 2.0, area, closed)


def _within(inner: Body, outer: Body) -> bool:
    reach = np.abs(inner.centre - outer.centre) + inner.extents / 2.0
    return bool((reach < outer.extents / 2.0).all())


@dataclass(frozen=True, eq=False)
class Ragged:
    """Rows of different lengths: row r is `items[first[r] : first[r + 1]]`.

    Args:
        first: (n + 1,) start of each row in `items`, then the end of the last row.
        items: (m,) items of all rows, in the order of the rows.
    """

    first: Index
    items: Index

    @classmethod
    def by_key(cls, keys: Index, count: int) -> "Ragged":
        """Return a row for each key from 0 to `count` - 1: the indices of this key in `keys`."""
        order = np.argsort(keys, kind="stable")
        return cls(np.searchsorted(keys[order], np.arange(count + 1)), order)

    def of(self, rows: Index) -> tuple[Index, Index]:
        """Return the index (m,) in `rows` (k,) and the item (m,) of all items of these rows."""
        begin = self.first[rows]
        owner, rank = counted(self.first[rows + 1] - begin)
        return owner, self.items[begin[owner] + rank]


def counted(counts: Index) -> tuple[Index, Index]:
    """Return group and rank within the group of each member; group g has `counts[g]` members."""
    group = np.repeat(np.arange(len(counts)), counts)
    return group, np.arange(len(group)) - (np.cumsum(counts) - counts)[group]
