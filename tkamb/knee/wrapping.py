"""The taut path of a massless string around a bone's convex sagittal outline.

The bone is a convex polygon in its x-y plane, extruded along z. The string passes in front of it
(+x): with x to the right and y up it runs clockwise from start to end. Unrolling gives the shortest
length. If S is that of the taut path in the x-y plane,

    L = sqrt(S² + dz²),   z linear in S.

When the tangent corner changes or wrapping begins, the two candidate paths coincide, so that length
and moment arm are continuous.

The tension is constant along the string. Its force on the bone at a corner is the tension times the
change of direction, without z component.
"""

from dataclasses import dataclass

import numpy as np

from tkamb.errors import ComputationError
from tkamb.geometry.compiled import compiled_as_written
from tkamb.geometry.frames import Array, transform

NEITHER, START, END = 0, 1, 2
"""Which end of a line lies inside the outline."""


@dataclass(frozen=True, eq=False)
class TautPath:
    """A taut path at one instant.

    Args:
        points: start, touched corners of the outline, end, (m, 3), m.
        length: length of the path, m.
        wrap_angle: change of direction in the bone's sagittal plane, rad; 0: straight.
    """

    points: Array
    length: float
    wrap_angle: float

    @property
    def wrapped(self) -> bool:
        """Whether the path touches the bone."""
        return len(self.points) > 2

    @property
    def directions(self) -> Array:
        """Unit vectors (m-1, 3) along the segments, from start to end."""
        steps = np.diff(self.points, axis=0)
        return np.asarray(steps / np.linalg.norm(steps, axis=1, keepdims=True))

    @property
    def start_direction(self) -> Array:
        """Unit vector (3,) along the string at its start. Tension pulls the start this way."""
        return np.asarray(self.directions[0])

    @property
    def end_direction(self) -> Array:
        """Unit vector (3,) along the string at its end. Tension pulls the end the opposite way."""
        return np.asarray(self.directions[-1])

    def moved(self, pose_here_in_there: Array) -> "TautPath":
        """Return the path in another frame."""
        return TautPath(transform(pose_here_in_there, self.points), self.length, self.wrap_angle)


def straight_path(start: Array, end: Array) -> TautPath:
    """Return the straight path between two points (3,)."""
    return TautPath(np.stack([start, end]), float(np.linalg.norm(end - start)), 0.0)


def taut_path(start: Array, end: Array, outline: Array) -> TautPath:
    """Return the taut path around an outline in the bone's frame.

    The clockwise angle from start to end about the outline's centre, between -90 and 270 deg,
    decides on which side the string passes. `outline` (n, 2), m, is a strictly convex polygon in
    x-y, counter-clockwise.

    Raises:
        ComputationError: start or end lies inside the outline.
    """
    start, end = np.asarray(start, float), np.asarray(end, float)
    points, length, turn, inside = _taut(start, end, outline)
    if inside:
        name = "start" if inside == START else "end"
        raise ComputationError(f"the {name} of a wrapping line lies inside the bone's outline")
    return TautPath(points, length, turn)


def is_inside(point: Array, outline: Array) -> bool:
    """Return whether a point (3,) lies within an outline (n, 2) of the same frame."""
    return bool(_is_inside(np.asarray(point, float), outline))


def path_in_link(
    start: Array, end: Array, outline: Array | None, pose_link_in_here: Array
) -> TautPath:
    """Return the taut path between two points around an outline that is fixed to a link.

    `start` and `end` (3,), m, are in the result's frame; `outline` (n, 2), m, is in the link's
    sagittal plane; None: a straight path.
    """
    if outline is None:
        return straight_path(np.asarray(start, float), np.asarray(end, float))
    origin = pose_link_in_here[:3, 3]
    # The path is computed in the link's axes, the axes of the outline.
    back = pose_link_in_here[:3, :3].T
    path = taut_path(back @ (start - origin), back @ (end - origin), outline)
    return path.moved(pose_link_in_here)


