"""The lattice of every run contains the whole insert: random designs, steps, pieces, refusals."""

import logging

import numpy as np
import pytest
import trimesh

from inserts import dished, real_insert
from random_inserts import (
    in_insert_frame,
    joined_surfaces,
    lattice_error,
    random_insert,
    share_of_load,
    voxel_surface,
)
from tkamb.contact.lattice.meshing.cells import cell_volumes
from tkamb.contact.lattice.meshing.grid import build_grid, missing_part, outer_skin
from tkamb.contact.lattice.meshing.quality import whole_lattice
from tkamb.contact.materials import material
from tkamb.contact.pair import ContactPair
from tkamb.contact.registry import contact_model
from tkamb.errors import InputError
from tkamb.geometry.height_field import inside_intervals
from tkamb.geometry.surface import Surface

LOAD = 1000.0


def on_lines(x, y, z, solid):
    """Return the closed surface of boxes (mm); solid(x, y, z) selects boxes by their centres."""
    lines = [np.unique(np.asarray(line, float)) for line in (x, y, z)]
    middle = np.meshgrid(*[(line[1:] + line[:-1]) / 2 for line in lines], indexing="ij")
    return voxel_surface(tuple(1e-3 * line for line in lines), solid(*middle))


def ridge(edges=(-6.5, 6.5)):
    """Return a plate of 50 x 76 x 8 mm with a ridge 6 mm high along x."""
    z = np.concatenate([np.arange(-38, 39), edges])
    return on_lines(
        np.arange(-25, 26),
        [0, 8, 14],
        z,
        lambda x, y, z: (y < 8) | ((z > edges[0]) & (z < edges[1])),
    )


def plates(gap=16.0, second_floor=0.0):
    """Return two plates of 50 x 8 x 30 mm side by side, the second one at another height."""
    z = (gap / 2, gap / 2 + 30)
    first = on_lines(
        np.arange(-25, 26), [0, 8], np.linspace(-z[1], -z[0], 31), lambda x, y, z: y < 9
    )
    floor = [second_floor, 8]
    other = on_lines(np.arange(-25, 26), floor, np.linspace(*z, 31), lambda x, y, z: y < 9)
    return joined_surfaces(first, other)


def loads(insert, contact, size=2.0, bearing="fixed"):
    """Return the forces of the medial and lateral condyle, spheres of 22 mm at z = ±22 mm."""
    balls = []
    for side in (-0.022, 0.022):
        ball = trimesh.creation.icosphere(4, 0.022)
        ball.apply_translation([0.0, 0.05, side])
        balls.append(ball)
    spheres = trimesh.util.concatenate(balls)
    femoral = Surface(np.asarray(spheres.vertices), np.asarray(spheres.faces, np.int64), "femoral")
    pair = ContactPair(femoral, insert, material("polyethylene-linear"), bearing)
    model = contact_model(contact, resolution=size * 1e-3)
    result = model.press(model.prepare(pair), LOAD, np.eye(4))
    return result.medial.force, result.lateral.force


def test_random_inserts_keep_their_volume_or_are_refused():
    """A sample; scripts/measure_random_inserts has 2,000 inserts."""
    errors, refused = [], []
    for seed in range(15):
        try:
            errors.append(lattice_error(random_insert(seed)))
        except InputError as refusal:
            refused.append(str(refusal))
    assert np.abs(errors).max() <= 0.02
    assert len(errors) >= 13
    assert all("volume than the mesh" in words for words in refused)


@pytest.mark.parametrize("seed", range(3))
def test_symmetric_inserts_share_the_load_evenly(seed):
    assert share_of_load(random_insert(seed, symmetric=True)) == pytest.approx(0.5, abs=0.0025)


@pytest.mark.parametrize("contact", ["lattice-linear", "fe", "lattice-source"])
def test_a_ridge_with_walls_over_cell_centres_is_complete(contact):
    """At 1 mm the centres of 28,950 cells lie exactly under a step."""
    insert = ridge()
    lattice = build_grid(insert, 1e-3)
    assert cell_volumes(lattice.nodes[lattice.cells]).sum() == pytest.approx(
        insert.volume, rel=1e-3
    )
    medial, lateral = loads(insert, contact, 2.0)
    assert medial == pytest.approx(LOAD / 2, rel=0.005)
    assert lateral == pytest.approx(LOAD / 2, rel=0.005)


