"""Sharma's lattice: one stiffness k = E·C for every spring.

Every node is joined to its 26 neighbours. C (m) makes the compliance of a uniformly strained
cell in the superior-inferior direction 1/E: 13 springs belong to the volume of one cell, and

    C_ijkl = (k/V) sum over 13 springs of L² n_i n_j n_k n_l,   k = E / (E of unit k)

(Sharma's sum runs over 26 springs per cell and counts each twice). On a cube of edge a
this is k = E a/2.7, and Poisson's ratio is 0.35 whatever the material's. Springs on the surface
have the same k though fewer cells own them: a patch with free sides is too stiff.

Nonlinear: f = sigma(eps) C L0 along the spring as it lies now, eps from its true length.
Reference: Sharma, PhD dissertation, University of Tennessee (2008), sections 4.5.1 to 4.5.3.
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
    # Stiffness of a cell of unit springs under uniform strain: sum of l² (n n) (n n) over the
    # volume.
    unit = np.einsum("s,si,sj->ij", length**2, strain, strain) / np.prod(spacing)
    # Scaled so that a free bar along y has the material's Young's modulus (Sharma 2008).
    return float(np.linalg.inv(unit)[VERTICAL, VERTICAL])


@dataclass(frozen=True, eq=False)
class Tangent:
    """Tangent of all springs as they lie.

    Args:
        stiffness: (s,) N/m along the spring.
        direction: (s, 3) unit.
    """

    stiffness: Array
    direction: Array


class SourceNetwork(Solid):
    """Springs of one stiffness, linear or after the material's curve; see `Solid`.

    Args:
        nodes: (n, 3) m.
        cells: (c, 8); they only give strains for the flags.
        spacing: (3,) m.
        material: E and the stress-strain curve; its Poisson's ratio has no effect.
        springs: (s, 2) nodes, each spring once.
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
        """Return linear forces minus those of the springs as they lie, N, (k, 6)."""
        springs = slice(None) if chosen is None else chosen
        strain, direction = self._state(displacement, springs)
        a, b = self.springs[springs].T
        straight = self.lines[springs] / self.lengths[springs, None]
        longer = np.einsum("sd,sd->s", straight, displacement[b] - displacement[a])
        linear = self.material.young_modulus * longer[:, None] * straight
        # Springs turn with the displacement, so that force and direction are those of the deformed
        # network.
        now = (self.material.stress(strain) * self.lengths[springs])[:, None] * direction
        softened = self.factor * (linear - now)
        return np.hstack([-softened, softened])

    def internal_force(self, displacement: Array) -> Array:
        """Return the forces f = sigma C L0 of the springs as they lie, N, (n, 3)."""
        if self.material.is_linear:
            return self.linear_force(displacement)
        strain, direction = self._state(displacement)
        return self._pulls(self.material.stress(strain) * (self.factor * self.lengths), direction)

    def tangent(self, displacement: Array) -> sparse.csr_matrix:
        """Return the springs' (d sigma/d eps) C n nᵀ, assembled as in Sharma (2008) (3n, 3n).

        The turning of the loaded springs is left out: the forces are exact, the step is not.
        """
        if self.material.is_linear:
            return self.stiffness
        tangent = self.spring_tangent(displacement)
        return self._assembled(tangent.stiffness, tangent.direction)

    def spring_tangent(self, displacement: Array) -> Tangent:
        """Return the tangent spring by spring; nothing is assembled."""
        if self.material.is_linear:
            k = np.full(len(self.springs), self.material.young_modulus * self.factor)
            return Tangent(k, self._straight)
        strain, direction = self._state(displacement)
        return Tangent(self.material.tangent(strain) * self.factor, direction)

    def tangent_force(self, tangent: Tangent, displacement: Array) -> Array:
        """Return what a small displacement (n, 3) adds to the forces, N, (n, 3)."""
        total = np.zeros((len(self.nodes), 3))
        _add_tangent_forces(self.springs, tangent.direction, tangent.stiffness, displacement, total)
        return total

    def _pulls(self, pull: Array, direction: Array) -> Array:
        """Return nodal forces (n, 3) of springs that pull their ends together by pull (s,), N."""
        total = np.zeros((len(self.nodes), 3))
        _add_pulls(self.springs, direction, pull, total)
        return total

    @cached_property
    def _straight(self) -> Array:
        """Unit directions (s, 3) of the undeformed springs."""
        return self.lines / self.lengths[:, None]

    @cached_property
    def _spring_pattern(self) -> Pattern:
        return Pattern.of(self.springs, len(self.nodes))

    def _assembled(self, stiffness: Array, direction: Array) -> sparse.csr_matrix:
        block = stiffness[:, None, None] * direction[:, :, None] * direction[:, None, :]
        # Stiffness along the spring only: how the force turns with it is left out.
        matrices = np.block([[block, -block], [-block, block]])
        return self._spring_pattern.assemble([matrices])

    def _state(
        self, displacement: Array, springs: Index | slice = slice(None)
    ) -> tuple[Array, Array]:
        """Return strain (k,) and unit direction (k, 3) of springs as they lie."""
        a, b = self.springs[springs].T
        lines = self.lines[springs] + displacement[b] - displacement[a]
        length = np.linalg.norm(lines, axis=1)
        return length / self.lengths[springs] - 1, lines / length[:, None]


@compiled
def _add_tangent_forces(
    springs: Index, direction: Array, stiffness: Array, displacement: Array, total: Array
) -> None:
    """Add the forces k n (n · (u_b − u_a)) of springs (s, 2) to the nodes' (n, 3).

    Args:
        springs: (s, 2) nodes a and b.
        direction: (s, 3) n, unit, from a to b.
        stiffness: (s,) k, N/m.
        displacement: (n, 3) u, m.
        total: (n, 3) N, sum of forces that hold the displacement; added to.
    """
    for s in range(len(springs)):
        a, b = springs[s]
        longer = 0.0
        for axis in range(3):
            longer += direction[s, axis] * (displacement[b, axis] - displacement[a, axis])
        longer *= stiffness[s]
        for axis in range(3):
            total[a, axis] -= longer * direction[s, axis]
            total[b, axis] += longer * direction[s, axis]


@compiled
def _add_pulls(springs: Index, direction: Array, pull: Array, total: Array) -> None:
    """Add the forces of springs (s, 2) that pull by pull (s,), N, to the nodes' (n, 3)."""
    for s in range(len(springs)):
        a, b = springs[s]
        for axis in range(3):
            total[a, axis] -= pull[s] * direction[s, axis]
            total[b, axis] += pull[s] * direction[s, axis]
