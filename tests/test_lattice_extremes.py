"""Extremes of the lattice: the reference Newton within 1 %, or a status that says why not."""

import numpy as np
import pytest
import trimesh

from lattice_bodies import above, box_insert, condyles, dished_insert, pair, sphere_cap
from tkamb.contact.materials import material
from tkamb.contact.model import ContactStatus
from tkamb.contact.registry import contact_model
from tkamb.geometry.frames import knee_pose
from tkamb.geometry.surface import Surface

LEVEL = knee_pose(np.zeros(6))
TILTED = knee_pose([0, 0, 0, 0, np.radians(5), 0])
TWO = condyles(subdivisions=4)
ONE = sphere_cap(20e-3)


def with_post():
    """Return a block with a low post (a ridge along x) between two condyles."""
    outline = np.array([[-20, 0], [-3, 0], [3, 0], [20, 0], [20, 9], [3, 9], [3, 10], [-3, 10],
                        [-3, 9], [-20, 9]]) * 1e-3  # fmt: skip
    ends = [
        np.column_stack([np.full(10, x), outline[:, 1], outline[:, 0]]) for x in (-12e-3, 12e-3)
    ]
    quads = [[0, 1, 8, 9], [1, 2, 5, 8], [2, 3, 4, 5], [8, 5, 6, 7]]
    sides = [[i + 10, (i + 1) % 10 + 10, (i + 1) % 10, i] for i in range(10)]
    quads = np.array(quads + [[v + 10 for v in reversed(q)] for q in quads] + sides)
    mesh = trimesh.Trimesh(
        np.concatenate(ends), np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    )
    assert mesh.is_watertight
    assert mesh.volume > 0
    return Surface(np.array(mesh.vertices), np.array(mesh.faces, np.int64), "post")


CASES = {
    "thin": (TWO, lambda: dished_insert(height=4e-3, cells=24), LEVEL, 2.0),
    "thick": (TWO, lambda: dished_insert(height=25e-3, cells=24), LEVEL, 4.0),
    "two millimetres": (ONE, lambda: box_insert(20e-3, 2e-3, 20e-3), above(), 1.0),
    "coarse": (TWO, lambda: dished_insert(cells=24), LEVEL, 6.0),
    "fine": (sphere_cap(6e-3, 2e-3, 5e-5), lambda: box_insert(6e-3, 3e-3, 6e-3), above(), 0.5),
    "one condyle": (ONE, lambda: box_insert(20e-3, 9e-3, 20e-3), above(), 3.0),
    "tilted": (TWO, lambda: dished_insert(cells=24), TILTED, 3.0),
    "on the rim": (ONE, lambda: box_insert(20e-3, 9e-3, 20e-3), above(9.8e-3, 9.5e-3), 3.0),
}


def compare(femoral, insert, mat, pose, size, load):
    """Return the quick result after checking it against Newton's."""
    state = contact_model("lattice", size).prepare(pair(femoral, insert, mat))
    quick = contact_model("lattice", size).press(state, load, pose)
    if quick.status is not ContactStatus.OK:
        assert quick.flags
        return quick
    exact = contact_model("lattice", size, newton=True, tolerance=5e-4).press(state, load, pose)
    assert -quick.wrench_on_insert[1] == pytest.approx(load, rel=1e-6)
    assert exact.status is ContactStatus.OK
    assert quick.approach == pytest.approx(exact.approach, rel=0.01)
    assert quick.pressure.max() == pytest.approx(exact.pressure.max(), rel=0.01)
    return quick


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("load", [1e-3, 1.0, 1e3, 1e4, 3e4])
def test_extreme_shapes_and_loads(case, load):
    femoral, insert, pose, size = CASES[case]
    compare(femoral, insert(), material("polyethylene"), pose, size, load)


@pytest.mark.slow
@pytest.mark.parametrize("nu", [0.0, 0.25, 0.45, 0.4999])
@pytest.mark.parametrize("load", [1e-3, 1.0, 1e3, 1e4])
def test_extreme_ratios(nu, load):
    mat = material("polyethylene", poisson_ratio=nu)
    result = compare(TWO, dished_insert(cells=24), mat, LEVEL, 3.0, load)
    assert result.status is ContactStatus.OK


def test_zero_load_returns_at_once():
    state = contact_model("lattice", 3.0).prepare(
        pair(ONE, box_insert(20e-3, 9e-3, 20e-3), material("polyethylene"))
    )
    result = contact_model("lattice", 3.0).press(state, 0.0, above())
    assert result.status is ContactStatus.OK
    assert result.approach == 0
    assert not result.pressure.any()


@pytest.mark.slow
def test_insert_with_a_post_is_pressed_beside_it():
    result = compare(TWO, with_post(), material("polyethylene"), LEVEL, 3.0, 1000.0)
    loaded = result.points[result.pressure > 0]
    assert (np.abs(loaded[:, 2]) > 3e-3).all()
