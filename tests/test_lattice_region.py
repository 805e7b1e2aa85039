"""Passes that evaluate only a region of the solid: their results hold for the whole solid."""

from dataclasses import replace

import numpy as np
import pytest

from lattice_bodies import condyles, dished_insert, pair
from tkamb.contact.lattice.initial_guess import LatticeStart, initial_guess, lattice_start
from tkamb.contact.lattice.linear import compliance
from tkamb.contact.lattice.linear.compliance import ComplianceCache, by_component, unknowns_of
from tkamb.contact.lattice.nonlinear_balance import largest_shares
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
    return contact_model(request.param, 2.0)


@pytest.fixture(scope="module")
def state(model):
    bodies = pair(condyles(subdivisions=4), dished_insert(cells=24), material("polyethylene"))
    return model.prepare(bodies)


@pytest.fixture(scope="module")
def tight(model, state):
    """The state for a tolerance that a factor in 16-bit integers cannot reach."""
    finer = replace(model, tolerance=1e-4).prepare(state.pair)
    kept = [one.problem.operator.factor.values.dtype for one in (state, finer)]
    assert kept == [np.int16, np.float32]
    return finer


def solved(state, x, tolerance, before=None):
    """Return the solution with the femur shifted by x (m), with or without a warm start."""
    pose = POSE.copy()
    pose[0, 3] += x
    gaps, planes = undeformed(state.problem, pose)
    lowest = gaps.min()
    pose[1, 3] -= lowest
    rest = gaps - lowest, planes.raised(-lowest)
    start = initial_guess(state.compliance, *rest, 0.4e-3, False)
    if before is not None:
        moved = np.zeros_like(state.points)
        moved[before.candidates] = before.displacement
        own = moved[start.candidates]
        start = replace(
            start,
            loads=before.loads,
            displacement=own,
            region=before.region,
        )
    return solve(state.problem, pose, LOAD, start, settings(tolerance))


def settings(tolerance):
    """Return solver settings for a relative tolerance of the residual force."""
    usual = LatticeSolverSettings()
    return replace(
        usual,
        force_tolerance=tolerance,
        work_tolerance=tolerance * usual.work_tolerance / usual.force_tolerance,
        gap_tolerance=tolerance / 4,
    )


def imbalance(state, solution):
    """Return the norm of the residual of the whole solid, relative to the contact forces."""
    problem, touched = state.problem, state.problem.contact_nodes[solution.candidates]
    pushed = solution.forces.force[:, None] * solution.planes.normals
    outside = -problem.solid.internal_force(solution.field)
    outside[touched] += pushed
    return np.linalg.norm(outside.ravel()[~problem.held]) / np.linalg.norm(pushed)


@pytest.mark.parametrize("tolerance", [2e-3, 1e-4])
def test_the_whole_solid_is_in_balance_from_rest_and_from_a_neighbour(state, tight, tolerance):
    state = state if tolerance == 2e-3 else tight
    cold = solved(state, 0.0, tolerance)
    warm = solved(state, 0.4e-3, tolerance, cold)
    again = solved(state, 0.4e-3, tolerance)
    for solution in (cold, warm, again):
        assert solution.converged
        assert imbalance(state, solution) <= tolerance
    assert warm.passes <= again.passes
    assert warm.forces.approach == pytest.approx(again.forces.approach, rel=tolerance)


def test_few_elements_count_and_the_loads_of_the_others_are_left_out(state):
    cold = solved(state, 0.0, 2e-3)
    region, whole = cold.region, state.problem.everywhere
    assert whole.whole and not region.whole
    assert len(region.elements) < 0.7 * len(whole.elements)
    assert len(region.fronts.fronts) <= len(whole.fronts.fronts)
    lost = np.linalg.norm(state.problem.solid.nonlinear_residual(cold.field), axis=1)
    others = np.setdiff1d(whole.elements, region.elements)
    assert lost[others].max() <= lost[region.elements].min()


def test_elements_are_left_out_up_to_the_bound():
    size = np.array([3.0, 0.1, 5.0, 0.2, 0.0])
    assert np.flatnonzero(largest_shares(size, 0.2)).tolist() == [0, 2, 3]
    assert np.flatnonzero(largest_shares(size, 0.23)).tolist() == [0, 2]
    assert np.flatnonzero(largest_shares(size, 0.0)).tolist() == [0, 1, 2, 3]
    assert np.flatnonzero(largest_shares(size, 10.0)).tolist() == []


@pytest.fixture(scope="module")
def pressed(state):
    """The solid and its displacement field."""
    return state.problem.solid, solved(state, 0.0, 1e-3).field


