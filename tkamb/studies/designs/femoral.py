"""A femoral component: sagittal J-curves swept with a coronal groove-and-ridge profile.

The J-curve is a chain of circular arcs with common tangents. A point of the articular surface has
two coordinates: phi, the angle of the normal of the sagittal profile, and z, the mediolateral
position. It lies `depth` below the profile along the inward normal. Every condyle is therefore a
piece of a torus, with the sagittal radius at the ridge and the coronal radius across it. If the
J-curves of the two condyles differ, the surface blends from one to the other in the groove.

A posterior-stabilised component has a cam: a cylinder that joins the two walls of the box. It is
exact up to `FLANGE_MM` from a wall. There it widens to the edge of an opening in the wall, so the
mesh is one closed body without self-intersection.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.studies.designs import solids

# Number of facets around a cam. The facets lie within 0.05 % of the radius.
SIDES = 96
# Number of rings of vertices along the cam. Chosen for triangles about as long as wide.
STATIONS = 13
# mm: distance from a wall of the box to the cylinder. Chosen to leave room to widen it.
FLANGE_MM = 1.0
# deg: half the angle that the cam's opening in a wall subtends at the origin.
WINDOW_DEG = 22.0
# mm: distance within which a vertex lies in the plane of a wall. Above round-off.
WALL_TOLERANCE_MM = 1e-6


Ids = NDArray[np.int64]


@dataclass(frozen=True)
class Cam:
    """A cylinder along z across the box of a femoral component; mm, femoral frame."""

    centre_ap: float
    centre_si: float
    radius: float

    def rings(self, half_length: float) -> Array:
        """Return points (`STATIONS`, `SIDES`, 3) on the cylinder within ±half_length."""
        turn = np.linspace(0.0, 2.0 * np.pi, SIDES, endpoint=False)
        x = self.centre_ap + self.radius * np.cos(turn)
        y = self.centre_si + self.radius * np.sin(turn)
        z = np.linspace(-half_length, half_length, STATIONS)[:, None]
        return np.stack(np.broadcast_arrays(x, y, z), axis=-1)


def joined(cam: Cam, box_half: float, vertices: Array, faces: Ids) -> tuple[Array, Ids]:
    """Return a femoral component with its cam, closed.

    Args:
        box_half: half the width of the box, mm. Its walls are the planes z = ±box_half.
        vertices: vertices of the component without the cam, mm, (n, 3).
        faces: faces of the component without the cam, (k, 3).
    """
    cam_direction = np.arctan2(-cam.centre_ap, -cam.centre_si)
    angle = np.degrees(np.arctan2(-vertices[:, 0], -vertices[:, 1]) - cam_direction)
    near = np.abs((angle + 180.0) % 360.0 - 180.0) <= WINDOW_DEG
    loops = []
    for wall in (-box_half, box_half):
        inside = near & (np.abs(vertices[:, 2] - wall) < WALL_TOLERANCE_MM)
        window = inside[faces].all(axis=1)
        loops.append(_outline(vertices, faces[window]))
        faces = faces[~window]
    rings = cam.rings(box_half - FLANGE_MM)
    ids = len(vertices) + np.arange(rings.shape[0] * SIDES).reshape(-1, SIDES)
    vertices = np.concatenate([vertices, rings.reshape(-1, 3)])
    tube = [loops[0], *ids, loops[1]]
    sleeves = [_between(vertices, a, b) for a, b in pairwise(tube)]
    used, faces = np.unique(np.concatenate([faces, *sleeves]), return_inverse=True)
    return vertices[used], faces.reshape(-1, 3)


def _outline(vertices: Array, window: Ids) -> Ids:
    """Return a window's edge vertices, sorted by angle about their mean."""
    edges = window[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    pairs, count = np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)
    rim = pairs[count == 1]
    loop = np.unique(rim)
    if len(loop) >= 3 and len(loop) == len(rim):
        loop = loop[np.argsort(_angles(vertices, loop))]
        steps = np.sort(np.stack([loop, np.roll(loop, -1)], axis=1), axis=1)
        if np.array_equal(np.unique(steps, axis=0), rim):
            return loop
    raise InputError(
        "the cam cannot be joined to the walls of the box",
        "[cam]",
        "move the cam, or make the component thicker",
    )


def _angles(vertices: Array, loop: Ids) -> Array:
    x, y = (vertices[loop, :2] - vertices[loop, :2].mean(axis=0)).T
    return np.arctan2(y, x) % (2.0 * np.pi)


