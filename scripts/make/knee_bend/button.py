"""The patellar button: a spherical dome on a short cylinder, dome towards posterior (-x).

The patellar frame has its origin in the middle of the button's flat back.
"""

import numpy as np

from knee_bend import dimensions as d

DOME_CENTRE = np.array([d.DOME_RADIUS - d.BUTTON_THICKNESS, 0.0])
"""mm: centre of the dome (anterior, superior) in the patellar frame."""

RINGS, SECTORS = 24, 132


def mesh():
    """Return vertices (mm) and faces of the closed button, in the patellar frame."""
    radii = d.BUTTON_RADIUS * np.arange(1, RINGS + 1) / RINGS
    dome = DOME_CENTRE[0] - np.sqrt(d.DOME_RADIUS**2 - radii**2)
    rings = [_ring(r, x) for r, x in zip(radii, dome, strict=True)]
    rings.append(_ring(d.BUTTON_RADIUS, 0.0))
    apex, back = np.array([[-d.BUTTON_THICKNESS, 0.0, 0.0]]), np.zeros((1, 3))
    vertices = np.concatenate([apex, *rings, back])
    i = np.arange(SECTORS)
    j = np.roll(i, -1)
    first, last = 1, 1 + (len(rings) - 1) * SECTORS
    faces = [np.stack([np.zeros_like(i), first + j, first + i], axis=1)]
    for start in range(1, last, SECTORS):
        a, b, c, e = start + i, start + j, start + SECTORS + j, start + SECTORS + i
        faces += [np.stack([a, b, c], axis=1), np.stack([a, c, e], axis=1)]
    faces.append(np.stack([np.full_like(i, len(vertices) - 1), last + i, last + j], axis=1))
    return vertices, np.concatenate(faces)


def _ring(radius, x):
    angle = 2.0 * np.pi * np.arange(SECTORS) / SECTORS
    return np.stack([np.full(SECTORS, x), radius * np.cos(angle), radius * np.sin(angle)], axis=1)
