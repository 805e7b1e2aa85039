"""The taut path of a massless string around a bone's convex sagittal outline.

The bone is a general cylinder: a convex polygon in its own x-y plane, extruded along z. The
string starts at one point, keeps the bone on its right-hand side (seen with x to the right
and y up: it passes in front of the bone on its way down) and ends at another point. Its
shortest length is found by unrolling: with S the length of the taut path in the x-y plane,

    L = sqrt(S² + dz²),   z linear in S.

Around a polygon dL is exact and continuous: at a change of the tangent corner, and where
wrapping begins, both candidate paths coincide, so the moment arm has no jump.

Frictionless: the tension is the same all along, and the bone is pressed at the corners by
the change of the string's direction, which has no z component.
"""

from dataclasses import dataclass

import numpy as np

from tkamb.errors import ComputationError
from tkamb.geometry.frames import Array, transform


@dataclass(frozen=True, eq=False)
class TautPath:
    """A taut path at one instant.

    Args:
        points: (m, 3) m, from start to end, with the corners it touches between.
        length: m.
        wrap_angle: rad, by which the bone turns the string in its sagittal plane; 0 if straight.
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
        """Unit vector (3,) that leaves the start: the way a tension pulls the start."""
        return np.asarray(self.directions[0])

    @property
    def end_direction(self) -> Array:
        """Unit vector (3,) that arrives at the end: a tension pulls the end the other way."""
        return np.asarray(self.directions[-1])

    def moved(self, pose_here_in_there: Array) -> "TautPath":
        """Return the path in another frame."""
        return TautPath(transform(pose_here_in_there, self.points), self.length, self.wrap_angle)


def straight_path(start: Array, end: Array) -> TautPath:
    """Return the straight path between two points (3,)."""
    return TautPath(np.stack([start, end]), float(np.linalg.norm(end - start)), 0.0)


def taut_path(start: Array, end: Array, outline: Array) -> TautPath:
    """Return the taut path around an outline, all in the bone's frame.

    Which way round: the angle swept about the outline's centre from start to end, clockwise
    (x to the right, y up), is taken between -90 and 270 deg.

    Args:
        start: (3,) m.
        end: (3,) m.
        outline: (n, 2) m, strictly convex polygon in x-y, counter-clockwise.

    Raises:
        ComputationError: start or end lies inside the outline.
    """
    start, end = np.asarray(start, float), np.asarray(end, float)
    above, below = _height(start[:2], outline), _height(end[:2], outline)
    for name, heights in (("start", above), ("end", below)):
        if (heights >= 0.0).all():
            raise ComputationError(f"the {name} of a wrapping line lies inside the bone's outline")
    if _passes_freely(start[:2], end[:2], outline, above, below):
        return straight_path(start, end)
    corners, turn = _wrapped_corners(start[:2], end[:2], outline, above, below)
    plane = np.concatenate([start[None, :2], corners, end[None, :2]])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(plane, axis=0), axis=1))])
    z = start[2] + (end[2] - start[2]) * along / along[-1]
    return TautPath(
        np.column_stack([plane, z]), float(np.hypot(along[-1], end[2] - start[2])), turn
    )


def is_inside(point: Array, outline: Array) -> bool:
    """Say whether a point (3,) lies within an outline (n, 2) of its own frame."""
    return bool((_height(point[:2], outline) >= 0.0).all())


def path_in_link(
    start: Array, end: Array, outline: Array | None, pose_link_in_here: Array
) -> TautPath:
    """Return the taut path between points given here around an outline fixed to a link.

    Args:
        start: (3,) m, in the frame "here".
        end: (3,) m, in the frame "here".
        outline: (n, 2) m in the link's sagittal plane; None for a straight line.
        pose_link_in_here: (4, 4).
    """
    if outline is None:
        return straight_path(np.asarray(start, float), np.asarray(end, float))
    origin = pose_link_in_here[:3, 3]
    back = pose_link_in_here[:3, :3].T
    path = taut_path(back @ (start - origin), back @ (end - origin), outline)
    return path.moved(pose_link_in_here)


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def _height(point: Array, outline: Array) -> Array:
    """Return twice the area (n,) that each edge spans with a point: negative if it is seen."""
    offset = point - outline
    ahead = np.concatenate([offset[1:], offset[:1]])
    return np.asarray(offset[:, 0] * ahead[:, 1] - offset[:, 1] * ahead[:, 0])


def _passes_freely(start: Array, end: Array, outline: Array, above: Array, below: Array) -> bool:
    """Whether the straight segment leaves the outline on its right, or never comes to it.

    Args:
        start: (2,) m.
        end: (2,) m.
        outline: (n, 2) m.
        above: (n,) heights of the start over the edges.
        below: (n,) heights of the end.
    """
    centre = outline.mean(axis=0)
    a, b = start - centre, end - centre
    clockwise_sweep = -np.arctan2(_cross(a, b), a @ b)
    return bool(clockwise_sweep >= -0.5 * np.pi) and not _crosses(above, below)


def _crosses(above: Array, below: Array) -> bool:
    """Clip the segment by the outline's half planes (Cyrus-Beck), given its ends' heights."""
    if ((above <= 0.0) & (below <= 0.0)).any():
        return False
    enters, leaves = (above < 0.0) & (below > 0.0), (above > 0.0) & (below < 0.0)
    share = above / np.where(enters | leaves, above - below, 1.0)
    return bool(np.max(share[enters], initial=0.0) < np.min(share[leaves], initial=1.0))


def _wrapped_corners(
    start: Array, end: Array, outline: Array, above: Array, below: Array
) -> tuple[Array, float]:
    """Return the corners touched, in order, and the angle turned.

    The edges seen from the start begin (counter-clockwise) at the corner whose tangent has
    the outline on its right; those seen from the end stop at the corner of the other tangent.
    """
    seen_from_start, seen_from_end = above < 0.0, below < 0.0
    first = int(np.flatnonzero(seen_from_start & ~np.roll(seen_from_start, 1))[0])
    last = int(np.flatnonzero(seen_from_end & ~np.roll(seen_from_end, -1))[0]) + 1
    corners = outline[(first - np.arange((first - last) % len(outline) + 1)) % len(outline)]
    steps = np.diff(np.concatenate([start[None], corners, end[None]]), axis=0)
    turns = -np.arctan2(_cross(steps[:-1], steps[1:]), (steps[:-1] * steps[1:]).sum(axis=1))
    return corners, float(turns.sum())