def _between(vertices: Array, first: Ids, second: Ids) -> Ids:
    """Return triangles between two loops sorted by angle; `second` has greater z."""
    ahead = [np.append(_angles(vertices, loop)[1:], np.inf) for loop in (first, second)]
    i = j = 0
    triangles = []
    while i < len(first) or j < len(second):
        if i < len(first) and (j == len(second) or ahead[0][i] <= ahead[1][j]):
            point, after = first[i], first[(i + 1) % len(first)]
            triangles.append((point, after, second[j % len(second)]))
            i += 1
        else:
            point, after = second[j], second[(j + 1) % len(second)]
            triangles.append((first[i % len(first)], after, point))
            j += 1
    return np.array(triangles, np.int64)


def normal(phi: ArrayLike) -> Array:
    """Return outward normals (..., 2) as (anterior, superior).

    They point distally at phi = 0 and posteriorly at phi = pi/2.
    """
    angle = np.asarray(phi, float)
    return np.stack([-np.sin(angle), -np.cos(angle)], axis=-1)


class SagittalProfile:
    """Circular arcs that meet with a common tangent.

    The centres of the arcs are c_{i+1} = c_i + (R_i - R_{i+1}) n(phi_i), where phi_i is the angle
    of the normal at which arcs i and i + 1 meet.

    Args:
        arcs: rows (from deg, to deg, radius mm), one after the other.
        origin: anterior and superior position of the first arc's centre, mm.
    """

    def __init__(self, arcs: ArrayLike, origin: Sequence[float] = (0.0, 0.0)) -> None:
        table = np.asarray(arcs, float)
        if table.ndim != 2 or table.shape[1] != 3 or not (table[:, 2] > 0.0).all():
            raise InputError("sagittal arcs are not (from, to, radius)", "sagittal_arcs_deg_mm")
        if (table[:-1, 1] != table[1:, 0]).any() or (table[:, 1] <= table[:, 0]).any():
            raise InputError(
                "sagittal arcs do not follow each other",
                "sagittal_arcs_deg_mm",
                "let each arc start at the angle at which the preceding arc ends",
            )
        self.radii = table[:, 2]
        self.joints = np.radians(table[:-1, 1])
        self.range = np.radians([table[0, 0], table[-1, 1]])
        self.centres = np.zeros((len(table), 2))
        self.centres[0] = origin
        for i, joint in enumerate(self.joints):
            shift = self.radii[i] - self.radii[i + 1]
            self.centres[i + 1] = self.centres[i] + shift * normal(joint)

    def moved(self, offset: ArrayLike) -> "SagittalProfile":
        """Return the same profile moved by offset (2,) mm."""
        ends = np.concatenate([self.range[:1], self.joints, self.range[1:]])
        arcs = np.column_stack([np.degrees(ends[:-1]), np.degrees(ends[1:]), self.radii])
        return SagittalProfile(arcs, self.centres[0] + np.asarray(offset))

    def centre_at(self, phi: float) -> Array:
        """Return the centre (2,) of the arc with the normal phi, rad."""
        return np.asarray(self.centres[np.searchsorted(self.joints, phi)])

    def point(self, phi: ArrayLike, depth: ArrayLike = 0.0) -> Array:
        """Return points (..., 2) at `depth` mm below the profile along the inward normal."""
        arc = np.searchsorted(self.joints, phi)
        radius = np.asarray(self.radii[arc] - depth)
        return np.asarray(self.centres[arc] + radius[..., None] * normal(phi))

    def nodes(self, spacings: Sequence[Sequence[float]]) -> Array:
        """Return the angles of the normals, rad, at which the mesh divides the profile.

        Args:
            spacings: rows (from deg, to deg, largest spacing mm).
        """
        pieces = []
        joints = np.degrees(self.joints)
        for start, end, spacing in spacings:
            ends = [start, *[j for j in joints if start + 1e-9 < j < end - 1e-9], end]
            for a, b in pairwise(ends):
                radius = self.radii[np.searchsorted(self.joints, np.radians((a + b) / 2))]
                count = max(1, int(np.ceil(np.radians(b - a) * radius / spacing)))
                pieces.append(np.radians(np.linspace(a, b, count, endpoint=False)))
        pieces.append(np.radians([spacings[-1][1]]))
        return np.concatenate(pieces)


Arcs = tuple[tuple[float, float, float], ...]

