"""The result of a contact model at one pose, and the warm start of its next evaluation.

A caller that presses many times passes the `WarmStart` of `ContactModel.press_from` to the next
press. A result may be passed instead, but saves less time.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tkamb.contact.flags import TOO_NARROW, edge_of_insert_flags, mesh_flags
from tkamb.contact.pair import ContactPair, ContactSurface, PreparedContact
from tkamb.geometry.frames import Array, Mask
from tkamb.units import MEGAPASCAL, MILLIMETRE

# Pa: peak pressure above which a result is flagged. Measured stress-strain curves
# of polyethylene end at 40 to 60 MPa, and the largest von Mises stress of a Hertz contact is about
# 0.6 of its peak pressure.
MAX_MEASURED_PRESSURE = 100.0 * MEGAPASCAL
# 1: a patch that carries a smaller share of the force does not count as contact of a second
# condyle. Such a patch is a fragment of the first condyle's contact.
LEAST_PATCH_SHARE = 0.05
# m: smallest distance between the centres of two condyles' patches. Condyles of a
# knee are 40 to 50 mm apart.
LEAST_PATCH_DISTANCE = 15.0 * MILLIMETRE


class ContactStatus(Enum):
    """How an evaluation ended."""

    OK = "ok"
    NOT_CONVERGED = "not_converged"
    OUT_OF_RANGE = "out_of_range"


@dataclass(frozen=True, eq=False)
class CondyleContact:
    """The contact of one condyle, SI.

    Args:
        force: N, magnitude of the summed normal forces on the insert.
        mean_pressure: Pa, force / area. Sharma (2008) divides the sum of the nodal forces'
            magnitudes by the area, which is larger on a curved surface.
        centre_of_pressure: (3,) m, insert frame.
        thickness: m, insert under the centre of pressure, along y.
    """

    force: float
    area: float
    mean_pressure: float
    peak_pressure: float
    centre_of_pressure: Array
    thickness: float

    @property
    def thickness_over_radius(self) -> float:
        """1, thickness over the radius of the circle with the contact's area."""
        return self.thickness / math.sqrt(self.area / math.pi)


