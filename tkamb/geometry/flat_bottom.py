"""The insert's flat bottom, and the insert frame that it defines."""

import logging
import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from tkamb.errors import InputError
from tkamb.geometry.frames import Array, Index, Mask, pose
from tkamb.geometry.repair import facing_material
from tkamb.geometry.surface import Surface

# m: largest distance of a flat's corners from its plane. The noise of a mesh is
# smaller.
FLATNESS = 5e-5
# 1: smallest area of a flat that may be the bottom, as a share of the largest flat's area.
# A smaller flat is a recess.
COMPARABLE_SHARE = 0.5
# 1: of two flats that face down, the larger one is the bottom if the smaller one has less than
# this share of the larger one's area. If the areas are closer, the mesh is refused.
CLEAR_SHARE = 0.9
# m: noise of the bottom above which a notice is printed. A mesh in single precision
# rounds by less.
UNEVEN_NOISE = 1e-6
# rad: a smaller tilt is not corrected. It moves the ends of the insert by less than
# rounding.
LEVEL_TILT = 1e-6


TILT_LIMIT = math.radians(30.0)
"""rad: a bottom tilted by less than this from -y is turned level."""


# 1: a flat is an inner wall if material lies in front of more than this share of its area.
# The majority of the area.
INNER_SHARE = 0.5


_CONE = math.radians(15.0)

_log = logging.getLogger("tkamb")


@dataclass(frozen=True, eq=False)
class FlatBottom:
    """Triangles of a surface that lie in one plane.

    Args:
        normal: (3,) unit outward normal, in the surface's frame like the centre of area (3,), m.
        faces: (k,) indices of the flat's triangles.
        vertices: (n,) indices of the surface's vertices in the plane.
        noise: m, root mean square distance of these vertices from the plane.
    """

    normal: Array
    centre: Array
    area: float
    faces: Index
    vertices: Index
    noise: float


def find_flats(surface: Surface) -> list[FlatBottom]:
    """Return the flats that may be the bottom, largest first.

    The search finds the direction that the most area faces, then the most frequent offset of
    triangles within 15 deg of it. It fits a plane to these with decreasing tolerances. It is
    repeated without this flat until none of comparable area remains.
    """
    normals, area = surface.face_normals, surface.areas
    free = area > 0
    flats: list[FlatBottom] = []
    for _ in range(12):
        least = COMPARABLE_SHARE * max((f.area for f in flats), default=0.0)
        flat = _largest_flat(surface, normals, area, free, least) if free.any() else None
        if flat is None or flat.area < least:
            break
        flats.append(flat)
        free = free.copy()
        free[flat.faces] = False
    largest = max((flat.area for flat in flats), default=0.0)
    flats = [flat for flat in flats if flat.area >= COMPARABLE_SHARE * largest]
    return sorted(flats, key=lambda flat: -flat.area)


def find_flat_bottom(surface: Surface, rotation: Array | None = None) -> FlatBottom:
    """Return the bottom of an insert: the largest flat that faces -y, within 30 deg.

    Its area must be at least half of the largest flat's. A notice is printed if it is clearly
    smaller.

    `surface` is in anatomical axes (x anterior, y superior, z right), m; `rotation` (3, 3) from
    mesh axes to these is for messages.
    """
    rotation = np.eye(3) if rotation is None else rotation
    flats = find_flats(surface)
    if not flats:
        raise InputError(
            f"{surface.name} has no flat bottom", None, "give the mesh of a tibial insert"
        )
    down = [flat for flat in flats if -flat.normal[1] >= math.cos(TILT_LIMIT)]
    if len(down) > 1:  # the wall between two touching bodies may face down, too
        outer = [flat for flat in down if not _is_inner(surface, flat)]
        down = outer or down
    if not down:
        raise _faces_elsewhere(surface.name, flats[0], rotation)
    if len(down) > 1 and down[1].area >= CLEAR_SHARE * down[0].area:
        raise InputError(
            f"{surface.name} has two flats that could be its bottom: "
            f"{_described(down[0], rotation)}, and {_described(down[1], rotation)}",
            None,
            "remove one, or give the part without its underside",
        )
    if down[0].noise > UNEVEN_NOISE:
        _log.warning(
            "%s: the flat bottom is uneven by %.0f µm (root mean square)",
            surface.name,
            1e6 * down[0].noise,
        )
    if down[0].area < CLEAR_SHARE * flats[0].area:
        _log.warning(
            "%s: the flat that faces inferior (%s) is taken as the bottom, though another is "
            "larger (%s)",
            surface.name,
            _described(down[0], rotation),
            _described(flats[0], rotation),
        )
    return down[0]


