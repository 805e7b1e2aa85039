"""Sharma's lattice: one stiffness k = E·C for every spring.

Every node is joined to its 26 neighbours. C, m, is calibrated so that a uniformly strained cell has
Young's modulus E in the superior-inferior direction. 13 springs belong to the volume of a cell, so

    C_ijkl = (k/V) sum over 13 springs of L² n_i n_j n_k n_l,   k = E / (E at k = 1)

(Sharma's sum has 26 springs per cell and counts each twice). On a cube of edge a, k = E a/2.7.
Poisson's ratio is 0.35 for every material. Springs on the surface have the same k although fewer
cells share them, so that a part with free sides is too stiff.

Nonlinear: the force is f = sigma(eps) C L0 along the deformed spring, with eps from its length.
Source: Sharma, PhD dissertation, University of Tennessee (2008), sections 4.5.1 to 4.5.3.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sparse

from tkamb.contact.lattice.meshing.cells import DIRECTIONS
from tkamb.contact.lattice.solid import Pattern, Scatter, Solid
from tkamb.contact.materials import Material
from tkamb.geometry.compiled import compiled
from tkamb.geometry.frames import Array, Index

VERTICAL = 1
"""Row of the superior-inferior direction in [xx, yy, zz, 2xy, 2yz, 2zx]."""


def source_factor(spacing: Array) -> float:
    """Return C = k/E, m, of Sharma's calibration on box cells of edges (3,), m."""
    lines = DIRECTIONS * spacing
    length = np.linalg.norm(lines, axis=1)
    n = lines / length[:, None]
    strain = np.column_stack([n**2, n[:, 0] * n[:, 1], n[:, 1] * n[:, 2], n[:, 2] * n[:, 0]])
    # Elasticity matrix of a cell with springs of k = 1.
    unit = np.einsum("s,si,sj->ij", length**2, strain, strain) / np.prod(spacing)
    # With k = E C, a free bar along y has the material's Young's modulus.
    return float(np.linalg.inv(unit)[VERTICAL, VERTICAL])


@dataclass(frozen=True, eq=False)
class Tangent:
    """Tangent stiffness of all deformed springs.

    Args:
        stiffness: stiffness along the spring, N/m, (s,).
        direction: unit vector along the spring, (s, 3).
    """

    stiffness: Array
    direction: Array


