"""Passes on a region of the solid give solutions of the whole solid."""

from dataclasses import replace

import numpy as np
import pytest

from lattice_bodies import condyles, dished_insert, pair
from tkamb.contact.lattice.initial_guess import LatticeStart, initial_guess, lattice_start
from tkamb.contact.lattice.linear import compliance
from tkamb.contact.lattice.linear.compliance import ComplianceCache, by_component, unknowns_of
from tkamb.contact.lattice.nonlinear_balance import Residual, largest_shares
from tkamb.contact.lattice.problem import Region, undeformed
from tkamb.contact.lattice.settings import LatticeSolverSettings
from tkamb.contact.lattice.solver import solve
from tkamb.contact.materials import material
from tkamb.contact.registry import contact_model
from tkamb.contact.result import ContactResult
from tkamb.geometry.frames import knee_pose

POSE = knee_pose([1e-3, 0.0, 0.3e-3, 0.0, np.radians(0.3), 0.0])
LOAD = 2500.0


@pytest.fixture(scope="module", params=["lattice", "fe", "lattice-source"])
def model(request):
    return contact_model(request.param, resolution=2e-3)


@pytest.fixture(scope="module")
def state(model):
    bodies = pair(condyles(subdivisions=4), dished_insert(cells=24), material("polyethylene"))
    return model.prepare(bodies)


@pytest.fixture(scope="module")
def tight(model, state):
    """Return a prepared state with a factor in single precision, for smaller tolerances."""
    fine = replace(model, tolerance=1e-4).prepare(state.pair)
    types = [prepared.problem.operator.factor.values.dtype for prepared in (state, fine)]
    assert types == [np.int16, np.float32]
    return fine


def solved(state, x, tolerance, before=None):
    """Return the solution with the femur shifted by x (m), with or without a warm start."""
    pose = POSE.copy()
    pose[0, 3] += x
    gaps, planes = undeformed(state.problem, pose)
    lowest = gaps.min()
    pose[1, 3] -= lowest
    guess = initial_guess(
        state.compliance, gaps - lowest, planes.raised(-lowest), 0.4e-3, at_pose=False
    )
    if before is not None:
        displacement = np.zeros_like(state.points)
        displacement[before.candidates] = before.displacement
        guess = replace(
            guess,
            loads=before.loads,
            displacement=displacement[guess.candidates],
            region=before.region,
        )
    return solve(state.problem, pose, LOAD, guess, settings(tolerance))


def settings(tolerance):
    """Return solver settings for a relative tolerance of the residual force."""
    default = LatticeSolverSettings()
    return replace(
        default,
        force_tolerance=tolerance,
        work_tolerance=tolerance * default.work_tolerance / default.force_tolerance,
        gap_tolerance=tolerance / 4,
    )


def relative_residual(state, solution):
    """Return the norm of the residual of the whole solid, relative to the contact forces."""
    problem, nodes = state.problem, state.problem.contact_nodes[solution.candidates]
    force = solution.forces.force[:, None] * solution.planes.normals
    residual = -problem.solid.internal_force(solution.field)
    residual[nodes] += force
    return np.linalg.norm(residual.ravel()[~problem.held]) / np.linalg.norm(force)


@pytest.mark.parametrize("tolerance", [2e-3, 1e-4])
def test_cold_and_warm_starts_converge_on_the_whole_solid(state, tight, tolerance):
    state = state if tolerance == 2e-3 else tight
    cold = solved(state, 0.0, tolerance)
    warm = solved(state, 0.4e-3, tolerance, cold)
    again = solved(state, 0.4e-3, tolerance)
    for solution in (cold, warm, again):
        assert solution.converged
        assert relative_residual(state, solution) <= tolerance
    assert warm.passes <= again.passes
    assert warm.forces.approach == pytest.approx(again.forces.approach, rel=tolerance)


def test_the_region_has_the_elements_with_the_largest_shares(state):
    cold = solved(state, 0.0, 2e-3)
    region, whole = cold.region, state.problem.everywhere
    assert whole.whole and not region.whole
    assert len(region.elements) < 0.7 * len(whole.elements)
    assert len(region.fronts.fronts) <= len(whole.fronts.fronts)
    shares = np.linalg.norm(state.problem.solid.nonlinear_residual(cold.field), axis=1)
    others = np.setdiff1d(whole.elements, region.elements)
    assert shares[others].max() <= shares[region.elements].min()


def test_the_norm_of_the_omitted_shares_is_within_the_bound():
    size = np.array([3.0, 0.1, 5.0, 0.2, 0.0])
    assert np.flatnonzero(largest_shares(size, 0.2)).tolist() == [0, 2, 3]
    assert np.flatnonzero(largest_shares(size, 0.23)).tolist() == [0, 2]
    assert np.flatnonzero(largest_shares(size, 0.0)).tolist() == [0, 1, 2, 3]
    assert np.flatnonzero(largest_shares(size, 10.0)).tolist() == []


@pytest.mark.parametrize("model", ["lattice"], indirect=True)
def test_a_region_that_is_too_small_is_enlarged(state):
    cold = solved(state, 0.0, 2e-3)
    sizes = np.linalg.norm(state.problem.solid.nonlinear_residual(cold.field), axis=1)
    small = Region.of(state.problem, np.sort(np.argsort(sizes)[-40:]))
    warm = solved(state, 0.4e-3, 2e-3, replace(cold, region=small))
    assert len(warm.region.elements) > 40 and warm.converged and warm.passes > 1
    assert relative_residual(state, warm) <= 2e-3
    expected = solved(state, 0.4e-3, 2e-3).forces.approach
    assert warm.forces.approach == pytest.approx(expected, rel=5e-4)


