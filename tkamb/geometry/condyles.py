"""The plane between the two condyles of a femoral component, and the lowest point of each."""

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
    """The search for the two condyles of a femoral component."""

    notch_depth: float = 2e-3
    """m: a component with a shallower notch along z has one condyle. Real components
    with two condyles have notches of 6 to 14 mm."""
    yawed_notch_depth: float = 3e-3
    """m: smallest depth of a notch along any direction that shows two condyles. A
    single condyle of a real component has notches up to 2.4 mm (components of the Grand Challenge
    subjects DM and JW, and of the shipped knee, cut in halves)."""
    extended_notch_depth: float = 0.5e-3
    """m: smallest depth, at 0 deg of flexion, of the notch between two condyles. A
    single long body has no notch there, although its ends may resemble condyles in flexion."""
    facet_depth: float = 3e-5
    """m: largest distance between a facet of 1 to 2 mm and the curved condyle that it approximates.
    Heights that differ by less count as equal."""
    strip_width: float = 1e-3
    """m: width of the strips along z in which the notch is searched. A condyle is
    wider."""
    sample_spacing: float = 1e-3
    """m: spacing of the samples of a condyle's surface. About the size of a mesh's
    facets."""
    highest_sample: float = 10 * facet_depth
    """m: height above the lowest vertex above which samples have no weight."""
    samples_per_box: int = 32
    """Samples in one box of the search: for speed only, results do not depend on it."""
    deepest_notch: float = 15e-3
    """m: upper limit of heights above the lowest point. Notches are 6 to 14 mm
    deep."""


CONDYLE = CondyleSettings()


# 1: smallest share of the surface that faces the middle of the bounding box, the inner surface of
# a shell. Measured: 0.41 to 0.44 in nine femoral components, at most 0.24 in inserts, 0 in convex
# bodies.
LEAST_INNER_SHARE = 0.33
# 1: smallest magnitude of the sum of the inner surface's area vectors, as a share of its area. A
# smaller sum shows no opening. Below the 0.38 to 0.52 of nine femoral components; two
# spheres side by side have 0.
LEAST_OPENING_SHARE = 0.3
# rad: angle of the opening's direction from superior towards posterior. Measured: 11 to 30 deg in
# nine femoral components.
OPENING_LEAN = 20.0 * DEGREE
# 1: half the width of the strip between the condyles in which the flange is searched, as a share
# of the component's width. It is narrower than the notch.
FLANGE_WIDTH_SHARE = 0.1
# 1: smallest position of the flange along the component, as a share of the length from behind.
# Below the 0.87 to 0.94 of nine femoral components.
FLANGE_POSITION = 0.75
# rad: if the opening's direction is farther from the sagittal plane, the axes are wrong. Measured:
# at most 2 deg in nine femoral components.
SIDEWAYS = 45.0 * DEGREE


_FLEXIONS = np.radians(np.arange(0.0, 121.0, 15.0))


@dataclass(frozen=True)
class YawSearch:
    """Search for the line through both condyles in the horizontal plane.

    Args:
        flexions: rad, over which the outline is averaged; `step`: rad; `spacing`, `strip`: m.
        largest_yaw: rad, largest accepted angle between the line and z. On real components the
            error of the estimate is at most 3 deg; at 20 deg the plane between the condyles cuts
            them.
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

    The outline is the lowest height of the surface in each strip of 1 mm along z, averaged over
    flexions from 0 to 120 deg (about +z, as in `tkamb.geometry.frames`). Two condyles are two
    valleys of the outline. The ridge between them must rise at least 3 mm above both, or 2 mm if it
    exists in extension, too. The split is the middle of the ridge at half its height. A sphere, a
    cylinder along z or a unicondylar component has one valley.

    Args:
        femoral: femoral component, femoral frame (x anterior, y superior, z right).

    Raises:
        InputError: the two condyles do not lie side by side along z.
    """
    samples = _samples(femoral, CONDYLE.strip_width / 2)
    outline, middles = _mean_outline(samples, CONDYLE.strip_width, _FLEXIONS)
    rise = _rise(outline)
    top = int(np.argmax(rise))
    _check_yaw(femoral)
    # A shallow notch counts if it exists in extension, too; one condyle that lies askew has none.
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
    """Return the angle between z and the line through both condyles, and the depth of the notch.

    The notch is deepest along the line through both condyles. The angle is the mean over horizontal
    directions with more than half this depth, weighted by depth.

    Returns:
        Angle about +y, rad, in (-90, 90] deg (without meaning if there is no notch), and depth, m.
    """
    samples = _samples(femoral, search.spacing)
    yaws = np.arange(-np.pi / 2, np.pi / 2 - search.step / 2, search.step)
    depth = np.zeros(len(yaws))
    for n, yaw in enumerate(yaws):
        cosine, sine = np.cos(yaw), np.sin(yaw)
        turn = np.array([[cosine, 0.0, -sine], [0.0, 1.0, 0.0], [sine, 0.0, cosine]])
        turned_samples = np.einsum("ij,nj->ni", turn, samples)
        extended, _ = _mean_outline(turned_samples, search.strip, np.zeros(1))
        if _rise(extended).max() < CONDYLE.extended_notch_depth:
            continue
        outline, _ = _mean_outline(turned_samples, search.strip, np.array(search.flexions))
        depth[n] = _rise(outline).max()
    deepest = float(depth.max())
    weight = np.where(depth > deepest / 2, depth, 0.0)
    doubled = weight @ np.exp(2j * yaws)  # the angle of a line is defined modulo 180 deg
    return float(np.angle(doubled) / 2), deepest


