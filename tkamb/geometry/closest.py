"""Closest points of the femoral condyles and the insert, and the gap between them."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import fcl
import numpy as np

from tkamb.geometry.compiled import compiled_as_written
from tkamb.geometry.condyles import CONDYLE, condyle_faces
from tkamb.geometry.first_touch import FirstTouch
from tkamb.geometry.frames import Array, Index, inverse, rotate, transform
from tkamb.geometry.nearest import NearestPoints, sampled
from tkamb.geometry.surface import Surface
from tkamb.units import MILLIMETRE

# m: edge of a cell. About the edge of a mesh's triangles.
CELL_EDGE = 1e-3
# Largest number of cells along an edge of the grid; a larger surface gets larger cells.
# It limits memory.
MOST_CELLS = 400
# Number of cells along x or z. Triangles that span more are processed one by one.
# Such triangles are few.
WIDE_TRIANGLE_CELLS = 4
# 1: largest slope of a plane that bounds the height. The bound of a steeper plane
# is loose.
LARGEST_SLOPE = 3.0


class HeightBound:
    """An upper bound of a surface's height: one plane per cell of an x-z grid.

        y <= c + g . (x, z)      for every upward triangle over the cell

    g is the mean slope over the cell. On a slope the plane is closer to the surface than the
    largest height of the cell.
    """

    def __init__(self, surface: Surface) -> None:
        low, high = surface.bounds[:, [0, 2]]
        self._origin = low
        self._edge = max(CELL_EDGE, float((high - low).max()) / MOST_CELLS)
        self._last = ((high - low) // self._edge).astype(np.int64)
        self._cells = self._cell_planes(surface)

    def over(self, points: Array) -> Array:
        """Return a height (n,), m, that the surface over the points (n, 3) does not exceed."""
        xz = points[:, [0, 2]]
        plane = self._cells[tuple(self._place(xz).T)]
        return np.einsum("ij,ij->i", plane[:, :2], xz) + plane[:, 2]

    def _place(self, xz: Array) -> Index:
        index = np.floor((xz - self._origin) / self._edge).astype(np.int64)
        return np.clip(index, 0, self._last)

    def _cell_planes(self, surface: Surface) -> Array:
        """Return each cell's plane, (i, j, 3): g along x and z, and c (m)."""
        faces = surface.faces[surface.face_normals[:, 1] > 0]
        triangles = surface.vertices[faces]
        a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
        area, xz, heights = np.cross(b - a, c - a), triangles[:, :, [0, 2]], triangles[:, :, 1]
        covered = list(self._covered(xz.min(axis=1), xz.max(axis=1)))
        total = np.zeros((*(self._last + 1), 3))
        for chosen, cells in covered:
            np.add.at(total, cells, area[chosen])
        planes = np.full(total.shape, -np.inf)
        upward = np.maximum(total[..., 1:2], 1e-300)
        planes[..., :2] = np.clip(-total[..., ::2] / upward, -LARGEST_SLOPE, LARGEST_SLOPE)
        for chosen, cells in covered:
            rise = (planes[cells][:, None, :2] * xz[chosen]).sum(axis=2)
            np.maximum.at(planes[..., 2], cells, (heights[chosen] - rise).max(axis=1))
        return planes

    def _covered(self, low: Array, high: Array) -> Iterator[tuple[Index, tuple[Index, Index]]]:
        """Yield, in parts, all pairs (m,): a rectangle and a cell that it covers.

        `low` and `high` (n, 2), m, are the rectangles' smallest and largest x and z.
        """
        first, last = self._place(low), self._place(high)
        wide = (last - first >= WIDE_TRIANGLE_CELLS).any(axis=1)
        for t in np.flatnonzero(wide):
            rows, columns = (np.arange(first[t, k], last[t, k] + 1) for k in (0, 1))
            cells = np.repeat(rows, len(columns)), np.tile(columns, len(rows))
            yield np.full(len(cells[0]), t), cells
        small = np.flatnonzero(~wide)
        first, last = first[small], last[small]
        for i in range(WIDE_TRIANGLE_CELLS):
            for j in range(WIDE_TRIANGLE_CELLS):
                inside = (first[:, 0] + i <= last[:, 0]) & (first[:, 1] + j <= last[:, 1])
                yield small[inside], (first[inside, 0] + i, first[inside, 1] + j)


