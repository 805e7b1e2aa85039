"""B-bar hexahedra: eight Gauss points for shear, the cell's mean dilatation for bulk.

They are the finite-element reference for the lattice, with the same grid, material and contact.
Source: Hughes, Int J Numer Meth Eng 15:1413 (1980), doi:10.1002/nme.1620150914.
"""

from collections.abc import Iterator

import numpy as np
import scipy.sparse as sparse

from tkamb.contact.lattice.meshing.cells import gauss_gradients
from tkamb.contact.lattice.solid import (
    DEVIATORIC,
    ShearCurve,
    Solid,
    chunks,
    elements_of,
    strain_matrix,
)
from tkamb.contact.materials import Material
from tkamb.errors import InputError
from tkamb.geometry.frames import Array, Index

_VALUES, _VECTORS = np.linalg.eigh(DEVIATORIC)
_ROOT = (_VECTORS * np.sqrt(np.maximum(_VALUES, 0))).T[_VALUES > 1e-12]
"""R, (5, 6), with Rᵀ R = `DEVIATORIC`."""


class BbarHexahedra(Solid):
    """Mean-dilatation hexahedra, small strain, J2 deformation theory at the Gauss points.

    At each point e² = (2/3) dev eps : dev eps and 3 mu_s = q(e)/e. The bulk is elastic.
    `Solid` has the arguments, `ShearCurve` q.
    """

    def __init__(self, nodes: Array, cells: Index, spacing: Array, material: Material) -> None:
        super().__init__(nodes, cells, spacing, material)
        gradients, self.weights = gauss_gradients(self.corners())
        if not (self.weights > 0).all():
            raise InputError("a hexahedron is turned inside out", "lattice", "use finer cells")
        # R turns the strain into five numbers. Their squares sum to 3 e².
        self.shear = np.einsum("rq,cgqj->cgrj", _ROOT, strain_matrix(gradients))
        self.curve = ShearCurve.of(material)

    @property
    def stiffness(self) -> sparse.csr_matrix:
        """Linear stiffness (3n, 3n), N/m."""
        return self.pattern.assemble(self._linear_matrices())

    def _linear_matrices(self) -> Iterator[Array]:
        for chunk in chunks(len(self.cells)):
            shear = np.sqrt(self.weights[chunk])[..., None, None] * self.shear[chunk]
            flat = shear.reshape(-1, 40, 24)
            matrices = self.material.shear_modulus * (np.swapaxes(flat, 1, 2) @ flat)
            yield matrices + self.bulk(chunk)

    def linear_force(self, displacement: Array) -> Array:
        """Return K u, N, (n, 3); see `Solid`."""
        strain, _ = self._state(displacement)
        strain *= (self.material.shear_modulus * self.weights)[..., None]
        force = self._per_cell_forces(strain, None) + self.bulk_force(displacement)
        return self.scatter.sum(force)

    def nonlinear_residual(self, displacement: Array, chosen: Index | None = None) -> Array:
        """Return the nodal forces of the stress 2 (mu - mu_s) dev eps, N, (k, 24)."""
        strain, equivalent = self._state(displacement, chosen)
        # The linear stiffness overestimates the deviatoric stress by 2 (mu - mu_s) dev eps.
        lost_modulus = self.material.shear_modulus - self.curve.modulus(equivalent)
        strain *= (lost_modulus * elements_of(self.weights, chosen))[..., None]
        return self._per_cell_forces(strain, chosen)

    def tangent(self, displacement: Array) -> sparse.csr_matrix:
        """Return d f / d u (3n, 3n), N/m."""
        strain, equivalent = self._state(displacement)
        secant, softening = self.curve.modulus(equivalent), self.curve.softening(equivalent)

        def matrices() -> Iterator[Array]:
            for chunk in chunks(len(self.cells)):
                result = self.bulk(chunk)
                for point in range(8):
                    weight, shear = self.weights[chunk, point], self.shear[chunk, point]
                    result += (weight * secant[chunk, point])[:, None, None] * (
                        np.swapaxes(shear, 1, 2) @ shear
                    )
                    force = np.einsum("cri,cr->ci", shear, strain[chunk, point])
                    # The rank-one part of the tangent comes from the derivative of the secant
                    # modulus by the equivalent strain.
                    scale = weight * softening[chunk, point] / 3
                    result += scale[:, None, None] * force[:, :, None] * force[:, None, :]
                yield result

        return self.pattern.assemble(matrices())

    def _state(self, displacement: Array, chosen: Index | None = None) -> tuple[Array, Array]:
        """Return R eps (k, 8, 5) and the equivalent strain e (k, 8) at the Gauss points."""
        local = self.scatter.gather(displacement, chosen)
        strain = np.einsum("cgrj,cj->cgr", elements_of(self.shear, chosen), local)
        return strain, np.sqrt(np.einsum("cgr,cgr->cg", strain, strain) / 3)

    def _per_cell_forces(self, stress: Array, chosen: Index | None) -> Array:
        """Return nodal forces (k, 24) from R eps times modulus and weight (k, 8, 5)."""
        return np.einsum("cgrj,cgr->cj", elements_of(self.shear, chosen), stress)
