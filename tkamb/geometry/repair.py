"""Repairs of a triangulated surface, with a notice of each, and removal of its inner walls.

Files of CAD systems contain the two-sided wall between touching bodies: a triangle of one side has
the other body's material in front of it. A whole wall of such triangles is removed, and the outer
surfaces of the bodies are joined along its rim: an open edge is divided at the vertices of the
other surface that lie on it. If bodies overlap, or a triangle extends beyond the wall, the wall
stays. Results do not depend on it (`tkamb.geometry.winding`).
"""

from collections import defaultdict
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from tkamb.geometry.frames import Array, Index, Mask
from tkamb.geometry.polygons import ears
from tkamb.geometry.surface import Surface
from tkamb.geometry.topology import (
    BoundaryLoop,
    boundary_loops,
    connected_parts,
    edge_use,
    half_edges,
    is_closed,
    open_edges,
    same_places,
    signed_volumes,
)

# m: distance below which vertices of open edges are merged. Below the facets of a mesh and
# above the rounding of its file.
WELD_DISTANCE = 5e-5
# m: largest width of a hole that is closed by a fan of triangles. About one lattice cell.
GAP_WIDTH = 2e-3
# m: largest width of a hole of three edges that is closed. It may be wider than other holes,
# because it is one missing triangle.
TRIANGLE_WIDTH = 5e-3


@dataclass(frozen=True, eq=False)
class Repair:
    """A repaired surface, with notices.

    Args:
        faces: (k, 3) vertices of the triangles, with consistent winding; outward if closed.
        notices: one phrase per kind of repair; empty without repairs.
        holes: loops that are open after the repair, widest first.
        forks: (m,) vertices of edges that an odd number (3 or more) of faces share.
        one_sided: whether the surface has no consistent winding, like a Möbius strip.
    """

    vertices: Array
    faces: Index
    notices: tuple[str, ...]
    holes: tuple[BoundaryLoop, ...]
    forks: Index
    one_sided: bool


def repair(vertices: Array, faces: Index) -> Repair:
    """Repair duplicate and degenerate faces, winding, cracks, small holes and loose vertices.

    Equal vertices are merged without a notice, because STL triangles have separate vertices. A
    triangle without area but with three corners stays: it closes the surface.
    """
    unused = len(vertices) - int(_used(vertices, faces).sum())
    vertices, faces = _merged(vertices, faces)
    faces, collapsed = _without_collapsed(faces)
    faces, duplicates = _without_duplicates(faces)
    reversed_faces, welded, filled, widest, one_sided = 0, 0, 0, 0.0, False
    closed = is_closed(faces)
    if not closed:
        faces, reversed_faces, one_sided = _wound(vertices, faces)
        faces, welded = _welded(vertices, faces)
        if welded:
            faces, more = _without_collapsed(faces)
            collapsed += more
            faces, more = _without_duplicates(faces)
            duplicates += more
            faces, more, one_sided = _wound(vertices, faces)
            reversed_faces += more
        vertices, faces, filled, widest = _filled(vertices, faces)
    faces, inside_out = _outward(vertices, faces)
    vertices, faces = _referenced(vertices, faces)
    notices = (
        _notice(duplicates, "duplicate face", "removed"),
        _notice(collapsed, "degenerate face", "removed"),
        _notice(reversed_faces, "face", "with flipped winding turned"),
        _notice(inside_out, "face", "of an inside-out body turned"),
        _notice(unused, "unreferenced vertex", "removed"),
        _notice(welded, "open vertex", "welded to a neighbour"),
        _notice(filled, "small hole", f"closed (up to {1e3 * widest:.2g} mm wide)"),
    )
    messages = tuple(notice for notice in notices if notice)
    if closed:
        return Repair(vertices, faces, messages, (), np.empty(0, np.int64), one_sided)
    holes = tuple(boundary_loops(vertices, faces))
    return Repair(vertices, faces, messages, holes, _forks(faces), one_sided)


def _notice(count: int, noun: str, action: str) -> str:
    several = noun.replace("vertex", "vertice") + "s"
    return f"{count} {noun if count == 1 else several} {action}" if count else ""


def _merged(vertices: Array, faces: Index) -> tuple[Array, Index]:
    first, place = same_places(vertices)
    return vertices[first] + 0.0, place[faces]


def _without_collapsed(faces: Index) -> tuple[Index, int]:
    a, b, c = faces.T
    good = (a != b) & (b != c) & (c != a)
    return faces[good], int((~good).sum())


