"""The lattice of any insert: counts, volume, surfaces, invariance, repair, invariants."""

import base64
import logging
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from inserts import dished, raised, real_insert, shipped_insert, volume
from lattice_bodies import box_insert
from shapes import nearest_on_triangles
from tkamb.contact.lattice.meshing.cells import (
    DIRECTIONS,
    FAMILY_SHARE,
    PAIRS,
    cell_volumes,
    join_springs,
    scaled_jacobians,
)
from tkamb.contact.lattice.meshing.columns import Levels, _without_narrow_gaps, interval_ends
from tkamb.contact.lattice.meshing.contact_map import contact_squares
from tkamb.contact.lattice.meshing.grid import (
    BOTTOM,
    CONTACT,
    INTERNAL,
    OTHER,
    build_grid,
    grid_spacing,
)
from tkamb.contact.lattice.meshing.quality import measure_quality
from tkamb.contact.lattice.meshing.walls import NOTCH
from tkamb.errors import InputError
from tkamb.geometry.flat_bottom import insert_placement
from tkamb.geometry.frames import pose
from tkamb.geometry.height_field import Intervals
from tkamb.geometry.repair import repair
from tkamb.geometry.surface import Surface
from tkamb.io.recordings.meshes import axes_rotation
from tkamb.io.vtk import write_lattice

SIZES = np.array([3.0, 2.0, 1.5, 1.0])
INSERTS = [pytest.param("dm", marks=pytest.mark.slow), "jw", "shipped"]


def box(size, spacing=5e-4):
    x, z = (np.linspace(-s / 2, s / 2, round(s / spacing) + 1) for s in (size[0], size[2]))
    solid = np.ones((len(x) - 1, len(z) - 1), bool)
    return raised(x, z, np.full((len(x), len(z)), size[1]), solid)


def lattice_volume(lattice):
    return cell_volumes(lattice.nodes[lattice.cells]).sum()


@pytest.mark.parametrize(
    ("cells", "springs"), [((1, 1, 1), 28), ((2, 2, 2), 158), ((3, 4, 5), None), ((7, 2, 3), None)]
)
def test_spring_counts_of_blocks(cells, springs):
    """28 for one cell, 158 for 3 x 3 x 3 nodes, else the closed form."""
    lattice = build_grid(box(1e-3 * np.array(cells)), 1e-3)
    assert len(lattice.cells) == np.prod(cells)
    nodes = np.array(cells) + 1
    assert len(lattice.springs.ends) == sum(np.prod(nodes - np.abs(way)) for way in DIRECTIONS)
    if springs:
        assert len(lattice.springs.ends) == springs


def test_a_block_gives_the_exact_regular_grid():
    lattice = build_grid(box((0.02, 0.008, 0.03)), 1e-3)
    np.testing.assert_allclose(
        lattice.nodes, lattice.origin + lattice.index * lattice.spacing, atol=1e-16
    )
    np.testing.assert_allclose(lattice.spacing, 1e-3)
    j, counts = lattice.index[:, 1], np.bincount(lattice.node_class, minlength=4)
    assert (lattice.node_class[j == 0] == BOTTOM).all()
    assert (lattice.node_class[j == 8] == CONTACT).all()
    assert counts[INTERNAL] == 19 * 7 * 29
    assert counts[OTHER] == 21 * 7 * 31 - counts[INTERNAL]
    area = lattice.nodes[lattice.contact_triangles]
    cross = np.cross(area[:, 1] - area[:, 0], area[:, 2] - area[:, 0])
    np.testing.assert_allclose(cross.sum(axis=0) / 2, [0, 0.02 * 0.03, 0], atol=1e-15)


@given(
    st.tuples(*[st.floats(1e-3, 0.1)] * 3).filter(lambda e: max(e) < 60 * min(e)),
    st.floats(5e-4, 4e-3),
)
def test_cells_are_near_cubic_for_any_box(extent, size):
    extent = np.array(extent)
    spacing = grid_spacing(extent, size)
    np.testing.assert_allclose(np.round(extent / spacing) * spacing, extent)
    assert spacing.max() / spacing.min() <= 1.4


