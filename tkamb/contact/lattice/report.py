"""From a solution of the lattice to the contract's result: pressures, sums, flags."""

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from tkamb.contact.area import covered_areas
from tkamb.contact.lattice.coarse import beside, coarse_flags
from tkamb.contact.lattice.edges import edge_flags
from tkamb.contact.lattice.problem import STEEPEST, Indices, footing
from tkamb.contact.lattice.solver import Solution
from tkamb.contact.pressing import HALF
from tkamb.contact.result import ContactResult, ContactStatus, medial_points
from tkamb.geometry.frames import Array
from tkamb.units import MILLIMETRE

if TYPE_CHECKING:
    from tkamb.contact.lattice.model import LatticeState

Mask = NDArray[np.bool_]
PressureRule = Literal["tributary", "source"]

STRAIN_FLAG = -0.4
"""Principal strain below which a result is flagged: the law has no barrier at -100 %."""
MOST_UNSEEN = 0.2e-3
"""m; a node of a 3 mm cell misses the bottom of a ball of 15 mm by 0.15 mm."""
COLLAPSE = -1.0
"""Principal strain at which a cell is compressed to nothing: out of range."""


def result_of(
    state: "LatticeState",
    pose: Array,
    load: float | None,
    gaps: Array,
    solution: Solution,
    rule: PressureRule,
) -> ContactResult:
    """Return the contract's result.

    Args:
        state: prepared contact.
        pose: (4, 4) at approach 0 of the solution.
        load: N, or None when the pose was given.
        gaps: (c,) vertical gaps at that pose, m.
        solution: what the solver found.
        rule: how a nodal force becomes a pressure.
    """
    depth = solution.forces.approach if load is not None else 0.0
    pose = pose.copy()
    pose[1, 3] -= depth
    if solution.field is not None and not np.isfinite(solution.field).all():
        return ContactResult.failed(state, pose, "the solver left the range of numbers")
    flags, collapsed = _strain_flags(state, solution)
    if collapsed:
        return ContactResult.failed(state, pose, *flags)
    if not solution.converged:
        flags = (*flags, _unsettled(solution))
    force, pressure, area = _pressures(state, gaps - depth, solution, rule)
    gap = _gaps(state, pose, gaps - depth, force, solution)
    surface, covered = state.surface, area
    if rule == "tributary":
        covered = covered_areas(
            surface.points, surface.triangles, surface.triangle_area,
            pressure, gap, state.pair.material,
        )  # fmt: skip
    result = ContactResult.of(
        state, pose, pressure, gap, force, area, covered,
        status=ContactStatus.OK if solution.converged else ContactStatus.NOT_CONVERGED,
        iterations=solution.passes,
        residual=solution.residual,
        flags=flags,
    )  # fmt: skip
    return replace(result, flags=(*result.flags, *_unresolved_flags(state, result)))


def _pressures(
    state: "LatticeState", gaps: Array, solution: Solution, rule: PressureRule
) -> tuple[Array, Array, Array]:
    """Return nodal forces (c, 3), pressures (c,) and the areas (c,) they stand on.

    Args:
        state: prepared contact.
        gaps: (c,) vertical gaps of the undeformed insert at the final pose, m.
        solution: what the solver found.
        rule: how a nodal force becomes a pressure.
    """
    force, size = np.zeros_like(state.surface.points), np.zeros(len(gaps))
    force[solution.candidates] = solution.forces.force[:, None] * solution.footing.normals
    size[solution.candidates] = solution.forces.force
    area = _areas(state, gaps, size > 0, rule)
    if rule == "source":
        size = np.maximum(-np.einsum("ij,ij->i", force, state.surface.normals), 0.0)
    return force, size / area, area


