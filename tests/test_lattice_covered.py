"""Small contacts on the lattice: their area between the nodes, and the flag of narrow ones."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from lattice_bodies import above, box_insert, pair, plate, sphere_cap
from layer_contact import sphere_on_layer
from tkamb.contact.area import covered_areas
from tkamb.contact.materials import material
from tkamb.contact.registry import contact_model
from tkamb.geometry.surface import Surface

LINEAR = material("polyethylene-linear")
RADIUS, A = 22e-3, 2.5e-3
OFFSETS = [(0, 0), (0.5, 0.5), (0.5, 0), (0.25, 0.25), (0.13, 0.37), (0.4, 0.1)]


def sheet(size, half=12):
    """Return nodes of a level square grid, its triangles and their areas."""
    ticks = size * np.arange(-half, half + 1)
    x, z = (g.ravel() for g in np.meshgrid(ticks, ticks, indexing="ij"))
    number = np.arange(x.size).reshape(2 * half + 1, -1)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    triangles = np.concatenate(
        [np.stack(corners, axis=-1).reshape(-1, 3) for corners in ((a, b, c), (a, c, d))]
    )
    points = np.stack([x, 0 * x, z], axis=1)
    return points, triangles, np.full(len(triangles), 0.5 * size**2)


def hertz(r):
    """Return pressure and gap at the radius r of a rigid sphere, with the contact radius A."""
    modulus = LINEAR.young_modulus / (1 - LINEAR.poisson_ratio**2)
    p0 = 2 * A * modulus / (np.pi * RADIUS)
    outer = np.maximum(r, A)
    displacement = (2 * A**2 - outer**2) * np.arcsin(A / outer) + A * np.sqrt(outer**2 - A**2)
    gap = p0 / (2 * A * modulus) * displacement - A**2 / RADIUS + outer**2 / (2 * RADIUS)
    return p0 * np.sqrt(np.maximum(1 - r**2 / A**2, 0)), np.where(r < A, 0.0, gap)


def area_error(size, offset):
    points, triangles, area = sheet(size, int(4e-3 / size) + 2)
    r = np.hypot(points[:, 0] - offset[0] * size, points[:, 2] - offset[1] * size)
    return covered_areas(points, triangles, area, *hertz(r), LINEAR).sum() / (np.pi * A**2) - 1


def test_exact_nodal_values_give_the_area_of_the_circle():
    """Errors remain: a polygon replaces the circle, and the edge's law is asymptotic."""
    sizes = np.array([1e-3, 0.5e-3, 0.25e-3, 0.125e-3])
    errors = np.array([[area_error(size, offset) for offset in OFFSETS] for size in sizes])
    rms = np.sqrt((errors**2).mean(axis=1))
    assert np.abs(errors[0]).max() < 0.03
    assert rms[-1] < 0.004
    assert np.polyfit(np.log(sizes), np.log(rms), 1)[0] > 0.6


@pytest.mark.parametrize(("size", "worst"), [(1.0, 0.06), (2.0, 0.08)])
@pytest.mark.parametrize("nu", [0.3, 0.45, 0.4999])
def test_the_contact_area_of_a_sphere_is_accurate(size, worst, nu):
    """500 N. The sum of tributary areas would be 20 and 40 % too large."""
    body = replace(LINEAR, poisson_ratio=nu)
    model = contact_model("lattice-linear", resolution=size * 1e-3)
    state = model.prepare(pair(sphere_cap(RADIUS), box_insert(16e-3, 8e-3, 16e-3), body))
    a, *_ = sphere_on_layer(RADIUS, 8e-3, 500.0, body.young_modulus, nu)
    result = [model.press(state, 500.0, above(*(np.array(o) * size * 1e-3))) for o in OFFSETS]
    area = np.array([f.medial.area for f in result]) / (np.pi * a**2)
    tributary = np.array([f.area[f.pressure > 0].sum() for f in result]) / (np.pi * a**2)
    assert abs(area.mean() - 1) < worst
    assert area.std() < 0.06
    assert tributary.mean() > 1.15
    assert result[0].medial.mean_pressure == pytest.approx(
        result[0].medial.force / result[0].medial.area
    )


