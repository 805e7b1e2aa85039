"""The sagittal J-curve: circular arcs, tangent continuous, run through by their normal."""

from itertools import pairwise

import numpy as np

from deep_knee_bend import dimensions as d


def normal(phi):
    """Outward normals (..., 2) as (anterior, superior), phi in rad."""
    return np.stack([-np.sin(phi), -np.cos(phi)], axis=-1)


def _centres():
    """Centres (n, 2) and radii (n,) of the arcs, origin at the arc that holds ORIGIN_PHI."""
    arcs = np.array(d.SAGITTAL_ARCS)
    radii = arcs[:, 2]
    centres = np.zeros((len(arcs), 2))
    for i in range(1, len(arcs)):
        joint = normal(np.radians(arcs[i, 0]))
        centres[i] = centres[i - 1] + (radii[i - 1] - radii[i]) * joint
    home = np.searchsorted(arcs[:, 1], d.ORIGIN_PHI)
    return centres - centres[home], radii


CENTRES, RADII = _centres()
JOINTS = np.radians([arc[1] for arc in d.SAGITTAL_ARCS[:-1]])
PHI_RANGE = np.radians([d.SAGITTAL_ARCS[0][0], d.SAGITTAL_ARCS[-1][1]])


def point(phi, depth=0.0):
    """Points (..., 2) at `depth` mm below the profile along the inward normal."""
    arc = np.searchsorted(JOINTS, phi)
    reach = RADII[arc] - depth
    return CENTRES[arc] + reach[..., None] * normal(phi)


def nodes(spacings):
    """Normals (rad) that divide the profile; spacings: (from deg, to deg, mm) in turn."""
    pieces = []
    for start, end, spacing in spacings:
        joints = [start, *[j for j in np.degrees(JOINTS) if start + 1e-9 < j < end - 1e-9], end]
        for a, b in pairwise(joints):
            radius = RADII[np.searchsorted(JOINTS, np.radians((a + b) / 2))]
            count = max(1, int(np.ceil(np.radians(b - a) * radius / spacing)))
            pieces.append(np.radians(np.linspace(a, b, count, endpoint=False)))
    pieces.append(np.radians([spacings[-1][1]]))
    return np.concatenate(pieces)
