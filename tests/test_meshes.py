"""Mesh files as surfaces: axes, units, repairs with a notice, refusals in one line."""

import logging
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from shapes import joined, plate, sphere, two_dishes
from tkamb.cli import main
from tkamb.errors import InputError
from tkamb.geometry import topology
from tkamb.geometry.repair import repair
from tkamb.geometry.surface import Surface, corner_angles, corner_normals
from tkamb.geometry.topology import boundary_loops
from tkamb.io.recordings.mesh_check import check_mesh
from tkamb.io.recordings.meshes import (
    BONE_SIZE,
    axes_rotation,
    load_surface,
    read_triangles,
)

DATA = Path(__file__).parents[2] / "shared" / "data"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="the measured data are missing")


def save(path, surface, scale=1e3):
    trimesh.Trimesh(surface.vertices * scale, surface.faces, process=False).export(path)
    return path


def without(surface, faces):
    return Surface(surface.vertices, np.delete(surface.faces, faces, axis=0), surface.name)


def refused(words, *arguments, **options):
    with pytest.raises(InputError) as caught:
        load_surface(*arguments, name="insert", **options)
    message = str(caught.value)
    assert words in message
    assert "\n" not in message
    return message


def test_axes_name_the_rows_of_a_rotation():
    assert np.array_equal(axes_rotation("-x,+y,-z"), np.diag([-1.0, 1.0, -1.0]))
    assert np.array_equal(axes_rotation("z, x, y"), [[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    moved = axes_rotation("+y,-z,-x") @ [1.0, 2.0, 3.0]
    assert np.array_equal(moved, [2.0, -3.0, -1.0])


@pytest.mark.parametrize("axes", ["+x,+y", "+x,+x,+z", "+x,+y,+w", "x y z", "++x,+y,+z"])
def test_invalid_axes_are_refused(axes):
    with pytest.raises(InputError, match="three different axes"):
        axes_rotation(axes)


def test_left_handed_axes_are_refused_with_a_right_handed_suggestion():
    with pytest.raises(InputError, match="left-handed") as caught:
        axes_rotation("-x,+y,+z")
    assert np.linalg.det(axes_rotation(str(caught.value).split("'")[3])) == 1


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply"])
@pytest.mark.parametrize(("unit", "scale"), [("mm", 1e3), ("cm", 1e2), ("m", 1.0)])
def test_meshes_are_read_in_metres(tmp_path, suffix, unit, scale, caplog):
    ball = sphere(0.02, 3)
    path = save(tmp_path / f"ball.{suffix}", ball, scale)
    surface = load_surface(path, unit, name="ball", closed=True)
    assert surface.mesh.is_watertight
    assert surface.mesh.volume == pytest.approx(ball.mesh.volume, rel=1e-5)
    assert len(surface.vertices) == len(ball.vertices)
    assert not caplog.records


def test_axes_turn_the_mesh(tmp_path):
    insert = two_dishes()
    turn = axes_rotation("-z,+x,-y")
    turned = Surface(insert.vertices @ turn, insert.faces)
    path = save(tmp_path / "turned.ply", turned)
    expected = load_surface(path, "mm", "-z,+x,-y", name="insert")
    straight = load_surface(save(tmp_path / "straight.ply", insert), "mm", name="insert")
    assert np.array_equal(expected.vertices, straight.vertices)
    assert np.array_equal(expected.faces, straight.faces)


def test_a_surface_mirrored_twice_is_unchanged_and_outward():
    ball = sphere(0.02, 2, (0.0, 0.01, 0.03))
    once = ball.mirrored()
    assert once.vertices[:, 2].mean() == pytest.approx(-0.03)
    assert once.mesh.volume == pytest.approx(ball.mesh.volume)
    assert np.array_equal(once.mirrored().vertices, ball.vertices)


def test_a_wrong_unit_is_refused_with_the_correct_one(tmp_path):
    path = save(tmp_path / "plate.stl", plate())
    message = refused("no size of a part", path, "m")
    assert "'mm' would make it 60 mm" in message


def test_a_whole_bone_may_be_longer_than_an_implant(tmp_path):
    path = save(tmp_path / "bone.stl", sphere(0.2, 3))
    refused("400 mm", path, "mm")
    assert load_surface(path, "mm", name="bone", size=BONE_SIZE).bounds[1, 0] == pytest.approx(0.2)


def test_unreadable_files_are_refused(tmp_path):
    refused("no such mesh file", tmp_path / "none.stl", "mm")
    text = tmp_path / "text.stl"
    text.write_text("not a mesh at all\n")
    refused("text.stl", text, "mm")
    points = tmp_path / "points.ply"
    trimesh.PointCloud(np.random.default_rng(0).normal(size=(20, 3))).export(points)
    refused("triangles", points, "mm")
    refused("unknown unit 'foot'", save(tmp_path / "plate.stl", plate()), "foot")


def test_a_coordinate_that_is_not_a_number_is_refused(tmp_path):
    shared = plate()  # other tests use it, too
    vertices = shared.vertices.copy()
    vertices[3, 1] = np.nan
    bad = Surface(vertices, shared.faces)
    refused("not a number", save(tmp_path / "bad.stl", bad), "mm")


def test_three_sheets_on_one_edge_are_refused(tmp_path):
    vertices = np.array([[0, 0, 0], [50, 0, 0], [20, 30, 0], [20, -30, 5], [20, 0, 30.0]])
    fan = Surface(vertices, np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4], [0, 2, 4]]))
    assert "(" in refused("three or more sheets", save(tmp_path / "fan.ply", fan, 1.0), "mm")


