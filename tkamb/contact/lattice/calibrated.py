"""Stiffness of the calibrated cell: 28 springs that make an isotropic solid.

The cells are boxes with edges a, b, c, volume V and L² = a² + b² + c². At unit shear modulus,
the springs of the whole lattice are

    face diagonals   k_xy = (a² + b²)/(2 a² b²) (V - 4 k_b a² b²/L²), cyclic
    edges            k_x  = V/a² (3 - a²/b² - a²/c²) + 4 k_b a²/L², cyclic
    body diagonals   k_b, free between bounds

A cell owns a quarter of each edge, half of each face diagonal and all of its body diagonals.
A uniform strain then stores the energy of an isotropic solid with lambda = mu
(docs/lattice.md). The deviatoric stiffness of a cell of any shape is

    K_d = V B̄ᵀ (2 I_dev) B̄ + Pᵀ K_spr P

B̄ gives the strain of the cell's mean displacement gradient, and I_dev its deviatoric part. P
subtracts the linear field of this gradient from the displacement. K_spr is the matrix of the
springs. So the patch test is exact for sheared cells too.
"""

from collections.abc import Iterator
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from tkamb.contact.lattice.meshing.cells import CORNERS, PAIR_AXES, PAIRS
from tkamb.contact.lattice.solid import LEAST_STRAIN, ShearCurve, Solid, chunks
from tkamb.contact.materials import Material
from tkamb.geometry.compiled import compiled
from tkamb.geometry.frames import Array, Index
from tkamb.geometry.threads import in_halves

# Coordinates of a cube's corners, -1 or 1.
_SIGNS = 2.0 * CORNERS - 1.0
HOURGLASS_MODES = np.stack([*(_SIGNS * np.roll(_SIGNS, 1, axis=1)).T, _SIGNS.prod(axis=1)])
"""H (4, 8): displacements of a cube's corners along an axis without a mean gradient."""


@compiled
def deviatoric_matrices(
    corners: Array, gradients: Array, volumes: Array, springs: Array, pairs: Index
) -> Array:
    """Return K_d = V B̄ᵀ (2 I_dev) B̄ + Pᵀ K_spr P of cells (c, 24, 24), m per unit shear modulus.

    Between nodes i and j the first part is V (g_i·g_j I + g_j g_iᵀ - 2/3 g_i g_jᵀ). A spring k
    along n between corners a and b adds k r_i r_j n nᵀ. Here r is the difference of the rows b and
    a of P = I - x gᵀ (8, 8).

    Args:
        corners: true corners, m, (c, 8, 3).
        gradients: mean gradients g, 1/m, (c, 8, 3).
        volumes: m³, (c,).
        springs: `spring_families` of the nominal box, m, (28,).
        pairs: corners that each spring joins, (28, 2).
    """
    result = np.zeros((len(corners), 24, 24))
    excess = np.empty((8, 8))
    elongation, force = np.empty((len(pairs), 24)), np.empty((len(pairs), 24))
    for cell in range(len(corners)):
        x, g, matrix = corners[cell], gradients[cell], result[cell]
        for i in range(8):
            for j in range(8):
                product = g[i, 0] * g[j, 0] + g[i, 1] * g[j, 1] + g[i, 2] * g[j, 2]
                for a in range(3):
                    for b in range(3):
                        mixed = g[i, b] * g[j, a] - 2.0 / 3.0 * g[i, a] * g[j, b]
                        matrix[3 * i + a, 3 * j + b] = volumes[cell] * mixed
                    matrix[3 * i + a, 3 * j + a] += volumes[cell] * product
                excess[i, j] = -(x[i, 0] * g[j, 0] + x[i, 1] * g[j, 1] + x[i, 2] * g[j, 2])
            excess[i, i] += 1.0
        for spring in range(len(pairs)):
            first, second = pairs[spring, 0], pairs[spring, 1]
            line = x[second] - x[first]
            stiffness = springs[spring] / (line[0] ** 2 + line[1] ** 2 + line[2] ** 2)
            for i in range(8):
                for a in range(3):
                    elongation[spring, 3 * i + a] = (excess[second, i] - excess[first, i]) * line[a]
                    force[spring, 3 * i + a] = stiffness * elongation[spring, 3 * i + a]
        matrix += np.dot(elongation.T, force)
    return result


