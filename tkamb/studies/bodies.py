"""Femoral components and inserts of simple, known shape, in metres, for the studies."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tkamb.geometry.frames import Array, Index
from tkamb.geometry.surface import Surface

Height = Callable[[Array, Array], Array]


def balls(
    radius: float,
    apart: float,
    waist: float = 1.0,
    finest_deg: float = 0.3,
    sectors: int = 96,
) -> Surface:
    """Return one or two spheroids whose lowest points are at y = -radius.

    Args:
        radius: m, in the sagittal plane at the lowest point.
        apart: m, z of the lateral one, the medial one at -apart; 0: a single one.
        waist: radius along z over `radius`.
        finest_deg: distance of the rings of vertices near the lowest point.
        sectors: vertices of a ring.
    """
    one = _ball(radius, waist, finest_deg, sectors)
    if apart == 0:
        return Surface(*one, "ball")
    vertices, faces = one
    shift = np.array([0.0, 0.0, apart])
    both = np.concatenate([vertices - shift, vertices + shift])
    return Surface(both, np.concatenate([faces, faces + len(vertices)]), "condyles")


def block(
    height: Height, size: tuple[float, float], spacing: float = 0.5e-3, name: str = "insert"
) -> Surface:
    """Return a closed block on y = 0 whose upper surface is y = height(x, z).

    Args:
        height: m, of arrays x and z.
        size: m, along x and z.
        spacing: m, of the vertices of the upper surface.
        name: of the surface.
    """
    x, z = (np.linspace(-s / 2, s / 2, max(3, round(s / spacing) + 1)) for s in size)
    gx, gz = np.meshgrid(x, z, indexing="ij")
    top = np.stack([gx, np.broadcast_to(height(gx, gz), gx.shape), gz], axis=-1).reshape(-1, 3)
    number = np.arange(gx.size).reshape(gx.shape)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    upper = np.concatenate([_corners(a, d, c), _corners(a, c, b)])
    rim = np.concatenate([number[:, 0], number[-1, 1:], number[-2::-1, -1], number[0, -2:0:-1]])
    after, n = np.roll(rim, -1), gx.size
    walls = [_corners(rim, after, after + n), _corners(rim, after + n, rim + n)]
    vertices = np.concatenate([top, top * [1.0, 0.0, 1.0]])
    return Surface(vertices, np.concatenate([upper, upper[:, ::-1] + n, *walls]), name)


def flat(thickness: float) -> Height:
    """Return a flat upper surface."""
    return lambda x, z: np.full_like(x, thickness)


def dishes(thickness: float, radius: float, apart: float, rim: float = 2e-3) -> Height:
    """Return two dishes (one for apart = 0), parabolic near the middle, under a flat rim.

    Args:
        thickness: m, under the dishes' lowest points.
        radius: m, of curvature there.
        apart: m, z of the lateral dish's middle.
        rim: m, height of the rim over the lowest points.
    """

    def height(x: Array, z: Array) -> Array:
        away = np.hypot(x, np.abs(z) - apart)
        return thickness + np.minimum(away**2 / (2 * radius), rim)

    return height


def _corners(*numbers: NDArray[Any]) -> Index:
    return np.stack([n.ravel() for n in numbers], axis=1).astype(np.int64)


def _ball(radius: float, waist: float, finest_deg: float, sectors: int) -> tuple[Array, Index]:
    polar = np.radians(
        np.concatenate([np.arange(finest_deg, 24, finest_deg), np.linspace(24, 180, 50)[:-1]])
    )
    around = np.arange(sectors) * 2 * np.pi / sectors
    rings = np.stack(
        [
            np.outer(np.sin(polar), np.cos(around)),
            -np.outer(np.cos(polar), np.ones(sectors)),
            np.sqrt(waist) * np.outer(np.sin(polar), np.sin(around)),
        ],
        axis=-1,
    ).reshape(-1, 3)
    vertices = radius * np.concatenate([[[0, -1, 0]], rings, [[0, 1, 0]]])
    first = np.arange(sectors)
    second = (first + 1) % sectors
    parts = [_corners(np.zeros_like(first), 1 + first, 1 + second)]
    for row in range(len(polar) - 1):
        a, b = 1 + row * sectors, 1 + (row + 1) * sectors
        parts += [
            _corners(a + first, b + first, b + second),
            _corners(a + first, b + second, a + second),
        ]
    last = 1 + (len(polar) - 1) * sectors
    parts.append(_corners(last + first, np.full_like(first, len(vertices) - 1), last + second))
    return vertices, np.concatenate(parts)