def test_a_one_sided_strip_is_refused(tmp_path):
    n = 40
    angle = np.linspace(0, 2 * np.pi, n, endpoint=False)
    radial = np.stack([np.cos(angle), np.zeros(n), np.sin(angle)], axis=1)
    across = np.cos(angle / 2)[:, None] * radial + np.sin(angle / 2)[:, None] * [0, 1, 0]
    vertices = np.concatenate([30 * radial + 8 * across, 30 * radial - 8 * across])
    i = np.arange(n)
    j = (i + 1) % n
    a, b = i, i + n
    c, d = np.where(j == 0, n, j), np.where(j == 0, 0, j + n)
    strip = Surface(vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([c, b, d], 1)]))
    refused("only one side", save(tmp_path / "moebius.ply", strip, 1.0), "mm")


def test_each_repair_restores_the_body_with_one_notice(tmp_path, caplog):
    insert = two_dishes()
    rng = np.random.default_rng(1)
    chosen = rng.choice(len(insert.faces), 50, replace=False)
    flipped = insert.faces.copy()
    flipped[chosen] = flipped[chosen][:, ::-1]
    shared = insert.faces[0]
    cases = {
        "duplicate": np.concatenate([insert.faces, insert.faces[chosen[:3]]]),
        "degenerate": np.concatenate([insert.faces, [[5, 5, 9]]]),
        "winding": flipped,
        "inside-out": insert.faces[:, ::-1],
        "small hole": np.delete(insert.faces, chosen[:20], axis=0),
        "2 duplicate": np.concatenate([insert.faces, [shared, shared[::-1]]]),
    }
    for words, faces in cases.items():
        caplog.clear()
        path = save(tmp_path / "broken.ply", Surface(insert.vertices, faces))
        repaired = load_surface(path, "mm", name="insert", closed=True)
        assert repaired.mesh.is_watertight
        assert repaired.mesh.volume == pytest.approx(insert.mesh.volume, rel=1e-5)
        assert len(caplog.records) == 1
        assert caplog.records[0].levelno == logging.WARNING
        assert words in caplog.text
        assert "broken.ply" in caplog.text


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    lost=st.integers(0, 25),
    flipped=st.integers(0, 400),
    doubled=st.integers(0, 10),
    split=st.booleans(),
)
def test_any_mixture_of_small_defects_is_repaired(seed, lost, flipped, doubled, split):
    """Missing, flipped and duplicate triangles, with merged or separate vertices."""
    rng = np.random.default_rng(seed)
    ball = sphere(0.02, 3)
    faces = np.delete(ball.faces, rng.choice(len(ball.faces), lost, replace=False), axis=0)
    faces = np.concatenate([faces, faces[rng.choice(len(faces), doubled)]])
    turned = rng.choice(len(faces), flipped, replace=False)
    faces[turned] = faces[turned][:, ::-1]
    vertices = ball.vertices
    if split:
        vertices, faces = vertices[faces].reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3)
    repaired = repair(vertices, faces)
    surface = Surface(repaired.vertices, repaired.faces)
    wide = [hole for hole in repaired.holes if len(hole.vertices) <= 3]
    assert not wide
    assert surface.mesh.is_winding_consistent
    if not repaired.holes:
        assert surface.mesh.is_watertight
        assert surface.mesh.volume == pytest.approx(ball.mesh.volume, rel=5e-3)


