"""From a solution of the lattice to the contract's result: pressures, sums, flags.

Flags name strains, edges and contacts that the lattice does not resolve. At a rounded edge that is
narrower than the cells the pressure is that of a punch: it rises with every refinement
(docs/lattice.md, "Convergence on real implants"). If a contact is too narrow for the cells, the
peak is an average over an area larger than the contact.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tkamb.contact.area import covered_areas
from tkamb.contact.flags import narrow_flags
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


@dataclass(frozen=True)
class LatticeFlagSettings:
    """When a result of the lattice gets a flag."""

    edge_distance_cells: float = 2.0
    """Cells: distance from the peak at which the femoral normal is looked at. Chosen: a peak at an
    edge lies one or two cells inside it."""
    least_edge_distance: float = 2.0 * MILLIMETRE
    """m: smallest distance from the peak at which the femoral normal is looked at. Chosen: an edge
    of 6 mm radius counts as an edge with fine cells too."""
    sharp_edge_angle: float = 20.0 * DEGREE
    """rad: turn of the femoral normal over that distance from which a peak is flagged. Chosen: the
    turn of a radius of 6 cells."""
    strain_flag: float = -0.4
    """1: principal strain below which a result is flagged. The material law has no barrier at
    -1, and measured curves end before -0.4."""
    max_unseen_height: float = 0.2e-3
    """m: height of the femoral surface between nodes that may stay unseen. Chosen: a node of a 3 mm
    cell misses the bottom of a ball of 15 mm radius by 0.15 mm."""
    collapse_strain: float = -1.0
    """1: principal strain at which a cell is compressed to nothing; the result is out of range. By
    definition of the strain."""


LATTICE_FLAG = LatticeFlagSettings()


AROUND = np.array([(x, 0.0, z) for x in (-1, 0, 1) for z in (-1, 0, 1)], float)


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
    """Return a flag for each peak that lies at an edge of the femoral component.

    There the femoral normal turns by more than `LATTICE_FLAG.sharp_edge_angle`. The normal under
    the peak is compared with normals along x, z and both diagonals. Their distance from the peak is
    `LATTICE_FLAG.edge_distance_cells`, and at least `LATTICE_FLAG.least_edge_distance`. Each
    direction ends where the femoral surface ends.

    Args:
        femoral: the femoral component seen from below.
        pose: (4, 4) pose_femoral_in_insert.
        spacing: (3,) m, edges of a cell.
        peaks: side -> (3,) m, where its pressure is highest, insert frame.
    """
    reach = np.maximum(LATTICE_FLAG.edge_distance_cells * spacing, LATTICE_FLAG.least_edge_distance)
    # Eight directions at equal distance; the diagonals are shortened to it.
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
    # The middle row is the place of the peak itself.
    cosine = normals @ normals[len(AROUND) // 2]
    turn = float(np.arccos(np.clip(cosine.min(), -1.0, 1.0)))
    return f"turns by {turn / DEGREE:.0f} deg" if turn > LATTICE_FLAG.sharp_edge_angle else ""


def strain_flags(state: LatticeState, solution: Solution) -> tuple[tuple[str, ...], bool]:
    """Return the flags and whether the insert is compressed to nothing."""
    if solution.field is not None:
        solid = state.problem.solid
        least = solid.least_principal_strain(solution.field)
        kind = "principal strain"
    else:
        # A linear solver keeps no field of displacements: the mean strain of a column stands for
        # it.
        sunk = solution.displacement[:, 1] / state.surface.thickness[solution.candidates]
        least, kind = float(sunk.min(initial=0.0)), "mean strain of a column"
    if least <= LATTICE_FLAG.collapse_strain:
        return (f"{kind} {least:.2f}: the insert is compressed to nothing",), True
    return (
        (f"{kind} {least:.2f} is below {LATTICE_FLAG.strain_flag}",)
        if least < LATTICE_FLAG.strain_flag
        else ()
    ), False


def unseen_flags(state: LatticeState, result: ContactResult, depth: float) -> Iterator[str]:
    """Yield a flag where the meshes overlap much before any node is touched.

    Args:
        state: prepared contact.
        result: of a press.
        depth: m, how far the femoral component went below the first contact node.
    """
    unseen = result.approach - depth
    if unseen > max(
        LATTICE_FLAG.max_unseen_height, PRESS.flagged_thickness_share * result.approach
    ):
        yield (
            f"the meshes first touch {unseen / MILLIMETRE:.2g} mm before any node does (cells of "
            f"{state.lattice.spacing.max() / MILLIMETRE:.2g} mm); the approach counts from first "
            "touch: check the meshes for a spike or a ridge"
        )


def unsettled_flag(solution: Solution) -> str:
    """Return in words how large the residual of a solution is that has not converged."""
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
