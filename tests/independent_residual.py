"""The residual of a lattice solution, computed independently of the solver.

It uses only the cell matrices K_d, the material's curve, and new rays to the femoral mesh.
"""

from contextlib import contextmanager

import numpy as np

from tkamb.contact.lattice import model as lattice_model
from tkamb.contact.lattice.calibrated import CalibratedNetwork
from tkamb.contact.lattice.solid import chunks


def internal_force(solid, field):
    """Return f(u) (n, 3), N: mu_s K_d u + K V g (g · u), 3 mu_s = q(e)/e, e² = uᵀ K_d u/(3 V)."""
    if not isinstance(solid, CalibratedNetwork):
        return solid.internal_force(field)  # from the assembled stiffness
    total = np.zeros_like(field)
    for chunk in chunks(len(solid.cells)):
        cells, volume = solid.cells[chunk], solid.volume[chunk]
        u = field[cells].reshape(len(cells), 24)
        unit = np.einsum("cij,cj->ci", solid._deviatoric(chunk), u)
        strain = np.sqrt(np.maximum(np.einsum("ci,ci->c", u, unit), 0.0) / (3 * volume))
        gradient = solid.gradients[chunk].reshape(len(cells), 24)
        pressure = solid.material.bulk_modulus * volume * np.einsum("ci,ci->c", gradient, u)
        force = solid.curve.modulus(strain)[:, None] * unit + pressure[:, None] * gradient
        np.add.at(total, cells.ravel(), force.reshape(-1, 3))
    return total


def recomputed(state, solution, pose):
    """Return the relative force and gap residuals of a solution at its final pose (4, 4)."""
    problem = state.problem
    nodes = problem.contact_nodes[solution.candidates]
    force = solution.forces.force[:, None] * solution.planes.normals
    residual = -internal_force(problem.solid, solution.field)
    residual[nodes] += force
    residual = residual.ravel()[~problem.held]
    displacement = solution.field[nodes]
    positions = problem.surface_points[solution.candidates] + displacement
    points, normals = problem.femoral.over(positions, pose)
    gap = np.nan_to_num(np.einsum("ij,ij->i", normals, positions - points))
    active = solution.forces.active
    gap_error = np.where(active, np.abs(gap), np.maximum(-gap, 0.0))
    size = np.abs(displacement[active]).max()
    return np.linalg.norm(residual) / np.linalg.norm(force), gap_error.max() / size


@contextmanager
def recorded_solutions():
    """Yield a list that gets (state, solution, result) of every solution inside the context."""
    records, result_of = [], lattice_model.result_of

    def recording(state, pose, load, gaps, solution, rule, forces_only=False):
        result = result_of(state, pose, load, gaps, solution, rule, forces_only)
        if not forces_only:
            records.append((state, solution, result))
        return result

    lattice_model.result_of = recording
    try:
        yield records
    finally:
        lattice_model.result_of = result_of


def difference(state, solution, result):
    """Return the larger of the errors of the reported force and gap residuals.

    Both are relative to the norm of the nodal forces, and are converted to be relative to the load.
    """
    expected, size = recomputed(state, solution, result.pose), np.linalg.norm(result.nodal_force)
    measured = solution.residual.force, solution.residual.gap
    assert result.residual == max(measured)
    return np.abs(np.subtract(expected, measured)).max() * size / -result.wrench_on_insert[1]
