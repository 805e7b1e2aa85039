"""The femoral component: the sagittal J-curve swept with a coronal groove-and-ridge profile.

A point of the articular surface is named by (phi, z): the normal of the sagittal profile and
the ML position. It lies `depth` below the profile along the inward normal, so that every
condyle is a torus piece: sagittal radius at the ridge, CORONAL_RADIUS across it.
"""

import numpy as np

from deep_knee_bend import dimensions as d
from deep_knee_bend import sagittal, solids

ROW_SPACING = (
    (-100.0, -15.0, 1.3),
    (-15.0, 12.0, 0.72),
    (12.0, 35.0, 0.64),
    (35.0, 135.0, 0.56),
    (135.0, 150.0, 0.9),
)
"""Spacing of the mesh's rows, mm, between normals in deg: fine where the insert is met."""


def _taper(phi):
    """0 at the top of the flange, 1 from the trochlea on, smooth (rad in)."""
    start, end = np.radians(d.FLANGE_TAPER_PHI)
    s = np.clip((phi - start) / (end - start), 0.0, 1.0)
    return s * s * (3.0 - 2.0 * s)


def ridge(phi):
    """ML distance of the ridge (apex of the condyle) from the middle."""
    top = d.RIDGE_HALF_AT_FLANGE_TOP
    return top + (d.CONDYLE_SPACING_HALF - top) * _taper(phi)


def width(phi):
    """ML distance of the outer edge from the middle."""
    top = d.WIDTH_HALF_AT_FLANGE_TOP
    return top + (d.WIDTH_HALF - top) * _taper(phi)


def notch(phi):
    """ML distance of the notch's edge from the middle: an elliptic front, then parallel."""
    start, end = np.radians(d.NOTCH_PHI)
    s = np.clip((phi - start) / (end - start), 0.0, 1.0)
    s = np.where(s < 1e-9, 0.0, s)
    return d.NOTCH_WIDTH_HALF * np.sqrt(s * (2.0 - s))


def groove_depth(phi):
    """Depth of the groove's floor below the ridges: groove arc and ridge arc are tangent."""
    reach = d.GROOVE_RADIUS + d.CORONAL_RADIUS
    return reach - np.sqrt(reach**2 - ridge(phi) ** 2)


def _fillet(distance, radius):
    """Drop of a rounded edge at `distance` from it."""
    inside = np.clip(radius - distance, 0.0, radius)
    return radius - np.sqrt(radius**2 - inside**2)


def depth(phi, z):
    """Depth of the articular surface below the sagittal profile of the ridges."""
    u, apex = np.abs(z), ridge(phi)
    tangent = apex * d.GROOVE_RADIUS / (d.GROOVE_RADIUS + d.CORONAL_RADIUS)
    across = np.clip(u - apex, -d.CORONAL_RADIUS, d.CORONAL_RADIUS)
    convex = d.CORONAL_RADIUS - np.sqrt(d.CORONAL_RADIUS**2 - across**2)
    inside = np.minimum(u, d.GROOVE_RADIUS)
    concave = groove_depth(phi) - d.GROOVE_RADIUS + np.sqrt(d.GROOVE_RADIUS**2 - inside**2)
    edge = notch(phi)
    drop = _fillet(u - edge, d.NOTCH_FILLET) * edge / d.NOTCH_WIDTH_HALF
    outer = _fillet(width(phi) - u, d.FEMORAL_EDGE_FILLET)
    return np.where(u < tangent, concave, convex) + drop + outer


def surface(phi, z):
    """Points (..., 3) of the articular surface in the femoral frame, mm."""
    phi, z = np.broadcast_arrays(phi, z)
    profile = sagittal.point(phi, depth(phi, z))
    return np.concatenate([profile, z[..., None]], axis=-1)


def groove(phi):
    """Points (..., 2) of the groove's floor in the sagittal plane, mm."""
    return sagittal.point(phi, groove_depth(phi))


def _bone_side(phi, z):
    """Points (..., 3) of the surface towards the bone."""
    top = d.FEMORAL_THICKNESS_AT_FLANGE_TOP
    thickness = top + (d.FEMORAL_THICKNESS - top) * _taper(phi)
    return np.concatenate([sagittal.point(phi, thickness), z[..., None]], axis=-1)


def _columns(phi):
    """ML stations (rows, columns) of the right half, from the notch's edge outwards."""
    apex, outer, inner = ridge(phi)[:, None], width(phi)[:, None], notch(phi)[:, None]
    rest = outer - d.FEMORAL_EDGE_FILLET
    near, far = apex - 9.0, apex + 0.8 * (rest - apex)
    turn = np.sin(np.radians(np.linspace(0.0, 90.0, 5)))[1:]
    return np.concatenate(
        [
            inner + (near - inner) * np.linspace(0.0, 1.0, 13)[:-1],
            near + (far - near) * np.linspace(0.0, 1.0, 24)[:-1],
            far + (rest - far) * np.linspace(0.0, 1.0, 3),
            rest + d.FEMORAL_EDGE_FILLET * turn,
        ],
        axis=1,
    )


def _rows():
    """Normals of the rows: fine where the insert is met, and across the notch's front."""
    start, end = np.radians(d.NOTCH_PHI)
    front = start + (end - start) * (1.0 - np.cos(np.radians(np.linspace(0.0, 30.0, 5))))
    rows = sagittal.nodes(ROW_SPACING)
    apart = np.abs(rows[:, None] - front).min(axis=1) > np.radians(0.3)
    return np.sort(np.concatenate([rows[apart], front]))


def mesh():
    """Closed triangulation (vertices mm, faces) in the femoral frame."""
    rows = _rows()
    half = _columns(rows)
    z = np.concatenate([-half[:, ::-1], half], axis=1)
    phi = np.broadcast_to(rows[:, None], z.shape)
    outer, inner = surface(phi, z), _bone_side(phi, z)
    bridge = int(np.searchsorted(rows, np.radians(d.NOTCH_PHI[0]) + 1e-9)) - 1
    middle = z.shape[1] // 2
    columns = {0, *range(0, middle, 5), middle - 1, middle, *range(middle, 2 * middle, 5)}
    kept = sorted({*range(0, len(rows), 4), bridge, len(rows) - 1})
    return solids.close_sheets(outer, inner, kept, sorted({*columns, 2 * middle - 1}), bridge)
