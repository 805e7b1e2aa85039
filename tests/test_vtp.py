"""VTK PolyData is read in every encoding that VTK writes. Truncated and other files are refused."""

import base64
import tracemalloc
import zlib
from itertools import product

import numpy as np
import pytest

from shapes import two_dishes
from tkamb.errors import InputError
from tkamb.io.mesh_files import write_triangles
from tkamb.io.recordings.meshes import load_surface, read_triangles

BODY = two_dishes(0.05)
ARRAYS = {
    "points": 1e3 * BODY.vertices,
    "connectivity": BODY.faces.ravel(),
    "offsets": 3 * np.arange(1, len(BODY.faces) + 1),
}


def words(values, header, order):
    return np.array(values, np.dtype(order + header)).tobytes()


def coded(array, header, order, packed, apart, raw):
    """Return an array as VTK writes it: header and data, in base64 or raw."""
    data = array.tobytes()
    if packed:
        block = 4096
        parts = [data[i : i + block] for i in range(0, len(data), block)]
        squeezed = [zlib.compress(part) for part in parts]
        last = len(parts[-1]) if len(parts[-1]) < block else 0
        head = words([len(parts), block, last, *map(len, squeezed)], header, order)
        data = b"".join(squeezed)
    else:
        head = words([len(data)], header, order)
    if raw:
        return head + data
    if packed or apart:
        return base64.b64encode(head) + base64.b64encode(data)
    return base64.b64encode(head + data)


def written(path, mode, header="u4", order="<", packed=False, apart=False, arrays=ARRAYS):
    """Write a .vtp; mode: ascii, binary, base64 (appended) or raw (appended)."""
    kinds = {
        "points": ("f4", "Float32"),
        "connectivity": ("i8", "Int64"),
        "offsets": ("i4", "Int32"),
    }
    blocks, tags, start = [], {}, 0
    for name, values in arrays.items():
        code, kind = kinds[name]
        tag = f'<DataArray type="{kind}" Name="{name}" NumberOfComponents="1"'
        array = values.astype(order + code)
        if mode == "ascii":
            text = " ".join(map(str, array.ravel().tolist()))
            tags[name] = f'{tag} format="ascii">{text}</DataArray>'
            continue
        block = coded(array, header, order, packed, apart, mode == "raw")
        if mode == "binary":
            tags[name] = f'{tag} format="binary">\n {block.decode()}\n</DataArray>'
        else:
            tags[name] = f'{tag} format="appended" offset="{start}"/>'
            blocks.append(block)
            start += len(block)
    polys = len(arrays["offsets"])
    head = (
        f'<?xml version="1.0"?><VTKFile type="PolyData" version="1.0" header_type='
        f'"{"UInt32" if header == "u4" else "UInt64"}" '
        f'byte_order="{"LittleEndian" if order == "<" else "BigEndian"}"'
        + (' compressor="vtkZLibDataCompressor"' if packed else "")
        + f'><PolyData><Piece NumberOfPoints="{len(arrays["points"])}" NumberOfPolys="{polys}">'
        f"<PointData/><Points>{tags['points']}</Points><Polys>{tags['connectivity']}"
        f"{tags['offsets']}</Polys></Piece></PolyData>"
    ).encode()
    if blocks:
        encoding = b"raw" if mode == "raw" else b"base64"
        tail = b'<AppendedData encoding="' + encoding + b'">\n_' + b"".join(blocks)
        head += tail + b"\n</AppendedData>"
    path.write_bytes(head + b"</VTKFile>")
    return path


@pytest.mark.parametrize("mode", ["ascii", "binary", "base64", "raw"])
def test_every_encoding_gives_the_same_body(mode, tmp_path):
    for header, order, packed, apart in product(("u4", "u8"), "<>", (False, True), (False, True)):
        path = written(tmp_path / "part.vtp", mode, header, order, packed, apart)
        vertices, faces = read_triangles(path)
        assert np.array_equal(faces, BODY.faces)
        assert np.array_equal(vertices, (1e3 * BODY.vertices).astype("f4"))


def test_a_written_vtp_is_read_again(tmp_path):
    write_triangles(tmp_path / "part.vtp", BODY.vertices, BODY.faces, {})
    surface = load_surface(tmp_path / "part.vtp", "m", name="insert", closed=True)
    assert np.array_equal(surface.vertices, BODY.vertices)
    assert np.array_equal(surface.faces, BODY.faces)


