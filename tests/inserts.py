"""Inserts for lattice tests: synthetic inserts with holes, posts and rims, and real inserts."""

from functools import cache, lru_cache
from pathlib import Path

import numpy as np
import pytest

from tkamb.geometry.flat_bottom import insert_placement
from tkamb.geometry.surface import Surface
from tkamb.io.recordings.meshes import load_surface

DATA = Path(__file__).parents[2] / "shared" / "data"


def raised(x, z, height, solid):
    """Return a closed block over the solid squares of a grid; its bottom lies in y = 0.

    Args:
        x: (a,) m, coordinates of the grid's points.
        z: (b,) m, coordinates of the grid's points.
        height: (a, b) m, y of the top at the grid's points.
        solid: (a - 1, b - 1) whether a square belongs to the block.
    """
    a, b = len(x), len(z)
    grid = np.arange(a * b).reshape(a, b)
    xx, zz = np.meshgrid(x, z, indexing="ij")
    upper = np.column_stack([xx.ravel(), height.ravel(), zz.ravel()])
    lower = upper * [1.0, 0.0, 1.0]
    corners = np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]], -1)[solid]
    top = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
    faces = [top, top[:, ::-1] + a * b]
    directed = np.concatenate([corners[:, [i, (i + 1) % 4]] for i in range(4)])
    edges = {tuple(edge) for edge in directed.tolist()}
    rim = np.array([edge for edge in directed.tolist() if (edge[1], edge[0]) not in edges])
    s, e = rim.T
    faces += [np.column_stack([e, s, s + a * b]), np.column_stack([e, s + a * b, e + a * b])]
    faces = np.concatenate(faces)
    used, number = np.unique(faces, return_inverse=True)
    points = np.concatenate([upper, lower])[used]
    return Surface(points, number.reshape(-1, 3), "insert")


@lru_cache(8)
def dished(size=(0.04, 0.06), lip=0.012, dish=0.006, spacing=5e-4, radius=0.035):
    """Return a block with two spherical dishes, and its exact top as a function of x and z."""

    def top(x, z):
        floor = dish + radius - np.sqrt(radius**2 - x**2 - (np.abs(z) - size[1] / 4) ** 2)
        return np.minimum(lip, floor)

    x, z = (np.linspace(-s / 2, s / 2, round(s / spacing) + 1) for s in size)
    height = top(*np.meshgrid(x, z, indexing="ij"))
    return raised(x, z, height, np.ones((len(x) - 1, len(z) - 1), bool)), top


@cache
def real_insert(name):
    """Return the insert of DM or JW in the insert frame; skip the test without the data."""
    path = DATA / name / "geometry" / "tibial_insert.stl"
    if not path.is_file():
        pytest.skip("subject data absent (shared/data): meshes of DM and JW are not shipped")
    surface = load_surface(path, "m", "-x,+y,-z", name=f"insert of {name.upper()}", closed=True)
    return surface.moved(insert_placement(surface))


@cache
def shipped_insert():
    """Return the insert of the shipped deep knee bend, in the insert frame."""
    path = Path(__file__).parents[1] / "models" / "deep_knee_bend" / "insert.stl"
    surface = load_surface(path, "mm", name="shipped insert", closed=True)
    return surface.moved(insert_placement(surface))


def volume(surface):
    """Return the enclosed volume, m³."""
    a, b, c = np.moveaxis(surface.triangles, 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)
