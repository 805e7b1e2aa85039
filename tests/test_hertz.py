"""Hertz contact against closed forms and the integral equation of the half-space."""

import numpy as np
import pytest
from scipy.integrate import quad

from contact_bodies import dished_insert, flat_insert, graded_sphere, joined
from tkamb.contact.hertz import Hertz, condyle_geometry, contact_ellipse
from tkamb.contact.materials import material
from tkamb.contact.pair import ContactPair
from tkamb.contact.result import ContactStatus
from tkamb.geometry.frames import knee_pose, pose
from tkamb.geometry.surface import Surface

LINEAR = material("polyethylene-linear")
PLANE = LINEAR.young_modulus / (1 - LINEAR.poisson_ratio**2)
RADIUS, HEIGHT = 30e-3, 10e-3


def displacement(patch, u, v):
    """Return the half-space's displacement (m) at (u, v) inside the patch.

    Boussinesq: 1/(pi E*) times the integral of p/r, in polar coordinates about the point. The
    integral of the semi-ellipsoid along a chord has a closed form.
    """
    a, b = patch.long_axis, patch.short_axis

    def chord(angle):
        c, s = np.cos(angle) / a, np.sin(angle) / b
        square, mixed = c * c + s * s, u / a * c + v / b * s
        free = 1 - (u / a) ** 2 - (v / b) ** 2
        return np.pi / 2 * (free + mixed**2 / square) / np.sqrt(square)

    integral = quad(chord, 0, np.pi, epsabs=0, epsrel=1e-11, limit=400)[0]
    return patch.peak_pressure / (np.pi * PLANE) * integral


@pytest.mark.parametrize("ratio", [1.0, 1.0001, 2.0, 17.0, 900.0])
def test_the_ellipse_satisfies_the_contact_condition(ratio):
    """delta - A u² - B v² equals the displacement at every point of the patch."""
    flat, approach = 10.0, 0.1e-3
    patch = contact_ellipse(flat, ratio * flat, approach, PLANE)
    for x, y in ((0, 0), (0.5, 0), (0, 0.7), (0.6, -0.6)):
        u, v = x * patch.long_axis, y * patch.short_axis
        expected = approach - flat * u**2 - ratio * flat * v**2
        assert displacement(patch, u, v) == pytest.approx(expected, rel=1e-7)
    volume = 2 / 3 * np.pi * patch.long_axis * patch.short_axis * patch.peak_pressure
    assert patch.force == pytest.approx(volume)


def test_a_circular_patch_is_that_of_a_sphere():
    patch = contact_ellipse(1 / (2 * RADIUS), 1 / (2 * RADIUS), 1e-4, PLANE)
    assert patch.force == pytest.approx(4 / 3 * PLANE * RADIUS**0.5 * 1e-4**1.5)
    assert patch.long_axis == pytest.approx(np.sqrt(RADIUS * 1e-4))


def sphere_force(radius, depth):
    return 4 / 3 * PLANE * np.sqrt(radius) * depth**1.5


def lowered(depth, top=HEIGHT, radius=RADIUS):
    return pose(np.eye(3), [0, top + radius - depth, 0])


def test_a_sphere_on_a_block_has_the_force_area_and_peak_of_hertz():
    """Force within 1 % of Hertz; twice the depth gives 2.83 times the force within 1 %."""
    model = Hertz()
    state = model.prepare(ContactPair(graded_sphere(RADIUS), flat_insert(HEIGHT), LINEAR))
    depths = np.array([0.05e-3, 0.1e-3, 0.2e-3, 0.4e-3])
    results = [model.evaluate(state, lowered(d)) for d in depths]
    forces = np.array([-r.wrench_on_insert[1] for r in results])
    assert np.allclose(forces[1:], sphere_force(RADIUS, depths[1:]), rtol=0.01)
    assert np.allclose(forces[2:] / forces[1:-1], 2**1.5, rtol=0.01)
    last = results[-1].medial
    assert last.area == pytest.approx(np.pi * RADIUS * 0.4e-3, rel=0.01)
    assert last.peak_pressure == pytest.approx(1.5 * last.mean_pressure, rel=1e-6)
    pressed = model.press(state, 1000.0, lowered(0))
    assert pressed.approach == pytest.approx(
        (1000 / sphere_force(RADIUS, 1.0)) ** (2 / 3), rel=0.01
    )
    assert pressed.residual < 1e-6


