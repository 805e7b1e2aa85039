"""Passes that look only where forces are lost: what they report holds for the whole solid."""

from dataclasses import replace

import numpy as np
import pytest

from lattice_bodies import condyles, dished_insert, pair
from tkamb.contact.lattice.candidates import choose_start
from tkamb.contact.lattice.problem import undeformed
from tkamb.contact.lattice.region import Region, members_that_count
from tkamb.contact.lattice.solver import Tolerance, solve
from tkamb.contact.materials import material
from tkamb.contact.registry import contact_model
from tkamb.contact.result import ContactResult
from tkamb.geometry.frames import knee_pose

POSE = knee_pose([1e-3, 0.0, 0.3e-3, 0.0, np.radians(0.3), 0.0])
LOAD = 2500.0


@pytest.fixture(scope="module", params=["lattice", "fe", "lattice-source"])
def state(request):
    bodies = pair(condyles(subdivisions=4), dished_insert(cells=24), material("polyethylene"))
    return contact_model(request.param, 2.0).prepare(bodies)


def solved(state, x, tolerance, before=None):
    """Return the solution at a place, from rest or from an earlier solution."""
    pose = POSE.copy()
    pose[0, 3] += x
    gaps, foot = undeformed(state.problem, pose)
    lowest = gaps.min()
    pose[1, 3] -= lowest
    rest = gaps - lowest, foot.raised(-lowest)
    start = choose_start(state.pool, *rest, 0.4e-3, False, None, None)
    if before is not None:
        moved = np.zeros_like(state.points)
        moved[before.candidates] = before.displacement
        own = moved[start.candidates]
        start = replace(start, lost=before.lost, moved=own, region=before.region)
    return solve(state.problem, pose, LOAD, start, Tolerance(tolerance))


def imbalance(state, solution):
    """Return what is out of balance anywhere in the solid, relative to the contact forces."""
    problem = state.problem
    outside = -problem.solid.internal_force(solution.field)
    pushed = solution.forces.force[:, None] * solution.footing.normals
    outside[problem.contact_nodes[solution.candidates]] += pushed
    return np.linalg.norm(outside.ravel()[~problem.held]) / np.linalg.norm(pushed)


@pytest.mark.parametrize("tolerance", [1e-3, 1e-4])
def test_the_whole_solid_is_in_balance_from_rest_and_from_a_neighbour(state, tolerance):
    cold = solved(state, 0.0, tolerance)
    warm = solved(state, 0.4e-3, tolerance, cold)
    again = solved(state, 0.4e-3, tolerance)
    for solution in (cold, warm, again):
        assert solution.converged
        assert imbalance(state, solution) <= 1.05 * tolerance
    assert warm.passes <= again.passes
    assert warm.forces.approach == pytest.approx(again.forces.approach, rel=5 * tolerance)


def test_few_members_count_and_the_rest_of_the_forces_is_zero(state):
    found = solved(state, 0.0, 1e-3)
    region, whole = found.region, Region.everywhere(state.problem)
    assert whole.whole and not region.whole
    assert len(region.members) < 0.7 * len(whole.members)
    assert len(region.fronts) <= len(whole.fronts)
    outside = np.setdiff1d(np.arange(len(found.lost)), region.nodes)
    assert not found.lost[outside].any()
    lost = np.linalg.norm(state.problem.solid.lost(found.field), axis=1)
    others = np.setdiff1d(whole.members, region.members)
    assert lost[others].max() <= lost[region.members].min()


def test_members_are_left_out_up_to_the_bound():
    size = np.array([3.0, 0.1, 5.0, 0.2, 0.0])
    assert members_that_count(size, 0.2).tolist() == [0, 2, 3]
    assert members_that_count(size, 0.23).tolist() == [0, 2]
    assert members_that_count(size, 0.0).tolist() == [0, 1, 2, 3]
    assert members_that_count(size, 10.0).tolist() == []


def test_an_approach_may_be_found_when_it_is_read():
    asked = []

    def approach():
        asked.append(True)
        return 2e-4

    nothing = np.zeros(1)
    result = ContactResult(*[nothing] * 8, None, None, approach)
    assert not asked
    assert result.approach == result.approach == 2e-4
    assert len(asked) == 1
    assert replace(result, approach=1e-4).approach == 1e-4
    with pytest.raises(TypeError, match="approach"):
        ContactResult(*[nothing] * 8, None, None)
