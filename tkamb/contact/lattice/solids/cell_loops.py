"""The calibrated cell in compiled loops: its matrix, and the forces of displaced cells."""

import numpy as np
from numpy.typing import NDArray

from tkamb.contact.lattice.compiled import compiled
from tkamb.contact.lattice.meshing.cells import PAIRS
from tkamb.contact.lattice.solids.curve import LEAST_STRAIN
from tkamb.geometry.frames import Array, Index


@compiled
def deviatoric_matrices(corners: Array, gradients: Array, volumes: Array, springs: Array) -> Array:
    """Return K_d = V B̄ᵀ (2 I_dev) B̄ + Pᵀ K_spr P of cells (c, 24, 24), m per unit shear modulus.

    Between nodes i and j the first part is V (g_i·g_j I + g_j g_iᵀ - 2/3 g_i g_jᵀ). A spring
    k along n between corners a and b adds k r_i r_j n nᵀ, r = P_b - P_a with the displacement's
    rest P = I - x gᵀ (8, 8).

    Args:
        corners: (c, 8, 3) m, true shapes.
        gradients: (c, 8, 3) mean gradients g, 1/m.
        volumes: (c,) m³.
        springs: (28,) m, `spring_families` of the nominal box.
    """
    result = np.zeros((len(corners), 24, 24))
    rest = np.empty((8, 8))
    pulled, force = np.empty((len(PAIRS), 24)), np.empty((len(PAIRS), 24))
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
        for spring in range(len(PAIRS)):
            first, second = PAIRS[spring, 0], PAIRS[spring, 1]
            line = x[second] - x[first]
            stiffness = springs[spring] / (line[0] ** 2 + line[1] ** 2 + line[2] ** 2)
            for i in range(8):
                for a in range(3):
                    pulled[spring, 3 * i + a] = (rest[second, i] - rest[first, i]) * line[a]
                    force[spring, 3 * i + a] = stiffness * pulled[spring, 3 * i + a]
        matrix += np.dot(pulled.T, force)
    return result


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
def shear_forces(
    diagonals: NDArray[np.float32],
    volumes: Array,
    nodes: Index,
    chosen: Index,
    displacement: Array,
) -> tuple[Array, Array]:
    """Return K_d u (k, 24) and the equivalent strain (k,), e² = uᵀ K_d u / (3 V), of cells.

    Args:
        diagonals: (c, 13, 24) K_d, m, see `CalibratedNetwork`.
        volumes: (c,) m³.
        nodes: (c, 8) of the cells.
        chosen: (k,) cells.
        displacement: (n, 3) m.
    """
    forces, strains = np.empty((len(chosen), 24)), np.empty(len(chosen))
    u, force = np.empty(36), np.empty(36)
    for k in range(len(chosen)):
        cell = chosen[k]
        energy = _shear_force(diagonals[cell], nodes[cell], displacement, u, force)
        strains[k] = np.sqrt(energy / (3 * volumes[cell]))
        forces[k] = force[:24]
    return forces, strains


@compiled
def softened_forces(
    diagonals: NDArray[np.float32],
    volumes: Array,
    shear_modulus: float,
    knots: Array,
    cubic: Array,
    nodes: Index,
    chosen: Index,
    displacement: Array,
) -> Array:
    """Return (mu - mu_s) K_d u (k, 24), N, of cells; see `shear_forces`.

    Args:
        diagonals: (c, 13, 24) K_d, m.
        volumes: (c,) m³.
        shear_modulus: mu, Pa.
        knots: (q,) e between which 3 mu_s e is cubic.
        cubic: (4, q - 1) its coefficients, the highest power first.
        nodes: (c, 8) of the cells.
        chosen: (k,) cells.
        displacement: (n, 3) m.
    """
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
