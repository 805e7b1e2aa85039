"""Lowest points of the femoral condyles."""

import numpy as np

from tkamb.geometry.close_region import RESOLUTION
from tkamb.geometry.condyles import condyle_faces
from tkamb.geometry.frames import Array, rotate, transform
from tkamb.geometry.nearest import sampled
from tkamb.geometry.surface import Surface

_SPACING = 1e-3


class LowestPoints:
    """Lowest point of each condyle along the insert's y, prepared for many poses.

    y is that of the lowest vertex. x and z are the mean of the condyle's surface, weighted
    with exp(-height / RESOLUTION) of the height above that vertex (RESOLUTION as in
    `tkamb.geometry.close_region`), so that the point rolls with the condyle and does not jump
    from vertex to vertex of the mesh.

    Args:
        femoral: femoral component, femoral frame.
        split: z between the condyles in the femoral frame, None for one condyle.
    """

    def __init__(self, femoral: Surface, split: float | None) -> None:
        self._condyles = []
        for faces in condyle_faces(femoral, split):
            if len(faces):
                part = Surface(femoral.vertices, femoral.faces[faces], femoral.name)
                samples, _, areas = sampled(part, _SPACING)
                self._condyles.append((femoral.vertices[np.unique(part.faces)], samples, areas))

    def at(self, pose_femoral_in_insert: Array) -> tuple[Array, Array | None]:
        """Return the points (3,) m, insert frame, of the medial and the lateral condyle.

        The lateral one is None where there is no split.
        """
        pose = np.asarray(pose_femoral_in_insert, float)
        points = [_lowest(pose, *condyle) for condyle in self._condyles]
        return points[0], points[1] if len(points) > 1 else None


def lowest_points(
    femoral: Surface, pose_femoral_in_insert: Array, split: float | None
) -> tuple[Array, Array | None]:
    """Return the lowest points at one pose; `LowestPoints` is the way to many."""
    return LowestPoints(femoral, split).at(pose_femoral_in_insert)


def _lowest(pose: Array, vertices: Array, samples: Array, areas: Array) -> Array:
    heights = vertices @ pose[1, :3]
    lowest = vertices[np.argmin(heights)]
    above = samples @ pose[1, :3] - heights.min()
    near = above < 10 * RESOLUTION
    weights = np.append(areas[near], areas.mean()) * np.exp(-np.append(above[near], 0) / RESOLUTION)
    across = rotate(pose, np.vstack([samples[near], lowest]) - lowest)
    step = weights @ across / weights.sum()
    return np.asarray(transform(pose, lowest) + step * np.array([1.0, 0.0, 1.0]))
