"""The travel of the femoral component along -y until it first touches the insert."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from tkamb.geometry.compiled import compiled_as_written
from tkamb.geometry.condyles import condyle_faces
from tkamb.geometry.frames import Array
from tkamb.geometry.nearest import TriangleTree
from tkamb.geometry.surface import Surface

STEEP = 1e-9
"""1: ratio of a triangle's area in the plan view to its area below which it is a wall and skipped.
Its edges are those of its neighbours.
"""
FACING = 0.2
"""1: smallest vertical component of a mean normal with which its plane is used as a bound."""
ROUNDING = 1e-12
"""m: rounding error of a plane's height."""
MOST_WAITING = 256
"""Most pairs of boxes on the stack: two for each level of both trees."""
MOST_CORNERS = 9
"""Most corners of a triangle cut by another one: six, and up to nine by rounding."""


@dataclass(frozen=True, eq=False)
class Touch:
    """First touch of one condyle with the insert.

    Args:
        travel: m, distance along -y until the condyle touches; negative if it overlaps the insert.
        point: (3,) m, insert frame, contact point on the insert.
    """

    travel: float
    point: Array


class FirstTouch:
    """Vertical clearance between two triangulated surfaces, exact for their triangles.

    The clearance of two triangles is the smallest difference of their heights over the polygon that
    both cover in the plan view; the difference is linear, so it is smallest at a corner. Pairs of
    boxes and triangles without a smaller clearance than the smallest so far are skipped.

    `split` is z (m, femoral frame) between the condyles (None: one condyle, medial); a triangle's
    centroid decides its side.
    """

    def __init__(self, femoral: Surface, insert: Surface, split: float | None = None) -> None:
        self._femoral, self._split = femoral, split
        self._insert = _arrays(insert.upward_tree)

    @cached_property
    def _whole(self) -> tuple[Array, Array, Array]:
        return _arrays(self._femoral.tree)

    @cached_property
    def _condyles(self) -> list[tuple[Array, Array, Array] | None]:
        sides = condyle_faces(self._femoral, self._split)
        return [
            _arrays(TriangleTree(self._femoral, faces)) if len(faces) else None for faces in sides
        ]

    def at(self, pose: ArrayLike) -> tuple[Touch | None, Touch | None]:
        """Return the touch of the medial and of the lateral condyle.

        A touch is None if no part of that condyle lies over the insert, or `pose`,
        pose_femoral_in_insert (4, 4), is not finite.
        """
        pose = np.asarray(pose, float)
        if self._split is None:
            return self._touch(pose, self._whole), None
        medial, lateral = self._condyles
        return self._touch(pose, medial), self._touch(pose, lateral)

    def travel(self, pose: ArrayLike) -> float:
        """Return the travel (m) until either condyle touches; NaN if none lies over the insert."""
        touch = self.either(pose)
        return float("nan") if touch is None else touch.travel

    def either(self, pose: ArrayLike) -> Touch | None:
        """Return the first touch of either condyle; None if none lies over the insert."""
        return self._touch(np.asarray(pose, float), self._whole)

    def _touch(self, pose: Array, part: tuple[Array, Array, Array] | None) -> Touch | None:
        if part is None or not np.isfinite(pose).all():
            return None
        rotation, translation = np.ascontiguousarray(pose[:3, :3]), pose[:3, 3].copy()
        travel, point = _least_clearance(*part, *self._insert, rotation, translation)
        return Touch(travel, point) if np.isfinite(travel) else None


def _arrays(tree: TriangleTree) -> tuple[Array, Array, Array]:
    return tree.boxes, tree.supports, tree.corners


@compiled_as_written
def _turned_box(box: Array, rotation: Array, translation: Array, result: Array) -> None:
    for i in range(3):
        middle, half = translation[i], 0.0
        for j in range(3):
            middle += 0.5 * rotation[i, j] * (box[j] + box[j + 3])
            half += 0.5 * abs(rotation[i, j]) * (box[j + 3] - box[j])
        result[i], result[i + 3] = middle - half, middle + half


