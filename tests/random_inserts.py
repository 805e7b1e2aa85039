"""Random inserts: blocks with ridges, posts, steps, notches, holes and voids, in any pose."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from tkamb.contact.lattice.meshing.cells import cell_volumes
from tkamb.contact.lattice.meshing.quality import whole_lattice
from tkamb.contact.materials import material
from tkamb.contact.pair import ContactPair
from tkamb.contact.registry import contact_model
from tkamb.contact.result import ContactStatus
from tkamb.geometry.flat_bottom import insert_placement
from tkamb.geometry.frames import Array, Mask, pose
from tkamb.geometry.repair import repair
from tkamb.geometry.surface import Surface

KINDS = ("ridge", "post", "step", "notch", "hole", "void", "dish")
EVEN_SIZES = (0.75, 1.0, 1.25, 1.5, 2.0, 2.5, 3.0)
"""mm: cell sizes with which grid lines lie exactly under the walls of a design."""
TWIST = np.array([[0, 0], [0, 1], [1, 1], [1, 0]])


def voxel_surface(lines: tuple[Array, Array, Array], solid: Mask, name: str = "insert") -> Surface:
    """Return the closed surface of the solid cells of an uneven grid.

    Args:
        lines: increasing coordinates (m) of the planes normal to x, y and z.
        solid: (nx - 1, ny - 1, nz - 1) whether a cell is solid.
        name: name of the surface.
    """
    shape = tuple(len(line) for line in lines)
    number = np.arange(np.prod(shape)).reshape(shape)
    full = np.pad(solid, 1)
    quads = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        before = np.moveaxis(full, axis, 0)[:-1]
        after = np.moveaxis(full, axis, 0)[1:]
        for inner, outer, outward in ((before, after, 1), (after, before, -1)):
            face = np.argwhere(np.moveaxis(inner & ~outer, 0, axis))
            face -= np.where(np.arange(3) == axis, 0, 1)
            ring = np.zeros((4, 3), np.int64)
            ring[:, u], ring[:, v] = TWIST[:, 1], TWIST[:, 0]
            corners = number[tuple(np.moveaxis(face[:, None] + ring, -1, 0))]
            quads.append(corners if outward > 0 else corners[:, ::-1])
    corners = np.concatenate(quads)
    faces = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
    points = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)
    used, faces = np.unique(faces, return_inverse=True)
    return Surface(points[used], faces.reshape(-1, 3).astype(np.int64), name)


@dataclass(frozen=True, eq=False)
class RandomInsert:
    """An insert in an arbitrary pose, and its features.

    Args:
        surface: closed surface, m.
        kinds: kinds of the features.
        size: m, edge of the lattice's cells.
        symmetric: whether the insert is symmetric about z = 0.
    """

    surface: Surface
    kinds: tuple[str, ...]
    size: float
    symmetric: bool


def random_insert(seed: int, symmetric: bool | None = None) -> RandomInsert:
    """Return the random insert of a seed."""
    random = np.random.default_rng(seed)
    symmetric = bool(random.random() < 0.3) if symmetric is None else symmetric
    length, width = random.uniform(35, 60), random.uniform(55, 85)
    height = random.uniform(6, 14)
    if random.random() < 0.5:  # round numbers as in CAD, on planes of the grid
        length, width, height = np.round(length), np.round(width), np.round(height)
    kinds = tuple(random.choice(KINDS, size=random.integers(1, 4), replace=False))
    features = [_feature(random, kind, length, width, height) for kind in kinds]
    if symmetric:
        features += [(kind, (x, y, (-z[1], -z[0]))) for kind, (x, y, z) in features]
    even = random.random() < 0.5
    size = float(random.choice(EVEN_SIZES) if even else random.uniform(0.7, 3.0))
    on_ties = bool(random.random() < 0.4)
    if on_ties:
        features = [(kind, _on_ties(box, (length, width), size)) for kind, box in features]
    lines, solid = _filled(features, (length, width, height))
    surface = voxel_surface(tuple(1e-3 * line for line in lines), solid)
    dished = "dish" in kinds
    surface = _shaped(random, surface, 1e-3 * height, dished, symmetric, on_ties)
    return RandomInsert(surface, kinds, 1e-3 * size, symmetric)


def _on_ties(box, plan, size):
    """Return the box with walls moved to planes of a grid's nodes, or half-way between them."""
    moved = list(box)
    for axis, extent in zip((0, 2), plan, strict=True):
        half = extent / round(extent / size) / 2
        planes = [half * np.round((edge + extent / 2) / half) - extent / 2 for edge in box[axis]]
        moved[axis] = (planes[0], max(planes[1], planes[0] + 2 * half))
    return tuple(moved)


