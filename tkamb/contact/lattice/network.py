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

    def linear_force(self, displacement: Array) -> Array:
        """Return K u, N, (n, 3); see `Solid`."""
        return self._cells_force(self.shape_stiffness(), displacement)

    def lost(self, displacement: Array, chosen: NDArray[np.int64] | None = None) -> Array:
        """Return (mu - mu_s) K_d u of the cells, N, (k, 24); see `Solid`."""
        force, equivalent = self._state(displacement, chosen)
        lost = self.material.shear_modulus - self.curve.modulus(equivalent)
        return lost[:, None] * force

    def tangent(self, displacement: Array) -> sparse.csr_matrix:
        """Return d f / d u (3n, 3n): mu_s K_d + mu_s'/(3 V e) (K_d u)(K_d u)ᵀ + bulk."""
        force, equivalent = self._state(displacement)
        shape = self.shape_of_cell
        secant, softening = self.curve.modulus(equivalent), self.curve.softening(equivalent)
        scale = softening / (3 * self.volume[shape])
        matrices = secant[:, None, None] * self.deviatoric[shape] + self._bulk[shape]
        matrices += scale[:, None, None] * force[:, :, None] * force[:, None, :]
        return self.pattern.assemble(matrices)

    @cached_property
    def _bulk(self) -> Array:
        g = self.dilatation
        scale = self.material.bulk_modulus * self.volume
        return np.asarray(scale[:, None, None] * g[:, :, None] * g[:, None, :])

    @cached_property
    def _others(self) -> tuple[Array, NDArray[np.int64]]:
        """K_d of the cells that are not of the commonest shape, and where each cell's is; -1."""
        others = self.kinds[1]
        place = np.full(len(self.cells), -1)
        place[others] = np.arange(len(others))
        return self.deviatoric[self.shape_of_cell[others]], place

    def _state(
        self, displacement: Array, chosen: NDArray[np.int64] | None = None
    ) -> tuple[Array, Array]:
        """Return K_d u (k, 24) and the equivalent strain e (k,) of the chosen cells."""
        local = self.scatter.gather(displacement, chosen)
        cells = slice(None) if chosen is None else chosen
        matrices, place = self._others
        place = place[cells]
        force = local @ self.deviatoric[self.kinds[0]]
        others = np.flatnonzero(place >= 0)
        matrices = matrices if chosen is None else matrices[place[others]]
        force[others] = np.einsum("cij,cj->ci", matrices, local[others])
        energy = np.einsum("ci,ci->c", local, force)
        volume = self.volume[self.shape_of_cell[cells]]
        return force, np.sqrt(np.maximum(energy, 0) / (3 * volume))
