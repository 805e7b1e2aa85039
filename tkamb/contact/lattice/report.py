"""From a solution of the lattice to a `ContactResult`: pressures, areas and flags.

Flags mark large strains, and peaks that the cells do not resolve: at a rounded edge narrower than
the cells, the peak rises with every refinement (docs/lattice.md, "Convergence on real implants");
in a contact too narrow for the cells, it is an average over a larger area.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tkamb.contact.area import covered_areas
from tkamb.contact.flags import MESH_DEFECT, narrow_flags
from tkamb.contact.lattice.problem import (
    LEAST_NORMAL_Y,
    LatticeState,
    SurfaceFromBelow,
    tangent_planes,
)
from tkamb.contact.lattice.solver import Solution
from tkamb.contact.pressing import PRESS
from tkamb.contact.result import ContactResult, ContactStatus, medial_points
from tkamb.geometry.frames import Array, Index, Mask
from tkamb.units import DEGREE, MILLIMETRE

# Cells: distance from the peak at which the femoral normal is evaluated. A peak at
# an edge lies one or two cells inside it.
EDGE_DISTANCE_CELLS = 2.0
# m: smallest distance from the peak at which the femoral normal is evaluated. An
# edge of 6 mm radius then counts as an edge with fine cells too.
LEAST_EDGE_DISTANCE = 2.0 * MILLIMETRE
# rad: a peak is flagged if the femoral normal turns by more over that distance. A
# radius of 6 cells turns by this angle.
SHARP_EDGE_ANGLE = 20.0 * DEGREE
# 1: a result with a smaller principal strain is flagged. The material law does not
# prevent strains below -1, and measured curves end before -0.4.
STRAIN_FLAG = -0.4
# m: a press is flagged if its travel from first touch to the first contact node is larger.
# The nodes of 3 mm cells miss the bottom of a ball of 15 mm radius by 0.15 mm.
MAX_UNSEEN_HEIGHT = 0.2e-3
# 1: principal strain at which a cell has no thickness left. The result is then out of range. By
# definition of the strain.
COLLAPSE_STRAIN = -1.0


AROUND = np.array([(x, 0.0, z) for x in (-1, 0, 1) for z in (-1, 0, 1)], float)
"""Directions along x, z and the diagonals, with the centre in the middle row, (9, 3)."""


def unresolved_flags(state: LatticeState, result: ContactResult) -> tuple[str, ...]:
    """Return the flags of peaks that the cells do not resolve."""
    medial = medial_points(result.points, result.pose, state.pair.split)
    sides = {"medial": medial, "lateral": ~medial}
    pressures = {side: np.where(points, result.pressure, 0.0) for side, points in sides.items()}
    peaks = {
        side: result.points[np.argmax(pressure)]
        for side, pressure in pressures.items()
        if pressure.max(initial=0.0) > 0.0
    }
    femoral, spacing = state.problem.femoral, state.lattice.spacing
    narrow = narrow_flags(state.surface.triangles, result.pressure > 0, sides)
    # Finer cells do not help against a rough surface; an opening says nothing about their size.
    if any(MESH_DEFECT in flag and "opening" not in flag for flag in result.flags):
        narrow = iter(())
    return (
        *narrow,
        *edge_flags(femoral, result.pose, spacing, peaks),
    )


def edge_flags(
    femoral: SurfaceFromBelow,
    pose: Array,
    spacing: Array,
    peaks: Mapping[str, Array],
) -> tuple[str, ...]:
    """Return a flag for each peak that lies at an edge of the femoral component.

    The femoral normal at the peak is compared with eight normals around it, at
    `EDGE_DISTANCE_CELLS` or, if larger, `LEAST_EDGE_DISTANCE`. A turn by more than
    `SHARP_EDGE_ANGLE` or an end of the surface is an edge. `spacing` (3,), m, are the edges of a
    cell, `peaks` points (3,), m, insert frame.
    """
    distance = np.maximum(EDGE_DISTANCE_CELLS * spacing, LEAST_EDGE_DISTANCE)
    # All eight directions have the same length.
    around = AROUND / np.maximum(np.linalg.norm(AROUND, axis=1), 1.0)[:, None] * distance
    sites = (np.array(list(peaks.values())).reshape(-1, 1, 3) + around).reshape(-1, 3)
    normals = femoral.over(sites, pose)[1].reshape(len(peaks), len(AROUND), 3)
    sharpness = zip(peaks, map(_sharpness, normals), strict=True)
    return tuple(
        f"the {side} peak pressure lies at an edge of the femoral component, which {words} "
        f"within {distance.max() / MILLIMETRE:.2g} mm: the peak rises as cells shrink"
        for side, words in sharpness
        if words
    )


def _sharpness(normals: NDArray[np.float64]) -> str:
    """Return in words how the femoral surface turns or ends; "" if it is smooth."""
    if not np.isfinite(normals).all():
        return "ends"
    # The middle row is the normal at the peak itself.
    cosine = normals @ normals[len(AROUND) // 2]
    turn = float(np.arccos(np.clip(cosine.min(), -1.0, 1.0)))
    return f"turns by {turn / DEGREE:.0f} deg" if turn > SHARP_EDGE_ANGLE else ""


def strain_flags(state: LatticeState, solution: Solution) -> tuple[tuple[str, ...], bool]:
    """Return the flags of large strains, and whether a cell has no thickness left."""
    if solution.field is not None:
        solid = state.problem.solid
        least = solid.least_principal_strain(solution.field)
        kind = "principal strain"
    else:
        # A linear solution has only the displacement of the candidates.
        strains = solution.displacement[:, 1] / state.surface.thickness[solution.candidates]
        least, kind = float(strains.min(initial=0.0)), "mean strain of a column"
    if least <= COLLAPSE_STRAIN:
        return (f"{kind} {least:.2f}: the insert is compressed to nothing",), True
    return ((f"{kind} {least:.2f} is below {STRAIN_FLAG}",) if least < STRAIN_FLAG else ()), False


def unseen_flags(state: LatticeState, result: ContactResult, depth: float) -> Iterator[str]:
    """Yield a flag if the meshes touch long before any node does.

    `depth`, m, is the femoral travel of a press since it touched the first contact node.
    """
    unseen = result.approach - depth
    if unseen > max(MAX_UNSEEN_HEIGHT, PRESS.flagged_thickness_share * result.approach):
        yield (
            f"the meshes first touch {unseen / MILLIMETRE:.2g} mm before any node does (cells of "
            f"{state.lattice.spacing.max() / MILLIMETRE:.2g} mm); the approach counts from first "
            "touch: check the meshes for a spike or a ridge"
        )


def unconverged_flag(solution: Solution) -> str:
    """Return the flag of a solution that has not converged, with its residual."""
    percent = 100 * solution.residual.reported
    return (
        f"the solver has not converged: after {solution.passes} passes the residual is "
        f"{percent:.2g} % of the force or of the distance to the femoral surface; "
        "check whether the femoral mesh is rough"
    )


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
    """Return the result of a solution.

    Args:
        pose: pose at approach 0 of the solution, (4, 4).
        load: N, or None if the pose was given.
        gaps: vertical gaps at that pose, m, (c,).
        rule: rule for the area that a nodal force acts on.
        forces_only: the solution is that of the region, and nothing is flagged.
    """
    # A pose that was given is final. The pose of a press is that of first touch, and the femoral
    # component moves down by the approach.
    depth = solution.forces.approach if load is not None else 0.0
    pose = pose.copy()
    pose[1, 3] -= depth
    if solution.field is not None and not np.isfinite(solution.field).all():
        return ContactResult.out_of_range(
            state, pose, "the solver diverged: its forces are not finite"
        )
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
        return ContactResult.out_of_range(state, pose, *flags)
    if not solution.converged:
        flags = (*flags, unconverged_flag(solution))
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
    """Return forces (c, 3), N, pressures (c,), Pa, and their areas (c,), m².

    `gaps` are those of the undeformed insert at the final pose.
    """
    force, size = np.zeros_like(state.surface.points), np.zeros(len(gaps))
    force[solution.candidates] = solution.forces.force[:, None] * solution.planes.normals
    size[solution.candidates] = solution.forces.force
    area = _areas(state, gaps, size > 0, rule)
    if rule == "source":
        # Sharma's pressure uses the component of the nodal force along the insert's normal.
        size = np.maximum(-np.einsum("ij,ij->i", force, state.surface.normals), 0.0)
    return force, size / area, area


def _gaps(state: LatticeState, pose: Array, gaps: Array, force: Array, solution: Solution) -> Array:
    """Return (c,), m.

    They are those of the deformed insert in and beside the contact, and where the undeformed bodies
    overlap. Elsewhere they are `gaps` of the undeformed insert at this pose. The edge of contact
    depends on those beside it, but the candidates on the initial guess: a gap there is computed for
    any node.
    """
    loaded: Mask = np.asarray(force.any(axis=1), bool)
    close = beside(state.surface.triangles, loaded) | loaded | (gaps < 0)
    candidates = solution.candidates[close[solution.candidates]]
    gap = gaps.copy()
    gap[candidates] = solution.forces.gap[close[solution.candidates]]
    close[candidates] = False
    others = np.flatnonzero(close)
    if others.size:
        gap[others] = gaps_of_others(state, pose, others, solution)
    return gap


def gaps_of_others(state: LatticeState, pose: Array, nodes: Index, solution: Solution) -> Array:
    """Return the gaps (m,), m, of displaced nodes that are no candidates; inf: no surface above."""
    problem = state.problem
    if solution.field is not None:
        displacement = solution.field[problem.contact_nodes[nodes]]
    else:
        loaded = solution.forces.force != 0.0
        force = solution.forces.force[loaded, None] * solution.planes.normals[loaded]
        displacement = state.compliance.displacement(nodes, solution.candidates[loaded], force)
    positions = problem.surface_points[nodes] + displacement
    planes = tangent_planes(problem, positions, pose, None)
    # A steep femoral surface cannot be loaded by a vertical press.
    return np.where(planes.normal_y < LEAST_NORMAL_Y, planes.gap(positions), np.inf)


def _areas(state: LatticeState, gaps: Array, loaded: Mask, rule: PressureRule) -> Array:
    """Return the area (c,), m², of each node's force.

    By Sharma's rule, the nodes in contact have equal shares of the undeformed bodies' overlap.
    """
    if rule == "tributary" or not loaded.any():
        return state.surface.area
    overlap = float(state.surface.area[gaps < 0].sum())
    return np.where(loaded, overlap / loaded.sum(), state.surface.area)


def beside(triangles: Index, in_contact: Mask) -> Mask:
    """Return the nodes (n,) out of contact that share a triangle with one in it."""
    neighbours = np.zeros_like(in_contact)
    neighbours[triangles[in_contact[triangles].any(axis=1)]] = True
    return neighbours & ~in_contact