def test_half_cell_rule_and_thin_intervals():
    """Rules 8 and 9: nearest nodes; thin intervals by two nodes, or one at the mean."""
    low = np.array([0.4, 0.6, 0.5, 3.3, 3.4, 2.7, 2.6, 3.9])
    high = np.array([4.4, 4.6, 4.5, 3.85, 3.6, 3.3, 3.2, 5.8])
    ends = interval_ends(low, high, 9)
    np.testing.assert_array_equal(ends.first, [0, 1, 1, 3, 4, 3, 2, 4])
    np.testing.assert_array_equal(ends.last, [4, 5, 4, 4, 4, 4, 3, 6])
    single = np.zeros(8, bool)
    single[4] = True
    np.testing.assert_array_equal(ends.single, single)


@pytest.mark.parametrize(("begins", "joined"), [(2.4, 1), (2.6, 0), (2.8, 0), (3.4, 0)])
def test_a_gap_is_closed_where_both_its_ends_fall_on_one_node(begins, joined):
    """The interval below ends at 2.0, on node 2, the next one at the nearest to where it begins."""
    low, high = np.array([0.0, begins]), np.array([2.0, 6.0])
    line = np.zeros(2, int)
    merged, *_, count = _without_narrow_gaps(Intervals(line, line, low, high, 0), low, high)
    assert count == joined
    assert merged.upper.tolist() == ([6.0] if joined else [2.0, 6.0])


@pytest.mark.parametrize("noise", [-1e-9, 1e-9])
def test_rounding_does_not_move_an_interval_on_a_tie(noise):
    """Ends half-way between nodes, on nodes, and as thick as half a cell."""
    low = np.array([0.5, 1.5, 2.0, 3.35, 4.0])
    high = np.array([4.5, 3.0, 2.5, 3.85, 6.5])
    plain = interval_ends(low, high, 9)
    for ends in (interval_ends(low + noise, high, 9), interval_ends(low, high + noise, 9)):
        for name, value in vars(plain).items():
            np.testing.assert_array_equal(getattr(ends, name), value, name)


def test_one_node_inside_a_very_thin_interval_is_left_alone():
    ends = interval_ends(np.array([2.8]), np.array([3.1]), 9)
    assert ends.first[0] == ends.last[0] == 3
    assert ends.single[0]
    assert ends.held[0]


def test_volume_of_a_dished_block_converges():
    """Against the exact volume of the mesh: error < 1 % at 1 mm, order >= 1."""
    surface, _ = dished()
    errors = [lattice_volume(build_grid(surface, s * 1e-3)) / volume(surface) - 1 for s in SIZES]
    assert abs(errors[-1]) < 0.01
    assert np.polyfit(np.log(SIZES), np.log(np.abs(errors)), 1)[0] >= 1.0


@pytest.mark.parametrize("name", INSERTS)
def test_volume_of_real_inserts_converges(name):
    surface = shipped_insert() if name == "shipped" else real_insert(name)
    errors = [lattice_volume(build_grid(surface, s * 1e-3)) / volume(surface) - 1 for s in SIZES]
    assert abs(errors[-1]) < 0.01
    assert np.polyfit(np.log(SIZES), np.log(np.abs(errors)), 1)[0] >= 1.0


def distances(surface, points, reach=1e-4):
    """Distance of each point to the surface, all triangles within `reach` asked."""
    low, high = surface.triangles.min(axis=1) - reach, surface.triangles.max(axis=1) + reach
    result = np.full(len(points), np.inf)
    for n, point in enumerate(points):
        near = np.flatnonzero(((low <= point) & (point <= high)).all(axis=1))
        foot = nearest_on_triangles(surface.triangles[near], np.tile(point, (len(near), 1)))
        result[n] = np.linalg.norm(foot - point, axis=1).min(initial=np.inf)
    return result


def notch_nodes(lattice):
    """Say which contact nodes may be those of filled notches, a little outside the outline.

    They are corners of one square, or of two where notches meet.
    """
    squares = contact_squares(lattice.contact_triangles)
    count = np.bincount(squares.ravel(), minlength=len(lattice.nodes))
    return count[lattice.contact_nodes] <= 2


