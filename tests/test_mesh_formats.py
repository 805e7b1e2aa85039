"""Variants of mesh files: polygons, textures, trailing bytes, units, far origins."""

import logging
import struct

import numpy as np
import pytest
import trimesh

from shapes import joined, plate, two_dishes
from tkamb.cli import main
from tkamb.errors import InputError
from tkamb.geometry.polygons import CrossedPolygonError, triangulated
from tkamb.geometry.surface import Surface
from tkamb.geometry.topology import is_closed
from tkamb.io.recordings.mesh_check import check_mesh
from tkamb.io.recordings.meshes import (
    coordinate_rounding,
    load_surface,
    plausible_units,
    read_triangles,
)
from tkamb.units import LENGTH

NOTCHED = [(-25, -38), (25, -38), (25, 38), (-25, 38), (-25, 8), (-7, 8), (-7, -8), (-25, -8)]
STAR = [(40 * np.cos(a), (40 if n % 2 else 14) * np.sin(a)) for n, a in
        enumerate(np.linspace(0, 2 * np.pi, 24, endpoint=False))]  # fmt: skip
COMB = [(-25, -38), (25, -38), (25, 38), *[(x, z) for k in range(6)
        for x, z in ((25 - 8 * k, 38), (25 - 8 * k, -20), (21 - 8 * k, -20), (21 - 8 * k, 38))][1:],
        (-25, 38)]  # fmt: skip
WITH_HOLE = [(-25, -38), (25, -38), (25, 38), (-25, 38), (-25, -38), (-5, -8), (-5, 8), (5, 8),
             (5, -8), (-5, -8)]  # fmt: skip
"""An outline with a hole, joined to it by a slit."""
OUTLINES = {"notch": NOTCHED, "star": STAR, "comb": COMB}


def prism(outline, height=9.0):
    """Return vertices (2 n, 3) and polygons of a prism; each face is one polygon."""
    n = len(outline)
    vertices = [(x, y, z) for y in (0.0, height) for x, z in outline]
    faces = [list(range(n)), list(range(2 * n - 1, n - 1, -1))]
    faces += [[i, i + n, (i + 1) % n + n, (i + 1) % n] for i in range(n)]
    return np.array(vertices, float), faces


def area_of(outline):
    x, z = np.array(outline, float).T
    return abs(np.sum(x * np.roll(z, -1) - z * np.roll(x, -1))) / 2


def write_obj(path, vertices, faces, first=1, texture=""):
    lines = [texture] + ["v {!r} {!r} {!r}".format(*map(float, v)) for v in vertices]
    lines += ["f " + " ".join(f"{i + first}" for i in face) for face in faces]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def ply_header(form, vertices, faces, extra="", real="double", more=""):
    return (
        f"ply\nformat {form} 1.0\n{extra}element vertex {len(vertices)}\n"
        + "".join(f"property {real} {axis}\n" for axis in "xyz")
        + f"element face {len(faces)}\nproperty list uchar int vertex_indices\n{more}end_header\n"
    )


def write_ply(path, vertices, faces, extra="", more="", tail=""):
    text = ply_header("ascii", vertices, faces, extra, more=more)
    text += "".join("{!r} {!r} {!r}\n".format(*map(float, v)) for v in vertices)
    text += "".join(f"{len(f)} {' '.join(map(str, f))}{tail}\n" for f in faces)
    path.write_text(text, encoding="utf-8")
    return path


def write_binary_ply(path, vertices, faces, big=False):
    order = ">" if big else "<"
    data = ply_header(f"binary_{'big' if big else 'little'}_endian", vertices, faces).encode()
    data += b"".join(struct.pack(order + "3d", *v) for v in vertices)
    data += b"".join(struct.pack(f"{order}B{len(f)}i", len(f), *f) for f in faces)
    path.write_bytes(data)
    return path