def _is_inner(surface: Surface, flat: FlatBottom) -> bool:
    """Return whether material lies before most of a flat."""
    area = surface.areas[flat.faces]
    return bool(area @ facing_material(surface, flat.faces) > INNER_SHARE * area.sum())


def _faces_elsewhere(name: str, flat: FlatBottom, rotation: Array) -> InputError:
    inferior = facing(np.array([0.0, -1.0, 0.0]), rotation)
    if facing(flat.normal, rotation) == inferior:
        tilt = math.degrees(math.acos(min(-flat.normal[1], 1.0)))
        return InputError(
            f"flat bottom of {name} is tilted by {tilt:.0f} deg from {inferior} of the mesh",
            None,
            f"turn the mesh so that it is within {math.degrees(TILT_LIMIT):.0f} deg",
        )
    return InputError(
        f"flat bottom of {name} ({_described(flat, rotation)}) faces "
        f"{facing(flat.normal, rotation)} of the mesh; axes say that {inferior} is inferior",
        None,
        "name the axes that point anterior, superior and right so that superior is "
        f"{facing(-flat.normal, rotation)}",
    )


def insert_placement(surface: Surface, rotation: Array | None = None) -> Array:
    """Return the pose (4, 4) of the insert's mesh, turned to anatomical axes, in the insert frame.

    Its plane y = 0 is the flat bottom, which faces -y, with the origin at the centre of its
    bounding rectangle. The smallest rotation turns a tilted mesh level.

    `surface` and `rotation`: see `find_flat_bottom`.
    """
    flat = find_flat_bottom(surface, rotation)
    level = _levelling(flat.normal)
    bottom = surface.vertices[flat.vertices] @ level.T
    low, high = bottom.min(axis=0), bottom.max(axis=0)
    height = np.median(bottom[:, 1])
    return pose(level, -np.array([(low[0] + high[0]) / 2, height, (low[2] + high[2]) / 2]))


def facing(direction: Array, rotation: Array | None = None) -> str:
    """Return the mesh axis ("+x" … "-z") nearest to a direction in anatomical axes."""
    in_mesh = direction if rotation is None else rotation.T @ direction
    axis = int(np.argmax(np.abs(in_mesh)))
    return f"{'-' if in_mesh[axis] < 0 else '+'}{'xyz'[axis]}"


def _described(flat: FlatBottom, rotation: Array) -> str:
    x, y, z = 1e3 * (rotation.T @ flat.centre)
    return (
        f"{1e6 * flat.area:.4g} mm² at ({x:.1f}, {y:.1f}, {z:.1f}) mm, "
        f"facing {facing(flat.normal, rotation)}"
    )


def _levelling(normal: Array) -> Array:
    axis = np.cross(normal, [0.0, -1.0, 0.0])
    sine = float(np.linalg.norm(axis))
    if sine < LEVEL_TILT:
        return np.eye(3)
    angle = math.atan2(sine, -normal[1])
    return Rotation.from_rotvec(axis / sine * angle).as_matrix()


def _largest_flat(
    surface: Surface, normals: Array, area: Array, free: Mask, least: float
) -> FlatBottom | None:
    """Return the largest flat of free triangles; None below `least` (m²)."""
    best: FlatBottom | None = None
    for seed in _peaks(normals[free], area[free]):
        near = np.flatnonzero(free & (normals @ seed > math.cos(_CONE)))
        if area[near].sum() < (least if best is None else best.area):
            continue
        flat = _grown(surface, normals, area, near, seed)
        if flat is not None and (best is None or flat.area > best.area):
            best = flat
    return best