@pytest.mark.parametrize("name", INSERTS)
def test_contact_nodes_lie_on_the_surface(name):
    surface = shipped_insert() if name == "shipped" else real_insert(name)
    lattice = build_grid(surface, 1.5e-3)
    away = distances(surface, lattice.nodes[lattice.contact_nodes], reach=5e-4)
    in_a_notch = notch_nodes(lattice)
    assert away[~in_a_notch].max() < 1e-9
    assert away.max() < NOTCH.corner_margin * np.linalg.norm(lattice.spacing[[0, 2]])
    assert np.abs(lattice.nodes[lattice.bottom_nodes, 1]).max() < 5e-5
    assert scaled_jacobians(lattice.nodes[lattice.cells]).min() > 0.0
    columns = lattice.index[lattice.contact_nodes][:, [0, 2]]
    assert len(np.unique(columns, axis=0)) == len(columns)


@pytest.mark.parametrize("name", INSERTS)
def test_permuted_axes_give_exactly_the_same_lattice(name):
    surface = shipped_insert() if name == "shipped" else real_insert(name)
    lattice = build_grid(surface, 2e-3)
    for axes in ("-x,+y,-z", "+z,-x,-y", "+y,+z,+x"):
        rotation = axes_rotation(axes)
        mesh = Surface(surface.vertices @ rotation, surface.faces)
        again = mesh.moved(pose(rotation, np.zeros(3)))
        again = build_grid(again.moved(insert_placement(again)), 2e-3)
        np.testing.assert_array_equal(again.cells, lattice.cells)
        np.testing.assert_allclose(again.nodes, lattice.nodes, atol=1e-15)


@pytest.mark.parametrize("name", INSERTS)
@pytest.mark.parametrize(
    "axis",
    [
        pytest.param((1, 0, 0), marks=pytest.mark.slow),
        pytest.param((0, 0, 1), marks=pytest.mark.slow),
        (0.6, 0, -0.8),
    ],
)
def test_a_tilt_of_10_deg_changes_next_to_nothing(name, axis):
    surface = shipped_insert() if name == "shipped" else real_insert(name)
    lattice = build_grid(surface, 1.5e-3)
    tilt = Rotation.from_rotvec(np.radians(10.0) * np.array(axis)).as_matrix()
    tilted = surface.moved(pose(tilt, [0.01, 0.02, -0.03]))
    again = build_grid(tilted.moved(insert_placement(tilted)), 1.5e-3)
    assert len(again.nodes) == pytest.approx(len(lattice.nodes), rel=2e-3)
    assert lattice_volume(again) == pytest.approx(lattice_volume(lattice), rel=1e-3)


def held(solid_hole=None, post=None, lip=0.012, rim=0.0):
    """A dished block with a hole (x0, x1, z0, z1), a post (same, height) and a rim (width)."""
    _, top = dished(lip=lip)
    x, z = np.linspace(-0.02, 0.02, 81), np.linspace(-0.03, 0.03, 121)
    height = top(*np.meshgrid(x, z, indexing="ij"))
    solid = np.ones((80, 120), bool)
    if solid_hole:
        a, b, c, d = solid_hole
        middle_x, middle_z = (x[1:] + x[:-1]) / 2, (z[1:] + z[:-1]) / 2
        solid &= ~(((middle_x > a) & (middle_x < b))[:, None] & ((middle_z > c) & (middle_z < d)))
    if post:
        a, b, c, d, rise = post
        on = ((x >= a) & (x <= b))[:, None] & ((z >= c) & (z <= d))
        height = np.where(on, rise, height)
    if rim:
        on = (np.abs(x) > 0.02 - rim)[:, None] | (np.abs(z) > 0.03 - rim)
        height = np.where(on, height + 0.003, height)
    return raised(x, z, height, solid)


