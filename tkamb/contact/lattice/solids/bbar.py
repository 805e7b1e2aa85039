"""B-bar hexahedra: eight Gauss points for shear, the cell's mean dilatation for bulk.

The yardstick of the lattice, on the same grid, with the same material and contact.
Reference: Hughes, Int J Numer Meth Eng 15:1413 (1980), doi:10.1002/nme.1620150914.
"""

from functools import cached_property

import numpy as np
import scipy.sparse as sparse

from tkamb.contact.lattice.meshing.cells import gauss_gradients, mean_gradient
from tkamb.contact.lattice.solids.curve import ShearCurve
from tkamb.contact.lattice.solids.solid import DEVIATORIC, CellSolid, strain_matrix
from tkamb.contact.materials import Material
from tkamb.errors import InputError
from tkamb.geometry.frames import Array, Index

_VALUES, _VECTORS = np.linalg.eigh(DEVIATORIC)
_ROOT = (_VECTORS * np.sqrt(np.maximum(_VALUES, 0))).T[_VALUES > 1e-12]
"""(5, 6) with rootᵀ root = the form 2 dev eps : dev eps."""


class BbarHexahedra(CellSolid):
    """Mean-dilatation hexahedra, small strain, J2 deformation theory at the Gauss points.

    At each point e² = (2/3) dev eps : dev eps and 3 mu_s = q(e)/e; the bulk stays elastic.
    See `Solid` for the arguments.

    Raises:
        InputError: the Jacobian is not positive at a Gauss point.
    """

    def __init__(self, nodes: Array, cells: Index, spacing: Array, material: Material) -> None:
        super().__init__(nodes, cells, spacing, material)
        gradients, self.weights = gauss_gradients(self.shapes)
        if not (self.weights > 0).all():
            raise InputError("a hexahedron is turned inside out", "lattice", "use finer cells")
        self.shear = np.einsum("rq,sgqj->sgrj", _ROOT, strain_matrix(gradients))
        mean, self.volume = mean_gradient(self.shapes)
        self.dilatation = mean.reshape(-1, 24)
        self.curve = ShearCurve.of(material)

    def shape_stiffness(self) -> Array:
        """Return the linear stiffness of each shape (s, 24, 24), N/m."""
        shear = np.einsum("sg,sgri,sgrj->sij", self.weights, self.shear, self.shear, optimize=True)
        return self.material.shear_modulus * shear + self.bulk

    def nonlinear_residual(self, displacement: Array, chosen: Index | None = None) -> Array:
        """Return the Gauss points' (mu - mu_s) times unit shear forces, N, (k, 24)."""
        strain, equivalent = self._state(displacement, chosen)
        softened = self.material.shear_modulus - self.curve.modulus(equivalent)
        cells = slice(None) if chosen is None else chosen
        strain *= (softened * self.weights[self.shape_of_cell[cells]])[..., None]
        return self._per_cell_forces(strain, chosen)

    def tangent(self, displacement: Array) -> sparse.csr_matrix:
        """Return d f / d u (3n, 3n), N/m."""
        strain, equivalent = self._state(displacement)
        shape = self.shape_of_cell
        secant, softening = self.curve.modulus(equivalent), self.curve.softening(equivalent)
        matrices = self.bulk[shape]
        for point in range(8):
            weight, shear = self.weights[shape, point], self.shear[shape, point]
            matrices += (weight * secant[:, point])[:, None, None] * (
                np.swapaxes(shear, 1, 2) @ shear
            )
            force = np.einsum("cri,cr->ci", shear, strain[:, point])
            scale = weight * softening[:, point] / 3
            matrices += scale[:, None, None] * force[:, :, None] * force[:, None, :]
        return self.pattern.assemble(matrices)

    @cached_property
    def _others(self) -> tuple[Array, Array]:
        """Shear matrices (40, 24) of the commonest shape and of the cells of other shapes."""
        common, others = self.kinds
        flat = self.shear.reshape(-1, 40, 24)
        return flat[common], flat[self.shape_of_cell[others]]

    def _sorted(self, chosen: Index | None) -> tuple[Array, Index, Array]:
        """Return the common matrix, which of the chosen cells are others, and their matrices."""
        matrix, matrices = self._others
        index = self.index_among_others if chosen is None else self.index_among_others[chosen]
        others = np.flatnonzero(index >= 0)
        return matrix, others, matrices if chosen is None else matrices[index[others]]

    def _state(self, displacement: Array, chosen: Index | None = None) -> tuple[Array, Array]:
        """Return scaled deviatoric strain (k, 8, 5) and equivalent strain (k, 8)."""
        local = self.scatter.gather(displacement, chosen)
        matrix, others, matrices = self._sorted(chosen)
        flat = local @ matrix.T
        flat[others] = np.einsum("crj,cj->cr", matrices, local[others])
        strain = flat.reshape(-1, 8, 5)
        return strain, np.sqrt(np.einsum("cgr,cgr->cg", strain, strain) / 3)

    def _per_cell_forces(self, stress: Array, chosen: Index | None) -> Array:
        """Return (k, 24) from weighted scaled stresses (k, 8, 5)."""
        flat = stress.reshape(-1, 40)
        matrix, others, matrices = self._sorted(chosen)
        force = flat @ matrix
        force[others] = np.einsum("crj,cr->cj", matrices, flat[others])
        return force
