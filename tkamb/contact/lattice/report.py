"""From a solution of the lattice to the contract's result: pressures, sums, flags."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from tkamb.contact.lattice.coarse import beside, coarse_flags
from tkamb.contact.lattice.covered import covered_areas
from tkamb.contact.lattice.edges import edge_flags
from tkamb.contact.lattice.problem import STEEPEST, Indices, footing
from tkamb.contact.lattice.solver import Solution
from tkamb.contact.pressing import approach_at, failed_result
from tkamb.contact.result import ContactResult, ContactStatus
from tkamb.contact.summary import medial_points, summarise_condyles, wrench_of
from tkamb.contact.validity import HALF, peak_flags
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


def untouched(state: "LatticeState", pose: Array, gaps: Array) -> ContactResult:
    """Return a result without contact; gaps (c,) are vertical, m."""
    nothing = np.zeros(len(gaps))
    return ContactResult(
        pose=pose,
        points=state.map.points,
        normals=state.map.normals,
        pressure=nothing,
        area=state.map.area,
        gap=gaps,
        nodal_force=np.zeros((len(gaps), 3)),
        wrench_on_insert=np.zeros(6),
        medial=None,
        lateral=None,
        approach=0.0,
    )


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
        return failed_result(state, pose, "the solver left the range of numbers")
    flags, collapsed = _strain_flags(state, solution)
    if collapsed:
        return failed_result(state, pose, *flags)
    if not solution.converged:
        flags = (*flags, _unsettled(solution))
    carried = _carried(state, pose, gaps - depth, solution, rule)
    return replace(
        carried,
        status=ContactStatus.OK if solution.converged else ContactStatus.NOT_CONVERGED,
        iterations=solution.passes,
        residual=solution.residual,
        flags=(*flags, *_peak_flags(state, carried)),
        approach=partial(approach_at, state.pair, pose),  # type: ignore[arg-type]
    )


def _carried(
    state: "LatticeState", pose: Array, gaps: Array, solution: Solution, rule: PressureRule
) -> ContactResult:
    """Return the map and its sums; gaps (c,) are those of the undeformed insert at the pose."""
    surface = state.map
    force, pressure, stood_on = _pressures(state, gaps, solution, rule)
    gap = _gaps(state, pose, gaps, force, solution)
    area = stood_on
    if rule == "tributary":
        area = covered_areas(
            surface.points, surface.triangles, surface.triangle_area,
            pressure, gap, state.pair.material,
        )  # fmt: skip
    medial, lateral = summarise_condyles(
        medial_points(surface.points, pose, state.split),
        surface.points, pressure, area, force, surface.thickness,
    )  # fmt: skip
    return ContactResult(
        pose=pose,
        points=surface.points,
        normals=surface.normals,
        pressure=pressure,
        area=stood_on,
        gap=gap,
        nodal_force=force,
        wrench_on_insert=wrench_of(surface.points, force),
        medial=medial,
        lateral=lateral,
        approach=0.0,
    )


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
    force, size = np.zeros_like(state.map.points), np.zeros(len(gaps))
    force[solution.candidates] = solution.forces.force[:, None] * solution.footing.normals
    size[solution.candidates] = solution.forces.force
    area = _areas(state, gaps, size > 0, rule)
    if rule == "source":
        size = np.maximum(-np.einsum("ij,ij->i", force, state.map.normals), 0.0)
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
    close = beside(state.map.triangles, loaded) | loaded | (gaps < 0)
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
        return state.map.area
    overlap = float(state.map.area[gaps < 0].sum())
    return np.where(loaded, overlap / loaded.sum(), state.map.area)


def _peak_flags(state: "LatticeState", carried: ContactResult) -> tuple[str, ...]:
    """Return the flags of peaks that the cells do not resolve."""
    medial = medial_points(carried.points, carried.pose, state.split)
    sides = {"medial": medial, "lateral": ~medial}
    pressures = {side: np.where(own, carried.pressure, 0.0) for side, own in sides.items()}
    peaks = {
        side: carried.points[np.argmax(pressure)]
        for side, pressure in pressures.items()
        if pressure.max(initial=0.0) > 0.0
    }
    floor, spacing = state.problem.floor, state.lattice.spacing
    return (
        *peak_flags(carried.medial, carried.lateral),
        *coarse_flags(state.map.triangles, carried.pressure > 0, sides),
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
        sunk = solution.displacement[:, 1] / state.map.thickness[solution.candidates]
        least, kind = float(sunk.min(initial=0.0)), "mean strain of a column"
    if least <= COLLAPSE:
        return (f"{kind} {least:.2f}: the insert is compressed to nothing",), True
    return ((f"{kind} {least:.2f} is below {STRAIN_FLAG}",) if least < STRAIN_FLAG else ()), False
