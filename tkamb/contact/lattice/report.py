"""From a solution of the lattice to the contract's result: pressures, sums, flags."""

from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np

from tkamb.contact.area import covered_areas
from tkamb.contact.lattice.flags import strain_flags, unresolved_flags, unsettled_flag
from tkamb.contact.lattice.problem import LEAST_NORMAL_Y, LatticeState, tangent_planes
from tkamb.contact.lattice.solver import Solution
from tkamb.contact.result import ContactResult, ContactStatus
from tkamb.geometry.frames import Array, Index, Mask

PressureRule = Literal["tributary", "source"]


def result_of(
    state: LatticeState,
    pose: Array,
    load: float | None,
    gaps: Array,
    solution: Solution,
    rule: PressureRule,
    forces_only: bool = False,
) -> ContactResult:
    """Return the contract's result.

    Args:
        state: prepared contact.
        pose: (4, 4) at approach 0 of the solution.
        load: N, or None when the pose was given.
        gaps: (c,) vertical gaps at that pose, m.
        solution: solution of the lattice.
        rule: how a nodal force becomes a pressure.
        forces_only: the residual and the field are those of the region: nothing is flagged.
    """
    # `evaluate` gets the final pose, `press` the pose of first touch, from which the solver's
    # approach is taken off.
    depth = solution.forces.approach if load is not None else 0.0
    pose = pose.copy()
    pose[1, 3] -= depth
    if solution.field is not None and not np.isfinite(solution.field).all():
        return ContactResult.failed(state, pose, "the solver diverged: its forces are not finite")
    force, pressure, area = _pressures(state, gaps - depth, solution, rule)
    with_fields = partial(
        ContactResult.of,
        status=ContactStatus.OK if solution.converged else ContactStatus.NOT_CONVERGED,
        iterations=solution.passes,
        residual=solution.residual.reported,
    )
    if forces_only:
        return with_fields(state, pose, pressure, gaps - depth, force, area, area)
    flags, collapsed = strain_flags(state, solution)
    if collapsed:
        return ContactResult.failed(state, pose, *flags)
    if not solution.converged:
        flags = (*flags, unsettled_flag(solution))
    gap = _gaps(state, pose, gaps - depth, force, solution)
    surface, covered = state.surface, area
    if rule == "tributary":
        covered = covered_areas(
            surface.points, surface.triangles, surface.triangle_area,
            pressure, gap, state.pair.material,
        )  # fmt: skip
    result = with_fields(state, pose, pressure, gap, force, area, covered, flags=flags)
    return replace(result, flags=(*result.flags, *unresolved_flags(state, result)))


def _pressures(
    state: LatticeState, gaps: Array, solution: Solution, rule: PressureRule
) -> tuple[Array, Array, Array]:
    """Return nodal forces (c, 3), pressures (c,) and the areas (c,) that they act on.

    Args:
        state: prepared contact.
        gaps: (c,) vertical gaps of the undeformed insert at the final pose, m.
        solution: what the solver found.
        rule: how a nodal force becomes a pressure.
    """
    force, size = np.zeros_like(state.surface.points), np.zeros(len(gaps))
    force[solution.candidates] = solution.forces.force[:, None] * solution.planes.normals
    size[solution.candidates] = solution.forces.force
    area = _areas(state, gaps, size > 0, rule)
    if rule == "source":
        # Sharma's pressure counts the part of a nodal force along the insert's normal.
        size = np.maximum(-np.einsum("ij,ij->i", force, state.surface.normals), 0.0)
    return force, size / area, area


def _gaps(state: LatticeState, pose: Array, gaps: Array, force: Array, solution: Solution) -> Array:
    """Return the gaps (c,), m: of the deformed insert in and beside the contact and where the
    undeformed bodies overlap, of the undeformed one elsewhere.

    Which nodes are candidates depends on the initial guess. A node beside the contact may be
    none, but its gap is needed to place the edge of contact.

    Args:
        state: prepared contact.
        pose: (4, 4) final.
        gaps: (c,) vertical gaps of the undeformed insert there, m.
        force: (c, 3) N.
        solution: what the solver found.
    """
    loaded: Mask = np.asarray(force.any(axis=1), bool)
    # The edge of contact depends on the deformed gaps of the neighbours only; farther away the
    # undeformed gap is near enough.
    close = beside(state.surface.triangles, loaded) | loaded | (gaps < 0)
    own = solution.candidates[close[solution.candidates]]
    gap = gaps.copy()
    gap[own] = solution.forces.gap[close[solution.candidates]]
    close[own] = False
    rest = np.flatnonzero(close)
    if rest.size:
        gap[rest] = gaps_of_others(state, pose, rest, solution)
    return gap


def gaps_of_others(state: LatticeState, pose: Array, nodes: Index, solution: Solution) -> Array:
    """Return the gaps (m,), m, of deformed nodes that are no candidates; inf: nothing above."""
    problem = state.problem
    if solution.field is not None:
        displacement = solution.field[problem.contact_nodes[nodes]]
    else:
        loaded = solution.forces.force != 0.0
        force = solution.forces.force[loaded, None] * solution.planes.normals[loaded]
        displacement = state.compliance.moved(nodes, solution.candidates[loaded], force)
    positions = problem.surface_points[nodes] + displacement
    planes = tangent_planes(problem, positions, pose, None)
    # A femoral normal that does not point down cannot be loaded by a vertical press.
    return np.where(planes.normal_y < LEAST_NORMAL_Y, planes.gap(positions), np.inf)


def _areas(state: LatticeState, gaps: Array, loaded: Mask, rule: PressureRule) -> Array:
    """Return the area (c,) that each node's force acts on, m².

    Sharma's rule: area that overlaps the undeformed insert, shared evenly by the nodes in
    contact; the pressure is then the force along the insert's normal over it.
    """
    if rule == "tributary" or not loaded.any():
        return state.surface.area
    overlap = float(state.surface.area[gaps < 0].sum())
    return np.where(loaded, overlap / loaded.sum(), state.surface.area)


def beside(triangles: Index, touched: Mask) -> Mask:
    """Return which nodes (n,) share a triangle with one in contact and are not in contact."""
    neighbours = np.zeros_like(touched)
    neighbours[triangles[touched[triangles].any(axis=1)]] = True
    return neighbours & ~touched