@compiled
def hourglass_shapes(
    corners: Array, gradients: Array, springs: Array, pairs: Index, modes: Array
) -> tuple[Array, NDArray[Any]]:
    """Return gamma (c, 4, 8) and S (c, 12, 12) of cells, with Pᵀ K_spr P = gammaᵀ S gamma.

    With the four hourglass modes H (4, 8) of a cube, gamma = (H - (H x) gᵀ)/8 (Flanagan &
    Belytschko 1981). Along each axis, b = gamma u is zero for every linear field u. So the
    remainder P u, except for a translation, is P Hᵀ (gamma Hᵀ)⁻¹ b.
    `deviatoric_matrices` has the other arguments.

    Args:
        modes: H.
    """
    gamma, stiffness = np.empty((len(corners), 4, 8)), np.empty((len(corners), 12, 12), np.float32)
    elongation = np.empty((len(pairs), 12))
    for cell in range(len(corners)):
        x, g = corners[cell], gradients[cell]
        gamma[cell] = (modes - np.dot(np.dot(modes, x), g.T)) / 8
        remainder = modes.T - np.dot(x, np.dot(g.T, modes.T))
        remainder = np.dot(remainder, np.linalg.inv(np.dot(gamma[cell], modes.T)))
        for spring in range(len(pairs)):
            first, second = pairs[spring, 0], pairs[spring, 1]
            line = x[second] - x[first]
            scale = np.sqrt(springs[spring] / (line[0] ** 2 + line[1] ** 2 + line[2] ** 2))
            for mode in range(4):
                stretch = scale * (remainder[second, mode] - remainder[first, mode])
                for axis in range(3):
                    elongation[spring, 4 * axis + mode] = stretch * line[axis]
        stiffness[cell] = np.dot(elongation.T, elongation)
    return gamma, stiffness


@compiled
def _along(a: Array, b: Array) -> float:
    total = 0.0
    for i in range(8):
        total += a[i] * b[i]
    return total


@compiled
def _shear_force(
    g: Array,
    gamma: Array,
    stiffness: NDArray[Any],
    volume: float,
    nodes: Index,
    displacement: Array,
    u: Array,
    b: Array,
    force: Array,
) -> tuple[float, float]:
    """Write K_d u of a cell into `force`; return uᵀ K_d u, m³, and the mean dilatation g · u.

    With G = sum u_i g_iᵀ, D = 2 V dev(sym G) and q = S gamma u, the nodal forces are D g_i +
    gamma_iᵀ q. The eight values of an axis are adjacent in memory, so that they fill the
    processor's vector registers. G and D are in nine and six registers.

    Args:
        g: mean gradients, 1/m, (3, 8).
        gamma: see `hourglass_shapes`, (4, 8).
        stiffness: S, m, (12, 12).
        volume: m³.
        nodes: the cell's nodes, (8,).
        displacement: m, (n, 3).
        u: scratch (3, 8) for displacements relative to the first node, m.
        b: scratch (2, 12) for gamma u, m, and q, m².
        force: K_d u, m², (3, 8).
    """
    first = nodes[0]
    for i in range(8):
        node = nodes[i]
        u[0, i] = displacement[node, 0] - displacement[first, 0]
        u[1, i] = displacement[node, 1] - displacement[first, 1]
        u[2, i] = displacement[node, 2] - displacement[first, 2]
    xx, xy, xz = _along(u[0], g[0]), _along(u[0], g[1]), _along(u[0], g[2])
    yx, yy, yz = _along(u[1], g[0]), _along(u[1], g[1]), _along(u[1], g[2])
    zx, zy, zz = _along(u[2], g[0]), _along(u[2], g[1]), _along(u[2], g[2])
    q = b[1]
    q[:] = 0.0
    for axis in range(3):
        for mode in range(4):
            b[0, 4 * axis + mode] = _along(u[axis], gamma[mode])
    for i in range(12):
        for j in range(12):
            q[j] += stiffness[i, j] * b[0, i]
    energy = 0.0
    for j in range(12):
        energy += q[j] * b[0, j]
    dilatation = xx + yy + zz
    mean = 2.0 / 3.0 * dilatation
    xx, yy, zz = volume * (2 * xx - mean), volume * (2 * yy - mean), volume * (2 * zz - mean)
    xy, xz, yz = volume * (xy + yx), volume * (xz + zx), volume * (yz + zy)
    energy += ((xx * xx + yy * yy + zz * zz) / 2 + xy * xy + xz * xz + yz * yz) / volume
    for i in range(8):
        force[0, i] = xx * g[0, i] + xy * g[1, i] + xz * g[2, i]
        force[1, i] = xy * g[0, i] + yy * g[1, i] + yz * g[2, i]
        force[2, i] = xz * g[0, i] + yz * g[1, i] + zz * g[2, i]
        for mode in range(4):
            force[0, i] += q[mode] * gamma[mode, i]
            force[1, i] += q[4 + mode] * gamma[mode, i]
            force[2, i] += q[8 + mode] * gamma[mode, i]
    return max(energy, 0.0), dilatation


