"""A solid made of cells, and its material law as a secant shear modulus.

J2 deformation theory with an elastic bulk: under uniaxial stress sigma the strain is
eps = e + sigma/(9 K), with e the equivalent deviatoric strain and K the bulk modulus, so that

    q(e) = sigma(eps),   e = eps - sigma(eps)/(9 K),   3 mu_s = q(e)/e

reproduces sigma(eps) exactly. e grows with eps, because the tangent never exceeds E and
E/(9 K) = (1 - 2 nu)/3 < 1. Strains are engineering strains of the undeformed shape.
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


@dataclass(frozen=True)
class StressCurveSettings:
    """A measured stress-strain curve."""

    least_strain: float = 1e-9
    """1: below this strain the secant modulus is that at this strain. Chosen: above zero, where
    stress over strain is 0/0."""


STRESS_CURVE = StressCurveSettings()

_STRAINS = np.concatenate([[0.0], np.geomspace(1e-7, 20.0, 6000)])


@dataclass(frozen=True, eq=False)
class ShearCurve:
    """Equivalent stress over equivalent deviatoric strain.

    Args:
        shear_modulus: mu at zero strain, Pa.
        spline: q(e), Pa, or None for a linear material.
    """

    shear_modulus: float
    spline: CubicHermiteSpline | None

    @classmethod
    def of(cls, material: Material) -> "ShearCurve":
        """Return the curve of a material, sampled finely with exact slopes."""
        if material.is_linear:
            return cls(material.shear_modulus, None)
        stress, tangent = material.stress(_STRAINS), material.tangent(_STRAINS)
        nine_bulk = 9 * material.bulk_modulus
        # Uniaxial strain minus its volumetric part leaves the equivalent deviatoric strain: e = eps
        # - s / (9 K).
        strain = _STRAINS - stress / nine_bulk
        # Chain rule: ds/de from ds/deps.
        spline = CubicHermiteSpline(strain, stress, tangent / (1 - tangent / nine_bulk))
        return cls(material.shear_modulus, spline)

    def modulus(self, equivalent: Array) -> Array:
        """Return the secant shear modulus mu_s, Pa, at equivalent strains e >= 0."""
        if self.spline is None:
            return np.full_like(equivalent, self.shear_modulus)
        floored = np.clip(equivalent, STRESS_CURVE.least_strain, self.spline.x[-1])
        return self.spline(floored) / (3 * floored)

    def softening(self, equivalent: Array) -> Array:
        """Return (d mu_s / d e) / e, Pa, at equivalent strains e >= 0: never positive."""
        if self.spline is None:
            return np.zeros_like(equivalent)
        floored = np.clip(equivalent, STRESS_CURVE.least_strain, self.spline.x[-1])
        slope = self.spline(floored, 1) / 3 - self.modulus(floored)
        # Below this strain the curve is elastic and the quotient is rounding.
        return np.where(equivalent < 1e-7, 0.0, slope / floored**2)


@dataclass(frozen=True)
class SolidSettings:
    """The elements of a lattice."""

    cells_at_once: int = 2000
    """Cells whose matrices are in memory at once, 9 MB."""


SOLID = SolidSettings()

DEVIATORIC = np.diag([2.0, 2.0, 2.0, 1.0, 1.0, 1.0])
DEVIATORIC[:3, :3] -= 2 / 3
"""2 dev eps : dev eps as a form (6, 6) in [xx, yy, zz, 2xy, 2yz, 2zx]."""
DIFFERENCE = 1e-5
"""Relative step of the displacement in a finite difference of the internal forces."""


@dataclass(frozen=True, eq=False)
class Pattern:
    """Where the node pairs of each element (cell or spring) go in the global matrix.

    Args:
        indptr: (n + 1,) start of each node's row.
        indices: (b,) column node of each block.
        slot: (c, p²) block of each ordered node pair of each element of p nodes.
    """

    indptr: Index
    indices: Index
    slot: Index

    @classmethod
    def of(cls, elements: Index, nodes: int) -> "Pattern":
        """Return the pattern of elements (c, p) on so many nodes."""
        count = elements.shape[1]
        rows = np.repeat(elements, count, axis=1).ravel().astype(np.int64)
        columns = np.tile(elements, (1, count)).ravel()
        keys, slot = np.unique(rows * nodes + columns, return_inverse=True)
        indptr = np.searchsorted(keys, np.arange(nodes + 1) * nodes)
        return cls(indptr, keys % nodes, slot.reshape(len(elements), count**2))

    @property
    def nodes(self) -> int:
        """How many nodes."""
        return len(self.indptr) - 1

    def assemble(self, matrices: Iterable[Array]) -> sparse.csr_matrix:
        """Return the sum (3n, 3n) of the elements' matrices.

        Args:
            matrices: (k, 3p, 3p) of consecutive groups of elements, in the elements' order.
        """
        blocks, at = np.zeros((len(self.indices), 3, 3)), 0
        for some in matrices:
            _add_blocks(some, self.slot[at : at + len(some)], blocks)
            at += len(some)
        size = 3 * self.nodes
        return sparse.bsr_matrix((blocks, self.indices, self.indptr), (size, size)).tocsr()


@compiled
def _add_blocks(matrices: Array, slot: Index, blocks: Array) -> None:
    """Add the (3, 3) blocks of matrices (k, 3p, 3p) to the slots (k, p²) that they have."""
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
    """Sums the elements' nodal vectors into global ones.

    Args:
        elements: (c, p) nodes of each element (cell or spring).
        nodes: how many nodes.
    """

    elements: Index
    nodes: int

    def gather(self, displacement: Array, chosen: Index | None = None) -> Array:
        """Return (k, 3p) of the chosen elements, by default of all, from nodal (n, 3)."""
        elements = elements_of(self.elements, chosen)
        return displacement[elements].reshape(len(elements), 3 * elements.shape[1])

    def sum(self, forces: Array, chosen: Index | None = None, which: Index | None = None) -> Array:
        """Return nodal (n, 3) from (k, 3p) of the chosen elements, by default of all.

        Args:
            forces: (k, 3p) N.
            chosen: (k,) elements.
            which: of the k that count; all by default.
        """
        total = np.zeros((self.nodes, 3))
        own = np.arange(len(self.elements)) if chosen is None else chosen
        some = np.arange(len(own)) if which is None else which
        shape = len(own), self.elements.shape[1], 3
        _add_up(forces.reshape(shape), self.elements, own, some, total)
        return total

    def mean(self, values: Array, forces: Array, chosen: Index) -> Array:
        """Return the force-weighted mean of elements' values at nodes (n,); 0 without elements.

        Args:
            values: (k,) of the chosen elements.
            forces: (k, 3p) N; their norms are the weights.
            chosen: (k,) elements.
        """
        return _mean_of(values, forces, self.elements, chosen, self.nodes)


def elements_of(elements: NDArray[Any], chosen: Index | None) -> NDArray[Any]:
    """Return some rows, by default all."""
    return elements if chosen is None else elements[chosen]


@compiled
def _add_up(parts: Array, elements: Index, chosen: Index, which: Index, total: Array) -> None:
    """Add vectors (k, p, 3) of some of the chosen elements (k,) to nodal vectors (n, 3)."""
    for k in which:
        element = chosen[k]
        for corner in range(parts.shape[1]):
            for axis in range(3):
                total[elements[element, corner], axis] += parts[k, corner, axis]


@compiled
def _mean_of(values: Array, forces: Array, elements: Index, chosen: Index, nodes: int) -> Array:
    """Return the nodes' weighted means (n,); see `Scatter.mean`."""
    total, weight = np.zeros(nodes), np.zeros(nodes)
    for k in range(len(chosen)):
        size = 0.0
        for i in range(forces.shape[1]):
            size += forces[k, i] ** 2
        size = np.sqrt(size)
        for corner in range(elements.shape[1]):
            node = elements[chosen[k], corner]
            total[node] += size * values[k]
            weight[node] += size
    for node in range(nodes):
        if weight[node] > 0.0:
            total[node] /= weight[node]
    return total


