"""Where a femoral component parts into a medial and a lateral condyle."""

import numpy as np
from numpy.typing import NDArray

from tkamb.geometry.frames import Array
from tkamb.geometry.nearest import sampled
from tkamb.geometry.surface import Surface

NOTCH_DEPTH = 2e-3
"""m; a shallower valley between two lobes does not make two condyles."""
_FLEXIONS = np.radians(np.arange(0.0, 121.0, 15.0))
_STRIP = 1e-3
_DEEPEST = 15e-3


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


def condyle_faces(
    femoral: Surface, split: float | None
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
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
    samples = np.concatenate([sampled(femoral, _STRIP / 2)[0], femoral.vertices])
    low, high = femoral.bounds[:, 2]
    count = max(int(np.ceil((high - low) / _STRIP)), 3)
    strip = np.clip(((samples[:, 2] - low) / (high - low) * count).astype(int), 0, count - 1)
    total = np.zeros(count)
    for flexion in _FLEXIONS:
        height = samples[:, 0] * np.sin(flexion) + samples[:, 1] * np.cos(flexion)
        outline = np.full(count, np.inf)
        np.minimum.at(outline, strip, height)
        total += np.minimum(outline - outline.min(), _DEEPEST)
    middles = low + (np.arange(count) + 0.5) * (high - low) / count
    return total / len(_FLEXIONS), middles