def test_unreferenced_vertices_are_removed_with_a_notice(tmp_path, caplog):
    insert = two_dishes()
    more = Surface(np.concatenate([insert.vertices, [[0.0, 0.5, 0.0]]]), insert.faces)
    repaired = load_surface(save(tmp_path / "loose.ply", more), "mm", name="insert", closed=True)
    assert "1 unreferenced vertex" in caplog.text
    assert repaired.bounds[1, 1] < 0.02


def test_a_fold_without_thickness_is_removed():
    ball = sphere(0.02, 2)
    tip = ball.vertices[ball.faces[0]].mean(axis=0) * 1.2
    a, b, n = *ball.faces[0][:2], len(ball.vertices)
    folded = np.concatenate([ball.faces, [[a, b, n], [n, b, a]]])
    repaired = repair(np.vstack([ball.vertices, tip]), folded)
    assert len(repaired.faces) == len(ball.faces)
    assert repaired.notices[0] == "2 duplicate faces removed"


def test_cracks_are_welded():
    insert = two_dishes()
    rng = np.random.default_rng(2)
    corners = insert.triangles.reshape(-1, 3) + rng.uniform(-1e-5, 1e-5, (3 * len(insert.faces), 3))
    repaired = repair(corners, np.arange(len(corners)).reshape(-1, 3))
    assert not repaired.holes
    assert any("welded" in notice for notice in repaired.notices)
    volume = Surface(repaired.vertices, repaired.faces).mesh.volume
    assert volume == pytest.approx(insert.mesh.volume, rel=1e-3)


def test_a_void_inside_stays_a_void():
    shell = sphere(0.03, 3)
    void = sphere(0.02, 3)
    faces = np.concatenate([shell.faces, void.faces[:, ::-1] + len(shell.vertices)])
    repaired = repair(np.concatenate([shell.vertices, void.vertices]), faces)
    assert repaired.notices == ()
    volume = Surface(repaired.vertices, repaired.faces).mesh.volume
    assert volume == pytest.approx(shell.mesh.volume - void.mesh.volume)


def test_a_wide_hole_is_refused_in_a_closed_surface(tmp_path, caplog):
    insert = two_dishes()
    middle = insert.triangles.mean(axis=1)
    hole = np.flatnonzero(np.linalg.norm(middle - [0.0, 0.007, 0.022], axis=1) < 0.004)
    path = save(tmp_path / "holed.stl", without(insert, hole))
    message = refused("not closed", path, "mm", closed=True)
    assert "edges" in message
    assert "mm wide, at (" in message
    assert len(load_surface(path, "mm", name="insert").faces) == len(insert.faces) - len(hole)


def test_touching_holes_are_two_loops():
    insert = plate(spacing=5e-3)
    vertex = int(np.argmin(np.linalg.norm(insert.vertices - [0.0, 0.01, 0.0], axis=1)))
    around = np.flatnonzero((insert.faces == vertex).any(axis=1))
    pair = [f for f in around[1:] if len(set(insert.faces[f]) & set(insert.faces[around[0]])) == 1]
    holed = without(insert, [around[0], pair[0]])
    loops = boundary_loops(holed.vertices, holed.faces)
    assert [len(loop.vertices) for loop in loops] == [3, 3]
    assert loops[0].width == pytest.approx(5e-3 / np.sqrt(2))


def test_check_reports_and_changes_nothing(tmp_path):
    path = save(tmp_path / "insert.stl", two_dishes())
    health = check_mesh(path)
    assert health.watertight
    assert health.units == ("mm",)
    assert health.flats[0].faces == "-y"
    text = "\n".join(health.lines())
    assert "millimetres?" in text
    assert "bottom?" in text
    assert "--axes ±x,+y,±z" in text
    assert max(health.extents) == pytest.approx(76.0)
    assert health.as_dict()["components"] == 1


