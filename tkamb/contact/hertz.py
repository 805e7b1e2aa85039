"""Hertz: an elliptical patch on each condyle, a rigid femur against an elastic half-space."""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from tkamb.contact.bed import STEEPEST, Bed, sample_bed
from tkamb.contact.curvature import OsculatingContact, osculate
from tkamb.contact.ellipse import ContactEllipse, contact_ellipse
from tkamb.contact.foundation import gaps_along_normals
from tkamb.contact.model import ContactModel
from tkamb.contact.pair import ContactPair, PreparedContact
from tkamb.contact.pressing import approach_at, failed_result
from tkamb.contact.result import CondyleContact, ContactResult, ContactStatus
from tkamb.contact.summary import summarise_condyles, thickness_under, wrench_of
from tkamb.contact.validity import peak_flags
from tkamb.geometry.condyles import condyle_split
from tkamb.geometry.first_touch import FirstTouch
from tkamb.geometry.frames import SIDES, Array
from tkamb.geometry.rays import RayCaster

SHORT_AXIS_SUB_CELLS = 10
"""Sub-cells on the ellipse's short semi-axis, over which the pressure is averaged."""
FEWEST_SUB_CELLS, MOST_SUB_CELLS = 6, 50
"""Bounds of the sub-cells per edge of a grid cell."""
LEAST_ON_BED = 0.95
"""Share of the semi-ellipsoid that must lie on the insert."""
FLATTEST = 1e-6
"""Smallest ratio of the two relative curvatures that still makes an ellipse."""


CONFORMING = "conforms to the insert: no ellipse (relative curvature is not positive)"


@dataclass(frozen=True, eq=False)
class CondyleGeometry:
    """How one condyle meets the insert at a rotation, x and z.

    Args:
        height: m, y of the femoral origin at which the condyle's triangles touch.
        contact: the osculating quadrics there; None when they do not curve apart.
    """

    height: float
    contact: OsculatingContact | None


@dataclass(frozen=True, eq=False)
class HertzState(PreparedContact):
    """Ray casters, first touch and the bed that shows the pressure.

    Args:
        pair: the two bodies.
        bed: the sampled articular surface.
        insert_rays: insert frame.
        femoral_rays: femoral frame.
        touch: first touch per condyle.
    """

    pair: ContactPair
    bed: Bed
    insert_rays: RayCaster
    femoral_rays: RayCaster
    touch: FirstTouch

    @property
    def points(self) -> Array:  # type: ignore[override]
        """Map points (n, 3) m, insert frame."""
        return self.bed.points

    @property
    def triangles(self) -> NDArray[np.int64]:  # type: ignore[override]
        """Map triangles (k, 3)."""
        return self.bed.triangles


