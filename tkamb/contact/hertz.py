"""Hertz's contact of each condyle: a rigid femur on an elastic half-space, an elliptical patch."""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import ClassVar

import numpy as np
from scipy.optimize import brentq
from scipy.special import ellipkm1, elliprd

from tkamb.contact.curvature import OsculatingContact, osculate
from tkamb.contact.flags import unsupported_flags
from tkamb.contact.model import ContactModel
from tkamb.contact.result import CondyleContact, ContactResult, Guess, peak_flags, thickness_under
from tkamb.contact.samples import MAP_POINT, SampledContact, SurfaceSamples, gaps_along_normals
from tkamb.geometry.frames import SIDES, Array, Index
from tkamb.units import MILLIMETRE

# 1: smallest ratio of the semi-axes. A smaller ratio is a line contact, where
# elliptic integrals lose their digits.
SMALLEST_AXIS_RATIO = 1e-6


@dataclass(frozen=True)
class ContactEllipse:
    """The elliptical patch of contact and its force.

    Args:
        long_axis: a, m, semi-axis along the smaller relative curvature.
        short_axis: b, m, the other semi-axis.
        peak_pressure: p0, Pa; p = p0 sqrt(1 - (u/a)² - (v/b)²).
        force: N, 2/3 pi a b p0.
    """

    long_axis: float
    short_axis: float
    peak_pressure: float
    force: float


def contact_ellipse(
    flat: float, steep: float, approach: float, plane_modulus: float
) -> ContactEllipse:
    """Return the patch of two bodies whose gap at first touch is A u² + B v².

    With k = b/a, e² = 1 - k² and complete elliptic integrals K(e), E(e) (Johnson, Contact
    Mechanics, 1985, equations 4.24-4.32, doi:10.1017/CBO9781139171731):

        A = p0/E* b/(e² a²) [K - E]
        B = p0/E* b/(e² a²) [E/k² - K]
        delta = p0/E* b K

    [K - E]/e² and [E/k² - K]/e² are Carlson's R_D(0, k², 1)/3 and R_D(0, 1, k²)/3, which
    are exact at k = 1, too. B/A determines k.

    Args:
        flat: A, 1/m, positive; half the smaller relative curvature.
        steep: B >= A, 1/m.
        approach: delta, m, positive: mutual approach of distant points along the normal.
        plane_modulus: E* = E/(1 - nu²), Pa; the other body is rigid.
    """
    # The curvatures determine the axis ratio; the approach determines size and pressure.
    ratio = _axis_ratio(steep / flat)
    # Complete elliptic integral K(1 - ratio²); `ellipkm1` keeps its digits for slender ellipses,
    # where K diverges.
    first = float(ellipkm1(ratio**2))
    long_axis = np.sqrt(approach * float(elliprd(0.0, ratio**2, 1.0)) / (3 * first * flat))
    short_axis = ratio * long_axis
    peak = plane_modulus * approach / (short_axis * first)
    # Volume of a semi-ellipsoid of height p0 over the ellipse.
    force = 2 / 3 * np.pi * long_axis * short_axis * peak
    return ContactEllipse(float(long_axis), float(short_axis), float(peak), float(force))


def _axis_ratio(curvature_ratio: float) -> float:
    """Return k = b/a for B/A >= 1."""

    def excess(log_ratio: float) -> float:
        square = np.exp(2 * log_ratio)
        ratio = elliprd(0.0, 1.0, square) / elliprd(0.0, square, 1.0)
        return float(np.log(ratio) - np.log(curvature_ratio))

    # Equal curvatures give a circle; rounding may put the root at a positive logarithm.
    if curvature_ratio <= 1.0 or excess(0.0) >= 0:
        return 1.0
    return float(np.exp(brentq(excess, np.log(SMALLEST_AXIS_RATIO), 0.0, xtol=1e-15)))


# Number of sub-cells along the ellipse's short semi-axis. The pressure of a map point is the mean
# over the sub-cells of its cell. The mean is then exact to 1 %.
SHORT_AXIS_SUB_CELLS = 10
# 1: smallest share of the patch's force that must lie on the insert. With less the
# contact extends over the rim, and Hertz's solution does not hold.
LEAST_SHARE_ON_INSERT = 0.95
# 1: smallest ratio of the two relative curvatures. A smaller ratio is a line
# contact.
SMALLEST_CURVATURE_RATIO = 1e-6


FEWEST_SUB_CELLS, MOST_SUB_CELLS = 6, 50
"""Smallest and largest number of sub-cells along an edge of a grid cell."""

CONFORMING = "conforms to the insert: no ellipse (relative curvature is not positive)"


@dataclass(frozen=True, eq=False)
class CondyleGeometry:
    """First touch of one condyle at a given rotation, x and z.

    Args:
        height: m, y of the femoral origin at which the condyle's triangles touch.
        contact: osculating quadrics at the touch; None if the surfaces do not curve apart.
    """

    height: float
    contact: OsculatingContact | None


