"""The insert: a dished height field over a kidney-shaped outline, flat below.

The dish is a coronal arc moved along a sagittal arc, so the two curvatures are exact at its
low line; the eminence between the dishes is an arc tangent to both.
"""

import numpy as np

from deep_knee_bend import dimensions as d
from deep_knee_bend import solids


def _sagittal(x):
    s = x - d.DISH_LOW_POINT_AP
    radius = np.where(s > 0, d.DISH_RADIUS_ANTERIOR, d.DISH_RADIUS_POSTERIOR)
    return radius - np.sqrt(radius**2 - s**2)


def eminence_radius():
    """Radius of the arc of EMINENCE_HEIGHT that is tangent to both dishes."""
    r, h, w = d.DISH_CORONAL_RADIUS, d.EMINENCE_HEIGHT, d.CONDYLE_SPACING_HALF
    return (w**2 + (r - h) ** 2 - r**2) / (2.0 * h)


def _coronal(z):
    u, arc, bump = np.abs(z), d.DISH_CORONAL_RADIUS, eminence_radius()
    tangent = d.CONDYLE_SPACING_HALF * bump / (bump + arc)
    across = np.clip(u - d.CONDYLE_SPACING_HALF, -arc, arc)
    dish = arc - np.sqrt(arc**2 - across**2)
    hill = d.EMINENCE_HEIGHT - bump + np.sqrt(bump**2 - np.minimum(u, bump) ** 2)
    return np.where(u < tangent, hill, dish)


def height(x, z):
    """Height (mm) of the articular surface above the flat bottom, insert frame."""
    return d.INSERT_THICKNESS + _sagittal(x) + _coronal(z)


def _outline(z):
    """Posterior and anterior edge (2, n) at the ML stations, before centring."""
    u = np.abs(z) / (d.INSERT_WIDTH_HALF * 1.004)
    front = d.INSERT_DEPTH_HALF * (1.0 - u**3.0) ** (1.0 / 2.2)
    back = -d.INSERT_DEPTH_HALF * (1.0 - u**6.0) ** (1.0 / 2.2)
    notch = d.POSTERIOR_NOTCH_DEPTH * np.exp(-((z / d.POSTERIOR_NOTCH_WIDTH) ** 2))
    return np.stack([back + notch, front])


def _columns():
    """ML stations, closer at the rounded ends."""
    inner = np.linspace(0.0, 33.0, 49)
    end = d.INSERT_WIDTH_HALF - 33.0
    turn = np.sin(np.radians(np.linspace(0.0, 90.0, 13)))[1:]
    half = np.concatenate([inner, 33.0 + end * turn])
    return np.concatenate([-half[:0:-1], half])


def _fillet_drop(distance, radius):
    inside = np.clip(radius - distance, 0.0, radius)
    return radius - np.sqrt(radius**2 - inside**2)


def mesh():
    """Closed triangulation (vertices mm, faces) in the insert frame."""
    z = _columns()
    edges = _outline(z)
    back, front = edges - (edges.min() + edges.max()) / 2.0
    fillet = np.minimum(d.INSERT_EDGE_FILLET, (front - back) / 4.0)
    turn = (1.0 - np.cos(np.radians(np.linspace(0.0, 90.0, 5)[:-1])))[:, None]
    inside = np.linspace(0.0, 1.0, 71)[:, None]
    x = np.concatenate(
        [
            back + fillet * turn,
            back + fillet + (front - back - 2.0 * fillet) * inside,
            front - fillet * turn[::-1],
        ]
    )
    z = np.broadcast_to(z, x.shape)
    drop = _fillet_drop(np.minimum(x - back, front - x), fillet)
    drop = drop + _fillet_drop(d.INSERT_WIDTH_HALF - np.abs(z), d.INSERT_EDGE_FILLET)
    top = np.stack([x, height(x, z) - drop, z], axis=-1)
    bottom = top * np.array([1.0, 0.0, 1.0])
    columns = np.arange(z.shape[1])
    return solids.close_sheets(top, bottom, [0, len(x) - 1], columns)
