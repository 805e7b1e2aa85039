"""Passes that look only where forces are lost: what they report holds for the whole solid."""

from copy import copy
from dataclasses import replace

import numpy as np
import pytest

from lattice_bodies import condyles, dished_insert, pair
from tkamb.contact.lattice import nonlinear_balance
from tkamb.contact.lattice.initial_guess import WarmStart, initial_guess
from tkamb.contact.lattice.linear import compliance, response
from tkamb.contact.lattice.linear.compliance import ComplianceCache, by_component
from tkamb.contact.lattice.linear.response import unknowns_of
from tkamb.contact.lattice.model import warm_start_of
from tkamb.contact.lattice.nonlinear_balance import elements_that_count
from tkamb.contact.lattice.problem import Region, undeformed
from tkamb.contact.lattice.solids.solid import SMALL_STRAIN, Noticed
from tkamb.contact.lattice.solver import Tolerance, solve
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
    """The same for a tolerance that 16-bit integers are too coarse for."""
    finer = replace(model, tolerance=1e-4).prepare(state.pair)
    kept = [one.problem.operator.factor.values.dtype for one in (state, finer)]
    assert kept == [np.int16, np.float32]
    return finer


def solved(state, x, tolerance, before=None):
    """Return the solution at a place, from rest or from an earlier solution."""
    pose = POSE.copy()
    pose[0, 3] += x
    gaps, planes = undeformed(state.problem, pose)
    lowest = gaps.min()
    pose[1, 3] -= lowest
    rest = gaps - lowest, planes.raised(-lowest)
    start = initial_guess(state.compliance, *rest, 0.4e-3, False, None, None)
    if before is not None:
        moved = np.zeros_like(state.points)
        moved[before.candidates] = before.displacement
        own = moved[start.candidates]
        start = replace(
            start,
            nonlinear_residual=before.nonlinear_residual,
            half=before.half,
            left=before.left,
            moved=own,
            region=before.region,
        )
    return solve(state.problem, pose, LOAD, start, Tolerance(tolerance))


def imbalance(state, solution):
    """Return what is out of balance anywhere in the solid, relative to the contact forces."""
    problem, touched = state.problem, state.problem.contact_nodes[solution.candidates]
    pushed = solution.forces.force[:, None] * solution.planes.normals
    applied = solution.nonlinear_residual.copy()
    applied[touched] += pushed
    outside = -problem.solid.internal_force(problem.operator.solve(applied))
    outside[touched] += pushed
    return np.linalg.norm(outside.ravel()[~problem.held]) / np.linalg.norm(pushed)


@pytest.mark.parametrize("tolerance", [1e-3, 1e-4])
def test_the_whole_solid_is_in_balance_from_rest_and_from_a_neighbour(state, tight, tolerance):
    state = state if tolerance == 1e-3 else tight
    cold = solved(state, 0.0, tolerance)
    warm = solved(state, 0.4e-3, tolerance, cold)
    again = solved(state, 0.4e-3, tolerance)
    for solution in (cold, warm, again):
        assert solution.converged
        assert imbalance(state, solution) <= 1.05 * tolerance
    assert warm.passes <= again.passes
    assert warm.forces.approach == pytest.approx(again.forces.approach, rel=5 * tolerance)


def test_what_the_last_contact_leaves_is_foreseen(tight, monkeypatch):
    """Never more than said; were next to nothing foreseen, more than the tolerance."""

    def along_a_way(share):
        monkeypatch.setattr(nonlinear_balance, "LEFT", share * left)
        solutions = [solved(tight, 0.0, 1e-4)]
        for x in 0.15e-3 * np.arange(1, 9) ** 1.5:
            solutions.append(solved(tight, x, 1e-4, solutions[-1]))
        return [(imbalance(tight, one), one.residual) for one in solutions[1:]]

    left = nonlinear_balance.LEFT
    for found, said in along_a_way(1.0):
        assert found <= 1.05 * said <= 1.05e-4
    assert max(along_a_way(0.01))[0] > 5e-4


