"""UV lines, normals, arc lengths and condyle profiles against analytic curves."""

import numpy as np
import pytest
import trimesh
from scipy.integrate import quad

from condyle_profiles import condyle_profile
from inserts import DATA, raised, real_insert
from shapes import torus_condyle, trough
from surface_arcs import arc_lengths, draw_uv_lines
from tkamb.contact.lattice.meshing.grid import build_grid
from tkamb.errors import InputError
from tkamb.geometry.surface import Surface
from tkamb.io.recordings.meshes import load_surface


def torus_dish(major=0.03, minor=0.02, spacing=5e-4):
    """Return a block whose top is the lower half of a torus, and the function height(x, z).

    The axis of the torus is along z.
    """

    def height(x, z):
        ring = major - minor + np.sqrt(minor**2 - z**2)
        return 0.006 + major - np.sqrt(ring**2 - x**2)

    x, z = np.arange(-0.012, 0.0121, spacing), np.arange(-0.01, 0.0101, spacing)
    solid = np.ones((len(x) - 1, len(z) - 1), bool)
    return raised(x, z, height(*np.meshgrid(x, z, indexing="ij")), solid), height


def test_arc_length_on_a_cylinder_agrees_with_quadrature():
    """An oblique section is an arc of an ellipse. Quadrature gives its exact length."""
    radius = 0.05
    surface = trough(radius, spacing=5e-4)
    start = np.array([[-0.012, 0, -0.015], [-0.01, 0, 0.0], [0.0, 0, -0.01]])
    end = np.array([[0.012, 0, 0.015], [0.01, 0, 0.0], [0.0, 0, 0.01]])
    for n, length in enumerate(arc_lengths(surface, start, end)):
        (x0, _, z0), (x1, _, z1) = start[n], end[n]

        def rate(s, x0=x0, x1=x1, z0=z0, z1=z1):
            x = x0 + s * (x1 - x0)
            dy = x / np.sqrt(radius**2 - x**2) * (x1 - x0)
            return np.sqrt((x1 - x0) ** 2 + (z1 - z0) ** 2 + dy**2)

        assert length == pytest.approx(quad(rate, 0, 1)[0], rel=1e-3)


def test_arc_length_on_a_section_of_a_torus_is_exact():
    surface, height = torus_dish()
    rng = np.random.default_rng(4)
    start = rng.uniform([-0.011, 0, -0.009], [-0.004, 0, 0.009], (12, 3))
    end = rng.uniform([0.004, 0, -0.009], [0.011, 0, 0.009], (12, 3))
    lengths = arc_lengths(surface, start, end)
    for a, b, length in zip(start, end, lengths, strict=True):
        s = np.linspace(0, 1, 4001)[:, None]
        p = a + s * (b - a)
        curve = np.column_stack([p[:, 0], height(p[:, 0], p[:, 2]), p[:, 2]])
        exact = np.linalg.norm(np.diff(curve, axis=0), axis=1).sum()
        assert length == pytest.approx(exact, rel=2e-3)


def test_arc_length_is_exact_from_below_and_nan_off_the_surface():
    surface = torus_condyle(0.025, 0.01, 0.0)
    below = arc_lengths(surface, [[-0.01, 0, 0]], [[0.01, 0, 0]], side=-1.0)
    assert below[0] == pytest.approx(2 * 0.025 * np.arcsin(0.4), rel=2e-3)
    assert np.isnan(arc_lengths(surface, [[-0.05, 0, 0]], [[0.01, 0, 0]])[0])


def test_normals_of_uv_lines_on_a_paraboloid_are_exact():
    i, k = (v.ravel() for v in np.meshgrid(np.arange(15), np.arange(20), indexing="ij"))
    x, z = 1e-3 * i, 1e-3 * k
    points = np.column_stack([x, 20 * x**2 + 10 * x * z + 15 * z**2, z])
    lines = draw_uv_lines(points, i, k)
    exact = np.column_stack([-(40 * x + 10 * z), np.ones(len(x)), -(10 * x + 30 * z)])
    exact /= np.linalg.norm(exact, axis=1, keepdims=True)
    np.testing.assert_allclose(lines.normals, exact, atol=1e-12)


