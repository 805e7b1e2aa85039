"""Winding numbers of points about a closed surface, which decide whether a point is inside.

The winding number of a point is the number of exits of a vertical ray less the number of entries
above the point:

    w = sum of sign(n_y) over the triangles above the point

It is 1 inside a body, 0 outside and in a void, and 2 where two bodies of one file overlap. The two
sides of a wall between touching bodies change it by -1 and +1, so the wall does not count. The
parity of the crossings would be wrong for voids with wrong winding, overlaps and walls.

Positions in the plan view are integers (`PlanGrid`, steps of about 1e-10 m). The signs of the areas
that decide whether a ray passes through a triangle are therefore exact and consistent at edges and
vertices. A ray that meets an edge exactly is moved by an infinitesimal distance to +z, and by a
much smaller one to +x (simulation of simplicity, Edelsbrunner & Muecke, ACM Trans Graph 9:66
(1990), doi:10.1145/77635.77639). The result is correct for all points off the surface.

In a closed surface the sum over the triangles below, with the opposite sign, is equal. If a ray
leaves through a small hole of the mesh, the larger sum is the result.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from tkamb.geometry.compiled import compiled_as_written
from tkamb.geometry.frames import Array, Index, Mask

if TYPE_CHECKING:
    from tkamb.geometry.surface import Surface


# Largest number of buckets of the plan view. Larger: more memory. Not studied.
MAX_BUCKETS = 1_000_000
# Number of bits of the largest integer position. Products of differences fit into
# 63 bits.
PLAN_BITS = 29


@dataclass(frozen=True, eq=False)
class PlanGrid:
    """Conversion of positions in a plane to integers.

    Args:
        middle: (2,) m, position of the integers (0, 0).
        scale: 1/m, integer steps per metre.
    """

    middle: Array
    scale: float

    @classmethod
    def over(cls, plan: Array) -> "PlanGrid":
        """Return the grid over the positions (n, 2) of vertices."""
        low, high = plan.min(axis=0), plan.max(axis=0)
        half = float((high - low).max()) / 2.0
        return cls((low + high) / 2.0, (2**PLAN_BITS - 1) / max(half, 1e-30))

    @property
    def step(self) -> float:
        """Distance between the positions of two neighbouring integers, m."""
        return 1.0 / self.scale

    def whole(self, plan: Array) -> Index:
        """Return positions (n, 2), m, as integers; positions far from the surface are clipped."""
        numbers = np.rint((plan - self.middle) * self.scale)
        return np.clip(numbers, -(2 ** (PLAN_BITS + 1)), 2 ** (PLAN_BITS + 1)).astype(np.int64)


class WindingNumber:
    """Winding numbers of points about one surface.

    The triangles are sorted into rectangular buckets of the plan view (x and z), and a point is
    compared with those in its bucket only.
    """

    def __init__(self, surface: "Surface") -> None:
        self._surface = surface
        self._faces = np.ascontiguousarray(surface.faces, np.int64)
        self._vertices = np.ascontiguousarray(surface.vertices, np.float64)
        self._grid = PlanGrid.over(self._vertices[:, [0, 2]])
        self._plan = self._grid.whole(self._vertices[:, [0, 2]])

    @cached_property
    def _buckets(self) -> tuple[Index, Index, Index, Index, Index]:
        """Lower corner (2,), edge (2,) and number (2,), and their triangles."""
        low = self._plan.min(axis=0)
        per_side = int(np.ceil(np.sqrt(min(max(len(self._faces), 1), MAX_BUCKETS))))
        count = np.array([per_side, per_side], np.int64)
        edge = (self._plan.max(axis=0) - low) // count + 1
        corners = self._plan[self._faces]
        first, last = ((end(axis=1) - low) // edge for end in (corners.min, corners.max))
        starts, items = _sorted_into_buckets(first, last, count)
        return low, edge, count, starts, items

    def at(self, points: Array) -> Index:
        """Return the winding numbers (n,) of points (n, 3), m."""
        points = np.ascontiguousarray(points, np.float64).reshape(-1, 3)
        low, edge, count, starts, items = self._buckets
        plan = self._grid.whole(points[:, [0, 2]])
        bucket = (plan - low) // edge
        outside = ((bucket < 0) | (bucket >= count)).any(axis=1)
        number = np.where(outside, -1, bucket[:, 0] * count[1] + bucket[:, 1])
        return _winding_numbers(
            points, plan, number, starts, items, self._vertices, self._plan, self._faces
        )

    def inside(self, points: Array) -> Mask:
        """Return whether each point (n, 3), m, lies within a body."""
        return self.at(points) > 0


@compiled_as_written
def _sorted_into_buckets(first: Index, last: Index, count: Index) -> tuple[Index, Index]:
    """Return the buckets' starts (b + 1,) in the list of triangles, and this list (m,).

    `first` and `last` (k, 2) are the lowest and highest bucket of each triangle along x and z.
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
def _signed_area(plan: Index, start: int, end: int, x: int, z: int) -> tuple[int, int]:
    """Return twice the signed area of the triangle of an edge and a point, and a sign.

    That of a point on the edge is after its move (module docstring), 0 for an edge without length
    in the plan view.
    """
    du, dv = plan[end, 1] - plan[start, 1], plan[end, 0] - plan[start, 0]
    area = du * (x - plan[start, 0]) - dv * (z - plan[start, 1])
    decisive = area
    if decisive == 0:
        decisive = -dv
    if decisive == 0:
        decisive = du
    return area, (1 if decisive > 0 else (-1 if decisive < 0 else 0))


@compiled_as_written
def _winding_numbers(
    points: Array,
    plan: Index,
    bucket: Index,
    starts: Index,
    items: Index,
    vertices: Array,
    vertex_plan: Index,
    faces: Index,
) -> Index:
    """Return (n,), see `WindingNumber`.

    `plan` and `vertex_plan` (·, 2) are x and z as integers; `bucket` is -1 for a point outside all;
    `starts` (b + 1,) are the buckets' first places in the triangles `items` (m,).
    """
    result = np.zeros(len(points), np.int64)
    for n in range(len(points)):
        if bucket[n] < 0:
            continue
        x, z = plan[n, 0], plan[n, 1]
        above, below = 0, 0
        for place in range(starts[bucket[n]], starts[bucket[n] + 1]):
            a, b, c = faces[items[place], 0], faces[items[place], 1], faces[items[place], 2]
            first, first_sign = _signed_area(vertex_plan, b, c, x, z)
            second, second_sign = _signed_area(vertex_plan, c, a, x, z)
            if first_sign == 0 or second_sign != first_sign:
                continue
            third, third_sign = _signed_area(vertex_plan, a, b, x, z)
            if third_sign != first_sign:
                continue
            # The area in the plan view is not zero, because the ray passes through the triangle.
            height = first * vertices[a, 1] + second * vertices[b, 1] + third * vertices[c, 1]
            height /= float(first) + float(second) + float(third)
            if height > points[n, 1]:
                above += first_sign
            else:
                below -= first_sign
        result[n] = max(above, below)
    return result