def test_what_softened_elements_will_ask_for_saves_passes(tight, monkeypatch):
    """And without it, or with much more, the same is found."""

    def along_a_way(times):
        monkeypatch.setattr(nonlinear_balance, "FURTHER", times * further)
        solutions = [solved(tight, 0.0, 1e-4)]
        for x in 0.1e-3 * np.arange(1, 9):
            solutions.append(solved(tight, x, 1e-4, solutions[-1]))
        return solutions

    further = nonlinear_balance.FURTHER
    now, without, too_much = (along_a_way(times) for times in (1.0, 0.0, 4.0))
    passes = [sum(one.passes for one in found) for found in (now, without, too_much)]
    assert passes[0] < min(passes[1:])
    for one, same, again in zip(now, without, too_much, strict=True):
        found = [x.forces.approach for x in (same, again)]
        assert found == pytest.approx(2 * [one.forces.approach], rel=1e-4)


def test_few_elements_count_and_the_rest_of_the_forces_is_zero(state):
    found = solved(state, 0.0, 1e-3)
    region, whole = found.region, state.problem.everywhere
    assert whole.whole and not region.whole
    assert len(region.elements) < 0.7 * len(whole.elements)
    assert len(region.fronts.fronts) <= len(whole.fronts.fronts)
    outside = np.setdiff1d(np.arange(len(found.nonlinear_residual)), region.nodes)
    assert not found.nonlinear_residual[outside].any()
    lost = np.linalg.norm(state.problem.solid.nonlinear_residual(found.field), axis=1)
    others = np.setdiff1d(whole.elements, region.elements)
    assert lost[others].max() <= lost[region.elements].min()


def test_elements_are_left_out_up_to_the_bound():
    size = np.array([3.0, 0.1, 5.0, 0.2, 0.0])
    assert np.flatnonzero(elements_that_count(size, 0.2)).tolist() == [0, 2, 3]
    assert np.flatnonzero(elements_that_count(size, 0.23)).tolist() == [0, 2]
    assert np.flatnonzero(elements_that_count(size, 0.0)).tolist() == [0, 1, 2, 3]
    assert np.flatnonzero(elements_that_count(size, 10.0)).tolist() == []


@pytest.fixture(scope="module")
def pressed(state):
    """The solid and what it was displaced by."""
    return state.problem.solid, solved(state, 0.0, 1e-3).field


@pytest.mark.parametrize("model", ["lattice"], indirect=True)
@pytest.mark.parametrize("share", [1e-6, 1e-4, 1e-2])
@pytest.mark.parametrize("scale", [1.0, 0.1, 10.0])
def test_no_share_of_an_element_that_is_passed_over_exceeds_the_limit(pressed, share, scale):
    """Pressed, turned, moved as a whole and shaken: the bound knows the strain whatever moves."""
    solid, field = pressed
    turned = np.cross([0.0, 1e-3, 2e-3], solid.nodes) + np.array([1e-3, 0.0, 2e-3])
    shaken = 1e-7 * np.random.default_rng(3).normal(size=field.shape)
    field = scale * (field + turned + shaken)
    sizes = np.linalg.norm(solid.nonlinear_residual(field), axis=1)
    noticed = solid.noticeable(field, share)
    others = np.setdiff1d(np.arange(len(sizes)), noticed.elements)
    assert sizes[others].max(initial=0.0) <= share
    strain = np.linalg.eigvalsh(solid.strain(field, others))
    assert np.abs(strain).max(initial=0.0) < 2 * SMALL_STRAIN
    norms = np.linalg.norm(solid.strain(field, noticed.elements), axis=(1, 2))
    assert noticed.strain == pytest.approx(norms, rel=1e-9, abs=1e-12)
    everywhere = min(solid.least_principal_strain(field, noticed), strain.min(initial=np.inf))
    assert solid.least_principal_strain(field) == pytest.approx(everywhere, rel=1e-9)


@pytest.mark.parametrize("model", ["lattice"], indirect=True)
def test_the_calibrated_cells_pass_most_of_the_solid_over(pressed):
    """What it is for; and with a tenth of the bound some share is lost."""
    solid, field = pressed
    sizes = np.linalg.norm(solid.nonlinear_residual(field), axis=1)
    limit = 1e-2
    assert (sizes > limit).any()
    assert len(solid.noticeable(field, limit).elements) < 0.6 * len(sizes)
    assert len(solid.noticeable(field, limit).elements) < 3 * (sizes > limit).sum()
    wrong = copy(solid)
    wrong.__dict__["_largest"] = solid._largest / 10
    lost = np.setdiff1d(np.arange(len(sizes)), wrong.noticeable(field, limit).elements)
    assert sizes[lost].max() > limit
    field = field.copy()
    field[solid.cells[7, 3]] = np.nan
    assert 7 in solid.noticeable(field, limit).elements


