"""The residual of a lattice solution by code of its own: numpy, cell matrices, rays fired anew.

Nothing of the solver, its factor, its condensed compliance or its compiled loops over displaced
cells is used; only cell matrices K_d, the material's curve, and the femoral mesh.
"""

from contextlib import contextmanager

import numpy as np

from tkamb.contact.lattice import model as lattice_model
from tkamb.contact.lattice.calibrated import CalibratedNetwork
from tkamb.contact.lattice.solid import chunks


def internal_force(solid, field):
    """Return f(u) (n, 3), N: mu_s K_d u + K V g (g · u), 3 mu_s = q(e)/e, e² = uᵀ K_d u/(3 V)."""
    if not isinstance(solid, CalibratedNetwork):
        return solid.internal_force(field)  # by the assembled stiffness
    total = np.zeros_like(field)
    for some in chunks(len(solid.cells)):
        cells, volume = solid.cells[some], solid.volume[some]
        u = field[cells].reshape(len(cells), 24)
        unit = np.einsum("cij,cj->ci", solid._deviatoric(some), u)
        strain = np.sqrt(np.maximum(np.einsum("ci,ci->c", u, unit), 0.0) / (3 * volume))
        gradient = solid.gradients[some].reshape(len(cells), 24)
        pressed = solid.material.bulk_modulus * volume * np.einsum("ci,ci->c", gradient, u)
        force = solid.curve.modulus(strain)[:, None] * unit + pressed[:, None] * gradient
        np.add.at(total, cells.ravel(), force.reshape(-1, 3))
    return total


def recomputed(state, solution, pose):
    """Return force and gap residual of a solution, relative, at its final pose (4, 4)."""
    problem = state.problem
    nodes = problem.contact_nodes[solution.candidates]
    force = solution.forces.force[:, None] * solution.planes.normals
    outside = -internal_force(problem.solid, solution.field)
    outside[nodes] += force
    outside = outside.ravel()[~problem.held]
    moved = solution.field[nodes]
    where = problem.surface_points[solution.candidates] + moved
    points, normals = problem.femoral.over(where, pose)
    gap = np.nan_to_num(np.einsum("ij,ij->i", normals, where - points))
    loaded = solution.forces.active
    missed = np.where(loaded, np.abs(gap), np.maximum(-gap, 0.0))
    size = np.abs(moved[loaded]).max()
    return np.linalg.norm(outside) / np.linalg.norm(force), missed.max() / size


@contextmanager
def kept_solutions():
    """Yield a list of (state, solution, result) of every answer that is made within."""
    kept, made = [], lattice_model.result_of

    def keeping(state, pose, load, gaps, solution, rule, forces_only=False):
        result = made(state, pose, load, gaps, solution, rule, forces_only)
        if not forces_only:
            kept.append((state, solution, result))
        return result

    lattice_model.result_of = keeping
    try:
        yield kept
    finally:
        lattice_model.result_of = made


def difference(state, solution, result):
    """Return the largest difference of reported and recomputed residuals, as forces over the load.

    Force and gap are compared one by one; the larger one is what the result reports.
    """
    own, size = recomputed(state, solution, result.pose), np.linalg.norm(result.nodal_force)
    measured = solution.residual.force, solution.residual.gap
    assert result.residual == max(measured)
    return np.abs(np.subtract(own, measured)).max() * size / -result.wrench_on_insert[1]
