"""The calibrated cell in compiled loops: its matrix, and the forces of displaced cells."""

import numpy as np

from tkamb.geometry.compiled import compiled
from tkamb.geometry.frames import Array, Index

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