@dataclass(frozen=True)
class ClosestPointSettings:
    """The search for the closest points of two surfaces."""

    region_radius: float = 1.6e-2
    """m: largest distance of a point of the close region from the closest point. A
    condyle's contact is smaller."""
    facing_cosine: float = 0.7
    """1: cosine of the angle between the surfaces above which they face each other.
    Surfaces at more than 45 deg do not touch face to face."""
    clearance: float = 1e-6
    """m: a point this much above the bound of the insert's height is outside. It is above the
    rounding of a mesh.
    """
    gap_range: float = 10 * CONDYLE.facet_depth
    """m: largest excess of a sample's gap over the smallest gap. The weight of a
    farther sample is below 5e-5."""
    rounds: int = 3
    """Number of times that the triangles around the deepest point are divided into four."""
    kept_candidates: int = 8
    """Vertices or triangles with which the search of the deepest point continues. It is among them.
    """
    batch_size: int = 64
    """Vertices whose depth is computed together, and most intersecting triangles that are examined.
    """


CLOSEST_POINT = ClosestPointSettings()


@dataclass(frozen=True, eq=False)
class CondyleGap:
    """The gap of one condyle, insert frame.

    Args:
        gap: m, distance of the closest points; for an overlap the depth of the deepest femoral
            point below the insert's surface, negative.
        point_on_femoral: (3,) m, closest or deepest.
        point_on_insert: (3,) m, closest.
        centre: (3,) m, on the insert, centre of the close region (`_CloseRegion`).
        normal: (3,) unit, from the insert to the femur, mean of the insert's vertex normals over
            the close region.
    """

    gap: float
    point_on_femoral: Array
    point_on_insert: Array
    centre: Array
    normal: Array


@dataclass(frozen=True, eq=False)
class CondyleGaps:
    """The gaps of both condyles; `lateral` is None without a second condyle."""

    medial: CondyleGap
    lateral: CondyleGap | None


class ClosestPointQuery:
    """Closest points of one pair of bodies, prepared for many poses.

    The gap is the smallest signed distance of the condyle's surface to the insert, continuous
    through touch. Apart, it is the exact distance of the two triangulated surfaces (python-fcl). If
    they overlap, the search finds the deepest femoral vertices and divides the triangles around
    them to 1/8 of an edge, which resolves about 1 µm of depth on implants.

    The normal is the mean over the close region, because it turns smoothly as the contact moves.

    Args:
        split: z (m, femoral frame) between the condyles; None for one condyle.
    """

    def __init__(self, femoral: Surface, insert: Surface, split: float | None) -> None:
        self.femoral, self.insert, self.split = femoral, insert, split
        self._nearest = insert.nearest
        self._ceiling = HeightBound(insert)
        medial, lateral = condyle_faces(femoral, split)
        self._condyles = [_Condyle(femoral, faces) for faces in (medial, lateral) if len(faces)]

    @cached_property
    def _insert_tree(self) -> fcl.BVHModel:
        return _tree(self.insert, np.arange(len(self.insert.faces)))

    @cached_property
    def first_touch(self) -> FirstTouch:
        """Query of the travel along -y after which each condyle touches the insert."""
        return FirstTouch(self.femoral, self.insert, self.split)

    def at(self, pose_femoral_in_insert: Array) -> CondyleGaps:
        """Return the gaps at a pose (4, 4)."""
        pose = np.asarray(pose_femoral_in_insert, float)
        gaps = [self._gap(condyle, pose) for condyle in self._condyles]
        return CondyleGaps(gaps[0], gaps[1] if len(gaps) > 1 else None)

    def _gap(self, condyle: "_Condyle", pose: Array) -> CondyleGap:
        gap, on_femoral, on_insert = self._closest(condyle, pose)
        centre, normal = condyle.region.centre(self._nearest, pose, gap, on_femoral)
        return CondyleGap(gap, on_femoral, on_insert, centre, normal)

    def _closest(self, condyle: "_Condyle", pose: Array) -> tuple[float, Array, Array]:
        deepest = self._deepest_vertices(condyle, pose)
        if len(deepest):
            return self._refined(condyle.around(deepest), pose)
        gap, on_femoral, on_insert = self._apart(condyle, pose)
        if gap > 0:
            return gap, on_femoral, on_insert
        return self._refined(self._touching(condyle, pose), pose)

    def _apart(self, condyle: "_Condyle", pose: Array) -> tuple[float, Array, Array]:
        request = fcl.DistanceRequest(enable_nearest_points=True)
        result = fcl.DistanceResult()
        femoral, insert = condyle.placed(pose), fcl.CollisionObject(self._insert_tree)
        distance = fcl.distance(femoral, insert, request, result)
        on_femoral, on_insert = (np.asarray(point) * MILLIMETRE for point in result.nearest_points)
        return float(distance) * MILLIMETRE, on_femoral, on_insert

    def _touching(self, condyle: "_Condyle", pose: Array) -> Index:
        """Return triangles that touch the insert; else those at the nearest vertex."""
        request = fcl.CollisionRequest(
            num_max_contacts=CLOSEST_POINT.batch_size, enable_contact=True
        )
        result = fcl.CollisionResult()
        fcl.collide(condyle.placed(pose), fcl.CollisionObject(self._insert_tree), request, result)
        if result.contacts:
            return condyle.faces[np.unique([contact.b1 for contact in result.contacts])]
        distance = self._nearest.at(transform(pose, condyle.points)).distance
        return condyle.around(condyle.vertices[[np.argmin(distance)]])

    def _deepest_vertices(self, condyle: "_Condyle", pose: Array) -> Index:
        """Return the `kept_candidates` deepest vertices inside the insert, deepest first.

        Vertices are evaluated in the order of the depth along y, an upper bound.
        """
        near, points = _within_box(condyle.points, pose, *self.insert.bounds)
        under = points[:, 1] < self._ceiling.over(points) + CLOSEST_POINT.clearance
        near, points = near[under], points[under]
        below = self._depth_along_y(points)
        order = np.argsort(-below)
        order = order[below[order] > 0]
        depth = np.zeros(0)
        for start in range(0, len(order), CLOSEST_POINT.batch_size):
            batch = order[start : start + CLOSEST_POINT.batch_size]
            if len(depth) and below[batch[0]] < depth.max():
                break
            depth = np.append(depth, self._nearest.at(points[batch]).distance)
        return condyle.vertices[near[order[np.argsort(-depth)[: CLOSEST_POINT.kept_candidates]]]]

    def _depth_along_y(self, points: Array) -> Array:
        """Return the distance (n,), m, along +y to the insert's surface; 0 outside."""
        distance, face = self.insert.rays.first(points, np.array([0.0, 1.0, 0.0]))
        inside = (face >= 0) & (self.insert.face_normals[face, 1] > 0)
        return np.where(inside, distance, 0.0)

    def _refined(self, faces: Index, pose: Array) -> tuple[float, Array, Array]:
        """Return gap (m), deepest point of triangles, and its insert point."""
        corners = self.femoral.triangles[faces]
        triangles = transform(pose, corners.reshape(-1, 3)).reshape(-1, 3, 3)
        _, first = np.unique(self.femoral.faces[faces], return_index=True)
        points = triangles.reshape(-1, 3)[first]  # a corner shared by triangles appears once
        for _ in range(CLOSEST_POINT.rounds):
            triangles = _quartered(triangles)
            near = self._nearest.at(triangles.mean(axis=1))
            side = np.einsum("ij,ij->i", triangles.mean(axis=1) - near.points, near.normals)
            triangles = triangles[
                np.argsort(np.sign(side) * near.distance)[: CLOSEST_POINT.kept_candidates]
            ]
        points = np.concatenate([points, triangles.reshape(-1, 3), triangles.mean(axis=1)])
        gaps, feet = self._signed_gaps(points)
        best = int(np.argmin(gaps))
        return float(gaps[best]), points[best], feet[best]

    def _signed_gaps(self, points: Array) -> tuple[Array, Array]:
        near = self._nearest.at(points)
        inside = self._depth_along_y(points) > 0
        return np.where(inside, -near.distance, near.distance), near.points


