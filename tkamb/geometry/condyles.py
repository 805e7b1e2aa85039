"""Where a femoral component parts into two condyles, and the lowest point of each."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array, Index, cross, rotate, transform
from tkamb.geometry.nearest import sampled
from tkamb.geometry.surface import Surface
from tkamb.units import DEGREE, MILLIMETRE


@dataclass(frozen=True)
class CondyleSettings:
    """How the two condyles of a femoral component are told apart."""

    notch_depth: float = 2e-3
    """m: a component with a shallower notch along z has one condyle. Chosen: real components with
    two have 6 to 14 mm."""
    yawed_notch_depth: float = 3e-3
    """m: least notch along another direction than z that shows two condyles. A single condyle of
    a real component has up to 2.4 mm along some direction (DM, JW and the shipped knee cut in
    halves)."""
    extended_notch_depth: float = 0.5e-3
    """m: least notch at 0 deg of flexion along the line through two condyles. Chosen: a single long
    body has none there, although its ends may look like condyles in flexion."""
    facet_depth: float = 3e-5
    """m: depth that facets of 1 to 2 mm cut off a condyle. Chosen: heights that differ by less
    count as equal."""
    strip_width: float = 1e-3
    """m: width of the strips along z in which the notch is searched. Chosen: a condyle's ridge is
    wider."""
    sample_spacing: float = 1e-3
    """m: spacing of the samples of a condyle's surface. Chosen: about the facets of a mesh."""
    highest_sample: float = 10 * facet_depth
    """m above the lowest vertex: higher samples have no weight. Chosen: higher samples are not in
    contact."""
    samples_per_box: int = 32
    """Samples of a surface that share one box of the search tree. Chosen: it changes speed
    alone."""
    deepest_notch: float = 15e-3
    """m: height above the condyles up to which the notch between them is searched. Chosen: real
    notches have 6 to 14 mm."""


CONDYLE = CondyleSettings()


@dataclass(frozen=True)
class ShellSettings:
    """How the front and the bone side of a femoral component are found from its shape."""

    least_inner_share: float = 0.33
    """1: share of the surface that faces the middle of the bounding box, from which a part is a
    shell that opens towards the bone. Measured: 0.41 to 0.44 in nine femoral components, at most
    0.24 in inserts, 0 in convex bodies."""
    least_opening_share: float = 0.3
    """1: size of the sum of the area vectors of that part of the surface, as a share of its area,
    from which it opens in one direction. Measured: 0.38 to 0.52 in nine femoral components, 0 for
    two spheres side by side."""
    opening_lean: float = 20.0 * DEGREE
    """rad: angle from superior to the direction in which the shell opens, to posterior. Measured:
    11 to 30 deg in nine femoral components."""
    flange_width_share: float = 0.1
    """1: half the width, as a share of the component's, of the strip between the condyles in which
    the flange is looked for. Chosen: narrower than the notch."""
    flange_position: float = 0.75
    """1: least position of the strip's upper half along the component, as a share of its length
    from behind. Measured: 0.87 to 0.94 in nine femoral components."""
    sideways: float = 45.0 * DEGREE
    """rad: a shell that opens farther than this from its sagittal plane has wrong axes. Measured:
    at most 2 deg in nine femoral components."""


SHELL = ShellSettings()

_FLEXIONS = np.radians(np.arange(0.0, 121.0, 15.0))


@dataclass(frozen=True)
class YawSearch:
    """How the line through both condyles is found in the horizontal plane.

    Args:
        step: rad, between the directions that are tried.
        spacing: m, between the samples of the surface.
        strip: m, width of the strips along a direction.
        flexions: rad, at which the outline is taken.
        largest_yaw: rad, between that line and z. The estimate is within 3 deg on real
            components; at 20 deg the plane between the condyles already cuts them.
    """

    step: float = 10.0 * DEGREE
    spacing: float = 1.0 * MILLIMETRE
    strip: float = 2.0 * MILLIMETRE
    flexions: tuple[float, ...] = tuple(np.arange(0.0, 91.0, 15.0) * DEGREE)
    largest_yaw: float = 15.0 * DEGREE


YAW_SEARCH = YawSearch()


