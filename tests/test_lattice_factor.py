"""The factorisation and the stored response against scipy's own solver."""

import numpy as np
import pytest
import scipy.sparse.linalg as linalg

from lattice_blocks import block
from tkamb.contact.lattice.network import CalibratedNetwork
from tkamb.contact.lattice.operator import fixed_unknowns, prepare_operator
from tkamb.contact.materials import material

MM = 1e-3


def prepared(bearing, counts=(9, 4, 12), stretch=0.5):
    edges = np.full(3, MM)
    nodes, index, cells, _ = block(counts, edges, stretch)
    solid = CalibratedNetwork(nodes, cells, edges, material("polyethylene"))
    bottom = np.flatnonzero(index[:, 1] == 0)
    held = fixed_unknowns(nodes, bottom, bearing)
    top = np.flatnonzero(index[:, 1] == counts[1])
    return solid, held, prepare_operator(solid.stiffness, index, held, top), top


@pytest.mark.parametrize("bearing", ["fixed", "mobile"])
def test_solve_agrees_with_superlu(bearing):
    solid, held, operator, _ = prepared(bearing)
    force = np.random.default_rng(1).normal(size=solid.nodes.shape)
    free = ~held
    exact = linalg.spsolve(solid.stiffness[free][:, free].tocsc(), force.ravel()[free])
    u = operator.solve(force)
    assert u.ravel()[free] == pytest.approx(exact, rel=1e-8, abs=1e-10 * np.abs(exact).max())
    assert not u.ravel()[held].any()


@pytest.mark.parametrize("bearing", ["fixed", "mobile"])
def test_stored_response_is_the_solve(bearing):
    """Zᵀ Z, Z f and Zᵀ y are the compliance, the forward half and the projection."""
    solid, _, operator, top = prepared(bearing)
    force = np.zeros_like(solid.nodes)
    force[top] = np.random.default_rng(2).normal(size=(len(top), 3))
    u = operator.solve(force)
    scale = np.abs(u).max()
    compliance = operator.half.compliance(np.arange(3 * len(top)))
    assert np.abs(compliance @ force[top].ravel() - u[top].ravel()).max() < 1e-11 * scale
    y = np.zeros_like(operator.start(force))
    operator.half.apply(force[top].ravel(), y)
    assert np.abs(operator.finish(y) - u).max() < 1e-11 * scale
    projected = operator.half.project(operator.start(force))
    assert np.abs(projected - u[top].ravel()).max() < 1e-11 * scale
    some = np.array([3, 10, 11, 40, 7])
    assert operator.half.compliance(some) == pytest.approx(compliance[np.ix_(some, some)])


def test_mobile_bearing_holds_no_more_than_it_must():
    """Sliding bottom: y of all bottom nodes, x and z of two; no rigid mode is left."""
    solid, held, operator, _ = prepared("mobile", (4, 2, 6), 0.0)
    bottom = int((solid.nodes[:, 1] == 0).sum())
    assert held.sum() == bottom + 4
    assert operator.factor.order.size == held.size - held.sum()
