"""A solid made of cells: linear stiffness, what nonlinearity takes away, tangent."""

from abc import ABC, abstractmethod
from functools import cached_property

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from tkamb.contact.lattice.assembly import CellScatter, Pattern
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
        self.scatter = CellScatter(cells, len(nodes))

    @cached_property
    def pattern(self) -> Pattern:
        """Where cell matrices go in the global one."""
        return Pattern.of(self.cells, len(self.nodes))

    @property
    @abstractmethod
    def stiffness(self) -> sparse.csr_matrix:
        """Linear stiffness (3n, 3n), N/m."""

    @abstractmethod
    def correction(self, displacement: Array) -> Array:
        """Return h = K u - f(u), N, (n, 3): linear forces minus the material's own."""

    @abstractmethod
    def tangent(self, displacement: Array) -> sparse.csr_matrix:
        """Return d f / d u (3n, 3n), N/m."""

    @abstractmethod
    def equivalent_strain(self, displacement: Array) -> Array:
        """Return each cell's (largest) equivalent deviatoric strain (c,)."""

    def internal_force(self, displacement: Array) -> Array:
        """Return nodal internal forces f(u), N, (n, 3)."""
        linear = (self.stiffness @ displacement.ravel()).reshape(-1, 3)
        return np.asarray(linear - self.correction(displacement))

    def principal_strain_range(self, displacement: Array) -> tuple[float, float]:
        """Return the smallest and largest principal strain of the cells' mean gradients."""
        gradients = mean_gradient(self.shapes)[0][self.shape_of_cell]
        gradient = np.einsum("cna,cnb->cab", displacement[self.cells], gradients)
        principal = np.linalg.eigvalsh((gradient + np.swapaxes(gradient, 1, 2)) / 2)
        return float(principal[:, 0].min()), float(principal[:, 2].max())