@dataclass(frozen=True)
class Hertz(ContactModel):
    """Elliptical Hertz contact, condyle by condyle.

    At a rotation, x and z each condyle's first touch along -y gives its contact point;
    quadrics fitted there give normal and relative curvatures (`curvature.osculate`), the
    elliptic solution gives the law F = c delta^1.5 with E* = E/(1 - nu²) of the insert at
    zero strain (`ellipse.contact_ellipse`). Both condyles move down together, so each has
    delta = travel beyond its own touch times n_y: the tilt decides how they share. Contact
    point and curvatures stay those of first touch; E is the slope at the origin whatever
    the material's curve.

    The map holds the semi-ellipsoid, averaged over each grid cell and scaled so that its
    vertical force is the law's exactly; the wrench is the sum over the map. Area and peak
    of a condyle are the ellipse's own (pi a b, p0), not the map's.

    OUT_OF_RANGE: a condyle that conforms to the insert (relative curvature <= 0, concave
    radius <= convex radius) or whose ellipse leaves the insert. Flag: an ellipse wider than
    the insert is thick, where the half-space no longer holds (the layer is stiffer). A
    mobile bearing is pressed like a fixed one.

    Args:
        resolution: m, spacing of the map points.
        patch_radius: m, of the discs on which curvatures are fitted. On a sphere of 20 mm
            4 mm makes the force 0.5 % too small; on a real implant (relative radii 70 and
            240 mm) 4 to 6 mm move area and peak by 8 %, below 3 mm facets dominate.

    Reference: Johnson, Contact Mechanics (1985), chapter 4, doi:10.1017/CBO9781139171731.
    """

    name: ClassVar[str] = "hertz"
    assumes: ClassVar[str] = "two smooth bodies of constant curvature, linear elastic half-space"
    needs: ClassVar[str] = "condyles that do not conform to the insert; milliseconds"

    resolution: float = 1e-3
    patch_radius: float = 4e-3

    def prepare(self, pair: ContactPair) -> HertzState:
        """Sample the articular surface and build ray casters."""
        return HertzState(
            pair,
            sample_bed(pair.insert, self.resolution),
            pair.insert.rays,
            pair.femoral.rays,
            FirstTouch(pair.femoral, pair.insert, condyle_split(pair.femoral)),
        )

    def evaluate(
        self, state: HertzState, pose: Array, guess: ContactResult | None = None
    ) -> ContactResult:
        """Return the contact at a pose; see `ContactModel`."""
        if not np.isfinite(pose).all():
            return failed_result(state, pose, "the pose is not finite")
        bed, material = state.bed, state.pair.material
        plane_modulus = material.young_modulus / (1 - material.poisson_ratio**2)
        pressure = np.zeros((2, len(bed.points)))
        patches: list[CondyleContact | None] = [None, None]
        flags: list[str] = []
        for side, geometry in enumerate(condyle_geometry(state, pose, self.patch_radius)):
            if geometry is None:
                continue
            if geometry.contact is None:
                if pose[1, 3] < geometry.height:
                    return failed_result(state, pose, f"{SIDES[side]} condyle {CONFORMING}")
                continue
            depth = indentation(geometry, pose)
            if depth <= 0:
                continue
            flat, steep = geometry.contact.relative / 2
            patch = contact_ellipse(flat, steep, depth, plane_modulus)
            pressure[side], share = map_pressure(bed, geometry.contact, patch)
            if share < LEAST_ON_BED:
                return failed_result(
                    state, pose, f"{SIDES[side]} contact ellipse leaves the insert"
                )
            carried = patches[side] = _described(bed, geometry.contact, patch)
            if patch.long_axis > carried.thickness:
                flags.append(f"{SIDES[side]} contact ellipse is wider than the insert is thick")
        return _collected(state, pose, pressure, patches, tuple(flags))


def condyle_geometry(
    state: HertzState, pose: Array, patch_radius: float
) -> tuple[CondyleGeometry | None, CondyleGeometry | None]:
    """Return how each condyle meets the insert; the pose's y does not matter.

    None for a condyle that does not lie over the insert. The last few answers are kept.
    """
    level = np.array(pose, float)
    level[1, 3] = 0.0
    return _geometry(state, level.tobytes(), patch_radius)


def indentation(geometry: CondyleGeometry, pose: Array) -> float:
    """Return delta (m) along the contact normal; negative when apart."""
    contact = geometry.contact
    if contact is None:
        return float("nan")
    return float((geometry.height - pose[1, 3]) * contact.normal[1] - contact.gap)


def map_pressure(
    bed: Bed, contact: OsculatingContact, patch: ContactEllipse
) -> tuple[Array, float]:
    """Return the semi-ellipsoid on the bed (n,), Pa, and the share of it that the bed holds.

    Averaged over sub-cells of each grid cell, then scaled so that the vertical force on the
    bed is the patch's force times n_y. A patch much narrower than a cell goes to the nearest
    point.
    """
    pressure = np.zeros(len(bed.points))
    offset = bed.points - contact.point
    wanted = patch.force * contact.normal[1]
    if patch.short_axis < bed.resolution / MOST_SUB_CELLS * SHORT_AXIS_SUB_CELLS:
        nearest = int(np.einsum("ij,ij->i", offset, offset).argmin())
        pressure[nearest] = wanted / (bed.area[nearest] * bed.normals[nearest, 1])
        return pressure, 1.0
    beyond = np.abs(offset @ contact.axes.T) - [patch.long_axis, patch.short_axis]
    low = np.abs(offset @ contact.normal) < patch.long_axis + bed.resolution
    near = np.flatnonzero((beyond.max(axis=1) < 2 * bed.resolution) & low)
    pressure[near] = patch.peak_pressure * _cell_means(bed, near, contact, patch)
    held = float((pressure * bed.area) @ bed.normals[:, 1])
    return (pressure * (wanted / held), held / wanted) if held > 0 else (pressure, 0.0)