@compiled_as_written
def _bound(
    upper: Array,
    lower: Array,
    upper_support: Array,
    lower_support: Array,
    rotation: Array,
    translation: Array,
) -> float:
    """Return a lower bound (m) of the clearance of two boxes' triangles.

    It is the larger of the boxes' clearance and of their planes' over the rectangle that both
    cover; inf if they do not overlap in the plan view. Boxes (6,) are in the lower body's frame,
    planes (4,) (`TriangleTree.supports`) each in its own; the pose is the upper frame in the lower.
    """
    x0, x1 = max(upper[0], lower[0]), min(upper[3], lower[3])
    z0, z1 = max(upper[2], lower[2]), min(upper[5], lower[5])
    if x0 > x1 or z0 > z1:
        return np.inf
    bound, offset = upper[1] - lower[4], upper_support[3]
    nx, ny, nz = 0.0, 0.0, 0.0
    for k in range(3):
        nx += rotation[0, k] * upper_support[k]
        ny += rotation[1, k] * upper_support[k]
        nz += rotation[2, k] * upper_support[k]
    if ny < -FACING and lower_support[1] > FACING:
        offset += nx * translation[0] + ny * translation[1] + nz * translation[2]
        mx, my, mz = lower_support[0], lower_support[1], lower_support[2]
        a, b = mx / my - nx / ny, mz / my - nz / ny
        between = offset / ny - lower_support[3] / my
        between += min(a * x0, a * x1) + min(b * z0, b * z1) - ROUNDING
        bound = max(bound, between)
    return bound


@compiled_as_written
def _plane(corners: Array) -> tuple[float, float, float, float]:
    """Return h, a and b of a triangle's (9,) plane y = h + a x + b z, and a signed area.

    The area is twice that in the plan view, m²; negative if the triangle faces down, zero for a
    wall.
    """
    ux, uy, uz = corners[3] - corners[0], corners[4] - corners[1], corners[5] - corners[2]
    vx, vy, vz = corners[6] - corners[0], corners[7] - corners[1], corners[8] - corners[2]
    x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    if abs(y) <= STEEP * np.sqrt(x * x + y * y + z * z):
        return np.nan, np.nan, np.nan, 0.0
    a, b = -x / y, -z / y
    return corners[1] - a * corners[0] - b * corners[2], a, b, y


@compiled_as_written
def _over(upper: Array, lower: Array) -> bool:
    for axis in (0, 2):
        a, b, c = upper[axis], upper[axis + 3], upper[axis + 6]
        d, e, f = lower[axis], lower[axis + 3], lower[axis + 6]
        if max(a, b, c) < min(d, e, f) or max(d, e, f) < min(a, b, c):
            return False
    return True


@compiled_as_written
def _beyond(upper: Array, plane: tuple[float, float, float, float]) -> float:
    """Return the smallest height (m) of corners (9,) above a plane."""
    least = np.inf
    for corner in range(0, 9, 3):
        height = plane[0] + plane[1] * upper[corner] + plane[2] * upper[corner + 2]
        least = min(least, upper[corner + 1] - height)
    return least


@compiled_as_written
def _cut(
    polygon: Array,
    count: int,
    inside: Array,
    ax: float,
    az: float,
    bx: float,
    bz: float,
    way: float,
) -> int:
    """Write a polygon's part beside the line from a to b; return its corner count.

    A corner (3,) is x, z and clearance, m; `way`, 1 or -1, selects the side.
    """
    number = 0
    for corner in range(count):
        following = (corner + 1) % count
        first = way * (
            (bx - ax) * (polygon[corner, 1] - az) - (bz - az) * (polygon[corner, 0] - ax)
        )
        second = way * (
            (bx - ax) * (polygon[following, 1] - az) - (bz - az) * (polygon[following, 0] - ax)
        )
        if first >= 0.0:
            inside[number] = polygon[corner]
            number += 1
        if (first > 0.0 and second < 0.0) or (first < 0.0 and second > 0.0):
            share = first / (first - second)
            for k in range(3):
                inside[number, k] = polygon[corner, k] + share * (
                    polygon[following, k] - polygon[corner, k]
                )
            number += 1
    return number


