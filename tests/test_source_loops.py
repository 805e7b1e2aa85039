"""Sharma's loops, which solve with the stored factor."""

from functools import partial

import numpy as np
import pytest
import scipy.sparse.linalg as sparse_linalg

from lattice_bodies import above, box_insert, pair, sphere_cap
from tkamb.contact.lattice import source_lattice as loops
from tkamb.contact.lattice.linear import operator
from tkamb.contact.lattice.source_lattice import (
    CandidateResponse,
    ConjugateGradientSettings,
    HeldNodes,
    LoopSettings,
)
from tkamb.contact.materials import material
from tkamb.contact.registry import contact_model
from tkamb.contact.result import ContactStatus

RADIUS, LOAD = 20e-3, 800.0
EXACT = ConjugateGradientSettings(tolerance=1e-10, max_iterations=500)


@pytest.fixture(scope="module")
def bodies():
    return pair(sphere_cap(RADIUS), box_insert(14e-3, 6e-3, 14e-3), material("polyethylene"))


@pytest.fixture(scope="module")
def prepared(bodies):
    """Return the model at 2 mm and its prepared state, with a factor in single precision."""
    model = contact_model(
        "lattice-source", resolution=2e-3, loops="source", tolerance=1e-4, cache=False
    )
    return model, model.prepare(bodies)


@pytest.fixture
def held(prepared):
    """Return the lattice with prescribed displacement of the nodes within 3 mm of the centre."""
    problem = prepared[1].problem
    radius = np.hypot(problem.surface_points[:, 0], problem.surface_points[:, 2])
    candidates = np.flatnonzero(radius < 5e-3)
    active = radius[candidates] < 3e-3
    return HeldNodes(CandidateResponse(problem, candidates), active, EXACT)


def squeezed(nodes):
    """Return a displacement field that strains the upper springs by up to 12 %."""
    height = nodes[:, 1] / nodes[:, 1].max()
    u = np.zeros_like(nodes)
    u[:, 1] = -0.4e-3 * height**2 * np.exp(-(nodes[:, 0] ** 2 + nodes[:, 2] ** 2) / 4e-3**2)
    return u


def test_held_nodes_solve_as_the_assembled_tangent_does(prepared, held):
    solid, generator = prepared[1].problem.solid, np.random.default_rng(0)
    u = squeezed(solid.nodes)
    tangent = solid.spring_tangent(u)
    assert tangent.stiffness.min() < 0.6 * tangent.stiffness.max()
    force = generator.normal(size=u.shape)
    displacement = held.solve(tangent, force).ravel()
    free = ~held.held
    matrix = solid.tangent(u)[free][:, free].tocsc()
    exact = sparse_linalg.spsolve(matrix, force.ravel()[free])
    assert displacement[free] == pytest.approx(exact, rel=1e-6, abs=1e-8 * np.abs(exact).max())
    assert not displacement[held.held].any()


def test_a_given_displacement_spreads_as_in_the_undeformed_lattice(prepared, held):
    solid = prepared[1].problem.solid
    prescribed = -1e-4 * np.linspace(1.0, 2.0, len(held.unknowns))
    displacement = held.spread(prescribed).ravel()
    assert (displacement[held.unknowns] == prescribed).all()
    free, stiffness = ~held.held, solid.stiffness
    boundary_field = np.zeros(solid.nodes.size)
    boundary_field[held.unknowns] = prescribed
    matrix = stiffness[free][:, free].tocsc()
    exact = sparse_linalg.spsolve(matrix, -(stiffness @ boundary_field)[free])
    assert displacement[free] == pytest.approx(exact, abs=1e-5 * np.abs(prescribed).max())
    unit = np.zeros(solid.nodes.size)
    unit[held.unknowns] = -1.0
    unit[free] = sparse_linalg.spsolve(matrix, -(stiffness @ unit)[free])
    assert held.slope == pytest.approx(-(stiffness @ unit)[held.unknowns].sum(), rel=1e-4)


def test_forces_are_the_slope_of_the_stored_energy(prepared):
    """The energy is the sum of C L0² times the area under the stress-strain curve."""
    solid = prepared[1].problem.solid
    u, generator = squeezed(solid.nodes), np.random.default_rng(1)
    step = 1e-9 * generator.normal(size=u.shape)

    def energy(displacement):
        strain, _ = solid._state(displacement)
        shares = (np.arange(400) + 0.5) / 400  # midpoint rule
        area = np.mean([solid.material.stress(x * strain) * strain for x in shares], axis=0)
        return float(np.sum(solid.factor * solid.lengths**2 * area))

    change = energy(u + step) - energy(u - step)
    assert float((solid.internal_force(u) * step).sum()) == pytest.approx(change / 2, rel=1e-3)
    tiny = 1e-12 * generator.normal(size=u.shape)
    linear = (solid.stiffness @ tiny.ravel()).reshape(tiny.shape)
    size = np.abs(linear).max()
    assert np.abs(solid.internal_force(tiny) - linear).max() < 1e-4 * size
    assert np.abs(solid.linear_force(tiny) - linear).max() < 1e-12 * size


def test_a_press_factorises_nothing(prepared, monkeypatch):
    def forbidden(*_args, **_options):
        raise AssertionError("the stiffness was factorised again")

    model, state = prepared
    for module in (operator, loops):
        monkeypatch.setattr(module, "prepare_operator", forbidden, raising=False)
    result = model.press(state, LOAD, above())
    assert result.status is ContactStatus.OK
    assert result.iterations < 15


@pytest.mark.parametrize("law", ["linear", "nonlinear"])
def test_where_the_loops_begin_changes_no_answer(bodies, monkeypatch, law):
    model = contact_model("lattice-source", resolution=2e-3, loops="source", law=law, cache=False)
    state, results = model.prepare(bodies), []
    for first in (0.4, 0.8, 1.0):
        solve = partial(loops.solve_by_loops, settings=LoopSettings(first_depth=first))
        with monkeypatch.context() as patch:
            patch.setattr(loops, "solve_by_loops", solve)
            results.append(model.press(state, LOAD, above()))
    for result in results[1:]:
        assert result.approach == pytest.approx(results[0].approach, rel=2e-4)
        assert result.pressure == pytest.approx(results[0].pressure, rel=1e-3, abs=1e4)
