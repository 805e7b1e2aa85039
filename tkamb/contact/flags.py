"""Flags of contacts with an unreliable peak pressure: too narrow, or at the insert's edge.

A map contains the pressure at its points only: in a contact a few points wide, the highest pressure
lies between them, and the sum over the points is not the integral. Nor does it resolve the rounding
of a real edge, which also wears and chips.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from tkamb.geometry.defects import Defect, defect_words
from tkamb.geometry.frames import Array, Index, Mask, transform
from tkamb.geometry.surface import Surface
from tkamb.units import DEGREE, MILLIMETRE

TOO_NARROW = "contact is too narrow"
"""Text of the flag after "the <side> "."""


# Smallest number of inner points: map points with contact all around. With this number a sphere
# touches about 17 points, and the error of the peak is at most 8 %. Without inner points the peak
# of a lattice is 5 to 96 % too low (docs/lattice.md).
LEAST_INNER_POINTS = 5


def narrow_flags(
    triangles: Index,
    touched: Mask,
    sides: Mapping[str, Mask],
    points: str = "cells",
) -> Iterator[str]:
    """Yield a flag for each condyle with too few inner points (see `surrounded`).

    `triangles` (k, 3) join the points; `sides` (n,) are those under each condyle; `points` is the
    word for them in the message.
    """
    inner = surrounded(triangles, touched)
    for side, under_side in sides.items():
        if touched[under_side].any() and np.count_nonzero(inner & under_side) < LEAST_INNER_POINTS:
            yield (
                f"the {side} {TOO_NARROW} for the {points}: its peak pressure cannot be "
                f"relied on; take finer {points}"
            )


def surrounded(triangles: Index, touched: Mask) -> Mask:
    """Return whether each point (n,) is inner: all corners of its triangles are in contact."""
    a, b, c = touched[triangles.T]
    edge = triangles[(a | b | c) & ~(a & b & c)]
    inner = touched.copy()
    inner[edge] = False
    return inner


AT_EDGE = "contact reaches the edge of the insert's articular surface"
"""Text of the flag after "the <side> "."""
DOWN = np.array([0.0, -1.0, 0.0])


@dataclass(frozen=True)
class EdgeSettings:
    """Definition of a contact at the insert's edge."""

    spacing: float = 0.5 * MILLIMETRE
    """m: spacing of the vertical rays that find the edge, of which half is the error of the
    distance.
    """
    steepest: float = 50.0 * DEGREE
    """rad: slope above which a surface near the outline belongs to the rim. No
    loaded part of a dish is as steep."""
    rim: float = 4.0 * MILLIMETRE
    """m: largest width of the rim. A steep surface farther inside is a flank of the
    eminence or of a post."""
    reach: float = 2.5 * MILLIMETRE
    """m: distance from the edge below which a contact is flagged. The radius of a usual
    insert's rounded rim (1 to 2 mm) plus half the spacing of a map."""
    share: float = 0.05
    """1: share of the peak pressure above which a point counts as loaded. A smaller
    pressure at the edge does no harm."""


EDGE = EdgeSettings()


@dataclass(frozen=True, eq=False)
class ArticularEdge:
    """Distance from the edge of the articular surface, seen from above.

    Args:
        origin: (2,) m, x and z of the first cell.
        away: (a, b) m, distance of each cell's centre from the nearest cell beyond the edge.
    """

    origin: Array
    away: Array
    spacing: float

    @classmethod
    def of(cls, insert: Surface, settings: EdgeSettings = EDGE) -> "ArticularEdge":
        """Return the edge of an insert: the line where it ends or turns down to its walls."""
        from scipy.ndimage import distance_transform_edt  # slow import, not needed for a report

        low, high = insert.bounds[:, [0, 2]]
        # Two rows of margin on each side, so that the outside is one connected region.
        count = np.ceil((high - low) / settings.spacing).astype(int) + 4
        origin = low - 1.5 * settings.spacing
        x, z = (origin[d] + settings.spacing * np.arange(count[d]) for d in (0, 1))
        grid = np.stack(np.meshgrid(x, z, indexing="ij"), axis=-1).reshape(-1, 2)
        height = insert.bounds[1, 1] + MILLIMETRE
        rays = np.insert(grid, 1, height, axis=1)
        distance, face = insert.rays.first(rays, DOWN)
        covered = np.isfinite(distance).reshape(count)
        upright = insert.face_normals[face][:, 1].reshape(count)
        inside = distance_transform_edt(covered, settings.spacing)
        steep = covered & (upright < np.cos(settings.steepest)) & (inside <= settings.rim)
        # Only a steep surface that is connected to the outside is rim; the flank of a post is not.
        beyond = _joined_to_outside(~covered | steep, ~covered)
        return cls(origin, distance_transform_edt(~beyond, settings.spacing), settings.spacing)

    def distance(self, points: Array) -> Array:
        """Return the distance (n,) of points (n, 3) from the edge in x and z, m; 0 beyond it."""
        cell = np.round((points[:, [0, 2]] - self.origin) / self.spacing).astype(int)
        cell = np.clip(cell, 0, np.array(self.away.shape) - 1)
        # The distance is measured between centres of cells; on average the edge lies half a spacing
        # nearer.
        return np.asarray(np.maximum(self.away[tuple(cell.T)] - self.spacing / 2, 0.0), float)


