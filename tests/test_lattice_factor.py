"""The factorisation and the stored response against scipy's own solver."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse.linalg as linalg

from lattice_blocks import block
from tkamb.contact.lattice.calibrated import CalibratedNetwork
from tkamb.contact.lattice.linear.compliance import unknowns_of
from tkamb.contact.lattice.linear.operator import fixed_unknowns, prepare_operator
from tkamb.contact.materials import material

MM = 1e-3


def prepared(bearing, counts=(9, 4, 12), stretch=0.5, nu=0.46, coarse=False):
    edges = np.full(3, MM)
    nodes, index, cells, _ = block(counts, edges, stretch)
    solid = CalibratedNetwork(nodes, cells, edges, material("polyethylene", poisson_ratio=nu))
    bottom = np.flatnonzero(index[:, 1] == 0)
    held = fixed_unknowns(nodes, bottom, bearing)
    top = np.flatnonzero(index[:, 1] == counts[1])
    operator = prepare_operator(solid.stiffness, index, held, top, coarse=coarse)
    return solid, held, operator, top


@pytest.mark.parametrize("bearing", ["fixed", "mobile"])
def test_solve_agrees_with_superlu(bearing):
    solid, held, operator, _ = prepared(bearing)
    force = np.random.default_rng(1).normal(size=solid.nodes.shape)
    free = ~held
    exact = linalg.spsolve(solid.stiffness[free][:, free].tocsc(), force.ravel()[free])
    u = operator.solve(force)
    assert u.ravel()[free] == pytest.approx(exact, rel=1e-8, abs=1e-10 * np.abs(exact).max())
    assert not u.ravel()[held].any()


@pytest.mark.parametrize("nu", [0.3, 0.46, 0.4999])
@pytest.mark.parametrize("bearing", ["fixed", "mobile"])
def test_sixteen_bits_are_enough_whatever_the_condition(bearing, nu):
    """Displacements and strains under a neighbouring pair of forces, against double precision."""
    solid, _, operator, top = prepared(bearing, nu=nu)
    coarse = prepared(bearing, nu=nu, coarse=True)[2]
    assert coarse.factor.values.dtype == np.int16
    force = np.zeros_like(solid.nodes)
    force[top[[60, 61]], 1] = -1.0, 0.7
    exact = operator.solve(force)
    error = coarse.solve(force) - exact
    assert 0 < np.abs(error).max() < 2e-4 * np.abs(exact).max()
    strain = np.abs(solid.strain(exact)).max()
    assert 0 < np.abs(solid.strain(error)).max() < 1e-4 * strain


@pytest.mark.parametrize("bearing", ["fixed", "mobile"])
def test_stored_response_is_the_solve(bearing):
    """Zᵀ Z, Z f and Zᵀ y are the compliance, the forward half and the projection."""
    solid, _, operator, top = prepared(bearing)
    force = np.zeros_like(solid.nodes)
    force[top] = np.random.default_rng(2).normal(size=(len(top), 3))
    u = operator.solve(force)
    scale = np.abs(u).max()
    compliance = operator.half.compliance()
    assert np.abs(compliance @ force[top].ravel() - u[top].ravel()).max() < 1e-11 * scale
    y = np.zeros_like(operator.start(force))
    operator.half.apply(force[top].ravel(), y)
    operator.factor.backward(y)
    assert np.abs(operator.nodal(y) - u).max() < 1e-11 * scale
    projected = operator.half.project(operator.start(force))
    assert np.abs(projected - u[top].ravel()).max() < 1e-11 * scale


@pytest.mark.parametrize("bearing", ["fixed", "mobile"])
def test_response_of_some_nodes_is_part_of_the_whole(bearing):
    _, _, operator, top = prepared(bearing)
    whole = operator.half.compliance()
    some = unknowns_of(np.array([3, 10, 11, 40, 7]))
    part = operator.half.among(some)
    assert part.compliance() == pytest.approx(whole[np.ix_(some, some)])
    rows = np.array([4, 0, 9])
    assert part.compliance(rows) == pytest.approx(whole[np.ix_(some[rows], some)])
    force = np.random.default_rng(3).normal(size=len(some))
    full, y = np.zeros(3 * len(top)), np.zeros(len(operator.factor.order))
    full[some] = force
    z = y.copy()
    operator.half.apply(full, y)
    part.apply(force, z)
    assert z == pytest.approx(y, rel=1e-12, abs=1e-12 * np.abs(y).max())
    assert part.project(y) == pytest.approx(operator.half.project(y)[some])


def test_few_nodes_need_few_fronts():
    """Forces on, and displacements of, some nodes: the fronts above them are enough."""
    solid, held, operator, top = prepared("fixed")
    some = top[:4]
    fronts = operator.fronts_of(some)
    assert len(fronts.fronts) < len(operator.factor.parents)
    force = np.zeros_like(solid.nodes)
    force[some] = np.random.default_rng(4).normal(size=(4, 3))
    y = operator.start(force, fronts)
    assert y == pytest.approx(operator.start(force), rel=1e-12, abs=1e-12 * np.abs(y).max())
    u = operator.solve(force)
    operator.factor.backward(y, fronts)
    assert operator.nodal(y)[some] == pytest.approx(u[some])
    rest = np.setdiff1d(np.arange(len(operator.factor.parents)), fronts.fronts)
    operator.factor.backward(y, operator.factor.shared(rest))
    assert operator.nodal(y) == pytest.approx(u)
    assert not operator.fronts_of(np.flatnonzero(held.reshape(-1, 3).all(axis=1))).fronts.size


def test_single_precision_keeps_displacements_to_a_few_parts_in_a_million():
    edges = np.full(3, MM)
    nodes, index, cells, _ = block((20, 8, 20), edges, 0.5)
    nearly = replace(material("polyethylene"), poisson_ratio=0.4999)
    for kind in (material("polyethylene"), nearly):
        solid = CalibratedNetwork(nodes, cells, edges, kind)
        held = fixed_unknowns(nodes, np.flatnonzero(index[:, 1] == 0), "fixed")
        top = np.flatnonzero(index[:, 1] == 8)
        exact, kept = (
            prepare_operator(solid.stiffness, index, held, top, precision)
            for precision in (np.float64, np.float32)
        )
        force = np.zeros_like(nodes)
        force[top[150:200], 1] = -1.0
        u = exact.solve(force)
        assert np.abs(kept.solve(force) - u).max() < 5e-6 * np.abs(u).max()
        compliance = exact.half.compliance()
        assert np.abs(kept.half.compliance() - compliance).max() < 1e-6 * compliance.max()


def test_mobile_bearing_holds_no_more_than_it_must():
    """Sliding bottom: y of all bottom nodes, and three unknowns; no rigid mode is left."""
    solid, held, operator, _ = prepared("mobile", (4, 2, 6), 0.0)
    bottom = int((solid.nodes[:, 1] == 0).sum())
    assert held.sum() == bottom + 3
    assert operator.factor.order.size == held.size - held.sum()
