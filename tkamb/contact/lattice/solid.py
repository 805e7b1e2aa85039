"""A solid made of cells: linear stiffness, what nonlinearity takes away, tangent."""

from abc import ABC, abstractmethod
from functools import cached_property

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from tkamb.contact.lattice.assembly import Pattern, Scatter
from tkamb.contact.lattice.hexahedron import group_shapes, mean_gradient
from tkamb.contact.materials import Material
from tkamb.errors import InputError
from tkamb.geometry.frames import Array

Indices = NDArray[np.int64]


class Solid(ABC):
    """Cells of eight nodes with a material, small strain.

    Args:
        nodes: (n, 3) m.
        cells: (c, 8), VTK hexahedron order.
        spacing: (3,) m, edges of the lattice's box cell.
        material: its E, nu and stress-strain law.

    Raises:
        InputError: a cell is turned inside out.
    """

    def __init__(self, nodes: Array, cells: Indices, spacing: Array, material: Material) -> None:
        self.nodes, self.cells, self.spacing, self.material = nodes, cells, spacing, material
        self.shapes, self.shape_of_cell = group_shapes(nodes[cells])
        _, volume = mean_gradient(self.shapes)
        if not (volume > 0).all():
            raise InputError(
                f"{int((volume <= 0)[self.shape_of_cell].sum())} cells are turned inside out",
                "lattice",
                "take a finer resolution",
            )
        self.scatter = Scatter(cells, len(nodes))

    @cached_property
    def pattern(self) -> Pattern:
        """Where cell matrices go in the global one."""
        return Pattern.of(self.cells, len(self.nodes))

    @property
    @abstractmethod
    def stiffness(self) -> sparse.csr_matrix:
        """Linear stiffness (3n, 3n), N/m."""

    @abstractmethod
    def lost(self, displacement: Array, chosen: Indices | None = None) -> Array:
        """Return linear forces minus the material's own, N, of members of `scatter` (k, 3p).

        Args:
            displacement: (n, 3) m; only the chosen members' nodes are looked at.
            chosen: (k,) members; all by default.
        """

    def correction(self, displacement: Array) -> Array:
        """Return h = K u - f(u), N, (n, 3): linear forces minus the material's own."""
        if self.material.is_linear:
            return np.zeros_like(displacement)
        return self.scatter.sum(self.lost(displacement))

    @abstractmethod
    def tangent(self, displacement: Array) -> sparse.csr_matrix:
        """Return d f / d u (3n, 3n), N/m."""

    def internal_force(self, displacement: Array) -> Array:
        """Return nodal internal forces f(u), N, (n, 3)."""
        linear = (self.stiffness @ displacement.ravel()).reshape(-1, 3)
        return np.asarray(linear - self.correction(displacement))

    @abstractmethod
    def linear_force(self, displacement: Array) -> Array:
        """Return K u, N, (n, 3), summed member by member: no matrix is assembled."""

    def _cells_force(self, matrices: Array, displacement: Array) -> Array:
        """Return K u, N, (n, 3), from the stiffness of each shape (s, 24, 24)."""
        local = self.scatter.gather(displacement)
        common, others = self.kinds
        force = local @ matrices[common]
        force[others] = np.einsum("cij,cj->ci", matrices[self.shape_of_cell[others]], local[others])
        return self.scatter.sum(force)

    def least_principal_strain(self, displacement: Array) -> float:
        """Return the smallest principal strain of the cells' mean gradients.

        It is no smaller than minus the norm of its tensor: where the cell of largest norm is
        compressed, only cells whose norm exceeds that compression are looked at.
        """
        strain = self.strain(displacement)
        norm = np.linalg.norm(strain, axis=(1, 2))
        first = float(np.linalg.eigvalsh(strain[norm.argmax()])[0])
        return float(np.linalg.eigvalsh(strain[norm >= -first])[:, 0].min())

    def strain(self, displacement: Array) -> Array:
        """Return each cell's mean strain (c, 3, 3)."""
        common, others, gradients = self._mean_gradients
        local = displacement[self.cells].reshape(-1, 24)
        gradient = (local @ common).reshape(-1, 3, 3)
        for a in range(3):
            for b in range(3):
                along = np.einsum("cn,nc->c", local[others, a::3], gradients[:, b])
                gradient[others, a, b] = along
        return np.asarray((gradient + np.swapaxes(gradient, 1, 2)) / 2)

    @cached_property
    def _mean_gradients(self) -> tuple[Array, Indices, Array]:
        """Mean gradients of the commonest shape as (24, 9), the other cells, theirs (8, 3, k)."""
        gradients, (common, others) = mean_gradient(self.shapes)[0], self.kinds
        matrix = np.einsum("nb,ac->ncab", gradients[common], np.eye(3)).reshape(24, 9)
        theirs = gradients[self.shape_of_cell[others]]
        return matrix, others, np.ascontiguousarray(theirs.transpose(1, 2, 0))

    @cached_property
    def kinds(self) -> tuple[int, Indices]:
        """The commonest shape, and the cells (k,) of all others."""
        common = int(np.bincount(self.shape_of_cell).argmax())
        return common, np.flatnonzero(self.shape_of_cell != common)
