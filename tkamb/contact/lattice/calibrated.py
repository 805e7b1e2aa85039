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
(`deviatoric_matrices`).
"""

from collections.abc import Iterator
from functools import cached_property

import numpy as np
import scipy.sparse as sparse

from tkamb.contact.lattice.meshing.cells import CORNERS, PAIR_AXES, PAIRS
from tkamb.contact.lattice.solid import STRESS_CURVE, ShearCurve, Solid, chunks
from tkamb.contact.materials import Material
from tkamb.geometry.compiled import compiled
from tkamb.geometry.frames import Array, Index
from tkamb.geometry.threads import in_halves

NOTHING = 1e-300
"""m²: smallest divisor, which avoids a division by zero."""


@compiled
def deviatoric_matrices(
    corners: Array, gradients: Array, volumes: Array, springs: Array, pairs: Index
) -> Array:
    """Return K_d = V B̄ᵀ (2 I_dev) B̄ + Pᵀ K_spr P of cells (c, 24, 24), m per unit shear modulus.

    Between nodes i and j the first part is V (g_i·g_j I + g_j g_iᵀ - 2/3 g_i g_jᵀ). A spring
    k along n between corners a and b adds k r_i r_j n nᵀ, r = P_b - P_a with the displacement's
    rest P = I - x gᵀ (8, 8).

    Args:
        corners: (c, 8, 3) m, true shapes.
        gradients: (c, 8, 3) mean gradients g, 1/m.
        volumes: (c,) m³.
        springs: (28,) m, `spring_families` of the nominal box.
        pairs: (28, 2) corners that they join.
    """
    result = np.zeros((len(corners), 24, 24))
    rest = np.empty((8, 8))
    pulled, force = np.empty((len(pairs), 24)), np.empty((len(pairs), 24))
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
                rest[i, j] = -(x[i, 0] * g[j, 0] + x[i, 1] * g[j, 1] + x[i, 2] * g[j, 2])
            rest[i, i] += 1.0
        for spring in range(len(pairs)):
            first, second = pairs[spring, 0], pairs[spring, 1]
            line = x[second] - x[first]
            stiffness = springs[spring] / (line[0] ** 2 + line[1] ** 2 + line[2] ** 2)
            for i in range(8):
                for a in range(3):
                    pulled[spring, 3 * i + a] = (rest[second, i] - rest[first, i]) * line[a]
                    force[spring, 3 * i + a] = stiffness * pulled[spring, 3 * i + a]
        matrix += np.dot(pulled.T, force)
    return result


@compiled
def _parted(
    x: Array, g: Array, nodes: Index, displacement: Array, u: Array, rest: Array
) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Split a cell's displacement into G x, G = sum u_i g_iᵀ, and a rest; return G, row by row.

    The eight corners of an axis lie side by side, so that they fill the processor's vector
    registers. G is held in nine registers. The arguments are those of `_shear_force`.
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
    for i in range(8):
        rest[0, i] = u[0, i] - (xx * x[0, i] + xy * x[1, i] + xz * x[2, i])
    for i in range(8):
        rest[1, i] = u[1, i] - (yx * x[0, i] + yy * x[1, i] + yz * x[2, i])
    for i in range(8):
        rest[2, i] = u[2, i] - (zx * x[0, i] + zy * x[1, i] + zz * x[2, i])
    return xx, xy, xz, yx, yy, yz, zx, zy, zz


@compiled
def _along(one: Array, other: Array) -> float:
    """Return the scalar product of two vectors of eight numbers."""
    total = 0.0
    for i in range(8):
        total += one[i] * other[i]
    return total


@compiled
def _shear_force(
    x: Array,
    g: Array,
    volume: float,
    springs: Array,
    nodes: Index,
    displacement: Array,
    u: Array,
    rest: Array,
    force: Array,
) -> float:
    """Put K_d u of a cell into force (3, 8); return uᵀ K_d u.

    The matrix K_d is never assembled. G = sum u_i g_iᵀ gives the rests u_i - G x_i, and these the
    springs' forces t_i. With D = 2 V dev(sym G) - sum t_i x_iᵀ the nodes' forces are t_i + D g_i.
    D is held in nine registers, as G is.

    Args:
        x: (3, 8) m, corners.
        g: (3, 8) 1/m, mean gradients.
        volume: m³.
        springs: (8, 8) m, `spring_families` of the nominal box between any two corners.
        nodes: (8,).
        displacement: (n, 3) m.
        u: (3, 8) scratch, as `rest`: displacements from the cell's first node.
        rest: (3, 8).
        force: (3, 8) m².
    """
    xx, xy, xz, yx, yy, yz, zx, zy, zz = _parted(x, g, nodes, displacement, u, rest)
    for i in range(8):
        fx = fy = fz = 0.0
        for j in range(8):
            line_x, line_y, line_z = x[0, j] - x[0, i], x[1, j] - x[1, i], x[2, j] - x[2, i]
            pull = (rest[0, j] - rest[0, i]) * line_x + (rest[1, j] - rest[1, i]) * line_y
            pull += (rest[2, j] - rest[2, i]) * line_z
            square = line_x * line_x + line_y * line_y + line_z * line_z
            pull *= springs[i, j] / max(square, NOTHING)  # of a corner with itself
            fx, fy, fz = fx - pull * line_x, fy - pull * line_y, fz - pull * line_z
        force[0, i], force[1, i], force[2, i] = fx, fy, fz
    mean = 2.0 / 3.0 * (xx + yy + zz)
    xy, xz, yz = volume * (xy + yx), volume * (xz + zx), volume * (yz + zy)
    yx, zx, zy = xy, xz, yz
    xx, yy, zz = volume * (2 * xx - mean), volume * (2 * yy - mean), volume * (2 * zz - mean)
    fx, fy, fz = force[0], force[1], force[2]
    xx, xy, xz = xx - _along(fx, x[0]), xy - _along(fx, x[1]), xz - _along(fx, x[2])
    yx, yy, yz = yx - _along(fy, x[0]), yy - _along(fy, x[1]), yz - _along(fy, x[2])
    zx, zy, zz = zx - _along(fz, x[0]), zy - _along(fz, x[1]), zz - _along(fz, x[2])
    for i in range(8):
        force[0, i] += xx * g[0, i] + xy * g[1, i] + xz * g[2, i]
        force[1, i] += yx * g[0, i] + yy * g[1, i] + yz * g[2, i]
        force[2, i] += zx * g[0, i] + zy * g[1, i] + zz * g[2, i]
    energy = _along(force[0], u[0]) + _along(force[1], u[1]) + _along(force[2], u[2])
    return max(energy, 0.0)


@compiled
def shear_forces(
    corners: Array,
    gradients: Array,
    volumes: Array,
    springs: Array,
    nodes: Index,
    chosen: Index,
    displacement: Array,
) -> tuple[Array, Array]:
    """Return K_d u (k, 24) and the equivalent strain (k,), e² = uᵀ K_d u / (3 V), of cells.

    Args:
        corners: (c, 3, 8) m.
        gradients: (c, 3, 8) mean gradients, 1/m.
        volumes: (c,) m³.
        springs: (8, 8) m.
        nodes: (c, 8) of the cells.
        chosen: (k,) cells.
        displacement: (n, 3) m.
    """
    forces, strains = np.empty((len(chosen), 24)), np.empty(len(chosen))
    u, rest, force = np.empty((3, 8)), np.empty((3, 8)), np.empty((3, 8))
    for k in range(len(chosen)):
        cell = chosen[k]
        x, g, volume = corners[cell], gradients[cell], volumes[cell]
        energy = _shear_force(x, g, volume, springs, nodes[cell], displacement, u, rest, force)
        strains[k] = np.sqrt(energy / (3 * volume))
        for i in range(8):
            for a in range(3):
                forces[k, 3 * i + a] = force[a, i]
    return forces, strains


@compiled
def softened_forces(
    corners: Array,
    gradients: Array,
    volumes: Array,
    springs: Array,
    shear_modulus: float,
    knots: Array,
    cubic: Array,
    least: float,
    nodes: Index,
    chosen: Index,
    displacement: Array,
    forces: Array,
) -> None:
    """Put (mu - mu_s) K_d u (k, 24), N, of cells into `forces`; see `shear_forces`.

    Args:
        corners: (c, 3, 8) m.
        gradients: (c, 3, 8) 1/m.
        volumes: (c,) m³.
        springs: (8, 8) m.
        shear_modulus: mu, Pa.
        knots: (q,) e between which 3 mu_s e is cubic.
        cubic: (4, q - 1) its coefficients, the highest power first.
        least: smallest e that is distinguished from zero.
        nodes: (c, 8) of the cells.
        chosen: (k,) cells.
        displacement: (n, 3) m.
        forces: (k, 24).
    """
    u, rest, force = np.empty((3, 8)), np.empty((3, 8)), np.empty((3, 8))
    for k in range(len(chosen)):
        cell = chosen[k]
        x, g, volume = corners[cell], gradients[cell], volumes[cell]
        energy = _shear_force(x, g, volume, springs, nodes[cell], displacement, u, rest, force)
        strain = min(max(np.sqrt(energy / (3 * volume)), least), knots[-1])
        part = min(np.searchsorted(knots, strain, side="right") - 1, len(knots) - 2)
        y = strain - knots[part]
        stress = ((cubic[0, part] * y + cubic[1, part]) * y + cubic[2, part]) * y + cubic[3, part]
        softened = shear_modulus - stress / (3 * strain)
        for i in range(8):
            for a in range(3):
                forces[k, 3 * i + a] = softened * force[a, i]


@compiled
def cell_forces(
    corners: Array,
    gradients: Array,
    volumes: Array,
    springs: Array,
    shear_modulus: float,
    bulk_modulus: float,
    knots: Array,
    cubic: Array,
    least: float,
    nodes: Index,
    displacement: Array,
    residuals: Array,
    internal: Array,
) -> float:
    """Add mu_s K_d u + K V g (g · u), N, of cells to the nodes' `internal` (n, 3).

    Return uᵀ K_T u, N·m, K_T the tangent stiffness: V q'(e) e² + K V (g · u)² of each cell,
    q = 3 mu_s e. Also write (mu - mu_s) K_d u of each cell, N, into `residuals` (c, 24). One pass
    over the cells gives the true force of the solid and how much more the linear solid carries.

    Args:
        corners: (c, 3, 8) m.
        gradients: (c, 3, 8) 1/m.
        volumes: (c,) m³.
        springs: (8, 8) m.
        shear_modulus: mu, Pa.
        bulk_modulus: K, Pa.
        knots: (q,) equivalent strains between which 3 mu_s e is cubic.
        cubic: (4, q - 1) its coefficients, the highest power first.
        least: smallest equivalent strain that is distinguished from zero.
        nodes: (c, 8) of the cells.
        displacement: (n, 3) m.
        residuals: (c, 24), written.
        internal: (n, 3), added to.
    """
    u, rest, force = np.empty((3, 8)), np.empty((3, 8)), np.empty((3, 8))
    tangent_work = 0.0
    for cell in range(len(nodes)):
        x, g, volume = corners[cell], gradients[cell], volumes[cell]
        energy = _shear_force(x, g, volume, springs, nodes[cell], displacement, u, rest, force)
        strain = min(max(np.sqrt(energy / (3 * volume)), least), knots[-1])
        part = min(np.searchsorted(knots, strain, side="right") - 1, len(knots) - 2)
        y = strain - knots[part]
        stress = ((cubic[0, part] * y + cubic[1, part]) * y + cubic[2, part]) * y + cubic[3, part]
        secant = stress / (3 * strain)
        slope = (3 * cubic[0, part] * y + 2 * cubic[1, part]) * y + cubic[2, part]
        dilatation = _along(u[0], g[0]) + _along(u[1], g[1]) + _along(u[2], g[2])
        pressure = bulk_modulus * volume * dilatation
        tangent_work += slope * energy / 3 + pressure * dilatation
        for i in range(8):
            for a in range(3):
                residuals[cell, 3 * i + a] = (shear_modulus - secant) * force[a, i]
                internal[nodes[cell, i], a] += secant * force[a, i] + pressure * g[a, i]
    return tangent_work


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