@pytest.mark.parametrize("edges", [(-6.5, 6.5), (-6.25, 5.0), (-7.0, 6.5), (-20.0, -3.5)])
@pytest.mark.parametrize("size", [1.0, 1.5, 2.0, 2.5])
def test_steps_on_ties_of_any_grid_are_complete(edges, size):
    insert = ridge(edges)
    lattice = build_grid(insert, 1e-3 * size)
    assert cell_volumes(lattice.nodes[lattice.cells]).sum() == pytest.approx(
        insert.volume, rel=0.02
    )


@pytest.mark.parametrize("bearing", ["fixed", "mobile"])
@pytest.mark.parametrize("contact", ["lattice", "lattice-linear", "fe"])
def test_two_plates_carry_the_load_together(contact, bearing):
    medial, lateral = loads(plates(), contact, 2.0, bearing)
    assert medial == pytest.approx(LOAD / 2, rel=0.005)
    assert lateral == pytest.approx(LOAD / 2, rel=0.005)


@pytest.mark.parametrize("gap", [2.5, 7.0, 16.0])
def test_plates_any_distance_apart_are_two_pieces(gap):
    insert = plates(gap)
    lattice = whole_lattice(insert, 1.5e-3)
    assert lattice.piece_of_node.max() == 1
    assert cell_volumes(lattice.nodes[lattice.cells]).sum() == pytest.approx(
        insert.volume, rel=0.02
    )


def test_a_piece_without_support_is_refused_with_its_place():
    with pytest.raises(
        InputError, match=r"less volume than the mesh.*it lacks a part of"
    ) as caught:
        whole_lattice(plates(second_floor=3.0), 1.5e-3)
    assert "mm at (0.0, 5.6, 23.1) mm" in str(caught.value)


def test_smaller_cells_are_used_if_the_chosen_ones_lose_too_much_volume(caplog):
    insert = real_insert("jw")
    coarse = build_grid(insert, 2e-3)
    with caplog.at_level(logging.WARNING, "tkamb"):
        lattice = whole_lattice(insert, 2e-3)
    volume, lost = (cell_volumes(g.nodes[g.cells]).sum() for g in (lattice, coarse))
    assert abs(lost / insert.volume - 1) > 0.02 >= abs(volume / insert.volume - 1)
    assert "instead of 2 mm" in caplog.text
    assert any("instead of 2 mm" in words for words in lattice.notices)


def test_a_valid_lattice_is_the_unchanged_grid():
    insert, _ = dished()
    np.testing.assert_array_equal(whole_lattice(insert, 2e-3).nodes, build_grid(insert, 2e-3).nodes)


def test_the_outer_surface_encloses_the_cells_and_missing_cells_are_found():
    insert, _ = dished()
    lattice = build_grid(insert, 2e-3)
    skin = outer_skin(lattice.nodes, lattice.cells)
    assert skin.volume == pytest.approx(cell_volumes(lattice.nodes[lattice.cells]).sum(), rel=2e-3)
    half = lattice.cells[lattice.nodes[lattice.cells].mean(axis=1)[:, 2] > 0]
    part = missing_part(lattice.nodes, half, lattice.spacing, insert)
    assert part.centre[2] == pytest.approx(-0.015, abs=1e-3)
    assert part.volume == pytest.approx(insert.volume / 2, rel=0.05)


@pytest.mark.parametrize("seed", [0, 6, 9, 12])
def test_the_winding_number_agrees_with_the_intervals_of_lines(seed):
    """Also on lines through vertices, edges and walls: midpoints of intervals are inside."""
    surface = in_insert_frame(random_insert(seed))
    x, z = (np.unique(surface.vertices[:, a])[:: len(surface.vertices) // 12] for a in (0, 2))
    result = inside_intervals(surface, 1, z, x)
    assert result.mended == 0
    middle = np.column_stack([x[result.second], (result.lower + result.upper) / 2, z[result.first]])
    near_wall = result.upper - result.lower < 1e-6
    steps = [(x, 0.0, z) for x in (-1e-7, 1e-7) for z in (-1e-7, 1e-7)]
    inner = [surface.winding.inside(middle + step) for step in steps]
    assert (np.any(inner, axis=0) | near_wall).all()
    same_line = result.first[1:] == result.first[:-1]
    same_line &= result.second[1:] == result.second[:-1]
    gap = np.column_stack(
        [x[result.second[1:]], (result.lower[1:] + result.upper[:-1]) / 2, z[result.first[1:]]]
    )[same_line]
    assert not surface.winding.inside(gap).any()
