"""Inserts of several bodies side by side and hollow inserts act as one body; a stack is refused."""

import logging

import numpy as np
import pytest
import trimesh

from random_inserts import joined_surfaces, voxel_surface
from tkamb.contact.lattice.meshing.cells import cell_volumes
from tkamb.contact.lattice.meshing.quality import whole_lattice
from tkamb.contact.materials import material
from tkamb.contact.pair import ContactPair
from tkamb.contact.registry import contact_model
from tkamb.errors import InputError
from tkamb.geometry.flat_bottom import insert_placement
from tkamb.geometry.repair import find_inner_wall
from tkamb.geometry.surface import Surface
from tkamb.io.recordings.meshes import load_surface

LENGTH, WIDTH, HEIGHT = 0.050, 0.076, 0.010


def block(x, y, z, counts=(2, 1, 2)):
    """Return a closed block between x, y and z (m), with evenly divided sides."""
    lines = tuple(
        np.linspace(*limits, count + 1) for limits, count in zip((x, y, z), counts, strict=True)
    )
    return voxel_surface(lines, np.ones(counts, bool))


def slab(low, high, counts=(5, 1, 8)):
    return block((-LENGTH / 2, LENGTH / 2), (low, high), (-WIDTH / 2, WIDTH / 2), counts)


def side(low, high, counts=(5, 2, 4)):
    return block((-LENGTH / 2, LENGTH / 2), (0.0, HEIGHT), (low, high), counts)


def inside_out(surface):
    return Surface(surface.vertices, surface.faces[:, ::-1].copy())


SOLID = slab(0.0, HEIGHT)
STACKED = {
    "meshed alike": [slab(0, 0.004), slab(0.004, HEIGHT)],
    "meshed in two ways": [slab(0, 0.004), slab(0.004, HEIGHT, (10, 1, 16))],
    "no vertex in common but at the corners": [slab(0, 0.004, (7, 1, 9)), slab(0.004, HEIGHT)],
    "three layers": [slab(0, 0.003), slab(0.003, 0.006, (10, 1, 4)), slab(0.006, HEIGHT)],
    "overlapping": [slab(0, 0.006), slab(0.004, HEIGHT, (7, 1, 9))],
    "a smaller tray": [
        block((-0.02, 0.02), (-0.004, 0.0), (-0.03, 0.03), (3, 1, 5)),
        slab(0, HEIGHT),
    ],
}
TOUCHING = {
    "side by side": [side(-WIDTH / 2, 0.0), side(0.0, WIDTH / 2, (10, 4, 3))],
}
OVERLAPPING = {
    "overlapping sideways": [side(-WIDTH / 2, 0.01), side(-0.01, WIDTH / 2)],
}


def read(tmp_path, bodies):
    """Return the bodies of one STL file, read as in a run."""
    bodies_of_file = joined_surfaces(*bodies)
    path = tmp_path / "insert.stl"
    trimesh.Trimesh(1e3 * bodies_of_file.vertices, bodies_of_file.faces, process=False).export(path)
    surface = load_surface(path, "mm", name="insert", closed=True)
    return surface.moved(insert_placement(surface))


def peak(insert, contact):
    """Return the peak pressure (Pa) under a sphere of 22 mm at 500 N."""
    ball = trimesh.creation.icosphere(4, 0.022)
    femoral = Surface(np.asarray(ball.vertices), np.asarray(ball.faces, np.int64), "femoral")
    pair = ContactPair(femoral, insert, material("polyethylene"))
    model = contact_model(contact, resolution=2e-3)
    return model.press(model.prepare(pair), 500.0, np.eye(4)).pressure.max()


@pytest.fixture(scope="module")
def solid_peaks(tmp_path_factory):
    """Return the peak pressures of the solid block."""
    insert = read(tmp_path_factory.mktemp("solid"), [SOLID])
    return {contact: peak(insert, contact) for contact in ("foundation", "lattice-linear")}


@pytest.mark.parametrize("name", STACKED)
def test_bodies_that_lie_on_each_other_are_refused(name, tmp_path):
    """The lower one may be the metal tray, which would become polyethylene."""
    with pytest.raises(InputError, match="lie on each other, like an insert on its tray"):
        read(tmp_path, STACKED[name])


@pytest.mark.parametrize("name", TOUCHING)
def test_a_wall_between_touching_bodies_is_removed(name, tmp_path, solid_peaks, caplog):
    with caplog.at_level(logging.WARNING, "tkamb"):
        insert = read(tmp_path, TOUCHING[name])
    assert "inner wall" in caplog.text
    assert insert.mesh.is_watertight
    assert insert.volume == pytest.approx(SOLID.volume, rel=1e-6)
    assert find_inner_wall(insert.vertices, insert.faces) is None
    for contact, value in solid_peaks.items():
        assert peak(insert, contact) == pytest.approx(value, rel=1e-3)


@pytest.mark.parametrize("name", OVERLAPPING)
def test_overlapping_bodies_are_one_in_the_lattice(name, tmp_path, solid_peaks, caplog):
    with caplog.at_level(logging.WARNING, "tkamb"):
        insert = read(tmp_path, OVERLAPPING[name])
    assert "is ignored" in caplog.text
    assert peak(insert, "lattice-linear") == pytest.approx(solid_peaks["lattice-linear"], rel=1e-3)


def test_a_block_on_a_part_of_a_plate_is_joined_to_it(tmp_path):
    """The block covers parts of the plate's triangles, so the wall stays; it does not count."""
    ridge = block((-LENGTH / 2, LENGTH / 2), (HEIGHT, 0.015), (-0.0067, 0.0067), (5, 1, 2))
    insert = read(tmp_path, [SOLID, ridge])
    lattice = whole_lattice(insert, 1.5e-3)
    volume = cell_volumes(lattice.nodes[lattice.cells]).sum()
    assert volume == pytest.approx(SOLID.volume + ridge.volume, rel=0.02)


@pytest.mark.parametrize("size", [1.5e-3, 2e-3])
def test_a_void_contains_no_material(size, tmp_path):
    void = inside_out(block((-0.012, 0.012), (0.002, 0.007), (-0.02, 0.02)))
    insert = read(tmp_path, [SOLID, void])
    lattice = whole_lattice(insert, size)
    middle = lattice.nodes[lattice.cells].mean(axis=1)
    inner = np.abs(middle - [0.0, 0.0045, 0.0]) < np.array([0.012, 0.0025, 0.02]) - 1e-4
    assert not inner.all(axis=1).any()
    assert cell_volumes(lattice.nodes[lattice.cells]).sum() == pytest.approx(
        SOLID.volume - 0.024 * 0.005 * 0.04, rel=0.02
    )


def test_a_body_within_another_one_is_refused(tmp_path):
    inner = block((-0.01, 0.01), (0.002, 0.006), (-0.01, 0.01))
    with pytest.raises(InputError, match="2 separate bodies"):
        read(tmp_path, [SOLID, inner])


def test_bodies_a_tenth_of_a_millimetre_apart_are_separate(tmp_path):
    with pytest.raises(InputError, match="2 separate bodies"):
        read(tmp_path, [slab(0, 0.004), slab(0.0041, HEIGHT)])