def test_the_approach_is_that_of_the_pose(state):
    """A result computes its approach from pair and pose, also after a change of the pose."""
    first_touch = state.pair.pose_at_approach(POSE, 0.0)
    result = ContactResult.of(state, first_touch, *np.zeros((2, len(state.points))))
    assert result.approach == 0.0
    deeper = replace(result, pose=state.pair.pose_at_approach(POSE, 2e-4))
    assert deeper.approach == pytest.approx(2e-4, abs=1e-15)
    assert np.isnan(ContactResult.out_of_range(state, POSE, "why").approach)


def test_stored_compliance_changes_no_result(state):
    """A cache filled at other poses and an empty one give results that differ by rounding only."""
    model = contact_model("lattice", resolution=2e-3)
    for x in (4e-3, -3e-3):
        pose = POSE.copy()
        pose[0, 3] += x
        model.press(state, LOAD, pose)
    empty = replace(state, compliance=ComplianceCache(state.problem.operator.half))
    filled, fresh = model.press(state, LOAD, POSE), model.press(empty, LOAD, POSE)
    assert filled.approach == pytest.approx(fresh.approach, rel=1e-7)
    assert filled.pressure == pytest.approx(fresh.pressure, rel=1e-6, abs=1.0)


def test_the_stored_compliance_stays_within_its_bound(state, monkeypatch):
    """Stored nodes stay when others are added, unless their number would exceed the bound."""
    for bound, stored in ((4, [3, 5, 9, 10]), (3, [9, 10])):
        settings = compliance.ComplianceSettings(max_nodes=bound)
        monkeypatch.setattr(compliance, "COMPLIANCE", settings)
        cache = ComplianceCache(state.problem.operator.half)
        cache.among(np.array([3, 5]))
        cache.among(np.array([9, 10]))
        assert cache.nodes.tolist() == stored


def test_the_stored_compliance_can_grow_in_any_order(state, monkeypatch):
    """The products with and without BLAS agree too."""
    half = state.problem.operator.half
    nodes = np.array([2, 3, 5, 8, 20, 21, 30])
    whole = by_component(half.among(unknowns_of(nodes)).compliance())
    monkeypatch.setattr(compliance, "COMPLIANCE", compliance.ComplianceSettings(spare_nodes=2))
    for few in (0, 100):
        monkeypatch.setattr(compliance, "RESPONSE", compliance.ResponseSettings(few_columns=few))
        cache = ComplianceCache(half)
        for subset in ([20], [5, 8], [2], [8, 21, 30], [3, 5]):
            cache.among(np.array(subset))
        assert sorted(cache.nodes) == nodes.tolist() and cache.nodes.tolist() != nodes.tolist()
        stored = cache.among(nodes).compliance
        assert stored == pytest.approx(whole, rel=1e-5, abs=1e-6 * np.abs(whole).max())
        force = np.random.default_rng(1).normal(size=(2, 3))
        displacement = cache.displacement(nodes[[1, 3, 6]], nodes[[2, 3]], force)
        exact = np.einsum("aibj,jb->ia", whole[:, [1, 3, 6]][..., [2, 3]], force)
        assert displacement == pytest.approx(exact, rel=1e-4, abs=1e-6 * np.abs(exact).max())


@pytest.mark.parametrize("model", ["lattice"], indirect=True)
def test_a_step_that_continues_the_last_one_begins_at_the_extrapolated_state(model, state):
    def pose(x, z=0.0):
        return POSE @ knee_pose([x, 0.0, z, 0.0, 0.0, 0.0])

    _, first = model.press_from(state, LOAD, pose(0.0))
    _, second = model.press_from(state, LOAD, pose(2e-4), first)
    assert second.before.loads is first.loads and second.before.before is None
    for x in (3e-4, 4e-4):
        share = (x - 2e-4) / 2e-4
        start = second.extrapolated(pose(x))
        assert start.loads == pytest.approx(second.loads + share * (second.loads - first.loads))
        exact = state.problem.operator.start(start.loads)  # L⁻¹ h by a half-solve
        assert start.half == pytest.approx(exact, rel=1e-6, abs=1e-6 * np.abs(exact).max())
    for other in (pose(1e-4), pose(2e-4, 2e-4)):  # backwards and sideways
        assert second.extrapolated(other) is second
    result, third = model.press_from(state, LOAD, pose(4e-4), second)
    cold = model.press(state, LOAD, pose(4e-4))
    assert third.before.loads is second.loads and result.iterations <= cold.iterations
    assert result.approach == pytest.approx(cold.approach, rel=5e-4)
    assert result.pressure.max() == pytest.approx(cold.pressure.max(), rel=2e-3)


def test_the_peak_grows_by_the_residual_of_the_nodes_with_the_largest_forces():
    force, field = (
        np.array([[0.0, -10.0, 0.0], [6.0, -8.0, 0.0], [0.0, -5.0, 0.0]]),
        np.ones((4, 3)),
    )
    for node, size, expected in ((1, 0.02, 2e-3), (3, 5.0, 0.0), (3, 5.5, 0.05), (0, 9.0, 0.0)):
        r = np.zeros((4, 3))
        r[node, 2] = size
        residual = Residual.of(r, field, force, field[1:], np.array([1, 2, 3]), 1.0)
        assert residual.peak == pytest.approx(expected, abs=1e-12)
        assert not replace(residual, force=0.0, work=0.0, peak=2e-3).within(LatticeSolverSettings())


def test_a_warm_start_of_another_insert_is_not_used(state):
    model = contact_model("lattice", resolution=2e-3)
    other = replace(state, problem=replace(state.problem))
    result, start = model.press_from(other, LOAD, POSE)
    assert isinstance(start, LatticeStart)
    assert lattice_start(state, start) is None
    assert lattice_start(other, start) is start
    assert lattice_start(other, result) is None
