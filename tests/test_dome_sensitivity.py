"""Change of quadriceps and patellofemoral force per millimetre of the button's position."""

from dataclasses import replace

import numpy as np
import pytest

from test_load_states import FRICTION, UP, knee, loaded  # noqa: F401
from tkamb.knee.equations import dome_sensitivity, solve_knee


def test_quadriceps_follows_the_arms_about_the_shifted_contact(knee):  # noqa: F811
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


def test_the_sensitivity_is_the_slope_of_a_shifted_frame(knee):  # noqa: F811
    geometry, step = loaded(knee, 700 * UP, [-0.06, -0.45, 0.0]), 1e-5
    extensor, up = geometry.extensor, geometry.state.pose("patella")[:3, 1]
    ends = []
    for sign in (-1, 1):
        moved = replace(extensor, contact_point=extensor.contact_point + sign * step * up)
        values = solve_knee(replace(geometry, extensor=moved), FRICTION).values
        ends.append(np.array([values["muscle_quadriceps"], values["patellofemoral"]]))
    sensitivity = dome_sensitivity(geometry, solve_knee(geometry, FRICTION), FRICTION)
    assert sensitivity == pytest.approx((ends[1] - ends[0]) / (2 * step), rel=1e-5)


def test_a_slack_quadriceps_has_no_sensitivity(knee):  # noqa: F811
    geometry = loaded(knee, 700 * UP, [0.08, -0.45, 0.0])
    loads = solve_knee(geometry, FRICTION)
    assert dome_sensitivity(geometry, loads, FRICTION) == (0.0, 0.0)
