"""Columns of the foundation: walls and voids in the insert, and contact narrower than a column."""

import numpy as np
import pytest
import trimesh

from contact_bodies import flat_insert, graded_sphere, joined
from tkamb.contact.foundation import ElasticFoundation, LinearFoundation
from tkamb.contact.materials import material
from tkamb.contact.pair import ContactPair
from tkamb.contact.samples import sample_surface
from tkamb.geometry.frames import pose
from tkamb.geometry.surface import Surface

LINEAR = material("polyethylene-linear")
M = LINEAR.confined_modulus
MM = 1e-3
OFFSETS = [(0, 0), (0.5, 0.5), (0.5, 0), (0.25, 0.25), (0.13, 0.37)]


def box(low, high, turn_out=True):
    """Return a box of 30 x 30 mm, or a void of 8 x 8 mm, between y = low and high (mm)."""
    mesh = (
        trimesh.creation.box((30, high - low, 30))
        if turn_out
        else trimesh.creation.box((8, high - low, 8))
    )
    mesh.apply_translation((0, (low + high) / 2, 0))
    faces = np.asarray(mesh.faces, np.int64)
    return Surface(np.asarray(mesh.vertices) * MM, faces if turn_out else faces[:, ::-1], "insert")


def meshed(surface, times):
    mesh = surface.mesh
    for _ in range(times):
        mesh = mesh.subdivide()
    return Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64), "insert")


SOLID = box(0, 10)
INSERTS = {
    "two layers": joined(box(0, 4), box(4, 10)),
    "two layers, the wall meshed in two ways": joined(box(0, 4), meshed(box(4, 10), 2)),
    "three layers": joined(box(0, 3), box(3, 5), box(5, 10)),
    "a closed void": joined(SOLID, box(2, 5, turn_out=False)),
    "a hollow under the top": joined(SOLID, box(1, 8, turn_out=False)),
}


@pytest.mark.parametrize("name", INSERTS)
def test_a_column_ends_where_it_finally_leaves_the_insert(name):
    bed = sample_surface(INSERTS[name], 1 * MM)
    assert bed.thickness == pytest.approx(10 * MM)
    if "layers" in name:
        assert bed.depth == pytest.approx(10 * MM, abs=5e-6)


@pytest.mark.parametrize("name", INSERTS)
@pytest.mark.parametrize("model", [LinearFoundation, ElasticFoundation])
def test_walls_and_voids_do_not_change_the_pressure(name, model):
    result, solid = (
        model(1 * MM).press(
            model(1 * MM).prepare(ContactPair(graded_sphere(30 * MM), insert, LINEAR)),
            800.0,
            np.eye(4),
        )
        for insert in (INSERTS[name], SOLID)
    )
    assert result.medial.peak_pressure == pytest.approx(solid.medial.peak_pressure, rel=1e-6)
    assert result.approach == pytest.approx(solid.approach, rel=1e-6)


def narrow(result):
    return any("too narrow for the columns" in flag for flag in result.flags)


@pytest.mark.parametrize("size", [1.0, 2.0])
def test_the_peak_of_a_sphere_is_correct_or_flagged(size):
    """Radius 22 mm on 10 mm, 1 to 5000 N: force = M/h times the volume of the cap."""
    radius, height = 22 * MM, 10 * MM
    model = LinearFoundation(size * MM)
    insert = flat_insert(height, half_x=20 * MM, half_z=20 * MM)
    state = model.prepare(ContactPair(graded_sphere(radius), insert, LINEAR))
    peaks = []
    for load in (1.0, 10.0, 60.0, 200.0, 800.0, 1500.0, 5000.0):
        depths = np.linspace(0, 3 * MM, 300001)
        force = M / height * np.pi * depths**2 * (radius - depths / 3)
        exact = M / height * np.interp(load, force, depths)
        for x, z in np.array(OFFSETS) * size * MM:
            result = model.press(state, load, pose(np.eye(3), [x, 0, z]))
            peaks.append((narrow(result), result.medial.peak_pressure / exact - 1))
    flagged, error = (np.array(column) for column in zip(*peaks, strict=True))
    assert np.abs(error[~flagged]).max() < 0.08
    assert error[flagged].min() < -0.5
    assert 0.2 < flagged.mean() < 0.95


@pytest.mark.parametrize("degrees", [20.0, 30.0, 45.0])
def test_the_peak_of_a_tilted_block_is_correct_or_flagged(degrees):
    """A wedge of 90 deg presses a strip: force = M/h times its cross-section times its length."""
    brick = trimesh.creation.box((30, 30, 30))
    turn = trimesh.transformations.rotation_matrix(np.radians(degrees), [1, 0, 0])
    brick.apply_transform(turn)
    femoral = Surface(np.asarray(brick.vertices) * MM, np.asarray(brick.faces, np.int64), "brick")
    model = LinearFoundation(1 * MM)
    insert = flat_insert(12 * MM, half_x=20 * MM, half_z=30 * MM)
    result = model.press(model.prepare(ContactPair(femoral, insert, LINEAR)), 1000.0, np.eye(4))
    steep = 1 / np.tan(np.radians(degrees)) + np.tan(np.radians(degrees))
    depth = np.sqrt(1000.0 * 12 * MM / M / 30 / MM * 2 / steep)
    exact = M * depth / (12 * MM)
    assert narrow(result) or result.medial.peak_pressure == pytest.approx(exact, rel=0.08)
