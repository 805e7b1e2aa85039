"""Where a femoral component parts into two condyles, and the lowest point of each."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from tkamb.geometry.frames import Array, Index, rotate, transform
from tkamb.geometry.nearest import sampled
from tkamb.geometry.surface import Surface

NOTCH_DEPTH = 2e-3
"""m; a shallower valley between two lobes does not make two condyles."""
FACET_DEPTH = 3e-5
"""m; depth that facets of 1–2 mm cut off a condyle: heights that differ by less are the same."""
STRIP_WIDTH = 1e-3
"""m; of the strips along z in which the notch is looked for."""
SAMPLE_SPACING = 1e-3
"""m; between the samples of a condyle's surface."""
HIGHEST_SAMPLE = 10 * FACET_DEPTH
"""m above the lowest vertex; higher samples weigh nothing."""
SAMPLES_IN_A_BOX = 32
_FLEXIONS = np.radians(np.arange(0.0, 121.0, 15.0))
_DEEPEST = 15e-3


@lru_cache(maxsize=2)
def condyle_split(femoral: Surface) -> float | None:
    """Return the z (m, femoral frame) between the condyles; None for a single condyle.

    The lower outline of the component in the frontal plane is taken at flexions from 0 to
    120 deg (rotation about +z, as in `tkamb.geometry.frames`), in strips of 1 mm along z,
    as height above its lowest point, and averaged over flexion. Two condyles show as two
    valleys with a ridge, the notch, between them. It must rise at least 2 mm above both;
    the split is the middle of the notch at half its height. A sphere, a cylinder along z
    or a unicondylar part has one valley.

    In a right knee z above the split is lateral, below it medial.

    Args:
        femoral: in the femoral frame, anatomical axes (x anterior, y superior, z right).
    """
    outline, middles = _mean_outline(femoral)
    left = np.minimum.accumulate(outline)
    right = np.minimum.accumulate(outline[::-1])[::-1]
    rise = outline - np.maximum(left, right)
    top = int(np.argmax(rise))
    if rise[top] < NOTCH_DEPTH:
        return None
    high = outline > outline[top] - rise[top] / 2
    first = last = top
    while high[first - 1]:
        first -= 1
    while high[last + 1]:
        last += 1
    return float((middles[first] + middles[last]) / 2)


def condyle_faces(femoral: Surface, split: float | None) -> tuple[Index, Index]:
    """Return the triangles (k,) of the medial and of the lateral condyle.

    A triangle belongs to the side that its centroid is on. Without a split all of them are
    medial.
    """
    if split is None:
        return np.arange(len(femoral.faces)), np.empty(0, np.int64)
    lateral = femoral.triangles[:, :, 2].mean(axis=1) > split
    return np.flatnonzero(~lateral), np.flatnonzero(lateral)


def _mean_outline(femoral: Surface) -> tuple[Array, Array]:
    """Return height (n,) of the outline above its lowest point and z (n,) of the strips, m."""
    samples = np.concatenate([sampled(femoral, STRIP_WIDTH / 2)[0], femoral.vertices])
    low, high = femoral.bounds[:, 2]
    count = max(int(np.ceil((high - low) / STRIP_WIDTH)), 3)
    strip = np.clip(((samples[:, 2] - low) / (high - low) * count).astype(int), 0, count - 1)
    total = np.zeros(count)
    for flexion in _FLEXIONS:
        height = samples[:, 0] * np.sin(flexion) + samples[:, 1] * np.cos(flexion)
        outline = np.full(count, np.inf)
        np.minimum.at(outline, strip, height)
        total += np.minimum(outline - outline.min(), _DEEPEST)
    middles = low + (np.arange(count) + 0.5) * (high - low) / count
    return total / len(_FLEXIONS), middles


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
    """A condyle's samples, in boxes about each few of them that spare most from being looked at.

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
        samples, _, areas = sampled(condyle, SAMPLE_SPACING)
        begin = np.arange(0, len(samples), SAMPLES_IN_A_BOX)
        low = np.minimum.reduceat(samples, begin)
        high = np.maximum.reduceat(samples, begin)
        vertices = condyle.vertices[np.unique(condyle.faces)]
        return cls(vertices, samples, areas, (low + high) / 2, (high - low) / 2)

    def lowest(self, pose: Array) -> Array:
        """Return the lowest point (3,) m, insert frame."""
        heights = self.vertices @ pose[1, :3]
        lowest, bottom = self.vertices[np.argmin(heights)], heights.min()
        looked_at = self._low_samples(pose[1, :3], bottom + HIGHEST_SAMPLE)
        above = self.samples[looked_at] @ pose[1, :3] - bottom
        near = above < HIGHEST_SAMPLE
        looked_at, above = looked_at[near], above[near]
        weights = np.append(self.areas[looked_at], self.areas.mean()) * np.exp(
            -np.append(above, 0) / FACET_DEPTH
        )
        across = rotate(pose, np.vstack([self.samples[looked_at], lowest]) - lowest)
        step = weights @ across / weights.sum()
        return transform(pose, lowest) + step * np.array([1.0, 0.0, 1.0])

    def _low_samples(self, up: Array, height: float) -> Index:
        """Return the samples in boxes that reach down to a height, m along up (3,)."""
        least = self.centres @ up - self.halves @ np.abs(up)
        # a box's rounding is far below the weight's reach
        boxes = np.flatnonzero(least < height)
        chosen = boxes[:, None] * SAMPLES_IN_A_BOX + np.arange(SAMPLES_IN_A_BOX)
        return chosen[chosen < len(self.samples)]