def test_check_lists_defects(tmp_path):
    insert = two_dishes()
    middle = insert.triangles.mean(axis=1)
    hole = np.flatnonzero(np.linalg.norm(middle - [0.0, 0.007, 0.022], axis=1) < 0.004)
    health = check_mesh(save(tmp_path / "holed.stl", without(insert, [*hole, 3])))
    assert not health.watertight
    assert len(health.holes) == 2
    assert len(health.remaining_holes) == 1
    assert not health.closed_after_repair
    assert health.remaining_holes[0].width == pytest.approx(8.0, abs=2.0)
    assert any("small hole" in phrase for phrase in health.repairs)


def test_a_mesh_without_area_is_not_reported_as_closed(tmp_path):
    line = trimesh.Trimesh([[0, 0, 0], [60, 0, 0]], [[0, 0, 1]] * 4, process=False)
    path = tmp_path / "line.stl"
    line.export(path)
    health = check_mesh(path)
    assert not health.closed_after_repair
    assert "4 degenerate faces removed" in health.repairs


def test_several_bodies_are_refused_and_can_be_separated(tmp_path, capsys):
    insert, tray = two_dishes(), sphere(0.015, 3, (0.0, -0.03, 0.0))
    void = sphere(0.002, 1, (0.0, 0.003, 0.0))
    void = Surface(void.vertices, void.faces[:, ::-1])
    path = save(tmp_path / "assembly.ply", joined(tray, insert, void))
    for closed in (True, False):
        message = refused("2 separate bodies", path, "mm", closed=closed)
        assert "30 × 30 × 30" in message
        assert "tkamb mesh part" in message
    health = check_mesh(path)
    assert [part.triangles for part in health.bodies] == [
        len(insert.faces) + len(void.faces),
        len(tray.faces),
    ]
    assert health.bodies[1].centre == pytest.approx((0.0, -30.0, 0.0), abs=1e-3)
    assert any("30 × 30 × 30 at" in line for line in health.lines())
    out = tmp_path / "insert.ply"
    assert main(["mesh", "part", str(path), "1", "--out", str(out)]) == 0
    assert "body 1 of 2" in capsys.readouterr().out
    alone = load_surface(out, "mm", name="insert", closed=True)
    expected = insert.mesh.volume - sphere(0.002, 1).mesh.volume
    assert alone.mesh.volume == pytest.approx(expected, rel=1e-6)


def test_bodies_that_cannot_be_written_are_refused(tmp_path, capsys):
    path = save(tmp_path / "insert.ply", two_dishes())
    for number, out in (("2", "new.stl"), ("0", "new.stl"), ("1", "new.txt"), ("1", "insert.ply")):
        assert main(["mesh", "part", str(path), number, "--out", str(tmp_path / out)]) == 2
        assert capsys.readouterr().err.count("\n") == 1
    assert [p.name for p in tmp_path.iterdir()] == ["insert.ply"]


def test_two_condyles_are_one_component_and_a_pair_of_two_legs_is_refused(tmp_path):
    def pair(apart, radius=0.02):
        medial, lateral = (0.0, 0.0, -apart / 2), (0.0, 0.0, apart / 2)
        return save(
            tmp_path / "pair.ply", joined(sphere(0.02, 3, medial), sphere(radius, 3, lateral))
        )

    assert len(load_surface(pair(0.046), "mm", name="femoral component").faces) == 2 * 1280
    refused("2 separate bodies", pair(0.15), "mm")
    refused("2 separate bodies", pair(0.046, 0.005), "mm")
    refused("check the axes", pair(0.046), "mm", axes="+z,+x,+y")


def test_an_open_sheet_is_refused_with_the_reason(tmp_path):
    insert = two_dishes()
    faces = np.flatnonzero(insert.mesh.face_normals[:, 1] < 0.5)
    path = save(tmp_path / "insert_contact.ply", without(insert, faces))
    for closed in (True, False):
        message = refused("open sheet", path, "mm", closed=closed)
        assert "whole closed part" in message
    assert "  an open sheet" in "\n".join(check_mesh(path).lines())
    assert "open sheet" not in "\n".join(check_mesh(save(path, insert)).lines())


@needs_data
def test_real_contact_surfaces_are_refused():
    for path in sorted((DATA / "dm" / "geometry").glob("*_contact.stl")):
        refused("open sheet", path, "m", "-x,+y,-z")


