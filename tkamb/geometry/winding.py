"""How often a closed surface winds around points: what is inside, whatever the mesh is like.

A vertical ray leaves a body through a triangle that faces up and enters it through one that faces
down. The winding number of a point is the number of exits less the number of entries above it:

    w = sum of sign(n_y) over the triangles above the point

It is 1 inside a body, 0 outside and in a void, and 2 where two bodies of one file overlap. A wall
between two touching bodies changes it by -1 and +1 at one place, so that the wall does not count.
(The number of crossings alone, even or odd, gets all three wrong.)

No ray hangs on a tie. Whether it passes a triangle is decided by three signed areas. Each is
computed from the two ends of an edge in one fixed order, so that neighbouring triangles agree to
the last bit. A ray that meets an edge exactly is moved by an infinitesimal to +x and +z
(simulation of simplicity, Edelsbrunner & Muecke, ACM Trans Graph 9:66 (1990),
doi:10.1145/77635.77639). So the answer is wrong nowhere but for points that lie on the surface
itself, where there is none.

A ray may leave through a small hole in the mesh unseen. Then the count of the triangles above
differs from that of the triangles below, which must be equal in a closed surface; the larger one
is taken.
"""

from functools import cached_property

import numpy as np

from tkamb.compiled import compiled_as_written
from tkamb.geometry.frames import Array, Index, Mask
from tkamb.geometry.surface import Surface

MAX_BUCKETS = 1_000_000
"""Of the plan view, in all; more cost memory and gain nothing."""


class WindingNumber:
    """Winding numbers of points about one surface.

    The triangles are sorted into rectangular buckets of the plan view (x and z). A point is
    compared only with the triangles in its bucket.

    Args:
        surface: closed, outward normals, any frame whose y is vertical.
    """

    def __init__(self, surface: Surface) -> None:
        self._surface = surface
        self._faces = np.ascontiguousarray(surface.faces, np.int64)
        self._vertices = np.ascontiguousarray(surface.vertices, np.float64)

    @cached_property
    def _buckets(self) -> tuple[Array, Array, Index, Index, Index]:
        """Lower corner (2,), edge (2,) and number (2,) of the buckets; their triangles."""
        plan = self._vertices[:, [0, 2]]
        low, high = plan.min(axis=0), plan.max(axis=0)
        per_side = int(np.ceil(np.sqrt(min(max(len(self._faces), 1), MAX_BUCKETS))))
        count = np.array([per_side, per_side], np.int64)
        edge = np.maximum(high - low, 1e-30) / count
        corners = plan[self._faces]
        first = self._bucket_of(corners.min(axis=1), low, edge, count)
        last = self._bucket_of(corners.max(axis=1), low, edge, count)
        starts, items = _sorted_into_buckets(first, last, count)
        return low, edge, count, starts, items

    @staticmethod
    def _bucket_of(plan: Array, low: Array, edge: Array, count: Index) -> Index:
        """Return the bucket (n, 2) of points of the plan view; monotonic, so nothing is missed."""
        return np.clip(np.floor((plan - low) / edge).astype(np.int64), 0, count - 1)

    def at(self, points: Array) -> Index:
        """Return the winding numbers (n,) of points (n, 3), m."""
        points = np.ascontiguousarray(points, np.float64)
        low, edge, count, starts, items = self._buckets
        bucket = self._bucket_of(points[:, [0, 2]], low, edge, count)
        return _winding_numbers(
            points, bucket[:, 0] * count[1] + bucket[:, 1], starts, items,
            self._vertices, self._faces,
        )  # fmt: skip

    def inside(self, points: Array) -> Mask:
        """Say which points (n, 3) lie within a body."""
        return self.at(points) > 0


@compiled_as_written
def _sorted_into_buckets(first: Index, last: Index, count: Index) -> tuple[Index, Index]:
    """Return where each bucket's triangles begin (b + 1,), and the triangles.

    Args:
        first: (k, 2) lowest bucket of each triangle along x and z.
        last: (k, 2) highest.
        count: (2,) buckets along x and z.
    """
    starts = np.zeros(count[0] * count[1] + 1, np.int64)
    for face in range(len(first)):
        for i in range(first[face, 0], last[face, 0] + 1):
            for k in range(first[face, 1], last[face, 1] + 1):
                starts[i * count[1] + k + 1] += 1
    starts = np.cumsum(starts)
    items, filled = np.empty(starts[-1], np.int64), starts[:-1].copy()
    for face in range(len(first)):
        for i in range(first[face, 0], last[face, 0] + 1):
            for k in range(first[face, 1], last[face, 1] + 1):
                bucket = i * count[1] + k
                items[filled[bucket]] = face
                filled[bucket] += 1
    return starts, items


@compiled_as_written
def _signed_area(vertices: Array, start: int, end: int, x: float, z: float) -> tuple[float, int]:
    """Return twice the signed area of an edge and a point of the plan view, and its sign.

    The sign is never 0: a point on the edge counts as moved by an infinitesimal to +z, and by
    a much smaller one to +x.
    """
    turned = start > end
    if turned:
        start, end = end, start
    u, v = vertices[start, 2], vertices[start, 0]
    du, dv = vertices[end, 2] - u, vertices[end, 0] - v
    value = du * (x - v) - dv * (z - u)
    # the first of these that is not 0: for a point moved by (e, e²) along z and x
    decisive = value
    if decisive == 0.0:
        decisive = -dv
    if decisive == 0.0:
        decisive = du
    sign = 1 if decisive > 0.0 else (-1 if decisive < 0.0 else 0)
    if turned:
        return -value, -sign
    return value, sign


@compiled_as_written
def _winding_numbers(
    points: Array, bucket: Index, starts: Index, items: Index, vertices: Array, faces: Index
) -> Index:
    """Return the winding numbers (n,) of points, see `WindingNumber`.

    Args:
        points: (n, 3) m.
        bucket: (n,) of each.
        starts: (b + 1,) where each bucket's triangles begin.
        items: (m,) triangles.
        vertices: (v, 3) m.
        faces: (k, 3).
    """
    result = np.zeros(len(points), np.int64)
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        above, below = 0, 0
        for place in range(starts[bucket[n]], starts[bucket[n] + 1]):
            a, b, c = faces[items[place], 0], faces[items[place], 1], faces[items[place], 2]
            first, side = _signed_area(vertices, b, c, x, z)
            second, other = _signed_area(vertices, c, a, x, z)
            if side == 0 or other != side:
                continue
            third, last = _signed_area(vertices, a, b, x, z)
            if last != side:
                continue
            total = first + second + third
            if total != 0.0:
                height = first * vertices[a, 1] + second * vertices[b, 1] + third * vertices[c, 1]
                height /= total
            else:
                height = max(vertices[a, 1], vertices[b, 1], vertices[c, 1])
            if height > y:
                above += side
            else:
                below -= side
        result[n] = max(above, below)
    return result