def _peaks(normals: Array, area: Array) -> list[Array]:
    """Return the directions (3,) that the most area faces: at most 8, at least 15 deg apart."""
    # Each cell of the unit sphere has one number, because `np.unique` is slower on rows.
    number = np.round(normals * 6.0).astype(np.int64) @ [400, 20, 1]
    cells, cell = np.unique(number, return_inverse=True)
    weight = np.bincount(cell, area, len(cells))
    mean = np.stack([np.bincount(cell, area * n, len(cells)) for n in normals.T], axis=1)
    mean = mean / np.linalg.norm(mean, axis=1, keepdims=True)
    votes = np.array([weight[mean @ m > math.cos(_CONE / 2)].sum() for m in mean])
    peaks: list[Array] = []
    for index in np.argsort(-votes):
        if all(mean[index] @ peak < math.cos(_CONE) for peak in peaks):
            peaks.append(mean[index])
        if len(peaks) == 8:
            break
    return peaks


def _grown(
    surface: Surface, normals: Array, area: Array, near: Index, seed: Array
) -> FlatBottom | None:
    corners, weight = surface.triangles[near], area[near]
    normal, cone = _sharpened(seed, normals[near], weight), _CONE
    offset = _densest(corners.mean(axis=1) @ normal, weight, 20 * FLATNESS)
    tolerances = (
        20 * FLATNESS,
        8 * FLATNESS,
        3 * FLATNESS,
        FLATNESS,
        0.0,
        0.0,
    )
    chosen = np.zeros(len(near), bool)
    for tolerance in tolerances:
        if tolerance == 0.0:
            spread = _median(np.abs(corners @ normal - offset).max(axis=1)[chosen], weight[chosen])
            lean = _median(
                np.arccos(np.clip(normals[near] @ normal, -1, 1))[chosen], weight[chosen]
            )
            tolerance = min(max(3 * spread, 1e-6), FLATNESS)
            cone = min(max(6 * lean, math.radians(0.5)), _CONE)
        distance = np.abs(corners @ normal - offset).max(axis=1)
        chosen = (distance <= tolerance) & (normals[near] @ normal > math.cos(cone))
        if chosen.sum() == 0:
            return None
        normal, offset = _plane(corners[chosen], weight[chosen], normal)
    faces = near[chosen]
    vertices = np.flatnonzero(np.abs(surface.vertices @ normal - offset) <= tolerance)
    noise = float(np.sqrt(np.mean((surface.vertices[vertices] @ normal - offset) ** 2)))
    total = float(weight[chosen].sum())
    centre = weight[chosen] @ corners[chosen].mean(axis=1) / total
    return FlatBottom(normal, centre, total, faces, vertices, noise)


def _sharpened(direction: Array, normals: Array, weight: Array) -> Array:
    """Return the mean normal (3,) in a cone that is narrowed in steps."""
    for cone in np.radians([15.0, 8.0, 4.0, 2.0, 2.0]):
        mean = (weight * (normals @ direction > math.cos(cone))) @ normals
        length = np.linalg.norm(mean)
        if length == 0:
            break
        direction = mean / length
    return direction


def _densest(offsets: Array, weight: Array, window: float) -> float:
    """Return the mean offset (m) in the window with the most area."""
    order = np.argsort(offsets)
    offsets, total = offsets[order], np.concatenate([[0.0], np.cumsum(weight[order])])
    last = np.searchsorted(offsets, offsets + window, side="right")
    first = int(np.argmax(total[last] - total[:-1]))
    inside = slice(first, last[first])
    return float(np.average(offsets[inside], weights=weight[order][inside]))


def _median(values: Array, weight: Array) -> float:
    order = np.argsort(values)
    total = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(total, total[-1] / 2)])


def _plane(corners: Array, weight: Array, towards: Array) -> tuple[Array, float]:
    """Return normal (3,) and offset (m) of the least-squares plane, by area."""
    total = weight.sum()
    middle = corners.mean(axis=1)
    centre = weight @ middle / total
    arms = np.concatenate([(corners - centre).reshape(-1, 3), 3 * (middle - centre)])
    scale = np.concatenate([np.repeat(weight, 3), weight]) / 12
    moment = np.einsum("i,ij,ik->jk", scale, arms, arms)
    normal = np.linalg.eigh(moment)[1][:, 0]
    normal = normal if normal @ towards > 0 else -normal
    return normal, float(normal @ centre)
