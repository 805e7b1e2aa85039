"""Pressure at the outline of a map: the force of a node over its tributary area.

A bearing that slides without friction under a flat plate is in uniform uniaxial stress. The
pressure is therefore force over area at every node, also at corners and along any outline.
"""

from itertools import product

import numpy as np
import pytest

from tkamb.contact.lattice.meshing.contact_map import (
    consistent_areas,
    contact_map,
    contact_squares,
)
from tkamb.contact.lattice.meshing.grid import build_grid
from tkamb.contact.materials import material
from tkamb.contact.pair import ContactPair
from tkamb.contact.registry import contact_model
from tkamb.geometry.surface import Surface

LINEAR = material("polyethylene-linear")
MM = 1e-3


def turned(outline, degrees):
    angle = np.radians(degrees)
    return outline @ np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])


def rectangle(half_x, half_z):
    return np.array([[-half_x, -half_z], [half_x, -half_z], [half_x, half_z], [-half_x, half_z]])


def arc(radius, first, last, corners):
    angle = np.radians(np.linspace(first, last, corners))
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def area_of(outline):
    """Return the area of a polygon by the shoelace formula."""
    x, z = outline.T
    return 0.5 * float(x @ np.roll(z, -1) - z @ np.roll(x, -1))


OUTLINES = {
    "disc": arc(15.0, 0, 357, 120),
    "D": arc(16.0, -113.2, 113.2, 90),
    "turned square": turned(rectangle(9.0, 9.0), 30.0),
    "turned rectangle": turned(rectangle(12.0, 8.0), 17.0),
    "square at 45 deg": turned(rectangle(9.0, 9.0), 45.0),
    "rectangle at 60 deg": turned(rectangle(12.0, 8.0), 60.0),
    "triangle": arc(14.0, 90, 330, 3),
    "turned triangle": turned(arc(14.0, 90, 330, 3), 15.0),
    "hexagon": arc(12.0, 0, 300, 6),
    "box": rectangle(10.3, 7.7),
}
"""Convex outlines (n, 2), x and z in mm, counter-clockwise."""
AT_TWO_SIZES = ("disc", "D", "turned square", "turned rectangle", "hexagon", "box")


def extruded(outline, height=8.0, bottom=0.0):
    """Return a plate with a convex outline; its underside is at y = bottom (mm)."""
    n = len(outline)
    low, high = (np.insert(outline, 1, y, axis=1) for y in (bottom, bottom + height))
    fan = np.stack([np.zeros(n - 2, int), np.arange(1, n - 1), np.arange(2, n)], axis=1)
    start, after = np.arange(n), np.roll(np.arange(n), -1)
    walls = [np.stack([start, start + n, after], 1), np.stack([after, start + n, after + n], 1)]
    faces = np.concatenate([fan, fan[:, ::-1] + n, *walls])
    return Surface(np.concatenate([low, high]) * MM, faces, "plate")


@pytest.fixture(scope="module")
def cover():
    return extruded(rectangle(40, 40), bottom=8.0)


def pressures(outline, cover, name, size):
    insert = extruded(outline)
    assert insert.mesh.volume > 0
    pair = ContactPair(cover, insert, LINEAR, "mobile")
    model = contact_model(
        name, resolution=size * 1e-3, **({} if name == "foundation-linear" else {"cache": False})
    )
    result = model.press(model.prepare(pair), 1500.0, np.eye(4))
    return result, 1500.0 / (area_of(outline) * MM**2)


@pytest.mark.parametrize(
    ("shape", "size"),
    [*product(AT_TWO_SIZES, (1.0, 2.0)), *product(sorted(OUTLINES.keys() - AT_TWO_SIZES), (1.5,))],
)
def test_a_sliding_plate_has_a_uniform_pressure(shape, size, cover):
    result, exact = pressures(OUTLINES[shape], cover, "lattice-linear", size)
    assert result.medial.area == pytest.approx(area_of(OUTLINES[shape]) * MM**2, rel=0.012)
    assert result.pressure == pytest.approx(exact, rel=0.012)
    assert np.ptp(result.pressure) < 2e-3 * exact


@pytest.mark.parametrize("name", ["lattice", "fe", "foundation-linear"])
@pytest.mark.parametrize("shape", ["disc", "D", "turned rectangle"])
def test_every_model_has_a_uniform_pressure(shape, name, cover):
    result, exact = pressures(OUTLINES[shape], cover, name, 2.0)
    assert result.pressure == pytest.approx(exact, rel=0.02)


@pytest.mark.parametrize(("half", "size"), [(9.0, 1.0), (9.0, 1.5), (10.0, 1.5)])
def test_all_layers_of_an_upright_plate_have_one_outline(half, size):
    """Nodes lie half a cell from a wall, where rounding must decide alike in each layer."""
    lattice = build_grid(extruded(turned(rectangle(half, half), 45.0)), size * MM)
    layer = lattice.index[lattice.cells[:, 0], 1]
    columns = [
        {tuple(c) for c in lattice.index[lattice.cells[layer == level, 0]][:, [0, 2]]}
        for level in range(layer.max() + 1)
    ]
    assert all(each == columns[0] for each in columns)


@pytest.mark.parametrize("name", ["lattice-linear", "fe"])
def test_equal_forces_at_the_corners_of_a_face_give_one_pressure(name, cover):
    result, exact = pressures(rectangle(1, 1), cover, name, 2.0)
    assert result.pressure == pytest.approx(exact, rel=0.02)


def test_the_area_of_a_node_is_the_consistent_tributary_area():
    """A square gives each corner a quarter. For a distorted face it is an integral."""
    points = np.array([[0, 0, 0], [0, 0, 2], [2, 0, 2], [2, 0, 0]], float)
    assert consistent_areas(points, np.array([[0, 1, 2, 3]])) == pytest.approx(1.0)
    distorted = points.copy()
    distorted[2] = [1, 0, 1]  # on the line between its neighbours
    areas = consistent_areas(distorted, np.array([[0, 1, 2, 3]]))
    assert areas.sum() == pytest.approx(2.0)
    assert areas == pytest.approx([2 / 3, 1 / 2, 1 / 3, 1 / 2])


def test_every_upper_face_of_a_plate_is_a_contact_face():
    lattice = build_grid(extruded(OUTLINES["disc"]), 2 * MM)
    upper = lattice.cells[:, [2, 3, 7, 6]]
    upper = upper[(lattice.nodes[upper][..., 1] > 8 * MM - 1e-6).all(axis=1)]
    squares = contact_squares(lattice.contact_triangles)
    assert {tuple(sorted(s)) for s in upper} == {tuple(sorted(s)) for s in squares}
    _, surface = contact_map(lattice, extruded(OUTLINES["disc"]))
    assert surface.area.sum() == pytest.approx(surface.triangle_area.sum(), rel=1e-9)
