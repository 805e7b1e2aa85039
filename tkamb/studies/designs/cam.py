"""The cam of a posterior-stabilised component: a cylinder across the box, one solid with it.

The cylinder is exact up to `CAM.flange_mm` from the walls of the box. From there it widens into a
window of the wall, so that the mesh stays one closed body that does not cut itself.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from tkamb.errors import InputError
from tkamb.geometry.frames import Array


@dataclass(frozen=True)
class CamSettings:
    """The cam of a posterior-stabilised design."""

    sides: int = 96
    """Number of facets around a cam. Chosen: their chords leave out 0.05 % of the radius."""
    stations: int = 13
    """Number of rings of vertices along the cam. Chosen: triangles are then about as long as
    wide."""
    flange_mm: float = 1.0
    """mm from the wall of the box to the cylinder. Chosen: it keeps the cylinder clear of the
    wall."""
    window_deg: float = 22.0
    """deg about the origin on either side of the cam: what of the wall holds it."""
    wall_tolerance_mm: float = 1e-6
    """mm; vertices this near the plane of a wall lie in it. Chosen: above rounding."""


CAM = CamSettings()


Ids = NDArray[np.int64]


@dataclass(frozen=True)
class Cam:
    """A cylinder along z across the box of a femoral component; mm, femoral frame.

    Args:
        centre_ap: x of its axis.
        centre_si: y of its axis.
        radius: of the cylinder.
    """

    centre_ap: float
    centre_si: float
    radius: float

    def rings(self, half_length: float) -> Array:
        """Return points (`CAM.stations`, `CAM.sides`, 3) on the cylinder, by angle from x to y."""
        turn = np.linspace(0.0, 2.0 * np.pi, CAM.sides, endpoint=False)
        x = self.centre_ap + self.radius * np.cos(turn)
        y = self.centre_si + self.radius * np.sin(turn)
        z = np.linspace(-half_length, half_length, CAM.stations)[:, None]
        return np.stack(np.broadcast_arrays(x, y, z), axis=-1)


def joined(cam: Cam, box_half: float, vertices: Array, faces: Ids) -> tuple[Array, Ids]:
    """Return the closed triangulation of a femoral component with its cam.

    Args:
        cam: the cam.
        box_half: mm, half the width of the box, whose walls are planes across z.
        vertices: (n, 3) mm, of the component without it.
        faces: (k, 3).

    Raises:
        InputError: the walls have no part that could hold the cam.
    """
    towards = np.arctan2(-cam.centre_ap, -cam.centre_si)
    apart = np.degrees(np.arctan2(-vertices[:, 0], -vertices[:, 1]) - towards)
    near = np.abs((apart + 180.0) % 360.0 - 180.0) <= CAM.window_deg
    loops = []
    for wall in (-box_half, box_half):
        inside = near & (np.abs(vertices[:, 2] - wall) < CAM.wall_tolerance_mm)
        window = inside[faces].all(axis=1)
        loops.append(_outline(vertices, faces[window]))
        faces = faces[~window]
    rings = cam.rings(box_half - CAM.flange_mm)
    ids = len(vertices) + np.arange(rings.shape[0] * CAM.sides).reshape(-1, CAM.sides)
    vertices = np.concatenate([vertices, rings.reshape(-1, 3)])
    tube = [loops[0], *ids, loops[1]]
    sleeves = [_between(vertices, a, b) for a, b in pairwise(tube)]
    used, faces = np.unique(np.concatenate([faces, *sleeves]), return_inverse=True)
    return vertices[used], faces.reshape(-1, 3)


def _outline(vertices: Array, window: Ids) -> Ids:
    """Return the vertices around a patch of a wall, by angle about their middle."""
    edges = window[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    pairs, count = np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)
    rim = pairs[count == 1]
    loop = np.unique(rim)
    if len(loop) >= 3 and len(loop) == len(rim):
        loop = loop[np.argsort(_angles(vertices, loop))]
        steps = np.sort(np.stack([loop, np.roll(loop, -1)], axis=1), axis=1)
        if np.array_equal(np.unique(steps, axis=0), rim):
            return loop
    raise InputError(
        "the walls of the box do not hold the cam", "[cam]", "move it, or thicken them"
    )


def _angles(vertices: Array, loop: Ids) -> Array:
    """Return the angle (m,) of points about their middle in the sagittal plane, 0 to 2 pi."""
    x, y = (vertices[loop, :2] - vertices[loop, :2].mean(axis=0)).T
    return np.arctan2(y, x) % (2.0 * np.pi)


def _between(vertices: Array, first: Ids, second: Ids) -> Ids:
    """Return the triangles between two loops in order of angle, the second at a greater z."""
    ahead = [np.append(_angles(vertices, loop)[1:], np.inf) for loop in (first, second)]
    i = j = 0
    triangles = []
    while i < len(first) or j < len(second):
        if i < len(first) and (j == len(second) or ahead[0][i] <= ahead[1][j]):
            point, after = first[i], first[(i + 1) % len(first)]
            triangles.append((point, after, second[j % len(second)]))
            i += 1
        else:
            point, after = second[j], second[(j + 1) % len(second)]
            triangles.append((first[i % len(first)], after, point))
            j += 1
    return np.array(triangles, np.int64)