def test_mean_line_normals_of_sharma_err_by_half_the_slope():
    i, k = (v.ravel() for v in np.meshgrid(np.arange(6), np.arange(6), indexing="ij"))
    slope = np.tan(np.radians(10.0))
    points = np.column_stack([1e-3 * i, slope * 1e-3 * i, 1e-3 * k])
    lines = draw_uv_lines(points, i, k)
    cosine = np.einsum("ij,ij->i", lines.normals, lines.mean_line_normals)
    np.testing.assert_allclose(np.degrees(np.arccos(cosine)), 5.0, atol=1e-6)


def test_lines_end_at_gaps_and_an_isolated_point_has_no_slope():
    i, k = np.array([0, 1, 2, 5, 6, 9]), np.zeros(6, int)
    x = 1e-3 * i
    lines = draw_uv_lines(np.column_stack([x, np.where(i < 4, x, -x), 0 * x]), i, k)
    np.testing.assert_allclose(lines.slope_x[:5], [1, 1, 1, -1, -1])
    assert np.isnan(lines.slope_x[5])
    assert np.isnan(lines.slope_z).all()


@pytest.mark.parametrize("name", ["dm", "jw"])
def test_normals_on_the_dishes_of_real_inserts_are_within_2_deg(name):
    insert = real_insert(name)
    lattice = build_grid(insert, 1e-3)
    nodes = lattice.contact_nodes
    points = lattice.nodes[nodes]
    lines = draw_uv_lines(points, lattice.index[nodes, 0], lattice.index[nodes, 2])
    dish = (np.abs(np.abs(points[:, 2]) - 0.022) < 0.008) & (np.abs(points[:, 0]) < 0.012)
    assert dish.sum() > 500
    _, face = insert.rays.first(points[dish] * [1, 0, 1] + [0, 0.05, 0], (0, -1, 0))
    cosine = np.einsum("ij,ij->i", lines.normals[dish], insert.face_normals[face])
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    assert np.percentile(angle, 95) < 2.0


def test_profile_of_a_ring_is_a_circle():
    ring = trimesh.creation.torus(0.015, 0.01, 180, 90)
    ring = Surface(np.asarray(ring.vertices), np.asarray(ring.faces), "ring")
    profile = condyle_profile(ring, 1e-6)
    flexion = np.radians(np.linspace(0, 150, 31))
    np.testing.assert_allclose(profile.lowest(flexion), 0.025 * flexion, atol=1.5e-4)
    points = profile.at(profile.lowest(flexion))
    exact = -0.025 * np.column_stack([np.sin(flexion), np.cos(flexion)])
    np.testing.assert_allclose(points, exact, atol=1.5e-4)
    np.testing.assert_allclose(profile.locate(points), profile.lowest(flexion), atol=1e-6)


@pytest.mark.parametrize("name", ["dm", "jw"])
@pytest.mark.parametrize("z", [-0.022, 0.022])
def test_profiles_of_real_condyles_reach_160_deg(name, z):
    path = DATA / name / "geometry" / "femoral_component.stl"
    if not path.is_file():
        pytest.skip("subject data absent (shared/data): meshes of DM and JW are not shipped")
    profile = condyle_profile(load_surface(path, "m", "-x,+y,-z", name="femoral component"), z)
    lowest = profile.lowest(np.radians(np.arange(0.0, 161.0, 5.0)))
    assert (np.diff(lowest) > -1e-4).all()
    assert (np.diff(lowest)[:28] > 0).all()
    assert 0.05 < lowest[-1] < 0.07


def test_a_plane_that_misses_the_condyle_is_an_input_error():
    with pytest.raises(InputError, match="misses"):
        condyle_profile(torus_condyle(0.025, 0.01, 0.0), 0.1)
