"""Relaxation against its closed form; a moving load on columns of springs and dampers."""

import numpy as np
import pytest

import shapes
from tkamb.contact.samples import sample_surface
from tkamb.errors import InputError
from tkamb.geometry.frames import pose
from tkamb.wear.viscoelastic import PronySeries, ViscoelasticBed

SERIES = PronySeries((0.4, 0.3), (0.5, 20.0))


def test_a_step_of_strain_relaxes_by_the_series_whatever_the_steps():
    time = np.array([0.0, 0.01, 0.3, 1.0, 30.0, 31.0, 500.0])
    found = SERIES.stress(time, np.full((len(time), 2), 0.02))
    exact = 0.02 * np.array([SERIES.relaxation(t) for t in time])
    assert found == pytest.approx(np.stack([exact, exact], axis=1), rel=1e-12)


def test_a_ramp_has_its_closed_form():
    """sigma = rate (E_inf t + sum g tau (1 - exp(-t/tau)))."""
    time = np.linspace(0.0, 40.0, 9)
    parts = zip(SERIES.fractions, SERIES.times, strict=True)
    exact = SERIES.equilibrium * time + sum(g * t * -np.expm1(-time / t) for g, t in parts)
    assert SERIES.stress(time, time) == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize(("period", "modulus"), [(1e-4, 1.0), (1e6, SERIES.equilibrium)])
def test_fast_is_instantaneous_and_slow_is_in_equilibrium(period, modulus):
    time = np.linspace(0.0, period, 200)
    strain = np.sin(np.pi * time / period)
    assert SERIES.stress(time, strain) == pytest.approx(modulus * strain, abs=5e-3)


@pytest.mark.parametrize(
    ("fractions", "times"), [((0.5, 0.5), (1, 2)), ((-0.1,), (1,)), ((0.1,), (0,)), ((0.1,), ())]
)
def test_what_is_no_series_is_refused(fractions, times):
    with pytest.raises(InputError, match="viscoelastic"):
        PronySeries(fractions, times)


@pytest.fixture(scope="module")
def bodies():
    plate = shapes.block(lambda x, z: 0.01 + 0 * x, 0.02, 0.012, 2e-3)
    return sample_surface(plate, 1e-3), shapes.sphere(0.02, 4, (0.0, 0.03, 0.0))


def moved(bodies, speed):
    """Move a loaded ball 8 mm along x, in steps of half a millimetre; the last pressures."""
    bed, femoral = bodies
    columns = ViscoelasticBed(bed, femoral, 2e9, PronySeries((0.6,), (1.0,)))
    for place in np.arange(-4e-3, 4.1e-3, 5e-4):
        pressure = columns.press(300.0, pose(np.eye(3), [place, 0, 0]), 5e-4 / speed)
    force = pressure * bed.area
    return pressure, float(force @ bed.points[:, 0] / force.sum()) - place, force.sum()


SPEEDS = {"slow": 1e-6, "middling": 3e-3, "fast": 10.0}


@pytest.fixture(scope="module")
def runs(bodies):
    return {name: moved(bodies, speed) for name, speed in SPEEDS.items()}


def test_a_moving_load_is_carried_ahead_of_its_middle_and_only_at_middling_speeds(runs):
    """The front is fresh and stiff, the back has relaxed: the pressure leads the ball."""
    slow, middling, fast = runs.values()
    assert middling[1] > 2e-4
    assert abs(slow[1]) < 0.02 * middling[1]
    assert abs(fast[1]) < 0.02 * middling[1]
    for _, _, force in (slow, middling, fast):
        assert force == pytest.approx(300.0, rel=1e-4)


def test_slow_presses_like_the_relaxed_columns_and_fast_like_the_fresh_ones(bodies, runs):
    bed, femoral = bodies
    place = pose(np.eye(3), [4e-3, 0, 0])
    for name, modulus in (("slow", 0.4 * 2e9), ("fast", 2e9)):
        elastic = ViscoelasticBed(bed, femoral, modulus, PronySeries((1e-9,), (1.0,)))
        expected = elastic.press(300.0, place, 1.0)
        peak = expected.max()
        assert np.abs(runs[name][0] - expected).max() < 0.02 * peak