def test_a_hole_is_empty_and_its_walls_are_smooth():
    surface = held(solid_hole=(-0.0042, 0.0031, -0.0053, 0.0046))
    lattice = build_grid(surface, 1e-3)
    x, z = lattice.nodes[:, 0], lattice.nodes[:, 2]
    within = (x > -0.004 + 1e-6) & (x < 0.003 - 1e-6) & (z > -0.005 + 1e-6) & (z < 0.0045 - 1e-6)
    assert not within.any()
    assert lattice_volume(lattice) == pytest.approx(volume(surface), rel=0.01)


def test_walls_between_the_planes_of_the_grid_have_a_node_in_every_row():
    """A hole from -4 to 3 and -5.5 to 4.5 mm, of which only one lies on a plane of the grid."""
    lattice = build_grid(held(solid_hole=(-0.0042, 0.0031, -0.0053, 0.0046)), 1.3e-3)
    x, z = lattice.nodes[:, 0], lattice.nodes[:, 2]
    layers = len(np.unique(lattice.index[:, 1]))
    grid_x, grid_z = np.linspace(-0.02, 0.02, 32), np.linspace(-0.03, 0.03, 47)
    rows = (
        ((grid_x > -0.004) & (grid_x < 0.003)).sum(),
        ((grid_z > -0.0055) & (grid_z < 0.0045)).sum(),
    )
    beside = (z > -0.0055) & (z < 0.0045), (x > -0.004) & (x < 0.003)
    for wall in (-0.004, 0.003):
        assert ((np.abs(x - wall) < 2e-9) & beside[0]).sum() == rows[1] * layers
    for wall in (-0.0055, 0.0045):
        assert ((np.abs(z - wall) < 2e-9) & beside[1]).sum() == rows[0] * layers


def test_a_round_wall_keeps_its_volume():
    """A standing cylinder, of 17 cells across."""
    mesh = trimesh.creation.cylinder(0.0083, 0.01, sections=256)
    vertices = np.asarray(mesh.vertices)[:, [1, 2, 0]] + [0.0, 0.005, 0.0]
    surface = Surface(vertices, np.asarray(mesh.faces), "cylinder")
    lattice = build_grid(surface, 1e-3)
    assert lattice_volume(lattice) == pytest.approx(volume(surface), rel=2e-4)
    radius = np.hypot(lattice.nodes[:, 0], lattice.nodes[:, 2])
    top = (lattice.nodes[:, 1] > 0.01 - 1e-9) & (radius < 0.0083 + 1e-9)
    assert top.sum() > 200
    assert (lattice.node_class[top] == CONTACT).all()


def test_shear_is_the_angle_by_which_a_lattice_was_sheared():
    surface = box_insert(0.03, 0.01, 0.05)
    lattice = build_grid(surface, 3e-3)
    for axis in (0, 2):
        nodes = lattice.nodes.copy()
        nodes[:, axis] += np.tan(0.2) * nodes[:, 1]
        sheared = measure_quality(replace(lattice, nodes=nodes), surface).shear
        assert sheared == pytest.approx((0.2, 0.2, 0.2))


def test_a_post_is_filled_recognised_and_flagged():
    surface = held(post=(-0.008, 0.002, -0.005, 0.005, 0.025))
    lattice = build_grid(surface, 1e-3)
    assert lattice_volume(lattice) == pytest.approx(volume(surface), rel=0.015)
    quality = measure_quality(lattice, surface)
    assert quality.post is not None
    assert quality.post.x == pytest.approx(-0.003, abs=1e-3)
    assert quality.post.z == pytest.approx(0.0, abs=1e-3)
    assert any("cam-post contact is not modelled" in line for line in quality.lines())


def test_a_peg_under_the_bottom_is_filled():
    """A mobile bearing's peg: below the flat bottom, which stays the bottom."""
    surface, _ = dished()
    vertices = surface.vertices.copy()
    under = (vertices[:, 1] == 0.0) & (np.hypot(vertices[:, 0], vertices[:, 2]) < 0.0053)
    vertices[under, 1] = -0.008
    surface = Surface(vertices, surface.faces, "insert with a peg")
    lattice = build_grid(surface, 1e-3)
    assert lattice_volume(lattice) == pytest.approx(volume(surface), rel=0.01)
    low = lattice.nodes[:, 1] < -1e-3
    assert (lattice.node_class[low] != BOTTOM).all()
    assert lattice.nodes[:, 1].min() == pytest.approx(-0.008, abs=1e-9)
    assert np.hypot(*lattice.nodes[low][:, [0, 2]].T).max() < 0.0065


