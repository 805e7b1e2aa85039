"""Synthetic bodies for tests, in metres and anatomical axes."""

from collections.abc import Callable
from functools import lru_cache

import numpy as np
import trimesh

from tkamb.geometry.surface import Surface

Height = Callable[[np.ndarray, np.ndarray], np.ndarray]


def block(
    height: Height,
    size_x: float = 0.04,
    size_z: float = 0.06,
    spacing: float = 1e-3,
    name: str = "insert",
) -> Surface:
    """Return a closed block on y = 0 with the top y = height(x, z), centred on x = z = 0."""
    nx, nz = round(size_x / spacing) + 1, round(size_z / spacing) + 1
    x, z = np.meshgrid(
        np.linspace(-size_x / 2, size_x / 2, nx),
        np.linspace(-size_z / 2, size_z / 2, nz),
        indexing="ij",
    )
    top = np.stack([x, height(x, z), z], axis=-1).reshape(-1, 3)
    bottom = top * [1.0, 0.0, 1.0]
    index = np.arange(nx * nz).reshape(nx, nz)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    lid = np.concatenate(
        [np.stack([a, c, b], -1).reshape(-1, 3), np.stack([a, d, c], -1).reshape(-1, 3)]
    )
    rim = np.concatenate([index[:-1, 0], index[-1, :-1], index[:0:-1, -1], index[0, :0:-1]])
    after, below = np.roll(rim, -1), rim + nx * nz
    wall = np.concatenate(
        [np.stack([rim, after, below], -1), np.stack([after, np.roll(below, -1), below], -1)]
    )
    faces = np.concatenate([lid, lid[:, ::-1] + nx * nz, wall])
    return Surface(np.concatenate([top, bottom]), faces.astype(np.int64), name)


@lru_cache(8)
def plate(thickness: float = 0.01, spacing: float = 2e-3) -> Surface:
    """Return a flat block."""
    return block(lambda x, z: np.full_like(x, thickness), spacing=spacing)


@lru_cache(8)
def trough(radius: float, depth: float = 0.006, spacing: float = 1e-3) -> Surface:
    """Return a block with a cylindrical trough along z; its lowest line is at y = `depth`."""
    return block(lambda x, z: depth + radius - np.sqrt(radius**2 - x**2), 0.03, 0.04, spacing)


@lru_cache(8)
def two_dishes(radius: float = 0.05, apart: float = 0.044, depth: float = 0.006) -> Surface:
    """Return a block with two spherical dishes, with centres `apart` (m) along z."""

    def height(x: np.ndarray, z: np.ndarray) -> np.ndarray:
        out = np.abs(z) - apart / 2
        return depth + radius - np.sqrt(radius**2 - x**2 - out**2)

    return block(height, 0.044, 0.076)


@lru_cache(8)
def sphere(radius: float, subdivisions: int = 4, centre: tuple = (0.0, 0.0, 0.0)) -> Surface:
    """Return a triangulated sphere; its vertices lie on the exact sphere."""
    ball = trimesh.creation.icosphere(subdivisions, radius)
    return Surface(np.asarray(ball.vertices) + centre, np.asarray(ball.faces), "sphere")


def joined(*parts: Surface) -> Surface:
    """Return several bodies, which may overlap, as one surface."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + start for part, start in zip(parts, starts, strict=False)]
    return Surface(np.concatenate([part.vertices for part in parts]), np.concatenate(faces))


@lru_cache(8)
def torus_condyle(sagittal: float, frontal: float, z: float) -> Surface:
    """Return a torus about the z axis: outer radius `sagittal`, radius of the tube `frontal`."""
    ring = trimesh.creation.torus(sagittal - frontal, frontal, 64, 32)
    return Surface(np.add(ring.vertices, [0.0, 0.0, z]), np.asarray(ring.faces), "torus")


@lru_cache(8)
def bicondylar(kind: str = "sphere", apart: float = 0.044) -> Surface:
    """Return two condyles and a bridge between them, in front and above (x > 0)."""
    bridge = trimesh.creation.box((0.008, 0.02, apart))
    anterior = Surface(np.add(bridge.vertices, [0.02, 0.015, 0.0]), np.asarray(bridge.faces))
    if kind == "sphere":
        parts = [sphere(0.022, 4, (0.0, 0.0, side * apart / 2)) for side in (-1, 1)]
    else:
        parts = [torus_condyle(0.024, 0.01, side * apart / 2) for side in (-1, 1)]
    return joined(*parts, anterior)


def nearest_on_triangles(triangles, points):
    """Return the point (n, 3) of each triangle (n, 3, 3) that is nearest to its point (n, 3).

    This point is the projection onto the triangle's plane if it lies inside the triangle, else the
    nearest projection onto an edge. The result is correct for triangles of any size.
    """
    weights = _plane_weights(triangles, points)
    feet = np.einsum("ij,ijk->ik", weights, triangles)
    outside = ~(weights >= 0).all(axis=1)
    start, target = triangles[outside], points[outside, None]
    along = np.roll(start, -1, axis=1) - start
    length = np.einsum("ijk,ijk->ij", along, along)
    part = np.einsum("ijk,ijk->ij", target - start, along)
    part = np.clip(np.divide(part, length, out=np.zeros_like(part), where=length > 0), 0, 1)
    on_edges = start + part[:, :, None] * along
    nearest = ((on_edges - target) ** 2).sum(axis=2).argmin(axis=1)
    feet[outside] = on_edges[np.arange(len(start)), nearest]
    return feet


def _plane_weights(triangles, points):
    """Return barycentric coordinates (n, 3) of projections onto the planes; NaN without area."""
    a = triangles[:, 0]
    u, v, w = triangles[:, 1] - a, triangles[:, 2] - a, points - a
    uu, uv, vv = _dot(u, u), _dot(u, v), _dot(v, v)
    wu, wv = _dot(w, u), _dot(w, v)
    scale = uu * vv - uv * uv
    scale = np.where(scale > 1e-14 * uu * vv, scale, np.nan)
    second, third = (vv * wu - uv * wv) / scale, (uu * wv - uv * wu) / scale
    return np.stack([1 - second - third, second, third], axis=1)


def _dot(a, b):
    return np.einsum("ij,ij->i", a, b)