def _without_duplicates(faces: Index) -> tuple[Index, int]:
    """Remove duplicates of a face, and both of an opposite pair; count them."""
    corners = np.sort(faces, axis=1)
    most = int(faces.max(initial=0)) + 1
    _, pair = np.unique(corners[:, 0] * most + corners[:, 1], return_inverse=True)
    _, first, group, count = np.unique(
        pair.reshape(-1) * most + corners[:, 2],
        return_index=True,
        return_inverse=True,
        return_counts=True,
    )
    if (count == 1).all():
        return faces, 0
    group = group.reshape(-1)
    start = np.argmin(faces, axis=1)
    second = faces[np.arange(len(faces)), (start + 1) % 3]
    sign = np.where(second == corners[:, 1], 1, -1)
    net = np.bincount(group, weights=sign, minlength=len(count))
    keep = np.zeros(len(faces), bool)
    keep[first[net != 0]] = True
    agrees = sign == np.sign(net[group])
    for g in np.flatnonzero((count > 1) & (net != 0)):
        members = np.flatnonzero((group == g) & agrees)
        keep[first[g]] = False
        keep[members[0]] = True
    return faces[keep], int((~keep).sum())


def _wound(vertices: Array, faces: Index) -> tuple[Index, int, bool]:
    """Reverse faces so that neighbours have consistent winding; the smaller area is reversed.

    A graph connects the consistent states (original, reversed) of neighbours. Both states of a face
    are in one component only on a one-sided surface. Also returns the number of reversed faces, and
    whether the surface is one-sided.
    """
    k = len(faces)
    edge, count = edge_use(faces)
    directed = half_edges(faces)
    order = np.argsort(edge, kind="stable")
    pairs = order[np.repeat(count == 2, count)].reshape(-1, 2)
    first_face, second_face = pairs[:, 0] // 3, pairs[:, 1] // 3
    differ = directed[pairs[:, 0], 0] == directed[pairs[:, 1], 0]
    rows = np.concatenate([first_face, first_face + k])
    columns = np.concatenate([second_face + k * differ, second_face + k * ~differ])
    graph = coo_matrix((np.ones(len(rows), bool), (rows, columns)), shape=(2 * k, 2 * k))
    labels = connected_components(graph, directed=False)[1]
    forward, backward = labels[:k], labels[k:]
    one_sided = bool((forward == backward).any())
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.bincount(forward, np.linalg.norm(cross, axis=1) + 1e-30, labels.max() + 1)
    flip = (area[backward] > area[forward]) | (
        (area[backward] == area[forward]) & (backward < forward)
    )
    result = faces.copy()
    if not one_sided:
        result[flip] = result[flip][:, ::-1]
    return result, 0 if one_sided else int(flip.sum()), one_sided


def _welded(vertices: Array, faces: Index) -> tuple[Index, int]:
    """Merge vertices of open edges within `WELD_DISTANCE`; count them."""
    loose = np.unique(open_edges(faces))
    if len(loose) == 0:
        return faces, 0
    pairs = cKDTree(vertices[loose]).query_pairs(WELD_DISTANCE, output_type="ndarray")
    if len(pairs) == 0:
        return faces, 0
    graph = coo_matrix((np.ones(len(pairs), bool), pairs.T), shape=(len(loose), len(loose)))
    label = connected_components(graph, directed=False)[1]
    _, first = np.unique(label, return_index=True)
    target = np.arange(len(vertices))
    target[loose] = loose[first[label]]
    return target[faces], int((target != np.arange(len(vertices))).sum())


def _filled(vertices: Array, faces: Index) -> tuple[Array, Index, int, float]:
    """Close small holes: one of three edges by a triangle, another by a fan of triangles.

    Also returns number and largest width (m) of the closed holes.
    """
    new_vertices, new_faces = [vertices], [faces]
    widest, total, filled = 0.0, len(vertices), 0
    for loop in boundary_loops(vertices, faces):
        ring = loop.vertices[::-1]
        if len(ring) < 3 or loop.width > (TRIANGLE_WIDTH if len(ring) == 3 else GAP_WIDTH):
            continue
        if len(ring) == 3:
            new_faces.append(ring[None])
        else:
            new_vertices.append(loop.centre[None])
            fan = np.stack([ring, np.roll(ring, -1), np.full(len(ring), total)], axis=1)
            new_faces.append(fan)
            total += 1
        filled, widest = filled + 1, max(widest, loop.width)
    return np.concatenate(new_vertices), np.concatenate(new_faces), filled, widest


def _outward(vertices: Array, faces: Index) -> tuple[Index, int]:
    """Reverse and count the faces of inside-out bodies, but not those of a void."""
    part = connected_parts(faces)
    volume = np.bincount(part, signed_volumes(vertices, faces))
    if (volume >= 0).all():
        return faces, 0
    open_parts = set(np.unique(part[np.isin(faces, open_edges(faces)).any(axis=1)]))
    boxes = [_box(vertices[faces[part == p]]) for p in range(len(volume))]
    result, reversed_faces = faces.copy(), 0
    for p in np.flatnonzero(volume < 0):
        within = any(
            (boxes[q][0] < boxes[p][0]).all() and (boxes[p][1] < boxes[q][1]).all()
            for q in range(len(volume))
        )
        if p in open_parts or within:
            continue
        members = part == p
        result[members] = result[members][:, ::-1]
        reversed_faces += int(members.sum())
    return result, reversed_faces


def _box(corners: Array) -> tuple[Array, Array]:
    return corners.min(axis=(0, 1)), corners.max(axis=(0, 1))


