"""A surface with finer triangles and the same shape: the lattice's result does not change."""

import numpy as np
import pytest
import trimesh

from contact_bodies import dished_insert
from lattice_bodies import above, box_insert, condyles
from scenes import MODEL
from tkamb.contact.materials import material
from tkamb.contact.pair import ContactPair
from tkamb.contact.registry import contact_model
from tkamb.contact.result import ContactStatus
from tkamb.geometry.curved import CurvedSurface
from tkamb.geometry.frames import knee_pose
from tkamb.geometry.subdivision import coarsened
from tkamb.geometry.surface import Surface
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case

UP = np.array([0.0, 1.0, 0.0])
LINEAR = material("polyethylene-linear")


def halved(surface, times=1, seed=None):
    """Return the surface with triangles divided into four; a seed shuffles and rounds them."""
    points, faces = surface.vertices, surface.faces
    for _ in range(times):
        points, faces = trimesh.remesh.subdivide(points, faces)
    if seed is not None:
        generator = np.random.default_rng(seed)
        faces = generator.permutation(faces)
        turn = (np.arange(3) + generator.integers(3, size=len(faces))[:, None]) % 3
        faces = np.take_along_axis(faces, turn, axis=1)
        points = (points * 1e3).astype(np.float32).astype(float) / 1e3  # as an STL in mm
    return Surface(np.asarray(points), np.asarray(faces, np.int64), surface.name)


def undone(surface):
    """Return the coarser triangles of a surface."""
    return coarsened(surface.vertices, surface.faces)


def ball(subdivisions=4):
    """Return a sphere of 22 mm."""
    mesh = trimesh.creation.icosphere(subdivisions, 22e-3)
    return Surface(np.array(mesh.vertices), np.array(mesh.faces, np.int64), "ball")


@pytest.mark.parametrize("times", [1, 2, 3])
@pytest.mark.parametrize("seed", [None, 5])
def test_flat_subdivision_is_undone(times, seed):
    """All coarser triangles are recovered, with the position of each finer triangle."""
    box = box_insert(20e-3, 8e-3, 30e-3)
    for surface in (box, ball(2)):
        finer = halved(surface, times, seed)
        result = undone(finer)
        coarse = Surface(finer.vertices, result.faces)
        assert len(coarse.faces) == len(surface.faces)
        assert coarse.volume == pytest.approx(surface.volume, rel=1e-5)
        corners = np.einsum("kij,kjl->kil", result.corners, coarse.triangles[result.parent])
        assert np.abs(corners - finer.triangles).max() < 1e-7
        children = np.sort(np.bincount(result.parent))
        assert (children == 4**times).all()


def test_only_flat_subdivisions_are_undone():
    """One of two spheres is divided flatly. A subdivision with vertices on the sphere is another
    shape.
    """
    one, other = ball(2), halved(ball(2))
    spheres = Surface(
        np.vstack([one.vertices, other.vertices + 0.1]),
        np.vstack([one.faces, other.faces + len(one.vertices)]),
    )
    assert len(undone(spheres).faces) == 2 * len(one.faces)
    assert undone(one) is None
    assert undone(ball(3)) is None
    assert undone(condyles(subdivisions=3)) is None
    assert undone(dished_insert(lambda x, z: 8e-3 + (x**2 + z**2) / 0.08)) is None


def test_a_damaged_subdivision_is_not_undone():
    finer = halved(ball(2))
    moved = finer.vertices.copy()
    moved[-1] *= 1.0001
    assert undone(Surface(moved, finer.faces)) is None
    assert undone(Surface(finer.vertices, finer.faces[1:])) is None


def test_curved_patches_do_not_change_with_subdivision():
    surface = ball(3)
    faces = np.flatnonzero(surface.face_normals[:, 1] > 0.8)
    generator = np.random.default_rng(1)
    weights = generator.dirichlet([1, 1, 1], len(faces))
    points = np.einsum("ij,ijk->ik", weights, surface.triangles[faces])
    expected = CurvedSurface.of(surface).shift(faces, weights, UP)
    assert expected[0].max() > 1e-5
    for times in (1, 2):
        finer = halved(surface, times, seed=3)
        near = finer.rays.first(points + UP, -UP)[1]
        patches = CurvedSurface.of(finer)
        result = patches.shift(near, finer.barycentric(points, near), UP)
        assert np.abs(result[0] - expected[0]).max() < 1e-8
        assert np.abs(result[1] - expected[1]).max() < 1e-4


@pytest.mark.parametrize("cut", ["femoral", "insert"])
def test_subdivision_does_not_change_the_approach_of_a_sphere(cut):
    """The facets have a sagitta of 27 µm at an approach of 0.2 mm."""
    dish = dished_insert(lambda x, z: 8e-3 + (x**2 + z**2) / 0.08, 12e-3, 12e-3, 3e-3)
    result = []
    for times in (0, 1):
        femoral = halved(ball(), times if cut == "femoral" else 0)
        insert = halved(dish, times if cut == "insert" else 0)
        model = contact_model("lattice-linear", resolution=2e-3)
        state = model.prepare(ContactPair(femoral, insert, LINEAR))
        result.append(model.press(state, 800.0, above(0.3e-3, 0.2e-3)))
    before, after = result
    assert after.approach == pytest.approx(before.approach, rel=1e-3)
    assert after.pressure.max() == pytest.approx(before.pressure.max(), rel=1e-3)
    assert after.medial.area == pytest.approx(before.medial.area, rel=1e-3)


def test_subdivision_does_not_change_the_approach_of_the_shipped_condyles():
    case = load_case(load_scene(MODEL / "scene.toml"))
    pose = knee_pose(case.motion.coordinates[36])
    model, result = contact_model("lattice", resolution=3e-3), []
    for times in (0, 1):
        femoral, insert = halved(case.femoral, times), halved(case.insert, times)
        state = model.prepare(ContactPair(femoral, insert, material("polyethylene")))
        result.append(model.press(state, 1450.0, pose))
    before, after = result
    assert before.status is after.status is ContactStatus.OK
    assert after.approach == pytest.approx(before.approach, rel=2e-3)
    assert after.pressure.max() == pytest.approx(before.pressure.max(), rel=2e-3)
    assert after.lateral.area == pytest.approx(before.lateral.area, rel=2e-3)