@pytest.mark.parametrize("model", ["lattice"], indirect=True)
def test_a_region_may_become_the_whole_solid(state, monkeypatch):
    """Passes that looked at few elements go on with all: none is counted twice, none left out."""
    cold = solved(state, 0.0, 1e-3)
    sizes = np.linalg.norm(state.problem.solid.nonlinear_residual(cold.field), axis=1)
    few = Region.of(state.problem, np.sort(np.argsort(sizes)[-40:]))
    everything = Noticed(np.arange(len(sizes)), np.zeros(len(sizes)))
    monkeypatch.setattr(nonlinear_balance, "SHARE", 0.0)
    monkeypatch.setattr(type(state.problem.solid), "noticeable", lambda *given: everything)
    found = solved(state, 0.4e-3, 1e-3, replace(cold, region=few))
    assert found.region.whole and found.converged and found.passes > 1
    assert imbalance(state, found) <= 1.05e-3
    assert found.forces.approach == pytest.approx(
        solved(state, 0.4e-3, 1e-3).forces.approach, rel=5e-3
    )


def test_the_approach_is_that_of_the_pose(state):
    """Nothing is handed over: it follows from pair and pose, also after a change of pose."""
    resting = state.pair.pose_at_approach(POSE, 0.0)
    result = ContactResult.of(state, resting, *np.zeros((2, len(state.points))))
    assert result.approach == 0.0
    deeper = replace(result, pose=state.pair.pose_at_approach(POSE, 2e-4))
    assert deeper.approach == pytest.approx(2e-4, abs=1e-15)
    assert np.isnan(ContactResult.failed(state, POSE, "why").approach)


def test_compliance_at_hand_changes_no_answer(state):
    """Pressed with what other poses have left, and with nothing: single precision's rounding."""
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
    """Spare nodes are worked out along with those wanted, unless there are too many."""
    wanted, spare = np.array([3, 5]), np.arange(2, 9)
    for most, kept in ((7, spare), (6, wanted)):
        monkeypatch.setattr(compliance, "MOST_STORED", most)
        cache = ComplianceCache(state.problem.operator.half)
        cache.among(wanted, spare)
        assert cache.nodes.tolist() == kept.tolist()
        cache.among(np.array([9]), np.array([9, 10]))  # fits beside two, not beside seven
        assert cache.nodes.tolist() == ([9, 10] if most == 7 else [3, 5, 9, 10])


def test_the_compliance_grows_node_by_node(state, monkeypatch):
    """In whatever order nodes come, and through every way of working it out."""
    half = state.problem.operator.half
    nodes = np.array([2, 3, 5, 8, 20, 21, 30])
    whole = by_component(half.among(unknowns_of(nodes)).compliance())
    monkeypatch.setattr(compliance, "SPACE", 2)
    for few in (0, 100):
        monkeypatch.setattr(response, "FEW", few)
        cache = ComplianceCache(half)
        for some in ([20], [5, 8], [2], [8, 21, 30], [3, 5]):
            cache.among(np.array(some), np.array(some))
        assert sorted(cache.nodes) == nodes.tolist() and cache.nodes.tolist() != nodes.tolist()
        found = cache.among(nodes, nodes).compliance
        assert found == pytest.approx(whole, rel=1e-5, abs=1e-6 * np.abs(whole).max())
        force = np.random.default_rng(1).normal(size=(2, 3))
        moved = cache.moved(nodes[[1, 3, 6]], nodes[[2, 3]], force)
        mine = np.einsum("aibj,jb->ia", whole[:, [1, 3, 6]][..., [2, 3]], force)
        assert moved == pytest.approx(mine, rel=1e-4, abs=1e-6 * np.abs(mine).max())


def test_a_warm_start_of_another_insert_is_not_used(state):
    """A guess of another state saves nothing and harms nothing."""
    model = contact_model("lattice", 2.0)
    other = replace(state, problem=replace(state.problem))
    stranger = model.press(other, LOAD, POSE)
    assert isinstance(stranger.warm_start, WarmStart)
    assert warm_start_of(state, stranger) is None
    assert warm_start_of(other, stranger) is stranger.warm_start
