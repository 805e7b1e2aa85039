"""The calibrated lattice as a solid: one secant shear modulus per cell, elastic bulk."""

from functools import cached_property

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from tkamb.contact.lattice.calibrated import deviatoric_matrices
from tkamb.contact.lattice.curve import ShearCurve
from tkamb.contact.lattice.solid import Solid
from tkamb.contact.materials import Material
from tkamb.geometry.frames import Array


class CalibratedNetwork(Solid):
    """Cells mu_s K_d + K V g gᵀ, with mu_s from the cell's equivalent strain.

    e² = uᵀ K_d u / (3 V), 3 mu_s = q(e)/e: the forces derive from an energy, so the tangent
    is symmetric. See `Solid` for the arguments.
    """

    def __init__(
        self, nodes: Array, cells: NDArray[np.int64], spacing: Array, material: Material
    ) -> None:
        super().__init__(nodes, cells, spacing, material)
        self.deviatoric, self.dilatation, self.volume = deviatoric_matrices(self.shapes, spacing)
        self.curve = ShearCurve.of(material)

    @cached_property
    def stiffness(self) -> sparse.csr_matrix:
        """Linear stiffness (3n, 3n), N/m."""
        return self.pattern.assemble(self.shape_stiffness(), self.shape_of_cell)

    def shape_stiffness(self) -> Array:
        """Return mu K_d + K V g gᵀ of each shape (s, 24, 24), N/m."""
        return self.material.shear_modulus * self.deviatoric + self._bulk

    def correction(self, displacement: Array) -> Array:
        """Return the sum over cells of (mu - mu_s) K_d u, N, (n, 3)."""
        if self.curve.spline is None:
            return np.zeros_like(displacement)
        force, equivalent = self._state(displacement)
        lost = self.material.shear_modulus - self.curve.modulus(equivalent)
        return self.scatter.sum(lost[:, None] * force)

    def tangent(self, displacement: Array) -> sparse.csr_matrix:
        """Return d f / d u (3n, 3n): mu_s K_d + mu_s'/(3 V e) (K_d u)(K_d u)ᵀ + bulk."""
        force, equivalent = self._state(displacement)
        shape = self.shape_of_cell
        secant, softening = self.curve.modulus(equivalent), self.curve.softening(equivalent)
        scale = softening / (3 * self.volume[shape])
        matrices = secant[:, None, None] * self.deviatoric[shape] + self._bulk[shape]
        matrices += scale[:, None, None] * force[:, :, None] * force[:, None, :]
        return self.pattern.assemble(matrices)

    def equivalent_strain(self, displacement: Array) -> Array:
        """Return e of each cell (c,)."""
        return self._state(displacement)[1]

    @cached_property
    def _bulk(self) -> Array:
        g = self.dilatation
        scale = self.material.bulk_modulus * self.volume
        return np.asarray(scale[:, None, None] * g[:, :, None] * g[:, None, :])

    @cached_property
    def _kinds(self) -> tuple[int, NDArray[np.int64], Array]:
        """Most frequent shape, the cells of other shapes and their K_d."""
        common = int(np.bincount(self.shape_of_cell).argmax())
        others = np.flatnonzero(self.shape_of_cell != common)
        return common, others, self.deviatoric[self.shape_of_cell[others]]

    def _state(self, displacement: Array) -> tuple[Array, Array]:
        """Return K_d u (c, 24) and the equivalent strain e (c,)."""
        local = self.scatter.gather(displacement)
        common, others, matrices = self._kinds
        force = local @ self.deviatoric[common]
        force[others] = np.einsum("cij,cj->ci", matrices, local[others])
        energy = np.einsum("ci,ci->c", local, force)
        return force, np.sqrt(np.maximum(energy, 0) / (3 * self.volume[self.shape_of_cell]))
