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


def imbalance(state, result):
    """Return what is out of balance anywhere in the solid, relative to the contact forces."""
    problem, warm = state.problem, result.warm_start
    applied = np.zeros_like(problem.solid.nodes)
    applied[problem.contact_nodes] = result.nodal_force
    field = problem.operator.solve(applied + warm.loads)
    outside = applied - problem.solid.internal_force(field)
    missing = np.linalg.norm(outside.ravel()[~problem.held])
    return missing / np.linalg.norm(applied)


def test_a_sketch_has_the_forces_of_the_whole_answer(state):
    """Small steps as of a search: every look at all elements is left out but the first."""
    last = MODEL.press(state, LOAD, place(0.0))
    looked = last.warm_start.looked[1]
    for step in range(1, 6):
        pose = place(2e-5 * step, 0.3 + 0.02 * step)
        last = MODEL.press(state, LOAD, pose, last, sketch=True)
        whole = MODEL.press(state, LOAD, pose)
        assert last.warm_start.looked[1] is looked
        assert last.warm_start.region is not whole.warm_start.region
        size = np.linalg.norm(whole.nodal_force)
        assert np.linalg.norm(last.nodal_force - whole.nodal_force) < 2e-3 * size
        assert last.medial.force == pytest.approx(whole.medial.force, rel=1e-3)
        assert imbalance(state, last) < 1.2 * MODEL.tolerance


def test_beyond_the_bound_all_is_looked_at(state, monkeypatch):
    """Without the bound the same step leaves elements out that count, and nobody knows."""
    first = MODEL.press(state, LOAD, place(0.0))
    far = place(3e-3)
    sound = MODEL.press(state, LOAD, far, first, sketch=True)
    assert np.array_equal(sound.warm_start.looked[1], sound.warm_start.pose)
    assert imbalance(state, sound) < 1.2 * MODEL.tolerance
    monkeypatch.setattr(initial_guess, "FORCES_ONLY_DISTANCE", np.inf)
    blind = MODEL.press(state, LOAD, far, first, sketch=True)
    assert blind.warm_start.looked[1] is first.warm_start.looked[1]
    assert imbalance(state, blind) > 2 * MODEL.tolerance


def test_forces_that_grow_are_looked_at(state):
    first = MODEL.press(state, LOAD, place(0.0))
    heavier = MODEL.press(state, 1.2 * LOAD, place(0.0), first, sketch=True)
    assert heavier.warm_start.looked[0] > 1.1 * first.warm_start.looked[0]
    lighter = MODEL.press(state, 0.9 * LOAD, place(0.0), first, sketch=True)
    assert lighter.warm_start.looked[0] == first.warm_start.looked[0]


def test_a_sketch_flags_nothing_and_without_a_guess_looks_at_all(state):
    result = MODEL.press(state, LOAD, place(0.0), sketch=True)
    whole = MODEL.press(state, LOAD, place(0.0))
    assert result.flags == ()
    assert np.array_equal(result.nodal_force, whole.nodal_force)
    assert result.status is whole.status


@pytest.mark.slow
def test_a_sketch_that_compresses_cells_to_nothing_is_out_of_range(state):
    """A step of a search that went far too deep: it must not come back with forces."""
    touching = MODEL.press(state, LOAD, place(0.0))
    deep = touching.pose.copy()
    deep[1, 3] -= 6e-3
    whole = MODEL.evaluate(state, deep)
    sketch = MODEL.evaluate(state, deep, touching, sketch=True)
    assert any("compressed to nothing" in flag for flag in whole.flags)
    assert sketch.status is whole.status is not touching.status