def _joined_to_outside(mask: Mask, outside: Mask) -> Mask:
    from scipy.ndimage import label  # slow import, not needed for a report

    part, _ = label(mask, structure=np.ones((3, 3)))
    touching = np.unique(part[outside])
    return np.asarray(mask & np.isin(part, touching), bool)


def edge_of_insert_flags(
    edge: ArticularEdge,
    points: Array,
    pressure: Array,
    sides: Mapping[str, Mask],
    settings: EdgeSettings = EDGE,
) -> Iterator[str]:
    """Yield a flag for each condyle whose contact reaches the articular edge.

    `sides` (n,) are the map points (n, 3), m, under each condyle.
    """
    for side, under_side in sides.items():
        side_pressure = np.where(under_side, pressure, 0.0)
        highest = float(side_pressure.max(initial=0.0))
        if highest <= 0.0:
            continue
        # A pressure below this share of the peak makes no contact at the edge.
        loaded = np.flatnonzero(side_pressure > settings.share * highest)
        distances = edge.distance(points[loaded])
        if distances.min() > settings.reach:
            continue
        peak = float(distances[np.argmax(side_pressure[loaded])])
        where = (
            "its peak pressure lies there"
            if peak <= settings.reach
            else f"its peak pressure lies {peak / MILLIMETRE:.1f} mm from it"
        )
        yield (f"the {side} {AT_EDGE} (within {settings.reach / MILLIMETRE:g} mm); {where}")


# 1: distance from a loaded point, in cells of the map, below which a defect is reached. A
# cell and its diagonal.
REACH_CELLS = 1.5
# 1: share of a body's vertices in the contact that are noisy, from which it is flagged.
# A crease beside a contact makes fewer of them rough.
NOISY_SHARE = 0.5
# m: height above the bottom up to which a column counts as standing on it. Above the
# flatness of machined bottoms.
BOTTOM = 0.1 * MILLIMETRE


MESH_DEFECT = "the contact reaches a defect of the"
"""Text of the flag before " <body> mesh"."""
UNSUPPORTED = "contact lies over an unsupported bottom"
"""Text of the flag after "the <side> "."""


def unmeasured_flags(flags: Iterable[str]) -> list[str]:
    """Return the flags for which no model's error is known."""
    return [flag for flag in flags if MESH_DEFECT in flag or UNSUPPORTED in flag]


def mesh_flags(
    bodies: Mapping[str, tuple[Surface, Array]], points: Array, area: Array, pressure: Array
) -> Iterator[str]:
    """Yield a flag for each kind of defect of a mesh that the contact reaches.

    `bodies` are surfaces with their poses (4, 4) in the insert frame. Points (n, 3), m, areas, m²,
    and pressures, Pa, are those of a map.
    """
    loaded = pressure > 0.0
    if not loaded.any():
        return
    # Half a millimetre for the approach, which moves the femoral surface below the map points.
    reach = REACH_CELLS * float(np.sqrt(np.median(area[loaded]))) + 0.5 * MILLIMETRE
    contact = cKDTree(points[loaded])
    for name, (surface, pose) in bodies.items():
        reached: list[Defect] = []
        for defect in surface.defects:
            places = transform(pose, defect.places)
            within = contact.query(places, distance_upper_bound=reach)[0] <= reach
            if defect.kind == "noise" and within.any():
                own = transform(pose, surface.vertices)
                near = contact.query(own, distance_upper_bound=reach)[0] <= reach
                within &= within.sum() > NOISY_SHARE * near.sum()
            if within.any() or (defect.kind == "opening" and _below(places, points, reach)):
                reached.append(defect)
        for words in defect_words(reached):
            yield (
                f"{MESH_DEFECT} {name} mesh, {words}: pressure, area and approach cannot be relied "
                "on; mend the mesh"
            )


def _below(places: Array, points: Array, reach: float) -> bool:
    """Return whether a place (m, 3) lies beside and below a point (n, 3)."""
    distance, near = cKDTree(points[:, [0, 2]]).query(places[:, [0, 2]], distance_upper_bound=reach)
    over = np.isfinite(distance)
    return bool((places[over, 1] < points[near[over], 1]).any())


def unsupported_flags(
    insert: Surface, points: Array, pressure: Array, sides: Mapping[str, Mask]
) -> Iterator[str]:
    """Yield a flag for each condyle with a loaded column that ends above a pocket, a slot, a hole
    or an overhang.
    """
    for side, under_side in sides.items():
        highest = float(pressure[under_side].max(initial=0.0))
        if highest <= 0.0:
            continue
        loaded = np.flatnonzero(under_side & (pressure > EDGE.share * highest))
        start = points[loaded] - [0.0, MILLIMETRE / 100.0, 0.0]
        below = insert.rays.first(start, DOWN)[0]
        height = start[:, 1] - below - insert.bounds[0, 1]
        if (np.isfinite(below) & (height > BOTTOM)).any():
            yield (
                f"the {side} {UNSUPPORTED}: the columns stand on the fixed bottom, so that "
                "stiffness and pressure are too high there; the stated error does not apply"
            )