def test_curvature_error_shrinks_with_the_patch():
    """The relative error of the fitted curvature is (r/R)²/4, from the quartic term."""
    model = Hertz()
    state = model.prepare(ContactPair(graded_sphere(RADIUS), flat_insert(HEIGHT), LINEAR))
    radii = np.array([2e-3, 4e-3, 8e-3])
    errors = []
    for radius in radii:
        contact = condyle_geometry(state, lowered(0), radius)[0].contact
        errors.append(contact.relative.mean() * RADIUS - 1)
    growth = np.diff(errors) / np.diff((radii / RADIUS) ** 2)
    assert np.allclose(growth, 0.25, rtol=0.1)
    assert abs(errors[0]) < 2e-3


def test_an_ellipsoid_in_a_dish_has_the_force_and_peak_of_hertz():
    stretch = tuple(np.sqrt([1.2, 1.0, 1.6]))
    femoral = graded_sphere(20e-3, stretch=stretch)
    insert = dished_insert(lambda x, z: 9e-3 + x**2 / (2 * 60e-3) + z**2 / (2 * 90e-3))
    model = Hertz(patch_radius=3e-3)
    state = model.prepare(ContactPair(femoral, insert, LINEAR))
    true = np.array([1 / 24e-3 - 1 / 60e-3, 1 / 32e-3 - 1 / 90e-3])
    at = pose(np.eye(3), [0, 9e-3 + 20e-3 - 0.2e-3, 0])
    contact = condyle_geometry(state, at, 3e-3)[0].contact
    assert np.allclose(contact.relative, np.sort(true), rtol=0.02)
    assert np.allclose(contact.insert_curvature, [-1 / 90e-3, -1 / 60e-3], rtol=0.02)
    assert np.allclose(np.abs(contact.axes[0]), [0, 0, 1], atol=0.05)
    exact = contact_ellipse(true.min() / 2, true.max() / 2, 0.2e-3, PLANE)
    result = model.evaluate(state, at)
    assert result.medial.force == pytest.approx(exact.force, rel=0.015)
    assert result.medial.peak_pressure == pytest.approx(exact.peak_pressure, rel=0.015)


def test_the_map_has_the_exact_vertical_force_and_converges_to_the_peak():
    pair = ContactPair(graded_sphere(RADIUS), flat_insert(HEIGHT), LINEAR)
    peak_errors = []
    for resolution in (2e-3, 1e-3, 0.5e-3):
        model = Hertz(resolution)
        result = model.press(model.prepare(pair), 1500.0, lowered(0))
        force = (result.pressure * result.area) @ result.normals[:, 1]
        assert force == pytest.approx(1500, rel=1e-6)
        peak_errors.append(1 - result.pressure.max() / result.medial.peak_pressure)
    assert peak_errors[0] > peak_errors[1] > peak_errors[2] > 0
    assert peak_errors[2] < 0.02


def test_a_conforming_dish_is_out_of_range():
    insert = dished_insert(lambda x, z: 33e-3 - np.sqrt((25e-3) ** 2 - x**2 - z**2))
    model = Hertz()
    state = model.prepare(ContactPair(graded_sphere(26e-3), insert, LINEAR))
    result = model.press(state, 500.0, np.eye(4))
    assert result.status is ContactStatus.OUT_OF_RANGE
    assert "conforms to the insert" in " ".join(result.flags)
    assert np.isnan(result.wrench_on_insert).all()


def test_an_ellipse_past_the_rim_is_out_of_range():
    insert = flat_insert(HEIGHT, half_x=6e-3, half_z=6e-3)
    model = Hertz()
    state = model.prepare(ContactPair(graded_sphere(60e-3), insert, LINEAR))
    over_rim = pose(np.eye(3), [0, HEIGHT + 60e-3 - 1.2e-3, 0])
    result = model.evaluate(state, over_rim)
    assert result.status is ContactStatus.OUT_OF_RANGE
    assert "leaves the insert" in result.flags[0]


def test_a_patch_wider_than_the_insert_is_thick_is_flagged():
    model = Hertz()
    state = model.prepare(ContactPair(graded_sphere(60e-3), flat_insert(3e-3), LINEAR))
    result = model.evaluate(state, lowered(0.3e-3, 3e-3, 60e-3))
    assert result.status is ContactStatus.OK
    assert result.flags == (
        "the long semi-axis of the medial contact ellipse exceeds the thickness of the insert: "
        "Hertz assumes a half-space",
    )