def _check_yaw(femoral: Surface) -> None:
    """Raise an InputError if the two condyles do not lie side by side along z."""
    yaw, notch = condyle_yaw(femoral)
    if notch < CONDYLE.yawed_notch_depth or abs(yaw) <= YAW_SEARCH.largest_yaw:
        return
    raise InputError(
        f"its two condyles lie along a line turned by {abs(yaw) / DEGREE:.0f} deg from the "
        "medial-lateral axis, so that medial and lateral cannot be distinguished",
        femoral.name,
        "check the axes of the mesh: anterior, superior, right",
    )


@dataclass(frozen=True)
class Orientation:
    """Orientation of a femoral component on an insert.

    Args:
        flexion: rad, from -pi to pi; at 0 the bone side faces up.
        tilt: rad, angle of the medial-lateral axis from the horizontal plane; pi/2 also if the
            component opens along the z axis of the mesh.
        forward: 1, cosine of the angle between the fronts of component and insert, in the plan
            view.
    """

    flexion: float
    tilt: float
    forward: float


def orientation(femoral: Surface, pose: Array) -> Orientation | None:
    """Return the orientation; None if the component's shape is unclear.

    Of the mesh's axes only z, the medial-lateral axis, is used. The inner surface faces the middle
    of the bounding box; the sum of its area vectors points out of the opening, towards the bone.
    The upper half of the strip between the condyles belongs to the flange, which is in front. The
    error of the flexion is about 10 deg; `pose` is pose_femoral_in_insert (4, 4).
    """
    middle, centroids = femoral.bounds.mean(axis=0), femoral.triangles.mean(axis=1)
    inner = np.einsum("kj,kj->k", femoral.face_normals, centroids - middle) < 0.0
    areas = femoral.areas
    outward, inner_area = areas[inner] @ femoral.face_normals[inner], areas[inner].sum()
    if inner_area < LEAST_INNER_SHARE * areas.sum():
        return None
    if np.linalg.norm(outward) < LEAST_OPENING_SHARE * inner_area:
        return None
    if abs(outward[2]) > np.sin(SIDEWAYS) * np.linalg.norm(outward):
        return Orientation(0.0, np.pi / 2, 0.0)
    opening = outward[:2] / np.linalg.norm(outward[:2])
    across = np.array([opening[1], -opening[0]])  # anterior if the component is upright
    along, height = (femoral.vertices[:, :2] @ axis for axis in (across, opening))
    half_width = FLANGE_WIDTH_SHARE * np.ptp(femoral.vertices[:, 2])
    strip = (np.abs(centroids[:, 2] - middle[2]) < half_width) & (
        centroids[:, :2] @ opening > 0.5 * (height.min() + height.max())
    )
    if not areas[strip].any():
        return None
    flange = float(areas[strip] @ (centroids[strip, :2] @ across) / areas[strip].sum())
    position = (flange - along.min()) / np.ptp(along)
    if abs(position - 0.5) < FLANGE_POSITION - 0.5:
        return None
    front = across if position > 0.5 else -across
    cosine, sine = np.cos(OPENING_LEAN), np.sin(OPENING_LEAN)
    superior = np.append(cosine * opening + sine * front, 0.0)
    anterior = np.append(cosine * front - sine * opening, 0.0)
    up = rotate(pose, superior)
    right = rotate(pose, cross(anterior, superior))
    forward = np.array([right[2], 0.0, -right[0]])  # cross product of the insert's y and `right`
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

    A triangle's centroid decides its side. Without a split all triangles are medial.
    """
    if split is None:
        return np.arange(len(femoral.faces)), np.empty(0, np.int64)
    lateral = femoral.triangles[:, :, 2].mean(axis=1) > split
    return np.flatnonzero(~lateral), np.flatnonzero(lateral)


def _samples(femoral: Surface, spacing: float) -> Array:
    """Return samples of a surface and its triangles' corners, (s, 3), m."""
    corners = femoral.vertices[np.unique(femoral.faces)]
    return np.concatenate([sampled(femoral, spacing)[0], corners])


