"""What a reader must know of a lattice's answer: strains, edges and contacts it cannot resolve.

At a rounded edge narrower than the cells the pressure is that of a punch: it rises for as long
as the cells shrink (docs/lattice.md, "Convergence on real implants"). Of a contact too narrow
for the cells the peak is an average over more than the contact.
"""

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from tkamb.contact.lattice.problem import LatticeState, SurfaceFromBelow
from tkamb.contact.lattice.solver import Solution
from tkamb.contact.narrow import narrow_flags
from tkamb.contact.pressing import HALF
from tkamb.contact.result import ContactResult, medial_points
from tkamb.geometry.frames import Array
from tkamb.units import DEGREE, MILLIMETRE

REACH = 2.0
"""Cells from the peak to where the normal is looked at: a peak lies just inside its edge."""
LEAST_REACH = 2.0 * MILLIMETRE
"""And at least so far: an edge of 6 mm radius is an edge for any cell."""
SHARPEST = 20.0 * DEGREE
"""Turn of the femoral normal over that way from which a peak is flagged: a radius of 6 cells."""

AROUND = np.array([(x, 0.0, z) for x in (-1, 0, 1) for z in (-1, 0, 1)], float)
STRAIN_FLAG = -0.4
"""Principal strain below which a result is flagged: the law has no barrier at -100 %."""
MOST_UNSEEN = 0.2e-3
"""m; a node of a 3 mm cell misses the bottom of a ball of 15 mm by 0.15 mm."""
COLLAPSE = -1.0
"""Principal strain at which a cell is compressed to nothing: out of range."""


def unresolved_flags(state: LatticeState, result: ContactResult) -> tuple[str, ...]:
    """Return the flags of peaks that the cells do not resolve."""
    medial = medial_points(result.points, result.pose, state.pair.split)
    sides = {"medial": medial, "lateral": ~medial}
    pressures = {side: np.where(own, result.pressure, 0.0) for side, own in sides.items()}
    peaks = {
        side: result.points[np.argmax(pressure)]
        for side, pressure in pressures.items()
        if pressure.max(initial=0.0) > 0.0
    }
    femoral, spacing = state.problem.femoral, state.lattice.spacing
    return (
        *narrow_flags(state.surface.triangles, result.pressure > 0, sides),
        *edge_flags(femoral, result.pose, spacing, peaks),
    )


def edge_flags(
    femoral: SurfaceFromBelow,
    pose: Array,
    spacing: Array,
    peaks: Mapping[str, Array],
) -> tuple[str, ...]:
    """Return a flag for each peak where the femoral normal turns by more than `SHARPEST`.

    The normal under the peak is compared with those `REACH` cells, at least `LEAST_REACH`, away
    along x, z and both diagonals; where there is no femoral surface any more it ends.

    Args:
        femoral: the femoral component seen from below.
        pose: (4, 4) pose_femoral_in_insert.
        spacing: (3,) m, edges of a cell.
        peaks: side -> (3,) m, where its pressure is highest, insert frame.
    """
    reach = np.maximum(REACH * spacing, LEAST_REACH)
    around = AROUND / np.maximum(np.linalg.norm(AROUND, axis=1), 1.0)[:, None] * reach
    sites = (np.array(list(peaks.values())).reshape(-1, 1, 3) + around).reshape(-1, 3)
    normals = femoral.over(sites, pose)[1].reshape(len(peaks), len(AROUND), 3)
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


def strain_flags(state: LatticeState, solution: Solution) -> tuple[tuple[str, ...], bool]:
    """Return the flags and whether the insert is compressed to nothing."""
    if solution.field is not None:
        solid = state.problem.solid
        least = solid.least_principal_strain(solution.field, solution.noticed)
        kind = "principal strain"
    else:
        sunk = solution.displacement[:, 1] / state.surface.thickness[solution.candidates]
        least, kind = float(sunk.min(initial=0.0)), "mean strain of a column"
    if least <= COLLAPSE:
        return (f"{kind} {least:.2f}: the insert is compressed to nothing",), True
    return ((f"{kind} {least:.2f} is below {STRAIN_FLAG}",) if least < STRAIN_FLAG else ()), False


def unseen_flags(state: LatticeState, result: ContactResult, depth: float) -> Iterator[str]:
    """Yield a flag where much of the approach is seen by no node.

    Args:
        state: prepared contact.
        result: of a press.
        depth: m, how far the femoral component went below the first contact node.
    """
    unseen = result.approach - depth
    if unseen > max(MOST_UNSEEN, HALF * result.approach):
        yield (
            f"the meshes first touch {unseen / MILLIMETRE:.2g} mm before any node does (cells of "
            f"{state.lattice.spacing.max() / MILLIMETRE:.2g} mm); the approach counts from there: "
            "is there a spike or a ridge in a mesh?"
        )


def unsettled_flag(solution: Solution) -> str:
    """Return in words how far a solution that has not converged is from rest."""
    return (
        f"the solver has not converged: {100 * solution.residual:.2g} % of the force or of the way "
        f"to the femoral surface is left after {solution.passes} passes; is the femoral mesh rough?"
    )