@pytest.mark.parametrize("name", ["lattice", "lattice-linear", "fe"])
@pytest.mark.parametrize("load", [1e-3, 1.0, 50.0])
def test_the_mean_pressure_is_never_above_the_peak(name, load):
    """The contact is smaller than a cell, so that its area cannot be resolved."""
    model = contact_model(name, resolution=2e-3)
    state = model.prepare(
        pair(sphere_cap(RADIUS), box_insert(16e-3, 8e-3, 16e-3), material("polyethylene"))
    )
    for x in (0.0, 1e-3, 0.6e-3):
        condyle = model.press(state, load, above(x, 0.3e-3)).medial
        assert 0 < condyle.mean_pressure <= condyle.peak_pressure * (1 + 1e-12)


def test_the_contact_of_a_sharp_punch_ends_half_way_between_nodes():
    """A punch of 8 x 8 mm with edges between the nodes; the gap jumps at the edge."""
    model = contact_model("lattice-linear", resolution=1e-3)
    state = model.prepare(pair(plate(8e-3, 8e-3), box_insert(16e-3, 6e-3, 16e-3), LINEAR))
    result = model.press(state, 500.0, above(0.5e-3, 0.5e-3))
    assert result.medial.area == pytest.approx(64e-6, rel=0.02)


def test_contact_up_to_the_rim_has_the_whole_area():
    model = contact_model("lattice-linear", resolution=1e-3)
    state = model.prepare(pair(plate(20e-3, 20e-3), box_insert(12e-3, 3e-3, 12e-3), LINEAR))
    assert model.press(state, 1000.0, above()).medial.area == pytest.approx(144e-6, rel=1e-9)


def narrow(result):
    return bool([flag for flag in result.flags if "too narrow for the cells" in flag])


@pytest.mark.parametrize(
    ("name", "size"),
    [
        ("lattice-linear", 1.0),
        ("lattice-linear", 2.0),
        ("fe", 2.0),
        pytest.param("fe", 1.0, marks=pytest.mark.slow),
    ],
)
def test_a_contact_is_flagged_as_narrow_or_has_an_accurate_peak(name, size):
    model = contact_model(name, resolution=size * 1e-3)
    state = model.prepare(pair(sphere_cap(RADIUS), box_insert(16e-3, 8e-3, 16e-3), LINEAR))
    peaks = []
    for load in (1.0, 50.0, 200.0, 300.0, 500.0, 3000.0):
        *_, exact = sphere_on_layer(RADIUS, 8e-3, load, LINEAR.young_modulus, LINEAR.poisson_ratio)
        for x, z in np.array(OFFSETS) * size * 1e-3:
            result = model.press(state, load, above(x, z))
            peaks.append((narrow(result), result.medial.peak_pressure / exact[0] - 1))
    flagged, error = (np.array(column) for column in zip(*peaks, strict=True))
    assert np.abs(error[~flagged]).max() < 0.08
    assert error[flagged].max() < 0.05
    assert error[flagged].min() < -0.8


def test_a_line_contact_is_flagged_at_any_length():
    """A cylinder along x touches one or two rows of nodes."""
    body = trimesh.creation.cylinder(radius=8e-3, height=40e-3, sections=720)
    body.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0]))
    cylinder = Surface(np.array(body.vertices), np.array(body.faces, np.int64), "cylinder")
    insert = box_insert(16e-3, 6e-3, 12e-3)
    coarse, fine = (contact_model("lattice-linear", resolution=size * 1e-3) for size in (1.0, 0.5))
    state, exact = (model.prepare(pair(cylinder, insert, LINEAR)) for model in (coarse, fine))
    for load, z in ((150.0, 0.0), (150.0, 0.5e-3), (1500.0, 0.0), (3000.0, 0.5e-3)):
        result = coarse.press(state, load, above(0, z))
        peak = np.mean([fine.press(exact, load, above(0, y)).pressure.max() for y in (0, 0.25e-3)])
        assert (result.pressure > 0).sum() >= 16
        assert narrow(result) == (load < 1000)
        assert narrow(result) or result.pressure.max() == pytest.approx(peak, rel=0.1)
