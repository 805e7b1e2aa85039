"""Extreme presses of the lattice agree with a reference Newton's method within 1 %, or fail.

The lattice may fail only where the full Newton's method on the same grid fails, too.
"""

from functools import lru_cache

import numpy as np
import pytest
import trimesh

from lattice_bodies import above, box_insert, condyles, dished_insert, pair, sphere_cap
from tkamb.contact.materials import material
from tkamb.contact.registry import contact_model
from tkamb.contact.result import ContactStatus
from tkamb.errors import ComputationError
from tkamb.geometry.frames import knee_pose
from tkamb.geometry.surface import Surface

LEVEL = knee_pose(np.zeros(6))
TILTED = knee_pose([0, 0, 0, 0, np.radians(5), 0])
FLEXED = knee_pose([0, 0, 0, 0, 0, np.radians(5)])
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


SHAPES = {
    "thin": (TWO, lambda: dished_insert(height=4e-3, cells=24), LEVEL, 2.0),
    "thick": (TWO, lambda: dished_insert(height=25e-3, cells=24), LEVEL, 4.0),
    "two millimetres": (ONE, lambda: box_insert(20e-3, 2e-3, 20e-3), above(), 1.0),
    "coarse": (TWO, lambda: dished_insert(cells=24), LEVEL, 6.0),
    "fine": (sphere_cap(6e-3, 2e-3, 5e-5), lambda: box_insert(6e-3, 3e-3, 6e-3), above(), 0.5),
    "one condyle": (ONE, lambda: box_insert(20e-3, 9e-3, 20e-3), above(), 3.0),
    "post": (TWO, with_post, LEVEL, 3.0),
    "level": (TWO, lambda: dished_insert(cells=24), LEVEL, 3.0),
    "tilted": (TWO, lambda: dished_insert(cells=24), TILTED, 3.0),
    "flexed": (TWO, lambda: dished_insert(cells=24), FLEXED, 3.0),
    "on the rim": (ONE, lambda: box_insert(20e-3, 9e-3, 20e-3), above(9.8e-3, 9.5e-3), 3.0),
}
RATIOS = (0.0, 0.25, 0.45, 0.4999)
USUAL = [0.0, 1e-3, 1.0, 1e3]
HUGE = [pytest.param(load, marks=pytest.mark.slow) for load in (1e4, 3e4)]
"""Loads, N."""


@lru_cache
def prepared(shape, nu=None):
    """Return the prepared contact, the pose and the cell size (mm) of a shape."""
    femoral, insert, pose, size = SHAPES[shape]
    changes = {} if nu is None else {"poisson_ratio": nu}
    bodies = pair(femoral, insert(), material("polyethylene", **changes))
    return contact_model("lattice", resolution=size * 1e-3).prepare(bodies), pose, size


def by_newton(state, load, pose, size):
    """Return the result of the reference Newton's method; None if it fails."""
    model = contact_model("lattice", resolution=size * 1e-3, newton=True, tolerance=5e-4)
    try:
        result = model.press(state, load, pose)
    except ComputationError:
        return None
    return result if result.status is ContactStatus.OK else None


def compare(state, pose, size, load):
    """Return the lattice's result after a comparison with the reference Newton's method."""
    quick = contact_model("lattice", resolution=size * 1e-3).press(state, load, pose)
    exact = by_newton(state, load, pose, size)
    if quick.status is not ContactStatus.OK:
        assert quick.flags
        assert exact is None
        return quick
    assert exact is not None
    assert -quick.wrench_on_insert[1] == pytest.approx(load, rel=1e-6)
    assert quick.approach == pytest.approx(exact.approach, rel=0.01)
    assert quick.pressure.max() == pytest.approx(exact.pressure.max(), rel=0.01)
    return quick


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("load", USUAL + HUGE)
def test_extreme_shapes_and_loads_agree_with_newton_or_fail(shape, load):
    result = compare(*prepared(shape), load)
    if load == 0:
        assert result.status is ContactStatus.OK
        assert result.approach == 0
        assert not result.pressure.any()


@pytest.mark.parametrize("nu", RATIOS)
@pytest.mark.parametrize("load", USUAL + HUGE)
def test_extreme_poisson_ratios_agree_with_newton_or_fail(nu, load):
    compare(*prepared("level", nu), load)


@pytest.mark.parametrize("shape", [shape for shape in SHAPES if shape != "fine"])
def test_presses_of_one_kilonewton_converge(shape):
    """All shapes converge but the block of 6 mm, with a strain below -1."""
    state, pose, size = prepared(shape)
    assert (
        contact_model("lattice", resolution=size * 1e-3).press(state, 1e3, pose).status
        is ContactStatus.OK
    )


def test_a_completely_compressed_insert_gives_no_numbers():
    state, pose, size = prepared("two millimetres")
    result = contact_model("lattice", resolution=size * 1e-3).press(state, 1e4, pose)
    assert result.status is ContactStatus.OUT_OF_RANGE
    assert "compressed to nothing" in " ".join(result.flags)
    assert np.isnan(result.approach)
    assert np.isnan(result.pressure).all()


def test_an_insert_with_a_post_is_pressed_beside_the_post():
    state, pose, size = prepared("post")
    result = contact_model("lattice", resolution=size * 1e-3).press(state, 1e3, pose)
    loaded = result.points[result.pressure > 0]
    assert (np.abs(loaded[:, 2]) > 3e-3).all()