@compiled_as_written
def _height(point: Array, outline: Array, edge: int) -> float:
    """Return twice the area of the triangle of edge and point; negative: the point is outside."""
    following = (edge + 1) % len(outline)
    x, y = point[0] - outline[edge, 0], point[1] - outline[edge, 1]
    return float(x * (point[1] - outline[following, 1]) - y * (point[0] - outline[following, 0]))


@compiled_as_written
def _is_inside(point: Array, outline: Array) -> bool:
    outside = False
    for edge in range(len(outline)):
        outside |= not _height(point, outline, edge) >= 0.0  # NaN is not inside
    return not outside


@compiled_as_written
def _sweep(start: Array, end: Array, outline: Array) -> float:
    # The centroid of a convex outline lies inside the outline: the angle about it is defined.
    x, y = np.mean(outline[:, 0]), np.mean(outline[:, 1])
    ax, ay, bx, by = start[0] - x, start[1] - y, end[0] - x, end[1] - y
    return float(-np.arctan2(ax * by - ay * bx, ax * bx + ay * by))


@compiled_as_written
def _crosses(start: Array, end: Array, outline: Array) -> bool:
    """Return whether a segment crosses the outline, by half-planes (Cyrus and Beck 1978)."""
    entry_at, exit_at = 0.0, 1.0
    for edge in range(len(outline)):
        above, below = _height(start, outline, edge), _height(end, outline, edge)
        if above <= 0.0 and below <= 0.0:
            return False
        if above < 0.0 and below > 0.0:
            entry_at = max(entry_at, above / (above - below))
        elif above > 0.0 and below < 0.0:
            exit_at = min(exit_at, above / (above - below))
    return entry_at < exit_at


@compiled_as_written
def _taut(start: Array, end: Array, outline: Array) -> tuple[Array, float, float, int]:
    """Return points (m, 3), length and turn, and the end inside the outline.

    It is straight if the segment misses the outline; otherwise it touches it from the corner of the
    tangent through the start to that of the tangent through the end.
    """
    ends, straight = np.stack((start, end)), np.sqrt(np.sum((end - start) ** 2))
    if _is_inside(start, outline):
        return ends, straight, 0.0, START
    if _is_inside(end, outline):
        return ends, straight, 0.0, END
    # A straight line is taut if it misses the bone. The swept angle is between -90 and 270 deg: a
    # string that would sweep less than -90 deg passes around the front instead.
    if _sweep(start, end, outline) >= -0.5 * np.pi and not _crosses(start, end, outline):
        return ends, straight, 0.0, NEITHER
    count, first, last = len(outline), -1, -1
    for edge in range(count):
        before, after = (edge - 1) % count, (edge + 1) % count
        if first < 0 and _height(start, outline, edge) < 0.0 <= _height(start, outline, before):
            first = edge
        if last < 0 and _height(end, outline, edge) < 0.0 <= _height(end, outline, after):
            last = edge + 1
    corners = (first - last) % count + 1
    points, turn, along = np.empty((corners + 2, 3)), 0.0, np.zeros(corners + 2)
    points[0], points[-1] = start, end
    for corner in range(corners):
        # The outline is counter-clockwise. The string runs down its front, in the opposite order.
        points[corner + 1, :2] = outline[(first - corner) % count]
    for k in range(1, corners + 2):
        x, y = points[k, 0] - points[k - 1, 0], points[k, 1] - points[k - 1, 1]
        along[k] = along[k - 1] + np.hypot(x, y)
        if k <= corners:
            ahead = points[k + 1, 0] - points[k, 0], points[k + 1, 1] - points[k, 1]
            turn -= np.arctan2(x * ahead[1] - y * ahead[0], x * ahead[0] + y * ahead[1])
    # The geodesic of the unrolled cylinder is a straight line, so z is linear in the plane length.
    for k in range(1, corners + 1):
        points[k, 2] = start[2] + (end[2] - start[2]) * along[k] / along[-1]
    return points, np.hypot(along[-1], end[2] - start[2]), turn, NEITHER
