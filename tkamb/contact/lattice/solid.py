"""A solid made of cells, and its material law as a secant shear modulus mu_s.

The law is J2 deformation theory with an elastic bulk. Under uniaxial stress sigma the strain is eps
= e + sigma/(9 K), with the equivalent deviatoric strain e and the bulk modulus K, so

    q(e) = sigma(eps),   e = eps - sigma(eps)/(9 K),   3 mu_s = q(e)/e

reproduces sigma(eps) exactly. e grows with eps, because the tangent modulus is at most E and
E/(9 K) = (1 - 2 nu)/3 < 1. Strains are engineering strains.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

from tkamb.contact.lattice.meshing.cells import mean_gradient
from tkamb.contact.materials import Material
from tkamb.errors import InputError
from tkamb.geometry.compiled import compiled
from tkamb.geometry.frames import Array, Index

# 1: smaller strains get the secant modulus at this strain. Stress over strain is
# 0/0 at zero.
LEAST_STRAIN = 1e-9


_STRAINS = np.concatenate([[0.0], np.geomspace(1e-7, 20.0, 6000)])


@dataclass(frozen=True, eq=False)
class ShearCurve:
    """The curve q(e) of equivalent stress over equivalent deviatoric strain.

    Args:
        spline: q(e), Pa, or None for a linear material.
    """

    shear_modulus: float
    spline: CubicHermiteSpline | None

    @classmethod
    def of(cls, material: Material) -> "ShearCurve":
        """Return the curve of a material, as a fine spline with exact slopes."""
        if material.is_linear:
            return cls(material.shear_modulus, None)
        stress, tangent = material.stress(_STRAINS), material.tangent(_STRAINS)
        nine_bulk = 9 * material.bulk_modulus
        # e is the uniaxial strain minus its volumetric part.
        strain = _STRAINS - stress / nine_bulk
        # The chain rule gives dq/de from dsigma/deps.
        spline = CubicHermiteSpline(strain, stress, tangent / (1 - tangent / nine_bulk))
        return cls(material.shear_modulus, spline)

    def modulus(self, equivalent: Array) -> Array:
        """Return the secant shear modulus mu_s, Pa, at equivalent strains e >= 0."""
        if self.spline is None:
            return np.full_like(equivalent, self.shear_modulus)
        floored = np.clip(equivalent, LEAST_STRAIN, self.spline.x[-1])
        return self.spline(floored) / (3 * floored)

    def softening(self, equivalent: Array) -> Array:
        """Return (d mu_s / d e) / e, Pa, at equivalent strains e >= 0; it is never positive."""
        if self.spline is None:
            return np.zeros_like(equivalent)
        floored = np.clip(equivalent, LEAST_STRAIN, self.spline.x[-1])
        slope = self.spline(floored, 1) / 3 - self.modulus(floored)
        # Below this strain the curve is elastic, and the quotient would be rounding error.
        return np.where(equivalent < 1e-7, 0.0, slope / floored**2)


# Number of cells whose matrices are in memory at once. They take 9 MB.
CELLS_AT_ONCE = 2000


DEVIATORIC = np.diag([2.0, 2.0, 2.0, 1.0, 1.0, 1.0])
DEVIATORIC[:3, :3] -= 2 / 3
"""Matrix M (6, 6) with 2 dev eps : dev eps = eᵀ M e for strains e = [xx, yy, zz, 2xy, 2yz, 2zx]."""
DIFFERENCE = 1e-5
"""1: relative step of the displacement in the finite difference of internal forces."""


@dataclass(frozen=True, eq=False)
class Pattern:
    """The places of element matrices in the global matrix.

    Args:
        indptr: first block of each node's row, then the number of blocks, (n + 1,).
        indices: column node of each block, (b,).
        slot: block of each ordered node pair of each element of p nodes, (c, p²).
    """

    indptr: Index
    indices: Index
    slot: Index

    @classmethod
    def of(cls, elements: Index, nodes: int) -> "Pattern":
        """Return the pattern of elements (c, p) on a number of nodes."""
        count = elements.shape[1]
        rows = np.repeat(elements, count, axis=1).ravel().astype(np.int64)
        columns = np.tile(elements, (1, count)).ravel()
        keys, slot = np.unique(rows * nodes + columns, return_inverse=True)
        indptr = np.searchsorted(keys, np.arange(nodes + 1) * nodes)
        return cls(indptr, keys % nodes, slot.reshape(len(elements), count**2))

    @property
    def nodes(self) -> int:
        """Number of nodes."""
        return len(self.indptr) - 1

    def assemble(self, matrices: Iterable[Array]) -> sparse.csr_matrix:
        """Return the sum (3n, 3n) of `matrices` (k, 3p, 3p) of consecutive groups of elements."""
        blocks, at = np.zeros((len(self.indices), 3, 3)), 0
        for group in matrices:
            _add_blocks(group, self.slot[at : at + len(group)], blocks)
            at += len(group)
        size = 3 * self.nodes
        return sparse.bsr_matrix((blocks, self.indices, self.indptr), (size, size)).tocsr()


@compiled
def _add_blocks(matrices: Array, slot: Index, blocks: Array) -> None:
    """Add the (3, 3) blocks of matrices (k, 3p, 3p) to the blocks at `slot` (k, p²)."""
    count = matrices.shape[1] // 3
    for k in range(len(matrices)):
        for i in range(count):
            for j in range(count):
                block = blocks[slot[k, count * i + j]]
                for a in range(3):
                    for b in range(3):
                        block[a, b] += matrices[k, 3 * i + a, 3 * j + b]


@dataclass(frozen=True, eq=False)
class Scatter:
    """Sums nodal vectors of elements, (c, p) nodes, to global ones."""

    elements: Index
    nodes: int

    def gather(self, displacement: Array, chosen: Index | None = None) -> Array:
        """Return the nodal vectors (n, 3) of each chosen element, by default all, (k, 3p)."""
        elements = elements_of(self.elements, chosen)
        return displacement[elements].reshape(len(elements), 3 * elements.shape[1])

    def sum(self, forces: Array, chosen: Index | None = None) -> Array:
        """Return the nodal sums (n, 3), N, of forces (k, 3p) of the chosen elements."""
        total = np.zeros((self.nodes, 3))
        elements = np.arange(len(self.elements)) if chosen is None else chosen
        shape = len(elements), self.elements.shape[1], 3
        _add_up(forces.reshape(shape), self.elements, elements, total)
        return total


def elements_of(elements: NDArray[Any], chosen: Index | None) -> NDArray[Any]:
    """Return the chosen rows, by default all."""
    return elements if chosen is None else elements[chosen]


@compiled
def _add_up(parts: Array, elements: Index, chosen: Index, total: Array) -> None:
    """Add vectors (k, p, 3) of the chosen elements (k,) to nodal vectors (n, 3)."""
    for k in range(len(chosen)):
        element = chosen[k]
        for corner in range(parts.shape[1]):
            for axis in range(3):
                total[elements[element, corner], axis] += parts[k, corner, axis]


@compiled
def _mean_strains(cells: Index, gradients: Array, displacement: Array, chosen: Index) -> Array:
    """Return the mean strain (k, 3, 3) of the chosen cells under displacements (n, 3), m."""
    strains = np.empty((len(chosen), 3, 3))
    gradient = np.empty((3, 3))
    for k in range(len(chosen)):
        cell = chosen[k]
        gradient[:] = 0.0
        for corner in range(8):
            for a in range(3):
                component = displacement[cells[cell, corner], a]
                for b in range(3):
                    gradient[a, b] += component * gradients[cell, corner, b]
        for a in range(3):
            for b in range(3):
                strains[k, a, b] = (gradient[a, b] + gradient[b, a]) / 2
    return strains


class Solid(ABC):
    """A solid of eight-node cells, small strain.

    Args:
        nodes: m, (n, 3).
        cells: nodes of the cells in VTK hexahedron order, (c, 8).
        spacing: edges of the lattice's box cell, m, (3,).

    Attributes:
        gradients: mean gradients of the cells' shape functions, 1/m, (c, 8, 3).
        volume: volumes of the cells, m³, (c,).

    Raises:
        InputError: a cell is turned inside out.
    """

    def __init__(self, nodes: Array, cells: Index, spacing: Array, material: Material) -> None:
        self.nodes, self.cells, self.spacing, self.material = nodes, cells, spacing, material
        # The dilatation is constant in a cell (B-bar), so that a nearly incompressible material
        # does not lock.
        self.gradients, self.volume = mean_gradient(self.corners())
        if not (self.volume > 0).all():
            raise InputError(
                f"{int((self.volume <= 0).sum())} cells are turned inside out",
                "lattice",
                "take a finer resolution",
            )
        self.scatter = Scatter(cells, len(nodes))

    def corners(self, cells: slice = slice(None)) -> Array:
        """Return the corners (k, 8, 3), m, of cells, relative to their first corner."""
        corners = self.nodes[self.cells[cells]]
        return np.ascontiguousarray(corners - corners[:, :1])

    @cached_property
    def pattern(self) -> Pattern:
        """The places of cell matrices in the global matrix."""
        return Pattern.of(self.cells, len(self.nodes))

    @property
    @abstractmethod
    def stiffness(self) -> sparse.csr_matrix:
        """Linear stiffness (3n, 3n), N/m, assembled anew at each access to save memory."""

    @abstractmethod
    def nonlinear_residual(self, displacement: Array, chosen: Index | None = None) -> Array:
        """Return linear minus actual forces (k, 3p), N, of the elements of `scatter`.

        Only the chosen elements' nodes of the displacement (n, 3), m, are used; by default all.
        """

    def forces(self, displacement: Array) -> tuple[Array, Array, float]:
        """Return the internal forces of a displacement (n, 3), m, summed element by element.

        They do not use the stored factor, whose rounding would hide the error of a solution.

        Returns:
            Internal forces f(u) (n, 3), N; norm of h = K u - f(u) of each element (k,), N; and
            uᵀ K_T u, N·m, with the tangent stiffness K_T (here by a finite difference).
        """
        residuals = self.nonlinear_residual(displacement)
        internal = self.linear_force(displacement) - self.scatter.sum(residuals)
        # The difference is taken along u itself, so that one more evaluation gives uᵀ K_T u.
        scaled = (1 + DIFFERENCE) * displacement
        scaled_force = self.linear_force(scaled) - self.residual_force(scaled)
        work = float(np.vdot(displacement, scaled_force - internal)) / DIFFERENCE
        return internal, np.linalg.norm(residuals, axis=1), work

    def residual_force(self, displacement: Array) -> Array:
        """Return h = K u - f(u), N, (n, 3): linear minus internal forces."""
        if self.material.is_linear:
            return np.zeros_like(displacement)
        return self.scatter.sum(self.nonlinear_residual(displacement))

    @abstractmethod
    def tangent(self, displacement: Array) -> sparse.csr_matrix:
        """Return d f / d u (3n, 3n), N/m."""

    def internal_force(self, displacement: Array) -> Array:
        """Return nodal internal forces f(u), N, (n, 3)."""
        linear = (self.stiffness @ displacement.ravel()).reshape(-1, 3)
        return linear - self.residual_force(displacement)

    @abstractmethod
    def linear_force(self, displacement: Array) -> Array:
        """Return K u, N, (n, 3), summed element by element."""

    def least_principal_strain(self, displacement: Array) -> float:
        """Return the smallest principal strain of the mean strains of all cells.

        Its size is at most the norm of the strain tensor: the cell with the largest norm is
        evaluated first, and cells whose norm is below its compression are skipped.
        """
        strain = self.strain(displacement)
        norms = np.sqrt(np.einsum("kab,kab->k", strain, strain))
        largest = int(norms.argmax())
        evaluated = norms >= -np.linalg.eigvalsh(strain[largest])[0]
        evaluated[largest] = True  # by rounding its norm may be below its uniaxial compression
        return float(np.linalg.eigvalsh(strain[evaluated]).min())

    def bulk(self, cells: slice) -> Array:
        """Return the volumetric stiffness K V g gᵀ (k, 24, 24), N/m; g · u: mean dilatation."""
        g = self.gradients[cells].reshape(-1, 24)
        scale = self.material.bulk_modulus * self.volume[cells]
        return (scale[:, None] * g)[:, :, None] * g[:, None, :]

    def bulk_force(self, displacement: Array) -> Array:
        """Return K V g (g · u) of all cells (c, 24), N."""
        g = self.gradients.reshape(-1, 24)
        dilatation = np.einsum("ci,ci->c", g, displacement[self.cells].reshape(-1, 24))
        return (self.material.bulk_modulus * self.volume * dilatation)[:, None] * g

    def strain(self, displacement: Array, chosen: Index | None = None) -> Array:
        """Return the mean strain (k, 3, 3) of the chosen cells, by default all."""
        cells = np.arange(len(self.cells)) if chosen is None else chosen
        return _mean_strains(self.cells, self.gradients, displacement, cells)


def chunks(count: int) -> Iterator[slice]:
    """Yield slices of at most `CELLS_AT_ONCE` cells."""
    for first in range(0, count, CELLS_AT_ONCE):
        yield slice(first, min(first + CELLS_AT_ONCE, count))


def strain_matrix(gradients: Array) -> Array:
    """Return B (..., 6, 24), with B u = [xx, yy, zz, 2xy, 2yz, 2zx], of gradients (..., 8, 3)."""
    matrix = np.zeros((*gradients.shape[:-2], 6, 8, 3))
    for row, (k, m) in enumerate([(0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (2, 0)]):
        matrix[..., row, :, k] += gradients[..., m]
        if k != m:
            matrix[..., row, :, m] += gradients[..., k]
    return matrix.reshape(*gradients.shape[:-2], 6, 24)
