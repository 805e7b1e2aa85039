"""The insert's flat bottom, and the insert frame that it defines."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from shapes import joined, plate, two_dishes
from tkamb.errors import InputError
from tkamb.geometry.flat_bottom import FLATNESS, find_flat_bottom, find_flats, insert_placement
from tkamb.geometry.frames import pose, transform
from tkamb.geometry.surface import Surface
from tkamb.io.recordings.meshes import axes_rotation, load_surface

DATA = Path(__file__).parents[2] / "shared" / "data"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="the measured data are missing")

AXES = ["+x,+y,+z", "-x,+y,-z", "+z,+x,+y", "+y,-z,-x", "-z,-x,+y", "+x,-z,+y"]


def tilted(surface, x_deg, z_deg, shift=(0.003, -0.02, 0.011)):
    turn = Rotation.from_rotvec(np.radians([x_deg, 0.0, z_deg])).as_matrix()
    return surface.moved(pose(turn, shift))


def box(x, y, z, centre=(0.0, 0.0, 0.0)):
    mesh = trimesh.creation.box((x, y, z))
    return Surface(np.asarray(mesh.vertices) + centre, np.asarray(mesh.faces, np.int64), "box")


def test_the_origin_of_the_insert_frame_is_the_middle_of_the_bottom():
    insert = two_dishes()
    placement = insert_placement(insert.moved(pose(np.eye(3), [0.01, -0.3, 0.02])))
    assert np.allclose(placement, pose(np.eye(3), [-0.01, 0.3, -0.02]), atol=1e-15)
    flat = find_flat_bottom(insert)
    assert flat.area == pytest.approx(0.044 * 0.076)
    assert np.allclose(flat.normal, [0, -1, 0], atol=1e-12)
    assert np.allclose(flat.centre, 0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("x_deg", "z_deg"), [(10, 0), (-10, 0), (0, 10), (0, -10), (7, -7), (25, 0)]
)
def test_a_tilt_is_turned_level_by_the_smallest_rotation(x_deg, z_deg):
    insert = two_dishes()
    tilted_insert = tilted(insert, x_deg, z_deg)
    placed = transform(insert_placement(tilted_insert), tilted_insert.vertices)
    assert np.allclose(placed, insert.vertices, atol=1e-12)


def test_a_tilt_beyond_the_limit_is_refused():
    with pytest.raises(InputError, match="tilted by 40 deg"):
        insert_placement(tilted(two_dishes(), 40, 0))


@pytest.mark.parametrize("axes", AXES)
def test_permuted_axes_give_the_same_digits(axes):
    insert = two_dishes()
    rotation = axes_rotation(axes)
    in_mesh = insert.vertices @ rotation
    back = Surface(in_mesh @ rotation.T + 0.0, insert.faces)
    assert np.array_equal(back.vertices, insert.vertices)
    assert np.array_equal(insert_placement(back), insert_placement(insert))


def test_wrong_axes_are_refused_with_the_name_of_the_mesh_axis():
    rotation = axes_rotation("+y,+z,+x")
    wrong = Surface(two_dishes().vertices @ rotation.T, two_dishes().faces, "insert")
    with pytest.raises(InputError, match=r"faces -y of the mesh.*-z is inferior") as caught:
        insert_placement(wrong, rotation)
    assert "superior is +y" in str(caught.value)


def test_the_bottom_is_found_with_noise_and_fine_triangles():
    insert = two_dishes()
    rng = np.random.default_rng(3)
    noisy = Surface(insert.vertices + rng.normal(0, 1e-5, insert.vertices.shape), insert.faces)
    flat = find_flat_bottom(tilted(noisy, 10, 0))
    assert flat.area == pytest.approx(0.044 * 0.076, rel=0.02)
    assert flat.noise == pytest.approx(1e-5, rel=0.2)
    placement = insert_placement(noisy)
    assert np.allclose(placement, np.eye(4), atol=3e-5)


def test_the_axes_decide_between_equal_sides_of_a_block():
    assert np.allclose(insert_placement(plate()), np.eye(4), atol=1e-12)
    cube = insert_placement(box(0.03, 0.03, 0.03))
    assert np.allclose(cube[:3, 3], [0, 0.015, 0], atol=1e-12)


def test_a_larger_side_wall_gives_a_notice(caplog):
    placement = insert_placement(box(0.02, 0.03, 0.02))
    assert placement[1, 3] == pytest.approx(0.015)
    assert "another is larger" in caplog.text


def test_two_possible_bottoms_are_refused_with_their_places():
    bodies = joined(box(0.03, 0.01, 0.03), box(0.03, 0.01, 0.03, (0.031, 0.002, 0.0)))
    with pytest.raises(InputError, match="two flats that could be its bottom") as caught:
        insert_placement(bodies)
    assert str(caught.value).count("900 mm²") == 2


def test_the_clearly_larger_of_two_levels_is_the_bottom():
    bodies = joined(box(0.03, 0.01, 0.03), box(0.02, 0.008, 0.03, (0.026, 0.001, 0.0)))
    assert find_flat_bottom(bodies).area == pytest.approx(9e-4)


def test_a_sphere_has_no_flat_bottom():
    ball = trimesh.creation.icosphere(4, 0.03)
    flats = find_flats(Surface(np.asarray(ball.vertices), np.asarray(ball.faces)))
    assert all(flat.area < 0.02 * ball.area for flat in flats)


@needs_data
@pytest.mark.parametrize("subject", ["dm", "jw"])
def test_the_frame_of_a_real_insert_does_not_depend_on_tilt_and_noise(subject):
    path = DATA / subject / "geometry" / "tibial_insert.stl"
    insert = load_surface(path, "m", "-x,+y,-z", name="insert", closed=True)
    placement = insert_placement(insert)
    assert np.array_equal(placement[:3, :3], np.eye(3))
    placed = insert.moved(placement)
    assert abs(placed.bounds[0, 1]) < FLATNESS
    flat = find_flat_bottom(insert)
    assert 2.0e-3 < flat.area < 2.4e-3
    for x_deg, z_deg in [(10, 0), (-10, 0), (0, 10), (0, -10)]:
        tilted_insert = tilted(insert, x_deg, z_deg)
        levelled = transform(insert_placement(tilted_insert), tilted_insert.vertices)
        assert np.allclose(levelled, placed.vertices, atol=1e-8)
    rng = np.random.default_rng(0)
    noisy = Surface(insert.vertices + rng.normal(0, 1e-5, insert.vertices.shape), insert.faces)
    assert np.allclose(insert_placement(noisy), placement, atol=2.5e-4)