@lru_cache(maxsize=2)
def condyle_split(femoral: Surface) -> float | None:
    """Return the z (m, femoral frame) between the condyles; None for a single condyle.

    The lower outline of the component in the frontal plane is taken at flexions from 0 to
    120 deg (rotation about +z, as in `tkamb.geometry.frames`), in strips of 1 mm along z,
    as height above its lowest point, and averaged over flexion. Two condyles show as two
    valleys with a ridge, the notch, between them. It must rise at least 3 mm above both, or 2 mm
    where it is there in extension too; the split is the middle of the notch at half its height. A
    sphere, a cylinder along z or a unicondylar part has one valley.

    In a right knee z above the split is lateral, below it medial.

    Args:
        femoral: in the femoral frame, anatomical axes (x anterior, y superior, z right).

    Raises:
        InputError: the two condyles do not lie side by side along z, so that medial and lateral
            cannot be told.
    """
    samples = _samples(femoral, CONDYLE.strip_width / 2)
    outline, middles = _mean_outline(samples, CONDYLE.strip_width, _FLEXIONS)
    rise = _rise(outline)
    top = int(np.argmax(rise))
    _check_yaw(femoral)
    # A shallow notch counts if it is there in extension too: one condyle that lies askew has none.
    extended, _ = _mean_outline(samples, CONDYLE.strip_width, np.zeros(1))
    in_extension = _rise(extended).max() >= CONDYLE.notch_depth
    if rise[top] < (CONDYLE.notch_depth if in_extension else CONDYLE.yawed_notch_depth):
        return None
    high = outline > outline[top] - rise[top] / 2
    first = last = top
    while high[first - 1]:
        first -= 1
    while high[last + 1]:
        last += 1
    return float((middles[first] + middles[last]) / 2)


def condyle_yaw(femoral: Surface, search: YawSearch = YAW_SEARCH) -> tuple[float, float]:
    """Return how far the line through both condyles is turned from z, and its notch.

    The notch is looked for along every horizontal direction. It is deepest along the line
    through both condyles. The mean of the directions, weighted by the depth where it is more
    than half the largest, is that line.

    Args:
        femoral: in the femoral frame.
        search: settings.

    Returns:
        Angle about +y, rad, in (-90, 90] deg, and depth of the deepest notch, m. A single
        condyle has no notch along any direction and no direction of its own.
    """
    samples = _samples(femoral, search.spacing)
    yaws = np.arange(-np.pi / 2, np.pi / 2 - search.step / 2, search.step)
    depth = np.zeros(len(yaws))
    for n, yaw in enumerate(yaws):
        cosine, sine = np.cos(yaw), np.sin(yaw)
        turn = np.array([[cosine, 0.0, -sine], [0.0, 1.0, 0.0], [sine, 0.0, cosine]])
        turned_samples = samples @ turn.T
        extended, _ = _mean_outline(turned_samples, search.strip, np.zeros(1))
        if _rise(extended).max() < CONDYLE.extended_notch_depth:
            continue
        outline, _ = _mean_outline(turned_samples, search.strip, np.array(search.flexions))
        depth[n] = _rise(outline).max()
    deepest = float(depth.max())
    weight = np.where(depth > deepest / 2, depth, 0.0)
    doubled = weight @ np.exp(2j * yaws)  # a line has no sense: its angle is known modulo 180 deg
    return float(np.angle(doubled) / 2), deepest


def _check_yaw(femoral: Surface) -> None:
    """Raise an InputError where two condyles lie along another direction than z."""
    yaw, notch = condyle_yaw(femoral)
    if notch < CONDYLE.yawed_notch_depth or abs(yaw) <= YAW_SEARCH.largest_yaw:
        return
    raise InputError(
        f"its two condyles lie along a line turned by {abs(yaw) / DEGREE:.0f} deg from the "
        "medial-lateral axis, so that medial and lateral cannot be told",
        femoral.name,
        "check the axes of the mesh: anterior, superior, right",
    )


@dataclass(frozen=True)
class Orientation:
    """How a femoral component stands on an insert, from its shape and its pose.

    Args:
        flexion: rad, from -pi to pi; at 0 its bone side faces up.
        tilt: rad, angle of its medial-lateral axis from the horizontal plane; pi/2 also where the
            component opens along the axis that the file calls medial-lateral.
        forward: cosine of the angle between its front and the insert's, seen from above.
    """

    flexion: float
    tilt: float
    forward: float


