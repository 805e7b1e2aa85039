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
On a box this is K_spr - (5/3) V g gᵀ; on a sheared cell it keeps the patch exact
(`cell_loops.py` works it out).
"""

from collections.abc import Iterator
from functools import cached_property

import numpy as np
import scipy.sparse as sparse

from tkamb.contact.lattice.meshing.cells import CORNERS, PAIR_AXES, PAIRS
from tkamb.contact.lattice.solids.cell_loops import (
    cell_forces,
    deviatoric_matrices,
    shear_forces,
    softened_forces,
)
from tkamb.contact.lattice.solids.curve import STRESS_CURVE, ShearCurve
from tkamb.contact.lattice.solids.solid import Solid, chunks
from tkamb.contact.materials import Material
from tkamb.geometry.frames import Array, Index
from tkamb.geometry.threads import in_halves


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
    # Beyond it a face diagonal's stiffness would be negative.
    upper = np.prod(edges) * square.sum() / (4 * pairs.max())
    candidates = np.linspace(0, upper, 201)[1:-1]
    none = spring_families(edges, 0.0)
    per_unit = spring_families(edges, 1.0) - none
    # Family stiffnesses are linear in the body diagonal's, so that two evaluations give all.
    families = none + candidates[:, None] * per_unit
    complete = families.min(axis=1) >= 0
    if complete.any():
        candidates = candidates[complete]
    corners = box_corners(edges)[None]
    matrices = spring_matrix(corners, none)
    matrices = matrices + candidates[:, None, None] * spring_matrix(corners, per_unit)
    # Six eigenvalues are rigid motions; the seventh is the softest deformation, which hourglassing
    # would make zero.
    return float(candidates[np.linalg.eigvalsh(matrices)[:, 6].argmax()])


class CalibratedNetwork(Solid):
    """Cells mu_s K_d + K V g gᵀ, with mu_s from the cell's equivalent strain.

    e² = uᵀ K_d u / (3 V), 3 mu_s = q(e)/e: the forces derive from an energy, so the tangent
    is symmetric. See `Solid` for the arguments.
    """

    def __init__(self, nodes: Array, cells: Index, spacing: Array, material: Material) -> None:
        super().__init__(nodes, cells, spacing, material)
        self.springs = spring_families(spacing, body_diagonal_stiffness(spacing))
        self.curve = ShearCurve.of(material)

    def _deviatoric(self, cells: slice) -> Array:
        """Return K_d of some cells (k, 24, 24), m per unit shear modulus."""
        measures = self.gradients[cells], self.volume[cells]
        return deviatoric_matrices(self.corners(cells), *measures, self.springs, PAIRS)

    @property
    def stiffness(self) -> sparse.csr_matrix:
        """Linear stiffness (3n, 3n), N/m: mu K_d + K V g gᵀ of the cells."""
        mu = self.material.shear_modulus
        some = chunks(len(self.cells))
        return self.pattern.assemble(mu * self._deviatoric(c) + self.bulk(c) for c in some)

    def linear_force(self, displacement: Array) -> Array:
        """Return K u, N, (n, 3); see `Solid`."""
        force, _ = self._state(displacement)
        force *= self.material.shear_modulus
        return self.scatter.sum(force + self.bulk_force(displacement))

    def nonlinear_residual(self, displacement: Array, chosen: Index | None = None) -> Array:
        """Return (mu - mu_s) K_d u of the cells, N, (k, 24); see `Solid`."""
        cells = np.arange(len(self.cells)) if chosen is None else chosen
        if self.curve.spline is None:
            return np.zeros((len(cells), 24))
        curve = (
            self.curve.shear_modulus,
            self.curve.spline.x,
            self.curve.spline.c,
            STRESS_CURVE.least_strain,
        )
        forces = np.empty((len(cells), 24))

        def softened(some: slice) -> None:
            shapes, where = self._shapes, (self.cells, cells[some], displacement)
            softened_forces(*shapes, *curve, *where, forces[some])

        in_halves(softened, len(cells))
        return forces

    def forces(self, displacement: Array) -> tuple[Array, Array, float]:
        """Return f(u) (n, 3), h of each cell (c, 24), N, and uᵀ K_T u, N·m; see `Solid`."""
        if self.curve.spline is None:
            return super().forces(displacement)
        shear, bulk = self.curve.shear_modulus, self.material.bulk_modulus
        knots, cubic = self.curve.spline.x, self.curve.spline.c
        residuals = np.empty((len(self.cells), 24))

        def added(some: slice) -> tuple[Array, float]:
            internal = np.zeros_like(self.nodes)
            corners, gradients, volume, springs = self._shapes
            work = cell_forces(
                corners[some], gradients[some], volume[some], springs,
                shear, bulk, knots, cubic, STRESS_CURVE.least_strain,
                self.cells[some], displacement, residuals[some], internal,
            )  # fmt: skip
            return internal, work

        (first, work), (second, more) = in_halves(added, len(self.cells))
        return first + second, residuals, work + more

    def tangent(self, displacement: Array) -> sparse.csr_matrix:
        """Return d f / d u (3n, 3n): mu_s K_d + mu_s'/(3 V e) (K_d u)(K_d u)ᵀ + bulk."""
        force, equivalent = self._state(displacement)
        secant, softening = self.curve.modulus(equivalent), self.curve.softening(equivalent)
        scale = softening / (3 * self.volume)

        def matrices() -> Iterator[Array]:
            for some in chunks(len(self.cells)):
                result = secant[some, None, None] * self._deviatoric(some) + self.bulk(some)
                outer = force[some, :, None] * force[some, None, :]
                yield result + scale[some, None, None] * outer

        return self.pattern.assemble(matrices())

    @cached_property
    def _shapes(self) -> tuple[Array, Array, Array, Array]:
        """Corners (c, 3, 8), mean gradients (c, 3, 8), volumes (c,) and springs (8, 8)."""
        corners, gradients = (
            np.ascontiguousarray(one.transpose(0, 2, 1)) for one in (self.corners(), self.gradients)
        )
        springs = np.zeros((8, 8))
        springs[tuple(PAIRS.T)] = self.springs
        return corners, gradients, self.volume, springs + springs.T

    def _state(self, displacement: Array, chosen: Index | None = None) -> tuple[Array, Array]:
        """Return K_d u (k, 24) and the equivalent strain e (k,) of the chosen cells."""
        cells = np.arange(len(self.cells)) if chosen is None else chosen
        return shear_forces(*self._shapes, self.cells, cells, displacement)