class SourceNetwork(Solid):
    """Springs of equal stiffness, linear or with the material's curve; see `Solid`.

    Cells (c, 8) are needed only for the strains that decide on flags. The material's Poisson's
    ratio has no effect. `springs` (s, 2) are end nodes.
    """

    def __init__(
        self,
        nodes: Array,
        cells: Index,
        spacing: Array,
        material: Material,
        springs: Index,
    ) -> None:
        super().__init__(nodes, cells, spacing, material)
        self.springs = springs
        self.scatter = Scatter(springs, len(nodes))
        self.factor = source_factor(spacing)
        self.lines = nodes[springs[:, 1]] - nodes[springs[:, 0]]
        self.lengths = np.linalg.norm(self.lines, axis=1)

    @property
    def stiffness(self) -> sparse.csr_matrix:
        """Linear stiffness (3n, 3n), N/m."""
        k = np.full(len(self.springs), self.material.young_modulus * self.factor)
        return self._assembled(k, self.lines / self.lengths[:, None])

    def linear_force(self, displacement: Array) -> Array:
        """Return K u, N, (n, 3); see `Solid`."""
        k = np.full(len(self.springs), self.material.young_modulus * self.factor)
        return self.tangent_force(Tangent(k, self._straight), displacement)

    def nonlinear_residual(self, displacement: Array, chosen: Index | None = None) -> Array:
        """Return linear forces minus those of the deformed springs, N, (k, 6)."""
        springs = slice(None) if chosen is None else chosen
        strain, direction = self._state(displacement, springs)
        a, b = self.springs[springs].T
        undeformed = self.lines[springs] / self.lengths[springs, None]
        elongation = np.einsum("sd,sd->s", undeformed, displacement[b] - displacement[a])
        linear = self.material.young_modulus * elongation[:, None] * undeformed
        # The actual force acts along the deformed spring.
        actual = (self.material.stress(strain) * self.lengths[springs])[:, None] * direction
        difference = self.factor * (linear - actual)
        return np.hstack([-difference, difference])

    def internal_force(self, displacement: Array) -> Array:
        """Return the nodal forces f = sigma C L0 of the deformed springs, N, (n, 3)."""
        if self.material.is_linear:
            return self.linear_force(displacement)
        strain, direction = self._state(displacement)
        return self._pulls(self.material.stress(strain) * (self.factor * self.lengths), direction)

    def tangent(self, displacement: Array) -> sparse.csr_matrix:
        """Return the sum of (d sigma/d eps) C n nᵀ of the springs, N/m, (3n, 3n).

        As in Sharma (2008), it neglects that loaded springs turn.
        """
        if self.material.is_linear:
            return self.stiffness
        tangent = self.spring_tangent(displacement)
        return self._assembled(tangent.stiffness, tangent.direction)

    def spring_tangent(self, displacement: Array) -> Tangent:
        """Return the tangent stiffness of each spring."""
        if self.material.is_linear:
            k = np.full(len(self.springs), self.material.young_modulus * self.factor)
            return Tangent(k, self._straight)
        strain, direction = self._state(displacement)
        return Tangent(self.material.tangent(strain) * self.factor, direction)

    def tangent_force(self, tangent: Tangent, displacement: Array) -> Array:
        """Return the change (n, 3), N, of nodal forces under a small displacement (n, 3), m."""
        total = np.zeros((len(self.nodes), 3))
        _add_tangent_forces(self.springs, tangent.direction, tangent.stiffness, displacement, total)
        return total

    def _pulls(self, pull: Array, direction: Array) -> Array:
        """Return the nodal forces (n, 3), N, of springs with tensions `pull` (s,), N."""
        total = np.zeros((len(self.nodes), 3))
        _add_pulls(self.springs, direction, pull, total)
        return total

    @cached_property
    def _straight(self) -> Array:
        return self.lines / self.lengths[:, None]

    @cached_property
    def _spring_pattern(self) -> Pattern:
        return Pattern.of(self.springs, len(self.nodes))

    def _assembled(self, stiffness: Array, direction: Array) -> sparse.csr_matrix:
        block = stiffness[:, None, None] * direction[:, :, None] * direction[:, None, :]
        # The stiffness is along the spring only; the turning of its force is neglected.
        matrices = np.block([[block, -block], [-block, block]])
        return self._spring_pattern.assemble([matrices])

    def _state(
        self, displacement: Array, springs: Index | slice = slice(None)
    ) -> tuple[Array, Array]:
        """Return the strain (k,) and unit direction (k, 3) of deformed springs."""
        a, b = self.springs[springs].T
        lines = self.lines[springs] + displacement[b] - displacement[a]
        length = np.linalg.norm(lines, axis=1)
        return length / self.lengths[springs] - 1, lines / length[:, None]


@compiled
def _add_tangent_forces(
    springs: Index, direction: Array, stiffness: Array, displacement: Array, total: Array
) -> None:
    """Add the forces k n (n · (u_b − u_a)) of springs a-b to `total` (n, 3), N, in place.

    `direction` (s, 3) is n, from a to b; `stiffness` (s,) k, N/m; `displacement` u, m.
    """
    for s in range(len(springs)):
        a, b = springs[s]
        force = 0.0
        for axis in range(3):
            force += direction[s, axis] * (displacement[b, axis] - displacement[a, axis])
        force *= stiffness[s]
        for axis in range(3):
            total[a, axis] -= force * direction[s, axis]
            total[b, axis] += force * direction[s, axis]


@compiled
def _add_pulls(springs: Index, direction: Array, pull: Array, total: Array) -> None:
    """Add the forces of springs (s, 2) with tensions `pull` (s,), N, to nodal forces (n, 3)."""
    for s in range(len(springs)):
        a, b = springs[s]
        for axis in range(3):
            total[a, axis] -= pull[s] * direction[s, axis]
            total[b, axis] += pull[s] * direction[s, axis]