def _referenced(vertices: Array, faces: Index) -> tuple[Array, Index]:
    used = _used(vertices, faces)
    return vertices[used], (np.cumsum(used) - 1)[faces]


def _used(vertices: Array, faces: Index) -> Mask:
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    return used


def _forks(faces: Index) -> Index:
    edge, count = edge_use(faces)
    odd = (count > 2) & (count % 2 == 1)
    return np.unique(half_edges(faces)[odd[edge]])


# m: distance in front of a triangle at which material is searched. Bodies with a
# wider gap are separate.
PROBE_DISTANCE = 2e-5
# m: distance below which a vertex lies on an open edge. It is above the rounding of
# a mesh.
EDGE_DISTANCE = 1e-6
# m²: smallest area of a wall. Triangles in a narrow corner have less area.
LEAST_AREA = 2e-6


SAMPLES = np.array(
    [[1 / 3, 1 / 3, 1 / 3], [0.8, 0.1, 0.1], [0.1, 0.8, 0.1], [0.1, 0.1, 0.8], [0.45, 0.45, 0.1],
     [0.1, 0.45, 0.45], [0.45, 0.1, 0.45]]
)  # fmt: skip
"""Barycentric coordinates of the points in front of a triangle at which material is searched."""


@dataclass(frozen=True, eq=False)
class InnerWall:
    """A wall inside a surface, and the surface without the wall.

    Args:
        faces: (m,) triangles of both sides of the wall.
        area: m², area of one side.
        centre: (3,) m, centroid of the wall.
        without: vertices and faces of the surface without the wall; None if the wall must stay.
    """

    faces: Index
    area: float
    centre: Array
    without: tuple[Array, Index] | None


def facing_material(surface: Surface, faces: Index) -> Mask:
    """Return whether each triangle (m,) of a closed surface has material on its outer side."""
    points = np.einsum("sc,kcx->ksx", SAMPLES, surface.triangles[faces])
    points += PROBE_DISTANCE * surface.face_normals[faces][:, None]
    within = surface.winding.inside(points.reshape(-1, 3)).reshape(len(faces), -1)
    return np.asarray(within.all(axis=1))


def find_inner_wall(vertices: Array, faces: Index) -> InnerWall | None:
    """Return all walls inside a closed surface as one `InnerWall`; None if there are none.

    If a whole body lies within another one, the result is None, too: the inner body may be a void
    with wrong winding. The faces (k, 3) are wound outward.
    """
    surface = Surface(vertices, faces, merged=True)
    inner_faces = facing_material(surface, np.arange(len(faces)))
    part = connected_parts(faces)
    if len(np.setdiff1d(part, part[~inner_faces])):
        return None
    inner = np.flatnonzero(inner_faces)
    area = surface.areas[inner]
    if area.sum() / 2.0 < LEAST_AREA:
        return None
    centre = area @ surface.triangles[inner].mean(axis=1) / area.sum()
    remaining = _joined_along_rims(vertices, np.delete(faces, inner, axis=0))
    without = None
    if len(remaining) and is_closed(remaining):
        used, number = np.unique(remaining, return_inverse=True)
        without = vertices[used], number.reshape(-1, 3).astype(np.int64)
    return InnerWall(inner, float(area.sum() / 2.0), centre, without)


def touching_groups(vertices: Array, bodies: list[Index], faces: Index, wall: Index) -> int:
    """Return the number of groups of touching or overlapping bodies; `wall` are inner walls."""
    group = list(range(len(bodies)))
    skins = [Surface(vertices, faces[body], merged=True) for body in bodies]
    for a, body in enumerate(bodies):
        part = np.intersect1d(body, wall)
        if not len(part):
            continue
        wall_part = Surface(vertices, faces[part], merged=True)
        points = wall_part.triangles.mean(axis=1) + PROBE_DISTANCE * wall_part.face_normals
        for b in range(len(bodies)):
            if group[a] != group[b] and skins[b].winding.inside(points).any():
                group = [group[a] if each == group[b] else each for each in group]
    return len(set(group))


def _joined_along_rims(vertices: Array, faces: Index) -> Index:
    """Divide open edges at the open vertices that lie on them."""
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
        near = loose[tree.query_ball_point(middle, length / 2.0 + EDGE_DISTANCE)]
        near = near[(near != start) & (near != end)]
        share = (vertices[near] - vertices[start]) @ along / length**2
        distance = np.linalg.norm(vertices[near] - vertices[start] - share[:, None] * along, axis=1)
        dividing_vertices = (
            (distance < EDGE_DISTANCE)
            & (share * length > EDGE_DISTANCE)
            & ((1 - share) * length > EDGE_DISTANCE)
        )
        if dividing_vertices.any():
            dividing[int(start), int(end)] = near[dividing_vertices][
                np.argsort(share[dividing_vertices])
            ]
    return _divided(vertices, faces, dividing)


def _divided(vertices: Array, faces: Index, dividing: dict[tuple[int, int], Index]) -> Index:
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
