"""The option that leaves cells far from the contact linear."""

import numpy as np
import pytest

from lattice_bodies import condyles, dished_insert, pair
from tkamb.contact.lattice.network import CalibratedNetwork
from tkamb.contact.materials import material
from tkamb.contact.registry import contact_model
from tkamb.contact.result import ContactStatus
from tkamb.errors import InputError
from tkamb.geometry.frames import knee_pose

POSE = knee_pose([1e-3, 0.0, 0.3e-3, 0.0, np.radians(0.3), 0.0])
BODIES = pair(condyles(subdivisions=4), dished_insert(cells=24), material("polyethylene"))


def pressed(load=2500.0, name="lattice", **options):
    model = contact_model(name, 2.0, tolerance=1e-5, **options)
    result = model.press(model.prepare(BODIES), load, POSE)
    assert result.status is ContactStatus.OK
    return result


def test_error_goes_from_that_of_the_linear_lattice_to_none_with_the_distance():
    full, linear = pressed(), pressed(name="lattice-linear")
    errors = [
        abs(pressed(nonlinear_within_mm=within).approach / full.approach - 1)
        for within in (0.5, 3.0, 6.0, 8.0)
    ]
    assert errors[0] == pytest.approx(1 - linear.approach / full.approach, rel=1e-3)
    assert np.all(np.diff(errors) < 0)
    assert errors[2] < 2e-3
    assert errors[3] < 1e-4
    assert pressed(nonlinear_within_mm=40.0).approach == pytest.approx(full.approach, rel=1e-9)


def test_newton_solves_the_same_problem():
    fast = pressed(nonlinear_within_mm=3.0)
    exact = pressed(nonlinear_within_mm=3.0, newton=True)
    assert fast.approach == pytest.approx(exact.approach, rel=1e-4)
    assert fast.pressure.max() == pytest.approx(exact.pressure.max(), rel=1e-3)


def test_a_guess_changes_no_answer():
    model = contact_model("lattice", 2.0, nonlinear_within_mm=5.0)
    state = model.prepare(BODIES)
    moved = POSE.copy()
    moved[0, 3] += 3e-3
    first = model.press(state, 2500.0, POSE)
    warm = model.press(state, 2500.0, moved, first)
    cold = model.press(state, 2500.0, moved)
    assert warm.status is cold.status is ContactStatus.OK
    assert warm.approach == pytest.approx(cold.approach, rel=3e-3)


def test_cells_are_chosen_by_the_distance_of_their_middles():
    model = contact_model("lattice", 2.0)
    solid = model.prepare(BODIES).problem.solid
    assert isinstance(solid, CalibratedNetwork)
    points = np.array([[0.0, 8e-3, -11e-3], [2e-3, 8e-3, 11e-3]])
    middles = solid.nodes[solid.cells].mean(axis=1)
    away = np.linalg.norm(middles[:, None] - points, axis=2).min(axis=1)
    near = solid.softening_within(points, 5e-3).softening
    assert np.array_equal(near, np.flatnonzero(away < 5e-3))
    assert solid.softening is None


@pytest.mark.parametrize("value", [0.0, -1.0, "far", True])
def test_what_is_no_distance_is_refused(value):
    with pytest.raises(InputError, match="nonlinear_within_mm"):
        contact_model("lattice", 2.0, nonlinear_within_mm=value)