def _mean_outline(samples: Array, width: float, flexions: Array) -> tuple[Array, Array]:
    """Return height (n,), m, of the outline above its lowest point, and z (n,), m, of strips."""
    low, high = samples[:, 2].min(), samples[:, 2].max()
    count = max(int(np.ceil((high - low) / width)), 3)
    strip = np.clip(((samples[:, 2] - low) / (high - low) * count).astype(int), 0, count - 1)
    total = np.zeros(count)
    for flexion in flexions:
        height = samples[:, 0] * np.sin(flexion) + samples[:, 1] * np.cos(flexion)
        outline = np.full(count, np.inf)
        np.minimum.at(outline, strip, height)
        # Beside long thin triangles a strip may have no sample: its height is interpolated.
        sampled_strips = np.flatnonzero(np.isfinite(outline))
        outline = np.interp(np.arange(count), sampled_strips, outline[sampled_strips])
        total += np.minimum(outline - outline.min(), CONDYLE.deepest_notch)
    middles = low + (np.arange(count) + 0.5) * (high - low) / count
    return total / len(flexions), middles


def _rise(outline: Array) -> Array:
    """Return the height (n,), m, of each strip above the higher valley beside it."""
    left_valley = np.minimum.accumulate(outline)
    right_valley = np.minimum.accumulate(outline[::-1])[::-1]
    return np.asarray(outline - np.maximum(left_valley, right_valley), float)


class LowestPoints:
    """Lowest point of each condyle along the insert's y, prepared for many poses.

    The point has the y of the lowest vertex. Its x and z are means over the condyle's surface with
    the weight exp(-height / `CONDYLE.facet_depth`), height above the lowest vertex. The point
    therefore moves smoothly. `split` is z (m, femoral frame) between the condyles; None for one.
    """

    def __init__(self, femoral: Surface, split: float | None) -> None:
        self._condyles = []
        for faces in condyle_faces(femoral, split):
            if len(faces):
                part = Surface(femoral.vertices, femoral.faces[faces], femoral.name)
                self._condyles.append(_SampledCondyle.of(part))

    def at(self, pose_femoral_in_insert: Array) -> tuple[Array, Array | None]:
        """Return the medial and the lateral point (3,), m, insert frame; None for no condyle."""
        pose = np.asarray(pose_femoral_in_insert, float)
        points = [condyle.lowest(pose) for condyle in self._condyles]
        return points[0], points[1] if len(points) > 1 else None


@dataclass(frozen=True, eq=False)
class _SampledCondyle:
    """Samples of a condyle in small boxes; only samples in low boxes are evaluated.

    Vertices, samples, box centres and half edges are (·, 3), m, femoral frame; areas (n,), m².
    """

    vertices: Array
    samples: Array
    areas: Array
    centres: Array
    halves: Array

    @classmethod
    def of(cls, condyle: Surface) -> "_SampledCondyle":
        samples, _, areas = sampled(condyle, CONDYLE.sample_spacing)
        begin = np.arange(0, len(samples), CONDYLE.samples_per_box)
        low = np.minimum.reduceat(samples, begin)
        high = np.maximum.reduceat(samples, begin)
        vertices = condyle.vertices[np.unique(condyle.faces)]
        return cls(vertices, samples, areas, (low + high) / 2, (high - low) / 2)

    def lowest(self, pose: Array) -> Array:
        heights = self.vertices @ pose[1, :3]
        lowest, bottom = self.vertices[np.argmin(heights)], heights.min()
        candidates = self._low_samples(pose[1, :3], bottom + CONDYLE.highest_sample)
        above = self.samples[candidates] @ pose[1, :3] - bottom
        near = above < CONDYLE.highest_sample
        candidates, above = candidates[near], above[near]
        weights = np.append(self.areas[candidates], self.areas.mean()) * np.exp(
            -np.append(above, 0) / CONDYLE.facet_depth
        )
        across = rotate(pose, np.vstack([self.samples[candidates], lowest]) - lowest)
        step = weights @ across / weights.sum()
        return transform(pose, lowest) + step * np.array([1.0, 0.0, 1.0])

    def _low_samples(self, up: Array, height: float) -> Index:
        least = self.centres @ up - self.halves @ np.abs(up)
        # The rounding error of a box is far smaller than the heights at which samples have weight.
        boxes = np.flatnonzero(least < height)
        chosen = boxes[:, None] * CONDYLE.samples_per_box + np.arange(CONDYLE.samples_per_box)
        return chosen[chosen < len(self.samples)]