def _gaps(
    state: "LatticeState", pose: Array, gaps: Array, force: Array, solution: Solution
) -> Array:
    """Return the gaps (c,), m: of the deformed insert in and beside the contact and where the
    undeformed bodies overlap, of the undeformed one elsewhere.

    Which nodes are candidates depends on how the solution began, so that a node beside the
    contact may be none; the edge of contact lies by its gap all the same.

    Args:
        state: prepared contact.
        pose: (4, 4) final.
        gaps: (c,) vertical gaps of the undeformed insert there, m.
        force: (c, 3) N.
        solution: what the solver found.
    """
    loaded: Mask = np.asarray(force.any(axis=1), bool)
    close = beside(state.surface.triangles, loaded) | loaded | (gaps < 0)
    own = solution.candidates[close[solution.candidates]]
    gap = gaps.copy()
    gap[own] = solution.forces.gap[close[solution.candidates]]
    close[own] = False
    rest = np.flatnonzero(close)
    if rest.size:
        gap[rest] = _gaps_of_others(state, pose, rest, force, solution)
    return gap


def _gaps_of_others(
    state: "LatticeState", pose: Array, nodes: Indices, force: Array, solution: Solution
) -> Array:
    """Return the gaps (m,), m, of deformed nodes that are no candidates; inf: nothing above."""
    problem = state.problem
    if solution.field is not None:
        moved = solution.field[problem.contact_nodes[nodes]]
    else:
        pushed = np.flatnonzero(force.any(axis=1))
        moved = state.pool.moved(nodes, pushed, force[pushed])
    positions = problem.surface_points[nodes] + moved
    foot = footing(problem, positions, pose, None)
    return np.where(foot.lean < STEEPEST, foot.gap(positions), np.inf)


def _areas(state: "LatticeState", gaps: Array, loaded: Mask, rule: PressureRule) -> Array:
    """Return the area (c,) that each node's force stands on, m².

    The source's rule: area that overlaps the undeformed insert, shared evenly by the nodes in
    contact; the pressure is then the force along the insert's normal over it.
    """
    if rule == "tributary" or not loaded.any():
        return state.surface.area
    overlap = float(state.surface.area[gaps < 0].sum())
    return np.where(loaded, overlap / loaded.sum(), state.surface.area)


def _unresolved_flags(state: "LatticeState", carried: ContactResult) -> tuple[str, ...]:
    """Return the flags of peaks that the cells do not resolve."""
    medial = medial_points(carried.points, carried.pose, state.pair.split)
    sides = {"medial": medial, "lateral": ~medial}
    pressures = {side: np.where(own, carried.pressure, 0.0) for side, own in sides.items()}
    peaks = {
        side: carried.points[np.argmax(pressure)]
        for side, pressure in pressures.items()
        if pressure.max(initial=0.0) > 0.0
    }
    floor, spacing = state.problem.floor, state.lattice.spacing
    return (
        *coarse_flags(state.surface.triangles, carried.pressure > 0, sides),
        *edge_flags(floor, carried.pose, spacing, peaks),
    )


def _unsettled(solution: Solution) -> str:
    """Return in words how far a solution that has not converged is from rest."""
    return (
        f"the solver has not converged: {100 * solution.residual:.2g} % of the force or of the way "
        f"to the femoral surface is left after {solution.passes} passes; is the femoral mesh rough?"
    )


def unseen_flags(state: "LatticeState", result: ContactResult, depth: float) -> Iterator[str]:
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


def _strain_flags(state: "LatticeState", solution: Solution) -> tuple[tuple[str, ...], bool]:
    """Return the flags and whether the insert is compressed to nothing."""
    if solution.field is not None:
        least = state.problem.solid.least_principal_strain(solution.field)
        kind = "principal strain"
    else:
        sunk = solution.displacement[:, 1] / state.surface.thickness[solution.candidates]
        least, kind = float(sunk.min(initial=0.0)), "mean strain of a column"
    if least <= COLLAPSE:
        return (f"{kind} {least:.2f}: the insert is compressed to nothing",), True
    return ((f"{kind} {least:.2f} is below {STRAIN_FLAG}",) if least < STRAIN_FLAG else ()), False