def _interval(random, low, high, least, most):
    """Return a random interval within [low, high]; half of the intervals are round numbers."""
    size = random.uniform(least, min(most, high - low))
    start = random.uniform(low, high - size)
    if random.random() < 0.5:
        start, size = np.round(2 * start) / 2, max(np.round(2 * size) / 2, 0.5)
    return max(start, low), min(start + size, high)


def _feature(random, kind, length, width, height):
    """Return a kind and the box of the feature: lower and upper x, y and z, mm."""
    x, z = (-length / 2, length / 2), (-width / 2, width / 2)
    inner_x, inner_z = (x[0] + 4, x[1] - 4), (z[0] + 4, z[1] - 4)
    if kind == "ridge":  # along x or along z, up to the outline
        box = x, (height, height + random.uniform(1, 9)), _interval(random, *z, 4, 20)
        return kind, box if random.random() < 0.6 else (_interval(random, *x, 4, 20), box[1], z)
    if kind == "post":
        rise = (height, height + random.uniform(3, 14))
        return kind, (_interval(random, *inner_x, 5, 16), rise, _interval(random, *inner_z, 5, 16))
    if kind == "step":  # one end is lower
        low = (random.uniform(0.5, 0.8) * height, height)
        edge = _interval(random, *x, 5, 15)
        return kind, ((x[0], edge[1]) if random.random() < 0.5 else (edge[0], x[1]), low, z)
    if kind == "notch":  # through, open to the outline
        depth = random.uniform(5, 0.6 * length)
        return kind, ((x[0], x[0] + depth), (0, height), _interval(random, *inner_z, 4, 20))
    box = _interval(random, *inner_x, 4, 14), (0, height), _interval(random, *inner_z, 4, 14)
    if kind == "void":
        return kind, (box[0], (0.3 * height, 0.7 * height), box[2])
    return kind, box  # a hole; for a dish the box is not used


def _filled(features, size):
    """Return the lines (mm) and the solid cells of a block with features."""
    length, width, height = size
    planes = [[-length / 2, length / 2], [0.0, height], [-width / 2, width / 2]]
    for _, box in features:
        for axis in range(3):
            planes[axis] += list(box[axis])
    lines = [
        _refined(np.unique(np.round(plane, 9)), step)
        for plane, step in zip(planes, (2, 3, 2), strict=True)
    ]
    middle = np.meshgrid(*[(line[1:] + line[:-1]) / 2 for line in lines], indexing="ij")
    solid = middle[1] < height
    for kind, box in sorted(features, key=lambda f: f[0] not in ("ridge", "post")):
        within = np.all(
            [(m > low) & (m < high) for m, (low, high) in zip(middle, box, strict=True)], axis=0
        )
        if kind in ("ridge", "post"):
            solid |= within
        elif kind != "dish":
            above = (middle[1] > box[1][0]) if kind in ("step", "notch", "hole") else True
            column = np.all(
                [(middle[a] > box[a][0]) & (middle[a] < box[a][1]) for a in (0, 2)], axis=0
            )
            solid &= ~(within if kind == "void" else column & above)
    return lines, solid


def _refined(planes, step):
    """Return the planes and evenly spaced planes between them, at most `step` apart."""
    parts = [np.linspace(a, b, int(np.ceil((b - a) / step)) + 1)[:-1] for a, b in pairwise(planes)]
    return np.concatenate([*parts, planes[-1:]])