@dataclass(frozen=True, eq=False)
class ContactResult:
    """Pressure map and wrench at one pose; `ContactResult.of` makes it.

    The map has the same n points in every result of one state. Arrays are in the insert
    frame, SI.

    Args:
        pose: (4, 4) pose_femoral_in_insert of this contact; after a press the pressed pose.
        points: (n, 3) m, map points on the undeformed insert.
        normals: (n, 3) outward unit normals of the insert at these points.
        pressure: (n,) Pa, >= 0.
        area: (n,) m², tributary area of each point on the true surface, not projected.
        gap: (n,) m, positive when apart.
        nodal_force: (n, 3) N on the insert.
        places: (n, 3) m, where the nodal forces act: the map points, or the points of the femoral
            component that the columns of a foundation meet.
        wrench_on_insert: (6,) force (N) and moment about the insert origin (N·m).
        medial: contact of the medial (or only) condyle; None if unloaded, like `lateral`.
        residual: relative residual of the model's solver.
        flags: warnings in words.
    """

    pair: ContactPair
    pose: Array
    points: Array
    normals: Array
    pressure: Array
    area: Array
    gap: Array
    nodal_force: Array
    places: Array
    wrench_on_insert: Array
    medial: CondyleContact | None
    lateral: CondyleContact | None
    status: ContactStatus = ContactStatus.OK
    iterations: int = 0
    residual: float = 0.0
    flags: tuple[str, ...] = ()

    def __repr__(self) -> str:
        sides = [
            f"{name} {condyle.force:.0f} N on {condyle.area / MILLIMETRE**2:.0f} mm², "
            f"peak {condyle.peak_pressure / MEGAPASCAL:.1f} MPa"
            for name, condyle in (("medial", self.medial), ("lateral", self.lateral))
            if condyle is not None
        ]
        parts = [self.status.value, *(sides or ["nothing touches"]), f"{len(self.points)} points"]
        return f"<tkamb.ContactResult: {'; '.join(parts)}>"

    @property
    def failed(self) -> bool:
        """Whether the result has no numbers, because the model is out of its range."""
        return self.status is ContactStatus.OUT_OF_RANGE

    @property
    def reason(self) -> str:
        """Why the status is not OK, in a sentence; empty: it is OK."""
        return "" if self.status is ContactStatus.OK else "; ".join(self.flags)

    @cached_property
    def approach(self) -> float:
        """m, travel along -y since first touch; 0 when apart, NaN when out of range."""
        if self.failed:
            return math.nan
        return self.pair.approach(self.pose)

    @classmethod
    def of(
        cls,
        state: PreparedContact,
        pose: Array,
        pressure: Array,
        gap: Array,
        nodal_force: Array | None = None,
        area: Array | None = None,
        covered: Array | None = None,
        medial: Mask | None = None,
        places: Array | None = None,
        **ending: Any,
    ) -> "ContactResult":
        """Return the result of a pressure map.

        The wrench is the sum of the nodal forces, with moments about the insert's origin. If a
        pressure is not finite, the result is OUT_OF_RANGE.

        Args:
            nodal_force: (n, 3) N on the insert; by default pressure times area, against the normal.
            area: (n,) m²; by default the tributary area.
            covered: (n,) m², area in contact around each point, for the condyles' areas; by default
                `area`.
            medial: (n,) whether a point is under the medial condyle; by default `medial_points`.
            places: (n, 3) m, where the nodal forces act; by default the map points.
            ending: status, iterations, residual and flags of the result.
        """
        surface, pose = state.surface, np.array(pose, float)
        if not np.isfinite(pressure).all():
            return cls.out_of_range(
                state, pose, "the femoral component lies too deep in the insert"
            )
        if not pressure.any() and (passed := state.pair.passed_through(pose)):
            return cls.out_of_range(state, pose, passed)
        area = surface.area if area is None else area
        if nodal_force is None:
            nodal_force = -(pressure * area)[:, None] * surface.normals
        if medial is None:
            medial = medial_points(surface.points, pose, state.pair.split)
        places = surface.points if places is None else places
        sums = (surface.points, pressure, area if covered is None else covered, nodal_force)
        loaded = pressure > 0
        sides = {
            "medial": _summed(loaded & medial, *sums, surface.thickness),
            "lateral": _summed(loaded & ~medial, *sums, surface.thickness),
        }
        flags = (
            *ending.get("flags", ()),
            *peak_flags(sides),
            *edge_of_insert_flags(
                state.pair.articular_edge,
                surface.points,
                pressure,
                {"medial": medial, "lateral": ~medial},
            ),
        )
        bodies = {"femoral": (state.pair.femoral, pose), "insert": (state.pair.insert, np.eye(4))}
        defects = tuple(mesh_flags(bodies, surface.points, surface.area, pressure))
        if defects:  # finer cells do not help against a defect of the mesh
            flags = (*defects, *(flag for flag in flags if TOO_NARROW not in flag))
        if state.pair.split is None:
            flags = (*flags, *patch_flags(surface, pressure, nodal_force))
        ending["flags"] = flags
        return cls(
            pair=state.pair,
            pose=pose,
            points=surface.points,
            normals=surface.normals,
            pressure=pressure,
            area=area,
            gap=gap,
            nodal_force=nodal_force,
            places=places,
            wrench_on_insert=wrench_of(places, nodal_force),
            medial=sides["medial"],
            lateral=sides["lateral"],
            **ending,
        )

    @classmethod
    def out_of_range(
        cls,
        state: PreparedContact,
        pose: Array,
        *reasons: str,
        iterations: int = 0,
        residual: float = math.nan,
    ) -> "ContactResult":
        """Return a result with the status OUT_OF_RANGE, NaN for all numbers, and the reasons.

        An opening of a mesh is a frequent reason and is named.
        """
        points, pair = state.surface.points, state.pair
        openings = [
            f"the {name} mesh has {defect.words}"
            for name, body in (("femoral", pair.femoral), ("insert", pair.insert))
            for defect in body.defects
            if defect.kind == "opening"
        ]
        unknown, vectors = np.full(len(points), np.nan), np.full_like(points, np.nan)
        return cls(
            pair=state.pair,
            pose=np.array(pose, float),
            points=points,
            normals=vectors,
            pressure=unknown,
            area=unknown,
            gap=unknown,
            nodal_force=vectors,
            places=vectors,
            wrench_on_insert=np.full(6, np.nan),
            medial=None,
            lateral=None,
            status=ContactStatus.OUT_OF_RANGE,
            iterations=iterations,
            residual=residual,
            flags=tuple(dict.fromkeys([*reasons, *openings[:1]])),
        )


def medial_points(points: Array, pose: Array, split: float | None) -> Mask:
    """Return whether each point (n,) lies under the medial condyle: its femoral z is below `split`.

    Points are in the insert frame of a right knee (left knees are mirrored at input); `split` is in
    the femoral frame, m; None for one condyle, which is medial.
    """
    if split is None:
        return np.ones(len(points), bool)
    along = np.asarray(pose, float)[:3, 2]  # the femoral z axis
    return points @ along - pose[:3, 3] @ along < split