@pytest.mark.parametrize("name", [*INSERTS, "dished"])
@pytest.mark.parametrize("size", [2e-3, 1.5e-3, 1e-3])
def test_layers_have_no_step_in_a_dish(name, size):
    """A node on a step has half its support, and half its pressure: none where condyles stand."""
    if name == "dished":
        surface, _ = dished(lip=0.0125)
    else:
        surface = shipped_insert() if name == "shipped" else real_insert(name)
    lattice = build_grid(surface, size)
    top = lattice.index[lattice.contact_nodes], lattice.nodes[lattice.contact_nodes]
    rim = np.abs(top[1]) > np.abs(surface.bounds).min(axis=0) - 4e-3
    inner = ~rim[:, [0, 2]].any(axis=1) & (np.abs(top[1][:, 2]) > 11e-3)
    deep = inner & (top[1][:, 1] < np.quantile(top[1][inner, 1], 0.3))
    assert np.ptp(top[0][deep, 1]) == 0


def test_a_height_s_position_is_the_layer_that_stands_there():
    """Nodes of every column, pegs and posts included: `position` is the inverse of `heights`."""
    reference = 1e-3 * np.array([[8.0, 9.5, 12.0], [7.3, 10.0, 11.1]])
    levels = Levels(reference, layers=10, below=2, spacing=1e-3, count=16)
    heights = levels.heights()
    i, j, k = np.indices(heights.shape)
    found = levels.position(heights.ravel(), i.ravel(), k.ravel())
    np.testing.assert_allclose(found, j.ravel(), atol=1e-9)


@pytest.mark.parametrize("name", INSERTS)
def test_an_eminence_is_no_post(name):
    surface = shipped_insert() if name == "shipped" else real_insert(name)
    assert measure_quality(build_grid(surface, 3e-3), surface).post is None


def classes_agree(a, b):
    """Share of the nodes of either lattice that have the same class in both."""
    shape = tuple(np.maximum(a.index.max(axis=0), b.index.max(axis=0)) + 1)
    dense = [np.full(shape, -1) for _ in range(2)]
    for grid, lattice in zip(dense, (a, b), strict=True):
        grid[tuple(lattice.index.T)] = lattice.node_class
    used = (dense[0] >= 0) | (dense[1] >= 0)
    return (dense[0] == dense[1])[used].mean()


@pytest.mark.parametrize("name", INSERTS)
def test_twenty_triangles_removed_are_put_back(name):
    surface = shipped_insert() if name == "shipped" else real_insert(name)
    lattice = build_grid(surface, 1.5e-3)
    rng = np.random.default_rng(5)
    small = np.flatnonzero(np.ptp(surface.triangles, axis=1).max(axis=1) < 3e-3)
    kept = np.delete(np.arange(len(surface.faces)), rng.choice(small, 20, replace=False))
    mended = repair(surface.vertices, surface.faces[kept])
    assert mended.notices
    again = build_grid(Surface(mended.vertices, mended.faces), 1.5e-3)
    assert classes_agree(lattice, again) >= 0.999