def orientation(femoral: Surface, pose: Array) -> Orientation | None:
    """Return how a femoral component stands on the insert; None where its shape does not show it.

    Of the mesh's axes only z is used, the medial-lateral one. The bone side of a femoral component
    is the part of its surface that faces the middle of its bounding box. The sum of its area
    vectors points out of the opening. The strip between the condyles shows the front: its upper
    half belongs to the flange alone. The flexion is right within about 10 deg.

    Args:
        femoral: in the femoral frame.
        pose: (4, 4) pose_femoral_in_insert.
    """
    middle, centroids = femoral.bounds.mean(axis=0), femoral.triangles.mean(axis=1)
    inner = np.einsum("kj,kj->k", femoral.face_normals, centroids - middle) < 0.0
    areas = femoral.areas
    outward, inner_area = areas[inner] @ femoral.face_normals[inner], areas[inner].sum()
    if inner_area < SHELL.least_inner_share * areas.sum():
        return None
    if np.linalg.norm(outward) < SHELL.least_opening_share * inner_area:
        return None
    if abs(outward[2]) > np.sin(SHELL.sideways) * np.linalg.norm(outward):
        return Orientation(0.0, np.pi / 2, 0.0)
    opening = outward[:2] / np.linalg.norm(outward[:2])
    across = np.array([opening[1], -opening[0]])  # forward if the component stands upright
    along, height = (femoral.vertices[:, :2] @ way for way in (across, opening))
    half_width = SHELL.flange_width_share * np.ptp(femoral.vertices[:, 2])
    strip = (np.abs(centroids[:, 2] - middle[2]) < half_width) & (
        centroids[:, :2] @ opening > 0.5 * (height.min() + height.max())
    )
    if not areas[strip].any():
        return None
    flange = float(areas[strip] @ (centroids[strip, :2] @ across) / areas[strip].sum())
    position = (flange - along.min()) / np.ptp(along)
    if abs(position - 0.5) < SHELL.flange_position - 0.5:
        return None
    front = across if position > 0.5 else -across
    cosine, sine = np.cos(SHELL.opening_lean), np.sin(SHELL.opening_lean)
    superior = np.append(cosine * opening + sine * front, 0.0)
    anterior = np.append(cosine * front - sine * opening, 0.0)
    up = rotate(pose, superior)
    right = rotate(pose, cross(anterior, superior))
    forward = np.array([right[2], 0.0, -right[0]])  # insert's y x right
    length = float(np.linalg.norm(forward))
    if length == 0.0:
        return Orientation(0.0, np.pi / 2, 0.0)
    forward /= length
    return Orientation(
        float(np.arctan2(-up @ forward, up[1])),
        float(np.arctan2(abs(right[1]), length)),
        float(forward[0]),
    )


def condyle_faces(femoral: Surface, split: float | None) -> tuple[Index, Index]:
    """Return the triangles (k,) of the medial and of the lateral condyle.

    A triangle belongs to the side that its centroid is on. Without a split all of them are
    medial.
    """
    if split is None:
        return np.arange(len(femoral.faces)), np.empty(0, np.int64)
    lateral = femoral.triangles[:, :, 2].mean(axis=1) > split
    return np.flatnonzero(~lateral), np.flatnonzero(lateral)


def _samples(femoral: Surface, spacing: float) -> Array:
    """Return samples (s, 3) of a surface, m, with the corners of its triangles."""
    corners = femoral.vertices[np.unique(femoral.faces)]
    return np.concatenate([sampled(femoral, spacing)[0], corners])


def _mean_outline(samples: Array, width: float, flexions: Array) -> tuple[Array, Array]:
    """Return height (n,) of the outline above its lowest point and z (n,) of the strips, m.

    Args:
        samples: (s, 3) m, of the surface.
        width: m, of the strips along z.
        flexions: (f,) rad, over which the outline is averaged.
    """
    low, high = samples[:, 2].min(), samples[:, 2].max()
    count = max(int(np.ceil((high - low) / width)), 3)
    strip = np.clip(((samples[:, 2] - low) / (high - low) * count).astype(int), 0, count - 1)
    total = np.zeros(count)
    for flexion in flexions:
        height = samples[:, 0] * np.sin(flexion) + samples[:, 1] * np.cos(flexion)
        outline = np.full(count, np.inf)
        np.minimum.at(outline, strip, height)
        # Long thin triangles leave strips without a sample: they are between their neighbours.
        sampled_strips = np.flatnonzero(np.isfinite(outline))
        outline = np.interp(np.arange(count), sampled_strips, outline[sampled_strips])
        total += np.minimum(outline - outline.min(), CONDYLE.deepest_notch)
    middles = low + (np.arange(count) + 0.5) * (high - low) / count
    return total / len(flexions), middles


