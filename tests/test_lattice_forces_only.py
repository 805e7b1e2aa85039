"""Answers of which only the forces need be right: what they leave out, and how far that holds."""

import numpy as np
import pytest

from lattice_bodies import condyles, dished_insert, pair
from tkamb.contact.lattice import initial_guess
from tkamb.contact.materials import material
from tkamb.contact.registry import contact_model
from tkamb.geometry.frames import knee_pose

LOAD = 2500.0
MODEL = contact_model("lattice", 1.5)


@pytest.fixture(scope="module")
def state():
    bodies = pair(condyles(subdivisions=4), dished_insert(cells=24), material("polyethylene"))
    return MODEL.prepare(bodies)


def place(x, adduction=0.3):
    return knee_pose([x, 0.0, 0.3e-3, 0.0, np.radians(adduction), 0.0])


def imbalance(state, result, start):
    """Return what is out of balance anywhere in the solid, relative to the contact forces."""
    problem = state.problem
    applied = np.zeros_like(problem.solid.nodes)
    applied[problem.contact_nodes] = result.nodal_force
    field = problem.operator.solve(applied + start.loads)
    outside = applied - problem.solid.internal_force(field)
    missing = np.linalg.norm(outside.ravel()[~problem.held])
    return missing / np.linalg.norm(applied)


def test_forces_alone_are_those_of_the_whole_answer(state):
    """Small steps as of a search: every look at all elements is left out but the first."""
    _, start = MODEL.press_from(state, LOAD, place(0.0))
    looked = start.looked[1]
    for step in range(1, 6):
        pose = place(2e-5 * step, 0.3 + 0.02 * step)
        last, start = MODEL.press_from(state, LOAD, pose, start, forces_only=True)
        whole, whole_start = MODEL.press_from(state, LOAD, pose)
        assert start.looked[1] is looked
        assert start.region is not whole_start.region
        size = np.linalg.norm(whole.nodal_force)
        assert np.linalg.norm(last.nodal_force - whole.nodal_force) < 2e-3 * size
        assert last.medial.force == pytest.approx(whole.medial.force, rel=1e-3)
        assert imbalance(state, last, start) < 1.2 * MODEL.tolerance


def test_beyond_the_bound_all_is_looked_at(state, monkeypatch):
    """Without the bound the same step leaves elements out that count, and nobody knows."""
    _, first = MODEL.press_from(state, LOAD, place(0.0))
    far = place(3e-3)
    sound, start = MODEL.press_from(state, LOAD, far, first, forces_only=True)
    assert np.array_equal(start.looked[1][:, 0::2], far[:, 0::2])
    assert start.looked[1][0, 3] == far[0, 3]
    assert imbalance(state, sound, start) < 1.2 * MODEL.tolerance
    monkeypatch.setattr(initial_guess, "FORCES_ONLY_DISTANCE", np.inf)
    blind, start = MODEL.press_from(state, LOAD, far, first, forces_only=True)
    assert start.looked[1] is first.looked[1]
    assert imbalance(state, blind, start) > 2 * MODEL.tolerance


def test_forces_that_grow_are_looked_at(state):
    _, first = MODEL.press_from(state, LOAD, place(0.0))
    _, heavier = MODEL.press_from(state, 1.2 * LOAD, place(0.0), first, forces_only=True)
    assert heavier.looked[0] > 1.1 * first.looked[0]
    _, lighter = MODEL.press_from(state, 0.9 * LOAD, place(0.0), first, forces_only=True)
    assert lighter.looked[0] == first.looked[0]


def test_forces_alone_flag_nothing_and_without_a_start_look_at_all(state):
    result, _ = MODEL.press_from(state, LOAD, place(0.0), forces_only=True)
    whole = MODEL.press(state, LOAD, place(0.0))
    assert result.flags == ()
    assert np.array_equal(result.nodal_force, whole.nodal_force)
    assert result.status is whole.status


@pytest.mark.slow
def test_forces_alone_of_cells_compressed_to_nothing_are_out_of_range(state):
    """A step of a search that went far too deep: it must not come back with forces."""
    touching, start = MODEL.press_from(state, LOAD, place(0.0))
    deep = touching.pose.copy()
    deep[1, 3] -= 6e-3
    whole = MODEL.evaluate(state, deep)
    forces, _ = MODEL.evaluate_from(state, deep, start, forces_only=True)
    assert any("compressed to nothing" in flag for flag in whole.flags)
    assert forces.status is whole.status is not touching.status
