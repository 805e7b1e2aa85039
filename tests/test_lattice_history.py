"""Results of the lattice depend on pose and load, and not on the initial guess."""

from dataclasses import replace
from functools import lru_cache
from itertools import product

import numpy as np
import pytest

from scenes import MODEL
from tkamb.contact.area import area_above
from tkamb.contact.materials import material
from tkamb.contact.pair import ContactPair
from tkamb.contact.registry import contact_model
from tkamb.contact.result import WarmStart, medial_points
from tkamb.geometry.frames import knee_pose
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case

FRAMES, FAR = (12, 36, 84), 60
LOADS = {11: 700.0, 12: 750.0, 35: 1400.0, 36: 1450.0, 60: 2000.0, 83: 2150.0, 84: 2200.0}
"""Frame -> load, N."""


@lru_cache
def shipped():
    """Return the bodies and the poses of the shipped knee."""
    case = load_case(load_scene(MODEL / "scene.toml"))
    bodies = ContactPair(case.femoral, case.insert, material("polyethylene"))
    return bodies, [knee_pose(place) for place in case.motion.coordinates]


@lru_cache
def prepared(name):
    """Return a model with cells of 2 mm, prepared for the shipped knee."""
    model = contact_model(name, resolution=2e-3)
    return model, model.prepare(shipped()[0])


def too_deep(state, result, factor):
    """Return a result with an approach that is too large by a factor, as a guess."""
    pose = state.pair.pose_at_approach(result.pose, factor * result.approach)
    return replace(result, pose=pose)


def columns(state, result):
    """Return the columns of a results table for a contact."""
    medial = medial_points(result.points, result.pose, state.pair.split)
    row = {"approach": result.approach, "lowest gap": result.gap[result.pressure == 0].min()}
    for side, under_side in (("medial", medial), ("lateral", ~medial)):
        condyle = getattr(result, side)
        side_pressure = np.where(under_side, result.pressure, 0.0)
        row |= {
            f"{side} force": condyle.force,
            f"{side} area": condyle.area,
            f"{side} mean pressure": condyle.mean_pressure,
            f"{side} peak pressure": condyle.peak_pressure,
            f"{side} area above": area_above(result.points, state.triangles, side_pressure, 10e6),
            f"{side} centre x": condyle.centre_of_pressure[0] + 1.0,
            f"{side} centre z": condyle.centre_of_pressure[2] + 1.0,
        }
    return row


@pytest.mark.parametrize("name", ["lattice", "lattice-linear", "fe"])
@pytest.mark.parametrize("frame", FRAMES)
def test_results_do_not_depend_on_the_guess(name, frame):
    """Without a guess, and with guesses from the last frame, a far frame, and a stored frame.

    Centres of pressure agree within 5 µm, other values within 0.5 %.
    """
    (model, state), (_, poses) = prepared(name), shipped()
    cold = model.press(state, LOADS[frame], poses[frame])
    expected = columns(state, cold)
    before, start = model.press_from(state, LOADS[frame - 1], poses[frame - 1])
    far, far_start = model.press_from(state, LOADS[FAR], poses[FAR])
    for guess in (start, far_start, before, WarmStart.after(before), too_deep(state, far, 3.0)):
        result = columns(state, model.press(state, LOADS[frame], poses[frame], guess))
        for key, value in result.items():
            near = {"abs": 5e-6} if "centre" in key else {"rel": 5e-3, "abs": 2e-7}
            assert value == pytest.approx(expected[key], **near), key


def test_the_gap_beside_the_contact_is_that_of_the_deformed_insert():
    """The gaps with few candidates and with all candidates agree."""
    (model, state), (_, poses) = prepared("lattice-linear"), shipped()
    few = model.press(state, 2000.0, poses[84])
    many = model.press(state, 2000.0, poses[84], too_deep(state, few, 20.0))
    assert few.gap == pytest.approx(many.gap, rel=5e-3, abs=2e-7)
    assert (few.gap >= 0).all()


def grid(size):
    """Return x and z of a square grid about the unit circle, and its triangles."""
    ticks = np.arange(-round(2 / size), round(2 / size) + 1) * size
    x, z = (values.ravel() for values in np.meshgrid(ticks, ticks, indexing="ij"))
    number = np.arange(x.size).reshape(len(ticks), -1)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    halves = [np.stack(corners, axis=-1).reshape(-1, 3) for corners in ((a, b, c), (a, c, d))]
    return x, z, np.concatenate(halves)


def share_above(level, size, along, across):
    """Return the area above a level of Hertz's pressure, as a share of the circle."""
    x, z, triangles = grid(size)
    pressure = np.sqrt(np.maximum(1.0 - (x - along) ** 2 - (z - across) ** 2, 0.0))
    return area_above(np.stack([x, 0 * x, z], axis=1), triangles, pressure, level) / np.pi


@pytest.mark.parametrize("level", [0.3, 0.6, 0.9])
def test_area_above_a_level_is_that_of_hertz(level):
    """1 - (level / p0)² of the circle, within 3 % for cells of a fifth of the radius."""
    for size in (0.2, 0.1, 0.05):
        result = share_above(level, size, 0.07, 0.03)
        assert result == pytest.approx(1 - level**2, abs=0.7 * size**2 + 1e-3)


@pytest.mark.parametrize("level", [0.7, 0.9])
def test_area_above_a_level_is_exact_in_the_mean(level):
    """The mean error over all positions of the grid vanishes, because Hertz's p² is quadratic."""
    shifts = np.arange(8) / 8 * 0.1
    errors = [
        share_above(level, 0.1, along, across) - (1 - level**2)
        for along, across in product(shifts, shifts)
    ]
    assert np.mean(errors) == pytest.approx(0.0, abs=2e-5)


def test_area_above_a_level_is_continuous():
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1], [1, 0, 1.0]])
    triangles = np.array([[0, 1, 2], [1, 2, 3]])
    pressure = np.array([1.0, 2.0, 3.0, 4.0])
    levels = np.linspace(0.5, 4.5, 401)
    areas = [area_above(points, triangles, pressure, level) for level in levels]
    assert areas[0] == pytest.approx(1.0)
    assert areas[-1] == 0.0
    assert np.abs(np.diff(areas)).max() < 0.012