def write_vtp(path, vertices, faces):
    points = " ".join(repr(float(value)) for value in np.ravel(vertices))
    index = " ".join(str(i) for face in faces for i in face)
    ends = " ".join(map(str, np.cumsum([len(face) for face in faces])))
    path.write_text(
        '<VTKFile type="PolyData" byte_order="LittleEndian"><PolyData>'
        f'<Piece NumberOfPoints="{len(vertices)}" NumberOfPolys="{len(faces)}">'
        f'<Points><DataArray type="Float64" NumberOfComponents="3" format="ascii">{points}'
        '</DataArray></Points><Polys><DataArray type="Int64" Name="connectivity" format="ascii">'
        f'{index}</DataArray><DataArray type="Int64" Name="offsets" format="ascii">{ends}'
        "</DataArray></Polys></Piece></PolyData></VTKFile>",
        encoding="utf-8",
    )
    return path


WRITERS = {
    "obj": write_obj,
    "ply": write_ply,
    "ply little": write_binary_ply,
    "ply big": lambda *all: write_binary_ply(*all, big=True),
    "vtp": write_vtp,
}


@pytest.mark.parametrize("writer", WRITERS)
@pytest.mark.parametrize("outline", OUTLINES)
def test_concave_polygons_keep_their_shape(writer, outline, tmp_path):
    points, faces = prism(OUTLINES[outline])
    path = WRITERS[writer](tmp_path / f"part.{writer[:3]}", points, faces)
    surface = load_surface(path, "mm", name="insert", closed=True)
    assert is_closed(surface.faces)
    assert surface.volume == pytest.approx(9e-9 * area_of(OUTLINES[outline]), rel=1e-12)
    top = surface.face_normals[:, 1] > 0.5
    assert surface.areas[top].sum() == pytest.approx(1e-6 * area_of(OUTLINES[outline]), rel=1e-12)
    assert check_mesh(path).watertight


def test_a_polygon_with_a_hole_and_a_slit_keeps_its_area():
    points = np.array([(x, 0.0, z) for x, z in WITH_HOLE])
    faces = triangulated(points, np.arange(len(points)), np.array([len(points)]))
    a, b, c = np.moveaxis(points[faces], 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    assert area == pytest.approx(50 * 76 - 10 * 16)


def test_convex_polygons_stay_fans_and_crossed_ones_are_refused(tmp_path):
    square = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], float)
    fan = triangulated(square, np.arange(4), np.array([4]))
    assert fan.tolist() == [[0, 1, 2], [0, 2, 3]]
    crossed = np.array([(0, 0, 0), (4, 0, 0), (0, 1, 0), (4, 1, 0)], float)
    with pytest.raises(CrossedPolygonError):
        triangulated(crossed, np.arange(4), np.array([4]))
    with pytest.raises(InputError, match="crosses itself"):
        read_triangles(write_obj(tmp_path / "crossed.obj", crossed, [range(4)]))


def test_negative_indices_count_back_from_their_line(tmp_path):
    points, faces = prism(NOTCHED)
    text, count = "", len(points)
    for shift in (0.0, 60.0):
        text += "".join(f"v {x + shift:g} {y:g} {z:g}\n" for x, y, z in points)
        text += "".join("f " + " ".join(f"{i - count}//1" for i in f) + "\n" for f in faces)
    path = tmp_path / "blocks.obj"
    path.write_text(text, encoding="utf-8")
    vertices, triangles = read_triangles(path)
    assert len(vertices) == 2 * count
    surface = Surface(vertices, triangles)
    assert surface.volume == pytest.approx(2 * 9 * area_of(NOTCHED))
    assert np.ptp(surface.bounds[:, 0]) == pytest.approx(110.0)