@compiled_as_written
def _over_each_other(
    upper: Array,
    lower: Array,
    plane: tuple[float, float, float, float],
    best: float,
    polygon: Array,
    spare: Array,
    point: Array,
) -> float:
    """Return the smaller of two triangles' clearance (m) and `best`, the smallest so far.

    Corners `upper` and `lower` (9,), m, are in the lower body's frame; `plane` is that of `lower`
    (`_plane`), its area is not zero. `polygon` and `spare` (`MOST_CORNERS`, 3) are work arrays;
    `point` (3,) receives the place of a smaller clearance on the lower triangle.
    """
    height, a, b, area = plane
    for corner in range(3):
        x, y, z = upper[3 * corner], upper[3 * corner + 1], upper[3 * corner + 2]
        polygon[corner, 0], polygon[corner, 1] = x, z
        polygon[corner, 2] = y - (height + a * x + b * z)
    count, way = 3, -1.0 if area > 0.0 else 1.0
    for first in range(3):
        second = (first + 1) % 3
        ax, az = lower[3 * first], lower[3 * first + 2]
        bx, bz = lower[3 * second], lower[3 * second + 2]
        count = _cut(polygon, count, spare, ax, az, bx, bz, way)
        polygon, spare = spare, polygon
    for corner in range(count):
        x, z, clearance = polygon[corner, 0], polygon[corner, 1], polygon[corner, 2]
        if clearance < best:
            best = clearance
            point[0], point[1], point[2] = x, height + a * x + b * z, z
    return best


@compiled_as_written
def _least_clearance(
    upper_boxes: Array,
    upper_supports: Array,
    upper_corners: Array,
    lower_boxes: Array,
    lower_supports: Array,
    lower_corners: Array,
    rotation: Array,
    translation: Array,
) -> tuple[float, Array]:
    """Return the smallest clearance (m) of two surfaces, and its place (3,), m, on the lower one.

    Boxes (2 p, 6), supports (2 p, 4) and corners (p c, 9) are those of `TriangleTree`, in the frame
    of each surface; the pose is the upper frame in the lower. It is inf if they do not overlap in
    the plan view.
    """
    best, point = np.inf, np.full(3, np.nan)
    uppers, lowers = len(upper_boxes) // 2, len(lower_boxes) // 2
    upper_size, lower_size = len(upper_corners) // uppers, len(lower_corners) // lowers
    stack, least = np.empty((MOST_WAITING, 2), np.int64), np.empty(MOST_WAITING)
    box, upper = np.empty(6), np.empty((upper_size, 9))
    polygon, spare = np.empty((MOST_CORNERS, 3)), np.empty((MOST_CORNERS, 3))
    stack[0, 0], stack[0, 1], least[0], size = 1, 1, -np.inf, 1
    while size > 0:
        size -= 1
        upper_box, lower_box = stack[size, 0], stack[size, 1]
        if least[size] >= best:
            continue
        if upper_box >= uppers and lower_box >= lowers:
            for item in range(upper_size):
                corners = upper_corners[(upper_box - uppers) * upper_size + item]
                for corner in range(0, 9, 3):
                    for i in range(3):
                        upper[item, corner + i] = (
                            translation[i]
                            + rotation[i, 0] * corners[corner]
                            + rotation[i, 1] * corners[corner + 1]
                            + rotation[i, 2] * corners[corner + 2]
                        )
            for below in range(
                (lower_box - lowers) * lower_size, (lower_box - lowers + 1) * lower_size
            ):
                lower = lower_corners[below]
                plane = _plane(lower)
                if plane[3] == 0.0:
                    continue
                for item in range(upper_size):
                    if _over(upper[item], lower) and _beyond(upper[item], plane) < best:
                        best = _over_each_other(
                            upper[item], lower, plane, best, polygon, spare, point
                        )
            continue
        # The larger of the two boxes is halved.
        _turned_box(upper_boxes[upper_box], rotation, translation, box)
        wide = box[3] - box[0] + box[5] - box[2]
        below_box = lower_boxes[lower_box]
        halve_upper = upper_box < uppers and (
            lower_box >= lowers or wide > below_box[3] - below_box[0] + below_box[5] - below_box[2]
        )
        begin = size
        for child in range(2):
            first, second = (
                (2 * upper_box + child, lower_box)
                if halve_upper
                else (upper_box, 2 * lower_box + child)
            )
            if halve_upper:
                _turned_box(upper_boxes[first], rotation, translation, box)
            bound = _bound(
                box,
                lower_boxes[second],
                upper_supports[first],
                lower_supports[second],
                rotation,
                translation,
            )
            if bound >= best:
                continue
            stack[size, 0], stack[size, 1], least[size] = first, second, bound
            size += 1
        if size == begin + 2 and least[begin] < least[begin + 1]:  # the smaller bound is next
            for k in range(2):
                stack[begin, k], stack[begin + 1, k] = stack[begin + 1, k], stack[begin, k]
            least[begin], least[begin + 1] = least[begin + 1], least[begin]
    return best, point