@pytest.mark.parametrize("model", ["lattice"], indirect=True)
def test_a_region_that_is_too_small_is_found_out_and_chosen_anew(state):
    """Passes over too few elements continue with more, and the residual counts each just once."""
    cold = solved(state, 0.0, 2e-3)
    sizes = np.linalg.norm(state.problem.solid.nonlinear_residual(cold.field), axis=1)
    few = Region.of(state.problem, np.sort(np.argsort(sizes)[-40:]))
    found = solved(state, 0.4e-3, 2e-3, replace(cold, region=few))
    assert len(found.region.elements) > 40 and found.converged and found.passes > 1
    assert imbalance(state, found) <= 2e-3
    alone = solved(state, 0.4e-3, 2e-3).forces.approach
    assert found.forces.approach == pytest.approx(alone, rel=5e-4)


def test_the_approach_is_that_of_the_pose(state):
    """A result computes its approach from pair and pose, also after a change of the pose."""
    resting = state.pair.pose_at_approach(POSE, 0.0)
    result = ContactResult.of(state, resting, *np.zeros((2, len(state.points))))
    assert result.approach == 0.0
    deeper = replace(result, pose=state.pair.pose_at_approach(POSE, 2e-4))
    assert deeper.approach == pytest.approx(2e-4, abs=1e-15)
    assert np.isnan(ContactResult.failed(state, POSE, "why").approach)


def test_compliance_at_hand_changes_no_answer(state):
    """A cache filled at other poses and an empty one give results that differ by rounding only."""
    model = contact_model("lattice", 2.0)
    for x in (4e-3, -3e-3):
        moved = POSE.copy()
        moved[0, 3] += x
        model.press(state, LOAD, moved)
    bare = replace(state, compliance=ComplianceCache(state.problem.operator.half))
    used, fresh = model.press(state, LOAD, POSE), model.press(bare, LOAD, POSE)
    assert used.approach == pytest.approx(fresh.approach, rel=1e-7)
    assert used.pressure == pytest.approx(fresh.pressure, rel=1e-6, abs=1.0)


def test_the_compliance_at_hand_stays_within_its_bound(state, monkeypatch):
    """Stored nodes stay when others are added, unless their number would exceed the bound."""
    for most, kept in ((4, [3, 5, 9, 10]), (3, [9, 10])):
        settings = compliance.ComplianceSettings(max_nodes=most)
        monkeypatch.setattr(compliance, "COMPLIANCE", settings)
        cache = ComplianceCache(state.problem.operator.half)
        cache.among(np.array([3, 5]))
        cache.among(np.array([9, 10]))
        assert cache.nodes.tolist() == kept


def test_the_compliance_grows_node_by_node(state, monkeypatch):
    """The result depends neither on the order of the nodes nor on the way of the products."""
    half = state.problem.operator.half
    nodes = np.array([2, 3, 5, 8, 20, 21, 30])
    whole = by_component(half.among(unknowns_of(nodes)).compliance())
    monkeypatch.setattr(compliance, "COMPLIANCE", compliance.ComplianceSettings(spare_nodes=2))
    for few in (0, 100):
        monkeypatch.setattr(compliance, "RESPONSE", compliance.ResponseSettings(few_columns=few))
        cache = ComplianceCache(half)
        for some in ([20], [5, 8], [2], [8, 21, 30], [3, 5]):
            cache.among(np.array(some))
        assert sorted(cache.nodes) == nodes.tolist() and cache.nodes.tolist() != nodes.tolist()
        found = cache.among(nodes).compliance
        assert found == pytest.approx(whole, rel=1e-5, abs=1e-6 * np.abs(whole).max())
        force = np.random.default_rng(1).normal(size=(2, 3))
        moved = cache.displacement(nodes[[1, 3, 6]], nodes[[2, 3]], force)
        mine = np.einsum("aibj,jb->ia", whole[:, [1, 3, 6]][..., [2, 3]], force)
        assert moved == pytest.approx(mine, rel=1e-4, abs=1e-6 * np.abs(mine).max())


def test_a_warm_start_of_another_insert_is_not_used(state):
    """Only a warm start of the same prepared state is accepted."""
    model = contact_model("lattice", 2.0)
    other = replace(state, problem=replace(state.problem))
    result, stranger = model.press_from(other, LOAD, POSE)
    assert isinstance(stranger, LatticeStart)
    assert lattice_start(state, stranger) is None
    assert lattice_start(other, stranger) is stranger
    assert lattice_start(other, result) is None