@dataclass(frozen=True)
class Hertz(ContactModel):
    """Elliptical Hertz contact of each condyle.

    The contact point of each condyle is its first touch along -y, with the normal and the relative
    curvatures of quadrics fitted there (`osculate`). Then F = c delta^1.5 (`contact_ellipse`), with
    E* = E/(1 - nu²) of the insert; E is the slope of the material's curve at the origin. The delta
    of a condyle is its travel beyond first touch times n_y: both move down together, so the tilt
    decides how they share the load.

    The map contains the semi-ellipsoid of pressure, averaged over each grid cell and scaled so that
    its vertical force is exact. Area and peak of a condyle are those of the ellipse: pi a b and p0.

    A result is OUT_OF_RANGE if a condyle conforms to the insert (relative curvature <= 0) or its
    ellipse leaves the insert. It is flagged if the ellipse's longer semi-axis exceeds the insert's
    thickness: the half-space is then too soft. A mobile bearing is pressed like a fixed one.

    Args:
        patch_radius: m, radius of the discs on which curvatures are fitted. With 4 mm the force on
            a sphere of 20 mm is 0.5 % too small. On a real implant (relative radii 70 and 240 mm)
            area and peak differ by 8 % between 4 and 6 mm; below 3 mm facets dominate.

    Reference: Johnson, Contact Mechanics (1985), chapter 4, doi:10.1017/CBO9781139171731.
    """

    name: ClassVar[str] = "hertz"
    assumes: ClassVar[str] = "two smooth bodies of constant curvature, linear elastic half-space"
    needs: ClassVar[str] = "condyles that do not conform to the insert; milliseconds"
    # Point and curvatures of first touch change from facet to facet.
    differentiable: ClassVar[bool] = False

    resolution: float = 1e-3
    patch_radius: float = 4e-3

    def evaluate(
        self, state: SampledContact, pose: Array, guess: Guess | None = None
    ) -> ContactResult:
        """Return the contact at a pose; see `ContactModel`."""
        if not np.isfinite(pose).all():
            return ContactResult.out_of_range(state, pose, "the pose is not finite")
        samples, material = state.surface, state.pair.material
        # The femoral component is rigid, so only the insert's compliance counts.
        plane_modulus = material.young_modulus / (1 - material.poisson_ratio**2)
        pressure = np.zeros((2, len(samples.points)))
        patches: list[CondyleContact | None] = [None, None]
        flags: list[str] = []
        for side, geometry in enumerate(condyle_geometry(state, pose, self.patch_radius)):
            if geometry is None:
                continue
            if geometry.contact is None:
                if pose[1, 3] < geometry.height:
                    return ContactResult.out_of_range(
                        state, pose, f"{SIDES[side]} condyle {CONFORMING}"
                    )
                continue
            depth = indentation(geometry, pose)
            if depth <= 0:
                continue
            # Hertz's gap is A x² + B y² with A and B half the relative principal curvatures.
            flat, steep = geometry.contact.relative / 2
            patch = contact_ellipse(flat, steep, depth, plane_modulus)
            pressure[side], share = map_pressure(samples, geometry.contact, patch)
            if share < LEAST_SHARE_ON_INSERT:
                return ContactResult.out_of_range(
                    state, pose, f"{SIDES[side]} contact ellipse leaves the insert"
                )
            described = patches[side] = _described(samples, geometry.contact, patch)
            if depth >= described.thickness:
                words = f"the {SIDES[side]} condyle is deeper than the insert is thick"
                most = described.thickness / MILLIMETRE
                measured = f"{words}: {depth / MILLIMETRE:.2f} mm deep, at most {most:.2f} mm"
                return ContactResult.out_of_range(state, pose, measured)
            if patch.long_axis > described.thickness:
                flags.append(
                    f"the long semi-axis of the {SIDES[side]} contact ellipse exceeds the "
                    "thickness of the insert: Hertz assumes a half-space"
                )
        sides = dict(zip(SIDES, pressure > 0, strict=True))
        total = pressure.sum(axis=0)
        flags += unsupported_flags(state.pair.insert, samples.points, total, sides)
        return _collected(state, pose, pressure, patches, tuple(flags))


def condyle_geometry(
    state: SampledContact, pose: Array, patch_radius: float
) -> tuple[CondyleGeometry | None, CondyleGeometry | None]:
    """Return the first touch of each condyle; None for a condyle that is not over the insert.

    The pose's y has no influence. The last eight results are cached.
    """
    level = np.array(pose, float)
    # The geometry does not depend on the height: all evaluations of one press share a result.
    level[1, 3] = 0.0
    return _geometry(state, level.tobytes(), patch_radius)


def indentation(geometry: CondyleGeometry, pose: Array) -> float:
    """Return delta (m); negative when apart, NaN without a contact."""
    contact = geometry.contact
    if contact is None:
        return float("nan")
    # Travel is along y, penetration along the normal at the contact point.
    return float((geometry.height - pose[1, 3]) * contact.normal[1] - contact.gap)