ROW_SPACING = (
    (-100.0, -15.0, 1.3),
    (-15.0, 12.0, 0.72),
    (12.0, 35.0, 0.64),
    (35.0, 135.0, 0.56),
    (135.0, 150.0, 0.9),
)
"""Rows (from deg, to deg, spacing mm) of the mesh, fine where the insert touches."""


@dataclass(frozen=True)
class FemoralComponent:
    """A right femoral component; lengths in mm, angles in deg, z to the right (lateral).

    Args:
        medial_arcs: arcs (from, to, radius) of the medial J-curve.
        origin_phi: angle of the normal of the medial arc whose centre is the origin.
        ridge_half_at_flange_top: ML distance of the ridges at the top of the flange.
        groove_radius: radius of the trochlear groove, which is tangent to both condyles.
        width_half_at_flange_top: half the outer width at the top of the flange.
        taper_phi: angles of the normals between which ridges and outer edges widen.
        notch_phi: angles of the normals at which the notch (or box) begins and has its full width.
        blend_half: ML distance from the middle within which unequal J-curves blend.
    """

    medial_arcs: Arcs
    lateral_arcs: Arcs
    origin_phi: float = 60.0
    coronal_radius: float = 22.0
    ridge_half: float = 23.0
    ridge_half_at_flange_top: float = 17.0
    groove_radius: float = 27.0
    width_half: float = 35.0
    width_half_at_flange_top: float = 25.0
    taper_phi: tuple[float, float] = (-100.0, -25.0)
    edge_fillet: float = 2.5
    notch_phi: tuple[float, float] = (50.0, 72.0)
    notch_half: float = 8.5
    notch_fillet: float = 1.5
    thickness: float = 9.0
    thickness_at_flange_top: float = 6.5
    blend_half: float = 11.0
    cam: Cam | None = None

    @cached_property
    def profile(self) -> SagittalProfile:
        """Medial J-curve. The centre of its arc at `origin_phi` is the origin."""
        start = SagittalProfile(self.medial_arcs)
        return start.moved(-start.centre_at(np.radians(self.origin_phi)))

    @cached_property
    def lateral_profile(self) -> SagittalProfile:
        """Lateral J-curve. Its distal and posterior points are level with the medial ones."""
        if self.lateral_arcs == self.medial_arcs:
            return self.profile
        start = SagittalProfile(self.lateral_arcs)
        ends = np.radians([90.0, 0.0])
        return start.moved(np.diag(self.profile.point(ends) - start.point(ends)))

    def ridge(self, phi: ArrayLike) -> Array:
        """Return the ML distance of the ridge (apex of the condyle) from the middle."""
        top = self.ridge_half_at_flange_top
        return np.asarray(top + (self.ridge_half - top) * self._taper(phi))

    def width(self, phi: ArrayLike) -> Array:
        """Return the ML distance of the outer edge from the middle."""
        top = self.width_half_at_flange_top
        return np.asarray(top + (self.width_half - top) * self._taper(phi))

    def notch(self, phi: ArrayLike) -> Array:
        """Return the ML distance of the notch's edge from the middle. The front is elliptic."""
        start, end = np.radians(self.notch_phi)
        s = np.clip((np.asarray(phi) - start) / (end - start), 0.0, 1.0)
        s = np.where(s < 1e-9, 0.0, s)
        return np.asarray(self.notch_half * np.sqrt(s * (2.0 - s)))

    def groove_depth(self, phi: ArrayLike) -> Array:
        """Return the groove's depth below the ridges; groove and condyle arcs are tangent."""
        radii = self.groove_radius + self.coronal_radius
        return np.asarray(radii - np.sqrt(radii**2 - self.ridge(phi) ** 2))

    def depth(self, phi: ArrayLike, z: ArrayLike) -> Array:
        """Return the depth of the articular surface below the J-curve of the ridges."""
        u, apex, coronal = np.abs(z), self.ridge(phi), self.coronal_radius
        tangent = apex * self.groove_radius / (self.groove_radius + coronal)
        across = np.clip(u - apex, -coronal, coronal)
        convex = coronal - np.sqrt(coronal**2 - across**2)
        inside = np.minimum(u, self.groove_radius)
        concave = (
            self.groove_depth(phi) - self.groove_radius + np.sqrt(self.groove_radius**2 - inside**2)
        )
        edge = self.notch(phi)
        drop = rounded_edge(u - edge, self.notch_fillet) * edge / self.notch_half
        outer = rounded_edge(self.width(phi) - u, self.edge_fillet)
        return np.asarray(np.where(u < tangent, concave, convex) + drop + outer)

    def surface(self, phi: ArrayLike, z: ArrayLike) -> Array:
        """Return points (..., 3), femoral frame, mm."""
        phi, z = np.broadcast_arrays(phi, z)
        return self._below(phi, z, self.depth(phi, z))

    def groove(self, phi: ArrayLike) -> Array:
        """Return points (..., 2) of the groove's deepest line, sagittal plane, mm."""
        phi = np.asarray(phi, float)
        return np.asarray(self._below(phi, np.zeros_like(phi), self.groove_depth(phi))[..., :2])

    def mesh(self) -> tuple[Array, NDArray[np.int64]]:
        """Return a closed triangulation, femoral frame: vertices, mm, and faces."""
        rows = self._rows()
        half = self._columns(rows)
        z = np.concatenate([-half[:, ::-1], half], axis=1)
        phi = np.broadcast_to(rows[:, None], z.shape)
        outer, inner = self.surface(phi, z), self._bone_side(phi, z)
        bridge = int(np.searchsorted(rows, np.radians(self.notch_phi[0]) + 1e-9)) - 1
        middle = z.shape[1] // 2
        columns = {0, *range(0, middle, 5), middle - 1, middle, *range(middle, 2 * middle, 5)}
        sections = sorted({*range(0, len(rows), 4), bridge, len(rows) - 1})
        return solids.close_sheets(
            outer, inner, sections, sorted({*columns, 2 * middle - 1}), bridge
        )

    def mesh_with_cam(self) -> tuple[Array, NDArray[np.int64]]:
        """Return `mesh` with the cam across its box."""
        if self.cam is None:
            raise InputError("the femoral component has no cam", "[cam]", "give its dimensions")
        return joined(self.cam, self.notch_half, *self.mesh())

    def _below(self, phi: Array, z: Array, depth: Array) -> Array:
        """Return points (..., 3) below the J-curve, blended between condyles at z."""
        place = self.profile.point(phi, depth)
        if self.lateral_profile is not self.profile:
            s = np.clip(0.5 + 0.5 * np.asarray(z) / self.blend_half, 0.0, 1.0)
            lateral = (s * s * (3.0 - 2.0 * s))[..., None]
            place = (1.0 - lateral) * place + lateral * self.lateral_profile.point(phi, depth)
        return np.concatenate([place, np.asarray(z)[..., None]], axis=-1)

    def _bone_side(self, phi: Array, z: Array) -> Array:
        top = self.thickness_at_flange_top
        thickness = top + (self.thickness - top) * self._taper(phi)
        return self._below(phi, z, thickness)

    def _taper(self, phi: ArrayLike) -> Array:
        """Return a smooth factor of phi, rad: 0 at the flange's top, 1 behind the taper."""
        start, end = np.radians(self.taper_phi)
        s = np.clip((np.asarray(phi) - start) / (end - start), 0.0, 1.0)
        return np.asarray(s * s * (3.0 - 2.0 * s))

    def _columns(self, phi: Array) -> Array:
        """Return z (rows, columns) of the lateral half's vertices, from the notch outwards."""
        apex, outer, inner = (edge(phi)[:, None] for edge in (self.ridge, self.width, self.notch))
        fillet = outer - self.edge_fillet
        near, far = apex - 9.0, apex + 0.8 * (fillet - apex)
        turn = np.sin(np.radians(np.linspace(0.0, 90.0, 5)))[1:]
        return np.concatenate(
            [
                inner + (near - inner) * np.linspace(0.0, 1.0, 13)[:-1],
                near + (far - near) * np.linspace(0.0, 1.0, 24)[:-1],
                far + (fillet - far) * np.linspace(0.0, 1.0, 3),
                fillet + self.edge_fillet * turn,
            ],
            axis=1,
        )

    def _rows(self) -> Array:
        """Return phi of the rows, rad, dense at the insert and the notch's front."""
        start, end = np.radians(self.notch_phi)
        front = start + (end - start) * (1.0 - np.cos(np.radians(np.linspace(0.0, 30.0, 5))))
        rows = self.profile.nodes(ROW_SPACING)
        apart = np.abs(rows[:, None] - front).min(axis=1) > np.radians(0.3)
        return np.sort(np.concatenate([rows[apart], front]))


def rounded_edge(distance: ArrayLike, radius: ArrayLike) -> Array:
    """Return how far a rounded edge lies below the surface, mm, at a distance from the edge, mm."""
    inside = np.clip(np.asarray(radius) - distance, 0.0, radius)
    return np.asarray(radius - np.sqrt(np.asarray(radius) ** 2 - inside**2))
