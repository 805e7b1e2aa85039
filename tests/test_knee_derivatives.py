"""Derivatives of the knee's forces, of dynamics with them, of presses and of equilibria."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import tkamb
from knee_bodies import whole_body
from test_knee import FOUNDATION, SCENE, at, pressed
from tkamb.errors import ComputationError, InputError
from tkamb.knee import balance, patella_search, released

STATES = 50
"""Number of random states."""


@pytest.fixture(scope="module")
def read():
    return tkamb.read_scene(tkamb.load_scene(SCENE, FOUNDATION))


@pytest.fixture(autouse=True)
def _sharp_patella(monkeypatch):
    """Central differences of a solved patella need a search that ends at rounding errors."""
    sharp = replace(
        patella_search.PATELLA_SEARCH,
        length_tolerance=1e-13,
        rotation_tolerance=1e-11,
        max_evaluations=30,
    )
    monkeypatch.setattr(patella_search, "PATELLA_SEARCH", sharp)


def vectors(forces):
    return np.array([force.vector for force in forces])


def slopes(values, knee, q, v, step, rate=1e-5):
    """Return central differences of values (n,) by q and v; the step of an angle is 40 times."""
    model, found = knee.model, []
    sizes = np.full(model.nv, step)
    for joint in model.joints:
        if joint.nv == 0:
            continue
        lengths = {"JointModelFreeFlyer": 3, "JointModelTranslation": 3}.get(joint.shortname(), 0)
        if joint.shortname().startswith("JointModelP"):
            lengths = 1
        sizes[joint.idx_v + lengths : joint.idx_v + joint.nv] *= 40.0
    for by_v in (False, True):
        columns = []
        for k in range(model.nv):
            size = rate if by_v else sizes[k]
            move = size * np.eye(model.nv)[k]
            ends = [
                values(q, v + s * move) if by_v else values(pin.integrate(model, q, s * move), v)
                for s in (1.0, -1.0)
            ]
            columns.append((ends[0] - ends[1]) / (2.0 * size))
        found.append(np.moveaxis(np.array(columns), 0, -1))
    return found


def errors(computed, expected):
    """Return the error of each column, relative to it or to 1e-3 of the largest column."""
    axes = tuple(range(expected.ndim - 1))
    size = np.abs(expected).max(axis=axes)
    if not size.any():
        return np.abs(computed).max(axis=axes)
    size = np.maximum(size, 1e-3 * size.max())
    return np.abs(computed - expected).max(axis=axes) / size


def largest_error(values, computed, knee, q, v, steps=(1e-9, 1e-8)):
    """Return the largest error of derivatives by q and by v.

    Facets and columns give the forces kinks. Of each column the better of two steps counts: the
    longer one has less rounding, the shorter one meets fewer kinks.
    """
    found = [
        [errors(*pair) for pair in zip(computed, slopes(values, knee, q, v, step), strict=True)]
        for step in steps
    ]
    return float(np.max(np.min(found, axis=0)))


def force_error(knee, q, v, tensions=None, steps=(1e-9, 1e-8), data=None):
    computed = knee.external_forces_derivatives(q, v, tensions, data)
    return largest_error(
        lambda q, v: vectors(knee.external_forces(q, v, tensions, data)),
        computed,
        knee,
        q,
        v,
        steps,
    )


def random_states(read, knee, count, load=1000.0, seed=0):
    """Yield random states near recorded frames; the condyles carry about the load."""
    rng, motion = np.random.default_rng(seed), read[1]
    model = knee.model
    columns = plain_columns(read[0])
    while count:
        k = int(rng.integers(20, 95))
        move = np.zeros(model.nv)
        move[columns] = rng.uniform(-1, 1, 6) * [2e-3, 0, 1e-3, 0.03, 0.005, 0.05]
        q = pin.integrate(model, motion.q[k], move)
        v = motion.v[k] + 0.1 * rng.standard_normal(model.nv)
        yield pressed(knee, q, load * rng.uniform(0.5, 1.5)) if load else q, v
        count -= 1


def plain_columns(plain):
    return list(plain.chain.knee_columns()) if False else list(range(6, 12))


def knee_of(plain, name="foundation", **changes):
    parts = {
        "implant": plain.implant,
        "ligaments": plain.ligaments,
        "contact": tkamb.contact_model(name, resolution=3e-3) if name else None,
        "friction": 0.05 if name else 0.0,
    }
    return tkamb.Knee(plain.model, **(parts | changes))


@pytest.mark.parametrize("name", ["foundation", "foundation-linear"])
def test_forces_of_contact_friction_and_ligaments(read, name):
    knee = knee_of(read[0], name)
    for q, v in random_states(read, knee, 6):
        assert force_error(knee, q, v) < 1e-5


def test_forces_of_muscle_lines_extensor_and_a_moving_patella(read):
    plain = read[0]
    points = (
        ("femur", (-0.02, 0.2, 0.0)),
        ("femur", (-0.02, 0.05, 0.0)),
        ("tibia", (-0.03, 0.3, 0.01)),
    )
    knee = knee_of(
        plain, None, extensor=plain.extensor, muscles=[tkamb.Muscle("hamstrings", points)]
    )
    tensions = {"hamstrings": 150.0, plain.extensor.quadriceps.name: 500.0}
    for q, v in random_states(read, knee, 3, load=0.0):
        assert force_error(knee, q, v, tensions, steps=(1e-7, 1e-6)) < 1e-5