def test_polygons_are_divided_into_triangles(tmp_path):
    box = np.array([[x, y, z] for x in (0, 40) for y in (0, 10) for z in (0, 60.0)])
    sides = [0, 1, 3, 2, 4, 6, 7, 5, 0, 4, 5, 1, 2, 3, 7, 6, 0, 2, 6, 4, 1, 5, 7, 3]
    arrays = {"points": box, "connectivity": np.array(sides), "offsets": np.arange(4, 25, 4)}
    path = written(tmp_path / "box.vtp", "ascii", arrays=arrays)
    surface = load_surface(path, "mm", name="insert", closed=True)
    assert len(surface.faces) == 12
    assert surface.mesh.volume == pytest.approx(40e-3 * 10e-3 * 60e-3)


@pytest.mark.parametrize("mode", ["ascii", "binary", "base64", "raw"])
@pytest.mark.parametrize("packed", [False, True])
def test_a_file_cut_short_anywhere_is_refused(mode, packed, tmp_path):
    whole = written(tmp_path / "whole.vtp", mode, packed=packed).read_bytes()
    for share in (0.0, 0.01, 0.3, 0.6, 0.97):
        (tmp_path / "cut.vtp").write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(InputError, match=r"cut\.vtp"):
            read_triangles(tmp_path / "cut.vtp")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('type="PolyData"', 'type="UnstructuredGrid"', "it is UnstructuredGrid"),
        ('NumberOfPolys="', 'NumberOfStrips="2" NumberOfPolys="', "strips"),
        ('NumberOfPolys="', 'NumberOfPolys="1', "not as stated"),
        ('NumberOfPoints="', 'NumberOfPoints="1', "not as stated"),
        ("byte_order", 'compressor="vtkLZ4DataCompressor" byte_order', "vtkLZ4DataCompressor"),
        ('Name="offsets"', 'Name="ends"', "offsets"),
        ('format="ascii"', 'format="text"', "format 'text'"),
        ('header_type="UInt32"', 'header_type="Int8"', "header type"),
        ('type="Float32"', 'type="Complex"', "Complex"),
        ('<?xml version="1.0"?>', '<!DOCTYPE a [<!ENTITY b "c">]>', "entity"),
        ("<Polys>", "<Lines>", "mesh file"),
    ],
)
def test_what_cannot_be_read_is_named(old, new, words, tmp_path):
    path = written(tmp_path / "part.vtp", "ascii")
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(InputError, match=words) as caught:
        read_triangles(path)
    assert "\n" not in str(caught.value)


def test_a_triangle_with_a_missing_point_is_refused(tmp_path):
    arrays = ARRAYS | {"connectivity": ARRAYS["connectivity"] + 1}
    with pytest.raises(InputError, match="corner that is no point"):
        read_triangles(written(tmp_path / "part.vtp", "raw", arrays=arrays))


@pytest.mark.parametrize("mode", ["binary", "base64", "raw"])
@pytest.mark.parametrize("name", ["points", "connectivity", "offsets"])
@pytest.mark.parametrize("packed", [False, True])
def test_no_array_is_unpacked_beyond_its_stated_number(mode, name, packed, tmp_path):
    """A small compressed block may unpack to gigabytes."""
    long = np.concatenate([ARRAYS[name].ravel(), np.zeros(3_000_000, ARRAYS[name].dtype)])
    path = written(tmp_path / "part.vtp", mode, packed=packed, arrays=ARRAYS | {name: long})
    counts = f'NumberOfPoints="{len(BODY.vertices)}" NumberOfPolys="{len(BODY.faces)}"'
    content = path.read_bytes()
    begin = content.index(b"<Piece ") + len(b"<Piece ")
    end = content.index(b">", begin)
    path.write_bytes(content[:begin] + counts.encode() + content[end:])
    tracemalloc.start()
    with pytest.raises(InputError, match="larger than the number"):
        read_triangles(path)
    used = tracemalloc.get_traced_memory()[1] - 8 * path.stat().st_size
    tracemalloc.stop()
    assert used < 8_000_000
