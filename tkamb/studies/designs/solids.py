"""Closed solids from two structured sheets of points, and reproducible binary STL files."""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tkamb.geometry.frames import Array

Ids = NDArray[np.int64]
Node = tuple[int, int]
HEADER = b"tkamb deep knee bend, millimetres".ljust(80)
"""Header of every STL file, constant so that equal meshes give equal files."""


def close_sheets(
    outer: Array,
    inner: Array,
    rows_kept: Sequence[int],
    columns_kept: Sequence[int],
    fork: int | None = None,
) -> tuple[Array, Ids]:
    """Join two sheets of points (rows, columns, 3) into one closed triangulation.

    Args:
        outer: sheet of which all points are used.
        inner: opposite sheet on the same grid, of which a subset is used.
        rows_kept: increasing numbers of the used rows of `inner`, including first, last and `fork`.
        columns_kept: increasing numbers of the used columns of `inner`, including first, last and,
            with `fork`, the middle two.
        fork: last row in which the two middle columns coincide; behind it a notch separates them.
            None: no notch.

    Returns:
        Vertices (n, 3) and faces (k, 3) with outward normals by the right-hand rule.
    """
    rows, columns = outer.shape[:2]
    top = _ids(rows, columns, fork, 0)
    bottom = _ids(rows, columns, fork, rows * columns)
    middle = None if fork is None else columns // 2 - 1
    full_grid = (np.arange(rows), np.arange(columns))
    coarse_grid = (np.asarray(rows_kept), np.asarray(columns_kept))
    faces = np.concatenate(
        [
            _sheet(top, *full_grid, middle),
            _sheet(bottom, *coarse_grid, middle)[:, ::-1],
            _wall(top, bottom, coarse_grid, fork),
        ]
    )
    vertices = np.concatenate([outer.reshape(-1, 3), inner.reshape(-1, 3)])
    used, faces = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used], faces.reshape(-1, 3)
    return vertices, faces if signed_volume(vertices, faces) > 0 else faces[:, ::-1]


def _ids(rows: int, columns: int, fork: int | None, start: int) -> Ids:
    """Return the vertex number of every grid node. Up to the fork the middle columns share one."""
    ids = start + np.arange(rows * columns).reshape(rows, columns)
    if fork is not None:
        ids[: fork + 1, columns // 2] = ids[: fork + 1, columns // 2 - 1]
    return ids


def _sheet(ids: Ids, rows: Ids, columns: Ids, middle: int | None) -> Ids:
    """Return a grid's triangles, with a gap between `middle` and the next column."""
    pairs = [(a, b) for a, b in pairwise(columns) if a != middle]
    first, right = np.array(pairs).T
    up, down = rows[:-1, None], rows[1:, None]
    a, b, c, e = ids[up, first], ids[down, first], ids[down, right], ids[up, right]
    triangles = [np.stack([a, b, c], axis=-1), np.stack([a, c, e], axis=-1)]
    return np.concatenate([t.reshape(-1, 3) for t in triangles])


def _loop(rows: list[int], columns: list[int], fork: int | None) -> list[Node]:
    last = rows[-1]
    path = [(rows[0], c) for c in columns] + [(r, columns[-1]) for r in rows[1:]]
    if fork is None:
        path += [(last, c) for c in columns[-2::-1]]
    else:
        middle = columns[len(columns) // 2 - 1]
        behind = [r for r in rows if r >= fork]
        path += [(last, c) for c in columns[::-1] if middle < c < columns[-1]]
        path += [(r, middle + 1) for r in behind[-2::-1]]
        path += [(r, middle) for r in behind[1:]]
        path += [(last, c) for c in columns[::-1] if c < middle]
    return path + [(r, columns[0]) for r in rows[-2::-1]]


def _wall(top: Ids, bottom: Ids, coarse_grid: tuple[Ids, Ids], fork: int | None) -> Ids:
    """Return the triangles between the edges of both sheets."""
    fine = _loop(list(range(top.shape[0])), list(range(top.shape[1])), fork)
    coarse = set(_loop(coarse_grid[0].tolist(), coarse_grid[1].tolist(), fork))
    stations = [i for i, node in enumerate(fine) if node in coarse]
    triangles = []
    for start, end in pairwise(stations):
        chain = [top[node] for node in fine[start : end + 1]]
        first, second = bottom[fine[start]], bottom[fine[end]]
        half = len(chain) // 2
        for i in range(len(chain) - 1):
            triangles.append((chain[i], chain[i + 1], first if i < half else second))
        triangles.append((chain[half], second, first))
    return np.array([t for t in triangles if len(set(t)) == 3])


def signed_volume(vertices: Array, faces: Ids) -> float:
    """Return the enclosed volume, positive if the normals of the faces point outwards."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6.0


def write_stl(path: Path, vertices: Array, faces: Ids) -> None:
    """Write a binary STL file."""
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("pad", "<u2")])
    triangles = np.zeros(len(faces), record)
    corners = vertices[faces].astype("<f4").astype(float)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    triangles["normal"] = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    triangles["corners"] = corners
    with open(path, "wb") as file:
        file.write(HEADER + np.array(len(faces), "<u4").tobytes() + triangles.tobytes())
