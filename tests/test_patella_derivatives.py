"""Derivatives of `Knee.equilibrium` with a released patella, beside central differences."""

import numpy as np
import pinocchio as pin
import pytest

from derivative_cases import TOLERANCE
from equilibrium_cases import (
    STATES,
    compared,
    comparisons,
    directions,
    random_states,
    released_knee,
    sharpen,
)
from patella_bodies import body_knee, read_plane
from tkamb.errors import InputError


@pytest.fixture(scope="module")
def plain():
    return read_plane()


@pytest.fixture(scope="module")
def knee(plain):
    return released_knee(plain)


@pytest.fixture
def sharp(monkeypatch):
    sharpen(monkeypatch)


@pytest.mark.parametrize("left", [False, True])
def test_derivatives_agree_with_equilibria_beside(plain, knee, sharp, left):
    found = list(comparisons(plain, knee, left, 2))
    assert len(found) == 2
    for one in found:
        assert {name: each.error for name, each in one.items() if each.error >= TOLERANCE} == {}


@pytest.mark.slow
@pytest.mark.parametrize("left", [False, True])
def test_derivatives_agree_in_many_states(plain, knee, sharp, left):
    """At most one state in ten lies on a kink, where the derivative is that of its side."""
    found = list(comparisons(plain, knee, left, STATES))
    assert len(found) >= 0.9 * STATES
    for name in ("load", "held", "slack", "stiffness"):
        assert max(one[name].error for one in found) < TOLERANCE, name
        assert np.mean([one[name].kink for one in found]) <= 0.1, name


def test_a_slack_quadriceps_leaves_the_lines_of_the_patella_without_effect(plain, knee, sharp):
    """The ground pulls the foot forward and extends the knee."""
    state = next(random_states(plain, knee, False, 1))
    joint = knee.anatomy.tibia.joint
    extending = pin.Force(np.zeros(3), 400.0 * np.array([0.0, 0.0, 1.0]))
    state.fext[joint] = state.fext[joint] + extending
    state.v, state.a, state.released = 0.0 * state.v, 0.0 * state.a, ("adduction",)
    solved = state.equilibrium(derivatives=True)
    assert not solved.failed and solved.loads.quadriceps == 0.0, solved.reason
    slopes = solved.derivatives
    own = [one.name.startswith(("strand", "retinaculum")) for one in knee.ligaments]
    for columns in (slopes.by_slack_length, slopes.by_stiffness):
        assert columns.shape == (8, len(own))
        assert not columns[:, own].any() and columns[:, np.invert(own)].any()
    for parameter, change, slope in directions(state, solved, np.random.default_rng(0)):
        assert compared(state, parameter, change, slope).error < TOLERANCE, parameter


def test_a_button_whose_force_jumps_has_no_derivatives(plain):
    source = plain[0]
    other = body_knee(source, "hertz", released=True, contact=source.contact)
    _, motion, ground = plain
    with pytest.raises(InputError, match="'hertz' jump from facet to facet"):
        other.equilibrium(motion.q[60], motion.v[60], motion.a[60], ground[60], derivatives=True)