def _rise(outline: Array) -> Array:
    """Return by how much each strip (n,) of an outline rises above the valleys beside it, m."""
    least_before = np.minimum.accumulate(outline)
    right = np.minimum.accumulate(outline[::-1])[::-1]
    return np.asarray(outline - np.maximum(least_before, right), float)


class LowestPoints:
    """Lowest point of each condyle along the insert's y, prepared for many poses.

    y is that of the lowest vertex. x and z are the mean of the condyle's surface, weighted
    with exp(-height / FACET_DEPTH) of the height above that vertex, so that the point rolls with
    the condyle and does not jump from vertex to vertex of the mesh.

    Args:
        femoral: femoral component, femoral frame.
        split: z between the condyles in the femoral frame, None for one condyle.
    """

    def __init__(self, femoral: Surface, split: float | None) -> None:
        self._condyles = []
        for faces in condyle_faces(femoral, split):
            if len(faces):
                part = Surface(femoral.vertices, femoral.faces[faces], femoral.name)
                self._condyles.append(_SampledCondyle.of(part))

    def at(self, pose_femoral_in_insert: Array) -> tuple[Array, Array | None]:
        """Return the points (3,) m, insert frame, of the medial and the lateral condyle.

        The lateral one is None where there is no split.
        """
        pose = np.asarray(pose_femoral_in_insert, float)
        points = [condyle.lowest(pose) for condyle in self._condyles]
        return points[0], points[1] if len(points) > 1 else None


@dataclass(frozen=True, eq=False)
class _SampledCondyle:
    """A condyle's samples, in boxes of a few, so that most samples need not be evaluated.

    Args:
        vertices: (v, 3) m, femoral frame.
        samples: (n, 3) m.
        areas: (n,) m².
        centres: (b, 3) m, of the boxes.
        halves: (b, 3) m, half their edges.
    """

    vertices: Array
    samples: Array
    areas: Array
    centres: Array
    halves: Array

    @classmethod
    def of(cls, condyle: Surface) -> "_SampledCondyle":
        """Return the samples of a condyle's surface."""
        samples, _, areas = sampled(condyle, CONDYLE.sample_spacing)
        begin = np.arange(0, len(samples), CONDYLE.samples_per_box)
        low = np.minimum.reduceat(samples, begin)
        high = np.maximum.reduceat(samples, begin)
        vertices = condyle.vertices[np.unique(condyle.faces)]
        return cls(vertices, samples, areas, (low + high) / 2, (high - low) / 2)

    def lowest(self, pose: Array) -> Array:
        """Return the lowest point (3,) m, insert frame."""
        heights = self.vertices @ pose[1, :3]
        lowest, bottom = self.vertices[np.argmin(heights)], heights.min()
        looked_at = self._low_samples(pose[1, :3], bottom + CONDYLE.highest_sample)
        above = self.samples[looked_at] @ pose[1, :3] - bottom
        near = above < CONDYLE.highest_sample
        looked_at, above = looked_at[near], above[near]
        weights = np.append(self.areas[looked_at], self.areas.mean()) * np.exp(
            -np.append(above, 0) / CONDYLE.facet_depth
        )
        across = rotate(pose, np.vstack([self.samples[looked_at], lowest]) - lowest)
        step = weights @ across / weights.sum()
        return transform(pose, lowest) + step * np.array([1.0, 0.0, 1.0])

    def _low_samples(self, up: Array, height: float) -> Index:
        """Return the samples in boxes that reach down to a height, m along up (3,)."""
        least = self.centres @ up - self.halves @ np.abs(up)
        # The rounding of a box is far smaller than the height over which samples have weight.
        boxes = np.flatnonzero(least < height)
        chosen = boxes[:, None] * CONDYLE.samples_per_box + np.arange(CONDYLE.samples_per_box)
        return chosen[chosen < len(self.samples)]