def map_pressure(
    samples: SurfaceSamples, contact: OsculatingContact, patch: ContactEllipse
) -> tuple[Array, float]:
    """Return the pressure (n,), Pa, at the samples, and the share of the force on the insert.

    It is averaged over sub-cells and scaled so that the vertical force is the patch's force times
    n_y. A patch much narrower than a cell loads the nearest point alone.
    """
    pressure = np.zeros(len(samples.points))
    offset = samples.points - contact.point
    # The map must have the correct force along y, because a load prescribes this component.
    vertical_force = patch.force * contact.normal[1]
    if patch.short_axis < samples.resolution / MOST_SUB_CELLS * SHORT_AXIS_SUB_CELLS:
        nearest = int(np.einsum("ij,ij->i", offset, offset).argmin())
        pressure[nearest] = vertical_force / (samples.area[nearest] * samples.normals[nearest, 1])
        return pressure, 1.0
    beyond = np.abs(offset @ contact.axes.T) - [patch.long_axis, patch.short_axis]
    # Another surface of the insert below or above the contact (post, lip) is not in contact.
    same_surface = np.abs(offset @ contact.normal) < patch.long_axis + samples.resolution
    near = np.flatnonzero((beyond.max(axis=1) < 2 * samples.resolution) & same_surface)
    pressure[near] = patch.peak_pressure * _cell_means(samples, near, contact, patch)
    force_on_map = float((pressure * samples.area) @ samples.normals[:, 1])
    return (
        (pressure * (vertical_force / force_on_map), force_on_map / vertical_force)
        if force_on_map > 0
        else (pressure, 0.0)
    )


def _cell_means(
    samples: SurfaceSamples,
    near: Index,
    contact: OsculatingContact,
    patch: ContactEllipse,
) -> Array:
    """Return the mean of sqrt(1 - (u/a)² - (v/b)²) over the grid cells of points (m,)."""
    needed_sub_cells = int(np.ceil(SHORT_AXIS_SUB_CELLS * samples.resolution / patch.short_axis))
    count = min(max(needed_sub_cells, FEWEST_SUB_CELLS), MOST_SUB_CELLS)
    ticks = ((np.arange(count) + 0.5) / count - 0.5) * samples.resolution
    dx, dz = (grid.ravel() for grid in np.meshgrid(ticks, ticks))
    normals = samples.normals[near]
    slope = -normals[:, [0, 2]] / np.maximum(normals[:, 1:2], MAP_POINT.least_normal_y)
    rise = slope[:, :1] * dx + slope[:, 1:] * dz
    offset = np.stack(np.broadcast_arrays(dx, rise, dz), axis=-1)
    positions = (samples.points[near] - contact.point)[:, None] + offset
    u, v = np.moveaxis(positions @ contact.axes.T, -1, 0)
    # Hertz's pressure is p0 sqrt(1 - (u/a)² - (v/b)²) inside the ellipse.
    inside = 1 - (u / patch.long_axis) ** 2 - (v / patch.short_axis) ** 2
    return np.sqrt(np.maximum(inside, 0.0)).mean(axis=1)


def _described(
    samples: SurfaceSamples, contact: OsculatingContact, patch: ContactEllipse
) -> CondyleContact:
    area = np.pi * patch.long_axis * patch.short_axis
    return CondyleContact(
        force=patch.force,
        area=area,
        mean_pressure=patch.force / area,
        peak_pressure=patch.peak_pressure,
        centre_of_pressure=contact.point,
        thickness=thickness_under(contact.point, samples.points, samples.thickness),
    )


def _collected(
    state: SampledContact,
    pose: Array,
    pressure: Array,
    patches: list[CondyleContact | None],
    flags: tuple[str, ...],
) -> ContactResult:
    total = pressure.sum(axis=0)
    gap = gaps_along_normals(state.surface, state.pair.femoral, pose)
    result = ContactResult.of(state, pose, total, gap, medial=pressure[0] > 0)
    sides = {
        side: None
        if patch is None or condyle is None
        else replace(patch, force=condyle.force, mean_pressure=condyle.force / patch.area)
        for side, patch, condyle in zip(
            SIDES, patches, (result.medial, result.lateral), strict=True
        )
    }
    of_map = set(peak_flags({"medial": result.medial, "lateral": result.lateral}))
    others = (flag for flag in result.flags if flag not in of_map)
    return replace(
        result,
        medial=sides["medial"],
        lateral=sides["lateral"],
        flags=(*flags, *peak_flags(sides), *others),
    )


@lru_cache(maxsize=8)
def _geometry(
    state: SampledContact, level: bytes, patch_radius: float
) -> tuple[CondyleGeometry | None, CondyleGeometry | None]:
    pose = np.frombuffer(level).reshape(4, 4)
    condyles: list[CondyleGeometry | None] = []
    for touch in state.pair.first_touch.at(pose):
        if touch is None:
            condyles.append(None)
            continue
        touching = pose.copy()
        touching[1, 3] = -touch.travel
        contact = osculate(
            state.pair.insert.rays, state.pair.femoral.rays, touching, touch.point, patch_radius
        )
        usable = (
            contact is not None
            and contact.relative[0] > SMALLEST_CURVATURE_RATIO * contact.relative[1]
        )
        condyles.append(CondyleGeometry(-touch.travel, contact if usable else None))
    return condyles[0], condyles[1]
