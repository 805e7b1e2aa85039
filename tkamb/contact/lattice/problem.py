"""The discretised contact problem of one insert and one femoral component."""

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
"""1: femoral normals with a larger y (3 deg short of horizontal) carry no load."""
UP = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True, eq=False)
class SurfaceFromBelow:
    """The lowest femoral surface over any x and z of the insert.

    A ray that meets a triangle is continued to its curved patch (`CurvedSurface`), so that facets
    leave no pattern in the pressure. The surface is in the femoral frame.
    """

    surface: Surface
    rays: RayCaster

    @cached_property
    def _curved(self) -> CurvedSurface:
        return CurvedSurface.of(self.surface)

    def over(self, points: Array, pose: Array) -> tuple[Array, Array]:
        """Return the lowest femoral points (n, 3) on the verticals through points, and normals.

        The rays begin below both bodies. Points, m, and outward unit normals, which point down, are
        in the insert frame; NaN where there is no femoral surface. Normals are interpolated between
        vertices, so that they are continuous on smooth parts. y of `points` (n, 3), m, is not used.
        """
        to_femoral = inverse(pose)
        start = float(pose[1, 3]) - 2 * float(np.abs(self.surface.bounds).max()) - 1e-2
        hits = points.copy()
        hits[:, 1] = start
        origins, up = transform(to_femoral, hits), rotate(to_femoral, UP)
        distance, face, weights = self.rays.first_in_face(origins, up)
        shift, outward = self._curved.shift(face, weights, up)
        hits[:, 1] += distance + shift
        hits[face < 0] = np.nan
        outward = rotate(pose, outward)
        return hits, np.where(outward[:, 1:2] > 0, -outward, outward)


@dataclass(frozen=True, eq=False)
class ContactProblem:
    """A solid, its linear operator, its contact nodes and the femoral component.

    Args:
        index: lattice index of each node, (n, 3).
        held: mask of the unknowns held by the boundary, (3n,).
        direction: of the contact forces: along the femoral normal, or vertical (Sharma 2008).
        lift: height of the smooth surface above the contact nodes, m, (c,), or 0.
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
        """Nodes (c,) of the contact surface."""
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
        """Numbers of the held unknowns."""
        return np.flatnonzero(self.held)

    @cached_property
    def free_nodes(self) -> Mask:
        """Mask (n,) of the nodes with at least one free unknown."""
        return np.asarray(~self.held.reshape(-1, 3).all(axis=1), bool)

    @cached_property
    def everywhere(self) -> "Region":
        """The region of all elements."""
        return Region.of(self, np.arange(len(self.solid.scatter.elements)))


@dataclass(frozen=True, eq=False)
class TangentPlanes:
    """The tangent planes of the femoral surface over contact nodes, at zero approach.

    Points and outward unit normals (m, 3), m, lie on the verticals through the nodes.
    """

    points: Array
    normals: Array

    def gap(self, positions: Array) -> Array:
        """Return the gaps (m,), m, between displaced nodes (m, 3) and the planes."""
        return np.einsum("ij,ij->i", self.normals, positions - self.points)

    @property
    def normal_y(self) -> Array:
        """y of the normals (m,), negative."""
        return self.normals[:, 1]

    def part(self, nodes: Index) -> "TangentPlanes":
        """Return the planes over a subset of the nodes."""
        return TangentPlanes(self.points[nodes], self.normals[nodes])

    def raised(self, height: float) -> "TangentPlanes":
        """Return the planes of a femoral component that is raised by `height`, m."""
        return TangentPlanes(self.points + np.array([0.0, height, 0.0]), self.normals)


def undeformed(problem: ContactProblem, pose: Array) -> tuple[Array, TangentPlanes]:
    """Return the vertical gaps (c,), m, and planes of all undeformed contact nodes.

    The gap is inf where no femoral surface can be loaded.
    """
    points = problem.surface_points
    planes = tangent_planes(problem, points, pose, None)
    usable = planes.normal_y < LEAST_NORMAL_Y
    return np.where(usable, planes.points[:, 1] - points[:, 1], np.inf), planes


def tangent_planes(
    problem: ContactProblem, positions: Array, pose: Array, last: TangentPlanes | None
) -> TangentPlanes:
    """Return the femoral planes on vertical rays through displaced nodes (m, 3).

    A node that is not under the femoral component keeps its plane in `last`.
    """
    points, normals = problem.femoral.over(positions, pose)
    missed = ~(normals[:, 1] < LEAST_NORMAL_Y)
    if last is not None:
        points[missed], normals[missed] = last.points[missed], last.normals[missed]
    if problem.direction == "vertical":
        normals = np.where(np.isnan(normals), np.nan, [0.0, -1.0, 0.0])
    return TangentPlanes(points, normals)


@dataclass(frozen=True, eq=False)
class Region:
    """A subset of a solid's elements (cells or springs).

    Args:
        elements: numbers of the elements, increasing, (k,).
        nodes: their nodes that are not held, (m,).
        fronts: fronts of the factor that a solve for these nodes needs.
    """

    elements: Index
    nodes: Index
    fronts: Shares
    whole: bool

    @classmethod
    def of(cls, problem: ContactProblem, elements: Index) -> "Region":
        """Return the region of elements of the problem's solid."""
        scatter = problem.solid.scatter
        in_region = np.zeros(scatter.nodes, bool)
        in_region[scatter.elements[elements]] = True
        nodes = np.flatnonzero(in_region & problem.free_nodes)
        whole = len(elements) == len(scatter.elements)
        return cls(elements, nodes, problem.operator.fronts_of(nodes), whole)


@dataclass(frozen=True, eq=False)
class LatticeState(PreparedContact):
    """A prepared contact. `compliance` caches that of recent candidates; it changes no result."""

    surface: ContactMap
    lattice: Lattice
    problem: ContactProblem
    compliance: ComplianceCache

    @property
    def node_count(self) -> int:
        """Number of nodes of the grid."""
        return len(self.lattice.nodes)