@needs_data
def test_real_parts_load(caplog):
    for subject in ("dm", "jw"):
        for part in ("femoral_component", "tibial_insert", "patellar_button"):
            caplog.clear()
            path = DATA / subject / "geometry" / f"{part}.stl"
            surface = load_surface(path, "m", "-x,+y,-z", name=part, closed=True)
            assert surface.mesh.is_watertight
            assert surface.mesh.volume > 5e-6
            expected = (subject, part) == ("jw", "femoral_component")
            assert [r.message.split("repaired: ")[1] for r in caplog.records] == (
                ["4 duplicate faces removed"] if expected else []
            )


@needs_data
@pytest.mark.parametrize("subject", ["dm", "jw"])
def test_real_inserts_with_lost_triangles_and_jitter(tmp_path, subject, caplog):
    path = DATA / subject / "geometry" / "tibial_insert.stl"
    insert = load_surface(path, "m", "-x,+y,-z", name="insert", closed=True)
    rng = np.random.default_rng(4)
    lost = without(insert, rng.choice(len(insert.faces), 20, replace=False))
    repaired = load_surface(save(tmp_path / "lost.stl", lost), "mm", name="insert", closed=True)
    assert "small holes closed" in caplog.text
    assert repaired.mesh.volume == pytest.approx(insert.mesh.volume, rel=1e-5)
    moved = insert.vertices + rng.normal(0.0, 1e-5, insert.vertices.shape)
    noisy = Surface(moved, insert.faces)
    rough = load_surface(save(tmp_path / "noisy.stl", noisy), "mm", name="insert", closed=True)
    assert rough.mesh.volume == pytest.approx(insert.mesh.volume, rel=1e-3)


def test_a_binary_stl_is_read_as_by_trimesh(tmp_path):
    path = save(tmp_path / "ball.stl", sphere(0.02))
    theirs = trimesh.load(path, force="mesh", process=False)
    vertices, faces = read_triangles(path)
    assert np.array_equal(vertices, theirs.vertices)
    assert np.array_equal(faces, theirs.faces)


@pytest.mark.parametrize("hashed", [True, False])
def test_equal_points_are_grouped_with_any_hash(monkeypatch, hashed):
    if not hashed:
        monkeypatch.setattr(topology, "_ODD", np.zeros(3, np.uint64))
    points = np.array([[0.0, 1, 2], [3, 4, 5], [-0.0, 1, 2], [3, 4, 5.5], [3, 4, 5]])
    first, place = topology.same_places(points)
    assert first.tolist() == [0, 1, 3]
    assert place.tolist() == [0, 1, 0, 2, 1]


def test_edges_and_closedness_agree_with_trimesh():
    ball = sphere(0.02)
    edge, count = topology.edge_use(ball.faces)
    edges = np.empty((len(count), 2), np.int64)
    edges[edge] = np.sort(topology.half_edges(ball.faces), axis=1)
    assert sorted(edges.tolist()) == sorted(ball.mesh.edges_unique.tolist())
    turned = ball.faces.copy()
    turned[3] = turned[3][::-1]
    assert topology.is_closed(ball.faces)
    assert not topology.is_closed(turned)
    assert not topology.is_closed(ball.faces[1:])


@pytest.mark.parametrize("surface", [plate(), sphere(0.02), two_dishes()])
def test_corner_normals_are_means_over_neighbours_within_the_crease_angle(surface):
    """Against the definition, for each triangle at a vertex."""
    weights, crease = corner_angles(surface), np.deg2rad(40.0)
    result = corner_normals(surface, crease, weights)
    for face in range(0, len(surface.faces), 97):
        for corner, vertex in enumerate(surface.corner_vertices[face]):
            around, at = np.nonzero(surface.corner_vertices == vertex)
            normals = surface.face_normals[around]
            near = normals @ surface.face_normals[face] >= np.cos(crease)
            mean = weights[around, at][near] @ normals[near]
            np.testing.assert_allclose(
                result[face, corner], mean / np.linalg.norm(mean), atol=1e-12
            )


def test_the_longest_edge_of_every_triangle():
    surface = two_dishes()
    edges = np.diff(surface.triangles[:, [0, 1, 2, 0]], axis=1)
    np.testing.assert_allclose(surface.longest_edges, np.linalg.norm(edges, axis=2).max(axis=1))
