"""The contact surface of the lattice: thickness under its nodes, and the smooth surface above."""

import numpy as np

from tkamb.contact.lattice.meshing.contact_map import contact_map
from tkamb.contact.lattice.meshing.grid import build_grid
from tkamb.studies.cases import block, dishes, flat

RADIUS, THICK = 34e-3, 8e-3


def test_lifted_nodes_lie_on_the_dish_that_the_facets_stand_for():
    """Facets of 2 mm in a dish of 34 mm are up to 2²/8 / 34 mm = 15 µm off; lifted, a tenth."""
    insert = block(dishes(THICK, RADIUS, 0.0), (20e-3, 20e-3), 2e-3)
    _, found = contact_map(build_grid(insert, 1.3e-3), insert)
    away = np.hypot(found.points[:, 0], found.points[:, 2])
    inner = away < 7e-3
    true = THICK + away[inner] ** 2 / (2 * RADIUS)
    faceted = found.points[inner, 1] - true
    smooth = faceted + found.lift[inner]
    assert np.abs(faceted).max() > 8e-6
    assert np.abs(smooth).max() < 2e-6


def test_thickness_is_the_height_over_the_flat_bottom():
    insert = block(flat(THICK), (20e-3, 20e-3), 2e-3)
    _, found = contact_map(build_grid(insert, 2.5e-3), insert)
    np.testing.assert_allclose(found.thickness, THICK, rtol=1e-9)
    assert np.all(found.lift == 0.0)
    assert abs(found.area.sum() - 400e-6) < 1e-12