def _shaped(random, surface, height, dished, symmetric, upright):
    """Return the block with dishes if `dished`, random slants of its walls and a random pose."""
    points = surface.vertices.copy()
    half = np.abs(points[:, [0, 2]]).max(axis=0)
    share = points[:, 1] / height
    if dished:  # two dishes, deepest in the middle of surface side
        u, v = points[:, 0] / half[0], (np.abs(points[:, 2]) - half[1] / 2) / (half[1] / 2)
        points[:, 1] *= 1.0 - 0.3 * np.maximum(1 - u**2, 0) * np.maximum(1 - v**2, 0)
    if upright:
        return Surface(points, surface.faces, surface.name)
    if random.random() < 0.3:  # walls with a draft
        taper = random.uniform(-0.08, 0.08)
        points[:, [0, 2]] *= (1.0 + taper * share)[:, None]
    if random.random() < 0.3:
        points[:, 0] += random.uniform(-0.15, 0.15) * points[:, 1]
        slope = random.uniform(-0.1, 0.1)
        points[:, 1] += np.where(points[:, 1] > 0, slope * share * points[:, 0], 0.0)
    place = np.eye(4)
    if random.random() < 0.5:
        yaw = 0.0 if symmetric else random.uniform(-30, 30)
        angles = np.radians(
            [random.uniform(-8, 8), yaw, 0.0 if symmetric else random.uniform(-8, 8)]
        )
        turn = Rotation.from_euler("zyx", angles).as_matrix()
        place = pose(turn, random.uniform(-0.05, 0.05, 3) * [1, 1, 0 if symmetric else 1])
    return Surface(points, surface.faces, surface.name).moved(place)


def in_insert_frame(design: RandomInsert) -> Surface:
    """Return the design as in a run: repaired, and in the insert frame."""
    repaired = repair(design.surface.vertices, design.surface.faces)
    assert not repaired.holes and not len(repaired.forks) and not repaired.one_sided
    surface = Surface(repaired.vertices, repaired.faces, "insert", merged=True)
    return surface.moved(insert_placement(surface))


def lattice_error(design: RandomInsert) -> float:
    """Return the relative difference between the volumes of a run's lattice and of the mesh.

    Raises:
        InputError: the lattice is refused.
    """
    surface = in_insert_frame(design)
    lattice = whole_lattice(surface, design.size)
    return cell_volumes(lattice.nodes[lattice.cells]).sum() / surface.volume - 1.0


def share_of_load(design: RandomInsert, contact: str = "lattice-linear") -> float | None:
    """Return the medial condyle's share of 1000 N on two condyles; None if the press fails."""
    insert = in_insert_frame(design)
    width = np.ptp(insert.bounds[:, 2])
    balls = []
    for side in (-1, 1):
        ball = trimesh.creation.icosphere(4, 0.022)
        ball.apply_translation([0.0, 0.05, side * width / 4])
        balls.append(ball)
    spheres = trimesh.util.concatenate(balls)
    vertices = np.asarray(spheres.vertices)
    vertices[:, 2] = np.where(vertices[:, 2] < 0, vertices[:, 2], np.abs(vertices[:, 2]))
    femoral = Surface(vertices, np.asarray(spheres.faces, np.int64), "femoral", merged=True)
    pair = ContactPair(femoral, insert, material("polyethylene"))
    model = contact_model(contact, resolution=max(1e3 * design.size, 1.5) * 1e-3, cache=False)
    result = model.press(model.prepare(pair), 1000.0, np.eye(4))
    if result.status is not ContactStatus.OK:
        return None
    medial, lateral = (
        0.0 if part is None else part.force for part in (result.medial, result.lateral)
    )
    return medial / (medial + lateral)


def joined_surfaces(*surfaces: Surface) -> Surface:
    """Return several surfaces as one, unmerged."""
    first = np.cumsum([0, *(len(surface.vertices) for surface in surfaces[:-1])])
    faces = [surface.faces + start for surface, start in zip(surfaces, first, strict=True)]
    return Surface(
        np.concatenate([surface.vertices for surface in surfaces]), np.concatenate(faces)
    )
