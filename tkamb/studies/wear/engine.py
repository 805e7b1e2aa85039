"""Contact, sliding and worn surface: pressure maps of a cycle at the insert's vertices."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import pinocchio
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.sparse import csr_array
from scipy.spatial import Delaunay

from tkamb.contact.flags import unmeasured_flags
from tkamb.contact.materials import Material
from tkamb.contact.model import ContactModel
from tkamb.contact.pair import Bearing, ContactPair
from tkamb.contact.result import ContactStatus
from tkamb.errors import InputError
from tkamb.geometry.frames import Array, inverse
from tkamb.geometry.frames import pose as pose_of
from tkamb.geometry.rays import RayCaster
from tkamb.geometry.surface import Surface
from tkamb.geometry.topology import edge_use
from tkamb.studies.wear.motion import CycleMotion
from tkamb.studies.wear.simulator import EquilibriumPoses

Chosen = Callable[[Surface], NDArray[np.bool_]]

DOWN = np.array([0.0, -1.0, 0.0])


@dataclass(frozen=True)
class WornSurfaceSettings:
    """Surface from which wear is removed."""

    min_normal_y: float = 0.1
    """Smallest y component of the unit normal of a face that can wear. Such a face
    is inclined by 84 deg."""
    ray_offset: float = 1e-6
    """m: depth below the surface at which rays through the insert begin. Above the round-off
    of a mesh."""
    max_halvings: int = 12
    """Largest number of halvings of an edge. They reduce one metre to a quarter of a
    millimetre."""


WORN_SURFACE = WornSurfaceSettings()


@dataclass(frozen=True, eq=False)
class ArticularSurface:
    """The upward-facing vertices of the insert, with their tributary areas.

    A vertex has a third of the area vector of each of its triangles. Its normal n is the direction
    of the sum over its upward-facing triangles, so at the rim the wall has no effect. Its area is
    the y component of the sum over all its triangles, divided by n_y.

    A worn depth h along the normal moves the vertex down by h/n_y. The volume of a closed surface
    is linear in y, so for any depth exactly

        volume removed = sum over vertices of h times area

    Args:
        surface: insert in the insert frame, refined where it can wear.
        vertices: numbers of the n vertices that can wear, shape (n,).
        thickness: thickness of the unworn insert below each vertex along y, m, shape (n,).
    """

    surface: Surface
    vertices: NDArray[np.int64]
    thickness: Array

    @classmethod
    def of_insert(cls, insert: Surface, spacing: float) -> "ArticularSurface":
        """Return the articular surface of an insert, with edges of at most `spacing`, m."""
        merged = insert.mesh.copy()
        merged.merge_vertices()
        finer = refined(
            Surface(np.asarray(merged.vertices), np.asarray(merged.faces), insert.name),
            spacing,
            lambda s: s.face_normals[:, 1] > WORN_SURFACE.min_normal_y,
        )
        surface = insert.remade(finer.vertices, finer.faces)
        upward, total = area_vectors(surface)
        length = np.linalg.norm(upward, axis=1)
        up = np.flatnonzero((upward[:, 1] > WORN_SURFACE.min_normal_y * length) & (total[:, 1] > 0))
        points = surface.vertices[up]
        caster = RayCaster(surface)
        above = points.copy()
        above[:, 1] = surface.bounds[1, 1] + 1e-3
        first = caster.first(above, DOWN)[0]
        # a vertex below another part of the insert cannot wear
        top = np.abs(above[:, 1] - first - points[:, 1]) < 10 * WORN_SURFACE.ray_offset
        thickness = (
            WORN_SURFACE.ray_offset + caster.first(points + WORN_SURFACE.ray_offset * DOWN, DOWN)[0]
        )
        can_wear = top & np.isfinite(thickness)
        if not can_wear.any():
            raise InputError("no part of it faces upwards", insert.name, "check the mesh's axes")
        return cls(surface, up[can_wear], thickness[can_wear])

    def lowered(self, fall: Array) -> Surface:
        """Return the insert with its articular vertices moved down by `fall`, m, shape (n,)."""
        vertices = self.surface.vertices.copy()
        vertices[self.vertices, 1] -= fall
        return self.surface.remade(vertices, self.surface.faces)

    def normals_and_areas(self, lowered: Surface) -> tuple[Array, Array]:
        """Return unit normals (n, 3) and areas, m², (n,) of the vertices of a lowered surface."""
        upward, total = (vectors[self.vertices] for vectors in area_vectors(lowered))
        normals = upward / np.linalg.norm(upward, axis=1)[:, None]
        return normals, total[:, 1] / normals[:, 1]


def area_vectors(surface: Surface) -> tuple[Array, Array]:
    """Return a third of the summed area vectors of the triangles at each vertex, m², shape (n, 3).

    Returns:
        Sums over the upward-facing triangles, and over all triangles.
    """
    a, b, c = np.moveaxis(surface.triangles, 1, 0)
    vector = np.cross(b - a, c - a) / 6.0
    corners, count = surface.faces.T.ravel(), len(surface.vertices)

    def summed(each: Array) -> Array:
        return np.stack([np.bincount(corners, np.tile(v, 3), count) for v in each.T], axis=1)

    up = surface.face_normals[:, 1] > WORN_SURFACE.min_normal_y
    return summed(np.where(up[:, None], vector, 0.0)), summed(vector)


def volume(surface: Surface) -> float:
    """Return the volume inside a closed surface, m³."""
    a, b, c = np.moveaxis(surface.triangles - surface.bounds.mean(axis=0), 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def refined(surface: Surface, longest: float, chosen: Chosen) -> Surface:
    """Return the surface with the edges of chosen faces halved until none exceeds `longest`.

    Both faces of an edge get the same new vertex, so a closed surface stays closed. The shape does
    not change, and the original vertices come first.

    Args:
        longest: largest length of an edge, m.
        chosen: function of a surface that returns whether to refine each face, shape (k,).
    """
    for _ in range(WORN_SURFACE.max_halvings):
        halved = _halved(surface, longest, chosen(surface))
        if halved is None:
            break
        surface = halved
    return surface


def _halved(surface: Surface, longest: float, chosen: NDArray[np.bool_]) -> Surface | None:
    faces, vertices = surface.faces, surface.vertices
    edge, count = edge_use(faces)
    edge = edge.reshape(-1, 3)  # edges 01, 12, 20 of each face
    start, end = faces, np.roll(faces, -1, axis=1)
    long = np.linalg.norm(vertices[end] - vertices[start], axis=2) > longest
    marked = np.zeros(len(count), bool)
    marked[edge[long & chosen[:, None]]] = True
    if not marked.any():
        return None
    number = np.full(len(count), -1)
    number[marked] = len(vertices) + np.arange(marked.sum())
    middles = np.empty((marked.sum(), 3))
    middles[number[edge[marked[edge]]] - len(vertices)] = (
        0.5 * (vertices[start] + vertices[end])[marked[edge]]
    )
    points = np.concatenate([vertices, middles])
    return Surface(points, _split(faces, number[edge], points), surface.name)


def _split(faces: NDArray[np.int64], middle: NDArray[np.int64], points: Array) -> NDArray[np.int64]:
    """Return the faces after a division of their edges.

    `middle` has the number of the vertex in the middle of each edge, shape (k, 3); -1: not divided.
    """
    cut = middle >= 0
    cuts = cut.sum(axis=1)
    parts = [faces[cuts == 0]]
    # the first edge of a rotated face is its only divided or its only undivided edge
    for count, first in ((1, cut), (2, ~cut)):
        rows = np.flatnonzero(cuts == count)
        order = (first[rows].argmax(axis=1)[:, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(faces[rows], order, axis=1).T
        ab, bc, ca = np.take_along_axis(middle[rows], order, axis=1).T
        if count == 1:
            parts += [np.stack([a, ab, c], 1), np.stack([ab, b, c], 1)]
            continue
        # a-b is undivided: cut off the corner c, then divide the rest along its shorter diagonal
        parts.append(np.stack([ca, bc, c], 1))
        shorter = np.linalg.norm(points[a] - points[bc], axis=1) <= np.linalg.norm(
            points[b] - points[ca], axis=1
        )
        first_half = np.stack(
            [np.where(shorter, a, b), np.where(shorter, b, bc), np.where(shorter, bc, ca)]
        )
        second_half = np.stack([a, np.where(shorter, bc, b), ca])
        parts += [first_half.T, second_half.T]
    rows = np.flatnonzero(cuts == 3)
    (a, b, c), (ab, bc, ca) = faces[rows].T, middle[rows].T
    parts += [np.stack(t, 1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    return np.concatenate(parts)


def step_twists(poses: Array) -> Array:
    """Return the spatial twist of the screw motion from each pose to the next, shape (f - 1, 6).

        exp(twist) = pose_{k+1} pose_k^-1

    The linear part, m, comes first. It is the velocity of the femoral material at the origin of the
    insert frame times the duration of the step. The angular part, rad, follows.

    Args:
        poses: pose_femoral_in_insert, shape (f, 4, 4).
    """
    moves = poses[1:] @ inverse(poses[:-1])
    return np.array([pinocchio.log6(pinocchio.SE3(move)).vector for move in moves]).reshape(-1, 6)


def step_sliding(poses: Array, points: Array, normals: Array) -> Array:
    """Return the sliding path of the femoral surface over each point, m, shape (f - 1, n, 3).

    In a screw motion the femoral material at a fixed point x has the constant velocity
    v + omega × x, which is zero for pure rolling. The path of a step is therefore exact for
    rotations of any size. The component along the insert's normal is removed.

    Args:
        poses: pose_femoral_in_insert, shape (f, 4, 4).
        points: points on the insert, m, shape (n, 3).
        normals: unit outward normals of the insert at the points, shape (n, 3).
    """
    twists = step_twists(poses)
    path = twists[:, None, :3] + np.cross(twists[:, None, 3:], points[None])
    along = np.einsum("snj,nj->sn", path, normals)
    return path - along[..., None] * normals


@dataclass(frozen=True, eq=False)
class SlidingHistory:
    """Pressure and sliding at points of the insert in each step of a cycle.

    Args:
        pressure: mean pressure of each step, Pa, shape (s, n); zero without contact.
        sliding: sliding path of the femoral surface in the tangent plane, m, shape (s, n, 3).
        normals: unit outward normals of the insert, shape (n, 3).
        passes: passes through the steps per cycle: 2 for a motion there and back.
        seconds: duration of each step, s, shape (s,); None: equal steps.
    """

    pressure: Array
    sliding: Array
    normals: Array
    passes: int = 1
    seconds: Array | None = None

    @classmethod
    def of_cycle(
        cls,
        poses: Array,
        pressure: Array,
        points: Array,
        normals: Array,
        passes: int = 1,
        seconds: Array | None = None,
    ) -> "SlidingHistory":
        """Return the history of frames with poses (f, 4, 4) and pressure maps (f, n).

        The pressure of a step is the mean of its two frames. Sums over the cycle are therefore
        trapezoidal rules, of second order in the step.
        """
        between = 0.5 * (pressure[:-1] + pressure[1:])
        return cls(between, step_sliding(poses, points, normals), normals, passes, seconds)

    @cached_property
    def length(self) -> Array:
        """Path length of each step, m, shape (s, n)."""
        return np.linalg.norm(self.sliding, axis=2)

    @cached_property
    def work(self) -> Array:
        """Pressure times path, N/m, shape (s, n): work of friction per area for coefficient 1."""
        return self.pressure * self.length

    @cached_property
    def total_work(self) -> Array:
        """Sum of `work` over the cycle, N/m, shape (n,)."""
        return self.passes * self.work.sum(axis=0)

    @cached_property
    def distance(self) -> Array:
        """Path over each point in contact per cycle, m, shape (n,)."""
        return self.passes * np.where(self.pressure > 0, self.length, 0.0).sum(axis=0)

    @cached_property
    def mean_pressure(self) -> Array:
        """Time-mean pressure of the whole cycle, Pa, shape (n,)."""
        return np.average(self.pressure, axis=0, weights=self.seconds)

    @cached_property
    def cross_shear(self) -> Array:
        """Cross-shear ratio, shape (n,), see `cross_shear_ratio`; zero without sliding."""
        return cross_shear_ratio(self.work, self.sliding, self.normals)


def cross_shear_ratio(work: Array, sliding: Array, normals: Array) -> Array:
    """Return the share of the work of friction across the principal direction, shape (n,).

    The work w of a step in the direction t of the tangent plane has the parts w cos²(t - a) along
    and w sin²(t - a) across a direction a. Their sums over the cycle are the quadratic forms of

        M = sum over steps of w d dᵀ,      d the unit direction of sliding

    The principal direction has the largest work along it. It is the eigenvector of the larger
    eigenvalue of M, and the cross-shear ratio is

        CS = lambda_min / (lambda_min + lambda_max)

    Under constant pressure CS is A/(A + B) for a rectangular path with sides A <= B, 1/2 for a
    circle and 0 for a line.

    Args:
        work: pressure times path, N/m, shape (s, n).
        sliding: sliding path in the tangent plane, m, shape (s, n, 3).
        normals: unit normals, shape (n, 3).

    References:
        Wang, Wear 248:38 (2001): molecules align with the principal direction of sliding and are
        torn by work across it; Turell et al., Wear 259:984 (2005): rectangular paths, A/(A + B).
    """
    first, second = _tangents(normals)
    u = np.einsum("snj,nj->sn", sliding, first)
    v = np.einsum("snj,nj->sn", sliding, second)
    square = u**2 + v**2
    share = np.divide(work, square, out=np.zeros_like(work), where=square > 0)
    uu, vv, uv = ((share * a).sum(axis=0) for a in (u * u, v * v, u * v))
    total = uu + vv
    difference = np.hypot(uu - vv, 2.0 * uv)  # lambda_max - lambda_min
    ratio = np.divide(total - difference, 2.0 * total, out=np.zeros_like(total), where=total > 0)
    return np.clip(ratio, 0.0, 0.5)


def _tangents(normals: Array) -> tuple[Array, Array]:
    """Return two perpendicular unit vectors (n, 3) in the tangent plane of each normal."""
    axis = np.eye(3)[np.abs(normals).argmin(axis=1)]  # the axis farthest from the normal
    first = np.cross(normals, axis)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(normals, first)


GRID = (-0.012, -0.006, 0.0, 0.006, 0.012)
"""m: positions along x of the initial guesses of the dwell position."""


@dataclass(frozen=True)
class WearGridSettings:
    """Grid of the initial guesses of the dwell position."""

    spacing_z: float = 0.002
    """m: spacing of the initial guesses along z (mediolateral). A wear scar is
    several times as wide."""


WEAR_GRID = WearGridSettings()

SEARCH = {"xatol": 1e-5, "fatol": 1e-9, "maxfev": 120}
"""Options of the simplex search: x and z to 10 µm (xatol), height to 1 nm (fatol)."""


@dataclass(frozen=True, eq=False)
class CycleMaps:
    """Pressure maps of a cycle.

    Args:
        points: map points on the insert, m, shape (m, 3).
        triangles: point numbers of the triangles between them, shape (k, 3).
        pressure: contact pressure, Pa, shape (f, m).
        poses: femoral poses of the maps, shape (f, 4, 4). A frame without load has its given pose.
        failed: frame -> reason why its contact or equilibrium failed.
        flagged: frame -> flag of a contact at a defect of a mesh or over an unsupported bottom.
    """

    points: Array
    triangles: NDArray[np.int64]
    pressure: Array
    poses: Array
    failed: dict[int, str]
    flagged: dict[int, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class ContactEngine:
    """A contact model with femoral component and insert material, for any shape of the insert."""

    model: ContactModel
    femoral: Surface
    material: Material
    bearing: Bearing = "fixed"

    def maps(self, insert: Surface, motion: CycleMotion) -> CycleMaps:
        """Return the pressure maps of all frames of a motion on an insert.

        If the motion has a drive, equilibrium on this insert gives the poses.
        """
        pair = ContactPair(self.femoral, insert, self.material, self.bearing)
        state = self.model.prepare(pair)
        pressure = np.zeros((len(motion), len(state.points)))
        poses, failed, flagged, warm_start = motion.poses.copy(), {}, {}, None
        drive = motion.drive
        equilibrium = None if drive is None else EquilibriumPoses(self.model, state, drive)
        for k, (pose, load) in enumerate(zip(motion.poses, motion.load, strict=True)):
            if load <= 0:
                continue
            if equilibrium is not None:
                pose, reason = equilibrium.at(k, float(load), warm_start)
                if reason:
                    failed[k] = reason
                    continue
            result, end = self.model.press_from(state, float(load), pose, warm_start)
            if result.status is not ContactStatus.OK:
                failed[k] = "; ".join(result.flags) or result.status.value
                continue
            pressure[k], poses[k], warm_start = result.pressure, result.pose, end
            if beyond := unmeasured_flags(result.flags):
                flagged[k] = beyond[0]
        return CycleMaps(state.points, state.triangles, pressure, poses, failed, flagged)

    def dwell(self, insert: Surface, rotation: Array) -> tuple[float, float]:
        """Return the dwell position: x and z, m, where the femoral component lies lowest.

        A simplex search minimises the height of first touch, from the best of the initial guesses.
        AP and ML of a simulator are relative to the dwell position.

        Args:
            insert: insert in the insert frame.
            rotation: orientation of the femoral component, shape (3, 3).
        """
        pair = ContactPair(self.femoral, insert, self.material, self.bearing)

        def height(place: Array) -> float:
            result = pair.first_touch_height(pose_of(rotation, [place[0], 0.0, place[1]]))
            return result if np.isfinite(result) else 1.0

        middle = self.femoral.moved(pose_of(rotation, [0.0] * 3)).bounds.mean(axis=0)
        # around the origin of the insert frame: first the femoral origin, then the bounds' middle
        guesses = [
            np.array([x, z]) - offset
            for offset in (np.zeros(2), middle[[0, 2]])
            for x in GRID
            for z in (-WEAR_GRID.spacing_z, 0.0, WEAR_GRID.spacing_z)
        ]
        heights = [height(guess) for guess in guesses]
        best = guesses[int(np.argmin(heights))]
        if min(heights) >= 1.0:
            raise InputError("is not above the insert", self.femoral.name, "check the axes")
        result = minimize(height, best, method="Nelder-Mead", options=SEARCH)
        return float(result.x[0]), float(result.x[1])


def interpolation(map_points: Array, points: Array) -> csr_array:
    """Return weights (n, m) that interpolate values at map points (m, 3) to points (n, 3).

    The interpolation in x and z is linear on the Delaunay triangles of the map points, and zero
    outside their hull.
    """
    triangulation = Delaunay(map_points[:, [0, 2]])
    positions = points[:, [0, 2]]
    simplex = triangulation.find_simplex(positions)
    inside = np.flatnonzero(simplex >= 0)
    affine = triangulation.transform[simplex[inside]]
    barycentric = np.einsum("nij,nj->ni", affine[:, :2], positions[inside] - affine[:, 2])
    weights = np.column_stack([barycentric, 1.0 - barycentric.sum(axis=1)])
    weights = np.nan_to_num(np.clip(weights, 0.0, 1.0))  # NaN: a triangle without area
    columns = triangulation.simplices[simplex[inside]]
    rows = np.repeat(inside, 3)
    shape = (len(points), len(map_points))
    return csr_array((weights.ravel(), (rows, columns.ravel())), shape=shape)


def scaled_to_load(pressure: Array, projected: Array, load: Array) -> tuple[Array, float]:
    """Return pressure maps scaled to their loads, and the largest relative change.

    Args:
        pressure: pressure maps, Pa, shape (f, n).
        projected: tributary area of each point, projected on the xz plane, m², shape (n,).
        load: load of each map along -y, N, shape (f,).
    """
    force = pressure @ projected
    scale = np.divide(load, force, out=np.ones_like(force), where=(force > 0) & (load > 0))
    return pressure * scale[:, None], float(np.abs(scale - 1.0).max(initial=0.0))
