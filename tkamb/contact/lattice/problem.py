"""One insert under one femoral component, discretised: what every contact solver needs."""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from tkamb.contact.lattice.linear.compliance import ComplianceCache
from tkamb.contact.lattice.linear.multifrontal import Shares
from tkamb.contact.lattice.linear.operator import ElasticOperator
from tkamb.contact.lattice.meshing.contact_map import ContactMap
from tkamb.contact.lattice.meshing.grid import Lattice
from tkamb.contact.lattice.solid import Solid
from tkamb.contact.pair import PreparedContact
from tkamb.geometry.curved import CurvedSurface
from tkamb.geometry.frames import Array, Index, Mask, inverse, rotate, transform
from tkamb.geometry.rays import RayCaster
from tkamb.geometry.surface import Surface

Direction = Literal["normal", "vertical"]

LEAST_NORMAL_Y = -0.05
"""Largest y of a femoral normal that a vertical press can load: 87 deg from the vertical."""
UP = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True, eq=False)
class SurfaceFromBelow:
    """The lowest femoral surface over any x and z of the insert.

    Rays meet the triangles; from there they go on to the curved patches over them
    (`CurvedSurface`), so that facets leave no pattern in the pressure.

    Args:
        surface: femoral component, femoral frame.
        rays: its ray caster.
    """

    surface: Surface
    rays: RayCaster

    @cached_property
    def _curved(self) -> CurvedSurface:
        return CurvedSurface.of(self.surface)

    def over(self, points: Array, pose: Array) -> tuple[Array, Array]:
        """Return the lowest femoral points (n, 3) above or below points, and their normals.

        Vertical rays come from below everything. NaN where there is no femoral surface.

        Args:
            points: (n, 3) m, insert frame; only x and z count.
            pose: (4, 4) pose_femoral_in_insert.

        Returns:
            Points and outward unit normals (n, 3), insert frame. Normals are interpolated
            between vertices, so that they are continuous across the triangles of a smooth
            part; they point down.
        """
        back = inverse(pose)
        start = float(pose[1, 3]) - 2 * float(np.abs(self.surface.bounds).max()) - 1e-2
        below = points.copy()
        below[:, 1] = start
        origins, up = transform(back, below), rotate(back, UP)
        distance, face, weights = self.rays.first_in_face(origins, up)
        shift, outward = self._curved.shift(face, weights, up)
        below[:, 1] += distance + shift
        below[face < 0] = np.nan
        outward = rotate(pose, outward)
        return below, np.where(outward[:, 1:2] > 0, -outward, outward)


@dataclass(frozen=True, eq=False)
class ContactProblem:
    """A solid, its linear operator, the nodes that can be touched and what touches them.

    Args:
        solid: cells and material.
        operator: factor of the linear stiffness.
        index: (n, 3) lattice index of each node.
        held: (3n,) unknowns held by the boundary.
        femoral: the femoral component from below.
        direction: nodes are pressed along the femoral normal, or vertically (Sharma 2008).
        lift: (c,) m along y, from the contact nodes to the smooth surface that their mesh
            stands for; 0: they are taken where they are.
    """

    solid: Solid
    operator: ElasticOperator
    index: Index
    held: Mask
    femoral: SurfaceFromBelow
    direction: Direction = "normal"
    lift: Array | float = 0.0

    @property
    def contact_nodes(self) -> Index:
        """Nodes (c,) that can be touched."""
        return self.operator.contact_nodes

    @cached_property
    def surface_points(self) -> Array:
        """Undeformed contact nodes (c, 3), m, on the smooth surface of the insert."""
        points = self.solid.nodes[self.operator.contact_nodes]
        points[:, 1] += self.lift
        points.flags.writeable = False
        return points

    @cached_property
    def held_unknowns(self) -> Index:
        """Which of the 3n unknowns are held."""
        return np.flatnonzero(self.held)

    @cached_property
    def free_nodes(self) -> Mask:
        """Which nodes (n,) can move at all."""
        return np.asarray(~self.held.reshape(-1, 3).all(axis=1), bool)

    @cached_property
    def everywhere(self) -> "Region":
        """The region of all elements."""
        return Region.of(self, np.arange(len(self.solid.scatter.elements)))