@compiled
def shear_forces(
    gradients: Array,
    gammas: Array,
    stiffness: NDArray[Any],
    volumes: Array,
    nodes: Index,
    chosen: Index,
    displacement: Array,
) -> tuple[Array, Array]:
    """Return K_d u (k, 24) and the equivalent strain (k,), e² = uᵀ K_d u / (3 V), of cells.

    Args:
        gradients: mean gradients, 1/m, (c, 3, 8).
        gammas: see `hourglass_shapes`, (c, 4, 8).
        stiffness: S, m, (c, 12, 12).
        volumes: m³, (c,).
        nodes: the cells' nodes, (c, 8).
        chosen: numbers of the cells, (k,).
        displacement: m, (n, 3).
    """
    forces, strains = np.empty((len(chosen), 24)), np.empty(len(chosen))
    u, b, force = np.empty((3, 8)), np.empty((2, 12)), np.empty((3, 8))
    for k in range(len(chosen)):
        cell = chosen[k]
        g, volume, shapes = gradients[cell], volumes[cell], (gammas[cell], stiffness[cell])
        energy, _ = _shear_force(g, *shapes, volume, nodes[cell], displacement, u, b, force)
        strains[k] = np.sqrt(energy / (3 * volume))
        for i in range(8):
            for a in range(3):
                forces[k, 3 * i + a] = force[a, i]
    return forces, strains


@compiled
def softened_forces(
    gradients: Array,
    gammas: Array,
    stiffness: NDArray[Any],
    volumes: Array,
    shear_modulus: float,
    knots: Array,
    cubic: Array,
    least: float,
    nodes: Index,
    chosen: Index,
    displacement: Array,
    forces: Array,
) -> None:
    """Write (mu - mu_s) K_d u of the chosen cells, N, into `forces` (k, 24).

    `shear_forces` has the other arguments.

    Args:
        shear_modulus: mu, Pa.
        knots: equivalent strains between which 3 mu_s e is cubic, (q,).
        cubic: its coefficients, the highest power first, (4, q - 1).
        least: smallest e that is distinguished from zero.
    """
    u, b, force = np.empty((3, 8)), np.empty((2, 12)), np.empty((3, 8))
    for k in range(len(chosen)):
        cell = chosen[k]
        g, volume, shapes = gradients[cell], volumes[cell], (gammas[cell], stiffness[cell])
        energy, _ = _shear_force(g, *shapes, volume, nodes[cell], displacement, u, b, force)
        strain = min(max(np.sqrt(energy / (3 * volume)), least), knots[-1])
        part = min(np.searchsorted(knots, strain, side="right") - 1, len(knots) - 2)
        y = strain - knots[part]
        stress = ((cubic[0, part] * y + cubic[1, part]) * y + cubic[2, part]) * y + cubic[3, part]
        lost_modulus = shear_modulus - stress / (3 * strain)
        for i in range(8):
            for a in range(3):
                forces[k, 3 * i + a] = lost_modulus * force[a, i]