@pytest.mark.parametrize(
    "line", ["f 1 2 99", "f 0 1 2", "f -1 -2 -99", "f 1 2 x", "v 1 2", "v a b c"]
)
def test_a_bad_line_of_an_obj_file_is_refused_in_one_line(line, tmp_path):
    path = write_obj(tmp_path / "bad.obj", *prism(NOTCHED))
    path.write_text(path.read_text("utf-8") + line + "\n", encoding="utf-8")
    with pytest.raises(InputError, match="cannot be read as a mesh") as caught:
        read_triangles(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", ["texture", "coordinates", "materials"])
def test_a_missing_texture_has_no_influence(kind, tmp_path, capsys):
    points, faces = prism(NOTCHED)
    if kind == "materials":
        path = write_obj(tmp_path / "part.obj", points, faces, texture="mtllib none.mtl\nusemtl a")
    else:
        extra, more, tail = "comment TextureFile none.png\n", "", ""
        if kind == "coordinates":
            more, tail = "property list uchar float texcoord\nproperty uchar red\n", " 2 0.5 0.5 9"
        path = write_ply(tmp_path / "part.ply", points, faces, extra, more, tail)
    assert main(["mesh", "check", str(path)]) == 0
    message = capsys.readouterr()
    assert "watertight" in message.out
    assert "Traceback" not in message.err


@pytest.mark.parametrize("form", ["ascii", "binary"])
def test_a_truncated_ply_file_is_refused(form, tmp_path):
    write = write_ply if form == "ascii" else write_binary_ply
    path = write(tmp_path / "part.ply", *prism(NOTCHED))
    data = path.read_bytes()
    path.write_bytes(data[: len(data) - 40])
    with pytest.raises(InputError, match="cut short"):
        read_triangles(path)


def stl(surface, scale=1e3):
    mesh = trimesh.Trimesh(surface.vertices * scale, surface.faces, process=False)
    return mesh.export(file_type="stl")


@pytest.mark.parametrize("tail", [b"\0" * 37, b"\0", b"attributes " * 40, b"\xff" * 500])
def test_bytes_after_the_last_triangle_are_ignored_with_a_notice(tail, tmp_path, caplog):
    (path := tmp_path / "part.stl").write_bytes(stl(plate()) + tail)
    with caplog.at_level(logging.WARNING, "tkamb"):
        surface = load_surface(path, "mm", name="insert", closed=True)
    assert surface.volume == pytest.approx(plate().volume, rel=1e-6)
    assert f"{len(tail)} bytes after the last triangle are ignored" in caplog.text


@pytest.mark.parametrize("count", [0, 2**32 - 1])
def test_an_stl_with_a_wrong_number_of_triangles_is_read(count, tmp_path, caplog):
    data = bytearray(stl(plate()))
    data[80:84] = count.to_bytes(4, "little")
    (path := tmp_path / "part.stl").write_bytes(bytes(data))
    with caplog.at_level(logging.WARNING, "tkamb"):
        surface = load_surface(path, "mm", name="insert", closed=True)
    assert surface.volume == pytest.approx(plate().volume, rel=1e-6)
    assert "does not state its number of triangles" in caplog.text


def test_solids_one_after_the_other_are_all_read(tmp_path):
    moved = Surface(plate().vertices + np.array([0.2, 0.0, 0.0]), plate().faces)
    (path := tmp_path / "part.stl").write_bytes(stl(plate()) + stl(moved))
    assert len(read_triangles(path)[1]) == 2 * len(plate().faces)


@pytest.mark.parametrize("header", [b"solid made by CAD", b"  solid facets"])
def test_a_binary_stl_may_begin_with_the_word_solid(header, tmp_path):
    (path := tmp_path / "part.stl").write_bytes(header.ljust(80, b" ") + stl(plate())[80:] + b"\0")
    assert len(read_triangles(path)[1]) == len(plate().faces)


def test_a_truncated_binary_stl_is_refused_with_its_number_of_triangles(tmp_path):
    (path := tmp_path / "part.stl").write_bytes(stl(plate())[:-120])
    with pytest.raises(InputError, match=r"cut short: \d+ of \d+ triangles"):
        read_triangles(path)


def knee():
    """Return two condyles, 70 mm wide."""
    return two_dishes()


@pytest.mark.parametrize("width", [0.052, 0.070, 0.085])
def test_the_unit_follows_from_the_width_of_a_knee(width):
    inches, millimetres = width / 0.0254, width * 1e3
    assert plausible_units(inches) == ["inch"]
    assert plausible_units(millimetres) == ["mm"]
    assert plausible_units(millimetres / 10)[0] == "cm"
    assert plausible_units(width) == ["m"]


def test_a_mesh_in_inches_is_read_as_such(tmp_path):
    (path := tmp_path / "part.stl").write_bytes(stl(plate(), 1 / 0.0254))
    surface = load_surface(path, "inch", name="insert", closed=True)
    assert surface.volume == pytest.approx(plate().volume, rel=1e-5)
    for unit in set(LENGTH) - {"inch"}:
        with pytest.raises(InputError, match="'inch' would make it"):
            load_surface(path, unit, name="insert", closed=True)


def test_two_condyles_29_mm_wide_are_refused(tmp_path):
    balls = []
    for z in (-9.0, 9.0):
        ball = trimesh.creation.icosphere(3, 5.5)
        ball.apply_translation([0.0, 0.0, z])
        balls.append(ball)
    trimesh.util.concatenate(balls).export(tmp_path / "knee.stl")
    with pytest.raises(InputError, match="smaller than any person's knee"):
        load_surface(tmp_path / "knee.stl", "mm", name="femoral component")


@pytest.mark.parametrize("suffix", ["stl", "ply", "obj"])
@pytest.mark.parametrize("axis", range(3))
def test_coordinates_rounded_far_from_the_origin_are_refused(suffix, axis, tmp_path):
    ball = trimesh.creation.icosphere(4, 30.0)
    ball.vertices[:, axis] += 1e5
    rounded = ball.vertices.astype(np.float32).astype(float)
    if suffix == "obj":
        rounded = np.array([[float(f"{value:.7g}") for value in row] for row in ball.vertices])
    path = tmp_path / f"part.{suffix}"
    if suffix == "stl":
        ball.export(path)
    else:
        {"ply": write_binary_ply, "obj": write_obj}[suffix](path, rounded, ball.faces.tolist())
    with pytest.raises(InputError, match="mm from the origin of its file, where coordinates"):
        load_surface(path, "mm", name="femoral component")


def test_far_coordinates_with_full_precision_are_read(tmp_path, caplog):
    """In double precision, or as round numbers that single precision represents exactly."""
    points, faces = prism(STAR)
    path = write_obj(tmp_path / "part.obj", points + np.array([1e5, 0, 0]), faces)
    assert load_surface(path, "mm", name="insert", closed=True).volume == pytest.approx(
        9e-9 * area_of(STAR), rel=1e-6
    )
    box = trimesh.creation.box((50.0, 10.0, 80.0))
    box.apply_translation([1e5, 0, 0])
    box.export(tmp_path / "part.stl")
    assert len(load_surface(tmp_path / "part.stl", "mm", name="insert", closed=True).faces) == 12
    ball = trimesh.creation.icosphere(3, 30.0)
    ball.apply_translation([9000.0, 0, 0])
    ball.export(tmp_path / "near.stl")
    with caplog.at_level(logging.WARNING, "tkamb"):
        load_surface(tmp_path / "near.stl", "mm", name="insert")
    assert coordinate_rounding(ball.vertices.astype(np.float32)) == pytest.approx(0.00098, rel=0.01)


def test_two_parts_of_one_obj_file_are_joined(tmp_path):
    parts = joined(plate(), plate())
    path = write_obj(tmp_path / "two.obj", parts.vertices * 1e3, parts.faces.tolist())
    assert len(read_triangles(path)[1]) == len(parts.faces)