def test_rays_through_gaps_are_mended_with_a_notice(caplog):
    """A surface that reaches the grid with holes: odd rays take their neighbours' crossings."""
    surface, _ = dished()
    lattice = build_grid(surface, 1e-3)
    centre = surface.triangles.mean(axis=1)
    top = np.flatnonzero((surface.face_normals[:, 1] > 0.9) & (np.abs(centre[:, 0]) < 0.015))
    kept = np.delete(np.arange(len(surface.faces)), top[:: len(top) // 20][:20])
    with caplog.at_level(logging.WARNING, "tkamb"):
        again = build_grid(Surface(surface.vertices, surface.faces[kept], "holed"), 1e-3)
    assert again.mended_rays > 0
    assert "rays through gaps in the mesh mended" in caplog.text
    assert classes_agree(lattice, again) >= 0.999
    common = (
        np.abs(again.nodes - lattice.nodes).max() if len(again.nodes) == len(lattice.nodes) else 1
    )
    assert common < 5e-5


def shaken(surface, noise, seed):
    """The surface with uniform noise (m) on every coordinate of every vertex."""
    moved = np.random.default_rng(seed).uniform(-noise, noise, surface.vertices.shape)
    return Surface(surface.vertices + moved, surface.faces)


@pytest.mark.parametrize("name", INSERTS)
def test_rounding_of_a_mesh_leaves_the_classes_alone(name):
    """0.1 µm, as of single precision: no CAD face lies on a tie of the rules."""
    surface = shipped_insert() if name == "shipped" else real_insert(name)
    for size in (1.5e-3, 1e-3):
        again = build_grid(shaken(surface, 1e-7, 7), size)
        assert classes_agree(build_grid(surface, size), again) >= 0.999


@pytest.mark.parametrize("name", INSERTS)
def test_ten_micrometres_of_jitter_leave_the_classes_right(name):
    """Right: a node of each class is where its class says, on the surface without jitter.

    Nodes within the jitter of a half-cell tie may go either way and be right both times; so
    the class that the same grid place had without jitter agrees for 98.5 % only.
    """
    surface = shipped_insert() if name == "shipped" else real_insert(name)
    lattice = build_grid(shaken(surface, 1e-5, 6), 1.5e-3)
    assert classes_agree(lattice, build_grid(surface, 1.5e-3)) > 0.985
    kind, nodes = lattice.node_class, lattice.nodes
    away = distances(surface, nodes[kind == CONTACT], 5e-4)
    diagonal = np.linalg.norm(lattice.spacing[[0, 2]])
    on_top = away < np.where(notch_nodes(lattice), NOTCH.corner_margin * diagonal, 3e-5)
    on_bottom = np.abs(nodes[kind == BOTTOM, 1]) < 5e-5
    within = surface.winding.inside(nodes[kind == INTERNAL])
    near_wall = distances(surface, nodes[kind == OTHER], 2.5e-3) < 2.5e-3
    right = on_top.sum() + on_bottom.sum() + within.sum() + near_wall.sum()
    assert right >= 0.999 * len(nodes)


def test_more_cells_than_any_machine_holds_are_refused_before_they_are_made():
    surface, _ = dished()
    with pytest.raises(InputError, match=r"cells of 0.002 mm are too many"):
        build_grid(surface, 2e-6)


def test_an_open_surface_is_refused():
    surface, _ = dished()
    open_top = Surface(surface.vertices, surface.faces[surface.face_normals[:, 1] < 0.5], "tray")
    with pytest.raises(InputError, match="open"):
        build_grid(open_top, 2e-3)


def check_invariants(lattice, surface):
    used = np.zeros(len(lattice.nodes), bool)
    used[lattice.cells] = True
    assert used.all(), "orphan node"
    ends = np.sort(lattice.springs.ends, axis=1)
    assert len(np.unique(ends, axis=0)) == len(ends), "duplicate spring"
    length = np.linalg.norm(lattice.nodes[ends[:, 1]] - lattice.nodes[ends[:, 0]], axis=1)
    assert length.min() > 0.1 * lattice.spacing.min(), "spring without length"
    of_cells = np.sort(lattice.cells[:, PAIRS], axis=2)
    np.testing.assert_array_equal(ends[lattice.springs.of_cell], of_cells)
    owners = np.bincount(lattice.springs.of_cell.ravel(), minlength=len(ends))
    np.testing.assert_array_equal(owners, lattice.springs.owners)
    share = FAMILY_SHARE[lattice.springs.family] * owners
    assert share.max() <= 1.0
    internal = lattice.node_class[lattice.springs.ends] == INTERNAL
    np.testing.assert_array_equal(share[internal.any(axis=1)], 1.0)
    step = lattice.index[lattice.springs.ends[:, 1]] - lattice.index[lattice.springs.ends[:, 0]]
    np.testing.assert_array_equal(step, DIRECTIONS[lattice.springs.family])
    graph = coo_array((np.ones(len(ends)), tuple(ends.T)), shape=(len(used), len(used)))
    label = connected_components(graph, directed=False)[1]
    assert set(label[lattice.contact_nodes]) <= set(label[lattice.bottom_nodes]), "not reachable"
    assert scaled_jacobians(lattice.nodes[lattice.cells]).min() > 0.0, "inverted cell"
    assert set(np.unique(lattice.contact_triangles)) <= set(lattice.contact_nodes)
    tops = lattice.nodes[lattice.contact_nodes]
    low, high = surface.bounds
    assert (tops >= low - 1e-9).all()
    assert (tops <= high + 1e-9).all()


def test_springs_of_cells_without_a_grid_around_them():
    cells = np.array([[0, 1, 2, 3, 4, 5, 6, 7]])
    springs = join_springs(cells, 8)
    assert len(springs.ends) == 28
    assert (springs.owners == 1).all()


@settings(max_examples=12, deadline=None)
@given(
    hole=st.none() | st.tuples(*[st.floats(-0.012, 0.012)] * 2, *[st.floats(0.0005, 0.008)] * 2),
    post=st.none()
    | st.tuples(st.floats(-0.012, 0.004), st.floats(0.001, 0.01), st.floats(0.014, 0.03)),
    lip=st.floats(0.006, 0.012),
    rim=st.just(0.0) | st.floats(0.0006, 0.003),
    size=st.floats(1.2e-3, 3e-3),
)
def test_random_blocks_keep_the_invariants(hole, post, lip, rim, size):
    """Dished blocks with holes, posts and thin rims."""
    where = hole and (hole[0], hole[0] + hole[2], hole[1], hole[1] + hole[3])
    what = post and (post[0], post[0] + post[1], -post[1] / 2, post[1] / 2, post[2])
    surface = held(where, what, lip, rim)
    lattice = build_grid(surface, size)
    check_invariants(lattice, surface)
    assert lattice_volume(lattice) == pytest.approx(volume(surface), rel=0.2)


@pytest.mark.parametrize("name", INSERTS)
def test_real_inserts_keep_the_invariants(name):
    surface = shipped_insert() if name == "shipped" else real_insert(name)
    check_invariants(build_grid(surface, 1.5e-3), surface)


def test_the_vtu_file_holds_the_lattice(tmp_path):
    lattice = build_grid(box((0.004, 0.003, 0.005)), 1e-3)
    write_lattice(lattice, tmp_path / "lattice.vtu")
    root = ElementTree.parse(tmp_path / "lattice.vtu").getroot()
    kinds = {"Float64": "<f8", "Int64": "<i8", "UInt8": "u1", "Int8": "i1"}
    arrays = {}
    for array in root.iter("DataArray"):
        raw = base64.b64decode(array.text)
        assert np.frombuffer(raw[:8], "<u8")[0] == len(raw) - 8
        arrays[array.get("Name")] = np.frombuffer(raw[8:], kinds[array.get("type")])
    np.testing.assert_array_equal(arrays["points_m"].reshape(-1, 3), lattice.nodes)
    np.testing.assert_array_equal(arrays["connectivity"].reshape(-1, 8), lattice.cells)
    np.testing.assert_array_equal(arrays["types"], 12)
    np.testing.assert_array_equal(arrays["node_class"], lattice.node_class)


def test_meshio_reads_the_vtu_file(tmp_path):
    meshio = pytest.importorskip("meshio", reason="meshio is not installed")
    lattice = build_grid(box((0.004, 0.003, 0.005)), 1e-3)
    write_lattice(lattice, tmp_path / "lattice.vtu")
    mesh = meshio.read(tmp_path / "lattice.vtu")
    np.testing.assert_array_equal(mesh.cells_dict["hexahedron"], lattice.cells)
