"""Peaks that a grid cannot resolve: where the femoral surface turns sharply under them.

At a rounded edge narrower than the cells the pressure is that of a punch: it rises for as long
as the cells shrink (docs/lattice.md, "Convergence on real implants").
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from tkamb.contact.lattice.femoral import FemoralFloor
from tkamb.geometry.frames import Array
from tkamb.units import DEGREE, MILLIMETRE

REACH = 2.0
"""Cells from the peak to where the normal is looked at: a peak lies just inside its edge."""
LEAST_REACH = 2.0 * MILLIMETRE
"""And at least so far: an edge of 6 mm radius is an edge for any cell."""
SHARPEST = 20.0 * DEGREE
"""Turn of the femoral normal over that way from which a peak is flagged: a radius of 6 cells."""

AROUND = np.array([(x, 0.0, z) for x in (-1, 0, 1) for z in (-1, 0, 1)], float)


def edge_flags(
    floor: FemoralFloor,
    pose: Array,
    spacing: Array,
    peaks: Mapping[str, Array],
) -> tuple[str, ...]:
    """Return a flag for each peak where the femoral normal turns by more than `SHARPEST`.

    The normal under the peak is compared with those `REACH` cells, at least `LEAST_REACH`, away
    along x, z and both diagonals; where there is no femoral surface any more it ends.

    Args:
        floor: the femoral component seen from below.
        pose: (4, 4) pose_femoral_in_insert.
        spacing: (3,) m, edges of a cell.
        peaks: side -> (3,) m, where its pressure is highest, insert frame.
    """
    reach = np.maximum(REACH * spacing, LEAST_REACH)
    around = AROUND / np.maximum(np.linalg.norm(AROUND, axis=1), 1.0)[:, None] * reach
    sites = (np.array(list(peaks.values())).reshape(-1, 1, 3) + around).reshape(-1, 3)
    normals = floor.over(sites, pose)[1].reshape(len(peaks), len(AROUND), 3)
    sharp = zip(peaks, map(_sharpness, normals), strict=True)
    return tuple(
        f"the {side} peak pressure lies at an edge of the femoral component, which {how} "
        f"within {reach.max() / MILLIMETRE:.2g} mm: it rises as cells shrink"
        for side, how in sharp
        if how
    )


def _sharpness(normals: NDArray[np.float64]) -> str:
    """Return in words how sharply the surface turns around the middle point, if it does."""
    if not np.isfinite(normals).all():
        return "ends"
    cosine = normals @ normals[len(AROUND) // 2]
    turn = float(np.arccos(np.clip(cosine.min(), -1.0, 1.0)))
    return f"turns by {turn / DEGREE:.0f} deg" if turn > SHARPEST else ""
