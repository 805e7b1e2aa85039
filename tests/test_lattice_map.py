"""The contact surface of the lattice: thickness under its nodes, smooth surface above them."""

import numpy as np

from tkamb.contact.lattice.meshing.contact_map import contact_map
from tkamb.contact.lattice.meshing.grid import build_grid
from tkamb.studies.cases import block, dishes, flat

RADIUS, THICK = 34e-3, 8e-3


def test_the_smooth_surface_is_the_dish_of_the_facets():
    """Facets of 2 mm in a dish of 34 mm radius have errors of up to 2²/8 / 34 mm = 15 µm."""
    insert = block(dishes(THICK, RADIUS, 0.0), (20e-3, 20e-3), 2e-3)
    _, surface = contact_map(build_grid(insert, 1.3e-3), insert)
    radius = np.hypot(surface.points[:, 0], surface.points[:, 2])
    inner = radius < 7e-3
    exact = THICK + radius[inner] ** 2 / (2 * RADIUS)
    faceted = surface.points[inner, 1] - exact
    smooth = faceted + surface.lift[inner]
    assert np.abs(faceted).max() > 8e-6
    assert np.abs(smooth).max() < 2e-6


def test_thickness_is_the_height_over_the_flat_bottom():
    insert = block(flat(THICK), (20e-3, 20e-3), 2e-3)
    _, surface = contact_map(build_grid(insert, 2.5e-3), insert)
    np.testing.assert_allclose(surface.thickness, THICK, rtol=1e-9)
    assert np.all(surface.lift == 0.0)
    assert abs(surface.area.sum() - 400e-6) < 1e-12
