"""Finite elements on the lattice's grid, against beam theory and the lattice."""

import numpy as np
import pytest
import scipy.sparse.linalg as linalg

from lattice_blocks import block
from lattice_bodies import condyles, dished_insert, pair
from tkamb.contact.lattice.bbar import BbarHexahedra
from tkamb.contact.materials import Material, material
from tkamb.contact.registry import contact_model
from tkamb.geometry.frames import knee_pose


@pytest.mark.parametrize("nu", [0.3, 0.49, 0.4999])
def test_beam_in_bending_does_not_lock_with_the_bulk_modulus(nu):
    """The deflection of a slender beam under a tip load is within 10 % of theory."""
    counts, edges = (20, 4, 2), np.array([1.0, 0.5, 0.5]) * 1e-3
    nodes, index, cells, _ = block(counts, edges)
    solid = BbarHexahedra(nodes, cells, edges, Material("m", 1e9, nu))
    free = ~np.repeat(index[:, 0] == 0, 3)
    force = np.zeros_like(nodes)
    tip = index[:, 0] == counts[0]
    force[tip, 1] = 1.0 / tip.sum()
    u = np.zeros(nodes.size)
    u[free] = linalg.spsolve(solid.stiffness[free][:, free].tocsc(), force.ravel()[free])
    length, height, width = np.ptp(nodes, axis=0)
    exact = length**3 / (3 * 1e9 * width * height**3 / 12) + 1.2 * length * 2 * (1 + nu) / (
        1e9 * width * height
    )
    assert u.reshape(-1, 3)[tip, 1].mean() == pytest.approx(exact, rel=0.10)


@pytest.mark.parametrize("law", ["polyethylene", "polyethylene-linear"])
def test_lattice_and_finite_elements_agree_on_two_condyles(law):
    """2 mm cells, 1500 N: approach within 4 %, peak within 6 %, condyle forces within 1 %."""
    bodies = pair(condyles(subdivisions=5), dished_insert(), material(law))
    result = []
    for name in ("lattice", "fe"):
        model = contact_model(name, resolution=2e-3)
        result.append(model.press(model.prepare(bodies), 1500.0, knee_pose(np.zeros(6))))
    lattice, fe = result
    assert lattice.approach == pytest.approx(fe.approach, rel=0.04)
    assert lattice.pressure.max() == pytest.approx(fe.pressure.max(), rel=0.06)
    assert lattice.medial.force == pytest.approx(fe.medial.force, rel=0.01)


@pytest.mark.slow
def test_lattice_and_finite_elements_converge_to_each_other():
    """The difference in approach falls with the cell size."""
    bodies = pair(condyles(subdivisions=6), dished_insert(cells=72), material("polyethylene"))
    differences = []
    for size in (2.5, 1.25):
        approaches = []
        for name in ("lattice", "fe"):
            model = contact_model(name, resolution=size * 1e-3)
            state = model.prepare(bodies)
            approaches.append(model.press(state, 1500.0, knee_pose(np.zeros(6))).approach)
        differences.append(abs(approaches[0] / approaches[1] - 1))
    assert differences[1] < 0.75 * differences[0]