@compiled
def cell_forces(
    gradients: Array,
    gammas: Array,
    stiffness: NDArray[Any],
    volumes: Array,
    shear_modulus: float,
    bulk_modulus: float,
    knots: Array,
    cubic: Array,
    least: float,
    nodes: Index,
    displacement: Array,
    sizes: Array,
    internal: Array,
) -> float:
    """Return uᵀ K_T u, N·m, and compute the forces of all cells in the same pass.

    K_T is the tangent stiffness. A cell contributes V q'(e) e² + K V (g · u)², with q = 3 mu_s e.
    `shear_forces` and `softened_forces` have the other arguments.

    Args:
        bulk_modulus: K, Pa.
        sizes: overwritten by the norm of (mu - mu_s) K_d u of each cell, N, (c,). The linear solid
            carries this force in excess.
        internal: nodal forces, N, (n, 3). mu_s K_d u + K V g (g · u) of the cells is added.
    """
    u, b, force = np.empty((3, 8)), np.empty((2, 12)), np.empty((3, 8))
    tangent_work = 0.0
    for cell in range(len(nodes)):
        g, volume, shapes = gradients[cell], volumes[cell], (gammas[cell], stiffness[cell])
        energy, dilatation = _shear_force(
            g, *shapes, volume, nodes[cell], displacement, u, b, force
        )
        strain = min(max(np.sqrt(energy / (3 * volume)), least), knots[-1])
        part = min(np.searchsorted(knots, strain, side="right") - 1, len(knots) - 2)
        y = strain - knots[part]
        stress = ((cubic[0, part] * y + cubic[1, part]) * y + cubic[2, part]) * y + cubic[3, part]
        secant = stress / (3 * strain)
        slope = (3 * cubic[0, part] * y + 2 * cubic[1, part]) * y + cubic[2, part]
        pressure = bulk_modulus * volume * dilatation
        tangent_work += slope * energy / 3 + pressure * dilatation
        square = (
            _along(force[0], force[0]) + _along(force[1], force[1]) + _along(force[2], force[2])
        )
        sizes[cell] = (shear_modulus - secant) * np.sqrt(square)
        for i in range(8):
            for a in range(3):
                internal[nodes[cell, i], a] += secant * force[a, i] + pressure * g[a, i]
    return tangent_work


def spring_families(edges: Array, body_diagonal: float) -> Array:
    """Return a cell's own part (28,) of its springs' stiffness, m per unit shear modulus.

    Args:
        edges: a, b, c, m, (3,).
        body_diagonal: k_b, m per unit shear modulus.
    """
    square, volume = edges**2, np.prod(edges)
    total = square.sum()
    stiffness = np.empty(len(PAIRS))
    for spring, axes in enumerate(PAIR_AXES.astype(bool)):
        if axes.sum() == 1:
            along, across = square[axes][0], square[~axes]
            lattice_spring = (
                volume / along * (3 - along / across[0] - along / across[1])
                + 4 * body_diagonal * along / total
            )
            stiffness[spring] = lattice_spring / 4
        elif axes.sum() == 2:
            product = square[axes].prod()
            lattice_spring = (
                square[axes].sum() / (2 * product) * (volume - 4 * body_diagonal * product / total)
            )
            stiffness[spring] = lattice_spring / 2
        else:
            stiffness[spring] = body_diagonal
    return stiffness


def spring_matrix(corners: Array, stiffness: Array) -> Array:
    """Return the stiffness (s, 24, 24) of springs (28,) in cells (s, 8, 3): the sum of k n nᵀ."""
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
    """Return the corners (8, 3) of a box cell with edges (3,), m."""
    return CORNERS * edges


def body_diagonal_stiffness(edges: Array) -> float:
    """Return the best stiffness k_b of the body diagonals, m per unit shear modulus.

    It maximises the smallest of the 18 eigenvalues that are not rigid motions, among all k_b
    without a negative spring (if there are any). At the upper bound V L²/(4 max pair product) a
    face diagonal vanishes and hourglass modes appear. With k_b = 0 a cell of edge ratio 1.5 is
    indefinite.
    """
    square = edges**2
    pairs = square * np.roll(square, 1)
    # Beyond this bound a face diagonal would be negative.
    upper = np.prod(edges) * square.sum() / (4 * pairs.max())
    candidates = np.linspace(0, upper, 201)[1:-1]
    at_zero = spring_families(edges, 0.0)
    per_unit = spring_families(edges, 1.0) - at_zero
    # All stiffnesses are linear in k_b, so two evaluations are enough.
    families = at_zero + candidates[:, None] * per_unit
    admissible = families.min(axis=1) >= 0
    if admissible.any():
        candidates = candidates[admissible]
    corners = box_corners(edges)[None]
    matrices = spring_matrix(corners, at_zero)
    matrices = matrices + candidates[:, None, None] * spring_matrix(corners, per_unit)
    # The first six eigenvalues are rigid motions. The seventh is the softest deformation; it is
    # zero if the cell hourglasses.
    return float(candidates[np.linalg.eigvalsh(matrices)[:, 6].argmax()])


