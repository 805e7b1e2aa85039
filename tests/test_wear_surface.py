"""The worn insert: refinement without cracks, and the balance of the worn volume."""

import numpy as np
import pytest

import shapes
from contact_bodies import dished_insert, flat_insert
from tkamb.studies.wear.engine import ArticularSurface, refined, volume

MM = 1e-3


def longest_edge(surface, faces):
    corners = surface.triangles[faces]
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max()


@pytest.mark.parametrize("spacing", [0.7, 2.3, 11.0])
def test_refinement_keeps_a_box_closed_with_its_volume_and_area(spacing):
    box = flat_insert(8 * MM)
    fine = refined(box, spacing * MM, lambda s: s.face_normals[:, 1] > 0.1)
    assert fine.mesh.is_watertight
    assert volume(fine) == pytest.approx(volume(box), rel=1e-13)
    assert longest_edge(fine, fine.face_normals[:, 1] > 0.1) <= spacing * MM
    assert fine.mesh.area == pytest.approx(box.mesh.area, rel=1e-12)


def test_a_fine_surface_is_not_refined():
    box = flat_insert(8 * MM)
    assert refined(box, 1.0, lambda s: np.ones(len(s.faces), bool)) is box


def test_the_volume_of_a_box_and_a_dish_has_the_closed_form():
    assert volume(flat_insert(8 * MM)) == pytest.approx(30 * 30 * 8e-9, rel=1e-13)
    dish = dished_insert(lambda x, z: 5 * MM + 10 * (x**2 + z**2), spacing=0.25 * MM)
    exact = 0.03**2 * 5 * MM + 10 * 2 * 0.03 * 2 * 0.015**3 / 3
    assert volume(dish) == pytest.approx(exact, rel=3e-4)


@pytest.mark.parametrize("insert", [shapes.two_dishes(), shapes.trough(0.02), shapes.plate()])
def test_the_mesh_loses_the_volume_of_the_wear_map(insert):
    articular = ArticularSurface.of_insert(insert, 1.5 * MM)
    points = articular.surface.vertices[articular.vertices]
    fall, mapped = np.zeros(len(points)), 0.0
    for seed in range(3):
        depth = 0.2 * MM * np.exp(-(points[:, 0] ** 2 + (points[:, 2] - 0.02) ** 2) / 5e-5)
        depth *= np.random.default_rng(seed).uniform(0.5, 1.0, len(depth))
        normals, area = articular.normals_and_areas(articular.lowered(fall))
        fall, mapped = fall + depth / normals[:, 1], mapped + depth @ area
    lost = volume(articular.surface) - volume(articular.lowered(fall))
    assert mapped > 1e-9
    assert lost == pytest.approx(mapped, rel=1e-9)
    assert articular.lowered(fall).mesh.is_watertight


def test_a_spherical_dish_loses_the_volume_of_a_shell():
    """A dish of radius R that loses h along its normals loses h times area, to first order."""
    radius, half, depth = 30 * MM, 15 * MM, 1e-3 * MM
    dish = dished_insert(
        lambda x, z: 35 * MM - np.sqrt(radius**2 - x**2 - z**2), half, half, 0.5 * MM
    )
    articular = ArticularSurface.of_insert(dish, 1 * MM)
    normals, area = articular.normals_and_areas(articular.surface)
    points = articular.surface.vertices[articular.vertices]
    inside = np.hypot(points[:, 0], points[:, 2]) < 10 * MM
    cap = 2 * np.pi * radius * (radius - np.sqrt(radius**2 - (10 * MM) ** 2))
    assert (depth * area)[inside].sum() == pytest.approx(depth * cap, rel=0.01)
    to_centre = np.array([0, 35 * MM, 0]) - points[inside]
    to_centre /= np.linalg.norm(to_centre, axis=1)[:, None]
    assert np.einsum("ij,ij->i", to_centre, normals[inside]).min() > 0.9995


def test_thickness_reaches_to_the_bottom_and_undersides_do_not_wear():
    articular = ArticularSurface.of_insert(shapes.trough(0.02), 1.5 * MM)
    points = articular.surface.vertices[articular.vertices]
    assert articular.thickness == pytest.approx(points[:, 1], abs=1e-9)
    assert points[:, 1].min() > 5 * MM
