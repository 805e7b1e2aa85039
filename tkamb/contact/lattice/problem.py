"""One insert under one femoral component, discretised: what every contact solver needs."""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tkamb.contact.lattice.femoral import FemoralFloor
from tkamb.contact.lattice.operator import ElasticOperator
from tkamb.contact.lattice.solid import Solid
from tkamb.geometry.frames import Array

Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

Direction = Literal["normal", "vertical"]

STEEPEST = -0.05
"""Largest y of a femoral normal that a vertical press can load: 87 deg from the vertical."""


@dataclass(frozen=True, eq=False)
class ContactProblem:
    """A solid, its linear operator, the nodes that can be touched and what touches them.

    Args:
        solid: cells and material.
        operator: factor of the linear stiffness.
        index: (n, 3) lattice place of each node.
        held: (3n,) unknowns held by the boundary.
        floor: the femoral component from below.
        direction: nodes are pressed along the femoral normal, or vertically (the source).
        lift: (c,) m along y, from the contact nodes to the smooth surface that their mesh
            stands for; 0: they are taken where they are.
    """

    solid: Solid
    operator: ElasticOperator
    index: Indices
    held: Mask
    floor: FemoralFloor
    direction: Direction = "normal"
    lift: Array | float = 0.0

    @property
    def contact_nodes(self) -> Indices:
        """Nodes (c,) that can be touched."""
        return self.operator.contact_nodes

    @cached_property
    def surface_points(self) -> Array:
        """Undeformed contact nodes (c, 3), m, on the smooth surface of the insert."""
        points = self.solid.nodes[self.operator.contact_nodes]
        points[:, 1] += self.lift
        points.flags.writeable = False
        return points


@dataclass(frozen=True, eq=False)
class Footing:
    """Where some contact nodes meet the femoral surface, at zero approach.

    Args:
        places: (m, 3) femoral points on the verticals through the nodes.
        normals: (m, 3) femoral outward unit normals there.
    """

    places: Array
    normals: Array

    def gap(self, positions: Array) -> Array:
        """Return the gap (m,) of deformed nodes to the tangent planes, m."""
        return np.asarray(np.einsum("ij,ij->i", self.normals, positions - self.places))

    @property
    def lean(self) -> Array:
        """y of the normals (m,), negative."""
        return self.normals[:, 1]

    def part(self, nodes: Indices) -> "Footing":
        """Return the footing of some of the nodes."""
        return Footing(self.places[nodes], self.normals[nodes])

    def raised(self, height: float) -> "Footing":
        """Return the footing when the femoral component has moved along y (m)."""
        return Footing(self.places + np.array([0.0, height, 0.0]), self.normals)


def undeformed(problem: ContactProblem, pose: Array) -> tuple[Array, Footing]:
    """Return vertical gaps (c,) and footing of all contact nodes where they are at rest.

    The gap is inf where there is no femoral surface above.
    """
    points = problem.surface_points
    foot = footing(problem, points, pose, None)
    usable = foot.lean < STEEPEST
    return np.where(usable, foot.places[:, 1] - points[:, 1], np.inf), foot


def footing(
    problem: ContactProblem, positions: Array, pose: Array, last: Footing | None
) -> Footing:
    """Fire the vertical rays through displaced nodes again.

    A node that has slid from under the femoral component keeps its last plane.
    """
    places, normals = problem.floor.over(positions, pose)
    lost = ~(normals[:, 1] < STEEPEST)
    if last is not None:
        places[lost], normals[lost] = last.places[lost], last.normals[lost]
    if problem.direction == "vertical":
        normals = np.where(np.isnan(normals), np.nan, [0.0, -1.0, 0.0])
    return Footing(places, normals)
