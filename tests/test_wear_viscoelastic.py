"""Relaxation against its closed form; a moving load on columns of springs and dampers."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq

import shapes
from tkamb.contact.foundation import LEAST_THICKNESS
from tkamb.contact.lattice.model import LinearLattice
from tkamb.contact.materials import Material
from tkamb.contact.pair import ContactPair
from tkamb.contact.samples import gaps_along_normals, sample_surface
from tkamb.errors import InputError
from tkamb.geometry.frames import pose
from tkamb.studies.wear.viscoelastic import PronySeries, ViscoelasticLattice


class ViscoelasticBed:
    """Columns of springs and dampers under a rigid femoral component, step by step.

    Each column of the bed (`tkamb.contact.samples`) has the linear foundation's pressure p = M d/h
    where M relaxes as a Prony series. A column out of contact carries nothing and recovers. Its
    strain is then the strain at zero stress. The load acts along -y.

    Limits: those of the linear elastic foundation; the bulk and the shear modulus relax alike.

    Args:
        bed: the sampled articular surface.
        femoral: the femoral component, in its own frame.
        modulus: M_0, Pa, instantaneous and confined.
        series: relaxation of the modulus.
    """

    def __init__(self, bed, femoral, modulus, series):
        self._bed, self._femoral, self._modulus, self._series = bed, femoral, modulus, series
        self._strain = np.zeros(len(bed.points))
        self._memory = np.zeros((len(series.times), len(bed.points)))

    def press(self, load, pose, step):
        """Advance by `step` s to a load (N) at a pose with free y; return the pressure (n,), Pa."""

        def excess(descent):
            result = self._pressed(pose, descent, step)[1]
            return float((result * self._bed.area) @ self._bed.normals[:, 1]) - load

        descent = brentq(excess, -5e-3, 5e-3, xtol=1e-9)
        strain, pressure = self._pressed(pose, descent, step)
        _, decay, remaining = self._series.response(step)
        self._memory = decay[:, None] * self._memory + remaining[:, None] * (strain - self._strain)
        self._strain = strain
        return pressure

    def _pressed(self, pose, descent, step):
        """Return strains and pressures (n,) after a move of the femur down by `descent` (m)."""
        moved = np.array(pose, float)
        moved[1, 3] -= descent
        gap = gaps_along_normals(self._bed, self._femoral, moved)
        imposed = -gap / np.maximum(self._bed.thickness, LEAST_THICKNESS)
        slope, decay, remaining = self._series.response(step)
        history = decay @ self._memory - remaining.sum() * self._strain
        free = -history / slope  # strain at which the stress is zero
        strain = np.maximum(imposed, free)
        return strain, self._modulus * np.maximum(slope * strain + history, 0.0)


SERIES = PronySeries((0.4, 0.3), (0.5, 20.0))


def test_a_step_of_strain_relaxes_by_the_series_with_any_time_step():
    time = np.array([0.0, 0.01, 0.3, 1.0, 30.0, 31.0, 500.0])
    result = SERIES.stress(time, np.full((len(time), 2), 0.02))
    exact = 0.02 * np.array([SERIES.relaxation(t) for t in time])
    assert result == pytest.approx(np.stack([exact, exact], axis=1), rel=1e-12)


def test_a_ramp_has_its_closed_form():
    """sigma = rate (E_inf t + sum g tau (1 - exp(-t/tau)))."""
    time = np.linspace(0.0, 40.0, 9)
    parts = zip(SERIES.fractions, SERIES.times, strict=True)
    exact = SERIES.equilibrium * time + sum(g * t * -np.expm1(-time / t) for g, t in parts)
    assert SERIES.stress(time, time) == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize(("period", "modulus"), [(1e-4, 1.0), (1e6, SERIES.equilibrium)])
def test_fast_loading_is_instantaneous_and_slow_loading_relaxed(period, modulus):
    time = np.linspace(0.0, period, 200)
    strain = np.sin(np.pi * time / period)
    assert SERIES.stress(time, strain) == pytest.approx(modulus * strain, abs=5e-3)


@pytest.mark.parametrize(
    ("fractions", "times"), [((0.5, 0.5), (1, 2)), ((-0.1,), (1,)), ((0.1,), (0,)), ((0.1,), ())]
)
def test_an_invalid_series_is_refused(fractions, times):
    with pytest.raises(InputError, match="viscoelastic"):
        PronySeries(fractions, times)


@pytest.fixture(scope="module")
def bodies():
    plate = shapes.block(lambda x, z: 0.01 + 0 * x, 0.02, 0.012, 2e-3)
    return sample_surface(plate, 1e-3), shapes.sphere(0.02, 4, (0.0, 0.03, 0.0))


def moved(bodies, speed):
    """Return the last pressures of a loaded sphere that moves 8 mm along x, in steps of 0.5 mm."""
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


def test_the_pressure_leads_the_sphere_at_medium_speeds_only(runs):
    """At the front the material is fresh and stiff, at the back it has relaxed."""
    slow, middling, fast = runs.values()
    assert middling[1] > 2e-4
    assert abs(slow[1]) < 0.02 * middling[1]
    assert abs(fast[1]) < 0.02 * middling[1]
    for _, _, force in (slow, middling, fast):
        assert force == pytest.approx(300.0, rel=1e-4)


def test_slow_motion_has_relaxed_columns_and_fast_motion_fresh_ones(bodies, runs):
    bed, femoral = bodies
    place = pose(np.eye(3), [4e-3, 0, 0])
    for name, modulus in (("slow", 0.4 * 2e9), ("fast", 2e9)):
        elastic = ViscoelasticBed(bed, femoral, modulus, PronySeries((1e-9,), (1.0,)))
        expected = elastic.press(300.0, place, 1.0)
        peak = expected.max()
        assert np.abs(runs[name][0] - expected).max() < 5e-3 * peak


PAIR_SERIES = PronySeries((0.4, 0.2), (1.0, 20.0))


def bonded(top, resolution=2e-3, modulus=500e6):
    """Return a block of 10 mm on the lattice, bonded at its bottom, under a rigid body."""
    plate = shapes.block(lambda x, z: 0.01 + 0 * x, 0.02, 0.012, 2e-3)
    polymer = Material("m", modulus, 0.46)
    pair = ContactPair(top, plate, polymer, "fixed")
    return LinearLattice(resolution=resolution, cache=False), pair


@pytest.fixture(scope="module")
def flat():
    """Return a rigid plate that covers the block."""
    box = shapes.block(lambda x, z: 0.02 + 0 * x, 0.03, 0.02, 5e-3)
    return bonded(box)


def held_at(depth):
    return pose(np.eye(3), [0, 0.01 - depth, 0])


def test_a_bonded_block_under_a_flat_plate_relaxes_by_the_series(flat):
    """After a step of displacement the force falls as M(t), with any time step."""
    block = ViscoelasticLattice(*flat, PAIR_SERIES)
    first = -block.hold(held_at(0.1e-3), 1e-6).force[:, 1].sum()
    time = 0.0
    for step in (0.3, 0.7, 4.0, 15.0, 300.0):
        time += step
        result = -block.hold(held_at(0.1e-3), step).force[:, 1].sum()
        assert result / first == pytest.approx(PAIR_SERIES.relaxation(time), rel=1e-4)
    assert first == pytest.approx(-elastic(flat, held_at(0.1e-3)).nodal_force[:, 1].sum(), rel=1e-4)


def elastic(model_and_pair, place, share=1.0, load=None):
    model, pair = model_and_pair
    softer = replace(pair.material, young_modulus=share * pair.material.young_modulus)
    state = model.prepare(replace(pair, material=softer))
    return model.evaluate(state, place) if load is None else model.press(state, load, place)


def test_a_bonded_block_under_a_constant_load_creeps_by_the_reciprocal_of_the_series(flat):
    """One branch: J(t) M_0 = (1 - g exp(-t (1 - g)/tau))/(1 - g), Findley et al. 1976."""
    g, tau = 0.6, 1.0
    block = ViscoelasticLattice(*flat, PronySeries((g,), (tau,)))
    place, time = held_at(0.0), 0.0
    first = block.press(500.0, place, 1e-6).displacement[:, 1].mean()
    for step in np.full(20, 0.1):
        time += step
        result = block.press(500.0, place, step)
        exact = (1.0 - g * np.exp(-time * (1.0 - g) / tau)) / (1.0 - g)
        assert result.displacement[:, 1].mean() / first == pytest.approx(exact, rel=5e-3)
        assert -result.force[:, 1].sum() == pytest.approx(500.0, rel=1e-6)


def test_the_unloaded_block_recovers_its_shape(flat):
    block = ViscoelasticLattice(*flat, PAIR_SERIES)
    block.hold(held_at(0.1e-3), 50.0)
    released = block.hold(held_at(-1e-3), 1e-6)
    assert not released.force.any()
    assert released.displacement[:, 1].min() < -1e-5
    assert np.abs(block.hold(held_at(-1e-3), 1e4).displacement).max() < 1e-7


@pytest.fixture(scope="module")
def ball():
    return bonded(shapes.sphere(0.02, 4, (0.0, 0.03, 0.0)))


@pytest.fixture(scope="module")
def rolled(ball):
    return {name: moved_on_lattice(ball, speed) for name, speed in SPEEDS.items()}


def moved_on_lattice(model_and_pair, speed):
    """Return last pressures and lead of a loaded sphere that moves 4 mm along x, in steps of 0.5
    mm.
    """
    block = ViscoelasticLattice(*model_and_pair, PronySeries((0.6,), (1.0,)))
    for place in np.arange(-2e-3, 2.1e-3, 5e-4):
        result = block.press(200.0, pose(np.eye(3), [place, 0, 0]), 5e-4 / speed)
    force = -result.force[:, 1]
    lead = float(force @ block.points[:, 0] / force.sum()) - place
    return result, lead, force.sum()


def test_slow_motion_is_on_the_relaxed_lattice_and_fast_motion_on_the_fresh_one(ball, rolled):
    place = pose(np.eye(3), [2e-3, 0, 0])
    for name, share in (("slow", 0.4), ("fast", 1.0)):
        expected = elastic(ball, place, share, 200.0)
        result, _, force = rolled[name]
        assert force == pytest.approx(200.0, rel=1e-6)
        peak = expected.pressure.max()
        assert np.abs(result.pressure - expected.pressure).max() < 5e-3 * peak
        assert result.pose[1, 3] == pytest.approx(expected.pose[1, 3], abs=5e-3 * 1e-4)


def test_the_height_of_the_pose_is_only_an_initial_guess(ball):
    result = []
    for height in (1e-3, 0.0, -0.5e-3):
        block = ViscoelasticLattice(*ball, PAIR_SERIES)
        result.append(block.press(200.0, pose(np.eye(3), [0, height, 0]), 0.1))
    for other in result[1:]:
        assert np.abs(other.pressure - result[0].pressure).max() < 1e-6 * result[0].pressure.max()
        assert other.pose[1, 3] == pytest.approx(result[0].pose[1, 3], abs=1e-10)


def test_on_the_lattice_the_pressure_leads_at_medium_speeds_only(rolled):
    slow, middling, fast = (lead for _, lead, _ in rolled.values())
    assert middling > 1e-4
    assert middling > 20 * max(abs(slow - fast), 1e-9)


def test_a_time_step_of_zero_and_a_sphere_beside_the_block_are_refused(ball):
    block = ViscoelasticLattice(*ball, PAIR_SERIES)
    with pytest.raises(InputError, match="a step of 0 s"):
        block.press(100.0, np.eye(4), 0.0)
    with pytest.raises(InputError, match="does not lie over"):
        block.press(100.0, pose(np.eye(3), [0.2, 0, 0]), 1.0)