@dataclass(frozen=True, eq=False)
class TangentPlanes:
    """The femoral surface over some contact nodes, at zero approach: one plane each.

    Args:
        points: (m, 3) femoral points on the verticals through the nodes.
        normals: (m, 3) femoral outward unit normals there.
    """

    points: Array
    normals: Array

    def gap(self, positions: Array) -> Array:
        """Return the gap (m,) of deformed nodes to the planes, m."""
        return np.einsum("ij,ij->i", self.normals, positions - self.points)

    @property
    def normal_y(self) -> Array:
        """y of the normals (m,), negative."""
        return self.normals[:, 1]

    def part(self, nodes: Index) -> "TangentPlanes":
        """Return the planes over some of the nodes."""
        return TangentPlanes(self.points[nodes], self.normals[nodes])

    def raised(self, height: float) -> "TangentPlanes":
        """Return the planes when the femoral component has moved along y (m)."""
        return TangentPlanes(self.points + np.array([0.0, height, 0.0]), self.normals)


def undeformed(problem: ContactProblem, pose: Array) -> tuple[Array, TangentPlanes]:
    """Return vertical gaps (c,) and planes of all contact nodes where they are at rest.

    The gap is inf where there is no femoral surface above.
    """
    points = problem.surface_points
    planes = tangent_planes(problem, points, pose, None)
    usable = planes.normal_y < LEAST_NORMAL_Y
    return np.where(usable, planes.points[:, 1] - points[:, 1], np.inf), planes


def tangent_planes(
    problem: ContactProblem, positions: Array, pose: Array, last: TangentPlanes | None
) -> TangentPlanes:
    """Fire the vertical rays through displaced nodes again.

    A node that has slid from under the femoral component keeps its last plane.
    """
    points, normals = problem.femoral.over(positions, pose)
    lost = ~(normals[:, 1] < LEAST_NORMAL_Y)
    if last is not None:
        points[lost], normals[lost] = last.points[lost], last.normals[lost]
    if problem.direction == "vertical":
        normals = np.where(np.isnan(normals), np.nan, [0.0, -1.0, 0.0])
    return TangentPlanes(points, normals)


@dataclass(frozen=True, eq=False)
class Region:
    """Some elements (cells, springs) of a problem's solid, and what of the factor is theirs.

    Args:
        elements: (k,) increasing.
        nodes: (m,) their nodes that are not held.
        fronts: what of the factor these nodes need.
        whole: these are all elements.
    """

    elements: Index
    nodes: Index
    fronts: Shares
    whole: bool

    @classmethod
    def of(cls, problem: ContactProblem, elements: Index) -> "Region":
        """Return the region of some elements of the problem's solid."""
        scatter = problem.solid.scatter
        touched = np.zeros(scatter.nodes, bool)
        touched[scatter.elements[elements]] = True
        nodes = np.flatnonzero(touched & problem.free_nodes)
        whole = len(elements) == len(scatter.elements)
        return cls(elements, nodes, problem.operator.fronts_of(nodes), whole)


@dataclass(frozen=True, eq=False)
class LatticeState(PreparedContact):
    """What depends on geometry and material alone.

    Args:
        lattice: the insert's grid.
        problem: solid, factorised operator and femoral component.
        compliance: that of the contact nodes asked for last; it changes no answer.
    """

    surface: ContactMap
    lattice: Lattice
    problem: ContactProblem
    compliance: ComplianceCache

    @property
    def node_count(self) -> int:
        """Nodes of the grid."""
        return len(self.lattice.nodes)