def _cell_means(
    bed: Bed, near: NDArray[np.int64], contact: OsculatingContact, patch: ContactEllipse
) -> Array:
    """Return the mean of sqrt(1 - (u/a)² - (v/b)²) over the grid cells of points (m,)."""
    wanted = int(np.ceil(SHORT_AXIS_SUB_CELLS * bed.resolution / patch.short_axis))
    count = min(max(wanted, FEWEST_SUB_CELLS), MOST_SUB_CELLS)
    ticks = ((np.arange(count) + 0.5) / count - 0.5) * bed.resolution
    dx, dz = (grid.ravel() for grid in np.meshgrid(ticks, ticks))
    normals = bed.normals[near]
    slope = -normals[:, [0, 2]] / np.maximum(normals[:, 1:2], STEEPEST)
    rise = slope[:, :1] * dx + slope[:, 1:] * dz
    offset = np.stack(np.broadcast_arrays(dx, rise, dz), axis=-1)
    places = (bed.points[near] - contact.point)[:, None] + offset
    u, v = np.moveaxis(places @ contact.axes.T, -1, 0)
    inside = 1 - (u / patch.long_axis) ** 2 - (v / patch.short_axis) ** 2
    return np.asarray(np.sqrt(np.maximum(inside, 0.0)).mean(axis=1))


def _described(bed: Bed, contact: OsculatingContact, patch: ContactEllipse) -> CondyleContact:
    area = np.pi * patch.long_axis * patch.short_axis
    return CondyleContact(
        force=patch.force,
        area=area,
        mean_pressure=patch.force / area,
        peak_pressure=patch.peak_pressure,
        centre_of_pressure=contact.point,
        thickness=thickness_under(contact.point, bed.points, bed.thickness),
    )


def _collected(
    state: HertzState,
    pose: Array,
    pressure: Array,
    patches: list[CondyleContact | None],
    flags: tuple[str, ...],
) -> ContactResult:
    bed = state.bed
    both = pressure.sum(axis=0)
    nodal_force = -(both * bed.area)[:, None] * bed.normals
    medial = pressure[0] > 0
    summed = summarise_condyles(medial, bed.points, both, bed.area, nodal_force, bed.thickness)
    sides = [
        None
        if patch is None or found is None
        else replace(patch, force=found.force, mean_pressure=found.force / patch.area)
        for patch, found in zip(patches, summed, strict=True)
    ]
    return ContactResult(
        pose=np.array(pose, float),
        points=bed.points,
        normals=bed.normals,
        pressure=both,
        area=bed.area,
        gap=gaps_along_normals(bed, state.femoral_rays, pose),
        nodal_force=nodal_force,
        wrench_on_insert=wrench_of(bed.points, nodal_force),
        medial=sides[0],
        lateral=sides[1],
        approach=approach_at(state.pair, pose),
        status=ContactStatus.OK,
        flags=(*flags, *peak_flags(*sides)),
    )


@lru_cache(maxsize=8)
def _geometry(
    state: HertzState, level: bytes, patch_radius: float
) -> tuple[CondyleGeometry | None, CondyleGeometry | None]:
    pose = np.frombuffer(level).reshape(4, 4)
    found: list[CondyleGeometry | None] = []
    for touch in state.touch.at(pose):
        if touch is None:
            found.append(None)
            continue
        touching = pose.copy()
        touching[1, 3] = -touch.travel
        contact = osculate(
            state.insert_rays, state.femoral_rays, touching, touch.point, patch_radius
        )
        usable = contact is not None and contact.relative[0] > FLATTEST * contact.relative[1]
        found.append(CondyleGeometry(-touch.travel, contact if usable else None))
    return found[0], found[1]
