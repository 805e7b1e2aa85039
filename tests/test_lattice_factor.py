"""The factorisation and the stored response, compared with scipy's direct solver."""

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
    """Return solid, held unknowns, operator and top nodes of a block."""
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
def test_sixteen_bits_are_enough_for_every_poisson_ratio(bearing, nu):
    """Displacements and strains under two neighbouring forces agree with double precision."""
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
def test_stored_response_agrees_with_the_factor(bearing):
    """This holds for the compliance Zᵀ Z, the forward solve Z f and the projection Zᵀ y."""
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
def test_response_of_a_subset_is_part_of_the_whole(bearing):
    _, _, operator, top = prepared(bearing)
    whole = operator.half.compliance()
    subset = unknowns_of(np.array([3, 10, 11, 40, 7]))
    part = operator.half.among(subset)
    assert part.compliance() == pytest.approx(whole[np.ix_(subset, subset)])
    rows = np.array([4, 0, 9])
    assert part.compliance(rows) == pytest.approx(whole[np.ix_(subset[rows], subset)])
    force = np.random.default_rng(3).normal(size=len(subset))
    full, y = np.zeros(3 * len(top)), np.zeros(len(operator.factor.order))
    full[subset] = force
    z = y.copy()
    operator.half.apply(full, y)
    part.apply(force, z)
    assert z == pytest.approx(y, rel=1e-12, abs=1e-12 * np.abs(y).max())
    assert part.project(y) == pytest.approx(operator.half.project(y)[subset])


def test_few_nodes_need_few_fronts():
    """Their own fronts and those above give forward solves and displacements."""
    solid, held, operator, top = prepared("fixed")
    nodes = top[:4]
    fronts = operator.fronts_of(nodes)
    assert len(fronts.fronts) < len(operator.factor.parents)
    force = np.zeros_like(solid.nodes)
    force[nodes] = np.random.default_rng(4).normal(size=(4, 3))
    y = operator.start(force, fronts)
    assert y == pytest.approx(operator.start(force), rel=1e-12, abs=1e-12 * np.abs(y).max())
    u = operator.solve(force)
    operator.factor.backward(y, fronts)
    assert operator.nodal(y)[nodes] == pytest.approx(u[nodes])
    others = np.setdiff1d(np.arange(len(operator.factor.parents)), fronts.fronts)
    operator.factor.backward(y, operator.factor.shared(others))
    assert operator.nodal(y) == pytest.approx(u)
    assert not operator.fronts_of(np.flatnonzero(held.reshape(-1, 3).all(axis=1))).fronts.size


def test_displacements_in_single_precision_are_accurate_to_five_parts_in_a_million():
    edges = np.full(3, MM)
    nodes, index, cells, _ = block((20, 8, 20), edges, 0.5)
    nearly_incompressible = replace(material("polyethylene"), poisson_ratio=0.4999)
    for kind in (material("polyethylene"), nearly_incompressible):
        solid = CalibratedNetwork(nodes, cells, edges, kind)
        held = fixed_unknowns(nodes, np.flatnonzero(index[:, 1] == 0), "fixed")
        top = np.flatnonzero(index[:, 1] == 8)
        exact, single = (
            prepare_operator(solid.stiffness, index, held, top, precision)
            for precision in (np.float64, np.float32)
        )
        force = np.zeros_like(nodes)
        force[top[150:200], 1] = -1.0
        u = exact.solve(force)
        assert np.abs(single.solve(force) - u).max() < 5e-6 * np.abs(u).max()
        compliance = exact.half.compliance()
        assert np.abs(single.half.compliance() - compliance).max() < 1e-6 * compliance.max()


def test_mobile_bearing_holds_y_of_the_bottom_and_three_unknowns():
    """These three are the fewest that prevent rigid motion."""
    solid, held, operator, _ = prepared("mobile", (4, 2, 6), 0.0)
    bottom = int((solid.nodes[:, 1] == 0).sum())
    assert held.sum() == bottom + 3
    assert operator.factor.order.size == held.size - held.sum()
