"""Femoral components and inserts with known curvature, m, in the axes of the insert frame.

Bodies of the same sizes are one object for all tests, with their search trees.
"""

from functools import lru_cache

import numpy as np

from tkamb.geometry.surface import Surface

SECTORS = 96


@lru_cache(8)
def graded_sphere(radius, centre=(0.0, 0.0, 0.0), stretch=(1.0, 1.0, 1.0)):
    """Return a sphere with rings 0.15 deg apart near the lower pole.

    `stretch` scales x, y and z to an ellipsoid before the move to `centre`. At the lower pole the
    radius of curvature along x is radius * stretch_x² / stretch_y; along z stretch_z replaces
    stretch_x.
    """
    polar = np.radians(np.concatenate([np.arange(0.15, 20, 0.15), np.linspace(20, 180, 60)[:-1]]))
    around = np.arange(SECTORS) * 2 * np.pi / SECTORS
    ring = np.stack(
        [
            np.outer(np.sin(polar), np.cos(around)),
            -np.outer(np.cos(polar), np.ones(SECTORS)),
            np.outer(np.sin(polar), np.sin(around)),
        ],
        axis=-1,
    ).reshape(-1, 3)
    vertices = radius * np.concatenate([[[0, -1, 0]], ring, [[0, 1, 0]]])
    start = np.arange(SECTORS)
    end = (start + 1) % SECTORS
    faces = [np.stack([np.zeros(SECTORS, int), 1 + start, 1 + end], axis=1)]
    for row in range(len(polar) - 1):
        a, b = 1 + row * SECTORS, 1 + (row + 1) * SECTORS
        faces.append(np.stack([a + start, b + start, b + end], axis=1))
        faces.append(np.stack([a + start, b + end, a + end], axis=1))
    last = 1 + (len(polar) - 1) * SECTORS
    faces.append(np.stack([last + start, np.full(SECTORS, len(vertices) - 1), last + end], 1))
    surface = Surface(
        vertices * np.asarray(stretch) + np.asarray(centre), np.concatenate(faces), "sphere"
    )
    assert surface.mesh.is_watertight
    assert surface.mesh.volume > 0
    return surface


@lru_cache(8)
def joined(*surfaces):
    """Return several surfaces as one."""
    start = np.cumsum([0, *(len(s.vertices) for s in surfaces)])
    faces = [s.faces + n for s, n in zip(surfaces, start, strict=False)]
    return Surface(
        np.concatenate([s.vertices for s in surfaces]), np.concatenate(faces), surfaces[0].name
    )


def dished_insert(height, half_x=15e-3, half_z=15e-3, spacing=0.5e-3):
    """Return a closed insert on y = 0 with the upper surface y = height(x, z) (arrays, m)."""
    x = np.linspace(-half_x, half_x, round(2 * half_x / spacing) + 1)
    z = np.linspace(-half_z, half_z, round(2 * half_z / spacing) + 1)
    grid_x, grid_z = (grid.ravel() for grid in np.meshgrid(x, z, indexing="ij"))
    top = np.stack([grid_x, np.broadcast_to(height(grid_x, grid_z), grid_x.shape), grid_z], 1)
    number = np.arange(len(top)).reshape(len(x), len(z))
    a, b = number[:-1, :-1].ravel(), number[:-1, 1:].ravel()
    c, d = number[1:, :-1].ravel(), number[1:, 1:].ravel()
    upper = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])
    rim = np.concatenate([number[0, :], number[1:, -1], number[-1, -2::-1], number[-2:0:-1, 0]])
    after = np.roll(rim, -1)
    n = len(top)
    walls = np.concatenate(
        [np.stack([rim, rim + n, after], 1), np.stack([after, rim + n, after + n], 1)]
    )
    faces = np.concatenate([upper, upper[:, ::-1] + n, walls])
    surface = Surface(np.concatenate([top, top * [1, 0, 1]]), faces, "insert")
    assert surface.mesh.is_watertight
    assert surface.mesh.volume > 0
    return surface


@lru_cache(8)
def flat_insert(height, half_x=15e-3, half_z=15e-3):
    """Return a box of a height (m) on y = 0."""
    return dished_insert(lambda x, z: height + 0 * x, half_x, half_z, spacing=2 * half_x)