def patch_flags(surface: ContactSurface, pressure: Array, nodal_force: Array) -> Iterator[str]:
    """Yield a flag where a component with one condyle presses on two separate patches.

    A patch is a set of loaded points that the map's triangles connect. Each of the two carries more
    than `LEAST_PATCH_SHARE` of the force, and their centres are more than `LEAST_PATCH_DISTANCE`
    apart.
    """
    loaded = pressure > 0
    if not loaded.any():
        return
    sides = np.concatenate([surface.triangles[:, [0, 1]], surface.triangles[:, [1, 2]]])
    first, second = sides[loaded[sides].all(axis=1)].T
    count = len(pressure)
    graph = coo_array((np.ones(len(first), bool), (first, second)), shape=(count, count))
    patch = connected_components(graph, directed=False)[1][loaded]
    weight = np.linalg.norm(nodal_force[loaded], axis=1)
    force = np.bincount(patch, weight)
    large = np.flatnonzero(force > LEAST_PATCH_SHARE * force.sum())
    centres = np.array(
        [np.bincount(patch, weight * x)[large] / force[large] for x in surface.points[loaded].T]
    ).T
    distance = np.linalg.norm(centres[:, None] - centres, axis=2).max(initial=0.0)
    if distance > LEAST_PATCH_DISTANCE:
        yield (
            f"contact in separate patches {distance / MILLIMETRE:.0f} mm apart, but the femoral "
            "component shows one condyle: all of it is called medial; check the meshes' axes"
        )


def wrench_of(points: Array, nodal_force: Array) -> Array:
    """Return force (N) and moment about the insert origin (N·m), (6,), of nodal forces."""
    carrying = nodal_force.any(axis=1)
    force = nodal_force[carrying]
    return np.concatenate([force.sum(axis=0), np.cross(points[carrying], force).sum(axis=0)])


def _summed(
    chosen: Mask, points: Array, pressure: Array, area: Array, nodal_force: Array, thickness: Array
) -> CondyleContact | None:
    """Return the contact of the chosen points (n,); None if it is empty.

    The area is at least force / peak pressure, so that the mean pressure of a contact smaller than
    a cell is not above its peak.
    """
    if not chosen.any():
        return None
    force = float(np.linalg.norm(nodal_force[chosen].sum(axis=0)))
    weight = np.linalg.norm(nodal_force[chosen], axis=1)
    centre = weight @ points[chosen] / weight.sum()
    peak = float(pressure[chosen].max())
    covered = max(float(area[chosen].sum()), force / peak)
    under = thickness_under(centre, points, thickness)
    return CondyleContact(force, covered, force / covered, peak, centre, under)


def thickness_under(position: Array, points: Array, thickness: Array) -> float:
    """Return the insert's thickness (m) under a position (3,).

    It is the mean of the four map points nearest in x and z, by inverse distance.
    """
    square = (points[:, 0] - position[0]) ** 2 + (points[:, 2] - position[2]) ** 2
    near = np.argpartition(square, 3)[:4] if len(points) > 4 else np.arange(len(points))
    weight = 1.0 / np.maximum(np.sqrt(square[near]), 1e-9)
    return float(weight @ thickness[near] / weight.sum())


def peak_flags(sides: dict[str, CondyleContact | None]) -> Iterator[str]:
    """Yield a flag for each condyle with a peak pressure beyond measured stress-strain curves."""
    limit = MAX_MEASURED_PRESSURE
    for side, condyle in sides.items():
        if condyle is not None and condyle.peak_pressure > limit:
            yield (
                f"{side} peak above {limit / MEGAPASCAL:.0f} MPa: polyethylene's law is "
                "not known there; check whether the contact lies on the lip or at an edge"
            )


@dataclass(frozen=True, eq=False)
class WarmStart:
    """The initial guess that an earlier contact gives to the next one of the same state.

    It saves time, and changes the result by no more than the model's tolerance. Fields are those of
    `ContactResult`; the pressure is NaN if the contact failed.
    """

    pair: ContactPair
    pose: Array
    points: Array
    pressure: Array
    gap: Array

    @classmethod
    def after(cls, result: ContactResult) -> "WarmStart":
        """Return a warm start from the fields of a result."""
        return WarmStart(result.pair, result.pose, result.points, result.pressure, result.gap)

    @cached_property
    def approach(self) -> float:
        """m, travel along -y since first touch; NaN if the contact failed."""
        failed = bool(np.isnan(self.pressure).any())
        return float("nan") if failed else self.pair.approach(self.pose)


Guess = ContactResult | WarmStart
"""Initial guess of a press; both types have `pose`, `points`, `pressure`, `gap`, `approach`."""
