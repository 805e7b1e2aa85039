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
from numpy.typing import NDArray

from tkamb.contact.lattice.compiled import compiled
from tkamb.contact.lattice.meshing.cells import CORNERS, PAIR_AXES, PAIRS, mean_gradient
from tkamb.contact.lattice.solids.curve import LEAST_STRAIN, ShearCurve
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
        cells = np.arange(len(self.cells)) if chosen is None else chosen
        if self.curve.spline is None:
            return np.zeros((len(cells), 24))
        curve = (self.curve.shear_modulus, self.curve.spline.x, self.curve.spline.c)
        return _softened_forces(
            self._diagonals, self._volumes, *curve, self.cells, cells, displacement
        )

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
    def _diagonals(self) -> NDArray[np.float32]:
        """K_d of each cell by diagonals (c, 13, 24): entry i of the k-th is K_d[i, i + k mod 24].

        The matrix is symmetric, so that thirteen wrapped diagonals say all. The first and the
        last one are halved: `_shear_forces` takes each twice.
        """
        row = np.arange(24)
        column = (row + np.arange(13)[:, None]) % 24
        packed = self.deviatoric[:, row, column].astype(np.float32)
        packed[:, [0, 12]] /= 2
        return packed[self.shape_of_cell]

    @cached_property
    def _volumes(self) -> Array:
        """V of each cell (c,), m³."""
        return self.volume[self.shape_of_cell]

    def _state(self, displacement: Array, chosen: Index | None = None) -> tuple[Array, Array]:
        """Return K_d u (k, 24) and the equivalent strain e (k,) of the chosen cells."""
        cells = np.arange(len(self.cells)) if chosen is None else chosen
        return _shear_forces(self._diagonals, self._volumes, self.cells, cells, displacement)


@compiled
def _shear_force(
    diagonals: NDArray[np.float32],
    nodes: Index,
    displacement: Array,
    u: Array,
    force: Array,
) -> float:
    """Put K_d u of a cell into force (36,), of which 24 count; return uᵀ K_d u; u (36,) is scratch.

    u is taken from the cell's first node: K_d knows nothing of the way all nodes go together,
    and without it single precision of K_d does. Each diagonal meets u twice, above and below the
    main one, in stretches that fill vector registers.
    """
    for corner in range(8):
        for axis in range(3):
            u[3 * corner + axis] = displacement[nodes[corner], axis] - displacement[nodes[0], axis]
    u[24:] = u[:12]
    force[:] = 0.0
    for shift in range(13):
        for i in range(24):
            force[i] += diagonals[shift, i] * u[i + shift]
        for i in range(24):
            force[i + shift] += diagonals[shift, i] * u[i]
    force[:12] += force[24:]
    energy = 0.0
    for i in range(24):
        energy += force[i] * u[i]
    return max(energy, 0.0)


@compiled
def _shear_forces(
    diagonals: NDArray[np.float32],
    volumes: Array,
    nodes: Index,
    chosen: Index,
    displacement: Array,
) -> tuple[Array, Array]:
    """Return K_d u (k, 24) and the equivalent strain (k,) of chosen cells."""
    forces, strains = np.empty((len(chosen), 24)), np.empty(len(chosen))
    u, force = np.empty(36), np.empty(36)
    for k in range(len(chosen)):
        cell = chosen[k]
        energy = _shear_force(diagonals[cell], nodes[cell], displacement, u, force)
        strains[k] = np.sqrt(energy / (3 * volumes[cell]))
        forces[k] = force[:24]
    return forces, strains


@compiled
def _softened_forces(
    diagonals: NDArray[np.float32],
    volumes: Array,
    shear_modulus: float,
    knots: Array,
    cubic: Array,
    nodes: Index,
    chosen: Index,
    displacement: Array,
) -> Array:
    """Return (mu - mu_s) K_d u (k, 24) of chosen cells; 3 mu_s e is cubic between knots of e."""
    forces = np.empty((len(chosen), 24))
    u, force = np.empty(36), np.empty(36)
    for k in range(len(chosen)):
        cell = chosen[k]
        energy = _shear_force(diagonals[cell], nodes[cell], displacement, u, force)
        strain = min(max(np.sqrt(energy / (3 * volumes[cell])), LEAST_STRAIN), knots[-1])
        part = min(np.searchsorted(knots, strain, side="right") - 1, len(knots) - 2)
        x = strain - knots[part]
        stress = ((cubic[0, part] * x + cubic[1, part]) * x + cubic[2, part]) * x + cubic[3, part]
        softened = shear_modulus - stress / (3 * strain)
        for i in range(24):
            forces[k, i] = softened * force[i]
    return forces
