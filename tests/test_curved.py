"""Curved patches over triangles, exact to second order, and normals at corners: sharp at edges."""

import numpy as np
import pytest
import trimesh

from lattice_bodies import box_insert
from tkamb.geometry.curved import CurvedSurface
from tkamb.geometry.surface import Surface, sharp_edges

UP = np.array([0.0, 1.0, 0.0])
RADIUS = 20e-3


def ball(subdivisions):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=RADIUS)
    return Surface(np.array(mesh.vertices), np.array(mesh.faces, np.int64))


def sheet(x, z, height):
    """Return a triangulated height field over x (a,) and z (b,), m."""
    gx, gz = np.meshgrid(x, z, indexing="ij")
    number = np.arange(gx.size).reshape(gx.shape)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    quads = np.stack([a, d, c, b], axis=-1).reshape(-1, 4)
    points = np.column_stack([gx.ravel(), height(gx, gz).ravel(), gz.ravel()])
    return Surface(points, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]))


def scattered(surface, faces, seed=2):
    """Return a random point on each of some triangles, and its barycentric coordinates."""
    weights = np.random.default_rng(seed).dirichlet([1, 1, 1], len(faces))
    return np.einsum("ij,ijk->ik", weights, surface.triangles[faces]), weights


def test_a_faceted_sphere_becomes_round():
    """Within 5 % of a facet's sagitta, for three facet sizes."""
    for subdivisions in (3, 4, 5):
        surface = ball(subdivisions)
        faces = np.flatnonzero(surface.face_normals[:, 1] > 0.9)
        points, weights = scattered(surface, faces)
        shift, normals = CurvedSurface.of(surface).shift(faces, weights, UP)
        radius = np.linalg.norm(points + shift[:, None] * UP, axis=1)
        sagitta = RADIUS - np.linalg.norm(points, axis=1).min()
        assert np.abs(radius - RADIUS).max() < 0.05 * sagitta
        outward = points / np.linalg.norm(points, axis=1, keepdims=True)
        assert np.einsum("ij,ij->i", normals, outward).min() > np.cos(np.radians(0.5))


def test_neighbouring_patches_meet():
    surface = ball(4)
    patches, across = CurvedSurface.of(surface), surface.mesh.face_adjacency
    ends = surface.vertices[surface.mesh.face_adjacency_edges]
    points = 0.3 * ends[:, 0] + 0.7 * ends[:, 1]
    upper = surface.face_normals[across[:, 0], 1] > 0.7
    first, second = (
        patches.shift(faces, surface.barycentric(points, faces), UP)[0][upper] for faces in across.T
    )
    assert first.min() > 5e-6
    np.testing.assert_allclose(first, second, rtol=2e-3)


def test_a_box_keeps_its_faces():
    surface = box_insert(20e-3, 8e-3, 30e-3)
    faces = np.arange(12)
    shift, normals = CurvedSurface.of(surface).shift(faces, scattered(surface, faces)[1], UP)
    np.testing.assert_array_equal(shift, 0.0)
    np.testing.assert_allclose(normals, surface.face_normals, atol=1e-12)


def test_a_flat_that_meets_a_fillet_stays_flat():
    """Corner normals are tilted at the start of the fillet; the flat must not bulge."""
    radius, x = 3e-3, np.concatenate([np.linspace(-6e-3, 0, 7), np.linspace(0.5e-3, 2.5e-3, 5)])

    def height(gx, _):
        return np.sqrt(radius**2 - np.clip(gx, 0.0, None) ** 2) - radius

    surface = sheet(x, np.linspace(-2e-3, 2e-3, 5), height)
    faces = np.arange(len(surface.faces))
    points, weights = scattered(surface, faces)
    shift, _ = CurvedSurface.of(surface).shift(faces, weights, UP)
    inner = np.abs(points[:, 2]) < 1e-3
    flat, fillet = (
        inner & (points[:, 0] < 0),
        inner & (points[:, 0] > 0.5e-3) & (points[:, 0] < 1.5e-3),
    )
    exact = height(points[:, 0], 0.0) - points[:, 1]
    assert np.abs(shift[flat]).max() < 1e-6
    assert np.abs(shift - exact)[fillet].max() < 0.35 * exact[fillet].max()


@pytest.mark.parametrize("slope", [0.0, 0.7])
def test_a_saddle_is_approximated_closely(slope):
    """A quadratic height field, level and inclined."""
    x = np.linspace(-5e-3, 5e-3, 11)

    def height(gx, gz):
        return gx**2 / 40e-3 - gz**2 / 60e-3 + slope * gx

    surface = sheet(x, x, height)
    inner = np.abs(surface.triangles[..., [0, 2]]).max(axis=(1, 2)) < 4.5e-3
    faces = np.flatnonzero(inner)
    points, weights = scattered(surface, faces)
    shift, _ = CurvedSurface.of(surface).shift(faces, weights, UP)
    exact = height(points[:, 0], points[:, 2]) - points[:, 1]
    assert np.abs(shift - exact).max() < 0.1 * np.abs(exact).max()


def surface(mesh: trimesh.Trimesh) -> Surface:
    return Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces), mesh.metadata.get("name", ""))


def test_rim_of_a_cylinder_does_not_tilt_the_wall() -> None:
    part = surface(trimesh.creation.cylinder(0.02, 0.05, sections=180))
    normals = part.corner_normals
    wall = np.abs(part.face_normals[:, 2]) < 0.5
    corners = part.triangles[wall]
    radial = corners * [1.0, 1.0, 0.0]
    radial /= np.linalg.norm(radial, axis=2, keepdims=True)
    assert normals[wall] == pytest.approx(radial, abs=1e-3)
    flat = np.broadcast_to(part.face_normals[~wall][:, None], normals[~wall].shape)
    assert normals[~wall] == pytest.approx(flat, abs=1e-12)


def test_corner_normals_of_a_sphere_are_more_accurate_than_facet_normals() -> None:
    """The error is below a tenth of the facets' error, and falls with the edge length."""
    errors = []
    for level in (3, 4, 5):
        part = surface(trimesh.creation.icosphere(level, 1.0))
        error = np.linalg.norm(part.corner_normals - part.triangles, axis=2)
        facets = np.linalg.norm(part.face_normals[:, None] - part.triangles, axis=2)
        assert error.mean() < 0.1 * facets.mean()
        errors.append(error.mean())
    assert errors[0] > 1.9 * errors[1] > 1.9**2 * errors[2]


def test_sharp_and_open_edges_of_a_box() -> None:
    box = trimesh.creation.box()
    assert sharp_edges(surface(box)).sum() == 24
    opened = Surface(np.asarray(box.vertices), np.asarray(box.faces[1:]), "opened")
    assert sharp_edges(opened).sum() == 24 - 2 + 1
