"""Six load states of one knee, which the position of the ground reaction selects."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from knees import HALF, UP, bent_knee
from tkamb.knee.equations import dome_sensitivity, solve_knee
from tkamb.knee.load import PointForces
from tkamb.knee.unknowns import LoadState, Solution, wrong_signs

FRICTION = 0.05
ONE_SIDED_LOADS = (
    "medial_normal",
    "lateral_normal",
    "muscle_quadriceps",
    "patellar_ligament",
    "patellofemoral",
)


@pytest.fixture(scope="module")
def knee():
    return bent_knee()


def loaded(knee, force, point, moment=(0.0, 0.0, 0.0)):
    """Return the knee with a ground reaction on the tibia, insert frame."""
    moment = np.asarray(moment, float)
    return replace(knee, ground=PointForces("tibia", np.array([point]), np.array([force]), moment))


AHEAD = {"taut": -0.06, "slack": 0.08}
ASIDE = {"none": 0.0, "medial": 0.12, "lateral": -0.12}


@pytest.mark.parametrize(("ahead", "lifted"), list(product(AHEAD, ASIDE)))
def test_the_ground_reaction_selects_each_of_six_load_states(knee, ahead, lifted):
    """A ground reaction behind the knee needs the quadriceps. A ground reaction beside the condyles
    lifts the far condyle.
    """
    x, z = AHEAD[ahead], ASIDE[lifted]
    loads = solve_knee(loaded(knee, 700 * UP, [x, -0.45, z]), FRICTION)
    assert loads.problems == ()
    assert loads.lifted == frozenset(() if lifted == "none" else (lifted,))
    assert loads.slack == (ahead == "slack")
    assert not loads.ambiguous
    assert min(loads.values.get(name, 0.0) for name in ONE_SIDED_LOADS) >= 0.0
    if loads.slack:
        # a flexion moment on the tibia replaces flexors
        assert loads.values["residual_flexion"] < 0.0
    if loads.lifted:
        # the moment about x that a pull of the lifted condyle would exert on the tibia
        assert loads.values["residual_coronal"] * {"medial": -HALF, "lateral": HALF}[lifted] < 0.0


def test_a_slack_quadriceps_adds_nothing_to_the_contact_force(knee):
    """With slack muscles the contact carries the ground reaction less the weight of the shank."""
    force = solve_knee(loaded(knee, 700 * UP, [0.08, -0.45, 0.0]), FRICTION).contact_force
    state = knee.state
    gravity = 9.80665 * 4.2
    shank_axis = state.pose("tibia")[:3, :3] @ UP
    assert force[1] == pytest.approx(700 - gravity * shank_axis[1], abs=1.0)


@pytest.mark.parametrize("off", ["medial", "lateral"])
def test_a_condyle_that_the_recorded_gap_lifts_stays_lifted(knee, off):
    for x in AHEAD.values():
        geometry = replace(loaded(knee, 700 * UP, [x, -0.45, 0.0]), lifted=frozenset({off}))
        loads = solve_knee(geometry, FRICTION)
        assert loads.lifted == {off}
        assert f"{off}_normal" not in loads.values


def test_a_knee_in_traction_fails_with_the_reasons_of_all_load_states(knee):
    loads = solve_knee(loaded(knee, -400 * UP, [-0.01, -0.45, 0.0]), FRICTION)
    (problem,) = loads.problems
    assert "no load state has all signs right" in problem
    labels = ("all loaded", "quadriceps slack", "medial lifted", "lateral lifted")
    assert all(label in problem for label in labels)
    assert loads.values == {}
    assert np.isnan(loads.contact_force).all()


def test_a_patella_that_would_have_to_pull_fails_the_frame(knee):
    """With a slack quadriceps an extension moment is missing."""
    turned = replace(knee.extensor, contact_normal=-knee.extensor.contact_normal)
    geometry = replace(loaded(knee, 700 * UP, [-0.06, -0.45, 0.0]), extensor=turned)
    (problem,) = solve_knee(geometry, FRICTION).problems
    assert "patellofemoral" in problem
    assert "extension moment" in problem


def test_a_knee_without_contact_that_needs_extension_is_not_slack():
    """Without contact the residual flexion moment acts on the femur, with the opposite sign."""
    slack = LoadState(frozenset(), frozenset({"quadriceps"}))

    def wrong(name, moment):
        return wrong_signs(slack, Solution({name: moment}, 1.0, True))

    for name, extending in (("residual_flexion", 5.0), ("knee_moment_flexion", -5.0)):
        assert wrong(name, extending) == ["extension moment 5 N·m needed"]
        assert wrong(name, -extending) == []


@settings(max_examples=150, deadline=None)
@given(
    st.tuples(*[st.floats(-300, 300)] * 3),
    st.floats(-500, 1500),
    st.tuples(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2)),
    st.tuples(*[st.floats(-20, 20)] * 3),
)
def test_no_solution_of_a_random_load_has_a_wrong_sign(knee, shear, up, point, moment):
    """Loads have right signs, zero loads would have wrong signs, the shank is in equilibrium."""
    force = np.array([shear[0], up, shear[2]])
    geometry = loaded(knee, force, [point[0], -0.45, point[1]], moment)
    loads = solve_knee(geometry, FRICTION)
    if loads.problems:
        assert loads.values == {}
        return
    values = loads.values
    assert min(values.get(name, 0.0) for name in ONE_SIDED_LOADS) >= -1e-6
    if loads.slack:
        assert values["residual_flexion"] <= 0.25
    for side in loads.lifted:
        assert values["residual_coronal"] * (-1 if side == "medial" else 1) <= 1e-6
    assert np.allclose(shank_residual(geometry, loads), 0.0, atol=1e-6)


def shank_residual(geometry, loads):
    """Return the residual force (3,) on the shank, insert frame."""
    values, state = loads.values, geometry.state
    weight = -9.80665 * 4.2 * (state.pose("tibia")[:3, :3] @ UP)
    residual = np.array([values["residual_ap"], 0.0, values["residual_ml"]])
    ligament = values["patellar_ligament"] * geometry.extensor.patellar_ligament[1].forces[0]
    return weight + geometry.ground.forces[0] + residual + ligament - loads.contact_force


def test_quadriceps_follows_the_arms_about_the_shifted_contact(knee):
    """About the contact point, without the patella's weight, Q a_Q = PL a_PL."""
    geometry = loaded(knee, 700 * UP, [-0.06, -0.45, 0.0])
    loads, state, extensor = solve_knee(geometry, FRICTION), geometry.state, geometry.extensor
    ligament = loads.values["patellar_ligament"]
    femur, up = state.pose("femur")[:3, :3], state.pose("patella")[:3, 1]

    def quadriceps(point):
        arms = [
            np.cross(pull.points[0] - point, pull.forces[0]) @ femur[:, 2]
            for pull in (geometry.muscles[0].loads[1], extensor.patellar_ligament[0])
        ]
        return -ligament * arms[1] / arms[0]

    step = 0.5e-3
    point = extensor.contact_point
    slope = (quadriceps(point + step * up) - quadriceps(point - step * up)) / (2 * step)
    sensitivity = dome_sensitivity(geometry, loads, FRICTION)
    assert loads.values["muscle_quadriceps"] == pytest.approx(quadriceps(point), rel=0.01)
    assert sensitivity[0] == pytest.approx(slope, rel=0.02)
    assert abs(slope) > 0.005e3 * loads.values["muscle_quadriceps"]  # more than 0.5 % per mm


def test_the_sensitivity_is_the_slope_of_a_shifted_frame(knee):
    geometry, step = loaded(knee, 700 * UP, [-0.06, -0.45, 0.0]), 1e-5
    extensor, up = geometry.extensor, geometry.state.pose("patella")[:3, 1]
    ends = []
    for sign in (-1, 1):
        moved = replace(extensor, contact_point=extensor.contact_point + sign * step * up)
        values = solve_knee(replace(geometry, extensor=moved), FRICTION).values
        ends.append(np.array([values["muscle_quadriceps"], values["patellofemoral"]]))
    sensitivity = dome_sensitivity(geometry, solve_knee(geometry, FRICTION), FRICTION)
    assert sensitivity == pytest.approx((ends[1] - ends[0]) / (2 * step), rel=1e-5)


def test_a_slack_quadriceps_has_no_sensitivity(knee):
    geometry = loaded(knee, 700 * UP, [0.08, -0.45, 0.0])
    loads = solve_knee(geometry, FRICTION)
    assert dome_sensitivity(geometry, loads, FRICTION) == (0.0, 0.0)
