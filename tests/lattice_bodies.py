"""Bodies for the lattice's contact tests; bodies of the same sizes are one object."""

from functools import lru_cache

import numpy as np
import trimesh

from tkamb.contact.pair import ContactPair
from tkamb.geometry.surface import Surface


@lru_cache(8)
def box_insert(width, height, depth):
    """Return a box on y = 0 (sizes in m)."""
    box = trimesh.creation.box((width, height, depth))
    box.apply_translation((0, height / 2, 0))
    return Surface(np.array(box.vertices), np.array(box.faces, np.int64), "box")


def plate(width, depth):
    """Return a rigid plate with its underside in y = 0 (sizes in m)."""
    return box_insert(width, 5e-3, depth)


@lru_cache(8)
def sphere_cap(radius, reach=6e-3, step=1e-4, sectors=96):
    """Return the lower cap of a sphere about the origin, finely triangulated (sizes in m)."""
    count = int(reach / step)
    r = np.arange(1, count + 1)[:, None] * step
    angle = np.arange(sectors) * 2 * np.pi / sectors
    x, z = (r * np.cos(angle)).ravel(), (r * np.sin(angle)).ravel()
    rim = np.stack([x, -np.sqrt(radius**2 - x**2 - z**2), z], axis=1)
    a = np.arange(sectors)
    b = (a + 1) % sectors
    faces = [np.stack([np.zeros_like(a), 1 + a, 1 + b], axis=1)]
    for ring in range(count - 1):
        low, high = 1 + ring * sectors, 1 + (ring + 1) * sectors
        faces += [
            np.stack([low + a, high + a, high + b], 1),
            np.stack([low + a, high + b, low + b], 1),
        ]
    return Surface(np.vstack([[0, -radius, 0], rim]), np.concatenate(faces), "cap")


@lru_cache(8)
def dished_insert(width=24e-3, depth=40e-3, height=9e-3, radius=30e-3, cells=48):
    """Return a closed insert with two dishes at z = ±depth/4 (sizes in m)."""
    x = np.linspace(-width / 2, width / 2, cells + 1)
    z = np.linspace(-depth / 2, depth / 2, 2 * cells + 1)
    gx, gz = np.meshgrid(x, z, indexing="ij")
    distance = np.minimum(np.hypot(gx, gz - depth / 4), np.hypot(gx, gz + depth / 4))
    top = height - 2e-3 + np.minimum(distance**2 / (2 * radius), 2e-3)
    upper = np.stack([gx, top, gz], axis=-1).reshape(-1, 3)
    lower = upper * [1, 0, 1]
    number = np.arange(gx.size).reshape(gx.shape)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    quads = np.stack([a, d, c, b], axis=-1).reshape(-1, 4)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    shift = gx.size
    rim = np.concatenate([number[:, 0], number[-1, 1:], number[-2::-1, -1], number[0, -2:0:-1]])
    following = np.roll(rim, -1)
    walls = np.concatenate(
        [
            np.stack([rim, following + shift, rim + shift], 1),
            np.stack([rim, following, following + shift], 1),
        ]
    )
    mesh = trimesh.Trimesh(
        np.concatenate([upper, lower]), np.concatenate([faces, faces[:, ::-1] + shift, walls])
    )
    mesh.fix_normals()
    return Surface(np.array(mesh.vertices), np.array(mesh.faces, np.int64), "dished insert")


@lru_cache(8)
def condyles(radius=20e-3, offset=10e-3, subdivisions=5):
    """Return two spheres as a femoral component (sizes in m)."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    parts = [ball.copy().apply_translation((0, 0, side * offset)) for side in (-1, 1)]
    spheres = trimesh.util.concatenate(parts)
    return Surface(np.array(spheres.vertices), np.array(spheres.faces, np.int64), "condyles")


def pair(femoral, insert, material, bearing="fixed"):
    """Return the contact pair."""
    return ContactPair(femoral, insert, material, bearing)


def above(x=0.0, z=0.0, y=1.0, rotation=None):
    """Return a pose (4, 4) from a translation (m) and a rotation (3, 3)."""
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    if rotation is not None:
        pose[:3, :3] = rotation
    return pose
