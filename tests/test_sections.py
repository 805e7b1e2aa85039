"""Corner normals: sharp at edges, smooth elsewhere."""

import numpy as np
import pytest
import trimesh

from tkamb.geometry.surface import Surface, sharp_edges


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