class _Condyle:
    def __init__(self, femoral: Surface, faces: Index) -> None:
        self.faces, self._femoral = faces, femoral
        self.vertices = np.unique(femoral.faces[faces])
        self.points = femoral.vertices[self.vertices]
        self.region = _CloseRegion(femoral, faces)
        corners = femoral.faces[faces].ravel()
        self._by_vertex = np.argsort(corners, kind="stable")
        self._edges = np.searchsorted(corners[self._by_vertex], np.arange(corners.max() + 2))

    @cached_property
    def tree(self) -> fcl.BVHModel:
        return _tree(self._femoral, self.faces)

    def placed(self, pose: Array) -> fcl.CollisionObject:
        place = fcl.Transform(pose[:3, :3], pose[:3, 3] / MILLIMETRE)
        return fcl.CollisionObject(self.tree, place)

    def around(self, vertices: Index) -> Index:
        corners = [self._by_vertex[self._edges[v] : self._edges[v + 1]] for v in vertices.tolist()]
        return self.faces[np.unique(np.concatenate(corners) // 3)]


class _CloseRegion:
    """Part of one body's surface, prepared to find the close region on another body.

    On conforming surfaces the closest point of two meshes moves by millimetres from pose to pose,
    although the gap changes by a few micrometres. The centre of the close region moves smoothly:

        c = sum w_i p_i / sum w_i,   w_i = A_i exp(-(g_i - g) / d)

    Sample i has the area A_i, the signed gap g_i and the nearest point p_i on the other body; g is
    the smallest gap and d the depth of a facet (`CONDYLE.facet_depth`). If the gap has a sharp
    minimum, the centre is the closest point.

    `faces` (k,) are the triangles of the part.
    """

    def __init__(self, surface: Surface, faces: Index) -> None:
        part = Surface(surface.vertices, surface.faces[faces], surface.name)
        samples, owner, areas = sampled(part, CONDYLE.sample_spacing)
        first, self._areas = _thinned(samples, areas)
        self._samples, self._normals = samples[first], part.face_normals[owner[first]]

    def centre(
        self, other: NearestPoints, pose: Array, gap: float, closest: Array
    ) -> tuple[Array, Array]:
        """Return centre (3,), m, and mean unit normal (3,) on the other body.

        Both are in the other body's frame, like `closest` (3,), m, this body's point with the
        smallest signed `gap` (m). `pose` (4, 4) is this body in the other body's frame.
        """
        place = transform(inverse(pose), closest)
        near = _facing_alike(self._samples, self._normals, place, CLOSEST_POINT.region_radius)
        points = np.concatenate([transform(pose, self._samples[near]), closest[None]])
        within, nearest = other.within(points, abs(gap) + CLOSEST_POINT.gap_range)
        near, points = near[within[:-1]], points[within[:-1]]
        facing = -np.einsum("ij,ij->i", rotate(pose, self._normals[near]), nearest.normals[:-1])
        above = np.einsum("ij,ij->i", points - nearest.points[:-1], nearest.normals[:-1])
        excess = np.where(above < 0, -1, 1) * nearest.distance[:-1] - gap
        excess = np.where(excess < -CONDYLE.facet_depth, np.inf, np.maximum(excess, 0.0))
        weights = (
            self._areas[near]
            * (facing > CLOSEST_POINT.facing_cosine)
            * np.exp(-excess / CONDYLE.facet_depth)
        )
        weights = np.append(weights, self._areas.mean())
        mean = weights @ nearest.normals
        centre = other.at((weights @ nearest.points / weights.sum())[None]).points[0]
        return centre, mean / np.linalg.norm(mean)


def _thinned(samples: Array, areas: Array) -> tuple[Index, Array]:
    """Return one sample (m,) per cube of the sample spacing, with its area (m,)."""
    cubes = np.floor(samples / CONDYLE.sample_spacing).astype(np.int64)
    cubes -= cubes.min(axis=0)
    number = np.ravel_multi_index(tuple(cubes.T), tuple(cubes.max(axis=0) + 1))
    order = np.argsort(-areas, kind="stable")
    _, first, cube = np.unique(number[order], return_index=True, return_inverse=True)
    total = np.bincount(cube.reshape(-1), areas[order])
    return order[first].astype(np.int64), np.asarray(total, np.float64)


def _tree(surface: Surface, faces: Index) -> fcl.BVHModel:
    """Return the fcl tree of triangles, in millimetres.

    fcl has absolute tolerances: in metres it reports contact of small triangles 30 µm apart.
    """
    model = fcl.BVHModel()
    model.beginModel(len(surface.vertices), len(faces))
    model.addSubModel(surface.vertices / MILLIMETRE, surface.faces[faces])
    model.endModel()
    return model


@compiled_as_written
def _within_box(points: Array, pose: Array, low: Array, high: Array) -> tuple[Index, Array]:
    inside, places, count = np.empty(len(points), np.int64), np.empty((len(points), 3)), 0
    for i in range(len(points)):
        within = True
        for axis in (1, 0, 2):  # most of a condyle is above the insert
            place = pose[axis, 3]
            for k in range(3):
                place += pose[axis, k] * points[i, k]
            places[count, axis] = place
            if not low[axis] < place < high[axis]:
                within = False
                break
        if within:
            inside[count] = i
            count += 1
    return inside[:count].copy(), places[:count].copy()


@compiled_as_written
def _facing_alike(samples: Array, normals: Array, place: Array, radius: float) -> Index:
    """Return the samples within `radius` (m) whose normals are within 60 deg of the nearest's."""
    square, nearest = np.empty(len(samples)), 0
    for i in range(len(samples)):
        x, y, z = samples[i, 0] - place[0], samples[i, 1] - place[1], samples[i, 2] - place[2]
        square[i] = x * x + y * y + z * z
        if square[i] < square[nearest]:
            nearest = i
    normal, alike_samples, count = normals[nearest], np.empty(len(samples), np.int64), 0
    for i in range(len(samples)):
        if square[i] <= radius * radius:
            alike = (
                normals[i, 0] * normal[0] + normals[i, 1] * normal[1] + normals[i, 2] * normal[2]
            )
            if alike > 0.5:
                alike_samples[count] = i
                count += 1
    return alike_samples[:count].copy()


@compiled_as_written
def _quartered(triangles: Array) -> Array:
    count = len(triangles)
    parts = np.empty((4 * count, 3, 3))
    for k in range(count):
        for axis in range(3):
            a, b, c = triangles[k, 0, axis], triangles[k, 1, axis], triangles[k, 2, axis]
            ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
            for part, corners in enumerate(((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))):
                for corner in range(3):
                    parts[part * count + k, corner, axis] = corners[corner]
    return parts