def two_spheres():
    half_distance = 12e-3
    return joined(
        graded_sphere(20e-3, (0, 0, -half_distance)), graded_sphere(20e-3, (0, 0, half_distance))
    )


def test_two_condyles_approach_together():
    """A varus of 0.1 deg lowers the medial sphere by 24 mm sin(0.1 deg)."""
    model = Hertz()
    state = model.prepare(ContactPair(two_spheres(), flat_insert(HEIGHT, half_z=28e-3), LINEAR))
    level = model.press(state, 1500.0, np.eye(4))
    assert level.medial.force == pytest.approx(750, rel=1e-3)
    assert level.lateral.force == pytest.approx(750, rel=1e-3)
    varus = model.press(state, 1500.0, knee_pose([0, 0, 0, 0, np.radians(0.1), 0]))
    medial, lateral = (
        (side.force / sphere_force(20e-3, 1.0)) ** (2 / 3) for side in (varus.medial, varus.lateral)
    )
    assert medial - lateral == pytest.approx(24e-3 * np.sin(np.radians(0.1)), rel=0.02)
    assert varus.medial.force + varus.lateral.force == pytest.approx(1500, rel=1e-6)


def test_one_condyle_may_lift_off():
    model = Hertz()
    state = model.prepare(ContactPair(two_spheres(), flat_insert(HEIGHT, half_z=28e-3), LINEAR))
    result = model.press(state, 200.0, knee_pose([0, 0, 0, 0, np.radians(-2), 0]))
    assert result.medial is None
    assert result.lateral.force == pytest.approx(200, rel=1e-6)


def test_the_force_on_a_tilted_block_is_along_its_normal():
    """A flat top is inclined by 10 deg; the load is along y."""
    slope = np.tan(np.radians(10))
    insert = dished_insert(lambda x, z: 12e-3 + slope * x, spacing=30e-3)
    model = Hertz()
    state = model.prepare(ContactPair(graded_sphere(RADIUS), insert, LINEAR))
    result = model.press(state, 500.0, np.eye(4))
    force = result.wrench_on_insert[:3]
    assert force[1] == pytest.approx(-500, rel=1e-6)
    assert force[0] == pytest.approx(500 * slope, rel=1e-3)
    assert result.medial.force == pytest.approx(500 / np.cos(np.radians(10)), rel=1e-3)
    depth = (result.medial.force / sphere_force(RADIUS, 1.0)) ** (2 / 3)
    assert result.approach * np.cos(np.radians(10)) == pytest.approx(depth, rel=0.02)


def test_cells_on_a_slope_have_the_mean_of_the_semi_ellipsoid():
    """At 25 deg, with cells of half the patch, against a quadrature in x and z."""
    slope, size = np.tan(np.radians(25)), 2e-3
    insert = dished_insert(lambda x, z: 20e-3 + slope * x, spacing=30e-3)
    model = Hertz(size)
    state = model.prepare(ContactPair(graded_sphere(RADIUS), insert, LINEAR))
    result = model.press(state, 500.0, np.eye(4))
    ticks = ((np.arange(100) + 0.5) / 100 - 0.5) * size
    dx, dz = (grid.ravel() for grid in np.meshgrid(ticks, ticks))
    offset = result.points - result.medial.centre_of_pressure
    x, z = offset[:, :1] + dx, offset[:, 2:] + dz
    radius = np.sqrt(result.medial.area / np.pi)
    height = np.sqrt(np.maximum(1 - (x**2 * (1 + slope**2) + z**2) / radius**2, 0)).mean(axis=1)
    shares = result.pressure / result.pressure.sum()
    assert shares == pytest.approx(height / height.sum(), abs=2e-3)


def test_noise_of_the_mesh_averages_out():
    """Noise of 2 µm at vertices 0.5 mm apart changes the force by less than 5 %."""
    clean = dished_insert(lambda x, z: HEIGHT + (x**2 + z**2) / (2 * 60e-3))
    noise = np.random.default_rng(3).normal(0, 2e-6, len(clean.vertices))
    top = clean.vertices[:, 1] > 0
    rough = Surface(clean.vertices + np.outer(noise * top, [0, 1, 0]), clean.faces, "rough")
    forces = []
    for insert in (clean, rough):
        model = Hertz()
        state = model.prepare(ContactPair(graded_sphere(RADIUS), insert, LINEAR))
        at = lowered(0.2e-3)
        forces.append(model.evaluate(state, at).medial.force)
    assert forces[1] == pytest.approx(forces[0], rel=0.05)
