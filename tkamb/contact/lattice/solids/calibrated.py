"""Stiffness of the calibrated cell: 28 springs that make an isotropic solid.

Springs in a lattice of box cells of edges a, b, c (volume V, L² = a² + b² + c²), at unit
shear modulus; a cell owns a quarter of each edge, half of each face diagonal and all of its
body diagonals, so that the network's spring is the sum over the cells that own it:

    face diagonals   k_xy = (a² + b²)/(2 a² b²) (V - 4 k_b a² b²/L²), cyclic
    edges            k_x  = V/a² (3 - a²/b² - a²/c²) + 4 k_b a²/L², cyclic
    body diagonals   k_b, free between bounds

Then the energy of a uniform strain is that of an isotropic solid with lambda = mu (see
docs/lattice.md). Taking the bulk part (5/3) V g gᵀ away leaves the deviatoric stiffness

    K_d = V B̄ᵀ (2 I_dev) B̄ + Pᵀ K_spr P

with B̄ the strain of the cell's mean gradient and P what the mean gradient does not explain.
On a box this is K_spr - (5/3) V g gᵀ; on a sheared cell it keeps the patch exact.
"""

from functools import cached_property

import numpy as np
import scipy.sparse as sparse

from tkamb.contact.lattice.meshing.cells import CORNERS, PAIR_AXES, PAIRS, mean_gradient
from tkamb.contact.lattice.solids.curve import ShearCurve
from tkamb.contact.lattice.solids.solid import DEVIATORIC, CellSolid, strain_matrix
from tkamb.contact.materials import Material
from tkamb.geometry.frames import Array, Index


def spring_families(edges: Array, body_diagonal: float) -> Array:
    """Return what one cell owns of its 28 springs, per unit shear modulus, m.

    Args:
        edges: (3,) a, b, c in m.
        body_diagonal: k_b per unit shear modulus, m.
    """
    square, volume = edges**2, np.prod(edges)
    total = square.sum()
    stiffness = np.empty(len(PAIRS))
    for spring, axes in enumerate(PAIR_AXES.astype(bool)):
        if axes.sum() == 1:
            own, others = square[axes][0], square[~axes]
            whole = (
                volume / own * (3 - own / others[0] - own / others[1])
                + 4 * body_diagonal * own / total
            )
            stiffness[spring] = whole / 4
        elif axes.sum() == 2:
            product = square[axes].prod()
            whole = (
                square[axes].sum() / (2 * product) * (volume - 4 * body_diagonal * product / total)
            )
            stiffness[spring] = whole / 2
        else:
            stiffness[spring] = body_diagonal
    return stiffness


def spring_matrix(corners: Array, stiffness: Array) -> Array:
    """Return the stiffness (s, 24, 24) of springs k (28,) on cells (s, 8, 3): sum of k n nᵀ."""
    lines = corners[:, PAIRS[:, 1]] - corners[:, PAIRS[:, 0]]
    unit = lines / np.linalg.norm(lines, axis=2, keepdims=True)
    block = stiffness[:, None, None] * unit[..., :, None] * unit[..., None, :]
    matrix = np.zeros((len(corners), 8, 3, 8, 3))
    for spring, (i, j) in enumerate(PAIRS):
        matrix[:, i, :, i] += block[:, spring]
        matrix[:, j, :, j] += block[:, spring]
        matrix[:, i, :, j] -= block[:, spring]
        matrix[:, j, :, i] -= block[:, spring]
    return matrix.reshape(-1, 24, 24)


def box_corners(edges: Array) -> Array:
    """Return the corners (8, 3) of a box cell with these edges (3,), m."""
    return CORNERS * edges


def body_diagonal_stiffness(edges: Array) -> float:
    """Return k_b per unit shear modulus (m) that makes the cell's softest mode stiffest.

    Among k_b that leave no spring negative (if there are any) it maximises the smallest of
    the 18 eigenvalues that are not rigid modes. At the upper bound mu V L²/(4 max pair
    product) a face diagonal vanishes and hourglass modes appear; k_b = 0 is indefinite at
    edge ratio 1.5.
    """
    square = edges**2
    pairs = square * np.roll(square, 1)
    upper = np.prod(edges) * square.sum() / (4 * pairs.max())
    candidates = np.linspace(0, upper, 201)[1:-1]
    families = np.stack([spring_families(edges, k) for k in candidates])
    kept = families.min(axis=1) >= 0
    if kept.any():
        candidates, families = candidates[kept], families[kept]
    corners, none = box_corners(edges)[None], spring_families(edges, 0.0)
    per_unit = spring_matrix(corners, spring_families(edges, 1.0) - none)
    matrices = spring_matrix(corners, none) + candidates[:, None, None] * per_unit
    return float(candidates[np.linalg.eigvalsh(matrices)[:, 6].argmax()])


