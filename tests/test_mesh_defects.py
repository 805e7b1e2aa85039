"""Defects of meshes, unsupported bottoms and spaces of files reach the result of every model."""

import numpy as np
import pytest
import trimesh

from lattice_bodies import above, box_insert, condyles, dished_insert
from random_inserts import voxel_surface
from tkamb.contact.materials import material
from tkamb.contact.pair import ContactPair
from tkamb.contact.registry import contact_model
from tkamb.errors import InputError
from tkamb.geometry.surface import Surface
from tkamb.io.recordings.meshes import check_same_space, load_surface, space_of

FEMORAL = condyles(subdivisions=4)
INSERT = dished_insert(cells=24)
TIP = np.array([0.0, -20e-3, 10e-3])
MODELS = ("foundation", "foundation-linear", "hertz", "lattice-linear")


def flags(femoral, insert, model="foundation", load=1000.0):
    """Return the flags of a press as one text."""
    contact = contact_model(model, resolution=1.5e-3)
    pair = ContactPair(femoral, insert, material("polyethylene"))
    return "; ".join(contact.press(contact.prepare(pair), load, above()).flags)


def moved_vertices(surface, shift):
    return Surface(surface.vertices + shift, surface.faces, surface.name)


def spiked(surface, where, height):
    shift = np.zeros_like(surface.vertices)
    shift[np.linalg.norm(surface.vertices - where, axis=1).argmin(), 1] = height
    return moved_vertices(surface, shift)


def noisy(surface, size):
    shape = surface.vertices.shape
    return moved_vertices(surface, np.random.default_rng(0).normal(0.0, size, shape))


def opened(surface, where, radius):
    middle = surface.triangles.mean(axis=1)
    keep = np.linalg.norm(middle - where, axis=1) > radius
    return Surface(surface.vertices, surface.faces[keep], surface.name)


@pytest.mark.parametrize("model", MODELS)
def test_an_opening_in_the_contact_is_named_by_every_model(model):
    words = flags(opened(FEMORAL, TIP, 3e-3), INSERT, model)
    assert "femoral mesh, an opening" in words or "femoral mesh has an opening" in words


@pytest.mark.parametrize(
    ("femoral", "insert", "words"),
    [
        (spiked(FEMORAL, TIP, -0.5e-3), INSERT, "femoral mesh, a spike of 0.5 mm"),
        (noisy(FEMORAL, 3e-5), INSERT, "femoral mesh, noise"),
        (FEMORAL, spiked(INSERT, [0.0, 7e-3, 10e-3], 0.5e-3), "insert mesh, a spike"),
        (FEMORAL, noisy(INSERT, 3e-5), "insert mesh, noise"),
        (opened(FEMORAL, TIP + np.array([4e-3, 4e-4, 0.0]), 2e-3), INSERT, "an opening"),
    ],
)
def test_a_defect_in_the_contact_is_named(femoral, insert, words):
    assert words in flags(femoral, insert)


@pytest.mark.parametrize(
    "femoral",
    [
        FEMORAL,
        condyles(subdivisions=3),
        opened(FEMORAL, -TIP * [1, 1, -1], 6e-3),
        spiked(FEMORAL, [0.0, 20e-3, 10e-3], 0.5e-3),
    ],
    ids=["smooth", "coarse", "open on top", "spike on top"],
)
def test_a_defect_away_from_the_contact_is_not_flagged(femoral):
    assert "defect" not in flags(femoral, INSERT)


def test_steps_of_voxels_are_named_instead_of_finer_cells():
    lines = tuple(np.arange(-24, 25) * 1e-3 for _ in range(3))
    middle = np.stack(np.meshgrid(*(0.5 * (x[1:] + x[:-1]) for x in lines), indexing="ij"), -1)
    ball = voxel_surface(lines, np.linalg.norm(middle, axis=-1) < 22e-3)
    words = flags(ball, box_insert(20e-3, 8e-3, 20e-3), load=300.0)
    assert "femoral mesh, steps of 1 mm" in words
    assert "take finer" not in words


def with_room_below(half, low, high):
    """Return a block of 40 x 8 x 40 mm with a box-shaped room below its middle."""
    ticks = np.array([-20.0, -half, half, 20.0]) * 1e-3
    height = np.array(sorted({0.0, low, high, 8.0})) * 1e-3
    full = np.ones((3, len(height) - 1, 3), bool)
    full[1, (height[:-1] >= low * 1e-3) & (height[:-1] < high * 1e-3), 1] = False
    return voxel_surface((ticks, height, ticks), full)


@pytest.mark.parametrize("model", ["foundation", "foundation-linear", "hertz"])
@pytest.mark.parametrize(("low", "high"), [(0.0, 4.0), (2.0, 4.0)], ids=["pocket", "void"])
def test_a_contact_over_an_unsupported_bottom_is_flagged(model, low, high):
    ball = condyles(offset=0.0, subdivisions=4)
    assert "unsupported bottom" in flags(ball, with_room_below(6.0, low, high), model, 300.0)


def test_a_contact_that_stands_on_the_bottom_is_not_flagged():
    ball = condyles(offset=0.0, subdivisions=4)
    assert "unsupported" not in flags(ball, box_insert(20e-3, 8e-3, 20e-3), load=300.0)


BOX = trimesh.creation.box((50.0, 8.0, 76.0))
FIELD = '<FieldData><Array type="String" Name="SPACE" format="ascii">82 65 83 0</Array></FieldData>'


@pytest.mark.parametrize(
    ("name", "before"),
    [
        ("a.ply", lambda text: text.replace("element", "comment SPACE=RAS\nelement", 1)),
        ("a.obj", lambda text: "# 3D Slicer output. SPACE=RAS\n" + text),
        ("a.stl", lambda text: text.replace("solid", "solid SPACE=RAS", 1)),
    ],
)
def test_the_space_of_a_file_is_compared_with_the_axes(name, before, tmp_path):
    path = tmp_path / name
    kind = "stl_ascii" if name.endswith("stl") else name[2:]
    options = {"encoding": "ascii"} if kind == "ply" else {}
    text = BOX.export(file_type=kind, **options)
    path.write_text(before(text.decode() if isinstance(text, bytes) else text), encoding="utf-8")
    assert space_of(path) == "RAS"
    load_surface(path, "mm", "+y,+z,+x", name="insert")
    with pytest.raises(InputError, match=r"names the space RAS .* its axes are \+y,\+z,\+x"):
        load_surface(path, "mm", name="insert")


def test_files_of_different_spaces_are_refused(tmp_path):
    first, second = tmp_path / "a.obj", tmp_path / "b.vtp"
    first.write_text("# SPACE=LPS\nv 0 0 0\n", encoding="utf-8")
    second.write_text(f"<VTKFile>{FIELD}</VTKFile>", encoding="utf-8")
    assert space_of(second) == "RAS"
    with pytest.raises(InputError, match=r"names the space RAS in its header, but .* names LPS"):
        check_same_space(first, second)