@compiled
def _mean_strains(cells: Index, gradients: Array, displacement: Array, chosen: Index) -> Array:
    """Return the symmetric mean gradient (k, 3, 3) of nodal displacements (n, 3) in some cells."""
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
    """Cells of eight nodes with a material, small strain.

    Args:
        nodes: (n, 3) m.
        cells: (c, 8), VTK hexahedron order.
        spacing: (3,) m, edges of the lattice's box cell.
        material: its E, nu and stress-strain law.

    Attributes:
        gradients: (c, 8, 3) mean gradients of the cells' shape functions, 1/m.
        volume: (c,) m³.

    Raises:
        InputError: a cell is turned inside out.
    """

    def __init__(self, nodes: Array, cells: Index, spacing: Array, material: Material) -> None:
        self.nodes, self.cells, self.spacing, self.material = nodes, cells, spacing, material
        # The mean gradient makes the volumetric part constant in a cell (B-bar), so that nearly
        # incompressible material does not lock.
        self.gradients, self.volume = mean_gradient(self.corners())
        if not (self.volume > 0).all():
            raise InputError(
                f"{int((self.volume <= 0).sum())} cells are turned inside out",
                "lattice",
                "take a finer resolution",
            )
        self.scatter = Scatter(cells, len(nodes))

    def corners(self, cells: slice = slice(None)) -> Array:
        """Return the corners (k, 8, 3), m, of cells, from their first."""
        corners = self.nodes[self.cells[cells]]
        return np.ascontiguousarray(corners - corners[:, :1])

    @cached_property
    def pattern(self) -> Pattern:
        """Where cell matrices go in the global one."""
        return Pattern.of(self.cells, len(self.nodes))

    @property
    @abstractmethod
    def stiffness(self) -> sparse.csr_matrix:
        """Linear stiffness (3n, 3n), N/m; assembled anew, it is as large as half of the factor."""

    @abstractmethod
    def nonlinear_residual(self, displacement: Array, chosen: Index | None = None) -> Array:
        """Return linear forces minus the material's own, N, of elements of `scatter` (k, 3p).

        Args:
            displacement: (n, 3) m; only the chosen elements' nodes are used.
            chosen: (k,) elements; all by default.
        """

    def forces(self, displacement: Array) -> tuple[Array, Array, float]:
        """Return the forces that hold a displacement (n, 3), m, summed element by element.

        No stored factor is involved, so that they measure the error of a solution.

        Returns:
            Internal forces f(u) (n, 3), N; h = K u - f(u) of each element (k, 3p), N; and
            uᵀ K_T u, N·m, with the tangent stiffness K_T. Here that is a finite difference.
        """
        residuals = self.nonlinear_residual(displacement)
        internal = self.linear_force(displacement) - self.scatter.sum(residuals)
        # Directional derivative along the displacement itself: one more evaluation gives u K u.
        further = (1 + DIFFERENCE) * displacement
        beyond = self.linear_force(further) - self.residual_force(further)
        work = float(np.vdot(displacement, beyond - internal)) / DIFFERENCE
        return internal, residuals, work

    def residual_force(self, displacement: Array) -> Array:
        """Return h = K u - f(u), N, (n, 3): linear forces minus the material's own."""
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
        """Return K u, N, (n, 3), summed element by element: no matrix is assembled."""

    def least_principal_strain(self, displacement: Array) -> float:
        """Return the smallest principal strain of the mean gradients of all cells.

        The norm of a strain tensor bounds the size of its principal values. So the cell with the
        largest norm is evaluated first. Then only those cells are evaluated whose norm is at
        least its compression.
        """
        strain = self.strain(displacement)
        norms = np.sqrt(np.einsum("kab,kab->k", strain, strain))
        most = int(norms.argmax())
        near = norms >= -np.linalg.eigvalsh(strain[most])[0]
        near[most] = True  # under uniaxial strain rounding may put its norm below its compression
        return float(np.linalg.eigvalsh(strain[near]).min())

    def bulk(self, cells: slice) -> Array:
        """Return K V g gᵀ of some cells (k, 24, 24), N/m, g · u their mean dilatation."""
        g = self.gradients[cells].reshape(-1, 24)
        # Volumetric stiffness K V g gᵀ, with g the mean gradient of the dilatation.
        scale = self.material.bulk_modulus * self.volume[cells]
        return (scale[:, None] * g)[:, :, None] * g[:, None, :]

    def bulk_force(self, displacement: Array) -> Array:
        """Return K V g (g · u) of all cells (c, 24), N."""
        g = self.gradients.reshape(-1, 24)
        dilatation = np.einsum("ci,ci->c", g, displacement[self.cells].reshape(-1, 24))
        return (self.material.bulk_modulus * self.volume * dilatation)[:, None] * g

    def strain(self, displacement: Array, chosen: Index | None = None) -> Array:
        """Return the mean strain (k, 3, 3) of cells, by default of all."""
        some = np.arange(len(self.cells)) if chosen is None else chosen
        return _mean_strains(self.cells, self.gradients, displacement, some)


def chunks(count: int) -> Iterator[slice]:
    """Yield slices of at most `SOLID.cells_at_once` cells."""
    for first in range(0, count, SOLID.cells_at_once):
        yield slice(first, min(first + SOLID.cells_at_once, count))


def strain_matrix(gradients: Array) -> Array:
    """Return B (..., 6, 24) with strain [xx, yy, zz, 2xy, 2yz, 2zx] = B u from (..., 8, 3)."""
    matrix = np.zeros((*gradients.shape[:-2], 6, 8, 3))
    for row, (k, m) in enumerate([(0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (2, 0)]):
        matrix[..., row, :, k] += gradients[..., m]
        if k != m:
            matrix[..., row, :, m] += gradients[..., k]
    return matrix.reshape(*gradients.shape[:-2], 6, 24)