class CalibratedNetwork(Solid):
    """Cells with the secant stiffness mu_s K_d + K V g gᵀ (g · u: mean dilatation).

    The cell's equivalent strain e² = uᵀ K_d u / (3 V) gives 3 mu_s = q(e)/e. The forces derive
    from an energy, so the tangent is symmetric. `Solid` has the arguments.
    """

    def __init__(self, nodes: Array, cells: Index, spacing: Array, material: Material) -> None:
        super().__init__(nodes, cells, spacing, material)
        self.springs = spring_families(spacing, body_diagonal_stiffness(spacing))
        self.curve = ShearCurve.of(material)

    def _deviatoric(self, cells: slice) -> Array:
        """Return K_d of a chunk of cells (k, 24, 24), m per unit shear modulus."""
        measures = self.gradients[cells], self.volume[cells]
        return deviatoric_matrices(self.corners(cells), *measures, self.springs, PAIRS)

    @property
    def stiffness(self) -> sparse.csr_matrix:
        """Linear stiffness (3n, 3n), N/m: mu K_d + K V g gᵀ of the cells."""
        mu = self.material.shear_modulus
        slices = chunks(len(self.cells))
        return self.pattern.assemble(mu * self._deviatoric(c) + self.bulk(c) for c in slices)

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
            LEAST_STRAIN,
        )
        forces = np.empty((len(cells), 24))

        def write_forces(half: slice) -> None:
            where = self.cells, cells[half], displacement
            softened_forces(*self._shapes, *curve, *where, forces[half])

        in_halves(write_forces, len(cells))
        return forces

    def forces(self, displacement: Array) -> tuple[Array, Array, float]:
        """Return f(u) (n, 3), N, |h| of each cell (c,), N, and uᵀ K_T u, N·m; see `Solid`."""
        if self.curve.spline is None:
            return super().forces(displacement)
        shear, bulk = self.curve.shear_modulus, self.material.bulk_modulus
        knots, cubic = self.curve.spline.x, self.curve.spline.c
        sizes = np.empty(len(self.cells))

        def forces_and_work(half: slice) -> tuple[Array, float]:
            internal = np.zeros_like(self.nodes)
            gradients, gammas, stiffness, volumes = self._shapes
            work = cell_forces(
                gradients[half], gammas[half], stiffness[half], volumes[half],
                shear, bulk, knots, cubic, LEAST_STRAIN,
                self.cells[half], displacement, sizes[half], internal,
            )  # fmt: skip
            return internal, work

        (first, first_work), (second, second_work) = in_halves(forces_and_work, len(self.cells))
        return first + second, sizes, first_work + second_work

    def tangent(self, displacement: Array) -> sparse.csr_matrix:
        """Return d f / d u (3n, 3n): mu_s K_d + mu_s'/(3 V e) (K_d u)(K_d u)ᵀ + bulk."""
        force, equivalent = self._state(displacement)
        secant, softening = self.curve.modulus(equivalent), self.curve.softening(equivalent)
        scale = softening / (3 * self.volume)

        def matrices() -> Iterator[Array]:
            for chunk in chunks(len(self.cells)):
                result = secant[chunk, None, None] * self._deviatoric(chunk) + self.bulk(chunk)
                outer = force[chunk, :, None] * force[chunk, None, :]
                yield result + scale[chunk, None, None] * outer

        return self.pattern.assemble(matrices())

    @cached_property
    def _shapes(self) -> tuple[Array, Array, NDArray[Any], Array]:
        """Mean gradients (c, 3, 8), gamma (c, 4, 8), S (c, 12, 12) and volumes (c,)."""
        measures = self.corners(), self.gradients, self.springs, PAIRS, HOURGLASS_MODES
        gradients = np.ascontiguousarray(self.gradients.transpose(0, 2, 1))
        return gradients, *hourglass_shapes(*measures), self.volume

    def _state(self, displacement: Array, chosen: Index | None = None) -> tuple[Array, Array]:
        """Return K_d u (k, 24) and the equivalent strain e (k,)."""
        cells = np.arange(len(self.cells)) if chosen is None else chosen
        return shear_forces(*self._shapes, self.cells, cells, displacement)