def unexplained(corners: Array, gradients: Array) -> Array:
    """Return P (s, 24, 24): displacements minus the linear field of the cell's mean gradient."""
    linear = np.einsum("sia,sja->sij", corners, gradients)
    projection = np.eye(8) - linear
    return np.einsum("sij,ab->siajb", projection, np.eye(3)).reshape(-1, 24, 24)


def deviatoric_matrices(corners: Array, edges: Array) -> tuple[Array, Array, Array]:
    """Return K_d, g and V of cells with the springs of the nominal box.

    Args:
        corners: (s, 8, 3) m, true shapes.
        edges: (3,) m, edges of the lattice's box cell: they set the spring stiffnesses.

    Returns:
        K_d (s, 24, 24) in m per unit shear modulus, mean-dilatation vector g (s, 24) in 1/m
        and volume V (s,) in m³. A cell is mu K_d + K V g gᵀ with the bulk modulus K.
    """
    stiffness = spring_families(edges, body_diagonal_stiffness(edges))
    gradients, volume = mean_gradient(corners)
    strain = strain_matrix(gradients)
    mean = np.einsum("s,sri,rq,sqj->sij", volume, strain, DEVIATORIC, strain, optimize=True)
    rest = unexplained(corners, gradients)
    springs = np.swapaxes(rest, 1, 2) @ spring_matrix(corners, stiffness) @ rest
    return mean + springs, gradients.reshape(-1, 24), volume


class CalibratedNetwork(CellSolid):
    """Cells mu_s K_d + K V g gᵀ, with mu_s from the cell's equivalent strain.

    e² = uᵀ K_d u / (3 V), 3 mu_s = q(e)/e: the forces derive from an energy, so the tangent
    is symmetric. See `Solid` for the arguments.
    """

    def __init__(self, nodes: Array, cells: Index, spacing: Array, material: Material) -> None:
        super().__init__(nodes, cells, spacing, material)
        self.deviatoric, self.dilatation, self.volume = deviatoric_matrices(self.shapes, spacing)
        self.curve = ShearCurve.of(material)

    def shape_stiffness(self) -> Array:
        """Return mu K_d + K V g gᵀ of each shape (s, 24, 24), N/m."""
        return self.material.shear_modulus * self.deviatoric + self.bulk

    def nonlinear_residual(self, displacement: Array, chosen: Index | None = None) -> Array:
        """Return (mu - mu_s) K_d u of the cells, N, (k, 24); see `Solid`."""
        force, equivalent = self._state(displacement, chosen)
        softened = self.material.shear_modulus - self.curve.modulus(equivalent)
        return softened[:, None] * force

    def tangent(self, displacement: Array) -> sparse.csr_matrix:
        """Return d f / d u (3n, 3n): mu_s K_d + mu_s'/(3 V e) (K_d u)(K_d u)ᵀ + bulk."""
        force, equivalent = self._state(displacement)
        shape = self.shape_of_cell
        secant, softening = self.curve.modulus(equivalent), self.curve.softening(equivalent)
        scale = softening / (3 * self.volume[shape])
        matrices = secant[:, None, None] * self.deviatoric[shape] + self.bulk[shape]
        matrices += scale[:, None, None] * force[:, :, None] * force[:, None, :]
        return self.pattern.assemble(matrices)

    @cached_property
    def _others(self) -> Array:
        """K_d of the cells that are not of the commonest shape."""
        return self.deviatoric[self.shape_of_cell[self.kinds[1]]]

    def _state(self, displacement: Array, chosen: Index | None = None) -> tuple[Array, Array]:
        """Return K_d u (k, 24) and the equivalent strain e (k,) of the chosen cells."""
        local = self.scatter.gather(displacement, chosen)
        cells = slice(None) if chosen is None else chosen
        matrices, index = self._others, self.index_among_others[cells]
        force = local @ self.deviatoric[self.kinds[0]]
        others = np.flatnonzero(index >= 0)
        matrices = matrices if chosen is None else matrices[index[others]]
        force[others] = np.einsum("cij,cj->ci", matrices, local[others])
        energy = np.einsum("ci,ci->c", local, force)
        volume = self.volume[self.shape_of_cell[cells]]
        return force, np.sqrt(np.maximum(energy, 0) / (3 * volume))
